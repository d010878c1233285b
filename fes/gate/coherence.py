"""Do a sensor's accelerometer and gyroscope tell of the same movement? Each is held against the other, axis by axis.

A triad that repeats itself, or says nothing but noise, or is scaled, has numbers that could each be true. Together they
cannot: where a sensor turns, gravity turns in it; where force changes, something turns; and from one rest of a foot to
the next the force, turned along with the gyroscope, adds up to gravity and no more. Samples are judged by means of
some 15 ms, which noise hardly moves. Every bound was held against all real recordings, and virtual walks
(``benchmarks/coherence.py``, docs/safety.md).
"""

import math
from typing import Final

from fes.signals import G_MPS2, NS_PER_S, SHANK_SENSORS, ImuSample, Vector3

BLOCK_NS: Final = 14_500_000  # a mean over at least this long: two samples at 100 Hz, eight at 500 Hz
MOST_STEP_NS: Final = 40_000_000  # between two samples; what a longer gap hides cannot be added up
SAME_NS: Final = 60_000_000  # bit-equal while the other triad lives; real and virtual triads: 40 ms at most
SAME_AXIS_NS: Final = 100_000_000  # one axis bit-equal while the sensor moves; real: 20 ms
LIVED: Final = 50  # samples that differed: an axis that never did is none of this sensor's
FULL_SCALE_SHARE: Final = 0.98  # of the triad's greatest value: an axis there may be clipped
TURNS_RADPS: Final = 0.3  # slower, a zero that is off adds up to a turn in time
FORCE_MOVED_MPS2: Final = 1.0  # along an axis
RATE_MOVED_RADPS: Final = 0.25  # about an axis
MOST_UNSEEN_MPS2: Final = (
    10.0  # of gravity's own way through the sensor while no axis moved: a turn of 1 rad; real: 6.4
)
MOST_UNSEEN_AXIS_MPS2: Final = 18.0  # likewise along one axis; real: 10.5
MOST_UNTURNED: Final = 24  # moves of the force without one of the rate; real: 12
MOST_UNTURNED_AXIS: Final = 100  # without one of this axis' rate, of a foot; real: 51
JOLT_MPS2: Final = 2.0  # from one mean to the next: every contact with the ground
MOST_SMOOTH_RAD: Final = 6.0  # turned without a jolt; real: 2.7
RESTS_RADPS: Final = 0.6
STEADY_MPS2: Final = 0.7  # along an axis, from the mean of the rest
REST_NS: Final = 80_000_000
LONG_REST_NS: Final = 300_000_000
GRAVITY_OFF_MPS2: Final = 1.2  # in a long rest; real: 0.62
LEAST_TURN_RAD: Final = 1.0  # between two rests: a swing lies between them
SHORTEST_NS: Final = 8 * NS_PER_S // 10
LONGEST_NS: Final = 5 * NS_PER_S // 2  # between two rests: what is added up for longer drifts
EXCESS_MPS2: Final = 1.3  # of the mean vertical force over gravity, in two strides in a row; real: 0.5
EXCESS_ONCE_MPS2: Final = 1.6  # in one stride; real: 0.71
LACK_MPS2: Final = 2.2  # below gravity, in two strides in a row; real: 1.9
LACK_ONCE_MPS2: Final = 4.0  # below gravity: a rest that was none has been seen to lack 2.7
HOP_NS: Final = 250_000_000
HOPS: Final = 5  # 1.25 s: a stride of most
USUAL_HOPS: Final = 12  # before an axis' usual range counts as known …
FOLLOW: Final = 0.05  # … and a hop's share in it
MOVES_MPS2, MOVES_RADPS = 4.0, 1.5  # the usual range begins with the first that somebody moves by
OTHERS_MOVE: Final = 0.5  # of their usual range, in the middle of all axes
LEAST_SHARE: Final = 0.07  # of an axis' usual range against the other axes' share; real: 0.139, simulated turns 0.105
FORGET_NS: Final = 2 * NS_PER_S  # a longer silence: it may have been put on anew
NONE_SAME: Final = (False, False, False)
_AXES: Final = tuple(f"{triad}'s {axis} axis" for triad in ("accelerometer", "gyroscope") for axis in "xyz")


