"""The height over a stride: against least squares written from the model, and against a sensor shaken by an impact."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fes.estimation.strides.maximum_likelihood import HeightNoise, settle_height
from fes.signals import G_MPS2, FloatArray, IntArray

NOISE = HeightNoise()
STILL = np.full(2, 1e-6)  # variances of the velocities at the ends


def lifted(rate_hz: float = 200.0, peak_m: float = 0.12) -> tuple[IntArray, FloatArray, FloatArray]:
    """Stamps (N,), true heights (N,), specific force (N, 3): a level sensor that goes up and comes down in 0.6 s."""
    t = np.arange(round(rate_hz) + 1) / rate_hz
    omega = 2.0 * math.pi / 0.6
    angle = omega * np.clip(t - 0.1, 0.0, 0.6)
    bump = 0.5 - 0.5 * np.cos(angle)
    force = np.zeros((len(t), 3))
    force[:, 2] = G_MPS2 + peak_m * omega**2 * (0.5 * np.sin(angle) ** 2 + bump * np.cos(angle))
    return np.round(1e9 * t).astype(np.int64), peak_m * bump**2, force


def solve(
    t_ns: IntArray, force: FloatArray, noise: HeightNoise = NOISE, ends: tuple[float, float] = (0.0, 0.0)
) -> tuple[FloatArray, FloatArray]:
    """Vertical velocity and height (N,)."""
    quaternion = np.zeros((len(t_ns), 4))
    quaternion[:, 0] = 1.0
    out = np.empty((len(t_ns), 2))
    assert settle_height(t_ns, force, quaternion, np.array(ends), STILL, 0.0, noise, out)
    return out[:, 0], out[:, 1]


def reference(t_ns: IntArray, force: FloatArray, noise: HeightNoise, ends: tuple[float, float]) -> FloatArray:
    """Heights (N,): the smallest errors, each in its own size, by which both ends fit; effects written as matrices."""
    dt = 1e-9 * np.diff(t_ns)
    up = force[:, 2] - G_MPS2

    def course(first: float, pushes: FloatArray, bias: float) -> tuple[FloatArray, FloatArray]:
        v = first + np.concatenate(([0.0], np.cumsum(dt * (0.5 * (up[1:] + up[:-1]) + bias) + pushes)))
        return v, np.concatenate(([0.0], np.cumsum(0.5 * dt * (v[1:] + v[:-1]))))

    jumps = np.linalg.norm(np.diff(force, axis=0), axis=1)
    shaken = [max(jumps[k - j] * math.exp(-dt[k - j + 1 : k + 1].sum() / noise.shaken_s) for j in range(k + 1))
              for k in range(len(dt))]  # fmt: skip
    push_sd = np.sqrt(noise.push_mps2_rthz**2 * dt + (noise.shaken_share * np.array(shaken) * dt) ** 2)
    sizes = np.concatenate(([math.sqrt(STILL[0])], push_sd, [noise.bias_mps2, math.sqrt(STILL[1]), noise.end_height_m]))
    v0, h0 = course(ends[0], np.zeros(len(dt)), 0.0)
    columns = []
    for unit in np.eye(len(dt) + 2):
        v, h = course(ends[0] + unit[0], unit[1:-1], unit[-1])
        columns.append((v[-1] - v0[-1], h[-1] - h0[-1]))
    effects = np.array([*columns, (1.0, 0.0), (0.0, 1.0)]).T * sizes
    errors = sizes * np.linalg.lstsq(effects, np.array([ends[1] - v0[-1], -h0[-1]]), rcond=None)[0]
    return course(ends[0] + errors[0], errors[1 : len(dt) + 1], errors[len(dt) + 1])[1]


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**31), rate_hz=st.sampled_from([50.0, 100.0, 204.8]))
def test_the_same_as_least_squares(seed: int, rate_hz: float) -> None:
    rng = np.random.default_rng(seed)
    t_ns, _, force = lifted(rate_hz)
    force += rng.normal(0.0, 0.5, force.shape)
    force[round(0.7 * rate_hz)] += rng.normal(0.0, 80.0, 3)
    ends = (float(rng.normal(0.0, 0.02)), float(rng.normal(0.0, 0.02)))
    _, height = solve(t_ns, force, ends=ends)
    np.testing.assert_allclose(height, reference(t_ns, force, NOISE, ends), atol=1e-8)


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 500.0])
def test_a_faultless_sensor_is_left_alone(rate_hz: float) -> None:
    t_ns, truth, force = lifted(rate_hz)
    velocity, height = solve(t_ns, force)
    np.testing.assert_allclose(height, truth, atol=1e-3)
    assert abs(velocity[-1]) < 2e-3


def test_an_impact_that_shakes_the_sensor_does_not_bend_the_swing() -> None:
    """20 ms after contact the sensor reads nonsense that leaves 0.4 m/s: a bias over the stride would spread it."""
    t_ns, truth, force = lifted()
    force[144:150, 2] += np.array([60.0, -90.0, 110.0, 70.0, -40.0, -30.0])
    _, height = solve(t_ns, force)
    before = t_ns <= 700_000_000
    assert np.abs(height - truth)[before].max() < 0.01
    assert abs(height[-1]) < 0.002
    # the same error, if no sample is worse than another
    _, evenly = solve(t_ns, force, NOISE._replace(shaken_share=0.0))
    assert np.abs(evenly - truth)[before].max() > 0.03


def test_a_steady_error_is_spread_where_nothing_shakes() -> None:
    t_ns, truth, force = lifted()
    force[:, 2] += 0.05
    _, height = solve(t_ns, force)
    assert np.abs(height - truth).max() < 0.003


def test_nothing_to_integrate() -> None:
    quaternion, out = np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)), np.empty((3, 2))
    force = np.tile([0.0, 0.0, G_MPS2], (3, 1))
    for t_ns in (np.array([0, 10_000_000]), np.array([0, 0, 0])):
        n = len(t_ns)
        assert not settle_height(t_ns, force[:n], quaternion[:n], np.zeros(2), STILL, 0.0, NOISE, out[:n])
