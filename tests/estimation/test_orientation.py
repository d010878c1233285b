"""The orientation filter against independent arithmetic, against the print's errata, and over an hour."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from fes.estimation.foot.orientation import OrientationSettings, correct_by_gravity, propagate, start_covariance
from fes.estimation.numerics.rotation import from_gravity, quaternion_step, to_sensor, to_world
from fes.signals import G_MPS2, FloatArray

SETTINGS = OrientationSettings()
QUIET = SETTINGS._replace(
    rate_noise_radps_rthz=0.0, rate_scale_noise=0.0, bias_walk_radps2_rthz=0.0, bias_time_s=1e12
)  # fmt: skip
GRAVITY = np.array([0.0, 0.0, G_MPS2])


def cross(v: FloatArray) -> FloatArray:
    """S(v), so that S(v) u = v × u."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def wxyz(rotation: Rotation) -> FloatArray:
    return np.roll(rotation.as_quat(), 1)


def rotation(q: FloatArray) -> Rotation:
    return Rotation.from_quat(np.roll(q, -1))


def error_vector(truth: Rotation, estimate: Rotation) -> FloatArray:
    """e of q~ = q* ⊗ q^."""
    q = (truth.inv() * estimate).as_quat()
    return np.asarray(q[:3] * math.copysign(1.0, q[3]))


@dataclass
class Reference:
    """The same filter in matrices, written from the model alone; ``sign`` = -1 is the correction as printed."""

    attitude: Rotation
    bias: FloatArray
    covariance: FloatArray
    sign: float = 1.0
    settings: OrientationSettings = field(default=SETTINGS)

    def propagate(self, rate: FloatArray, dt_s: float) -> None:
        s = self.settings
        phi = np.zeros((6, 6))
        phi[:3, :3] = expm(-cross(rate) * dt_s)
        phi[:3, 3:] = 0.5 * dt_s * np.eye(3)
        phi[3:, 3:] = math.exp(-dt_s / s.bias_time_s) * np.eye(3)
        angle = s.rate_noise_radps_rthz**2 + float(rate @ rate) * s.rate_scale_noise**2
        noise = np.diag([0.25 * angle * dt_s] * 3 + [s.bias_walk_radps2_rthz**2 * dt_s] * 3)
        self.covariance = phi @ self.covariance @ phi.T + noise
        self.attitude = self.attitude * Rotation.from_rotvec(rate * dt_s)

    def update(self, force: FloatArray, dt_s: float) -> None:
        s = self.settings
        expected = self.attitude.inv().apply(GRAVITY)
        h = np.hstack((2.0 * cross(expected), np.zeros((3, 3))))
        r = s.acc_noise_mps2**2 * max(s.acc_correlation_s / dt_s, 1.0) * np.eye(3)
        gain = self.covariance @ h.T @ np.linalg.inv(h @ self.covariance @ h.T + r)
        down = expected / np.linalg.norm(expected)
        gain[:3] = (np.eye(3) - np.outer(down, down)) @ gain[:3]
        found = gain @ (self.sign * (expected - force))
        left = np.eye(6) - gain @ h
        self.covariance = left @ self.covariance @ left.T + gain @ r @ gain.T
        self.bias = self.bias + found[3:]
        e = found[:3]
        self.attitude = self.attitude * Rotation.from_rotvec(-2.0 * e)


