"""Indirect Kalman filter for the orientation of any moving body, from one inertial sensor; compiled, causal.

Gravity shows in a moving body's specific force only on average. What bounds the average is speed: the level part of the
acceleration, integrated, stays as small as the body's speed. So the filter carries the level velocity and takes "about
zero" for a measurement of it, with noise that adapts: a body whose acceleration is ``a`` rms moves at about
``a · movement_s``, so that quiet moments count for much. What is swayed about a place is fastest just where its
acceleration is nil; where the acceleration has been even for some seconds (squared mean over mean square: feet 0.4, a
board in the hand 0.6 to 0.9) the speed's noise is therefore nearly constant, as in VQF. In stance the speed is zero.

State, as errors in the world: ``theta`` with ``R^ = exp(theta) R``, ``beta = b^ - b``, ``nu = v^ - v`` (level), and
``alpha``, the accelerometer's bias, which turns with the sensor and so tells itself from a tilt::

    dtheta/dt = -R beta + noise,  dbeta/dt = -beta/T + noise,  dalpha/dt = noise
    dnu/dt = theta × g - R alpha - nu/T_v + noise

In ``dnu/dt`` stands gravity instead of the whole force, and the gain of every speed measurement is zero in the
heading's row: neither the heading nor its variance is changed. A reading at the sensor's limit, or a lost sample, is
guessed, and nothing is learnt from it.
Sources: Negård et al. (2005), Eq. (4)-(13), for the indirect filter and the Markov bias; Laidig and Seel (2023), VQF,
for averaging the force in a frame that gyroscopes carry, weights that do not follow a swaying body's acceleration, and
stillness: its thresholds of rate and force, held for 1.5 s, show the gyroscope's bias.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fes.estimation.numerics.jit import jit
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import from_gravity, quaternion_step, to_sensor, to_world
from fes.signals import G_MPS2, FloatArray

# errors: orientation in the world (3, heading last), gyroscope's bias (3), level velocity (2), accelerometer's bias (3)
STATES = 11
NO_RANGE = 1e30  # no value reaches it
MEMORY = 26  # numbers in State.memory

START_GIVEN = 0.5  # at STARTED: the quaternion is set already; else 0 before the first sample and 1 from then on

# where each thing lies in ``State.memory``
STARTED, ENERGY, STILL_S, SINCE_TURN_S, SINCE_PUSH_S = 0, 1, 2, 3, 4
RATE, SLOPE, FORCE, MEAN_RATE, MEAN_FORCE, TRUSTED = 5, 8, 11, 14, 17, 20  # three numbers each
PUSH, PUSH2, SINCE_MEASURED_S = 23, 24, 25


class BodySettings(NamedTuple):
    """Noise of the filter; densities and times, so that one setting holds at any sampling rate and on any body."""

    rate_noise_radps_rthz: float = 5e-4  # angular random walk
    rate_scale_noise: float = 0.002  # share of the rate that is noise per √Hz: scale errors, bandwidth
    bias_walk_radps2_rthz: float = 3e-5  # drives the Markov bias: 0.07 °/s in the long run
    bias_time_s: float = 3600.0  # the Markov bias's time constant
    acc_noise_mps2_rthz: float = 0.05
    acc_scale_noise: float = 0.015  # share of the body's acceleration that is noise per √Hz
    movement_s: float = 0.3  # speed is about acceleration × this, and lasts about this long
    energy_s: float = 0.05  # over which time the acceleration is judged
    measured_s: float = 0.014  # between measurements of the speed, for they cost most
    sway_mps: float = 0.4  # the speed of what moves evenly about a place, at most, …
    sway_s: float = 0.6  # … and its acceleration × this, …
    even_s: float = 2.0  # … where the acceleration of so long …
    least_evenness: float = 0.5  # … has a squared mean of this share of its mean square; wholly so …
    whole_evenness: float = 0.65  # … from this share
    least_speed_mps: float = 0.005
    speed_memory_s: float = 10.0  # after which a steady speed is forgotten
    rest_speed_mps: float = 0.02  # where rest is known: how far from zero the speed is, …
    rest_speed_per_rate_m: float = 0.05  # … how that grows with the rate, …
    rest_correlation_s: float = 0.1  # … and how long it stays the same
    still_s: float = 1.5  # stillness that long shows the gyroscope's bias, …
    still_mean_s: float = 0.5  # … by means over this time, …
    still_rate_radps: float = 0.035  # … from which rate, …
    still_acc_mps2: float = 0.5  # … and force stay this close, …
    still_mean_radps: float = 0.07  # … while no bias is this large, …
    still_bias_radps_rthz: float = 5e-4  # … to this density
    start_tilt_rad: float = 0.2
    start_bias_radps: float = 0.01
    start_speed_mps: float = 1.0
    start_force_mps2: float = 0.02  # the accelerometer's bias, …
    force_walk_mps3_rthz: float = 1e-4  # … and how it wanders
    extrapolation_s: float = 0.015  # a clipped rate goes on as it rose, for about this long, …
    greatest_excess: float = 1.0  # … by at most this share of the range, …
    clipped_share: float = 0.2  # … and is then off by this share of the range, in rate as in force


class State(NamedTuple):
    """All that evolves; the compiled code changes the arrays in place.

    ``quaternion`` (4,) w, x, y, z, sensor to world; ``bias`` (3,) rad/s; ``velocity`` (2,) m/s, level, of the last
    ``speed_memory_s``; ``force_bias`` (3,) m/s², the accelerometer's; ``covariance`` (11, 11); ``memory`` by the
    indices above; ``work`` (2, 11).
    """

    quaternion: FloatArray
    bias: FloatArray
    velocity: FloatArray
    force_bias: FloatArray
    covariance: FloatArray
    memory: FloatArray
    work: FloatArray


def new_state(
    settings: BodySettings,
    bias_radps: ArrayLike = (0.0, 0.0, 0.0),
    quaternion: FloatArray | None = None,
    force_bias_mps2: ArrayLike = (0.0, 0.0, 0.0),
) -> State:
    """A filter that has seen nothing; without a ``quaternion`` (4,) the first sample's force is its upright."""
    sd = [settings.start_tilt_rad] * 3 + [settings.start_bias_radps] * 3 + [settings.start_speed_mps] * 2
    sd += [settings.start_force_mps2] * 3
    memory, attitude = np.zeros(MEMORY), np.array([1.0, 0.0, 0.0, 0.0])
    if quaternion is not None:
        memory[STARTED], attitude = START_GIVEN, quaternion.copy()
    bias = np.array(bias_radps, dtype=np.float64)
    force_bias = np.array(force_bias_mps2, dtype=np.float64)
    return State(attitude, bias, np.zeros(2), force_bias, np.diag(np.square(sd)), memory, np.zeros((2, STATES)))


