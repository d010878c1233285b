"""The most likely stride: against linear algebra written from the model, and against errors that are known."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fes.estimation.strides.integration import integrate
from fes.estimation.strides.maximum_likelihood import StrideNoise, end_variances, maximum_likelihood
from fes.signals import G_MPS2, FloatArray, IntArray

NOISE = StrideNoise()
GRAVITY = np.array([0.0, 0.0, G_MPS2])


@dataclass
class Stride:
    """A known stride of one second and what a faultless sensor at it delivers; each test spoils something."""

    rate_hz: float = 100.0
    rise_m: float = 0.0
    t_ns: IntArray = field(init=False)
    acc: FloatArray = field(init=False)
    gyr: FloatArray = field(init=False)
    start: FloatArray = field(init=False)
    position: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        fine = 100
        dt = 1.0 / (self.rate_hz * fine)
        t = np.arange(-1, round(self.rate_hz) * fine + 2) * dt
        u = np.clip((t - 0.15) / 0.7, 0.0, 1.0)
        step = u - np.sin(2.0 * math.pi * u) / (2.0 * math.pi)
        bump = 0.5 - 0.5 * np.cos(2.0 * math.pi * u)
        position = np.column_stack((1.2 * step, 0.04 * bump**2, 0.12 * bump**2 + self.rise_m * step))
        turned = Rotation.from_euler("ZY", np.column_stack((0.1 * step, 0.7 * bump**2 * np.sin(2.0 * math.pi * u))))
        force = turned[1:-1].inv().apply((position[2:] - 2.0 * position[1:-1] + position[:-2]) / dt**2 + GRAVITY)
        rates = (turned[:-2].inv() * turned[2:]).as_rotvec() / (2.0 * dt)
        pick = slice(None, None, fine)
        self.t_ns = np.round(t[1:-1][pick] * 1e9).astype(np.int64)
        self.acc, self.gyr = np.ascontiguousarray(force[pick]), np.ascontiguousarray(rates[pick])
        self.start = np.roll(turned[1].as_quat(), 1)
        self.position = position[1:-1][pick]

    def mounted(self, by: Rotation) -> Stride:
        """The same stride seen by a sensor that sits turned by ``by`` on the foot."""
        self.acc, self.gyr = by.inv().apply(self.acc), by.inv().apply(self.gyr)
        self.start = np.roll((Rotation.from_quat(np.roll(self.start, -1)) * by).as_quat(), 1)
        return self

    def solve(
        self,
        noise: StrideNoise = NOISE,
        incline: float = 0.0,
        end_rate_radps: float = 0.0,
        push_mps2: float = 0.0,
    ) -> tuple[bool, FloatArray, FloatArray, FloatArray]:
        """Solved or not, quaternion (N, 4), velocity and position (N, 3)."""
        n = len(self.t_ns)
        quaternion, velocity, position = np.empty((n, 4)), np.empty((n, 3)), np.empty((n, 3))
        solved, self.free_rise_m = maximum_likelihood(
            self.t_ns, self.acc, self.gyr, self.start, np.zeros((2, 3)),
            np.array([self.acc[:3].mean(axis=0), self.acc[-3:].mean(axis=0)]),
            np.array([end_variances(end_rate_radps, 0.0, push_mps2, noise)] * 2),
            incline, noise, quaternion, velocity, position,
        )  # fmt: skip
        return solved, quaternion, velocity, position

    def way_error(self, noise: StrideNoise = NOISE, incline: float = 0.0) -> float:
        """Greatest distance from the true course (m)."""
        _, _, _, position = self.solve(noise, incline)
        return float(np.linalg.norm(position - self.position, axis=1).max())

    def plain_error(self) -> float:
        """The same of strapdown that corrects nothing."""
        _, _, p = strapdown(self, np.zeros(8), np.zeros((len(self.t_ns), 6)))
        return float(np.linalg.norm(p - self.position, axis=1).max())

    def constrained_error(self) -> float:
        """The same of the constrained integration of Negård et al., whose bias absorbs everything."""
        q, _, _ = strapdown(self, np.zeros(8), np.zeros((len(self.t_ns), 6)))
        velocity, position, gamma = np.empty_like(self.acc), np.empty_like(self.acc), np.empty((2, 3))
        assert integrate(self.t_ns, self.acc, q, np.zeros(3), np.zeros(3), 0.0, velocity, position, gamma)
        return float(np.linalg.norm(position - self.position, axis=1).max())


def strapdown(s: Stride, errors: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Reference: tilt (2), gyroscope and accelerometer bias (3, 3) and each sample's turn and push (N, 6) added."""
    attitude = Rotation.from_rotvec([errors[0], errors[1], 0.0]) * Rotation.from_quat(np.roll(s.start, -1))
    gyr, acc = s.gyr + errors[2:5], s.acc + errors[5:8]
    dt = 1e-9 * np.diff(s.t_ns)
    attitudes = [attitude]
    for k in range(1, len(s.t_ns)):
        attitude = Rotation.from_rotvec(noise[k, :3]) * attitude
        attitude = attitude * Rotation.from_rotvec(0.5 * dt[k - 1] * (gyr[k - 1] + gyr[k]))
        attitudes.append(attitude)
    turned = Rotation.concatenate(attitudes)
    a = turned.apply(acc) - GRAVITY
    steps = 0.5 * dt[:, None] * (a[1:] + a[:-1]) + noise[1:, 3:]
    v = np.vstack((np.zeros(3), np.cumsum(steps, axis=0)))
    p = np.vstack((np.zeros(3), np.cumsum(0.5 * dt[:, None] * (v[1:] + v[:-1]), axis=0)))
    return np.ascontiguousarray(np.roll(turned.as_quat(), 1, axis=1)), v, p


