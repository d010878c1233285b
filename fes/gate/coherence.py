"""Do a sensor's accelerometer and gyroscope tell of the same movement? Each is held against the other, axis by axis.

A triad that repeats itself, or says nothing but noise, or is scaled, has numbers that could each be true. Together they
cannot: where a sensor turns, gravity turns in it; where force changes, something turns; and over some strides the
force, turned along with the gyroscope, is gravity and no more. Samples are judged by means of some 15 ms, which noise
hardly moves. Compiled; a core is of :data:`fes.gate.bounds.CORE`.
"""

import math

from fes.estimation.numerics.jit import jit_ieee
from fes.estimation.numerics.records import Record, Vec
from fes.gate.bounds import (
    ACC_DEAD,
    ACC_FROZEN,
    AXIS_DEAD,
    AXIS_FROZEN,
    AXIS_STILL,
    DANGLES,
    GYR_DEAD,
    GYR_FROZEN,
    HOPS,
    MISFIT,
    SCALED,
)
from fes.signals import G_MPS2


def coherent(core: Record) -> int:
    """Take in the core's sample; the code of how the two triads contradict each other, 0 when they do not.

    What is told is told once, and anew when it goes on.
    """
    sample, block, repeats, bounds = core.sample, core.block, core.repeats, core.bounds
    step_ns = sample.t_sensor_ns - block.t_ns
    if -bounds.most_step_ns < step_ns <= 0:
        return 0  # a slip is counted elsewhere
    block.t_ns = sample.t_sensor_ns
    if not 0 < step_ns <= bounds.most_step_ns:
        if not 0 < step_ns <= bounds.forget_ns:
            forget_person(core)
        restart(core)
        return 0
    acc, gyr = sample.acc, sample.gyr
    force_repeats = repeat(repeats, 0, acc[0], acc[1], acc[2], step_ns)
    rate_repeats = repeat(repeats, 1, gyr[0], gyr[1], gyr[2], step_ns)
    at_band(core)
    if force_repeats or rate_repeats:
        code = frozen(core, step_ns)
        if code != 0:
            return code
    else:
        core.frozen = 0
    for axis in range(3):
        block.sums[axis] += acc[axis]
        block.sums[3 + axis] += gyr[axis]
    block.samples += 1
    block.ns += step_ns
    return contradicted(core) if block.ns >= bounds.block_ns else 0


def forget_person(core: Record) -> None:
    """Whoever wears the sensor now may be somebody else."""
    still, mean, bounds = core.still, core.mean, core.bounds
    mean.usual_mps2, mean.walked_ns = G_MPS2, 0
    still.usual_known, still.hops_known, still.gone = False, 0, 0.0
    for axis in range(6):
        still.least[axis] = bounds.least_mps2 if axis < 3 else bounds.least_radps
        still.farthest[axis], still.may_go[axis] = 0.0, math.inf


def restart(core: Record) -> None:
    """Begin as if nothing had come before; what is usual of the person stays."""
    clear_block(core.block)
    restart_still(core.still)
    core.mean.known, core.mean.ns = False, 0
    core.block.known, core.block.resting_ns, core.block.still_ns = False, 0, 0


def clear_block(block: Record) -> None:
    """Begin the next block."""
    for axis in range(6):
        block.sums[axis] = 0.0
    block.samples = block.ns = 0


def repeat(repeats: Record, triad: int, x: float, y: float, z: float, step_ns: int) -> bool:
    """Take in a triad's values a step later; whether any axis repeats itself to the bit, and how long each has."""
    first, values, most = 3 * triad, repeats.values, repeats.greatest[triad]
    if not (-most <= x <= most and -most <= y <= most and -most <= z <= most):
        repeats.greatest[triad] = greater(greater(greater(most, abs(x)), abs(y)), abs(z))
    same_x, same_y, same_z = x == values[first], y == values[first + 1], z == values[first + 2]
    values[first], values[first + 1], values[first + 2] = x, y, z
    same = repeats.same
    none_before = not (same[first] or same[first + 1] or same[first + 2])
    same[first], same[first + 1], same[first + 2] = same_x, same_y, same_z
    if not (same_x or same_y or same_z):
        repeats.all_lived[triad] += 1
        if not none_before:
            repeats.all_ns[triad] = 0
            for axis in range(first, first + 3):
                repeats.axis_ns[axis] = 0
        return False
    repeats.all_ns[triad] = repeats.all_ns[triad] + step_ns if same_x and same_y and same_z else 0
    for axis in range(first, first + 3):
        if not same[axis]:
            repeats.axis_ns[axis] = 0
            repeats.lived[axis] += 1
    return True


