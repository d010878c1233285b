"""The orientation filter of a moving body: arithmetic, heading, clipping, bias, lost samples, and ten hours."""

from __future__ import annotations

import importlib
import math
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fes.estimation.numerics.rotation import quaternion_step, to_sensor, to_world
from fes.estimation.orientation.body import OrientationPath, run, smooth_orientation, track_orientation
from fes.estimation.orientation.filter import NO_RANGE, STATES, BodySettings, measure, mirror, new_state, propagate_rows
from fes.signals import G_MPS2, FloatArray

RATE_HZ = 100.0
DT_S = 1.0 / RATE_HZ
SETTINGS = BodySettings()


def rotation(q: FloatArray) -> Rotation:
    return Rotation.from_quat(np.roll(q, -1, axis=-1))


def tilt_deg(path: OrientationPath, true_up: FloatArray) -> FloatArray:
    """Inclination error (N,) against upward directions in the sensor frame."""
    up = rotation(path.quaternion).inv().apply([0.0, 0.0, 1.0])
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(up, true_up), axis=1), np.sum(up * true_up, axis=1)))


def moved_by_hand(seed: int, seconds: float, rate_hz: float = RATE_HZ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Force, rate and true upward direction (N, 3) of a body that is turned and shaken: smooth, random, exact."""
    rng = np.random.default_rng(seed)
    n = round(seconds * rate_hz)
    t = np.arange(n) / rate_hz
    rate, push = np.zeros((n, 3)), np.zeros((n, 3))
    for j in range(3):
        for _ in range(4):
            hz, size, phase = rng.uniform(0.1, 0.8), rng.uniform(0.2, 1.2), rng.uniform(0.0, 7.0)
            rate[:, j] += size * np.sin(2.0 * math.pi * hz * t + phase)
            hz, size = rng.uniform(0.4, 1.2), rng.uniform(0.1, 1.0)
            push[:, j] += size * np.cos(2.0 * math.pi * hz * t + phase)
    attitude = np.empty((n, 4))
    q = (1.0, 0.0, 0.0, 0.0)
    for k in range(n):
        q = quaternion_step(*q, *(rate[k] / rate_hz))
        attitude[k] = q
    back = rotation(attitude).inv()
    force = back.apply(push + np.array([0.0, 0.0, G_MPS2]))
    return force + 0.02 * rng.normal(size=(n, 3)), rate + 0.002 * rng.normal(size=(n, 3)), back.apply([0.0, 0.0, 1.0])


# --- arithmetic ------------------------------------------------------------------------------------------


def random_covariance(rng: np.random.Generator) -> FloatArray:
    factor = rng.normal(size=(STATES, STATES)) * np.array([0.05] * 3 + [0.01] * 3 + [0.3] * 2 + [0.05] * 3)[:, None]
    return np.ascontiguousarray(factor @ factor.T + 1e-9 * np.eye(STATES))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_carrying_and_measuring_are_the_matrices(seed: int) -> None:
    rng = np.random.default_rng(seed)
    attitude = Rotation.random(random_state=seed % 2**31)
    state = new_state(SETTINGS, quaternion=np.roll(attitude.as_quat(), 1))
    state.covariance[:] = random_covariance(rng)
    state.velocity[:] = rng.normal(size=2)
    before = state.covariance.copy()
    phi = np.diag([1.0] * 3 + [0.999] * 3 + [0.99] * 2 + [1.0] * 3)
    phi[:3, 3:6] = -attitude.as_matrix() * DT_S
    phi[6:8, 8:] = -attitude.as_matrix()[:2] * DT_S
    phi[6, 1], phi[7, 0] = G_MPS2 * DT_S, -G_MPS2 * DT_S
    propagate_rows(state.covariance, state.quaternion, DT_S, 0.999, 0.99)
    propagate_rows(state.covariance.T, state.quaternion, DT_S, 0.999, 0.99)
    expected = phi @ before @ phi.T
    np.testing.assert_allclose(state.covariance, expected, rtol=1e-10, atol=1e-14)

    at, variance, residual = int(rng.choice([3, 4, 5, 6, 7])), float(rng.uniform(1e-4, 1.0)), float(rng.normal())
    gain = expected[:, at] / (expected[at, at] + variance)
    gain[2] = 0.0
    left = np.eye(STATES)
    left[:, at] -= gain
    velocity, heading = state.velocity.copy(), state.covariance[2, 2]
    measure(state, at, residual, variance)
    mirror(state.covariance)
    np.testing.assert_allclose(
        state.covariance, left @ expected @ left.T + variance * np.outer(gain, gain), rtol=1e-9, atol=1e-14
    )
    assert np.array_equal(state.covariance, state.covariance.T)
    assert np.linalg.eigvalsh(state.covariance).min() > 0.0
    np.testing.assert_allclose(state.bias, gain[3:6] * residual, rtol=1e-12)
    np.testing.assert_allclose(state.velocity, velocity + gain[6:8] * residual, rtol=1e-12)
    np.testing.assert_allclose(state.force_bias, gain[8:] * residual, rtol=1e-12)
    turned = (rotation(state.quaternion) * attitude.inv()).as_rotvec()
    np.testing.assert_allclose(turned[:2], gain[:2] * residual, rtol=1e-6, atol=1e-12)
    # heading: neither it nor its variance
    assert abs(turned[2]) < 1e-12
    assert state.covariance[2, 2] == pytest.approx(heading, rel=1e-12)


def hostile_block(seed: int) -> tuple[FloatArray, FloatArray, np.ndarray]:
    acc, gyr, _ = moved_by_hand(seed, 4.0)
    rng = np.random.default_rng(seed)
    gyr = np.clip(gyr, -1.5, 1.5)
    acc = np.clip(acc, -11.0, 11.0)
    acc[rng.integers(0, 400, 5)] = np.nan
    gyr[rng.integers(0, 400, 5), 1] = np.inf
    return acc, gyr, rng.random(400) < 0.2


class Stepped:
    """The causal filter, block by block."""

    def __init__(
        self, rate_hz: float, settings: BodySettings = SETTINGS, ranges: tuple[float, float] = (NO_RANGE, NO_RANGE)
    ) -> None:
        self.state, self.more = new_state(settings), (1.0 / rate_hz, np.array(ranges), settings)

    def advance(self, acc: ArrayLike, gyr: ArrayLike, rest: ArrayLike | None = None) -> OrientationPath:
        acc, gyr = np.atleast_2d(np.asarray(acc)), np.atleast_2d(np.asarray(gyr))
        return run(self.state, acc, gyr, np.zeros(len(acc), bool) if rest is None else np.atleast_1d(rest), *self.more)


@given(st.integers(0, 20), st.lists(st.integers(1, 399), max_size=6, unique=True))
@settings(max_examples=30, deadline=None)
def test_blocks_are_samples_to_the_bit(seed: int, cuts: list[int]) -> None:
    acc, gyr, rest = hostile_block(seed)
    whole = track_orientation(acc, gyr, RATE_HZ, zero_velocity=rest, acc_range_mps2=11.0, gyr_range_radps=1.5)
    assert np.isfinite(whole.quaternion).all()
    tracker = Stepped(RATE_HZ, ranges=(11.0, 1.5))
    edges = [0, *sorted(cuts), 400]
    parts = [tracker.advance(acc[a:b], gyr[a:b], rest[a:b]) for a, b in pairwise(edges)]
    assert np.concatenate([part.quaternion for part in parts]).tobytes() == whole.quaternion.tobytes()
    assert np.concatenate([part.tilt_sd_rad for part in parts]).tobytes() == whole.tilt_sd_rad.tobytes()
    single = Stepped(RATE_HZ, ranges=(11.0, 1.5))
    for k in range(400):
        single.advance(acc[k], gyr[k], rest[k])
    assert single.state.quaternion.tobytes() == whole.quaternion[-1].tobytes()
    assert single.state.covariance.tobytes() == tracker.state.covariance.tobytes()
    assert tracker.state.bias.tobytes() == whole.gyr_bias_radps.tobytes()


# --- heading and mounting --------------------------------------------------------------------------------


@given(st.integers(0, 50), st.integers(0, 2**31 - 1))
@settings(max_examples=20, deadline=None)
def test_inclination_does_not_depend_on_how_the_sensor_is_mounted(seed: int, mounting: int) -> None:
    acc, gyr, _ = moved_by_hand(seed, 5.0)
    turn = Rotation.random(random_state=mounting)
    up = rotation(track_orientation(acc, gyr, RATE_HZ).quaternion).inv().apply([0.0, 0.0, 1.0])
    other = rotation(track_orientation(turn.apply(acc), turn.apply(gyr), RATE_HZ).quaternion).inv()
    np.testing.assert_allclose(turn.inv().apply(other.apply([0.0, 0.0, 1.0])), up, atol=3e-4)


@given(st.integers(0, 50), st.floats(-3.0, 3.0))
@settings(max_examples=20, deadline=None)
def test_heading_follows_the_gyroscope_alone(seed: int, tilt_error: float) -> None:
    """Level turning with a wildly wrong force: the heading is the integral of the rate, its variance never shrinks."""
    rng = np.random.default_rng(seed)
    n = 300
    rate = np.zeros((n, 3))
    rate[:, 2] = rng.uniform(-2.0, 2.0)
    force = np.array([0.0, 0.0, G_MPS2]) + np.zeros((n, 3))
    force[50:, 0] += tilt_error * np.sin(np.arange(n - 50) / 9.0)
    settings_ = SETTINGS._replace(start_bias_radps=1e-9, bias_walk_radps2_rthz=0.0)
    tracker = Stepped(RATE_HZ, settings_)
    last = 0.0
    for k in range(n):
        tracker.advance(force[k], rate[k])
        assert tracker.state.covariance[2, 2] >= last
        last = tracker.state.covariance[2, 2]
    w, x, y, z = tracker.state.quaternion
    heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    expected = float(rate[1:, 2].sum() * DT_S)
    # a body that tilts while it turns has no exact heading: second order in the tilt
    slack = 1e-9 if tilt_error == 0.0 else 0.02
    assert abs((heading - expected + math.pi) % (2.0 * math.pi) - math.pi) < slack


# --- clipping and lost samples ---------------------------------------------------------------------------


def swings(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A body that rests, swings to and fro with a peak of 12 rad/s and rests, eight times, about any level axis."""
    rng = np.random.default_rng(seed)
    n = 1200
    t = np.arange(n) * DT_S
    beat = t % 1.5
    size = np.where((beat > 0.8) & (beat < 1.3), 12.0 * np.sin(2.0 * math.pi * (beat - 0.8) / 0.5), 0.0)
    size *= np.where(size > 0.0, 1.0, 0.8)  # asymmetric: only one half clips
    angle = rng.uniform(0.0, 2.0 * math.pi)
    rate = size[:, None] * np.array([math.cos(angle), math.sin(angle), 0.0])
    attitude = np.empty((n, 4))
    q = (1.0, 0.0, 0.0, 0.0)
    for k in range(n):
        q = quaternion_step(*q, *(rate[k] * DT_S))
        attitude[k] = q
    back = rotation(attitude).inv()
    noise = rng.normal(size=(2, n, 3))
    return back.apply([0.0, 0.0, G_MPS2]) + 0.05 * noise[0], rate + 0.002 * noise[1], back.apply([0.0, 0.0, 1.0])


@pytest.mark.parametrize("seed", range(6))
def test_a_clipped_turn_is_continued_and_doubted(seed: int) -> None:
    acc, gyr, up = swings(seed)
    limit = 0.75 * float(np.abs(gyr).max())
    clipped = np.clip(gyr, -limit, limit)
    aware = track_orientation(acc, clipped, RATE_HZ, gyr_range_radps=limit)
    naive = track_orientation(acc, clipped, RATE_HZ)
    at_limit = (np.abs(clipped) >= 0.999 * limit).any(axis=1)
    moving = np.abs(gyr).max(axis=1) > 0.5
    errors = [math.sqrt(np.mean(tilt_deg(path, up)[moving] ** 2)) for path in (aware, naive)]
    assert errors[0] < 0.6 * errors[1], errors
    inside = np.flatnonzero(at_limit[1:] & at_limit[:-1]) + 1
    assert (aware.tilt_sd_rad[inside] > aware.tilt_sd_rad[inside - 1]).all()
    assert aware.tilt_sd_rad[inside].mean() > 2.0 * naive.tilt_sd_rad[inside].mean()
    # the doubt is about right: not less than the error, nor many times it
    nees = np.radians(tilt_deg(aware, up)[at_limit]) ** 2 / (2.0 * aware.tilt_sd_rad[at_limit] ** 2)
    assert 0.02 < nees.mean() < 2.0


def test_a_clipped_force_is_no_gravity() -> None:
    """A blow of 100 g·ms on a sensor of 2 g: the part beyond the range is lost, and the filter must not lean."""
    acc, gyr, up = moved_by_hand(3, 20.0)
    for begin in range(200, 2000, 150):
        acc[begin : begin + 10, 0] += 95.0
        acc[begin + 10 : begin + 20, 0] -= 30.0
    clipped = np.clip(acc, -2 * G_MPS2, 2 * G_MPS2)
    aware = track_orientation(clipped, gyr, RATE_HZ, acc_range_mps2=2 * G_MPS2)
    naive = track_orientation(clipped, gyr, RATE_HZ)
    errors = [math.sqrt(np.mean(tilt_deg(path, up)[300:] ** 2)) for path in (aware, naive)]
    assert errors[0] < 0.8 * errors[1], errors


def test_lost_samples_are_bridged_and_doubted() -> None:
    acc, gyr, up = moved_by_hand(7, 20.0)
    acc[1000:1010], gyr[1000:1010] = np.nan, np.nan
    path = track_orientation(acc, gyr, RATE_HZ)
    assert np.isfinite(path.quaternion).all()
    assert path.tilt_sd_rad[1009] > 2.0 * path.tilt_sd_rad[999]
    assert tilt_deg(path, up)[-1] < 3.0
    first = track_orientation(np.full((3, 3), np.nan), np.full((3, 3), np.nan), RATE_HZ)
    assert first.quaternion.tolist() == [[1.0, 0.0, 0.0, 0.0]] * 3


# --- bias ------------------------------------------------------------------------------------------------


def test_the_bias_is_a_markov_process() -> None:
    """Without measurements it decays as exp(-t/T), and its variance goes to walk² T / 2 whatever it was."""
    settings_ = SETTINGS._replace(bias_time_s=20.0, bias_walk_radps2_rthz=1e-3, start_bias_radps=0.05)
    tracker = Stepped(10.0, settings_)
    still = [0.0, 0.0, G_MPS2]
    for _ in range(100):
        tracker.advance(still, [0.01, -0.02, 0.005])
    learnt = tracker.state.bias.copy()
    assert abs(learnt[0] - 0.01) < 0.002
    lost = [math.nan] * 3
    for _ in range(200):
        tracker.advance(lost, lost)
    np.testing.assert_allclose(tracker.state.bias, learnt * math.exp(-1.0), rtol=1e-6)
    for _ in range(2000):
        tracker.advance(lost, lost)
    np.testing.assert_allclose(np.diag(tracker.state.covariance)[3:6], 1e-6 * 20.0 / 2.0, rtol=0.01)


def test_the_bias_is_found_in_movement_and_at_once_in_stillness() -> None:
    bias = np.array([0.008, -0.006, 0.007])
    acc, gyr, up = moved_by_hand(11, 120.0)
    path = track_orientation(acc, gyr + bias, RATE_HZ)
    assert np.abs(path.gyr_bias_radps - bias).max() < 0.0025
    assert math.sqrt(np.mean(tilt_deg(path, up)[3000:] ** 2)) < 1.0
    rng = np.random.default_rng(1)
    still = np.array([0.0, 0.0, G_MPS2]) + 0.05 * rng.normal(size=(500, 3))
    quiet = track_orientation(still, bias + 0.002 * rng.normal(size=(500, 3)), RATE_HZ)
    np.testing.assert_allclose(quiet.gyr_bias_radps, bias, atol=5e-4)


# --- known rest, smoothing, hours ------------------------------------------------------------------------


def test_known_rest_helps() -> None:
    """A walking foot whose mean speed is not zero; the stance is where it rests."""
    n = 3000
    t = np.arange(n) * DT_S
    beat = t % 1.2
    swing = beat > 0.7
    push = np.where(swing, 25.0 * np.sin(2.0 * math.pi * (beat - 0.7) / 0.5), 0.0)
    rng = np.random.default_rng(2)
    acc = np.column_stack((push, np.zeros(n), np.full(n, G_MPS2))) + 0.2 * rng.normal(size=(n, 3))
    gyr = 0.01 * rng.normal(size=(n, 3)) + 0.004
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    with_rest = track_orientation(acc, gyr, RATE_HZ, zero_velocity=~swing)
    without = track_orientation(acc, gyr, RATE_HZ)
    late = slice(600, None)
    assert np.mean(tilt_deg(with_rest, up)[late] ** 2) < 0.7 * np.mean(tilt_deg(without, up)[late] ** 2)
    assert with_rest.tilt_sd_rad[late].mean() < without.tilt_sd_rad[late].mean()


def test_the_future_helps() -> None:
    ratios = []
    for seed in range(6):
        acc, gyr, up = moved_by_hand(seed, 40.0)
        gyr = gyr + np.array([0.006, -0.004, 0.005])
        causal, smoothed = (f(acc, gyr, RATE_HZ) for f in (track_orientation, smooth_orientation))
        ratios.append(float(np.mean(tilt_deg(smoothed, up) ** 2) / np.mean(tilt_deg(causal, up) ** 2)))
        assert (smoothed.tilt_sd_rad[500:] <= causal.tilt_sd_rad[500:] * 1.05).all()
        np.testing.assert_allclose(np.linalg.norm(smoothed.quaternion, axis=1), 1.0, atol=1e-9)
    assert np.median(ratios) < 0.7, ratios


@numba.njit
def _carried(
    n: int, first: int, rate_hz: float, q: FloatArray, bias: FloatArray, noise: FloatArray,
    acc: FloatArray, gyr: FloatArray, up: FloatArray,
) -> None:  # fmt: skip
    """A body that somebody carries about: it turns, sways at 0.3 to 0.6 Hz, rests every fifth minute."""
    dt = 1.0 / rate_hz
    for k in range(n):
        t = (first + k) * dt
        moving = 0.0 if t % 300.0 < 20.0 else 1.0
        w0, w1, w2 = 1.0 * math.sin(0.9 * t), 0.7 * math.sin(1.3 * t + 1.0), 0.5 * math.sin(0.31 * t)
        q[0], q[1], q[2], q[3] = quaternion_step(
            q[0], q[1], q[2], q[3], moving * w0 * dt, moving * w1 * dt, moving * w2 * dt
        )
        a0, a1 = 1.5 * math.sin(2.9 * t + math.sin(0.11 * t)), 1.2 * math.sin(2.1 * t + 2.0)
        f0, f1, f2 = to_sensor(q[0], q[1], q[2], q[3], moving * a0, moving * a1, 9.80665)
        acc[k, 0], acc[k, 1], acc[k, 2] = f0 + 20.0 * noise[k, 3], f1 + 20.0 * noise[k, 4], f2 + 20.0 * noise[k, 5]
        for j in range(3):
            bias[j] += 2e-5 * math.sqrt(dt) * noise[k, 6 + j] * 500.0 - bias[j] * dt / 3600.0
        gyr[k, 0] = moving * w0 + bias[0] + noise[k, 0]
        gyr[k, 1] = moving * w1 + bias[1] + noise[k, 1]
        gyr[k, 2] = moving * w2 + bias[2] + noise[k, 2]
        up[k, 0], up[k, 1], up[k, 2] = to_sensor(q[0], q[1], q[2], q[3], 0.0, 0.0, 1.0)


def test_ten_hours() -> None:
    """900 000 samples: the covariance stays one and bounded, the errors are what it says, the heading only loses."""
    rng = np.random.default_rng(9)
    rate_hz, n = 25.0, 22_500
    tracker = Stepped(rate_hz)
    q, bias = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.004, -0.005, 0.003])
    acc, gyr, up = (np.empty((n, 3)) for _ in range(3))
    nees, greatest, headings = [], [], []
    for part in range(40):  # a quarter of an hour each
        noise = 0.002 * rng.normal(size=(n, 9))
        _carried(n, part * n, rate_hz, q, bias, noise, acc, gyr, up)
        path = tracker.advance(acc, gyr)
        covariance = tracker.state.covariance
        assert np.array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance)[0] > 0.0
        assert abs(np.linalg.norm(path.quaternion[-1]) - 1.0) < 1e-12
        error_deg = tilt_deg(path, up)
        settled = slice(2000 if part == 0 else 0, None)
        nees.append(float(np.mean(np.radians(error_deg[settled]) ** 2 / (2.0 * path.tilt_sd_rad[settled] ** 2))))
        greatest.append(float(error_deg[settled].max()))
        assert path.tilt_sd_rad[settled].max() < math.radians(3.0)
        assert np.abs(path.gyr_bias_radps - bias).max() < 0.003
        headings.append(float(covariance[2, 2]))
    assert 0.1 < np.mean(nees) < 1.5, nees
    assert max(nees) < 2.5, nees
    assert max(greatest) < 3.0, greatest
    assert np.mean(nees[20:]) < 1.5 * np.mean(nees[:20])  # no worse for lasting
    assert headings[-1] > headings[0]
    assert math.isfinite(headings[-1])


