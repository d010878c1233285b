"""Recordings of stroke survivors on a treadmill: phases in order and walking speed, by the project's own benchmark."""

from __future__ import annotations

import importlib
import math
import os
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FES_DATA") or ROOT.parent / "shared" / "data") / "stroke_treadmill"
RUNS = sorted(DATA.glob("*.npz"))
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(
        not RUNS, reason=f"no recordings in {DATA}; set FES_DATA to the folder that holds stroke_treadmill"
    ),
]


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    return importlib.import_module("benchmarks.accuracy.stroke_treadmill")


def test_all_runs_are_there() -> None:
    assert len(RUNS) == 13


@pytest.mark.parametrize("path", RUNS, ids=lambda path: path.stem)
def test_phases_in_order_and_speed(path: Path, benchmark: ModuleType) -> None:
    """98 % of the strides between independent mid-swings go T3, T4, T1, T2; speed over belt 0.98 to 1.02 per foot."""
    results = benchmark.evaluate(path)
    assert [result.foot for result in results] == ["left_foot", "right_foot"]
    for result in results:
        assert result.strides >= 50
        assert result.in_order >= 0.98 * result.strides, f"{result.foot}: {result.in_order} of {result.strides}"
        if not math.isnan(result.belt_mps):  # a self-paced belt has no one speed
            assert 0.98 <= result.speed_ratio <= 1.02, f"{result.foot}: {result.speed_ratio:.4f}"
