"""The numbers of a session, without any drawing: what the tables, the report and ``--json`` show.

Means and spreads over the strides of a foot and the bursts of a channel.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from fes.analysis.swings import find_swings
from fes.config import Session
from fes.config.thresholds import changed_thresholds, describe_thresholds
from fes.estimation.sensor_choice import calibration_from_dict
from fes.estimation.shank.calibration import ShankCalibration
from fes.estimation.tracking.phase_features import LEAST, MEASURES, MOST
from fes.report import quality, stimulation
from fes.report.quality import THRESHOLDS
from fes.report.strides import (
    STANDING_S,
    HandRow,
    MarkRow,
    StrideRow,
    hand_rows,
    is_stop_note,
    stride_rows,
    with_live,
    with_marks,
)
from fes.report.text import Spread, plain, spread
from fes.signals import FOOT_SENSORS, NS_PER_S, SHANK_SENSORS, OperatorAction
from fes.walk_record import Finding, WalkRecord
from statemachine.guards import Thresholds
from statemachine.terms import unit

_VALUE: Final = re.compile(r"(\w+) ([-+.\de]+)")


@dataclass(frozen=True)
class MeasureRow:
    """One measure of one sensor's person: where it began, between which bounds it may follow, and where it went.

    ``strides`` values are in the log; least, most and last of them are the beginning's where there are none.
    """

    sensor: str
    name: str
    unit: str
    begin: float
    bounds: tuple[float, float]
    strides: int
    least: float
    most: float
    last: float


def measure_rows(record: WalkRecord, settings: Session | None) -> tuple[MeasureRow, ...]:
    """Of every sensor that the log has a calibration of, in its order."""
    calibrations = record.header.get("calibration")
    if not isinstance(calibrations, Mapping):
        return ()
    values: dict[tuple[str, str], list[float]] = {}
    for note in record.notes:
        if note.source == THRESHOLDS:
            sensor, _, text = note.text.partition(": ")
            for name, value in _VALUE.findall(text):
                values.setdefault((sensor, name), []).append(float(value))
    rows = []
    for sensor, data in calibrations.items():
        own = _at_the_beginning(data, settings)
        for name, _ in MEASURES if own is not None else ():
            begin = float(getattr(own, name))
            seen = values.get((sensor, name), [])
            ends = min(seen, default=begin), max(seen, default=begin), seen[-1] if seen else begin
            rows.append(MeasureRow(sensor, name, unit(name), begin, (LEAST * begin, MOST * begin), len(seen), *ends))
    return tuple(rows)


def _at_the_beginning(data: Any, settings: Session | None) -> Thresholds | None:
    """What the calibration gives, and the session changes; None where the log's is none."""
    try:
        calibration = calibration_from_dict(data)
        if isinstance(calibration, ShankCalibration):
            return calibration.levels.thresholds()
        return changed_thresholds(calibration.thresholds(), settings.thresholds if settings else {})
    except (KeyError, TypeError, ValueError, AttributeError):
        return None


NAN = float("nan")
STEADY_SHARE = 0.3
UNFINISHED_NS = 10 * NS_PER_S  # a stride of the end of a part is finished in the next one
FORMAT = 1
LONGEST_NS = 31 * 24 * 3600 * NS_PER_S
FURTHEST_NS = 2**62  # 146 years: differences stay within 64 bits


@dataclass(frozen=True)
class FootSummary:
    """One foot's session. Averages are over valid strides; stances over 3 s are standing and left out.

    ``swings`` are those that the raw signals show (:mod:`fes.analysis.swings`), 0 without samples; ``unexplained``
    those of them that are no stride's, ``unexplained_from_s`` … ``unexplained_to_s`` where they lie. ``walking_s`` is
    how long the swings say that it walked, ``unexplained_s`` how much of it is in no stride. ``toe_given``: where its
    toe is was measured and stated, not estimated. ``live`` of an analysis: the phases' durations as the live machine
    has them (``swing_live_s`` …).
    """

    foot: str
    strides: int
    valid: int
    four_phases: int
    without_loading_response: int
    heel_lifts_put_back: int
    stride_length_m: Spread
    clearance_cm: Spread
    toe_clearance_cm: Spread
    stride_time_s: Spread
    walking_speed_mps: float
    cadence_steps_per_min: float
    pre_swing_s: Spread
    swing_s: Spread
    loading_response_s: Spread
    stance_s: Spread
    swings: int = 0
    unexplained: int = 0
    unexplained_from_s: float = NAN
    unexplained_to_s: float = NAN
    walking_s: float = 0.0
    unexplained_s: float = 0.0
    toe_given: bool = False
    live: dict[str, Spread] = field(default_factory=dict)