def at_band(core: Record) -> None:
    """A rate of exactly 0 with the force as it was is a dead band, whatever the noise: it counts from a movement on."""
    acc, gyr, repeats = core.sample.acc, core.sample.gyr, core.repeats
    if not gyr[0] == gyr[1] == gyr[2] == 0.0:
        repeats.band = False
    elif not repeats.band:
        repeats.band = True
        for axis in range(3):
            repeats.band_force[axis] = acc[axis]
    elif not (repeats.all_ns[0] or apart(acc, repeats.band_force, core.bounds.force_moved_mps2)):
        repeats.all_ns[1] = 0


def frozen(core: Record, step_ns: int) -> int:
    """Whether a triad repeats itself while the other does not, or an axis while the sensor moves."""
    repeats, bounds, acc, gyr = core.repeats, core.bounds, core.sample.acc, core.sample.gyr
    force_ns, rate_ns = repeats.all_ns[0], repeats.all_ns[1]
    core.frozen = 0
    if force_ns >= bounds.same_ns > rate_ns:
        core.frozen = ACC_FROZEN
    elif rate_ns >= bounds.same_ns > force_ns:
        core.frozen = GYR_FROZEN
    if core.frozen:
        return int(core.frozen)
    if abs(square(acc, 0) - G_MPS2 * G_MPS2) > 2.0 * G_MPS2 or square(gyr, 0) > bounds.rests_radps**2:
        for axis in range(6):
            triad = axis // 3
            lived = repeats.all_lived[triad] + repeats.lived[axis] > bounds.lived
            full = bounds.full_scale * repeats.greatest[triad]
            if repeats.same[axis] and lived and abs(repeats.values[axis]) < full:
                repeats.axis_ns[axis] += step_ns
                if repeats.axis_ns[axis] >= bounds.same_axis_ns:
                    repeats.axis_ns[axis] = 0
                    return AXIS_FROZEN + axis
    return 0


def contradicted(core: Record) -> int:
    """Judge the block's means, and begin the next."""
    block, bounds, block_ns = core.block, core.bounds, core.block.ns
    share, sums = 1.0 / block.samples, block.sums
    x, y, z = share * sums[0], share * sums[1], share * sums[2]
    p, q, r = share * sums[3], share * sums[4], share * sums[5]
    clear_block(block)
    force_mps2, rate_radps = math.sqrt(x * x + y * y + z * z), math.sqrt(p * p + q * q + r * r)
    if not force_mps2 + rate_radps < math.inf:  # a fault of its own; sums would never forget it
        restart(core)
        return 0
    before = block.before
    jolt2 = (x - before[0]) * (x - before[0]) + (y - before[1]) * (y - before[1]) + (z - before[2]) * (z - before[2])
    before[0], before[1], before[2] = x, y, z
    if not block.known:
        begin_means(block, x, y, z, p, q, r)
        return 0
    block_s = 1e-9 * block_ns
    if rate_radps > bounds.turns_radps:
        # how far gravity went through the sensor, were the force all of it
        way = G_MPS2 * block_s / greater(2.0, force_mps2)
        along_x, along_y, along_z = way * abs(y * r - z * q), way * abs(z * p - x * r), way * abs(x * q - y * p)
        unseen = block.axis_unseen_mps2
        unseen[0] += along_x
        unseen[1] += along_y
        unseen[2] += along_z
        block.unseen_mps2 += math.sqrt(along_x * along_x + along_y * along_y + along_z * along_z)
        block.smooth_rad += rate_radps * block_s
    if jolt2 > bounds.jolt_mps2 * bounds.jolt_mps2:
        block.smooth_rad = 0.0
    axis = still_axis(core, x, y, z, p, q, r, block_ns)
    if axis >= 0:
        return int(AXIS_STILL + axis)
    felt_mps2 = misfit(core, x, y, z, p, q, r, rate_radps, block_ns)
    if felt_mps2 > 0.0:
        core.value = felt_mps2
        code = MISFIT
    else:
        code = dead(core, x, y, z, p, q, r)
        if code == 0:
            code = scaled(core, x, y, z, rate_radps, block_ns)
    if code != 0:
        restart_still(core.still)  # what lies is nothing to learn from
    return int(code)


