"""References of every kind of file, brought to the recording's clock and the belt's frame, and held against it."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fes.analysis.pipeline import analyse, calibrations_of
from fes.cli.main import main
from fes.evaluation.reference.alignment import standing_speed, to_belt
from fes.evaluation.reference.compare import Estimate, from_analysis
from fes.evaluation.reference.evaluation import Settings, evaluate, evaluate_orientation, read_orientation
from fes.evaluation.reference.read import companion_references, read_references
from fes.evaluation.reference.table import MarkerPath, Reference, ReferenceError
from fes.recording import Recording, Track, read_recording, write_recording
from fes.signals import G_MPS2, StrideResult

TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"
WALK = TRIALS / "example_csv.csv"
PATIENT = TRIALS / "negard_patient1.parquet"


@cache
def estimated(path: Path) -> Estimate:
    recording, found = calibrations_of(read_recording(path))
    return from_analysis(analyse(recording, found.calibrations))


def written(folder: Path, text: str, name: str = "x.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def row(result, quantity):
    return next(each for each in result.rows if each.quantity == quantity)


def count(result, what):
    return next(each for each in result.counts if each.what == what)


def test_the_bundled_truth_agrees():
    result = evaluate(estimated(PATIENT), read_references([TRIALS / "negard_patient1.strides.csv"]))
    assert (count(result, "stride").expected, count(result, "stride").missed, count(result, "stride").extra) == (
        40,
        0,
        0,
    )
    length = row(result, "stride_length_m")
    assert length.differences.n == 40
    assert abs(length.differences.bias.value) < 0.01
    assert length.differences.sd < 0.02
    assert length.icc.value > 0.9
    assert abs(row(result, "foot_off_s").differences.bias.value) < 0.01
    assert np.isnan(row(result, "foot_off_s").icc.value)  # a moment's size says nothing


def test_ultrasound_in_the_lab_is_moved_to_the_belt_and_its_clock_found():
    """Negård et al.'s own set-up: 25 Hz, lab frame, Eq. (21) and (22)."""
    reference = read_references([TRIALS / "negard_patient1.reference.csv"], foot="right_foot").shifted(-2.345)
    settings = Settings(belt_mps=1.1 / 3.6, fit_lag=True)
    result = evaluate(estimated(PATIENT), reference, settings)
    assert result.synchrony.applied_s == pytest.approx(2.345, abs=0.02)
    assert any("along +x" in note for note in result.notes)
    length, clearance = row(result, "stride_length_m").differences, row(result, "clearance_m").differences
    assert length.n == 40
    assert abs(length.bias.value) < 0.0174  # their better patient
    assert length.sd < 0.0165
    assert abs(clearance.bias.value) < 0.003
    assert clearance.sd < 0.004
    assert count(result, "swing (sensor)").missed == 0


def test_without_eq_21_the_same_path_is_refused():
    reference = read_references([TRIALS / "negard_patient1.reference.csv"], foot="right_foot")
    with pytest.raises(ReferenceError, match=r"nothing in it fits|does not stand still"):
        evaluate(estimated(PATIENT), reference, Settings(frame="lab", belt_mps=1.5))


@pytest.mark.parametrize(("axis", "turn"), [("+x", 0.0), ("+y", 90.0), ("-x", 180.0), ("-y", 270.0)])
def test_the_walking_direction_is_found(axis, turn):
    t = np.arange(0.0, 20.0, 0.01)
    speed = 1.2 * (1.0 - np.cos(2.0 * np.pi * t)) ** 2 / 1.5  # stands once a second, 1.2 m/s on average
    x = np.cumsum(speed) * 0.01 - 1.2 * t
    angle = np.radians(turn)
    place = np.column_stack([np.cos(angle) * x, np.sin(angle) * x, 0.05 * np.ones_like(t)])
    path = MarkerPath("left_foot", "heel", t, place, "lab")
    moved = to_belt(path, np.array([[0.0, 1.2], [20.0, 1.2]]))
    assert moved.axis == axis
    assert standing_speed(moved.path) < 0.1
    with pytest.raises(ReferenceError, match="does not stand still"):
        to_belt(path, np.array([[0.0, 3.0], [20.0, 3.0]]))


