"""The ZUPT-aided filter and smoother: exact walks, how errors grow, the textbook's smoothing, honest covariances."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fes.estimation.zupt.covariance import STATES, propagate_error, spread_noise
from fes.estimation.zupt.decimation import ZuptSettings, gather, gather_intervals, start_variances
from fes.estimation.zupt.detectors import rate_energy
from fes.estimation.zupt.filter import (
    IntervalTape,
    _integrate,
    filter_intervals,
    new_tape,
    rotate_in_world,
    smooth_intervals,
)
from fes.estimation.zupt.foot_trajectory import Trajectory, clipped_sd
from fes.estimation.zupt.thresholds import stance_instants, stride_time_s, with_missed_stances
from fes.signals import G_MPS2, BoolArray, FloatArray, IntArray

UP = np.array([0.0, 0.0, G_MPS2])
STRIDE_M, STEP_S, REST_S = 1.2, 0.6, 0.5
FIRM = ZuptSettings(drift_speed_mps=0.0)
LOST = 15  # where the tape has what a filter that was lost adds


def walk(
    rate_hz: float, strides: int = 6, *, rise_m: float = 0.0, lever_m: float = 0.0, rock_radps: float = 0.0
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, BoolArray]:
    """A foot that goes ``STRIDE_M`` forward per stride, pitching meanwhile: t, acc, gyr, true position (N, 3), rest.

    All polynomial or sine, so exact at any rate. In stance it rocks about the ground ``lever_m`` below the sensor.
    """
    t = np.arange(round((2.0 + strides * (STEP_S + REST_S)) * rate_hz)) / rate_hz
    into = np.clip(t - 2.0, 0.0, None)
    number = np.floor(into / (STEP_S + REST_S) + 1e-9)
    cycle = np.maximum(into - number * (STEP_S + REST_S), 0.0)
    moving = (t >= 2.0) & (cycle < STEP_S)
    u = np.where(moving, cycle / STEP_S, 1.0)
    done = np.where(t >= 2.0, number, -1.0)
    place = done + 10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5
    push = (60.0 * u - 180.0 * u**2 + 120.0 * u**3) / STEP_S**2  # of the place
    height_acc = 6.4 * (6.0 * u - 36.0 * u**2 + 60.0 * u**3 - 30.0 * u**4) / STEP_S**2 * moving
    height = 6.4 * u**3 * (1.0 - u) ** 3 * moving
    # a pitch of one rad and back; in stance a small rock about the ground
    v = np.where(moving, 0.0, (cycle - STEP_S) / REST_S) * (t >= 2.0)
    omega = 2.0 * math.pi / REST_S
    swing_rate = np.where(moving, 2.0 * math.pi / STEP_S * np.sin(2.0 * math.pi * u) ** 3, 0.0)
    swing_pitch = np.where(moving, _sine_cubed(u), 0.0)
    rock_rate = np.where(moving, 0.0, rock_radps * np.sin(math.pi * v * 2.0) ** 2)
    rock_pitch = np.where(
        moving, 0.0, rock_radps * (0.5 * v * REST_S - np.sin(2.0 * omega * v * REST_S) / (4.0 * omega))
    )
    total = 0.5 * rock_radps * REST_S  # each rock ends tilted by this; the next swing takes it back
    back = np.where(moving, total * (1.0 - u + np.sin(2.0 * math.pi * u) / (2.0 * math.pi)), 0.0) * (done > 0)
    back_rate = np.where(moving, total * (-1.0 + np.cos(2.0 * math.pi * u)) / STEP_S, 0.0) * (done > 0)
    pitch, rate = swing_pitch + rock_pitch + back, swing_rate + rock_rate + back_rate
    position = np.column_stack((STRIDE_M * (place + 1.0), 0.0 * t, height + rise_m * (place + 1.0)))
    acceleration = np.column_stack((STRIDE_M * push * moving, 0.0 * t, height_acc + rise_m * push * moving))
    if lever_m:  # the pivot goes the way above, the sensor turns about it; numerically, on the smooth pitch
        arm = lever_m * np.column_stack((np.sin(pitch), 0.0 * t, np.cos(pitch)))
        turn = np.gradient(rate, t)
        acceleration = acceleration + np.column_stack(
            (arm[:, 2] * turn - arm[:, 0] * rate**2, 0.0 * t, -arm[:, 0] * turn - arm[:, 2] * rate**2)
        )
        position = position + arm - arm[0]
    position = position - position[0]
    force = acceleration + UP
    c, s = np.cos(pitch), np.sin(pitch)
    acc = np.column_stack((c * force[:, 0] - s * force[:, 2], force[:, 1], s * force[:, 0] + c * force[:, 2]))
    gyr = np.column_stack((0.0 * t, rate, 0.0 * t))
    return np.rint(t * 1e9).astype(np.int64), acc, gyr, position, ~moving


def _sine_cubed(u: FloatArray) -> FloatArray:
    """Integral of 2 pi sin³(2 pi u) from 0."""
    c = np.cos(2.0 * math.pi * u)
    return np.asarray(2.0 / 3.0 - c + c**3 / 3.0)


def rests(rate_hz: float, strides: int) -> tuple[IntArray, IntArray]:
    """The middles of the stances around each stride, in ns."""
    middle = 2.0 - 0.5 * REST_S + (STEP_S + REST_S) * np.arange(strides + 1)
    t_ns = np.rint(1e9 * middle).astype(np.int64)
    return t_ns[:-1], t_ns[1:]


class Filtered:
    """A walk through the filter, and through the smoother unless it is not wanted."""

    def __init__(
        self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, rest: BoolArray, settings: ZuptSettings = FIRM, *,
        arm_m: float = 0.0, level: bool = False, smoothed: bool = True, acc_sd: FloatArray | None = None,
        per_sample: bool = False,
    ) -> None:  # fmt: skip
        none = np.zeros(len(t_ns))
        clipped = none if acc_sd is None else acc_sd
        intervals = gather_intervals(t_ns, acc, gyr, clipped, none, rest, (0.0, 0.0, 0.0), per_sample=per_sample)
        gather(t_ns, acc, gyr, clipped, none, 0.0, 0.0, 0.0, settings, intervals)
        self.t_ns, self.ends, self.settings, self.standing = t_ns, intervals.ends, settings, bool(rest[0])
        self.tape = new_tape(len(self.ends), int(rest[self.ends].sum()))
        lever = np.array([0.0, 0.0, arm_m])
        filter_intervals(t_ns, gyr, rest, intervals, acc[0], lever, np.zeros(3), level, settings, self.tape)
        if smoothed:
            smooth_intervals(t_ns, self.ends, self.standing, settings, self.tape)

    def path(self) -> Trajectory:
        return Trajectory(self.t_ns[self.ends], *self.tape[:3])

    def lengths(self, begin_ns: IntArray, end_ns: IntArray) -> FloatArray:
        path = self.path()
        return np.hypot(*(path.positions_at(end_ns) - path.positions_at(begin_ns))[:, :2].T)

    def dt(self, k: int) -> float:
        return 1e-9 * float(self.t_ns[self.ends[k]] - self.t_ns[self.ends[k - 1]])

    def covariances(self) -> tuple[list[FloatArray], list[FloatArray]]:
        """Before and after each interval's measurements, by matrices; the gains on the tape have to be theirs."""
        tape, start = self.tape, np.empty(STATES)
        start_variances(self.standing, self.settings, start)
        P, before, after = np.diag(start), [], []
        for k in range(len(self.ends)):
            if k:
                phi = transition(tape, k, self.dt(k))
                P = phi @ P @ phi.T + noise_of(tape, k, self.dt(k), self.settings)
            before.append(P.copy())
            for j in range(3):
                P[3 + j, 3 + j] += tape.added[k, LOST]
                P[6 + j, 6 + j] += self.settings.lost_tilt_rad**2 * (tape.added[k, LOST] > 0.0)
            if (m := int(tape.slot[k])) >= 0:
                for j, state in enumerate((3, 4, 5, 2)):
                    if (s := tape.residual_var[m, j]) > 0.0:
                        assert tape.gain[m, j] == pytest.approx(P[:, state] / s, rel=1e-6, abs=1e-7)
                        P = P - np.outer(P[:, state], P[state]) / s
            after.append(P)
        return before, after


