"""The recordings of one timing command: found, replayed, and the truth of each."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from fes.cli.common.exits import LOG_SUFFIX, Problem
from fes.cli.replay.log import repeat
from fes.cli.replay.preparation import prepared
from fes.config import Session
from fes.control.replay import digest, session_for, settings_of
from fes.estimation.sensor_choice import Calibration, phase_sensors
from fes.evaluation.timing.baseline import Baseline
from fes.evaluation.timing.judgement import DECISIONS, Limits, RecordingTiming, judge
from fes.evaluation.timing.replayed import Measured, as_recorded, measure
from fes.evaluation.timing.truth import (
    ExpectedMarks,
    TimingError,
    check_clock,
    companion_truth,
    expected_of_log,
    find_offset_s,
    read_truth,
    without_cut_ends,
)
from fes.recording import Recording
from fes.recording.can_log import CAN_SUFFIXES
from fes.recording.table import TABLE_SUFFIXES
from fes.session_log import read_session

if TYPE_CHECKING:
    from fes.session_log import SessionRecord

ROUNDS: Final = 3  # a latency that seems to have grown is measured so often again before anybody is told
LOG_TOLERANCE_MS: Final = 1.0  # against an earlier log, where nothing else is said


@dataclass(frozen=True, slots=True)
class Options:
    """How to measure: ``truth`` a file, or a folder that holds the recordings' truths; ``lag_s`` to add to its times.

    ``fit``: the clocks' offset is found from the events. ``recorded``: of a session log what it recorded, not what its
    events give today.
    """

    session: Path | None = None
    calibration: Path | None = None
    truth: Path | None = None
    plates: Mapping[int, str] | None = None
    lag_s: float | None = None
    fit: bool = False
    recorded: bool = False
    repeats: int = 3


@dataclass(frozen=True, eq=False)
class Case:
    """One recording measured: with what settings, its content's name, and how to measure it again."""

    name: str
    path: Path
    sha256: str
    settings: str
    session: Session
    measured: Measured
    truth: ExpectedMarks | None
    recording: Recording | None = None
    calibrations: Mapping[str, Calibration] | None = None

    def again(self, repeats: int) -> Case:
        """The same with its latencies measured once more; of each decision the quickest counts."""
        if self.recording is None or self.calibrations is None:
            return self
        more = measure(self.recording, self.session, self.calibrations, time.perf_counter_ns, repeats=repeats)
        quickest_ns = np.minimum(self.measured.latency_ns, more.latency_ns)
        return replace(self, measured=replace(self.measured, latency_ns=quickest_ns))


def find_recordings(given: Iterable[Path]) -> dict[str, Path]:
    """Recordings and session logs by name, those of a folder by their place in it.

    Raises:
        Problem: there is none, or two have one name.
    """
    found: dict[str, Path] = {}
    for path in given:
        if path.is_dir():
            inside = [each for each in sorted(path.rglob("*")) if _is_recording(each)]
            if not inside:
                wanted = ", ".join((*TABLE_SUFFIXES, *CAN_SUFFIXES))
                raise Problem(
                    f"{path}: no recording is below ({wanted}, each with its sidecar .toml; or {LOG_SUFFIX})."
                )
        elif path.is_file():
            inside = [path]
        else:
            raise Problem(f"{path}: is not there. Name recordings, session logs or folders of them.")
        for each in inside:
            name = (each.relative_to(path) if path.is_dir() else Path(each.name)).with_suffix("").as_posix()
            if name in found and found[name] != each:
                raise Problem(f"{each}: {found[name]} has the same name, {name!r}; check them one after the other.")
            found[name] = each
    return found


def _is_recording(path: Path) -> bool:
    if path.suffix == LOG_SUFFIX:
        return path.is_file()
    return path.suffix.lower() in TABLE_SUFFIXES + CAN_SUFFIXES and path.with_suffix(".toml").is_file()


def cases(recordings: Mapping[str, Path], options: Options) -> Iterator[Case]:
    """Each recording measured, one after the other.

    Raises:
        RecordingError, ConfigError, CalibrationError, SessionLogError, ReferenceError, TimingError: one is unusable.
    """
    if options.truth and options.truth.is_file() and len(recordings) > 1:
        raise TimingError(f"{options.truth}: is the truth of one recording, not of {len(recordings)}; name a folder.")
    for name, path in recordings.items():
        case = _of_log(name, path, options) if path.suffix == LOG_SUFFIX else _of_recording(name, path, options)
        if case.truth is not None:
            case = replace(case, truth=_in_time(case.truth, case.measured, options))
        yield case


