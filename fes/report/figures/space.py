"""Where the feet went over the ground, from above and how high; and strides of both feet in three dimensions.

The latter are drawn as Figure 5 of Wang et al. (2013), mean and mean ± SD, in the axes of the paper's visualization
frame: x to the right, y along the walk, z up. It is drawn here as it stands at first, which is also what is printed;
the report's script turns the same lines.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import islice
from typing import Any, Final

import numpy as np

from fes.analysis.ground_path import GroundPath
from fes.report.figures import svg
from fes.report.figures.strides import foot_color
from fes.report.figures.svg import BOTTOM, LEFT, RIGHT, TOP, Figure, Plot, nice_ticks, padded
from fes.report.gait import FootCurves, spread_of
from fes.report.summary import ReportData
from fes.report.text import count_of, readable
from fes.signals import NS_PER_S, FloatArray
from statemachine.phases import Phase

HEIGHTS = (200, 520)  # of the view from above, whose two scales are the same
LEAST_HEIGHT_M = 0.05  # a path that rises or falls less gets no side view
WIDTH, HEIGHT, MARGIN = 640, 340, 22
AZIMUTH_DEG, ELEVATION_DEG = -62.0, 24.0
MOST_LARGER = 6.0  # height and width, compared to length
FEET_GAP = 0.3  # of the length: how far apart the feet are drawn
FLOOR, POST, TEXT = "#c3cad1", "#6b747d", "#3c444d"
_MARKED: Final = (Phase.SWING, Phase.LOADING_RESPONSE)


def ground_figures(data: ReportData, paths: Mapping[str, GroundPath]) -> list[Figure]:
    """All feet from above, and their heights along the path where they change."""
    known = {foot: path for foot, path in paths.items() if len(path.t_ns) > 1}
    if not known:
        return []
    figures = [_from_above(data, known)]
    level = data.record.header.get("ground", {}).get("level", True)
    if not level and any(np.ptp(path.position_m[:, 2]) > LEAST_HEIGHT_M for path in known.values()):
        figures.append(_heights(data, known))
    return figures


def _from_above(data: ReportData, paths: Mapping[str, GroundPath]) -> Figure:
    x = padded((path.position_m[:, 0] for path in paths.values()), zero=True)
    y = padded((path.position_m[:, 1] for path in paths.values()), zero=True)
    x_range, y_range, height = same_scale(x, y)
    plot = Plot("Path of the feet from above", "ahead (m)", "to the left (m)", x_range, y_range, height=height)
    parts = []
    for foot, path in paths.items():
        color = foot_color(foot)
        plot.line(path.position_m[:, 0], path.position_m[:, 1], color, width=1.6, opacity=0.75)
        strides = [stride for stride in data.record.strides if stride.foot == foot and stride.valid]
        places = path.places_at(np.array([stride.t_end_ns for stride in strides], dtype=np.int64))
        titles = [
            f"{readable(foot)}, stride {stride.number}, {(stride.t_end_ns - data.origin_ns) / NS_PER_S:.1f} s: "
            f"{stride.stride_length_m:.2f} m"
            for stride in strides
        ]
        plot.points(places[:, 0], places[:, 1], color, titles)
        parts.append(f"{readable(foot)} {path.distance_m:.1f} m, ends {path.closure_m:.2f} m from its start")
    plot.points(np.zeros(1), np.zeros(1), "#000000", ["start"], hollow=True)
    return plot.figure(
        "Path over the ground, from above",
        f"Distance from stance to stance: {'; '.join(parts)}. Points: ends of strides; hollow: the start, drawn in one "
        "place for every foot. Heading is the gyroscope's alone and drifts; on a treadmill this is the path over the "
        "belt.",
    )


def _heights(data: ReportData, paths: Mapping[str, GroundPath]) -> Figure:
    """Height over time; stances are level."""
    seconds = {foot: (path.t_ns - data.origin_ns) / NS_PER_S for foot, path in paths.items()}
    x_range = padded(seconds.values(), share=0.02)
    y_range = padded((path.position_m[:, 2] for path in paths.values()), zero=True)
    plot = Plot("Height of the feet over time", "time (s)", "height above the start (m)", x_range, y_range)
    parts = []
    for foot, path in paths.items():
        plot.line(seconds[foot], path.position_m[:, 2], foot_color(foot), width=1.6)
        gained = [s.height_gained_m for s in data.record.strides if s.foot == foot and s.valid]
        usual = f", {100 * float(np.median(gained)):+.1f} cm in the median stride" if gained else ""
        parts.append(f"{readable(foot)} {path.height_gained_m:+.2f} m{usual}")
    return plot.figure("Height gained", f"From start to end: {'; '.join(parts)}.")


def same_scale(x: tuple[float, float], y: tuple[float, float]) -> tuple[tuple[float, float], tuple[float, float], int]:
    """Ranges and the plot's height with which a metre is as long along x as along y; the smaller range is widened."""
    across, least, most = svg.WIDTH - LEFT - RIGHT, *(height - TOP - BOTTOM for height in HEIGHTS)
    wide, tall = x[1] - x[0], y[1] - y[0]
    drawn = min(max(across * tall / wide, least), most)
    metre = min(across / wide, drawn / tall)
    x_air, y_air = 0.5 * (across / metre - wide), 0.5 * (drawn / metre - tall)
    return (x[0] - x_air, x[1] + x_air), (y[0] - y_air, y[1] + y_air), round(drawn) + TOP + BOTTOM


