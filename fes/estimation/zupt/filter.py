"""ZUPT-aided navigation: the path of a foot through a whole recording, forward and smoothed.

Source: Kumar et al., "Applying update using Kalman filter", after Fischer, Talkad Sukumar and Hazas (2013), "Tutorial:
implementing a pedestrian tracker using inertial sensors": strapdown integration, and an error-state filter for which a
resting foot's velocity is a measurement. Departures and additions:

- fifteen states instead of nine: the biases of gyroscope and accelerometer are estimated too;
- the resting foot turns about where it touches the ground: its velocity is ``w × r``, not zero. The arm ``r`` from
  there to the sensor is given, or taken as 6.5 cm straight up. It also creeps on the way it came, by 0.5 cm/s for the
  first second (optical recordings show the instep moving all through mid-stance);
- rest is not all or nothing: the measurement's noise grows with the rate, and neighbouring samples count together as
  one over the time for which they err alike, so that neither a looser threshold nor a higher sampling rate makes the
  filter sure of what it cannot know;
- trapezoids instead of rectangles; samples that clip, or jump faster than an accelerometer follows, count as noise;
- a rest at which the foot is sure to travel (beyond 4 standard deviations) is none: in a dragged or slow, even swing an
  inertial sensor reads like one at rest. Should it last, or nothing be measured for long, the filter is lost
  instead; its uncertainty grows by what it was wrong, and it takes the measurement;
- smoothing by an adjoint (Bierman 1973, "Fixed interval smoothing with discrete measurements") and the disturbances it
  shows (Koopman 1993): the estimates of Rauch, Tung and Striebel without inverting a covariance, which here is nearly
  singular (nothing measures heading, and position but weakly), and without keeping one for every sample.

Compiled core of the ZUPT-aided navigation filter: forward pass and smoothing, in scalar loops.

The error state is that of :mod:`fes.estimation.zupt.covariance`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.numerics.jit import inlined, jit, jit_fused
from fes.estimation.numerics.rotation import from_gravity, quaternion_step, to_sensor, to_world
from fes.estimation.zupt.covariance import BIASES, DIAGONAL, STATES, WIDTH, predict, update
from fes.signals import G_MPS2, FloatArray

MEASURED = 4  # velocity (3), height
LEAST_DISTANCE_M = 0.15  # of a stride that has a direction


class ZuptSettings(NamedTuple):
    """Noise of the filter; densities and correlation times, so that one setting holds at any sampling rate."""

    acc_noise_mps2_rthz: float = 0.02
    acc_scale_noise: float = 0.003  # share of the acceleration that is noise, per √Hz: scale errors, bandwidth
    rate_noise_radps_rthz: float = 0.002
    rate_scale_noise: float = 0.003  # the same of the rate
    acc_walk_mps2_rts: float = 2e-4
    rate_walk_radps_rts: float = 2e-5
    acc_bias_mps2: float = 0.15  # standard deviation at the start
    rate_bias_radps: float = 0.01
    tilt_rad: float = 0.05  # at the start, at rest …
    tilt_moving_rad: float = 0.4  # … and in movement
    start_speed_mps: float = 0.05  # at the start, at rest
    rest_speed_mps: float = 0.01  # how far the velocity of a resting foot is from the model's
    rest_speed_per_rate_m: float = 0.05  # … and how that grows with its rate
    rest_correlation_s: float = 0.1  # over which time that error stays the same
    rest_height_m: float = 0.01
    outlier_sigmas: float = 4.0  # a slow, even swing looks like rest: not if the foot is that sure to travel, …
    outlier_rest_s: float = 0.5  # … unless the rest lasts, …
    outlier_lost_s: float = 2.5  # … or nothing was measured for so long that it may be lost
    drift_speed_mps: float = 0.005  # the resting foot still creeps on the way it came, …
    drift_s: float = 1.0  # … for as long as a stance lasts
    lost_tilt_rad: float = 0.1  # how far the orientation may be off then
    jump_mps3: float = 4000.0  # a force that changes faster was not followed by the accelerometer


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


def new_tape(samples: int, *, covariance: bool = True) -> Tape:
    """An empty tape for N samples: 0.8 kB each, 2.6 kB with their covariance."""
    n = samples
    three = (n, 3)
    squares = (n if covariance else 0, STATES, STATES)
    shapes = (three, three, (n, 4), three, three, squares, three, (n, 3, 3), three, (n, 4), (n, 4), (n, 4, STATES))
    return Tape(*(np.zeros(shape) for shape in shapes))


@jit
def _matrix(q: Any, r: Any) -> None:
    for k in range(3):
        r[0, k], r[1, k], r[2, k] = to_world(
            q[0], q[1], q[2], q[3], 1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0
        )


@inlined
def turned(q: Any, x: float, y: float, z: float, out: Any) -> None:
    """``out = exp(psi) q`` for a world rotation vector."""
    rx, ry, rz = to_sensor(q[0], q[1], q[2], q[3], x, y, z)
    out[0], out[1], out[2], out[3] = quaternion_step(q[0], q[1], q[2], q[3], rx, ry, rz)


@jit_fused
def start_variances(at_rest: bool, p: ZuptSettings, out: Any) -> None:
    """Variances (15,) of the state's errors before the first sample; heading is the frame's own choice."""
    tilt = p.tilt_rad if at_rest else p.tilt_moving_rad
    for j in range(3):
        out[j] = 0.0
        out[3 + j] = p.start_speed_mps**2 if at_rest else 1.0
        out[6 + j] = tilt * tilt if j < 2 else 1e-10
        out[9 + j] = p.rate_bias_radps * p.rate_bias_radps
        out[12 + j] = p.acc_bias_mps2 * p.acc_bias_mps2


@jit_fused
def drift_velocity(s: Any, anchor: Any, speed: float, creep: Any) -> None:
    """Velocity of a foot that has just come to rest at ``s``, along the way from the last rest; none after no way."""
    x, y = s[0] - anchor[0], s[1] - anchor[1]
    way = math.sqrt(x * x + y * y)
    share = speed / way if way > LEAST_DISTANCE_M else 0.0
    creep[0], creep[1] = share * x, share * y


@jit_fused
def forward(
    t_ns: Any,
    acc: Any,
    gyr: Any,
    acc_sd: Any,
    gyr_sd: Any,
    rest: Any,
    start_force: Any,
    lever: Any,
    level: bool,
    p: ZuptSettings,
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
    start_variances(rest[0], p, x)
    for j in range(STATES):
        P[j * DIAGONAL] = x[j]
    q[0], q[1], q[2], q[3] = from_gravity(start_force[0], start_force[1], start_force[2])
    bg, ba, v, s = np.empty(3), np.zeros(3), np.zeros(3), np.zeros(3)
    for j in range(3):
        bg[j] = tape.gyr_bias[0, j]
    anchor, creep = np.zeros(2), np.zeros(2)  # where the last rest ended; how the foot creeps in this one
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
            if rest[i] and 1e-9 * (t_ns[i] - rest_began_ns) > p.drift_s and measured_ns > rest_began_ns:
                # whoever stands seems to accelerate by noise alone, which tells no heading
                f[0] = f[1] = 0.0
            _matrix(mid, tape.rotation[i])
            predict(P, carried, tape.rotation[i], f, dt)
            rate = math.sqrt(wx * wx + wy * wy + wz * wz)
            tape.added[i, 0], tape.added[i, 1] = add_noise(P, acc, i, f, rate, acc_sd, gyr_sd, dt, p)
        believed = False
        if rest[i]:
            if i > 0 and not rest[i - 1]:
                rest_began_ns = t_ns[i]
                drift_velocity(s, anchor, p.drift_speed_mps, creep)
            going = 1.0 if 1e-9 * (t_ns[i] - rest_began_ns) < p.drift_s else 0.0
            ux, uy, uz = gyr[i, 0] - bg[0], gyr[i, 1] - bg[1], gyr[i, 2] - bg[2]
            rate2 = ux * ux + uy * uy + uz * uz
            ex, ey, ez = to_world(
                q[0], q[1], q[2], q[3],
                uy * lever[2] - uz * lever[1], uz * lever[0] - ux * lever[2], ux * lever[1] - uy * lever[0],
            )  # fmt: skip
            ex += going * creep[0]
            ey += going * creep[1]
            spread = p.rest_speed_mps**2 + p.rest_speed_per_rate_m**2 * rate2
            off2 = (ex - v[0]) ** 2 + (ey - v[1]) ** 2 + (ez - v[2]) ** 2
            sure = p.outlier_sigmas**2 * (P[3 * DIAGONAL] + P[4 * DIAGONAL] + P[5 * DIAGONAL] + 3.0 * spread)
            lasted_s, lost_s = 1e-9 * (t_ns[i] - rest_began_ns), 1e-9 * (t_ns[i] - measured_ns)
            believed = off2 < sure or lasted_s > p.outlier_rest_s or lost_s > p.outlier_lost_s
            if believed and off2 >= sure:  # the filter was wrong, and more than it knew
                tape.added[i, 2] = off2
                for j in range(3):
                    P[(3 + j) * DIAGONAL] += off2
                    P[(6 + j) * DIAGONAL] += p.lost_tilt_rad**2
        if believed:
            measured_ns = t_ns[i]
            # neighbouring samples err alike: their information per second is fixed, whatever the rate
            alike = max(p.rest_correlation_s / dt, 1.0)
            spread *= alike
            for j in range(STATES):
                x[j] = 0.0
            for j in range(4 if level else 3):
                if j == 3:
                    state, error, var = 2, -s[2] - x[2], alike * p.rest_height_m * p.rest_height_m
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
            turned(q, x[6], x[7], x[8], q)
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
    P: Any, acc: Any, i: int, f: Any, rate: float, acc_sd: Any, gyr_sd: Any, dt: float, p: ZuptSettings
) -> tuple[float, float]:
    """Add what one interval's noise does; gives back the variances of velocity and of rotation in it."""
    jump = 0.0
    for j in range(3):
        jump += (acc[i, j] - acc[i - 1, j]) ** 2
    beyond = max(math.sqrt(jump) - p.jump_mps3 * dt, 0.0)
    az = f[2] - G_MPS2
    dynamic = f[0] * f[0] + f[1] * f[1] + az * az
    # a step somewhere within the interval: the trapezoid errs by up to half of it, evenly distributed
    missing = 0.25 * (acc_sd[i - 1] + acc_sd[i]) ** 2 + beyond * beyond / 12.0
    lost = 0.25 * (gyr_sd[i - 1] + gyr_sd[i]) ** 2
    v_var = (p.acc_noise_mps2_rthz**2 + p.acc_scale_noise**2 * dynamic) * dt + missing * dt * dt
    psi_var = (p.rate_noise_radps_rthz**2 + p.rate_scale_noise**2 * rate * rate) * dt + lost * dt * dt
    for j in range(3):
        P[j * DIAGONAL] += 0.25 * dt * dt * v_var
        P[j * WIDTH + 3 + j] += 0.5 * dt * v_var
        P[(3 + j) * WIDTH + j] += 0.5 * dt * v_var
        P[(3 + j) * DIAGONAL] += v_var
        P[(6 + j) * DIAGONAL] += psi_var
        P[(9 + j) * DIAGONAL] += p.rate_walk_radps_rts**2 * dt
        P[(12 + j) * DIAGONAL] += p.acc_walk_mps2_rts**2 * dt
    return v_var, psi_var
