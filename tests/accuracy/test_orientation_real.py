"""Orientation in movement against cameras and markers, one default setting for all.

Measured when this was written: inclination of a board moved by hand 0.60° causal, 0.59° off-line (mean of two trials);
pitch of a walking foot 0.83° and 0.74°. VQF: 0.64° and 0.58°, 1.83° and 1.19°. The bounds leave a little room.
"""

from __future__ import annotations

import importlib
import math
import os
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from fes.estimation.orientation.body import smooth_orientation, track_orientation

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FES_DATA") or ROOT.parent / "shared" / "data")
SETS = ("broad", "gaitmap_walk")
MISSING = [name for name in SETS if not (DATA / name).is_dir()]
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(bool(MISSING), reason=f"no {', '.join(MISSING)} in {DATA}; set FES_DATA"),
]
BAR_DEG = 0.7


@pytest.fixture(scope="module")
def sets() -> ModuleType:
    return importlib.import_module("benchmarks.accuracy.orientation")


def errors_deg(sets: ModuleType, trials: list[Any], known: str) -> list[float]:
    paths = (sets.FILTERS[known](t.acc_mps2, t.gyr_radps, t.rate_hz) for t in trials)
    return [trial.score(sets.upward(path.quaternion)) for trial, path in zip(trials, paths, strict=True)]


@pytest.mark.parametrize(("known", "pitch_deg"), [("causal", 0.95), ("off-line", 0.85)])
def test_inclination_of_a_moving_board_and_pitch_of_a_walking_foot(
    sets: ModuleType, known: str, pitch_deg: float
) -> None:
    boards, feet = sets.broad(DATA), sets.gaitmap_pitch(DATA)
    assert boards
    assert np.mean(errors_deg(sets, boards, known)) <= BAR_DEG
    assert len(feet) == 2
    assert np.mean(errors_deg(sets, feet, known)) < pitch_deg


def test_known_stance_helps_a_walking_foot(sets: ModuleType) -> None:
    for trial in sets.gaitmap_pitch(DATA):
        acc, gyr, rate_hz = trial.acc_mps2, trial.gyr_radps, trial.rate_hz
        _, rest, _ = sets.find_zero_velocity(acc, gyr, rate_hz, causal=True)
        known, unknown = (
            trial.score(sets.upward(track_orientation(acc, gyr, rate_hz, zero_velocity=at_rest).quaternion))
            for at_rest in (rest, None)
        )
        assert known < unknown
        assert known < 0.85


@pytest.mark.parametrize("index", [0, 1], ids=["fast rotation", "slow translation"])
def test_the_filter_knows_how_good_it_is(sets: ModuleType, index: int) -> None:
    """Tilt errors over the filter's own standard deviation: not more sure than right, not sure of nothing."""
    trial = sets.broad(DATA)[index]
    for run, most in ((track_orientation, 1.0), (smooth_orientation, 2.5)):
        path = run(trial.acc_mps2, trial.gyr_radps, trial.rate_hz)
        sd_deg = math.degrees(float(np.sqrt(np.mean(path.tilt_sd_rad**2))))
        error_deg = trial.score(sets.upward(path.quaternion)) / math.sqrt(2.0)  # about one axis
        assert 0.1 * sd_deg < error_deg < most * sd_deg


def test_a_clipping_gyroscope_costs_less_when_its_range_is_known(sets: ModuleType) -> None:
    """The fast board again, behind a gyroscope of 1000 °/s: one sample in a hundred clips."""
    trial = sets.broad(DATA)[0]
    limit = math.radians(1000.0)
    gyr = np.clip(trial.gyr_radps, -limit, limit)
    aware, naive = (
        trial.score(sets.upward(track_orientation(trial.acc_mps2, gyr, trial.rate_hz, gyr_range_radps=r).quaternion))
        for r in (limit, None)
    )
    assert aware < 0.8 * naive