def _of_recording(name: str, path: Path, options: Options) -> Case:
    recording, _, wanted, found = prepared(path, options.session, options.calibration)
    session = session_for(recording, wanted)
    known = set(phase_sensors(found.calibrations))
    for channel in session.channels:
        if channel.foot not in known:
            why = found.missing.get(channel.foot, "it has no sensor")
            raise TimingError(f"{path}: channel {channel.name!r} follows the {channel.foot}, but {why}.")
    truth = _truth_of(path, session, known, options)
    measured = replace(
        measure(recording, session, found.calibrations, time.perf_counter_ns, repeats=options.repeats), name=name
    )
    return Case(name, path, digest(path), _digest_of(session), session, measured, truth, recording, found.calibrations)


def _of_log(name: str, path: Path, options: Options) -> Case:
    """A session log: what its events give today, against what it recorded unless a truth is named."""
    record = read_session(path)
    try:
        session, calibrations, _ = settings_of(record.header, path)
    except (KeyError, TypeError, AttributeError) as error:
        raise TimingError(f"{path}: its header does not fit this version of fes ({error}).") from error
    if not record.samples:
        raise TimingError(f"{path}: holds no samples, so there is no timing to check.")
    truth = _truth_of(path, session, set(phase_sensors(calibrations)), options)
    if options.recorded:
        measured = as_recorded(name, record)
    else:
        measured = as_recorded(name, record, repeat(path).now)
        truth = truth or _own(record, path)
    return Case(name, path, digest(path), _digest_of(session), session, measured, truth)


def _own(record: SessionRecord, path: Path) -> ExpectedMarks:
    return expected_of_log(record, f"what {path.name} recorded")


def _digest_of(session: Session) -> str:
    return hashlib.sha256(session.model_dump_json().encode()).hexdigest()[:12]


def _truth_of(path: Path, session: Session, feet: set[str], options: Options) -> ExpectedMarks | None:
    file = options.truth or companion_truth(path)
    if file is not None and file.is_dir():
        folder, log = file, (file / path.name).with_suffix(LOG_SUFFIX)
        file = companion_truth(folder / path.name) or (log if log.is_file() else None)
        if file is None:
            raise TimingError(
                f"{folder}: holds no truth of {path.name} ({path.stem}.truth.parquet, .events.csv, .switch.csv, "
                f".mat.csv, .c3d or {LOG_SUFFIX})."
            )
    return read_truth(file, session, feet, plates=options.plates) if file is not None else None


def _in_time(truth: ExpectedMarks, measured: Measured, options: Options) -> ExpectedMarks:
    found = truth.judged(measured.marks) if truth.span_ns is None else measured.marks
    if options.fit:
        lag_s, caveat = find_offset_s(truth, found)
        if caveat:
            raise TimingError(f"{truth.source}: the offset of {lag_s:+.3f} s cannot be believed: {caveat}. Give --lag.")
        note = f"its clock is moved by {lag_s:+.4f} s, found from these events: their mean error went into it"
        truth = replace(truth.shifted(lag_s), notes=(*truth.notes, note))
    elif options.lag_s is not None:
        truth = truth.shifted(options.lag_s)
    else:
        truth = check_clock(truth, found)
    return without_cut_ends(truth, *measured.span_ns)


def judged(case: Case, baseline: Baseline | None, limits: Limits) -> tuple[RecordingTiming, Case]:
    """The outcome, and the case as it was measured in the end: a latency that seems too long is measured again."""
    if baseline is None and not limits.tolerance_ms and case.truth is not None and not case.truth.physical:
        kinds = {what for _, what in case.truth.kinds}
        limits = replace(limits, tolerance_ms=dict.fromkeys(kinds, LOG_TOLERANCE_MS))
    for _ in range(ROUNDS):
        outcome = judge(case.measured, case.truth, baseline, case.sha256, limits, case.settings)
        if case.recording is None or not any(f.against == DECISIONS for f in outcome.failures):
            break
        case = case.again(3)
    return judge(case.measured, case.truth, baseline, case.sha256, limits, case.settings), case
