"""Figures of strides: every stride by itself, means over the stride, and the swing paths as a butterfly.

Clinics call *butterfly* the path of the centre of pressure on an instrumented treadmill: it crosses from foot to foot
in double support, and its two wings are the two steps. No force is measured here. These wings are the paths of the two
foot sensors from stance to stance, left foot to the left, right foot to the right, laid against each other so that the
sides can be compared at a glance. Where the feet stand to each other is not known and not shown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from fes.report.figures.svg import Figure, Plot, padded
from fes.report.gait import POINTS, FootCurves, spread_of
from fes.report.quality import LOST, UNSURE, Flag, describe_flags
from fes.report.strides import StrideRow
from fes.report.summary import ReportData
from fes.report.text import count_of, readable
from fes.signals import FloatArray
from statemachine.phases import Phase

FAINT_STRIDES = 80  # so many single strides are drawn behind the mean, evenly picked
FOOT_COLORS = {"left_foot": "#0072B2", "right_foot": "#D55E00"}  # Okabe–Ito
PHASE_COLORS = {"pre_swing": "#E69F00", "swing": "#56B4E9", "loading_response": "#CC79A7", "stance": "#C9CED3"}
OTHER_COLOR = "#444444"
RING_COLOR = "#1b1f24"
Flags = Mapping[tuple[str, int], Sequence[Flag]]
NO_FLAGS: Final[Flags] = {}
STRIP_SHARE = 0.065  # of the plot's height: a foot's phases
DASHES: Final = {"right_foot": "9 4"}  # so that the feet differ in grey, too
_CURVES: Final[tuple[tuple[str, str, Callable[[FootCurves], FloatArray], str], ...]] = (
    (
        "Height over the stride",
        "height (cm)",
        lambda one: 100.0 * one.path_m[:, :, 2],
        "Height of the sensor above the stance before.",
    ),
    (
        "Pitch over the stride",
        "pitch (°), toe up +",
        lambda one: np.degrees(one.pitch_rad),
        "Rotation of the foot about the axis across it; 0° is the stance before.",
    ),
    (
        "Forward speed over the stride",
        "forward speed (m/s)",
        lambda one: one.speed_mps,
        "Speed of the sensor along the stride, over the ground (on a treadmill: over the belt).",
    ),
)
BUTTERFLY_FAINT_STRIDES = 40  # of a foot, evenly picked
NO_FORCE = (
    "Not the clinics' butterfly of the centre of pressure: no force is measured. Each wing is the path of one foot's "
    "sensor, both from the same point; how far apart the feet are is not known."
)


def foot_color(foot: str) -> str:
    """Blue for the left, vermilion for the right foot, in every figure."""
    return FOOT_COLORS.get(foot, OTHER_COLOR)


def stride_figures(data: ReportData, flags: Flags = NO_FLAGS) -> list[Figure]:
    """Stride length and clearance of every stride against time; flagged strides are ringed."""
    rows, belt = data.summary.strides, data.summary.belt_speed_mps
    if not rows:
        return []
    care = {key: own for key, found in flags.items() if (own := [flag for flag in found if flag.kind != UNSURE])}
    length, lengths = _per_stride(data, [row.stride_length_m for row in rows], "stride length (m)", 2, "m", care)
    clearance, clearances = _per_stride(data, [row.clearance_cm for row in rows], "clearance (cm)", 1, "cm", care)
    times = [row.duration_s for row in rows if row.valid]
    legend = "Filled: used, hollow: left out. Dashed: mean"
    if np.isfinite(belt) and times:
        expected_m = belt * float(np.mean(times))
        length.level(expected_m, "#000000", dash="2 3")
        lengths += f". Dotted: belt speed · mean stride time, {expected_m:.2f} m"
    ringed = f" Ringed, with care: {described}." if (described := describe_flags(care.values())) else ""
    height = "Greatest height of the sensor above its start."
    return [
        Figure("Stride length", length.render(), f"{legend} {lengths}.{ringed}"),
        Figure("Clearance", clearance.render(), f"{height} {legend} {clearances}.{ringed}"),
    ]


def _per_stride(
    data: ReportData, values: Sequence[float], label: str, digits: int, unit: str, care: Flags
) -> tuple[Plot, str]:
    """The plot, and the means as text."""
    rows = data.summary.strides
    y = np.array(values)
    start_s = np.array([row.start_s for row in rows])
    valid = np.array([row.valid for row in rows])
    low, high = padded([y[valid] if valid.any() else y], share=0.15)
    y = np.clip(y, low, high)  # a stride that was left out may lie anywhere and must not squeeze the others
    plot = Plot(f"{label} of every stride", "time (s)", label, padded([start_s], share=0.03), (low, high))
    means: list[str] = []
    for foot in data.timelines:
        for used in (True, False):
            pick = [i for i, row in enumerate(rows) if row.foot == foot and row.valid == used]
            titles = [
                f"{readable(foot)} {rows[i].number}: {values[i]:.{digits}f} {unit} {rows[i].reason}" for i in pick
            ]
            plot.points(start_s[pick], y[pick], foot_color(foot), titles, hollow=not used)
            good = y[pick][np.isfinite(y[pick])]
            if used and good.size:
                mean = float(good.mean())
                means.append(f"{readable(foot)} {mean:.{digits}f} {unit}")
                plot.level(mean, foot_color(foot))
    ringed = [i for i, row in enumerate(rows) if (row.foot, row.number) in care]
    plot.rings(start_s[ringed], y[ringed], RING_COLOR)
    return plot, ", ".join(means) or "–"


def phase_figures(data: ReportData, flags: Flags = NO_FLAGS) -> list[Figure]:
    """Per foot: how long each phase of each stride lasted, stacked; strides with a flag that tells on times ringed."""
    figures = []
    for foot in data.timelines:
        rows = [row for row in data.summary.strides if row.foot == foot]
        if rows:
            care = {
                row.number: own
                for row in rows
                if (own := [f for f in flags.get((foot, row.number), ()) if f.kind in (LOST, UNSURE)])
            }
            figures.append(_phase_bars(foot, rows, care))
    return figures


def _phase_bars(foot: str, rows: Sequence[StrideRow], care: Mapping[int, Sequence[Flag]]) -> Figure:
    layers = {
        "pre_swing": np.array([row.pre_swing_s for row in rows]),
        "swing": np.array([row.swing_s for row in rows]),
        "loading_response": np.array([row.loading_response_s for row in rows]),
        "stance": np.array([np.nan if row.stance_is_standing else row.stance_s for row in rows]),
    }
    number = np.array([float(row.number) for row in rows])
    top = np.sum([np.nan_to_num(values) for values in layers.values()], axis=0)
    plot = Plot(
        f"Phase durations of every stride, {readable(foot)}",
        "stride number",
        "time since heel rise (s)",
        (float(number.min()) - 0.7, float(number.max()) + 0.7),
        padded([top], zero=True),
    )
    floor = np.zeros(len(rows))
    for phase, values in layers.items():
        height = np.nan_to_num(values)
        plot.bars(number, floor, floor + height, 0.84, PHASE_COLORS[phase], readable(phase))
        floor = floor + height
    ringed = np.array([row.number in care for row in rows])
    plot.rings(number[ringed], floor[ringed], RING_COLOR)
    ringed_care = f" Ringed, with care: {flaws}." if (flaws := describe_flags(care.values())) else ""
    return Figure(
        f"Phase durations, {readable(foot)}",
        plot.render(),
        "From below: pre-swing, swing, loading response, stance. Stances over 3 s are standing, not drawn."
        f"{ringed_care}",
    )


def dash_of(foot: str) -> str:
    """How a foot's mean is drawn: the right one's is dashed."""
    return DASHES.get(foot, "")


def curve_figures(curves: Mapping[str, FootCurves], care: str = "") -> list[Figure]:
    """Height, pitch and forward speed over the stride; ``care``: a sentence on the strides' flags."""
    return [_figure(curves, *one, care) for one in _CURVES] if curves else []


