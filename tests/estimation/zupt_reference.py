"""The ZUPT-aided filter written out from sample to sample, forward and smoothed, to check the product's filter.

:mod:`fes.estimation.zupt.filter` says what is measured and why; it goes over intervals of a few hundredths of a second.
Here every sample is an interval, a path can be had forward only, and every sample's covariance can be kept.

With ``f`` the mean specific force of a sampling interval in the world and ``R`` the orientation in its middle, the
error state of :mod:`fes.estimation.zupt.covariance` moves as::

    dp/dt = v,  dv/dt = psi × f - R b_a,  dpsi/dt = -R b_g
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.numerics.jit import jit, jit_fused
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import from_gravity, quaternion_step, to_world
from fes.estimation.zupt.covariance import BIASES, DIAGONAL, STATES, WIDTH, update
from fes.estimation.zupt.decimation import ZuptSettings, start_variances
from fes.estimation.zupt.filter import MEASURED, drift_velocity, rotate_in_world
from fes.estimation.zupt.foot_trajectory import CLIPPED_SD, LEAST_RANGE, LEVER_M, clipped_sd
from fes.estimation.zupt.thresholds import (
    START_S,
    BoolArray,
    ZeroVelocityThresholds,
    find_zero_velocity,
    first_stance,
    with_missed_stances,
)
from fes.signals import G_MPS2, FloatArray, IntArray, Vector3


class Tape(NamedTuple):
    """What the filter leaves behind, N rows each; all from ``force`` on is for the smoother."""

    position: FloatArray  # (N, 3) m
    velocity: FloatArray  # (N, 3) m/s
    quaternions: FloatArray  # (N, 4)
    gyr_bias: FloatArray  # (N, 3) rad/s
    acc_bias: FloatArray  # (N, 3) m/s²
    covariance: FloatArray  # (N, 15, 15), or no rows: not kept
    force: FloatArray  # (N, 3) mean specific force in the world over the interval before the sample
    rotation: FloatArray  # (N, 3, 3) in the middle of that interval
    added: FloatArray  # (N, 3) variance of velocity and of rotation that the interval adds; of velocity, being lost
    residual: FloatArray  # (N, 4)
    residual_var: FloatArray  # (N, 4), 0: not measured
    gain: FloatArray  # (N, 4, 15), of what was measured


@dataclass(frozen=True, slots=True)
class ZuptPath:
    """Where a foot was; N samples, world with z up and the heading of the first sample.

    It begins where the foot has rested for 0.1 s for the first time; earlier rows repeat that one.

    Attributes:
        t_ns: (N,) time stamps.
        position_m: (N, 3) from where it begins.
        velocity_mps: (N, 3).
        q_world_from_sensor: (N, 4), wxyz.
        gyr_bias_radps: (N, 3).
        acc_bias_mps2: (N, 3).
        covariance: (N, 15, 15) of the errors of position, velocity, rotation in the world, both biases; no rows of a
            smoothed path, which does not need it.
        rest: (N,) where the velocity was measured.
        smoothed: every sample knows the whole recording; else only what came before.
    """

    t_ns: IntArray
    position_m: FloatArray
    velocity_mps: FloatArray
    q_world_from_sensor: FloatArray
    gyr_bias_radps: FloatArray
    acc_bias_mps2: FloatArray
    covariance: FloatArray
    rest: BoolArray
    smoothed: bool

    def at(self, t_ns: IntArray) -> FloatArray:
        """Positions (M, 3) in m at M instants, linear between samples.

        Raises:
            ValueError: an instant outside the recording.
        """
        t = np.asarray(t_ns, dtype=np.int64)
        if len(t) and (t.min() < self.t_ns[0] or t.max() > self.t_ns[-1]):
            raise ValueError(f"instants {t.min()} … {t.max()} ns lie outside {self.t_ns[0]} … {self.t_ns[-1]} ns")
        since = (self.t_ns - self.t_ns[0]).astype(np.float64)
        asked = (t - self.t_ns[0]).astype(np.float64)
        return np.column_stack([np.interp(asked, since, self.position_m[:, j]) for j in range(3)])

    def stride_lengths(self, begin_ns: IntArray, end_ns: IntArray) -> FloatArray:
        """Horizontal distances (M,) in m between the instants ``begin_ns`` and ``end_ns``, (M,) each."""
        return np.asarray(np.hypot(*(self.at(end_ns) - self.at(begin_ns))[:, :2].T))

    def plan_m(self) -> FloatArray:
        """The path from above (N, 2) in m, turned so that the farthest point lies on the positive x axis."""
        flat = self.position_m[:, :2] - self.position_m[0, :2]
        far = flat[np.argmax(np.hypot(*flat.T))]
        distance = float(np.hypot(*far))
        if distance == 0.0:
            return flat
        c, s = far / distance
        return np.asarray(flat @ np.array([[c, -s], [s, c]]))


def zupt_path(
    t_ns: IntArray,
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    *,
    calibration: ZeroVelocityThresholds | None = None,
    rest: BoolArray | None = None,
    lever_m: Vector3 | None = None,
    level_ground: bool = False,
    smoothed: bool = True,
    acc_range_mps2: float | None = None,
    gyr_range_radps: float | None = None,
    settings: ZuptSettings | None = None,
) -> ZuptPath:
    """Navigate through a recording.

    Args:
        t_ns: (N,) strictly increasing time stamps.
        acc_mps2: (N, 3) specific force.
        gyr_radps: (N, 3) angular rate.
        calibration: of the rest detector; found from the recording itself if not given. Its gyroscope bias is where
            the filter starts.
        rest: (N,) where the foot rests, instead of the detector's word. With it, ``calibration``, ``lever_m`` and
            both ranges given, the forward pass knows nothing of the future.
        lever_m: from the point of the ground about which the resting foot turns to the sensor, in the sensor frame;
            None: ``LEVER_M`` straight up, (0, 0, 0): a foot at rest does not move.
        level_ground: the foot rests at one height. Not on stairs or slopes.
        smoothed: use the future too.
        acc_range_mps2: the accelerometer's full scale; found from flat tops if not given.
        gyr_range_radps: the same of the gyroscope.
        settings: noise.

    Raises:
        ValueError: shapes or stamps that do not fit, values that are not finite, or too short for a calibration.
    """
    t = np.ascontiguousarray(t_ns, dtype=np.int64)
    acc, gyr = np.ascontiguousarray(acc_mps2, dtype=np.float64), np.ascontiguousarray(gyr_radps, dtype=np.float64)
    if t.ndim != 1 or len(t) < 3 or acc.shape != (len(t), 3) or gyr.shape != acc.shape:
        raise ValueError(f"need (N,), (N, 3), (N, 3) with N of 3 or more, got {t.shape}, {acc.shape}, {gyr.shape}")
    if not np.all(np.diff(t) > 0):
        raise ValueError("time stamps must increase strictly: drop doubled samples and sort the rest")
    if not (np.isfinite(acc).all() and np.isfinite(gyr).all()):
        raise ValueError("specific force and rate must be finite: fill or cut out what is missing")
    rate_hz = 1e9 / float(np.median(np.diff(t)))
    if calibration is None or rest is None:
        found, detected, energy = find_zero_velocity(acc, gyr, rate_hz)
        calibration = calibration or found
        rest = with_missed_stances(detected, gyr, rate_hz, energy) if rest is None else rest
    rest = np.ascontiguousarray(rest, dtype=np.bool_)
    if rest.shape != t.shape:
        raise ValueError(f"rest has the shape {rest.shape} instead of {t.shape}")
    if lever_m is None:
        up = acc[rest].mean(axis=0) if rest.any() else acc.mean(axis=0)
        lever = LEVER_M * up / max(float(np.linalg.norm(up)), 1e-9)
    else:
        lever = np.array(lever_m, dtype=np.float64)
    tape = new_tape(len(t), covariance=not smoothed)
    acc_sd = clipped_sd(acc, acc_range_mps2, LEAST_RANGE[0], CLIPPED_SD[0])
    gyr_sd = clipped_sd(gyr, gyr_range_radps, LEAST_RANGE[1], CLIPPED_SD[1])
    first = first_stance(rest, rate_hz)
    part = slice(first, None)
    before = acc[max(first - round(START_S * rate_hz), 0) : first + 1].mean(axis=0)
    ours = Tape(*(rows[part] if len(rows) else rows for rows in tape))
    ours.gyr_bias[0] = calibration.gyr_bias_radps
    noise = settings or ZuptSettings()
    forward(
        t[part], acc[part], gyr[part], acc_sd[part], gyr_sd[part], rest[part], before, lever, level_ground, noise, ours
    )
    if smoothed:
        smooth(t[part], bool(rest[first]), noise, ours)
    for rows in tape[:6]:
        if len(rows):
            rows[:first] = rows[first]
    return ZuptPath(t, *tape[:6], rest=rest, smoothed=smoothed)


def new_tape(samples: int, *, covariance: bool = True) -> Tape:
    """An empty tape for N samples: 0.8 kB each, 2.6 kB with their covariance."""
    n = samples
    three = (n, 3)
    squares = (n if covariance else 0, STATES, STATES)
    shapes = (three, three, (n, 4), three, three, squares, three, (n, 3, 3), three, (n, 4), (n, 4), (n, 4, STATES))
    return Tape(*(np.zeros(shape) for shape in shapes))


@jit
def _matrix(q: Vec, r: Mat) -> None:
    for k in range(3):
        r[0, k], r[1, k], r[2, k] = to_world(
            q[0], q[1], q[2], q[3], 1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0
        )


def carrier(
    along: int, across: int, out_along: int, out_across: int, count: int
) -> Callable[[Any, Any, Any, Any, float], None]:
    """Compile ``Φ x`` for ``count`` vectors ``x`` in flat storage; only p, v, psi go into ``out``, the biases stay.

    A vector's elements lie ``along`` apart and vectors ``across`` apart. The compiler knows these strides, so vectors
    that lie side by side go through its wide registers together.
    """

    @jit
    def propagate(x: Vec, out: Mat, r: Mat, f: Vec, dt: float) -> None:
        f0, f1, f2 = f[0], f[1], f[2]
        r00, r01, r02 = r[0, 0], r[0, 1], r[0, 2]
        r10, r11, r12 = r[1, 0], r[1, 1], r[1, 2]
        r20, r21, r22 = r[2, 0], r[2, 1], r[2, 2]
        for c in range(count):
            k, o = c * across, c * out_across
            p0, p1, p2 = x[k], x[k + along], x[k + 2 * along]
            v0, v1, v2 = x[k + 3 * along], x[k + 4 * along], x[k + 5 * along]
            s0, s1, s2 = x[k + 6 * along], x[k + 7 * along], x[k + 8 * along]
            g0, g1, g2 = x[k + 9 * along], x[k + 10 * along], x[k + 11 * along]
            b0, b1, b2 = x[k + 12 * along], x[k + 13 * along], x[k + 14 * along]
            d0 = dt * (s1 * f2 - s2 * f1 - (r00 * b0 + r01 * b1 + r02 * b2))
            d1 = dt * (s2 * f0 - s0 * f2 - (r10 * b0 + r11 * b1 + r12 * b2))
            d2 = dt * (s0 * f1 - s1 * f0 - (r20 * b0 + r21 * b1 + r22 * b2))
            out[o] = p0 + dt * (v0 + 0.5 * d0)
            out[o + out_along] = p1 + dt * (v1 + 0.5 * d1)
            out[o + 2 * out_along] = p2 + dt * (v2 + 0.5 * d2)
            out[o + 3 * out_along] = v0 + d0
            out[o + 4 * out_along] = v1 + d1
            out[o + 5 * out_along] = v2 + d2
            out[o + 6 * out_along] = s0 - dt * (r00 * g0 + r01 * g1 + r02 * g2)
            out[o + 7 * out_along] = s1 - dt * (r10 * g0 + r11 * g1 + r12 * g2)
            out[o + 8 * out_along] = s2 - dt * (r20 * g0 + r21 * g1 + r22 * g2)

    return propagate


propagate_one = carrier(1, STATES, 1, STATES, 1)
_propagate_columns = carrier(WIDTH, 1, WIDTH, 1, WIDTH)
_propagate_rows = carrier(1, WIDTH, WIDTH, 1, BIASES)  # what goes in as a row comes out as a column


@jit_fused
def predict(P: Vec, half: Vec, r: Mat, f: Vec, dt: float) -> None:
    """``P ← Φ P Φᵀ`` for a symmetric ``P``, 15 rows of 16 in flat storage (the last column fills the registers).

    ``half`` (9, 16), flat, receives ``Φ P``, whose columns of the biases are final.
    """
    _propagate_columns(P, half, r, f, dt)
    _propagate_rows(half, P, r, f, dt)
    for a in range(BIASES):
        for b in range(a + 1, BIASES):  # rounding makes the halves differ, and nothing would ever bring them together
            P[b * WIDTH + a] = P[a * WIDTH + b]
        for b in range(BIASES, STATES):
            P[a * WIDTH + b] = P[b * WIDTH + a] = half[a * WIDTH + b]


@jit_fused
def forward(
    t_ns: Vec,
    acc: Mat,
    gyr: Mat,
    acc_sd: Vec,
    gyr_sd: Vec,
    rest: Vec,
    start_force: Vec,
    lever: Vec,
    level: bool,
    settings: ZuptSettings,
    tape: Tape,
) -> None:
    """Filter N samples; every row of the tape then holds the state after the sample's own measurement.

    ``acc_sd``, ``gyr_sd`` (N,): extra standard deviation of a sample (clipped), m/s² and rad/s. ``gyr_bias``
    row 0 holds the start value. ``start_force`` (3,) is the specific force that says where up is at the first sample.
    """
    n = t_ns.shape[0]
    P, carried = np.zeros(STATES * WIDTH), np.empty(BIASES * WIDTH)
    x, row, gain = np.zeros(STATES), np.empty(WIDTH), np.empty(WIDTH)
    q, mid = np.empty(4), np.empty(4)
    keep = tape.covariance.shape[0] == n
    start_variances(rest[0], settings, x)
    for j in range(STATES):
        P[j * DIAGONAL] = x[j]
    q[0], q[1], q[2], q[3] = from_gravity(start_force[0], start_force[1], start_force[2])
    bg, ba, v, s = np.empty(3), np.zeros(3), np.zeros(3), np.zeros(3)
    for j in range(3):
        bg[j] = tape.gyr_bias[0, j]
    anchor, drift = np.zeros(2), np.zeros(2)  # where the last rest ended; how the foot creeps in this one
    rest_began_ns, measured_ns = t_ns[0], t_ns[0]
    ex = ey = ez = spread = 0.0
    typical_s = 1e-9 * (t_ns[n - 1] - t_ns[0]) / (n - 1)
    for i in range(n):
        dt = typical_s
        if i > 0:
            dt = 1e-9 * (t_ns[i] - t_ns[i - 1])
            wx = 0.5 * (gyr[i - 1, 0] + gyr[i, 0]) - bg[0]
            wy = 0.5 * (gyr[i - 1, 1] + gyr[i, 1]) - bg[1]
            wz = 0.5 * (gyr[i - 1, 2] + gyr[i, 2]) - bg[2]
            ax, ay, az = to_world(
                q[0], q[1], q[2], q[3], acc[i - 1, 0] - ba[0], acc[i - 1, 1] - ba[1], acc[i - 1, 2] - ba[2]
            )
            half = 0.5 * dt
            mid[0], mid[1], mid[2], mid[3] = quaternion_step(q[0], q[1], q[2], q[3], wx * half, wy * half, wz * half)
            q[0], q[1], q[2], q[3] = quaternion_step(q[0], q[1], q[2], q[3], wx * dt, wy * dt, wz * dt)
            cx, cy, cz = to_world(q[0], q[1], q[2], q[3], acc[i, 0] - ba[0], acc[i, 1] - ba[1], acc[i, 2] - ba[2])
            f = tape.force[i]
            f[0], f[1], f[2] = 0.5 * (ax + cx), 0.5 * (ay + cy), 0.5 * (az + cz)
            for j in range(3):
                dv = dt * (f[j] - (G_MPS2 if j == 2 else 0.0))
                s[j] += dt * (v[j] + 0.5 * dv)
                v[j] += dv
            if rest[i] and 1e-9 * (t_ns[i] - rest_began_ns) > settings.drift_s and measured_ns > rest_began_ns:
                # whoever stands seems to accelerate by noise alone, which tells no heading
                f[0] = f[1] = 0.0
            _matrix(mid, tape.rotation[i])
            predict(P, carried, tape.rotation[i], f, dt)
            rate = math.sqrt(wx * wx + wy * wy + wz * wz)
            tape.added[i, 0], tape.added[i, 1] = add_noise(P, acc, i, f, rate, acc_sd, gyr_sd, dt, settings)
        believed = False
        if rest[i]:
            if i > 0 and not rest[i - 1]:
                rest_began_ns = t_ns[i]
                drift_velocity(s, anchor, settings.drift_speed_mps, drift)
            going = 1.0 if 1e-9 * (t_ns[i] - rest_began_ns) < settings.drift_s else 0.0
            ux, uy, uz = gyr[i, 0] - bg[0], gyr[i, 1] - bg[1], gyr[i, 2] - bg[2]
            rate2 = ux * ux + uy * uy + uz * uz
            ex, ey, ez = to_world(
                q[0], q[1], q[2], q[3],
                uy * lever[2] - uz * lever[1], uz * lever[0] - ux * lever[2], ux * lever[1] - uy * lever[0],
            )  # fmt: skip
            ex += going * drift[0]
            ey += going * drift[1]
            spread = settings.rest_speed_mps**2 + settings.rest_speed_per_rate_m**2 * rate2
            off2 = (ex - v[0]) ** 2 + (ey - v[1]) ** 2 + (ez - v[2]) ** 2
            sure = settings.outlier_sigmas**2 * (P[3 * DIAGONAL] + P[4 * DIAGONAL] + P[5 * DIAGONAL] + 3.0 * spread)
            lasted_s, lost_s = 1e-9 * (t_ns[i] - rest_began_ns), 1e-9 * (t_ns[i] - measured_ns)
            believed = off2 < sure or lasted_s > settings.outlier_rest_s or lost_s > settings.outlier_lost_s
            if believed and off2 >= sure:  # the filter was wrong, and more than it knew
                tape.added[i, 2] = off2
                for j in range(3):
                    P[(3 + j) * DIAGONAL] += off2
                    P[(6 + j) * DIAGONAL] += settings.lost_tilt_rad**2
        if believed:
            measured_ns = t_ns[i]
            # neighbouring samples err alike: their information per second is fixed, whatever the rate
            alike = max(settings.rest_correlation_s / dt, 1.0)
            spread *= alike
            for j in range(STATES):
                x[j] = 0.0
            for j in range(4 if level else 3):
                if j == 3:
                    state, error, var = 2, -s[2] - x[2], alike * settings.rest_height_m * settings.rest_height_m
                else:
                    state, var = 3 + j, spread
                    error = (ex if j == 0 else ey if j == 1 else ez) - v[j] - x[3 + j]
                tape.residual[i, j] = error
                tape.residual_var[i, j] = update(P, x, state, error, var, row, gain)
                for a in range(STATES):
                    tape.gain[i, j, a] = gain[a]
            for j in range(3):
                s[j] += x[j]
                v[j] += x[3 + j]
                bg[j] += x[9 + j]
                ba[j] += x[12 + j]
            rotate_in_world(q, x[6], x[7], x[8], q)
            anchor[0], anchor[1] = s[0], s[1]
        for j in range(3):
            tape.position[i, j], tape.velocity[i, j], tape.gyr_bias[i, j], tape.acc_bias[i, j] = (
                s[j],
                v[j],
                bg[j],
                ba[j],
            )
        for j in range(4):
            tape.quaternions[i, j] = q[j]
        if keep:
            tape.covariance[i] = P.reshape(STATES, WIDTH)[:, :STATES]


@jit_fused
def add_noise(
    P: Vec, acc: Mat, i: int, f: Vec, rate: float, acc_sd: Vec, gyr_sd: Vec, dt: float, settings: ZuptSettings
) -> tuple[float, float]:
    """Add what one interval's noise does; gives back the variances of velocity and of rotation in it."""
    jump = 0.0
    for j in range(3):
        jump += (acc[i, j] - acc[i - 1, j]) ** 2
    beyond = max(math.sqrt(jump) - settings.jerk_mps3 * dt, 0.0)
    az = f[2] - G_MPS2
    dynamic = f[0] * f[0] + f[1] * f[1] + az * az
    # a step somewhere within the interval: the trapezoid errs by up to half of it, evenly distributed
    missing = 0.25 * (acc_sd[i - 1] + acc_sd[i]) ** 2 + beyond * beyond / 12.0
    lost = 0.25 * (gyr_sd[i - 1] + gyr_sd[i]) ** 2
    v_var = (settings.acc_noise_mps2_rthz**2 + settings.acc_scale_noise**2 * dynamic) * dt + missing * dt * dt
    psi_var = (settings.rate_noise_radps_rthz**2 + settings.rate_scale_noise**2 * rate * rate) * dt + lost * dt * dt
    for j in range(3):
        P[j * DIAGONAL] += 0.25 * dt * dt * v_var
        P[j * WIDTH + 3 + j] += 0.5 * dt * v_var
        P[(3 + j) * WIDTH + j] += 0.5 * dt * v_var
        P[(3 + j) * DIAGONAL] += v_var
        P[(6 + j) * DIAGONAL] += psi_var
        P[(9 + j) * DIAGONAL] += settings.rate_walk_radps_rts**2 * dt
        P[(12 + j) * DIAGONAL] += settings.acc_walk_mps2_rts**2 * dt
    return v_var, psi_var