@dataclass(frozen=True)
class SpaceFoot:
    """One foot's ``count`` strides: ``mean_m`` and ``sd_m`` (K, 3) of x right, y along, z up; points to mark."""

    mean_m: FloatArray
    sd_m: FloatArray
    count: int
    marks: Sequence[int] = ()


class SpaceFigure:
    """A figure and the numbers that the script turns it by."""

    def __init__(self, key: str, feet: Mapping[str, SpaceFoot], title: str, about: str) -> None:
        self.key = key
        self._lines: list[tuple[FloatArray, str]] = []  # points (K, 3) in drawn units, how it is drawn
        self._texts: list[tuple[FloatArray, str, str]] = []  # place (3,) in drawn units, text, colour
        length = max(float(np.ptp(foot.mean_m[:, 1])) for foot in feet.values()) or 1.0
        height = max(float(np.ptp(foot.mean_m[:, 2])) for foot in feet.values()) or 0.1 * length
        self._larger = max(1.0, min(MOST_LARGER, round(0.45 * length / height)))
        self._build(feet, length)
        counts = ", ".join(f"{readable(name)} {count_of(foot.count, 'stride')}" for name, foot in feet.items())
        dots = "Dots: foot off and first contact. " if any(foot.marks for foot in feet.values()) else ""
        caption = (
            f"{about} Bold: mean; thin: mean + SD and mean − SD; grey: the mean's shadow; {counts}. {dots}"
            f"Height and width are drawn {self._larger:.0f} times larger than length; how far apart the feet are is "
            "not known."
        )
        self.figure = Figure(title, self._svg(title), caption)

    def to_data(self) -> dict[str, Any]:
        """For the script: places in drawn units, rounded."""
        return {
            "key": self.key,
            "azimuth_deg": AZIMUTH_DEG,
            "elevation_deg": ELEVATION_DEG,
            "lines": [np.round(points.T, 4).tolist() for points, _ in self._lines],
            "texts": [np.round(place, 4).tolist() for place, _, _ in self._texts],
        }

    def _line(self, points: FloatArray | list[list[float]], color: str, width: float, dash: str = "") -> None:
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self._lines.append((np.asarray(points), f'stroke="{color}" stroke-width="{width:g}"{dashed}'))

    def _build(self, feet: Mapping[str, SpaceFoot], length: float) -> None:
        larger = np.array([self._larger, 1.0, self._larger])
        sideways = FEET_GAP * length * (np.arange(len(feet)) - 0.5 * (len(feet) - 1))
        ends = [foot.mean_m * larger + [aside, 0.0, 0.0] for aside, foot in zip(sideways, feet.values(), strict=True)]
        every = np.concatenate(ends)
        (left, near, _), (right, far, top) = every.min(axis=0), every.max(axis=0)
        self._floor(left - 0.06 * length, right + 0.06 * length, min(near, 0.0), far, top)
        for (name, foot), mean in zip(feet.items(), ends, strict=True):
            color, sd = foot_color(name), foot.sd_m * larger
            self._line(mean * [1.0, 1.0, 0.0], "#8a939c", 1.2)
            for sign in (1.0, -1.0):
                self._line(mean + sign * sd, color, 1.1, "4 2")
            self._line(mean, color, 3.2)
            for at in foot.marks:
                if 0 <= at < len(mean):
                    self._line(mean[[at, at]], color, 9.0)
            self._texts.append((mean[-1] + [0.0, 0.03 * length, 0.0], readable(name), color))

    def _floor(self, left: float, right: float, near: float, far: float, top: float) -> None:
        wide = right - left
        for y in nice_ticks(near, max(far, near + 0.1), about=5):
            self._line([[left, y, 0.0], [right, y, 0.0]], FLOOR, 1.0)
            self._texts.append((np.array([right + 0.06 * wide, y, 0.0]), f"{y:g} m", TEXT))
        for x in (left, right):
            self._line([[x, near, 0.0], [x, far, 0.0]], FLOOR, 1.0)
        up_cm = [cm for cm in nice_ticks(0.0, max(100.0 * top / self._larger, 1.0), about=3) if cm > 0]
        self._line([[left, near, 0.0], [left, near, self._larger * up_cm[-1] / 100 if up_cm else top]], POST, 1.4)
        for cm in up_cm:
            z = self._larger * cm / 100
            self._line([[left, near, z], [left + 0.03 * wide, near, z]], POST, 1.4)
            self._texts.append((np.array([left - 0.05 * wide, near, z]), f"{cm:g} cm", TEXT))

    def _svg(self, label: str) -> str:
        every = [points for points, _ in self._lines] + [place[None] for place, _, _ in self._texts]
        flat = projected(np.concatenate(every), math.radians(AZIMUTH_DEG), math.radians(ELEVATION_DEG))
        low, high = flat.min(axis=0), flat.max(axis=0)
        room = np.array([WIDTH - 4.0 * MARGIN, HEIGHT - 2.0 * MARGIN])
        scale = float((room / np.maximum(high - low, 1e-9)).min())
        drawn = (flat - 0.5 * (low + high)) * scale * np.array([1.0, -1.0]) + np.array([WIDTH, HEIGHT]) / 2
        places = iter(drawn.tolist())
        parts = []
        for points, how in self._lines:
            path = "L".join(f"{x:.1f} {y:.1f}" for x, y in islice(places, len(points)))
            parts.append(f'<path d="M{path}" {how}/>')
        for (_, text, color), (x, y) in zip(self._texts, places, strict=True):
            parts.append(f'<text x="{x:.1f}" y="{y:.1f}" style="fill:{color}">{escape(text)}</text>')
        return (
            f'<svg class="plot space" data-space="{escape(self.key)}" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
            f'aria-label="{escape(label)}">{"".join(parts)}</svg>'
        )