def begin_means(block: Record, x: float, y: float, z: float, p: float, q: float, r: float) -> None:
    """Count from these means on."""
    block.known = True
    block.force[0], block.force[1], block.force[2] = x, y, z
    block.rate[0], block.rate[1], block.rate[2] = p, q, r
    for axis in range(3):
        block.axis_force[axis], block.axis_unseen_mps2[axis] = block.force[axis], 0.0
    block.unseen_mps2, block.unturned, block.smooth_rad = 0.0, 0, 0.0


def dead(core: Record, x: float, y: float, z: float, p: float, q: float, r: float) -> int:
    """Whether one triad says nothing of what the other tells, or both nothing of the ground."""
    block, bounds, unseen, stuck = core.block, core.bounds, core.block.axis_unseen_mps2, -1
    force, rate = block.force, block.rate
    most = bounds.force_moved_mps2
    if abs(x - force[0]) > most or abs(y - force[1]) > most or abs(z - force[2]) > most:
        force[0], force[1], force[2] = x, y, z
        block.unseen_mps2 = 0.0
        block.unturned += 1
    turned = bounds.rate_moved_radps
    if abs(p - rate[0]) > turned or abs(q - rate[1]) > turned or abs(r - rate[2]) > turned:
        rate[0], rate[1], rate[2] = p, q, r
        block.unturned = 0
    for axis in range(3):
        now = block.before[axis]
        if abs(now - block.axis_force[axis]) > most:
            block.axis_force[axis], unseen[axis] = now, 0.0
        elif unseen[axis] > bounds.most_unseen_axis_mps2:
            unseen[axis], stuck = 0.0, axis
    if block.unseen_mps2 > bounds.most_unseen_mps2:
        block.unseen_mps2 = 0.0
        return ACC_DEAD
    if block.unturned > bounds.most_unturned:
        block.unturned = 0
        return GYR_DEAD
    if block.smooth_rad > bounds.most_smooth_rad:
        block.smooth_rad = 0.0
        return DANGLES
    return AXIS_DEAD + stuck if stuck >= 0 else 0


def scaled(core: Record, x: float, y: float, z: float, rate_radps: float, block_ns: int) -> int:
    """Whether the force at rest is not gravity."""
    block, bounds, rest = core.block, core.bounds, core.block.rest
    block.still_ns = block.still_ns + block_ns if rate_radps < bounds.still_radps else 0
    resting_ns = block.resting_ns
    block.resting_ns = 0
    if rate_radps >= bounds.rests_radps:
        return 0
    if resting_ns == 0:
        rest[0], rest[1], rest[2] = x, y, z
        block.rests, block.resting_ns = 1, block_ns
        return 0
    share, steady = 1.0 / block.rests, bounds.steady_mps2
    u, v, w = share * rest[0], share * rest[1], share * rest[2]
    if abs(x - u) > steady or abs(y - v) > steady or abs(z - w) > steady:
        return 0
    rest[0], rest[1], rest[2] = rest[0] + x, rest[1] + y, rest[2] + z
    block.rests += 1
    block.resting_ns = resting_ns + block_ns
    core.value = math.sqrt(u * u + v * v + w * w)
    long = block.resting_ns > bounds.long_rest_ns and block.still_ns > bounds.long_rest_ns
    return SCALED if long and abs(core.value - G_MPS2) > bounds.gravity_off_mps2 else 0