class Coherence:
    """One sensor's two triads against each other; what does not fit is told once, and anew when it goes on.

    Args:
        sensor: its name; a shank turns about one axis alone, a foot about all three.
    """

    def __init__(self, sensor: str) -> None:
        self._sensor = sensor
        self._is_foot = sensor not in SHANK_SENSORS
        self.not_ready = ""  # while a triad is frozen
        self._t_ns = 0
        self._force_repeats, self._rate_repeats = _Repeats(), _Repeats()
        self._ranges = _Ranges()
        self._restart()

    def fault(self, sample: ImuSample) -> str:
        """Take in a sample; in words how the two contradict each other, "" when they do not."""
        step_ns = sample.t_sensor_ns - self._t_ns
        if -MOST_STEP_NS < step_ns <= 0:
            return ""  # a slip is counted elsewhere
        self._t_ns = sample.t_sensor_ns
        if not 0 < step_ns <= MOST_STEP_NS:
            if not 0 < step_ns <= FORGET_NS:
                self._ranges = _Ranges()
            self._restart()
            return ""
        (x, y, z), (p, q, r) = sample.acc_mps2, sample.gyr_radps
        force_repeats = self._force_repeats.observe(sample.acc_mps2, step_ns)
        rate_repeats = self._rate_repeats.observe(sample.gyr_radps, step_ns)
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
        self._ranges.restart()
        self._before: Vector3 | None = None  # the last mean force
        self._resting_ns = 0
        self._up: Vector3 | None = None  # gravity's way up, turned along since the last rest
        self._upward_mps = self._turned_rad = 0.0  # since that rest: speed gained upward, and turned
        self._since_rest_ns = 0
        self._excess_before_mps2 = 0.0

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
            self._axis_force, self._axis_rate = [x, y, z], [p, q, r]
            self._unseen_mps2, self._axis_unseen_mps2 = 0.0, [0.0, 0.0, 0.0]
            self._unturned, self._axis_unturned = 0, [0, 0, 0]
            self._smooth_rad = 0.0
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
        if (axis := self._ranges.dead((x, y, z, p, q, r), block_ns)) >= 0:
            return f"{self._sensor}'s {_AXES[axis]} hardly moves any more, the others move as ever: stuck?"
        return self._dead((x, y, z), (p, q, r)) or self._gravity((x, y, z), (p, q, r), rate_radps, block_ns)

    def _dead(self, force: Vector3, rate: Vector3) -> str:
        """Says so when one triad, or one of its axes, says nothing of what the other tells."""
        moved = _apart(force, self._force, FORCE_MOVED_MPS2)
        turned = _apart(rate, self._rate, RATE_MOVED_RADPS)
        if moved:
            self._force, self._unseen_mps2 = force, 0.0
            self._unturned += 1
        if turned:
            self._rate, self._unturned = rate, 0
        unseen, unturned, axis_force, axis_rate = (
            self._axis_unseen_mps2, self._axis_unturned, self._axis_force, self._axis_rate
        )  # fmt: skip
        axis_unseen = axis_unturned = -1
        for axis in (2, 1, 0):
            if not -FORCE_MOVED_MPS2 <= force[axis] - axis_force[axis] <= FORCE_MOVED_MPS2:
                axis_force[axis], unseen[axis] = force[axis], 0.0
            elif unseen[axis] > MOST_UNSEEN_AXIS_MPS2:
                axis_unseen = axis
            if not -RATE_MOVED_RADPS <= rate[axis] - axis_rate[axis] <= RATE_MOVED_RADPS:
                axis_rate[axis], unturned[axis] = rate[axis], 0
            elif moved:
                unturned[axis] += 1
                if unturned[axis] > MOST_UNTURNED_AXIS:
                    axis_unturned = axis
        sensor = self._sensor
        if self._unseen_mps2 > MOST_UNSEEN_MPS2:
            self._unseen_mps2 = 0.0
            return f"{sensor} turns, but its accelerometer does not feel it: dead, or the gyroscope stuck?"
        if self._unturned > MOST_UNTURNED:
            self._unturned = 0
            return f"{sensor} is moved, but its gyroscope does not feel it: dead, or the accelerometer wrong?"
        if self._smooth_rad > MOST_SMOOTH_RAD:
            self._smooth_rad = 0.0
            return f"{sensor} turns and turns without ever touching the ground: does it dangle?"
        if axis_unseen >= 0:
            unseen[axis_unseen] = 0.0
            return f"{sensor} turns, but its {_AXES[axis_unseen]} does not feel it: stuck?"
        if self._is_foot and axis_unturned >= 0:
            unturned[axis_unturned] = 0
            return f"{sensor} is moved, but its {_AXES[3 + axis_unturned]} does not feel it: stuck?"
        return ""

    def _gravity(self, force: Vector3, rate: Vector3, rate_radps: float, block_ns: int) -> str:
        """Says so when the force at rest is not gravity, or from one rest to the next adds up to another one."""
        if self._up is not None:
            self._turn_along(self._up, force, rate, rate_radps, 1e-9 * block_ns)
            self._since_rest_ns += block_ns
        x, y, z = force
        resting_ns, self._resting_ns = self._resting_ns, 0
        if rate_radps >= RESTS_RADPS:
            return ""
        if resting_ns == 0:
            self._rest_x, self._rest_y, self._rest_z, self._rests = x, y, z, 1
            self._resting_ns = block_ns
            return ""
        count = self._rests
        mean = (self._rest_x / count, self._rest_y / count, self._rest_z / count)
        if _apart(force, mean, STEADY_MPS2):
            return ""
        self._rest_x, self._rest_y, self._rest_z, self._rests = (
            self._rest_x + x,
            self._rest_y + y,
            self._rest_z + z,
            count + 1,
        )
        self._resting_ns = resting_ns + block_ns
        if self._resting_ns < REST_NS:
            return ""
        return self._rested(mean)

    def _turn_along(self, up: Vector3, force: Vector3, rate: Vector3, rate_radps: float, block_s: float) -> None:
        """Turn gravity with the sensor, and add up what of the force is more than gravity along it."""
        (u, v, w), (p, q, r) = up, rate
        a, b, c = v * r - w * q, w * p - u * r, u * q - v * p
        half = 0.5 * block_s
        a, b, c = a + half * (b * r - c * q), b + half * (c * p - a * r), c + half * (a * q - b * p)
        u, v, w = u + block_s * a, v + block_s * b, w + block_s * c
        share = 1.0 / math.sqrt(u * u + v * v + w * w)
        u, v, w = share * u, share * v, share * w
        along = force[0] * (u + up[0]) + force[1] * (v + up[1]) + force[2] * (w + up[2])
        self._upward_mps += block_s * (0.5 * along - G_MPS2)
        self._turned_rad += block_s * rate_radps
        self._up = (u, v, w)

    def _rested(self, mean: Vector3) -> str:
        size_mps2 = math.sqrt(mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2])
        fault = ""
        if self._up is not None and self._turned_rad > LEAST_TURN_RAD and self._since_rest_ns <= LONGEST_NS:
            fault = self._excess(self._upward_mps / (1e-9 * max(self._since_rest_ns, SHORTEST_NS)))
        elif self._resting_ns > LONG_REST_NS and abs(size_mps2 - G_MPS2) > GRAVITY_OFF_MPS2:
            fault = f"{self._sensor} feels {size_mps2:.1f} m/s² at rest, gravity is 9.8: is it scaled?"
        if size_mps2 > 0.0:
            self._up = (mean[0] / size_mps2, mean[1] / size_mps2, mean[2] / size_mps2)
            self._upward_mps = self._turned_rad = 0.0
            self._since_rest_ns = 0
        return fault

    def _excess(self, excess_mps2: float) -> str:
        """A stride's mean vertical force over gravity."""
        before_mps2, self._excess_before_mps2 = self._excess_before_mps2, excess_mps2
        more = excess_mps2 > EXCESS_ONCE_MPS2 or min(excess_mps2, before_mps2) > EXCESS_MPS2
        less = excess_mps2 < -LACK_ONCE_MPS2 or max(excess_mps2, before_mps2) < -LACK_MPS2
        if not more and not less:
            return ""
        felt = f"{G_MPS2 + excess_mps2:.1f} m/s² of gravity in a stride"
        return f"{self._sensor}'s force and turn do not fit: {felt}: an axis stuck, scaled?"


