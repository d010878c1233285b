"""Fixed-interval smoothing of what the ZUPT-aided filter leaves behind.

Source: Bierman (1973), "Fixed interval smoothing with discrete measurements": an adjoint vector runs backwards through
intervals and measurements (the modified Bryson-Frazier form); then Koopman (1993), "Disturbance smoother for state
space models": the start's error and each interval's noise are their own variance times the adjoint, and carrying them
forward gives each interval's correction. The estimates are those of Rauch, Tung and Striebel; nothing is inverted,
which matters where a covariance is nearly singular (nothing measures heading, and position but weakly), and none has to
be kept.
"""

import numpy as np

from fes.estimation.numerics.jit import inlined, jit_fused
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import quaternion_step, to_sensor
from fes.estimation.zupt.covariance import ADDED, STATES, propagate_error, spread_noise
from fes.estimation.zupt.decimation import ZuptSettings, start_variances
from fes.estimation.zupt.filter import MEASURED, IntervalTape


@jit_fused
def smooth_intervals(t_ns: Vec, ends: Vec, standing: bool, settings: ZuptSettings, tape: IntervalTape) -> None:
    """Smoothing, in place, of position, velocity and orientation that ``filter_intervals`` left."""
    count = ends.shape[0]
    adjoint = np.empty((count, STATES))
    _adjoints(t_ns, ends, tape, adjoint)
    dx, start = np.zeros(STATES), np.empty(STATES)
    start_variances(standing, settings, start)
    for a in range(STATES):
        dx[a] = -start[a] * adjoint[0, a]
    for k in range(count):
        if k > 0:
            dt = 1e-9 * (t_ns[ends[k]] - t_ns[ends[k - 1]])
            propagate_error(dx, k, tape.mean, tape.push, dt)
            spread_noise(k, dx, tape.added, adjoint, dt, settings)
        lost = tape.added[k, ADDED - 1]
        if lost > 0.0:
            for j in range(3):
                dx[3 + j] -= lost * adjoint[k, 3 + j]
                dx[6 + j] -= settings.lost_tilt_rad**2 * adjoint[k, 6 + j]
        m = tape.slot[k]
        if m >= 0:  # the filter has taken this correction already
            for j in range(MEASURED):
                if tape.residual_var[m, j] > 0.0:
                    for a in range(STATES):
                        dx[a] -= tape.gain[m, j, a] * tape.residual[m, j]
        for j in range(3):
            tape.position[k, j] += dx[j]
            tape.velocity[k, j] += dx[3 + j]
        q0, q1, q2, q3 = tape.quaternions[k, 0], tape.quaternions[k, 1], tape.quaternions[k, 2], tape.quaternions[k, 3]
        x, y, z = to_sensor(q0, q1, q2, q3, dx[6], dx[7], dx[8])
        q0, q1, q2, q3 = quaternion_step(q0, q1, q2, q3, x, y, z)
        tape.quaternions[k, 0], tape.quaternions[k, 1] = q0, q1
        tape.quaternions[k, 2], tape.quaternions[k, 3] = q2, q3


@inlined
def _adjoints(t_ns: Vec, ends: Vec, tape: IntervalTape, out: Mat) -> None:
    """The adjoint (K, 15) before each interval's measurement: what all that follows says of the error there."""
    x = np.zeros(STATES)
    for k in range(ends.shape[0] - 1, -1, -1):
        m = tape.slot[k]
        if m >= 0:
            for j in range(MEASURED - 1, -1, -1):  # last first
                variance = tape.residual_var[m, j]
                if variance > 0.0:
                    one = two = three = 0.0  # a third of the sum each, so that they do not wait for one another
                    for a in range(0, STATES, 3):
                        one += tape.gain[m, j, a] * x[a]
                        two += tape.gain[m, j, a + 1] * x[a + 1]
                        three += tape.gain[m, j, a + 2] * x[a + 2]
                    x[2 if j == 3 else 3 + j] -= tape.residual[m, j] / variance + (one + two + three)
        for a in range(STATES):
            out[k, a] = x[a]
        if k > 0:
            _propagate_back(k, x, tape.mean, tape.push, 1e-9 * (t_ns[ends[k]] - t_ns[ends[k - 1]]))


@inlined
def _propagate_back(k: int, x: Vec, r: Mat, f: Mat, dt: float) -> None:
    """``λ ← Φᵀ λ`` for the adjoint (15,) over interval ``k``."""
    p0, p1, p2, v0, v1, v2 = x[0], x[1], x[2], x[3], x[4], x[5]
    e0, e1, e2 = v0 + 0.5 * dt * p0, v1 + 0.5 * dt * p1, v2 + 0.5 * dt * p2
    h0 = x[6] + v2 * f[k, 2, 1] - v1 * f[k, 2, 2]
    h1 = x[7] + v0 * f[k, 2, 2] - v2 * f[k, 2, 0]
    h2 = x[8] + v1 * f[k, 2, 0] - v0 * f[k, 2, 1]
    for j in range(3):
        x[9 + j] -= r[k, 0, j] * h0 + r[k, 1, j] * h1 + r[k, 2, j] * h2
        x[12 + j] -= r[k, 0, j] * e0 + r[k, 1, j] * e1 + r[k, 2, j] * e2
    x[6] += f[k, 1, 1] * p2 - f[k, 1, 2] * p1 + f[k, 0, 1] * v2 - f[k, 0, 2] * v1
    x[7] += f[k, 1, 2] * p0 - f[k, 1, 0] * p2 + f[k, 0, 2] * v0 - f[k, 0, 0] * v2
    x[8] += f[k, 1, 0] * p1 - f[k, 1, 1] * p0 + f[k, 0, 0] * v1 - f[k, 0, 1] * v0
    x[3], x[4], x[5] = v0 + dt * p0, v1 + dt * p1, v2 + dt * p2
