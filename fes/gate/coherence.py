"""Do a sensor's accelerometer and gyroscope tell of the same movement? Each is held against the other, axis by axis.

A triad that repeats itself, or says nothing but noise, or is scaled, has numbers that could each be true. Together they
cannot: where a sensor turns, gravity turns in it; where force changes, something turns; and from one rest of a foot to
the next the force, turned along with the gyroscope, adds up to gravity and no more. Samples are judged by means of
some 15 ms, which noise hardly moves. Every bound was held against all real recordings, and virtual walks
(``benchmarks/safety/coherence.py``, docs/safety.md).
"""

import math
from typing import Final

from fes.signals import G_MPS2, NS_PER_S, ImuSample, Vector3

BLOCK_NS: Final = 14_500_000  # a mean over at least this long: two samples at 100 Hz, eight at 500 Hz
MOST_STEP_NS: Final = 40_000_000  # between two samples; what a longer gap hides cannot be added up
SAME_NS: Final = 60_000_000  # bit-equal while the other triad lives; real and virtual triads: 40 ms at most
SAME_AXIS_NS: Final = 100_000_000  # one axis bit-equal while the sensor moves; real: 20 ms
LIVED: Final = 50  # samples that differed: an axis that never did is none of this sensor's
FULL_SCALE_SHARE: Final = 0.98  # of the triad's greatest value: an axis there may be clipped
TURNS_RADPS: Final = 0.3  # slower, a zero that is off adds up to a turn in time
FORCE_MOVED_MPS2: Final = 1.0  # along an axis
RATE_MOVED_RADPS: Final = 0.25  # about an axis
# of gravity's own way through the sensor while no axis moved: a turn of 1 rad; real: 6.4
MOST_UNSEEN_MPS2: Final = 10.0
MOST_UNSEEN_AXIS_MPS2: Final = 18.0  # likewise along one axis; real: 10.5
MOST_UNTURNED: Final = 24  # moves of the force without one of the rate; real: 12
JOLT_MPS2: Final = 2.0  # from one mean to the next: every contact with the ground
MOST_SMOOTH_RAD: Final = 4.0  # turned without a jolt; real: 2.7
RESTS_RADPS: Final = 0.6
STEADY_MPS2: Final = 0.7  # along an axis, from the mean of the rest
REST_NS: Final = 80_000_000
LONG_REST_NS, STILL_RADPS = 200_000_000, 0.3  # and no faster all the while: a slow swing comes down as evenly
GRAVITY_OFF_MPS2: Final = 1.6  # in a long rest; real: 0.62, a virtual foot that drags to its stop: 1.2
LEAST_TURN_RAD: Final = 1.0  # between two rests: a swing lies between them
SHORTEST_NS: Final = 8 * NS_PER_S // 10
LONGEST_NS: Final = 5 * NS_PER_S // 2  # between two rests: what is added up for longer drifts
EXCESS_MPS2: Final = 1.6  # of a stride's mean vertical force over gravity; real: 0.71
FORCE_MEAN_S: Final = 0.6  # twice, one mean after the other: a stride's own forces are gone by then
MEANS_NS: Final = 3 * NS_PER_S  # before the mean force counts
MORE_MPS2: Final = 1.3  # than usual here, of the mean force; real: 0.99
LESS_MPS2: Final = 1.6  # likewise; real: 1.28
MORE_AT_FIRST_MPS2: Final = 1.5  # than gravity, until what is usual is known; real: 1.1
LESS_AT_FIRST_MPS2: Final = 2.2  # likewise; real: 1.8
WALKS_RADPS: Final = 0.5
LEARNS_FORCE_NS: Final = 6 * NS_PER_S  # before the usual mean force counts as known (at 3 s, real: 1.57 less) …
USUAL_FORCE_S: Final = 10.0  # … and over how long it is the mean
HOP_NS: Final = 250_000_000
HOPS: Final = 5  # 1.25 s: a stride of most
FOLLOW: Final = 0.05  # a hop's share in an axis' usual range
MOVES_MPS2, MOVES_RADPS = 4.0, 1.5  # the usual range begins with the first that somebody moves by
OTHERS_MOVE: Final = 0.5  # of their usual range, in the middle of all axes
USUAL_HOPS: Final = 12  # before an axis' usual range counts as known
LEAST_SHARE: Final = 0.07  # of an axis' usual range against the other axes' share; real: 0.139, simulated turns 0.105
MOVE_SHARE: Final = 0.02  # of its usual range: by that, and …
LEAST: Final = (0.3, 0.3, 0.3, 0.07, 0.07, 0.07)  # … by so much at least (m/s², rad/s), an axis has moved
LIVES: Final = 3.0  # times the least: an axis that is used to less is not judged
MOST_STILL: Final = 2.8  # times as far as before all axes may go, in usual ranges, while one is still; real: 2.1
STILL_SUM: Final = 4.0  # as far as that counts as before, however seldom it is still …
STILL_SUM_AT_FIRST, KNOWN_SUM = 12.0, 120.0  # … and until they have gone six strides' way
FORGET_NS: Final = 2 * NS_PER_S  # a longer silence: it may have been put on anew
NO_RATE: Final = (0.0, 0.0, 0.0)  # what some gyroscopes show below their dead band, whatever their noise
NONE_SAME: Final = (False, False, False)
Turn = tuple[Vector3, Vector3, Vector3]
Six = tuple[float, float, float, float, float, float]
_AXES: Final = tuple(f"{triad}'s {axis} axis" for triad in ("accelerometer", "gyroscope") for axis in "xyz")