@dataclass(frozen=True)
class ChannelSummary:
    """One channel's session; ``outside_s`` is the time on in phases in which it must be off."""

    channel: int
    name: str
    foot: str
    muscle: str
    start_phase: str
    stop_phase: str
    bursts: int
    on_time_s: float
    peak_current_ma: float
    pulses: float
    charge_uc: float
    charge_counted_by_device: bool
    outside_s: float
    longest_outside_s: float
    bursts_outside: int
    bursts_by_hand: int
    foreseen: bool
    bursts_early: int
    on_without_command: int
    onset_after_pre_swing_ms: Spread
    burst_duration_s: Spread


def steady_speed_mps(rows: Sequence[StrideRow]) -> float:
    """Way over time of the steady strides, m/s; NaN where there is none.

    A stride is steady when its own speed is within ``STEADY_SHARE`` of the median stride's: the first and the last
    step of a walk and steps on the spot say nothing about the belt.
    """
    pairs = [(row.stride_length_m, row.duration_s) for row in rows if row.duration_s > 0]
    length_m, time_s = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
    speed_mps = length_m / time_s
    usual = float(np.median(speed_mps[np.isfinite(speed_mps)])) if np.isfinite(speed_mps).any() else NAN
    steady = np.abs(speed_mps - usual) <= STEADY_SHARE * abs(usual)
    return float(length_m[steady].sum() / time_s[steady].sum()) if steady.any() else NAN


def foot_summary(foot: str, rows: Sequence[StrideRow]) -> FootSummary:
    """Sum up the strides of one foot."""
    valid = [row for row in rows if row.valid]
    stride_time = spread(row.duration_s for row in valid)
    names = ("stride_length_m", "clearance_cm", "toe_clearance_cm", "pre_swing_s", "swing_s", "loading_response_s")
    spreads: dict[str, Any] = {name: spread(getattr(row, name) for row in valid) for name in names}
    live = {
        name: spread(row.live[name] for row in valid if name != "stance_live_s" or row.live[name] <= STANDING_S)
        for name in (valid[0].live if valid else ())
    }
    return FootSummary(
        **spreads,
        live=live,
        foot=foot,
        strides=len(rows),
        valid=len(valid),
        four_phases=sum(row.four_phases for row in rows),
        without_loading_response=sum(row.path.endswith("T6") for row in rows),
        heel_lifts_put_back=sum(row.heel_lifts_put_back for row in rows),
        stride_time_s=stride_time,
        walking_speed_mps=steady_speed_mps(valid),
        cadence_steps_per_min=120.0 / stride_time.mean if stride_time.n else NAN,
        stance_s=spread(row.stance_s for row in valid if not row.stance_is_standing),
    )


