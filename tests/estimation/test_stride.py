"""Integrating one stride: constraints, the smallest correction, trapezoids, stairs; and where strides begin and end."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields, replace
from statistics import median

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from replays import trial
from scipy.spatial.transform import Rotation

from benchmarks.accuracy.stride_length import NO_BIASES, quietest_near, solve_stride
from fes.analysis.pipeline import analyse, calibrations_of
from fes.calibration.recording import calibrate_track
from fes.config import FootGeometry, Stimulation
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.numerics.filters import runs
from fes.estimation.sensor_choice import stride_settings
from fes.estimation.strides import segmentation
from fes.estimation.strides.boundaries import UNSEEN_NS, stride_time_ns
from fes.estimation.strides.integration import double_integral, effects, goes_backward, integrate, orient
from fes.estimation.strides.results import TRAJECTORY_POINTS, StrideMaker, StrideSettings
from fes.estimation.strides.schema import COLUMNS, LIVE_TABLE, STRIDE, TABLE, table_row
from fes.estimation.zupt.thresholds import SHORTEST_MOVE_S, stance_instants
from fes.recording.tracks import Track
from fes.session_log.codec import decode, encode
from fes.signals import FOOT_SENSORS, G_MPS2, NS_PER_S, FloatArray, IntArray, StrideResult
from fes.simulation.forward import VirtualPatient, settings_for
from fes.simulation.forward.closed_loop import recording_of
from fes.stimulation.walking import WalkingJudge
from statemachine.phases import Phase, PhaseChange, Transition

FOOT = "right_foot"
GRAVITY = np.array([0.0, 0.0, G_MPS2])
BOTH_METHODS = [
    StrideSettings(forward=np.array([1.0, 0.0, 0.0]), up=np.array([0.0, 0.0, 1.0]), method=method)
    for method in ("maximum_likelihood", "constrained")
]
SETTINGS = BOTH_METHODS[0]
CREEP_M = 0.002  # in the second that a motion lasts
both_methods = pytest.mark.parametrize("method", BOTH_METHODS, ids=lambda s: s.method)
PHASES = {Phase.PRE_SWING: 100_000_000, Phase.SWING: 300_000_000, Phase.LOADING_RESPONSE: 700_000_000}


@dataclass(frozen=True)
class Motion:
    """A known motion and what a faultless sensor at it would deliver; axes of the sensor are those of the foot."""

    t_ns: IntArray
    acc: FloatArray
    gyr: FloatArray
    quaternion: FloatArray
    position: FloatArray


def smooth(u: FloatArray) -> FloatArray:
    """0 → 1 with rate and acceleration 0 at both ends."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u - np.sin(2.0 * math.pi * u) / (2.0 * math.pi))


def motion(
    rate_hz: float = 200.0,
    length_m: float = 1.2,
    lift_m: float = 0.12,
    rise_m: float = 0.0,
    pitch_rad: float = 0.6,
    turn_rad: float = 0.0,
    roll_rps: float = 0.0,
    tilt_rad: float = 0.0,
    height_m: float = 0.065,
    duration_s: float = 1.0,
    stance_s: float = 0.15,
    drift_speed_mps: float = CREEP_M,
) -> Motion:
    """Stance, swing, stance; ``roll_rps`` turns the foot forward all the time about a ground contact below the sensor;
    ``tilt_rad`` is how far its left side is up in mid-swing.

    Derivatives come from differences on a grid a hundred times finer, the sensor's numbers from picking its instants.
    """
    fine = 100
    dt = 1.0 / (rate_hz * fine)
    t = np.arange(-3, round(duration_s * rate_hz) * fine + 4) * dt
    u = (t - stance_s) / (duration_s - 2.0 * stance_s)
    swing = (u > 0.0) & (u < 1.0)
    bump = np.where(swing, 0.5 - 0.5 * np.cos(2.0 * math.pi * u), 0.0)
    x = length_m * smooth(u) + drift_speed_mps * t + height_m * roll_rps * t
    z = rise_m * smooth(u) + lift_m * bump**2
    toe_down = pitch_rad * bump**2 * np.sin(2.0 * math.pi * u) + roll_rps * t
    position = np.column_stack((x, 0.03 * bump**2, z))
    heading = turn_rad * smooth(u)
    turned = Rotation.from_euler("ZXY", np.column_stack((heading, tilt_rad * bump, toe_down)))
    acceleration = (position[2:] - 2.0 * position[1:-1] + position[:-2]) / dt**2
    rates = (turned[:-2].inv() * turned[2:]).as_rotvec() / (2.0 * dt)
    force = turned[1:-1].inv().apply(acceleration + GRAVITY)
    pick = slice(2, -2, fine)
    return Motion(
        np.round(t[1:-1][pick] * 1e9).astype(np.int64),
        np.ascontiguousarray(force[pick]),
        np.ascontiguousarray(rates[pick]),
        np.ascontiguousarray(np.roll(turned[1:-1][pick].as_quat(), 1, axis=1)),
        position[1:-1][pick],
    )


def solve(m: Motion, stride: StrideSettings = SETTINGS, first: int = 0, last: int = -1) -> StrideResult:
    return solve_stride(
        FOOT, 1, PHASES, first, last % len(m.t_ns), m.t_ns, m.acc, m.gyr, m.quaternion[first], stride
    )  # fmt: skip


# --- the constrained integral ----------------------------------------------------------------------------