def _figure(
    curves: Mapping[str, FootCurves],
    title: str,
    label: str,
    values_of: Callable[[FootCurves], FloatArray],
    about: str,
    care: str,
) -> Figure:
    every = {foot: values_of(one) for foot, one in curves.items()}
    means = {foot: values.mean(axis=0) for foot, values in every.items()}
    spreads = {foot: spread_of(values) for foot, values in every.items()}
    edges = [means[foot] + sign * spreads[foot] for foot in every for sign in (-1.0, 1.0)]
    low, high = padded(edges, zero=True, share=0.05)
    floor = low - (high - low) * STRIP_SHARE * (len(every) + 0.5)
    share = np.linspace(0.0, 100.0, next(iter(means.values())).size)
    plot = Plot(
        f"{title}, mean and standard deviation",
        "stride (%), from mid-stance to mid-stance",
        label,
        (0.0, 100.0),
        (floor, high),
        ticks_from=low,
    )
    for foot in every:
        plot.band(share, means[foot] - spreads[foot], means[foot] + spreads[foot], foot_color(foot), 0.25)
    for foot in every:
        plot.line(share, means[foot], foot_color(foot), width=2.6, dash=dash_of(foot))
    _strips(plot, curves, floor, (high - low) * STRIP_SHARE)
    counts = ", ".join(f"{readable(foot)} {count_of(one.count, 'stride')}" for foot, one in curves.items())
    return Figure(
        title,
        plot.render(),
        f"{about} Mean (right dashed) and ±1 SD: {counts}, "
        f"heel rise and foot flat brought together. Below: mean phases.{care}",
    )