def random_covariance(rng: np.random.Generator) -> FloatArray:
    factor = rng.normal(size=(6, 6)) * np.array([0.05, 0.05, 0.05, 0.01, 0.01, 0.01])[:, None]
    return np.ascontiguousarray(factor @ factor.T + 1e-9 * np.eye(6))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_one_propagation_and_one_update_are_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    attitude = Rotation.random(random_state=seed % 2**31)
    covariance, bias = random_covariance(rng), rng.normal(0.0, 0.01, 3)
    rate, dt_s = rng.normal(0.0, 3.0, 3), float(rng.choice([0.0005, 0.005, 0.01, 0.02, 0.2]))
    force = attitude.inv().apply(GRAVITY) + rng.normal(0.0, 1.0, 3)
    reference = Reference(attitude, bias.copy(), covariance.copy())
    q = wxyz(attitude)

    q[:] = quaternion_step(*q, *(rate * dt_s))
    propagate(covariance, *rate, dt_s, SETTINGS)
    reference.propagate(rate, dt_s)
    assert (rotation(q).inv() * reference.attitude).magnitude() < 1e-12
    np.testing.assert_allclose(covariance, reference.covariance, rtol=1e-10, atol=1e-15)

    correct_by_gravity(q, bias, covariance, np.zeros((6, 12)), *force, dt_s, SETTINGS)
    reference.update(force, dt_s)
    assert (rotation(q).inv() * reference.attitude).magnitude() < 1e-10
    np.testing.assert_allclose(bias, reference.bias, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(covariance, reference.covariance, rtol=1e-7, atol=1e-13)
    assert np.array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


# --- errata ----------------------------------------------------------------------------------------------


def swing_like(n: int = 1000) -> tuple[FloatArray, float]:
    """Rates (n, 3) of one second of a swing: push-off toe-down, then toe-up, with some roll and yaw."""
    u = np.arange(n) / n
    pitch = 4.0 * np.sin(math.pi * np.clip(u / 0.3, 0, 1)) - 3.0 * np.sin(math.pi * np.clip((u - 0.3) / 0.6, 0, 1))
    return np.column_stack((0.8 * np.sin(2 * math.pi * u), pitch, 0.6 * np.sin(math.pi * u))), 1.0 / n


def test_error_dynamics_hold_the_term_that_the_print_lacks() -> None:
    """de/dt = -S(w) e + b/2: a rank-one covariance goes the way of the error; the print is a fifth off."""
    rates, dt_s = swing_like()
    bias, start = np.array([0.004, -0.006, 0.005]), np.array([0.006, 0.004, -0.008])
    truth = Rotation.from_euler("xyz", [0.1, -0.2, 0.3])
    estimate = truth * Rotation.from_rotvec(2.0 * start)
    both = np.concatenate((start, bias))
    covariance = np.outer(both, both)
    printed = start.copy()
    for rate in rates:
        truth = truth * Rotation.from_rotvec(rate * dt_s)
        estimate = estimate * Rotation.from_rotvec((rate + bias) * dt_s)
        propagate(covariance, *rate, dt_s, QUIET)
        printed += 0.5 * bias * dt_s
    e = error_vector(truth, estimate)
    predicted = covariance[:3, 3] / bias[0]  # its column along the first bias is e · b
    assert np.linalg.norm(predicted - e) < 0.01 * np.linalg.norm(e)
    assert np.linalg.norm(printed - e) > 0.15 * np.linalg.norm(e)


def test_the_correction_turns_the_right_way_and_the_printed_sign_runs_away() -> None:
    truth = Rotation.from_euler("xyz", [20.0, -15.0, 70.0], degrees=True)
    start = truth * Rotation.from_euler("xy", [4.0, -3.0], degrees=True)
    force = truth.inv().apply(GRAVITY)
    covariance = np.zeros((6, 6))
    start_covariance(covariance, SETTINGS)
    right, wrong = (Reference(start, np.zeros(3), covariance.copy(), sign=sign) for sign in (1.0, -1.0))
    q, bias, scratch = wxyz(start), np.zeros(3), np.zeros((6, 12))
    for _ in range(300):
        for reference in (right, wrong):
            reference.propagate(np.zeros(3), 0.01)
            reference.update(force, 0.01)
        propagate(covariance, 0.0, 0.0, 0.0, 0.01, SETTINGS)
        correct_by_gravity(q, bias, covariance, scratch, *force, 0.01, SETTINGS)

    def tilt_deg(attitude: Rotation) -> float:
        up = attitude.apply(force)
        return math.degrees(math.acos(up[2] / np.linalg.norm(up)))

    assert tilt_deg(start) == pytest.approx(5.0, abs=0.1)
    assert tilt_deg(right.attitude) < 0.3
    assert tilt_deg(rotation(q)) < 0.3
    assert tilt_deg(wrong.attitude) > 9.0


def test_gravity_turns_nothing_about_the_vertical() -> None:
    truth = Rotation.from_euler("zyx", [50.0, 20.0, 10.0], degrees=True)
    start = truth * Rotation.from_euler("xyz", [3.0, 2.0, 9.0], degrees=True)
    covariance = random_covariance(np.random.default_rng(3))
    q = wxyz(start)
    correct_by_gravity(q, np.zeros(3), covariance, np.zeros((6, 12)), *truth.inv().apply(GRAVITY), 0.01, SETTINGS)
    turned = (rotation(q) * start.inv()).as_rotvec()
    assert np.linalg.norm(turned) > 1e-3
    assert abs(turned[2]) < 1e-9


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_an_update_never_shrinks_the_headings_variance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    attitude = Rotation.random(random_state=seed % 2**31)
    covariance = random_covariance(rng)
    up = attitude.inv().apply([0.0, 0.0, 1.0])
    across = np.linalg.svd(up[None])[2][1]
    heading, tilt = (float(v @ covariance[:3, :3] @ v) for v in (up, across))
    force = attitude.inv().apply(GRAVITY) + rng.normal(0.0, 0.3, 3)
    correct_by_gravity(wxyz(attitude), np.zeros(3), covariance, np.zeros((6, 12)), *force, 0.01, SETTINGS)
    assert up @ covariance[:3, :3] @ up == pytest.approx(heading, rel=1e-9)
    assert across @ covariance[:3, :3] @ across < tilt


# --- an hour ---------------------------------------------------------------------------------------------


@numba.njit
def _walk(
    q: FloatArray,
    bias: FloatArray,
    covariance: FloatArray,
    scratch: FloatArray,
    true_q: FloatArray,
    true_bias: FloatArray,
    first: int,
    count: int,
    rate_hz: float,
    noise: FloatArray,
    settings: OrientationSettings,
) -> None:
    """Strides of 1.2 s, half of each at rest; sampled rates hold between samples, so the truth is exact."""
    dt_s = 1.0 / rate_hz
    for k in range(count):
        t = (first + k) * dt_s
        u = (t % 1.2) / 1.2
        wx = wy = wz = 0.0
        if u >= 0.5:
            wy = 4.0 * math.sin(4.0 * math.pi * (u - 0.5))
            wx = 1.0 * math.sin(4.0 * math.pi * (u - 0.5))
        true_q[0], true_q[1], true_q[2], true_q[3] = quaternion_step(
            true_q[0], true_q[1], true_q[2], true_q[3], wx * dt_s, wy * dt_s, wz * dt_s
        )
        ex = wx + true_bias[0] - bias[0] + noise[k, 0]
        ey = wy + true_bias[1] - bias[1] + noise[k, 1]
        ez = wz + true_bias[2] - bias[2] + noise[k, 2]
        q[0], q[1], q[2], q[3] = quaternion_step(q[0], q[1], q[2], q[3], ex * dt_s, ey * dt_s, ez * dt_s)
        propagate(covariance, ex, ey, ez, dt_s, settings)
        if u < 0.5:
            fx, fy, fz = to_sensor(true_q[0], true_q[1], true_q[2], true_q[3], 0.0, 0.0, 9.80665)
            correct_by_gravity(
                q, bias, covariance, scratch,
                fx + 30.0 * noise[k, 3], fy + 30.0 * noise[k, 4], fz + 30.0 * noise[k, 5], dt_s, settings,
            )  # fmt: skip


def test_an_hour_of_walking() -> None:
    """360 000 samples: the covariance stays one, the bias is found, tilt stays small, heading drifts."""
    rng = np.random.default_rng(5)
    q, true_q = np.array([1.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
    bias, covariance, scratch = np.zeros(3), np.zeros((6, 6)), np.zeros((6, 12))
    start_covariance(covariance, SETTINGS)
    true_bias = np.array([0.004, -0.006, 0.003])
    found: dict[int, float] = {}
    tilts, headings = [], []
    chunk = 1200
    for minute_part in range(300):
        noise = 0.001 * rng.normal(size=(chunk, 6))
        _walk(q, bias, covariance, scratch, true_q, true_bias, minute_part * chunk, chunk, 100.0, noise, SETTINGS)
        assert np.array_equal(covariance, covariance.T)
        values = np.linalg.eigvalsh(covariance)
        assert values[0] > 0.0
        assert np.isfinite(values[-1])
        assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-12)
        up = np.array(to_world(*q, *to_sensor(*true_q, 0.0, 0.0, 1.0)))
        tilts.append(math.degrees(math.hypot(up[0], up[1])))
        headings.append(float(covariance[2, 2]))  # the walk begins and ends its strides level
        found[minute_part] = float(np.abs(bias - true_bias)[:2].max())
    assert found[24] < 0.001  # after five minutes
    assert max(list(found.values())[24:]) < 0.001
    assert max(tilts) < 1.0
    assert all(later > earlier for earlier, later in pairwise(headings))


# --- small parts -----------------------------------------------------------------------------------------


@given(st.integers(0, 2**31 - 1))
@settings(max_examples=50, deadline=None)
def test_quaternion_arithmetic(seed: int) -> None:
    rng = np.random.default_rng(seed)
    attitude, turn, v = Rotation.random(random_state=seed), rng.normal(0.0, 1.0, 3), rng.normal(0.0, 5.0, 3)
    q = wxyz(attitude)
    stepped = np.array(quaternion_step(*q, *turn))
    assert (rotation(stepped).inv() * attitude * Rotation.from_rotvec(turn)).magnitude() < 1e-12
    np.testing.assert_allclose(to_world(*q, *v), attitude.apply(v), atol=1e-12)
    np.testing.assert_allclose(to_sensor(*q, *v), attitude.inv().apply(v), atol=1e-12)
    upright = np.array(from_gravity(*v))
    np.testing.assert_allclose(to_world(*upright, *v), [0.0, 0.0, np.linalg.norm(v)], atol=1e-9)
    assert upright[3] == 0.0  # the smallest such turn has no part about the vertical


def test_upside_down_and_weightless() -> None:
    np.testing.assert_allclose(to_world(*from_gravity(0.0, 0.0, -9.8), 0.0, 0.0, -9.8), [0.0, 0.0, 9.8], atol=1e-9)
    assert from_gravity(0.0, 0.0, 0.0) == (1.0, 0.0, 0.0, 0.0)


def test_a_tiny_turn_keeps_its_size() -> None:
    q = np.array(quaternion_step(1.0, 0.0, 0.0, 0.0, 1e-10, -2e-10, 3e-10))
    np.testing.assert_allclose(2.0 * q[1:], [1e-10, -2e-10, 3e-10], rtol=1e-9)
