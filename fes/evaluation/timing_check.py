"""Phase changes and commands of a session against a truth or another log, decision latency against a budget."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fes.evaluation.trigger_timing import (
    LOG_TOLERANCE_MS,
    TRUTH_TOLERANCE_MS,
    Bounds,
    Mark,
    TimingCheck,
    check_latency,
    judge_timing,
    marks_of_commands,
    marks_of_phases,
    marks_of_truth,
    timing_rows,
)
from fes.session_log import SessionRecord, read_session
from fes.signals import StimCommand
from fes.simulation.truth import load_truth
from statemachine.phases import PhaseChange


class TimingError(ValueError):
    """There is nothing to compare with; the text says why."""


@dataclass(frozen=True, slots=True)
class TimingOptions:
    """What to hold the timing against; ``against`` None: the recording's own truth, of a log what it recorded."""

    against: Path | None = None
    tolerance_ms: float | None = None
    bounds: Bounds = field(default_factory=Bounds)


@dataclass(frozen=True, slots=True)
class Expected:
    """What should have happened: ``source`` for people, the marks, and whether they are a physical truth."""

    source: str
    marks: list[Mark]
    physical: bool


def expected_from(path: Path, feet: set[str]) -> Expected:
    """What a session log did, or what the truth beside a recording says of these feet.

    Raises:
        SessionLogError: the log cannot be read.
        TimingError: there is no truth.
    """
    if path.suffix == ".feslog":
        record = read_session(path)
        return Expected(str(path), [*marks_of_phases(record.phases), *marks_of_commands(record.commands)], False)
    try:
        return Expected(f"the truth of {path.name}", marks_of_truth(load_truth(path), feet), True)
    except FileNotFoundError as error:
        raise TimingError(
            f"{path} has no truth beside it to check the timing against ({Path(str(error).split(': ')[0]).name} is not "
            f"there). Name an earlier session log: --against LOG"
        ) from error
    except (ValueError, KeyError, OSError) as error:
        raise TimingError(f"{path}: its truth cannot be read: {error}") from error


def expected_of(options: TimingOptions, default: Path | Expected, sensors: Iterable[str]) -> Expected:
    """What is expected of these sensors: what ``options`` name, else ``default``.

    Raises:
        TimingError: there is nothing to compare with.
    """
    source = options.against or default
    return expected_from(source, {_foot(sensor) for sensor in sensors}) if isinstance(source, Path) else source


def check_timing(
    record: SessionRecord,
    options: TimingOptions,
    expected: Expected,
    phases: Sequence[PhaseChange] | None = None,
    commands: Iterable[StimCommand] | None = None,
) -> TimingCheck:
    """Compare a session with what is expected; its latencies count.

    ``phases`` and ``commands``: what fired and what went out, if not the record's.

    Raises:
        TimingError: the two tell of different times.
    """
    fired = marks_of_phases(record.phases if phases is None else phases)
    found = [Mark(mark.t_ns, _foot(mark.who) if expected.physical else mark.who, mark.what) for mark in fired]
    if not expected.physical:
        found += marks_of_commands(record.commands if commands is None else commands)
    _refuse_other_times(expected, found)
    tolerances = {} if options.tolerance_ms or not expected.physical else dict(TRUTH_TOLERANCE_MS)
    rows = timing_rows(expected.marks, found, tolerances, options.tolerance_ms or LOG_TOLERANCE_MS)
    latency = check_latency(record.latency_ns, options.bounds.latency_budget_ms)
    return judge_timing(expected.source, rows, latency, options.bounds)


def check_replayed(
    path: Path, options: TimingOptions, phases: list[PhaseChange], commands: list[StimCommand]
) -> TimingCheck:
    """Compare what a log's replay gave with the log itself, or with what ``options`` name.

    Raises:
        SessionLogError: the log cannot be read.
        TimingError: there is nothing to compare with.
    """
    record = read_session(path)
    recorded = [*marks_of_phases(record.phases), *marks_of_commands(record.commands)]
    own = Expected(f"what {path.name} recorded", recorded, False)
    expected = expected_of(options, own, record.header.get("calibration", {}))
    return check_timing(record, options, expected, phases, commands)


def _foot(sensor: str) -> str:
    """The foot that a sensor tells of."""
    return sensor.replace("_shank", "_foot")


def _refuse_other_times(expected: Expected, found: list[Mark]) -> None:
    if not (expected.marks and found):
        return
    should, did = ((1e-9 * min(marks).t_ns, 1e-9 * max(marks).t_ns) for marks in (expected.marks, found))
    if did[0] > should[1] or did[1] < should[0]:
        raise TimingError(
            f"{expected.source} tells of another time than this session ({should[0]:.1f}–{should[1]:.1f} s and "
            f"{did[0]:.1f}–{did[1]:.1f} s). Compare logs of the same recording; of two sessions, use `fes compare`."
        )