def random_case(seed: int) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 200))
    t_ns = np.cumsum(rng.integers(1_000_000, 20_000_000, n))
    q = np.roll(Rotation.random(n, random_state=seed % 2**31).as_quat(), 1, axis=1)
    return t_ns, rng.normal(0.0, 20.0, (n, 3)), np.ascontiguousarray(q), rng.normal(size=3), rng.normal(size=3)


def integrated(
    t_ns: IntArray, acc: FloatArray, q: FloatArray, v0: FloatArray, v1: FloatArray, incline: float = 0.0
) -> tuple[bool, FloatArray, FloatArray, FloatArray]:
    velocity, position, gamma = np.empty((len(t_ns), 3)), np.empty((len(t_ns), 3)), np.empty((2, 3))
    solved = integrate(t_ns, acc, q, v0, v1, incline, velocity, position, gamma)
    return solved, velocity, position, gamma


def left_over(
    t_ns: IntArray, acc: FloatArray, q: FloatArray, v0: FloatArray, v1: FloatArray, gamma: FloatArray
) -> FloatArray:
    """Velocity (3) and height (1) left over at the end, by sums written from Eq. (17) and (18) in trapezoids."""
    t = 1e-9 * (t_ns - t_ns[0])
    tau = (2.0 * t / t[-1] - 1.0)[:, None]
    force = acc - gamma[:3] - gamma[3:] * tau
    a = Rotation.from_quat(np.roll(q, -1, axis=1)).apply(force) - GRAVITY
    dt = np.diff(t)[:, None]
    v = v0 + np.vstack((np.zeros(3), np.cumsum(0.5 * dt * (a[1:] + a[:-1]), axis=0)))
    height = float(np.sum(0.5 * np.diff(t) * (v[1:, 2] + v[:-1, 2])))
    return np.append(v[-1] - v1, height)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_all_four_constraints_hold_exactly(seed: int) -> None:
    t_ns, acc, q, v0, v1 = random_case(seed)
    solved, velocity, position, gamma = integrated(t_ns, acc, q, v0, v1)
    assert solved
    scale = 1.0 + np.abs(gamma).max()  # three samples at random attitudes may need an absurd bias
    np.testing.assert_array_equal(velocity[0], v0)
    np.testing.assert_array_equal(position[0], np.zeros(3))
    np.testing.assert_allclose(velocity[-1], v1, atol=1e-9 * scale)
    assert abs(position[-1, 2]) < 1e-9 * scale
    assert np.abs(left_over(t_ns, acc, q, v0, v1, gamma.ravel())).max() < 1e-9 * scale


@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=60, deadline=None)
def test_the_correction_is_the_smallest_that_does_it(seed: int, equal_height: bool) -> None:
    t_ns, acc, q, v0, v1 = random_case(seed)
    _, _, _, gamma = integrated(t_ns, acc, q, v0, v1, 0.0 if equal_height else math.nan)
    rows = 4 if equal_height else 3
    base = left_over(t_ns, acc, q, v0, v1, np.zeros(6))
    effect = np.column_stack([base - left_over(t_ns, acc, q, v0, v1, unit) for unit in np.eye(6)])
    smallest = np.linalg.lstsq(effect[:rows], base[:rows], rcond=None)[0]
    np.testing.assert_allclose(gamma.ravel(), smallest, rtol=1e-5, atol=1e-6 * (1.0 + np.abs(smallest).max()))
    compiled = np.zeros((4, 6))
    effects(t_ns, q, compiled)
    np.testing.assert_allclose(compiled, effect, atol=1e-9 * (1.0 + np.abs(base).max()))


def test_without_the_height_constraint_the_height_is_free() -> None:
    t_ns, acc, q, v0, v1 = random_case(7)
    solved, velocity, position, _ = integrated(t_ns, acc, q, v0, v1, math.nan)
    assert solved
    np.testing.assert_allclose(velocity[-1], v1, atol=1e-9)
    assert abs(position[-1, 2]) > 0.01


@pytest.mark.parametrize("times", [[0, 10_000_000], [5, 5, 5, 5]], ids=["two samples", "no time passes"])
def test_what_cannot_be_solved_says_so(times: list[int]) -> None:
    n = len(times)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    assert not integrated(np.array(times), np.tile(GRAVITY, (n, 1)), q, np.zeros(3), np.zeros(3))[0]


def test_trapezoids_are_closer_than_the_rectangles_of_the_print() -> None:
    """On a known motion at 100 Hz, orientation given: rectangles lag by half a sample, wherever the foot moves."""
    m = motion(rate_hz=100.0)
    velocity, position = np.empty_like(m.acc), np.empty_like(m.acc)
    start = np.array([CREEP_M, 0.0, 0.0])
    double_integral(m.t_ns, m.acc, m.quaternion, start, np.zeros((2, 3)), velocity, position)
    a = Rotation.from_quat(np.roll(m.quaternion, -1, axis=1)).apply(m.acc) - GRAVITY
    rectangles = np.zeros_like(position)
    rectangles[1:] = 0.01 * np.cumsum(start + 0.01 * np.cumsum(a[1:], axis=0), axis=0)
    truth = m.position - m.position[0]
    trapezoid_error, rectangle_error = (float(np.abs(p - truth).max()) for p in (position, rectangles))
    assert trapezoid_error < 0.001
    assert rectangle_error > 0.008
    assert rectangle_error > 10.0 * trapezoid_error


