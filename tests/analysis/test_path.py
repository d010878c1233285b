"""The path over the ground: squares and stairs with exact truth, recordings, tables and figures."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from test_zupt import STRIDE_M, walk

from fes.analysis.ground_path import (
    GroundPath,
    _pointing_ahead,
    _without_false_turns,
    ground_path,
    without_relative_drift,
)
from fes.analysis.pipeline import analyse, calibrations_of
from fes.analysis.tables import Table
from fes.calibration.recording import calibrate_track
from fes.cli.main import main
from fes.config import Ground
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.sensor_choice import Calibration
from fes.estimation.strides.schema import TABLE, Column
from fes.estimation.zupt import foot_trajectory
from fes.estimation.zupt.decimation import ZuptSettings
from fes.recording import Recording, Track, read_recording
from fes.report.figures.strides import same_scale
from fes.signals import G_MPS2, FloatArray
from fes.simulation.truth import load_truth

TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"
DATA = Path(os.environ.get("FES_DATA") or TRIALS.parents[1] / "shared" / "data")
RATE_HZ = 200.0
LEG_STRIDES = 5


def track_of(acc: FloatArray, gyr: FloatArray, sensor: str = "right_foot", rate_hz: float = RATE_HZ) -> Track:
    t_ns = np.round(np.arange(len(acc)) * 1e9 / rate_hz).astype(np.int64)
    return Track(sensor, rate_hz, t_ns, t_ns, np.ascontiguousarray(acc), np.ascontiguousarray(gyr))


def gaitmap_tracks(name: str) -> dict[str, Track]:
    with (DATA / "gaitmap_walk" / name).open() as file:
        names = list(zip(*(file.readline().strip().split(",") for _ in range(2)), strict=True))
        values = np.genfromtxt(file, delimiter=",")
    tracks = {}
    for side in ("left", "right"):
        acc, gyr = (
            np.column_stack([values[:, names.index((f"{side}_sensor", f"{kind}_{axis}"))] for axis in "xyz"])
            for kind in ("acc", "gyr")
        )
        tracks[f"{side}_foot"] = track_of(acc, np.radians(gyr), f"{side}_foot", 204.8)
    return tracks


def calibrated(recording: Recording, *, incline: float = 0.0) -> tuple[Recording, dict[str, Calibration]]:
    labelled, found = calibrations_of(recording, incline=incline)
    assert found.missing == {}
    return labelled, found.calibrations


def polygon(corners: int, turn_rad: float, *, rise_m: float = 0.0) -> Track:
    """Legs of exact strides, and turns on the spot between them, to the left positive."""
    n = round(1.5 * RATE_HZ)
    u = (np.arange(n) + 0.5) / n
    rate = turn_rad / 1.5 * (1.0 - np.cos(2.0 * math.pi * u))
    turning = np.column_stack((np.zeros((n, 2)), rate))
    acc, gyr = [], []
    for _ in range(corners):
        _, a, w, _, _ = walk(RATE_HZ, LEG_STRIDES, rise_m=rise_m)
        acc += [a, np.tile([0.0, 0.0, G_MPS2], (n, 1))]
        gyr += [w, turning]
    return track_of(np.concatenate(acc), np.concatenate(gyr))


@pytest.fixture(scope="module")
def square() -> Track:
    return polygon(4, math.pi / 2)


@pytest.fixture(scope="module")
def calibration(square: Track) -> FootCalibration:
    return calibrate_track(square)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_square_ends_where_it_began(side: float) -> None:
    track = polygon(4, side * math.pi / 2)
    path = ground_path(track, calibrate_track(track))
    leg_m = LEG_STRIDES * STRIDE_M
    assert path.distance_m == pytest.approx(4 * leg_m, abs=0.2)
    assert path.closure_m < 0.15
    assert path.heading_rad[-1] == pytest.approx(side * 2.0 * math.pi, abs=0.03)
    leg_ns = int(track.t_ns[-1] / 4)
    corners = path.places_at(np.array([leg_ns, 2 * leg_ns, 3 * leg_ns]))[:, :2]
    assert corners == pytest.approx(np.array([[leg_m, 0.0], [leg_m, side * leg_m], [0.0, side * leg_m]]), abs=0.15)


def test_cutting_a_long_recording_changes_little(monkeypatch: pytest.MonkeyPatch, square, calibration) -> None:
    whole = ground_path(square, calibration)
    monkeypatch.setattr(foot_trajectory, "STRETCH_S", 8.0)
    monkeypatch.setattr(foot_trajectory, "SEARCH_S", 3.0)
    calls = []
    inner = foot_trajectory.gather_intervals
    monkeypatch.setattr(foot_trajectory, "gather_intervals", lambda *a, **b: calls.append(len(a[0])) or inner(*a, **b))
    cut = ground_path(square, calibration)
    assert len(calls) >= 3
    assert max(calls) < 12 * RATE_HZ
    assert np.abs(cut.position_m - whole.position_m).max() < 0.1
    assert np.abs(cut.heading_rad - whole.heading_rad).max() < 0.02


def test_stairs_rise_and_level_ground_does_not() -> None:
    track = polygon(2, math.pi, rise_m=0.17)
    calibration = calibrate_track(track)
    climbed = 2 * LEG_STRIDES * 0.17
    assert ground_path(track, calibration, level=False).height_gained_m == pytest.approx(climbed, abs=0.08)
    assert abs(ground_path(track, calibration, level=True).height_gained_m) < 0.1 * climbed
    recording = Recording("stairs", None, {"right_foot": track})
    up = analyse(*calibrated(recording, incline=math.nan), ground=Ground(free=True))
    gained = [s.height_gained_m for s in up.strides if s.valid]
    assert len(gained) >= 2 * LEG_STRIDES - 3
    assert np.median(gained) == pytest.approx(0.17, abs=0.02)
    assert up.walk_record().header["ground"]["level"] is False


def test_the_way_is_that_of_the_simulated_walker() -> None:
    recording = read_recording(TRIALS / "both_feet_200hz.parquet")
    truth = load_truth(TRIALS / "both_feet_200hz.parquet")
    result = analyse(*calibrated(recording))
    assert set(result.paths) == {"left_foot", "right_foot"}
    for foot, path in result.paths.items():
        true_m = sum(stride.stride_length_m for stride in truth.strides_of(foot))
        assert path.distance_m == pytest.approx(true_m, rel=0.03)
        assert abs(path.height_gained_m) < 0.05
    rows = [row for row in result.stride_table().rows() if row["valid"]]
    for foot in result.paths:
        own = [row for row in rows if row["foot"] == foot]
        steps = np.hypot(np.diff([r["x_m"] for r in own]), np.diff([r["y_m"] for r in own]))
        lengths = np.array([row["stride_length_m"] for row in own[1:]])
        assert np.median(np.abs(steps - lengths)) < 0.02
    table = result.path_table().rows()
    assert len(table) == sum(len(path.at_rate()[0]) for path in result.paths.values())
    seconds = np.array([row["t_s"] for row in table if row["foot"] == "left_foot"])
    assert np.diff(seconds) == pytest.approx(np.full(len(seconds) - 1, 0.1), abs=1e-6)


def drifting(track: Track, rate_radps: float, sensor: str) -> Track:
    """The same foot with a gyroscope that errs about the vertical while it moves."""
    gyr = track.gyr_radps.copy()
    moving = np.linalg.norm(gyr, axis=1) > 0.3
    # about the world's vertical, seen from a foot that only pitches: through the pitch so far
    pitch = np.cumsum(track.gyr_radps[:, 1]) / RATE_HZ
    gyr[:, 0] -= rate_radps * np.sin(pitch) * moving
    gyr[:, 2] += rate_radps * np.cos(pitch) * moving
    return track_of(track.acc_mps2, gyr, sensor)


def test_two_feet_correct_the_drift_that_they_do_not_share() -> None:
    straight = polygon(4, 0.0)
    feet = [drifting(straight, 0.08, "left_foot"), drifting(straight, -0.12, "right_foot")]
    alone = [ground_path(track, calibrate_track(track)) for track in feet]
    bent = [abs(path.heading_rad[-1] - path.heading_rad[0]) for path in alone]
    assert min(bent) > 0.15
    left, right = without_relative_drift(*alone)
    common = [path.heading_rad[-1] - path.heading_rad[0] for path in (left, right)]
    assert common[0] == pytest.approx(common[1], abs=0.02)  # what is left they share: half of their sum
    assert abs(common[0]) < 0.5 * min(bent)
    for path in (left, right):
        assert path.closure_m == pytest.approx(4 * LEG_STRIDES * STRIDE_M, rel=0.01)
    few = [replace(path, stance_ns=path.stance_ns[:5]) for path in alone]
    assert np.allclose(without_relative_drift(*few)[0].position_m, alone[0].position_m, atol=1e-9)


def test_a_true_turn_is_no_drift(square: Track, calibration: FootCalibration) -> None:
    left = replace(ground_path(square, calibration), foot="left_foot")
    right = ground_path(square, calibration)
    for path in without_relative_drift(left, right):
        assert np.abs(path.position_m - right.position_m).max() < 1e-9


@pytest.mark.data
def test_a_real_walk_to_and_fro_ends_where_markers_say() -> None:
    """Both feet end 0.13 m from where they began; each foot's heading alone errs by 3 m there."""
    if not (DATA / "gaitmap_walk" / "imu_sample.csv").is_file():
        pytest.skip(f"no gaitmap_walk in {DATA}")
    result = analyse(*calibrated(Recording("walk", None, gaitmap_tracks("imu_sample.csv"))))
    for path in result.paths.values():
        assert 39.0 < path.distance_m < 43.0
        assert path.closure_m < 0.6