def with_swings(summary: FootSummary, record: WalkRecord, origin_ns: int) -> FootSummary:
    """The summary with the swings that the sensor's samples show, from the first phase change on.

    Of a part of a longer walk the swings of its own span; a stride that its end cuts is the next part's.
    """
    samples = record.samples.get(summary.foot)
    begin_ns = min((change.t_ns for change in record.phases if change.foot == summary.foot), default=origin_ns)
    if samples is None or summary.foot not in (*FOOT_SENSORS, *SHANK_SENSORS):
        return summary
    if record.header.get("kind") == "analysis":  # else nobody looked for strides before
        begin_ns = origin_ns
    found = find_swings(quality.sample_times(samples), samples.acc_mps2, samples.gyr_radps)
    spans = [(stride.t_start_ns, stride.t_end_ns) for stride in record.strides if stride.foot == summary.foot]
    end_ns = found.end_ns
    if record.own_ns is not None:
        begin_ns, end_ns = max(begin_ns, record.own_ns[0]), min(end_ns, record.own_ns[1])
        if end_ns < found.end_ns and spans and spans[-1][1] > end_ns - UNFINISHED_NS:
            end_ns = spans[-1][1]  # what comes after is still to be finished
    found = replace(found, begin_ns=max(found.begin_ns, begin_ns), end_ns=end_ns)
    outside_ns = found.outside(spans)
    at_s = ((outside_ns - origin_ns) / NS_PER_S).tolist() or [NAN]
    return replace(
        summary,
        swings=len(found.whole()),
        unexplained=len(outside_ns),
        unexplained_from_s=at_s[0],
        unexplained_to_s=at_s[-1],
        walking_s=found.walking_s(found.whole()),
        unexplained_s=found.walking_s(outside_ns),
    )


def channel_summary(
    info: stimulation.ChannelInfo, bursts: Sequence[stimulation.Burst], rows: Sequence[StrideRow], stray: int
) -> ChannelSummary:
    """Sum up one channel; ``stray`` counts answers that say on without a command."""
    own = [item for row in rows for item in row.stimulation if item.channel == info.number]
    outside = [burst.outside_s for burst in bursts]
    known = info.foot != ""
    return ChannelSummary(
        channel=info.number,
        **{name: getattr(info, name) for name in ("name", "foot", "muscle", "start_phase", "stop_phase")},
        bursts=len(bursts),
        on_time_s=sum(burst.duration_s for burst in bursts),
        peak_current_ma=max((burst.peak_current_ma for burst in bursts), default=0.0),
        pulses=sum(burst.pulses for burst in bursts),
        charge_uc=sum(burst.charge_uc for burst in bursts),
        charge_counted_by_device=any(burst.counted for burst in bursts),
        outside_s=sum(outside) if known else NAN,
        longest_outside_s=max(outside, default=0.0) if known else NAN,
        bursts_outside=sum(value > 0 for value in outside),
        bursts_by_hand=sum(burst.by_hand for burst in bursts),
        foreseen=info.foreseen,
        bursts_early=sum(burst.early for burst in bursts),
        on_without_command=stray,
        onset_after_pre_swing_ms=spread(item.onset_after_pre_swing_ms for item in own),
        burst_duration_s=spread(burst.duration_s for burst in bursts),
    )


@dataclass(frozen=True)
class ExerciseSummary:
    """A session of exercise: the cycle that was set, how many were asked for of how many."""

    rise_s: float
    on_s: float
    fall_s: float
    off_s: float
    count: int
    done: int


def exercise_summary(record: WalkRecord, settings: Session | None) -> ExerciseSummary | None:
    """None for any other session."""
    if settings is None or settings.exercise is None:
        return None
    done = len({act.t_ns for act in record.acts if act.action is OperatorAction.EXERCISE})
    return ExerciseSummary(**settings.exercise.model_dump(exclude={"channels"}), done=done)


@dataclass(frozen=True)
class SessionSummary:
    """All numbers of a session; ``to_json`` gives them with their units in the names."""

    name: str
    subject: str
    recording: str
    kind: str
    created: str
    fes_version: str
    complete: bool
    lost: str
    duration_s: float
    belt_speed_mps: float
    walking_speed_mps: float
    speed_over_belt: float
    command_period_s: float
    feet: dict[str, FootSummary]
    channels: tuple[ChannelSummary, ...]
    refusals: tuple[quality.Refusal, ...]
    latency: quality.Latency
    notices: tuple[quality.Notice, ...]
    sensors: tuple[quality.SensorQuality, ...]
    run_summary: dict[str, Any]
    strides: tuple[StrideRow, ...]
    dose: tuple[stimulation.DoseRow, ...] = ()
    tuning: tuple[stimulation.TuningRow, ...] = ()
    reached: tuple[stimulation.ReachRow, ...] = ()
    measures: tuple[MeasureRow, ...] = ()
    thresholds: str = ""
    by_hand: tuple[HandRow, ...] = ()
    marks: tuple[MarkRow, ...] = ()
    exercise: ExerciseSummary | None = None
    sensor_findings: tuple[Finding, ...] = ()  # of the sensors, by whoever examined them

    @property
    def faults(self) -> tuple[quality.Notice, ...]:
        """The notices of faults; a stop that a person made is none."""
        faults = (notice for notice in self.notices if notice.severity == "fault")
        return tuple(fault for fault in faults if not is_stop_note(fault.source, fault.text))


