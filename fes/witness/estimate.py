"""What has to be assumed of a sensor for its strides to close: lag, gain, bias and scale, with their uncertainty.

Robust Gauss–Newton over the strides (Huber 1981), each residual weighed by its own scatter over them. The model is
never quite true, for the foot is never quite at rest: standard deviations come from the scatter of the strides' own
scores (White 1982).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from fes.estimation.closures import BIAS, GAIN, LAG, RESIDUALS, SOUND, closures
from fes.recording.tracks import Track, newer_samples
from fes.signals import FloatArray, IntArray

BoolVector = np.ndarray[Any, np.dtype[np.bool_]]

SHORTEST_S, LONGEST_S = 0.4, 3.0  # of a stride: what is added up for longer drifts
FEWEST: Final = 20  # strides that an estimate is made from
QUIET_RADPS: Final = 0.4  # at a stride's border, as for gravity (fes.estimation.foot.calibration)
BORDER_S: Final = 0.0401
APART_S: Final = 0.25  # no two quiet instants are closer
RESTING_RADPS, MOVING_RADPS = 1.0, 1.5  # at one, and somewhere between two
REPEATED: Final = 4  # equal greatest values in a row are a limit
LEAST_LIMIT: Final = (15.0, 4.0)  # m/s², rad/s, as in fes.report.quality
PRIOR_SD: Final = np.array((math.inf, 0.15, *3 * [math.radians(1.5)], 0.05))  # docs/witness.md
SCATTER_LEAST: Final = np.array((2e-3, 2e-3, 2e-3, 5e-4, 5e-4, 5e-4))  # of a residual: noise alone
STEP: Final = np.array((1e-3, 5e-3, 5e-3, 5e-3, 5e-3, 5e-3))
MOST_STEP: Final = np.array((0.02, 0.1, 0.05, 0.05, 0.05, 0.05))
ENOUGH: Final = np.array((1e-4, 5e-4, 5e-4, 5e-4, 5e-4, 5e-4))  # a step so small changes nothing that is told
HUBER: Final = 2.5
ROUNDS: Final = 8
MOST, MOST_ON_GRID = 60, 24  # strides, of a recording that has more
STRIDE_SCATTER: Final = np.array((0.15, 0.15, 0.15, 0.05, 0.03, 0.03))  # of one stride's residuals, sound
STRIDE_BIAS_SD_RADPS: Final = math.radians(15.0)
LAGS_S: Final = np.arange(-0.08, 0.0801, 0.01)
LAGS_APART_S: Final = (-0.02, 0.0, 0.02)  # the misfit has several hollows along the lag
GAINS: Final = (0.7, 0.8, 0.87, 0.93, 1.0, 1.07, 1.15, 1.25, 1.4)


@dataclass(frozen=True, eq=False)
class Spans:
    """Strides of a sensor that can be closed: samples (``closures``), borders as rows, and of all the number kept."""

    samples: tuple[FloatArray, FloatArray, FloatArray]
    begin_ns: int
    first: IntArray
    last: IntArray
    found: int
    limit_radps: float  # of the gyroscope, by its samples; infinite where it reached none
    clipped: int
    rest_radps: FloatArray  # (3,) what the gyroscope reads at the borders

    def part(self, which: slice | BoolVector) -> Spans:
        """Only these strides."""
        return replace(self, first=self.first[which], last=self.last[which])

    def thinned(self, most: int, newest: int = 0) -> Spans:
        """So many strides at most, evenly chosen, and the newest ones besides."""
        if len(self) <= most:
            return self
        order = np.arange(len(self))
        return self.part(
            np.isin(order, np.linspace(0, len(self) - 1, most).astype(int)) | (order >= len(self) - newest)
        )

    def t_ns(self, stride: int) -> int:
        """When a stride begins."""
        return self.begin_ns + round(1e9 * float(self.samples[0][self.first[stride]]))

    def __len__(self) -> int:
        return self.first.size


@dataclass(frozen=True, eq=False)
class Fit:
    """An estimate (6,) with its standard deviations; ``misfit``: the sum of the residuals' log scatters about zero."""

    sensor: FloatArray
    sd: FloatArray
    misfit: float
    scatter: FloatArray


