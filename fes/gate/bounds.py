"""What the gate knows of one sensor, as one record: its bounds with unit and reason, its place, its state; and words.

"real" is the farthest that any real recording went, so the bound's distance from gait
(``benchmarks/safety/gate_faults.py``, docs/safety.md). The compiled judge gives a
code; words are made of it only when something is to be said.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from fes.estimation.numerics.records import record_of, record_type, struct_of
from fes.signals import G_MPS2, NS_PER_S

MOST_SAMPLES: Final = 1000  # kept of a span of force; a sensor that sends more is judged by fewer
HOPS: Final = 5  # of a stride of most: 1.25 s


class Bounds(NamedTuple):
    """All bounds that do not depend on the sensor."""

    sustained_ns: int = 80_000_000  # what one knock, one clipped heel strike or one free fall of the foot never lasts
    # unit of the force
    mostly: float = 0.75  # of the samples of a span: in g too a swing has its spikes
    step: float = 4.0  # from one sample to the next; real ones that last reach 2.4 down and 3.0 up
    smooth_before_mps2: float = 8.0  # the change just before such a step; a foot that strikes the ground shakes by more
    most_gap_ns: int = 25_000_000  # in the span after a step: from fewer samples nobody can tell that it lasts
    # unit of the rate
    most_rate_radps: float = 40.0  # in any one sample: degrees taken for radians; real feet turn at 13, shanks at 20
    fast_radps: float = 15.0  # about one axis for a span: a turn in 0.4 s; real feet never, shanks for one sample
    # mounting
    upright: float = math.cos(math.radians(65))  # of a tilt from calibration; real: 30° at rest, 53° of the mean force
    rest_radps: float = 0.5  # slower is a rest, where …
    rest_mps2: float = 1.5  # … the force is this near to gravity
    mean_ns: int = 300_000_000  # gravity shows through a walk in the mean of so long
    most_in_mean_mps2: float = 2.0 * G_MPS2  # a sample counts as this: a stumble shakes a foot by ten times gravity
    # axes exchanged; with the first three 1.38 times as wide no real walk would be taken for an exchange yet
    least_jump: float = 0.7  # of force and rate together, each squared and against its own size
    smooth: float = 0.13  # of the jump: the steps before and after it are smaller
    explained: float = 0.09  # of the jump: what an exchange of axes leaves of it
    against: float = 0.02  # of the rate's square: an exchange may miss the new rate by so much more than the old one
    least_force2: float = 4.0**2  # (m/s²)²: smaller forces and rates are not taken as larger jumps for their size …
    least_rate2: float = 1.0**2  # … (rad/s)²
    steps_after: int = 2  # that have to be smooth
    most_apart_ns: int = 12_500_000  # by the sensor's own clock, between two samples; in a longer time all may change
    # the two triads against each other
    block_ns: int = 14_500_000  # a mean over at least this long: two samples at 100 Hz, eight at 500 Hz
    most_step_ns: int = 40_000_000  # between two samples; what a longer gap hides cannot be added up
    forget_ns: int = 2 * NS_PER_S  # a longer silence: it may have been put on anew
    same_ns: int = 60_000_000  # bit-equal while the other triad lives; real and virtual: 40 ms at most
    same_axis_ns: int = 100_000_000  # one axis bit-equal while the sensor moves; real: 20 ms
    lived: int = 50  # samples that differed: an axis that never did is none of this sensor's
    full_scale: float = 0.98  # of the triad's greatest value: an axis there may be clipped
    turns_radps: float = 0.3  # slower, a zero that is off adds up to a turn in time
    force_moved_mps2: float = 1.0  # along an axis
    rate_moved_radps: float = 0.25  # about an axis
    most_unseen_mps2: float = 10.0  # of gravity's own way while no axis moved: a turn of 1 rad; real: 6.4
    most_unseen_axis_mps2: float = 18.0  # likewise along one axis; real: 10.5
    most_unturned: int = 24  # moves of the force without one of the rate; real: 12
    jolt_mps2: float = 2.0  # from one mean to the next: every contact with the ground
    most_smooth_rad: float = 4.0  # turned without a jolt; real: 2.7
    rests_radps: float = 0.6
    steady_mps2: float = 0.7  # along an axis, from the mean of the rest
    long_rest_ns: int = 200_000_000
    still_radps: float = 0.3  # and no faster all through a long rest: a slow swing comes down as evenly
    gravity_off_mps2: float = 1.6  # in a long rest; real: 0.62, a virtual foot that drags to its stop: 1.2
    # the mean force
    force_mean_s: float = 0.6  # twice, one mean after the other: a stride's own forces are gone by then
    means_ns: int = 3 * NS_PER_S  # before the mean counts
    more_mps2: float = 1.3  # than usual here; real: 0.99
    less_mps2: float = 1.6  # likewise; real: 1.28
    more_at_first_mps2: float = 1.5  # than gravity, until what is usual is known; real: 1.1
    less_at_first_mps2: float = 2.2  # likewise; real: 1.8
    walks_radps: float = 0.5
    learns_force_ns: int = 6 * NS_PER_S  # before what is usual counts as known (at 3 s, real: 1.57 less) …
    usual_force_s: float = 10.0  # … and over how long it is the mean
    # an axis that is still
    hop_ns: int = 250_000_000  # five of them are a stride of most
    follow: float = 0.05  # a hop's share in an axis' usual range
    moves_mps2: float = 4.0  # the usual range begins with the first that somebody moves by …
    moves_radps: float = 1.5  # … in both triads
    others_move: float = 0.5  # of their usual range, in the middle of all axes
    usual_hops: int = 12  # before an axis' usual range counts as known
    least_share: float = 0.07  # of its usual range against the others' share; real: 0.139, simulated turns 0.105
    move_share: float = 0.02  # of its usual range: by that an axis has moved, and …
    least_mps2: float = 0.3  # … by so much at least …
    least_radps: float = 0.07  # … likewise
    lives: float = 3.0  # times the least: an axis that is used to less is not judged
    most_still: float = 2.8  # times as far as before all axes may go, in usual ranges, while one is still; real: 2.1
    still_sum: float = 4.0  # as far as that counts as before, however seldom it is still …
    still_sum_at_first: float = 12.0  # … and until they have gone …
    known_sum: float = 120.0  # … six strides' way


class Place(NamedTuple):
    """What is this sensor's own. A shank is shaken less than a foot."""

    weak_mps2: float  # what lies mostly below it for a span is in g
    low_mps2: float  # likewise after a step down
    high_mps2: float  # what lies mostly above it after a step up is scaled once more, or in mg; a force in g never does
    strong_mps2: float  # likewise, whatever was before
    most_axis_in_g_mps2: float  # what shows more along an axis is not in g
    acc_end_mps2: float  # of its range; infinite where nobody knows it
    gyr_end_radps: float
    mounted: bool  # whether it is known how it was put on:
    up_x: float
    up_y: float
    up_z: float


