"""The gate calls a sensor frozen after 80 ms of the same values: no living one, in the quietest stance, comes near."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from fes.gate.freshness import MAX_SAME_MS
from fes.recording import Track, read_recording
from fes.signals import FloatArray

TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"
DATA = Path(os.environ.get("FES_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
RUNS = sorted((DATA / "stroke_treadmill").glob("*.npz"))


def longest_repetition_s(t_s: FloatArray, acc: FloatArray, gyr: FloatArray) -> float:
    """Longest time (s) over which no value changes."""
    changed = np.flatnonzero((np.diff(acc, axis=0) != 0).any(axis=1) | (np.diff(gyr, axis=0) != 0).any(axis=1)) + 1
    begins = np.concatenate(([0], changed))
    ends = np.concatenate((changed - 1, [len(t_s) - 1]))
    return float((t_s[ends] - t_s[begins]).max())


def test_it_finds_a_repetition() -> None:
    values = np.array([[0.0], [1.0], [1.0], [1.0], [2.0]]).repeat(3, axis=1)
    assert longest_repetition_s(np.arange(5.0), values, np.zeros((5, 3))) == 2.0


def tracks() -> list[Track]:
    paths = [path for path in sorted(TRIALS.glob("*.parquet")) if "truth" not in path.name]
    return [track for path in paths for track in read_recording(path).tracks.values()]


def test_bundled_sensors_never_look_frozen() -> None:
    longest = [longest_repetition_s(1e-9 * track.t_ns, track.acc_mps2, track.gyr_radps) for track in tracks()]
    assert len(longest) >= 11
    assert max(longest) < 0.5 * MAX_SAME_MS / 1000


@pytest.mark.data
@pytest.mark.skipif(not RUNS, reason=f"no recordings in {DATA / 'stroke_treadmill'}; set FES_DATA")
@pytest.mark.parametrize("path", RUNS, ids=lambda path: path.stem)
def test_real_sensors_never_look_frozen(path: Path) -> None:
    data = np.load(path)
    for segment in ("leftfoot", "rightfoot", "leftshank", "rightshank"):
        acc, gyr = data[f"acc_{segment}"], data[f"gyr_{segment}"]
        assert longest_repetition_s(np.arange(len(acc)) / float(data["fs"]), acc, gyr) < 0.5 * MAX_SAME_MS / 1000
