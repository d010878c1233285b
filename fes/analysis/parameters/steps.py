"""What takes both feet: step times, double support, and step lengths where something ties the feet together.

Definitions: Perry & Burnfield, *Gait Analysis*, 2nd ed. 2010. Two sensors do not see each other; how far apart they
are is known only where both feet stand side by side. Where a straight walk begins and ends so (nobody can tell:
standing for longer than a stride is taken for it), the feet's strides are added up, and what they differ by at the
end is taken back in proportion to time; else there are no step lengths, for a few per mille of a hundred metres are
as long as a step. In long walks the error grows with the square root of the strides.

In strides of two and three seconds, as in severe hemiparesis, a stride length is some percent off, mostly by the same
amount in all strides of a foot (tilt and bias of its own sensor). Feet alternate, so their mean stride lengths are
the same, and are brought together. A bias or a tilt makes an error that grows with the square of the time for which
the foot moves: that gives the weights. On a curve the outer foot goes farther: nothing is done where the walk turns,
where the feet have different numbers of strides, or where they are too far apart for that to be drift. No paper; that
both sides' stride lengths agree is seen in Wang et al. (2013), Table 2.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np

from fes.analysis.parameters.contacts import Swing
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.signals import NS_PER_S, IntArray, StrideResult

LEAST_STRIDES = 6  # of either foot
STEADY_SHARE = 0.3  # of the median length
LARGEST_TURN_RAD = math.radians(3.0)  # per stride, on the whole
MOST_APART = 0.1  # of the length
MOST_EXTRA = 2  # strides of one foot more than of the other


def equalise_sides(feet: Mapping[str, Sequence[StrideResult]]) -> dict[str, float]:
    """By foot, the factor that scales its stride lengths and speeds so that both feet go equally far.

    It is 1 with fewer than two feet, on a curve, and where the feet differ by more than a tenth.
    """
    measured = {foot: one for foot, strides in feet.items() if (one := _length_moving_count(strides)) is not None}
    if len(feet) == len(measured) == 2:
        weights = {foot: moving_s**-4 for foot, (_, moving_s, _) in measured.items()}
        common_m = sum(weights[foot] * one[0] for foot, one in measured.items()) / sum(weights.values())
        (one_m, _, count), (other_m, _, other_count) = measured.values()
        if abs(one_m - other_m) <= MOST_APART * common_m and abs(count - other_count) <= MOST_EXTRA:
            return {foot: common_m / one[0] for foot, one in measured.items()}
    return dict.fromkeys(feet, 1.0)


def _length_moving_count(strides: Sequence[StrideResult]) -> tuple[float, float, int] | None:
    """Of the steady strides: mean length (m) and number, and for how long the foot moves in one (s, median).

    It moves from heel rise to stance, or for the stride's whole time where these are not known. None with too few
    strides, and on a curve.
    """
    valid = [stride for stride in strides if stride.valid]
    lengths = np.array([stride.stride_length_m for stride in valid])
    turns = np.array([stride.turn_rad for stride in valid])
    usual = float(np.median(lengths)) if len(lengths) else 0.0
    steady = np.abs(lengths - usual) <= STEADY_SHARE * usual
    count = int(np.count_nonzero(steady))
    if count < LEAST_STRIDES or usual <= 0.0 or abs(float(turns[steady].mean())) > LARGEST_TURN_RAD:
        return None
    known = [(s.t_pre_swing_ns, s.t_stance_ns, s.t_end_ns - s.t_start_ns) for s in valid]
    times = [whole if begin is None or end is None else end - begin for begin, end, whole in known]
    return float(lengths[steady].mean()), max(float(np.median(times)) / NS_PER_S, 0.1), count


LONGEST_STRIDE_S = 5.0  # from one contact to the next; beyond, the foot stood
LONGEST_STANCE_S = 3.0  # beyond, the walk was interrupted
ROOM_SHARE = 0.7  # of the usual stride time between two strides: room for one; in slow walks half of it is stance
MOST_TURN_RAD = math.radians(20.0)


@dataclass(frozen=True, slots=True)
class Step:
    """The step that ends a foot's stride, and the stride that its contact ends; s, NaN where it is not known."""

    stride_time_s: float
    stance_s: float
    step_time_s: float
    double_support_s: float
    foot_flat_s: float = math.nan


def steps_of(
    own: Sequence[Swing | None], other: Sequence[Swing | None], begins_ns: Sequence[int] | None = None
) -> list[Step]:
    """One per stride of one foot, in order; ``other`` are those of the other foot (none: no steps).

    ``begins_ns``: where each stride begins. Where the contact before was not seen, the other foot's that begins a step
    must be later than that, or else one in between was not seen either.
    """
    begins_ns = [-1] * len(own) if begins_ns is None else begins_ns
    contacts, offs = (
        np.array(sorted(getattr(s, name) for s in other if s is not None), dtype=np.int64)
        for name in ("contact_ns", "foot_off_ns")
    )
    found = zip(pairwise((None, *own)), begins_ns, strict=True)
    return [_step(before, swing, begin_ns, contacts, offs) for (before, swing), begin_ns in found]


