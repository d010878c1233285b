"""The rows of a sweep: one a combination and case, and what all cases together say of each combination."""

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import pyarrow as pa

from fes.cohort.store import Measure, Store, columns_of
from fes.cohort.sweep.grid import Axis, times_of
from fes.cohort.task import DONE
from fes.report.figures.svg import Figure, Plot, padded
from fes.report.html import rendered
from fes.signals import FloatArray

RESULTS: Final = "results"
_COUNTS: Final = columns_of(
    pa.int64(),
    "strides valid_strides four_phases marks missed extra off bursts swings_without bursts_without reached_after "
    "dragged stumbled roll_backs latched",
)
SCHEMAS: Final[Mapping[str, pa.Schema]] = {
    RESULTS: pa.schema(
        columns_of(pa.string(), "result combination settings on status reason fes_version")
        + _COUNTS
        + columns_of(pa.float64(), "stride_time_s stride_length_m error_ms error_p95_ms foot_off_error_ms")
        + columns_of(pa.float64(), "contact_error_ms stride_length_rmse_m in_band in_band_later charge_uc")
    )
}
AGAINST_TRUTH: Final = (
    Measure("wrong", "wrong transitions", "%", -1, 2, 100.0),
    Measure("error_ms", "error, median", "ms", -1),
    Measure("error_p95_ms", "error, 95 %", "ms"),
    Measure("missed", "missed", digits=0),
    Measure("extra", "extra", digits=0),
    Measure("off", "beyond tolerance", digits=0),
    Measure("foot_off_error_ms", "foot off", "ms"),
    Measure("contact_error_ms", "initial contact", "ms"),
    Measure("stride_length_rmse_m", "stride length, RMSE", "cm", factor=100.0),
)
BY_STRIDES: Final = (
    Measure("four_share", "strides through all four phases", "%", 1, 2, 100.0),
    Measure("valid_strides", "valid strides", best=1, digits=0),
    Measure("strides", "strides", digits=0),
    Measure("stride_time_s", "stride time", "s", digits=3),
    Measure("stride_length_m", "stride length", "m", digits=3),
)
BURSTS: Final = (
    Measure("bursts", "bursts", digits=0),
    Measure("swings_without", "swings without a burst", best=-1, digits=0),
    Measure("bursts_without", "bursts without a swing", best=-1, digits=0),
)
ON_PATIENTS: Final = (
    Measure("in_band", "strides in the band", "%", 1, 1, 100.0),
    Measure("charge_uc", "charge a stride", "µC", -1, 0),
    Measure("stumbled", "stumbles", best=-1, digits=0),
    Measure("dragged", "drags", digits=0),
    Measure("in_band_later", "in the band after 10 strides", "%", 0, 1, 100.0),
    Measure("reached_after", "strides until in the band", digits=0),
    Measure("roll_backs", "rolled back", digits=0),
    Measure("latched", "stopped by the gate", digits=0),
)
_SUMS: Final = frozenset(name for name, _ in _COUNTS) - {"reached_after"}


@dataclass(frozen=True, slots=True)
class Combination:
    """One combination over all its cases: how many are ``done`` and ``failed``, and the ``reasons``, each once.

    ``settings`` by name, empty for the session as it is; ``figures`` by measure's name, None where unknown;
    ``efficient``: no other one is at least as good in every measure that has a good end and better in one.
    """

    settings: dict[str, Any]
    figures: dict[str, float | None]
    done: int
    failed: int
    reasons: tuple[str, ...]
    efficient: bool = False

    @property
    def text(self) -> str:
        """The settings in a line."""
        return ", ".join(f"{name} = {value}" for name, value in self.settings.items()) or "as it is"


def sweep_store(url: str) -> Store:
    """A store for a sweep's rows."""
    return Store(url, SCHEMAS, RESULTS)


