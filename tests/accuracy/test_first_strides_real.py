"""Real starts, turns and pauses: few steps stay without a burst. Two-minute walks of stroke survivors, with turns."""

from __future__ import annotations

import importlib
import os
from itertools import islice
from pathlib import Path
from types import ModuleType

import pytest

from fes.config import Stimulation

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FES_DATA") or ROOT.parent / "shared" / "data")
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(
        not (DATA / "unseen_walkers" / "stroke_walks").is_dir(),
        reason=f"no unseen_walkers/stroke_walks in {DATA}; set FES_DATA to the folder that holds them",
    ),
]
FEET = 16  # eight people's, with turns in all of them


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    return importlib.import_module("benchmarks.loop.first_strides")


def test_who_walks_and_turns_and_pauses_goes_on_being_stimulated(benchmark: ModuleType) -> None:
    feet = islice(benchmark.feet_of(DATA, ["stroke_walks"]), FEET)
    found = benchmark.refused_by_set(feet, (Stimulation(), Stimulation(strides_before_start=2)))
    steps, (refused, refused_by_two) = found["stroke_walks"]
    assert steps > 1000
    assert refused <= 0.08 * steps
    assert refused < refused_by_two


def test_of_nobody_walking_there_is_no_burst(benchmark: ModuleType) -> None:
    assert benchmark.bursts_of_nobody(Stimulation()) == 0
