"""Plots as inline SVG: drawn once, sharp on screen and on paper, no script needed."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape
from typing import TypeVar

import numpy as np
from markupsafe import Markup

from fes.signals import FloatArray

WIDTH, LEFT, RIGHT, TOP, BOTTOM = 560, 58, 14, 12, 46
UNIT_WIDTH = 6.4  # of a letter of a label, about
Number = TypeVar("Number", float, FloatArray)
MAX_TITLED_POINTS = 400  # beyond this, points share one path: a hover text each would swell the file


def nice_ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Round numbers that cover [low, high]."""
    raw = (high - low) / about
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * factor for factor in (1, 2, 2.5, 5, 10) if power * factor >= raw * 0.999)
    return [round(i * step, 10) for i in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _tick(value: float) -> str:
    return f"{value / 1000:g}k" if abs(value) >= 10_000 else f"{value:g}"


def padded(values: Iterable[FloatArray], *, zero: bool = False, share: float = 0.06) -> tuple[float, float]:
    """A range with some air around all finite values; ``zero`` puts 0 inside it."""
    parts = [np.asarray(array, dtype=np.float64).ravel() for array in values]
    finite = np.concatenate(parts) if parts else np.zeros(0)
    finite = finite[np.isfinite(finite)]
    finite = np.append(finite, 0.0) if zero else finite
    if finite.size == 0:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    air = share * (high - low) or max(abs(high) * 0.1, 0.5)
    return (low if zero and low == 0 else low - air), high + air


@dataclass(frozen=True)
class Figure:
    """A plot, whose own texts are escaped where it is drawn, with the text that belongs below it."""

    title: str
    svg: Markup
    caption: str


@dataclass
class Plot:
    """One pair of axes. Marks are added in data units; :meth:`figure` draws them.

    ``ticks_from``: the y axis has no ticks below; ``mirrored``: x is counted from 0 to both sides.
    """

    label: str
    x_label: str
    y_label: str
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    height: int = 290
    ticks_from: float = -math.inf
    mirrored: bool = False
    _marks: list[str] = field(default_factory=list, init=False)

    def _x(self, x: Number) -> Number:
        low, high = self.x_range
        return LEFT + (x - low) / (high - low) * (WIDTH - LEFT - RIGHT)

    def _y(self, y: Number) -> Number:
        low, high = self.y_range
        return self.height - BOTTOM - (y - low) / (high - low) * (self.height - TOP - BOTTOM)

    def line(
        self, x: FloatArray, y: FloatArray, color: str, *, width: float = 1.5, opacity: float = 1.0, dash: str = ""
    ) -> None:
        """A line through finite points; it breaks where a value is missing."""
        if path := self._path(x, y):
            dashed = f' stroke-dasharray="{dash}"' if dash else ""
            seen = f' stroke-opacity="{opacity:g}"' if opacity < 1 else ""
            self._marks.append(
                f'<path d="{path}" fill="none" stroke="{color}" stroke-width="{width:g}" stroke-linejoin="round"'
                f"{seen}{dashed}/>"
            )

    def band(self, x: FloatArray, low: FloatArray, high: FloatArray, color: str, opacity: float = 0.2) -> None:
        """The area between two curves over the same x."""
        ok = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
        if ok.sum() > 1:
            self.area(np.append(x[ok], x[ok][::-1]), np.append(low[ok], high[ok][::-1]), color, opacity)

    def area(self, x: FloatArray, y: FloatArray, color: str, opacity: float = 0.2) -> None:
        """The inside of a closed curve."""
        self._marks.append(f'<path d="{self._path(x, y)}Z" fill="{color}" fill-opacity="{opacity:g}"/>')

    def text(self, x: float, y: float, text: str, color: str) -> None:
        """Text at a place."""
        place = f'x="{self._x(x):.1f}" y="{self._y(y):.1f}"'
        self._marks.append(f'<text class="halo" {place} text-anchor="start" fill="{color}">{escape(text)}</text>')

    def rings(self, x: FloatArray, y: FloatArray, color: str) -> None:
        """A ring around every finite point."""
        ok = np.isfinite(x) & np.isfinite(y)
        places = zip(self._x(x[ok]), self._y(y[ok]), strict=True)
        if path := "".join(f"M{a - 6:.1f} {b:.1f}a6 6 0 1 0 12 0a6 6 0 1 0 -12 0" for a, b in places):
            self._marks.append(f'<path class="ring" d="{path}" fill="none" stroke="{color}" stroke-width="1.4"/>')

    def bars(self, x: FloatArray, low: FloatArray, high: FloatArray, width: float, color: str, name: str = "") -> None:
        """Bars from ``low`` to ``high`` (N,), ``width`` wide in units of x, as one shape."""
        ok = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
        edges = self._x(x[ok] - width / 2), self._x(x[ok] + width / 2), self._y(high[ok]), self._y(low[ok])
        path = "".join(f"M{a:.1f} {d:.1f}H{b:.1f}V{c:.1f}H{a:.1f}Z" for a, b, c, d in zip(*edges, strict=True))
        title = f"<title>{escape(name)}</title>" if name else ""
        self._marks.append(f'<path d="{path}" fill="{color}">{title}</path>')

    def points(self, x: FloatArray, y: FloatArray, color: str, titles: list[str], *, hollow: bool = False) -> None:
        """Round marks, each with a hover text as long as there are not too many."""
        ok = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
        px, py = self._x(x[ok]), self._y(y[ok])
        if ok.size > MAX_TITLED_POINTS:
            dots = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(px, py, strict=True))
            how = 'stroke-width="4" stroke-linecap="round" stroke-opacity="0.7"'
            self._marks.append(f'<path d="{dots}" stroke="{color}" {how}/>')
            return
        paint = f'fill="#fff" stroke="{color}" stroke-width="1.6"' if hollow else f'fill="{color}"'
        self._marks += [
            f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.4" {paint}><title>{escape(titles[i])}</title></circle>'
            for i, a, b in zip(ok.tolist(), px, py, strict=True)
        ]

    def level(self, y: float, color: str, *, dash: str = "6 4") -> None:
        """A level right across."""
        if math.isfinite(y):
            path = f'<path d="M{LEFT} {self._y(y):.1f}H{WIDTH - RIGHT}" stroke="{color}" stroke-width="1.8"'
            self._marks.append(f'{path} stroke-dasharray="{dash}"/>')

    def upright(self, x: float, color: str, text: str) -> None:
        """A line from bottom to top with its name at the top."""
        if not math.isfinite(x):
            return
        at = self._x(x)
        fits = at + 4 + UNIT_WIDTH * len(text) <= WIDTH
        place = f'x="{at + 4:.1f}"' if fits else f'x="{at - 4:.1f}" text-anchor="end"'
        self._marks.append(
            f'<path d="M{at:.1f} {TOP}V{self.height - BOTTOM}" stroke="{color}" stroke-width="1.3" '
            f'stroke-dasharray="3 3"/><text class="halo" {place} y="{TOP + 11}" fill="{color}">{escape(text)}</text>'
        )

    def figure(self, title: str, caption: str) -> Figure:
        """The plot with what belongs to it."""
        return Figure(title, Markup(self.render()), caption)

    def render(self) -> str:
        """The whole plot; its label is read out by screen readers."""
        floor, end = self.height - BOTTOM, WIDTH - RIGHT
        grid, texts = [], []
        for value in nice_ticks(*self.y_range):
            if value >= self.ticks_from:
                at = self._y(value)
                grid.append(f"M{LEFT} {at:.1f}H{end}")
                texts.append(f'<text x="{LEFT - 7}" y="{at + 4:.1f}" text-anchor="end">{_tick(value)}</text>')
        for value in nice_ticks(*self.x_range, about=7):
            at, shown = self._x(value), abs(value) if self.mirrored else value
            grid.append(f"M{at:.1f} {floor}v5")
            texts.append(f'<text x="{at:.1f}" y="{floor + 18}" text-anchor="middle">{_tick(shown)}</text>')
        middle, center = (TOP + floor) / 2, (LEFT + end) / 2
        return (
            f'<svg class="plot" viewBox="0 0 {WIDTH} {self.height}" role="img" aria-label="{escape(self.label)}">'
            f'<path class="grid" d="{"".join(grid)}"/>{"".join(self._marks)}'
            f'<path class="axis" d="M{LEFT} {TOP}V{floor}H{end}"/>{"".join(texts)}'
            f'<text class="name" x="{center}" y="{self.height - 8}" text-anchor="middle">{escape(self.x_label)}</text>'
            f'<text class="name" transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">'
            f"{escape(self.y_label)}</text></svg>"
        )

    def _path(self, x: FloatArray, y: FloatArray) -> str:
        ok = np.isfinite(x) & np.isfinite(y)
        px, py = self._x(np.where(ok, x, 0.0)).tolist(), self._y(np.where(ok, y, 0.0)).tolist()
        parts, pen = [], "M"
        for a, b, good in zip(px, py, ok.tolist(), strict=True):
            if good:
                parts.append(f"{pen}{a:.1f} {b:.1f}")
            pen = "L" if good else "M"
        return "".join(parts)