@pytest.mark.parametrize(("samples", "said"), [(2, "2 samples make no path"), (900, "never rests")])
def test_what_makes_no_path_says_why(samples: int, said: str, calibration) -> None:
    rng = np.random.default_rng(3)
    shaken = track_of(rng.normal(0.0, 40.0, (samples, 3)), rng.normal(0.0, 8.0, (samples, 3)))
    with pytest.raises(ValueError, match="right_foot") as caught:
        ground_path(shaken, calibration)
    assert said in str(caught.value)


def test_a_foot_without_a_path_is_told_and_costs_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_args: object, **_more: object) -> GroundPath:
        raise ValueError("no rest")

    monkeypatch.setattr("fes.analysis.pipeline.ground_path", fail)
    recording = read_recording(TRIALS / "example_csv.csv")
    result = analyse(*calibrated(recording))
    assert result.no_path == {"right_foot": "right_foot: no rest"}
    assert result.path_table().rows() == []
    assert all(math.isnan(row["x_m"]) for row in result.stride_table().rows())
    assert len(result.strides) >= 4


def test_a_path_of_no_numbers_is_none_and_spares_the_other_foots(monkeypatch: pytest.MonkeyPatch) -> None:
    """What two feet do not share is taken off both, so that one without numbers would leave the other without any."""
    recording, calibrations = calibrated(read_recording(TRIALS / "both_feet_100hz.parquet"))
    alone = analyse(replace(recording, tracks={"right_foot": recording.tracks["right_foot"]}), calibrations)
    left, way = recording.tracks["left_foot"], foot_trajectory.FootSamples.trajectory

    def broken(foot: foot_trajectory.FootSamples, settings: ZuptSettings, *, level: bool) -> foot_trajectory.Trajectory:
        found = way(foot, settings, level=level)
        if np.array_equal(foot.acc_mps2, left.acc_mps2):
            found.position_m[-3:] = math.nan
        return found

    monkeypatch.setattr(foot_trajectory.FootSamples, "trajectory", broken)
    result = analyse(recording, calibrations)
    assert result.no_path == {"left_foot": "left_foot: the path comes out as no number; check the units"}
    assert np.array_equal(result.paths["right_foot"].position_m, alone.paths["right_foot"].position_m)


