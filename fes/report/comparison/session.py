"""One session of a comparison: what was measured of each side, stride by stride, and what the session itself says.

Logs and recordings are analysed in the same way, off-line and with the same settings, so that a difference is none of
method. Stimulation, charge and faults are a log's own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from fes.analysis.parameters.contacts import no_swings
from fes.analysis.parameters.definitions import STRIDE_KEYS
from fes.analysis.parameters.gait import gait_parameters
from fes.analysis.parameters.motion import pitches
from fes.analysis.parameters.steps import steps_of
from fes.analysis.parameters.strides import motion_of, stride_parameters
from fes.analysis.pipeline import analyse, calibrations_of
from fes.analysis.results import Analysis
from fes.analysis.tables import Table, by_column
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.sensor_choice import Calibration, calibration_from_dict, phase_sensors
from fes.recording import Recording, RecordingError, Track, read_recording
from fes.report.gait import swings_by_phases
from fes.report.stimulation import session_settings
from fes.report.strides import StrideRow
from fes.report.summary import SessionSummary, summarise
from fes.session_log import SessionLogError, SessionRecord, read_session
from fes.signals import SENSORS, FloatArray, StrideResult

LOG: Final = ".feslog"
PHASES: Final = ("pre_swing", "swing", "loading_response", "stance")
FOUND_SHARE: Final = 0.8  # of the strides whose phases are known must have off-line events
OFF_LINE: Final = "analysed off-line"
AS_DECIDED: Final = "as decided in the session, for its log keeps no samples that could be analysed"
_OF_ROWS: Final = {  # the few parameters that a stride itself holds
    "stride_length_common_m": ("stride_length_m", 1.0),
    "stride_time_s": ("duration_s", 1.0),
    "speed_mps": ("speed_mps", 1.0),
    "lift_m": ("clearance_cm", 0.01),
    "toe_clearance_m": ("toe_clearance_cm", 0.01),
    "heel_clearance_m": ("heel_clearance_cm", 0.01),
}


class ComparisonProblem(ValueError):
    """A session cannot be compared; the message names it and says what would do."""


@dataclass(frozen=True)
class Side:
    """One side's walk: ``values`` by parameter and ``phases`` by phase, one number a stride in order of time, SI.

    ``by_phases`` are the same parameters with foot off and contact from the phases (T2, T3) instead of found off-line;
    ``strides`` are the valid ones, with their paths; ``found`` counts the invalid ones too; ``sensor`` told them.
    """

    values: Mapping[str, FloatArray]
    by_phases: Mapping[str, FloatArray]
    phases: Mapping[str, FloatArray]
    strides: Sequence[StrideResult]
    found: int
    sensor: str


@dataclass(frozen=True)
class ComparedSession:
    """A session under the name it has in the comparison; ``summary`` is the log's own, or the analysis's without one.

    ``stimulated``: the share of its strides in which a channel was on, NaN where it is not known of strides. ``toe``:
    by side, how the toe's place is known.
    """

    label: str
    source: str
    how: str
    summary: SessionSummary
    sides: Mapping[str, Side]
    stimulated: float
    toe: Mapping[str, str]
    rates_hz: Mapping[str, float]

    @property
    def speed_mps(self) -> float:
        """The belt's speed, measured where no belt is known."""
        belt = self.summary.belt_speed_mps
        return belt if belt > 0.0 else self.summary.walking_speed_mps


def read_compared(path: Path, label: str) -> ComparedSession:
    """A session log, a folder that holds one, or a recording.

    ComparisonProblem: it cannot be read, or nobody walks in it.
    """
    if path.is_dir():
        logs = sorted(path.glob(f"*{LOG}"))
        if len(logs) != 1:
            raise ComparisonProblem(f"{path}: holds {len(logs)} session logs; name one, or a recording")
        path = logs[0]
    try:
        if path.suffix == LOG:
            return of_record(read_session(path), label, path)
        recording, found = calibrations_of(read_recording(path))
        analysis = analyse(recording, found.calibrations)
    except (SessionLogError, RecordingError, CalibrationError) as error:
        raise ComparisonProblem(str(error)) from error
    return _made(label, path, summarise(analysis.walk_record()), analysis, recording.subject)


def of_record(record: SessionRecord, label: str, path: Path) -> ComparedSession:
    """A log that was read; its samples are analysed, with the calibration that it was run with.

    ComparisonProblem: nobody walks in it.
    """
    own = summarise(record)
    recording = recording_of(record, path)
    calibrations = _calibrations(record, recording)
    if not calibrations:
        return _made(label, path, own, None, decided=record.strides)
    return _made(label, path, own, analyse(recording, calibrations))


def recording_of(record: SessionRecord, path: Path) -> Recording:
    """A log's samples as the recording they were; a sample that holds no number is left out."""
    settings = session_settings(record.header)
    tracks = {}
    for sensor, samples in record.samples.items():
        good = np.isfinite(samples.acc_mps2).all(axis=1) & np.isfinite(samples.gyr_radps).all(axis=1)
        t_ns, stamps = samples.t_ns[good], samples.t_sensor_ns[good]
        steps = np.diff(stamps)
        if sensor not in SENSORS or not (steps > 0).any():
            continue
        rate_hz = 1e9 / float(np.median(steps[steps > 0]))
        arrived = np.maximum.accumulate(t_ns)
        tracks[sensor] = Track(sensor, rate_hz, arrived, stamps, samples.acc_mps2[good], samples.gyr_radps[good])
    told = record.header.get("recording")
    stated = told.get("belt_speed_mps") if isinstance(told, dict) else None
    belt = float(stated) if isinstance(stated, (int, float)) and stated > 0 else None
    geometry = {str(foot): value for foot, value in settings.geometry.items()} if settings else {}
    return Recording(path.stem, path, tracks, belt_speed_mps=belt, geometry=geometry)


