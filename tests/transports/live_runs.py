"""`fes run` as a process of its own between simulated sensors and a simulated stimulator, each in theirs."""

from __future__ import annotations

import json
import os
import pty
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from replays import MS, SETTINGS, cut, edit, keep, trial
from shank_walks import ShankWalk, shank_walk

from drivers.simulated.record import RecordEntry, RecordReader
from drivers.simulated.spawn import (
    DeviceHandle,
    DeviceKind,
    ImuHandle,
    ImuKind,
    NodeHandle,
    spawn_device,
    spawn_imu,
    spawn_node,
)
from fes.calibration.recording import SensorCalibrations, calibrate_phase_sensors, calibrate_shank_track, save
from fes.config import Bus
from fes.live.operator import ASKED
from fes.live.status import Status
from fes.recording import Recording, Track, write_recording
from fes.session_log import SessionRecord

TAP_EVERY_S = 1.5  # a second of rest before the next one
STAND_S = 8  # so that a session that has just begun can be armed before the first step
FOOT = "right_foot"
RATE_HZ = 500.0
EVERY = 5  # of its samples, for lines that execute less
SLOW_RATE_HZ = RATE_HZ / EVERY
SHANK = "right_shank"
SHANK_RATE_HZ = 100.0
INTENSITY = 0.6
MOST_MA = 30.0 * INTENSITY
LISTING = """
import atexit, pathlib, sys
from fes.cli import main
atexit.register(lambda: pathlib.Path("loaded.txt").write_text("\\n".join(sys.modules)))
main(prog_name="fes")
"""
PULSE_GAP_NS = 60 * MS  # a pulse train of 40 Hz with no pulse for so long is off
LEASE_NS = 60 * MS
PERIOD_NS = 20 * MS  # between commands of a burst
TURN_NS = 5 * MS  # of a simulated device's loop, at most, while nothing holds it up
BEGUN_NS = 300 * MS  # a burst that began longer ago may end by itself before a blow has struck; the shortest last 0.5 s


def standing_first(recording: Recording, stand_s: int) -> Recording:
    """The recording with its first second, at rest, so many times before it."""

    def longer(track: Track) -> Track:
        n = int(track.rate_hz)
        rows = np.concatenate([np.tile(np.arange(n), stand_s), np.arange(n, len(track.t_ns))])
        t_ns = (np.arange(len(rows)) * 1e9 / track.rate_hz).astype(np.int64)
        return replace(
            track, t_ns=t_ns, t_sensor_ns=t_ns, acc_mps2=track.acc_mps2[rows], gyr_radps=track.gyr_radps[rows]
        )

    return replace(recording, tracks={name: longer(track) for name, track in recording.tracks.items()})


def prepare(folder: Path, every: int = 1) -> tuple[Path, Path]:
    """A recording to play round and round (standing, then seven seconds of walking), and its calibration.

    Of its samples only every so manieth is kept.
    """

    def thinned(track: Track) -> Track:
        return replace(keep(track, slice(None, None, every)), rate_hz=track.rate_hz / every)

    whole = edit(trial("negard_patient2"), thinned)
    recording, calibration = folder / f"loop{every}.parquet", folder / f"loop{every}.calibration.json"
    write_recording(standing_first(cut(whole, 3.0, 11.0), STAND_S), recording)
    save(calibrate_phase_sensors(whole), calibration)
    return recording, calibration


def prepare_shank(folder: Path) -> tuple[Path, Path]:
    """The same for a shank: standing, six strides, standing."""
    made = shank_walk(standing_s=STAND_S, strides=6, noise=0.02, rate_hz=SHANK_RATE_HZ, seed=3)
    learnt = shank_walk(standing_s=2.0, strides=12, noise=0.02, rate_hz=SHANK_RATE_HZ, seed=3)
    whole = trial("soft_contact")
    (foot,) = whole.tracks.values()

    def track_of(walk: ShankWalk) -> Track:
        return replace(
            foot,
            sensor=SHANK,
            rate_hz=SHANK_RATE_HZ,
            t_ns=walk.t_ns,
            t_sensor_ns=walk.t_ns,
            acc_mps2=walk.acc,
            gyr_radps=walk.gyr,
        )

    recording, calibration = folder / "shank.parquet", folder / "shank.calibration.json"
    write_recording(replace(whole, tracks={SHANK: track_of(made)}), recording)
    save(SensorCalibrations({SHANK: calibrate_shank_track(track_of(learnt))}), calibration)
    return recording, calibration