@jit
def _propagate_back(L: Vec, r: Mat, f: Vec, dt: float) -> None:
    """``L ← Φᵀ L`` for the adjoint (15,)."""
    u0 = dt * (L[3] + 0.5 * dt * L[0])
    u1 = dt * (L[4] + 0.5 * dt * L[1])
    u2 = dt * (L[5] + 0.5 * dt * L[2])
    for j in range(3):
        L[9 + j] -= dt * (r[0, j] * L[6] + r[1, j] * L[7] + r[2, j] * L[8])
        L[12 + j] -= r[0, j] * u0 + r[1, j] * u1 + r[2, j] * u2
    L[6] += f[1] * u2 - f[2] * u1
    L[7] += f[2] * u0 - f[0] * u2
    L[8] += f[0] * u1 - f[1] * u0
    for j in range(3):
        L[3 + j] += dt * L[j]


@jit
def _state(k: int) -> int:
    """The state that a sample's measurement ``k`` is of."""
    return 2 if k == 3 else 3 + k


@jit
def _adjoints(t_ns: Vec, tape: Tape, out: Mat) -> None:
    """The adjoint (N, 15) before each sample's measurements: what all that follows says of the error there."""
    lam = np.zeros(STATES)
    for i in range(t_ns.shape[0] - 1, -1, -1):
        for k in range(MEASURED - 1, -1, -1):  # last first
            variance = tape.residual_var[i, k]
            if variance > 0.0:
                along = tape.residual[i, k] / variance
                for a in range(STATES):
                    along += tape.gain[i, k, a] * lam[a]
                lam[_state(k)] -= along
        for a in range(STATES):
            out[i, a] = lam[a]
        if i > 0:
            _propagate_back(lam, tape.rotation[i], tape.force[i], 1e-9 * (t_ns[i] - t_ns[i - 1]))


