"""The ZUPT filter from step to step: against the one from sample to sample, against matrices, against exact walks."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_zupt import STRIDE_M, UP, rests, walk

from fes.analysis.ground_path import STRIDE_SETTINGS
from fes.estimation.zupt import foot_trajectory
from fes.estimation.zupt.covariance import STATES, WIDTH, interval_noise, predict, propagate_error, spread_noise
from fes.estimation.zupt.decimation import ZuptSettings, gather, gather_intervals
from fes.estimation.zupt.detectors import ACC_TOLERANCE_MPS2, RATE_TOLERANCE_RADPS, Detector, statistic, window_samples
from fes.estimation.zupt.filter import _propagate_back
from fes.estimation.zupt.foot_trajectory import foot_samples
from fes.estimation.zupt.thresholds import find_zero_velocity
from fes.recording import read_recording
from fes.signals import G_MPS2, FloatArray
from fes.simulation.truth import load_truth

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


@pytest.mark.parametrize("settings", [ZuptSettings(), STRIDE_SETTINGS])
@pytest.mark.parametrize("level", [True, False])
def test_intervals_and_single_samples_agree(settings: ZuptSettings, level: bool) -> None:
    """On a noisy walk with clipping and a jolt at each contact, they are millimetres apart, all along the way."""
    t_ns, acc, gyr, _, _ = walk(200.0, 12)
    rng = np.random.default_rng(8)
    acc = acc + rng.normal(0.0, 0.1, acc.shape) + (0.05, -0.03, 0.02)
    gyr = gyr + rng.normal(0.0, 0.005, gyr.shape) + (0.002, -0.003, 0.001)
    acc[np.arange(2, 10) * 220 + 505] += 120.0
    by_intervals, by_samples = (
        foot_samples(t_ns, acc, gyr, per_sample=each).trajectory(settings, level=level) for each in (False, True)
    )
    assert len(by_samples.t_ns) > 3 * len(by_intervals.t_ns)
    assert np.abs(by_intervals.positions_at(by_samples.t_ns) - by_samples.position_m).max() < 0.03
    one, other = (
        np.hypot(*np.subtract(*(path.positions_at(at) for at in rests(200.0, 12)))[:, :2].T)
        for path in (by_intervals, by_samples)
    )
    assert one == pytest.approx(other, abs=0.004)


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

    one_by_one, turn = np.zeros((STATES, STATES)), np.eye(3)
    for i in range(1, n):
        part = gather_intervals(t_ns[i - 1 : i + 1], acc[i - 1 : i + 1], gyr[i - 1 : i + 1], none, none, rest, NO_BIAS)
        force = turn @ part.push[1] / dt
        beyond = max(float(np.linalg.norm(acc[i] - acc[i - 1])) - p.jerk_mps3 * dt, 0.0)
        pushed = (p.acc_noise_mps2_rthz**2 + p.acc_scale_noise**2 * float(np.sum((force - UP) ** 2))) * dt
        pushed += beyond**2 / 12.0 * dt * dt
        rate2 = float(np.sum((0.5 * (gyr[i - 1] + gyr[i])) ** 2))
        turned = (p.rate_noise_radps_rthz**2 + p.rate_scale_noise**2 * rate2) * dt
        phi = np.eye(STATES)
        phi[:3, 3:6] = dt * np.eye(3)
        phi[3:6, 6:9] = dt * np.cross(np.eye(3), force).T
        phi[:3, 6:9] = 0.5 * dt * phi[3:6, 6:9]
        of_push = np.vstack((0.5 * dt * np.eye(3), np.eye(3)))
        one_by_one = phi @ one_by_one @ phi.T
        one_by_one[:6, :6] += pushed * of_push @ of_push.T
        one_by_one[6:9, 6:9] += turned * np.eye(3)
        turn = turn @ Rotation.from_quat(part.turn[1], scalar_first=True).as_matrix()
    at_once = at_once.reshape(STATES, WIDTH)[:, :STATES]
    found, wanted = at_once[3:9, 3:9], one_by_one[3:9, 3:9]
    assert found == pytest.approx(wanted, rel=0.02, abs=0.02 * float(np.abs(wanted[3:, :3]).max()))
    assert at_once[0, 0] == pytest.approx(one_by_one[0, 0], rel=0.05)

    adjoint, x = rng.normal(size=(2, STATES)), np.zeros(STATES)
    spread_noise(0, x, q[1:], adjoint, 9 * dt, p)
    assert x == pytest.approx(-at_once @ adjoint[0], rel=1e-9)


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


# --- Zero-velocity detectors: Skog's formulas, causal and centred windows ---


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