AT_LIMIT = 0.999  # of the range


@jit
def usable_rate(memory: Vec, gyr: Mat, range_radps: float, dt_s: float, settings: BodySettings) -> float:
    """Fill ``memory`` at RATE with the rate to integrate (rad/s); return for how long it has been guessed (s).

    An axis at its limit goes on as it rose before, ever more slowly: ``w + dw/dt · T (1 - exp(-t/T))``, at least the
    limit and at most ``greatest_excess`` above it. A lost sample (not finite) repeats the last good rate.
    """
    guessed = False
    for j in range(3):
        if not (math.isfinite(gyr[j]) and abs(gyr[j]) < AT_LIMIT * range_radps):
            guessed = True
    t = memory[SINCE_TURN_S] + dt_s if guessed else 0.0
    memory[SINCE_TURN_S] = t
    for j in range(3):
        value, last = gyr[j], memory[TRUSTED + j]
        if not math.isfinite(value):
            memory[RATE + j] = last
        elif abs(value) < AT_LIMIT * range_radps:
            memory[SLOPE + j] = (value - last) / dt_s if memory[RATE + j] == last else 0.0
            memory[RATE + j] = value
            memory[TRUSTED + j] = value
        else:
            side = 1.0 if value > 0.0 else -1.0
            reach = settings.extrapolation_s * (1.0 - math.exp(-t / settings.extrapolation_s))
            size = side * (last + memory[SLOPE + j] * reach)
            size = min(max(size, abs(value)), (1.0 + settings.greatest_excess) * range_radps)
            memory[RATE + j] = side * size
    return t


