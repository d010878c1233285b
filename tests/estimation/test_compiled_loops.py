"""Compiled loops against the plain array formulas that they stand for."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fes.estimation.numerics.filters import into_rows, spreads
from fes.estimation.numerics.rotation import quaternions_of, rotate_all, up_in_sensor
from fes.estimation.strides.integration import height_and_turn, stride_shape
from fes.estimation.zupt.covariance import STATES, WIDTH, update, update_velocity
from fes.estimation.zupt.detectors import window_variances
from fes.estimation.zupt.foot_trajectory import turn_path

RNG = np.random.default_rng(11)


@pytest.mark.parametrize("n", [7, 50])
def test_the_variances_of_windows_are_numpys(n: int) -> None:
    x = RNG.normal(9.0, 1.0, (400, 3))
    wanted = [x[i : i + n].var(axis=0) for i in range(0, 400 - n + 1, 5)]
    assert window_variances(x, n, 5) == pytest.approx(np.array(wanted))
    assert len(window_variances(x[: n - 1], n, 5)) == 0


def test_windows_run_through_stretches_as_if_these_followed_each_other() -> None:
    vectors, begins, size, window = RNG.normal(0.0, 1.0, (200, 3)) + 5.0, np.array([0, 60, 170]), 25, 10
    squares, found = np.empty(75), np.empty(7)
    spreads(vectors, begins, size, window, squares, found)
    joined = np.concatenate([vectors[i : i + size] for i in begins])
    assert squares == pytest.approx((joined**2).sum(axis=1))
    assert found == pytest.approx(np.sqrt(joined[:70].reshape(7, window, 3).var(axis=1).sum(axis=1)))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_the_greatest_size_of_three_columns(kind: type[np.floating[Any]]) -> None:
    columns = RNG.normal(0.0, 1.0, (3, 50)).astype(kind)
    out = np.empty((50, 3))
    assert into_rows(*columns, out) == np.abs(columns).max()
    assert np.array_equal(out, columns.T)
    columns[1, 7] = -9.0
    assert into_rows(*columns, out) == 9.0
    for axis, odd in ((0, math.nan), (1, math.inf), (2, math.nan)):
        holed = columns.copy()
        holed[axis, 20] = odd
        assert into_rows(*holed, out) == math.inf  # whatever follows
        assert np.array_equal(out, holed.T, equal_nan=True)


def test_a_velocity_measured_at_once_is_as_one_axis_after_the_other() -> None:
    half = RNG.normal(0.0, 1.0, (STATES, STATES))
    one = np.ascontiguousarray(np.pad(half @ half.T, ((0, 0), (0, 1)))).ravel()
    at_once, state, wanted, off = one.copy(), np.empty(STATES), np.zeros(STATES), RNG.normal(0.0, 1.0, 3)
    residual, variance, gains = off.copy(), np.empty(3), np.empty(6 * WIDTH)
    update_velocity(at_once, state, residual, 0.2, variance, gains)
    for j in range(3):
        left, gain = off[j] - wanted[3 + j], np.empty(WIDTH)
        assert update(one, wanted, 3 + j, left, 0.2, np.empty(WIDTH), gain) == pytest.approx(variance[j])
        assert residual[j] == pytest.approx(left)
        assert gains[j * WIDTH : j * WIDTH + STATES] == pytest.approx(gain[:STATES])
    assert state == pytest.approx(wanted)
    assert at_once == pytest.approx(one, abs=1e-12)
    after = at_once.reshape(STATES, WIDTH)[:, :STATES]
    assert np.array_equal(after, after.T)


def test_a_strides_shape_is_interpolated_and_turned() -> None:
    n = 90
    t_ns = 10**15 + np.cumsum(RNG.integers(1_000_000, 9_000_000, n))
    pitch = np.linspace(0.1, -0.4, n)
    quaternion = np.column_stack((np.cos(pitch / 2), np.zeros(n), np.sin(pitch / 2), np.zeros(n)))
    position = np.cumsum(RNG.normal(0.02, 0.01, (n, 3)), axis=0)
    position -= position[0]
    out = np.empty((101, 5))
    stride_shape(t_ns, quaternion, position, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, out)
    highest, turn = height_and_turn(quaternion, position, 1.0, 0.0, 0.0)
    assert highest == position[:, 2].max()
    assert turn == pytest.approx(0.0, abs=1e-12)
    dx, dy = position[-1, :2] / np.hypot(*position[-1, :2])
    walking = position @ np.array([[dx, -dy, 0.0], [dy, dx, 0.0], [0.0, 0.0, 1.0]])
    at, since = np.linspace(0.0, float(t_ns[-1] - t_ns[0]), 101), (t_ns - t_ns[0]).astype(np.float64)
    for k in range(3):
        assert out[:, k] == pytest.approx(np.interp(at, since, walking[:, k]), abs=1e-12)
    assert out[:, 3] == pytest.approx(np.interp(at, since, -(pitch - pitch[0])), abs=1e-12)
    assert out[:, 4] == pytest.approx(np.zeros(101), abs=1e-12)


@pytest.mark.parametrize("heading_deg", [0.0, 130.0])
def test_a_strides_tilt_is_of_the_mediolateral_axis_however_steep_the_foot_stands(heading_deg: float) -> None:
    tilt, pitch = np.radians(np.linspace(0.0, 12.0, 80)), np.radians(np.linspace(0.0, -60.0, 80))
    heading = np.full(80, math.radians(heading_deg))
    turned = Rotation.from_euler("ZXY", np.column_stack((heading, tilt, -pitch)))  # about the foot's own axes
    mounted = Rotation.from_euler("ZXY", (0.4, -0.3, 0.7))  # how the sensor sits on the foot
    forward, up = mounted.inv().apply((1.0, 0.0, 0.0)), mounted.inv().apply((0.0, 0.0, 1.0))
    quaternion = np.ascontiguousarray(np.roll((turned * mounted).as_quat(), 1, axis=1))
    t_ns, position, out = 10_000_000 * np.arange(80), np.zeros((80, 3)), np.empty((80, 5))
    stride_shape(t_ns, quaternion, position, *forward, *up, 0.1, out)
    assert out[:, 4] == pytest.approx(tilt, abs=1e-9)
    assert math.sin(out[-1, 3]) == pytest.approx(math.sin(pitch[-1]) * math.cos(tilt[-1]), abs=1e-9)


@pytest.mark.parametrize("toe_out_deg", [-7.0, 7.0])
@pytest.mark.parametrize("turn_deg", [0.0, 20.0])
@pytest.mark.parametrize("off_deg", [-15.0, 12.0])
def test_a_strides_tilt_is_of_the_foot_even_where_it_swings_about_another_axis(
    off_deg: float, turn_deg: float, toe_out_deg: float
) -> None:
    """The axis that the calibration found lies ``off_deg`` left of the foot's own, which points out of the way."""
    tilt, pitch = np.radians(np.linspace(0.0, 12.0, 80)), np.radians(np.linspace(0.0, 25.0, 80))
    tilt[-1] = pitch[-1] = 0.0  # stances at both ends
    heading = np.radians(toe_out_deg + np.linspace(-0.5, 0.5, 80) * turn_deg)
    turned = Rotation.from_euler("ZXY", np.column_stack((heading, tilt, -pitch)))
    quaternion = np.ascontiguousarray(np.roll(turned.as_quat(), 1, axis=1))
    forward = (math.cos(math.radians(off_deg)), math.sin(math.radians(off_deg)), 0.0)
    position, out = np.column_stack((np.linspace(0.0, 1.0, 80), np.zeros((80, 2)))), np.empty((80, 5))
    t_ns = 10_000_000 * np.arange(80)
    stride_shape(t_ns, quaternion, position, *forward, 0.0, 0.0, 1.0, math.radians(toe_out_deg), out)
    assert out[:, 4] == pytest.approx(tilt, abs=1e-9)
    sideways = np.ascontiguousarray(position[:, [1, 0, 2]])
    stride_shape(t_ns, quaternion, sideways, *forward, 0.0, 0.0, 1.0, math.radians(toe_out_deg), out)
    assert np.abs(out[:, 4] - tilt).max() > math.radians(3.0)  # nothing but the calibrated axis is known then