def test_rates_are_integrated_by_trapezoids_too() -> None:
    m = motion(rate_hz=100.0, turn_rad=0.3)
    out = np.empty_like(m.quaternion)
    tilt = orient(m.t_ns, m.gyr, m.quaternion[0], *m.acc[-1], 0.0, out)
    rectangle = Rotation.from_quat(np.roll(m.quaternion[0], -1))
    worst = 0.0
    for k in range(1, len(m.t_ns)):
        rectangle = rectangle * Rotation.from_rotvec(0.01 * m.gyr[k])
        worst = max(worst, (rectangle.inv() * Rotation.from_quat(np.roll(m.quaternion[k], -1))).magnitude())
    angle = 2.0 * np.arccos(np.clip(np.abs(np.einsum("ij,ij->i", out, m.quaternion)), 0.0, 1.0))
    assert tilt < 0.002
    assert angle.max() < 0.005
    assert worst > 5.0 * angle.max()


@pytest.mark.parametrize("gain", [0.0, 0.15, 1.0])
def test_the_share_of_the_tilt_that_is_taken_back(gain: float) -> None:
    m = motion(turn_rad=0.4)
    drift = np.array([0.03, -0.02, 0.0])
    out = np.empty_like(m.quaternion)
    tilt = orient(m.t_ns, m.gyr + drift, m.quaternion[0], *m.acc[-1], gain, out)
    assert math.degrees(tilt) == pytest.approx(math.degrees(math.hypot(0.03, 0.02)), abs=0.3)
    end = Rotation.from_quat(np.roll(out[-1], -1)).apply(m.acc[-1])
    left = math.atan2(math.hypot(end[0], end[1]), end[2])
    assert left == pytest.approx((1.0 - gain) * tilt, abs=0.001)


def test_no_force_at_the_end_is_no_direction() -> None:
    m = motion()
    assert orient(m.t_ns, m.gyr, m.quaternion[0], 0.0, 0.0, 0.0, 0.15, np.empty_like(m.quaternion)) == math.pi


# --- a stride's numbers ----------------------------------------------------------------------------------


@both_methods
@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 500.0])
def test_a_known_stride(rate_hz: float, method: StrideSettings) -> None:
    result = solve(motion(rate_hz=rate_hz, turn_rad=math.radians(10.0)), method)
    assert result.valid
    assert result.reason == ""
    assert result.stride_length_m == pytest.approx(1.2 + CREEP_M, abs=0.005)
    assert result.clearance_m == pytest.approx(0.12, abs=0.003)
    assert result.height_gained_m == pytest.approx(0.0, abs=1e-9 if method.method == "constrained" else 0.001)
    assert math.degrees(result.turn_rad) == pytest.approx(10.0, abs=0.3)
    assert result.speed_mps == pytest.approx(result.stride_length_m / 1.0, rel=1e-6)
    assert (result.t_start_ns, result.t_end_ns) == (0, 1_000_000_000)
    assert (result.t_pre_swing_ns, result.t_swing_ns, result.t_loading_response_ns, result.t_stance_ns) == (
        100_000_000, 300_000_000, 700_000_000, None,
    )  # fmt: skip
    assert result.trajectory_m.shape == (101, 3)
    np.testing.assert_allclose(result.trajectory_m[0], 0.0, atol=1e-12)
    assert result.trajectory_m[-1, 0] == pytest.approx(result.stride_length_m, abs=1e-9)
    assert result.trajectory_m[-1, 1] == pytest.approx(0.0, abs=1e-9)  # x is the stride's own direction
    assert result.pitch_rad[0] == 0.0
    assert -result.pitch_rad.min() == pytest.approx(0.6 * 0.52, abs=0.1)  # push-off: toe down is negative
    assert np.argmin(result.pitch_rad) < 50 < np.argmax(result.pitch_rad)


@both_methods
@pytest.mark.parametrize(("foot", "inward"), [("left_foot", -1.0), ("right_foot", 1.0)])
def test_the_roll_is_inversion_on_both_feet(foot: str, inward: float, method: StrideSettings) -> None:
    m = motion(tilt_rad=0.2, turn_rad=0.2)
    result = solve_stride(foot, 1, PHASES, 0, len(m.t_ns) - 1, m.t_ns, m.acc, m.gyr, m.quaternion[0], method)
    assert result.roll_rad.shape == result.pitch_rad.shape
    assert result.roll_rad[0] == 0.0
    assert result.roll_rad[-1] == pytest.approx(0.0, abs=0.005)
    assert result.roll_rad[50] == pytest.approx(0.2 * inward, abs=0.01)  # the left side is a left foot's outer one
    assert result.pitch_rad[50] == pytest.approx(solve(motion(turn_rad=0.2), method).pitch_rad[50], abs=0.005)


@both_methods
@pytest.mark.parametrize("incline", [0.0, math.nan])
def test_a_stair(incline: float, method: StrideSettings) -> None:
    result = solve(motion(rise_m=0.17, length_m=0.6), replace(method, incline=incline))
    assert result.valid
    if incline == 0.0:
        assert abs(result.height_gained_m) < (1e-9 if method.method == "constrained" else 0.08)  # torn two ways
    else:
        assert result.height_gained_m == pytest.approx(0.17, abs=0.003)
        assert result.stride_length_m == pytest.approx(0.6 + CREEP_M, abs=0.005)
    if method.method == "maximum_likelihood":
        assert result.free_rise_m == pytest.approx(0.17, abs=0.01)  # whatever the ground is said to be


