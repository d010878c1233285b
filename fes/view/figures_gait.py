"""Figures of every stride by itself: lengths, clearance and phase durations; flagged strides are ringed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fes.view.findings import words
from fes.view.flags import LOST, UNSURE, Flag
from fes.view.flags import told as told_of
from fes.view.strides import StrideRow
from fes.view.summary import SessionView
from fes.view.svg import Plot, padded

FAINT_STRIDES = 80  # so many single strides are drawn behind the mean, evenly picked
FOOT_COLORS = {"left_foot": "#0072B2", "right_foot": "#D55E00"}  # Okabe–Ito
PHASE_COLORS = {"pre_swing": "#E69F00", "swing": "#56B4E9", "loading_response": "#CC79A7", "stance": "#C9CED3"}
OTHER_COLOR = "#444444"
RING_COLOR = "#1b1f24"
Flags = Mapping[tuple[str, int], Sequence[Flag]]
NO_FLAGS: Final[Flags] = {}


@dataclass(frozen=True)
class Figure:
    """A plot with the text that belongs below it; ``svg`` is safe markup."""

    title: str
    svg: str
    caption: str


def foot_color(foot: str) -> str:
    """Blue for the left, vermilion for the right foot, in every figure."""
    return FOOT_COLORS.get(foot, OTHER_COLOR)


def stride_figures(view: SessionView, flags: Flags = NO_FLAGS) -> list[Figure]:
    """Stride length and clearance of every stride against time; ``flags`` of foot and number are told."""
    rows, belt = view.summary.strides, view.summary.belt_speed_mps
    if not rows:
        return []
    care = {key: own for key, found in flags.items() if (own := [flag for flag in found if flag.kind != UNSURE])}
    length, lengths = _per_stride(view, [row.stride_length_m for row in rows], "stride length (m)", 2, "m", care)
    clearance, clearances = _per_stride(view, [row.clearance_cm for row in rows], "clearance (cm)", 1, "cm", care)
    times = [row.duration_s for row in rows if row.valid]
    told = "Filled: used, hollow: left out. Dashed: mean"
    if np.isfinite(belt) and times:
        expected_m = belt * float(np.mean(times))
        length.level(expected_m, "#000000", dash="2 3")
        lengths += f". Dotted: belt speed · mean stride time, {expected_m:.2f} m"
    ringed = f" Ringed, with care: {said}." if (said := told_of(care.values())) else ""
    height = "Greatest height of the sensor above its start."
    return [
        Figure("Stride length", length.render(), f"{told} {lengths}.{ringed}"),
        Figure("Clearance", clearance.render(), f"{height} {told} {clearances}.{ringed}"),
    ]


def _per_stride(
    view: SessionView, values: Sequence[float], label: str, digits: int, unit: str, care: Flags
) -> tuple[Plot, str]:
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
    ringed = [i for i, row in enumerate(rows) if (row.foot, row.number) in care]
    plot.rings(start_s[ringed], y[ringed], RING_COLOR)
    return plot, ", ".join(means) or "–"


def phase_figures(view: SessionView, flags: Flags = NO_FLAGS) -> list[Figure]:
    """Per foot: how long each phase of each stride lasted, stacked; strides with a flag that tells on times ringed."""
    figures = []
    for foot in view.timelines:
        rows = [row for row in view.summary.strides if row.foot == foot]
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
    ringed = np.array([row.number in care for row in rows])
    plot.rings(number[ringed], floor[ringed], RING_COLOR)
    said = f" Ringed, with care: {told}." if (told := told_of(care.values())) else ""
    return Figure(
        f"Phase durations, {words(foot)}",
        plot.render(),
        f"From below: pre-swing, swing, loading response, stance. Stances over 3 s are standing, not drawn.{said}",
    )
