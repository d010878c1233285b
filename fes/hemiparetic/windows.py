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
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fes.signals import FloatArray, IntArray

BoolArray = np.ndarray[Any, np.dtype[np.bool_]]

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
    keep = gaps >= MERGE_SHARE * gaps.mean()
    return np.column_stack((windows[np.append(True, keep), 0], windows[np.append(keep, True), 1])).astype(np.int64)


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
        out.append(_pieces(window, energy_m2ps4, threshold_m2ps4, least_gap) if long else window[None])
    return np.concatenate(out)


def _pieces(window: IntArray, energy_m2ps4: FloatArray, threshold_m2ps4: float, least_gap: float) -> IntArray:
    begin, end = int(window[0]), int(window[1])
    for halvings in range(1, TIGHTENINGS + 1):
        tighter = threshold_m2ps4 * 0.5**halvings
        found = runs(energy_m2ps4[begin:end] < tighter) + begin
        if len(found) < 2:
            continue
        apart = found[1:, 0] - found[:-1, 1] >= least_gap
        if apart.any():
            parts = np.column_stack((found[np.append(True, apart), 0], found[np.append(apart, True), 1]))
            parts[0, 0], parts[-1, 1] = begin, end
            return parts.astype(np.int64)
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
