"""How good the recorded data are: gaps, doubled and backward stamps, stuck sensors; and what was noted."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fes.signals import NS_PER_S, IntArray, StimAlive, StimCommand
from fes.walk_record import Note, SampleArrays, WalkRecord

CLOCKS_AGREE_NS = NS_PER_S
FAR_NS = 3600 * NS_PER_S
GAP_FACTOR = 1.8  # an interval this many times the usual one has at least one sample missing
NAN = float("nan")


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
    return SensorQuality(
        sensor=sensor,
        samples=int(samples.t_ns.size),
        rate_hz=NS_PER_S / usual_ns,
        missing=int((np.rint(gaps / usual_ns) - 1).sum()) if gaps.size else 0,
        doubled=int((step_ns == 0).sum()),
        backward=int((step_ns < 0).sum()),
        not_a_number=int((~finite).sum()),
        longest_silence_ms=float(silence_ns.max()) / 1e6 if silence_ns.size else NAN,
    )


def all_sensors(samples: Mapping[str, SampleArrays]) -> tuple[SensorQuality, ...]:
    """The quality of every sensor that sent anything."""
    return tuple(sensor_quality(name, arrays) for name, arrays in samples.items() if arrays.t_ns.size)


def without_numbers(text: str) -> str:
    """The words of a reason, by which like reasons are told from unlike ones."""
    return re.sub(r"\d+([.,]\d+)?", "#", text)


def group_refusals(commands: Sequence[StimCommand], origin_ns: int) -> tuple[Refusal, ...]:
    """Group the refused commands by reason, most frequent first; each group shows its first wording."""
    groups: dict[str, list[StimCommand]] = {}
    for command in commands:
        groups.setdefault(without_numbers(command.refused), []).append(command)
    found = [
        Refusal(
            reason=group[0].refused,
            count=len(group),
            channels=tuple(sorted({command.channel for command in group})),
            first_s=(min(command.t_ns for command in group) - origin_ns) / NS_PER_S,
            last_s=(max(command.t_ns for command in group) - origin_ns) / NS_PER_S,
        )
        for group in groups.values()
    ]
    return tuple(sorted(found, key=lambda refusal: -refusal.count))


def latency_of(latency_ns: IntArray) -> Latency:
    """Median, 99th percentile and maximum of the decision latency."""
    if latency_ns.size == 0:
        return Latency(0, NAN, NAN, NAN)
    p50, p99 = np.percentile(latency_ns, (50, 99)) / 1e6
    return Latency(int(latency_ns.size), float(p50), float(p99), float(latency_ns.max()) / 1e6)


def session_notices(record: WalkRecord, origin_ns: int) -> tuple[Notice, ...]:
    """All notes, and what the stimulator itself reported as a fault, in order of time."""
    found = [Notice((note.t_ns - origin_ns) / NS_PER_S, note.severity, note.source, note.text) for note in record.notes]
    found += [
        Notice((note.t_ns - origin_ns) / NS_PER_S, note.severity, note.source, note.text)
        for note in (*_status_faults(record), *_heartbeat_faults(record.alive))
    ]
    return tuple(sorted(found, key=lambda notice: notice.time_s))


def _status_faults(record: WalkRecord) -> Iterable[Note]:
    groups = Counter((status.channel, status.fault) for status in record.statuses if status.fault)
    for (channel, fault), count in groups.items():
        first = next(s for s in record.statuses if s.channel == channel and s.fault == fault)
        yield Note(first.t_ns, "fault", "stimulator", f"channel {channel}: {fault} ({count} answers)")


def _heartbeat_faults(alive: Sequence[StimAlive]) -> Iterable[Note]:
    fault, boot = "", alive[0].boot_id if alive else 0
    for beat in alive:
        if beat.fault and beat.fault != fault:
            yield Note(beat.t_ns, "fault", "stimulator", beat.fault)
        if beat.boot_id != boot:
            yield Note(beat.t_ns, "fault", "stimulator", f"restarted (boot {boot} → {beat.boot_id})")
        fault, boot = beat.fault, beat.boot_id