def misfit(
    core: Record, x: float, y: float, z: float, p: float, q: float, r: float, rate_radps: float, block_ns: int
) -> float:
    """How large the mean force is (m/s²) when it cannot be so, else 0.

    Turned along with the gyroscope it is gravity and no more, for whoever walks ends as fast as he began. A force that
    is scaled changes its size; a rate that is scaled, or an axis of either that is stuck, turns the mean where the
    force does not go, and it shrinks, or grows where the force of a swing is taken for another direction's.
    """
    mean, bounds, once, twice, block_s = core.mean, core.bounds, core.mean.once, core.mean.twice, 1e-9 * block_ns
    if not mean.known:
        size = mean.usual_mps2 / greater(math.sqrt(x * x + y * y + z * z), 1e-6)
        once[0], once[1], once[2] = size * x, size * y, size * z
        twice[0], twice[1], twice[2] = once[0], once[1], once[2]
        mean.known = True
    share = block_s / bounds.force_mean_s
    turn(once, block_s * p, block_s * q, block_s * r)
    turn(twice, block_s * p, block_s * q, block_s * r)
    once[0] += share * (x - once[0])
    once[1] += share * (y - once[1])
    once[2] += share * (z - once[2])
    for axis in range(3):
        twice[axis] += share * (once[axis] - twice[axis])
    mean.ns += block_ns
    if mean.ns < bounds.means_ns:
        return 0.0
    size_mps2 = math.sqrt(square(twice, 0))
    off_mps2 = size_mps2 - mean.usual_mps2
    if mean.walked_ns >= bounds.learns_force_ns:
        wrong = not -bounds.less_mps2 <= off_mps2 <= bounds.more_mps2
    else:
        wrong = not -bounds.less_at_first_mps2 <= size_mps2 - G_MPS2 <= bounds.more_at_first_mps2
    if wrong:
        mean.known, mean.ns = False, 0
        return greater(1e-3, size_mps2)
    if rate_radps > bounds.walks_radps:
        mean.walked_ns += block_ns
        mean.usual_mps2 += block_s / bounds.usual_force_s * off_mps2
    return 0.0


def turn(a: Vec, p: float, q: float, r: float) -> None:
    """Turn what stands still (3,) in a sensor that turns by these angles (rad); to the 2nd order."""
    pq, qr, rp, pp, qq, rr = 0.5 * p * q, 0.5 * q * r, 0.5 * r * p, 0.5 * p * p, 0.5 * q * q, 0.5 * r * r
    u, v, w = a[0], a[1], a[2]
    a[0] = (1.0 - qq - rr) * u + (pq + r) * v + (rp - q) * w
    a[1] = (pq - r) * u + (1.0 - rr - pp) * v + (qr + p) * w
    a[2] = (rp + q) * u + (qr - p) * v + (1.0 - pp - qq) * w


# --- an axis that is still --------------------------------------------------------------------------------------------
# In a sound sensor no axis is still for long while the others move, in stance as in swing: as long as the foot rests
# all do. How long is a person's own; ways are counted in usual ranges, so that no axis and no speed counts for more.


def restart_still(still: Record) -> None:
    """Look at a stretch of its own from now on; what is usual stays. Nothing is learnt of the first stretch."""
    still.hops = still.means = still.ns = 0
    still.at_known = False
    for axis in range(6):
        still.since[axis], still.until[axis] = math.inf, still.gone + still.may_go[axis]


def still_axis(core: Record, x: float, y: float, z: float, p: float, q: float, r: float, block_ns: int) -> int:
    """Take in means of force and rate; the number of an axis that is stuck, -1 for none.

    Such is one while which all axes go farther than ever before while it was still, or one that a stride hardly moves.
    """
    still, now, low, high = core.still, core.still.latest, core.still.now_low, core.still.now_high
    now[0], now[1], now[2], now[3], now[4], now[5] = x, y, z, p, q, r
    for axis in range(6):
        if not still.means or now[axis] < low[axis]:
            low[axis] = now[axis]
        if not still.means or now[axis] > high[axis]:
            high[axis] = now[axis]
    still.means += 1
    still.ns += block_ns
    stuck = hop(core) if still.ns >= core.bounds.hop_ns else -1
    if not (still.usual_known and still.at_known):
        still.at_known = True
        for axis in range(6):
            still.at[axis] = now[axis]
        return -1
    gone, moves = still.gone, False
    for axis in range(6):
        still.moved[axis] = abs(now[axis] - still.at[axis]) > still.least[axis]
        if still.moved[axis]:
            moves = True
        elif gone > still.until[axis]:
            stuck = axis
    if stuck >= 0:
        restart_still(still)  # its stretch is none to learn from; told anew when it goes on
    elif moves:
        move(still)
    return int(stuck)


