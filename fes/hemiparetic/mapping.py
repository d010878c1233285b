"""The healthy foot's motion windows become the afflicted foot's zero-velocity windows, and are adjusted.

Source: Wang et al. (2013), section 3.1. While the healthy foot swings, the afflicted one must carry the body: it
stands. Four adjustments are named there, none with a number; what is silent is settled so:

- *appending*: the parts at the recording's start and end in which both feet stand;
- *shifting*, against errors of synchronisation: all windows by the same time, at most a fifth of the usual stride, to
  where the afflicted foot's energy in them is least;
- *expanding* into double support: outwards while the afflicted foot's energy is below the threshold;
- *shrinking*: inwards while it is above. Of a window that would vanish, its quietest 0.1 s stays: the foot did stand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fes.hemiparetic.windows import ENERGY_WINDOW_S, between, runs
from fes.signals import FloatArray, IntArray

MOST_SHIFT_SHARE = 0.2  # of the time from window to window


@dataclass(frozen=True, slots=True)
class Mapped:
    """The afflicted foot's zero-velocity windows (K, 2), and by how much (s) all were shifted, later positive."""

    windows: IntArray
    shift_s: float


def mapped(
    healthy: IntArray,
    healthy_energy: FloatArray,
    afflicted_energy: FloatArray,
    thresholds_m2ps4: tuple[float, float],
    rate_hz: float,
) -> Mapped:
    """Windows of the afflicted foot from those of the healthy one.

    Args:
        healthy: (K, 2) zero-velocity windows of the healthy foot.
        healthy_energy: (N,) m²/s⁴, see :func:`fes.hemiparetic.windows.energy`.
        afflicted_energy: (N,) at the same instants.
        thresholds_m2ps4: of the healthy and of the afflicted foot.
        rate_hz: sampling rate.
    """
    n = len(afflicted_energy)
    if len(healthy) < 2:
        return Mapped(np.zeros((0, 2), np.int64), 0.0)
    windows = between(healthy)
    usual = float(np.median(np.diff(healthy.mean(axis=1))))
    shift = _shift(windows, afflicted_energy, round(MOST_SHIFT_SHARE * usual))
    windows = np.clip(windows + shift, 0, n)
    threshold = thresholds_m2ps4[1]
    hold = max(round(ENERGY_WINDOW_S * rate_hz), 1)
    adjusted = [_fitted(int(a), int(b), afflicted_energy, threshold, hold) for a, b in windows if b > a]
    both = (healthy_energy < thresholds_m2ps4[0]) & (afflicted_energy < threshold)
    adjusted += _ends(runs(both), np.array(adjusted, np.int64).reshape(-1, 2), n, hold)
    return Mapped(_joined(np.array(sorted(adjusted), dtype=np.int64).reshape(-1, 2)), shift / rate_hz)


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


def _fitted(begin: int, end: int, energy_m2ps4: FloatArray, threshold: float, hold: int) -> tuple[int, int]:
    """One window, expanded and shrunk."""
    still = energy_m2ps4 < threshold
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


def _ends(both: IntArray, windows: IntArray, n: int, hold: int) -> list[tuple[int, int]]:
    """Standing with both feet before the first and after the last window."""
    if len(windows) == 0:
        return []
    first, last = int(windows[:, 0].min()), int(windows[:, 1].max())
    found = []
    before, after = both[both[:, 1] <= first], both[both[:, 0] >= last]
    for stands in (before[:1], after[-1:]):
        found += [(int(a), int(b)) for a, b in stands if b - a >= hold and (a < hold or b > n - hold)]
    return found


def _joined(windows: IntArray) -> IntArray:
    """Windows that touch or overlap as one."""
    out: list[list[int]] = []
    for begin, end in windows.tolist():
        if out and begin <= out[-1][1]:
            out[-1][1] = max(out[-1][1], end)
        else:
            out.append([begin, end])
    return np.array(out, dtype=np.int64).reshape(-1, 2)
