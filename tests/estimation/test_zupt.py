"""The ZUPT-aided filter's reference: analytic walks, smoothed as Rauch, Tung, Striebel, covariance, causality."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fes.estimation.zupt.covariance import BIASES, STATES, WIDTH, update
from fes.estimation.zupt.decimation import ZuptSettings
from fes.estimation.zupt.detectors import Detector, rate_energy
from fes.estimation.zupt.foot_trajectory import clipped_sd
from fes.estimation.zupt.thresholds import (
    BoolArray,
    ZeroVelocityThresholds,
    stance_instants,
    stride_time_s,
    with_missed_stances,
)
from fes.recording import read_recording
from fes.signals import G_MPS2, FloatArray, IntArray
from fes.simulation.truth import load_truth
from tests.estimation.zupt_reference import (
    Tape,
    ZuptPath,
    add_noise,
    forward,
    new_tape,
    predict,
    propagate_one,
    smooth,
    zupt_path,
)

SIMULATED = Path(__file__).resolve().parents[2] / "sim_inputs"
UP = np.array([0.0, 0.0, G_MPS2])
STRIDE_M, STEP_S, REST_S = 1.2, 0.6, 0.5
FIRM = ZuptSettings(drift_speed_mps=0.0)
STANDING = ZeroVelocityThresholds(Detector.SHOE, 2.0, G_MPS2, (0.0, 0.0, 0.0), True)
NO_LEVER = (0.0, 0.0, 0.0)


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


@pytest.mark.parametrize("rate_hz", [100.0, 204.8, 500.0])
def test_an_exact_walk_comes_out_exact_at_any_rate(rate_hz: float) -> None:
    t_ns, acc, gyr, position, rest = walk(rate_hz)
    for smoothed in (False, True):
        path = zupt_path(
            t_ns, acc, gyr, calibration=STANDING, rest=rest, lever_m=NO_LEVER, settings=FIRM, smoothed=smoothed
        )
        assert path.stride_lengths(*rests(rate_hz, 6)) == pytest.approx(np.full(6, STRIDE_M), abs=0.004)
        assert np.abs(path.position_m - position).max() < 0.015


def test_biases_are_found() -> None:
    t_ns, acc, gyr, _, rest = walk(200.0, strides=20)
    gyr = gyr + np.array([0.008, -0.006, 0.004])
    acc = acc + np.array([0.0, 0.0, 0.1])
    path = zupt_path(t_ns, acc, gyr, calibration=STANDING, rest=rest, lever_m=NO_LEVER, settings=FIRM)
    assert path.gyr_bias_radps[-1, :2] == pytest.approx((0.008, -0.006), abs=0.0015)
    assert path.acc_bias_mps2[-1, 2] == pytest.approx(0.1, abs=0.02)
    assert path.stride_lengths(*rests(200.0, 20)) == pytest.approx(np.full(20, STRIDE_M), abs=0.015)


def test_the_arm_counts() -> None:
    """A stance that rocks forward on the ground: with the arm the length is right, with zero velocity it is short."""
    t_ns, acc, gyr, position, rest = walk(200.0, lever_m=0.1, rock_radps=0.5)
    begin, end = rests(200.0, 6)
    true = np.interp(end, t_ns, position[:, 0]) - np.interp(begin, t_ns, position[:, 0])
    errors = {
        arm: zupt_path(
            t_ns, acc, gyr, calibration=STANDING, rest=rest, lever_m=(0.0, 0.0, arm), settings=FIRM
        ).stride_lengths(begin, end)
        - true
        for arm in (0.0, 0.1)
    }
    assert np.abs(errors[0.1][1:]).max() < 0.008
    assert errors[0.0][1:].mean() < -0.01


def test_stairs_are_climbed_unless_the_ground_is_said_to_be_level() -> None:
    t_ns, acc, gyr, _, rest = walk(200.0, rise_m=0.17)
    free, level = (
        zupt_path(
            t_ns, acc, gyr, calibration=STANDING, rest=rest, lever_m=NO_LEVER, settings=FIRM, level_ground=level_ground
        )
        for level_ground in (False, True)
    )
    assert free.position_m[-1, 2] == pytest.approx(6 * 0.17, abs=0.02)
    assert abs(level.position_m[-1, 2]) < 0.05


def test_forward_knows_nothing_of_the_future() -> None:
    t_ns, acc, gyr, _, rest = walk(100.0)
    other_acc, other_gyr, other_rest = acc.copy(), gyr.copy(), rest.copy()
    other_acc[400:] += 2.0
    other_gyr[400:] -= 0.3
    other_rest[400:] = ~other_rest[400:]
    one, other = (
        zupt_path(
            t_ns,
            a,
            g,
            calibration=STANDING,
            rest=r,
            lever_m=NO_LEVER,
            smoothed=False,
            acc_range_mps2=160.0,
            gyr_range_radps=35.0,
        )
        for a, g, r in ((acc, gyr, rest), (other_acc, other_gyr, other_rest))
    )
    for part in ("position_m", "velocity_mps", "q_world_from_sensor", "gyr_bias_radps", "acc_bias_mps2", "covariance"):
        assert np.array_equal(getattr(one, part)[:400], getattr(other, part)[:400]), part
    assert not np.allclose(one.position_m[420], other.position_m[420])


def filtered(rate_hz: float, strides: int, p: ZuptSettings) -> tuple[IntArray, FloatArray, Tape]:
    t_ns, acc, gyr, _, rest = walk(rate_hz, strides)
    rng = np.random.default_rng(4)
    acc = acc + rng.normal(0.0, 0.1, acc.shape)
    gyr = gyr + rng.normal(0.0, 0.01, gyr.shape)
    tape, none = new_tape(len(t_ns)), np.zeros(len(t_ns))
    forward(t_ns, acc, gyr, none, none, rest, acc[0], np.zeros(3), False, p, tape)
    return t_ns, np.concatenate((acc, gyr), axis=1), tape


def test_smoothing_is_that_of_rauch_tung_striebel() -> None:
    """The textbook's recursion, with inverses, on the same forward pass."""
    p = ZuptSettings(drift_speed_mps=0.0, outlier_sigmas=1e6)
    t_ns, imu, tape = filtered(50.0, 2, p)
    n = len(t_ns)
    correction = np.zeros((n, STATES))
    none = np.zeros(n)
    for i in range(n - 1, 0, -1):
        dt = 1e-9 * float(t_ns[i] - t_ns[i - 1])
        phi, flat = np.eye(STATES), np.zeros(STATES * WIDTH)
        for column in phi:  # rows of the transpose until all are carried
            propagate_one(column, column, tape.rotation[i], tape.force[i], dt)
        phi = phi.T
        mean_rate = 0.5 * (imu[i - 1, 3:] + imu[i, 3:]) - tape.gyr_bias[i - 1]
        add_noise(flat, imu[:, :3].copy(), i, tape.force[i], float(np.linalg.norm(mean_rate)), none, none, dt, p)
        noise = flat.reshape(STATES, WIDTH)[:, :STATES]
        predicted = phi @ tape.covariance[i - 1] @ phi.T + noise
        injected = sum(
            (tape.gain[i, k] * tape.residual[i, k] for k in range(3) if tape.residual_var[i, k] > 0.0),
            np.zeros(STATES),
        )
        back = np.linalg.solve(predicted, phi @ tape.covariance[i - 1]).T
        correction[i - 1] = back @ (correction[i] + injected)
    before = Tape(*(part.copy() for part in tape))
    smooth(t_ns, True, p, tape)
    assert np.abs(correction[:, :3]).max() > 0.001
    assert tape.position - before.position == pytest.approx(correction[:, :3], abs=1e-6)
    assert tape.velocity - before.velocity == pytest.approx(correction[:, 3:6], abs=1e-6)
    assert tape.acc_bias - before.acc_bias == pytest.approx(correction[:, 12:], abs=1e-6)