@dataclass(frozen=True)
class ReportData:
    """A summary together with what the figures need besides it."""

    record: WalkRecord
    settings: Session | None
    summary: SessionSummary
    origin_ns: int
    end_ns: int
    timelines: dict[str, stimulation.PhaseTimeline]
    channels: tuple[stimulation.ChannelInfo, ...]
    commands: dict[int, stimulation.CommandColumns] = field(repr=False)
    bursts: dict[int, tuple[stimulation.Burst, ...]] = field(repr=False)
    sensors: dict[str, quality.SensorFlags] = field(repr=False)
    flags: dict[tuple[str, int], tuple[quality.Flag, ...]] = field(repr=False)


def summarise(record: WalkRecord) -> SessionSummary:
    """Work out a session's numbers."""
    return summarise_session(record).summary


def summarise_session(record: WalkRecord) -> ReportData:
    """Work out a session's numbers and keep the columns they came from.

    SessionLogError: its times run over more than a month, or are too large to be subtracted.
    """
    settings = stimulation.session_settings(record.header)
    origin_ns, end_ns = session_span(record)
    if not 0 <= end_ns - origin_ns <= LONGEST_NS or max(abs(origin_ns), abs(end_ns)) > FURTHEST_NS:
        from fes.session_log import SessionLogError  # here, for an analysis has nothing to do with logs

        raise SessionLogError(
            f"its times run from {origin_ns / NS_PER_S:g} s to {end_ns / NS_PER_S:g} s; no session is so long, or so "
            "far from its clock's beginning. Nothing can be drawn of it; `fes convert` gives what it holds."
        )
    sensor_of = stimulation.phase_sensors_of(record.header)
    feet_known = _feet(record, settings, sensor_of)
    timelines = {foot: stimulation.build_timeline(record.phases, foot, origin_ns, end_ns) for foot in feet_known}
    infos = stimulation.channel_infos(settings, record.commands, sensor_of)
    commands = {info.number: stimulation.command_columns(record.commands, info.number) for info in infos}
    statuses = {info.number: stimulation.status_columns(record.statuses, info.number) for info in infos}
    bursts = {
        n: stimulation.find_bursts(info, commands[n], statuses[n], timelines.get(info.phase_sensor), record.acts)
        for n, info in ((info.number, info) for info in infos)
    }
    stray = {number: stimulation.answers_without_command(commands[number], statuses[number]) for number in commands}
    refused = [c for c in record.commands if c.refused and not quality.behind_the_end(record, c.t_ns, c.refused)]
    rows = stride_rows(record.strides, timelines, infos, bursts, refused, origin_ns)
    if record.live is not None:
        phases, strides = record.live[0], [own for own in record.live[1] if own.foot in FOOT_SENSORS]
        live = {foot: stimulation.build_timeline(phases, foot, origin_ns, end_ns) for foot in feet_known}
        unmoved = {id(stride) for stride in record.strides}
        kept = {(stride.foot, stride.number) for stride in strides if id(stride) in unmoved}
        rows = with_live(rows, stride_rows(strides, live, (), {}, (), origin_ns), kept)
    marks, rows = with_marks(record, rows, origin_ns)
    sensors = quality.all_flags(record, settings)
    flags = quality.stride_flags(record, rows, sensors)
    feet = {foot: foot_summary(foot, [row for row in rows if row.foot == foot]) for foot in timelines}
    given = _toes_given(record.header, settings)
    feet = {n: with_swings(replace(own, toe_given=n in given), record, origin_ns) for n, own in feet.items()}
    speeds = [foot.walking_speed_mps for foot in feet.values() if np.isfinite(foot.walking_speed_mps)]
    speed = float(np.mean(speeds)) if speeds else NAN
    header = record.header
    recording, session = ({} if not isinstance(header.get(k), dict) else header[k] for k in ("recording", "session"))
    belt = settings.treadmill.belt_speed_mps if settings and settings.treadmill else NAN
    if isinstance(stated := recording.get("belt_speed_mps"), (int, float)) and stated > 0:
        belt = float(stated)
    summary = SessionSummary(
        name=str(session.get("name", "") or recording.get("name", "") or "session"),
        subject=str(session.get("subject", "") or recording.get("subject", "")),
        recording=str(recording.get("name", "")),
        kind=str(header.get("kind", "")),
        created=str(header.get("created", "")),
        fes_version=str(header.get("fes_version", "")),
        complete=record.complete,
        lost=record.lost,
        duration_s=(end_ns - origin_ns) / NS_PER_S,
        belt_speed_mps=belt,
        walking_speed_mps=speed,
        speed_over_belt=speed / belt,
        command_period_s=1.0 / (settings.stimulation.command_rate_hz if settings else 50.0),
        feet=feet,
        channels=tuple(channel_summary(info, bursts[info.number], rows, stray[info.number]) for info in infos),
        refusals=quality.group_refusals(refused, origin_ns),
        latency=quality.latency_of(record.latency_ns),
        notices=quality.session_notices(record, origin_ns),
        sensors=tuple(quality.sensor_quality(name, own) for name, own in record.samples.items() if own.t_ns.size),
        run_summary=plain(record.summary),
        strides=rows,
        dose=stimulation.dose_rows(record, settings, origin_ns),
        tuning=stimulation.tuning_rows(record.notes, origin_ns),
        reached=stimulation.reach_rows(settings, commands, origin_ns),
        measures=measure_rows(record, settings),
        thresholds=describe_thresholds(settings.thresholds) if settings else "",
        marks=marks,
        by_hand=hand_rows(record, origin_ns, settings.stimulation.intensity if settings else 1.0),
        exercise=exercise_summary(record, settings),
        sensor_findings=(*record.findings, *quality.flag_findings(flags, sensors)),
    )
    return ReportData(record, settings, summary, origin_ns, end_ns, timelines, infos, commands, bursts, sensors, flags)