@jit
def usable_force(memory: Vec, acc: Mat, range_mps2: float, dt_s: float) -> float:
    """Fill ``memory`` at FORCE with the force to integrate (m/s²); return for how long it has been guessed (s).

    At the limit the reading is the best guess there is; a lost sample repeats the last.
    """
    guessed = False
    for j in range(3):
        if math.isfinite(acc[j]):
            memory[FORCE + j] = acc[j]
            guessed = guessed or abs(acc[j]) >= AT_LIMIT * range_mps2
        else:
            guessed = True
    t = memory[SINCE_PUSH_S] + dt_s if guessed else 0.0
    memory[SINCE_PUSH_S] = t
    return t


TINY = 1e-12  # m²/s⁴, no acceleration
HEADING = 2  # its place in the state


@jit
def propagate_rows(p: Vec, quaternion: Mat, dt_s: float, bias_share: float, speed_share: float) -> None:
    """``P ← Φ P`` in place, on the transposed view ``P Φᵀ``; ``quaternion`` (4,) is that at the interval's end."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    ax, ay, az = to_world(w, x, y, z, dt_s, 0.0, 0.0)
    bx, by, bz = to_world(w, x, y, z, 0.0, dt_s, 0.0)
    cx, cy, cz = to_world(w, x, y, z, 0.0, 0.0, dt_s)
    h = G_MPS2 * dt_s
    for j in range(STATES):
        t0, t1 = p[0, j], p[1, j]
        b0, b1, b2 = p[3, j], p[4, j], p[5, j]
        p[0, j] = t0 - (ax * b0 + bx * b1 + cx * b2)
        p[1, j] = t1 - (ay * b0 + by * b1 + cy * b2)
        p[2, j] -= az * b0 + bz * b1 + cz * b2
        p[3, j] = bias_share * b0
        p[4, j] = bias_share * b1
        p[5, j] = bias_share * b2
        f0, f1, f2 = p[8, j], p[9, j], p[10, j]
        p[6, j] = speed_share * p[6, j] + h * t1 - (ax * f0 + bx * f1 + cx * f2)
        p[7, j] = speed_share * p[7, j] - h * t0 - (ay * f0 + by * f1 + cy * f2)


@jit
def mirror(p: Mat) -> None:
    """Make the upper half of a covariance the lower one's."""
    for i in range(STATES):
        for j in range(i):
            p[j, i] = p[i, j]


@jit
def measure(state: State, at: int, residual: float, variance: float) -> None:
    """Take a scalar measurement of the error at index ``at``: ``residual`` is truth less estimate.

    Reads and writes the lower half of ``P`` only. The heading's row of the gain is zero. Errors found are taken out of
    the estimates at once.
    """
    p, gain, column = state.covariance, state.work[0], state.work[1]
    total, heading = p[at, at] + variance, p[HEADING, HEADING]
    share = 1.0 / math.sqrt(total)
    for i in range(STATES):
        column[i] = share * (p[i, at] if i >= at else p[at, i])
        gain[i] = share * column[i]
    for i in range(STATES):
        c = column[i]
        for j in range(i + 1):
            p[i, j] -= c * column[j]
    p[HEADING, HEADING] = heading
    q = state.quaternion
    rx, ry, rz = to_sensor(q[0], q[1], q[2], q[3], gain[0] * residual, gain[1] * residual, 0.0)
    q[0], q[1], q[2], q[3] = quaternion_step(q[0], q[1], q[2], q[3], rx, ry, rz)
    for j in range(3):
        state.bias[j] += gain[3 + j] * residual
    for j in range(2):
        state.velocity[j] += gain[6 + j] * residual
    for j in range(3):
        state.force_bias[j] += gain[8 + j] * residual


