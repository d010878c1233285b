"""Can these numbers come from this sensor, on this foot, mounted as it was? Axes, units, range, mounting, coherence.

Every bound was held against real recordings (docs/safety.md): gait never comes near them.
``benchmarks/safety/gate_faults.py`` shows how soon a wrong unit or exchanged axes are found, and on how many real
recordings they are found wrongly. The judge is compiled: a sensor's record in, a code out; words, and the lie each rule
is for: :mod:`fes.gate.bounds`.
"""

import math
from itertools import permutations, product
from typing import Final

import numpy as np

from fes.config import ImuDevice
from fes.estimation.numerics.jit import jit_ieee
from fes.estimation.numerics.records import Record, Vec, handed, new_core
from fes.gate.bounds import (
    CODES,
    CORE,
    EXCHANGED,
    FAST,
    IN_G,
    MOST_SAMPLES,
    NO_CLOCK,
    SATURATED,
    TOO_FAST,
    TOO_STRONG,
    TURNED,
    Bounds,
    Place,
    pack_sample,
    sentence,
)
from fes.gate.coherence import coherent, forget_person, greater, restart, square
from fes.signals import G_MPS2, SHANK_SENSORS, ImuSample, Vector3

AT_RANGE: Final = 0.995  # of the range that the session states
BEYOND: Final = 1.05  # of an axis' range: what calibrating makes of a sample at its end stays below
FAR_NS: Final = 2**62  # between stamps nearer than this to 0 no difference overflows
BOUNDS: Final = Bounds()
# a box turned, never mirrored: (order, signs); a mirrored force alone is what many a hard heel strike looks like
_TURNS = tuple(
    (order, signs)
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if math.prod(signs) * (1.0 if order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1.0) > 0.0
)
_ORDERS, _SIGNS = tuple(order for order, _ in _TURNS), tuple(signs for _, signs in _TURNS)
_FAST, _SATURATED, _RESTS, _MOVES = range(4)  # what may last; turned, both
_WEAK, _LOW, _USUAL, _HIGH, _STRONG = range(5)  # levels of the force
_LEVEL, _DOWN, _UP, _GAP, _BEYOND = 7, 8, 16, 32, 64  # and what else is known of a sample in a span


def judge(cores: Vec) -> int:
    """Take in the sample of a core (1,): the code of what cannot be, and ``CODES`` times that of why it is not ready.

    Either is 0 when all can be. All rules take the sample in, whatever one of them says; the gravest is named.
    """
    core = cores[0]
    sample, bounds, place = core.sample, core.bounds, core.place
    if not core.begun:
        core.begun = True
        forget_person(core)
        restart(core)
        forget_mean(core)
    t_ns, acc, gyr = sample.t_ns, sample.acc, sample.gyr
    force_mps2, most_mps2, rate_radps = math.sqrt(square(acc, 0)), largest(acc), largest(gyr)
    unit, exchanged = wrong_unit(core, force_mps2, most_mps2), axes_changed(core)
    incoherent = coherent(core)
    fast = lasts(core, _FAST, t_ns, rate_radps > bounds.fast_radps)
    at_end = rate_radps >= place.gyr_end_radps or most_mps2 >= place.acc_end_mps2
    saturated = lasts(core, _SATURATED, t_ns, at_end)
    rests = lasts(core, _RESTS, t_ns, rests_turned(core, force_mps2, rate_radps))
    moves = lasts(core, _MOVES, t_ns, moves_turned(core, force_mps2))
    code = incoherent
    if rate_radps > bounds.most_rate_radps:
        code, core.value = TOO_FAST, rate_radps
    elif unit:
        code, core.value = unit, force_mps2
    elif exchanged:
        code = EXCHANGED
    elif saturated:
        code = SATURATED
    elif fast:
        code = FAST
    return int(code + CODES * (TURNED if rests or moves else core.frozen))


def lasts(core: Record, what: int, t_ns: int, is_so: bool) -> bool:
    """Whether it has now been so for a span."""
    lasting = core.lasting
    if is_so and not lasting.is_so[what]:
        lasting.since_ns[what] = t_ns
    lasting.is_so[what] = is_so
    return bool(is_so and t_ns - lasting.since_ns[what] >= core.bounds.sustained_ns)


