"""Figures of where the feet went over the ground: from above, and how high."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fes.ground_path import GroundPath
from fes.signals import NS_PER_S, FloatArray
from fes.view.figures_gait import Figure, foot_color
from fes.view.findings import words
from fes.view.summary import SessionView
from fes.view.svg import BOTTOM, LEFT, RIGHT, TOP, Plot, padded

WIDTH = 560
HEIGHTS = (200, 520)  # of the view from above, whose two scales are the same
LEAST_HEIGHT_M = 0.05  # a path that rises or falls less gets no side view


def ground_figures(view: SessionView, paths: Mapping[str, GroundPath]) -> list[Figure]:
    """All feet from above, and their heights along the way where they change."""
    known = {foot: path for foot, path in paths.items() if len(path.t_ns) > 1}
    if not known:
        return []
    figures = [_from_above(view, known)]
    level = view.record.header.get("ground", {}).get("level", True)
    if not level and any(np.ptp(path.position_m[:, 2]) > LEAST_HEIGHT_M for path in known.values()):
        figures.append(_heights(view, known))
    return figures


def _from_above(view: SessionView, paths: Mapping[str, GroundPath]) -> Figure:
    x = padded((path.position_m[:, 0] for path in paths.values()), zero=True)
    y = padded((path.position_m[:, 1] for path in paths.values()), zero=True)
    x_range, y_range, height = same_scale(x, y)
    plot = Plot("Path of the feet from above", "ahead (m)", "to the left (m)", x_range, y_range, height=height)
    parts = []
    for foot, path in paths.items():
        color = foot_color(foot)
        plot.line(path.position_m[:, 0], path.position_m[:, 1], color, width=1.6, opacity=0.75)
        places, titles = _stride_ends(view, foot, path)
        plot.points(places[:, 0], places[:, 1], color, titles)
        parts.append(f"{words(foot)} {path.way_m:.1f} m, ends {path.closure_m:.2f} m from its start")
    plot.points(np.zeros(1), np.zeros(1), "#000000", ["start"], hollow=True)
    return Figure(
        "Path over the ground, from above",
        plot.render(),
        f"Way from stance to stance: {'; '.join(parts)}. Points: ends of strides; hollow: the start, drawn in one "
        "place for every foot. Heading is the gyroscope's alone and drifts; on a treadmill this is the way over the "
        "belt.",
    )


def _heights(view: SessionView, paths: Mapping[str, GroundPath]) -> Figure:
    """Height over time; stances are level."""
    seconds = {foot: (path.t_ns - view.origin_ns) / NS_PER_S for foot, path in paths.items()}
    plot = Plot(
        "Height of the feet over time",
        "time (s)",
        "height above the start (m)",
        padded(seconds.values(), share=0.02),
        padded((path.position_m[:, 2] for path in paths.values()), zero=True),
    )
    parts = []
    for foot, path in paths.items():
        plot.line(seconds[foot], path.position_m[:, 2], foot_color(foot), width=1.6)
        gained = [s.height_gained_m for s in view.record.strides if s.foot == foot and s.valid]
        usual = f", {100 * float(np.median(gained)):+.1f} cm in the median stride" if gained else ""
        parts.append(f"{words(foot)} {path.height_gained_m:+.2f} m{usual}")
    return Figure("Height gained", plot.render(), f"From start to end: {'; '.join(parts)}.")


def _stride_ends(view: SessionView, foot: str, path: GroundPath) -> tuple[FloatArray, list[str]]:
    """Where the valid strides of a foot end (M, 2), and a hover text for each."""
    strides = [stride for stride in view.record.strides if stride.foot == foot and stride.valid]
    places = path.at(np.array([stride.t_end_ns for stride in strides], dtype=np.int64))[:, :2]
    titles = [
        f"{words(foot)}, stride {stride.number}, {(stride.t_end_ns - view.origin_ns) / NS_PER_S:.1f} s: "
        f"{stride.stride_length_m:.2f} m"
        for stride in strides
    ]
    return places, titles


def same_scale(x: tuple[float, float], y: tuple[float, float]) -> tuple[tuple[float, float], tuple[float, float], int]:
    """Ranges and the plot's height with which a metre is as long along x as along y; the smaller range is widened."""
    across, least, most = WIDTH - LEFT - RIGHT, *(height - TOP - BOTTOM for height in HEIGHTS)
    wide, tall = x[1] - x[0], y[1] - y[0]
    drawn = min(max(across * tall / wide, least), most)
    metre = min(across / wide, drawn / tall)
    x_air, y_air = 0.5 * (across / metre - wide), 0.5 * (drawn / metre - tall)
    return (x[0] - x_air, x[1] + x_air), (y[0] - y_air, y[1] + y_air), round(drawn) + TOP + BOTTOM
