"""The feet's swing paths as the two wings of a butterfly: left foot to the left, right foot to the right.

Clinics call *butterfly* the path of the centre of pressure on an instrumented treadmill: it crosses from foot to foot
in double support, and its two wings are the two steps. No force is measured here. These wings are the ways of the two
foot sensors from stance to stance, laid against each other so that the sides can be compared at a glance; where the
feet stand to each other is not known and not shown.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fes.signals import FloatArray
from fes.view.curves import POINTS, FootCurves, spread_of
from fes.view.figures_gait import Figure, foot_color
from fes.view.figures_stride import dash_of
from fes.view.findings import count_of, words
from fes.view.svg import Plot, padded

FAINT_STRIDES = 40  # of a foot, evenly picked
HONEST = (
    "Not the clinics' butterfly of the centre of pressure: no force is measured. Each wing is the way of one foot's "
    "sensor, both from the same point; how far apart the feet are is not known."
)


def butterfly_figures(curves: Mapping[str, FootCurves], care: str = "") -> list[Figure]:
    """From the side (height over way) and from above (way over excursion outwards); with one foot one wing each."""
    by_way = {foot: ways for foot, one in curves.items() if (ways := _by_way(one)) is not None}
    if not by_way:
        return []
    counts = ", ".join(f"{words(foot)} {count_of(len(ways), 'stride')}" for foot, ways in by_way.items())
    told = f"Bold: mean (right dashed), band: ±1 SD at the same share of the way; {counts}.{care}"
    name = "Butterfly" if len(by_way) > 1 else "Path"
    return [_from_the_side(name, by_way, told), _from_above(name, by_way, told)]


def outward(foot: str) -> float:
    """Which sign makes a sideways distance, left positive, one to the outside of this foot."""
    return -1.0 if foot.startswith("right") else 1.0


def _by_way(one: FootCurves) -> FloatArray | None:
    """(S, POINTS, 3): way forward (m), outward (cm), height (cm) at equal shares of each stride's way; None: no way.

    By place and not by time: a foot that waits longer in stance would else smear the mean over the swing.
    """
    share = np.linspace(0.0, 1.0, POINTS)
    forward = np.maximum.accumulate(one.path_m[:, :, 0], axis=1)
    rows = []
    for way, path in zip(forward, one.path_m, strict=True):
        if way[-1] > way[0]:
            x = way[0] + share * (way[-1] - way[0])
            sideways = outward(one.foot) * np.interp(x, way, path[:, 1])
            rows.append(np.column_stack((x, 100.0 * sideways, 100.0 * np.interp(x, way, path[:, 2]))))
    return np.array(rows) if rows else None


def _wing(foot: str) -> float:
    """The left foot's wing is on the left."""
    return -1.0 if foot.startswith("left") else 1.0


def _from_the_side(name: str, by_way: Mapping[str, FloatArray], told: str) -> Figure:
    sides = {foot: _wing(foot) * ways[:, :, 0] for foot, ways in by_way.items()}
    plot = Plot(
        f"{name} of the swing paths seen from the side",
        _ends(by_way, "forward (m)"),
        "height (cm)",
        padded(sides.values(), zero=True, share=0.03),
        padded((ways[:, :, 2] for ways in by_way.values()), zero=True),
        mirrored=True,
    )
    honest = HONEST if len(by_way) > 1 else ""
    for foot, ways in by_way.items():
        color, x, height = foot_color(foot), sides[foot], ways[:, :, 2]
        for at in _picked(len(ways)):
            plot.line(x[at], height[at], color, width=0.8, opacity=0.2)
        mean, sd = height.mean(axis=0), spread_of(height)
        plot.band(x.mean(axis=0), mean - sd, mean + sd, color, 0.32)
        plot.line(x.mean(axis=0), mean, color, width=3, dash=dash_of(foot))
    return Figure(f"{name}, from the side", plot.render(), f"{told} Height is drawn larger than length. {honest}")


def _from_above(name: str, by_way: Mapping[str, FloatArray], told: str) -> Figure:
    sides = {foot: _wing(foot) * ways[:, :, 1] for foot, ways in by_way.items()}
    most = max(float(np.abs(values).max()) for values in sides.values()) * 1.1 or 1.0
    plot = Plot(
        f"{name} of the swing paths seen from above",
        _ends(by_way, "outwards from the straight line (cm)"),
        "forward (m)",
        (-most, most),
        padded((ways[:, :, 0] for ways in by_way.values()), zero=True, share=0.03),
        mirrored=True,
    )
    plot.upright(0.0, "#555555", "")
    for foot, ways in by_way.items():
        color, x, way = foot_color(foot), sides[foot], ways[:, :, 0]
        for at in _picked(len(ways)):
            plot.line(x[at], way[at], color, width=0.8, opacity=0.2)
        mean, sd, along = x.mean(axis=0), spread_of(x), way.mean(axis=0)
        plot.area(np.append(mean - sd, (mean + sd)[::-1]), np.append(along, along[::-1]), color, 0.32)
        plot.line(mean, along, color, width=3, dash=dash_of(foot))
    return Figure(
        f"{name}, from above",
        plot.render(),
        f"{told} A wing that bulges is circumduction; one that crosses the middle went inwards. Width is drawn larger "
        "than length.",
    )


def _ends(by_way: Mapping[str, FloatArray], label: str) -> str:
    return f"◀ left foot · {label} · right foot ▶" if len(by_way) > 1 else label


def _picked(count: int) -> list[int]:
    picked: list[int] = np.unique(np.linspace(0, count - 1, min(count, FAINT_STRIDES)).round().astype(int)).tolist()
    return picked
