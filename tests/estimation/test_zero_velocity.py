"""Zero-velocity detectors: Skog's formulas, causal and centred windows, thresholds that calibrate themselves."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fes.estimation.zupt.detectors import ACC_TOLERANCE_MPS2, RATE_TOLERANCE_RADPS, Detector, statistic, window_samples
from fes.estimation.zupt.thresholds import find_zero_velocity
from fes.recording import read_recording
from fes.signals import G_MPS2, FloatArray
from fes.simulation.truth import load_truth

UP = np.array([0.0, 0.0, G_MPS2])
BIAS = np.array([0.02, -0.01, 0.03])

SIMULATED = Path(__file__).resolve().parents[2] / "sim_inputs"
EVERY = pytest.mark.parametrize("detector", list(Detector), ids=lambda detector: detector.name)


def noise(count: int, seed: int = 1) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    return rng.normal(0.0, 3.0, (count, 3)) + UP, rng.normal(0.0, 1.0, (count, 3))


def by_the_book(detector: Detector, acc: FloatArray, gyr: FloatArray, g: float) -> float:
    """Skog et al. (2010) on one window, in numpy."""
    mean = acc.mean(axis=0)
    rate = float((gyr**2).sum(axis=1).mean())
    if detector is Detector.SHOE:
        force = float(((acc - g * mean / np.linalg.norm(mean)) ** 2).sum(axis=1).mean())
        return force / ACC_TOLERANCE_MPS2**2 + rate / RATE_TOLERANCE_RADPS**2
    if detector is Detector.MV:
        return float(((acc - mean) ** 2).sum(axis=1).mean())
    if detector is Detector.MAG:
        return float(((np.linalg.norm(acc, axis=1) - g) ** 2).mean())
    return rate if detector is Detector.ARE else float((gyr[0] ** 2).sum())


@EVERY
@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("count", [5, 6])
def test_formulas(detector: Detector, causal: bool, count: int) -> None:
    acc, gyr = noise(300)
    got = statistic(detector, acc, gyr, 100.0, window_s=count / 100.0, causal=causal, gravity_mps2=9.7)
    ahead = 0 if causal else (count - 1) // 2
    for i in range(300):
        own = slice(i, i + 1) if detector is Detector.GYR else slice(max(i + ahead + 1 - count, 0), i + ahead + 1)
        assert got[i] == pytest.approx(by_the_book(detector, acc[own], gyr[own], 9.7), rel=1e-12)


@pytest.mark.parametrize("detector", [Detector.SHOE, Detector.MV, Detector.MAG])
def test_perfect_rest_in_any_attitude_is_nothing(detector: Detector) -> None:
    acc = np.tile(np.array([3.0, -5.0, 7.0]), (30, 1))
    g = float(np.linalg.norm(acc[0]))
    assert statistic(detector, acc, np.zeros((30, 3)), 100.0, gravity_mps2=g) == pytest.approx(np.zeros(30), abs=1e-20)


def test_errata_one_over_w_is_on_both_terms_and_the_norm_is_squared() -> None:
    acc, gyr = np.tile([0.0, 0.0, G_MPS2], (200, 1)), np.tile([0.3, 0.0, 0.4], (200, 1))
    for window_s in (0.02, 0.2):
        values = statistic(Detector.SHOE, acc, gyr, 200.0, window_s=window_s)
        assert values == pytest.approx(np.full(200, 0.25 / RATE_TOLERANCE_RADPS**2))
    shaking = acc + np.random.default_rng(3).normal(0.0, 0.1, acc.shape)
    once = statistic(Detector.MV, shaking, gyr, 200.0)
    twice = statistic(Detector.MV, acc + 2.0 * (shaking - acc), gyr, 200.0)
    assert twice == pytest.approx(4.0 * once)
    assert statistic(Detector.ARE, shaking, gyr, 200.0) == pytest.approx(np.full(200, 0.25))


@EVERY
def test_the_causal_window_does_not_see_the_future(detector: Detector) -> None:
    acc, gyr = noise(80)
    changed_acc, changed_gyr = acc.copy(), gyr.copy()
    changed_acc[50:] += 5.0
    changed_gyr[50:] += 5.0
    causal = [statistic(detector, a, g, 100.0, causal=True) for a, g in ((acc, gyr), (changed_acc, changed_gyr))]
    assert np.array_equal(causal[0][:50], causal[1][:50])
    assert not np.isclose(causal[0][50], causal[1][50])
    if detector is not Detector.GYR:
        centred = [statistic(detector, a, g, 100.0) for a, g in ((acc, gyr), (changed_acc, changed_gyr))]
        assert not np.isclose(centred[0][49], centred[1][49])


def sway(rate_hz: float, noisy: float = 0.01) -> tuple[FloatArray, FloatArray]:
    """Two seconds of standing, then stances and swings of half a second each, the same at any rate."""
    t = np.arange(round(12.0 * rate_hz)) / rate_hz
    swing = np.where((t > 2.0) & (t % 1.0 >= 0.5), np.sin(2.0 * math.pi * (t % 1.0 - 0.5)), 0.0)
    rng = np.random.default_rng(5)
    acc = np.column_stack((12.0 * swing, 0.0 * t, G_MPS2 + 6.0 * swing)) + rng.normal(0.0, 2.0 * noisy, (len(t), 3))
    acc += (swing != 0.0)[:, None] * rng.normal(0.0, 1.5, acc.shape)  # a moving foot shakes
    gyr = np.column_stack((0.5 * swing, 6.0 * swing, 0.0 * t)) + rng.normal(0.0, noisy, (len(t), 3))
    return acc, gyr + BIAS


@EVERY
def test_one_setting_at_any_rate(detector: Detector) -> None:
    shares = []
    for rate_hz in (100.0, 204.8, 500.0, 1000.0):
        acc, gyr = sway(rate_hz)
        calibration, rest, _ = find_zero_velocity(acc, gyr, rate_hz, detector)
        assert calibration.standing
        assert calibration.gyr_bias_radps == pytest.approx((0.02, -0.01, 0.03), abs=0.003)
        shares.append(rest.mean())
    assert max(shares) - min(shares) < 0.04
    assert min(shares) > 0.5  # 7 of 12 s are rest
    assert max(shares) < 0.7


@EVERY
def test_noise_alone_does_not_break_a_rest(detector: Detector) -> None:
    """A sensor twenty times noisier than usual: the measured noise raises the threshold."""
    rng = np.random.default_rng(2)
    acc, gyr = rng.normal(0.0, 0.15, (2000, 3)) + UP, rng.normal(0.0, 0.03, (2000, 3))
    quiet, _, _ = find_zero_velocity(0.05 * (acc - UP) + UP, 0.05 * gyr, 100.0, detector)
    calibration, rest, _ = find_zero_velocity(acc, gyr, 100.0, detector)
    assert calibration.standing
    assert calibration.threshold > quiet.threshold
    assert rest.mean() > 0.998


@EVERY
def test_without_standing_the_quiet_stretches_tell(detector: Detector) -> None:
    acc, gyr = sway(200.0)
    acc, gyr = acc[450:], gyr[450:]
    calibration, rest, _ = find_zero_velocity(acc, gyr, 200.0, detector, use_standing=False)
    assert not calibration.standing
    assert calibration.gyr_bias_radps == (0.0, 0.0, 0.0)
    assert calibration.gravity_mps2 == pytest.approx(G_MPS2, abs=0.05)
    truth = np.arange(len(acc)) / 200.0
    resting = (truth + 2.25) % 1.0 < 0.5
    assert np.mean(rest == resting) > 0.9


def test_gravity_is_the_sensors_own() -> None:
    acc, gyr = sway(100.0)
    acc *= 1.02
    assert find_zero_velocity(acc, gyr, 100.0)[0].gravity_mps2 == pytest.approx(1.02 * G_MPS2, abs=0.01)


def test_turning_at_an_even_rate_is_not_standing() -> None:
    acc, gyr = np.tile([0.0, 0.0, G_MPS2], (300, 1)), np.tile([0.0, 0.0, 1.0], (300, 1))
    assert not find_zero_velocity(acc, gyr, 100.0)[0].standing


def test_long_stillness_does_not_set_the_split() -> None:
    """Half a minute of standing among the steps leaves the quiet-stretch threshold where it is."""
    acc, gyr = sway(100.0)
    long_acc = np.concatenate((np.tile([0.0, 0.0, G_MPS2], (3000, 1)), acc))
    long_gyr = np.concatenate((np.full((3000, 3), 1e-4), gyr))
    both = [
        find_zero_velocity(a, w, 100.0, Detector.ARE, use_standing=False)[0].threshold
        for a, w in ((acc, gyr), (long_acc, long_gyr))
    ]
    assert both[0] == pytest.approx(both[1], rel=0.05)


@pytest.mark.parametrize(
    ("name", "least"), [("both_feet_100hz", 0.87), ("both_feet_200hz", 0.87), ("misaligned", 0.88)]
)
@EVERY
def test_simulated_walks(name: str, least: float, detector: Detector) -> None:
    """F1 against the true speed of the sensor below 0.1 m/s."""
    recording, truth = (load(SIMULATED / f"{name}.parquet") for load in (read_recording, load_truth))
    for sensor, track in recording.tracks.items():
        foot = truth.feet[sensor]
        speed = np.linalg.norm(np.gradient(foot.sensor_m, 1e-9 * foot.t_ns, axis=0), axis=1)
        slow = np.interp(track.t_sensor_ns, foot.t_ns, speed) < 0.1
        _, said, _ = find_zero_velocity(track.acc_mps2, track.gyr_radps, track.rate_hz, detector)
        assert 2.0 * np.count_nonzero(slow & said) / (slow.sum() + said.sum()) > least


def test_what_does_not_fit_is_refused() -> None:
    acc, gyr = noise(50)
    with pytest.raises(ValueError, match=r"shape \(N, 3\)"):
        statistic(Detector.ARE, acc, gyr[:-1], 100.0)
    with pytest.raises(ValueError, match="must be above 0"):
        window_samples(0.0, 100.0)
    with pytest.raises(ValueError, match="too short"):
        find_zero_velocity(acc, gyr, 100.0)


def test_free_fall_has_no_direction_and_is_no_rest() -> None:
    values = statistic(Detector.SHOE, np.zeros((10, 3)), np.zeros((10, 3)), 100.0)
    assert np.all(values > 100.0)