def test_a_metre_is_a_metre_both_ways() -> None:
    for x, y in (((0.0, 10.0), (0.0, 1.0)), ((0.0, 1.0), (0.0, 30.0)), ((-2.0, 2.0), (-1.0, 2.0))):
        (x0, x1), (y0, y1), height = same_scale(x, y)
        across, tall = 560 - 58 - 14, height - 12 - 46
        assert across / (x1 - x0) == pytest.approx(tall / (y1 - y0), rel=0.02)
        assert x0 <= x[0] < x[1] <= x1
        assert y0 <= y[0] < y[1] <= y1


def test_the_command_writes_the_path_and_draws_it(tmp_path: Path) -> None:
    trial = TRIALS / "both_feet_100hz.parquet"
    done = CliRunner().invoke(main, ["analyse", str(trial), "--out", str(tmp_path), "--stairs"])
    assert done.exit_code == 0, done.output
    assert re.search(r"Path, left: \d+\.\d\d m, ends \d+\.\d\d m from its start, [+-]0\.\d\d m in height", done.output)
    folder = tmp_path / "both_feet_100hz-001"
    with (folder / "path.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert set(rows[0]) == {"foot", "t_s", "x_m", "y_m", "z_m", "heading_rad"}
    assert float(rows[-1]["x_m"]) > 20.0
    page = (folder / "report.html").read_text()
    assert "Path over the ground, from above" in page
    level = CliRunner().invoke(main, ["analyse", str(trial), "--out", str(tmp_path), "--json", "--no-report"])
    told = json.loads(level.stdout)["paths"]["left_foot"]
    assert told["way_m"] > 20.0
    assert abs(told["height_gained_m"]) < 0.05


@pytest.mark.data
def test_a_real_loop_closes() -> None:
    path = DATA / "xio_walk" / "short_walk.csv"
    if not path.is_file():
        pytest.skip(f"no xio_walk in {DATA}")
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    grid = np.arange(table[0, 0], table[-1, 0], 1.0 / 400.0)
    columns = np.column_stack([np.interp(grid, table[:, 0], table[:, k]) for k in range(1, 7)])
    track = track_of(columns[:, 3:] * G_MPS2, np.radians(columns[:, :3]), rate_hz=400.0)
    found = ground_path(track, calibrate_track(track))
    assert 20.0 < found.distance_m < 26.0
    assert found.closure_m < 0.01 * found.distance_m


@pytest.mark.data
def test_real_stairs_rise_by_two_steps_a_stride() -> None:
    path = DATA / "gaitmap_walk" / "imu_sample_healthy_stair_up.csv"
    if not path.is_file():
        pytest.skip(f"no gaitmap_walk in {DATA}")
    tracks = gaitmap_tracks(path.name)
    recording = Recording("stairs", None, tracks)
    result = analyse(*calibrated(recording, incline=math.nan), ground=Ground(free=True))
    ends = [path.height_gained_m for path in result.paths.values()]
    assert abs(ends[0] - ends[1]) < 0.25  # both feet end on the same floor
    for foot in tracks:
        gained = np.array([s.height_gained_m for s in result.strides if s.foot == foot and s.valid])
        stairs = gained[gained > 0.15]
        assert len(stairs) >= 12
        assert 0.25 < np.median(stairs) < 0.36
        alike = np.abs(stairs - np.median(stairs)) < 0.03
        assert alike.mean() > 0.7  # the stairs are built alike; a landing takes one step
        assert gained.sum() == pytest.approx(result.paths[foot].height_gained_m, abs=0.3)


# --- Tables: rows, columns, Arrow and what a notebook shows ---


COLUMNS = (
    Column("foot", str, "", "which <foot>"),
    Column("number", int, "", "counts"),
    Column("length_m", float, "m", "how long", "Wang et al. 2013"),
)
ROWS = [{"foot": "left_foot", "number": k, "length_m": None if k == 2 else 1.0 + k} for k in range(4)]


def test_rows_columns_and_parts_of_a_table() -> None:
    table = Table.from_rows(COLUMNS, ROWS)
    assert len(table) == 4
    assert table.names == ("foot", "number", "length_m")
    assert table["number"].tolist() == [0, 1, 2, 3]
    assert math.isnan(table["length_m"][2])
    assert table[1] == ROWS[1]
    assert table[-1] == ROWS[3]
    assert table[1:3].rows()[0] == ROWS[1]
    assert [row["number"] for row in table] == [0, 1, 2, 3]


def test_what_is_not_there_is_refused() -> None:
    table = Table.from_rows(COLUMNS, ROWS)
    with pytest.raises(KeyError, match="there are foot"):
        table["width_m"]
    for number in (4, -5):
        with pytest.raises(IndexError, match="there are 4"):
            table[number]
    with pytest.raises(ValueError, match="no values of length_m"):
        Table(COLUMNS, {"foot": [], "number": []})
    with pytest.raises(ValueError, match="not of one length"):
        Table(COLUMNS, {"foot": ["a"], "number": [], "length_m": []})


def test_arrow_keeps_units_and_sources() -> None:
    arrow = Table.from_rows(COLUMNS, ROWS).to_arrow()
    metadata = arrow.schema.field("length_m").metadata
    assert metadata == {b"unit": b"m", b"description": b"how long", b"source": b"Wang et al. 2013"}
    assert arrow.column("number").to_pylist() == [0, 1, 2, 3]
    assert Table.from_rows(TABLE, []).to_arrow().num_rows == 0


def test_a_notebook_shows_the_first_rows() -> None:
    table = Table.from_rows(COLUMNS, ROWS * 10)
    html = table._repr_html_()
    assert html.count("<tr>") == 21
    assert "40 rows, the first 20 are shown" in html
    assert "which &lt;foot&gt;" in html
    assert repr(table) == "Table of 40 rows: foot, number, length_m"


def test_pandas_is_asked_for_only_when_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table.from_rows(COLUMNS, ROWS)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        table.to_pandas()


def test_false_turns_between_stances_go() -> None:
    rng = np.random.default_rng(11)
    t_ns = 10**15 + np.cumsum(rng.integers(20_000_000, 60_000_000, 200))
    stance_ns, heading = t_ns[10::20] + 3_000_000, np.cumsum(rng.uniform(-0.2, 0.2, 200))
    assert np.array_equal(_without_false_turns(t_ns, heading, stance_ns), heading)
    between = [(stance_ns[k] + stance_ns[k + 1]) // 2 for k in (3, 6)]  # a whole turn to the left, two to the right
    wrong = heading + 2.0 * math.pi * ((t_ns >= between[0]) - 2.0 * (t_ns >= between[1]))
    assert _without_false_turns(t_ns, wrong, stance_ns) == pytest.approx(heading, abs=1e-12)


@pytest.mark.parametrize(("reach_m", "at"), [(3.0, 21), (1.0, 32)])
def test_x_points_to_where_a_path_is_two_metres_away_or_farthest(reach_m: float, at: int) -> None:
    along = reach_m * np.concatenate((np.linspace(0.0, 1.0, 32), np.linspace(1.0, 0.0, 32)))
    place = np.column_stack((-along, 0.3 * np.sin(np.arange(64.0) / 9.0), np.arange(64.0)))
    turned, facing = _pointing_ahead(place, np.full(64, 7.0))
    assert turned[at] == pytest.approx([math.hypot(*place[at, :2]), 0.0, at], abs=1e-12)
    assert np.hypot(*turned[:, :2].T) == pytest.approx(np.hypot(*place[:, :2].T))
    far = math.atan2(place[at, 1], place[at, 0])
    assert facing == pytest.approx(np.full(64, math.remainder(7.0 - far, 2.0 * math.pi)))