def test_covariance_stays_sound() -> None:
    _, _, tape = filtered(100.0, 8, ZuptSettings())
    assert tape.covariance == pytest.approx(tape.covariance.transpose(0, 2, 1), rel=1e-9, abs=1e-15)
    least = np.linalg.eigvalsh(tape.covariance)[:, 0]
    assert least.min() > -1e-12


def test_standing_for_an_hour_tells_nothing_of_heading() -> None:
    rng = np.random.default_rng(6)
    n = 36_000
    t_ns = np.arange(n) * 100_000_000
    acc = np.array([0.0, 0.0, G_MPS2]) + rng.normal(0.0, 0.02, (n, 3))
    gyr = rng.normal(0.0, 0.002, (n, 3))
    path = zupt_path(t_ns, acc, gyr, rest=np.ones(n, bool), smoothed=False)
    heading = path.covariance[:, 8, 8]
    assert np.all(np.diff(heading[100:]) > -1e-12)
    assert np.linalg.eigvalsh(path.covariance[-1])[0] > 0.0
    assert float(np.linalg.norm(path.velocity_mps[-1])) < 0.01


def test_errors_are_as_large_as_the_filter_says() -> None:
    """Noise drawn as the settings say: the end of the path lies within 4 standard deviations, in each of 20 draws."""
    t_ns, acc, gyr, position, rest = walk(100.0)
    p = ZuptSettings(drift_speed_mps=0.0, acc_scale_noise=0.0, rate_scale_noise=0.0)
    scores = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        a = acc + rng.normal(0.0, p.acc_noise_mps2_rthz * 10.0, acc.shape) + rng.normal(0.0, 0.1, 3)
        g = gyr + rng.normal(0.0, p.rate_noise_radps_rthz * 10.0, gyr.shape) + rng.normal(0.0, p.rate_bias_radps, 3)
        path = zupt_path(t_ns, a, g, calibration=STANDING, rest=rest, lever_m=NO_LEVER, smoothed=False, settings=p)
        error = path.position_m[-1] - position[-1]
        scores.append(float(error @ np.linalg.solve(path.covariance[-1, :3, :3], error)))
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
    begin, end = rests(200.0, 6)
    noticed, unnoticed = (
        zupt_path(
            t_ns, clipped, gyr, calibration=STANDING, rest=rest, lever_m=NO_LEVER, settings=settings,
            acc_range_mps2=full_scale,
        ).stride_lengths(begin, end) - STRIDE_M
        for settings, full_scale in ((FIRM, None), (ZuptSettings(drift_speed_mps=0.0, jerk_mps3=1e9), 1e9))
    )  # fmt: skip
    assert np.abs(noticed).max() < 0.6 * np.abs(unnoticed).max()
    assert np.abs(noticed).max() < 0.03