# --- what is connected -----------------------------------------------------------------------------------

Stimulator = NodeHandle | DeviceHandle


@dataclass
class Bench:
    """A sensor, a stimulator, and what the session file says of them."""

    sensor: str
    imu: ImuHandle
    stimulator: Stimulator
    text: str


def sensor_text(
    device: str, port: str, *, sensor: str = FOOT, rate_hz: float = RATE_HZ, options: str = "baudrate = 921600"
) -> str:
    return (
        f'[[sensors]]\nsensor = "{sensor}"\ndevice = "{device}"\nport = "{port}"\nrate_hz = {rate_hz}\n'
        f"acc_range_g = 16\ngyr_range_dps = 2000\n[sensors.options]\n{options}\n"
    )


def bus_text(bus: Bus) -> str:
    options = "".join(f"{name} = {json.dumps(value)}\n" for name, value in bus.options.items())
    return f'[bus]\ninterface = "{bus.interface}"\nchannel = "{bus.channel}"\n[bus.options]\n{options}'


def xbus_and_can(folder: Path, recording: Path, stack: ExitStack) -> Bench:
    """A foot's sensor on a serial line, the stimulator on CAN."""
    node = stack.enter_context(spawn_node(record=folder / "node.jsonl"))
    imu = stack.enter_context(spawn_imu("xbus", sensor=FOOT, recording=recording, rate_hz=RATE_HZ))
    return Bench(FOOT, imu, node, bus_text(node.bus) + sensor_text("xbus", imu.port))


def xsens_can_and_can(folder: Path, recording: Path, stack: ExitStack) -> Bench:
    """Both on one CAN bus."""
    node = stack.enter_context(spawn_node(record=folder / "node.jsonl"))
    imu = stack.enter_context(
        spawn_imu("xsens_can", sensor=FOOT, recording=recording, rate_hz=SLOW_RATE_HZ, bus=node.bus, id_offset=0x400)
    )
    options = "id_offset = 0x400"
    return Bench(
        FOOT,
        imu,
        node,
        bus_text(node.bus) + sensor_text("xsens_can", "bus", rate_hz=SLOW_RATE_HZ, options=options),
    )


def shank_and_can(folder: Path, recording: Path, stack: ExitStack) -> Bench:
    """No sensor on the foot: the shank's drives it."""
    node = stack.enter_context(spawn_node(record=folder / "node.jsonl"))
    imu = stack.enter_context(spawn_imu("xbus", sensor=SHANK, recording=recording, rate_hz=SHANK_RATE_HZ))
    sensor = sensor_text("xbus", imu.port, sensor=SHANK, rate_hz=SHANK_RATE_HZ)
    return Bench(SHANK, imu, node, bus_text(node.bus) + sensor)


def lsl_and_can(folder: Path, recording: Path, stack: ExitStack) -> Bench:
    """A sensor's stream over Lab Streaming Layer."""
    name = f"fes-run-{os.getpid()}"
    node = stack.enter_context(spawn_node(record=folder / "node.jsonl"))
    imu = stack.enter_context(spawn_imu("lsl", sensor=FOOT, recording=recording, rate_hz=SLOW_RATE_HZ, name=name))
    return Bench(
        FOOT, imu, node, bus_text(node.bus) + sensor_text("lsl", name, rate_hz=SLOW_RATE_HZ, options="timeout_s = 20")
    )


