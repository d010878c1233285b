"""A recording through the loop to see when things happen: marks, and how long each decision takes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fes.config import Session
from fes.control.controller import Controller
from fes.control.replay import log_header
from fes.control.runner import Runner, armed_after, with_ticks
from fes.estimation.sensor_choice import Calibration, shank_phase_sensors
from fes.evaluation.log_replay import ReplayOutput
from fes.evaluation.timing.marks import Mark, by_foot, marks_of_commands, marks_of_phases
from fes.gate import gate_of
from fes.recording import Recording
from fes.recording.tracks import samples_of
from fes.session_log import SessionRecord
from fes.signals import SHANK_SENSORS, IntArray, StimAlive, StimCommand, StimStatus, WireFrame
from fes.walk_record import SampleArrays, WalkRecord

ARM_AFTER_S: Final = 0.5
CREATED: Final = "2000-01-01T00:00:00+00:00"  # the same run, the same bytes
_NO_FRAME: Final = 0


@dataclass(frozen=True, eq=False)
class Measured:
    """When things happened in one recording; ``record`` is all that pages show of it.

    ``latency_ns`` (N,): of each sample, from its release to the last byte written.
    """

    name: str
    record: WalkRecord
    marks: tuple[Mark, ...]
    latency_ns: IntArray

    @property
    def span_ns(self) -> tuple[int, int]:
        """The recording's first and last sample."""
        times = [each.t_ns for each in self.record.samples.values() if each.t_ns.size]
        return min(int(t[0]) for t in times), max(int(t[-1]) for t in times)


class _NoStimulator:
    """Nothing is sent anywhere."""

    def send(self, command: StimCommand) -> WireFrame:
        """No frame."""
        return WireFrame(command.t_ns, _NO_FRAME, b"")

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """Nobody answers."""
        return []


class _TimedOutput(ReplayOutput):
    """Remembers how long decisions took as well."""

    def __init__(self) -> None:
        super().__init__()
        self.latencies_ns: list[int] = []

    def latency(self, t_ns: int, latency_ns: int) -> None:
        """Keep it."""
        self.latencies_ns.append(latency_ns)


def measure(
    recording: Recording,
    session: Session,
    calibrations: Mapping[str, Calibration],
    clock_ns: Callable[[], int],
    *,
    repeats: int = 3,
    controller_of: Callable[[Session, Mapping[str, Calibration]], Controller] = Controller,
) -> Measured:
    """Replay a recording, armed after half a second, ``repeats`` times.

    The marks are those of the first run; every run gives the same. Of each decision the quickest time counts, so that
    what else the machine does meanwhile, which hits another decision each time, is left out. ``clock_ns`` measures it.

    Raises:
        ConfigError: the calibrations fit no controller.
    """
    up = {sensor: each.up for sensor, each in calibrations.items()}
    sensors = set(calibrations) | (set(recording.tracks) & set(SHANK_SENSORS))
    first: _TimedOutput | None = None
    latency_ns = np.zeros(0, np.int64)
    for _ in range(repeats):
        out = _TimedOutput()
        gate = gate_of(session, up, shank_phase_sensors(calibrations))
        runner = Runner(controller_of(session, calibrations), gate, _NoStimulator(), out, clock_ns)
        runner.run(
            armed_after(with_ticks(samples_of(recording, sensors)), ARM_AFTER_S, session.stimulation.intensity),
            lambda event: None,
        )
        own_ns = np.array(out.latencies_ns, np.int64)
        latency_ns = own_ns if first is None else np.minimum(latency_ns, own_ns)
        first = first or out
    assert first is not None, "repeated at least once"
    record = WalkRecord(
        log_header(recording, "", session, calibrations, 1, CREATED),
        samples={
            name: SampleArrays(track.t_ns, track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
            for name, track in recording.tracks.items()
        },
        phases=first.phases,
        strides=first.strides,
        commands=first.commands,
        latency_ns=latency_ns,
        complete=True,
    )
    marks = (*marks_of_phases(first.phases), *marks_of_commands(first.commands))
    return Measured(recording.name, record, by_foot(marks), latency_ns)


def as_recorded(name: str, record: SessionRecord, again: ReplayOutput | None = None) -> Measured:
    """What a session did, or what its events gave ``again``; the latencies are the session's own either way."""
    phases = record.phases if again is None else again.phases
    commands = record.commands if again is None else again.commands
    shown = replace(record, phases=phases, commands=commands)
    marks = (*marks_of_phases(phases), *marks_of_commands(commands))
    return Measured(name, shown, by_foot(marks), record.latency_ns)
