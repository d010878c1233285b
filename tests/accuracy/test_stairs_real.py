"""Real stairs, of which nobody has told the session: no stride up them teaches the tuning anything."""

from __future__ import annotations

import importlib
import math
import os
from pathlib import Path

import pytest

from fes.analysis.pipeline import analyse, calibrations_of
from fes.config import Ground
from fes.stimulation.ground import GroundWatch

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FES_DATA") or ROOT.parent / "shared" / "data")
LEAST_STEP_M = 0.1  # a step of stairs is at least half as high again
SAME_SWING_NS = 150_000_000


@pytest.mark.data
@pytest.mark.skipif(
    not (DATA / "gaitmap_walk").is_dir(),
    reason=f"no gaitmap_walk in {DATA}; set FES_DATA to the folder that holds it",
)
def test_every_stride_up_the_stairs_is_skipped() -> None:
    walk = importlib.import_module("benchmarks.lib.real_sets").stairs(DATA)
    live_strides = importlib.import_module("benchmarks.accuracy.inclines").live_strides
    climbed = [
        (stride.foot, stride.t_swing_ns)
        for stride in analyse(walk, ground=Ground(free=True)).strides
        if stride.valid and stride.t_swing_ns is not None and stride.height_gained_m > LEAST_STEP_M
    ]
    taught, skipped = [], 0
    for foot, calibration in calibrations_of(walk, incline=math.nan)[1].calibrations.items():
        watch = GroundWatch()
        for stride in live_strides(walk.tracks[foot], calibration, None, Ground()):
            reason = watch.unusual(stride) if stride.valid else "not measured"
            begun_ns = stride.t_swing_ns or 0
            if any(foot == other and abs(begun_ns - t_ns) < SAME_SWING_NS for other, t_ns in climbed):
                skipped += bool(reason)
                taught += [] if reason else [stride]
    assert len(climbed) >= 30  # of 40 by both feet; the others are on the floor before and after
    assert skipped == len(climbed)
    assert not taught
