"""Data frames as gaitmap and mobgap give them, and arrays, with lost samples: as a file with empty rows and gaps.

The frames are stand-ins with what pandas' have: columns, an index, and a column by its name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from test_recording import walk

import fes

TRACK = walk(seconds=20.0)
N = TRACK.t_ns.size
NAMES = [f"{kind}_{axis}" for kind in ("acc", "gyr") for axis in "xyz"]
VALUES = np.hstack((TRACK.acc_mps2, np.degrees(TRACK.gyr_radps)))
EPOCH = np.datetime64("2026-09-21T14:13:20", "ns")


class Index:
    def __init__(self, values: np.ndarray, name: str | None = None) -> None:
        self.values, self.name = values, name


class Frame:
    """Of columns of numbers; a first level of the columns' names gives a frame of its own."""

    def __init__(
        self, columns: Mapping[Any, np.ndarray], index: np.ndarray | None = None, name: str | None = None
    ) -> None:
        self._columns = dict(columns)
        size = len(next(iter(columns.values()), []))
        self.columns, self.index = list(columns), Index(np.arange(size) if index is None else index, name)

    def __getitem__(self, name: Any) -> Any:
        inner = {column[1]: values for column, values in self._columns.items() if column[:1] == (name,)}
        return Frame(inner, self.index.values, self.index.name) if inner else self._columns[name]


def frame(index: np.ndarray | None = None, rows: np.ndarray | slice = slice(None), **other: Any) -> Frame:
    values = other.pop("values", VALUES)
    columns = {name: values[rows, k] for k, name in enumerate(other.pop("names", NAMES))}
    return Frame(columns, None if index is None else index[rows], **other)


INDICES = {
    "seconds": np.arange(N) / 100.0,
    "dates": EPOCH + np.arange(N) * np.timedelta64(10_000, "us"),
    "dates in us": (EPOCH + np.arange(N) * np.timedelta64(10_000, "us")).astype("M8[us]"),
    "durations": np.arange(N) * np.timedelta64(10, "ms"),
    "epoch in ns": 1_790_000_000_000_000_000 + np.arange(N) * 10_000_000,
    "milliseconds": np.arange(N) * 10,
    "samples": np.arange(N) + 5000,
}


@pytest.mark.parametrize("name", INDICES)
def test_lost_samples_of_a_frame_are_a_file_s(name: str) -> None:
    values = VALUES.copy()
    values[500:520] = np.nan
    kept = np.delete(np.arange(N), slice(1000, 1030))
    rate_hz = 100.0 if name == "samples" else None
    found = fes.recording(frame(INDICES[name], kept, values=values), rate_hz=rate_hz).tracks["left_foot"]
    same = np.delete(np.arange(N), [*range(500, 520), *range(1000, 1030)])
    np.testing.assert_allclose(found.acc_mps2, TRACK.acc_mps2[same])
    np.testing.assert_allclose(found.gyr_radps, TRACK.gyr_radps[same])
    np.testing.assert_array_equal(found.t_sensor_ns - found.t_sensor_ns[0], TRACK.t_ns[same])
    assert found.quality.missing == 50
    assert found.quality.samples == N - 50


