"""How good the data are: gaps, doubled stamps, notices; and which strides to be careful with, and why.

A sensor's limit is its range, where the recording or the session file names it. Else it is found in the samples: noise
never repeats the greatest value of a whole recording four times in a row, a sensor at its limit does.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import radians
from typing import Any, Final

import numpy as np

from fes.config import Session
from fes.report.strides import StrideRow
from fes.report.text import count_of, readable, without_numbers
from fes.signals import G_MPS2, NS_PER_S, BoolArray, FloatArray, IntArray, StimCommand
from fes.stimulation.onset import EACH_ONSET
from fes.walk_record import MARK, Finding, SampleArrays, WalkRecord

CLOCKS_AGREE_NS = NS_PER_S
FAR_NS = 3600 * NS_PER_S
GAP_FACTOR = 1.8  # an interval this many times the usual one has at least one sample missing
NAN = float("nan")
AT_LIMIT: Final = 0.999  # of a range that is known
IN_A_ROW: Final = 4  # equal greatest values that tell a limit where it is not
LATCHED: Final = "off until armed again: "  # as fes.control.runner notes it
STALE: Final = " ms old, limit "  # as fes.gate.freshness words it
THRESHOLDS: Final = "thresholds"  # who notes this person's measures, stride by stride
LEAST_GAP_S: Final = 0.025  # as long as a foot's impact; a sample or two that are lost elsewhere change nothing
LEAST_LIMIT: Final = {"acc": 15.0, "gyr": 4.0}  # m/s², rad/s: a sensor that hardly moved has no limit to reach
CLIPPED_ACC, CLIPPED_GYR, LOST, UNSURE = "accelerometer", "gyroscope", "lost", "unsure"
SHORT: Final = {CLIPPED_ACC: "clip a", CLIPPED_GYR: "clip g", LOST: "gap", UNSURE: "unsure"}
_AT_LIMIT_OF: Final = {kind: f"{kind} at its limit" for kind in (CLIPPED_ACC, CLIPPED_GYR)}
NAMES: Final = _AT_LIMIT_OF | {LOST: "lost samples", UNSURE: "a phase not seen"}
MEANING: Final = {
    CLIPPED_ACC: "the accelerometer was at its limit: lengths, heights and paths may be off",
    CLIPPED_GYR: "the gyroscope was at its limit: angles, lengths, heights and paths may be off",
    LOST: "samples are missing for more than 25 ms: all numbers of the stride may be off",
    UNSURE: "a phase was not seen: times of swing and stance may be off",
}


@dataclass(frozen=True)
class SensorQuality:
    """One sensor's stream by its own clock; ``longest_silence_ms`` is by arrival at the host."""

    sensor: str
    samples: int
    rate_hz: float
    missing: int
    doubled: int
    backward: int
    not_a_number: int
    longest_silence_ms: float


@dataclass(frozen=True)
class Refusal:
    """Commands that the gate turned off for the same reason (numbers in the words left aside)."""

    reason: str
    count: int
    channels: tuple[int, ...]
    first_s: float
    last_s: float


@dataclass(frozen=True)
class Latency:
    """Time from a sample's arrival to the answer, milliseconds; NaN where it was not measured."""

    count: int
    p50_ms: float
    p99_ms: float
    max_ms: float


@dataclass(frozen=True)
class Notice:
    """A note with its time counted from the session's start."""

    time_s: float
    severity: str
    source: str
    text: str


def sample_times(samples: SampleArrays) -> IntArray:
    """The sensor's own stamps, which are even where arrival comes in batches; arrival if the clocks do not agree.

    Arrival, too, of a sample whose stamp is over an hour away from it.
    """
    t_ns, t_sensor_ns = samples.t_ns, samples.t_sensor_ns
    if not abs(float(np.median(t_ns - t_sensor_ns))) < CLOCKS_AGREE_NS:
        return t_ns
    far = (t_sensor_ns < t_ns - FAR_NS) | (t_sensor_ns > t_ns + FAR_NS)
    return np.where(far, t_ns, t_sensor_ns) if far.any() else t_sensor_ns