def _calibrations(record: SessionRecord, recording: Recording) -> dict[str, Calibration]:
    """The log's own where they are whole, else from the samples; empty where there is nothing to go by."""
    kept = record.header.get("calibration")
    try:
        found = {name: calibration_from_dict(data) for name, data in (kept or {}).items() if name in recording.tracks}
    except (KeyError, TypeError, ValueError, AttributeError):
        found = {}
    if found:
        return {sensor: found[sensor] for sensor in phase_sensors(found).values()}
    try:
        return calibrations_of(recording)[1].calibrations
    except CalibrationError:
        return {}


def _made(
    label: str,
    path: Path,
    own: SessionSummary,
    analysis: Analysis | None,
    subject: str = "",
    decided: Sequence[StrideResult] = (),
) -> ComparedSession:
    how, rows, strides = AS_DECIDED, own.strides, list(decided)
    toe: dict[str, str] = {}
    detailed: dict[str, dict[str, FloatArray]] = {}
    phased: dict[str, dict[str, FloatArray]] = {}
    if analysis is not None:
        how = OFF_LINE
        rows, strides = summarise(analysis.walk_record()).strides, analysis.strides
        toe = {_side(foot): known.describe() for foot, known in analysis.points.items()}
        detailed = {_side(foot): _steady(found) for foot, found in gait_parameters(analysis).strides.items()}
        phased = {_side(foot): _steady(found) for foot, found in by_phases(analysis).items()}
    sides = {}
    for foot in dict.fromkeys(stride.foot for stride in strides):
        mine = [row for row in rows if row.foot == foot]
        valid = [stride for stride in strides if stride.foot == foot and stride.valid]
        used = [row for row in mine if row.valid]
        of_rows = {key: k * np.array([getattr(row, name) for row in used]) for key, (name, k) in _OF_ROWS.items()}
        values = detailed.get(_side(foot)) or of_rows
        sides[_side(foot)] = Side(values, phased.get(_side(foot), values), _phases(mine), valid, len(mine), foot)
    if not any(len(side.strides) for side in sides.values()):
        raise ComparisonProblem(f"{path}: holds no stride that can be used; there is nothing to compare")
    feet = {channel.foot for channel in own.channels if channel.bursts}
    stimulated = [bool(row.stimulation) for row in own.strides if row.foot in feet]
    share = float(np.mean(stimulated)) if stimulated else float("nan" if feet else 0.0)
    summary, sides = (
        replace(own, subject=own.subject or subject),
        {s: sides[s] for s in ("left", "right") if s in sides},
    )
    rates_hz = {sensor.sensor: sensor.rate_hz for sensor in own.sensors}
    return ComparedSession(label, str(path), how, summary, sides, share, toe, rates_hz)


def by_phases(analysis: Analysis) -> dict[str, Table]:
    """By foot, the parameters with the times of the phases: foot off is T2, contact T3. Step lengths are left out."""
    feet = {foot: [s for s in analysis.strides if s.foot == foot and s.valid] for foot in analysis.blocks}
    swings = {foot: swings_by_phases(own) for foot, own in feet.items()}
    found = {}
    for foot, own in feet.items():
        other = next((swings[name] for name in feet if name != foot), no_swings(0))
        paths = analysis.blocks[foot].paths()
        columns = by_column(own)
        motion = motion_of(columns, paths.chosen(paths.places(columns["number"])), pitches(paths), swings[foot])
        found[foot] = stride_parameters(columns, motion, swings[foot], steps_of(columns, swings[foot], other))
    return found


def _steady(found: Table) -> dict[str, FloatArray]:
    steady = found[found["steady"]]
    return {key: steady[key] for key in STRIDE_KEYS} if len(steady) else {}


def with_the_same_timing(sessions: Sequence[ComparedSession]) -> tuple[list[ComparedSession], str]:
    """The sessions with times found in one way: off-line, or by the phases where that fails in any of them; and why.

    A muscle that is stimulated moves the foot in ways that the off-line events do not know.
    """
    for session in sessions:
        for side, one in session.sides.items():
            known = int(np.isfinite(one.values.get("swing_s", np.zeros(0))).sum())
            could = int(np.isfinite(one.by_phases.get("swing_s", np.zeros(0))).sum())
            if known < FOUND_SHARE * could:
                why = (
                    f"{session.label}, {side}: foot off and contact were found off-line in only {known} of {could} "
                    "strides. So all times are those of the phases, as a session decides them, in every session."
                )
                timed = [{name: replace(s, values=s.by_phases) for name, s in each.sides.items()} for each in sessions]
                return [replace(each, sides=sides) for each, sides in zip(sessions, timed, strict=True)], why
    return list(sessions), ""


def _side(foot: str) -> str:
    return foot.split("_")[0]


def _phases(rows: Sequence[StrideRow]) -> dict[str, FloatArray]:
    valid = [row for row in rows if row.valid and row.four_phases]
    found = {phase: np.array([getattr(row, f"{phase}_s") for row in valid]) for phase in PHASES}
    found["stance"] = np.array([np.nan if row.stance_is_standing else row.stance_s for row in valid])
    return found