def serial_rig(
    device: str, kind: DeviceKind, sensors: ImuKind = "ximu3", rate_hz: float = RATE_HZ
) -> Callable[[Path, Path, ExitStack], Bench]:
    """A sensor and a serial stimulator, each on a pseudo-terminal; the stimulator's has a name that stays."""

    def make(folder: Path, recording: Path, stack: ExitStack) -> Bench:
        stimulator = stack.enter_context(spawn_device(kind, record=folder / "device.jsonl"))
        port = folder / "stimulator"
        port.symlink_to(stimulator.port)
        imu = stack.enter_context(spawn_imu(sensors, sensor=FOOT, recording=recording, rate_hz=rate_hz))
        stim = f'[stimulator]\ndevice = "{device}"\nport = "{port}"\n'
        return Bench(FOOT, imu, stimulator, stim + sensor_text(sensors, imu.port, rate_hz=rate_hz))

    return make


ximu3_and_p24 = serial_rig("p24_low_level", "sciencemode4")
capture2go_and_p24 = serial_rig("p24_low_level", "sciencemode4", "capture2go", SLOW_RATE_HZ)
ximu3_and_rehastim2 = serial_rig("rehastim2", "sciencemode2")


# --- the session -----------------------------------------------------------------------------------------


class LiveRun:
    """A running session; orders go over its control socket, statuses come back."""

    def __init__(self, process: subprocess.Popen[str], folder: Path, bench: Bench, keys: int):
        self.process = process
        self.folder = folder
        self.sensor = bench.sensor
        self.stimulator: Stimulator = bench.stimulator
        self.imu = bench.imu
        self.keys = keys
        self.link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.link.bind(str(folder / "me.sock"))
        self.link.settimeout(0.5)
        self.status: Status | None = None
        self.answers: list[dict[str, object]] = []
        self._record: RecordReader | None = None
        self._recorded: Stimulator | None = None  # whose record that is: a test may put another one in its place
        self._entries: list[RecordEntry] = []
        self.tap_s = 0.0  # the next tap's time
        self.off_ns = 0  # when the output went off, as :meth:`off_after_ms` found it

    def loaded(self) -> set[str]:
        """The modules that the session's process had loaded when it ended."""
        return set((self.folder / "loaded.txt").read_text().split())

    @property
    def log(self) -> Path:
        return next(self.folder.glob("*/*/session.feslog"))

    def order(self, ask: str, **more: object) -> None:
        self.link.sendto(json.dumps({"ask": ask, **more}).encode(), str(self.folder / "c.sock"))

    def operate(self, ask: str) -> None:
        """Order it as a person would: after a sensor's fault, arming goes with a tap on it, after a second's rest."""
        if ask == "arm" and self.status is not None and any(ASKED in notice for notice in self.status.notices):
            if time.monotonic() < self.tap_s:
                return
            self.tap_s = time.monotonic() + TAP_EVERY_S
            self.imu.inject("tap")
        self.order(ask, confirm=True)

    def until(
        self, what: Callable[[Status], bool], repeat: str | Callable[[], str] = "", timeout_s: float = 120.0
    ) -> Status:
        """Wait for a status of now, not one that has waited to be read; meanwhile order ``repeat`` again and again."""
        begin_ns = time.monotonic_ns()
        end_s, next_s = time.monotonic() + timeout_s, 0.0
        while time.monotonic() < end_s:
            assert self.process.poll() is None, self.said()
            if time.monotonic() > next_s:
                next_s = time.monotonic() + 0.2
                try:
                    self.link.sendto(b"watch", str(self.folder / "c.sock"))
                    if ask := repeat if isinstance(repeat, str) else repeat():
                        self.operate(ask)
                except OSError:
                    continue  # the socket is not there yet
            try:
                datagram = self.link.recv(65536)
            except TimeoutError:
                continue
            if self._take(datagram) and self.status is not None and self.status.t_ns >= begin_ns and what(self.status):
                return self.status
        raise AssertionError(f"it did not come; last: {self.status}")

    def operated(self) -> str:
        """What an operator would order now to have it armed and at its intensity, "" nothing.

        A machine that is too busy may hold the session up for longer than it allows itself, which switches off and
        latches at any moment: whoever waits for something that only an armed session does, goes on operating.
        """
        if self.status is None or self.status.state not in ("armed", "running"):
            return "arm"
        return "up" if self.status.intensity < INTENSITY - 0.01 else ""

    def armed_at(self, intensity: float = INTENSITY) -> None:
        """Armed by hand, while the patient stands, and raised; again, as :meth:`in_mid_burst` does, if it latches."""

        def order() -> str:
            return "up" if self.status is not None and self.status.state in ("armed", "running") else "arm"

        self.until(lambda status: order() == "up" and status.intensity >= intensity - 0.01, order)

    def children(self, module: str) -> list[int]:
        """The session's own processes that run this module."""
        pids = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        return [int(pid) for pid in pids if module in Path(f"/proc/{pid}/cmdline").read_text()]

    def struck(self, number: signal.Signals) -> int:
        """Send the session a signal; when that was, at the latest."""
        self.process.send_signal(number)
        return time.monotonic_ns()

    # --- the stimulator's own record is the judge ---------------------------------------------------------

    def entries(self) -> list[RecordEntry]:
        """Of channel 0 of the device there now, all so far; only what is new is read, for a long run is asked often."""
        assert self.stimulator.record is not None
        if self._record is None or self._recorded is not self.stimulator:
            self._record, self._recorded, self._entries = RecordReader(self.stimulator.record), self.stimulator, []
        self._entries += [entry for entry in self._record.new_entries() if entry.channel == 0]
        return self._entries

    @property
    def gives_pulses(self) -> bool:
        """Whether the record is of single pulses, not of levels that hold."""
        return isinstance(self.stimulator, DeviceHandle)

    def current_ma(self) -> float:
        """Of channel 0 now."""
        entries = self.entries()
        if not entries or (self.gives_pulses and time.monotonic_ns() - entries[-1].t_ns > PULSE_GAP_NS):
            return 0.0
        return entries[-1].current_ma

    def begun_ns(self) -> int | None:
        """When the burst of channel 0 began whose current is near its plateau now; None where there is none."""
        on_ns, newest = None, None
        for entry in self.entries():
            late = self.gives_pulses and newest is not None and entry.t_ns - newest.t_ns > PULSE_GAP_NS
            if entry.current_ma <= 0.0:
                on_ns = None
            elif on_ns is None or late:
                on_ns = entry.t_ns
            newest = entry
        return on_ns if newest is not None and self.current_ma() >= 0.85 * MOST_MA else None

    def in_mid_burst(self, timeout_s: float = 120.0) -> None:
        """Wait until the current is near its plateau, in a burst that began so lately that it will last.

        Armed and raised by hand until then: see :meth:`operated`.
        """
        end_s, next_s, armings = time.monotonic() + timeout_s, 0.0, 0
        self.link.settimeout(0.004)
        while (begun_ns := self.begun_ns()) is None or time.monotonic_ns() - begun_ns > BEGUN_NS:
            assert self.process.poll() is None, self.said()
            assert time.monotonic() < end_s, f"no burst; {self.status}"
            if time.monotonic() > next_s:
                next_s = time.monotonic() + 0.2
                with suppress(TimeoutError):  # it is held up
                    self.link.sendto(b"watch", str(self.folder / "c.sock"))
                    if self.status is not None and (ask := self.operated()):
                        self.operate(ask)
                        armings += ask == "arm"
            with suppress(TimeoutError):
                self._take(self.link.recv(65536))
        self.link.settimeout(0.5)
        if armings:
            print(f"armed again, in {armings} attempts: {self.status and self.status.fault}")

    def _take(self, datagram: bytes) -> bool:
        """Keep an answer or a status; whether it was a status."""
        if b'"ok"' in datagram[:6]:
            self.answers.append(json.loads(datagram))
            return False
        self.status = Status.decode(datagram)
        return True

    def off_after_ms(self, blow_ns: int, timeout_s: float = 5.0) -> float:
        """How long after the blow the stimulator's output went off, ms, by its own record; 0 if it was off by then.

        Args:
            blow_ns: when it was struck at the latest: read the clock after the blow. Whatever holds the test up between
                the two then adds nothing to what the session is blamed for.

        It is off at the end of its lease, though its process may be held up before it notes that: there is no pulse
        later than that. For how long it was held up, the session is not blamed; see :func:`_held_up_ns`.
        """
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            seen_ns = time.monotonic_ns()
            entries = self.entries()
            if self.gives_pulses:
                last_ns = max((entry.t_ns for entry in entries if entry.current_ma > 0.0), default=blow_ns)
                if seen_ns - max(last_ns, blow_ns) > 3 * PULSE_GAP_NS:
                    self.off_ns = last_ns
                    return max(last_ns - blow_ns, 0) / MS
            elif not entries or entries[-1].current_ma == 0.0:
                self.off_ns = max((entry.t_ns for entry in _ends(entries)), default=0)
                return max(self.off_ns - _held_up_ns(entries, blow_ns) - blow_ns, 0) / MS
            time.sleep(0.004)
        raise AssertionError("it is still on")

    def ended(self) -> RecordEntry:
        """What ended the last current, by the record of a stimulator whose levels hold."""
        return _ends(self.entries())[-1]

    def stays_off(self, since_ns: int, seconds: float) -> bool:
        time.sleep(seconds)
        return not self.on_since(since_ns)

    def on_since(self, since_ns: int) -> list[RecordEntry]:
        """Current after an instant."""
        return [entry for entry in self.entries() if entry.t_ns > since_ns and entry.current_ma > 0.0]

    def quit(self) -> str:
        self.order("quit")
        return self.end()

    def end(self, timeout_s: float = 60.0) -> str:
        said, _ = self.process.communicate(timeout=timeout_s)
        return said

    def said(self) -> str:
        self.process.kill()
        return self.process.communicate(timeout=30)[0]