@jit
def smooth(t_ns: Vec, at_rest: bool, settings: ZuptSettings, tape: Tape) -> None:
    """Fixed-interval smoothing, in place, of the states that ``forward`` left; ``at_rest`` at the first sample."""
    n = t_ns.shape[0]
    adjoint = np.empty((n, STATES))
    _adjoints(t_ns, tape, adjoint)
    dx, start = np.zeros(STATES), np.empty(STATES)
    start_variances(at_rest, settings, start)
    for a in range(STATES):
        dx[a] = -start[a] * adjoint[0, a]
    for i in range(n):
        lam = adjoint[i]
        if i > 0:
            dt = 1e-9 * (t_ns[i] - t_ns[i - 1])
            propagate_one(dx, dx, tape.rotation[i], tape.force[i], dt)
            for j in range(3):
                push = tape.added[i, 0] * (lam[3 + j] + 0.5 * dt * lam[j])
                dx[j] -= 0.5 * dt * push
                dx[3 + j] -= push
                dx[6 + j] -= tape.added[i, 1] * lam[6 + j]
                dx[9 + j] -= settings.rate_walk_radps_rts**2 * dt * lam[9 + j]
                dx[12 + j] -= settings.acc_walk_mps2_rts**2 * dt * lam[12 + j]
        if tape.added[i, 2] > 0.0:
            for j in range(3):
                dx[3 + j] -= tape.added[i, 2] * lam[3 + j]
                dx[6 + j] -= settings.lost_tilt_rad**2 * lam[6 + j]
        for k in range(MEASURED):
            if tape.residual_var[i, k] > 0.0:  # the filter has taken this correction already
                for a in range(STATES):
                    dx[a] -= tape.gain[i, k, a] * tape.residual[i, k]
        for j in range(3):
            tape.position[i, j] += dx[j]
            tape.velocity[i, j] += dx[3 + j]
            tape.gyr_bias[i, j] += dx[9 + j]
            tape.acc_bias[i, j] += dx[12 + j]
        rotate_in_world(tape.quaternions[i], dx[6], dx[7], dx[8], tape.quaternions[i])