def sensor_quality(sensor: str, samples: SampleArrays) -> SensorQuality:
    """Count what is wrong with one sensor's samples; the usual interval is the median one."""
    step_ns = np.diff(samples.t_sensor_ns)
    forward = step_ns[step_ns > 0]
    usual_ns = float(np.median(forward)) if forward.size else NAN
    gaps = forward[forward > GAP_FACTOR * usual_ns] if forward.size else forward
    finite = np.isfinite(samples.acc_mps2).all(axis=1) & np.isfinite(samples.gyr_radps).all(axis=1)
    silence_ns = np.diff(samples.t_ns)
    longest_ms = float(silence_ns.max()) / 1e6 if silence_ns.size else NAN
    missing = int((np.rint(gaps / usual_ns) - 1).sum()) if gaps.size else 0
    doubled, backward, unreal = (int(each.sum()) for each in (step_ns == 0, step_ns < 0, ~finite))
    counts = missing, doubled, backward, unreal
    return SensorQuality(sensor, samples.t_ns.size, NS_PER_S / usual_ns, *counts, longest_ms)


def group_refusals(commands: Sequence[StimCommand], origin_ns: int) -> tuple[Refusal, ...]:
    """Group the refused commands by reason, most frequent first; each group shows its first wording."""
    groups: dict[str, list[StimCommand]] = {}
    for command in commands:
        groups.setdefault(without_numbers(command.refused), []).append(command)
    found = []
    for group in groups.values():
        times_s = [(command.t_ns - origin_ns) / NS_PER_S for command in group]
        channels = tuple(sorted({command.channel for command in group}))
        found.append(Refusal(group[0].refused, len(group), channels, min(times_s), max(times_s)))
    return tuple(sorted(found, key=lambda refusal: -refusal.count))


def latency_of(latency_ns: IntArray) -> Latency:
    """Median, 99th percentile and maximum of the decision latency."""
    if latency_ns.size == 0:
        return Latency(0, NAN, NAN, NAN)
    p50, p99 = np.percentile(latency_ns, (50, 99)) / 1e6
    return Latency(int(latency_ns.size), float(p50), float(p99), float(latency_ns.max()) / 1e6)


def behind_the_end(record: WalkRecord, t_ns: int, reason: str) -> bool:
    """Whether a replay's gate finds the data old because the recording has ended, which is no fault."""
    ends = [int(samples.t_ns[-1]) for samples in record.samples.values() if samples.t_ns.size]
    return record.header.get("kind") == "replay" and t_ns > max(ends, default=t_ns) and STALE in reason


def session_notices(record: WalkRecord, origin_ns: int) -> tuple[Notice, ...]:
    """All notes, and what the stimulator itself reported as a fault, in order of time."""
    notes = []
    for note in record.notes:
        if note.source in (THRESHOLDS, EACH_ONSET, MARK):  # a table of their own; what the bursts show
            continue
        if note.source == "gate" and behind_the_end(record, note.t_ns, note.text):
            notes.append((note.t_ns, "info", note.source, f"the recording ends in a burst: {note.text}"))
        else:
            notes.append((note.t_ns, note.severity, note.source, note.text))
    notes += [(t_ns, "fault", "stimulator", text) for t_ns, text in _stimulator_faults(record)]
    found = [Notice((t_ns - origin_ns) / NS_PER_S, *told) for t_ns, *told in notes]
    return tuple(sorted(found, key=lambda notice: notice.time_s))


def _stimulator_faults(record: WalkRecord) -> Iterable[tuple[int, str]]:
    """In its answers, each kind once, and in its heartbeats."""
    groups = Counter((status.channel, status.fault) for status in record.statuses if status.fault)
    for (channel, fault), count in groups.items():
        first = next(s for s in record.statuses if s.channel == channel and s.fault == fault)
        yield first.t_ns, f"channel {channel}: {fault} ({count} answers)"
    fault, boot = "", record.alive[0].boot_id if record.alive else 0
    for beat in record.alive:
        if beat.fault and beat.fault != fault:
            yield beat.t_ns, beat.fault
        if beat.boot_id != boot:
            yield beat.t_ns, f"restarted (boot {boot} → {beat.boot_id})"
        fault, boot = beat.fault, beat.boot_id