_I, _F, _B = np.int64, np.float64, np.bool_
_UNIT = record_type([
    ("seen_ns", _I, MOST_SAMPLES + 1), ("seen", _I, MOST_SAMPLES + 1), ("first", _I), ("filled", _I), ("counts", _I, 5),
    ("gaps", _I), ("beyond", _I), ("before_mps2", _F), ("before_ns", _I), ("known", _B),
    ("earlier", _F, 3), ("last", _F, 3),
])  # fmt: skip
_AXES = record_type([
    ("known", _I), ("before_ns", _I), ("before", _F, 6), ("force", _F), ("rate", _F), ("left", _I),
    ("jump_force", _F), ("jump_rate", _F), ("jump_smooth", _F), ("was", _F, 6), ("becomes", _F, 6),
])  # fmt: skip
_REPEATS = record_type([
    ("all_ns", _I, 2), ("greatest", _F, 2), ("all_lived", _I, 2), ("values", _F, 6), ("axis_ns", _I, 6),
    ("same", _I, 6), ("lived", _I, 6), ("band", _B), ("band_force", _F, 3),
])  # fmt: skip
_BLOCK = record_type([
    ("t_ns", _I), ("sums", _F, 6), ("samples", _I), ("ns", _I), ("known", _B), ("before", _F, 3), ("force", _F, 3),
    ("rate", _F, 3), ("axis_force", _F, 3), ("unseen_mps2", _F), ("axis_unseen_mps2", _F, 3), ("unturned", _I),
    ("smooth_rad", _F), ("resting_ns", _I), ("still_ns", _I), ("rests", _I), ("rest", _F, 3),
])  # fmt: skip
_MEAN = record_type([
    ("usual_mps2", _F), ("walked_ns", _I), ("known", _B), ("ns", _I), ("once", _F, 3), ("twice", _F, 3),
])  # fmt: skip
_STILL = record_type([
    ("usual_known", _B), ("usual", _F, 6), ("least", _F, 6), ("hops_known", _I), ("farthest", _F, 6), ("gone", _F),
    ("may_go", _F, 6), ("hops", _I), ("low", _F, 6 * HOPS), ("high", _F, 6 * HOPS), ("now_low", _F, 6),
    ("now_high", _F, 6), ("means", _I), ("ns", _I), ("at_known", _B), ("at", _F, 6), ("since", _F, 6),
    ("until", _F, 6), ("moved", _I, 6), ("latest", _F, 6), ("ranges", _F, 6), ("ranked", _F, 6),
])  # fmt: skip
_LASTING = record_type([("is_so", _I, 4), ("since_ns", _I, 4)])
_MOUNT = record_type([("known", _B), ("t_ns", _I), ("force", _F, 3)])
_SAMPLE = record_type([("t_ns", _I), ("t_sensor_ns", _I), ("acc", _F, 3), ("gyr", _F, 3)])
CORE: Final = record_type([
    ("sample", _SAMPLE), ("bounds", record_of(Bounds)), ("place", record_of(Place)), ("begun", _B), ("frozen", _I),
    ("value", _F), ("unit", _UNIT), ("axes", _AXES), ("repeats", _REPEATS), ("block", _BLOCK), ("mean", _MEAN),
    ("still", _STILL), ("lasting", _LASTING), ("mount", _MOUNT),
])  # fmt: skip
pack_sample = struct_of(CORE, "sample").pack_into