def rests_turned(core: Record, force_mps2: float, rate_radps: float) -> bool:
    """Whether gravity comes from elsewhere at rest."""
    acc, bounds, place = core.sample.acc, core.bounds, core.place
    rests = rate_radps <= bounds.rest_radps and abs(force_mps2 - G_MPS2) <= bounds.rest_mps2
    along = acc[0] * place.up_x + acc[1] * place.up_y + acc[2] * place.up_z
    return bool(place.mounted and rests and along < force_mps2 * bounds.upright)


def moves_turned(core: Record, force_mps2: float) -> bool:
    """Whether the force, averaged over about 0.3 s, comes from elsewhere than gravity does in anybody's gait.

    A stance need not hold a rest: of stroke survivors' shanks, most do not. A foot that stumbles can show so too, but
    not for long.
    """
    mount, bounds, place, t_ns = core.mount, core.bounds, core.place, core.sample.t_ns
    if not place.mounted:
        return False
    step_ns = t_ns - mount.t_ns if mount.known else 0
    mount.known, mount.t_ns = True, t_ns
    share = min(max(step_ns, 0), bounds.most_step_ns) / bounds.mean_ns  # one after a silence does not stand for all
    most = bounds.most_in_mean_mps2 / force_mps2 if force_mps2 > bounds.most_in_mean_mps2 else 1.0
    force = mount.force
    for axis in range(3):
        force[axis] += share * (most * core.sample.acc[axis] - force[axis])
    size = math.sqrt(square(force, 0))
    if not size < math.inf:  # a fault of its own; a mean would never forget it
        forget_mean(core)
        return False
    return bool(force[0] * place.up_x + force[1] * place.up_y + force[2] * place.up_z < size * bounds.upright)


def forget_mean(core: Record) -> None:
    """Upright, as far as anybody knows."""
    force, place = core.mount.force, core.place
    force[0], force[1], force[2] = G_MPS2 * place.up_x, G_MPS2 * place.up_y, G_MPS2 * place.up_z


# --- the force's unit -------------------------------------------------------------------------------------------------
# A force in g for m/s² is 9.8 times too small. Where that takes it below what any swing shows, its level tells; in a
# brisk swing it does not, but then the change itself does: no foot's force falls to less than a quarter from one sample
# to the next and then stays low. The same the other way round for a force scaled once more, or in mg. A heel that
# lands, bounces and slaps down comes nearest; but that shakes just before the step too, and mostly shows more than the
# sensor's range in g, or than any sensor's.


def wrong_unit(core: Record, force_mps2: float, most_mps2: float) -> int:
    """What is wrong with the force's unit, by its level over a span, and by a step in it that lasts; 0 for nothing."""
    unit, sample, bounds, place = core.unit, core.sample, core.bounds, core.place
    t_ns = sample.t_ns
    if unit.filled and not 0 <= t_ns - newest_ns(unit) <= bounds.sustained_ns:  # reported elsewhere: begin anew
        while unit.filled:
            forget_oldest(unit)
    seen = _USUAL
    if force_mps2 < place.low_mps2:
        seen = _WEAK if force_mps2 < place.weak_mps2 else _LOW
    elif force_mps2 > place.high_mps2:
        seen = _STRONG if force_mps2 > place.strong_mps2 else _HIGH
    apart_ns = sample.t_sensor_ns - unit.before_ns
    smooth = square_apart(unit.earlier, 0, unit.last, 0) <= bounds.smooth_before_mps2**2
    if smooth and unit.filled > 0 and 0 < apart_ns <= bounds.most_apart_ns:
        seen += _DOWN if force_mps2 * bounds.step < unit.before_mps2 else 0
        seen += _UP if force_mps2 > unit.before_mps2 * bounds.step else 0
    for axis in range(3):
        unit.earlier[axis] = unit.last[axis] if unit.known else sample.acc[axis]
        unit.last[axis] = sample.acc[axis]
    unit.known, unit.before_mps2, unit.before_ns = True, force_mps2, sample.t_sensor_ns
    if apart_ns > bounds.most_gap_ns:
        seen += _GAP
        unit.gaps += 1
    if most_mps2 > place.most_axis_in_g_mps2 or force_mps2 > place.high_mps2:
        seen += _BEYOND
        unit.beyond += 1
    unit.counts[seen & _LEVEL] += 1
    at = (unit.first + unit.filled) % (MOST_SAMPLES + 1)
    unit.seen_ns[at], unit.seen[at] = t_ns, seen
    unit.filled += 1
    code = 0
    while t_ns - unit.seen_ns[unit.first] >= bounds.sustained_ns:
        code = code or unit_of_span(core)
        forget_oldest(unit)
    if unit.filled > MOST_SAMPLES:
        forget_oldest(unit)
    return int(code)