def transition(tape: IntervalTape, k: int, dt: float) -> FloatArray:
    phi = np.eye(STATES)
    for column in phi:
        propagate_error(column, k, tape.mean, tape.push, dt)
    return phi.T


def noise_of(tape: IntervalTape, k: int, dt: float, settings: ZuptSettings) -> FloatArray:
    noise = np.zeros((STATES, STATES))
    for unit, column in zip(np.eye(STATES), noise, strict=True):
        spread_noise(0, column, tape.added[k : k + 1], unit[None], dt, settings)
    return -noise


@pytest.mark.parametrize("rate_hz", [100.0, 204.8, 500.0])
@pytest.mark.parametrize("smoothed", [False, True])
def test_an_exact_walk_comes_out_exact_at_any_rate(rate_hz: float, smoothed: bool) -> None:
    t_ns, acc, gyr, position, rest = walk(rate_hz)
    found = Filtered(t_ns, acc, gyr, rest, smoothed=smoothed)
    assert found.lengths(*rests(rate_hz, 6)) == pytest.approx(np.full(6, STRIDE_M), abs=0.004)
    assert np.abs(found.tape.position - position[found.ends]).max() < 0.015


def test_biases_do_not_bend_the_way() -> None:
    t_ns, acc, gyr, _, rest = walk(200.0, strides=20)
    found = Filtered(t_ns, acc + np.array([0.0, 0.0, 0.1]), gyr + np.array([0.008, -0.006, 0.004]), rest)
    assert found.lengths(*rests(200.0, 20)) == pytest.approx(np.full(20, STRIDE_M), abs=0.015)


