"""Figures of a comparison: the foot's height and pitch of all sessions over each other, their phases, and intervals.

Sessions differ by colour and by dash, so that neither colour vision nor colour printing is needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np

from fes.evaluation.agreement import Interval
from fes.report.comparison.rows import ParameterRow
from fes.report.comparison.session import PHASES, ComparedSession
from fes.report.figures.strides import PHASE_COLORS
from fes.report.figures.svg import Figure, Plot, nice_ticks, padded
from fes.report.gait import POINTS, by_distance, spread_of
from fes.report.text import readable
from fes.signals import FloatArray, StrideResult

COLORS: Final = ("#444444", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#0072B2")  # Okabe–Ito, not those of the feet
DASHES: Final = ("", "9 4", "3 3", "12 3 3 3", "6 2 2 2 2 2", "1 3")
BAR, LEFT, WIDTH = 22, 158, 560
SKETCH: Final = (110, 18)


@dataclass(frozen=True)
class Curve:
    """Strides of a session at the same points: mean x, and mean and SD of y (K,)."""

    x: FloatArray
    mean: FloatArray
    sd: FloatArray
    n: int


def curve_figures(sessions: Sequence[ComparedSession]) -> list[Figure]:
    """For each side the height over the distance forward, and the pitch from heel rise to foot flat."""
    figures = []
    for title, curve_of, axes in (
        ("Foot height", height_curve, ("forward (m)", "height of the sensor (cm)")),
        ("Foot pitch", pitch_curve, ("from heel rise (0 %) to foot flat (100 %)", "pitch (°), toe up +")),
    ):
        found = {
            side: [curve_of(session.sides[side].strides) if side in session.sides else None for session in sessions]
            for side in ("left", "right")
        }
        every = [curve for curves in found.values() for curve in curves if curve is not None]
        x_range = padded([curve.x for curve in every], share=0.03)
        y_range = padded([curve.mean + k * curve.sd for curve in every for k in (-1, 1)], zero=True)
        for side, curves in found.items():
            known = [(k, curve) for k, curve in enumerate(curves) if curve is not None]
            if not known:
                continue
            plot = Plot(f"{title}, {side}, mean ± SD of each session", *axes, x_range, y_range)
            for k, curve in known:
                plot.band(curve.x, curve.mean - curve.sd, curve.mean + curve.sd, COLORS[k], 0.22)
            for k, curve in known:
                plot.line(curve.x, curve.mean, COLORS[k], width=3, dash=DASHES[k])
            counts = ", ".join(f"{sessions[k].label} {curve.n}" for k, curve in known)
            figures.append(plot.figure(f"{title}, {side}", f"Mean and band of ± 1 SD; strides: {counts}."))
    return figures


def height_curve(strides: Sequence[StrideResult]) -> Curve | None:
    """Height in cm at equal shares of each stride's distance, so that waiting in stance does not smear the swing."""
    whole = [s.trajectory_m for s in strides if len(s.trajectory_m) > 1 and np.isfinite(s.trajectory_m).all()]
    paths = [path for each in whole if (path := by_distance(each)) is not None]
    return _curve([path[:, 0] for path in paths], [100.0 * path[:, 2] for path in paths])


def pitch_curve(strides: Sequence[StrideResult]) -> Curve | None:
    """Pitch in degrees from the entry into pre-swing to the entry into stance, 0 in the stance before."""
    share = np.linspace(0.0, 1.0, POINTS)
    rows = []
    for stride in strides:
        begin, end, pitch = stride.t_pre_swing_ns, stride.t_stance_ns, stride.pitch_rad
        if begin is not None and end is not None and end > begin and len(pitch) > 1 and np.isfinite(pitch).all():
            own = np.linspace(stride.t_start_ns - begin, stride.t_end_ns - begin, len(pitch)) / (end - begin)
            rows.append(np.interp(share, own, np.degrees(pitch)))
    return _curve([100.0 * share] * len(rows), rows)


def _curve(x: Sequence[FloatArray], y: Sequence[FloatArray]) -> Curve | None:
    if not y:
        return None
    stacked = np.stack(y)
    return Curve(np.stack(x).mean(axis=0), stacked.mean(axis=0), spread_of(stacked), len(stacked))


def phase_figure(sessions: Sequence[ComparedSession], rows: Sequence[ParameterRow]) -> Figure | None:
    """The mean phases of each side and session, one bar each from heel rise on."""
    bars = []
    for side in ("left", "right"):
        for k, session in enumerate(sessions):
            mine = {row.about.key.removeprefix("phase_"): row.means[k].mean for row in rows if row.side == side}
            lasted = [(phase, mine[phase]) for phase in PHASES if np.isfinite(mine.get(phase, np.nan))]
            if lasted:
                bars.append((f"{side}, {session.label}", lasted))
    if not bars:
        return None
    longest = max(sum(seconds for _, seconds in lasted) for _, lasted in bars)
    scale = (WIDTH - LEFT - 14) / longest
    floor = 8 + (BAR + 8) * len(bars)
    parts = []
    for number, (name, lasted) in enumerate(bars):
        top, at = 8 + (BAR + 8) * number, float(LEFT)
        short = name if len(name) <= 20 else f"{name[:19]}…"
        parts.append(f'<text x="{LEFT - 8}" y="{top + 15}" text-anchor="end">{escape(short)}</text>')
        for phase, seconds in lasted:
            wide = scale * seconds
            parts.append(
                f'<rect x="{at:.1f}" y="{top}" width="{wide:.1f}" height="{BAR}" fill="{PHASE_COLORS[phase]}" '
                f'stroke="#fff"><title>{escape(readable(phase))}: {seconds:.2f} s</title></rect>'
            )
            if wide > 34:
                parts.append(f'<text x="{at + wide / 2:.1f}" y="{top + 15}" text-anchor="middle">{seconds:.2f}</text>')
            at += wide
    for value in nice_ticks(0.0, longest):
        x = LEFT + scale * value
        parts.append(f'<path class="axis" d="M{x:.1f} {floor}v5"/>')
        parts.append(f'<text x="{x:.1f}" y="{floor + 20}" text-anchor="middle">{value:g}</text>')
    svg = (
        f'<svg class="plot" viewBox="0 0 {WIDTH} {floor + 40}" role="img" aria-label="Mean phase durations">'
        f'<path class="axis" d="M{LEFT} {floor}H{WIDTH - 14}"/>{"".join(parts)}</svg>'
    )
    return Figure("Phases", svg, "Mean durations in s, from heel rise: pre-swing, swing, loading response, stance.")


def sketch(change: Interval, reach: float, color: str) -> str:
    """An interval as a small bar around zero, ``reach`` to either side; "" where it is not known."""
    if not (np.isfinite(change.low) and np.isfinite(change.high) and reach > 0.0):
        return ""
    width, height = SKETCH
    scale, middle = 0.46 * width / reach, width / 2
    low, high, at = (middle + scale * value for value in (change.low, change.high, change.value))
    return (
        f'<svg class="sketch" viewBox="0 0 {width} {height}" width="{width}" height="{height}" aria-hidden="true">'
        f'<path d="M{middle} 1V{height - 1}" stroke="#6b747d"/>'
        f'<path d="M{low:.1f} {height / 2}H{high:.1f}" stroke="{color}" stroke-width="4"/>'
        f'<circle cx="{at:.1f}" cy="{height / 2}" r="4" fill="{color}"/></svg>'
    )