def observed(s: Stride, errors: FloatArray, noise: FloatArray) -> FloatArray:
    """Velocity (3), height, and the turn that would bring the measured gravity away from z at the end and the start."""
    q, v, p = strapdown(s, errors, noise)
    tilts = []
    for k, force in ((-1, s.acc[-3:].mean(axis=0)), (0, s.acc[:3].mean(axis=0))):
        up = Rotation.from_quat(np.roll(q[k], -1)).apply(force)
        across = math.hypot(up[0], up[1])
        per = math.atan2(across, up[2]) / across if across > 0.0 else 0.0
        tilts += [-per * up[1], per * up[0]]
    return np.array([*v[-1], p[-1, 2], *tilts])


def reference(s: Stride, noise: StrideNoise) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The most likely errors by the textbook, effects by differences, and the course with them taken out."""
    n, small = len(s.t_ns), 1e-5
    dt = 1.0 / s.rate_hz
    none, quiet = np.zeros(8), np.zeros((n, 6))
    base = observed(s, none, quiet)
    columns, variances = [], []
    sizes = [noise.start_tilt_rad] * 2 + [noise.gyr_drift_rad] * 3 + [noise.acc_bias_mps2] * 3
    for unit, size in zip(np.eye(8), sizes, strict=True):
        columns.append((observed(s, small * unit, quiet) - base) / small)
        variances.append(size**2)
    rate2 = np.einsum("ij,ij->i", s.gyr, s.gyr)
    for k in range(1, n):
        for axis in range(6):
            one = quiet.copy()
            one[k, axis] = small
            columns.append((observed(s, none, one) - base) / small)
            turn = (noise.gyr_noise_radps_rthz**2 + noise.gyr_scale**2 * rate2[k]) * dt
            variances.append(turn if axis < 3 else noise.acc_noise_mps2_rthz**2 * dt)
    effect, prior = np.column_stack(columns), np.array(variances)
    slip = noise.end_velocity_mps**2
    end = np.diag([slip] * 3 + [noise.end_height_m**2] + [noise.end_tilt_rad**2] * 4)
    of_start = np.zeros((8, 3))
    of_start[:3] = np.eye(3)
    of_start[3, 2] = 1e-9 * (s.t_ns[-1] - s.t_ns[0])
    total = (effect * prior) @ effect.T + end + slip * of_start @ of_start.T
    weights = np.linalg.solve(total, -base)
    found = prior * (effect.T @ weights)
    start_velocity = slip * of_start.T @ weights
    q, v, p = strapdown(s, found[:8], np.vstack((np.zeros(6), found[8:].reshape(n - 1, 6))))
    t = 1e-9 * (s.t_ns - s.t_ns[0])[:, None]
    return q, v + start_velocity, p + start_velocity * t


QUIET = NOISE._replace(
    start_tilt_rad=1e-5, gyr_drift_rad=1e-5, acc_bias_mps2=1e-4, gyr_noise_radps_rthz=1e-6, gyr_scale=1e-5,
    acc_noise_mps2_rthz=1e-4, end_velocity_mps=1e-4, end_height_m=0.03, end_tilt_rad=0.05,
)  # fmt: skip


@pytest.mark.parametrize(
    ("noise", "start"),
    [
        (NOISE, ""),
        (QUIET._replace(start_tilt_rad=0.1), "tilt"),
        (QUIET._replace(end_velocity_mps=0.2), "slip"),
    ],
    ids=["all errors", "tilt at the start", "slip at the start"],
)
def test_the_textbook_finds_the_same_course(noise: StrideNoise, start: str) -> None:
    """At 50 Hz, all errors at once: the correction agrees with the reference's to a few percent of its size."""
    rng = np.random.default_rng(1)
    s = Stride(rate_hz=50.0).mounted(Rotation.random(random_state=1))
    tilt = Rotation.from_rotvec([*rng.normal(0.0, 0.015, 2), 0.0])
    s.start = np.roll((tilt * Rotation.from_quat(np.roll(s.start, -1))).as_quat(), 1)
    s.gyr = s.gyr + rng.normal(0.0, 0.004, 3) + rng.normal(0.0, 0.003, s.gyr.shape)
    s.acc = s.acc + rng.normal(0.0, 0.1, 3) + rng.normal(0.0, 0.2, s.acc.shape)
    plain_q, plain_v, plain_p = strapdown(s, np.zeros(8), np.zeros((len(s.t_ns), 6)))
    solved, q, v, p = s.solve(noise)
    reference_q, reference_v, reference_p = reference(s, noise)
    assert solved
    r, reference_r, plain_r = (
        Rotation.from_quat(np.roll(each, -1, axis=1)).as_matrix() for each in (q, reference_q, plain_q)
    )
    compared = {"v": (v, reference_v, plain_v), "p": (p, reference_p, plain_p)}
    if start == "slip":
        compared["slip"] = (v[0], reference_v[0], plain_v[0])
    elif start == "tilt":
        compared["tilt"] = (r[0], reference_r[0], plain_r[0])
        compared["r"] = (r, reference_r, plain_r)
    for what, (mine, theirs, plain) in compared.items():
        correction = np.abs(theirs - plain).max()
        assert correction > 0.003, what
        assert np.abs(mine - theirs).max() < 0.05 * correction, what