def test_a_shifted_reference_is_warned_of_and_misses_are_counted(tmp_path):
    strides = read_references([TRIALS / "example_csv.strides.csv"])
    late = evaluate(estimated(WALK), strides.shifted(0.1))
    assert any("off the recording's clock" in warning for warning in late.warnings)
    fitted = evaluate(estimated(WALK), strides.shifted(0.1), Settings(fit_lag=True))
    assert fitted.synchrony.applied_s == pytest.approx(-0.1, abs=0.02)
    assert any("mean error says nothing" in warning for warning in fitted.warnings)
    contacts = [event for event in strides.events if event.what == "IC"]
    middle = 0.5 * (contacts[1].t_s + contacts[2].t_s)
    text = "foot,event,t_ms\n" + "".join(f"R,heel strike,{1e3 * t}\n" for t in [*(c.t_s for c in contacts), middle])
    result = evaluate(estimated(WALK), read_references([written(tmp_path, text)]))
    assert (count(result, "IC").missed, count(result, "IC").extra) == (1, 0)
    fewer = evaluate(estimated(WALK), Reference(events=tuple(contacts[:1] + contacts[2:])))
    assert (count(fewer, "IC").missed, count(fewer, "IC").extra) == (0, 1)


def test_foot_switches_bounce_and_drop_samples(tmp_path):
    lines = ["time (ms);left_heel;left_toe;right_foot"]
    for k in range(400):
        t = 10 * k
        phase = t % 1000
        heel = 0 if 300 <= phase < 900 and phase not in (310,) else 1
        toe = 1 if 100 <= phase < 600 else 0
        pressed = "" if k == 50 else f"{400.5 + 300 * (phase < 600)}".replace(".", ",")
        lines.append(f"{t};{heel};{toe};{pressed}")
    reference = read_references([written(tmp_path, "\n".join(lines))])
    of = {(e.foot, e.what, round(e.t_s, 3)) for e in reference.events}
    assert ("left_foot", "FO", 0.595) in of  # the toe's switch opens last
    assert ("left_foot", "IC", 0.895) in of  # the heel's closes first
    assert ("right_foot", "FO", 0.595) in of
    assert len([e for e in of if e[:2] == ("left_foot", "IC")]) == 4


def test_a_mat_gives_strides_events_and_durations(tmp_path):
    truth = read_references([TRIALS / "example_csv.strides.csv"])
    contacts = [e.t_s for e in truth.events if e.what == "IC"]
    offs = [next(e.t_s for e in truth.events if e.what == "FO" and e.t_s > t) for t in contacts[:-1]]
    place, rows = 0.0, ["foot,first_contact_s,last_contact_s,x_cm,y_cm"]
    for k, (contact, off) in enumerate(zip(contacts[:-1], offs, strict=True)):
        place += truth.strides[k].values["stride_length_m"]
        rows.append(f"right,{contact},{off},{100 * place},3.0")
    result = evaluate(estimated(WALK), read_references([written(tmp_path, "\n".join(rows), "x.mat.csv")]))
    assert abs(row(result, "stride_length_m").differences.bias.value) < 0.02
    assert abs(row(result, "stance_time_s").differences.bias.value) < 0.03


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "no known kind"),
        ("", "no row"),
        ("foot,event,t_s\nmiddle,IC,1\n", "no foot"),
        ("foot,event,t_s\nleft,jump,1\n", "no event"),
        ("foot,event,t_s\nleft,IC,soon\n", "no number"),
        ("foot,event,t_s\nleft,IC\n", "2 cells"),
        ("t_s,x_m,y_m,z_m\n0,0,0,0\n0,0,0,0\n1,0,0,0\n", "does not increase"),
        ("foot,t_start_s,t_end_s\nleft,2,1\n", "after t_start"),
        ("t_s,left_foot\n0,1\n1,1\n2,1\n", "never change"),
        ("t_s,left_knee_x_m,left_knee_y_m,left_knee_z_m\n0,0,0,0\n1,0,0,0\n2,0,0,0\n", "a marker is one of"),
        ("event,t_s\nIC,1\n", "--foot"),
    ],
)
def test_wrong_files_are_named_with_place_and_fix(tmp_path, text, message):
    with pytest.raises(ReferenceError, match=message) as error:
        read_references([written(tmp_path, text)])
    assert str(tmp_path) in str(error.value)