def spans_of(track: Track, starts_ns: IntArray, ends_ns: IntArray) -> Spans:
    """The strides of a track that can be closed: whole, quiet at both ends, without a gap and off the limits."""
    t_ns, acc, gyr = newer_samples(track)
    t_s = 1e-9 * (t_ns - t_ns[0])
    limits = [_limit(values, least) for values, least in zip((acc, gyr), LEAST_LIMIT, strict=True)]
    full = (np.abs(acc) >= 0.999 * limits[0]).any(axis=1) | (np.abs(gyr) >= 0.999 * limits[1]).any(axis=1)
    usual_s = float(np.median(np.diff(t_s)))
    broken = np.append(np.diff(t_s) > max(4.0 * usual_s, 0.03), False) | ~np.isfinite(acc.sum(axis=1) + gyr.sum(axis=1))
    clipped, breaks = (np.concatenate(([0], np.cumsum(each))) for each in (full, broken))
    first, last = np.searchsorted(t_ns, starts_ns), np.searchsorted(t_ns, ends_ns)
    inside = (first > 0) & (last < t_ns.size - 1)
    first, last = first[inside], last[inside]
    lasts_s = t_s[last] - t_s[first]
    whole = (lasts_s > SHORTEST_S) & (lasts_s < LONGEST_S) & (breaks[last + 1] == breaks[first])
    first, last = first[whole], last[whole]
    off = clipped[last + 1] == clipped[first]
    both = np.concatenate((first, last))
    rates = _means(t_s, gyr, both).reshape(2, -1, 3)
    usual = np.median(rates.reshape(-1, 3), axis=0) if both.size else np.zeros(3)  # the bias, if the foot rests
    quiet = (np.sqrt(((rates - usual) ** 2).sum(axis=2)) < QUIET_RADPS).all(axis=0)
    kept = off & quiet
    samples = t_s, np.ascontiguousarray(acc), np.ascontiguousarray(gyr)
    begin_ns, clipped_count = int(t_ns[0]), int((~off).sum())
    return Spans(samples, begin_ns, first[kept], last[kept], len(starts_ns), limits[1], clipped_count, usual)


def quiet_spans(track: Track) -> Spans:
    """As :func:`spans_of`, with borders of their own: the quietest instants between movements, whatever their sense.

    The strides of the phase machine hang on the sign of the axis that it reads; these do not.
    """
    t_ns, _, gyr = newer_samples(track)
    t_s = 1e-9 * (t_ns - t_ns[0])
    rate = np.linalg.norm(_means(t_s, gyr, np.arange(t_s.size)), axis=1)
    reach = max(round(APART_S / float(np.median(np.diff(t_s)))), 1)
    around = sliding_window_view(np.pad(rate, reach, mode="edge"), 2 * reach + 1)
    rows = np.flatnonzero((rate == around.min(axis=1)) & (rate < RESTING_RADPS))
    moves = np.array([rate[low:high].max() > MOVING_RADPS for low, high in pairwise(rows.tolist())], dtype=np.bool_)
    return spans_of(track, t_ns[rows[:-1][moves]], t_ns[rows[1:][moves]])


def _means(t_s: FloatArray, values: FloatArray, rows: IntArray) -> FloatArray:
    """(K, 3) over what is near each of these rows."""
    sums = np.concatenate((np.zeros((1, 3)), np.cumsum(np.nan_to_num(values), axis=0)))
    low, high = (np.searchsorted(t_s, t_s[rows] + off) for off in (-BORDER_S, BORDER_S))
    means: FloatArray = (sums[high] - sums[low]) / np.maximum(high - low, 1)[:, None]
    return means


def _limit(values: FloatArray, least: float) -> float:
    """The greatest size, if it stands so often in a row that it must be a limit; else infinite."""
    top = float(np.nanmax(np.abs(values), initial=0.0))
    if top < least:
        return math.inf
    at = np.abs(values) >= 0.999 * top
    runs = np.all([at[k : len(at) - REPEATED + 1 + k] for k in range(REPEATED)], axis=0)
    return top if runs.any() else math.inf


def misfit_of(residuals: FloatArray) -> FloatArray:
    """(P,) of (P, K, 6): half of −2 log likelihood a stride, were each residual's scatter about zero estimated."""
    scatter = 1.4826 * np.median(np.abs(residuals), axis=-2)
    total: FloatArray = np.log(scatter + SCATTER_LEAST).sum(axis=-1)
    return total