@both_methods
@pytest.mark.parametrize("percent", [-15.0, 5.0, 10.0])
@pytest.mark.parametrize("known", [True, False])
def test_an_incline(percent: float, known: bool, method: StrideSettings) -> None:
    """Heights count from the line between the stances, whether it is told or found."""
    rise_m = 0.01 * percent * (1.2 + CREEP_M)
    geometry = FootGeometry(toe_forward_m=0.0, toe_up_m=-0.065, heel_forward_m=0.0, heel_up_m=-0.065)
    settings = replace(method, incline=0.01 * percent if known else math.nan, geometry=geometry)
    result = solve(motion(rise_m=rise_m, pitch_rad=0.0), settings)
    assert result.height_gained_m == pytest.approx(rise_m, abs=0.003)
    assert result.clearance_m == pytest.approx(0.12, abs=0.004)
    assert result.heel_clearance_m == pytest.approx(result.clearance_m, abs=0.002)  # it does not turn


def test_on_a_stair_the_toe_has_no_clearance() -> None:
    geometry = FootGeometry(toe_forward_m=0.15, toe_up_m=-0.065, heel_forward_m=-0.07, heel_up_m=-0.065)
    result = solve(motion(rise_m=0.34, length_m=0.6), replace(SETTINGS, incline=math.nan, geometry=geometry))
    assert result.valid
    assert math.isnan(result.toe_clearance_m)
    assert math.isnan(result.heel_clearance_m)
    assert result.clearance_m > 0.34  # above its start


@pytest.mark.parametrize(("roll_rps", "valid"), [(0.5, True), (1.5, True), (4.0, False)])
def test_a_foot_without_true_rest_is_weighed_too_and_says_so(roll_rps: float, valid: bool) -> None:
    m = motion(roll_rps=roll_rps, pitch_rad=0.3)
    mine, plain = (solve(m, method) for method in BOTH_METHODS)
    assert mine.valid is valid
    if valid:
        assert mine.reason.startswith("no true rest: 1.5 rad/s" if roll_rps > 1.0 else "")
        assert mine.stride_length_m != plain.stride_length_m
        assert mine.stride_length_sd_m > solve(motion()).stride_length_sd_m  # the ends are known less well
    else:
        assert mine.reason.startswith("the foot never rests: 4.0 rad/s")


def test_the_quietest_instant_near_a_given_one() -> None:
    t_ns = np.arange(200) * 5_000_000
    rate = np.zeros((len(t_ns), 3))
    rate[:, 1] = 0.05 + np.abs(1e-9 * t_ns - 0.53)
    assert t_ns[quietest_near(t_ns, rate, 500_000_000)] == pytest.approx(530_000_000, abs=6_000_000)
    assert t_ns[quietest_near(t_ns, rate, 400_000_000)] == pytest.approx(450_000_000, abs=6_000_000)


@both_methods
def test_the_ends_move_as_a_foot_that_turns_about_its_contact(method: StrideSettings) -> None:
    """At 0.15 rad/s, 10 cm above the ground, a zero end velocity would cost 1.5 cm a second."""
    rolling = motion(roll_rps=0.15, height_m=0.10)
    way = float(rolling.position[-1, 0] - rolling.position[0, 0])
    right = solve(rolling, replace(method, sensor_height_m=0.10))
    without = solve(rolling, replace(method, sensor_height_m=0.0))
    assert right.stride_length_m == pytest.approx(way, abs=0.005)
    assert without.stride_length_m - way == pytest.approx(-0.015, abs=0.006)


def test_toe_and_heel_need_to_be_known() -> None:
    m = motion()
    assert math.isnan(solve(m).toe_clearance_m)
    assert math.isnan(solve(m).heel_clearance_m)
    geometry = FootGeometry(toe_forward_m=0.12, toe_up_m=-0.06, heel_forward_m=-0.14, heel_up_m=-0.06)
    result = solve(m, replace(SETTINGS, geometry=geometry))
    turned = Rotation.from_quat(np.roll(m.quaternion, -1, axis=1))
    toe, heel = (m.position + turned.apply(arm) - arm for arm in ([0.12, 0.0, -0.06], [-0.14, 0.0, -0.06]))
    middle = (m.t_ns >= 400_000_000) & (m.t_ns < 620_000_000)  # 25–80 % of the swing
    assert result.toe_clearance_m == pytest.approx(float(toe[middle, 2].min()), abs=0.003)
    assert result.heel_clearance_m == pytest.approx(float(heel[:, 2].max()), abs=0.003)


def test_a_toe_that_still_stands_a_tenth_of_the_swing_has_not_left_the_ground() -> None:
    m = motion(
        pitch_rad=0.0, stance_s=0.28, duration_s=1.1, length_m=0.8
    )  # gone 2 % of its way a seventh of the swing after T2
    geometry = FootGeometry(toe_forward_m=0.12, toe_up_m=-0.06, heel_forward_m=-0.14, heel_up_m=-0.06)
    left_ns = m.t_ns[m.position[:, 0] - m.position[0, 0] <= 0.02 * 0.8][-1]
    least_m = []
    for off_ns in (left_ns, 300_000_000):
        begin_ns, end_ns = (off_ns + share * (700_000_000 - off_ns) for share in (0.25, 0.8))
        least_m.append(float(m.position[(m.t_ns >= begin_ns) & (m.t_ns < end_ns), 2].min()))
    measured_m = solve(m, replace(SETTINGS, geometry=geometry)).toe_clearance_m
    assert measured_m == pytest.approx(least_m[0], abs=0.003)
    assert measured_m > least_m[1] + 0.01


def with_gap(m: Motion, gap_s: float) -> Motion:
    keep = ~((m.t_ns > 500_000_000) & (m.t_ns < 500_000_000 + round(gap_s * 1e9)))
    return Motion(m.t_ns[keep], m.acc[keep], m.gyr[keep], m.quaternion[keep], m.position[keep])