class Coherence:
    """One sensor's two triads against each other; what does not fit is told once, and anew when it goes on.

    Args:
        sensor: its name.
    """

    def __init__(self, sensor: str) -> None:
        self._sensor = sensor
        self.not_ready = ""  # while a triad is frozen
        self._t_ns = 0
        self._force_repeats, self._rate_repeats = _Repeats(), _Repeats()
        self._band_force: Vector3 | None = None  # when the rate became exactly 0
        self._stillness, self._mean_force = Stillness(), MeanForce()
        self._restart()

    def fault(self, sample: ImuSample) -> str:
        """Take in a sample; in words how the two contradict each other, "" when they do not."""
        step_ns = sample.t_sensor_ns - self._t_ns
        if -MOST_STEP_NS < step_ns <= 0:
            return ""  # a slip is counted elsewhere
        self._t_ns = sample.t_sensor_ns
        if not 0 < step_ns <= MOST_STEP_NS:
            if not 0 < step_ns <= FORGET_NS:
                self._stillness, self._mean_force = Stillness(), MeanForce()
            self._restart()
            return ""
        (x, y, z), (p, q, r) = sample.acc_mps2, sample.gyr_radps
        force_repeats = self._force_repeats.observe(sample.acc_mps2, step_ns)
        rate_repeats = self._rate_repeats.observe(sample.gyr_radps, step_ns)
        if sample.gyr_radps != NO_RATE:
            self._band_force = None
        elif self._band_force is None:
            self._band_force = sample.acc_mps2
        elif not (self._force_repeats.ns or _apart(sample.acc_mps2, self._band_force, FORCE_MOVED_MPS2)):
            self._rate_repeats.ns = 0  # a gyroscope with a dead band, at rest: it counts from the first movement on
        if force_repeats or rate_repeats:
            if frozen := self._frozen(sample, step_ns):
                return frozen
        elif self.not_ready:
            self.not_ready = ""
        self._x += x
        self._y += y
        self._z += z
        self._p += p
        self._q += q
        self._r += r
        self._samples += 1
        self._block_ns += step_ns
        return self._judge() if self._block_ns >= BLOCK_NS else ""

    def _frozen(self, sample: ImuSample, step_ns: int) -> str:
        """Says so when a triad repeats itself while the other does not, or an axis while the sensor moves."""
        force, rate = self._force_repeats, self._rate_repeats
        frozen = "accelerometer" if force.ns >= SAME_NS > rate.ns else ""
        frozen = "gyroscope" if rate.ns >= SAME_NS > force.ns else frozen
        self.not_ready = f"{self._sensor}'s {frozen} is frozen: the same values, the other's change" if frozen else ""
        if frozen:
            return self.not_ready
        (x, y, z), (p, q, r) = sample.acc_mps2, sample.gyr_radps
        moves = abs(x * x + y * y + z * z - G_MPS2 * G_MPS2) > 2.0 * G_MPS2 or p * p + q * q + r * r > RESTS_RADPS**2
        if moves:
            for first, repeats in ((0, force), (3, rate)):
                if (axis := repeats.stuck(step_ns)) >= 0:
                    return f"{self._sensor}'s {_AXES[first + axis]} is frozen: the same value, the others' change"
        return ""

    def _restart(self) -> None:
        """Begin as if nothing had come before."""
        self._clear_block()
        self._stillness.restart()
        self._mean_force.restart()
        self._before: Vector3 | None = None  # the last mean force
        self._resting_ns = self._still_ns = 0
        self._up: Vector3 | None = None  # gravity's way up, turned along since the last rest
        self._upward_mps = self._turned_rad = 0.0  # since that rest: speed gained upward, and turned
        self._since_rest_ns = 0

    def _clear_block(self) -> None:
        self._x = self._y = self._z = self._p = self._q = self._r = 0.0
        self._samples = self._block_ns = 0

    def _judge(self) -> str:
        share, block_ns = 1.0 / self._samples, self._block_ns
        x, y, z = share * self._x, share * self._y, share * self._z
        p, q, r = share * self._p, share * self._q, share * self._r
        self._clear_block()
        force_mps2, rate_radps = math.sqrt(x * x + y * y + z * z), math.sqrt(p * p + q * q + r * r)
        if not force_mps2 + rate_radps < math.inf:  # a fault of its own; sums would never forget it
            self._restart()
            return ""
        before = self._before
        self._before = (x, y, z)
        if before is None:
            self._force, self._rate = (x, y, z), (p, q, r)
            self._axis_force = [x, y, z]
            self._unseen_mps2, self._axis_unseen_mps2 = 0.0, [0.0, 0.0, 0.0]
            self._unturned, self._smooth_rad = 0, 0.0
            return ""
        block_s = 1e-9 * block_ns
        if rate_radps > TURNS_RADPS:
            # how far gravity went through the sensor, were the force all of it
            way = G_MPS2 * block_s / max(force_mps2, 2.0)
            along_x, along_y, along_z = way * abs(y * r - z * q), way * abs(z * p - x * r), way * abs(x * q - y * p)
            unseen = self._axis_unseen_mps2
            unseen[0] += along_x
            unseen[1] += along_y
            unseen[2] += along_z
            self._unseen_mps2 += math.sqrt(along_x * along_x + along_y * along_y + along_z * along_z)
            self._smooth_rad += rate_radps * block_s
        jolt_x, jolt_y, jolt_z = x - before[0], y - before[1], z - before[2]
        if jolt_x * jolt_x + jolt_y * jolt_y + jolt_z * jolt_z > JOLT_MPS2 * JOLT_MPS2:
            self._smooth_rad = 0.0
        if (axis := self._stillness.stuck((x, y, z, p, q, r), block_ns)) >= 0:
            return f"{self._sensor} moves as ever, but its {_AXES[axis]} does not feel it: stuck?"
        turn = turn_of((p, q, r), block_s)
        if felt_mps2 := self._mean_force.wrong((x, y, z), turn, rate_radps, block_ns):
            felt = f"{felt_mps2:.1f} m/s² of gravity"
            fault = f"{self._sensor}'s force and turn do not fit: {felt}: an axis stuck, scaled, its unit?"
        else:
            fault = self._dead((x, y, z), (p, q, r)) or self._gravity((x, y, z), turn, rate_radps, block_ns)
        if fault:
            self._stillness.restart()  # what lies is nothing to learn from
        return fault

    def _dead(self, force: Vector3, rate: Vector3) -> str:
        """Says so when one triad says nothing of what the other tells, or both nothing of the ground."""
        moved = _apart(force, self._force, FORCE_MOVED_MPS2)
        if moved:
            self._force, self._unseen_mps2 = force, 0.0
            self._unturned += 1
        if _apart(rate, self._rate, RATE_MOVED_RADPS):
            self._rate, self._unturned = rate, 0
        sensor, unseen, stuck = self._sensor, self._axis_unseen_mps2, -1
        for axis, (now, then) in enumerate(zip(force, self._axis_force, strict=True)):
            if not -FORCE_MOVED_MPS2 <= now - then <= FORCE_MOVED_MPS2:
                self._axis_force[axis], unseen[axis] = now, 0.0
            elif unseen[axis] > MOST_UNSEEN_AXIS_MPS2:
                unseen[axis], stuck = 0.0, axis
        if self._unseen_mps2 > MOST_UNSEEN_MPS2:
            self._unseen_mps2 = 0.0
            return f"{sensor} turns, but its accelerometer does not feel it: dead, or the gyroscope stuck?"
        if self._unturned > MOST_UNTURNED:
            self._unturned = 0
            return f"{sensor} is moved, but its gyroscope does not feel it: dead, or the accelerometer wrong?"
        if self._smooth_rad > MOST_SMOOTH_RAD:
            self._smooth_rad = 0.0
            return f"{sensor} turns and turns without ever touching the ground: does it dangle?"
        return f"{sensor} turns, but its {_AXES[stuck]} does not feel it: stuck?" if stuck >= 0 else ""

    def _gravity(self, force: Vector3, turn: Turn, rate_radps: float, block_ns: int) -> str:
        """Says so when the force at rest is not gravity, or from one rest to the next adds up to more."""
        if self._up is not None:
            self._turn_along(self._up, force, turn, rate_radps, 1e-9 * block_ns)
            self._since_rest_ns += block_ns
            if self._since_rest_ns > LONGEST_NS:
                self._up = None
        x, y, z = force
        self._still_ns = self._still_ns + block_ns if rate_radps < STILL_RADPS else 0
        resting_ns, self._resting_ns = self._resting_ns, 0
        if rate_radps >= RESTS_RADPS:
            return ""
        if resting_ns == 0:
            self._rest_x, self._rest_y, self._rest_z, self._rests = x, y, z, 1
            self._resting_ns = block_ns
            return ""
        share = 1.0 / self._rests
        mean = (share * self._rest_x, share * self._rest_y, share * self._rest_z)
        if _apart(force, mean, STEADY_MPS2):
            return ""
        self._rest_x, self._rest_y, self._rest_z = self._rest_x + x, self._rest_y + y, self._rest_z + z
        self._rests += 1
        self._resting_ns = resting_ns + block_ns
        return self._rested(mean) if self._resting_ns >= REST_NS else ""

    def _turn_along(self, up: Vector3, force: Vector3, turn: Turn, rate_radps: float, block_s: float) -> None:
        """Turn gravity with the sensor, and add up what of the force is more than gravity along it."""
        (a, b, c), (d, e, f), (g, h, i) = turn
        u, v, w = up
        u, v, w = a * u + b * v + c * w, d * u + e * v + f * w, g * u + h * v + i * w
        share = 1.0 / math.sqrt(u * u + v * v + w * w)
        u, v, w = share * u, share * v, share * w
        along = force[0] * (u + up[0]) + force[1] * (v + up[1]) + force[2] * (w + up[2])
        self._upward_mps += block_s * (0.5 * along - G_MPS2)
        self._turned_rad += block_s * rate_radps
        self._up = (u, v, w)

    def _rested(self, mean: Vector3) -> str:
        size_mps2 = _size(mean)
        fault = ""
        if self._up is not None and self._turned_rad > LEAST_TURN_RAD:
            excess_mps2 = self._upward_mps / (1e-9 * max(self._since_rest_ns, SHORTEST_NS))
            if excess_mps2 > EXCESS_MPS2:
                felt = f"{G_MPS2 + excess_mps2:.1f} m/s² of gravity in a stride"
                fault = f"{self._sensor}'s force and turn do not fit: {felt}: an axis stuck, scaled, its unit?"
        elif min(self._resting_ns, self._still_ns) > LONG_REST_NS and abs(size_mps2 - G_MPS2) > GRAVITY_OFF_MPS2:
            fault = f"{self._sensor} feels {size_mps2:.1f} m/s² at rest, gravity is 9.8: is it scaled?"
        if size_mps2 > 0.0:
            self._up = (mean[0] / size_mps2, mean[1] / size_mps2, mean[2] / size_mps2)
            self._upward_mps = self._turned_rad = 0.0
            self._since_rest_ns = 0
        return fault


