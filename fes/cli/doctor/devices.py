"""Do the session's devices answer, at their rates? Sensors are read for two seconds; no stimulator is commanded."""

import errno
import os
import select
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from drivers.imu.open import ON_CAN, WITHOUT_LINE, open_imus
from drivers.imu.port import ImuLost, ImuPort, LineCounts
from drivers.stimulator.bus import BusError, bus_name, open_bus
from drivers.stimulator.can_codec import PROTOCOL_VERSION, Alive, FrameRejected, decode, fault_text
from drivers.stimulator.open import open_stimulator
from drivers.stimulator.port import StimulatorLost
from drivers.stimulator.serial_line import latency_hint
from drivers.switches import SwitchFailed, open_switch
from fes.cli.common.options import cannot_be_seen
from fes.cli.doctor.command import Finding, failure, ok, warning
from fes.cli.run.devices import serial_ports_of
from fes.config import ConfigError, ImuDevice, Session, Switch
from fes.live.sensor_monitor import RATE_TOLERANCE, alive_ns
from fes.signals import NS_PER_S

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
    remedy = "switch the stimulator on; check channel, bit rate, cable and termination (120 ohm at both ends)"
    return failure(name, f"{where}: no heartbeat within {HEARTBEAT_WAIT_S:g} s ({frames} other frames)", remedy)


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
