"""How far two clocks are apart: the lag at which two signals look most alike, and whether that can be believed.

Walking repeats itself, so that a wrong lag, one stride off, looks nearly as good as the right one. The lag is therefore
only believed where the signals are alike, the next best lag is clearly worse, and both halves of the recording say the
same.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fes.evaluation.agreement import NAN
from fes.signals import FloatArray

GRID_S: Final = 0.01
LEAST_OVERLAP: Final = 0.5  # of the shorter signal
LEAST_LIKENESS: Final = 0.7
LEAST_LEAD: Final = 0.02
PEAK_S: Final = 0.3  # around the best lag: its own peak, not another
HALVES_S: Final = 0.05
WIDTH_S: Final = 0.03  # standard deviation of the bump that stands for an event


@dataclass(frozen=True, slots=True)
class Lag:
    """``t_recording = t_reference + lag_s``."""

    lag_s: float  # refined between grid points
    likeness: float  # correlation of the two signals there, −1…1
    residual: float  # what is left of the reference when the scaled recording is taken off, as a share of its RMS
    next_best: float  # the greatest correlation at any other peak
    halves_s: float  # lag of the later half minus lag of the earlier one; a drift of one clock shows here
    caveat: str = ""  # why the lag should not be believed; "" where it may


def event_trains(times_s: Sequence[FloatArray], grid_s: FloatArray, width_s: float = WIDTH_S) -> FloatArray:
    """One column per kind of event: a bump of ``width_s`` at each of its times, on a grid (N,); returns (N, K)."""
    out = np.zeros((len(grid_s), len(times_s)))
    for k, times in enumerate(times_s):
        for at in np.asarray(times, np.float64):
            near = slice(*np.searchsorted(grid_s, (at - 5.0 * width_s, at + 5.0 * width_s)).tolist())
            out[near, k] += np.exp(-0.5 * ((grid_s[near] - at) / width_s) ** 2)
    return out


def find_lag(
    reference_s: FloatArray, reference: FloatArray, recording_s: FloatArray, recording: FloatArray, most_s: float
) -> Lag:
    """Cross-correlate two signals of K columns, each on its own increasing times, up to ``most_s`` either way.

    Times are (N,) and (M,) in s, the signals (N, K) or (N,), (M, K) or (M,); NaN rows count as unknown.

    Raises:
        ValueError: nothing overlaps within that lag, or a signal never changes.
    """
    a, begin_a = _on_grid(reference_s, reference)
    b, begin_b = _on_grid(recording_s, recording)
    offset_s = begin_b - begin_a  # of the grids' first points
    first, last = (round((side * most_s - offset_s) / GRID_S) for side in (-1.0, 1.0))
    steps = np.arange(first, last + 1)
    likeness = np.array([_likeness(a, b, int(step)) for step in steps])
    if not np.isfinite(likeness).any():
        raise ValueError(f"the reference and the recording do not overlap with a lag of up to {most_s:g} s")
    best = int(np.nanargmax(likeness))
    lag_s = offset_s + GRID_S * (float(steps[best]) + _between(likeness, best))
    peak = float(likeness[best])
    away = np.abs(np.arange(len(steps)) - best) > round(PEAK_S / GRID_S)
    others = likeness[away & np.isfinite(likeness)]
    next_best = float(others.max()) if len(others) else NAN
    halves_s = _halves(a, b, int(steps[best]))
    caveat = ""
    if peak < LEAST_LIKENESS:
        caveat = f"the two signals are not much alike at any lag (correlation {peak:.2f})"
    elif np.isfinite(next_best) and peak - next_best < LEAST_LEAD:
        caveat = f"another lag fits nearly as well (correlation {peak:.3f} against {next_best:.3f})"
    elif np.isfinite(halves_s) and abs(halves_s) > HALVES_S:
        caveat = f"the later half asks for {1e3 * halves_s:+.0f} ms more than the earlier one: a clock drifts"
    return Lag(lag_s, peak, float(np.sqrt(max(1.0 - peak * peak, 0.0))), next_best, halves_s, caveat)


def _on_grid(times_s: FloatArray, values: FloatArray) -> tuple[FloatArray, float]:
    """Values (N, K) on an even grid, each column without its mean and of one size; and where the grid begins."""
    times_s, values = np.asarray(times_s, np.float64), np.asarray(values, np.float64)
    values = values[:, None] if values.ndim == 1 else values
    known = np.isfinite(values).all(axis=1) & np.isfinite(times_s)
    times_s, values = times_s[known], values[known]
    if len(times_s) < 3 or times_s[-1] - times_s[0] < 3.0 * GRID_S:
        raise ValueError("a signal for the lag needs at least three known values")
    begin = float(times_s[0])
    grid = begin + GRID_S * np.arange(int((times_s[-1] - begin) / GRID_S) + 1)
    out = np.column_stack([np.interp(grid, times_s, column) for column in values.T])
    out -= out.mean(axis=0)
    size = np.sqrt((out**2).mean(axis=0))
    if not (size > 0.0).any():
        raise ValueError("a signal for the lag never changes")
    return np.asarray(out / np.where(size > 0.0, size, 1.0)), begin


def _likeness(a: FloatArray, b: FloatArray, step: int) -> float:
    """Correlation of ``a[i]`` with ``b[i + step]`` where both are known; NaN where they hardly overlap."""
    low, high = max(0, -step), min(len(a), len(b) - step)
    if high - low < LEAST_OVERLAP * min(len(a), len(b)):
        return NAN
    x, y = a[low:high], b[low + step : high + step]
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    size = float(np.sqrt((x * x).sum() * (y * y).sum()))
    return float((x * y).sum()) / size if size > 0.0 else NAN


def _between(likeness: FloatArray, best: int) -> float:
    """Where the top of a parabola through the three points around the best one lies, −0.5…0.5 grid points."""
    if not 0 < best < len(likeness) - 1:
        return 0.0
    left, top, right = likeness[best - 1 : best + 2]
    bend = left - 2.0 * top + right
    return float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5)) if np.isfinite(bend) and bend < 0.0 else 0.0


def _halves(a: FloatArray, b: FloatArray, best: int) -> float:
    """Lag of the later half minus that of the earlier one (s), looked for near the best; NaN where too short."""
    low, high = max(0, -best), min(len(a), len(b) - best)
    middle, reach = (low + high) // 2, round(PEAK_S / GRID_S)
    if high - low < 20 * reach:
        return NAN
    found = []
    for begin, end in ((low, middle), (middle, high)):
        part = a[begin:end]
        steps = [step for step in range(best - reach, best + reach + 1) if begin + step >= 0 and end + step <= len(b)]
        if not steps:
            return NAN
        values = np.array([float((part * b[begin + step : end + step]).sum()) for step in steps])
        at = int(np.argmax(values))
        found.append(GRID_S * (steps[at] + _between(values, at)))
    return found[1] - found[0]