@pytest.mark.parametrize(
    ("m", "reason"),
    [
        (with_gap(motion(), 0.06), "samples missing for 60 ms"),
        (motion(duration_s=0.39, stance_s=0.02, length_m=0.2), "lasts 0.39 s"),
        (motion(duration_s=5.1), "lasts 5.10 s"),
        (motion(length_m=3.4, duration_s=2.0), "3.4. m is no stride length"),
    ],
    ids=["gap", "too short", "too long", "too far"],
)
def test_a_stride_that_must_not_be_used_says_why(m: Motion, reason: str) -> None:
    result = solve(m)
    assert not result.valid
    assert re.fullmatch(reason, result.reason)
    assert math.isnan(result.stride_length_m)
    assert math.isnan(result.clearance_m)
    assert result.t_swing_ns == 300_000_000
    assert len(result.trajectory_m) == 0


def test_a_gap_of_a_few_samples_is_bridged() -> None:
    result = solve(with_gap(motion(), 0.02))
    assert result.valid
    assert result.stride_length_m == pytest.approx(1.2 + CREEP_M, abs=0.01)


def test_at_low_rates_a_gap_is_counted_in_samples() -> None:
    """At 50 Hz two lost samples are 60 ms: under three and a half intervals."""
    assert solve(with_gap(motion(rate_hz=50.0), 0.06)).valid


def test_an_orientation_that_is_far_off_at_the_end() -> None:
    m = motion()
    spoiled = Motion(m.t_ns, m.acc, m.gyr + np.array([0.7, 0.0, 0.0]), m.quaternion, m.position)
    result = solve(spoiled)
    assert not result.valid
    assert result.reason == "the orientation is 40° off at its end"


def test_a_start_that_was_not_known_is_righted_only_where_gravity_is_seen_at_both_ends() -> None:
    """By 60°: a foot that turns at 2.2 rad/s does not show where down is."""

    def started_wrong(m: Motion) -> StrideResult:
        off = np.roll((Rotation.from_euler("X", 60.0, degrees=True) * upright(m)).as_quat(), 1)
        return solve(replace(m, quaternion=np.vstack((off, m.quaternion[1:]))))

    def upright(m: Motion) -> Rotation:
        return Rotation.from_quat(np.roll(m.quaternion[0], -1))

    resting = started_wrong(motion())
    assert resting.valid
    assert resting.stride_length_m == pytest.approx(1.2, abs=0.02)
    rolling = started_wrong(motion(roll_rps=2.2, pitch_rad=0.3))
    assert not rolling.valid
    assert rolling.reason.startswith("the orientation is 60° off")


def test_a_jolt_is_no_rest() -> None:
    """A foot that turns to and fro by 5 rad/s does not stand, though on average it hardly turns."""
    m = motion()
    struck = m.gyr + np.outer(
        np.where(1e-9 * m.t_ns < 0.05, 5.0 * (-1.0) ** np.arange(len(m.t_ns)), 0.0), [0.0, 0.0, 1.0]
    )
    result = solve(replace(m, gyr=struck))
    assert not result.valid
    assert result.reason.startswith("the foot never rests: 5.")


def test_a_foot_that_hardly_stands_gives_way_more() -> None:
    """The rate at the ends changes by 12 rad/s each second: a spread of 0.1 rad/s."""
    m = motion()
    near = np.minimum(1e-9 * m.t_ns, 1.0 - 1e-9 * m.t_ns)
    restless = replace(m, gyr=m.gyr + np.outer(12.0 * np.where(near < 0.1, near - 0.05, 0.0), [0.0, 0.0, 1.0]))
    assert 0.001 < solve(restless).stride_length_m - solve(m).stride_length_m < 0.01


def test_no_force_at_all_is_no_stride() -> None:
    m = motion()
    assert not solve(Motion(m.t_ns, 0.0 * m.acc, m.gyr, m.quaternion, m.position)).valid


# --- where strides begin and end -------------------------------------------------------------------------


STRIDE_S = 1.2


class Follower(StrideMaker):
    """Takes phases one at a time, as the compiled core does."""

    @property
    def due_ns(self) -> int | None:
        due_ns = self.core["state"]["due_ns"].item()
        return None if due_ns == segmentation.NEVER_NS else due_ns

    def restart(self, t_ns: int) -> None:
        segmentation.restart(self.core, t_ns)

    def on_phase(self, change: PhaseChange) -> None:
        segmentation.on_phase(self.core, change.destination.value, change.t_ns)

    def leave_stance(self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, start: FloatArray) -> StrideResult | None:
        result = self.close(t_ns, acc, gyr, start) if self.due_ns is not None else None
        segmentation.begin(self.core, len(t_ns), t_ns, gyr, NO_BIASES, STRIDE_S)
        return result

    def close(self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, start: FloatArray) -> StrideResult | None:
        n, out = len(t_ns), segmentation.new_out(1, len(t_ns), TRAJECTORY_POINTS)
        first, last = segmentation.close(self.core, n, t_ns, gyr, NO_BIASES, STRIDE_S, out)
        if first < last:
            segmentation.solve_rows(self.core, first, last, n, t_ns, acc, gyr, start[first], NO_BIASES, out)
        return self.stride_in(out) if out.filled[segmentation.STRIDES] else None