def measures_in(rows: Iterable[Mapping[str, Any]]) -> tuple[Measure, ...]:
    """What these rows are judged by, the most telling first.

    Where any case has a truth, or is a patient, that is what counts; strides are then only told.
    """
    found = {name for row in rows for name, value in row.items() if value is not None}
    groups = ((AGAINST_TRUTH, "marks"), (BURSTS, "swings_without"), (ON_PATIENTS, "in_band"))
    telling = [measure for group, sign in groups if sign in found for measure in group]
    by_strides = [replace(measure, best=0) for measure in BY_STRIDES] if telling else BY_STRIDES
    source = {"wrong": "marks", "four_share": "four_phases"}
    return tuple(measure for measure in (*telling, *by_strides) if source.get(measure.name, measure.name) in found)


def combinations(rows: Sequence[Mapping[str, Any]], measures: Sequence[Measure]) -> list[Combination]:
    """One a combination, the best first: by the first measure that has a good end, then the next.

    Counts are summed over cases, times and lengths are means over cases. A combination that failed anywhere comes last.
    """
    by: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        by[row["settings"]].append(row)
    found = []
    for settings, own in by.items():
        done = [row for row in own if row["status"] == DONE]
        reasons = dict.fromkeys(row["reason"] for row in own if row["status"] != DONE)
        figures = {measure.name: _figure(measure.name, done) for measure in measures}
        found.append(Combination(json.loads(settings), figures, len(done), len(own) - len(done), tuple(reasons)))
    judged = [m for m in measures if m.best]
    ordered = sorted(
        ((_goods(each, judged), each) for each in found),
        key=lambda item: (item[1].failed > 0, [-good for good in item[0]], len(item[1].settings)),
    )
    front: list[list[float]] = []  # in this order only what comes before can be better
    listed = []
    for goods, each in ordered:
        efficient = not each.failed and not any(_beats(other, goods) for other in front)
        if efficient:
            front.append(goods)
        listed.append(replace(each, efficient=efficient))
    return listed


def combination_table(found: Sequence[Combination], measures: Sequence[Measure]) -> pa.Table:
    """For a Parquet file: a row a combination, best first, with a column a setting (text where kinds differ)."""
    columns: dict[str, Any] = {}
    for name in dict.fromkeys(name for each in found for name in each.settings):
        values = [each.settings.get(name) for each in found]
        kinds = {type(value) for value in values if value is not None}
        numbers = kinds <= {int, float}
        plain = len(kinds) == 1 or numbers
        columns[name] = [v if v is None else float(v) if numbers else v if plain else str(v) for v in values]
    columns |= {m.name: [each.figures[m.name] for each in found] for m in measures}
    columns |= {name: [getattr(each, name) for each in found] for name in ("done", "failed", "efficient")}
    return pa.table(columns)


def _figure(name: str, rows: Sequence[Mapping[str, Any]]) -> float | None:
    if name == "wrong":
        return _share(rows, ("missed", "extra", "off"), "marks")
    if name == "four_share":
        return _share(rows, ("four_phases",), "strides")
    known = [row[name] for row in rows if row.get(name) is not None]
    return float(sum(known) if name in _SUMS else np.mean(known)) if known else None


def _share(rows: Sequence[Mapping[str, Any]], parts: Sequence[str], whole: str) -> float | None:
    of = sum(row[whole] or 0 for row in rows if row.get(whole) is not None)
    return sum(row[part] or 0 for row in rows for part in parts) / of if of else None


def _goods(one: Combination, judged: Sequence[Measure]) -> list[float]:
    """The judged figures, greater being better; an unknown one is the worst."""
    values = [(m.best, one.figures[m.name]) for m in judged]
    return [float("-inf") if value is None else best * value for best, value in values]


def _beats(one: Sequence[float], other: Sequence[float]) -> bool:
    pairs = list(zip(one, other, strict=True))
    return all(a >= b for a, b in pairs) and any(a > b for a, b in pairs)


# --- A sweep's page: the best combinations, their trade-off, what each setting does by itself, what failed ---


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
        figures=[*_trade_off(found, measures), *_by_setting(axes, found, measures)],
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
    times = [times for value in axis.values if (times := times_of(value)) is not None]
    if len(times) == len(axis.values):
        return np.array(times), f"{axis.name}, times what calibration gives"
    numbers = [value for value in axis.values if isinstance(value, (int, float)) and not isinstance(value, bool)]
    if len(numbers) == len(axis.values):
        return np.array(numbers, np.float64), axis.name
    return np.arange(len(axis.values), dtype=np.float64), ""
