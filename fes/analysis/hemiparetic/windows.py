"""Zero-velocity windows of the healthy foot: found by a threshold, merged, and split.

Source: Wang et al. (2013), section 3.1. The mean energy of the acceleration without gravity over a sliding window of
0.1 s is below 0.025 m²/s⁴ where the foot rests. Then:

- *merging*: a motion window shorter than half the mean motion window is removed; its neighbours become one;
- *splitting*: a zero-velocity window longer than twice their (new) mean is thresholded anew, more tightly.

The paper does not say how much more tightly, nor when to stop. Here the threshold is halved until the window falls
apart into rests that a motion window of at least half the mean separates, at most ``TIGHTENINGS`` times; a window
that begins or ends the recording is standing, and stays. "By selecting a proper threshold" is the paper's:
:func:`fitted_threshold` selects one where the printed value shows hardly any rest, as on a shaking treadmill or with
a brisk foot.

The healthy foot's motion windows become the paretic foot's zero-velocity windows, and are adjusted.

While the healthy foot swings, the paretic one must carry the body: it stands. Four adjustments are named there, none
with a number; what is silent is settled so:

- *appending*: the parts at the recording's start and end in which both feet stand;
- *shifting*, against errors of synchronisation: all windows by the same time, at most a fifth of the usual stride, to
  where the paretic foot's energy in them is least;
- *expanding* into double support: outwards while the paretic foot's energy is below the threshold;
- *shrinking*: inwards while it is above. Of a window that would vanish, its quietest 0.1 s stays: the foot did stand.
"""

import numpy as np

from fes.signals import BoolArray, FloatArray, IntArray

ENERGY_WINDOW_S = 0.1
THRESHOLD_M2PS4 = 0.025
MERGE_SHARE = 0.5  # of the mean motion window
SPLIT_FACTOR = 2.0  # of the mean zero-velocity window
TIGHTENINGS = 6  # halvings of the threshold inside a window that is too long
LOOSENINGS = 10  # doublings of the printed threshold, where it finds too little
LEAST_REST_SHARE = 0.15  # of a recording of walking; healthy feet rest for about a third of the time


def energy(acc_world_mps2: FloatArray, rate_hz: float) -> FloatArray:
    """Mean energy (N,) in m²/s⁴ over 0.1 s, centred, of the acceleration without gravity (N, 3)."""
    count = max(round(ENERGY_WINDOW_S * rate_hz), 1) | 1
    each = np.einsum("ij,ij->i", acc_world_mps2, acc_world_mps2)
    known = np.convolve(np.ones(len(each)), np.ones(count), "same")
    return np.asarray(np.convolve(each, np.ones(count), "same") / known)


