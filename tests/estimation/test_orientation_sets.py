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


def test_a_trial_judges_what_may_be_judged(sets: ModuleType) -> None:
    up = np.tile([0.0, 0.0, 1.0], (400, 1))
    true_up = np.tile([0.0, math.sin(math.radians(2.0)), math.cos(math.radians(2.0))], (400, 1))
    true_up[:100] = (1.0, 0.0, 0.0)
    assert sets._against(true_up, np.arange(400) >= 100)(up) == pytest.approx(2.0, abs=1e-6)


def test_without_recordings_there_are_no_trials(sets: ModuleType, tmp_path: Path) -> None:
    assert sets.broad(tmp_path) == sets.gaitmap_pitch(tmp_path) == []


@pytest.mark.parametrize(
    "content",
    [b"", b"\x89HDF\r\n\x1a\n\x02" + bytes(100), b"time,x\n0,1\n", zlib.compress(b"x") + struct.pack("<Q", 8)],
)
def test_other_files_are_refused_by_name(sets: ModuleType, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "trial.hdf5"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"trial\.hdf5"):
        sets.OldHdf5(path)
