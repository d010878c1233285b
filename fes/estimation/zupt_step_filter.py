"""Compiled core of the off-line ZUPT filter: forwards over the steps of ``fes.estimation.zupt_steps``.

What is measured, when it is believed and with which noise is as in ``fes.estimation.zupt_kernel``, which goes from
sample to sample; only that the covariance goes from step to step here, a few hundredths of a second at a time, and that
the velocity of a resting foot is measured once a step, for the time from the middle of one to that of the next.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fes.estimation.compiled import jit_fused
from fes.estimation.rotation import from_gravity, to_world
from fes.estimation.zupt_covariance import DIAGONAL, STATES, WIDTH, update, update_velocity
from fes.estimation.zupt_kernel import MEASURED, ZuptSettings, creep_velocity, start_variances, turned
from fes.estimation.zupt_step_covariance import predict, step_noise
from fes.estimation.zupt_steps import Steps, matrix
from fes.signals import G_MPS2, FloatArray, IntArray

ADDED = 16  # of a step's noise, as step_noise leaves it


class StepTape(NamedTuple):
    """What the filter leaves behind at the ends of K steps; all from ``push`` on is for the smoother."""

    position: FloatArray  # (K, 3) m
    velocity: FloatArray  # (K, 3) m/s
    quaternions: FloatArray  # (K, 4)
    push: FloatArray  # (K, 3, 3) in the world, biases out: push, shift, and how much of the push is late
    mean: FloatArray  # (K, 3, 3) integral of the orientation in the world, s
    added: FloatArray  # (K, 16) what step_noise says
    slot: IntArray  # (K,) row of the measurement, -1: none
    residual: FloatArray  # (M, 4) of velocity and height
    residual_var: FloatArray  # (M, 4), 0: not measured
    gain: FloatArray  # (M, 4, 15)


def new_step_tape(steps: int, resting: int) -> StepTape:
    """An unwritten tape for K steps of which M end at rest: 0.4 kB a step, 0.5 kB more for one at rest."""
    k, m = steps, resting
    return StepTape(
        position=np.empty((k, 3)),
        velocity=np.empty((k, 3)),
        quaternions=np.empty((k, 4)),
        push=np.empty((k, 3, 3)),
        mean=np.empty((k, 3, 3)),
        added=np.empty((k, ADDED)),
        slot=np.empty(k, np.int64),
        residual=np.empty((m, MEASURED)),
        residual_var=np.empty((m, MEASURED)),
        gain=np.empty((m, MEASURED, STATES)),
    )


@jit_fused
def _carry_state(
    k: int, dt: float, steps: Steps, m: Any, r: Any, f: Any, s: Any, v: Any, q: Any, bg: Any, ba: Any
) -> None:
    """Strapdown over step ``k``: position, velocity and orientation, in place.

    Receive what the errors' way needs, in the world: ``m`` (9,) the orientation before, and rows ``k`` of ``r``
    (K, 3, 3) its integral, ``f`` (K, 3, 3) push, shift, and how much of the push is late.
    """
    w, x, y, z = q[0], q[1], q[2], q[3]
    m0, m1, m2, m3, m4, m5, m6, m7, m8 = matrix(w, x, y, z)
    m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8] = m0, m1, m2, m3, m4, m5, m6, m7, m8
    px, py, pz = steps.push[k, 0], steps.push[k, 1], steps.push[k, 2]
    b0, b1, b2 = m0 * px + m1 * py + m2 * pz, m3 * px + m4 * py + m5 * pz, m6 * px + m7 * py + m8 * pz
    px, py, pz = steps.shift[k, 0], steps.shift[k, 1], steps.shift[k, 2]
    a0, a1, a2 = m0 * px + m1 * py + m2 * pz, m3 * px + m4 * py + m5 * pz, m6 * px + m7 * py + m8 * pz
    per = 1.0 / dt
    c0, c1, c2 = b0 - a0 * per, b1 - a1 * per, b2 - a2 * per
    hx = hy = hz = ex = ey = ez = 0.0
    for j in range(3):
        tx, ty, tz = steps.mean[k, 0, j], steps.mean[k, 1, j], steps.mean[k, 2, j]
        tx, ty, tz = m0 * tx + m1 * ty + m2 * tz, m3 * tx + m4 * ty + m5 * tz, m6 * tx + m7 * ty + m8 * tz
        r[k, 0, j], r[k, 1, j], r[k, 2, j] = tx, ty, tz
        hx, hy, hz = hx + tx * bg[j], hy + ty * bg[j], hz + tz * bg[j]
        ex, ey, ez = ex + tx * ba[j], ey + ty * ba[j], ez + tz * ba[j]
    b0, b1, b2 = b0 + (c1 * hz - c2 * hy) - ex, b1 + (c2 * hx - c0 * hz) - ey, b2 + (c0 * hy - c1 * hx) - ez
    half = 0.5 * dt
    a0, a1, a2 = a0 - half * ex, a1 - half * ey, a2 - half * ez
    f[k, 0, 0], f[k, 0, 1], f[k, 0, 2] = b0, b1, b2
    f[k, 1, 0], f[k, 1, 1], f[k, 1, 2] = a0, a1, a2
    f[k, 2, 0], f[k, 2, 1], f[k, 2, 2] = c0, c1, c2
    s[0] += dt * v[0] + a0
    s[1] += dt * v[1] + a1
    s[2] += dt * (v[2] - half * G_MPS2) + a2
    v[0] += b0
    v[1] += b1
    v[2] += b2 - dt * G_MPS2
    tw, tx, ty, tz = steps.turn[k, 0], steps.turn[k, 1], steps.turn[k, 2], steps.turn[k, 3]
    q[0] = w * tw - x * tx - y * ty - z * tz
    q[1] = w * tx + x * tw + y * tz - z * ty
    q[2] = w * ty - x * tz + y * tw + z * tx
    q[3] = w * tz + x * ty - y * tx + z * tw
    turned(q, -hx, -hy, -hz, q)


@jit_fused
def forward_steps(
    t_ns: Any,
    gyr: Any,
    rest: Any,
    steps: Steps,
    start_force: Any,
    lever: Any,
    bias: Any,
    level: bool,
    p: ZuptSettings,
    tape: StepTape,
) -> None:
    """Filter K steps; every row of the tape then holds the state after the measurement at that step's end.

    ``bias`` (3,) is what the steps' rates were freed of; the others as for ``fes.estimation.zupt_kernel.forward``.
    """
    ends = steps.ends
    count = ends.shape[0]
    sample_ns = (t_ns[ends[count - 1]] - t_ns[0]) / (ends[count - 1])
    P = np.zeros(STATES * WIDTH)
    x, row, gain = np.zeros(STATES), np.empty(WIDTH), np.empty(6 * WIDTH)
    error, var = np.empty(3), np.empty(3)
    start_variances(rest[0], p, x)
    for j in range(STATES):
        P[j * DIAGONAL] = x[j]
    q, m, r, f = np.empty(4), np.empty(9), tape.mean, tape.push
    q[0], q[1], q[2], q[3] = from_gravity(start_force[0], start_force[1], start_force[2])
    bg, ba, v, s = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    anchor, creep = np.zeros(2), np.zeros(2)  # where the last rest ended; how the foot creeps in this one
    rest_began_ns, measured_ns, measured = t_ns[0], t_ns[0], 0
    for k in range(count):
        i = ends[k]
        if k > 0:
            dt = 1e-9 * (t_ns[i] - t_ns[ends[k - 1]])
            _carry_state(k, dt, steps, m, r, f, s, v, q, bg, ba)
            step_noise(k, steps, m, f, dt, p, tape.added)
            if rest[i] and 1e-9 * (t_ns[i] - rest_began_ns) > p.creep_s and measured_ns > rest_began_ns:
                # whoever stands seems to accelerate by noise alone, which tells no heading
                for j in range(3):
                    f[k, j, 0] = f[k, j, 1] = 0.0
            predict(P, k, r, f, dt, tape.added, p)
        else:
            tape.added[k, ADDED - 1] = 0.0
        tape.slot[k] = -1
        believed = False
        if rest[i]:
            if k > 0 and not rest[i - 1]:
                rest_began_ns = t_ns[i]
                creep_velocity(s, anchor, p.creep_mps, creep)
            going = 1.0 if 1e-9 * (t_ns[i] - rest_began_ns) < p.creep_s else 0.0
            ux, uy, uz = gyr[i, 0] - bias[0] - bg[0], gyr[i, 1] - bias[1] - bg[1], gyr[i, 2] - bias[2] - bg[2]
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
                tape.added[k, ADDED - 1] = off2
                for j in range(3):
                    P[(3 + j) * DIAGONAL] += off2
                    P[(6 + j) * DIAGONAL] += p.lost_tilt_rad**2
        if believed:
            measured_ns = t_ns[i]
            # half of the step before and of the one after; neighbouring samples err alike: their information per
            # second is fixed, whatever the rate
            stands_ns = sample_ns
            if k > 0 and rest[i - 1]:
                stands_ns += t_ns[i] - t_ns[ends[k - 1]]
            if k + 1 < count and rest[i + 1]:
                stands_ns += t_ns[ends[k + 1]] - t_ns[i]
            alike = max(2e9 * p.rest_correlation_s / stands_ns, 1.0)
            spread *= alike
            tape.slot[k] = measured
            error[0], error[1], error[2] = ex - v[0], ey - v[1], ez - v[2]
            update_velocity(P, x, error, spread, var, gain)
            for j in range(3):
                tape.residual[measured, j], tape.residual_var[measured, j] = error[j], var[j]
                for a in range(STATES):
                    tape.gain[measured, j, a] = gain[j * WIDTH + a]
            tape.residual_var[measured, 3] = 0.0
            if level:
                height, doubt = -s[2] - x[2], alike * p.rest_height_m * p.rest_height_m
                tape.residual[measured, 3] = height
                tape.residual_var[measured, 3] = update(P, x, 2, height, doubt, row, gain)
                for a in range(STATES):
                    tape.gain[measured, 3, a] = gain[a]
            measured += 1
            for j in range(3):
                s[j] += x[j]
                v[j] += x[3 + j]
                bg[j] += x[9 + j]
                ba[j] += x[12 + j]
            turned(q, x[6], x[7], x[8], q)
            anchor[0], anchor[1] = s[0], s[1]
        for j in range(3):
            tape.position[k, j], tape.velocity[k, j] = s[j], v[j]
        for j in range(4):
            tape.quaternions[k, j] = q[j]
