"""Recordings: what is written is read again, and tracks hold what they promise."""

from __future__ import annotations

import math
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fes.config import FootGeometry, Ground
from fes.recording import Recording, RecordingError, Track, TrackQuality, read_recording, write_recording
from fes.recording.write import toml_text
from fes.signals import G_MPS2, ImuSample


def walk(sensor: str = "left_foot", seconds: float = 4.0, rate_hz: float = 100.0, start_ns: int = 0) -> Track:
    """A foot that stands 0.6 s and swings 0.4 s of every second; float32-representable values."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    phase = np.clip((t % 1.0 - 0.6) / 0.4, 0.0, 1.0)
    swing = np.sin(np.pi * phase) * (phase < 1.0)
    noise = np.random.default_rng(sum(map(ord, sensor))).normal(0.0, 0.02, (t.size, 6))
    acc = np.column_stack([12.0 * swing * np.cos(9.0 * t), 2.0 * swing, G_MPS2 + 8.0 * swing]) + noise[:, :3]
    gyr = np.column_stack([0.5 * swing, 7.0 * swing * np.sin(np.pi * phase), 0.3 * swing]) + 0.2 * noise[:, 3:]
    stamps = start_ns + np.rint(t * 1e9).astype(np.int64)
    acc, gyr = (values.astype(np.float32).astype(np.float64) for values in (acc, gyr))
    return Track(sensor, rate_hz, stamps, stamps, acc, gyr, quality=TrackQuality(samples=t.size))


def both_feet(**kwargs: float) -> Recording:
    tracks = {sensor: walk(sensor, **kwargs) for sensor in ("left_foot", "right_foot")}
    return Recording("two feet", None, tracks)


def assert_same_track(read: Track, written: Track) -> None:
    for name in ("t_ns", "t_sensor_ns", "acc_mps2", "gyr_radps"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name), err_msg=name)
        assert getattr(read, name).flags.c_contiguous
        assert getattr(read, name).dtype == getattr(written, name).dtype


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_what_fes_writes_fes_reads(tmp_path: Path, suffix: str) -> None:
    tracks = {
        "left_foot": walk("left_foot", rate_hz=128.0),
        "right_foot": walk("right_foot", rate_hz=100.0, start_ns=123_456_789),
        "left_shank": walk("left_shank", rate_hz=204.8, start_ns=1_700_000),
    }
    written = Recording(
        "müller “1”\n",
        None,
        tracks,
        belt_speed_mps=0.8,
        subject="S 07",
        description='tabs\tand "quotes" \\ and \x7f',
        ground=Ground(incline_percent=-8.0),
        geometry={"left_foot": FootGeometry(toe_forward_m=0.1, toe_up_m=-0.05, heel_forward_m=-0.15, heel_up_m=-0.06)},
        extra={"truth": {"stride_lengths_m": [1.25, 1.3], "ok": True}, "mounting": {"left_foot": {"up": "+z"}}},
    )
    path = tmp_path / f"walk{suffix}"
    write_recording(written, path)
    read = read_recording(path)
    assert list(read.tracks) == list(tracks)
    for sensor, track in tracks.items():
        assert_same_track(read.tracks[sensor], track)
        assert read.tracks[sensor].rate_hz == track.rate_hz
        assert read.tracks[sensor].quality == track.quality
    for name in ("name", "belt_speed_mps", "subject", "description", "geometry", "ground", "extra"):
        assert getattr(read, name) == getattr(written, name)
    assert read.path == path
    assert not list(tmp_path.glob(".*")), "temporary files are gone"


def test_csv_keeps_every_digit_and_parquet_float32(tmp_path: Path) -> None:
    track = walk()
    acc = track.acc_mps2 + 1e-12
    one = Recording("x", None, {"left_foot": Track("left_foot", 100.0, track.t_ns, track.t_ns, acc, track.gyr_radps)})
    write_recording(one, tmp_path / "a.csv")
    write_recording(one, tmp_path / "b.parquet")
    np.testing.assert_array_equal(read_recording(tmp_path / "a.csv").tracks["left_foot"].acc_mps2, acc)
    single = read_recording(tmp_path / "b.parquet").tracks["left_foot"].acc_mps2
    np.testing.assert_array_equal(single, acc.astype(np.float32).astype(np.float64))


def test_a_clock_of_its_own_and_late_arrival_survive(tmp_path: Path) -> None:
    track = walk()
    stamps = track.t_sensor_ns.copy()
    stamps[50] = stamps[49]
    stamps[80] -= 25_000_000
    arrival = np.maximum.accumulate(stamps) + 7_000_000
    odd = Track("left_foot", 100.0, arrival, stamps, track.acc_mps2, track.gyr_radps, 160.0, 35.0)
    write_recording(Recording("odd", None, {"left_foot": odd}), tmp_path / "odd.parquet")
    read = read_recording(tmp_path / "odd.parquet").tracks["left_foot"]
    assert_same_track(read, odd)
    assert (read.acc_range_mps2, read.gyr_range_radps) == (160.0, 35.0)
    assert (read.quality.doubled, read.quality.backward) == (1, 1)


def test_refuses_to_overwrite_unless_told(tmp_path: Path) -> None:
    path = tmp_path / "walk.parquet"
    write_recording(both_feet(), path)
    before = path.read_bytes()
    with pytest.raises(RecordingError, match="is there already"):
        write_recording(both_feet(seconds=2.0), path)
    assert path.read_bytes() == before
    with pytest.raises(RecordingError, match=r"walk\.toml.*is there already"):
        write_recording(both_feet(), tmp_path / "walk.csv")
    write_recording(both_feet(seconds=2.0), path, overwrite=True)
    assert read_recording(path).tracks["left_foot"].t_ns.size == 200


def test_a_failed_write_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "walk.parquet"
    write_recording(both_feet(), path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    code = (
        "import resource, signal, sys; from pathlib import Path\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r}); from test_recording import both_feet\n"
        "from fes.recording import write_recording, RecordingError\n"
        "import pyarrow.parquet; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (8000, 8000))\n"
        "try: write_recording(both_feet(seconds=60.0), Path(sys.argv[1]), overwrite=True)\n"
        "except RecordingError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert "cannot be written" in done.stdout
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_refuses_what_it_cannot_write(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"written as \.parquet or \.csv"):
        write_recording(both_feet(), tmp_path / "walk.xlsx")
    with pytest.raises(RecordingError, match="no samples"):
        write_recording(Recording("x", None, {}), tmp_path / "walk.csv")
    with pytest.raises(RecordingError, match="cannot be written"):
        write_recording(both_feet(), tmp_path / "nowhere" / "walk.csv")
    recording = both_feet()
    recording.extra["truth"] = np.zeros(3)
    with pytest.raises(RecordingError, match=r"extra\.truth: ndarray has no TOML form"):
        write_recording(recording, tmp_path / "walk.csv")
    assert not list(tmp_path.iterdir())


def test_samples_are_merged_by_arrival_with_sensors_in_order_on_ties() -> None:
    recording = Recording(
        "x",
        None,
        {
            name: walk(name, rate_hz=rate)
            for name, rate in (("right_shank", 50.0), ("left_foot", 100.0), ("right_foot", 100.0))
        },
    )
    samples = list(recording.samples())
    assert len(samples) == 1000
    assert [sample.sensor for sample in samples[:5]] == [
        "left_foot",
        "right_foot",
        "right_shank",
        "left_foot",
        "right_foot",
    ]
    times = [sample.t_ns for sample in samples]
    assert times == sorted(times)
    track = recording.tracks["right_foot"]
    mine = [sample for sample in samples if sample.sensor == "right_foot"]
    assert mine[7] == ImuSample(
        int(track.t_ns[7]), "right_foot", int(track.t_sensor_ns[7]), tuple(track.acc_mps2[7]), tuple(track.gyr_radps[7])
    )
    assert type(mine[0].t_ns) is int
    assert type(mine[0].acc_mps2[0]) is float


def test_many_samples_cross_the_blocks_in_order() -> None:
    recording = Recording("x", None, {name: walk(name, seconds=800.0) for name in ("left_foot", "right_foot")})
    samples = list(recording.samples())
    assert len(samples) == 160_000
    for sensor, track in recording.tracks.items():
        mine = [sample for sample in samples if sample.sensor == sensor]
        np.testing.assert_array_equal([sample.acc_mps2 for sample in mine], track.acc_mps2)


def test_a_track_refuses_wrong_shapes() -> None:
    track = walk()
    with pytest.raises(RecordingError, match="a sensor is one of left_foot"):
        Track("nose", 100.0, track.t_ns, track.t_ns, track.acc_mps2, track.gyr_radps)
    with pytest.raises(RecordingError, match=r"acc_mps2 is float64 \(400, 2\), must be float64 \(400, 3\)"):
        Track("left_foot", 100.0, track.t_ns, track.t_ns, track.acc_mps2[:, :2], track.gyr_radps)
    turned = np.asfortranarray(track.acc_mps2)
    made = Track("left_foot", 100.0, track.t_ns, track.t_ns, turned, track.gyr_radps)
    assert made.acc_mps2.flags.c_contiguous


plain = st.one_of(
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(allow_nan=False),
    st.text(st.characters(exclude_categories=["Cs"])),
)
values = st.recursive(
    plain,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), inner, max_size=4),
    ),
    max_leaves=12,
)


@given(st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), values, max_size=5))
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_toml_text_is_read_back_by_the_standard_library(content: dict[str, object]) -> None:
    assert tomllib.loads(toml_text(content)) == content


def test_toml_text_names_what_it_cannot_write() -> None:
    with pytest.raises(TypeError, match=r"a\.b: set"):
        toml_text({"a": {"b": {1, 2}}})
    assert math.isnan(tomllib.loads(toml_text({"x": math.nan}))["x"])