# codes: what a sensor's sample can be told to be
TOO_FAST, IN_G, TOO_STRONG, EXCHANGED, SATURATED, FAST, ACC_FROZEN, GYR_FROZEN, ACC_DEAD, GYR_DEAD = range(1, 11)
DANGLES, MISFIT, SCALED, TURNED, NO_CLOCK = range(11, 16)
AXIS_FROZEN, AXIS_STILL, AXIS_DEAD = 16, 24, 32  # and the axis' number: force x, y, z, rate x, y, z
CODES: Final = 64  # more than there are

_MS: Final = Bounds().sustained_ns // 1_000_000
_IN_FRAMES: Final = "force and turn do not fit: {value:.1f} m/s² of gravity: an axis stuck, scaled, its unit?"
# by code: the words, and the lie that it catches sooner than any other rule, or alone
SAID: Final[dict[int, tuple[str, str]]] = {
    TOO_FAST: ("{sensor} turns at {value:.0f} rad/s, which no foot does: is its unit °/s?", "rate in degrees"),
    FAST: (
        f"{{sensor}} turns at more than {Bounds().fast_radps:.0f} rad/s for {_MS} ms: is its unit °/s?",
        "rate in degrees, of a foot that turns slowly",
    ),
    IN_G: (f"{{sensor}} shows {{value:.2g}} m/s² and less than gravity for {_MS} ms: is its unit g?", "force in g"),
    TOO_STRONG: (
        f"{{sensor}} shows {{value:.0f}} m/s² and more than a foot can take for {_MS} ms: wrong unit?",
        "force scaled by g again, or in mg",
    ),
    EXCHANGED: (
        "the axes of {sensor} changed from one sample to the next: remounted?",
        "started anew with other axes, in swing",
    ),
    SATURATED: (f"{{sensor}} is saturated: at the end of its range for {_MS} ms", "beyond its range"),
    TURNED: ("{sensor} shows turned by more than 65° from its calibration: remounted?", "fell off, put on turned"),
    ACC_FROZEN: ("{sensor}'s accelerometer is frozen: the same values, the other's change", "a triad bit-equal"),
    GYR_FROZEN: ("{sensor}'s gyroscope is frozen: the same values, the other's change", "a triad bit-equal"),
    ACC_DEAD: (
        "{sensor} turns, but its accelerometer does not feel it: dead, or the gyroscope stuck?",
        "accelerometer that says noise only, within a swing",
    ),
    GYR_DEAD: (
        "{sensor} is moved, but its gyroscope does not feel it: dead, or the accelerometer wrong?",
        "gyroscope that says noise only",
    ),
    DANGLES: ("{sensor} turns and turns without ever touching the ground: does it dangle?", "hanging on its cable"),
    MISFIT: (f"{{sensor}}'s {_IN_FRAMES}", "a triad scaled, a gyroscope's sign or axes, an offset of force"),
    SCALED: (
        "{sensor} feels {value:.1f} m/s² at rest, gravity is 9.8: is it scaled?",
        "force scaled by less than a unit, at the first rest",
    ),
    NO_CLOCK: ("{sensor}'s stamps are beyond any clock", "stamps whose differences would overflow"),
    AXIS_FROZEN: ("{sensor}'s {axis} is frozen: the same value, the others' change", "an axis bit-equal"),
    AXIS_STILL: ("{sensor} moves as ever, but its {axis} does not feel it: stuck?", "an axis stuck, with noise"),
    AXIS_DEAD: ("{sensor} turns, but its {axis} does not feel it: stuck?", "hanging on its cable, within a second"),
}
_AXIS_NAMES: Final = tuple(f"{triad}'s {axis} axis" for triad in ("accelerometer", "gyroscope") for axis in "xyz")


def sentence(code: int, sensor: str, value: float) -> str:
    """What a code says of this sensor; "" for none. ``value`` is the number that goes with it."""
    if not code:
        return ""
    rule = code if code < AXIS_FROZEN else code & ~7
    return SAID[rule][0].format(sensor=sensor, axis=_AXIS_NAMES[(code - rule) % 6], value=value)
