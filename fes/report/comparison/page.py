"""Sessions side by side, before and after, with and without stimulation: one HTML page, or plain values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from fes import __version__
from fes.evaluation.agreement import Interval
from fes.report.comparison.figures import COLORS, DASHES, curve_figures, phase_figure, sketch
from fes.report.comparison.rows import KEY, ParameterRow, SymmetryRow, parameter_rows, phase_rows, symmetry_rows
from fes.report.comparison.sentences import changes, confounders, describe_stimulation, speed_differs, value_text
from fes.report.comparison.session import ComparedSession, with_the_same_timing
from fes.report.figures.strides import PHASE_COLORS, foot_color
from fes.report.findings import Finding
from fes.report.glossary import GLOSSARY
from fes.report.html import style, templates, trusted, write_page_file
from fes.report.text import capitalised, number, plain

FORMAT: Final = 1
MOST: Final = len(COLORS)


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
        return dict(
            plain(
                {
                    "format": FORMAT,
                    "sessions": [_session_json(session) for session in self.sessions],
                    "parameters": [_row_json(row) for row in (*self.parameters, *self.phases)],
                    "symmetry": [
                        {
                            "parameter": row.about.key,
                            "first": row.first,
                            "second": row.second,
                            "index_percent": row.indices,
                            "change": row.changes,
                        }
                        for row in self.symmetry
                    ],
                    "speed_differs": self.speed_differs,
                    "confounders": self.confounders,
                    "changes": self.changes,
                }
            )
        )


def compare_sessions(sessions: Sequence[ComparedSession], *, paretic: str | None = None) -> SessionComparison:
    """Hold the later sessions against the first; ``paretic`` is "left", "right" or None where nobody said."""
    sessions, why = with_the_same_timing(sessions)
    rows, phases = parameter_rows(sessions), phase_rows(sessions)
    timing = [Finding("info", why)] if why else []
    return SessionComparison(
        tuple(sessions),
        tuple(rows),
        tuple(phases),
        tuple(symmetry_rows(sessions, paretic)),
        tuple(confounders(sessions) + timing),
        tuple(changes(sessions, rows)),
        speed_differs(sessions),
    )


def write_comparison(comparison: SessionComparison, path: Path) -> None:
    """Write the page as one self-contained HTML file; the same sessions always give the same bytes.

    Raises:
        ReportError: it cannot be written.
    """
    write_page_file(render_comparison(comparison), path, "Choose another --report.")


def render_comparison(comparison: SessionComparison) -> str:
    """The page as HTML text."""
    sessions = comparison.sessions
    phases = phase_figure(sessions, comparison.phases)
    key = [row for row in comparison.parameters if row.about.key in KEY]
    rest = [row for row in comparison.parameters if row.about.key not in KEY]
    labels = [session.label for session in sessions]
    return (
        templates()
        .get_template("comparison.html.j2")
        .render(
            title=" – ".join(labels) if len(labels) < 4 else f"{len(labels)} sessions",
            version=__version__,
            c=comparison,
            labels=labels,
            people=sorted({session.summary.subject for session in sessions} - {""}),
            key=_groups(comparison, key),
            rest=_groups(comparison, rest),
            phases=_groups(comparison, comparison.phases),
            symmetry=[_symmetry(row) for row in comparison.symmetry],
            detectable=any(row.detectable for row in comparison.parameters),
            sources=sorted({row.detectable.source for row in comparison.parameters if row.detectable}),
            figures=trusted(curve_figures(sessions)),
            phase_figures=trusted([phases] if phases else []),
            looks=[_line_sample(k) for k in range(len(sessions))],
            style=style(),
            stimulation=describe_stimulation,
            phase_colors=PHASE_COLORS,
            glossary=GLOSSARY,
        )
    )


def _groups(comparison: SessionComparison, rows: Sequence[ParameterRow]) -> list[dict[str, Any]]:
    """Rows of one parameter together, as the template shows them."""
    groups: list[dict[str, Any]] = []
    first, *others = comparison.sessions
    for name in dict.fromkeys(row.about.key for row in rows):
        mine = [row for row in rows if row.about.key == name]
        about = mine[0].about
        marks = [mine[0].with_speed and speed_differs((first, other)) for other in others]
        groups.append(
            {
                "name": capitalised(about.name),
                "unit": about.shown,
                "about": f"{capitalised(about.text)}." + (f" [{about.source}]" if about.source else ""),
                "marks": marks,
                "rows": [_cells(row) for row in mine],
            }
        )
    return groups


def _cells(row: ParameterRow) -> dict[str, Any]:
    reach = max((abs(end) for c in row.changes for end in (c.low, c.high) if np.isfinite(end)), default=0.0)
    color = foot_color(f"{row.side}_foot")
    return {
        "side": row.side,
        "color": color,
        "means": [
            {"text": f"{value_text(row, m.mean)} ± {value_text(row, m.sd)}" if m.n else "–", "n": m.n}
            for m in row.means
        ],
        "changes": [
            {
                "value": value_text(row, change.value, "+"),
                "interval": f"{value_text(row, change.low, '+')} … {value_text(row, change.high, '+')}"
                if np.isfinite(change.low)
                else "too few strides",
                "sketch": Markup(sketch(change, reach, color)),
                "verdict": _verdict(row, k),
                "clear": row.clear(k),
            }
            for k, change in enumerate(row.changes)
        ],
    }


def _verdict(row: ParameterRow, k: int) -> str:
    if not np.isfinite(row.changes[k].low):
        return "–"
    if not row.clear(k):
        return "not clear"
    text = "▲ more" if row.changes[k].value > 0.0 else "▼ less"
    if row.detectable is not None:
        text += ", > MDC" if row.beyond(k) else ", < MDC"
    return text


def _symmetry(row: SymmetryRow) -> dict[str, Any]:
    def text(interval: Interval) -> str:
        if not np.isfinite(interval.low):
            return number(interval.value, 1)
        return f"{interval.value:+.1f} ({interval.low:+.1f} … {interval.high:+.1f})"

    nearer = {True: "nearer to symmetric", False: "farther from symmetric", None: "not clear"}
    return {
        "name": capitalised(row.about.name),
        "about": row.about.text,
        "first": row.first,
        "second": row.second,
        "indices": [text(index) for index in row.indices],
        "changes": [{"text": text(c), "verdict": nearer[row.nearer(k)]} for k, c in enumerate(row.changes)],
    }


def _line_sample(k: int) -> dict[str, Any]:
    line = f'<path d="M0 7H34" stroke="{COLORS[k]}" stroke-width="4" stroke-dasharray="{DASHES[k]}"/>'
    return {"color": COLORS[k], "line": Markup(f'<svg width="34" height="14" aria-hidden="true">{line}</svg>')}


def _session_json(session: ComparedSession) -> dict[str, Any]:
    s = session.summary
    return {
        "label": session.label,
        "source": session.source,
        "how": session.how,
        "subject": s.subject,
        "created": s.created,
        "belt_speed_mps": s.belt_speed_mps,
        "walking_speed_mps": s.walking_speed_mps,
        "stimulated_share": session.stimulated,
        "strides": {side: {"valid": len(one.strides), "found": one.found} for side, one in session.sides.items()},
        "channels": s.channels,
        "dose": s.dose,
    }


def _row_json(row: ParameterRow) -> dict[str, Any]:
    return {
        "parameter": row.about.key,
        "unit": row.about.unit,
        "side": row.side,
        "sessions": row.means,
        "changes": [{**plain(c), "clear": row.clear(k), "beyond": row.beyond(k)} for k, c in enumerate(row.changes)],
        "changes_with_speed": row.with_speed,
        "least_detectable": row.detectable,
    }
