"""Shank strides on an inverted pendulum with exact truth: reset, lever arm, calibration, stairs, what goes wrong."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from shank_walks import ShankWalk, shank_walk

from benchmarks.accuracy.shank_phases import shank_strides
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.shank.calibration import ShankCalibration, calibrate_shank
from fes.estimation.shank.lever_arm import ANKLE, ARM_BOUNDS_M, SHANK, ArmEstimate, ArmPrior, learn_arm
from fes.estimation.shank.motion import levelled, moving_mean, rotate_each, still_spans, stride_spans, swing_peaks
from fes.estimation.shank.strides import ShankIntegrationSettings
from fes.signals import FloatArray, StrideResult


def calibrated(walk: ShankWalk, *, prior: ArmPrior = SHANK) -> ShankCalibration:
    return calibrate_shank(
        "left_shank", walk.rate_hz, walk.t_ns, walk.acc, walk.gyr, prior=prior, level=walk.rise_m == 0.0
    )


def strides(walk: ShankWalk, calibration: ShankCalibration, arm: FloatArray | None) -> list[StrideResult]:
    settings = replace(
        ShankIntegrationSettings.for_calibration(calibration, incline=0.0 if walk.rise_m == 0.0 else math.nan), arm=arm
    )
    return shank_strides(walk.t_ns, walk.acc, walk.gyr, calibration, settings)


def mean_length(results: list[StrideResult]) -> float:
    return float(np.mean([s.stride_length_m for s in results if s.valid]))


def true_arm(walk: ShankWalk) -> FloatArray:
    return np.asarray(walk.sensor_from_shank @ walk.arm_m)


def estimate(walk: ShankWalk, prior: ArmPrior = SHANK) -> ArmEstimate:
    return calibrated(walk, prior=prior).arm


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


def test_an_ankle_sensor_with_its_own_prior() -> None:
    walk = shank_walk(arm_m=(0.0, 0.02, 0.12), seed=6)
    calibration = calibrated(walk, prior=ANKLE)
    assert calibration.arm.length_m == pytest.approx(0.12, abs=0.02)
    results = strides(walk, calibration, np.array(calibration.arm.arm_m))
    assert mean_length(results) == pytest.approx(walk.stride_length_m, rel=0.015)


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
    up = rotate_each(quaternions, np.tile(walk.sensor_from_shank[:, 2], (len(quaternions), 1)))
    forward = rotate_each(quaternions, np.tile(walk.sensor_from_shank[:, 0], (len(quaternions), 1)))
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


def test_moving_mean_is_the_mean() -> None:
    x = np.arange(10.0)
    np.testing.assert_allclose(moving_mean(x, 3)[1:-1], x[1:-1])
    np.testing.assert_allclose(moving_mean(np.stack((x, 2 * x), 1), 3)[:, 1], 2 * moving_mean(x, 3))
    assert moving_mean(x, 1) is x


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