# --- hostile input ---------------------------------------------------------------------------------------


def test_what_cannot_be_is_refused() -> None:
    good = np.tile([0.0, 0.0, G_MPS2], (4, 1))
    for rate_hz in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="rate_hz"):
            track_orientation(good, good, rate_hz)
    with pytest.raises(ValueError, match="acc_range_mps2"):
        track_orientation(good, good, 100.0, acc_range_mps2=0.0)
    with pytest.raises(ValueError, match="gyr_range_radps"):
        smooth_orientation(good, good, 100.0, gyr_range_radps=math.nan)
    with pytest.raises(ValueError, match="shape"):
        track_orientation(good, good[:3], 100.0)
    with pytest.raises(ValueError, match="one bool per sample"):
        track_orientation(good, good, 100.0, zero_velocity=np.zeros(3, dtype=bool))
    with pytest.raises(ValueError, match="one bool per sample"):
        track_orientation(good, good, 100.0, zero_velocity=np.array([0.0, 1.0, 0.0, 0.5]))
    with pytest.raises(ValueError, match="no sample"):
        smooth_orientation(np.empty((0, 3)), np.empty((0, 3)), 100.0)
    assert len(track_orientation(np.empty((0, 3)), np.empty((0, 3)), 100.0).quaternion) == 0


def test_the_first_sample_is_the_upright() -> None:
    path = track_orientation(np.array([[3.0, 4.0, 5.0]]), np.zeros((1, 3)), 100.0)
    np.testing.assert_allclose(to_world(*path.quaternion[0], 3.0, 4.0, 5.0), [0.0, 0.0, math.sqrt(50.0)], atol=1e-12)


# --- The orientation benchmark's own arithmetic: heading-free errors, delays, missing packages ---


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
