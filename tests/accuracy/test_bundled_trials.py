"""The bundled trials against their truth: order of phases, times of events, stride lengths, clearances.

The bar is Table 2 of Negård et al. (2005), the better of its two patients in each number: stride length error mean
1.7 cm and SD 1.7 cm, clearance error mean 0.3 cm and SD 0.4 cm. The truth is made by the project itself: what holds
here is that the method does what it should, not how accurate it is on people.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from fes.calibration.recording import calibrate_track
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import stride_settings
from fes.estimation.strides.results import StrideMaker
from fes.recording import read_recording
from fes.signals import FloatArray, StrideResult
from fes.simulation.truth import Truth, TruthStride, load_truth
from statemachine.phases import PhaseChange, Transition

FOLDER = Path(__file__).resolve().parents[2] / "sim_inputs"
BOTH = ("left_foot", "right_foot")
FEET = {
    "negard_patient1": ("right_foot",),
    "negard_patient2": ("right_foot",),
    "both_feet_100hz": BOTH,
    "both_feet_200hz": BOTH,
    "misaligned": BOTH,
    "soft_contact": ("right_foot",),
    "not_walking": BOTH,
}
WALKS = [(name, foot) for name, feet in FEET.items() for foot in feet]
NEGARD = ["negard_patient1", "negard_patient2"]
EVENT_MEAN_S, EVENT_SD_S = 0.015, 0.010
LENGTH_M, CLEARANCE_M = (0.017, 0.017), (0.003, 0.004)


@dataclass(frozen=True)
class Run:
    changes: list[PhaseChange]
    strides: list[StrideResult]
    truth: Truth
    belt_mps: float | None

    def pairs(self, foot: str) -> list[tuple[StrideResult, TruthStride]]:
        """The strides that the truth marks steady, each with the one found that holds its foot off."""
        found = []
        for true in self.truth.strides_of(foot):
            if true.steady and true.walking:
                match = [s for s in self.strides if s.t_start_ns < 1e9 * true.t_swing_s < s.t_end_ns]
                assert len(match) == 1, f"stride {true.number}: {len(match)} found"
                found.append((match[0], true))
        return found


@cache
def run(name: str, foot: str) -> Run:
    path = FOLDER / f"{name}.parquet"
    recording = read_recording(path)
    track = recording.tracks[foot]
    calibration = calibrate_track(track)
    settings = stride_settings(calibration, recording.geometry.get(foot))
    outcomes = FootTracker(calibration, StrideMaker(foot, settings)).advance(
        track.t_sensor_ns, track.acc_mps2, track.gyr_radps
    )
    changes = [outcome for outcome in outcomes if isinstance(outcome, PhaseChange)]
    strides = [outcome for outcome in outcomes if isinstance(outcome, StrideResult)]
    return Run(changes, strides, load_truth(path), recording.belt_speed_mps)


def within(errors: list[float] | FloatArray, mean: float, sd: float, what: str) -> None:
    found = float(np.mean(errors)), float(np.std(errors, ddof=1))
    assert abs(found[0]) <= mean, f"{what}: mean {found[0]:.4f}, SD {found[1]:.4f}"
    assert found[1] <= sd, f"{what}: mean {found[0]:.4f}, SD {found[1]:.4f}"


@pytest.mark.parametrize(("name", "foot"), WALKS)
def test_every_stride_passes_the_phases_in_order(name: str, foot: str) -> None:
    """Of all strides of the walk, steady or not: between one true mid-swing and the next T3, T4, T1, T2, once each."""
    r = run(name, foot)
    landing = [3, 4]
    walked = [true for true in r.truth.strides_of(foot) if true.walking]
    middles = [0.5e9 * (true.t_swing_s + true.t_loading_response_s) for true in walked]
    assert len(walked) >= 9
    for number, (begin, end) in enumerate(pairwise([-math.inf, *middles, math.inf])):
        seen = [c.transition.value for c in r.changes if begin < c.t_ns <= end]
        if number == 0:
            assert seen[-2:] == [1, 2]
        elif number == len(middles):
            assert seen[: len(landing)] == landing
        else:
            assert seen == [*landing, 1, 2], f"from stride {number} to the next"


@pytest.mark.parametrize(("name", "foot"), [w for w in WALKS if w[0] != "not_walking"])
def test_nothing_else_fires(name: str, foot: str) -> None:
    r = run(name, foot)
    count = Counter(change.transition for change in r.changes)
    strides = len(r.truth.strides_of(foot))
    assert count[Transition.T2] == strides
    assert count[Transition.T4] == strides
    assert count[Transition.T5] == count[Transition.T6] == 0
    assert count[Transition.NONE] == 0
    assert len(r.strides) == strides
    assert [s.reason for s in r.strides if not s.valid] == []


@pytest.mark.parametrize(("name", "foot"), WALKS)
def test_foot_off_and_initial_contact(name: str, foot: str) -> None:
    pairs = run(name, foot).pairs(foot)
    offs = [1e-9 * s.t_swing_ns - t.t_swing_s for s, t in pairs if s.t_swing_ns is not None]
    assert len(offs) == len(pairs)
    within(offs, EVENT_MEAN_S, EVENT_SD_S, "foot off (s)")
    contacts = [
        1e-9 * s.t_loading_response_ns - t.t_loading_response_s
        for s, t in pairs
        if s.t_loading_response_ns is not None and t.loading_detectable
    ]
    assert len(contacts) == (0 if name == "soft_contact" else len(pairs))
    if contacts:
        within(contacts, EVENT_MEAN_S, EVENT_SD_S, "initial contact (s)")


@pytest.mark.parametrize(("name", "foot"), WALKS)
def test_heel_rise_and_foot_flat_come_on_time(name: str, foot: str) -> None:
    """Heel rise after 5 mm; foot flat as the simulation's heel and toes are both down."""
    pairs = run(name, foot).pairs(foot)
    rise = [1e-9 * s.t_pre_swing_ns - t.t_pre_swing_s for s, t in pairs if s.t_pre_swing_ns is not None]
    flat = [1e-9 * s.t_stance_ns - t.t_stance_s for s, t in pairs if s.t_stance_ns is not None]
    assert len(rise) == len(flat) == len(pairs)
    assert np.median(rise) < 0.040
    assert np.percentile(rise, 95) < 0.080
    assert abs(np.median(flat)) < 0.030
    assert np.abs(np.percentile(flat, [5, 95])).max() < 0.080