CELLS = st.sampled_from(["", "0", "1", "2.5", "-3", "1e300", "nan", "inf", "left", "R", "IC", "toe off", "x", "1,5"])
NAMES = st.sampled_from(
    [
        "t_s",
        "foot",
        "event",
        "t_start_s",
        "t_end_s",
        "x_m",
        "y_m",
        "z_m",
        "left",
        "right_toe",
        "t_contact",
        "t_off_ms",
        "stride_length_cm",
        "speed_kmh",
        "steady",
        "left_heel_x_mm",
        "left_heel_y_mm",
        "left_heel_z_mm",
    ]
)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_any_table_is_read_or_refused(tmp_path_factory, data):
    names = data.draw(st.lists(NAMES, min_size=1, max_size=6))
    rows = data.draw(st.lists(st.lists(CELLS, min_size=len(names), max_size=len(names)), max_size=6))
    delimiter = data.draw(st.sampled_from([",", ";"]))
    text = "\n".join(delimiter.join(cells) for cells in [names, *rows])
    path = written(tmp_path_factory.getbasetemp(), text, "any.csv")
    with suppress(ReferenceError):  # and nothing else
        reference = read_references([path], foot=data.draw(st.sampled_from([None, "right_foot"])))
        evaluate(estimated(WALK), reference)


