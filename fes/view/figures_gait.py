"""Figures of the walking itself: sagittal paths, pitch, lengths, clearance and phase durations per stride."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fes.signals import FloatArray, StrideResult
from fes.view.findings import words
from fes.view.strides import StrideRow
from fes.view.summary import SessionView
from fes.view.svg import Plot, padded

POINTS = 101
FAINT_STRIDES = 80  # so many single strides are drawn behind the mean, evenly picked
FOOT_COLORS = {"left_foot": "#0072B2", "right_foot": "#D55E00"}  # Okabe–Ito
PHASE_COLORS = {"pre_swing": "#E69F00", "swing": "#56B4E9", "loading_response": "#CC79A7", "stance": "#C9CED3"}
OTHER_COLOR = "#444444"


@dataclass(frozen=True)
class Figure:
    """A plot with the text that belongs below it; ``svg`` is safe markup."""

    title: str
    svg: str
    caption: str


def foot_color(foot: str) -> str:
    """Blue for the left, vermilion for the right foot, in every figure."""
    return FOOT_COLORS.get(foot, OTHER_COLOR)


def path_figures(view: SessionView) -> list[Figure]:
    """Per foot: height over way forward, and pitch over the stride."""
    curves = {foot: found for foot in view.timelines if (found := _curves(view.record.strides, foot)) is not None}
    figures = [_sagittal(foot, found, list(curves.values())) for foot, found in curves.items()]
    return figures + [_pitch(foot, found, list(curves.values())) for foot, found in curves.items()]


@dataclass(frozen=True)
class _Curves:
    """All usable strides of a foot (S, POINTS) at equal shares of the stride: metres, centimetres, degrees."""

    forward_m: FloatArray
    height_cm: FloatArray
    pitch_deg: FloatArray


def _curves(strides: Sequence[StrideResult], foot: str) -> _Curves | None:
    grid = np.linspace(0.0, 1.0, POINTS)
    rows = []
    for stride in strides:
        count = stride.trajectory_m.shape[0]
        if stride.foot != foot or not stride.valid or count < 2 or stride.pitch_rad.shape != (count,):
            continue
        share = np.linspace(0.0, 1.0, count)
        columns = (stride.trajectory_m[:, 0], stride.trajectory_m[:, 2] * 100, np.degrees(stride.pitch_rad))
        row = np.stack([np.interp(grid, share, column) for column in columns])
        if np.isfinite(row).all():
            rows.append(row)
    if not rows:
        return None
    forward_m, height_cm, pitch_deg = np.stack(rows, axis=1)
    return _Curves(forward_m, height_cm, pitch_deg)


def _draw(plot: Plot, x: FloatArray, y: FloatArray, color: str) -> None:
    """Single strides faint, ±1 SD as a band, the mean on top; x and y are (S, POINTS)."""
    for at in np.unique(np.linspace(0, len(y) - 1, min(len(y), FAINT_STRIDES)).round().astype(int)):
        plot.line(x[at], y[at], color, width=0.8, opacity=0.25)
    mean = y.mean(axis=0)
    if len(y) > 1:
        sd = y.std(axis=0, ddof=1)
        plot.band(x.mean(axis=0), mean - sd, mean + sd, color)
    plot.line(x.mean(axis=0), mean, color, width=3)


def _sagittal(foot: str, own: _Curves, every: Sequence[_Curves]) -> Figure:
    name, count = words(foot), len(own.height_cm)
    plot = Plot(
        f"Path of the {name} sensor seen from the side, {count} strides",
        "forward (m)",
        "height (cm)",
        padded((one.forward_m for one in every), share=0.03),
        padded((one.height_cm for one in every), zero=True),
    )
    _draw(plot, own.forward_m, own.height_cm, foot_color(foot))
    return Figure(
        f"Path seen from the side, {name}",
        plot.render(),
        f"{count} valid strides; bold: mean, band: ±1 SD of the height. Height is drawn larger than length.",
    )


def _pitch(foot: str, own: _Curves, every: Sequence[_Curves]) -> Figure:
    name = words(foot)
    plot = Plot(
        f"Pitch of the {name} over the stride",
        "share of the stride (%), mid-stance to mid-stance",
        "pitch (°), toe up +",
        (0.0, 100.0),
        padded((one.pitch_deg for one in every), zero=True),
    )
    _draw(plot, np.broadcast_to(np.linspace(0, 100, POINTS), own.pitch_deg.shape), own.pitch_deg, foot_color(foot))
    return Figure(f"Foot pitch, {name}", plot.render(), "0° is the foot in the stance at the stride's start.")


def stride_figures(view: SessionView) -> list[Figure]:
    """Stride length and clearance of every stride against time."""
    rows, belt = view.summary.strides, view.summary.belt_speed_mps
    if not rows:
        return []
    length = _per_stride(view, [row.stride_length_m for row in rows], "stride length (m)", 2, "m")
    clearance = _per_stride(view, [row.clearance_cm for row in rows], "clearance (cm)", 1, "cm")
    times = [row.duration_s for row in rows if row.valid]
    told = "Filled: used, hollow: left out."
    if np.isfinite(belt) and times:
        length.level(belt * float(np.mean(times)), "#000000", "belt speed · mean stride time", dash="2 3", above=False)
    return [
        Figure("Stride length", length.render(), f"{told} Dashed: mean of each foot."),
        Figure("Clearance", clearance.render(), f"Greatest height of the sensor above its start. {told}"),
    ]


def _per_stride(view: SessionView, values: Sequence[float], label: str, digits: int, unit: str) -> Plot:
    rows = view.summary.strides
    y = np.array(values)
    start_s = np.array([row.start_s for row in rows])
    valid = np.array([row.valid for row in rows])
    low, high = padded([y[valid] if valid.any() else y], share=0.15)
    y = np.clip(y, low, high)  # a stride that was left out may lie anywhere and must not squeeze the others
    plot = Plot(f"{label} of every stride", "time (s)", label, padded([start_s], share=0.03), (low, high))
    for foot in view.timelines:
        for used in (True, False):
            pick = [i for i, row in enumerate(rows) if row.foot == foot and row.valid == used]
            titles = [f"{words(foot)} {rows[i].number}: {values[i]:.{digits}f} {unit} {rows[i].reason}" for i in pick]
            plot.points(start_s[pick], y[pick], foot_color(foot), titles, hollow=not used)
            good = y[pick][np.isfinite(y[pick])]
            if used and good.size:
                mean = float(good.mean())
                plot.level(mean, foot_color(foot), f"{words(foot)} {mean:.{digits}f} {unit}")
    return plot


def phase_figures(view: SessionView) -> list[Figure]:
    """Per foot: how long each phase of each stride lasted, stacked."""
    figures = []
    for foot in view.timelines:
        rows = [row for row in view.summary.strides if row.foot == foot]
        if rows:
            figures.append(_phase_bars(foot, rows))
    return figures


def _phase_bars(foot: str, rows: Sequence[StrideRow]) -> Figure:
    layers = {
        "pre_swing": np.array([row.pre_swing_s for row in rows]),
        "swing": np.array([row.swing_s for row in rows]),
        "loading_response": np.array([row.loading_response_s for row in rows]),
        "stance": np.array([np.nan if row.stance_is_standing else row.stance_s for row in rows]),
    }
    number = np.array([float(row.number) for row in rows])
    top = np.sum([np.nan_to_num(values) for values in layers.values()], axis=0)
    plot = Plot(
        f"Phase durations of every stride, {words(foot)}",
        "stride number",
        "time from the entry into pre-swing (s)",
        (float(number.min()) - 0.7, float(number.max()) + 0.7),
        padded([top], zero=True),
    )
    floor = np.zeros(len(rows))
    for phase, values in layers.items():
        height = np.nan_to_num(values)
        plot.bars(number, floor, floor + height, 0.84, PHASE_COLORS[phase], words(phase))
        floor = floor + height
    return Figure(
        f"Phase durations, {words(foot)}",
        plot.render(),
        "From below: pre-swing, swing, loading response, stance. A stance longer than 3 s is standing, not drawn.",
    )
