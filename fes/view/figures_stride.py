"""Figures over the stride: mean and ± 1 SD of height, pitch and forward speed, both feet in one, phases below."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from fes.signals import FloatArray
from fes.view.curves import FootCurves, spread_of
from fes.view.figures_gait import PHASE_COLORS, Figure, foot_color
from fes.view.findings import count_of, words
from fes.view.svg import Plot, padded
from statemachine.phases import Phase

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


def dash_of(foot: str) -> str:
    """How a foot's mean is drawn: the right one's is dashed."""
    return DASHES.get(foot, "")


def curve_figures(curves: Mapping[str, FootCurves], care: str = "") -> list[Figure]:
    """Height, pitch and forward speed over the stride; ``care``: what is to be said of the strides' flags."""
    return [_figure(curves, *one, care) for one in _CURVES] if curves else []


def _figure(
    curves: Mapping[str, FootCurves],
    title: str,
    label: str,
    values_of: Callable[[FootCurves], FloatArray],
    told: str,
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
    counts = ", ".join(f"{words(foot)} {count_of(one.count, 'stride')}" for foot, one in curves.items())
    return Figure(
        title,
        plot.render(),
        f"{told} Mean (right dashed) and ±1 SD: {counts}, "
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
        plot.text(1.0, base + 0.25 * height, words(foot).removesuffix(" foot"), "#1b1f24")
