"""Strides of both feet in three dimensions: mean and mean ± SD, as Figure 5 of Wang et al. (2013).

Drawn here as it stands at first, which is also what is printed; the report's script turns the same lines. Axes are
those of the paper's visualization frame: x to the right, y along the walk, z up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Final

import numpy as np

from fes.signals import FloatArray
from fes.view.curves import FootCurves
from fes.view.figures_gait import Figure, foot_color
from fes.view.findings import count_of, words
from fes.view.svg import nice_ticks
from statemachine.phases import Phase

WIDTH, HEIGHT, MARGIN = 640, 340, 22
AZIMUTH_DEG, ELEVATION_DEG = -62.0, 24.0
MOST_LARGER = 6.0  # height and width, compared to length
APART = 0.3  # of the length: how far apart the feet are drawn
FLOOR, POST = "#c3cad1", "#6b747d"


@dataclass(frozen=True)
class SpaceFoot:
    """One foot's ``count`` strides: ``mean_m`` and ``sd_m`` (K, 3) of x right, y along, z up; points to mark."""

    mean_m: FloatArray
    sd_m: FloatArray
    count: int
    marks: Sequence[int] = ()


@dataclass(frozen=True)
class _Line:
    points: FloatArray  # (K, 3), drawn units
    color: str
    width: float
    dash: str = ""


@dataclass(frozen=True)
class _Text:
    place: FloatArray
    words: str
    color: str = "#3c444d"


class SpaceFigure:
    """A figure and the numbers that the script turns it by."""

    def __init__(self, key: str, feet: Mapping[str, SpaceFoot], title: str, told: str) -> None:
        self.key = key
        self._lines: list[_Line] = []
        self._texts: list[_Text] = []
        length = max(float(np.ptp(foot.mean_m[:, 1])) for foot in feet.values()) or 1.0
        height = max(float(np.ptp(foot.mean_m[:, 2])) for foot in feet.values()) or 0.1 * length
        self._larger = max(1.0, min(MOST_LARGER, round(0.45 * length / height)))
        self._build(feet, length)
        counts = ", ".join(f"{words(name)} {count_of(foot.count, 'stride')}" for name, foot in feet.items())
        dots = "Dots: foot off and first contact. " if any(foot.marks for foot in feet.values()) else ""
        caption = (
            f"{told} Bold: mean; thin: mean + SD and mean − SD; grey: the mean's shadow; {counts}. {dots}"
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
            "lines": [np.round(line.points.T, 4).tolist() for line in self._lines],
            "texts": [np.round(text.place, 4).tolist() for text in self._texts],
        }

    def _build(self, feet: Mapping[str, SpaceFoot], length: float) -> None:
        larger = np.array([self._larger, 1.0, self._larger])
        middle = 0.5 * (len(feet) - 1)
        ends = [
            foot.mean_m * larger + np.array([(at - middle) * APART * length, 0.0, 0.0])
            for at, foot in enumerate(feet.values())
        ]
        every = np.concatenate(ends)
        (left, near, _), (right, far, top) = every.min(axis=0), every.max(axis=0)
        self._floor(left - 0.06 * length, right + 0.06 * length, min(near, 0.0), far, top)
        for (name, foot), mean in zip(feet.items(), ends, strict=True):
            color, sd = foot_color(name), foot.sd_m * larger
            self._lines.append(_Line(mean * np.array([1.0, 1.0, 0.0]), "#8a939c", 1.2))
            self._lines += [_Line(mean + sign * sd, color, 1.1, "4 2") for sign in (1.0, -1.0)]
            self._lines.append(_Line(mean, color, 3.2))
            self._lines += [_Line(mean[[at, at]], color, 9.0) for at in foot.marks if 0 <= at < len(mean)]
            self._texts.append(_Text(mean[-1] + np.array([0.0, 0.03 * length, 0.0]), words(name), color))

    def _floor(self, left: float, right: float, near: float, far: float, top: float) -> None:
        steps = nice_ticks(near, max(far, near + 0.1), about=5)
        for y in steps:
            self._lines.append(_Line(np.array([[left, y, 0.0], [right, y, 0.0]]), FLOOR, 1.0))
            self._texts.append(_Text(np.array([right + 0.06 * (right - left), y, 0.0]), f"{y:g} m"))
        for x in (left, right):
            self._lines.append(_Line(np.array([[x, near, 0.0], [x, far, 0.0]]), FLOOR, 1.0))
        up_cm = [cm for cm in nice_ticks(0.0, max(100.0 * top / self._larger, 1.0), about=3) if cm > 0]
        post = np.array([[left, near, 0.0], [left, near, self._larger * up_cm[-1] / 100 if up_cm else top]])
        self._lines.append(_Line(post, POST, 1.4))
        for cm in up_cm:
            z = self._larger * cm / 100
            self._lines.append(_Line(np.array([[left, near, z], [left + 0.03 * (right - left), near, z]]), POST, 1.4))
            self._texts.append(_Text(np.array([left - 0.05 * (right - left), near, z]), f"{cm:g} cm"))

    def _svg(self, label: str) -> str:
        points = np.concatenate([line.points for line in self._lines] + [text.place[None] for text in self._texts])
        flat = projected(points, math.radians(AZIMUTH_DEG), math.radians(ELEVATION_DEG))
        low, high = flat.min(axis=0), flat.max(axis=0)
        room = np.array([WIDTH - 4.0 * MARGIN, HEIGHT - 2.0 * MARGIN])
        scale = float((room / np.maximum(high - low, 1e-9)).min())
        center = 0.5 * (low + high)
        parts, at = [], 0

        def placed(count: int) -> FloatArray:
            own = (flat[at : at + count] - center) * scale * np.array([1.0, -1.0])
            return np.asarray(own + np.array([WIDTH, HEIGHT]) / 2)

        for line in self._lines:
            path = "L".join(f"{x:.1f} {y:.1f}" for x, y in placed(len(line.points)).tolist())
            dash = f' stroke-dasharray="{line.dash}"' if line.dash else ""
            parts.append(f'<path d="M{path}" stroke="{line.color}" stroke-width="{line.width:g}"{dash}/>')
            at += len(line.points)
        for text in self._texts:
            (x, y), at = placed(1)[0].tolist(), at + 1
            parts.append(f'<text x="{x:.1f}" y="{y:.1f}" style="fill:{text.color}">{escape(text.words)}</text>')
        return (
            f'<svg class="plot space" data-space="{escape(self.key)}" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
            f'aria-label="{escape(label)}">{"".join(parts)}</svg>'
        )


