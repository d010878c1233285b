"""Packet counters, sample numbers and device clocks are proposed as time, so that lost samples leave gaps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_recording import both_feet, walk
from test_recording_template import accept, put

from fes.analysis.pipeline import analyse, calibrations_of
from fes.recording import Recording, RecordingError, Track, read_recording, sidecar_template
from fes.recording.table import unwrapped

VALUES = [f"{kind}_{axis}" for kind in ("Acc", "Gyr") for axis in "XYZ"]
WALK = Path(__file__).parents[2] / "sim_inputs" / "both_feet_100hz.parquet"
RATE = "// Update Rate: 100.0Hz\n"


def lossy(track: Track, lost: int) -> tuple[Track, np.ndarray]:
    """The track without so many samples, in bursts of 5 to 60, and the numbers of those that are left."""
    random = np.random.default_rng(lost)
    kept = np.ones(track.t_ns.size, bool)
    while (left := lost - np.count_nonzero(~kept)) > 0:
        begin = int(random.integers(100, kept.size - 200))
        burst = min(left, int(random.integers(5, 60)))
        kept[begin + np.flatnonzero(kept[begin:])[:burst]] = False
    left = {name: getattr(track, name)[kept] for name in ("t_ns", "t_sensor_ns", "acc_mps2", "gyr_radps")}
    return replace(track, **left), np.flatnonzero(kept)


def export(path: Path, track: Track, times: dict[str, np.ndarray], above: str = RATE) -> Path:
    values = [np.asarray(each, np.float64) for each in times.values()]
    return put(path, [*times, *VALUES], [*values, track.acc_mps2, track.gyr_radps], above=above)


def test_an_xsens_walk_with_losses_keeps_its_gaps(tmp_path: Path) -> None:
    """Both feet's counters wrap at 16 bits, at different samples; SampleTimeFine stays empty, as it does there."""
    recording = read_recording(WALK)
    for sensor, lost in (("left_foot", 511), ("right_foot", 603)):
        track, numbers = lossy(recording.tracks[sensor], lost)
        path = export(tmp_path / f"{sensor}.csv", track, {"PacketCounter": (64_000 + numbers) % 65_536})
        text = path.read_text().replace("PacketCounter,", "PacketCounter,SampleTimeFine,")
        head, rows = text.split("\n")[:2], text.split("\n")[2:]
        path.write_text("\n".join([*head, *(row.replace(",", ",,", 1) for row in rows)]))
    template = sidecar_template(tmp_path / "left_foot.csv")
    assert 'time_column = "PacketCounter"  # it counts samples, 511 of them missing' in template
    lines = [
        line.removeprefix("# ") if line[2:6] in ("[sen", "file", "acc ", "gyr ") else line
        for line in template.split("\n")
    ]
    (tmp_path / "left_foot.toml").write_text("\n".join(lines))
    read = read_recording(tmp_path / "left_foot.csv")
    assert {name: track.quality.missing for name, track in read.tracks.items()} == {"left_foot": 511, "right_foot": 603}
    calibrations = calibrations_of(recording)[1].calibrations
    strides = analyse(read, calibrations).strides
    assert all(np.count_nonzero([s.foot == foot and not s.valid for s in strides]) >= 5 for foot in read.tracks)


@pytest.mark.parametrize(
    ("name", "turn", "per_sample"),
    [
        ("PacketCounter", 65_536, 1),
        ("Packet number", 256, 1),
        ("sample_no", 10_000, 1),
        ("Frame Index", 2**32, 1),
        ("Counter", 65_536, 2),
        ("Timestamp (ms)", 65_536, 10),
        ("SampleTimeFine", 2**32, 100),
        ("SampleTimeFine", 2**32, 10_000),
    ],
)
def test_counters_that_wrap_are_proposed_and_their_gaps_counted(
    tmp_path: Path, name: str, turn: int, per_sample: int
) -> None:
    track, numbers = lossy(walk(seconds=20.0), 90)
    path = export(tmp_path / "left.csv", track, {name: (turn - 500 * per_sample + numbers * per_sample) % turn})
    read = accept(path).tracks["left_foot"]
    assert read.quality.missing == 90
    np.testing.assert_array_equal(read.t_ns - read.t_ns[0], track.t_ns - track.t_ns[0])
    assert f"time_wraps_at = {turn}" in sidecar_template(path)


