"""Sessions side by side, before and after, with and without stimulation: one HTML page, or plain values.

Figures of a comparison: the foot's height and pitch of all sessions over each other, their phases, and intervals.

Sessions differ by colour and by dash, so that neither colour vision nor colour printing is needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from fes.evaluation.agreement import Interval
from fes.report.comparison.session import (
    KEY,
    PHASES,
    ComparedSession,
    ParameterRow,
    SymmetryRow,
    changes,
    confounders,
    describe_stimulation,
    parameter_rows,
    phase_rows,
    speed_differs,
    symmetry_rows,
    value_text,
    with_the_same_timing,
)
from fes.report.figures.strides import PHASE_COLORS, foot_color
from fes.report.figures.svg import Figure, Plot, nice_ticks, padded
from fes.report.gait import POINTS, by_distance, spread_of
from fes.report.html import rendered
from fes.report.parameter_table import GLOSSARY
from fes.report.text import capitalised, number, plain, readable
from fes.signals import FloatArray, StrideResult
from fes.walk_record import Finding

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
    for row, (name, lasted) in enumerate(bars):
        top, at = 8 + (BAR + 8) * row, float(LEFT)
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
    return Figure(
        "Phases", Markup(svg), "Mean durations in s, from heel rise: pre-swing, swing, loading response, stance."
    )


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


FORMAT: Final = 1
MOST: Final = len(COLORS)
LINE_SAMPLE: Final = (
    '<svg width="34" height="14" aria-hidden="true"><path d="M0 7H34" stroke="{}" stroke-width="4" '
    'stroke-dasharray="{}"/></svg>'
)


@dataclass(frozen=True)
class SessionComparison:
    """Sessions held against the first of them."""

    sessions: tuple[ComparedSession, ...]
    parameters: tuple[ParameterRow, ...]
    phases: tuple[ParameterRow, ...]
    symmetry: tuple[SymmetryRow, ...]
    confounders: tuple[Finding, ...]
    changes: tuple[Finding, ...]
    speed_differs: bool

    def to_json(self) -> dict[str, Any]:
        """Plain values, SI, null for what is not known; ``format`` changes when a key changes its meaning."""
        symmetry = [
            {"parameter": r.about.key, "first": r.first, "second": r.second, "index_percent": r.indices}
            | {"change": r.changes}
            for r in self.symmetry
        ]
        values = {
            "format": FORMAT,
            "sessions": [_session_json(session) for session in self.sessions],
            "parameters": [_row_json(row) for row in (*self.parameters, *self.phases)],
            "symmetry": symmetry,
            "speed_differs": self.speed_differs,
            "confounders": self.confounders,
            "changes": self.changes,
        }
        return dict(plain(values))


def compare_sessions(sessions: Sequence[ComparedSession], *, paretic: str | None = None) -> SessionComparison:
    """Hold the later sessions against the first; ``paretic`` is "left", "right" or None where nobody said."""
    sessions, why = with_the_same_timing(sessions)
    rows, phases, symmetry = parameter_rows(sessions), phase_rows(sessions), symmetry_rows(sessions, paretic)
    before = confounders(sessions) + ([Finding("info", why)] if why else [])
    found = changes(sessions, rows)
    told = tuple(before), tuple(found), speed_differs(sessions)
    return SessionComparison(tuple(sessions), tuple(rows), tuple(phases), tuple(symmetry), *told)


def render_comparison(comparison: SessionComparison) -> str:
    """The page as one self-contained HTML text; the same sessions always give the same bytes."""
    sessions = comparison.sessions
    phases = phase_figure(sessions, comparison.phases)
    labels = [session.label for session in sessions]
    sources = {row.detectable.source for row in comparison.parameters if row.detectable}
    return rendered(
        "comparison.html.j2",
        title=" – ".join(labels) if len(labels) < 4 else f"{len(labels)} sessions",
        c=comparison,
        labels=labels,
        people=sorted({session.summary.subject for session in sessions} - {""}),
        key=_groups(comparison, [row for row in comparison.parameters if row.about.key in KEY]),
        rest=_groups(comparison, [row for row in comparison.parameters if row.about.key not in KEY]),
        phases=_groups(comparison, comparison.phases),
        symmetry=[_symmetry(row) for row in comparison.symmetry],
        detectable=bool(sources),
        sources=sorted(sources),
        figures=curve_figures(sessions),
        phase_figures=[phases] if phases else [],
        looks=[{"line": Markup(LINE_SAMPLE.format(*look))} for look in zip(COLORS, DASHES, strict=True)],
        stimulation=describe_stimulation,
        phase_colors=PHASE_COLORS,
        glossary=GLOSSARY,
    )


def _groups(comparison: SessionComparison, rows: Sequence[ParameterRow]) -> list[dict[str, Any]]:
    """Rows of one parameter together, as the template shows them."""
    first, *others = comparison.sessions
    differs = [speed_differs((first, other)) for other in others]
    return [
        {
            "name": capitalised(about.name),
            "unit": about.shown,
            "about": f"{capitalised(about.text)}." + (f" [{about.source}]" if about.source else ""),
            "marks": [each and with_speed for each in differs],
            "rows": [_cells(row) for row in rows if row.about.key == about.key],
        }
        for about, with_speed in {row.about.key: (row.about, row.with_speed) for row in rows}.values()
    ]


def _cells(row: ParameterRow) -> dict[str, Any]:
    reach = max((abs(end) for c in row.changes for end in (c.low, c.high) if np.isfinite(end)), default=0.0)
    color = foot_color(f"{row.side}_foot")
    means = [
        {"text": f"{value_text(row, m.mean)} ± {value_text(row, m.sd)}" if m.n else "–", "n": m.n} for m in row.means
    ]
    changes = []
    for k, change in enumerate(row.changes):
        value, low, high = (value_text(row, each, "+") for each in (change.value, change.low, change.high))
        interval = f"{low} … {high}" if np.isfinite(change.low) else "too few strides"
        drawn = Markup(sketch(change, reach, color))
        told = {"value": value, "interval": interval, "sketch": drawn, "verdict": _verdict(row, k)}
        changes.append({**told, "clear": row.clear(k)})
    return {"side": row.side, "color": color, "means": means, "changes": changes}


def _verdict(row: ParameterRow, k: int) -> str:
    if not np.isfinite(row.changes[k].low):
        return "–"
    if not row.clear(k):
        return "not clear"
    text = "▲ more" if row.changes[k].value > 0.0 else "▼ less"
    return text + ("" if row.detectable is None else ", > MDC" if row.beyond(k) else ", < MDC")


def _symmetry(row: SymmetryRow) -> dict[str, Any]:
    def text(interval: Interval) -> str:
        if not np.isfinite(interval.low):
            return number(interval.value, 1)
        return f"{interval.value:+.1f} ({interval.low:+.1f} … {interval.high:+.1f})"

    nearer = {True: "nearer to symmetric", False: "farther from symmetric", None: "not clear"}
    changes = [{"text": text(c), "verdict": nearer[row.nearer(k)]} for k, c in enumerate(row.changes)]
    about = {"name": capitalised(row.about.name), "about": row.about.text, "first": row.first, "second": row.second}
    return about | {"indices": [text(index) for index in row.indices], "changes": changes}


def _session_json(session: ComparedSession) -> dict[str, Any]:
    names = ("subject", "created", "belt_speed_mps", "walking_speed_mps")
    strides = {side: {"valid": len(one.strides), "found": one.found} for side, one in session.sides.items()}
    return {
        **{name: getattr(session, name) for name in ("label", "source", "how")},
        **{name: getattr(session.summary, name) for name in names},
        "stimulated_share": session.stimulated,
        "strides": strides,
        **{name: getattr(session.summary, name) for name in ("channels", "dose")},
    }


def _row_json(row: ParameterRow) -> dict[str, Any]:
    changes = [{**plain(c), "clear": row.clear(k), "beyond": row.beyond(k)} for k, c in enumerate(row.changes)]
    known = {"parameter": row.about.key, "unit": row.about.unit, "side": row.side, "sessions": row.means}
    return known | {"changes": changes, "changes_with_speed": row.with_speed, "least_detectable": row.detectable}