def _toes_given(header: Mapping[str, Any], settings: Session | None) -> set[str]:
    """The feet of which the session or the recording states where the toe is."""
    found = header.get("toe_and_heel")
    points = found.items() if isinstance(found, dict) else ()
    stated = {foot for foot, known in points if isinstance(known, dict) and known.get("source") == "given"}
    return stated | ({str(foot) for foot in settings.geometry} if settings else set())


def session_span(record: WalkRecord) -> tuple[int, int]:
    """First and last instant that anything happened; what was noted before the loop began lies before the first."""
    times = [arrays.t_ns for arrays in record.samples.values()] + [record.ticks_ns, record.latency_t_ns]
    edges = [int(edge) for array in times if array.size for edge in (array.min(), array.max())]
    for things in (record.phases, record.commands, record.statuses):
        edges += [thing.t_ns for thing in (*things[:1], *things[-1:])]
    for stride in (*record.strides[:1], *record.strides[-1:]):
        edges += [stride.t_start_ns, stride.t_end_ns]
    noted = [note.t_ns for note in (*record.notes[:1], *record.notes[-1:])]
    return (min(edges or noted), max(edges + noted)) if edges or noted else (0, 0)


def _feet(record: WalkRecord, settings: Session | None, sensor_of: Mapping[str, str]) -> list[str]:
    """The feet (or shanks) that anything is known about, feet first, then whatever else a log names."""
    seen = {stride.foot for stride in record.strides} | {change.foot for change in record.phases}
    seen |= {name for name, arrays in record.samples.items() if name in FOOT_SENSORS and arrays.t_ns.size}
    if settings and settings.exercise is None:
        seen |= {sensor_of.get(channel.foot, channel.foot) for channel in settings.channels}
    return [foot for foot in FOOT_SENSORS if foot in seen] + sorted(seen - set(FOOT_SENSORS))