@jit
def _still(memory: Vec, dt_s: float, settings: BodySettings) -> bool:
    """Follow the means of rate and force; whether both have been steady for long enough."""
    share = 1.0 - math.exp(-dt_s / settings.still_mean_s)
    rate = force = mean = 0.0
    for j in range(3):
        dw, da = memory[RATE + j] - memory[MEAN_RATE + j], memory[FORCE + j] - memory[MEAN_FORCE + j]
        memory[MEAN_RATE + j] += share * dw
        memory[MEAN_FORCE + j] += share * da
        rate += dw * dw
        force += da * da
        mean += memory[MEAN_RATE + j] * memory[MEAN_RATE + j]
    steady = rate < settings.still_rate_radps**2 and force < settings.still_acc_mps2**2
    if steady and mean < settings.still_mean_radps**2:
        memory[STILL_S] += dt_s
    else:
        memory[STILL_S] = 0.0
    return bool(memory[STILL_S] > settings.still_s)


@jit
def one_sample(
    state: State, acc: Mat, gyr: Mat, zero_velocity: bool, dt_s: float, ranges: Vec, settings: BodySettings
) -> None:
    """Take one sample ``acc`` (3,) m/s², ``gyr`` (3,) rad/s; ``ranges`` are the full scales of both, in this order."""
    m, q, p, bias, velocity = state.memory, state.quaternion, state.covariance, state.bias, state.velocity
    pushed_s = usable_force(m, acc, ranges[0], dt_s)
    turned_s = usable_rate(m, gyr, ranges[1], dt_s, settings)
    if m[STARTED] < 1.0:
        for j in range(3):
            if not (math.isfinite(acc[j]) and math.isfinite(gyr[j])):
                return  # nothing to start from yet
        for j in range(3):
            m[TRUSTED + j] = m[MEAN_RATE + j] = m[RATE + j]
            m[MEAN_FORCE + j] = m[FORCE + j]
        if m[STARTED] != START_GIVEN:
            q[0], q[1], q[2], q[3] = from_gravity(m[FORCE], m[FORCE + 1], m[FORCE + 2])
        m[STARTED] = 1.0
        return
    wx, wy, wz = m[RATE] - bias[0], m[RATE + 1] - bias[1], m[RATE + 2] - bias[2]
    q[0], q[1], q[2], q[3] = quaternion_step(q[0], q[1], q[2], q[3], wx * dt_s, wy * dt_s, wz * dt_s)
    b = state.force_bias
    ax, ay, az = to_world(q[0], q[1], q[2], q[3], m[FORCE] - b[0], m[FORCE + 1] - b[1], m[FORCE + 2] - b[2])
    az -= G_MPS2
    speed_share = math.exp(-dt_s / settings.speed_memory_s)
    velocity[0] = speed_share * velocity[0] + ax * dt_s
    velocity[1] = speed_share * velocity[1] + ay * dt_s
    bias_share = math.exp(-dt_s / settings.bias_time_s)
    for j in range(3):
        bias[j] *= bias_share
    propagate_rows(p, q, dt_s, bias_share, speed_share)
    propagate_rows(p.T, q, dt_s, bias_share, speed_share)

    rate2, push2 = wx * wx + wy * wy + wz * wz, ax * ax + ay * ay + az * az
    angle = settings.rate_noise_radps_rthz**2 + settings.rate_scale_noise**2 * rate2
    speed = settings.acc_noise_mps2_rthz**2 + settings.acc_scale_noise**2 * push2
    # a guess stays wrong in the same way: its error grows as the time, the variance as its square
    angle += 2.0 * turned_s * (settings.clipped_share * min(ranges[1], math.sqrt(rate2) + 1.0)) ** 2
    speed += 2.0 * pushed_s * (settings.clipped_share * min(ranges[0], math.sqrt(push2) + G_MPS2)) ** 2
    for j in range(3):
        p[j, j] += angle * dt_s
        p[3 + j, 3 + j] += settings.bias_walk_radps2_rthz**2 * dt_s
        p[8 + j, 8 + j] += settings.force_walk_mps3_rthz**2 * dt_s
    for j in range(2):
        p[6 + j, 6 + j] += speed * dt_s

    m[ENERGY] += (1.0 - math.exp(-dt_s / settings.energy_s)) * (push2 - m[ENERGY])
    share = min(dt_s / settings.even_s, 1.0)
    m[PUSH] += share * (math.sqrt(push2) - m[PUSH])
    m[PUSH2] += share * (push2 - m[PUSH2])
    still = _still(m, dt_s, settings)
    if turned_s > 0.0 or pushed_s > 0.0:
        return  # nothing is learnt from a guess
    m[SINCE_MEASURED_S] += dt_s
    if m[SINCE_MEASURED_S] >= settings.measured_s:
        elapsed_s = m[SINCE_MEASURED_S]
        m[SINCE_MEASURED_S] = 0.0
        t = settings.movement_s
        even = (m[PUSH] ** 2 / max(m[PUSH2], TINY) - settings.least_evenness) / (
            settings.whole_evenness - settings.least_evenness
        )
        even = min(max(even, 0.0), 1.0)
        sway2 = min(settings.sway_s**2 * max(m[ENERGY], m[PUSH2]), settings.sway_mps**2)
        speed2 = settings.least_speed_mps**2 + (1.0 - even) * t * t * m[ENERGY] + even * sway2
        variance = speed2 * max(2.0 * t / elapsed_s, 1.0)
        if zero_velocity:
            standing = settings.rest_speed_mps**2 + settings.rest_speed_per_rate_m**2 * rate2
            variance = min(variance, standing * max(2.0 * settings.rest_correlation_s / elapsed_s, 1.0))
        for j in range(2):
            measure(state, 6 + j, -velocity[j], variance)
    if still:
        variance = settings.still_bias_radps_rthz**2 / dt_s
        for j in range(3):
            measure(state, 3 + j, m[MEAN_RATE + j] - bias[j], variance)
    mirror(p)


LEVEL = np.array([0, 1, 6, 7])  # level errors' places in the state: tilt and velocity


@jit
def advance(
    state: State, acc: Mat, gyr: Mat, rest: Vec, dt_s: float, ranges: Vec, settings: BodySettings, out: Vec, tilt: Vec,
    speed: Mat, spread: Mat,
) -> None:  # fmt: skip
    """Take samples (N, 3), (N, 3), (N,); fill ``out`` (N, 4) and ``tilt`` (N,), the mean tilt variance in rad².

    ``speed`` (N, 2), m/s, and ``spread`` (N, 4, 4), the covariance at LEVEL, are filled unless they are empty.
    """
    for k in range(acc.shape[0]):
        one_sample(state, acc[k], gyr[k], rest[k], dt_s, ranges, settings)
        for j in range(4):
            out[k, j] = state.quaternion[j]
        tilt[k] = 0.5 * (state.covariance[0, 0] + state.covariance[1, 1])
        if len(speed) > 0:
            speed[k, 0], speed[k, 1] = state.velocity[0], state.velocity[1]
            for i in range(4):
                for j in range(4):
                    spread[k, i, j] = state.covariance[LEVEL[i], LEVEL[j]]
