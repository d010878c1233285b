"""A sweep's page: the best combinations, their trade-off, what each setting does by itself, what failed."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from fes.cohort.store import Measure
from fes.cohort.sweep.grid import Axis, Factor
from fes.cohort.sweep.table import Combination
from fes.report.figures.svg import Figure, Plot, padded
from fes.report.html import rendered, trusted
from fes.signals import FloatArray

SHOWN: Final = 50  # combinations in the table, besides the efficient ones and the session as it is
FIGURES: Final = 8  # settings with a figure of their own
BEST, OTHER, AS_IS = "#0b6e4f", "#9aa5b1", "#c0392b"


def sweep_page(
    axes: Sequence[Axis], found: Sequence[Combination], measures: Sequence[Measure], cases: Sequence[str], name: str
) -> str:
    """The page as HTML text; ``name`` is the session's, ``cases`` what was tried on."""
    listed = [one for at, one in enumerate(found) if one.done and (at < SHOWN or one.efficient or not one.settings)]
    failed = [one for one in found if one.failed]
    return rendered(
        *("sweep.html.j2", "fes.cohort"),
        title=f"Sweep of {name}",
        axes=[(axis.name, ", ".join(map(str, axis.values))) for axis in axes],
        names=[axis.name for axis in axes],
        measures=measures,
        rows=listed,
        count=len(found),
        efficient=sum(one.efficient for one in found),
        failed=failed[:SHOWN],
        failures=len(failed),
        cases=cases,
        figures=trusted([*_trade_off(found, measures), *_by_setting(axes, found, measures)]),
        judged=[measure.title for measure in measures if measure.best],
    )


def _trade_off(found: Sequence[Combination], measures: Sequence[Measure]) -> list[Figure]:
    judged = [measure for measure in measures if measure.best][:2]
    if len(judged) < 2:
        return []
    x, y = judged
    points = [one for one in found if not one.failed and None not in (one.figures[x.name], one.figures[y.name])]
    if len(points) < 2:
        return []
    across, up = (np.array([m.factor * (one.figures[m.name] or 0.0) for one in points]) for m in (x, y))
    plot = Plot(f"{y.title} over {x.title}", x.axis, y.axis, padded([across]), padded([up]))
    kinds = np.array([AS_IS if not one.settings else BEST if one.efficient else OTHER for one in points])
    for colour in (OTHER, BEST, AS_IS):
        own = np.flatnonzero(kinds == colour)
        plot.points(across[own], up[own], colour, [points[at].text for at in own], hollow=colour == OTHER)
    caption = "Green: no other combination is at least as good in everything and better in something. Red: as it is."
    return [plot.figure("Trade-off", caption)]


def _by_setting(axes: Sequence[Axis], found: Sequence[Combination], measures: Sequence[Measure]) -> list[Figure]:
    judged = next((measure for measure in measures if measure.best), None)
    if judged is None:
        return []
    figures = []
    for axis in axes[:FIGURES]:
        labels = [str(value) for value in axis.values]
        known = [
            (labels.index(str(one.settings[axis.name])), judged.factor * value)
            for one in found
            if axis.name in one.settings and (value := one.figures[judged.name]) is not None
        ]
        if len(labels) < 2 or not known:
            continue
        at, across = _places(axis)
        x, y = at[[number for number, _ in known]], np.array([value for _, value in known])
        plot = Plot(f"{judged.title} by {axis.name}", across, judged.axis, padded([at]), padded([y]))
        caption = "Every combination."
        if across:
            order = np.argsort(at)
            middle = np.array([np.median(y[x == value]) if (x == value).any() else np.nan for value in at[order]])
            plot.line(at[order], middle, BEST, width=2.0)
            caption = "Every combination; the line joins the medians."
        else:
            for label, place in zip(labels, at, strict=True):
                plot.upright(float(place), OTHER, label)
        plot.points(x, y, OTHER, [f"{value:.{judged.digits}f}" for value in y], hollow=True)
        figures.append(plot.figure(axis.name, caption))
    return figures


def _places(axis: Axis) -> tuple[FloatArray, str]:
    """Where an axis's values lie, and its name; words lie side by side, under names of their own ("")."""
    times = [value.times for value in axis.values if isinstance(value, Factor)]
    if len(times) == len(axis.values):
        return np.array(times), f"{axis.name}, times what calibration gives"
    numbers = [value for value in axis.values if isinstance(value, (int, float)) and not isinstance(value, bool)]
    if len(numbers) == len(axis.values):
        return np.array(numbers, np.float64), axis.name
    return np.arange(len(axis.values), dtype=np.float64), ""
