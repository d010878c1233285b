"""Two feet with separate clocks: by how much the clock of one runs ahead, from what both sensors feel.

Wang et al. (2013), section 2, had their subjects hop, for a signature in both sensors. Three things that a walk itself
shows are used here, none is in the paper:

1. *Which stride is which*: contacts of one foot, counted from a contact of the other, spread least where the count is
   right (:func:`_pairing`). ``runner_up`` says how close a walk comes to itself shifted by a stride.
2. *Which part of the stride*: the clocks are set so that both double supports last equally long (:func:`_halves`); in
   hemiparesis they differ by up to 0.1 s, and this is off by half of it.
3. *The instant*: a foot feels the other one land (:func:`_jolts`). The delay of left after right and of right after
   left is the same but for the clocks: half of their difference is the error of the second.

**Knocks** (stamping, hopping, knocking the sensors together) at standing beat all that: :func:`knocks`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fes.estimation.events.offline import GaitEvents, find_events
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.sensor_choice import Calibration
from fes.recording import Recording
from fes.recording.tracks import increasing
from fes.signals import FOOT_SENSORS, NS_PER_S, FloatArray, IntArray

LEAST_STRIDES = 8
JOLT_REACH_S = 0.15  # around the other's contact
JOLT_STEP_S = 0.005
JOLT_CLEAR = 1.4  # how much stronger than around it a jolt must be
MOST_JOLT_S = 0.12  # what jolts correct by at most
KNOCK_HZ = 100.0
KNOCK_MPS2 = 4.0  # rms over 20 ms: nothing that a standing foot does by itself
KNOCK_CLEAR = 0.7
LEAST_KNOCKS = 3  # a single jolt may be a first step that was not seen as one
EXPECTED_S = {"knocks": 0.01, "jolts": 0.12, "halves": 0.2}  # the largest seen
SURE = 0.8  # the runner-up's


@dataclass(frozen=True, slots=True)
class Samples:
    """One foot on its own clock: ``t_ns`` (N,), ``acc_mps2`` (N, 3) as measured, ``events`` of the whole recording."""

    t_ns: IntArray
    acc_mps2: FloatArray
    events: GaitEvents


@dataclass(frozen=True, slots=True)
class Offset:
    """What to add to the second foot's clock (s)."""

    offset_s: float
    method: str  # "knocks", "jolts" (walking, refined by the other foot's landings) or "halves" (walking alone)
    runner_up: float  # spread of the pairing found over that of the best other one, 0 (certain) … 1 (a guess)
    expected_s: float  # how far off it may be
    sure: bool  # whether the stride was told clearly


def offset(one: Samples, other: Samples) -> Offset:
    """By how much the second foot's clock must be set forward to agree with the first one's.

    Raises:
        ValueError: too few steps, and no knocks.
    """
    knock = knocks(one, other)
    if knock is not None:
        return Offset(knock, "knocks", 0.0, EXPECTED_S["knocks"], True)
    a, b = ((s.events.ic_ns - one.t_ns[0]) / NS_PER_S for s in (one, other))
    if min(len(a), len(b)) < LEAST_STRIDES:
        raise ValueError(f"{len(a)} and {len(b)} steps, and no knocks: {LEAST_STRIDES} steps of either foot are needed")
    coarse, runner_up = _pairing(a, b)
    halves = _halves(one, other, coarse)
    jolt = _jolts(one, other, halves)
    method = "halves" if jolt is None else "jolts"
    return Offset(halves + (jolt or 0.0), method, runner_up, EXPECTED_S[method], runner_up < SURE)


def _pairing(a_s: FloatArray, b_s: FloatArray) -> tuple[float, float]:
    """Offset (s) that puts B's contacts midway between A's, and how near the second best pairing comes.

    For each count m, the differences ``b[k + m] − a[k]`` vary by no more than a step's time varies only where both are
    of the same stride; elsewhere the variation of all strides in between comes on top.
    """
    usual = float(np.median(np.diff(a_s)))
    most = max(len(a_s), len(b_s)) - LEAST_STRIDES
    spreads: dict[int, tuple[float, float]] = {}
    for m in range(-most, most + 1):
        first, last = max(0, -m), min(len(a_s), len(b_s) - m)
        if last - first < LEAST_STRIDES:
            continue
        apart = b_s[first + m : last + m] - a_s[first:last]
        middle = float(np.median(apart))
        # a missed step shifts the rest by one: whole strides count as nothing
        rest = apart - middle
        rest -= usual * np.round(rest / usual)
        spreads[m] = float(np.sqrt(np.mean(rest**2))), middle
    # of two neighbouring counts one is half a stride early, one half a stride late
    pairs = {m: spreads[m][0] + spreads[m + 1][0] for m in spreads if m + 1 in spreads}
    best = min(pairs, key=lambda m: pairs[m])
    others = [value for m, value in pairs.items() if m != best]
    runner_up = pairs[best] / min(others) if others else 1.0
    middle = 0.5 * (spreads[best][1] + spreads[best + 1][1])
    return -middle, runner_up


def _halves(one: Samples, other: Samples, coarse_s: float) -> float:
    """Offset with which both double supports last equally long (medians)."""
    events = one.events.ic_ns, one.events.fo_ns, other.events.ic_ns, other.events.fo_ns
    a_ic, a_fo, b_ic, b_fo = ((times - one.t_ns[0]) / NS_PER_S for times in events)
    found = coarse_s
    for _ in range(2):
        # A lands, then B leaves; B lands, then A leaves
        first, second = _following(a_ic, b_fo + found), _following(b_ic + found, a_fo)
        found += 0.5 * (second - first)
    return found


