"""Which stimulator a replay talks to: none, or a simulated one in its own process; the sensors of one to a real device.

And what encodes as a session did when its log is repeated: a serial stimulator's port gets what its line brought then.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from drivers.simulated.record import RecordWriter
from drivers.simulated.spawn import spawn_node
from drivers.simulated.stimulator.in_process import InProcessStimulator
from drivers.stimulator.bus import open_bus
from drivers.stimulator.can_codec import CONTROLLER_IDS, NODE_IDS, logged_commands
from drivers.stimulator.can_port import ByteSink, CanStimulator
from drivers.stimulator.open import SERIAL, open_stimulator
from drivers.stimulator.port import StimulatorLost
from drivers.stimulator.sciencemode import ScienceModePort
from drivers.stimulator.serial_line import Line
from fes.config import ImuDevice, Session
from fes.control.runner import Stimulator
from fes.evaluation.delivered import Delivered, compare_delivered
from fes.live.supervision import UNSENT, is_due
from fes.recording import Recording
from fes.session_log import Received
from fes.signals import G_MPS2, Event, RawSample, StimAlive, StimCommand, StimOpened, StimStatus, WireFrame


class LoggedLine:
    """A :class:`drivers.stimulator.serial_line.Line` with nobody behind it: it brings what it is given."""

    name = "the session log"

    def __init__(self) -> None:
        self.brings = b""

    def write(self, data: bytes) -> None:
        """It goes nowhere."""

    def read(self) -> bytes:
        """What it was given since the last call."""
        data, self.brings = self.brings, b""
        return data

    def wait(self, timeout_s: float) -> None:
        """There is nothing to wait for."""

    def fileno(self) -> int:
        """None."""
        return -1

    def close(self) -> None:
        """Nothing is held."""


Came = Callable[[StimCommand, WireFrame], None]


class _RepeatingSink:
    """Encodes as the session did, but not what it could not send; ``sent`` says by command whether it did.

    ``own`` are the commands that its supervisor sent by itself, by their number among all; they go to ``came``.
    """

    def __init__(self, sink: ByteSink | ScienceModePort, sent: Sequence[bool] = ()) -> None:
        self.sent, self._sink, self._number = sent, sink, 0
        self.own: Mapping[int, StimCommand] = {}
        self.came: Came = lambda command, frame: None

    def send_own(self) -> None:
        """What the supervisor sent by itself before the next command."""
        while (own := self.own.get(self._number)) is not None:
            self._number += 1
            self.came(own, self._sink.send(own))

    def send(self, command: StimCommand) -> WireFrame:
        """The frame that the session sent, or left out."""
        self.send_own()
        number, self._number = self._number, self._number + 1
        if number < len(self.sent) and not self.sent[number]:
            return WireFrame(command.t_ns, UNSENT, b"")
        return self._sink.send(command)

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """Its answers are events in the log."""
        return []


class LoggedSink(_RepeatingSink):
    """For a CAN stimulator: under a new identifier after it opened again."""

    def __init__(self, session_id: int, sent: Sequence[bool]) -> None:
        super().__init__(ByteSink(session_id), sent)

    def replay_events(self, events: Iterable[Event]) -> Iterator[Event]:
        """The events, and where the stimulator was opened again, that."""
        for event in events:
            if isinstance(event, StimOpened):
                self._sink = ByteSink(event.session_id)
            yield event
        self.send_own()


class SerialSink(_RepeatingSink):
    """For a serial stimulator, from what its port heard: its queue, its questions, its numbers.

    A line that was lost got no command.

    ConfigError: the log's settings are not such a device's.
    """

    def __init__(self, session: Session, polled_every_ns: int = 0) -> None:
        self._session = session
        self._every_ns = polled_every_ns
        self._polled_ns: int | None = None
        self._line = LoggedLine()
        self._port = self._open(0)
        super().__init__(self._port)

    def replay_events(self, inputs: Iterable[Event | Received | WireFrame], session_id: int) -> Iterator[Event]:
        """The log's events, while the port gets what lies between them.

        The session looked at the line after every event that was no answer of the stimulator's own; what it then found
        is in the log before the answers that it made of it.
        """
        greeted: list[WireFrame] = []
        begun, looked_ns, commands = False, None, 0
        for each in inputs:
            if isinstance(each, WireFrame):
                if each.identifier in self._port.greetings:
                    greeted.append(each)
                    continue
                if commands in self.own and commands == self._number:  # before what its line brought next
                    self.send_own()
                commands += 1
                continue
            if not begun:
                self._resume(session_id, greeted)
                begun = True
            if isinstance(each, Received):
                self._line.brings += each.data
                continue
            self._check(looked_ns)
            if isinstance(each, StimOpened):
                self._resume(each.session_id, greeted)
            yield each
            looked_ns = None if isinstance(each, StimStatus | StimAlive) else each.t_ns
        self._check(looked_ns)
        self.send_own()

    def logged_commands(self, frames: Iterable[WireFrame]) -> list[WireFrame]:
        """Of all frames those of commands, one each: all but the handshakes'."""
        return [frame for frame in frames if frame.identifier not in self._port.greetings]

    def _check(self, t_ns: int | None) -> None:
        if t_ns is not None and is_due(t_ns, self._polled_ns, self._every_ns):
            self._polled_ns = t_ns
            with suppress(StimulatorLost):  # as it was then, and the log says so
                self._port.poll(t_ns)

    def _resume(self, session_id: int, greeted: list[WireFrame]) -> None:
        self._line, self._polled_ns = LoggedLine(), None
        self._sink = self._port = self._open(session_id)
        self._port.resume(greeted)
        greeted.clear()

    def _open(self, session_id: int) -> ScienceModePort:
        line: Line = self._line
        port = open_stimulator(self._session.stimulator, self._session, session_id, lambda name, settings: line)
        assert isinstance(port, ScienceModePort), "a serial device"
        return port