@pytest.mark.parametrize(("name", "foot"), WALKS)
def test_stride_length_and_clearance(name: str, foot: str) -> None:
    pairs = run(name, foot).pairs(foot)
    assert len(pairs) >= 7
    within([s.stride_length_m - t.stride_length_m for s, t in pairs], *LENGTH_M, "stride length (m)")
    within([s.clearance_m - t.clearance_m for s, t in pairs], *CLEARANCE_M, "clearance (m)")


@pytest.mark.parametrize(("name", "foot"), WALKS)
def test_toe_and_heel_clearance_and_turn(name: str, foot: str) -> None:
    pairs = run(name, foot).pairs(foot)
    within([s.toe_clearance_m - t.toe_clearance_m for s, t in pairs], 0.005, 0.006, "toe clearance (m)")
    within([s.heel_clearance_m - t.heel_clearance_m for s, t in pairs], 0.010, 0.008, "heel clearance (m)")
    within([np.degrees(s.turn_rad) - t.turn_deg for s, t in pairs], 1.5, 2.0, "turn (°)")


@pytest.mark.parametrize(("name", "foot"), WALKS)
def test_strides_begin_and_end_where_the_foot_is_quiet(name: str, foot: str) -> None:
    r = run(name, foot)
    truth = r.truth.feet[foot]
    t_s = 1e-9 * truth.t_ns
    speed = np.linalg.norm(np.gradient(truth.sensor_m, t_s, axis=0), axis=1)
    ends = [1e-9 * t for s, _ in r.pairs(foot) for t in (s.t_start_ns, s.t_end_ns)]
    assert np.interp(ends, t_s, speed).max() < 0.05


@pytest.mark.parametrize("name", NEGARD)
def test_against_the_laboratorys_reference(name: str) -> None:
    """As published: the marker at 25 Hz, moved to the belt by Eq. (21), step length by Eq. (22).

    Between its instants the marker's way is interpolated; its noise of 1.5 mm makes the greatest height larger.
    """
    r = run(name, "right_foot")
    assert r.belt_mps is not None
    t_s, x, y, z = r.truth.reference.T
    assert np.median(np.diff(t_s)) == pytest.approx(0.04)
    on_belt = x + r.belt_mps * t_s
    lengths, clearances = [], []
    for s, _ in r.pairs("right_foot"):
        begin, end = 1e-9 * s.t_start_ns, 1e-9 * s.t_end_ns
        along, across = (np.interp(end, t_s, v) - np.interp(begin, t_s, v) for v in (on_belt, y))
        lengths.append(s.stride_length_m - float(np.hypot(along, across)))
        part = (t_s >= begin) & (t_s <= end)
        clearances.append(s.clearance_m - float(z[part].max() - np.interp(begin, t_s, z)))
    assert len(lengths) in (40, 45)
    within(lengths, *LENGTH_M, "stride length (m)")
    within(clearances, *CLEARANCE_M, "clearance (m)")


@pytest.mark.parametrize("name", NEGARD)
def test_the_strides_add_up_to_the_belts_way(name: str) -> None:
    r = run(name, "right_foot")
    pairs = r.pairs("right_foot")
    speed = sum(s.stride_length_m for s, _ in pairs) / sum(1e-9 * (s.t_end_ns - s.t_start_ns) for s, _ in pairs)
    assert speed / (r.belt_mps or 0.0) == pytest.approx(1.0, abs=0.02)
