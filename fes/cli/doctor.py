"""``fes doctor``: everything that can be checked before a session, and what to do about what is not right.

Is this computer fit for a session? Its clock, disk, permissions, compiled code; how a check's finding is shown.
"""

from __future__ import annotations

import ctypes
import errno
import grp
import json
import os
import select
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Final

import click

from drivers.imu.open import ON_CAN, WITHOUT_LINE, open_imus
from drivers.imu.port import ImuLost, ImuPort, LineCounts
from drivers.stimulator.bus import BusError, bus_name, open_bus, silence_hint
from drivers.stimulator.can_codec import PROTOCOL_VERSION, Alive, FrameRejected, decode, fault_text
from drivers.stimulator.open import open_stimulator
from drivers.stimulator.port import StimulatorLost
from drivers.stimulator.serial_line import latency_hint
from drivers.switches import SwitchFailed, open_switch
from fes.cli.common import FAILED, PATH, Number, cannot_be_seen, not_there
from fes.cli.run.devices import serial_ports_of
from fes.config import ConfigError, ImuDevice, Session, Switch, load_session, refuse_blind_targets
from fes.estimation.sensor_choice import phase_sensors
from fes.estimation.warm_up import COMPILES, NOT_COMPILED, warm_up
from fes.live.processes import Grant, fixed_priority, locked_memory
from fes.live.sensor_monitor import RATE_TOLERANCE, alive_ns
from fes.session_log import SessionLogError
from fes.session_log.writer import SessionWriter
from fes.signals import NS_PER_S, ImuSample, StimCommand, WireFrame

# --- Do the session's devices answer, at their rates? Sensors are read for two seconds; no stimulator is commanded ---


SETTLE_S: Final = 0.3  # what had queued up before it was opened, and a clock that is only just known
MEASURE_S: Final = 2.0
HEARTBEAT_WAIT_S: Final = 1.0
SWITCH_WAIT_S: Final = 1.0
CLOCK_TOLERANCE: Final = 0.05  # as the gate's: a sensor's clock that runs so far off has no time to be trusted
DIALOUT: Final = "sudo usermod -aG dialout $USER, then log in again"


def devices(session: Session) -> Iterator[Finding]:
    """Every check of what the session names."""
    yield from sensors(session)
    yield stimulator(session)
    for switch in session.foot_switches:
        yield switch_answers(f"{switch.foot}'s switch", switch, session)
    if session.live.stop_button is not None:
        yield switch_answers("stop button", session.live.stop_button, session)
    for port in serial_ports_of(session):
        if hint := latency_hint(port):
            said, _, remedy = hint.partition("; ")
            yield warning("latency timer", said, remedy)


def port_fault(name: str, port: str) -> Finding | None:
    """Why a serial port cannot be opened, where that can be told without trying; None when nothing is wrong."""
    if "://" in port:
        return None
    if hidden := cannot_be_seen(port):
        return failure(name, f"{port}: {hidden}", "run as a user who may enter its folder, or name the port otherwise")
    if not Path(port).exists():
        return failure(name, f"{port}: there is no such port", "plug it in and switch it on; `fes devices` lists ports")
    if not os.access(port, os.R_OK | os.W_OK):
        return failure(name, f"{port}: this user may not open it", DIALOUT)
    return None


@dataclass
class Heard:
    """What came from one sensor while it was measured."""

    device: ImuDevice
    host_ns: list[int] = field(default_factory=list)
    device_ns: list[int] = field(default_factory=list)
    missing: int = 0
    clipped: int = 0