def projected(points: FloatArray, azimuth_rad: float, elevation_rad: float) -> FloatArray:
    """Places (N, 3) seen from far away: (N, 2), to the right and up. Azimuth 0: from behind; elevation 0: level."""
    across = points[:, 0] * math.cos(azimuth_rad) - points[:, 1] * math.sin(azimuth_rad)
    away = points[:, 0] * math.sin(azimuth_rad) + points[:, 1] * math.cos(azimuth_rad)
    return np.column_stack((across, points[:, 2] * math.cos(elevation_rad) + away * math.sin(elevation_rad)))


_MARKED: Final = (Phase.SWING, Phase.LOADING_RESPONSE)


def space_of(curves: Mapping[str, FootCurves]) -> SpaceFigure | None:
    """Of the project's own strides; None without any."""
    feet = {foot: _turned(one) for foot, one in curves.items()}
    if not feet:
        return None
    told = (
        "As Figure 5 of Wang et al. (2013), from the strides of this report, heel rise and foot flat brought together: "
        "x right, y along the stride, z up."
    )
    return SpaceFigure("strides", feet, "Strides in three dimensions", told)


def _turned(one: FootCurves) -> SpaceFoot:
    """From forward, left, up to right, along, up."""
    mean, sd = one.mean_path_m, one.sd_path_m
    marks = [round(one.entries_percent[phase]) for phase in _MARKED if phase in one.entries_percent]
    return SpaceFoot(np.column_stack((-mean[:, 1], mean[:, 0], mean[:, 2])), sd[:, [1, 0, 2]], one.count, marks)