class _Repeats:
    """How long a triad, and each of its axes, has repeated itself to the bit."""

    def __init__(self) -> None:
        self.ns = 0  # so long all three axes have
        self._values: Vector3 = (math.nan, math.nan, math.nan)
        self._ns = [0, 0, 0]  # so long an axis has while the sensor moved
        self._same = NONE_SAME  # which do now
        self._all_lived = 0  # samples in which all axes differed …
        self._lived = [0, 0, 0]  # … and those in which only some did
        self._greatest = 0.0

    def observe(self, values: Vector3, step_ns: int) -> bool:
        """Whether any axis does, with these values a step later."""
        (x, y, z), (a, b, c), most = values, self._values, self._greatest
        self._values = values
        if not (-most <= x <= most and -most <= y <= most and -most <= z <= most):
            self._greatest = max(most, abs(x), abs(y), abs(z))
        if x != a and y != b and z != c:
            self._all_lived += 1
            if self._same != NONE_SAME:
                self._same, self.ns, self._ns = NONE_SAME, 0, [0, 0, 0]
            return False
        self._same = x == a, y == b, z == c
        self.ns = self.ns + step_ns if all(self._same) else 0
        for axis, same in enumerate(self._same):
            if not same:
                self._ns[axis] = 0
                self._lived[axis] += 1
        return True

    def stuck(self, step_ns: int) -> int:
        """The number of an axis that has for too long while the sensor moved, -1 for none: of the values just taken."""
        for axis, same in enumerate(self._same):
            lived = self._all_lived + self._lived[axis] > LIVED
            if same and lived and abs(self._values[axis]) < FULL_SCALE_SHARE * self._greatest:
                self._ns[axis] += step_ns
                if self._ns[axis] >= SAME_AXIS_NS:
                    self._ns[axis] = 0
                    return axis
        return -1