def sensors(session: Session, measure_s: float = MEASURE_S) -> Iterator[Finding]:
    """Open every sensor, read all at once for two seconds, hold the rates against the settings."""
    heard: dict[str, Heard] = {}
    ports: list[ImuPort] = []
    lines: dict[tuple[str, str], list[ImuDevice]] = {}
    for device in session.sensors:  # those that share a bus are opened together, or one would take the other's frames
        kind = "can" if device.device in ON_CAN else str(device.sensor)
        lines.setdefault((kind, device.port), []).append(device)
    try:
        for group in lines.values():
            if group[0].device not in (*ON_CAN, *WITHOUT_LINE) and (
                fault := port_fault(str(group[0].sensor), group[0].port)
            ):
                yield fault
                continue
            try:
                ports += open_imus(group, session.bus)
            except (ImuLost, BusError, ConfigError, ValueError) as error:
                yield failure(", ".join(str(each.sensor) for each in group), *_why(error))
            else:
                heard |= {str(each.sensor): Heard(each) for each in group}
        if ports:
            lost, took_s = _listen(ports, heard, measure_s)
            for sensor, each in heard.items():
                yield lost[sensor] if sensor in lost else judged(sensor, each, took_s)
            for notice in (notice for port in ports if not set(port.sensors) & lost.keys() for notice in port.notices):
                sensor, _, said = notice.partition(": ")
                yield warning(sensor, said, "see to it before the session; docs/imus.md says what it means")
    finally:
        for port in ports:
            port.close()


def _why(error: Exception) -> tuple[str, str]:
    """What is wrong, and the remedy, from a driver's words."""
    said = str(error)
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, PermissionError) or getattr(cause, "errno", None) == errno.EACCES:
            return said, DIALOUT
        cause = cause.__cause__
    if any(word in said for word in ("exclusively lock", "busy", "Resource temporarily unavailable")):
        return f"in use by another program: {said}", "end the program that uses it (Linux: fuser -v PORT names it)"
    return said, "check cable, power and settings; `fes devices` lists what is connected"


def _listen(ports: Sequence[ImuPort], heard: dict[str, Heard], measure_s: float) -> tuple[dict[str, Finding], float]:
    """What was lost, and how long it listened: from the end of the last reading that does not count."""
    since_ns = now_ns = time.monotonic_ns()
    begin_ns = since_ns + int(SETTLE_S * NS_PER_S)
    end_ns = begin_ns + int(measure_s * NS_PER_S)
    before: dict[str, LineCounts] = {}
    lost: dict[str, Finding] = {}
    while now_ns < end_ns:
        counts = now_ns >= begin_ns
        alive = [port for port in ports if not set(port.sensors) & lost.keys()]
        waiting = [number for port in alive if (number := port.fileno()) is not None]
        select.select(waiting, [], [], 0.001 if len(waiting) < len(alive) else 0.05)
        for port in alive:
            try:
                samples = port.read(time.monotonic_ns())
            except ImuLost as error:
                lost |= {sensor: failure(sensor, *_why(error)) for sensor in port.sensors}
                continue
            read_ns = time.monotonic_ns()
            for sample in samples if counts else ():
                each = heard[sample.sensor]
                each.host_ns.append(read_ns)
                each.device_ns.append(sample.t_device_ns)
                now = port.counts[sample.sensor]
                first = before.setdefault(sample.sensor, replace(now))
                each.missing, each.clipped = now.missing - first.missing, now.clipped - first.clipped
        now_ns = time.monotonic_ns()
        since_ns = since_ns if counts else now_ns
    return lost, (now_ns - since_ns) / NS_PER_S


def judged(sensor: str, heard: Heard, measure_s: float) -> Finding:
    """One sensor's two seconds held against its settings."""
    nominal_hz, n = heard.device.rate_hz, len(heard.host_ns)
    if n < 2:
        remedy = "switch it on; is it measuring, and is the port its own?"
        return failure(sensor, f"{heard.device.port}: nothing is heard", remedy)
    rate_hz = n / measure_s
    quiet_ns = max(later - earlier for earlier, later in zip(heard.host_ns, heard.host_ns[1:], strict=False))
    own_s, host_s = _elapsed_s(heard)
    said = f"{rate_hz:.1f} Hz, {heard.missing} lost, longest silence {quiet_ns / 1e6:.0f} ms"
    said += f", {heard.clipped} at the end of their range" if heard.clipped else ""
    if abs(rate_hz - nominal_hz) > RATE_TOLERANCE * nominal_hz:
        remedy = f"set rate_hz = {rate_hz:.0f} if the sensor is meant to run so, or set the sensor to {nominal_hz:g} Hz"
        return failure(sensor, f"{said}; the settings say {nominal_hz:g} Hz", remedy)
    if host_s > 0.5 and abs(own_s / host_s - 1.0) > CLOCK_TOLERANCE:
        said += f"; its clock runs {own_s / host_s:.3f} times as fast as this computer's"
        return failure(sensor, said, "restart the sensor")
    most_ns = alive_ns(heard.device)
    if heard.missing or quiet_ns > most_ns:
        remedy = "bring it nearer, use another channel or cable, close other programs"
        return warning(sensor, f"{said}; stimulation stops at a silence of {most_ns / 1e6:.0f} ms", remedy)
    return ok(sensor, said)