def test_a_way_is_turned_about_the_vertical() -> None:
    place, velocity, q = RNG.normal(0.0, 1.0, (9, 3)), RNG.normal(0.0, 1.0, (9, 3)), RNG.normal(0.0, 1.0, (9, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    shift, axis, c, s = np.array([1.0, 2.0, 3.0]), np.array([0.3, 0.4, 0.5]), math.cos(0.7), math.sin(0.7)
    about_z = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = [rows.copy() for rows in (place, velocity, q)]
    turn_path(*turned, 0.7, shift)
    assert turned[0] == pytest.approx(place @ about_z.T + shift)
    assert turned[1] == pytest.approx(velocity @ about_z.T)
    assert rotate_all(turned[2], axis) == pytest.approx(rotate_all(q, axis) @ about_z.T)


def test_rotations_go_to_matrices_and_back() -> None:
    q = RNG.normal(0.0, 1.0, (50, 4))
    q[:4] = np.eye(4)  # half turns about each axis, and none
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    axes = np.stack([rotate_all(q, axis) for axis in np.eye(3)], axis=2)
    back = quaternions_of(axes)
    assert back * np.sign((back * q).sum(axis=1, keepdims=True)) == pytest.approx(q, abs=1e-14)
    for turned, matrix in zip(q.tolist(), axes, strict=True):
        assert up_in_sensor(*turned) == pytest.approx(matrix[2], abs=1e-14)
