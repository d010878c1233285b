"""Recordings of real walks pass the checks; spoiled units of real walks do not."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fes.recording import Recording, RecordingError, Track, read_recording, sidecar_template, write_recording

DATA = Path(os.environ.get("FES_DATA", Path(__file__).parents[3] / "shared" / "data"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings under {DATA}; set FES_DATA")


def stroke_walks() -> list[Path]:
    return sorted((DATA / "stroke_treadmill").glob("*.npz"))


def stroke_recording(path: Path) -> Recording:
    content = np.load(path)
    rate_hz = float(content["fs"])
    tracks = {}
    for key in content.files:
        if not key.startswith("acc_"):
            continue
        sensor = key[4:].replace("left", "left_").replace("right", "right_")
        acc = np.ascontiguousarray(content[key], dtype=np.float64)
        gyr = np.ascontiguousarray(content[f"gyr_{key[4:]}"], dtype=np.float64)
        stamps = np.rint(np.arange(len(acc)) * (1e9 / rate_hz)).astype(np.int64)
        tracks[sensor] = Track(sensor, rate_hz, stamps, stamps, acc, gyr)
    return Recording(path.stem, None, tracks)


@needs_data
@pytest.mark.data
def test_walks_of_stroke_survivors_pass_on_feet_and_shanks(tmp_path: Path) -> None:
    walks = stroke_walks()
    assert walks
    for number, walk in enumerate(walks):
        recording = stroke_recording(walk)
        path = tmp_path / f"{number}.parquet"
        write_recording(recording, path)
        read = read_recording(path)
        assert set(read.tracks) == set(recording.tracks)
        for track in read.tracks.values():
            assert (track.quality.missing, track.quality.irregular) == (0, 0)


@needs_data
@pytest.mark.data
@pytest.mark.parametrize(
    ("old", "new", "fix"),
    [
        ('acc_unit = "m/s^2"', 'acc_unit = "g"', 'set acc_unit = "m/s\\^2"'),
        ('gyr_unit = "rad/s"', 'gyr_unit = "deg/s"', 'set gyr_unit = "rad/s"'),
    ],
)
def test_wrong_units_of_real_walks_are_refused(tmp_path: Path, old: str, new: str, fix: str) -> None:
    for number, walk in enumerate(stroke_walks()[:4]):
        path = tmp_path / f"{number}.parquet"
        write_recording(stroke_recording(walk), path)
        sidecar = path.with_suffix(".toml")
        sidecar.write_text(sidecar.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
        with pytest.raises(RecordingError, match=fix):
            read_recording(path)


@needs_data
@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "rate_hz", "feet"),
    [("gaitmap_walk/imu_sample.csv", 204.8, 2), ("xio_walk/short_walk.csv", 398.3, 1)],
)
def test_files_as_their_makers_left_them_read_with_the_template(
    tmp_path: Path, name: str, rate_hz: float, feet: int
) -> None:
    path = tmp_path / "own.csv"
    shutil.copyfile(DATA / name, path)
    template = sidecar_template(path).replace("rate_hz = 0", f"rate_hz = {rate_hz}").replace('"?"', "left_foot")
    path.with_suffix(".toml").write_text(template, encoding="utf-8")
    recording = read_recording(path)
    assert list(recording.tracks) == ["left_foot", "right_foot"][:feet]
    assert recording.tracks["left_foot"].rate_hz == pytest.approx(rate_hz, rel=1e-3)
    peak = np.percentile(np.linalg.norm(recording.tracks["left_foot"].gyr_radps, axis=1), 99)
    assert 3.0 < peak < 20.0
    if feet == 1:
        assert recording.tracks["left_foot"].quality.doubled > 100, "its stamps are known to be doubled"


def test_heavy_libraries_load_only_where_used() -> None:
    code = (
        "import sys, fes.recording, fes.session_log\n"
        "heavy = {'pyarrow', 'can', 'cantools', 'scipy', 'pandas', 'numba'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
