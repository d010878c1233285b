"""The ZUPT filter from step to step: against the one from sample to sample, against matrices, against exact walks."""

from __future__ import annotations

import numpy as np
import pytest
from test_zupt import STRIDE_M, rests, walk

from fes.analysis.stride_fusion import SETTINGS
from fes.estimation.zupt import foot_trajectory
from fes.estimation.zupt.covariance import BIASES, STATES, WIDTH, interval_noise, predict, propagate_error, spread_noise
from fes.estimation.zupt.decimation import ZuptSettings, gather, gather_intervals
from fes.estimation.zupt.foot_trajectory import foot_samples
from fes.estimation.zupt.smoother import _propagate_back
from fes.signals import G_MPS2, FloatArray
from tests.estimation.zupt_reference import add_noise as add_sample_noise
from tests.estimation.zupt_reference import predict as predict_sample
from tests.estimation.zupt_reference import zupt_path

NO_BIAS = (0.0, 0.0, 0.0)


def transition(r: FloatArray, f: FloatArray, dt: float) -> FloatArray:
    phi = np.eye(STATES)
    for column in phi:
        propagate_error(column, 0, r[None], f[None], dt)
    return phi.T


@pytest.mark.parametrize("rate_hz", [100.0, 204.8, 500.0])
def test_an_exact_walk_comes_out_exact_at_any_rate(rate_hz: float) -> None:
    t_ns, acc, gyr, _, _ = walk(rate_hz, 8)
    path = foot_samples(t_ns, acc, gyr).trajectory(ZuptSettings(drift_speed_mps=0.0), level=False)
    begin, end = rests(rate_hz, 8)
    lengths = np.hypot(*(path.positions_at(end) - path.positions_at(begin))[:, :2].T)
    assert lengths == pytest.approx(np.full(8, STRIDE_M), abs=0.006)
    assert np.diff(path.t_ns).max() < 60_000_000


@pytest.mark.parametrize("settings", [ZuptSettings(), SETTINGS])
@pytest.mark.parametrize("level", [True, False])
@pytest.mark.parametrize("per_sample", [True, False])
def test_intervals_and_the_reference_agree(settings: ZuptSettings, level: bool, per_sample: bool) -> None:
    """On a noisy walk with clipping and a jolt at each contact, they are millimetres apart, all along the way."""
    t_ns, acc, gyr, _, _ = walk(200.0, 12)
    rng = np.random.default_rng(8)
    acc = acc + rng.normal(0.0, 0.1, acc.shape) + (0.05, -0.03, 0.02)
    gyr = gyr + rng.normal(0.0, 0.005, gyr.shape) + (0.002, -0.003, 0.001)
    acc[np.arange(2, 10) * 220 + 505] += 120.0
    foot = foot_samples(t_ns, acc, gyr, per_sample=per_sample)
    by_intervals = foot.trajectory(settings, level=level)
    by_samples = zupt_path(
        t_ns, acc, gyr, calibration=foot.thresholds, rest=foot.zero_velocity, level_ground=level, settings=settings
    )
    late = t_ns[t_ns >= by_intervals.t_ns[0]]
    apart = by_intervals.positions_at(late) - by_samples.position_m[-len(late) :]
    assert np.abs(apart).max() < 0.03
    begin, end = rests(200.0, 12)
    assert np.hypot(*(by_intervals.positions_at(end) - by_intervals.positions_at(begin))[:, :2].T) == pytest.approx(
        by_samples.stride_lengths(begin, end), abs=0.004
    )


def test_prediction_is_that_of_matrices_and_the_adjoint_its_transpose() -> None:
    rng = np.random.default_rng(2)
    r, f, dt = 0.04 * np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=(3, 3)), 0.04
    phi, root = transition(r, f, dt), rng.normal(size=(STATES, STATES))
    P = np.zeros((STATES, WIDTH))
    P[:, :STATES] = root @ root.T
    wanted, flat = phi @ P[:, :STATES] @ phi.T, P.ravel().copy()
    still = ZuptSettings(acc_walk_mps2_rts=0.0, rate_walk_radps_rts=0.0)
    predict(flat, 0, r[None], f[None], dt, np.zeros((1, 16)), still)
    found = flat.reshape(STATES, WIDTH)[:, :STATES]
    assert found == pytest.approx(wanted, abs=1e-10)
    assert np.array_equal(found, found.T)
    adjoint = rng.normal(size=STATES)
    back = adjoint.copy()
    _propagate_back(0, back, r[None], f[None], dt)
    assert back == pytest.approx(phi.T @ adjoint, abs=1e-12)


