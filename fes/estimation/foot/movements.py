"""Movements in a recording, before anything is known of phases: where one begins and ends, and where it leads."""

import math
from typing import Any

import numpy as np

from fes.estimation.numerics.filters import solve
from fes.estimation.numerics.jit import inlined, jit, jit_ieee
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import axes_in_world, from_gravity, to_sensor, to_world, turn_by, up_in_sensor
from fes.signals import G_MPS2, FloatArray, IntArray

BACK = 0.3  # share of the tilt found at a movement's end that is taken back where no way is sought

# What a movement shows. ``turn``: the quaternion by which it turns the sensor, its tilt left as it is. ``way``: where
# it leads (m), in the sensor frame of its beginning, with all of the tilt taken back, and with the smallest constant
# and steadily growing bias of the force that ends it at rest and as high as it began. ``left``: what plain integration
# leaves over at the end, vertical velocity and height; ``effect``: what a constant bias of the force does to each.
# ``lively``: the sum of how far the force's size is from gravity's.
MOVED = np.dtype(
    [("turn", "f8", 4), ("way", "f8", 3), ("left", "f8", 2), ("effect", "f8", (2, 3)), ("lively", "f8")]
)  # fmt: skip


@jit
def _mean_force(acc: Any, begin: int, end: int) -> tuple[float, float, float]:
    """Mean of the rows ``begin`` … ``end - 1``, as far as there are such rows."""
    begin, end = max(begin, 0), min(end, acc.shape[0])
    x = y = z = 0.0
    for i in range(begin, end):
        x += acc[i, 0]
        y += acc[i, 1]
        z += acc[i, 2]
    return x / (end - begin), y / (end - begin), z / (end - begin)