@contextmanager
def live_run(
    folder: Path,
    recording: Path,
    *options: str | Path,
    text: str = "",
    command: str = "run",
    bench: Callable[[Path, Path, ExitStack], Bench] = xbus_and_can,
) -> Iterator[LiveRun]:
    """A session with what a bench connects. ``text`` is added to its settings; at its end it lists what is loaded."""
    with ExitStack() as stack:
        connected = bench(folder, recording, stack)
        settings = folder / "live.toml"
        at_once = SETTINGS.read_text().replace("strides_before_start = 1", "strides_before_start = 0")
        settings.write_text(f"{at_once}\n{connected.text}\n{text}")
        out = () if "folder" in text else ("--out", folder / "out")  # else below the folder that the settings name
        master, slave = pty.openpty()
        process = subprocess.Popen(
            (
                sys.executable,
                "-c",
                LISTING,
                command,
                settings,
                "--control",
                folder / "c.sock",
                *out,
                *(() if "--report" in options else ("--no-report",)),
                *options,
            ),
            cwd=folder,
            stdin=slave,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        os.close(slave)
        run = LiveRun(process, folder, connected, master)
        try:
            yield run
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
                process.communicate(timeout=30)
            run.link.close()
            os.close(master)


def _ends(entries: list[RecordEntry]) -> list[RecordEntry]:
    """Of a record of levels, what ended each current."""
    return [entry for before, entry in pairwise(entries) if before.current_ma > 0.0 and entry.current_ma == 0.0]


def _held_up_ns(entries: list[RecordEntry], since_ns: int) -> int:
    """For how long the stimulator's process was held up, as far as its own record proves it.

    It noted the end of a lease late. What it then found in its queue, and took for fresh, had been coming since the
    command after the last one that it had taken in time was due.
    """
    held_up_ns = 0
    for entry, then in zip(entries, [*entries[1:], None], strict=True):
        late_ns = entry.t_ns - entry.accepted_ns - LEASE_NS
        if entry.t_ns >= since_ns and entry.event == "lease_expired" and late_ns > 0:
            queued = late_ns > TURN_NS and then is not None and then.event == "on" and then.t_ns - entry.t_ns < TURN_NS
            held_up_ns += late_ns + (LEASE_NS - PERIOD_NS if queued else 0)
    return held_up_ns


def faults_named(record: SessionRecord) -> list[str]:
    """Every fault that the log names, by whatever part of the session: which of several comes first is chance.

    Whatever comes first latches, and is noted as the reason; what comes behind it stands among the events alone.
    """
    notes = [note.text for note in record.notes if note.severity == "fault"]
    events = [*record.statuses, *record.alive]
    return [*notes, *(fault.text for fault in record.faults), *(event.fault for event in events if event.fault)]