def test_the_arm_counts() -> None:
    """A stance that rocks forward on the ground: with the arm the length is right, with zero velocity it is short."""
    t_ns, acc, gyr, position, rest = walk(200.0, lever_m=0.1, rock_radps=0.5)
    begin, end = rests(200.0, 6)
    true = np.interp(end, t_ns, position[:, 0]) - np.interp(begin, t_ns, position[:, 0])
    errors = {arm_m: Filtered(t_ns, acc, gyr, rest, arm_m=arm_m).lengths(begin, end) - true for arm_m in (0.0, 0.1)}
    assert np.abs(errors[0.1][1:]).max() < 0.008
    assert errors[0.0][1:].mean() < -0.01


def test_stairs_are_climbed_unless_the_ground_is_said_to_be_level() -> None:
    t_ns, acc, gyr, _, rest = walk(200.0, rise_m=0.17)
    free, level = (Filtered(t_ns, acc, gyr, rest, level=level).tape.position[-1, 2] for level in (False, True))
    assert free == pytest.approx(6 * 0.17, abs=0.02)
    assert abs(level) < 0.05


def test_forward_knows_nothing_of_the_future() -> None:
    t_ns, acc, gyr, _, rest = walk(100.0)
    changed = acc.copy(), gyr.copy(), rest.copy()
    changed[0][400:] += 2.0
    changed[1][400:] -= 0.3
    changed[2][400:] = ~rest[400:]
    one, other = (
        Filtered(t_ns, *given, ZuptSettings(), smoothed=False, per_sample=True).tape
        for given in ((acc, gyr, rest), changed)
    )
    for name in ("position", "velocity", "quaternions"):
        assert np.array_equal(getattr(one, name)[:399], getattr(other, name)[:399]), name
    assert not np.allclose(one.position[420], other.position[420])


def noisy(rate_hz: float, strides: int, settings: ZuptSettings, **more: Any) -> Filtered:
    t_ns, acc, gyr, _, rest = walk(rate_hz, strides)
    rng = np.random.default_rng(4)
    acc, gyr = acc + rng.normal(0.0, 0.1, acc.shape), gyr + rng.normal(0.0, 0.01, gyr.shape)
    return Filtered(t_ns, acc, gyr, rest, settings, smoothed=False, **more)


def test_an_error_grows_as_the_integration_lets_it_grow() -> None:
    """What the covariance goes by, against differences of the strapdown integration itself."""
    rng, n = np.random.default_rng(2), 9
    t_ns, none = np.arange(n) * 5_000_000, np.zeros(n)
    acc, gyr = rng.normal(0.0, 5.0, (n, 3)) + UP, rng.normal(0.0, 1.0, (n, 3))
    intervals = gather_intervals(t_ns, acc, gyr, none, none, np.zeros(n, bool), (0.0, 0.0, 0.0))
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    tape, dt = new_tape(2, 0), 1e-9 * float(t_ns[-1])
    assert intervals.ends.tolist() == [0, n - 1]

    def carried(error: FloatArray) -> tuple[FloatArray, Rotation]:
        place, velocity, turned = error[:3].copy(), np.array([1.0, 0.2, -0.3]) + error[3:6], np.empty(4)
        rotate_in_world(q, *error[6:9], turned)
        biases = error[9:12].copy(), error[12:].copy()
        _integrate(1, dt, intervals, np.empty(9), tape.mean, tape.push, place, velocity, turned, *biases)
        return np.concatenate((place, velocity)), Rotation.from_quat(turned, scalar_first=True)

    (at, turned), small = carried(np.zeros(STATES)), 1e-6
    phi = transition(tape, 1, dt)
    for unit in np.eye(STATES):
        moved, away = carried(small * unit)
        found = np.concatenate((moved - at, (away * turned.inv()).as_rotvec())) / small
        assert found == pytest.approx((phi @ unit)[:9], abs=2e-3), unit


