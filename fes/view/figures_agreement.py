"""Figures of an agreement: Bland–Altman, estimate over reference, errors over time; inline SVG."""

from __future__ import annotations

import numpy as np

from fes.reference.compare import Pair
from fes.reference.evaluation import AgreementRow, Evaluation
from fes.signals import FloatArray
from fes.view.figures_gait import Figure, foot_color
from fes.view.findings import words
from fes.view.svg import Plot, padded

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
        f"{q.about[0].upper()}{q.about[1:]}. A slope would be a clock or a sensor that drifts.",
    )


def _values(row: AgreementRow, pairs: list[Pair]) -> tuple[FloatArray, FloatArray]:
    factor = row.about.factor
    return (
        factor * np.array([pair.reference for pair in pairs]),
        factor * np.array([pair.estimate for pair in pairs]),
    )


def _points(plot: Plot, pairs: list[Pair], x: FloatArray, y: FloatArray, unit: str, digits: int) -> None:
    for foot in sorted({pair.foot for pair in pairs}):
        mine = [k for k, pair in enumerate(pairs) if pair.foot == foot]
        titles = [f"{words(foot)}, {pairs[k].t_s:.2f} s: {y[k]:.{digits}f} {unit}" for k in mine]
        plot.points(x[mine], y[mine], foot_color(foot), titles)
