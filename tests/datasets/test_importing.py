"""Public data sets → recordings and references: small files of the same layout, and the real ones where present."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from fes.cli.main import main
from fes.datasets import ImportProblem
from fes.datasets.stroke_treadmill import read_xsens_text
from fes.evaluation.reference.read import companion_references, read_references
from fes.recording import read_recording
from fes.signals import G_MPS2

DATA = Path(os.environ.get("FES_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
N = 600
RNG = np.random.default_rng(5)


def samples(up: int = 2, sign: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    acc, gyr = RNG.normal(0.0, 0.3, (N, 3)), RNG.normal(0.0, 0.5, (N, 3))
    acc[:, up] += sign * G_MPS2
    return acc, gyr


def imported(*arguments: str | Path, code: int = 0) -> dict:
    done = CliRunner().invoke(main, ["import", *map(str, arguments), "--json"])
    assert done.exit_code == code, done.output
    return json.loads(done.stdout) if code == 0 else {"error": done.stderr}


def gaitmap(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    acc, gyr = samples()
    sides, names = ("left_sensor", "right_sensor"), [f"{kind}_{axis}" for kind in ("acc", "gyr") for axis in "xyz"]
    head = ",".join(["sensor", *(side for side in sides for _ in names)]) + "\n"
    head += ",".join(["axis", *(name for _ in sides for name in names)]) + "\n"
    rows = np.column_stack([np.arange(N), acc, np.degrees(gyr), acc, np.degrees(gyr)])
    (folder / "imu_sample.csv").write_text(head + "\n".join(",".join(f"{v:.9g}" for v in row) for row in rows))
    labels = [f"{side}_{point}" for side in "LR" for point in ("TOE", "FCC", "FM5")]
    text = "," + ",".join(label for label in labels for _ in "xyz") + "\n," + ",".join("xyz" * len(labels)) + "\n"
    text += "\n".join(f"{k}," + ",".join(str(1000.0 + k + c) for c in range(18)) for k in range(200))
    (folder / "mocap_sample.csv").write_text(text)
    (folder / "stride_events_sample.csv").write_text(
        "s_id,foot,start,end,ic,tc,min_vel,pre_ic\n0,left,100.0,300.0,260.0,180.0,100.0,60.0\n"
    )
    return acc, gyr


def test_gaitmap(tmp_path):
    acc, gyr = gaitmap(tmp_path)
    told = imported("gaitmap", tmp_path, "--out", tmp_path / "out")
    assert told["licence"] == "MIT"
    recording = read_recording(Path(told["made"][0]["recording"]))
    assert list(recording.tracks) == ["left_foot", "right_foot"]
    left = recording.tracks["left_foot"]
    assert left.rate_hz == pytest.approx(204.8)
    np.testing.assert_allclose(left.acc_mps2, acc, atol=1e-5)
    np.testing.assert_allclose(left.gyr_radps, gyr, atol=1e-6)  # degrees became radians
    assert recording.extra["licence"] == "MIT"
    reference = read_references(companion_references(Path(told["made"][0]["recording"])))
    assert {(p.foot, p.point) for p in reference.paths} == {
        (f, p) for f in ("left_foot", "right_foot") for p in ("heel", "toe")
    }
    toe = next(p for p in reference.paths if (p.foot, p.point) == ("left_foot", "toe"))
    np.testing.assert_allclose(toe.position_m[3], [1.003, 1.004, 1.005])
    assert [(e.what, e.t_s) for e in reference.events] == [
        ("FO", pytest.approx(180 / 204.8, abs=1e-6)),
        ("IC", pytest.approx(260 / 204.8, abs=1e-6)),
    ]
    again = imported("gaitmap", tmp_path / "imu_sample.csv", "--out", tmp_path / "out", code=2)
    assert "--overwrite" in again["error"]


def test_gaitmap_on_stairs_has_no_truth(tmp_path):
    gaitmap(tmp_path)
    (tmp_path / "imu_sample.csv").rename(tmp_path / "imu_sample_healthy_stair_up.csv")
    made = imported("gaitmap", tmp_path, "--out", tmp_path / "out")["made"][0]
    assert made["references"] == []
    assert any("--stairs" in note for note in made["notes"])


def test_stroke_treadmill(tmp_path):
    arrays = {}
    for place in ("leftfoot", "rightfoot", "leftshank", "rightshank"):
        arrays[f"acc_{place}"], arrays[f"gyr_{place}"] = samples()
    np.savez(tmp_path / "MR07_FBIC.npz", fs=100.0, belt_speed=0.9, fsa_mean_deg=12.0, **arrays)
    np.savez(tmp_path / "MR07_1Reg.npz", fs=100.0, belt_speed=np.nan, fsa_mean_deg=np.nan, **arrays)
    made = imported("stroke_treadmill", tmp_path, "--out", tmp_path / "out")["made"]
    free, belt = (read_recording(Path(each["recording"])) for each in made)
    assert free.belt_speed_mps is None
    assert not made[0]["references"]
    assert belt.belt_speed_mps == 0.9
    assert list(belt.tracks) == ["left_foot", "right_foot", "left_shank", "right_shank"]
    assert belt.extra["foot_strike_mean_deg"] == 12.0
    reference = read_references(companion_references(Path(made[1]["recording"])))
    assert reference.belt[:, 1].tolist() == [0.9] * 3


XSENS_HEAD = """// General information: \n//  MT Manager version: 2019.2.0
// Device information: \n//  DeviceId: {device}
//  Firmware Version: 4.6.0\n// Coordinate system: ENU
PacketCounter\tSampleTimeFine\tAcc_X\tAcc_Y\tAcc_Z\tFreeAcc_E\tGyr_X\tGyr_Y\tGyr_Z\tMag_X
"""
ONE_SET = {"00B4778E": "left_foot", "00B47793": "right_foot", "00B47786": "left_shank", "00B47795": "right_shank"}


def xsens(folder: Path, device: str, acc: np.ndarray, gyr: np.ndarray, first: int, lost: tuple[int, ...] = ()) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for k in range(N):
        a, g = ("\t".join(f"{value:.6f}" for value in row[k]) for row in (acc, gyr))
        values = "\t\t\t\t\t\t\t" if k in lost else f"{a}\t0.1\t{g}\t-0.7"
        lines.append(f"{(first + k) % 65536}\t\t{values}")
    text = XSENS_HEAD.format(device=device) + "\n".join(lines) + "\n"
    (folder / f"MT_012000E0_001-000_{device}.txt").write_text(text)


def test_stroke_treadmill_as_its_authors_publish_it(tmp_path):
    """Folders of Xsens texts as in the repository: counters that wrap, a lost packet, runs named in a text beside."""
    person = tmp_path / "data" / "1019_pp02"
    run, late = person / "Xsens" / "exported001", person / "Xsens" / "exported004"
    truth = {}
    for device, place in (*ONE_SET.items(), ("00B47791", "lumbar")):
        truth[place] = samples()
        first = 65000 + (3 if place == "right_foot" else 0)  # one sensor begins three packets later
        xsens(run, device, *truth[place], first, lost=(100, 101) if place == "left_foot" else ())
        xsens(late, device, *truth[place], 5)
    (person / "corresponding_files.txt").write_text(
        "1019_MR002_2303081Reg.c3d = exported000\n1019_MR002_2303081FBIC.c3d'] = exported001\n"
        "1019_MR002_2303082FB.c3d'] = exported004 # Is the second trial without feedback\n"
    )
    made = imported("stroke_treadmill", tmp_path / "data", "--out", tmp_path / "out")["made"]
    paths = sorted(Path(each["recording"]) for each in made)
    assert [path.stem.removeprefix("stroke_treadmill_") for path in paths] == ["MR02_2Reg", "MR02_FBIC"]
    free, belt = map(read_recording, paths)
    assert (free.belt_speed_mps, belt.belt_speed_mps, belt.subject) == (None, 1.6, "MR02")
    assert list(belt.tracks) == list(ONE_SET.values())
    left, right = belt.tracks["left_foot"], belt.tracks["right_foot"]
    kept = np.delete(np.arange(N), [100, 101])
    np.testing.assert_allclose(left.acc_mps2, truth["left_foot"][0][kept], atol=1e-5)
    np.testing.assert_allclose(left.gyr_radps, truth["left_foot"][1][kept], atol=1e-5)
    np.testing.assert_allclose(1e-9 * left.t_sensor_ns, kept / 100.0, atol=1e-9)  # the counter wraps at 65536
    assert right.t_sensor_ns[0] == 30_000_000
    assert any("2 packets were lost" in note for note in made[-1]["notes"] + made[0]["notes"])
    assert read_references(companion_references(Path(belt.path))).belt[:, 1].tolist() == [1.6] * 3
    one = imported("stroke_treadmill", run, "--out", tmp_path / "again")["made"]
    assert len(one) == 1


@settings(max_examples=40, deadline=None)
@given(st.text(alphabet="0123456789.-\t\n/ einfa", max_size=400))
def test_any_text_is_an_export_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("any") / "MT_1_00B47787.txt"
    path.write_text(XSENS_HEAD.format(device="00B47787") + text)
    with suppress(ImportProblem):
        assert (np.diff(read_xsens_text(path).counter) > 0).all()


def test_stroke_treadmill_exports_say_what_is_wrong(tmp_path):
    run = tmp_path / "1019_pp05" / "Xsens" / "exported003"
    acc, gyr = samples()
    xsens(run, "00B47787", acc, gyr, 10)
    told = imported("stroke_treadmill", run, "--out", tmp_path / "a")["made"][0]
    assert any("by the sensors' numbers" in note for note in told["notes"])
    assert list(read_recording(Path(told["recording"])).tracks) == ["left_foot"]
    (run / "sensorspec.json").write_text('{"rightfoot": "47787.txt"}')
    told = imported("stroke_treadmill", run, "--out", tmp_path / "b")["made"][0]
    assert list(read_recording(Path(told["recording"])).tracks) == ["right_foot"]
    (run / "sensorspec.json").write_text("{not json")
    assert "sensorspec.json" in imported("stroke_treadmill", run, "--out", tmp_path / "c", code=2)["error"]
    (run / "sensorspec.json").unlink()
    text = run / "MT_012000E0_001-000_00B47787.txt"
    whole = text.read_text()
    for spoilt, message in (
        (whole[:-200], "holds no packet"),
        (whole.replace("Acc_X", "Beschl_X"), "lacks the columns Acc_X"),
        (whole.replace("\n300\t", "\n200\t"), "PacketCounter does not increase"),
        (whole.replace("\n300\t", "\nnan\t"), "holds no packet"),
        (whole.replace("\n300\t", "\n1e999\t"), "holds no packet"),
        ("", "lacks the columns"),
    ):
        text.write_text(spoilt)
        assert message in imported("stroke_treadmill", run, "--out", tmp_path / "d", code=2)["error"]
    text.rename(run / "MT_012000E0_001-000_00B99999.txt")
    assert "sensorspec.json" in imported("stroke_treadmill", run, "--out", tmp_path / "e", code=2)["error"]


def test_pyshoe_leaves_jumps_out(tmp_path):
    acc, gyr = samples(sign=-1.0)
    place = np.cumsum(np.full((N, 3), 0.001), axis=0)
    place[100] += 0.5
    (tmp_path / "2017-01-01").mkdir()
    savemat(tmp_path / "2017-01-01" / "processed_data.mat", {"imu": np.hstack([acc, gyr]), "gt": place})
    made = imported("pyshoe", tmp_path, "--out", tmp_path / "out")["made"][0]
    assert Path(made["recording"]).stem == "pyshoe_2017-01-01"
    path = read_references(companion_references(Path(made["recording"]))).paths[0]
    assert (path.foot, path.point) == ("right_foot", "sensor")
    assert np.flatnonzero(np.isnan(path.position_m[:, 0])).tolist() == [99, 100, 101]
    np.testing.assert_allclose(path.position_m[50], place[50], atol=1e-6)


def test_ruler(tmp_path):
    acc, gyr = samples(sign=-1.0)
    savemat(tmp_path / "SensorConnectData_7_LLIO.mat", {"imu_data": np.hstack([acc, gyr])})
    table = tmp_path / "SensorConnectData_7_strideIndex_timestamp_gcpX_gcpY.csv"
    table.write_text("strideIndex,timestamp,gcpX,gcpY\n100,0.5,0,0\n300,1.5,0.3,0.4\n500,2.5,0.9,1.2\n")
    made = imported("ruler", tmp_path, "--out", tmp_path / "out", "--foot", "left")["made"][0]
    strides = read_references(companion_references(Path(made["recording"]))).strides
    assert [(s.foot, s.t_start_s, s.values["stride_length_m"]) for s in strides] == [
        ("left_foot", 0.5, pytest.approx(0.5)),
        ("left_foot", 1.5, pytest.approx(1.0)),
    ]
    table.write_text("strideIndex,timestamp,gcpX,gcpY\n100,0.5,0,0\n90,1.5,0.3,0.4\n")
    error = imported("ruler", tmp_path, "--out", tmp_path / "more", code=2)["error"]
    assert "strideIndex must increase" in error


def test_xio_drops_doubled_rows_and_keeps_the_stamps(tmp_path):
    acc, gyr = samples()
    t = np.cumsum(RNG.choice([0.0, 0.0025, 0.005], N, p=[0.05, 0.8, 0.15]))
    head = "Time (s)," + ",".join(f"Gyroscope {a} (deg/s)" for a in "XYZ") + ","
    head += ",".join(f"Accelerometer {a} (g)" for a in "XYZ") + "\n"
    rows = np.column_stack([t, np.degrees(gyr), acc / G_MPS2])
    (tmp_path / "long_walk.csv").write_text(head + "\n".join(",".join(f"{v:.9g}" for v in row) for row in rows))
    made = imported("xio", tmp_path, "--out", tmp_path / "out")["made"][0]
    track = read_recording(Path(made["recording"])).tracks["right_foot"]
    kept = np.concatenate([[True], np.diff(t) > 0])
    assert len(track.t_ns) == kept.sum()
    np.testing.assert_allclose(1e-9 * track.t_sensor_ns, t[kept] - t[0], atol=1e-8)
    np.testing.assert_allclose(track.acc_mps2, acc[kept], atol=1e-5)
    (tmp_path / "long_walk.csv").write_text(head.replace("(g)", "(m/s2)") + "1,2,3,4,5,6,7\n")
    assert "accelerometer in g" in imported("xio", tmp_path, "--out", tmp_path / "more", code=2)["error"]


@pytest.mark.parametrize("form", ["mat", "hdf5"])
def test_broad_as_matlab_and_as_hdf5(tmp_path, form):
    acc, gyr = samples()
    quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (N, 1))
    trial = {"imu_acc": acc, "imu_gyr": gyr, "opt_quat": quaternion, "opt_pos": np.zeros((N, 3))}
    if form == "mat":
        savemat(tmp_path / "01_still.mat", {**trial, "movement": np.ones(N), "sampling_rate": 285.714})
    else:
        h5py = pytest.importorskip("h5py", reason="pip install 'fes-gait[apdm]'")
        with h5py.File(tmp_path / "01_still.hdf5", "w") as file:
            for name, values in {**trial, "movement": np.ones(N, bool)}.items():
                file[name] = values
            file.attrs["sampling_rate"] = 285.714
    made = imported("broad", tmp_path, "--out", tmp_path / "out")["made"][0]
    assert "not a foot" in made["notes"][0]
    assert Path(made["references"][0]).read_text().splitlines()[:2] == [
        "t_s,q_w,q_x,q_y,q_z,x_m,y_m,z_m,moving",
        "0,1,0,0,0,0,0,0,1",
    ]


@pytest.mark.parametrize(
    ("name", "file"),
    [("pyshoe", "a.mat"), ("ruler", "a_LLIO.mat"), ("stroke_treadmill", "MR1.npz"), ("broad", "a.hdf5")],
)
def test_damaged_files_are_named(tmp_path, name, file):
    (tmp_path / file).write_bytes(b"\x89HDF\r\n\x1a\n\x00PK\x03\x04 no such file")
    assert file in imported(name, tmp_path, "--out", tmp_path / "out", code=2)["error"]


def test_one_bad_file_does_not_stop_the_others(tmp_path):
    acc, gyr = samples()
    (tmp_path / "MR01_A.npz").write_bytes(b"nothing")
    np.savez(tmp_path / "MR02_A.npz", fs=100.0, belt_speed=1.0, acc_leftfoot=acc, gyr_leftfoot=gyr)
    done = CliRunner().invoke(main, ["import", "stroke_treadmill", str(tmp_path), "--out", str(tmp_path / "out")])
    assert done.exit_code == 1
    assert "MR01_A.npz" in done.stderr
    assert (tmp_path / "out" / "stroke_treadmill_MR02_A.parquet").is_file()


def test_unknown_sets_and_missing_files():
    assert "gaitmap" in imported("gaitmop", "x", "--out", "y", code=2)["error"]
    assert "is not there" in imported("xio", "nowhere.csv", "--out", "y", code=2)["error"]
    assert "stroke_treadmill" in CliRunner().invoke(main, ["import", "list"]).output


REAL = {
    "gaitmap": ("gaitmap_walk/imu_sample.csv", "stride_length_m", 53, 0.02),
    "pyshoe": ("pyshoe_vicon/2017-11-22-11-38-45.mat", "stride_length_m", 20, 0.025),
}


@pytest.mark.data
@pytest.mark.parametrize("name", REAL)
def test_real_files_import_and_agree(tmp_path, name):
    file, quantity, least, rmse_m = REAL[name]
    if not (DATA / file).is_file():
        pytest.skip(f"no {file} in {DATA}; set FES_DATA")
    made = imported(name, DATA / file, "--out", tmp_path)["made"][0]
    done = CliRunner().invoke(main, ["evaluate", made["recording"], "--no-report", "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    row = [each for each in told["agreement"] if each["quantity"] == quantity][-1]
    assert row["differences"]["n"] >= least
    assert row["differences"]["rmse"] < rmse_m
    assert abs(told["clock"]["found"]["lag_s"]) < 0.01  # both were recorded on one clock


@pytest.mark.data
def test_real_files_of_every_set_import(tmp_path):
    files = {
        "stroke_treadmill": "stroke_treadmill/MR02_FBIC.npz",
        "ruler": "ruler_walks/SensorConnectData_31_LLIO.mat",
        "xio": "xio_walk/short_walk.csv",
        "broad": "broad/07_undisturbed_fast_rotation_B.hdf5",
    }
    there = {name: DATA / file for name, file in files.items() if (DATA / file).is_file()}
    if not there:
        pytest.skip(f"none of the data sets in {DATA}; set FES_DATA")
    for name, file in there.items():
        made = imported(name, file, "--out", tmp_path)["made"][0]
        assert read_recording(Path(made["recording"])).tracks
        if name in ("xio", "broad"):
            done = CliRunner().invoke(main, ["evaluate", made["recording"], "--no-report", "--json"])
            assert done.exit_code == 0, done.output
            rows = {row["quantity"]: row["differences"]["rmse"] for row in json.loads(done.stdout)["agreement"]}
            assert rows["end_distance_m"] < 0.5 if name == "xio" else rows["inclination_z_rad"] < np.radians(1.5)


def test_footswitch_treadmill(tmp_path):
    acc, gyr = samples()
    t_s = 3.0 + np.arange(N) / 194.0
    t_s[350:] += 0.7  # a stall
    gyr[150] = 1e6  # a spike
    label = np.repeat([1, 2, 3, 0, 1, 2], N // 6)
    bad = np.zeros(N, bool)
    bad[[150, 350]] = True
    meta = {"person": "P01", "group": "hemiparetic", "note": "doubtful"}
    path = tmp_path / "P01_2.npz"
    given = {"foot_t_s": t_s, "foot_acc": acc, "foot_gyr": gyr, "label": label, "bad": bad}
    np.savez(path, meta=json.dumps(meta), **given)
    made = imported("footswitch_treadmill", path, "--out", tmp_path / "out", "--foot", "left")["made"][0]
    assert {"1 rows that no sensor can have measured were left out", "doubtful"} <= set(made["notes"])
    recording = read_recording(Path(made["recording"]))
    track = recording.tracks["left_foot"]
    assert (recording.subject, len(track.t_ns)) == ("P01", N - 1)
    assert np.abs(np.delete(t_s - 3.0, 150) - 1e-9 * track.t_sensor_ns).max() < 1e-6, "times of arrival, as they are"
    events = read_references(companion_references(Path(made["recording"]))).events
    known = [(event.what, event.t_s) for event in events]
    assert known == [("FO", pytest.approx(t_s[200] - 3.0)), ("IC", pytest.approx(t_s[300] - 3.0))]
    phases = (tmp_path / "out" / "footswitch_treadmill_P01_2.phases.csv").read_text().splitlines()
    assert phases[0] == "foot,t_start_s,t_end_s,phase,judged"
    assert [row.split(",")[3:] for row in phases[1:4]] == [["stance", "1"], ["pre_swing", "0"], ["swing", "1"]]
    np.savez(path, meta=json.dumps(meta), **{**given, "label": label + 2})
    assert "its labels must be" in imported("footswitch_treadmill", path, "--out", tmp_path / "o", code=2)["error"]


def test_stroke_walks(tmp_path):
    acc, gyr = samples()
    t_s = np.arange(N) / 104.0
    back = np.append(t_s[:-10], t_s[-10:] - 1.5)
    meta = {"rate_hz": 104, "acc_range_g": 8, "gyr_range_degps": 573, "group": "stroke", "aid": True}
    sides = {"left_t_s": back, "right_t_s": t_s}
    sides |= {f"{side}_{kind}": v for side in ("left", "right") for kind, v in (("acc", acc), ("gyr", gyr))}
    path = tmp_path / "S02.npz"
    np.savez(path, meta=json.dumps(meta), **sides)
    made = imported("stroke_walks", path, "--out", tmp_path / "out")["made"][0]
    assert "left_foot: the clock goes back 1 times, as recorded" in made["notes"]
    tracks = read_recording(Path(made["recording"])).tracks
    assert (len(tracks["left_foot"].t_ns), tracks["left_foot"].quality.late, len(tracks["right_foot"].t_ns)) == (
        590,
        10,
        N,
    )
    assert tracks["left_foot"].acc_range_mps2 == pytest.approx(8 * G_MPS2)
    assert tracks["left_foot"].gyr_range_radps == pytest.approx(np.radians(573))
    np.savez(path, meta=json.dumps({**meta, "rate_hz": "fast"}), **sides)
    assert "rate_hz = 'fast'" in imported("stroke_walks", path, "--out", tmp_path / "o", code=2)["error"]


@pytest.mark.data
@pytest.mark.parametrize("name", ["footswitch_treadmill", "stroke_walks"])
def test_real_hemiparetic_walks_import(tmp_path, name):
    folder = DATA / "unseen_walkers" / name
    if not folder.is_dir():
        pytest.skip(f"no {folder}; set FES_DATA")
    for made in imported(name, folder, "--out", tmp_path)["made"]:
        tracks = read_recording(Path(made["recording"])).tracks
        assert len(tracks) == (1 if name == "footswitch_treadmill" else 2)
        assert all(track.duration_s > 60.0 for track in tracks.values())