def test_the_command_writes_page_json_and_pairs(tmp_path):
    done = CliRunner().invoke(main, ["evaluate", str(WALK), "--out", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    folder = Path(told["files"]["folder"])
    assert sorted(path.name for path in folder.iterdir()) == ["agreement.html", "agreement.json", "pairs.csv"]
    page = (folder / "agreement.html").read_text(encoding="utf-8")
    assert page.count("<svg") >= 10
    assert "Bland–Altman" in page
    assert "http" not in page.replace("http-equiv", "")
    assert json.loads((folder / "agreement.json").read_text(encoding="utf-8"))["agreement"] == told["agreement"]
    assert companion_references(WALK) == [TRIALS / "example_csv.strides.csv"]
    for wrong in (["--lag", "1", "--sync", "fit"], ["--reference", "nowhere.csv"], ["--marker", "LHEE"]):
        assert CliRunner().invoke(main, ["evaluate", str(WALK), "--no-report", *wrong]).exit_code == 2


def test_c3d_markers_and_events(tmp_path):
    ezc3d = pytest.importorskip("ezc3d", reason="reading C3D is an extra")
    t = np.arange(300) / 100.0
    points = np.ones((4, 3, len(t)))
    points[0, 0], points[1, 0], points[2, 0] = 10.0, 100.0 * t, 1000.0 * t  # y up, walking along z
    points[:3, 1] = 5.0
    points[:3, 2] = np.nan
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [100]
    file["parameters"]["POINT"]["LABELS"]["value"] = ["LHEE", "RTOE", "HEAD"]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["data"]["points"] = points
    file.add_parameter("EVENT", "CONTEXTS", ["Left", "Right", "General"])
    file.add_parameter("EVENT", "LABELS", ["Foot Strike", "Foot Off", "Event"])
    file.add_parameter("EVENT", "TIMES", np.array([[0.0, 1.0, 0.0], [1.25, 0.5, 2.0]]))
    path = tmp_path / "walk.c3d"
    file.write(str(path))
    reference = read_references([path], up="y")
    assert [(p.foot, p.point) for p in reference.paths] == [("left_foot", "heel"), ("right_foot", "toe")]
    heel = reference.paths[0]
    assert heel.rate_hz == pytest.approx(100.0)
    np.testing.assert_allclose(heel.position_m[100], [1.0, 0.01, 0.1], atol=1e-6)  # z up, x forward, y left
    assert [(e.foot, e.what, e.t_s) for e in reference.events] == [
        ("left_foot", "IC", pytest.approx(1.25)),
        ("right_foot", "FO", pytest.approx(60.5)),
    ]
    named = read_references([path], markers={"HEAD": ("left_foot", "sensor")})
    assert [(p.foot, p.point) for p in named.paths] == [("left_foot", "sensor")]
    with pytest.raises(ReferenceError, match="no marker"):
        read_references([path], markers={"NOSE": ("left_foot", "sensor")})
    path.write_bytes(path.read_bytes()[:700])
    with pytest.raises(ReferenceError, match=r"walk\.c3d"):
        read_references([path])


def turning_board(rate_hz: float = 100.0, seconds: float = 30.0) -> tuple[Recording, np.ndarray, np.ndarray]:
    """A body that rests, then rolls and pitches by up to 0.6 rad; with it its true quaternions (N, 4)."""
    t = np.arange(round(rate_hz * seconds)) / rate_hz
    swell = np.clip((t - 3.0) / 2.0, 0.0, 1.0)
    euler = np.column_stack((0.6 * swell * np.sin(1.7 * t), 0.4 * swell * np.sin(2.9 * t), 0.0 * t))
    turn = Rotation.from_euler("xyz", euler)
    rate = (turn[:-1].inv() * turn[1:]).as_rotvec() * rate_hz
    gyr = np.vstack((np.zeros(3), rate))
    acc = turn.inv().apply((0.0, 0.0, G_MPS2))
    t_ns = np.round(t * 1e9).astype(np.int64)
    track = Track("right_foot", rate_hz, t_ns, t_ns, acc, gyr)
    return Recording("board", None, {"right_foot": track}), t, np.roll(turn.as_quat(), 1, axis=1)


def test_orientation_is_held_against_the_sensor_alone(tmp_path):
    recording, t, quaternion = turning_board()
    write_recording(recording, tmp_path / "board.parquet")
    heads = ("t_s", "q_w", "q_x", "q_y", "q_z", "moving")
    rows = [[f"{v:.8f}" for v in (*row, float(row[0] > 5.0))] for row in np.column_stack((t, quaternion))]
    for cells in rows:
        cells[5] = cells[5][0]
    for k in range(700, 720):
        rows[k][1:5] = [""] * 4  # the cameras lost it
    path = written(tmp_path, "\n".join(map(",".join, [heads, *rows])), "board.orientation.csv")
    done = CliRunner().invoke(main, ["evaluate", str(tmp_path / "board.parquet"), "--no-report", "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    errors = {each["quantity"]: each["differences"] for each in told["agreement"]}
    assert set(errors) == {"inclination_x_rad", "inclination_z_rad"}
    assert max(each["rmse"] for each in errors.values()) < np.radians(0.3)
    assert errors["inclination_z_rad"]["n"] == pytest.approx(250, abs=5)
    assert any("RMS of 2479 samples" in note for note in told["notes"])
    tilted = Rotation.from_rotvec((0.05, 0.0, 0.0)) * Rotation.from_quat(np.roll(quaternion, -1, axis=1))
    wrong = replace(read_orientation(path), quaternion=np.roll(tilted.as_quat(), 1, axis=1))
    found = re.search(r"off by ([0-9.]+)°", evaluate_orientation(recording, [wrong]).notes[0])
    assert found
    assert float(found[1]) == pytest.approx(np.degrees(0.05), abs=0.3)


QUATERNIONS = "t_s,q_w,q_x,q_y,q_z,sensor\n"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0,1,0,0,0,\n1,0.5,0,0,0,\n2,1,0,0,0,\n", "quaternion has the length 0.500"),
        ("0,1,0,0,0,a\n1,1,0,0,0,b\n2,1,0,0,0,a\n", "several sensors (a, b)"),
        ("900,1,0,0,0,\n901,1,0,0,0,\n902,1,0,0,0,\n", "fewer than 10 of its orientations"),
        ("0,1,0,0,0,left_foot\n1,1,0,0,0,left_foot\n2,1,0,0,0,left_foot\n", "of which sensor"),
    ],
)
def test_orientations_that_cannot_be_used(tmp_path, rows, message):
    path = written(tmp_path, QUATERNIONS + rows)
    recording = turning_board(seconds=10.0)[0]
    with pytest.raises(ReferenceError, match=re.escape(message)):
        evaluate_orientation(recording, [read_orientation(path)])
    with pytest.raises(ReferenceError, match="held against a sensor alone"):
        read_references([path])


def climbing(count: int = 8, rise_m: float = 0.34) -> Estimate:
    """Strides on stairs as an analysis would give them, each of two risers and a little off."""
    strides = []
    for k in range(count):
        ends = (round(1.5e9 * k), round(1.5e9 * (k + 1)))
        entries = (round(1.5e9 * k + at) for at in (4e8, 6e8, 11e8, 12e8))
        gained = rise_m + 0.002 * (k % 3)
        strides.append(StrideResult("right_foot", k, *ends, 0.6, 0.3, gained, 0.0, 0.4, *entries))
    ends_m = {"right_foot": (4.81, 2.75)}
    return Estimate("stairs", "", 0.0, 1.5 * count, tuple(strides), {}, {}, ends_m, level=False)


def test_stairs_by_a_table_of_heights_and_by_the_walks_end(tmp_path):
    rows = "\n".join(f"right,{1.5 * k},{1.5 * k + 1.5},34" for k in range(8))
    table = written(tmp_path, f"foot,t_start_s,t_end_s,height_gained_cm\n{rows}\n", "a.csv")
    end = written(tmp_path, "foot,end_distance_m,end_height_m\nright,4.80,2.72\n", "b.csv")
    result = evaluate(climbing(), read_references([table, end]))
    gained = row(result, "height_gained_m").differences
    assert gained.n == 8
    assert gained.bias.value == pytest.approx(0.002 * 7 / 8)
    assert row(result, "end_distance_m").differences.bias.value == pytest.approx(0.01)
    assert row(result, "end_height_m").differences.bias.value == pytest.approx(0.03)
    on_the_level = evaluate(replace(climbing(), level=True), read_references([end]))
    assert [each.quantity for each in on_the_level.rows] == ["end_distance_m"]
    for wrong in ("end_distance_m\n-1\n", "foot,end_height_m\nright,\n", "foot,end_height_m\nright,1\nright,2\n"):
        with pytest.raises(ReferenceError, match="needs one row a foot"):
            read_references([written(tmp_path, wrong)], foot="right_foot")


def test_stairs_by_a_marker(tmp_path):
    """Standing from 1.3 s of every stride to 0.3 s of the next, between them up and ahead."""
    t = np.arange(0.0, 12.0, 0.01)
    way = np.floor(t / 1.5) + np.clip((t % 1.5 - 0.3) / 0.9, 0.0, 1.0)
    lines = [f"{a:.2f},{0.6 * w:.4f},0,{0.34 * w:.4f}" for a, w in zip(t, way, strict=True)]
    path = written(tmp_path, "t_s,x_m,y_m,z_m\n" + "\n".join(lines))
    result = evaluate(climbing(), read_references([path], foot="right_foot"))
    assert row(result, "height_gained_m").differences.n >= 6
    assert abs(row(result, "height_gained_m").differences.bias.value) < 0.005
    level = evaluate(replace(climbing(), level=True), read_references([path], foot="right_foot"))
    assert "height_gained_m" not in {each.quantity for each in level.rows}