class _Repeats:
    """How long a triad, and each of its axes, has repeated itself to the bit."""

    def __init__(self) -> None:
        self.ns = 0  # so long all three axes have
        self._values: Vector3 = (math.nan, math.nan, math.nan)
        self._ns = [0, 0, 0]  # so long an axis has while the sensor moved
        self._same = NONE_SAME  # which do now
        self._all_lived, self._lived = (
            0,
            [0, 0, 0],
        )  # samples in which all axes differed, and those in which only some did
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


class _Ranges:
    """How far each of six axes goes in 1.25 s, against what is usual for it here.

    One that hardly moves while the others move as usual is dead, whatever noise it has.
    """

    def __init__(self) -> None:
        self._usual: list[float] = []
        self._known = 0
        self.restart()

    def restart(self) -> None:
        """Look at a stretch of its own from now on; what is usual stays."""
        self._hops: list[tuple[list[float], list[float]]] = []
        self._means: list[tuple[float, ...]] = []
        self._ns = 0

    def dead(self, means: tuple[float, ...], block_ns: int) -> int:
        """Take in means (6,) of force and rate; the number of a dead axis, -1 for none."""
        self._means.append(means)
        self._ns += block_ns
        if self._ns < HOP_NS:
            return -1
        axes = list(zip(*self._means, strict=True))
        self._hops = [*self._hops[1 - HOPS :], ([*map(min, axes)], [*map(max, axes)])]
        self._means, self._ns = [], 0
        return self._judge() if len(self._hops) == HOPS else -1

    def _judge(self) -> int:
        least, most = zip(*self._hops, strict=True)
        ranges = [high - low for high, low in zip(map(max, *most), map(min, *least), strict=True)]
        if not self._usual:
            if max(ranges[:3]) > MOVES_MPS2 and max(ranges[3:]) > MOVES_RADPS:
                self._usual = ranges
            return -1
        shares = [now / max(usual, 1e-6) for now, usual in zip(ranges, self._usual, strict=True)]
        ranked = sorted(shares)
        middle = 0.5 * (ranked[2] + ranked[3])
        if middle <= OTHERS_MOVE:
            return -1
        if self._known >= USUAL_HOPS and ranked[0] < LEAST_SHARE * middle:
            self._hops = []
            return shares.index(ranked[0])
        self._known += 1
        self._usual = [usual + FOLLOW * (now - usual) for now, usual in zip(ranges, self._usual, strict=True)]
        return -1


def _apart(a: Vector3, b: Vector3, most: float) -> bool:
    """Whether they differ by more than this along any axis."""
    return abs(a[0] - b[0]) > most or abs(a[1] - b[1]) > most or abs(a[2] - b[2]) > most
