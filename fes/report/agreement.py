"""How an estimate agrees with its reference: the terminal's table, JSON, and one HTML page with figures.

The figures are Bland–Altman's, the estimate over the reference, and the errors over time.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from fes import __version__
from fes.evaluation.agreement import Interval
from fes.evaluation.reference.compare import Count, Pair
from fes.evaluation.reference.evaluation import BOTH, AgreementRow, Evaluation
from fes.report.figures.strides import foot_color
from fes.report.figures.svg import Figure, Plot, padded
from fes.report.html import style, templates, trusted, write_page_file
from fes.report.text import capitalised, number, plain, readable
from fes.signals import FloatArray

GREY, LIMIT = "#5a636d", "#b3261e"


def agreement_figures(evaluation: Evaluation) -> list[Figure]:
    """For each quantity the errors over time; unless it is an instant, also over size, and both against each other."""
    figures = []
    for name in dict.fromkeys(row.quantity for row in evaluation.rows):
        row = [each for each in evaluation.rows if each.quantity == name][-1]  # both feet, where there are two
        pairs = [pair for pair in evaluation.pairs if pair.quantity == name]
        if not row.about.instant:
            figures += [_bland_altman(row, pairs), _against(row, pairs)]
        figures.append(_errors(row, pairs))
    return figures


def _bland_altman(row: AgreementRow, pairs: list[Pair]) -> Figure:
    q, d = row.about, row.differences
    true, ours = _values(row, pairs)
    means, errors = 0.5 * (true + ours), ours - true
    levels = q.factor * np.array([d.bias.value, d.lower_limit.value, d.upper_limit.value])
    bands = q.factor * np.array(
        [[d.lower_limit.low, d.upper_limit.low, d.bias.low], [d.lower_limit.high, d.upper_limit.high, d.bias.high]]
    )
    plot = Plot(
        f"{q.label}: difference over mean",
        f"mean of both, {q.unit}",
        f"estimate − reference, {q.unit}",
        padded([means]),
        padded([errors, levels, bands.ravel()], zero=True),
    )
    ends = np.array(plot.x_range)
    for low, high in bands.T:
        plot.band(ends, np.full(2, low), np.full(2, high), GREY, 0.15)
    _points(plot, pairs, means, errors, q.unit, q.digits)
    plot.level(float(levels[0]), GREY, dash="")
    for level in levels[1:]:
        plot.level(float(level), LIMIT)
    caption = (
        f"{d.n} pairs: bias {levels[0]:+.{q.digits}f} {q.unit}, 95 % limits of agreement {levels[1]:+.{q.digits}f} and "
        f"{levels[2]:+.{q.digits}f} {q.unit}; grey: their 95 % intervals."
    )
    return Figure(f"{q.label}: Bland–Altman", plot.render(), caption)


def _against(row: AgreementRow, pairs: list[Pair]) -> Figure:
    q = row.about
    true, ours = _values(row, pairs)
    reach = padded([true, ours])
    plot = Plot(f"{q.label}: estimate over reference", f"reference, {q.unit}", f"estimate, {q.unit}", reach, reach)
    ends = np.array(reach)
    plot.line(ends, ends, GREY, dash="4 4")
    _points(plot, pairs, true, ours, q.unit, q.digits)
    slope, intercept = row.line.slope.value, q.factor * row.line.intercept.value
    caption = "Dashed: equal."
    if np.isfinite(slope):
        plot.line(np.array([true.min(), true.max()]), intercept + slope * np.array([true.min(), true.max()]), LIMIT)
        caption += (
            f" Red: least squares, slope {slope:.2f}, intercept {intercept:+.{q.digits}f} {q.unit}, r {row.line.r:.3f}."
        )
    return Figure(f"{q.label}: one over the other", plot.render(), caption)


def _errors(row: AgreementRow, pairs: list[Pair]) -> Figure:
    q = row.about
    true, ours = _values(row, pairs)
    times, errors = np.array([pair.t_s for pair in pairs]), ours - true
    plot = Plot(
        f"{q.label}: error over time",
        "time, s",
        f"estimate − reference, {q.unit}",
        padded([times]),
        padded([errors], zero=True),
    )
    plot.level(0.0, GREY, dash="")
    _points(plot, pairs, times, errors, q.unit, q.digits)
    return Figure(
        f"{q.label}: errors",
        plot.render(),
        f"{capitalised(q.about)}. A slope would be a clock or a sensor that drifts.",
    )


def _values(row: AgreementRow, pairs: list[Pair]) -> tuple[FloatArray, FloatArray]:
    factor = row.about.factor
    reference, estimate = factor * np.array([(pair.reference, pair.estimate) for pair in pairs]).T
    return reference, estimate


def _points(plot: Plot, pairs: list[Pair], x: FloatArray, y: FloatArray, unit: str, digits: int) -> None:
    for foot in sorted({pair.foot for pair in pairs}):
        mine = [k for k, pair in enumerate(pairs) if pair.foot == foot]
        titles = [f"{readable(foot)}, {pairs[k].t_s:.2f} s: {y[k]:.{digits}f} {unit}" for k in mine]
        plot.points(x[mine], y[mine], foot_color(foot), titles)


def agreement_json(evaluation: Evaluation) -> dict[str, Any]:
    """Everything in SI, with the pairs; what is not known is null."""
    lag = evaluation.synchrony
    return dict(
        plain(
            {
                "recording": evaluation.estimate.source,
                "estimate": evaluation.estimate.how,
                "reference": list(evaluation.sources),
                "clock": {"applied_lag_s": lag.applied_s, "found_by": lag.by, "found": lag.found},
                "counts": evaluation.counts,
                "agreement": evaluation.rows,
                "notes": evaluation.notes,
                "warnings": evaluation.warnings,
                "pairs": evaluation.pairs,
            }
        )
    )


def agreement_rows(evaluation: Evaluation) -> list[dict[str, Any]]:
    """A flat row for each quantity and foot, SI: bias and 95 % limits of estimate minus reference, ICC(2,1)."""
    return [
        {
            "quantity": row.quantity,
            "foot": row.foot,
            "n": row.differences.n,
            "reference_mean": row.reference_mean,
            "estimate_mean": row.estimate_mean,
            "bias": row.differences.bias.value,
            "lower_limit": row.differences.lower_limit.value,
            "upper_limit": row.differences.upper_limit.value,
            "icc": row.icc.value,
        }
        for row in evaluation.rows
    ]


def pair_rows(evaluation: Evaluation) -> list[dict[str, Any]]:
    """A flat row for each pair, SI."""
    return [asdict(pair) | {"error": pair.estimate - pair.reference} for pair in evaluation.pairs]


def agreement_text(evaluation: Evaluation) -> RenderableType:
    """Two tables, at most 100 columns wide, and what was assumed."""
    table = Table(
        title="Agreement: estimate − reference",
        caption="± after the bias: half its 95 % interval. LoA: 95 % limits of agreement. ICC(2,1), 95 % interval.",
        caption_justify="left",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
        show_edge=False,
    )
    for title in ("quantity", "foot", "unit"):
        table.add_column(title, no_wrap=True)
    for title in ("n", "bias", "SD", "RMSE", "LoA", "ICC", "slope"):
        table.add_column(title, justify="right", no_wrap=True)
    names = ("label", "foot", "unit", "n", "bias", "sd", "rmse", "limits", "icc", "slope")
    for cells in map(_cells, evaluation.rows):
        table.add_row(*(cells[name] for name in names))
    lines = [Text(_describe_count(count)) for count in evaluation.counts]
    lines += [Text(_describe_clocks(evaluation))]
    lines += [Text(note) for note in evaluation.notes]
    lines += [Text(f"! {warning}", style="yellow") for warning in evaluation.warnings]
    return Group(table, *lines)


def _cells(row: AgreementRow) -> dict[str, str]:
    """One row as people read it."""
    q, d = row.about, row.differences
    half = q.factor * 0.5 * (d.bias.high - d.bias.low)

    def shown(value: float, sign: str = "") -> str:
        return number(q.factor * value, q.digits, sign)

    def between(low: float, high: float) -> str:
        return f"{shown(low, '+')} … {shown(high, '+')}"

    def with_interval(value: Interval) -> str:
        if not np.isfinite(value.value):
            return "–"
        return f"{number(value.value, 2)} ({number(value.low, 2)}…{number(value.high, 2)})"

    return {
        "label": q.label,
        "foot": row.foot if row.foot == BOTH else readable(row.foot).removesuffix(" foot"),
        "unit": q.unit,
        "n": str(d.n),
        "reference": shown(row.reference_mean),
        "bias": f"{shown(d.bias.value, '+')} ± {number(half, q.digits)}",
        "sd": shown(d.sd),
        "rmse": shown(d.rmse),
        "worst": shown(d.worst),
        "limits": between(d.lower_limit.value, d.upper_limit.value),
        "lower": between(d.lower_limit.low, d.lower_limit.high),
        "upper": between(d.upper_limit.low, d.upper_limit.high),
        "icc": with_interval(row.icc),
        "slope": number(row.line.slope.value, 2),
        "intercept": shown(row.line.intercept.value, "+"),
        "r": number(row.line.r, 3),
        "trend": with_interval(row.line.trend),
        "about": q.about,
    }


def _describe_count(c: Count) -> str:
    text = f"{c.what}, {readable(c.foot)}: {c.expected} expected, {c.missed} missed, {c.extra} extra"
    return text + (f"; {c.left_out} left out, for one side cannot be relied on there" if c.left_out else "")


def _describe_clocks(evaluation: Evaluation) -> str:
    lag = evaluation.synchrony
    if lag.found is None:
        return f"Clocks: lag of {lag.applied_s:+.3f} s applied, not checked"
    found = lag.found
    return (
        f"Clocks: {lag.applied_s:+.3f} s applied; by {lag.by} {found.lag_s:+.3f} s (correlation {found.likeness:.3f}, "
        f"next best {number(found.next_best, 3)}, residual {100 * found.residual:.0f} %, later half "
        f"{number(1e3 * found.halves_s, 0)} ms apart)"
    )


def write_page(evaluation: Evaluation, path: Path) -> None:
    """Write the page as one self-contained HTML file; the same evaluation always gives the same bytes.

    Raises:
        ReportError: it cannot be written.
    """
    write_page_file(render_page(evaluation), path, "Choose another --out.")


def render_page(evaluation: Evaluation) -> str:
    """The page as HTML text."""
    return (
        templates()
        .get_template("agreement.html.j2")
        .render(
            title=f"{Path(evaluation.estimate.source).name} – agreement",
            e=evaluation,
            version=__version__,
            rows=[_cells(row) for row in evaluation.rows],
            counts=[_describe_count(count) for count in evaluation.counts],
            clock=_describe_clocks(evaluation),
            feet=[(readable(foot), foot_color(foot)) for foot in sorted({pair.foot for pair in evaluation.pairs})],
            figures=trusted(agreement_figures(evaluation)),
            style=style(),
        )
    )