@pytest.mark.parametrize("rate_hz", [100.0, 500.0])
def test_nothing_wrong_nothing_corrected(rate_hz: float) -> None:
    s = Stride(rate_hz=rate_hz)
    solved, q, v, p = s.solve()
    assert solved
    assert s.way_error() < 0.001
    assert np.abs(v[-1]).max() < 0.002
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-12)
    np.testing.assert_array_equal(p[0], np.zeros(3))


def spoiled(what: str) -> Stride:
    s = Stride()
    if what == "tilt at the start":
        tilted = Rotation.from_rotvec([0.0, 0.02, 0.0]) * Rotation.from_quat(np.roll(s.start, -1))
        s.start = np.roll(tilted.as_quat(), 1)
    elif what == "gyroscope bias":
        s.gyr = s.gyr + np.array([0.008, 0.012, 0.0])
    elif what == "accelerometer bias":
        s.acc = s.acc + np.array([0.1, 0.05, -0.1])
    elif what == "clipped contact":
        s.acc = s.acc.copy()
        s.acc[80] += np.array([150.0, 20.0, 250.0])
        s.acc[81] -= np.array([40.0, 0.0, 30.0])
    return s


@pytest.mark.parametrize("what", ["tilt at the start", "gyroscope bias", "accelerometer bias", "clipped contact"])
def test_each_error_is_mostly_taken_out(what: str) -> None:
    s = spoiled(what)
    assert s.plain_error() > 0.01
    assert s.way_error() < 0.6 * s.plain_error()