def _elapsed_s(heard: Heard) -> tuple[float, float]:
    """How much time passed by the sensor's clock and by ours, between the samples that waited least at either end.

    The first or the last one may have waited for a program that was held up.
    """
    n = len(heard.host_ns)
    late_ns = [host - own for host, own in zip(heard.host_ns, heard.device_ns, strict=True)]
    first = min(range(-(-n // 4)), key=late_ns.__getitem__)
    last = min(range(n - -(-n // 4), n), key=late_ns.__getitem__)
    own_ns, host_ns = (times[last] - times[first] for times in (heard.device_ns, heard.host_ns))
    return own_ns / NS_PER_S, host_ns / NS_PER_S


def stimulator(session: Session) -> Finding:
    """The bus opens and a heartbeat is heard; a serial device answers to its handshake. Nothing is stimulated."""
    settings = session.stimulator
    if settings.device == "can":
        return _heartbeat(session)
    if settings.device != "canopen" and (fault := port_fault("stimulator", settings.port)):
        return fault
    try:
        with closing(open_stimulator(settings, session, 1)) as port:
            port.open(time.monotonic_ns())
    except (StimulatorLost, ConfigError) as error:
        return failure("stimulator", *_why(error))
    return ok("stimulator", f"{settings.device} on {settings.port or bus_name(session.bus)} answers")


def _heartbeat(session: Session) -> Finding:
    name, where = "stimulator", bus_name(session.bus)
    try:
        bus = open_bus(session.bus)
    except BusError as error:
        return failure(name, *_why(error))
    frames = 0
    with bus:
        end_s = time.monotonic() + HEARTBEAT_WAIT_S
        while (left_s := end_s - time.monotonic()) > 0:
            try:
                message = bus.recv(timeout=left_s)
                heard = None if message is None else decode(message.arbitration_id, bytes(message.data))
            except FrameRejected:
                heard = None
            except OSError as error:
                return failure(name, f"{where}: cannot be read: {error}", "check the adapter")
            frames += message is not None
            if isinstance(heard, Alive):
                said = f"{where}: heartbeat of boot {heard.boot_id}"
                if heard.version != PROTOCOL_VERSION:
                    said += f", protocol version {heard.version} instead of {PROTOCOL_VERSION}"
                    return failure(name, said, "update the older one")
                if heard.faults:
                    return failure(name, f"{said}, faults: {fault_text(heard.faults)}", "check electrodes and leads")
                return ok(name, said)
    said = f"{where}: no heartbeat within {HEARTBEAT_WAIT_S:g} s ({frames} other frames)"
    return failure(name, said, silence_hint(bus))


def switch_answers(name: str, settings: Switch, session: Session) -> Finding:
    """The switch says whether it is pressed, and is not."""
    try:
        switch = open_switch(settings, session.bus)
    except SwitchFailed as error:
        return failure(name, *_why(error))
    with closing(switch):
        end_s = time.monotonic() + SWITCH_WAIT_S
        while (pressed := switch.read()) is None and time.monotonic() < end_s:
            time.sleep(0.01)
    if pressed is None:
        return failure(name, "nothing is heard of it", "check its cable, identifier and bit")
    if pressed and name == "stop button":
        return failure(name, "is pressed", "release it")
    return ok(name, "is pressed" if pressed else "is not pressed")


class Verdict(StrEnum):
    """Whether a session can be begun with it."""

    OK = "ok"
    WARNING = "warning"
    FAILURE = "failure"


@dataclass(frozen=True, slots=True)
class Finding:
    """One check: what was looked at, what was found, and for what is not right the ``remedy``."""

    name: str
    verdict: Verdict
    said: str
    remedy: str = ""


COLOURS: Final = {Verdict.OK: "green", Verdict.WARNING: "yellow", Verdict.FAILURE: "red"}


def ok(name: str, said: str) -> Finding:
    """All is well."""
    return Finding(name, Verdict.OK, said)


def warning(name: str, said: str, remedy: str) -> Finding:
    """It works, at a cost that ``said`` names."""
    return Finding(name, Verdict.WARNING, said, remedy)


def failure(name: str, said: str, remedy: str) -> Finding:
    """A session would not begin, or not hold."""
    return Finding(name, Verdict.FAILURE, said, remedy)


FINEST_NS: Final = 1_000_000  # a clock that is coarser cannot tell one sample of a 1 kHz sensor from the next
SLEW_PPM: Final = 500.0  # the most that time servers turn a clock by
SLOW_SYNC_S: Final = 0.25  # what a crash of the whole computer may lose
SYNCS: Final = 8
COMPILED_S: Final = 3.0
ROOM_BYTES: Final = 1 << 20  # of a log beside its samples: header, strides, notes
PORT_GROUPS: Final = ("dialout", "uucp", "plugdev")


def clock(for_s: float = 0.2) -> Finding:
    """The monotonic clock: how fine, and by how much it is being turned towards a time server now."""
    name, remedy = "clock", "choose another clock source in the kernel"
    finest_ns = min(_step_ns() for _ in range(20))
    raw = getattr(time, "CLOCK_MONOTONIC_RAW", None)
    if finest_ns > FINEST_NS:
        return failure(name, f"counts in steps of {finest_ns / 1e6:.1f} ms", remedy)
    if raw is None:
        return ok(name, f"counts in steps of {finest_ns} ns")
    began = time.monotonic_ns(), time.clock_gettime_ns(raw)
    time.sleep(for_s)
    ended = time.monotonic_ns(), time.clock_gettime_ns(raw)
    drift_ppm = 1e6 * ((ended[0] - began[0]) / (ended[1] - began[1]) - 1.0)
    said = f"counts in steps of {finest_ns} ns, is turned by {drift_ppm:+.0f} ppm"
    if abs(drift_ppm) > SLEW_PPM:
        return warning(name, said, "let the time server finish before the session (chronyc waitsync, timedatectl)")
    return ok(name, said)


def _step_ns() -> int:
    began_ns = now_ns = time.monotonic_ns()
    while now_ns == began_ns:
        now_ns = time.monotonic_ns()
    return now_ns - began_ns


def disk(session: Session | None, out: Path, hours: float) -> Iterator[Finding]:
    """Whether the results' folder takes a session of so many hours, at the rate that a log of it grows."""
    name, remedy = "disk", "make room, or choose another folder with --out"
    place = next(each for each in (out, *out.absolute().parents) if not not_there(each))
    try:
        with tempfile.TemporaryDirectory(prefix=".fes-doctor-", dir=place) as folder:
            bytes_per_s = log_bytes_per_s(session, Path(folder))
            syncs_s = _syncs_s(Path(folder))
    except (OSError, SessionLogError) as error:
        why = getattr(error, "strerror", None) or error
        yield failure(name, f"{place} cannot be written: {why}", remedy)
        return
    free = shutil.disk_usage(place).free
    needed = int(hours * 3600 * bytes_per_s) + ROOM_BYTES
    growth = f"{hours:g} h of log need {needed / 1e9:.2f} GB ({bytes_per_s / 1e3:.0f} kB/s)"
    said = f"{place}: {free / 1e9:.2f} GB free, {growth}"
    yield failure(name, said, remedy) if free < needed else ok(name, said)
    said = f"an fsync takes {1e3 * statistics.median(syncs_s):.0f} ms, {1e3 * max(syncs_s):.0f} ms at worst"
    if max(syncs_s) > SLOW_SYNC_S:
        remedy = "a power cut may lose more than 250 ms of the log (a crash of fes does not); use a local disk"
        yield warning("disk speed", said, remedy)
    else:
        yield ok("disk speed", said)


def log_bytes_per_s(session: Session | None, folder: Path) -> float:
    """How fast the log of this session grows, from a log of ten seconds with values that do not repeat."""
    rates_hz = {str(device.sensor): device.rate_hz for device in session.sensors} if session else {}
    rates_hz = rates_hz or {"left_foot": 500.0, "right_foot": 500.0}
    path = folder / "rate.feslog"
    log = SessionWriter(path, {})
    begun = path.stat().st_size
    seconds = 10
    for sensor, rate_hz in rates_hz.items():
        for number in range(int(seconds * rate_hz)):
            t_ns = int(number * NS_PER_S / rate_hz)
            value = number % 997 * 0.01
            log.event(ImuSample(t_ns, sensor, t_ns, (value, -value, 9.81), (value, value, -value)))
            log.latency(t_ns, 100_000 + number)
    channels = len(session.channels) if session else 1
    for number in range(int(seconds * (session.stimulation.command_rate_hz if session else 50.0))):
        t_ns = number * NS_PER_S // 50
        for channel in range(channels):
            log.command(StimCommand(t_ns, channel, True, 20.0, 300.0, 40.0, 60), WireFrame(t_ns, 1, bytes(16)))
    log.close({})
    return (path.stat().st_size - begun) / seconds


def _syncs_s(folder: Path) -> list[float]:
    took_s = []
    with (folder / "sync").open("wb", buffering=0) as file:
        for _ in range(SYNCS):
            file.write(os.urandom(1 << 14))
            began_s = time.perf_counter()
            os.fsync(file.fileno())
            took_s.append(time.perf_counter() - began_s)
    return took_s


def permissions() -> Iterator[Finding]:
    """What the loop will ask the operating system for; given back at once."""
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    grants = [fixed_priority()]
    with suppress(OSError):
        os.sched_setscheduler(0, policy, parameters)
    grants.append(locked_memory())
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).munlockall()
    for grant in grants:
        yield of_grant(grant)


def of_grant(grant: Grant) -> Finding:
    """A refusal is no obstacle, but its cost must be known."""
    if grant.refused:
        return warning(grant.name, f"{grant.refused}; {grant.cost}", grant.remedy)
    return ok(grant.name, "granted")


def group(ids: set[int] | None = None) -> Finding:
    """Whether this user may open serial ports in general."""
    name = "serial ports' group"
    if os.geteuid() == 0 and ids is None:
        return ok(name, "runs as root")
    mine = set(os.getgroups()) if ids is None else ids
    there = {each.gr_name: each.gr_gid for each in grp.getgrall() if each.gr_name in PORT_GROUPS}
    member = sorted(group for group, number in there.items() if number in mine)
    if member:
        return ok(name, f"member of {', '.join(member)}")
    wanted = next((group for group in PORT_GROUPS if group in there), PORT_GROUPS[0])
    remedy = f"sudo usermod -aG {wanted} $USER; log in again"
    return warning(name, f"not a member of {wanted}; serial ports may be refused", remedy)


def compiled() -> Finding:
    """The compiled code, compiled now if it was not."""
    began_s = time.perf_counter()
    warm_up()
    took_s = time.perf_counter() - began_s
    if NOT_COMPILED:
        return warning("compiled code", NOT_COMPILED, COMPILES)
    if took_s > COMPILED_S:
        return ok("compiled code", f"was compiled now, in {took_s:.0f} s; the next start is quicker")
    return ok("compiled code", f"warm in {took_s:.1f} s")


@click.command(name="doctor")
@click.argument("session", type=PATH, required=False)
@click.option("--out", type=PATH, help="Where results will go. Default: the session's live.folder.")
@click.option("--stop-file", type=PATH, help="As for `fes run`. Default: live.stop_file.")
@click.option("--hours", type=Number(min=0.01), default=4.0, show_default=True, help="Length of the session.")
@click.option("--json", "as_json", is_flag=True, help="As JSON on stdout.")
def command(session: Path | None, out: Path | None, stop_file: Path | None, hours: float, as_json: bool) -> None:
    """Check ports, buses, rates, clocks, disk and permissions; with SESSION (TOML) also all that it names.

    Sensors are read for two seconds. The stimulator is asked whether it is there; nothing is stimulated.

    Exit code: 0 a session can begin (warnings name a cost), 1 it cannot.
    """
    findings = []
    for finding in examined(session, out, stop_file, hours):
        findings.append(finding)
        if not as_json:
            word = click.style(f"{finding.verdict:<8}", fg=COLOURS[finding.verdict])
            click.echo(f"{word} {finding.name}: {finding.said}")
            if finding.remedy:
                click.echo(f"{'':<9}→ {finding.remedy}")
    failures = sum(finding.verdict is Verdict.FAILURE for finding in findings)
    if as_json:
        listed = [asdict(finding) for finding in findings]
        click.echo(json.dumps({"ok": not failures, "findings": listed}, indent=2))
    if failures:
        click.secho(f"{failures} of {len(findings)} checks failed; a session would not hold.", fg="red", err=True)
        raise SystemExit(FAILED)


def examined(path: Path | None, out: Path | None, stop_file: Path | None, hours: float) -> Iterator[Finding]:
    """One finding after the other, as they come."""
    session: Session | None = None
    if path is not None:
        try:
            session = load_session(path)
            refuse_blind_targets(session, path)
        except ConfigError as error:
            yield failure(
                "session",
                str(error),
                "correct the file; docs/sessions.md lists every setting, docs/tuning.md those of tuning",
            )
        else:
            yield from settings(path, session, stop_file)
    elif stop_file:
        yield stop_file_finding(stop_file)
    yield clock()
    yield from disk(session, out or Path(session.live.folder if session else "out"), hours)
    yield from permissions()
    yield group()
    yield compiled()
    if session is not None:
        yield from devices(session)


def settings(path: Path, session: Session, stop_file: Path | None = None) -> Iterator[Finding]:
    """What the session file says, as far as a live session needs it; ``stop_file`` in place of its own."""
    if not session.channels:
        yield warning("session", f"{path}: has no channel; nothing can be stimulated", "add a [[channels]] table")
    else:
        names = ", ".join(f"{c.name} ≤ {c.limits.max_current_ma:g} mA" for c in session.channels)
        yield ok("session", f"{path}: all limits are present ({names})")
    if not session.sensors:
        yield failure("session", f"{path}: has no [[sensors]] table", "add one for each sensor; see docs/live.md")

    driven = phase_sensors(str(device.sensor) for device in session.sensors)
    for channel in session.channels:
        if session.sensors and channel.foot not in driven:
            said = f"{channel.name} follows the {channel.foot}, which no sensor is worn on"
            yield failure("session", said, "add its [[sensors]]")
    if stop_file or session.live.stop_file:
        yield stop_file_finding(stop_file or Path(session.live.stop_file))


def stop_file_finding(path: Path) -> Finding:
    """Whether the file is away, and could appear."""
    name, folder = "stop file", path.absolute().parent
    if hidden := cannot_be_seen(path):
        remedy = "name a file in a folder that this user may enter; it would never be seen to appear"
        return failure(name, f"{path}: {hidden}", remedy)
    if os.path.lexists(path):  # a link that leads nowhere is there too
        return failure(name, f"{path} is there; arming would be refused", "remove it")
    if not folder.is_dir():
        return failure(name, f"{path} cannot appear: {folder} is no folder; arming would be refused", "make the folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        remedy = "name a file in a folder that all may write to who are to stop the session"
        return warning(name, f"{path}: this user may not write to {folder}, and cannot stop the session by it", remedy)
    return ok(name, f"{path} is not there")