def runs(inside: BoolArray) -> IntArray:
    """Stretches (K, 2) of True: first sample, and one past the last."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], inside, [False])).astype(np.int8)))
    return np.column_stack((edges[0::2], edges[1::2])).astype(np.int64)


def between(windows: IntArray) -> IntArray:
    """The motion windows (K − 1, 2) between neighbouring zero-velocity windows (K, 2)."""
    return np.column_stack((windows[:-1, 1], windows[1:, 0])).astype(np.int64)


def merged(windows: IntArray) -> IntArray:
    """Without motion windows shorter than half their mean."""
    if len(windows) < 2:
        return windows
    gaps = windows[1:, 0] - windows[:-1, 1]
    return _kept(windows, gaps >= MERGE_SHARE * gaps.mean())


def split(windows: IntArray, energy_m2ps4: FloatArray, threshold_m2ps4: float) -> IntArray:
    """Windows longer than twice their mean, split at tighter thresholds."""
    if len(windows) < 2:
        return windows
    lengths = windows[:, 1] - windows[:, 0]
    inner = (windows[:, 0] > 0) & (windows[:, 1] < len(energy_m2ps4))
    usual = float(lengths[inner].mean()) if inner.any() else float(lengths.mean())
    least_gap = MERGE_SHARE * float((windows[1:, 0] - windows[:-1, 1]).mean())
    out: list[IntArray] = []
    for window, length, is_inner in zip(windows, lengths.tolist(), inner.tolist(), strict=True):
        long = is_inner and length > SPLIT_FACTOR * usual
        out.append(_chunks(window, energy_m2ps4, threshold_m2ps4, least_gap) if long else window[None])
    return np.concatenate(out)


def _kept(windows: IntArray, apart: BoolArray) -> IntArray:
    """The windows (K, 2) joined where those of the K − 1 gaps between them are not kept ``apart``."""
    return np.column_stack((windows[np.append(True, apart), 0], windows[np.append(apart, True), 1])).astype(np.int64)


def _chunks(window: IntArray, energy_m2ps4: FloatArray, threshold_m2ps4: float, least_gap: float) -> IntArray:
    begin, end = int(window[0]), int(window[1])
    for halvings in range(1, TIGHTENINGS + 1):
        found = runs(energy_m2ps4[begin:end] < threshold_m2ps4 * 0.5**halvings) + begin
        apart = found[1:, 0] - found[:-1, 1] >= least_gap
        if apart.any():
            parts = _kept(found, apart)
            parts[0, 0], parts[-1, 1] = begin, end
            return parts
    return window[None]


def still_windows(energy_m2ps4: FloatArray, threshold_m2ps4: float = THRESHOLD_M2PS4) -> IntArray:
    """Zero-velocity windows (K, 2) of a foot: thresholded, merged, split; first sample, one past the last."""
    found = runs(energy_m2ps4 < threshold_m2ps4)
    return split(merged(found), energy_m2ps4, threshold_m2ps4)


def fitted_threshold(energy_m2ps4: FloatArray) -> float:
    """The printed threshold, doubled until the foot rests for a plausible share of the recording (m²/s⁴)."""
    threshold = THRESHOLD_M2PS4
    for _ in range(LOOSENINGS):
        if float((energy_m2ps4 < threshold).mean()) >= LEAST_REST_SHARE:
            break
        threshold *= 2.0
    return threshold


MOST_SHIFT_SHARE = 0.2  # of the time from window to window


def mapped(
    healthy: IntArray,
    healthy_energy: FloatArray,
    paretic_energy: FloatArray,
    thresholds_m2ps4: tuple[float, float],
    rate_hz: float,
) -> tuple[IntArray, float]:
    """The paretic foot's zero-velocity windows (K, 2), and by how much (s) all were shifted, later positive.

    ``healthy`` (K, 2) are the other foot's; the energies (N,) in m²/s⁴ are of the same instants, see :func:`energy`;
    the thresholds are the healthy and the paretic foot's.
    """
    n = len(paretic_energy)
    if len(healthy) < 2:
        return np.zeros((0, 2), np.int64), 0.0
    windows = between(healthy)
    usual = float(np.median(np.diff(healthy.mean(axis=1))))
    shift = _shift(windows, paretic_energy, round(MOST_SHIFT_SHARE * usual))
    still = paretic_energy < thresholds_m2ps4[1]
    hold = max(round(ENERGY_WINDOW_S * rate_hz), 1)
    shifted = np.clip(windows + shift, 0, n)
    adjusted = [_fitted(int(a), int(b), paretic_energy, still, hold) for a, b in shifted if b > a]
    if adjusted:  # and standing with both feet before the first and after the last window
        first, last = min(begin for begin, _ in adjusted), max(end for _, end in adjusted)
        both = runs((healthy_energy < thresholds_m2ps4[0]) & still)
        for stands in (both[both[:, 1] <= first][:1], both[both[:, 0] >= last][-1:]):
            adjusted += [(int(a), int(b)) for a, b in stands if b - a >= hold and (a < hold or b > n - hold)]
    joined: list[list[int]] = []
    for begin, end in sorted(adjusted):
        if joined and begin <= joined[-1][1]:
            joined[-1][1] = max(joined[-1][1], end)
        else:
            joined.append([begin, end])
    return np.array(joined, dtype=np.int64).reshape(-1, 2), shift / rate_hz


def _shift(windows: IntArray, energy_m2ps4: FloatArray, most: int) -> int:
    """The common shift (samples) with the least mean energy; the smaller one where two are as good."""
    total = np.concatenate(([0.0], np.cumsum(energy_m2ps4)))
    best, found = np.inf, 0
    for shift in sorted(range(-most, most + 1), key=abs):
        moved = np.clip(windows + shift, 0, len(energy_m2ps4))
        count = int((moved[:, 1] - moved[:, 0]).sum())
        mean = float((total[moved[:, 1]] - total[moved[:, 0]]).sum()) / max(count, 1)
        if mean < best * (1.0 - 1e-9):
            best, found = mean, shift
    return found


def _fitted(begin: int, end: int, energy_m2ps4: FloatArray, still: BoolArray, hold: int) -> tuple[int, int]:
    """One window, expanded and shrunk."""
    first, last = begin, end
    while first < last and not still[first]:
        first += 1
    while last > first and not still[last - 1]:
        last -= 1
    if first == last:
        quiet = begin + int(np.argmin(energy_m2ps4[begin:end]))
        return max(quiet - hold // 2, begin), min(quiet + hold // 2 + 1, end)
    while first > 0 and still[first - 1]:
        first -= 1
    while last < len(still) and still[last]:
        last += 1
    return first, last