class MeanForce:
    """The mean force, turned along with the gyroscope: gravity and no more, for whoever walks ends as fast as he began.

    A force that is scaled changes its size; a rate that is scaled, or an axis of either that is stuck, turns the mean
    where the force does not go, and it shrinks, or grows where the force of a swing is taken for another direction's.
    """

    def __init__(self) -> None:
        self._usual_mps2, self._walked_ns = G_MPS2, 0
        self.restart()

    def restart(self) -> None:
        """Begin with the next force; what is usual stays."""
        self._once: Vector3 | None = None
        self._ns = 0

    def wrong(self, force: Vector3, turn: Turn, rate_radps: float, block_ns: int) -> float:
        """Take in means of a block; how large the mean force is (m/s²) when it cannot be so, else 0."""
        block_s = 1e-9 * block_ns
        share, (x, y, z) = block_s / FORCE_MEAN_S, force
        if self._once is None:
            size = self._usual_mps2 / max(_size(force), 1e-6)
            self._once = self._twice = (size * x, size * y, size * z)
        (a, b, c), (d, e, f), (g, h, i) = turn
        u, v, w = self._once
        u, v, w = a * u + b * v + c * w, d * u + e * v + f * w, g * u + h * v + i * w
        self._once = u, v, w = u + share * (x - u), v + share * (y - v), w + share * (z - w)
        x, y, z = self._twice
        x, y, z = a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z
        self._twice = x, y, z = x + share * (u - x), y + share * (v - y), z + share * (w - z)
        self._ns += block_ns
        if self._ns < MEANS_NS:
            return 0.0
        size_mps2 = math.sqrt(x * x + y * y + z * z)
        off_mps2 = size_mps2 - self._usual_mps2
        known = self._walked_ns >= LEARNS_FORCE_NS
        if known:
            wrong = not -LESS_MPS2 <= off_mps2 <= MORE_MPS2
        else:
            wrong = not -LESS_AT_FIRST_MPS2 <= size_mps2 - G_MPS2 <= MORE_AT_FIRST_MPS2
        if wrong:
            self.restart()
            return max(size_mps2, 1e-3)
        if rate_radps > WALKS_RADPS:
            self._walked_ns += block_ns
            self._usual_mps2 += block_s / USUAL_FORCE_S * off_mps2
        return 0.0