class Walk:
    """A foot's history, second by second, and a stride maker that follows it; stance is loud but for one quiet spot."""

    def __init__(self, steps: int = 3, stance_s: float = 0.6, quiet_s: float = 0.3, swing_s: float = 0.6) -> None:
        self.stance_s, self.swing_s, self.quiet_s = stance_s, swing_s, quiet_s
        self.cycle_s = stance_s + swing_s
        rate_hz = 100.0
        n = round((steps * self.cycle_s + 3.0) * rate_hz)
        self.t_ns = np.arange(n) * 10_000_000
        at = (self.t_ns * 1e-9) % self.cycle_s
        last = self.t_ns * 1e-9 >= steps * self.cycle_s
        loud = np.where(np.abs(at - quiet_s) <= 0.06, 0.01, 0.3)
        loud = np.where((at >= stance_s) & ~last, 3.0, loud)
        self.gyr = np.column_stack((np.zeros(n), loud * np.where(np.arange(n) % 2, 1.0, -1.0), np.zeros(n)))
        self.acc = np.tile(GRAVITY, (n, 1))
        self.quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
        self.maker = Follower(FOOT, SETTINGS)
        self.maker.restart(0)

    def history(self, until_s: float) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        n = round(until_s * 100.0) + 1
        return self.t_ns[:n], self.acc[:n], self.gyr[:n], self.quaternion[:n]

    def go(self, transition: Transition, at_s: float) -> StrideResult | None:
        """One transition as the tracker hands it over."""
        phases = {1: (0, 1), 2: (1, 2), 3: (2, 3), 4: (3, 0), 5: (1, 0), 6: (2, 0)}
        source, destination = phases[transition]
        result = self.maker.leave_stance(*self.history(at_s)) if transition is Transition.T1 else None
        self.maker.on_phase(PhaseChange(round(at_s * 1e9), FOOT, transition, Phase(source), Phase(destination)))
        return result

    def stride(self, number: int, *, contact: bool = True) -> StrideResult | None:
        """All transitions of one stride; returns what T1 closed."""
        start = number * self.cycle_s
        result = self.go(Transition.T1, start + self.stance_s)
        self.go(Transition.T2, start + self.stance_s + 0.2)
        if contact:
            self.go(Transition.T3, start + self.stance_s + 0.5)
        self.go(Transition.T4 if contact else Transition.T6, start + self.cycle_s)
        return result


def test_a_stride_runs_from_quietest_to_quietest_and_closes_with_the_next_heel_rise() -> None:
    walk = Walk()
    assert walk.stride(0) is None
    result = walk.stride(1)
    assert result is not None
    assert result.number == 1
    assert result.t_start_ns == pytest.approx(0.3e9, abs=2e7)
    assert result.t_end_ns == pytest.approx(1.5e9, abs=2e7)
    times = (result.t_pre_swing_ns, result.t_swing_ns, result.t_loading_response_ns, result.t_stance_ns)
    assert times == (600_000_000, 800_000_000, 1_100_000_000, 1_200_000_000)
    again = walk.stride(2)
    assert again is not None
    assert (again.number, again.t_start_ns) == (2, result.t_end_ns)


def test_by_t6_there_is_no_loading_response() -> None:
    walk = Walk()
    walk.stride(0, contact=False)
    result = walk.stride(1)
    assert result is not None
    assert (result.t_loading_response_ns, result.t_stance_ns) == (None, 1_200_000_000)
    assert result.valid


def test_a_heel_lifted_and_put_back_is_no_stride() -> None:
    walk = Walk(stance_s=1.2)
    walk.go(Transition.T1, 0.5)
    walk.go(Transition.T5, 0.8)
    assert walk.maker.due_ns is None
    assert walk.stride(0) is None  # nothing was under way
    result = walk.stride(1)
    assert result is not None
    assert result.number == 1
    assert result.t_pre_swing_ns == 1_200_000_000  # of the swing, not of the lifted heel


def test_a_heel_lifted_after_a_stride_closes_it_once() -> None:
    walk = Walk(stance_s=1.2)
    walk.stride(0)
    closed = walk.go(Transition.T1, 1.8 + 0.6)
    walk.go(Transition.T5, 1.8 + 0.8)
    assert closed is not None
    assert closed.number == 1
    assert walk.go(Transition.T1, 3.0) is None


def test_a_long_stance_closes_the_stride_by_the_time() -> None:
    walk = Walk(steps=1)
    walk.stride(0)
    assert walk.maker.due_ns == 2_200_000_000  # a second into the stance
    result = walk.maker.close(*walk.history(2.2))
    assert result is not None
    assert result.number == 1
    assert 1_170_000_000 <= result.t_end_ns <= 1_700_000_000  # of a long stance only the first half second
    assert walk.maker.due_ns is None
    assert walk.maker.close(*walk.history(2.3)) is None
    assert walk.go(Transition.T1, 3.0) is None


def test_one_border_for_each_stance_however_long_unless_the_foot_stops() -> None:
    for stance_s, stops in ((1.5, False), (2.9, True)):
        walk = Walk(stance_s=stance_s)
        walk.stride(0)
        first = walk.maker.close(*walk.history(walk.cycle_s + 1.0))  # by the time
        second = walk.stride(1)
        second = second or walk.maker.close(*walk.history(2 * walk.cycle_s + 1.0))
        assert first is not None
        assert second is not None
        assert (second.t_start_ns > first.t_end_ns) is stops


def test_a_heel_put_back_leaves_no_gap() -> None:
    walk = Walk(stance_s=1.2)
    walk.stride(0)
    closed = walk.go(Transition.T1, 1.8 + 0.6)
    walk.go(Transition.T5, 1.8 + 0.8)
    walk.stride(1)
    result = walk.maker.close(*walk.history(2 * 1.8 + 1.0))
    assert closed is not None
    assert result is not None
    assert result.t_start_ns == closed.t_end_ns


