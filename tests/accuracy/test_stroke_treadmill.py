"""Recordings of stroke survivors on a treadmill: phases in order and walking speed, by the project's own benchmark."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest

from benchmarks.accuracy.every_walker import speed_mps
from benchmarks.lib.real_sets import LAST_S
from benchmarks.lib.swing_judge import score
from benchmarks.lib.walkers import calibrate, causal, stroke_treadmill, swings_of

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FES_DATA") or ROOT.parent / "shared" / "data") / "stroke_treadmill"
RUNS = sorted(DATA.glob("*.npz"))
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(
        not RUNS, reason=f"no recordings in {DATA}; set FES_DATA to the folder that holds stroke_treadmill"
    ),
]


def test_all_runs_are_there() -> None:
    assert len(RUNS) == 13


@pytest.mark.parametrize("path", RUNS, ids=lambda path: path.stem)
def test_phases_in_order_and_speed(path: Path) -> None:
    """98 % of the strides between independent mid-swings go T3, T4, T1, T2; speed over belt 0.98 to 1.02 per foot."""
    feet = [foot for foot in stroke_treadmill(DATA.parent, "known") if foot.run == path.stem]
    assert [foot.side for foot in feet] == ["left", "right"]
    for foot in feet:
        changes, strides = causal(foot.track, calibrate(foot.track))
        found = score(swings_of(foot), changes, strides)
        assert found.strides >= 50
        assert found.in_order >= 0.98 * found.strides, f"{foot.side}: {found.in_order} of {found.strides}"
        if not math.isnan(foot.belt_mps):  # a self-paced belt has no one speed
            ratio = speed_mps(strides, foot.track.t_ns[-1] - LAST_S * 1e9) / foot.belt_mps
            assert 0.98 <= ratio <= 1.02, f"{foot.side}: {ratio:.4f}"
