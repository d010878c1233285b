"""What each quantity should reach, for every method alike: the project's bars, all with one default setting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from benchmarks.accuracy.accuracy_row import Row

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


_SPEED = Bar(
    "mean 99.7–100.3 %, SD ≤ 0.6, worst ≤ 1.5",
    lambda row: abs(row.bias) <= 0.3 and row.sd <= 0.6 and row.worst <= 1.5,
)
_CLEARANCE = Bar("|mean| ≤ 0.3, SD ≤ 0.6 cm", lambda row: abs(row.bias) <= 0.3 and row.sd <= 0.6)

BARS: dict[tuple[str, str], Bar] = {
    ("gaitmap_walk", LENGTH_GIVEN): _rmse(1.5, "cm"),
    ("gaitmap_walk", LIFT_GIVEN): _rmse(0.35, "cm"),
    ("gaitmap_walk", LENGTH_OWN): Bar("RMSE ≤ 1.8 cm, all found", lambda row: row.rmse <= 1.8 and row.recall >= 1.0),
    ("gaitmap_walk", TOE): _CLEARANCE,
    ("gaitmap_walk", HEEL): _CLEARANCE,
    ("gaitmap_walk", "IC time"): Bar(
        "|mean| ≤ 5, SD ≤ 7 ms, recall ≥ 99 %", lambda row: abs(row.bias) <= 5 and row.sd <= 7 and row.recall >= 0.99
    ),
    ("gaitmap_walk", "FO time"): Bar(
        "|mean| ≤ 5, SD ≤ 4 ms, recall ≥ 99 %", lambda row: abs(row.bias) <= 5 and row.sd <= 4 and row.recall >= 0.99
    ),
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