def test_an_intervals_noise_is_that_of_its_samples() -> None:
    """One step of a fast swing with a jolt in it: its noise gathered at once, and carried on sample by sample."""
    rng = np.random.default_rng(5)
    n, dt, p = 10, 0.005, ZuptSettings(rate_scale_noise=0.05, acc_walk_mps2_rts=0.0, rate_walk_radps_rts=0.0)
    t_ns = np.arange(n) * 5_000_000
    acc, gyr = rng.normal(0.0, 20.0, (n, 3)) + np.array([0.0, 0.0, G_MPS2]), rng.normal(0.0, 3.0, (n, 3))
    none, rest = np.zeros(n), np.zeros(n, np.bool_)
    steps = gather_intervals(t_ns, acc, gyr, none, none, rest, NO_BIAS)
    gather(t_ns, acc, gyr, none, none, *NO_BIAS, p, steps)
    assert steps.ends.tolist() == [0, 9]
    q, m, f = np.zeros((2, 16)), np.eye(3).ravel(), np.zeros((2, 3, 3))
    f[1, 0], f[1, 1] = steps.push[1], steps.shift[1]
    f[1, 2] = f[1, 0] - f[1, 1] / (9 * dt)
    interval_noise(1, steps, m, f, 9 * dt, p, q)
    at_once, nothing = np.zeros(STATES * WIDTH), np.zeros((2, 3, 3))
    predict(at_once, 1, nothing, nothing, 9 * dt, q, p)

    one_by_one, scratch = np.zeros(STATES * WIDTH), np.empty(BIASES * WIDTH)
    turn = np.eye(3)
    for i in range(1, n):
        part = gather_intervals(t_ns[i - 1 : i + 1], acc[i - 1 : i + 1], gyr[i - 1 : i + 1], none, none, rest, NO_BIAS)
        force = turn @ part.push[1] / dt
        rotation = turn @ part.mean[1] / dt
        predict_sample(one_by_one, scratch, rotation, force, dt)
        rate = float(np.linalg.norm(0.5 * (gyr[i - 1] + gyr[i])))
        add_sample_noise(one_by_one, acc, i, force, rate, none, none, dt, p)
        w, x, y, z = part.turn[1]
        turn = turn @ np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
    found, wanted = (v.reshape(STATES, WIDTH)[3:9, 3:9] for v in (at_once, one_by_one))
    assert found == pytest.approx(wanted, rel=0.02, abs=0.02 * float(np.abs(wanted[3:, :3]).max()))
    places = [v.reshape(STATES, WIDTH)[0, 0] for v in (at_once, one_by_one)]
    assert places[0] == pytest.approx(places[1], rel=0.05)

    adjoint, x = rng.normal(size=(2, STATES)), np.zeros(STATES)
    spread_noise(0, x, q[1:], adjoint, 9 * dt, p)
    assert x == pytest.approx(-at_once.reshape(STATES, WIDTH)[:, :STATES] @ adjoint[0], rel=1e-9)


def test_between_intervals_the_trajectory_is_smooth() -> None:
    t_ns, acc, gyr, position, _ = walk(200.0, 6)
    path = foot_samples(t_ns, acc, gyr).trajectory(ZuptSettings(drift_speed_mps=0.0), level=True)
    late = t_ns >= path.t_ns[0]
    assert np.abs(path.positions_at(t_ns[late]) - position[late]).max() < 0.02
    assert np.array_equal(path.positions_at(np.array([-(10**9)])), path.position_m[:1])
    assert np.array_equal(path.positions_at(np.array([10**12])), path.position_m[-1:])


@pytest.mark.parametrize(("resting", "begin"), [(11, 0), (12, -2)])
def test_first_rest_that_ends_with_the_recording_is_no_beginning(resting: int, begin: int) -> None:
    """Rest has lasted long enough with its 11th sample; a way from the very last one on would have no second place."""
    t_ns, acc, gyr, _, _ = walk(100.0, 3)
    foot = foot_samples(t_ns, acc, gyr)
    foot.zero_velocity[:] = np.arange(len(t_ns)) >= len(t_ns) - resting
    path = foot.trajectory(ZuptSettings(), level=True)
    assert path.t_ns[[0, -1]].tolist() == t_ns[[begin, -1]].tolist()
    assert np.isfinite(path.positions_at(t_ns)).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_samples_of_no_use_are_left_out(bad: float) -> None:
    """Not finite, larger than any sensor's, at a time not after all before: without them all is as without them."""
    t_ns, acc, gyr, _, _ = walk(100.0, 6)
    acc[[170, 270, 370], 1] = 156.9
    at = np.array([3, 90, 90, 400])
    t, a, w = np.insert(t_ns, at, t_ns[at] - 1), np.insert(acc, at, 0.0, axis=0), np.insert(gyr, at, 0.0, axis=0)
    a[3, 2] = w[91, 0] = a[92, 1] = w[403, 1] = bad
    again = np.array([0, 0, 50, 300])  # a stamp once more, and others from before
    t, a, w = (np.insert(x, [1, 200, 250, 380], x[again], axis=0) for x in (t, a, w))
    clean, found = foot_samples(t_ns, acc, gyr), foot_samples(t, a, w)
    for name in ("t_ns", "acc_mps2", "gyr_radps", "zero_velocity", "energy"):
        assert np.array_equal(getattr(found, name), getattr(clean, name)), name
    assert (found.thresholds, found.rate_hz) == (clean.thresholds, clean.rate_hz)
    assert np.array_equal(found.noise, clean.noise)
    assert np.flatnonzero(found.noise[0]).tolist() == [170, 270, 370]


def test_where_nothing_can_be_told_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    t_ns, acc, gyr, _, _ = walk(100.0, 4)
    with pytest.raises(ValueError, match="2 samples make no path"):
        foot_samples(t_ns[:2], acc[:2], gyr[:2])
    with pytest.raises(ValueError, match="0 samples make no path"):
        foot_samples(t_ns, acc + np.nan, gyr)
    with pytest.raises(ValueError, match="never rests"):  # the gyroscope has stopped, and not at 0
        foot_samples(t_ns, acc, np.tile((1.1, 0.3, 0.7), (len(t_ns), 1)))
    monkeypatch.setattr(foot_trajectory, "with_missed_stances", lambda zero_velocity, *_: zero_velocity & False)
    with pytest.raises(ValueError, match="never rests"):
        foot_samples(t_ns, acc, gyr)
