"""A shank drives the gait phases: features, order, strides, blocks; and what is no walking does not stimulate."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from replays import SETTINGS
from shank_walks import ShankWalk, eased, shank_moved, shank_walk

from benchmarks.accuracy.shank_phases import shank_strides
from fes.config import load_session
from fes.control.controller import Controller
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.numerics.rotation import rotate_all
from fes.estimation.sensor_choice import phase_sensors, shank_phase_sensors
from fes.estimation.shank.calibration import ShankCalibration, calibrate_shank
from fes.estimation.shank.lever_arm import ARM_BOUNDS_M, SHANK, ArmEstimate, learn_arm
from fes.estimation.shank.motion import (
    ShankLevels,
    fit_levels,
    levelled,
    still_spans,
    stride_spans,
    swing_peaks,
    trace_of,
)
from fes.estimation.shank.tracker import ShankIntegrationSettings, ShankTracker
from fes.estimation.tracking.phase_features import LEAST, MOST
from fes.estimation.tracking.tracker import Outcome
from fes.signals import FloatArray, ImuSample, IntArray, OperatorAct, OperatorAction, StimRequest, StrideResult
from statemachine.phases import Phase, PhaseChange, Transition

SENSOR = "right_shank"
ARM_M = (0.02, 0.0, 0.25)
LENGTH_M = 1.2
STRIDE_S = 1.2


@cache
def walk(rate_hz: float = 100.0, rise_m: float = 0.0, stride_length_m: float = LENGTH_M) -> ShankWalk:
    """Ten strides between two stretches of standing, with a jolt at each contact."""
    made = shank_walk(
        strides=10, standing_s=2.0, noise=0.03, rate_hz=rate_hz, rise_m=rise_m, stride_length_m=stride_length_m
    )
    begin_s = 1.9 + 0.3 - 0.4 * STRIDE_S
    width = max(round(0.01 * rate_hz), 1)
    jolt = np.repeat([15.0, -30.0, 15.0], width)  # the heel strikes; adds neither velocity nor height
    for k in range(1, 10):
        at = round((begin_s + k * STRIDE_S) * rate_hz)
        made.acc[at : at + len(jolt)] += jolt[:, None] * made.sensor_from_shank[:, 2]
    return made


@cache
def calibration(rate_hz: float = 100.0, level: bool = True) -> ShankCalibration:
    made = walk(rate_hz) if level else walk(rate_hz, 0.16, 0.7)
    return calibrate_shank(SENSOR, rate_hz, made.t_ns, made.acc, made.gyr, level=level)


def facts(outcomes: list[Outcome]) -> list[tuple[object, ...]]:
    """Everything in the outcomes, to the last bit."""
    return [
        (o.t_ns, o.transition)
        if isinstance(o, PhaseChange)
        else (o.t_start_ns, o.t_end_ns, repr(o.stride_length_m), o.valid, o.trajectory_m.tobytes())
        for o in outcomes
    ]


def advanced(made: ShankWalk, cuts: list[int] | None = None) -> list[Outcome]:
    tracker = ShankTracker(calibration(made.rate_hz))
    edges = [0, *(cuts if cuts is not None else []), len(made.t_ns)]
    outcomes: list[Outcome] = []
    for a, b in pairwise(edges):
        outcomes += tracker.advance(made.t_ns[a:b], made.acc[a:b], made.gyr[a:b])
    return outcomes


@pytest.mark.parametrize("rate_hz", [60.0, 100.0, 204.8, 400.0])
def test_every_stride_passes_the_four_phases_in_order(rate_hz: float) -> None:
    made = walk(rate_hz)
    fired = [o.transition for o in advanced(made) if isinstance(o, PhaseChange)]
    cycle = [Transition.T1, Transition.T2, Transition.T3, Transition.T4]
    first = next(k for k in range(len(fired)) if fired[k : k + 4] == cycle)  # the walk begins in the middle of a stance
    assert first <= 4
    assert fired[first : first + 4 * 8] == cycle * 8


def test_phases_begin_where_the_ankle_says_so() -> None:
    """Foot-off and contact are known exactly; heel-off precedes foot-off; foot-flat comes soon after contact."""
    changes = [o for o in advanced(walk()) if isinstance(o, PhaseChange)]
    begin_s = 1.9 + 0.3 - 0.4 * STRIDE_S
    for k in range(2, 9):
        inside = [c for c in changes if 0.25 <= 1e-9 * c.t_ns - begin_s - k * STRIDE_S < 0.25 + STRIDE_S]
        at = {c.transition: (1e-9 * c.t_ns - begin_s) / STRIDE_S - k for c in inside}
        assert at[Transition.T2] == pytest.approx(0.68, abs=0.1)  # the lean's greatest rate is between 0.6 and 0.7
        assert at[Transition.T3] == pytest.approx(1.0, abs=0.04)
        assert 0.3 < at[Transition.T1] < at[Transition.T2]
        assert at[Transition.T3] < at[Transition.T4] < 1.3


def test_strides_are_wu_et_als_and_causal() -> None:
    strides = [o for o in advanced(walk()) if isinstance(o, StrideResult)]
    valid = [s for s in strides if s.valid]
    assert len(valid) >= 8
    assert np.median([s.stride_length_m for s in valid]) == pytest.approx(LENGTH_M, abs=0.06)
    assert all(s.t_swing_ns is not None and s.t_start_ns < s.t_swing_ns < s.t_end_ns for s in valid)
    assert all(abs(s.height_gained_m) < 1e-9 for s in valid)


def test_stairs_free_the_height() -> None:
    made = walk(100.0, 0.16, 0.7)
    found = calibration(100.0, False)
    outcomes = ShankTracker(found).advance(made.t_ns, made.acc, made.gyr)
    valid = [o for o in outcomes if isinstance(o, StrideResult) and o.valid]
    assert len(valid) >= 7
    assert np.median([s.height_gained_m for s in valid]) == pytest.approx(0.16, abs=0.04)
    assert not ShankCalibration.from_dict(found.to_dict()).level


@pytest.mark.parametrize("level", [True, False])
def test_the_ground_that_a_person_says_counts_from_the_next_stride_on(level: bool) -> None:
    """Over what the calibration says of it, and the other way round."""
    made = walk(100.0, 0.16, 0.7)
    tracker = ShankTracker(calibration(100.0, level))
    half = len(made.t_ns) // 2
    before = tracker.advance(made.t_ns[:half], made.acc[:half], made.gyr[:half])
    tracker.set_incline(np.nan if level else 0.0)
    after = tracker.advance(made.t_ns[half:], made.acc[half:], made.gyr[half:])
    heights = [abs(o.height_gained_m) > 1e-6 for o in [*before, *after] if isinstance(o, StrideResult) and o.valid]
    turns = [at for at in range(1, len(heights)) if heights[at] != heights[at - 1]]
    assert len(turns) == 1
    assert heights[0] != level
    assert turns[0] >= sum(isinstance(o, StrideResult) and o.valid for o in before), "none that was under way"


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(0, len(walk().t_ns)), max_size=6).map(sorted))
def test_blocks_and_samples_give_the_same_bits(cuts: list[int]) -> None:
    assert facts(advanced(walk(), cuts)) == facts(advanced(walk()))


def test_single_samples_give_the_same_bits() -> None:
    assert facts(advanced(walk(), list(range(1, len(walk().t_ns))))) == facts(advanced(walk()))


def test_a_silence_restarts_in_stance() -> None:
    made = walk()
    tracker = ShankTracker(calibration())
    half = len(made.t_ns) // 2
    tracker.advance(made.t_ns[:half], made.acc[:half], made.gyr[:half])
    late = made.t_ns[half:] + 1_000_000_000
    outcomes = tracker.advance(late, made.acc[half:], made.gyr[half:])
    assert isinstance(outcomes[0], PhaseChange)
    assert outcomes[0].transition is Transition.NONE
    assert tracker.counts.restarts == 1
    assert tracker.phase in Phase


def test_nonsense_changes_nothing() -> None:
    made = walk()
    acc = made.acc.copy()
    acc[500] = np.nan
    tracker = ShankTracker(calibration())
    outcomes = tracker.advance(made.t_ns, acc, made.gyr)
    assert tracker.counts.not_finite == 1
    assert sum(isinstance(o, StrideResult) and o.valid for o in outcomes) >= 7


def test_the_ankle_stands_still_in_stance_and_levels_follow_the_walk() -> None:
    made, found = walk(), calibration()
    trace = trace_of(found.parameters(), made.t_ns, made.acc, made.gyr)
    begin_s = 1.9 + 0.3 - 0.4 * STRIDE_S
    stance = [round((begin_s + (k + 0.35) * STRIDE_S) * 100.0) for k in range(3, 9)]
    swing = [round((begin_s + (k + 0.75) * STRIDE_S) * 100.0) for k in range(3, 9)]
    assert trace[stance, 1].max() < 1.0 < 3.0 < trace[swing, 1].min()
    assert trace[stance, 0].min() > 0.0 > trace[[s + 8 for s in swing], 0].max()
    levels = found.levels
    assert trace[stance, 1].max() < levels.still_mps2 < trace[swing, 1].min()
    assert levels.push_off_radps > levels.heel_rise_radps > levels.rest_lean_radps > 0.0
    assert levels.fall_radps > 2.0 * levels.push_off_radps
    assert levels.stride_s == pytest.approx(STRIDE_S, abs=0.05)
    peaks = [trace[s : s + 60, 0].max() for s in stance]
    assert levels.push_off_radps == pytest.approx(np.median(peaks), rel=0.1)


def test_without_strides_the_levels_are_the_usual_ones() -> None:
    assert fit_levels(np.ones((200, 4)), [], 100.0) == ShankLevels()


def test_the_guards_limits_of_a_shank_are_its_levels() -> None:
    levels = calibration().levels
    for each in (levels, replace(levels, push_off_radps=0.3 * levels.fall_radps)):
        p = each.thresholds(swing_at_reversal=True)
        rate = max(p.push_off_radps, 0.5 * p.fall_radps)
        assert p.rest_share * rate == pytest.approx(each.rest_lean_radps)
        assert p.heel_rise_share * rate == pytest.approx(each.heel_rise_radps)
        assert (p.push_off_radps, p.fall_radps, p.stride_s) == (each.push_off_radps, each.fall_radps, each.stride_s)
        assert p.contact_jerk_mps3 == each.contact_jolt_mps3
        assert p.swing_at_reversal is True


def test_measures_of_a_shank_follow_within_bounds() -> None:
    made = walk()
    tracker = ShankTracker(calibration())
    start = tracker.thresholds
    assert start == calibration().levels.thresholds()
    tracker.advance(made.t_ns, made.acc, made.gyr)
    assert tracker.thresholds != start
    for name in ("push_off_radps", "fall_radps", "stride_s", "contact_jerk_mps3"):
        assert LEAST <= getattr(tracker.thresholds, name) / getattr(start, name) <= MOST
    assert tracker.thresholds._replace(**{n: getattr(start, n) for n in start._fields[:6]}) == start


@pytest.mark.parametrize("moves", [False, True])
def test_a_lean_over_a_standing_ankle_is_no_heel_rise(moves: bool) -> None:
    """As fast as at heel rise; only once the ankle goes with it does the heel rise."""
    lean = eased([1.0, 1.4], [0.0, 0.4], 3.0)
    assert np.gradient(lean, 0.01).max() > calibration().levels.heel_rise_radps
    ankle = np.zeros((300, 3))
    if moves:
        ankle[:, 0], ankle[:, 2] = eased([1.0, 1.4], [0.0, 0.2], 3.0), eased([1.0, 1.4], [0.0, 0.1], 3.0)
    made = shank_moved(lean, ankle)
    left = [o.transition for o in ShankTracker(calibration()).advance(*made) if isinstance(o, PhaseChange)]
    assert left[:1] == ([Transition.T1] if moves else [])


def test_the_foot_drives_where_it_has_a_sensor() -> None:
    assert phase_sensors(["left_shank", "right_shank", "right_foot"]) == {
        "left_foot": "left_shank",
        "right_foot": "right_foot",
    }
    assert shank_phase_sensors({SENSOR: calibration()}) == {"right_foot": SENSOR}


def requests_of(made: list[tuple[IntArray, FloatArray, FloatArray]]) -> tuple[list[StimRequest], list[StrideResult]]:
    """What the controller asks for with the only sensor on the right shank; pieces follow one another."""
    controller = Controller(load_session(SETTINGS), {SENSOR: calibration()})
    controller.step(OperatorAct(0, OperatorAction.SET_INTENSITY, 1.0))
    asked: list[StimRequest] = []
    strides: list[StrideResult] = []
    offset = 0
    for t_ns, acc, gyr in made:
        for t, a, g in zip((t_ns + offset).tolist(), acc.tolist(), gyr.tolist(), strict=True):
            decision = controller.step(ImuSample(t, SENSOR, t, (a[0], a[1], a[2]), (g[0], g[1], g[2])))
            asked += decision.requests
            strides += [o for o in decision.outcomes if isinstance(o, StrideResult)]
        offset += int(t_ns[-1]) + 10_000_000
    return asked, strides


def test_a_walking_shank_stimulates_its_foots_channel() -> None:
    made = walk()
    asked, strides = requests_of([(made.t_ns, made.acc, made.gyr)])
    assert any(request.on for request in asked)
    assert {stride.foot for stride in strides} == {SENSOR}


T = np.arange(0.0, 30.0, 0.01)
FIXED = np.zeros((3000, 3))
OVER_AND_OVER = [3.0 * k + s for k in range(10) for s in (0.5, 1.0, 1.6, 2.1)]
RAISED = [FIXED[:, 0], FIXED[:, 0], eased(OVER_AND_OVER, [0.0, 0.06, 0.06, 0.0] * 10, 30.0)]
NOT_WALKING = {
    "seated, the leg swings": shank_moved(np.radians(35) * np.sin(2 * np.pi * 0.8 * T)),
    "seated, slow swings": shank_moved(np.radians(25) * np.sin(2 * np.pi * 0.3 * T)),
    "seated, the knee is stretched and bent": shank_moved(
        eased(OVER_AND_OVER, [0.0, -0.7, -0.7, 0.0] * 10, 30.0),
    ),
    "seated, the foot is put forward and back": shank_moved(
        eased(OVER_AND_OVER, [0.17, -0.44, -0.44, 0.17] * 10, 30.0),
    ),
    "weight shifts": shank_moved(np.radians(3) * np.sin(2 * np.pi * 0.4 * T), FIXED),
    "standing up and sitting down": shank_moved(eased(OVER_AND_OVER, [0.0, 0.35, 0.35, 0.0] * 10, 30.0), FIXED),
    "heel raises": shank_moved(eased(OVER_AND_OVER, [0.0, 0.14, 0.14, 0.0] * 10, 30.0), np.column_stack(RAISED)),
}


@pytest.mark.parametrize("what", NOT_WALKING)
def test_what_is_no_walking_does_not_stimulate(what: str) -> None:
    asked, _ = requests_of([NOT_WALKING[what]])
    assert asked
    assert not any(request.on for request in asked)


# --- Shank strides on an inverted pendulum with exact truth: reset, lever arm, calibration, stairs ---


def calibrated(walk: ShankWalk) -> ShankCalibration:
    return calibrate_shank("left_shank", walk.rate_hz, walk.t_ns, walk.acc, walk.gyr, level=walk.rise_m == 0.0)


def strides(walk: ShankWalk, calibration: ShankCalibration, arm: FloatArray | None) -> list[StrideResult]:
    settings = replace(
        ShankIntegrationSettings.for_calibration(calibration, incline=0.0 if walk.rise_m == 0.0 else math.nan), arm=arm
    )
    return shank_strides(walk.t_ns, walk.acc, walk.gyr, calibration, settings)


def mean_length(results: list[StrideResult]) -> float:
    return float(np.mean([s.stride_length_m for s in results if s.valid]))


def true_arm(walk: ShankWalk) -> FloatArray:
    return np.asarray(walk.sensor_from_shank @ walk.arm_m)


def estimate(walk: ShankWalk) -> ArmEstimate:
    return calibrated(walk).arm


@pytest.mark.parametrize("seed", range(4))
def test_calibration_finds_the_mounting_whatever_it_is(seed: int) -> None:
    walk = shank_walk(seed=seed, noise=0.03)
    calibration = calibrated(walk)
    assert np.array(calibration.left) @ walk.sensor_from_shank[:, 1] > np.cos(np.radians(1.0))
    assert np.array(calibration.up) @ walk.sensor_from_shank[:, 2] > np.cos(np.radians(12.0))  # it leans in mid-stance
    assert calibration.forward() @ walk.sensor_from_shank[:, 0] > np.cos(np.radians(12.0))
    assert np.linalg.norm(calibration.acc_bias_mps2) < 0.05
    assert calibration.axis_confidence > 0.95
    assert calibration.strides == walk.strides - 1


def test_gyroscope_bias_shows_without_standing_still_except_along_gravity() -> None:
    walk = shank_walk(seed=2, gyr_bias_radps=0.01, strides=30)
    bias = 0.01 * np.array([0.6, -0.64, 0.48])
    calibration = calibrated(walk)
    error = np.array(calibration.gyr_bias_radps) - bias
    up = np.array(calibration.up)
    assert not calibration.standing
    assert np.linalg.norm(error - up * (up @ error)) < 0.0015
    standing = calibrated(shank_walk(seed=2, gyr_bias_radps=0.01, strides=4, standing_s=2.0))
    assert standing.standing
    np.testing.assert_allclose(standing.gyr_bias_radps, bias, atol=5e-4)


@pytest.mark.parametrize(("stride_s", "length_m"), [(0.95, 1.6), (1.2, 1.2), (1.8, 0.7), (2.6, 0.5)])
def test_stride_length_with_the_true_arm(stride_s: float, length_m: float) -> None:
    walk = shank_walk(stride_s=stride_s, stride_length_m=length_m, strides=10, seed=1)
    results = strides(walk, calibrated(walk), true_arm(walk))
    assert len(results) == 9
    assert all(s.valid for s in results)
    assert mean_length(results) == pytest.approx(length_m, rel=0.006)
    assert results[4].speed_mps == pytest.approx(length_m / stride_s, rel=0.01)
    assert results[4].trajectory_m.shape == (101, 3)
    assert abs(results[4].turn_rad) < 0.01


def test_resetting_to_zero_is_too_short_and_the_arm_makes_up_for_it() -> None:
    walk = shank_walk(seed=3)
    calibration = calibrated(walk)
    zupt = mean_length(strides(walk, calibration, None))
    learnt = mean_length(strides(walk, calibration, np.array(calibration.arm.arm_m)))
    assert zupt < 0.92 * walk.stride_length_m
    assert learnt == pytest.approx(walk.stride_length_m, rel=0.04)


@pytest.mark.parametrize("length_m", [0.1, 0.2, 0.3, 0.38])
def test_the_shape_of_the_velocity_alone_shows_the_length(length_m: float) -> None:
    arm = estimate(shank_walk(arm_m=(0.02, 0.0, length_m), seed=4))
    assert arm.length_data_m == pytest.approx(length_m, abs=0.012)
    assert arm.learnt
    assert arm.anchored == 0
    # and the estimate lies between the prior and that
    low, high = sorted((SHANK.length_m, arm.length_data_m))
    assert low - 0.005 <= arm.length_m <= high + 0.005


def test_a_walk_from_rest_to_rest_says_more() -> None:
    free = estimate(shank_walk(arm_m=(0.02, 0.0, 0.2), strides=4, seed=5))
    anchored = estimate(shank_walk(arm_m=(0.02, 0.0, 0.2), strides=4, seed=5, standing_s=2.0))
    assert anchored.anchored == 3
    assert anchored.length_data_sd_m < 0.5 * free.length_data_sd_m
    assert anchored.length_data_m == pytest.approx(0.2, abs=0.03)
    # the slower the shank turns in mid-stance the less the arm shows, and the less it matters
    assert abs(anchored.length_m - 0.2) < 0.75 * abs(free.length_m - 0.2)


def test_standing_on_a_belt_that_starts_is_no_rest_to_start_from() -> None:
    arm = estimate(shank_walk(strides=5, seed=5, standing_s=2.0, belt_mps=1.0))
    assert arm.anchored == 0
    assert arm.windows > 0
    assert estimate(shank_walk(strides=30, seed=5, standing_s=2.0)).anchored == 0  # too long to be integrated at once


def test_nothing_to_learn_from_falls_back_to_the_prior_and_says_why() -> None:
    walk = shank_walk(arm_m=(0.02, 0.0, 0.2), even=True, seed=7, strides=20)
    calibration = calibrated(walk)
    arm = calibration.arm
    assert not arm.learnt
    assert "hardly changes" in arm.reason
    assert arm.length_m == SHANK.length_m
    np.testing.assert_allclose(arm.arm_m, SHANK.length_m * np.array(calibration.up), atol=1e-9)


def test_too_few_windows_or_none_fall_back() -> None:
    walk = shank_walk(seed=8)
    up, left = walk.sensor_from_shank[:, 2], walk.sensor_from_shank[:, 1]
    nothing = learn_arm(walk.t_ns, walk.acc, walk.gyr, [], up, left)
    assert not nothing.learnt
    assert nothing.windows == 0
    assert nothing.condition == np.inf
    assert nothing.length_data_sd_m == np.inf
    np.testing.assert_allclose(nothing.arm_m, 0.3 * up)


@pytest.mark.parametrize("seed", range(12))
def test_noise_never_makes_a_wild_arm(seed: int) -> None:
    walk = shank_walk(seed=seed, strides=6)
    rng = np.random.default_rng(seed)
    up, left = walk.sensor_from_shank[:, 2], walk.sensor_from_shank[:, 1]
    spans = stride_spans(walk.gyr, swing_peaks(walk.gyr @ left, walk.rate_hz), walk.rate_hz)
    acc = walk.acc + rng.normal(0.0, 10.0 ** (seed / 4.0 - 1.0), walk.acc.shape)
    gyr = walk.gyr * (1.0 + 0.3 * rng.standard_normal(3))
    arm = learn_arm(walk.t_ns, acc, gyr, spans, up, left)
    assert np.all(np.isfinite(arm.arm_m))
    assert ARM_BOUNDS_M[0] <= arm.length_m <= ARM_BOUNDS_M[1]
    assert np.linalg.norm(np.array(arm.arm_m) - 0.3 * up) < 3.0 * np.linalg.norm((0.05, 0.05, 0.02)) + 1e-9


@pytest.mark.parametrize("rise_m", [0.32, -0.32])
def test_stairs_report_the_height_gained(rise_m: float) -> None:
    walk = shank_walk(rise_m=rise_m, stride_length_m=0.6, stride_s=1.4, strides=8, seed=9)
    calibration = calibrated(walk)
    results = strides(walk, calibration, true_arm(walk))
    assert np.mean([s.height_gained_m for s in results]) == pytest.approx(rise_m, abs=0.01)
    assert mean_length(results) == pytest.approx(0.6, abs=0.01)
    learnt = shank_strides(
        walk.t_ns,
        walk.acc,
        walk.gyr,
        calibration,
        ShankIntegrationSettings.for_calibration(calibration, incline=math.nan),
    )
    assert np.mean([s.height_gained_m for s in learnt]) == pytest.approx(rise_m, abs=0.03)
    level = shank_strides(
        walk.t_ns,
        walk.acc,
        walk.gyr,
        calibration,
        ShankIntegrationSettings.for_calibration(calibration, incline=0.0),
    )
    assert max(abs(s.height_gained_m) for s in level) < 1e-9


def test_a_wobble_of_the_strap_hardly_matters() -> None:
    walk = shank_walk(seed=10)
    t = 1e-9 * walk.t_ns
    wobble = 0.6 * np.sin(2 * np.pi * 9.0 * t)[:, None] * walk.sensor_from_shank[:, 1]
    calibration = calibrated(walk)
    shaken = replace(walk, gyr=walk.gyr + wobble)
    assert mean_length(strides(shaken, calibration, true_arm(walk))) == pytest.approx(walk.stride_length_m, rel=0.02)


def test_a_pause_between_strides_costs_no_stride_and_makes_none() -> None:
    walk = shank_walk(strides=5, standing_s=2.0, seed=11)
    # the same walk twice, one after the other
    t_ns = np.concatenate((walk.t_ns, walk.t_ns + walk.t_ns[-1] + walk.t_ns[1]))
    acc, gyr = np.concatenate((walk.acc, walk.acc)), np.concatenate((walk.gyr, walk.gyr))
    calibration = calibrated(walk)
    results = shank_strides(
        t_ns, acc, gyr, calibration, replace(ShankIntegrationSettings.for_calibration(calibration), arm=true_arm(walk))
    )
    assert len(results) == 10
    # from standing to standing the sensor has gone as far as the ankle
    whole = [sum(s.stride_length_m for s in part) for part in (results[:5], results[5:])]
    np.testing.assert_allclose(whole, 5 * walk.stride_length_m, rtol=0.003)


def test_missing_samples_make_the_stride_invalid_with_the_reason() -> None:
    walk = shank_walk(seed=12)
    calibration = calibrated(walk)
    keep = np.ones(len(walk.t_ns), dtype=bool)
    keep[600:612] = False
    results = shank_strides(walk.t_ns[keep], walk.acc[keep], walk.gyr[keep], calibration)
    bad = [s for s in results if not s.valid]
    assert 1 <= len(bad) <= 2  # the gap may lie in the window that two strides share
    assert "samples missing" in bad[0].reason
    assert np.isnan(bad[0].stride_length_m)


def test_shaking_without_a_slow_stance_makes_no_valid_stride() -> None:
    t_ns = (10_000_000 * np.arange(1000)).astype(np.int64)
    left = np.array([0.0, 1.0, 0.0])
    # turning fast all the time, to and fro once a second
    rate = np.where(np.sin(2 * np.pi * 1e-9 * t_ns) > 0.0, 8.0, -10.0)
    gyr = rate[:, None] * left
    spans = stride_spans(gyr, swing_peaks(gyr @ left, 100.0), 100.0)
    assert spans
    assert not any(span.quiet for span in spans)
    walk = shank_walk()
    calibration = replace(calibrated(walk), left=(0.0, 1.0, 0.0), up=(0.0, 0.0, 1.0), gyr_bias_radps=(0.0, 0.0, 0.0))
    results = shank_strides(t_ns, np.tile((0.0, 0.0, 9.81), (1000, 1)), gyr, calibration)
    assert results
    assert not any(s.valid for s in results)
    assert "does not turn slowly" in results[0].reason


def test_levelled_puts_gravity_upright_over_the_stride() -> None:
    walk = shank_walk(seed=13)
    spans = stride_spans(walk.gyr, swing_peaks(walk.gyr @ walk.sensor_from_shank[:, 1], 100.0), 100.0)
    span = spans[4]
    quaternions = levelled(walk.t_ns, walk.acc, walk.gyr, (span.first, span.last), 5)
    assert quaternions.shape == (span.last - span.first + 11, 4)
    up = rotate_all(quaternions, walk.sensor_from_shank[:, 2])
    forward = rotate_all(quaternions, walk.sensor_from_shank[:, 0])
    lean = np.degrees(np.arctan2(-forward[:, 2], up[:, 2]))
    assert lean.max() == pytest.approx(38.0, abs=1.5)
    assert lean.min() == pytest.approx(-24.0, abs=1.5)


def test_still_spans_are_the_standing() -> None:
    walk = shank_walk(standing_s=2.0, strides=3, seed=14)
    rests = still_spans(walk.acc, walk.gyr, walk.rate_hz)
    assert len(rests) == 2
    assert rests[0][0] < 20
    assert 120 < rests[0][1] < 230
    assert still_spans(shank_walk(seed=14).acc, shank_walk(seed=14).gyr, 100.0) == []


def test_calibration_survives_the_session_log() -> None:
    calibration = calibrated(shank_walk())
    data = calibration.to_dict()
    data["up"] = list(data["up"])
    data["arm"]["arm_m"] = list(data["arm"]["arm_m"])
    assert ShankCalibration.from_dict(data) == calibration


def test_calibration_refuses_what_shows_no_walk() -> None:
    walk = shank_walk()
    with pytest.raises(CalibrationError, match="too short"):
        calibrate_shank("left_shank", 100.0, walk.t_ns[:200], walk.acc[:200], walk.gyr[:200])
    with pytest.raises(CalibrationError, match="acc_unit"):
        calibrate_shank("left_shank", 100.0, walk.t_ns, walk.acc / 9.81, walk.gyr)
    still = np.tile((0.0, 0.0, 9.81), (2000, 1))
    t_ns = (10_000_000 * np.arange(2000)).astype(np.int64)
    with pytest.raises(CalibrationError, match="fewer than 3 strides"):
        calibrate_shank("left_shank", 100.0, t_ns, still, np.zeros((2000, 3)))
    to_and_fro = 3.0 * np.sin(2 * np.pi * 1e-9 * t_ns)[:, None] * np.array([0.0, 1.0, 0.0])
    with pytest.raises(CalibrationError, match="strides"):
        calibrate_shank("left_shank", 100.0, t_ns, still, to_and_fro)
