"""The rows of a sweep: one a combination and case, and what all cases together say of each combination."""

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import pyarrow as pa

from fes.cohort.store import Measure, Store
from fes.cohort.task import DONE

RESULTS: Final = "results"
_TEXT, _NUMBER, _COUNT = pa.string(), pa.float64(), pa.int64()
_COUNTS: Final = (
    *("strides", "valid_strides", "four_phases", "marks", "missed", "extra", "off", "bursts", "swings_without"),
    *("bursts_without", "reached_after", "dragged", "stumbled", "roll_backs", "latched"),
)
_NUMBERS: Final = (
    *("stride_time_s", "stride_length_m", "error_ms", "error_p95_ms", "foot_off_error_ms", "contact_error_ms"),
    *("stride_length_rmse_m", "in_band", "in_band_later", "charge_uc"),
)
SCHEMAS: Final[Mapping[str, pa.Schema]] = {
    RESULTS: pa.schema(
        [
            *[(n, _TEXT) for n in ("result", "combination", "settings", "on", "status", "reason", "fes_version")],
            *[(name, _COUNT) for name in _COUNTS],
            *[(name, _NUMBER) for name in _NUMBERS],
        ]
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
_SUMS: Final = frozenset(_COUNTS) - {"reached_after"}


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
