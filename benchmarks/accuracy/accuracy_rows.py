"""The lines of the accuracy table, made from errors in the same way for us and every peer; its bars; and its tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
import numpy.typing as npt
from rich.table import Table

from benchmarks.lib.command_line import table_of

OURS = "fes"
CAUSAL, OFFLINE = "causal", "off-line"


@dataclass(frozen=True)
class Row:
    """One method on one quantity of one data set; all numbers in ``unit``, NaN where there is none.

    ``bias`` is the mean error, ``sd`` the spread about it, ``worst`` the greatest absolute error, ``recall`` the share
    (0–1) of what the reference holds that the method found. ``causal`` numbers are known at the latest when the stride
    (for an event: the event) is over. ``note`` says why a method has no numbers, or what the numbers do not show.
    """

    data_set: str
    quantity: str
    unit: str
    method: str
    known: str
    n: int = 0
    bias: float = float("nan")
    sd: float = float("nan")
    rmse: float = float("nan")
    worst: float = float("nan")
    recall: float = float("nan")
    bar: str = ""
    bar_met: bool | None = None
    note: str = ""

    @property
    def ours(self) -> bool:
        return self.method.startswith(OURS)


def row_of(
    data_set: str,
    quantity: str,
    unit: str,
    method: str,
    known: str,
    errors: npt.ArrayLike,
    recall: float = float("nan"),
) -> Row:
    """The row of errors (estimate − truth) in ``unit``; those that are not finite do not count."""
    e = np.asarray(errors, dtype=float).ravel()
    e = e[np.isfinite(e)]
    if len(e) == 0:
        return Row(data_set, quantity, unit, method, known, recall=recall, note="nothing found")
    sd = float(e.std(ddof=1)) if len(e) > 1 else float("nan")
    bias, rmse, worst = float(e.mean()), float(np.sqrt((e**2).mean())), float(np.abs(e).max())
    return Row(data_set, quantity, unit, method, known, len(e), bias, sd, rmse, worst, recall)


# --- bars: what each quantity should reach, for every method alike, with one default setting --------------------------

LENGTH_GIVEN, LENGTH_OWN = "stride length, reference borders", "stride length, own detection"
LIFT_GIVEN, LIFT_OWN = "sensor lift, reference borders", "sensor lift, own detection"
LIFT_ARM = "lift, own detection, marker's lever arm fitted"
BELT, BELT_OWN = "speed over belt, per foot", "speed over belt, per foot, own detection"
SHANK_BELT = "speed over belt, per shank"
PHASES = "four phases in order"
STRIKE = "foot-strike angle, mean of a run"
INCLINATION, PITCH = "inclination in motion, RMSE of a trial", "pitch of the foot, RMSE of a trial"
TOE, HEEL = "toe clearance, own detection", "heel clearance, own detection"
CLOSURE = "closure of a loop"
PATH = "path over the ground, RMS after fitting place and direction"


@dataclass(frozen=True)
class Bar:
    """A bar in words, and whether a row reaches it."""

    words: str
    reached: Callable[[Row], bool]


def _rmse(most: float, unit: str) -> Bar:
    return Bar(f"RMSE ≤ {most:g} {unit}", lambda row: row.rmse <= most)


def _time(sd_ms: int) -> Bar:
    words = f"|mean| ≤ 5, SD ≤ {sd_ms} ms, recall ≥ 99 %"
    return Bar(words, lambda row: abs(row.bias) <= 5 and row.sd <= sd_ms and row.recall >= 0.99)


_SPEED = Bar(
    "mean 99.7–100.3 %, SD ≤ 0.6, worst ≤ 1.5", lambda row: abs(row.bias) <= 0.3 and row.sd <= 0.6 and row.worst <= 1.5
)
_CLEARANCE = Bar("|mean| ≤ 0.3, SD ≤ 0.6 cm", lambda row: abs(row.bias) <= 0.3 and row.sd <= 0.6)

BARS: dict[tuple[str, str], Bar] = {
    ("gaitmap_walk", LENGTH_GIVEN): _rmse(1.5, "cm"),
    ("gaitmap_walk", LIFT_GIVEN): _rmse(0.35, "cm"),
    ("gaitmap_walk", LENGTH_OWN): Bar("RMSE ≤ 1.8 cm, all found", lambda row: row.rmse <= 1.8 and row.recall >= 1.0),
    ("gaitmap_walk", TOE): _CLEARANCE,
    ("gaitmap_walk", HEEL): _CLEARANCE,
    ("gaitmap_walk", "IC time"): _time(7),
    ("gaitmap_walk", "FO time"): _time(4),
    ("pyshoe_vicon", LENGTH_GIVEN): _rmse(1.5, "cm"),
    ("pyshoe_vicon", LENGTH_OWN): _rmse(1.5, "cm"),
    ("pyshoe_vicon", LIFT_ARM): Bar("SD ≤ 0.8 cm", lambda row: row.sd <= 0.8),
    ("ruler_walks", LENGTH_GIVEN): _rmse(1.7, "cm"),
    ("ruler_walks", LENGTH_OWN): _rmse(1.7, "cm"),
    ("stroke_treadmill", BELT): _SPEED,
    ("stroke_treadmill", BELT_OWN): _SPEED,
    ("stroke_treadmill", SHANK_BELT): Bar(
        "mean 98–102 %, worst ≤ 8", lambda row: abs(row.bias) <= 2.0 and row.worst <= 8.0
    ),
    ("broad", INCLINATION): _rmse(0.7, "°"),
}


def with_bar(row: Row) -> Row:
    """The row, judged where its quantity has a bar and nothing else has judged it."""
    bar = BARS.get((row.data_set, row.quantity))
    if bar is None or row.bar or row.n == 0:
        return row
    return replace(row, bar=bar.words, bar_met=bool(bar.reached(row)))


# --- the tables -------------------------------------------------------------------------------------------------------

HEAD = ("method", "known", "n", "bias", "SD", "RMSE", "worst", "recall", "met", "note")


def in_order(rows: list[Row]) -> list[Row]:
    """By data set and quantity, the least error first, what did not run last."""

    def key(row: Row) -> tuple[str, str, float, str]:
        size = next((size for size in (row.rmse, abs(row.bias)) if size == size), float("inf"))
        return row.data_set, row.quantity, size, row.method

    return sorted(rows, key=key)


def cells(row: Row) -> list[str]:
    """One row as text, under `HEAD`."""

    def number(value: float, sign: str = "") -> str:
        return "–" if value != value else f"{value:{sign}.2f}"

    recall = "–" if row.recall != row.recall else f"{100 * row.recall:.1f} %"
    met = "" if row.bar_met is None else ("yes" if row.bar_met else "no")
    errors = [number(row.bias, "+"), number(row.sd), number(row.rmse), number(row.worst)]
    return [row.method, row.known, str(row.n), *errors, recall, met, row.note]


def groups(rows: list[Row]) -> list[list[Row]]:
    """Rows of one quantity of one data set each, in the order they come."""
    return [list(group) for _, group in groupby(rows, lambda row: (row.data_set, row.quantity))]


def bar_of(group: list[Row]) -> str:
    """The bar of a quantity in words, empty where it has none."""
    return next((row.bar for row in group if row.bar), "")


def verdicts(rows: list[Row]) -> list[str]:
    """Of every bar, which of our methods meet it."""
    lines = []
    for group in groups(rows):
        judged = [row for row in group if row.ours and row.bar_met is not None]
        if judged:
            met = ", ".join(f"{row.method} ({row.known})" for row in judged if row.bar_met)
            verdict = f"met by {met}" if met else "NOT MET by any of our methods"
            lines.append(f"{group[0].data_set}, {group[0].quantity}: {bar_of(group)}: {verdict}")
    return lines


def tables(rows: list[Row]) -> list[Table]:
    """One for each quantity of each data set, our methods in bold."""
    found = []
    for group in groups(rows):
        bar = bar_of(group)
        title = f"{group[0].data_set}: {group[0].quantity} ({group[0].unit})" + (f"; bar: {bar}" if bar else "")
        texts = ([f"**{name}**" if row.ours else name, *others] for row in group for name, *others in [cells(row)])
        found.append(table_of(title, HEAD, texts))
    return found
