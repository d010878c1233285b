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
    """Per foot: height over way forward, and pitch from heel rise to foot flat."""
    figures = []
    for draw, curves_of in ((_sagittal, _paths), (_pitch, _pitches)):
        curves = {foot: found for foot in view.timelines if (found := curves_of(_usable(view, foot))) is not None}
        figures += [draw(foot, own, list(curves.values())) for foot, own in curves.items()]
    return figures


@dataclass(frozen=True)
class _Curves:
    """Strides of a foot brought to the same points: x and y (S, POINTS), and landmarks on x by name."""

    x: FloatArray
    y: FloatArray
    marks: dict[str, float]


def _usable(view: SessionView, foot: str) -> list[StrideResult]:
    return [
        stride
        for stride in view.record.strides
        if stride.foot == foot
        and stride.valid
        and len(stride.trajectory_m) > 1
        and stride.pitch_rad.shape == (len(stride.trajectory_m),)
        and np.isfinite(stride.trajectory_m).all()
        and np.isfinite(stride.pitch_rad).all()
    ]


def _paths(strides: Sequence[StrideResult]) -> _Curves | None:
    """Height in cm at equal shares of each stride's way forward in m.

    By place and not by time: a foot that waits longer in stance would else smear the mean over the swing.
    """
    share = np.linspace(0.0, 1.0, POINTS)
    rows = []
    for stride in strides:
        forward = np.maximum.accumulate(stride.trajectory_m[:, 0])
        if forward[-1] > forward[0]:
            x = forward[0] + share * (forward[-1] - forward[0])
            rows.append((x, np.interp(x, forward, stride.trajectory_m[:, 2] * 100)))
    if not rows:
        return None
    x, y = np.stack(rows, axis=1)
    return _Curves(x, y, {})


def _pitches(strides: Sequence[StrideResult]) -> _Curves | None:
    """Pitch in degrees from the entry into pre-swing (0 %) to the entry into stance (100 %)."""
    share = np.linspace(0.0, 1.0, POINTS)
    rows, swings, loadings = [], [], []
    for stride in strides:
        begin, end = stride.t_pre_swing_ns, stride.t_stance_ns
        if begin is None or end is None or end <= begin or stride.t_end_ns <= stride.t_start_ns:
            continue
        own = np.linspace(stride.t_start_ns - begin, stride.t_end_ns - begin, len(stride.pitch_rad)) / (end - begin)
        rows.append(np.interp(share, own, np.degrees(stride.pitch_rad)))
        swings += [100 * (stride.t_swing_ns - begin) / (end - begin)] if stride.t_swing_ns is not None else []
        loading = stride.t_loading_response_ns
        loadings += [100 * (loading - begin) / (end - begin)] if loading is not None else []
    if not rows:
        return None
    named = (("swing", swings), ("loading response", loadings))
    marks = {name: float(np.mean(shares)) for name, shares in named if shares}
    y = np.stack(rows)
    return _Curves(np.broadcast_to(100 * share, y.shape), y, marks)


def _draw(plot: Plot, curves: _Curves, color: str) -> None:
    """Single strides faint, ±1 SD as a band, the mean on top."""
    x, y = curves.x, curves.y
    for at in np.unique(np.linspace(0, len(y) - 1, min(len(y), FAINT_STRIDES)).round().astype(int)):
        plot.line(x[at], y[at], color, width=0.8, opacity=0.2)
    mean = y.mean(axis=0)
    if len(y) > 1:
        sd = y.std(axis=0, ddof=1)
        plot.band(x.mean(axis=0), mean - sd, mean + sd, color, 0.32)
    plot.line(x.mean(axis=0), mean, color, width=3)
    for name, place in curves.marks.items():
        plot.upright(place, "#555555", name)


def _sagittal(foot: str, own: _Curves, every: Sequence[_Curves]) -> Figure:
    name, count = words(foot), len(own.y)
    plot = Plot(
        f"Path of the {name} sensor seen from the side, {count} strides",
        "forward (m)",
        "height (cm)",
        padded((one.x for one in every), share=0.03),
        padded((one.y for one in every), zero=True),
    )
    _draw(plot, own, foot_color(foot))
    return Figure(
        f"Path seen from the side, {name}",
        plot.render(),
        f"{count} valid strides; bold: mean, band: ±1 SD of the height at the same share of the way. "
        "Height is drawn larger than length.",
    )


def _pitch(foot: str, own: _Curves, every: Sequence[_Curves]) -> Figure:
    name = words(foot)
    low, high = padded((one.y for one in every), zero=True, share=0.12)
    plot = Plot(
        f"Pitch of the {name} from heel rise to foot flat",
        "from heel rise (0 %) to foot flat (100 %)",
        "pitch (°), toe up +",
        (0.0, 100.0),
        (low, high),
    )
    _draw(plot, own, foot_color(foot))
    return Figure(
        f"Foot pitch, {name}",
        plot.render(),
        f"{len(own.y)} valid strides. 0° is the foot in the stance before. Upright lines: mean entries.",
    )


def stride_figures(view: SessionView) -> list[Figure]:
    """Stride length and clearance of every stride against time."""
    rows, belt = view.summary.strides, view.summary.belt_speed_mps
    if not rows:
        return []
    length, lengths = _per_stride(view, [row.stride_length_m for row in rows], "stride length (m)", 2, "m")
    clearance, clearances = _per_stride(view, [row.clearance_cm for row in rows], "clearance (cm)", 1, "cm")
    times = [row.duration_s for row in rows if row.valid]
    told = "Filled: used, hollow: left out. Dashed: mean"
    if np.isfinite(belt) and times:
        expected_m = belt * float(np.mean(times))
        length.level(expected_m, "#000000", dash="2 3")
        lengths += f". Dotted: belt speed · mean stride time, {expected_m:.2f} m"
    return [
        Figure("Stride length", length.render(), f"{told} {lengths}."),
        Figure("Clearance", clearance.render(), f"Greatest height of the sensor above its start. {told} {clearances}."),
    ]


def _per_stride(view: SessionView, values: Sequence[float], label: str, digits: int, unit: str) -> tuple[Plot, str]:
    """The plot and the means in words."""
    rows = view.summary.strides
    y = np.array(values)
    start_s = np.array([row.start_s for row in rows])
    valid = np.array([row.valid for row in rows])
    low, high = padded([y[valid] if valid.any() else y], share=0.15)
    y = np.clip(y, low, high)  # a stride that was left out may lie anywhere and must not squeeze the others
    plot = Plot(f"{label} of every stride", "time (s)", label, padded([start_s], share=0.03), (low, high))
    means: list[str] = []
    for foot in view.timelines:
        for used in (True, False):
            pick = [i for i, row in enumerate(rows) if row.foot == foot and row.valid == used]
            titles = [f"{words(foot)} {rows[i].number}: {values[i]:.{digits}f} {unit} {rows[i].reason}" for i in pick]
            plot.points(start_s[pick], y[pick], foot_color(foot), titles, hollow=not used)
            good = y[pick][np.isfinite(y[pick])]
            if used and good.size:
                mean = float(good.mean())
                means.append(f"{words(foot)} {mean:.{digits}f} {unit}")
                plot.level(mean, foot_color(foot))
    return plot, ", ".join(means) or "–"


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
        "time since heel rise (s)",
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
