"""Sessions side by side, before and after, with and without stimulation: one HTML page, or plain values."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from fes.evaluation.agreement import Interval
from fes.report.comparison.figures import COLORS, DASHES, curve_figures, phase_figure, sketch
from fes.report.comparison.rows import KEY, ParameterRow, SymmetryRow, parameter_rows, phase_rows, symmetry_rows
from fes.report.comparison.sentences import changes, confounders, describe_stimulation, speed_differs, value_text
from fes.report.comparison.session import ComparedSession, with_the_same_timing
from fes.report.figures.strides import PHASE_COLORS, foot_color
from fes.report.glossary import GLOSSARY
from fes.report.html import rendered, trusted
from fes.report.text import capitalised, number, plain
from fes.walk_record import Finding

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
        figures=trusted(curve_figures(sessions)),
        phase_figures=trusted([phases] if phases else []),
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
