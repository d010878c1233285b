"""Wang et al.'s windows and frame, the afflicted side, stairs, clocks of two feet; and the command."""

from __future__ import annotations

import csv
import json
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from stepping_feet import Steps, calibration, stepping

from benchmarks.lib.real_sets import load_run
from benchmarks.lib.swing_judge import mid_swings
from fes.analysis.hemiparetic import foot as w
from fes.analysis.hemiparetic.foot import (
    common_times,
    foot_of,
    in_visualization_frame,
    mapped,
    tracked,
    visualization_frame,
)
from fes.analysis.hemiparetic.sync import Samples, offset
from fes.analysis.hemiparetic.walk import (
    Power,
    Terrain,
    feet_of,
    hemiparetic_walk,
    paretic_side,
    terrain,
)
from fes.analysis.parameters.gait import Statistic
from fes.analysis.pipeline import analyse, calibrations_of, uneven_strides
from fes.cli.main import main
from fes.estimation.events.offline import find_events
from fes.recording import Recording, read_recording, write_recording
from fes.signals import FOOT_SENSORS, NS_PER_S
from fes.simulation.forward import VirtualPatient, settings_for
from fes.simulation.forward.closed_loop import recording_of

TRIAL = Path(__file__).resolve().parents[2] / "sim_inputs" / "both_feet_100hz.parquet"


def both(steps: Steps) -> Recording:
    """A walk of two feet that alternate."""
    half = 0.5 * (steps.swing_s + steps.rest_s)
    tracks = {"left_foot": stepping("left_foot", steps)[0], "right_foot": stepping("right_foot", steps, half)[0]}
    return Recording("stepping", None, tracks)


# --- windows ---------------------------------------------------------------------------------------------


def test_a_window_with_too_short_a_motion_in_it_is_merged():
    found = w.merged(np.array([[0, 50], [100, 150], [155, 190], [240, 290]]))
    assert found.tolist() == [[0, 50], [100, 190], [240, 290]]


def test_a_window_that_is_too_long_is_split_at_a_tighter_threshold():
    energy = np.full(1100, 1.0)
    for begin in range(0, 1100, 100):
        energy[begin : begin + 50] = 0.001
    energy[200:350] = 0.001
    energy[250:300] = 0.02  # a weak swing under the threshold
    whole = [[begin, begin + 50] for begin in range(0, 1100, 100)]
    assert w.still_windows(energy).tolist() == whole
    energy[250:300] = 0.001  # no swing at all: nothing to split at
    assert [200, 350] in w.still_windows(energy).tolist()


def test_standing_at_the_ends_is_never_split():
    energy = np.full(1000, 1.0)
    for begin, end in ((0, 300), (350, 400), (450, 500), (550, 600), (700, 1000)):
        energy[begin:end] = 0.001
    energy[100:150] = 0.02
    assert w.still_windows(energy).tolist()[0] == [0, 300]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.booleans(), min_size=2, max_size=300))
def test_windows_stay_in_order_and_apart(pattern):
    energy = np.where(np.array(pattern), 0.001, 1.0)
    found = w.still_windows(energy)
    assert (found[:, 0] < found[:, 1]).all()
    assert (found[1:, 0] > found[:-1, 1]).all()
    assert len(w.between(found)) == max(len(found) - 1, 0)


def test_the_fitted_threshold_is_the_printed_one_where_that_shows_enough_rest():
    assert w.fitted_threshold(np.array([0.001] * 30 + [1.0] * 70)) == w.THRESHOLD_M2PS4
    shaken = np.array([0.3] * 30 + [5.0] * 70)
    assert 0.3 < w.fitted_threshold(shaken) <= 0.6


def test_the_healthy_sides_motion_is_the_afflicted_sides_rest():
    n = 1000
    healthy, afflicted = np.full(n, 0.001), np.full(n, 1.0)
    for begin in (200, 400, 600):
        healthy[begin : begin + 80] = 1.0
        afflicted[begin - 10 : begin + 60] = 0.001  # stands a little earlier, and less long
    afflicted[:100] = afflicted[900:] = 0.001
    own = w.still_windows(healthy)
    found, shift_s = mapped(own, healthy, afflicted, (0.025, 0.025), 100.0)
    assert found.tolist() == [[0, 100], [190, 260], [390, 460], [590, 660], [900, 1000]]
    assert shift_s <= 0.0


def test_the_afflicted_foot_keeps_its_quietest_moment_where_it_is_never_still():
    healthy, afflicted = np.full(600, 0.001), np.full(600, 0.5)
    for begin in (100, 250, 400):
        healthy[begin : begin + 50] = 1.0
        afflicted[begin + 20] = 0.1
    found, _ = mapped(w.still_windows(healthy), healthy, afflicted, (0.025, 0.025), 100.0)
    assert len(found) == 3
    assert all(begin <= quiet < end for (begin, end), quiet in zip(found.tolist(), (120, 270, 420), strict=True))