LEFT, RIGHT = frame(INDICES["seconds"]), frame(INDICES["seconds"], slice(0, N - 70))
SEVERAL = {
    "gaitmap's dict": {"left_sensor": LEFT, "right_sensor": RIGHT},
    "gaitmap's levels": Frame(
        {(sensor, n): VALUES[:, k] for sensor in ("left_sensor", "right_sensor") for k, n in enumerate(NAMES)},
        INDICES["seconds"],
        "time after start [s]",
    ),
    "mobgap's": {place: frame(INDICES["dates"], name="time") for place in ("LowerBack", "LeftFoot", "RightFoot")},
    "names in the columns": Frame(
        {f"{side}_{n}": VALUES[:, k] for side in ("left", "right") for k, n in enumerate(NAMES)}, INDICES["seconds"]
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SEVERAL)
def test_several_sensors_are_told_by_their_names(name: str) -> None:
    recording = fes.recording(SEVERAL[name])
    assert list(recording.tracks) == ["left_foot", "right_foot"]
    for track in recording.tracks.values():
        np.testing.assert_allclose(track.gyr_radps, TRACK.gyr_radps[: track.t_ns.size])


def test_the_analysis_takes_a_frame() -> None:
    foot = fes.read(fes.bundled_file("both_feet_100hz.parquet")).tracks["left_foot"]
    values = np.hstack((foot.acc_mps2, np.degrees(foot.gyr_radps)))
    values[3000:3050] = np.nan
    one = Frame({name: values[:, k] for k, name in enumerate(NAMES)})
    found, whole = fes.analyse(one, rate_hz=100.0), fes.analyse(fes.recording(foot.acc_mps2, foot.gyr_radps, 100.0))
    lost = len(whole.strides) - int(found.strides["valid"].sum())
    assert 1 <= lost <= 3, "the strides with the gap alone"
    assert any("missing" in each.text for each in found.findings)


def test_arrays_have_lost_samples_and_times_too() -> None:
    acc, gyr, t_s = TRACK.acc_mps2.copy(), TRACK.gyr_radps.copy(), TRACK.t_ns * 1e-9
    acc[700:710] = gyr[700:710] = np.nan
    assert fes.recording(acc, gyr, 100.0).tracks["left_foot"].quality.missing == 10
    kept = np.delete(np.arange(N), slice(1000, 1030))
    track = fes.recording(acc[kept], gyr[kept], t_s=t_s[kept]).tracks["left_foot"]
    assert track.quality.missing == 40
    assert track.rate_hz == pytest.approx(100.0)
    t_s[300] = -1e6
    assert fes.recording(acc, gyr, t_s=t_s).tracks["left_foot"].quality.repaired == 1


HALF = np.where(np.arange(N)[:, None] == 7, [np.nan, *5 * [1.0]], VALUES)
NO_TIME = np.where(np.arange(N) == 7, np.nan, INDICES["seconds"])
NO_DATE = np.where(np.arange(N) == 7, np.datetime64("NaT"), INDICES["dates"])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: fes.analyse(frame()), "the index counts samples: give rate_hz"),
        (lambda: fes.recording(TRACK.acc_mps2, TRACK.gyr_radps), "give rate_hz, or times"),
        (lambda: fes.recording(TRACK.acc_mps2), "gyr is missing"),
        (lambda: fes.recording({}), "gyr is missing"),
        (lambda: fes.analyse({"LowerBack": LEFT}), "holds no sensor of a foot or shank; call one left_foot"),
        (lambda: fes.analyse({"a": LEFT}), "frame: a: nothing says which sensor it is"),
        (lambda: fes.analyse({"left": LEFT, "left_sensor": LEFT}), "is left_foot, and so is 'left'; leave one out"),
        (lambda: fes.analyse(frame(INDICES["seconds"], names=["acc_pa", *NAMES[1:]])), "no columns such as .*'acc_pa'"),
        (lambda: fes.analyse(frame(np.array([f"r{k}" for k in range(N)]))), "the index is no time"),
        (lambda: fes.analyse(frame(INDICES["seconds"] * 7.7)), "which is no usual rate: give it in seconds"),
        (lambda: fes.analyse(frame(NO_DATE)), "rows without a time"),
        (lambda: fes.analyse(frame(NO_TIME)), "is no time in row 8"),
        (lambda: fes.analyse(frame(INDICES["seconds"], values=HALF)), r"row 8: column 'left_foot acc x' is empty"),
        (lambda: fes.analyse(frame(INDICES["seconds"], values=VALUES * 0.01)), "nor numbers tell the unit"),
        (lambda: fes.analyse(frame(INDICES["seconds"][::-1].copy())), "the index never advances; sort the rows"),
        (lambda: fes.recording(LEFT, gyr_unit="rad/s"), 'set gyr_unit = "deg/s"'),
    ],
)  # fmt: skip
def test_what_does_not_fit_says_what_to_do(make: Callable[[], object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        make()