def test_smoothing_is_that_of_rauch_tung_striebel() -> None:
    """The textbook's recursion, with inverses, on the same forward pass."""
    walked = noisy(50.0, 2, ZuptSettings(drift_speed_mps=0.0, outlier_sigmas=1e6))
    tape, n = walked.tape, len(walked.ends)
    predicted, after = walked.covariances()
    correction = np.zeros((n, STATES))
    for k in range(n - 1, 0, -1):
        phi, m = transition(tape, k, walked.dt(k)), int(tape.slot[k])
        injected = tape.gain[m, :3].T @ tape.residual[m, :3] if m >= 0 else np.zeros(STATES)
        back = np.linalg.solve(predicted[k], phi @ after[k - 1]).T
        correction[k - 1] = back @ (correction[k] + injected)
    place, velocity = tape.position.copy(), tape.velocity.copy()
    smooth_intervals(walked.t_ns, walked.ends, walked.standing, walked.settings, tape)
    assert np.abs(correction[:, :3]).max() > 0.001
    assert tape.position - place == pytest.approx(correction[:, :3], abs=1e-6)
    assert tape.velocity - velocity == pytest.approx(correction[:, 3:6], abs=1e-6)


@pytest.mark.parametrize("level", [False, True])
def test_covariance_stays_sound_and_is_that_of_matrices(level: bool) -> None:
    for found in noisy(100.0, 8, ZuptSettings(), level=level).covariances()[1]:
        assert np.linalg.eigvalsh(0.5 * (found + found.T))[0] > -1e-12


def test_standing_tells_nothing_of_heading() -> None:
    rng = np.random.default_rng(6)
    n = 1200
    acc, gyr = UP + rng.normal(0.0, 0.02, (n, 3)), rng.normal(0.0, 0.002, (n, 3))
    stood = Filtered(np.arange(n) * 100_000_000, acc, gyr, np.ones(n, bool), ZuptSettings(), smoothed=False)
    heading = np.array([covariance[8, 8] for covariance in stood.covariances()[1]])
    assert np.all(np.diff(heading[100:]) > -1e-12)
    assert float(np.linalg.norm(stood.tape.velocity[-1])) < 0.01


def test_errors_are_as_large_as_the_filter_says() -> None:
    """Noise drawn as the settings say: the end of the path lies within 4 standard deviations, in each of 20 draws."""
    t_ns, acc, gyr, position, rest = walk(100.0)
    p = ZuptSettings(drift_speed_mps=0.0, acc_scale_noise=0.0, rate_scale_noise=0.0)
    scores = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        a = acc + rng.normal(0.0, p.acc_noise_mps2_rthz * 10.0, acc.shape) + rng.normal(0.0, 0.1, 3)
        g = gyr + rng.normal(0.0, p.rate_noise_radps_rthz * 10.0, gyr.shape) + rng.normal(0.0, p.rate_bias_radps, 3)
        found = Filtered(t_ns, a, g, rest, p, smoothed=False)
        error, covariance = found.tape.position[-1] - position[-1], found.covariances()[1][-1][:3, :3]
        scores.append(float(error @ np.linalg.solve(covariance, error)))
    assert max(scores) < 16.0
    assert np.mean(scores) > 0.1  # nor is it overly humble


def test_clipped_samples_are_missing_data() -> None:
    t_ns, acc, gyr, _, rest = walk(200.0)
    impact = np.zeros(len(acc))
    for k in range(6):  # a heel strike of 0.03 s, there and back, that the sensor cuts off at 16 g
        at = round((2.0 + k * (STEP_S + REST_S) + 0.55) * 200.0)
        impact[at : at + 6] += (0.0, 150.0, 300.0, -150.0, -200.0, -100.0)
    clipped = acc + np.column_stack((impact, 0.0 * impact, 0.0 * impact))
    clipped = np.clip(clipped, -16.0 * G_MPS2, 16.0 * G_MPS2)
    deaf = ZuptSettings(drift_speed_mps=0.0, jerk_mps3=1e9)
    noticed, unnoticed = (
        Filtered(t_ns, clipped, gyr, rest, settings, acc_sd=sd).lengths(*rests(200.0, 6)) - STRIDE_M
        for settings, sd in ((FIRM, clipped_sd(clipped, None, 30.0, 0.3)), (deaf, None))
    )
    assert np.abs(noticed).max() < 0.6 * np.abs(unnoticed).max()
    assert np.abs(noticed).max() < 0.03


