"""How an estimate agrees with its reference: the terminal's table, JSON, and one HTML page with figures.

The figures are Bland–Altman's, the estimate over the reference, and the errors over time.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from fes.evaluation.agreement import Interval
from fes.evaluation.reference.compare import Count, Pair
from fes.evaluation.reference.evaluation import BOTH, AgreementRow, Evaluation
from fes.report.figures.strides import foot_color
from fes.report.figures.svg import Figure, Plot, padded
from fes.report.html import rendered
from fes.report.tables import small_table
from fes.report.text import capitalised, number, plain, readable
from fes.signals import FloatArray

GREY, LIMIT = "#5a636d", "#b3261e"


def agreement_figures(evaluation: Evaluation) -> list[Figure]:
    """For each quantity the errors over time; unless it is an instant, also over size, and both against each other."""
    figures = []
    for name in dict.fromkeys(row.quantity for row in evaluation.rows):
        row = [each for each in evaluation.rows if each.quantity == name][-1]  # both feet, where there are two
        pairs = [pair for pair in evaluation.pairs if pair.quantity == name]
        true, ours = row.about.factor * np.array([(pair.reference, pair.estimate) for pair in pairs]).T
        if not row.about.instant:
            figures += [_bland_altman(row, pairs, true, ours), _against(row, pairs, true, ours)]
        figures.append(_errors(row, pairs, ours - true))
    return figures


def _bland_altman(row: AgreementRow, pairs: list[Pair], true: FloatArray, ours: FloatArray) -> Figure:
    q, d = row.about, row.differences
    means, errors = 0.5 * (true + ours), ours - true
    levels = q.factor * np.array([d.bias.value, d.lower_limit.value, d.upper_limit.value])
    bands = q.factor * np.array(
        [[d.lower_limit.low, d.upper_limit.low, d.bias.low], [d.lower_limit.high, d.upper_limit.high, d.bias.high]]
    )
    y_label, y_range = f"estimate − reference, {q.unit}", padded([errors, levels, bands.ravel()], zero=True)
    plot = Plot(f"{q.label}: difference over mean", f"mean of both, {q.unit}", y_label, padded([means]), y_range)
    ends = np.array(plot.x_range)
    for low, high in bands.T:
        plot.band(ends, np.full(2, low), np.full(2, high), GREY, 0.15)
    _points(plot, row, pairs, means, errors)
    plot.level(float(levels[0]), GREY, dash="")
    for level in levels[1:]:
        plot.level(float(level), LIMIT)
    caption = (
        f"{d.n} pairs: bias {levels[0]:+.{q.digits}f} {q.unit}, 95 % limits of agreement {levels[1]:+.{q.digits}f} and "
        f"{levels[2]:+.{q.digits}f} {q.unit}; grey: their 95 % intervals."
    )
    return plot.figure(f"{q.label}: Bland–Altman", caption)


def _against(row: AgreementRow, pairs: list[Pair], true: FloatArray, ours: FloatArray) -> Figure:
    q = row.about
    reach = padded([true, ours])
    plot = Plot(f"{q.label}: estimate over reference", f"reference, {q.unit}", f"estimate, {q.unit}", reach, reach)
    ends = np.array(reach)
    plot.line(ends, ends, GREY, dash="4 4")
    _points(plot, row, pairs, true, ours)
    slope, intercept = row.line.slope.value, q.factor * row.line.intercept.value
    caption = "Dashed: equal."
    if np.isfinite(slope):
        span = np.array([true.min(), true.max()])
        plot.line(span, intercept + slope * span, LIMIT)
        caption += (
            f" Red: least squares, slope {slope:.2f}, intercept {intercept:+.{q.digits}f} {q.unit}, r {row.line.r:.3f}."
        )
    return plot.figure(f"{q.label}: one over the other", caption)


def _errors(row: AgreementRow, pairs: list[Pair], errors: FloatArray) -> Figure:
    q, times = row.about, np.array([pair.t_s for pair in pairs])
    y_label, y_range = f"estimate − reference, {q.unit}", padded([errors], zero=True)
    plot = Plot(f"{q.label}: error over time", "time, s", y_label, padded([times]), y_range)
    plot.level(0.0, GREY, dash="")
    _points(plot, row, pairs, times, errors)
    drift = "A slope would be a clock or a sensor that drifts."
    return plot.figure(f"{q.label}: errors", f"{capitalised(q.about)}. {drift}")


def _points(plot: Plot, row: AgreementRow, pairs: list[Pair], x: FloatArray, y: FloatArray) -> None:
    digits, unit = row.about.digits, row.about.unit
    for foot in sorted({pair.foot for pair in pairs}):
        mine = [k for k, pair in enumerate(pairs) if pair.foot == foot]
        titles = [f"{readable(foot)}, {pairs[k].t_s:.2f} s: {y[k]:.{digits}f} {unit}" for k in mine]
        plot.points(x[mine], y[mine], foot_color(foot), titles)


def agreement_json(evaluation: Evaluation) -> dict[str, Any]:
    """Everything in SI, with the pairs; what is not known is null."""
    lag = evaluation.synchrony
    values = {
        "recording": evaluation.estimate.source,
        "estimate": evaluation.estimate.how,
        "reference": list(evaluation.sources),
        "clock": {"applied_lag_s": lag.applied_s, "found_by": lag.by, "found": lag.found},
        "counts": evaluation.counts,
        "agreement": evaluation.rows,
    }
    names = ("notes", "warnings", "pairs")
    return dict(plain(values | {name: getattr(evaluation, name) for name in names}))


def agreement_rows(evaluation: Evaluation) -> list[dict[str, Any]]:
    """A flat row for each quantity and foot, SI: bias and 95 % limits of estimate minus reference, ICC(2,1)."""
    return [
        {"quantity": row.quantity, "foot": row.foot, "n": row.differences.n}
        | {"reference_mean": row.reference_mean, "estimate_mean": row.estimate_mean}
        | {name: getattr(row.differences, name).value for name in ("bias", "lower_limit", "upper_limit")}
        | {"icc": row.icc.value}
        for row in evaluation.rows
    ]


def pair_rows(evaluation: Evaluation) -> list[dict[str, Any]]:
    """A flat row for each pair, SI."""
    return [asdict(pair) | {"error": pair.estimate - pair.reference} for pair in evaluation.pairs]


def agreement_text(evaluation: Evaluation) -> RenderableType:
    """Two tables, at most 100 columns wide, and what was assumed."""
    legend = "± after the bias: half its 95 % interval. LoA: 95 % limits of agreement. ICC(2,1), 95 % interval."
    numbers = ("n", "bias", "SD", "RMSE", "LoA", "ICC", "slope")
    table = small_table("Agreement: estimate − reference", legend, ["quantity", "foot", "unit"], numbers, (0, 1, 0, 0))
    names = ("label", "foot", "unit", "n", "bias", "sd", "rmse", "limits", "icc", "slope")
    for cells in map(_cells, evaluation.rows):
        table.add_row(*(cells[name] for name in names))
    told = (*map(_describe_count, evaluation.counts), _describe_clocks(evaluation), *evaluation.notes)
    lines = [Text(line) for line in told]
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
        known = f"{number(value.value, 2)} ({number(value.low, 2)}…{number(value.high, 2)})"
        return known if np.isfinite(value.value) else "–"

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
    good = f"correlation {found.likeness:.3f}, next best {number(found.next_best, 3)}"
    rest = f"residual {100 * found.residual:.0f} %, later half {number(1e3 * found.halves_s, 0)} ms apart"
    return f"Clocks: {lag.applied_s:+.3f} s applied; by {lag.by} {found.lag_s:+.3f} s ({good}, {rest})"


def render_page(evaluation: Evaluation) -> str:
    """The page as one self-contained HTML text; the same evaluation always gives the same bytes."""
    return rendered(
        "agreement.html.j2",
        title=f"{Path(evaluation.estimate.source).name} – agreement",
        e=evaluation,
        rows=[_cells(row) for row in evaluation.rows],
        counts=[_describe_count(count) for count in evaluation.counts],
        clock=_describe_clocks(evaluation),
        feet=[(readable(foot), foot_color(foot)) for foot in sorted({pair.foot for pair in evaluation.pairs})],
        figures=agreement_figures(evaluation),
    )
