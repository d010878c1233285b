"""Compiled core of the off-line ZUPT filter: forwards over the steps of ``fes.estimation.zupt_steps``.

What is measured, when it is believed and with which noise is as in ``fes.estimation.zupt_kernel``, which goes from
sample to sample; only that the covariance goes from step to step here, a few hundredths of a second at a time, and that
the velocity of a resting foot is measured once a step, for the time from the middle of one to that of the next.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fes.estimation.compiled import jit
from fes.estimation.rotation import from_gravity, to_world
from fes.estimation.zupt_covariance import BIASES, DIAGONAL, STATES, WIDTH, update
from fes.estimation.zupt_kernel import MEASURED, ZuptSettings, creep_velocity, start_variances, turned
from fes.estimation.zupt_step_covariance import add_noise, predict, step_noise
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


@jit
def _carry_state(
    k: int, dt: float, steps: Steps, m: Any, r: Any, f: Any, s: Any, v: Any, q: Any, bg: Any, ba: Any
) -> None:
    """Strapdown over step ``k``: position, velocity and orientation, in place.

    Receive what the errors' way needs, in the world: ``m`` (3, 3) the orientation before, ``r`` (3, 3) its integral,
    ``f`` (3, 3) push, shift, and how much of the push is late.
    """
    matrix(q[0], q[1], q[2], q[3], m)
    for a in range(3):
        f[0, a] = m[a, 0] * steps.push[k, 0] + m[a, 1] * steps.push[k, 1] + m[a, 2] * steps.push[k, 2]
        f[1, a] = m[a, 0] * steps.shift[k, 0] + m[a, 1] * steps.shift[k, 1] + m[a, 2] * steps.shift[k, 2]
        f[2, a] = f[0, a] - f[1, a] / dt
        for b in range(3):
            r[a, b] = m[a, 0] * steps.mean[k, 0, b] + m[a, 1] * steps.mean[k, 1, b] + m[a, 2] * steps.mean[k, 2, b]
    hx = r[0, 0] * bg[0] + r[0, 1] * bg[1] + r[0, 2] * bg[2]
    hy = r[1, 0] * bg[0] + r[1, 1] * bg[1] + r[1, 2] * bg[2]
    hz = r[2, 0] * bg[0] + r[2, 1] * bg[1] + r[2, 2] * bg[2]
    f[0, 0] += f[2, 1] * hz - f[2, 2] * hy
    f[0, 1] += f[2, 2] * hx - f[2, 0] * hz
    f[0, 2] += f[2, 0] * hy - f[2, 1] * hx
    for a in range(3):
        e = r[a, 0] * ba[0] + r[a, 1] * ba[1] + r[a, 2] * ba[2]
        f[0, a] -= e
        f[1, a] -= 0.5 * dt * e
        g = G_MPS2 if a == 2 else 0.0
        s[a] += dt * (v[a] - 0.5 * dt * g) + f[1, a]
        v[a] += f[0, a] - dt * g
    w, x, y, z = q[0], q[1], q[2], q[3]
    tw, tx, ty, tz = steps.turn[k, 0], steps.turn[k, 1], steps.turn[k, 2], steps.turn[k, 3]
    q[0] = w * tw - x * tx - y * ty - z * tz
    q[1] = w * tx + x * tw + y * tz - z * ty
    q[2] = w * ty - x * tz + y * tw + z * tx
    q[3] = w * tz + x * ty - y * tx + z * tw
    turned(q, -hx, -hy, -hz, q)


@jit
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
    half = np.empty(BIASES * WIDTH)
    x, row, gain = np.zeros(STATES), np.empty(WIDTH), np.empty(WIDTH)
    start_variances(rest[0], p, x)
    for j in range(STATES):
        P[j * DIAGONAL] = x[j]
    q, m, r, f, noise = np.empty(4), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(ADDED)
    q[0], q[1], q[2], q[3] = from_gravity(start_force[0], start_force[1], start_force[2])
    bg, ba, v, s = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    anchor, creep = np.zeros(2), np.zeros(2)  # where the last rest ended; how the foot creeps in this one
    rest_began_ns, measured_ns, measured = t_ns[0], t_ns[0], 0
    for k in range(count):
        i = ends[k]
        if k > 0:
            dt = 1e-9 * (t_ns[i] - t_ns[ends[k - 1]])
            _carry_state(k, dt, steps, m, r, f, s, v, q, bg, ba)
            step_noise(k, steps, m, f, dt, p, noise)
            if rest[i] and 1e-9 * (t_ns[i] - rest_began_ns) > p.creep_s and measured_ns > rest_began_ns:
                # whoever stands seems to accelerate by noise alone, which tells no heading
                for j in range(3):
                    f[j, 0] = f[j, 1] = 0.0
            predict(P, half, r, f, dt)
            add_noise(P, noise, dt, p)
            for a in range(3):
                for b in range(3):
                    tape.mean[k, a, b], tape.push[k, a, b] = r[a, b], f[a, b]
            for j in range(ADDED):
                tape.added[k, j] = noise[j]
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
            for j in range(STATES):
                x[j] = 0.0
            tape.residual_var[measured, 3] = 0.0
            for j in range(4 if level else 3):
                if j == 3:
                    state, error, var = 2, -s[2] - x[2], alike * p.rest_height_m * p.rest_height_m
                else:
                    state, var = 3 + j, spread
                    error = (ex if j == 0 else ey if j == 1 else ez) - v[j] - x[3 + j]
                tape.residual[measured, j] = error
                tape.residual_var[measured, j] = update(P, x, state, error, var, row, gain)
                for a in range(STATES):
                    tape.gain[measured, j, a] = gain[a]
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