def test_a_slow_swing_that_looks_like_rest_is_not_believed() -> None:
    t_ns, acc, gyr, _, rest = walk(100.0)
    into = np.clip(1e-9 * t_ns - 2.0, 0.0, None) % (STEP_S + REST_S)
    false = rest | ((t_ns > 2_000_000_000) & (into > 0.25) & (into < 0.35))
    lengths = zupt_path(
        t_ns, acc, gyr, calibration=STANDING, rest=false, lever_m=NO_LEVER, settings=FIRM
    ).stride_lengths(*rests(100.0, 6))
    assert lengths == pytest.approx(np.full(6, STRIDE_M), abs=0.02)


def test_a_lost_filter_finds_back() -> None:
    t_ns, acc, gyr, _, rest = walk(100.0, strides=12)
    gyr = gyr.copy()
    gyr[450:470, 1] += 4.0  # somebody knocks against the sensor: 0.8 rad that its own noise does not explain
    path = zupt_path(t_ns, acc, gyr, calibration=STANDING, rest=rest, lever_m=NO_LEVER, settings=FIRM, smoothed=False)
    stance = rest & (t_ns > int(13e9))
    assert float(np.linalg.norm(path.velocity_mps[stance], axis=1).max()) < 0.3


@pytest.mark.parametrize(
    ("name", "rmse_m"),
    [("both_feet_100hz", 0.01), ("both_feet_200hz", 0.01), ("misaligned", 0.012), ("soft_contact", 0.01),
     ("negard_patient1", 0.02), ("negard_patient2", 0.022)],
)  # fmt: skip
def test_simulated_walks_smoothed(name: str, rmse_m: float) -> None:
    recording, truth = (load(SIMULATED / f"{name}.parquet") for load in (read_recording, load_truth))
    for sensor, track in recording.tracks.items():
        new = np.append(True, np.diff(track.t_sensor_ns) > 0)  # one of the sensors doubles samples
        path = zupt_path(track.t_sensor_ns[new], track.acc_mps2[new], track.gyr_radps[new])
        strides = [s for s in truth.strides_of(sensor) if s.steady and s.walking]
        begin = np.array([round(1e9 * s.t_start_s) for s in strides])
        end = np.array([round(1e9 * s.t_end_s) for s in strides])
        errors = path.stride_lengths(begin, end) - [s.stride_length_m for s in strides]
        assert len(errors) >= 30
        assert float(np.sqrt(np.mean(errors**2))) < rmse_m


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


