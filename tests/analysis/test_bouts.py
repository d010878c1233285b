"""Bouts, turns, stairs and slopes: by hand-made strides, on a virtual day with truth, on measured walks."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import fes
from benchmarks.lib.real_sets import data_folder
from fes.analysis.bouts import LENGTHS_S, Bout, Stride, bout_tables, bouts_of, kept_of
from fes.cli import main
from fes.signals import StrideResult
from tests.analysis.virtual_day import TrueDay, write_day


def strides(count: int, begin_s: float = 0.0, turn_deg: float = 0.0, rise_m: float = 0.0) -> list[Stride]:
    """Of both feet by turns, a second and 1.2 m each."""
    feet = ("left_foot", "right_foot")
    turn = math.radians(turn_deg)
    starts = [begin_s + 0.5 * k for k in range(count)]
    return [Stride(feet[k % 2], t, t + 1.0, t + 0.4, t + 0.8, 1.2, rise_m, turn, True) for k, t in enumerate(starts)]


def test_a_break_of_more_than_three_seconds_ends_a_bout() -> None:
    first = strides(6)
    end = first[-1].contact_s
    assert [len(bout.strides) for bout in bouts_of(first + strides(6, end + 2.5))] == [12]
    assert [len(bout.strides) for bout in bouts_of(first + strides(6, end + 2.7))] == [6, 6]


@pytest.mark.parametrize("gap_s", [10.0, 600.0, 90_000.0])
def test_nothing_is_told_of_a_gap(gap_s: float) -> None:
    rows = bout_tables(bouts_of(strides(20) + strides(20, 10.0 + gap_s)))
    assert [row["duration_s"] for row in rows["bouts"]] == pytest.approx([9.9, 9.9])
    assert [row["distance_m"] for row in rows["bouts"]] == pytest.approx([12.0, 12.0])
    assert [row["stride_time_s"] for row in rows["bouts"]] == pytest.approx([1.0, 1.0])
    every = rows["bouts_by_length"][0]
    assert every["duration_s_sum"] == pytest.approx(19.8)
    assert every["speed_mps_mean"] == pytest.approx(1.2)


def test_one_foot_that_moves_alone_is_no_walking() -> None:
    alone = [stride for stride in strides(40, 100.0) if stride.foot == "left_foot"]
    assert [len(bout.strides) for bout in bouts_of(strides(8) + alone)] == [8]
    assert not bouts_of(strides(3))


def test_pedals_never_rest() -> None:
    turning = [Stride(s.foot, s.begin_s, s.end_s, s.off_s, s.contact_s, 1.2, 0.0, 0.0, False) for s in strides(40)]
    assert not bouts_of(turning)


def test_what_is_no_stride_of_a_walk_is_not_kept() -> None:
    def result(length_m: float, rise_m: float, valid: bool = True) -> StrideResult:
        return StrideResult("left_foot", 1, 0, 1_000_000_000, length_m, free_rise_m=rise_m, valid=valid)

    assert not kept_of([result(0.05, 0.0), result(1.2, 0.8), result(1.2, 0.0, valid=False)])
    assert len(kept_of([result(1.2, 0.0), result(1.2, math.nan)])) == 2


def test_a_turn_has_its_angle_and_its_duration() -> None:
    parts = strides(10), strides(5, 5.0, turn_deg=36.0), strides(10, 7.5)
    (turn,) = Bout(tuple(chain(*parts))).turns()
    assert math.degrees(turn.angle_rad) == pytest.approx(90.0, abs=1.0)  # each stride of a foot, mean of both feet
    assert 2.0 <= turn.end_s - turn.begin_s <= 3.5


def test_stairs_and_slopes_are_told_apart() -> None:
    parts = [(10, 0.0), (6, 0.34), (10, 0.0), (8, -0.1), (10, 0.0), (6, -0.34)]
    made, begin = list[Stride](), 0.0
    for count, rise_m in parts:
        made += strides(count, begin, rise_m=rise_m)
        begin += 0.5 * count
    found = [(stretch.terrain, stretch.strides) for stretch in Bout(tuple(made)).terrain()]
    names = ["level", "stairs_up", "level", "slope_down", "level", "stairs_down"]
    assert [name for name, _ in found] == names
    assert [count for _, count in found] == pytest.approx([count for count, _ in parts], abs=1)


def test_bouts_are_counted_by_their_length() -> None:
    made = strides(10) + strides(50, 100.0) + strides(150, 200.0)
    counts = {row["length"]: row["bouts"] for row in bout_tables(bouts_of(made))["bouts_by_length"]}
    assert counts == dict(zip(LENGTHS_S, (3, 1, 2, 1, 1), strict=True))


Rows = list[dict[str, str]]
TERRAIN = {kind: f"stairs_{kind}" for kind in ("up", "down")}
RELAXED_S = 1.5  # about a change of terrain a stride is on both


@dataclass(frozen=True)
class Score:
    true_bouts: int
    bouts: int
    recall: float
    precision: float
    true_turns: int
    turns: int
    missed_turns: int
    turn_errors_rad: np.ndarray
    terrain_right: float
    stray_strides: int  # whose middle lies in nothing that is walking


def rows_of(folder: Path, name: str) -> Rows:
    with (folder / f"{name}.csv").open() as file:
        return list(csv.DictReader(file))


def score(truth: TrueDay, folder: Path) -> Score:
    """Of the tables that the command wrote."""
    found = spans(rows_of(folder, "bouts"))
    true = [(bout.begin_s, bout.end_s) for bout in truth.bouts]
    turns = [(*span, float(row["angle_rad"])) for row, span in with_spans(rows_of(folder, "turns"))]
    errors, missed = [], 0
    true_turns = [turn for bout in truth.bouts for turn in bout.turns]
    for turn in true_turns:
        near = max(turns, key=lambda one: overlap(one, (turn.begin_s, turn.end_s)), default=(0.0, 0.0, 0.0))
        if overlap(near, (turn.begin_s, turn.end_s)) > 0.0:
            errors.append(near[2] - turn.angle_rad)
        else:
            missed += 1
    stretches = [(span, row["terrain"]) for row, span in with_spans(rows_of(folder, "terrain"))]
    right = []
    for bout in truth.bouts:
        for begin, end, kind in bout.terrain:
            for t in np.arange(begin + RELAXED_S, end - RELAXED_S, 0.5):
                right += [name == TERRAIN.get(kind, kind) for span, name in stretches if span[0] <= t <= span[1]][:1]
    middles = [0.5 * (float(row["t_start_s"]) + float(row["t_end_s"])) for row in rows_of(folder, "strides")]
    stray = sum(not any(begin - 1.0 <= t <= end + 1.0 for begin, end in true) for t in middles)
    return Score(
        len(true),
        len(found),
        share(covered(one, found) for one in true),
        share(covered(one, true) for one in found),
        len(true_turns),
        len(turns),
        missed,
        np.array(errors),
        share(right),
        stray,
    )


def spans(rows: Rows) -> list[tuple[float, float]]:
    return [span for _, span in with_spans(rows)]


def with_spans(rows: Rows) -> list[tuple[dict[str, str], tuple[float, float]]]:
    return [(row, (float(row["begin_s"]), float(row["end_s"]))) for row in rows]


def overlap(one: tuple[float, ...], other: tuple[float, float]) -> float:
    return max(0.0, min(one[1], other[1]) - max(one[0], other[0]))


def covered(one: tuple[float, float], others: Iterable[tuple[float, float]]) -> bool:
    return any(overlap(one, other) > 0.5 * (one[1] - one[0]) for other in others)


def share(values: Iterable[bool]) -> float:
    listed = list(values)
    return sum(listed) / len(listed) if listed else float("nan")


def analysed(path: Path, folder: Path) -> Path:
    done = CliRunner().invoke(main, ["analyse", str(path), "--bouts", "--no-report", "--out", str(folder)])
    assert done.exit_code == 0, done.output
    (made,) = folder.iterdir()
    return made


@pytest.mark.slow
def test_a_virtual_day(tmp_path: Path) -> None:
    truth = write_day(tmp_path / "day.parquet", hours=4.0, seed=11)
    found = score(truth, analysed(tmp_path / "day.parquet", tmp_path / "out"))
    assert found.true_bouts >= 10
    assert found.true_turns >= 5
    assert found.recall >= 0.95
    assert found.precision >= 0.95
    assert found.missed_turns == 0
    assert np.degrees(np.abs(found.turn_errors_rad)).max() <= 10.0
    assert found.terrain_right >= 0.95
    assert found.stray_strides == 0


@pytest.mark.slow
def test_two_hours_of_no_walking_yield_no_stride(tmp_path: Path) -> None:
    kinds = {"sitting": 1500, "fidgeting": 1200, "standing": 1200, "cycling": 1200, "driving": 1200, "lying": 900}
    activities = [("walking", 40.0), ("standing", 10.0), *((kind, float(lasts)) for kind, lasts in kinds.items())]
    truth = write_day(tmp_path / "day.parquet", seed=2, activities=activities)
    folder = analysed(tmp_path / "day.parquet", tmp_path / "out")
    (walk,) = truth.bouts
    assert sum(kinds.values()) == 7200
    every = rows_of(folder, "strides")
    assert len(every) >= 60
    assert max(float(row["t_end_s"]) for row in every) <= walk.end_s + 1.0
    assert len(rows_of(folder, "bouts")) == 1


@pytest.mark.data
@pytest.mark.slow
def test_stairs_and_turns_of_measured_walks(tmp_path: Path) -> None:
    data = data_folder()
    if not (data / "gaitmap_walk").is_dir() or not (data / "xio_walk").is_dir():
        pytest.skip(f"no gaitmap_walk, ruler_walks and xio_walk in {data}")
    runner = CliRunner()
    for name, folder in (("gaitmap", "gaitmap_walk"), ("ruler", "ruler_walks"), ("xio", "xio_walk")):
        done = runner.invoke(main, ["import", name, str(data / folder), "--out", str(tmp_path / name)])
        assert done.exit_code == 0, done.output

    def bouts(name: str, stem: str) -> list[Bout]:
        (path,) = (tmp_path / name).rglob(f"*{stem}.parquet")
        return bouts_of(kept_of(fes.analyse(path).analysis().strides))

    (stairs,) = bouts("gaitmap", "stair_up")
    up = [stretch for stretch in stairs.terrain() if stretch.terrain == "stairs_up"]
    assert sum(stretch.strides for stretch in up) >= 20
    assert not [stretch for stretch in stairs.terrain() if stretch.terrain == "stairs_down"]
    (ruler,) = bouts("ruler", "ruler_31")  # to and fro along a corridor
    assert [abs(math.degrees(turn.angle_rad)) for turn in ruler.turns()] == pytest.approx([180.0] * 3, abs=15.0)
    (loop,) = bouts("xio", "short_walk")  # comes back to where it began
    assert len(loop.turns()) >= 3