def move(still: Record) -> None:
    """Count how far the axes that have moved have gone, and for each how far all had while it was still."""
    before = still.gone
    for axis in range(6):
        if still.moved[axis]:
            share = abs(still.latest[axis] - still.at[axis]) / still.usual[axis]
            still.gone += share if share < 1.0 else 1.0
            still.at[axis] = still.latest[axis]
    for axis in range(6):
        if still.moved[axis]:
            still.farthest[axis] = greater(still.farthest[axis], before - still.since[axis])
            still.since[axis], still.until[axis] = still.gone, still.gone + still.may_go[axis]


def hop(core: Record) -> int:
    """What an axis goes through in a stride is learnt while most move; one that then hardly moves is stuck."""
    still, bounds, ranges, ranked = core.still, core.bounds, core.still.ranges, core.still.ranked
    at = 6 * (still.hops % HOPS)
    for axis in range(6):
        still.low[at + axis], still.high[at + axis] = still.now_low[axis], still.now_high[axis]
    still.hops += 1
    still.means = still.ns = 0
    if still.hops < HOPS:
        return -1
    for axis in range(6):
        low, high = still.low[axis], still.high[axis]
        for k in range(axis + 6, 6 * HOPS, 6):
            low, high = -greater(-low, -still.low[k]), greater(high, still.high[k])
        ranges[axis] = high - low
    if not still.usual_known:
        least_moves = greater(greater(ranges[0], ranges[1]), ranges[2]) <= bounds.moves_mps2
        if least_moves or greater(greater(ranges[3], ranges[4]), ranges[5]) <= bounds.moves_radps:
            return -1
        still.usual_known = True
        for axis in range(6):
            still.usual[axis] = greater(ranges[axis], 1e-6)
    for axis in range(6):
        share, k = ranges[axis] / still.usual[axis], axis
        while k > 0 and ranked[k - 1] > share:
            ranked[k] = ranked[k - 1]
            k -= 1
        ranked[k] = share
    middle = 0.5 * (ranked[2] + ranked[3])
    if middle > bounds.others_move:
        if still.hops_known >= bounds.usual_hops and ranked[0] < bounds.least_share * middle:
            axis = 0
            while ranges[axis] / still.usual[axis] != ranked[0]:
                axis += 1
            return axis
        still.hops_known += 1
        for axis in range(6):
            still.usual[axis] += bounds.follow * (ranges[axis] - still.usual[axis])
    rarely = bounds.still_sum if still.gone > bounds.known_sum else bounds.still_sum_at_first
    for axis in range(6):
        usual, least = still.usual[axis], bounds.least_mps2 if axis < 3 else bounds.least_radps
        still.least[axis] = greater(bounds.move_share * usual, least)
        way = bounds.most_still * greater(rarely, still.farthest[axis])
        still.may_go[axis] = way if usual >= bounds.lives * least else math.inf
    return -1


def square(a: Vec, first: int) -> float:
    """Of the size of (3,) numbers from the ``first`` on."""
    x, y, z = a[first], a[first + 1], a[first + 2]
    return float(x * x + y * y + z * z)


def apart(a: Vec, b: Vec, most: float) -> bool:
    """Whether they differ by more than this along any axis."""
    return bool(abs(a[0] - b[0]) > most or abs(a[1] - b[1]) > most or abs(a[2] - b[2]) > most)


def greater(a: float, b: float) -> float:
    """The greater one; the first where the second is no number."""
    return b if b > a else a


# Compiled here and not by a decorator, for the mutation test passes over functions that have one.
_ALL = (
    coherent, forget_person, restart, clear_block, repeat, at_band, frozen, contradicted, begin_means, dead,
    scaled, misfit, turn, restart_still, still_axis, move, hop, square, apart, greater,
)  # fmt: skip
globals().update({each.__name__: jit_ieee(each) for each in _ALL})