class Stillness:
    """How far the other axes go while one is still, against the farthest that they have gone so before.

    In a sound sensor no axis is still for long while the others move, in stance as in swing: as long as the foot rests
    all do. How long is a person's own; ways are counted in usual ranges, so that no axis and no speed counts for more.
    """

    def __init__(self) -> None:
        self._usual: list[float] = []
        self._least = list(LEAST)
        self._known = 0  # hops in which the usual ranges were learnt
        self._farthest = [0.0] * 6
        self._gone = 0.0  # by all axes so far
        self._may_go = [math.inf] * 6  # while an axis is still
        self.restart()

    def restart(self) -> None:
        """Look at a stretch of its own from now on; what is usual stays."""
        self._hops: list[tuple[list[float], list[float]]] = []
        self._means: list[Six] = []
        self._ns = 0
        self._at: list[float] = []  # each axis where it last moved to, …
        self._since = [math.inf] * 6  # … and how far all had gone then; nothing is learnt of the first stretch …
        self._until = [self._gone + way for way in self._may_go]  # … and how far they may go

    def stuck(self, means: Six, block_ns: int) -> int:
        """Take in means of force and rate; the number of an axis that is stuck, -1 for none."""
        self._means.append(means)
        self._ns += block_ns
        stuck = self._hop() if self._ns >= HOP_NS else -1
        if not self._usual or not self._at:
            self._at = list(means)
            return -1
        at, until, gone, moved = self._at, self._until, self._gone, []
        axis = 0
        for now, then, least in zip(means, at, self._least, strict=True):
            if now - then > least or then - now > least:
                moved.append(axis)
            elif gone > until[axis]:
                stuck = axis
            axis += 1  # noqa: SIM113 - enumerate takes a tenth longer
        if stuck >= 0:
            self.restart()  # its stretch is none to learn from; told anew when it goes on
        elif moved:
            self._move(moved, means)
        return stuck

    def _move(self, moved: list[int], means: Six) -> None:
        before = gone = self._gone
        at, usual, since, until, may_go = self._at, self._usual, self._since, self._until, self._may_go
        for axis in moved:
            now = means[axis]
            share = abs(now - at[axis]) / usual[axis]
            gone += share if share < 1.0 else 1.0
            at[axis] = now
        self._gone = gone
        for axis in moved:
            if before - since[axis] > self._farthest[axis]:
                self._farthest[axis] = before - since[axis]
            since[axis], until[axis] = gone, gone + may_go[axis]

    def _hop(self) -> int:
        """What an axis goes through in a stride is learnt while most move; one that then hardly moves is stuck."""
        axes = list(zip(*self._means, strict=True))
        self._hops = [*self._hops[1 - HOPS :], ([*map(min, axes)], [*map(max, axes)])]
        self._means, self._ns = [], 0
        if len(self._hops) < HOPS:
            return -1
        least, most = zip(*self._hops, strict=True)
        ranges = [high - low for high, low in zip(map(max, *most), map(min, *least), strict=True)]
        if not self._usual:
            if max(ranges[:3]) <= MOVES_MPS2 or max(ranges[3:]) <= MOVES_RADPS:
                return -1
            self._usual = [max(each, 1e-6) for each in ranges]
        shares = [now / usual for now, usual in zip(ranges, self._usual, strict=True)]
        ranked = sorted(shares)
        middle = 0.5 * (ranked[2] + ranked[3])
        if middle > OTHERS_MOVE:
            if self._known >= USUAL_HOPS and ranked[0] < LEAST_SHARE * middle:
                return shares.index(ranked[0])
            self._known += 1
            self._usual = [usual + FOLLOW * (now - usual) for now, usual in zip(ranges, self._usual, strict=True)]
        self._least = [max(MOVE_SHARE * usual, least) for usual, least in zip(self._usual, LEAST, strict=True)]
        rarely = STILL_SUM if self._gone > KNOWN_SUM else STILL_SUM_AT_FIRST
        self._may_go = [
            MOST_STILL * max(way, rarely) if usual >= LIVES * least else math.inf
            for way, usual, least in zip(self._farthest, self._usual, LEAST, strict=True)
        ]
        return -1


def turn_of(rate: Vector3, block_s: float) -> Turn:
    """Rows (3, 3) that turn what stands still, in a sensor that turns at ``rate`` (rad/s); to the angle's 2nd order."""
    p, q, r = block_s * rate[0], block_s * rate[1], block_s * rate[2]
    pq, qr, rp, pp, qq, rr = 0.5 * p * q, 0.5 * q * r, 0.5 * r * p, 0.5 * p * p, 0.5 * q * q, 0.5 * r * r
    return (1.0 - qq - rr, pq + r, rp - q), (pq - r, 1.0 - rr - pp, qr + p), (rp + q, qr - p, 1.0 - pp - qq)


def _size(a: Vector3) -> float:
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def _apart(a: Vector3, b: Vector3, most: float) -> bool:
    """Whether they differ by more than this along any axis."""
    return abs(a[0] - b[0]) > most or abs(a[1] - b[1]) > most or abs(a[2] - b[2]) > most