# --- reconstruction --------------------------------------------------------------------------------------


def test_a_walk_by_formula_is_reconstructed_in_the_visualization_frame():
    steps = Steps()
    track, _ = stepping("left_foot", steps)
    times = common_times([track])
    foot = foot_of(track, calibration("left_foot"), times)
    found = in_visualization_frame(tracked(foot, w.still_windows(w.energy(foot.acc_mps2, foot.rate_hz))))
    lengths = found.stride_lengths_m()
    assert len(lengths) == steps.count
    assert np.allclose(lengths, steps.length_m, rtol=0.03)
    way = found.position_m[found.centres[-1]]
    assert way[1] == pytest.approx(steps.count * steps.length_m, rel=0.03)  # y is ahead
    assert abs(way[0]) < 0.1
    assert np.median(found.swing_s()) == pytest.approx(steps.swing_s, abs=0.12)
    assert len(found.stance_s()) == steps.count - 1


@settings(max_examples=100, deadline=None)
@given(
    st.floats(-math.pi, math.pi),
    st.floats(-1.2, 1.2),
    st.floats(0.5, 100.0),
)
def test_the_visualization_frame_is_a_rotation_even_on_stairs(heading, slope, way_m):
    way = way_m * np.array([math.cos(heading) * math.cos(slope), math.sin(heading) * math.cos(slope), math.sin(slope)])
    level = math.hypot(way[0], way[1])
    up = np.array([0.0, 0.0, 9.7])
    if level < 0.3:
        with pytest.raises(ValueError, match="no direction"):
            visualization_frame(up, way)
        return
    turn = visualization_frame(up, way)
    assert np.allclose(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) == pytest.approx(1.0)
    x, y, z = turn @ way
    assert y == pytest.approx(level)
    assert abs(x) < 1e-9 * way_m
    assert z == pytest.approx(way[2])


def test_nothing_is_integrated_without_a_window():
    track, _ = stepping("left_foot", Steps(count=3))
    foot = foot_of(track, calibration("left_foot"), common_times([track]))
    with pytest.raises(ValueError, match="no zero-velocity window"):
        tracked(foot, np.zeros((0, 2), np.int64))


def test_feet_that_share_no_time_are_refused():
    one, other = stepping("left_foot", Steps(count=3))[0], stepping("right_foot", Steps(count=3))[0]
    later = replace(other, t_ns=other.t_ns + 10**12, t_sensor_ns=other.t_sensor_ns + 10**12)
    with pytest.raises(ValueError, match="in common"):
        common_times([one, later])


# --- stairs ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rise_m", "said"), [(0.0, Terrain.LEVEL), (0.3, Terrain.UP), (-0.3, Terrain.DOWN), (0.16, Terrain.UP)]
)
def test_stairs_are_told_from_level_ground_stride_by_stride(rise_m, said):
    steps = Steps(rise_m=rise_m, length_m=0.6)
    recording = both(steps)
    found = uneven_strides(recording, {foot: calibration(foot) for foot in FOOT_SENSORS})
    for strides in found.values():
        kinds = [terrain(s.height_gained_m, s.stride_length_m) for s in strides if s.valid]
        assert len(kinds) >= steps.count - 2
        assert set(kinds) == {said}


@pytest.mark.parametrize(
    ("height_m", "length_m", "said"),
    [
        (0.07, 0.5, Terrain.LEVEL),
        (0.12, 1.3, Terrain.LEVEL),  # a ramp
        (0.3, 0.6, Terrain.UP),
        (-0.17, 0.3, Terrain.DOWN),
        (math.nan, 0.5, Terrain.UNKNOWN),
        (0.3, math.nan, Terrain.UNKNOWN),
    ],
)
def test_terrain_by_height_and_length(height_m, length_m, said):
    assert terrain(height_m, length_m) is said


# --- which side ------------------------------------------------------------------------------------------


def feet_with(swing: tuple[float, float], rotation: tuple[float, float], contact: tuple[float, float]):
    return {
        foot: {
            "swing_s": Statistic(swing[k], 0.01, 0.01, 20),
            "heel_rotation_rad": Statistic(rotation[k], 0.01, 0.01, 20),
            "angle_contact_rad": Statistic(contact[k], 0.01, 0.01, 20),
        }
        for k, foot in enumerate(FOOT_SENSORS)
    }


def test_signs_that_agree_tell_the_side_and_mirror_with_the_feet():
    left = paretic_side(Power(0.5, 1.0), feet_with((0.6, 0.45), (0.7, 1.0), (0.0, 0.3)))
    right = paretic_side(Power(2.0, 1.0), feet_with((0.45, 0.6), (1.0, 0.7), (0.3, 0.0)))
    assert (left.side, right.side) == ("left", "right")
    assert left.score == pytest.approx(right.score)
    assert left.agreeing == right.agreeing == 4
    assert "paretic side: left" in left.describe()