def steps_by_number(
    strides: Sequence[StrideResult], swings: Mapping[int, Swing], other: Sequence[Swing | None]
) -> dict[int, Step]:
    """One per valid stride of one foot, by its number.

    Where a stride is missing between two (its numbers must not be used, or samples were lost for so long that it was
    not seen: then there is room for one), the contact before is not the one that began the stride: stride time, stance
    and double support are not known.
    """
    starts = np.array([stride.t_start_ns for stride in strides], dtype=np.int64)
    room_ns = ROOM_SHARE * float(np.median(np.diff(starts))) if len(strides) > 1 else math.inf
    own: list[Swing | None] = []
    begins_ns: list[int] = []
    places: dict[int, int] = {}
    before: StrideResult | None = None
    for stride in strides:
        if before is not None and (
            stride.number != before.number + 1 or stride.t_start_ns - before.t_end_ns >= room_ns
        ):
            own.append(None)
            begins_ns.append(-1)
        places[stride.number] = len(own)
        own.append(swings.get(stride.number))
        begins_ns.append(stride.t_start_ns)
        before = stride
    found = steps_of(own, other, begins_ns)
    return {number: found[place] for number, place in places.items()}


def _step(before: Swing | None, swing: Swing | None, begin_ns: int, contacts: IntArray, offs: IntArray) -> Step:
    nan = float("nan")
    if swing is None:
        return Step(nan, nan, nan, nan)
    off, end = swing.foot_off_ns, swing.contact_ns
    begin = before.contact_ns if before is not None else begin_ns
    stride = (end - begin) / NS_PER_S
    walking = before is not None and 0.0 < stride <= LONGEST_STRIDE_S
    last = int(np.searchsorted(contacts, end)) - 1
    step = (end - int(contacts[last])) / NS_PER_S if last >= 0 else nan
    missed = last >= 0 and int(contacts[last]) <= begin  # the other foot's step in between was not seen
    step = step if step <= LONGEST_STRIDE_S and not missed else nan
    if not walking:
        return Step(nan, nan, step, nan)
    # the other foot's swing within this foot's stance: both stand before and after it
    inside = int(np.searchsorted(offs, begin))
    support = nan
    if inside < len(offs) and int(offs[inside]) < off:
        landed = int(np.searchsorted(contacts, int(offs[inside])))
        if landed < len(contacts) and int(contacts[landed]) <= off:
            support = ((int(offs[inside]) - begin) + (off - int(contacts[landed]))) / NS_PER_S
    assert before is not None
    flat_s = seconds_between(before.foot_flat_ns, swing.heel_rise_ns)
    return Step(stride, (off - begin) / NS_PER_S, step, support, flat_s)


def seconds_between(begin_ns: int, end_ns: int) -> float:
    """The time from one instant to another, NaN where one was not seen."""
    return math.nan if UNSEEN_NS in (begin_ns, end_ns) else (end_ns - begin_ns) / NS_PER_S


def step_lengths(
    strides: Mapping[str, Sequence[StrideResult]],
    swings: Mapping[str, Mapping[int, Swing]],
    span_ns: tuple[int, int],
    scales: Mapping[str, float],
) -> tuple[dict[str, dict[int, float]], str]:
    """Step lengths (m) by foot and stride number; and why there are none, else "".

    ``strides`` are all of each foot by time, ``span_ns`` the recording's first and last time, ``scales`` those of
    :func:`equalise_sides`.
    """
    why = _untied(strides, span_ns)
    if why:
        return {}, why
    begin, end = min(own[0].t_start_ns for own in strides.values()), max(own[-1].t_end_ns for own in strides.values())
    lengths = {foot: [scales[foot] * stride.stride_length_m for stride in own] for foot, own in strides.items()}
    distances = {foot: np.cumsum([0.0, *own]) for foot, own in lengths.items()}
    found: dict[str, dict[int, float]] = {}
    for foot, other in permutations(strides, 2):
        landed = np.array(sorted(swing.contact_ns for swing in swings[other].values()), dtype=np.int64)
        left_over = float(distances[foot][-1] - distances[other][-1])
        found[foot] = {}
        if len(landed) != len(strides[other]):
            return {}, f"{other}: not every stride shows its contact"
        for k, stride in enumerate(strides[foot]):
            if swing := swings[foot].get(stride.number):
                its = int(np.searchsorted(landed, swing.contact_ns))
                drift = left_over * (swing.contact_ns - begin) / (end - begin)
                found[foot][stride.number] = float(distances[foot][k + 1] - distances[other][its]) - drift
    return found, ""


def _untied(strides: Mapping[str, Sequence[StrideResult]], span_ns: tuple[int, int]) -> str:
    """Why the feet's strides cannot be laid side by side, "" if they can."""
    if len(strides) != 2 or not all(strides.values()):
        return "strides of one foot only"
    for foot, own in strides.items():
        if not all(stride.valid for stride in own):
            return f"{foot}: not all strides are valid"
        if any(abs(stride.turn_rad) > MOST_TURN_RAD for stride in own):
            return f"{foot}: the walk turns"
        if any(b.t_start_ns - a.t_end_ns > LONGEST_STANCE_S * NS_PER_S for a, b in pairwise(own)):
            return f"{foot}: the walk is interrupted"
        usual = float(np.median(np.diff([stride.t_end_ns for stride in own]))) if len(own) > 1 else math.inf
        before, after = own[0].t_start_ns - span_ns[0], span_ns[1] - own[-1].t_end_ns
        # a recording that is cut off within a stance must not pass for one that ends in standing
        if min(before, after) < usual:
            return "no standing side by side both before and after the walk"
    return ""
