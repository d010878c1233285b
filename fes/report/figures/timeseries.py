"""Signals for the zoomable plots: even grids, least and greatest value per bin, packed into 16-bit numbers."""

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np

from fes.report.figures.stimulation import channel_color
from fes.report.figures.strides import PHASE_COLORS, foot_color
from fes.report.quality import SensorFlags, sample_times
from fes.report.stimulation import PhaseTimeline
from fes.report.summary import ReportData
from fes.report.text import readable
from fes.signals import NS_PER_S, BoolArray, FloatArray
from fes.walk_record import SampleArrays
from statemachine.phases import Phase

DETAIL = ((600.0, 200), (1800.0, 100), (float("inf"), 80))  # sessions up to so long (s) keep so many points a second
GAP_INTERVALS = 2.5  # a pause this many intervals long is drawn as a gap
LONG_UNKNOWN = 1000  # of so many points without a value only the last is kept
MOST_RADPS = 1e6  # beyond what turns, and what can be squared: no number
MISSING = -32768
MOST_NOTICES = 2000  # that a click can show
MOST_MARKS = 500  # on the time line
SHOWN_OF_MARK = 32  # characters of its text there; the list has all
MARK_COLOR = "#7a1f6b"
FULL_SCALE = 32000


def chart_data(data: ReportData, sensors: Mapping[str, SensorFlags] | None = None) -> dict[str, Any]:
    """All that the script draws, in plain values: per foot its signals and phases, and the channels' current.

    ``sensors``: by foot, what is wrong with the samples; drawn where it is.
    """
    wrong = sensors or {}
    seconds = (data.end_ns - data.origin_ns) / NS_PER_S
    points_per_s = next(points for longest_s, points in DETAIL if seconds <= longest_s)
    feet = [
        _foot(data.record.samples[foot], timeline, data.origin_ns, points_per_s)
        | {"wrong": wrong[foot].spans(data.origin_ns) if foot in wrong else []}
        for foot, timeline in data.timelines.items()
        if foot in data.record.samples and data.record.samples[foot].t_ns.size > 1
    ]
    count = int(seconds * points_per_s) + 1 if data.channels else 0
    grid_ns = data.origin_ns + (np.arange(count) * (NS_PER_S // points_per_s)).astype(np.int64)
    channels = [
        {
            "name": info.name,
            "color": channel_color(info.number),
            "current_ma": pack(data.commands[info.number].current_at(grid_ns)),
        }
        for info in data.channels
    ]
    # the first window begins just before the first stimulation, or else the first stride
    bursts = [(burst.t_start_ns - data.origin_ns) / NS_PER_S - 3.0 for own in data.bursts.values() for burst in own]
    strides = [row.start_s - 0.5 for row in data.summary.strides]
    return {
        "duration_s": seconds,
        "opening_s": max(0.0, min(bursts or strides or [0.0])),
        "feet": feet,
        "current": {"start_s": 0.0, "step_s": 1.0 / points_per_s, "pieces": [[0, count]], "channels": channels},
        "notices": [
            {"time_s": round(each.time_s, 3), "source": each.source, "text": each.text}
            for each in data.summary.notices[:MOST_NOTICES]
        ],
        "marks": [
            {
                "t_s": round(each.time_s, 3),
                "name": each.text[:SHOWN_OF_MARK],
                "row": 0,
                "color": MARK_COLOR,
                "always": True,
            }
            for each in data.summary.marks[:MOST_MARKS]
        ],
        "phases": [{"name": readable(name), "color": PHASE_COLORS[name]} for name in (p.name.lower() for p in Phase)],
    }


def pack(values: FloatArray) -> dict[str, Any]:
    """Values (N,) as base64 of little-endian 16-bit numbers and the size of one step; NaN is −32768."""
    finite = np.isfinite(values)
    most = float(np.abs(values[finite]).max()) if finite.any() else 0.0
    step = most / FULL_SCALE if most > 0 else 1.0
    packed = np.full(values.shape, MISSING, dtype="<i2")
    packed[finite] = np.rint(values[finite] / step).astype("<i2")
    return {"step": step, "data": base64.b64encode(packed.tobytes()).decode("ascii")}


def even_grid(t_s: FloatArray, values: FloatArray, points_per_s: int) -> tuple[float, float, FloatArray]:
    """Bring a signal (N,) onto an even grid of at most ``points_per_s``: (start in s, step in s, values).

    A slow signal is interpolated at its own rate; of a fast one each bin of two points keeps the least and the
    greatest value, in the order in which the signal passed them. Pauses become NaN.
    """
    start, usual = float(t_s[0]), float(np.median(np.diff(t_s)))
    if usual * points_per_s >= 0.9:
        step = max(usual, 1e-3)
        grid = start + step * np.arange(int((t_s[-1] - start) / step) + 1)
        after = np.clip(np.searchsorted(t_s, grid), 1, t_s.size - 1)
        even = np.interp(grid, t_s, values)
        even[t_s[after] - t_s[after - 1] > GAP_INTERVALS * step] = np.nan
        return start, step, even
    width = 2.0 / points_per_s
    index = ((t_s - start) / width).astype(np.int64)
    first = np.flatnonzero(np.diff(index, prepend=-1))
    low, high = np.fmin.reduceat(values, first), np.fmax.reduceat(values, first)
    rises = values[first] <= values[np.append(first[1:], values.size) - 1]
    even = np.full((int(index[-1]) + 1, 2), np.nan)
    even[index[first], 0] = np.where(rises, low, high)
    even[index[first], 1] = np.where(rises, high, low)
    return start, width / 2, even.ravel()


def _pieces(known: BoolArray) -> list[list[int]]:
    """Where the pieces of a grid (N,) begin that are worth keeping, and how long each is; between them it is long
    unknown, and the first after each is so too, which breaks the line."""
    at = np.flatnonzero(known)
    borders = np.flatnonzero(np.diff(at) > LONG_UNKNOWN)
    begins, ends = np.append(0, at[borders + 1] - 1), np.append(at[borders] + 1, known.size)
    pieces: list[list[int]] = np.column_stack((begins, ends - begins)).tolist()
    return pieces


def main_axis_rate_radps(samples: SampleArrays, timeline: PhaseTimeline) -> tuple[FloatArray, bool]:
    """Rotation rate (N,) about the axis that the foot turns about most, and whether its sign is known.

    The axis is the gyroscope's first principal axis, so no calibration is needed. Positive is toe-down: the sign
    that makes the mean rate of all pre-swings, in which the heel rises, positive.
    """
    gyr = samples.gyr_radps
    sound = (np.abs(gyr) < MOST_RADPS).all(axis=1)
    good = gyr if sound.all() else gyr[sound]
    if good.shape[0] < 2:
        return np.full(gyr.shape[0], np.nan), False
    axis = np.linalg.eigh(good.T @ good)[1][:, -1]
    rate = gyr @ axis
    rate[~sound] = np.nan
    at = np.clip(np.searchsorted(timeline.start_ns, samples.t_ns, side="right") - 1, 0, None)
    pushing = rate[(timeline.phase[at] == Phase.PRE_SWING) & np.isfinite(rate)]
    if pushing.size == 0:
        return rate, False
    return (rate if pushing.mean() >= 0 else -rate), True


def _foot(samples: SampleArrays, timeline: PhaseTimeline, origin_ns: int, points_per_s: int) -> dict[str, Any]:
    t_ns = sample_times(samples)
    t_s = (t_ns - origin_ns) / NS_PER_S
    rate, signed = main_axis_rate_radps(samples, timeline)
    x, y, z = samples.acc_mps2.T  # not by its norm, which would have hours of samples there twice more
    acc = np.sqrt(x * x + y * y + z * z)
    if (t_ns[1:] < t_ns[:-1]).any():
        order = np.argsort(t_ns, kind="stable")
        t_s, rate, acc = t_s[order], rate[order], acc[order]
    start, step, gyr_even = even_grid(t_s, np.degrees(rate), points_per_s)
    _, _, acc_even = even_grid(t_s, acc, points_per_s)
    pieces = _pieces(np.isfinite(gyr_even) | np.isfinite(acc_even))
    gyr_even, acc_even = (np.concatenate([x[at : at + n] for at, n in pieces]) for x in (gyr_even, acc_even))
    return {
        "name": readable(timeline.foot),
        "color": foot_color(timeline.foot),
        "start_s": start,
        "step_s": step,
        "pieces": pieces,
        "toe_down_positive": signed,
        "gyr_degps": pack(gyr_even),
        "acc_mps2": pack(acc_even),
        "phase_start_s": [round(value, 4) for value in ((timeline.start_ns - origin_ns) / NS_PER_S).tolist()],
        "phase_end_s": [round(value, 4) for value in ((timeline.end_ns - origin_ns) / NS_PER_S).tolist()],
        "phase": timeline.phase.tolist(),
    }