def _following(times: FloatArray, events: FloatArray) -> float:
    """Median time (s) from each of ``times`` to the nearest of ``events``."""
    at = np.clip(np.searchsorted(events, times), 1, len(events) - 1)
    before, after = events[at - 1] - times, events[at] - times
    return float(np.median(np.where(np.abs(before) < np.abs(after), before, after)))


def _jolts(one: Samples, other: Samples, offset_s: float) -> float | None:
    """What the other's landings, as each foot feels them, say is still wrong with the offset (s); None: not felt."""
    left, right = (
        _delay(own, (its.events.ic_ns - own.t_ns[0]) / NS_PER_S + sign * offset_s)
        for own, its, sign in ((one, other, 1.0), (other, one, -1.0))
    )
    if left is None or right is None:
        return None
    # A feels B land too late by as much as B's clock is set too early, and the other way round
    wrong = 0.5 * (left - right)
    return wrong if abs(wrong) <= MOST_JOLT_S else None


def _delay(own: Samples, landed_s: FloatArray) -> float | None:
    """When this foot feels a jolt, after the other lands (s, where the median jolt begins); None if it feels none."""
    t = (own.t_ns - own.t_ns[0]) / NS_PER_S
    jerk = np.zeros(len(t))
    jerk[1:] = np.linalg.norm(np.diff(own.acc_mps2, axis=0), axis=1) / np.diff(t)
    grid = np.arange(-JOLT_REACH_S, JOLT_REACH_S + 1e-9, JOLT_STEP_S)
    inside = landed_s[(landed_s > t[0] + JOLT_REACH_S) & (landed_s < t[-1] - JOLT_REACH_S)]
    if len(inside) < LEAST_STRIDES:
        return None
    shown = np.median([np.interp(at + grid, t, jerk) for at in inside], axis=0)
    quiet = float(np.median(shown[: len(grid) // 3]))
    rise = shown > JOLT_CLEAR * quiet
    # the jolt is the first rise; what comes later is the foot's own push-off
    if not rise.any() or rise[: len(grid) // 6].any():
        return None
    return float(grid[int(np.argmax(rise))])


def knocks(one: Samples, other: Samples) -> float | None:
    """Offset (s) from knocks that both feet feel at once while neither walks; None where there are none.

    Taken from the cross-correlation of the jolts' envelopes, at 100 Hz, of all that lies before the first or after
    the last swing of each foot.
    """
    envelopes = [_knock_envelope(samples) for samples in (one, other)]
    for envelope in envelopes:
        above = np.flatnonzero(envelope > KNOCK_MPS2)
        if not len(above) or np.count_nonzero(np.diff(above) > 0.2 * KNOCK_HZ) + 1 < LEAST_KNOCKS:  # within 0.2 s: one
            return None
    a, b = (np.where(e > KNOCK_MPS2, e, 0.0) for e in envelopes)
    size = 1 << (len(a) + len(b)).bit_length()
    product = np.fft.irfft(np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size)), size)
    product /= float(np.linalg.norm(a) * np.linalg.norm(b))
    at = int(np.argmax(product))
    if product[at] < KNOCK_CLEAR:
        return None
    lag = at - size if at > size // 2 else at
    return lag / KNOCK_HZ - float(other.t_ns[0] - one.t_ns[0]) / NS_PER_S


def _knock_envelope(samples: Samples) -> FloatArray:
    """Rms (m/s²) over 20 ms of what changes in the force's size within 50 ms, at 100 Hz, zero while the foot walks."""
    t = (samples.t_ns - samples.t_ns[0]) / NS_PER_S
    rate = 1.0 / float(np.median(np.diff(t)))
    size = np.linalg.norm(samples.acc_mps2, axis=1)
    width = max(round(0.05 * rate), 3) | 1
    changing = (size - np.convolve(size, np.ones(width) / width, "same")) ** 2
    changing[:width] = changing[-width:] = 0.0
    short = max(round(0.02 * rate), 1)
    rms = np.sqrt(np.convolve(changing, np.ones(short) / short, "same"))
    events = samples.events
    if len(events):
        walking = (samples.t_ns > events.fo_ns[0] - NS_PER_S) & (samples.t_ns < events.ic_ns[-1] + NS_PER_S)
        rms[walking] = 0.0
    grid = np.arange(0.0, t[-1], 1.0 / KNOCK_HZ)
    return np.asarray(np.interp(grid, t, rms))


def synchronised(recording: Recording, calibrations: Mapping[str, Calibration]) -> tuple[Recording, Offset]:
    """The recording with all sensors of the right leg set to the left foot's clock, and how far they were set forward.

    All times move together so that none is negative.

    Raises:
        ValueError: not both feet are there, or neither walk nor knocks show how their clocks lie.
    """
    samples = []
    for foot in FOOT_SENSORS:
        calibration = calibrations.get(foot)
        if foot not in recording.tracks or not isinstance(calibration, FootCalibration):
            raise ValueError(f"{recording.name}: {foot} is missing; it takes both feet to bring them together")
        track = recording.tracks[foot]
        newer = increasing(track)
        t_ns, acc, gyr = track.t_sensor_ns[newer], track.acc_mps2[newer], track.gyr_radps[newer]
        samples.append(Samples(t_ns, acc, find_events(t_ns, acc, gyr, calibration)))
    found = offset(samples[0], samples[1])
    forward = round(found.offset_s * NS_PER_S)
    shifts = {name: forward if name.startswith("right") else 0 for name in recording.tracks}
    earliest = min(int(track.t_ns[0]) + shifts[name] for name, track in recording.tracks.items())
    shifts = {name: shift - min(earliest, 0) for name, shift in shifts.items()}
    later = {
        name: replace(track, t_ns=track.t_ns + shifts[name], t_sensor_ns=track.t_sensor_ns + shifts[name])
        for name, track in recording.tracks.items()
    }
    return replace(recording, tracks=later), found