def unit_of_span(core: Record) -> int:
    """What is wrong with the unit, by the span from the oldest sample to the newest."""
    unit, most = core.unit, core.bounds.mostly * core.unit.filled
    weak, strong, oldest = unit.counts[_WEAK], unit.counts[_STRONG], unit.seen[unit.first]
    known = unit.gaps == (1 if oldest & _GAP else 0)  # of the step to the oldest sample, after which there is no gap
    down, up = known and oldest & _DOWN > 0 and unit.beyond == 0, known and oldest & _UP > 0
    if weak >= most or (down and weak + unit.counts[_LOW] >= most):
        return IN_G
    return TOO_STRONG if strong >= most or (up and strong + unit.counts[_HIGH] >= most) else 0


def newest_ns(unit: Record) -> int:
    """When the newest sample of the span came."""
    return int(unit.seen_ns[(unit.first + unit.filled - 1) % (MOST_SAMPLES + 1)])


def forget_oldest(unit: Record) -> None:
    """Count it no more."""
    seen = unit.seen[unit.first]
    unit.counts[seen & _LEVEL] -= 1
    unit.gaps -= 1 if seen & _GAP else 0
    unit.beyond -= 1 if seen & _BEYOND else 0
    unit.first = (unit.first + 1) % (MOST_SAMPLES + 1)
    unit.filled -= 1


# --- axes exchanged ---------------------------------------------------------------------------------------------------
# One jump that exchanged axes explain and gait does not. Real force and rate jump too, at heel strikes, but neither
# before nor after such a jump are they smooth, and no exchange of axes leads from the one sample to the other in both
# at once. Under a heel the force may turn right around and stay so for two samples; but the rate goes on as it was, and
# so speaks against an exchange. A foot that is pulled off the ground is jolted too, and two samples later the force is
# on its way back.


def axes_changed(core: Record) -> bool:
    """Whether the axes changed two samples ago."""
    axes, sample, bounds, before = core.axes, core.sample, core.bounds, core.axes.before
    apart_ns = sample.t_sensor_ns - axes.before_ns
    last_force, last_rate = axes.force, axes.rate
    axes.force, axes.rate = square_apart(sample.acc, 0, before, 0), square_apart(sample.gyr, 0, before, 3)
    axes.before_ns = sample.t_sensor_ns
    found = False
    if not axes.known or not 0 < apart_ns <= bounds.most_apart_ns:
        axes.known, axes.left = 1, 0
    elif axes.left:
        axes.known, axes.left = 2, axes.left - 1
        smooth = axes.force / axes.jump_force + axes.rate / axes.jump_rate <= axes.jump_smooth
        if not smooth:
            axes.left = 0
        found = smooth and not axes.left and stays(axes, sample)
    else:
        # most steps are too small already if held against the least sizes, and against any other they are smaller
        large = axes.force / bounds.least_force2 + axes.rate / bounds.least_rate2 >= bounds.least_jump
        if axes.known == 2 and large and jumps(core, last_force, last_rate):
            axes.left = bounds.steps_after
        axes.known = 2
    for axis in range(3):
        before[axis], before[3 + axis] = sample.acc[axis], sample.gyr[axis]
    return bool(found)


def jumps(core: Record, last_force: float, last_rate: float) -> bool:
    """Whether the step to this sample is a jump from a smooth step that an exchange of axes explains."""
    axes, bounds, acc, gyr = core.axes, core.bounds, core.sample.acc, core.sample.gyr
    was, becomes = axes.was, axes.becomes
    for axis in range(6):
        was[axis] = axes.before[axis]
    force = greater(greater(square(acc, 0), square(was, 0)), bounds.least_force2)
    rate = greater(greater(square(gyr, 0), square(was, 3)), bounds.least_rate2)
    size = axes.force / force + axes.rate / rate
    smooth = bounds.smooth * size
    if size < bounds.least_jump or last_force / force + last_rate / rate > smooth:
        return False
    axes.jump_force, axes.jump_rate, axes.jump_smooth = force, rate, smooth
    most, rate_most = bounds.explained * size, axes.rate / rate + bounds.against
    for k in range(len(_ORDERS)):
        for axis in range(3):
            becomes[axis] = _SIGNS[k][axis] * was[_ORDERS[k][axis]]
            becomes[3 + axis] = _SIGNS[k][axis] * was[3 + _ORDERS[k][axis]]
        rate_left = square_apart(gyr, 0, becomes, 3) / rate
        if rate_left <= rate_most and rate_left + square_apart(acc, 0, becomes, 0) / force <= most:
            return True
    return False