def repeats_bytes(session: Session, header: Mapping[str, object]) -> bool:
    """Whether a log holds all that the session's serial port went by; a recording's has a simulated stimulator."""
    return session.stimulator.device in SERIAL and header.get("heard") is True


def polled_every_ns(header: Mapping[str, object]) -> int:
    """How far apart the session looked at its stimulator's line; 0: after every event."""
    every = header.get("polled_every_ns", 0)
    return every if isinstance(every, int) else 0


LAST_ANSWERS_S = 0.5
UNKNOWN_RANGES: Final = {"acc_range_g": 400.0, "gyr_range_dps": 10_000.0}  # as wide as settings go: nothing saturates


class OpenStimulator(Stimulator, Protocol):
    """A stimulator with its session open."""

    @property
    def outstanding(self) -> int:
        """Commands not yet answered."""


@dataclass(frozen=True, slots=True)
class Opened:
    """An open stimulator, what its handshake sent and heard, and whether anything answers at all."""

    stimulator: OpenStimulator
    frames: tuple[WireFrame, ...] = ()
    alive: tuple[StimAlive, ...] = ()
    answers: bool = True


@contextmanager
def no_stimulator(session_id: int, boot_id: int, t_ns: int, validity_ms: int) -> Iterator[Opened]:
    """Bytes only: nothing is sent anywhere."""
    sink = ByteSink(session_id, validity_ms)
    yield Opened(sink, frames=(sink.open(t_ns, boot_id),), answers=False)


@contextmanager
def simulated(
    session_id: int, boot_id: int, t_ns: int, validity_ms: int, *, real_time: bool, record: Path
) -> Iterator[Opened]:
    """A simulated stimulator: in this process by the recording's time, or in ``real_time`` a process on virtual CAN.

    ``record``: where it says what it delivered. StimulatorLost, BusError: it did not start, or cannot be reached.
    """
    if real_time:
        with (
            spawn_node(boot_id=boot_id, record=record) as node,
            closing(CanStimulator(open_bus(node.bus, NODE_IDS), session_id, validity_ms=validity_ms)) as stimulator,
        ):
            handshake = stimulator.open(t_ns, timeout_s=10.0)
            yield Opened(stimulator, handshake.frames, handshake.alive)
        return
    with closing(RecordWriter(record)) as delivered:
        stimulator = InProcessStimulator(session_id, boot_id, t_ns, validity_ms=validity_ms)
        try:
            with closing(stimulator):
                handshake = stimulator.start(t_ns)
                yield Opened(stimulator, handshake.frames, handshake.alive)
        finally:
            delivered.write(stimulator.bus.node.take_record())


class RecordedSensors:
    """A recording as the line that its sensors are on: each sample comes in its time, counted from the first look.

    An :class:`fes.live.source.Imu`, so that a replay to a real device is a live session in all else.
    """

    def __init__(self, recording: Recording, sensors: Collection[str]) -> None:
        self.sensors = tuple(sorted(sensors))
        self.serials: dict[str, str] = {}
        self.notices: tuple[str, ...] = ()
        self._samples = deque(each for each in recording.samples() if each.sensor in sensors)
        self._ahead_ns: int | None = None

    def fileno(self) -> int | None:
        """There is nothing to wait on."""
        return None

    def read(self, t_ns: int) -> list[RawSample]:
        """What is due by ``t_ns``."""
        if self._ahead_ns is None and self._samples:
            self._ahead_ns = t_ns - self._samples[0].t_ns
        due: list[RawSample] = []
        while self._samples and self._ahead_ns is not None and self._samples[0].t_ns + self._ahead_ns <= t_ns:
            each = self._samples.popleft()
            due.append(RawSample(each.sensor, t_ns, each.t_sensor_ns, each.acc_mps2, each.gyr_radps))
        return due

    def clock_answers(self) -> tuple[tuple[str, int, int], ...]:
        """Nobody asks a recording."""
        return ()

    def reopen(self) -> None:
        """It goes on where it is."""

    def close(self) -> None:
        """Nothing is held."""


def worn_sensors(session: Session, recording: Recording, sensors: Collection[str]) -> tuple[ImuDevice, ...]:
    """The recording's sensors as a live session's: the session's own settings at the recording's rate."""
    known = {str(device.sensor): device.model_dump() for device in session.sensors}
    devices = []
    for name in sorted(sensors):
        track, ranges = recording.tracks[name], {}
        for key, unit, value in (
            ("acc_range_g", G_MPS2, track.acc_range_mps2),
            ("gyr_range_dps", math.radians(1.0), track.gyr_range_radps),
        ):
            ranges[key] = known[name][key] if name in known else UNKNOWN_RANGES[key] if value is None else value / unit
        settings = {"sensor": name, "device": "xbus", **known.get(name, {}), **ranges, "rate_hz": track.rate_hz}
        devices.append(ImuDevice.model_validate(settings))
    return tuple(devices)


def last_answers(stimulator: OpenStimulator, t_ns: int) -> list[StimStatus | StimAlive]:
    """What still comes after the last command, for at most half a second."""
    replies: list[StimStatus | StimAlive] = []
    deadline = time.monotonic() + LAST_ANSWERS_S
    while True:
        replies += stimulator.poll(t_ns)
        if not stimulator.outstanding or time.monotonic() > deadline:
            return replies
        time.sleep(0.005)


def wire_truth(frames: list[WireFrame], statuses: list[StimStatus]) -> Delivered:
    """Hold the command frames that went out against what the stimulator said it delivered."""
    return compare_delivered(logged_commands([f for f in frames if f.identifier in CONTROLLER_IDS]), statuses)