def test_a_stance_in_which_the_foot_turns_fast_is_none() -> None:
    walk = Walk()
    walk.stride(0)
    walk.gyr[120:181, 1] = 4.0  # all of the next stance: a swing in which a contact was thought to be
    assert walk.stride(1) is None
    result = walk.stride(2)
    assert result is not None
    assert (result.number, result.t_end_ns - result.t_start_ns) == (1, pytest.approx(2.4e9, abs=4e7))


def test_where_no_gravity_was_seen_the_next_stride_starts_as_the_last_one_ended() -> None:
    """The filter's orientation is 6° off at the second stride's start; the first one's end knew better."""
    m = motion()
    n, off = len(m.t_ns), Rotation.from_rotvec([0.0, 0.1, 0.0])
    wrong = (off * Rotation.from_quat(m.quaternion[0][[1, 2, 3, 0]])).as_quat()[[3, 0, 1, 2]]
    lengths = []
    for chained in (False, True):
        maker, out = Follower(FOOT, SETTINGS), segmentation.new_out(1, n, TRAJECTORY_POINTS)
        out.filled[segmentation.STRIDES] = 1
        if chained:
            maker.core["state"]["chained_ns"], maker.core["state"]["chained"] = m.t_ns[0], m.quaternion[0]
        segmentation.solve_rows(maker.core, 0, n - 1, n, m.t_ns, m.acc, m.gyr, wrong, NO_BIASES, out)
        segmentation.chain(maker.core, out)
        assert maker.core["state"]["chained_ns"] == out.strides["t_end_ns"][0]
        lengths.append(out.strides["stride_length_m"][0])
    assert abs(lengths[1] - 1.2 - CREEP_M) < 0.01 < abs(lengths[0] - 1.2 - CREEP_M)


def test_a_start_is_sought_only_in_the_last_second_of_a_long_stance() -> None:
    walk = Walk(steps=1, stance_s=3.0, quiet_s=0.5)
    walk.go(Transition.T1, 3.0)
    walk.go(Transition.T2, 3.2)
    walk.go(Transition.T4, 3.6)
    result = walk.maker.close(*walk.history(4.6))
    assert result is not None
    assert result.t_start_ns >= 2_000_000_000


def test_lost_data_end_the_stride_under_way() -> None:
    walk = Walk()
    walk.stride(0)
    walk.maker.restart(1_250_000_000)
    assert walk.maker.due_ns is None
    assert walk.stride(1) is None  # the stance before the silence is not its end
    result = walk.stride(2)
    assert result is not None
    assert result.number == 1
    assert result.t_start_ns > 1_250_000_000


@pytest.mark.parametrize(("radps", "begins"), [(0.3, True), (3.9, False)])
def test_data_that_go_on_in_a_swing_begin_no_stride(radps: float, begins: bool) -> None:
    t_ns = np.arange(4) * 10_000_000 + NS_PER_S
    gyr = np.column_stack((np.zeros(4), radps + np.array([0.1, 0.0, 0.1, 0.2]), np.zeros(4)))
    maker = Follower(FOOT, SETTINGS)
    maker.restart(int(t_ns[0]))
    segmentation.begin(maker.core, 4, t_ns, gyr, NO_BIASES, STRIDE_S)
    assert (maker.core["state"]["start_ns"].item() != UNSEEN_NS) == begins


def test_a_stride_that_outlasts_the_history() -> None:
    walk = Walk()
    walk.stride(0)
    t_ns, acc, gyr, quaternion = walk.history(1.8)
    late = slice(50, None)  # the start, at 0.3 s, has been forgotten
    result = walk.maker.leave_stance(t_ns[late], acc[late], gyr[late], quaternion[late])
    assert result is not None
    assert not result.valid
    assert result.reason == "longer than the history kept"


# --- How long a stride took: the rest between two strides of a walk belongs to it, standing does not ---


@pytest.mark.parametrize(
    ("before_ns", "time_ns"),
    [(None, 100), (1000, 100), (940, 160), (900, 200), (899, 100), (1001, 100), (1050, 100)],
)
def test_a_rest_no_longer_than_the_stride_is_part_of_it(before_ns: int | None, time_ns: int) -> None:
    assert stride_time_ns(1000, 1100, UNSEEN_NS if before_ns is None else before_ns) == time_ns


@pytest.mark.parametrize("speed_mps", [0.2, 0.6])
def test_in_slow_walking_the_speed_is_the_belts(speed_mps: float) -> None:
    patient = VirtualPatient(settings_for("moderate", speed_mps=speed_mps, seed=4))
    samples = patient.advance(60 * NS_PER_S)
    recording, found = calibrations_of(recording_of(patient, samples, "walk", ""))
    strides = [stride for stride in analyse(recording, found.calibrations).strides if stride.valid]
    for foot in FOOT_SENSORS:
        mine = [stride for stride in strides if stride.foot == foot][3:-1]
        assert median(stride.speed_mps for stride in mine) == pytest.approx(speed_mps, rel=0.05)


# --- The columns of a stride, stated once: what carries them has the same names, in the docs too ---


PATH = {"x_m", "y_m", "z_m", "heading_rad"}
LIVE = {f"t_{phase}_live_s" for phase in ("pre_swing", "swing", "loading_response", "stance")}
RESULT = StrideResult(
    "left_foot", 3, 10, 2_000_000_000, 1.2, 0.1, 0.0, 0.02, 1.1, 5, None, 6, 7, 0.02, 0.2, True, "why",
    np.zeros((101, 3)), np.zeros(101),
)  # fmt: skip