def test_signs_that_contradict_each_other_tell_no_side():
    told = paretic_side(Power(0.7, 0.6), feet_with((0.45, 0.5), (1.0, 0.98), (0.3, 0.25)))
    assert told.side is None
    assert "not clear" in told.describe()


def test_what_was_not_measured_does_not_vote():
    told = paretic_side(Power(math.nan, 0.0), {})
    assert (told.side, told.known, told.score) == (None, 0, 0.0)


@pytest.fixture(scope="module")
def patients():
    """A pattern with the left, and one with the right side afflicted."""
    found = {}
    for side, pattern in (("left", "hemiparetic_3"), ("right", "hemiparetic_1")):
        patient = VirtualPatient(settings_for("moderate", pattern=pattern, side=side, sensors=FOOT_SENSORS, seed=21))
        recording = recording_of(patient, patient.advance(40 * NS_PER_S), pattern, "")
        recording, calibrations = calibrations_of(recording)
        found[side] = analyse(recording, calibrations.calibrations)
    return found


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_afflicted_side_of_a_virtual_patient_is_told(patients, side):
    walk = hemiparetic_walk(patients[side])
    assert walk.side.side == side
    assert walk.parameters.paretic == side
    assert walk.parameters.sides["swing_s"].first == side
    assert walk.parameters.sides["swing_s"].ratio > 1.1
    assert {row["afflicted"] for row in walk.rows() if row["foot"] == f"{side}_foot"} == {"yes"}
    told = walk.to_json()
    assert json.loads(json.dumps(told))["afflicted"] == side
    strides = {foot: len(rows) for foot, rows in walk.parameters.strides.items()}
    assert walk.windows is not None
    for foot, count in told["windows"]["strides"].items():
        assert abs(count - strides[foot]) <= 2


def test_a_side_that_somebody_names_is_taken(patients):
    walk = hemiparetic_walk(patients["left"], paretic="right")
    assert walk.side.side == "right"
    assert walk.windows is not None
    assert walk.windows.healthy == "left_foot"


def test_one_foot_alone_is_no_hemiparetic_walk():
    recording = read_recording(TRIAL)
    recording, found = calibrations_of(replace(recording, tracks={"left_foot": recording.tracks["left_foot"]}))
    with pytest.raises(ValueError, match="right_foot missing"):
        hemiparetic_walk(analyse(recording, found.calibrations))


# --- two clocks ------------------------------------------------------------------------------------------


def samples_of(recording: Recording, ahead_s: float, knocks_s: tuple[float, ...] = ()) -> list[Samples]:
    """Left and right, cut differently, the right clock behind by ``ahead_s``."""
    recording, found = calibrations_of(recording)
    out = []
    for foot, begin_s, end_s, ahead in (("left_foot", 0.4, 1.1, 0.0), ("right_foot", 0.9, 0.3, ahead_s)):
        track = recording.tracks[foot]
        t, acc = track.t_sensor_ns, track.acc_mps2.copy()
        for at in knocks_s:
            acc[np.abs(t * 1e-9 - at) < 0.015, 2] += 30.0
        keep = (t > t[0] + begin_s * NS_PER_S) & (t < t[-1] - end_s * NS_PER_S)
        t, acc, gyr = t[keep], acc[keep], track.gyr_radps[keep]
        out.append(Samples(t - round(ahead * NS_PER_S), acc, find_events(t, acc, gyr, found.calibrations[foot])))
        moved = out[-1].events
        shift = round(ahead * NS_PER_S)
        times = {name: getattr(moved, name) - shift for name in ("fo_ns", "mid_swing_ns", "ic_ns")}
        out[-1] = replace(out[-1], events=replace(moved, **times))
    return out


def test_two_feet_recorded_apart_are_brought_together_by_their_walk():
    result = offset(*samples_of(read_recording(TRIAL), 5.437))
    assert result.sure
    assert result.offset_s == pytest.approx(5.437, abs=0.03)
    assert result.method in ("jolts", "halves")


def test_knocks_bring_them_together_more_exactly():
    result = offset(*samples_of(read_recording(TRIAL), -2.718, (1.2, 1.7, 2.5)))
    assert result.method == "knocks"
    assert result.offset_s == pytest.approx(-2.718, abs=0.011)


def test_a_few_steps_without_knocks_are_refused():
    one, other = samples_of(read_recording(TRIAL), 1.0)
    few = replace(
        one.events, **{n: getattr(one.events, n)[:4] for n in ("fo_ns", "mid_swing_ns", "ic_ns", "heel_strike")}
    )
    with pytest.raises(ValueError, match="4 and"):
        offset(replace(one, events=few), other)


