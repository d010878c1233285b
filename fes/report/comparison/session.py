"""One session of a comparison: what was measured of each side, stride by stride; and what all of them say in numbers.

Logs and recordings are analysed in the same way, off-line and with the same settings, so that a difference is none of
method. How much a parameter must change before day-to-day error cannot explain it stands beside it where that was found
in print, with its people and its setting.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np

from fes.analysis.parameters.definitions import DEFINITIONS, STRIDE_KEYS, Definition
from fes.analysis.parameters.gait import gait_parameters
from fes.analysis.pipeline import analyse, calibrations_of
from fes.analysis.results import Analysis
from fes.analysis.tables import Table
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.sensor_choice import Calibration, calibration_from_dict, phase_sensors
from fes.evaluation.agreement import Interval, Mean, combined, difference, mean_of, symmetry_index
from fes.recording import Recording, RecordingError, Track, read_recording
from fes.report.findings import findings
from fes.report.gait import gait_of_strides
from fes.report.parameter_table import GLOSSARY
from fes.report.stimulation import session_settings
from fes.report.strides import StrideRow
from fes.report.summary import SessionSummary, summarise
from fes.report.text import DIGITS, count_of, number, readable
from fes.session_log import SessionLogError, SessionRecord, read_session
from fes.signals import SENSORS, FloatArray, StrideResult
from fes.walk_record import Finding

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
        phased = {_side(foot): _steady(found) for foot, found in gait_of_strides(strides).strides.items()}
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


KESAR: Final = (
    "Kesar et al. 2011, Gait & Posture 33:314–317: 19 people with chronic stroke on a treadmill, two sessions three "
    "weeks apart; 3.2–4.2 % of the gait cycle for temporal variables (the larger is taken), 6.7 cm for paretic step "
    "length"
)
HOSOI: Final = (
    "Hosoi et al. 2023, Frontiers in Neurology 14:1219505: 84 people after stroke, comfortable speed over 10 m; "
    "0.05 m/s below 0.4 m/s, 0.11 m/s up to 0.8 m/s, 0.21 m/s above"
)
_LEAST: Final = {"swing_share": 0.042, "stance_share": 0.042, "double_support_share": 0.042, "step_length_m": 0.067}
KEY: Final = (
    *("speed_mps", "stride_length_common_m", "stride_time_s", "step_length_m", "toe_clearance_m", "angle_contact_rad"),
    *("circumduction_m", "swing_share", "double_support_share"),
)
SYMMETRIC: Final = ("step_length_m", "step_time_s", "swing_s", "stance_s", "toe_clearance_m", "lift_m")
# spatiotemporal parameters and joint kinematics change with speed: Fukuchi et al. 2019, Systematic Reviews 8:153;
# so does minimum toe clearance: De Asha & Buckley 2015 (PMC4361493)
WITH_SPEED: Final = (
    *("stride_length_common_m", "speed_mps", "stride_time_s", "swing_s", "stance_s", "swing_share", "stance_share"),
    *("step_time_s", "double_support_s", "double_support_share", "step_length_m", "lift_m", "toe_clearance_m"),
    *("heel_clearance_m", "heel_rotation_rad", "angle_contact_rad", "angle_off_rad"),
    *("phase_pre_swing", "phase_swing", "phase_loading_response", "phase_stance"),
)
Pick: TypeAlias = Callable[[Side, Definition], FloatArray | None]


@dataclass(frozen=True, slots=True)
class DetectableChange:
    """The least change (SI) beyond day-to-day error, and who found it in whom."""

    value: float
    source: str


def detectable_change(key: str, first_speed_mps: float, *, belt: bool) -> DetectableChange | None:
    """For one parameter, None where no source is known.

    Args:
        key: of :data:`fes.analysis.parameters.definitions.DEFINITIONS`.
        first_speed_mps: the walking speed of the session that the others are held against.
        belt: any of the sessions was on a treadmill, whose speed is not the patient's choice.
    """
    if key in _LEAST:
        return DetectableChange(_LEAST[key], KESAR)
    if key == "speed_mps" and not belt and first_speed_mps > 0.0:
        least = 0.05 if first_speed_mps < 0.4 else 0.11 if first_speed_mps <= 0.8 else 0.21
        return DetectableChange(least, HOSOI)
    return None


@dataclass(frozen=True)
class ParameterRow:
    """One parameter of one side in all sessions; ``changes`` are of the later ones against the first, SI."""

    about: Definition
    side: str
    means: tuple[Mean, ...]
    changes: tuple[Interval, ...]
    detectable: DetectableChange | None

    @property
    def digits(self) -> int:
        """How many decimals are shown."""
        return DIGITS.get(self.about.shown, 2)

    @property
    def with_speed(self) -> bool:
        """Whether it is known to change with walking speed."""
        return self.about.key in WITH_SPEED

    def clear(self, k: int) -> bool:
        """Whether the interval of change ``k`` leaves zero out."""
        change = self.changes[k]
        return change.low > 0.0 or change.high < 0.0  # NaN limits are not clear

    def beyond(self, k: int) -> bool:
        """Whether change ``k`` is clear, and greater than the least detectable one."""
        return self.detectable is not None and self.clear(k) and abs(self.changes[k].value) > self.detectable.value


@dataclass(frozen=True)
class SymmetryRow:
    """The symmetry index (percent, 0 is symmetric) of one parameter in all sessions, and its changes."""

    about: Definition
    first: str
    second: str
    indices: tuple[Interval, ...]
    changes: tuple[Interval, ...]

    def nearer(self, k: int) -> bool | None:
        """Whether session ``k + 1`` is nearer to symmetry than the first; None where that is not clear."""
        change = self.changes[k]
        if not (change.low > 0.0 or change.high < 0.0):
            return None
        return abs(self.indices[k + 1].value) < abs(self.indices[0].value)


def parameter_rows(sessions: Sequence[ComparedSession]) -> list[ParameterRow]:
    """Of every stride parameter that at least two sessions know, both sides, in the order of the definitions."""
    return _rows(sessions, [DEFINITIONS[key] for key in STRIDE_KEYS], lambda side, about: side.values.get(about.key))


def phase_rows(sessions: Sequence[ComparedSession]) -> list[ParameterRow]:
    """Of the four phases, both sides."""
    names = {phase: readable(phase) for phase in PHASES}
    unit, source = ("", "s", "s", 1.0), "Negård et al. 2005"
    abouts = [Definition(f"phase_{p}", f"{name} (phase)", *unit, GLOSSARY[name], source) for p, name in names.items()]
    return _rows(sessions, abouts, lambda side, about: side.phases.get(about.key.removeprefix("phase_")))


def _rows(sessions: Sequence[ComparedSession], abouts: Sequence[Definition], pick: Pick) -> list[ParameterRow]:
    belt = any(session.summary.belt_speed_mps > 0.0 for session in sessions)
    speed = sessions[0].summary.walking_speed_mps
    rows = []
    for about in abouts:
        for side in ("left", "right"):
            known = [pick(one.sides[side], about) if side in one.sides else None for one in sessions]
            means = tuple(mean_of(() if values is None else values) for values in known)
            if sum(mean.n > 0 for mean in means) < 2:
                continue
            changes = tuple(difference(means[0], mean) for mean in means[1:])
            rows.append(ParameterRow(about, side, means, changes, detectable_change(about.key, speed, belt=belt)))
    return rows


def symmetry_rows(sessions: Sequence[ComparedSession], paretic: str | None = None) -> list[SymmetryRow]:
    """Of the parameters in which sides differ: ``paretic`` against the other side, left against right without it."""
    first = paretic or "left"
    second = "right" if first == "left" else "left"
    rows = []
    for key in SYMMETRIC if all({"left", "right"} <= set(session.sides) for session in sessions) else ():
        values = [[mean_of(one.sides[side].values.get(key, ())) for side in (first, second)] for one in sessions]
        found = [symmetry_index(*each) for each in values]
        if not all(math.isfinite(value) for value, _ in found):
            continue
        before, parts_before = found[0]
        changes = tuple(combined(value - before, parts + parts_before) for value, parts in found[1:])
        indices = tuple(combined(value, parts) for value, parts in found)
        rows.append(SymmetryRow(DEFINITIONS[key], first, second, indices, changes))
    return rows


# --- A comparison in plain sentences: first what stands in the way of comparing, then what changed ----------


BELT_MPS = 0.05  # treadmills show their speed to 0.1 m/s
MEASURED_MPS = 0.1
FEW_STRIDES = 20
VALID_SHARE = 0.8
RATE_SHARE = 0.03
MOST_CHANGES = 8
SMALL_SD = 0.5


def speed_differs(sessions: Sequence[ComparedSession]) -> bool:
    """Whether walking speed could explain differences: marks the parameters that change with it."""
    return any(any(_speed_gaps(sessions[0], other)) for other in sessions[1:])


def confounders(sessions: Sequence[ComparedSession]) -> list[Finding]:
    """All that, besides what is being compared, differs between the first session and a later one."""
    first = sessions[0]
    found = [finding for other in sessions[1:] for finding in _against(first, other)]
    found += [finding for session in sessions for finding in _alone(session)]
    return sorted(dict.fromkeys(found), key=lambda each: ("alert", "warning", "info", "good").index(each.level))


def changes(sessions: Sequence[ComparedSession], rows: Sequence[ParameterRow]) -> list[Finding]:
    """For each later session which of the key parameters clearly changed, the greatest first, and which did not.

    Great and small are against how much strides differ from one another: a change that is clear only because strides
    are so alike counts as small.
    """
    found, first = [], sessions[0].label
    most = MOST_CHANGES if len(sessions) == 2 else MOST_CHANGES // 2
    key = [row for row in rows if row.about.key in KEY]
    for k, other in enumerate(sessions[1:]):
        dagger = speed_differs((sessions[0], other))
        known = [row for row in key if math.isfinite(row.changes[k].low)]
        clear = sorted((row for row in known if row.clear(k)), key=lambda row: -_in_sd(row, k))
        great = [row for row in clear if _in_sd(row, k) >= SMALL_SD]
        found += [Finding("info", _change(row, k, sessions[0], other, dagger)) for row in great[:most]]
        if len(great) > most:
            found.append(Finding("info", f"… and {count_of(len(great) - most, 'more change')}, below."))
        who = f"{other.label} against {first}"
        if small := [_name(row, dagger) for row in clear if _in_sd(row, k) < SMALL_SD]:
            text = "changed clearly, but by less than half of what strides differ among themselves"
            found.append(Finding("info", f"{who}, {text}: {'; '.join(small)}."))
        if same := [_name(row, dagger) for row in known if not row.clear(k)]:
            found.append(Finding("info", f"{who}, no clear change: {'; '.join(same)}."))
        if not known:
            found.append(Finding("warning", f"{other.label}: too few strides to compare with {first}."))
    return found


def value_text(row: ParameterRow, value: float, sign: str = "") -> str:
    """A value of a row as people read it, without its unit; with a ``sign`` (a change) one digit finer in m and s."""
    return number(row.about.factor * value, row.digits + (1 if sign and row.digits == 2 else 0), sign)


def _name(row: ParameterRow, dagger: bool) -> str:
    mark = " †" if dagger and row.with_speed else ""
    return f"{row.about.name}{mark}, {row.side}"


def _in_sd(row: ParameterRow, k: int) -> float:
    """A change in standard deviations of single strides, pooled over the two sessions."""
    a, b = row.means[0], row.means[k + 1]
    pooled = math.sqrt(((a.n - 1) * a.sd**2 + (b.n - 1) * b.sd**2) / (a.n + b.n - 2))
    return abs(row.changes[k].value) / pooled if pooled > 0.0 else math.inf


def _change(row: ParameterRow, k: int, first: ComparedSession, other: ComparedSession, dagger: bool) -> str:
    change = row.changes[k]
    name = _name(row, dagger)
    before, after = value_text(row, row.means[0].mean), value_text(row, row.means[k + 1].mean)
    by, low, high = (value_text(row, value, "+") for value in (change.value, change.low, change.high))
    far = ""
    if row.detectable is not None:
        least = f"{row.about.factor * row.detectable.value:.{row.digits}f}\u00a0{row.about.shown}"
        word = "beyond" if row.beyond(k) else "within"
        far = f"; {word} the least detectable change in people after stroke ({least})"
    return (
        f"{name[0].upper()}{name[1:]}: {before} ({first.label}) → {after} {row.about.shown} ({other.label}), change "
        f"{by} (95\u00a0% interval {low} … {high}){far}."
    )


def _against(first: ComparedSession, other: ComparedSession) -> Iterator[Finding]:
    a, b, one, two = first.summary, other.summary, first.label, other.label
    if a.subject and b.subject and a.subject != b.subject:
        people = f"{one} is of subject {a.subject}, {two} of {b.subject}"
        yield Finding("alert", f"{people}: two people, not one person twice.")
    elif not (a.subject and b.subject):
        yield Finding("info", f"{one} and {two}: not both name their subject; whether it is one person is not checked.")
    belt, measured = _speed_gaps(first, other)
    if belt:
        yield Finding(
            "warning",
            f"{one} and {two} differ in belt speed by {belt:.2f} m/s ({a.belt_speed_mps:.2f} and "
            f"{b.belt_speed_mps:.2f}): parameters marked † change with speed, so stimulation or training alone does "
            "not explain them.",
        )
    elif (a.belt_speed_mps > 0.0) != (b.belt_speed_mps > 0.0):
        on, off = (one, two) if a.belt_speed_mps > 0.0 else (two, one)
        yield Finding("warning", f"{on} is on a treadmill, of {off} no belt speed is known: perhaps over ground.")
    if measured and not belt:
        each = f"{one} {a.walking_speed_mps:.2f}, {two} {b.walking_speed_mps:.2f}"
        text = f"Measured walking speed differs by {measured:.2f} m/s ({each}): parameters marked † change with speed."
        yield Finding("warning", text)
    if set(first.sides) != set(other.sides):
        yield Finding("warning", f"{one} has the sides {', '.join(first.sides)}, {two} {', '.join(other.sides)}.")
    for side in sorted(set(first.sides) & set(other.sides)):
        sensors = first.sides[side].sensor, other.sides[side].sensor
        if sensors[0] != sensors[1]:
            names = [readable(sensor) for sensor in sensors]
            by = f"{one}'s {side} strides are those of the {names[0]} sensor, {two}'s of the {names[1]}'s"
            yield Finding("warning", f"{by}: the methods differ, and so may the numbers.")
    if first.how != other.how:
        yield Finding(
            "warning", f"{one} was {first.how}, {two} {other.how}: the methods differ, and so may the numbers."
        )
    for sensor in sorted(set(first.rates_hz) & set(other.rates_hz)):
        rates = first.rates_hz[sensor], other.rates_hz[sensor]
        if abs(rates[0] - rates[1]) > RATE_SHARE * rates[0]:
            yield Finding("info", f"Sensor {sensor}: {rates[0]:.0f} Hz in {one}, {rates[1]:.0f} Hz in {two}.")
    for side in sorted(set(first.toe) & set(other.toe)):
        if first.toe[side] != other.toe[side]:
            known = f"({one}: {first.toe[side]}; {two}: {other.toe[side]})"
            may = "toe and heel clearance may differ by that alone"
            yield Finding("warning", f"Where the toe is on the {side} foot was not known alike {known}: {may}.")


def _alone(session: ComparedSession) -> Iterator[Finding]:
    label = session.label
    for side, found in session.sides.items():
        valid = len(found.strides)
        if valid < FEW_STRIDES:
            few = count_of(valid, "valid stride")
            yield Finding("warning", f"{label}, {side}: only {few}; its intervals are wide.")
        if valid < VALID_SHARE * found.found:
            yield Finding("warning", f"{label}, {side}: only {valid} of {found.found} strides are valid.")
    changed = sum(row.changes for row in session.summary.tuning)
    if changed:
        tuned = f"the stimulation tuned itself {count_of(changed, 'time')} during the session"
        yield Finding("warning", f"{label}: {tuned}; its means mix what was before and after.")
    if 0.0 < session.stimulated < 0.9:
        some = f"{100 * session.stimulated:.0f} % of the strides were stimulated"
        yield Finding("warning", f"{label}: {some}; its means mix strides with and without.")
    for finding in findings(session.summary):
        if finding.level in ("alert", "warning"):
            yield Finding(finding.level, f"{label}: {finding.text}")


def _speed_gaps(first: ComparedSession, other: ComparedSession) -> tuple[float, float]:
    """By how much (m/s) belt and measured speed differ; 0 where that is little or not known."""
    belt = abs(other.summary.belt_speed_mps - first.summary.belt_speed_mps)
    measured = abs(other.summary.walking_speed_mps - first.summary.walking_speed_mps)
    return belt if belt > BELT_MPS - 1e-9 else 0.0, measured if measured > MEASURED_MPS else 0.0


def describe_stimulation(session: ComparedSession) -> str:
    """With or without stimulation, in short."""
    if not session.summary.channels or not any(channel.bursts for channel in session.summary.channels):
        return "none"
    peak = max(channel.peak_current_ma for channel in session.summary.channels)
    share = f"{100 * session.stimulated:.0f} % of strides, " if math.isfinite(session.stimulated) else ""
    return f"{share}up to {number(peak, 1)} mA"
