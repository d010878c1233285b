"""How an estimate agrees with its reference: the console's table, plain JSON, and one HTML page with figures."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from fes import __version__
from fes.agreement import Interval
from fes.reference.evaluation import BOTH, AgreementRow, Evaluation
from fes.view.figures_agreement import agreement_figures
from fes.view.figures_gait import foot_color
from fes.view.findings import words
from fes.view.jsonable import plain
from fes.view.page_file import write_page_file
from fes.view.tables import number


def agreement_json(evaluation: Evaluation) -> dict[str, Any]:
    """Everything in SI, with the pairs; what is not known is null."""
    lag = evaluation.synchrony
    told: dict[str, Any] = plain(
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
    return told


def pair_rows(evaluation: Evaluation) -> list[dict[str, Any]]:
    """A flat row for each pair, SI."""
    return [
        {
            "quantity": pair.quantity,
            "foot": pair.foot,
            "t_s": pair.t_s,
            "reference": pair.reference,
            "estimate": pair.estimate,
            "error": pair.estimate - pair.reference,
        }
        for pair in evaluation.pairs
    ]


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
    for row in evaluation.rows:
        c = cells(row)
        names = ("n", "bias", "sd", "rmse", "limits", "icc", "slope")
        table.add_row(c["label"], c["foot"], c["unit"], *(c[name] for name in names))
    lines = [Text(count_words(evaluation, k)) for k in range(len(evaluation.counts))]
    lines += [Text(clock_words(evaluation))]
    lines += [Text(note) for note in evaluation.notes]
    lines += [Text(f"! {warning}", style="yellow") for warning in evaluation.warnings]
    return Group(table, *lines)


def cells(row: AgreementRow) -> dict[str, str]:
    """One row as people read it."""
    q, d = row.about, row.differences
    half = q.factor * 0.5 * (d.bias.high - d.bias.low)

    def shown(value: float, sign: str = "") -> str:
        scaled = q.factor * value
        return f"{round(scaled, q.digits) + 0.0:{sign}.{q.digits}f}" if np.isfinite(scaled) else "–"

    def between(interval: Interval) -> str:
        return f"{shown(interval.low, '+')} … {shown(interval.high, '+')}"

    return {
        "label": q.label,
        "foot": row.foot if row.foot == BOTH else words(row.foot).removesuffix(" foot"),
        "unit": q.unit,
        "n": str(d.n),
        "reference": shown(row.reference_mean),
        "bias": f"{shown(d.bias.value, '+')} ± {number(half, q.digits)}",
        "sd": shown(d.sd),
        "rmse": shown(d.rmse),
        "worst": shown(d.worst),
        "limits": f"{shown(d.lower_limit.value, '+')} … {shown(d.upper_limit.value, '+')}",
        "lower": between(d.lower_limit),
        "upper": between(d.upper_limit),
        "icc": f"{number(row.icc.value, 2)} ({number(row.icc.low, 2)}…{number(row.icc.high, 2)})"
        if np.isfinite(row.icc.value)
        else "–",
        "slope": number(row.line.slope.value, 2),
        "intercept": shown(row.line.intercept.value, "+"),
        "r": number(row.line.r, 3),
        "trend": f"{number(row.line.trend.value, 2)} ({number(row.line.trend.low, 2)}…{number(row.line.trend.high, 2)})"
        if np.isfinite(row.line.trend.value)
        else "–",
        "about": q.about,
    }


def count_words(evaluation: Evaluation, k: int) -> str:
    """One count in words."""
    c = evaluation.counts[k]
    text = f"{c.what}, {words(c.foot)}: {c.expected} expected, {c.missed} missed, {c.extra} extra"
    return text + (f"; {c.left_out} left out, for one side cannot be relied on there" if c.left_out else "")


def clock_words(evaluation: Evaluation) -> str:
    """What became of the clocks, in words."""
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
        _environment()
        .get_template("agreement.html.j2")
        .render(
            title=f"{Path(evaluation.estimate.source).name} – agreement",
            e=evaluation,
            version=__version__,
            rows=[cells(row) for row in evaluation.rows],
            counts=[count_words(evaluation, k) for k in range(len(evaluation.counts))],
            clock=clock_words(evaluation),
            feet=[(words(foot), foot_color(foot)) for foot in sorted({pair.foot for pair in evaluation.pairs})],
            figures=[
                {"title": figure.title, "svg": Markup(figure.svg), "caption": figure.caption}
                for figure in agreement_figures(evaluation)
            ],
            style=Markup(_style()),
        )
    )


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("fes.view"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


@cache
def _style() -> str:
    return files("fes.view").joinpath("static", "report.css").read_text(encoding="utf-8")