def follow(t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: IntArray) -> np.ndarray[Any, np.dtype[Any]]:
    """What each of K movements (K, 2) shows, as :data:`MOVED` (K,)."""
    out = np.empty((len(spans), MOVED.itemsize // 8))
    _follow(*_whole(t_ns, acc, gyr, spans), out)
    return out.view(MOVED)[:, 0]


def contact_jumps(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: IntArray, turns: FloatArray, after: FloatArray, lag: int
) -> FloatArray:
    """Greatest change of the vertical force over ``lag`` samples, or half that of the whole force where that is more,
    (K,) in each movement (K, 2) once ``after`` (N,) has been least, NaN where that is too short; ``turns`` (K, 4) are
    those by which the movements turn the sensor."""
    out = np.empty(len(spans))
    _contact_jumps(*_whole(t_ns, acc, gyr, spans), np.ascontiguousarray(turns), after, lag, out)
    return out


def closures(t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: IntArray) -> tuple[FloatArray, FloatArray]:
    """By which turn (K, 3) in rad gravity at each movement's end misses gravity at its start, in the sensor frame of
    the start, and what a bias of the gyroscope does to it, (K, 3, 3) in s."""
    missed, effect = np.empty((len(spans), 3)), np.empty((len(spans), 3, 3))
    _closures(*_whole(t_ns, acc, gyr, spans), missed, effect)
    return missed, effect


def _whole(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: IntArray
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """As the compiled code knows them: C-contiguous."""
    contiguous = np.ascontiguousarray
    return contiguous(t_ns), contiguous(acc), contiguous(gyr), contiguous(spans)


@jit_ieee
def peaks_before(x: Vec, at: Vec, reach: int) -> Vec:
    """Where ``x`` (N,) is greatest within the ``reach`` samples that end with each of some (K,)."""
    peaks = np.empty(len(at), np.int64)
    for k in range(len(at)):
        best = max(at[k] - reach + 1, 0)
        for row in range(best, at[k] + 1):
            if x[row] > x[best]:
                best = row
        peaks[k] = best
    return peaks


@jit_ieee
def quiet_ends(push_offs: Vec, mids: Vec, unrest: Vec, gaps: Vec, reach: int, farther: float, shortest: float) -> Vec:
    """The spans (K, 2) of the swings that have one; what lies ``farther`` off has to be half as restless."""
    spans = np.empty((len(mids), 2), np.int64)
    found = 0
    for k in range(len(mids)):
        begin = max(mids[k - 1] if k else 0, push_offs[k] - reach)
        end = min(push_offs[k + 1] if k + 1 < len(mids) else len(unrest), mids[k] + reach)
        if push_offs[k] - begin < 2 or end - mids[k] < 2:
            continue
        first = last = -1
        least_first = least_last = np.inf
        for back in range(push_offs[k] - begin):
            weighted = unrest[push_offs[k] - 1 - back] * (1.0 + (back / farther) ** 2)
            if weighted < least_first:
                least_first, first = weighted, push_offs[k] - 1 - back
        for ahead in range(end - mids[k]):
            weighted = unrest[mids[k] + ahead] * (1.0 + (ahead / farther) ** 2)
            if weighted < least_last:
                least_last, last = weighted, mids[k] + ahead
        whole = first > 0 and last < len(unrest) - 1  # not cut off by the recording's end
        if whole and shortest <= last - first and gaps[first] == gaps[last]:
            spans[found, 0], spans[found, 1] = first, last
            found += 1
    return spans[:found]


@jit_ieee
def _upright(
    acc: Any, first: int, last: int, qw: float, qx: float, qy: float, qz: float
) -> tuple[float, float, float, float, float, float]:
    """The orientation at a movement's start as gravity says there, and by which turn about x and y of the world (rad)
    its end, to which ``q`` turns the sensor from its start, then is not upright."""
    around = max((last - first) // 50, 1)
    x, y, z = _mean_force(acc, last - around, last + around + 1)
    x, y, z = to_world(qw, qx, qy, qz, x, y, z)
    qw, qx, qy, qz = from_gravity(*_mean_force(acc, first - around, first + around + 1))
    x, y, z = to_world(qw, qx, qy, qz, x, y, z)
    level = math.sqrt(x * x + y * y)
    norm = math.sqrt(x * x + y * y + z * z)
    by = math.atan2(level, z) / level if norm >= 1e-9 and level > 1e-9 * norm else 0.0
    return qw, qx, qy, qz, by * y, -by * x


@inlined
def _turned(
    w: float, x: float, y: float, z: float, rx: float, ry: float, rz: float, dx: float, dy: float
) -> tuple[float, float, float, float]:
    """Turn by the vector ``r`` of the sensor frame and by ``d`` of the world's level plane (rad)."""
    ax, ay = 2.0 * dx, 2.0 * dy  # d in the sensor frame: the shorter way to it, for each turn waits for the one before
    rx = (rx + dx) + ((x * y + w * z) * ay - (y * y + z * z) * ax)
    ry = (ry + dy) + ((x * y - w * z) * ax - (x * x + z * z) * ay)
    rz = rz + ((x * z + w * y) * ax + (y * z - w * x) * ay)
    return turn_by(w, x, y, z, rx, ry, rz)


@jit_ieee
def _follow(t_ns: Any, acc: Any, gyr: Any, spans: Any, out: Any) -> None:
    """Fill the rows of ``out`` with the numbers of :data:`MOVED`, in its order.

    The velocity and the way that trapezoids gain (:mod:`fes.estimation.strides.integration`) are sums of the
    acceleration with a weight for each sample; what a bias does to them, the same sums of the sensor's axes. Two
    orientations run side by side, for each has to wait for its own last value: for the way, and for what is left over.
    """
    axes, force = np.empty((3, 3)), np.empty(3)
    effect, gained, system = np.empty((6, 6)), np.empty(6), np.empty((4, 5))  # rows: velocity x y z, way z x y
    for row in range(spans.shape[0]):
        first, last = spans[row, 0], spans[row, 1]
        qw, qx, qy, qz = 1.0, 0.0, 0.0, 0.0
        for i in range(first + 1, last + 1):
            by = 0.5e-9 * (t_ns[i] - t_ns[i - 1])
            x, y, z = gyr[i - 1, 0] + gyr[i, 0], gyr[i - 1, 1] + gyr[i, 1], gyr[i - 1, 2] + gyr[i, 2]
            qw, qx, qy, qz = turn_by(qw, qx, qy, qz, by * x, by * y, by * z)
        out[row, 0], out[row, 1], out[row, 2], out[row, 3] = qw, qx, qy, qz
        sw, sx, sy, sz, dx, dy = _upright(acc, first, last, qw, qx, qy, qz)
        qw, qx, qy, qz = sw, sx, sy, sz
        pw, px, py, pz = sw, sx, sy, sz
        for j in range(6):
            gained[j] = 0.0
            for k in range(6):
                effect[j, k] = 0.0
        speed = height = vx = vy = vz = hx = hy = hz = 0.0
        lively = since_s = 0.0
        span_s = 1e-9 * (t_ns[last] - t_ns[first])
        for i in range(first, last + 1):
            if i > first:
                since_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
                by, share = 0.5 * since_s, since_s / span_s
                x, y, z = gyr[i - 1, 0] + gyr[i, 0], gyr[i - 1, 1] + gyr[i, 1], gyr[i - 1, 2] + gyr[i, 2]
                x, y, z = by * x, by * y, by * z
                pw, px, py, pz = _turned(pw, px, py, pz, x, y, z, share * dx, share * dy)
                share *= BACK
                qw, qx, qy, qz = _turned(qw, qx, qy, qz, x, y, z, share * dx, share * dy)
            left_s = 1e-9 * (t_ns[last] - t_ns[i])
            then_s = 1e-9 * (t_ns[min(i + 1, last)] - t_ns[i])
            of_speed = 0.5 * (since_s + then_s)
            of_way = 0.5 * (since_s * (left_s + 0.5 * since_s) + then_s * (left_s - 0.5 * then_s))
            tau = 1.0 - 2.0 * left_s / span_s
            fx, fy, fz = acc[i, 0], acc[i, 1], acc[i, 2]
            lively += abs(math.sqrt(fx * fx + fy * fy + fz * fz) - G_MPS2)
            x, y, z = up_in_sensor(qw, qx, qy, qz)
            a = x * fx + y * fy + z * fz - G_MPS2
            speed, vx, vy, vz = speed + of_speed * a, vx + of_speed * x, vy + of_speed * y, vz + of_speed * z
            height, hx, hy, hz = height + of_way * a, hx + of_way * x, hy + of_way * y, hz + of_way * z
            one, two, three = axes_in_world(pw, px, py, pz)
            axes[0, 0], axes[1, 0], axes[2, 0] = one
            axes[0, 1], axes[1, 1], axes[2, 1] = two
            axes[0, 2], axes[1, 2], axes[2, 2] = three
            for j in range(3):
                force[j] = axes[j, 0] * fx + axes[j, 1] * fy + axes[j, 2] * fz
            force[2] -= G_MPS2
            for j in range(3):
                w = 3 + (j + 1) % 3
                gained[j] += of_speed * force[j]
                gained[w] += of_way * force[j]
                for k in range(3):
                    effect[j, k] += of_speed * axes[j, k]
                    effect[j, k + 3] += of_speed * tau * axes[j, k]
                    effect[w, k] += of_way * axes[j, k]
                    effect[w, k + 3] += of_way * tau * axes[j, k]
        x = y = 0.0
        if last - first >= 2 and span_s > 0.0 and _smallest_bias(effect, gained, system):
            x, y = gained[4], gained[5]
        out[row, 4], out[row, 5], out[row, 6] = to_sensor(sw, sx, sy, sz, x, y, 0.0)
        out[row, 7], out[row, 8] = speed, height
        out[row, 9], out[row, 10], out[row, 11], out[row, 12], out[row, 13], out[row, 14] = vx, vy, vz, hx, hy, hz
        out[row, 15] = lively


@jit_ieee
def _smallest_bias(effect: Any, gained: Any, system: Any) -> bool:
    """Take off what was ``gained`` (6,) that of the smallest bias (6,) with which its first four come to nothing;
    ``effect`` (6, 6) is that of a bias. False where there is none."""
    for i in range(4):
        for j in range(4):
            system[i, j] = 0.0
            for k in range(6):
                system[i, j] += effect[i, k] * effect[j, k]
        system[i, 4] = gained[i]
    if not solve(system, 4):
        return False
    for k in range(6):
        bias = 0.0
        for i in range(4):
            bias += effect[i, k] * system[i, 4]
        for j in range(6):
            gained[j] -= effect[j, k] * bias
    return True


@jit_ieee
def _contact_jumps(t_ns: Any, acc: Any, gyr: Any, spans: Any, turns: Any, after: Any, lag: int, out: Any) -> None:
    for k in range(spans.shape[0]):
        first, last = spans[k, 0], spans[k, 1]
        vertical = np.empty(last + 1 - first)
        qw, qx, qy, qz, dx, dy = _upright(acc, first, last, turns[k, 0], turns[k, 1], turns[k, 2], turns[k, 3])
        per_ns = BACK / (t_ns[last] - t_ns[first])
        for i in range(first, last + 1):
            if i > first:
                since_ns = t_ns[i] - t_ns[i - 1]
                by, share = 0.5e-9 * since_ns, per_ns * since_ns
                x, y, z = gyr[i - 1, 0] + gyr[i, 0], gyr[i - 1, 1] + gyr[i, 1], gyr[i - 1, 2] + gyr[i, 2]
                qw, qx, qy, qz = _turned(qw, qx, qy, qz, by * x, by * y, by * z, share * dx, share * dy)
            x, y, z = up_in_sensor(qw, qx, qy, qz)
            vertical[i - first] = x * acc[i, 0] + y * acc[i, 1] + z * acc[i, 2]
        least = first
        for i in range(first + 1, last + 1):
            if after[i] < after[least]:
                least = i
        out[k] = math.nan
        for i in range(least - first + lag, last + 1 - first):
            j = first + i
            x, y, z = acc[j, 0] - acc[j - lag, 0], acc[j, 1] - acc[j - lag, 1], acc[j, 2] - acc[j - lag, 2]
            jump = max(abs(vertical[i] - vertical[i - lag]), 0.5 * math.sqrt(x * x + y * y + z * z))
            if not jump <= out[k]:
                out[k] = jump


@jit_ieee
def _closures(t_ns: Vec, acc: Mat, gyr: Mat, spans: Mat, missed: Mat, effect: Mat) -> None:
    whole = np.empty((3, 3))
    for k in range(spans.shape[0]):
        first, last = spans[k, 0], spans[k, 1]
        qw, qx, qy, qz = 1.0, 0.0, 0.0, 0.0
        for j in range(3):
            for i in range(3):
                whole[j, i] = 0.0
        for i in range(first + 1, last + 1):
            since_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
            by = 0.5 * since_s
            one, two, three = axes_in_world(qw, qx, qy, qz)
            for j in range(3):
                whole[j, 0] += since_s * one[j]
                whole[j, 1] += since_s * two[j]
                whole[j, 2] += since_s * three[j]
            x, y, z = gyr[i - 1, 0] + gyr[i, 0], gyr[i - 1, 1] + gyr[i, 1], gyr[i - 1, 2] + gyr[i, 2]
            qw, qx, qy, qz = turn_by(qw, qx, qy, qz, by * x, by * y, by * z)
        around = max((last - first) // 50, 1)
        ux, uy, uz = _mean_force(acc, first - around, first + around + 1)
        x, y, z = _mean_force(acc, last - around, last + around + 1)
        vx, vy, vz = to_world(qw, qx, qy, qz, x, y, z)
        u = math.sqrt(ux * ux + uy * uy + uz * uz)
        size = u * math.sqrt(vx * vx + vy * vy + vz * vz)
        missed[k, 0], missed[k, 1], missed[k, 2] = (
            (uy * vz - uz * vy) / size, (uz * vx - ux * vz) / size, (ux * vy - uy * vx) / size
        )  # fmt: skip
        ux, uy, uz = ux / u, uy / u, uz / u
        for i in range(3):
            along = ux * whole[0, i] + uy * whole[1, i] + uz * whole[2, i]
            effect[k, 0, i] = whole[0, i] - along * ux
            effect[k, 1, i] = whole[1, i] - along * uy
            effect[k, 2, i] = whole[2, i] - along * uz
