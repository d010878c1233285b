"""The orientation benchmark's own arithmetic: heading-free errors, delays, missing packages, unreadable files."""

from __future__ import annotations

import importlib
import math
import struct
import zlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def sets() -> ModuleType:
    return importlib.import_module("benchmarks.accuracy.orientation_sets")


@pytest.fixture(scope="module")
def benchmark(sets: ModuleType) -> ModuleType:
    return importlib.import_module("benchmarks.accuracy.orientation")


def wxyz(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1, axis=-1)


def test_the_error_is_free_of_heading(sets: ModuleType) -> None:
    truth = Rotation.random(200, random_state=1)
    turned = Rotation.from_euler("z", 130.0, degrees=True) * truth
    up, true_up = sets.upward(wxyz(turned)), sets.upward(wxyz(truth))
    np.testing.assert_allclose(sets.inclination_error_deg(up, true_up), 0.0, atol=1e-6)
    tilted = Rotation.from_euler("x", 3.0, degrees=True) * turned
    np.testing.assert_allclose(sets.inclination_error_deg(sets.upward(wxyz(tilted)), true_up), 3.0, atol=1e-6)


def test_a_later_estimate_is_shifted(sets: ModuleType) -> None:
    ramp = np.column_stack([np.arange(10.0)] * 3)
    np.testing.assert_allclose(sets.later(ramp, 0.5)[:9, 1], np.arange(9) + 0.5)


def trial(sets: ModuleType) -> object:
    n = 400
    acc, gyr = np.tile([0.0, 0.0, 9.80665], (n, 1)), np.zeros((n, 3))
    true_up = np.tile([0.0, math.sin(math.radians(2.0)), math.cos(math.radians(2.0))], (n, 1))
    judged = np.arange(n) >= 100
    return sets.Trial("made", "up", 100.0, acc, gyr, sets._against(true_up, judged))


def test_a_row_holds_the_trials_figures(benchmark: ModuleType, sets: ModuleType) -> None:
    row = benchmark.evaluate(benchmark.METHODS[0], "made", [trial(sets)])
    assert row.installed
    assert row.trials == {"up": pytest.approx(2.0, abs=1e-6)}
    assert row.mean_deg == row.worst_deg == pytest.approx(2.0, abs=1e-6)


def test_what_is_not_installed_says_so(benchmark: ModuleType, sets: ModuleType) -> None:
    absent = benchmark.Method("absent", True, "no_such_package_here", lambda acc, gyr, rate_hz: acc)
    row = benchmark.evaluate(absent, "made", [trial(sets)])
    assert not row.installed
    assert math.isnan(row.mean_deg)


def test_without_recordings_there_are_no_rows(benchmark: ModuleType, tmp_path: Path) -> None:
    assert benchmark.orientation_rows(tmp_path) == []


@pytest.mark.parametrize(
    "content",
    [b"", b"\x89HDF\r\n\x1a\n\x02" + bytes(100), b"time,x\n0,1\n", zlib.compress(b"x") + struct.pack("<Q", 8)],
)
def test_other_files_are_refused_by_name(sets: ModuleType, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "trial.hdf5"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"trial\.hdf5"):
        sets.OldHdf5(path)