def refine(spans: Spans, start: Sequence[float] | FloatArray, held: Sequence[int] = ()) -> Fit:
    """The nearest estimate from a start; what is ``held`` stays as it is there."""
    sensor, free = np.array(start, dtype=float), [k for k in range(len(SOUND)) if k not in held]
    best: Fit | None = None
    for turn in range(ROUNDS):
        tried = np.vstack([sensor, *(sensor + step for step in np.diag(STEP)[free])])
        residuals = closures(spans.samples, spans.first, spans.last, tried)
        residuals = residuals[:, np.isfinite(residuals).all(axis=(0, 2))]
        now = residuals[0]
        if not len(now):
            break
        scatter = 1.4826 * np.median(np.abs(now - np.median(now, axis=0)), axis=0) + SCATTER_LEAST
        change = ((residuals[1:] - now) / STEP[free, None, None] / scatter).transpose(1, 2, 0)
        off = now / scatter
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(off), 1e-9))
        prior = 1.0 / PRIOR_SD[free] ** 2
        normal = np.einsum("kri,kr,krj->ij", change, weight, change) + np.diag(prior)
        scores = np.einsum("kri,kr,kr->ki", change, weight, off)
        inverse = np.linalg.inv(normal)
        spread = scores - scores.mean(axis=0)
        sd = np.zeros(len(SOUND))
        sd[free] = np.sqrt(np.diag(inverse @ (spread.T @ spread) @ inverse))
        misfit = float(misfit_of(now))
        if best is None or misfit < best.misfit:
            best = Fit(sensor.copy(), sd, misfit, scatter)
        step = np.zeros(len(SOUND))
        step[free] = -inverse @ (scores.sum(axis=0) + prior * (sensor - SOUND)[free])
        if (np.abs(step) < ENOUGH).all() and turn:
            break
        sensor = sensor + np.clip(step, -MOST_STEP, MOST_STEP)
        sensor[GAIN] = min(max(sensor[GAIN], 0.3), 3.0)
    return best or Fit(sensor, np.full(len(SOUND), math.inf), math.inf, np.full(RESIDUALS, math.inf))


@dataclass(frozen=True, eq=False)
class Fits:
    """The best estimates: nothing but bias and scale off; the lag too; the gain too; both."""

    plain: Fit
    lag: Fit
    gain: Fit
    both: Fit


def estimate(spans: Spans) -> Fits:
    """Fit a sensor's strides under each of four assumptions, from a grid of lag and gain."""
    some, fewer = spans.thinned(MOST), spans.thinned(MOST_ON_GRID)
    plain = refine(some, SOUND, (LAG, GAIN))
    grid = np.array([(lag, gain, *SOUND[2:]) for lag in LAGS_S for gain in GAINS])
    misfit = misfit_of(np.nan_to_num(closures(fewer.samples, fewer.first, fewer.last, grid), nan=1e3))
    table = misfit.reshape(len(LAGS_S), len(GAINS))
    no_lag, no_gain = int(np.argmin(np.abs(LAGS_S))), GAINS.index(1.0)
    lag_s = LAGS_S[int(np.argmin(table[:, no_gain]))]
    lag_starts = [np.array((lag_s + apart_s, *plain.sensor[1:])) for apart_s in LAGS_APART_S]
    gain_start = grid[no_lag * len(GAINS) + int(np.argmin(table[no_lag]))]
    lag = _least([plain, *(refine(some, start, (GAIN,)) for start in (*lag_starts, plain.sensor))])
    gain = _least([plain, *(refine(some, start, (LAG,)) for start in (gain_start, plain.sensor))])
    starts = (grid[int(np.argmin(misfit))], lag.sensor, gain.sensor)
    return Fits(plain, lag, gain, _least([lag, gain, *(refine(some, start) for start in starts)]))


def _least(fits: list[Fit]) -> Fit:
    return min(fits, key=lambda fit: fit.misfit)


def biases_of(spans: Spans) -> FloatArray:
    """The gyroscope's bias (K, 3) that each stride by itself asks for, all else being sound; rad/s.

    Each is found from the prior alone: turning about gravity hardly shows.
    """
    sensors = np.tile(SOUND, (len(spans), 1))
    prior = np.eye(3) / STRIDE_BIAS_SD_RADPS**2
    for _ in range(ROUNDS):
        tried = np.array([sensors, *(sensors + step for step in np.diag(STEP)[BIAS])])
        residuals = np.nan_to_num(closures(spans.samples, spans.first, spans.last, tried))
        off = residuals[0] / STRIDE_SCATTER
        change = ((residuals[1:] - residuals[0]) / STEP[BIAS][:, None, None] / STRIDE_SCATTER).transpose(1, 2, 0)
        normal = np.einsum("kri,krj->kij", change, change) + prior
        scores = np.einsum("kri,kr->ki", change, off) + (sensors - np.array(SOUND))[:, BIAS] / STRIDE_BIAS_SD_RADPS**2
        step = np.clip(np.linalg.solve(normal, scores[..., None])[..., 0], -0.2, 0.2)
        sensors[:, BIAS] -= step
        if (np.abs(step) < ENOUGH[BIAS]).all():
            break
    return sensors[:, BIAS]