@dataclass(frozen=True, slots=True)
class Flag:
    """One reason to be careful with one stride; ``count`` samples are concerned, 0 where it is not about samples."""

    kind: str
    count: int

    @property
    def short(self) -> str:
        """For a table's cell."""
        return f"{SHORT[self.kind]} {self.count}" if self.count else SHORT[self.kind]

    @property
    def text(self) -> str:
        """For people."""
        return MEANING[self.kind] + (f" ({self.count} samples)" if self.count else "")


@dataclass(frozen=True)
class SensorFlags:
    """One sensor's samples that want care, by time: ``t_ns`` (N,) in order, usually ``period_ns`` apart.

    ``at_limit`` by "acc" and "gyr" (N,): which have an axis at the limit. ``lost`` (N,): how many samples are missing
    just before this one, if they leave a gap that matters. ``limits`` by "acc" and "gyr": m/s², rad/s, NaN where none
    was reached and none is known; ``known``: they were given, not found in the samples.
    """

    t_ns: IntArray
    at_limit: dict[str, BoolArray]
    lost: IntArray
    limits: dict[str, float]
    known: bool
    period_ns: float = 0.0

    def count(self, kind: str, start_ns: int, end_ns: int) -> int:
        """How many samples of [start, end) are concerned."""
        low, high = np.searchsorted(self.t_ns, [start_ns, end_ns])
        values = self.lost if kind == LOST else self.at_limit["acc" if kind == CLIPPED_ACC else "gyr"]
        return int(values[low:high].sum())

    def spans(self, origin_ns: int) -> list[dict[str, Any]]:
        """Stretches with anything wrong, those less than 50 ms apart as one: kind, start and end in s."""
        found = []
        for kind, wrong in (("clipped", self.at_limit["acc"] | self.at_limit["gyr"]), ("lost", self.lost > 0)):
            at = np.flatnonzero(wrong)
            if not at.size:
                continue
            begin = end = self.t_ns[at]
            if kind == "lost":  # it began so many samples ago
                begin = end - (self.lost[at] * self.period_ns).astype(np.int64)
            first = np.flatnonzero(np.append(True, begin[1:] - end[:-1] > 0.05 * NS_PER_S))
            last = np.append(first[1:] - 1, at.size - 1)
            spans_s = (np.column_stack((begin[first], end[last])) - origin_ns) / NS_PER_S
            found += [{"kind": kind, "start_s": round(a, 4), "end_s": round(b, 4)} for a, b in spans_s.tolist()]
        return found


def sensor_flags(samples: SampleArrays, ranges: Mapping[str, float] | None = None) -> SensorFlags:
    """What is wrong with one sensor's samples; ``ranges`` by "acc" (m/s²) and "gyr" (rad/s), where they are known."""
    t_ns = sample_times(samples)
    values = {"acc": samples.acc_mps2, "gyr": samples.gyr_radps}
    if (t_ns[1:] < t_ns[:-1]).any():
        order = np.argsort(t_ns, kind="stable")
        t_ns, values = t_ns[order], {name: vectors[order] for name, vectors in values.items()}
    limits = {n: (ranges or {}).get(n) or _limit_reached(vectors, LEAST_LIMIT[n]) for n, vectors in values.items()}
    at_limit: dict[str, BoolArray] = {name: np.zeros(t_ns.size, np.bool_) for name in values}
    for name, vectors in values.items():
        for axis in vectors.T:  # one by one: hours of samples are not to be there twice
            at_limit[name] |= np.abs(axis) >= AT_LIMIT * limits[name]
    lost = np.zeros(t_ns.size, dtype=np.int64)
    whole = np.flatnonzero(np.isfinite(values["acc"]).all(axis=1) & np.isfinite(values["gyr"]).all(axis=1))
    step_ns = np.diff(t_ns[whole])
    forward = step_ns[step_ns > 0]
    usual_ns = float(np.median(forward)) if forward.size else 0.0
    if usual_ns:
        gap = step_ns > max(GAP_FACTOR * usual_ns, LEAST_GAP_S * NS_PER_S)
        lost[whole[1:][gap]] = np.rint(step_ns[gap] / usual_ns).astype(np.int64) - 1
    return SensorFlags(t_ns, at_limit, lost, limits, bool(ranges), usual_ns)