@pytest.mark.parametrize("what", ["tilt at the start", "clipped contact"])
def test_what_is_no_bias_is_not_taken_for_one(what: str) -> None:
    """The constrained integration spreads every error evenly over the stride; here each goes where it came from."""
    s = spoiled(what)
    assert s.way_error() < 0.8 * s.constrained_error()


def test_a_jolt_is_blamed_first() -> None:
    """Without it being noticed as a jolt the same spoiled contact bends the whole course."""
    s = spoiled("clipped contact")
    assert s.way_error() < 0.3 * s.way_error(NOISE._replace(jolt_mps3=1e9))


@pytest.mark.parametrize("incline", [0.0, math.nan])
def test_a_stair(incline: float) -> None:
    s = Stride(rise_m=0.17)
    _, _, _, position = s.solve(incline=incline)
    assert s.free_rise_m == pytest.approx(0.17, abs=0.005)
    if incline == 0.0:
        assert position[-1, 2] < 0.08
    else:
        assert position[-1, 2] == pytest.approx(0.17, abs=0.002)
        assert s.way_error(incline=math.nan) < 0.003


def test_a_foot_that_turns_at_its_end_is_trusted_less() -> None:
    """Tilt of 2.5° measured at the end is mostly believed of a foot at rest, hardly of one that turns at 1 rad/s."""
    s = Stride()
    s.acc = s.acc.copy()
    s.acc[-3:] = Rotation.from_rotvec([0.0, math.radians(2.5), 0.0]).apply(s.acc[-3:])
    _, truth, _, _ = Stride().solve()

    def turned(end_rate_radps: float) -> float:
        _, q, _, _ = s.solve(end_rate_radps=end_rate_radps)
        return 2.0 * math.acos(min(abs(float(q[-1] @ truth[-1])), 1.0))

    assert turned(0.0) > 3.0 * turned(1.0)


def test_a_foot_that_is_jolted_at_its_ends_is_trusted_less() -> None:
    quiet, jolted = (end_variances(0.1, 0.02, push_mps2, NOISE) for push_mps2 in (0.05, 1.0))
    assert jolted[1] > 2.0 * quiet[1]
    assert jolted[0] == quiet[0]
    assert end_variances(0.1, 0.5, 0.05, NOISE)[0] > 4.0 * quiet[0]


def test_gravity_at_the_start_is_listened_to() -> None:
    """The orientation filter is 1° off; a start that is quiet tells so, one that is jolted does not."""
    s = spoiled("tilt at the start")
    _, truth, _, _ = Stride().solve()

    def off(push_mps2: float) -> float:
        _, q, _, _ = s.solve(push_mps2=push_mps2)
        return 2.0 * math.acos(min(abs(float(q[0] @ truth[0])), 1.0))

    assert off(0.0) < 0.8 * off(20.0)


@pytest.mark.parametrize("times", [[0, 10_000_000], [5, 5, 5, 5]], ids=["two samples", "no time passes"])
def test_nothing_to_integrate(times: list[int]) -> None:
    s = Stride()
    n = len(times)
    s.t_ns, s.acc, s.gyr = np.array(times), s.acc[:n], s.gyr[:n]
    assert not s.solve()[0]