def test_a_stride_has_the_columns_that_the_schema_states() -> None:
    carried = {field.name for field in fields(StrideResult)} - {"trajectory_m", "pitch_rad", "roll_rad", "left_over"}
    assert carried == {column.name for column in COLUMNS if column.shown} - PATH - LIVE
    assert len({column.name for column in COLUMNS}) == len(COLUMNS)
    assert set(STRIDE.names or ()) >= carried - {"foot", "valid", "reason"}


def test_a_row_of_the_table_is_in_seconds() -> None:
    row = table_row(RESULT)
    assert set(row) | PATH == {column.name for column in LIVE_TABLE} == {column.name for column in TABLE} - LIVE
    assert "off-line" not in " ".join(column.text for column in LIVE_TABLE)
    assert (row["t_end_s"], row["t_pre_swing_s"], row["t_swing_s"]) == (2.0, 5e-9, None)
    assert row["stride_length_m"] == 1.2
    assert all(column.text and (column.unit or column.kind is not float) for column in TABLE)
    assert not math.isnan(row["speed_mps"])


def test_a_log_carries_the_same_columns() -> None:
    kind, payload = encode(RESULT)
    assert decode(kind, memoryview(payload)) == RESULT


def test_a_log_from_before_the_roll_is_read() -> None:
    angles = np.linspace(0.0, 0.5, 101)
    stride = replace(RESULT, pitch_rad=angles, roll_rad=-angles)
    kind, payload = encode(stride)
    now, before = decode(kind, memoryview(payload)), decode(kind, memoryview(payload)[: -4 * 101])
    assert isinstance(now, StrideResult)
    assert isinstance(before, StrideResult)
    assert now.roll_rad == pytest.approx(-angles, abs=1e-7)
    assert before == RESULT
    assert (len(before.roll_rad), len(before.trajectory_m)) == (0, 101)
    assert np.array_equal(before.pitch_rad, now.pitch_rad)
    with pytest.raises(ValueError, match="length"):
        decode(kind, memoryview(payload)[:-4])


# --- Steps backward, walked with the calibration of a walk forward: refused ---


def turned_round(track: Track) -> Track:
    """The same movement, last sample first: joints go backward nearly so."""
    return replace(
        track,
        t_ns=track.t_ns[0] + track.t_ns[-1] - track.t_ns[::-1],
        t_sensor_ns=track.t_sensor_ns[0] + track.t_sensor_ns[-1] - track.t_sensor_ns[::-1],
        acc_mps2=track.acc_mps2[::-1].copy(),
        gyr_radps=-track.gyr_radps[::-1],
    )


@pytest.mark.parametrize("name", ["both_feet_100hz", "negard_patient2"])
def test_steps_backward_are_told_and_permit_no_bursts(name: str) -> None:
    track = trial(name).tracks["right_foot"]
    calibration = calibrate_track(track)
    assert isinstance(calibration, FootCalibration)
    back = turned_round(track)
    tracker = FootTracker(calibration, StrideMaker(track.sensor, stride_settings(calibration)))
    judge, permitted, strides = WalkingJudge(Stimulation()), 0, list[StrideResult]()
    for outcome in tracker.advance(back.t_sensor_ns, back.acc_mps2, back.gyr_radps):
        if isinstance(outcome, StrideResult):
            strides.append(outcome)
            judge.on_stride(outcome)
        elif isinstance(outcome, PhaseChange):
            permitted += judge.on_phase(outcome) and outcome.transition.name == "T1"
    told = [stride for stride in strides if stride.reason.startswith("went backward")]
    assert len(strides) > 20
    assert len(told) > 0.2 * len(strides)
    assert permitted <= 0.1 * len(strides)


@pytest.mark.parametrize(("ahead_m", "turn_rad", "backward"), [(-0.4, 0.0, True), (0.4, 0.0, False), (-0.1, 0.0, False),
                                                               (-0.4, 1.7, False)])  # fmt: skip
def test_a_stride_goes_backward_where_the_heel_points(ahead_m: float, turn_rad: float, backward: bool) -> None:
    position = np.linspace((0.0, 0.0, 0.0), (0.0, ahead_m, 0.0), 50)  # the toe points along y
    quaternion = np.tile((np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)), (50, 1))
    assert goes_backward(quaternion, position, turn_rad, 1.0, 0.0, 0.0) == backward


# --- Quietest instants of rests and of long movements, against the same in plain words ---


REST = st.integers(40, 200).flatmap(lambda n: arrays.arrays(np.bool_, n))


@settings(deadline=None)
@given(REST, st.integers(0, 2**32 - 1))
def test_the_quietest_of_every_rest(rest, seed):
    energy = np.random.default_rng(seed).integers(0, 9, len(rest)).astype(np.float64)
    joined: list[list[int]] = []
    for begin, end in runs(rest).tolist():
        if joined and begin - joined[-1][1] < 100.0 * SHORTEST_MOVE_S:
            joined[-1][1] = end
        else:
            joined.append([begin, end])
    found = stance_instants(rest, energy, 100.0).tolist()
    assert found == [begin + int(energy[begin:end].argmin()) for begin, end in joined]


@settings(deadline=None)
@given(REST)
def test_runs_are_what_is_true(rest):
    found = runs(rest)
    assert (
        np.concatenate([np.zeros(0, int), *(np.arange(*each) for each in found)]).tolist()
        == np.flatnonzero(rest).tolist()
    )
    assert (found[1:, 0] > found[:-1, 1]).all()
