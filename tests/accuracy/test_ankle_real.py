"""Shanks of stroke survivors on a treadmill: speed over belt, however the sensor is turned, and from a short walk."""

from __future__ import annotations

import importlib
import os
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FES_DATA") or ROOT.parent / "shared" / "data") / "stroke_treadmill"
RUNS = sorted(DATA.glob("*.npz"))
SAMPLE = [path for path in RUNS if path.stem in ("MR02_FBIC", "MR05_2FB", "MR08_FBIC", "MR11_2FB")]
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(
        not RUNS, reason=f"no recordings in {DATA}; set FES_DATA to the folder that holds stroke_treadmill"
    ),
]


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    return importlib.import_module("benchmarks.accuracy.ankle")


@pytest.fixture(scope="module")
def results(benchmark: ModuleType) -> list[object]:
    @cache
    def all_runs() -> list[object]:
        return [result for path in RUNS for result in benchmark.evaluate(path)]

    return all_runs()


def test_speed_over_belt_meets_the_bar(benchmark: ModuleType, results: list[object]) -> None:
    """Mean 0.98–1.02, every side within 8 %; resetting to zero is far from it."""
    known = [r for r in results if not np.isnan(r.belt_mps)]
    assert len(known) == 24
    learnt, zupt = np.array([r.learnt for r in known]), np.array([r.zupt for r in known])
    assert 0.98 <= learnt.mean() <= 1.02
    assert np.abs(learnt - 1.0).max() <= 0.08
    assert learnt.std(ddof=1) < 0.04
    assert zupt.mean() < 0.9
    assert benchmark.holds(results)


def test_hardly_a_stride_is_lost_and_no_arm_is_wild(results: list[object]) -> None:
    for r in results:
        assert r.strides > 80
        assert r.invalid <= 0.02 * r.strides
        assert 0.2 <= r.arm_m[2] <= 0.4
        assert np.linalg.norm(r.arm_m[:2]) < 0.08
        assert 1.0 < r.condition < 30.0


@pytest.mark.parametrize("path", SAMPLE, ids=lambda path: path.stem)
@pytest.mark.parametrize("variant", ["turned", "20 s", "50 Hz"])
def test_mounting_length_and_rate_do_not_matter(path: Path, variant: str, benchmark: ModuleType) -> None:
    """A sensor mounted any other way gives the same; 20 s of walking or half the rate stay within the bar."""
    shanks, rate_hz, belt_mps = benchmark.load_shanks(path)
    for sensor, (acc, gyr) in shanks.items():
        plain = benchmark.calibrate(sensor, rate_hz, acc, gyr)
        reference = benchmark.speed(acc, gyr, plain, np.array(plain.arm.arm_m))[0] / belt_mps
        if variant == "turned":
            mounting = Rotation.from_euler("xyz", (140.0, -50.0, 80.0), degrees=True)
            acc, gyr = np.ascontiguousarray(mounting.apply(acc)), np.ascontiguousarray(mounting.apply(gyr))
            calibration, tolerance = benchmark.calibrate(sensor, rate_hz, acc, gyr), 1e-3
        elif variant == "20 s":
            n = round(20.0 * rate_hz)
            calibration, tolerance = benchmark.calibrate(sensor, rate_hz, acc[:n], gyr[:n]), 0.03
        else:
            acc, gyr = np.ascontiguousarray(acc[::2]), np.ascontiguousarray(gyr[::2])
            calibration, tolerance = benchmark.calibrate(sensor, 0.5 * rate_hz, acc, gyr), 0.03
        ratio = benchmark.speed(acc, gyr, calibration, np.array(calibration.arm.arm_m))[0] / belt_mps
        assert ratio == pytest.approx(reference, abs=tolerance)
        assert abs(ratio - 1.0) <= 0.08