# --- the command -----------------------------------------------------------------------------------------


def test_the_command_tells_the_side_and_writes_the_tables(tmp_path, patients):
    path = tmp_path / "walk.parquet"
    write_recording(patients["right"].recording, path)
    done = CliRunner().invoke(
        main, ["analyse", str(path), "--hemiparetic", "--no-report", "--json", "--out", str(tmp_path / "out")]
    )
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["hemiparetic"]["afflicted"] == "right"
    assert told["parameters"]["sides"]["swing_s"]["first"] == "right"
    folder = tmp_path / "out" / "walk-001"
    with (folder / "parameters.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["afflicted"] for row in rows} == {"yes", "no"}
    assert {row["terrain"] for row in rows} == {"level"}
    with (folder / "windows.csv").open() as file:
        assert len(list(csv.DictReader(file))) > 10


def test_the_command_says_why_one_foot_is_not_enough(tmp_path):
    trial = TRIAL.with_name("negard_patient2.parquet")
    done = CliRunner().invoke(main, ["analyse", str(trial), "--hemiparetic", "--no-report", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "left_foot missing" in " ".join(done.output.split())
    assert (tmp_path / "negard_patient2-001" / "parameters_summary.csv").is_file()


def test_the_command_brings_feet_recorded_apart_together(tmp_path, patients):
    recording = read_recording(TRIAL)
    right = recording.tracks["right_foot"]
    ahead = round(3.3 * NS_PER_S)
    late = replace(right, t_ns=right.t_ns + ahead, t_sensor_ns=right.t_sensor_ns + ahead)
    write_recording(replace(recording, tracks={**recording.tracks, "right_foot": late}), tmp_path / "apart.parquet")
    options = ["--sync-clocks", "--no-report", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(main, ["analyse", str(tmp_path / "apart.parquet"), *options])
    assert done.exit_code == 0, done.output
    said = " ".join(done.output.split())
    assert "Right foot's clock set forward by -3." in said
    with (tmp_path / "out" / "apart-001" / "parameters.csv").open() as file:
        steps = [float(row["step_time_s"]) for row in csv.DictReader(file) if row["step_time_s"]]
    assert np.median(steps) == pytest.approx(0.565, abs=0.03)


def test_feet_recorded_apart_without_a_walk_are_refused(tmp_path):
    trial = TRIAL.with_name("negard_patient2.parquet")
    done = CliRunner().invoke(main, ["analyse", str(trial), "--sync-clocks", "--no-report", "--out", str(tmp_path)])
    assert done.exit_code == 2
    assert "left_foot is missing" in " ".join(done.output.split())


def test_both_feet_are_placed_in_one_frame(patients):
    rows = hemiparetic_walk(patients["right"]).track_rows()
    assert {row["foot"] for row in rows} == set(FOOT_SENSORS)
    for foot in FOOT_SENSORS:
        own = [row for row in rows if row["foot"] == foot]
        assert own[0]["y_m"] == pytest.approx(0.0, abs=0.3)
        assert own[-1]["y_m"] > 4.0
        assert abs(own[-1]["x_m"]) < 0.5 * own[-1]["y_m"]


# --- real walks ------------------------------------------------------------------------------------------

DATA = Path(os.environ.get("FES_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
RUN = DATA / "stroke_treadmill" / "MR05_FBIC.npz"


@pytest.mark.skipif(not RUN.is_file(), reason="the stroke-treadmill recordings are not here (FES_DATA)")
def test_strides_and_speed_of_a_stroke_survivor():
    """Own strides are as many as the mid-swings, and as fast as the belt; the printed threshold finds next to none."""
    tracks, belt_mps = load_run(RUN)
    result = analyse(Recording(RUN.stem, None, tracks, belt_speed_mps=belt_mps))
    walk = hemiparetic_walk(result)
    printed = {name: w.still_windows(w.energy(foot.acc_mps2, foot.rate_hz)) for name, foot in feet_of(result).items()}
    for foot, track in tracks.items():
        swings = len(mid_swings(track.gyr_radps[:, 1], track.rate_hz))
        rows = walk.parameters.strides[foot]
        assert sum(s.foot == foot for s in result.strides) == pytest.approx(swings, abs=2)
        assert len(rows) == pytest.approx(swings, abs=2)
        assert len(printed[foot]) < 0.5 * swings
        late = rows[(rows["t_start_s"] >= track.duration_s - 120.0) & np.isfinite(rows["stride_time_s"])]
        speed_mps = late["stride_length_common_m"].sum() / late["stride_time_s"].sum()
        assert speed_mps / belt_mps == pytest.approx(1.0, abs=0.01)
    assert walk.side.side == "right"
    assert all(kind is Terrain.LEVEL for found in walk.terrain.values() for kind in found.values())