def stays(axes: Record, sample: Record) -> bool:
    """Whether this sample is nearer to what exchanged axes make of the one before the jump than to that one itself."""
    to_becomes = square_apart(sample.acc, 0, axes.becomes, 0) / axes.jump_force
    to_was = square_apart(sample.acc, 0, axes.was, 0) / axes.jump_force
    to_becomes += square_apart(sample.gyr, 0, axes.becomes, 3) / axes.jump_rate
    to_was += square_apart(sample.gyr, 0, axes.was, 3) / axes.jump_rate
    return bool(to_becomes <= to_was)


def square_apart(a: Vec, i: int, b: Vec, k: int) -> float:
    """Of the distance of (3,) numbers from the ``i``-th and the ``k``-th on."""
    x, y, z = a[i] - b[k], a[i + 1] - b[k + 1], a[i + 2] - b[k + 2]
    return float(x * x + y * y + z * z)


def largest(a: Vec) -> float:
    """Of the three sizes."""
    return greater(greater(abs(a[0]), abs(a[1])), abs(a[2]))


# as in fes.gate.coherence
_ALL = (
    judge, lasts, rests_turned, moves_turned, forget_mean, wrong_unit, unit_of_span, newest_ns, forget_oldest,
    axes_changed, jumps, stays, square_apart, largest,
)  # fmt: skip
globals().update({each.__name__: jit_ieee(each) for each in _ALL})


def place_of(sensor: str, device: ImuDevice | None, up: Vector3 | None) -> Place:
    """What is this sensor's own."""
    acc_mps2 = AT_RANGE * device.acc_range_g * G_MPS2 if device else math.inf
    gyr_radps = AT_RANGE * math.radians(device.gyr_range_dps) if device else math.inf
    in_g_mps2 = BEYOND * device.acc_range_g if device else math.inf
    high_mps2, strong_mps2 = (45.0, 60.0) if sensor in SHANK_SENSORS else (60.0, 80.0)
    end = acc_mps2, gyr_radps, up is not None, *(up or (0.0, 0.0, 0.0))
    return Place(2.5, 7.0, high_mps2, strong_mps2, in_g_mps2, *end)


class Plausibility:
    """One sensor's samples against what is possible. Its judge is compiled with the first one that is made.

    Args:
        sensor: its name.
        device: its settings, for its ranges; without them saturation cannot be told.
        up: the upward direction in the sensor's frame when it was calibrated; without it the mounting is not judged.
    """

    def __init__(self, sensor: str, device: ImuDevice | None, up: Vector3 | None) -> None:
        self._sensor, self._unready = sensor, 0
        parts = {"bounds": BOUNDS, "place": place_of(sensor, device, up)}
        judge(handed(new_core(CORE, **parts)))  # nothing is to be compiled in the loop
        self._core = new_core(CORE, **parts)
        self._handed = handed(self._core)
        self._bytes = self._core.view(np.uint8).data

    def fault(self, sample: ImuSample) -> str:
        """Take in a finite sample; what cannot be, in words, "" when all can."""
        if not (-FAR_NS < sample.t_ns < FAR_NS and -FAR_NS < sample.t_sensor_ns < FAR_NS):
            return self._sentence(NO_CLOCK)
        pack_sample(self._bytes, 0, sample.t_ns, sample.t_sensor_ns, *sample.acc_mps2, *sample.gyr_radps)
        found = judge(self._handed)
        self._unready = found // CODES
        return self._sentence(found % CODES) if found else ""

    @property
    def not_ready(self) -> str:
        """Why its data are no ground for stimulating now; no fault by itself, for a foot may rest so."""
        return self._sentence(self._unready) if self._unready else ""

    def _sentence(self, code: int) -> str:
        return sentence(code, self._sensor, float(self._core["value"][0]))