def _strips(plot: Plot, curves: Mapping[str, FootCurves], floor: float, height: float) -> None:
    """The mean phases of each foot as a bar along the bottom, left above right."""
    order = (Phase.PRE_SWING, Phase.SWING, Phase.LOADING_RESPONSE, Phase.STANCE)
    for at, (foot, one) in enumerate(reversed(list(curves.items()))):
        base = floor + at * height
        entries = [(0.0, Phase.STANCE)]
        entries += [(one.entries_percent[phase], phase) for phase in order if phase in one.entries_percent]
        for (begin, phase), (end, _) in zip(entries, [*entries[1:], (100.0, Phase.STANCE)], strict=True):
            span = np.clip(np.array([begin, end]), 0.0, 100.0)
            low, high = np.full(2, base + 0.08 * height), np.full(2, base + 0.92 * height)
            plot.band(span, low, high, PHASE_COLORS[phase.name.lower()], 1.0)
        plot.text(1.0, base + 0.25 * height, readable(foot).removesuffix(" foot"), "#1b1f24")


def butterfly_figures(curves: Mapping[str, FootCurves], care: str = "") -> list[Figure]:
    """From the side (height over distance) and from above (distance over excursion); with one foot one wing each."""
    distances = {foot: paths for foot, one in curves.items() if (paths := _by_distance(one)) is not None}
    if not distances:
        return []
    counts = ", ".join(f"{readable(foot)} {count_of(len(paths), 'stride')}" for foot, paths in distances.items())
    legend = f"Bold: mean (right dashed), band: ±1 SD at the same share of the distance; {counts}.{care}"
    name = "Butterfly" if len(distances) > 1 else "Path"
    return [_from_the_side(name, distances, legend), _from_above(name, distances, legend)]


def outward(foot: str) -> float:
    """Which sign makes a sideways distance, left positive, one to the outside of this foot."""
    return -1.0 if foot.startswith("right") else 1.0