def test_plan_and_instants() -> None:
    t_ns, acc, gyr, _, rest = walk(100.0)
    path: ZuptPath = zupt_path(t_ns, acc, gyr, calibration=STANDING, rest=rest, lever_m=NO_LEVER, settings=FIRM)
    plan = path.plan_m()
    far = plan[np.argmax(np.hypot(*plan.T))]
    assert far == pytest.approx((6 * STRIDE_M, 0.0), abs=0.02)
    with pytest.raises(ValueError, match="outside"):
        path.at(np.array([t_ns[-1] + 1]))


def test_what_does_not_fit_is_refused() -> None:
    t_ns, acc, gyr, _, rest = walk(100.0)
    with pytest.raises(ValueError, match=r"need \(N,\)"):
        zupt_path(t_ns, acc[:-1], gyr)
    doubled = t_ns.copy()
    doubled[5] = doubled[4]
    with pytest.raises(ValueError, match="increase strictly"):
        zupt_path(doubled, acc, gyr)
    with pytest.raises(ValueError, match="rest has the shape"):
        zupt_path(t_ns, acc, gyr, rest=rest[:-1])
    acc[7] = np.inf
    with pytest.raises(ValueError, match="finite"):
        zupt_path(t_ns, acc, gyr)


def test_prediction_and_measurement_are_those_of_matrices() -> None:
    rng = np.random.default_rng(3)
    half = rng.normal(0.0, 1.0, (STATES, STATES))
    dense = half @ half.T
    flat = np.ascontiguousarray(np.pad(dense, ((0, 0), (0, 1)))).ravel()
    rotation, force, dt = np.linalg.qr(rng.normal(0.0, 1.0, (3, 3)))[0].copy(), rng.normal(0.0, 5.0, 3), 0.01
    phi = np.eye(STATES)
    for column in phi:
        propagate_one(column, column, rotation, force, dt)
    phi = phi.T
    predict(flat, np.empty(BIASES * WIDTH), rotation, force, dt)
    wanted = phi @ dense @ phi.T
    assert flat.reshape(STATES, WIDTH)[:, :STATES] == pytest.approx(wanted, rel=1e-10, abs=1e-12)
    state, gain = np.zeros(STATES), np.empty(WIDTH)
    variance = update(flat, state, 4, 0.5, 0.2, np.empty(WIDTH), gain)
    assert variance == pytest.approx(wanted[4, 4] + 0.2)
    assert state == pytest.approx(0.5 * wanted[:, 4] / variance)
    after = flat.reshape(STATES, WIDTH)
    assert after[:, :STATES] == pytest.approx(wanted - np.outer(wanted[4], wanted[4]) / variance, abs=1e-10)
    assert np.array_equal(after[:, :STATES], after[:, :STATES].T)
    assert not after[:, STATES].any()