def test_a_slow_swing_that_looks_like_rest_is_not_believed() -> None:
    t_ns, acc, gyr, _, rest = walk(100.0)
    into = np.clip(1e-9 * t_ns - 2.0, 0.0, None) % (STEP_S + REST_S)
    false = rest | ((t_ns > 2_000_000_000) & (into > 0.25) & (into < 0.35))
    assert Filtered(t_ns, acc, gyr, false).lengths(*rests(100.0, 6)) == pytest.approx(np.full(6, STRIDE_M), abs=0.02)


def test_a_lost_filter_finds_back() -> None:
    t_ns, acc, gyr, _, rest = walk(100.0, strides=12)
    gyr[450:470, 1] += 4.0  # somebody knocks against the sensor: 0.8 rad that its own noise does not explain
    found = Filtered(t_ns, acc, gyr, rest, smoothed=False)
    stance = rest[found.ends] & (t_ns[found.ends] > int(13e9))
    assert float(np.linalg.norm(found.tape.velocity[stance], axis=1).max()) < 0.3


def test_quietest_instants_fill_what_the_detector_missed() -> None:
    rate_hz = 100.0
    t = np.arange(2000) / rate_hz
    gyr = np.column_stack((0.0 * t, 1.2 + 4.0 * np.sin(math.pi * t) ** 2, 0.0 * t))  # stride 1 s, never at rest
    assert stride_time_s(gyr, rate_hz) == pytest.approx(1.0, abs=0.03)
    filled = with_missed_stances(np.zeros(2000, bool), gyr, rate_hz, rate_energy(gyr, rate_hz))
    k = stance_instants(filled, rate_energy(gyr, rate_hz), rate_hz)
    assert 16 <= len(k) <= 20
    assert np.abs(t[k] - np.rint(t[k])).max() < 0.05
    assert stride_time_s(np.random.default_rng(0).normal(0.0, 1.0, (2000, 3)), rate_hz) == 0.0
    still = np.zeros((300, 3))
    assert not with_missed_stances(np.zeros(300, bool), still, rate_hz, rate_energy(still, rate_hz)).any()


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 204.8, 500.0])
def test_a_rate_that_stands_still_repeats_nothing(rate_hz: float) -> None:
    """Whatever it is: its mean is rounded, and of the rest that leaves every lag would look like every other."""
    for held in np.random.default_rng(5).normal(0.0, 3.0, (30, 3)):
        gyr = np.tile(held, (round((20.0 + abs(held[0])) * rate_hz), 1))
        assert stride_time_s(gyr, rate_hz) == 0.0
        energy = rate_energy(gyr, rate_hz)
        assert not with_missed_stances(np.zeros(len(gyr), bool), gyr, rate_hz, energy).any()


def test_stance_instants_merge_what_is_close() -> None:
    rest = np.zeros(300, bool)
    rest[20:60] = rest[65:80] = rest[150:200] = True
    gyr = np.full((300, 3), 1.0)
    gyr[70] = gyr[180] = 0.0
    found = stance_instants(rest, rate_energy(gyr, 100.0), 100.0)
    assert len(found) == 2
    assert np.abs(found - [70, 180]).max() <= 2
    assert len(stance_instants(np.zeros(10, bool), np.ones(10), 100.0)) == 0


def test_clipping_is_seen_with_and_without_a_stated_range() -> None:
    values = np.zeros((100, 3))
    values[10:14, 2] = -78.4
    assert np.flatnonzero(clipped_sd(values, None, 30.0, 0.3)).tolist() == [10, 11, 12, 13]
    assert not clipped_sd(values[:12], None, 30.0, 0.3).any()  # two samples make no flat top
    assert not clipped_sd(values, 156.9, 30.0, 0.3).any()
    assert clipped_sd(values, 78.4, 30.0, 0.3).max() == pytest.approx(0.3 * 78.4)