def _by_distance(one: FootCurves) -> FloatArray | None:
    """(S, POINTS, 3): forward (m), outward (cm), height (cm) at equal shares of each stride's distance; None if 0.

    By place and not by time: a foot that waits longer in stance would else smear the mean over the swing.
    """
    share = np.linspace(0.0, 1.0, POINTS)
    forward = np.maximum.accumulate(one.path_m[:, :, 0], axis=1)
    rows = []
    for ahead, path in zip(forward, one.path_m, strict=True):
        if ahead[-1] > ahead[0]:
            x = ahead[0] + share * (ahead[-1] - ahead[0])
            sideways = outward(one.foot) * np.interp(x, ahead, path[:, 1])
            rows.append(np.column_stack((x, 100.0 * sideways, 100.0 * np.interp(x, ahead, path[:, 2]))))
    return np.array(rows) if rows else None


def _wing(foot: str) -> float:
    """The left foot's wing is on the left."""
    return -1.0 if foot.startswith("left") else 1.0


def _from_the_side(name: str, distances: Mapping[str, FloatArray], legend: str) -> Figure:
    sides = {foot: _wing(foot) * paths[:, :, 0] for foot, paths in distances.items()}
    plot = Plot(
        f"{name} of the swing paths seen from the side",
        _ends(distances, "forward (m)"),
        "height (cm)",
        padded(sides.values(), zero=True, share=0.03),
        padded((paths[:, :, 2] for paths in distances.values()), zero=True),
        mirrored=True,
    )
    no_force = NO_FORCE if len(distances) > 1 else ""
    for foot, paths in distances.items():
        color, x, height = foot_color(foot), sides[foot], paths[:, :, 2]
        for at in _picked(len(paths)):
            plot.line(x[at], height[at], color, width=0.8, opacity=0.2)
        mean, sd = height.mean(axis=0), spread_of(height)
        plot.band(x.mean(axis=0), mean - sd, mean + sd, color, 0.32)
        plot.line(x.mean(axis=0), mean, color, width=3, dash=dash_of(foot))
    return Figure(f"{name}, from the side", plot.render(), f"{legend} Height is drawn larger than length. {no_force}")


def _from_above(name: str, distances: Mapping[str, FloatArray], legend: str) -> Figure:
    sides = {foot: _wing(foot) * paths[:, :, 1] for foot, paths in distances.items()}
    most = max(float(np.abs(values).max()) for values in sides.values()) * 1.1 or 1.0
    plot = Plot(
        f"{name} of the swing paths seen from above",
        _ends(distances, "outwards from the straight line (cm)"),
        "forward (m)",
        (-most, most),
        padded((paths[:, :, 0] for paths in distances.values()), zero=True, share=0.03),
        mirrored=True,
    )
    plot.upright(0.0, "#555555", "")
    for foot, paths in distances.items():
        color, x, ahead = foot_color(foot), sides[foot], paths[:, :, 0]
        for at in _picked(len(paths)):
            plot.line(x[at], ahead[at], color, width=0.8, opacity=0.2)
        mean, sd, along = x.mean(axis=0), spread_of(x), ahead.mean(axis=0)
        plot.area(np.append(mean - sd, (mean + sd)[::-1]), np.append(along, along[::-1]), color, 0.32)
        plot.line(mean, along, color, width=3, dash=dash_of(foot))
    return Figure(
        f"{name}, from above",
        plot.render(),
        f"{legend} A wing that bulges is circumduction; one that crosses the middle went inwards. Width is drawn "
        "larger than length.",
    )


def _ends(distances: Mapping[str, FloatArray], label: str) -> str:
    return f"◀ left foot · {label} · right foot ▶" if len(distances) > 1 else label


def _picked(count: int) -> list[int]:
    places = np.linspace(0, count - 1, min(count, BUTTERFLY_FAINT_STRIDES))
    return list(np.unique(places.round().astype(int)))