def projected(points: FloatArray, azimuth_rad: float, elevation_rad: float) -> FloatArray:
    """Places (N, 3) seen from far away: (N, 2), to the right and up. Azimuth 0: from behind; elevation 0: level."""
    across = points[:, 0] * math.cos(azimuth_rad) - points[:, 1] * math.sin(azimuth_rad)
    away = points[:, 0] * math.sin(azimuth_rad) + points[:, 1] * math.cos(azimuth_rad)
    return np.column_stack((across, points[:, 2] * math.cos(elevation_rad) + away * math.sin(elevation_rad)))


def space_figure(curves: Mapping[str, FootCurves]) -> SpaceFigure | None:
    """Of the project's own strides; None without any."""
    feet = {}
    for foot, one in curves.items():  # from forward, left, up to right, along, up
        mean, sd = one.path_m.mean(axis=0)[:, [1, 0, 2]] * [-1.0, 1.0, 1.0], spread_of(one.path_m)[:, [1, 0, 2]]
        marks = [round(one.entries_percent[phase]) for phase in _MARKED if phase in one.entries_percent]
        feet[foot] = SpaceFoot(mean, sd, one.count, marks)
    about = (
        "As Figure 5 of Wang et al. (2013), from the strides of this report, heel rise and foot flat brought together: "
        "x right, y along the stride, z up."
    )
    return SpaceFigure("strides", feet, "Strides in three dimensions", about) if feet else None