def test_a_clock_written_from_the_rows_does_not_hide_what_the_counter_shows(tmp_path: Path) -> None:
    track, numbers = lossy(walk(seconds=20.0), 90)
    even = np.arange(numbers.size) * 0.01
    path = export(tmp_path / "left.csv", track, {"Time": even, "PacketCounter": numbers}, above="")
    assert accept(path).tracks["left_foot"].quality.missing == 90
    assert "rate_hz = 100  # by Time" in sidecar_template(path)


def test_a_number_of_the_row_does_not_hide_what_the_clock_shows(tmp_path: Path) -> None:
    track, numbers = lossy(walk(seconds=20.0), 90)
    path = export(
        tmp_path / "left.csv", track, {"Sample": np.arange(numbers.size), "Time (ms)": numbers * 10}, above=""
    )
    assert accept(path).tracks["left_foot"].quality.missing == 90


def test_without_a_rate_a_counter_asks_one_question(tmp_path: Path) -> None:
    track, numbers = lossy(walk(seconds=20.0), 90)
    path = export(tmp_path / "left.csv", track, {"PacketCounter": numbers}, above="")
    questions = [line for line in sidecar_template(path).split("\n") if "?" in line]
    assert questions == ["rate_hz = 0  # ? samples per second, as the sensor was set"]
    assert accept(path, rate_hz="100").tracks["left_foot"].quality.missing == 90


def test_each_sensor_of_a_file_has_its_own_counter(tmp_path: Path) -> None:
    recording = both_feet(seconds=20.0)
    names, columns = [], []
    for (sensor, track), start in zip(recording.tracks.items(), (65_000, 200), strict=True):
        names += [f"{sensor}_PacketCounter", *(f"{sensor}_{value}" for value in VALUES)]
        columns += [(start + np.arange(2000)) % 65_536, track.acc_mps2, track.gyr_radps]
    read = accept(put(tmp_path / "walk.csv", names, columns, above=RATE))
    starts = [int(track.t_ns[0]) for track in read.tracks.values()]
    assert starts[1] - starts[0] == pytest.approx((65_536 + 200 - 65_000) * 1e7), "the second had wrapped before"


def test_what_a_sidecar_says_of_counters_is_checked(tmp_path: Path) -> None:
    path = export(tmp_path / "left.csv", walk(), {"PacketCounter": np.arange(400)})
    good = sidecar_template(path)
    sidecar = path.with_suffix(".toml")
    sidecar.write_text(good.replace("rate_hz = 100", "#"))
    with pytest.raises(RecordingError, match=r'time_unit = "samples" needs rate_hz'):
        read_recording(path)
    sidecar.write_text(good.replace('time_unit = "samples"', 'time_unit = "samples"\ntime_wraps_at = 256'))
    with pytest.raises(
        RecordingError, match=r"line 259, column 'PacketCounter': 256 is none of 0 to 255; correct time_w"
    ):
        read_recording(path)
    sidecar.write_text(good.replace('"samples"', '"packets"'))
    with pytest.raises(RecordingError, match=r'time_unit = .packets.: must be "s", "ms", "us", "ns", "samples"'):
        read_recording(path)


def test_a_counter_that_was_set_back_is_no_wrap(tmp_path: Path) -> None:
    path = export(tmp_path / "left.csv", walk(seconds=20.0), {"PacketCounter": np.arange(2000) % 900})
    with pytest.raises(RecordingError, match=r"the clock jumps back 8\.990 s"):
        accept(path)


def test_unwrapping_keeps_steps_back() -> None:
    np.testing.assert_array_equal(
        unwrapped(np.array([254.0, 253.0, 255.0, 1.0, 240.0]), 256), [254, 253, 255, 257, 496]
    )


def test_gaps_of_a_recording_are_its_tracks(tmp_path: Path) -> None:
    track, numbers = lossy(walk(seconds=20.0), 90)
    read = accept(export(tmp_path / "left.csv", track, {"PacketCounter": numbers}))
    assert isinstance(read, Recording)
    assert np.count_nonzero(np.diff(read.tracks["left_foot"].t_ns) > 15_000_000) == np.count_nonzero(
        np.diff(numbers) > 1
    )
