"""A movement's numbers, each against the longer way to it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fes.estimation.foot.movements import BACK, closures, contact_jumps, follow
from fes.estimation.numerics.filters import moving_mean
from fes.estimation.numerics.rotation import from_gravity, to_world, up_in_sensor
from fes.estimation.strides.integration import integrate, orient
from fes.signals import G_MPS2, FloatArray, IntArray

RNG = np.random.default_rng(5)
SPANS = np.array([(20, 150), (150, 290)])


def walked() -> tuple[IntArray, FloatArray, FloatArray]:
    """Stamps that are not even, and a sensor that turns and is shaken, tilted at either end."""
    t_ns = np.cumsum(RNG.integers(4_000_000, 6_000_000, 320))
    at = 1e-9 * t_ns[:, None]
    gyr = np.sin(at * (3.0, 9.0, 5.0)) * (0.4, 2.0, 0.6) + RNG.normal(0.0, 0.05, (320, 3))
    acc = (1.5, 0.5, 9.3) + np.sin(at * (11.0, 7.0, 13.0)) * (4.0, 1.0, 3.0)
    return t_ns, acc, gyr


def oriented(t_ns: IntArray, acc: FloatArray, gyr: FloatArray, span: IntArray, gain: float) -> FloatArray:
    """Quaternions (n, 4) in a movement, upright at its start; ``gain`` of its tilt at the end taken back."""
    first, last = span.tolist()
    around = max((last - first) // 50, 1)
    start, end = (acc[i - around : i + around + 1].mean(axis=0) for i in (first, last))
    out = np.empty((last + 1 - first, 4))
    part = slice(first, last + 1)
    orient(t_ns[part], gyr[part], np.array(from_gravity(*start.tolist())), *end.tolist(), gain, out)
    return out


@pytest.mark.parametrize("span", SPANS)
def test_where_a_movement_leads_is_where_its_integration_ends(span: IntArray) -> None:
    t_ns, acc, gyr = walked()
    moved = follow(t_ns, acc, gyr, span[None])[0]
    part = slice(span[0], span[1] + 1)
    q = oriented(t_ns, acc, gyr, span, 1.0)
    velocity, position, gamma = np.empty((len(q), 3)), np.empty((len(q), 3)), np.empty((2, 3))
    assert integrate(t_ns[part], acc[part], q, np.zeros(3), np.zeros(3), 0.0, velocity, position, gamma)
    back = q[0] * (1.0, -1.0, -1.0, -1.0)
    assert moved["way"] == pytest.approx(to_world(*back, *position[-1]), rel=1e-10)
    assert np.linalg.norm(moved["way"]) > 0.01


@pytest.mark.parametrize("span", SPANS)
def test_what_a_movement_leaves_over_is_that_of_trapezoids(span: IntArray) -> None:
    t_ns, acc, gyr = walked()
    moved = follow(t_ns, acc, gyr, span[None])[0]
    part = slice(span[0], span[1] + 1)
    up = np.array([up_in_sensor(*q) for q in oriented(t_ns, acc, gyr, span, BACK).tolist()])
    steps = 1e-9 * np.diff(t_ns[part])[:, None]

    def summed(x: FloatArray) -> FloatArray:
        return np.concatenate((np.zeros((1, x.shape[1])), np.cumsum(0.5 * steps * (x[1:] + x[:-1]), axis=0)))

    gained = np.column_stack((up, np.vecdot(up, acc[part]) - G_MPS2))
    speed = summed(gained)
    both = np.stack((speed[-1], summed(speed)[-1]))
    assert moved["effect"] == pytest.approx(both[:, :3], rel=1e-10)
    assert moved["left"] == pytest.approx(both[:, 3], rel=1e-10)
    assert moved["lively"] == pytest.approx(np.abs(np.linalg.norm(acc[part], axis=1) - G_MPS2).sum())


def test_a_jump_counts_from_where_the_other_is_least() -> None:
    t_ns, acc, gyr = walked()
    turns, lag = follow(t_ns, acc, gyr, SPANS)["turn"], 4
    least = (100, 288)  # the second leaves less than the lag
    after = np.ones(len(t_ns))
    after[list(least)] = 0.0
    jumps = contact_jumps(t_ns, acc, gyr, SPANS, turns, after, lag)
    up = np.array([up_in_sensor(*q) for q in oriented(t_ns, acc, gyr, SPANS[0], BACK).tolist()])
    vertical, whole = np.vecdot(up, acc[20:151])[least[0] - 20 :], acc[least[0] : 151]
    upward = np.abs(vertical[lag:] - vertical[:-lag])
    half = 0.5 * np.linalg.norm(whole[lag:] - whole[:-lag], axis=1)
    assert jumps[0] == pytest.approx(np.maximum(upward, half).max(), rel=1e-10)
    assert math.isnan(jumps[1])


def test_of_a_jump_sideways_half_counts() -> None:
    t_ns = np.arange(200) * 5_000_000
    acc, gyr, after = np.tile((0.0, 0.0, G_MPS2), (200, 1)), np.zeros((200, 3)), np.arange(200.0)
    acc[100:110, 1] = 6.0
    span = np.array([(20, 150)])
    assert contact_jumps(t_ns, acc, gyr, span, follow(t_ns, acc, gyr, span)["turn"], after, 2) == pytest.approx(3.0)
    acc[100:110, 2] += 4.0
    assert contact_jumps(t_ns, acc, gyr, span, follow(t_ns, acc, gyr, span)["turn"], after, 2) == pytest.approx(4.0)


def turning() -> tuple[IntArray, FloatArray, FloatArray]:
    """A sensor that turns and feels gravity only, as the integrated rates say."""
    t_ns, _, gyr = walked()
    quaternions = np.empty((len(t_ns), 4))
    orient(t_ns, gyr, np.array(from_gravity(1.0, 2.0, 9.0)), 0.0, 0.0, 1.0, 0.0, quaternions)
    return t_ns, G_MPS2 * np.array([up_in_sensor(*q) for q in quaternions.tolist()]), gyr


def test_gravity_closes_over_rates_without_bias() -> None:
    missed, _ = closures(*turning(), SPANS)
    assert np.abs(missed).max() < 1e-3  # the mean force about each end is all that differs


def test_what_gravity_misses_is_the_biass_effect() -> None:
    t_ns, acc, gyr = turning()
    plain, effect = closures(t_ns, acc, gyr, SPANS)
    bias = np.array([0.02, -0.03, 0.01])
    missed, _ = closures(t_ns, acc, gyr + bias, SPANS)
    assert np.linalg.norm(missed - plain) > 0.01
    assert missed - plain == pytest.approx(effect @ bias, abs=1e-3)
    gravity = acc[SPANS[:, 0]] / G_MPS2
    assert np.einsum("ki,kij->kj", gravity, effect) == pytest.approx(0.0, abs=0.02)  # about gravity nothing shows


def test_a_movement_too_short_to_integrate_leads_nowhere() -> None:
    t_ns, acc, gyr = walked()
    assert not follow(t_ns, acc, gyr, np.array([(50, 51)]))["way"].any()


@pytest.mark.parametrize("window", [1, 2, 5, 10])
def test_a_moving_mean_is_over_what_there_is(window: int) -> None:
    x = RNG.normal(0.0, 1.0, (40, 2))
    before, after = window // 2, window - window // 2
    wanted = [x[max(i - before, 0) : i + after].mean(axis=0) for i in range(40)]
    assert moving_mean(x, window) == pytest.approx(np.array(wanted))
    assert np.array_equal(moving_mean(x[:, 0], window), moving_mean(x, window)[:, 0])
