"""Toe and heel clearance against optical markers, and geometry found from walking, by the project's own benchmark."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from benchmarks.lib.foot_paths import join_paths
from fes.estimation.clearance.geometry import EstimatedGeometry, estimate_geometry

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FES_DATA") or ROOT.parent / "shared" / "data")
NEEDS_MARKERS = [
    pytest.mark.data,
    pytest.mark.skipif(
        not (DATA / "gaitmap_walk").is_dir(),
        reason=f"no gaitmap_walk in {DATA}; set FES_DATA to the folder that holds it",
    ),
]


@pytest.fixture(scope="module")
def benchmark() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FES_DATA", str(DATA))
        yield importlib.import_module("benchmarks.accuracy.clearance")


@pytest.mark.parametrize("levels", [False, True])
def test_bundled_trials(benchmark: ModuleType, levels: bool) -> None:
    rows = {row.geometry: row for row in benchmark.trial_rows() if row.anchored == levels}
    assert rows["given"].strides > 350
    assert rows["given"].holds, rows["given"]
    estimated = rows["estimated"]
    assert abs(estimated.toe_m[0]) <= 0.004, estimated
    assert estimated.toe_m[1] <= 0.005, estimated
    assert abs(estimated.heel_m[0]) <= 0.006, estimated
    assert estimated.heel_m[1] <= 0.008, estimated


class TestMarkers:
    pytestmark = NEEDS_MARKERS

    def test_a_given_geometry(self, benchmark: ModuleType) -> None:
        """The bar is 0.3 ± 0.6 cm."""
        rows = {(row.geometry, row.anchored): row for row in benchmark.marker_rows(DATA)}
        with_levels, without = rows["given", True], rows["given", False]
        assert with_levels.strides >= 50
        for mean, sd in (with_levels.toe_m, with_levels.heel_m):
            assert abs(mean) <= 0.003, with_levels
            assert sd <= 0.005, with_levels
        # what the contact levels are for
        assert with_levels.toe_m[1] < 0.85 * without.toe_m[1]
        assert with_levels.heel_m[1] < without.heel_m[1]

    def test_an_estimated_geometry_is_better_than_published(self, benchmark: ModuleType) -> None:
        """Published: 1.3 ± 0.9 cm, toe, and 4.1 ± 2.3 cm, heel. The bar of 0.3 ± 0.6 cm it misses by its means."""
        row = next(row for row in benchmark.marker_rows(DATA) if row.geometry == "estimated" and row.anchored)
        assert abs(row.toe_m[0]) <= 0.006, row
        assert abs(row.heel_m[0]) <= 0.025, row
        assert max(row.toe_m[1], row.heel_m[1]) <= 0.006, row


@pytest.mark.data
@pytest.mark.skipif(
    not (DATA / "stroke_treadmill").is_dir(),
    reason=f"no stroke_treadmill in {DATA}; set FES_DATA to the folder that holds it",
)
@pytest.mark.parametrize("patient", ["MR08", "MR11"])
@pytest.mark.parametrize("foot", ["left_foot", "right_foot"])
def test_runs_of_one_patient_give_the_same_geometry(benchmark: ModuleType, patient: str, foot: str) -> None:
    runs = importlib.import_module("benchmarks.lib.real_sets")
    found: list[EstimatedGeometry] = []
    for path in sorted((DATA / "stroke_treadmill").glob(f"{patient}_*.npz")):
        tracks, _ = runs.load_run(path)
        found.append(estimate_geometry(join_paths(benchmark.walked(tracks[foot])[1])))
    assert len(found) >= 3
    assert np.ptp([each.geometry.toe_up_m for each in found]) <= 0.016
    assert np.ptp([each.geometry.toe_forward_m for each in found]) <= 0.012
    assert np.ptp([each.geometry.heel_forward_m for each in found]) <= 0.031