def _limit_reached(values: FloatArray, least: float) -> float:
    """The greatest size in (N, 3), if it stands so often in a row that it must be a limit; else NaN."""
    greatest = max(float(np.abs(axis).max(where=np.isfinite(axis), initial=0.0)) for axis in values.T)
    if greatest < least:
        return float("nan")
    full = np.concatenate([part for axis in values.T for part in (np.abs(axis) >= greatest, [False])])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], full]).astype(np.int8)))
    longest = int((edges[1::2] - edges[::2]).max()) if edges.size > 1 else 0
    return greatest if longest >= IN_A_ROW else float("nan")


def all_flags(record: WalkRecord, settings: Session | None) -> dict[str, SensorFlags]:
    """Of every sensor that sent anything, by name."""
    ranges = _ranges(record.header, settings)
    sent = {name: samples for name, samples in record.samples.items() if samples.t_ns.size}
    return {name: sensor_flags(samples, ranges.get(name)) for name, samples in sent.items()}


def stride_flags(
    record: WalkRecord, rows: Sequence[StrideRow], sensors: Mapping[str, SensorFlags]
) -> dict[tuple[str, int], tuple[Flag, ...]]:
    """By foot and stride number: what to be careful about; strides without anything are left out."""
    spans = {(stride.foot, stride.number): (stride.t_start_ns, stride.t_end_ns) for stride in record.strides}
    found = {}
    for row in rows:
        sensor, span = sensors.get(row.foot), spans.get((row.foot, row.number))
        kinds = (CLIPPED_ACC, CLIPPED_GYR, LOST) if sensor is not None and span is not None else ()
        flags = [Flag(kind, count) for kind in kinds if sensor and span and (count := sensor.count(kind, *span))]
        flags += [Flag(UNSURE, 0)] if row.valid and not row.four_phases else []
        if flags:
            found[row.foot, row.number] = tuple(flags)
    return found


def flag_findings(flags: Mapping[tuple[str, int], Sequence[Flag]], sensors: Mapping[str, SensorFlags]) -> list[Finding]:
    """A sentence for every sensor that reached its limit."""
    found = []
    for name, sensor in sensors.items():
        for kind, axis, unit in ((CLIPPED_ACC, "acc", "m/s²"), (CLIPPED_GYR, "gyr", "rad/s")):
            samples = int(sensor.at_limit[axis].sum())
            strides = sum(any(flag.kind == kind for flag in own) for (foot, _), own in flags.items() if foot == name)
            if samples:
                limit = f"{kind} at its limit of {sensor.limits[axis]:.0f} {unit}"
                where = f"in {count_of(samples, 'sample')}, in {count_of(strides, 'stride')}"
                how = "" if sensor.known else ", found in the samples, for the range is not known"
                text = f"Sensor {readable(name)}: {limit} {where}{how}."
                finding = Finding(
                    "warning", text, code=f"{axis}_clipped", sensor=name, cause=limit, effect=MEANING[kind],
                    remedy="record with a greater range",
                )  # fmt: skip
                found.append(finding)
    return found


def describe_flags(flags: Iterable[Sequence[Flag]]) -> str:
    """How many of these strides have which flag, in words; "" where none has."""
    strides = list(flags)
    counts = {kind: sum(any(flag.kind == kind for flag in own) for own in strides) for kind in NAMES}
    return ", ".join(f"{NAMES[kind]} in {count}" for kind, count in counts.items() if count)


def _ranges(header: Mapping[str, Any], settings: Session | None) -> dict[str, dict[str, float]]:
    """By sensor, from the session's devices or the recording's header."""
    found = {
        str(device.sensor): {"acc": device.acc_range_g * G_MPS2, "gyr": radians(device.gyr_range_dps)}
        for device in (settings.sensors if settings else ())
    }
    recording = header.get("recording")
    given = recording.get("ranges") if isinstance(recording, dict) else None
    for sensor, values in given.items() if isinstance(given, dict) else ():
        sizes = {name: values.get(name) for name in ("acc", "gyr")} if isinstance(values, dict) else {}
        numbers = {k: float(v) for k, v in sizes.items() if isinstance(v, (int, float)) and v > 0}
        if numbers:
            found.setdefault(str(sensor), numbers)
    return found
