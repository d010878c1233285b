"""An instant of a session explained: sentences, one table, one plot; on the terminal, as JSON, as a page."""

from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from fes.evaluation.explanation import AROUND_NS, Explanation, FootThen
from fes.report.figures.strides import PHASE_COLORS
from fes.report.figures.svg import Figure, Plot, padded
from fes.report.figures.timeseries import channel_color
from fes.report.html import rendered
from fes.report.tables import add_columns, small_table
from fes.report.text import number, plain, readable
from fes.signals import NS_PER_S
from statemachine.phases import Phase
from statemachine.terms import FLAG

ASKED_COLOR = "#B00020"


def guard_rows(explained: Explanation) -> list[dict[str, Any]]:
    """A row per comparison: foot, guard, whether it was asked and what it said, value, sign, limit, what that is of."""
    return [
        {
            "foot": foot.foot,
            "guard": guard.transition,
            "asked": guard.asked,
            "fires": guard.terms.holds,
            "what": term.what,
            "seen": bool(term.seen) if term.unit == FLAG else term.seen,
            "sign": term.sign,
            "limit": bool(term.limit) if term.unit == FLAG else term.limit,
            "unit": "" if term.unit in (FLAG, "–") else term.unit,
            "of": term.limit_is,
            "holds": term.holds,
        }
        for foot in explained.feet
        for guard in foot.guards
        for term in guard.terms.each()
    ]


def cell(value: bool | float) -> str:
    """A flag or a number as the table shows it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return number(value, 0 if abs(value) >= 100 else 3)


def explanation_table(explained: Explanation) -> Table:
    """What every guard saw against its threshold; those of other phases are dim."""
    caption = "✓ holds, · does not; dim: not asked in this phase. Limits: docs/phases.md"
    table = small_table("What the guards saw", caption, ["foot", "guard", "", "what"], ["seen", "", "limit"])
    add_columns(table, "unit", "the limit is")
    before = ""
    for row in guard_rows(explained):
        first = f"{row['foot']} {row['guard']}" != before
        before = f"{row['foot']} {row['guard']}"
        name = (readable(row["foot"]).removesuffix(" foot"), row["guard"]) if first else ("", "")
        values = cell(row["seen"]), row["sign"], cell(row["limit"])
        cells = (*name, "✓" if row["holds"] else "·", row["what"], *values, row["unit"], row["of"])
        table.add_row(*map(escape, cells), style=None if row["asked"] else "dim")
    return table


def explanation_json(explained: Explanation) -> dict[str, Any]:
    """Sentences, guards, channels, thresholds and the tuning's changes as plain values."""
    return {
        "at_s": explained.at_s,
        "sentences": explained.sentences(),
        "gate": explained.gate,
        "guards": plain(guard_rows(explained)),
        "thresholds": {foot.foot: plain(foot.thresholds._asdict()) for foot in explained.feet},
        "channels": plain(explained.channels),
        "tuning": plain(explained.tuning),
    }


def explanation_figure(explained: Explanation, foot: FootThen) -> Figure:
    """The toe-down rate about the instant, the phases behind it, bursts below, and the limits on this rate."""
    t_s, rate, phase = (np.array(column) for column in zip(*explained.trace[foot.foot], strict=True))
    around_s = AROUND_NS / NS_PER_S
    limits = [
        (term.limit if term.what == "toe down" else -term.limit, guard.transition)
        for guard in foot.guards
        if guard.asked
        for term in guard.terms.each()
        if term.what in ("toe down", "toe up")
    ]
    levels = np.array([value for value, _ in limits] + [0.0])
    low, high = padded([rate, levels])
    floor = low - 0.12 * (high - low)
    ends = explained.at_s - around_s, explained.at_s + around_s
    plot = Plot(f"Toe-down rate, {readable(foot.foot)}", "time (s)", "toe-down rate (rad/s)", ends, (floor, high))
    starts = np.flatnonzero(np.diff(phase, prepend=-1))
    for begin, end in zip(starts, [*starts[1:], len(phase) - 1], strict=True):
        span = np.array([t_s[begin], t_s[end]])
        plot.band(span, np.full(2, low), np.full(2, high), PHASE_COLORS[Phase(int(phase[begin])).name.lower()], 0.4)
    for channel, from_s, to_s in explained.bursts:
        span = np.clip(np.array([from_s, to_s]), *ends)
        plot.band(span, np.full(2, floor), np.full(2, 0.4 * floor + 0.6 * low), channel_color(channel), 1.0)
    plot.line(t_s, rate, "#1b1f24", width=1.6)
    for value, name in limits:
        plot.level(value, ASKED_COLOR)
        plot.text(ends[0], value, name, ASKED_COLOR)
    plot.upright(explained.at_s, "#000000", f"{explained.at_s:.3f} s")
    text = "Behind: phases. Below: bursts. Dashed: limits on this rate of the guards that were asked."
    return plot.figure(f"{readable(foot.foot).capitalize()} about {explained.at_s:.3f} s", text)


def render_explanation(explained: Explanation, log: str, differs: str = "") -> str:
    """The page: answer, table, plot."""
    drawn = [explanation_figure(explained, foot) for foot in explained.feet if len(explained.trace[foot.foot]) > 1]
    rows = [row | {name: cell(row[name]) for name in ("seen", "limit")} for row in guard_rows(explained)]
    keys = list(PHASE_COLORS.items())
    shown = {"rows": rows, "figures": drawn, "phases": keys}
    return rendered("explanation.html.j2", e=explained, log=log, differs=differs, shown=shown)
