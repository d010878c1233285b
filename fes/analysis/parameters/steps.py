"""What takes both feet: step times, double support, and step lengths where something ties the feet together.

Definitions: Perry & Burnfield, *Gait Analysis*, 2nd ed. 2010. How far two sensors are apart is known only where both
feet stand side by side. Where a straight walk begins and ends so (standing for longer than a stride is taken for it),
the feet's strides are added up, and what they differ by at the end is taken back in proportion to time; else there are
no step lengths, for a few per mille of a hundred metres are as long as a step.

In strides of two and three seconds, as in severe hemiparesis, a stride length is some percent off, mostly by the same
amount in all strides of a foot. Feet alternate, so their mean stride lengths are brought together, weighed by the error
of a bias or a tilt, which grows with the square of the time for which the foot moves. Nothing is done where the walk
turns, where the feet have different numbers of strides, or where they are too far apart for drift. No paper; that both
sides' stride lengths agree is seen in Wang et al. (2013), Table 2.
"""

import math
from collections.abc import Mapping
from itertools import permutations
from typing import NamedTuple

import numpy as np

from fes.analysis.parameters.contacts import Swings
from fes.analysis.tables import Table
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.signals import NS_PER_S, FloatArray, IntArray

LEAST_STRIDES = 6  # of either foot
STEADY_SHARE = 0.3  # of the median length
LARGEST_TURN_RAD = math.radians(3.0)  # per stride, on the whole
MOST_APART = 0.1  # of the length
MOST_EXTRA = 2  # strides of one foot more than of the other


def equalise_sides(feet: Mapping[str, Table]) -> dict[str, float]:
    """By foot, the factor that scales its stride lengths and speeds so that both feet go equally far.

    ``feet`` are the strides of each, as of ``tables.by_column``. It is 1 with fewer than two feet, on a curve, and
    where the feet differ by more than a tenth.
    """
    measured = {foot: one for foot, strides in feet.items() if (one := _length_moving_count(strides)) is not None}
    if len(feet) == len(measured) == 2:
        weights = {foot: moving_s**-4 for foot, (_, moving_s, _) in measured.items()}
        common_m = sum(weights[foot] * one[0] for foot, one in measured.items()) / sum(weights.values())
        (one_m, _, count), (other_m, _, other_count) = measured.values()
        if abs(one_m - other_m) <= MOST_APART * common_m and abs(count - other_count) <= MOST_EXTRA:
            return {foot: common_m / one[0] for foot, one in measured.items()}
    return dict.fromkeys(feet, 1.0)


def _length_moving_count(strides: Table) -> tuple[float, float, int] | None:
    """Of the steady strides: mean length (m) and number, and for how long the foot moves in one (s, median).

    It moves from heel rise to stance, or for the stride's whole time where these are not known. None with too few
    strides, and on a curve.
    """
    valid = strides[strides["valid"]]
    lengths, turns = valid["stride_length_m"], valid["turn_rad"]
    usual = float(np.median(lengths)) if len(lengths) else 0.0
    steady = np.abs(lengths - usual) <= STEADY_SHARE * usual
    count = int(np.count_nonzero(steady))
    if count < LEAST_STRIDES or usual <= 0.0 or abs(float(turns[steady].mean())) > LARGEST_TURN_RAD:
        return None
    begin_ns, end_ns = valid["t_pre_swing_ns"], valid["t_stance_ns"]
    known = (begin_ns != UNSEEN_NS) & (end_ns != UNSEEN_NS)
    times_ns = np.where(known, end_ns - begin_ns, valid["t_end_ns"] - valid["t_start_ns"])
    return float(lengths[steady].mean()), max(float(np.median(times_ns)) / NS_PER_S, 0.1), count


LONGEST_STRIDE_S = 5.0  # from one contact to the next; beyond, the foot stood
LONGEST_STANCE_S = 3.0  # beyond, the walk was interrupted
ROOM_SHARE = 0.7  # of the usual stride time between two strides: room for one; in slow walks half of it is stance
MOST_TURN_RAD = math.radians(20.0)


class Steps(NamedTuple):
    """The step that ends each of S strides, and the stride that its contact ends: (S,) in s, NaN where not known."""

    stride_time_s: FloatArray
    stance_s: FloatArray
    step_time_s: FloatArray
    double_support_s: FloatArray
    foot_flat_s: FloatArray


def steps_of(strides: Table, own: Swings, other: Swings) -> Steps:
    """Of each of a foot's valid strides by time; ``other`` are the swings of the other foot (none: no steps).

    Where a stride is missing between two (its numbers must not be used, or samples were lost for so long that it was
    not seen: then there is room for one), the contact before is not the one that began the stride: stride time, stance
    and double support are not known. Nor is the step, unless the other foot's contact that began it is later than the
    stride's own beginning, or else one in between was not seen either.
    """
    number, start_ns, end_ns = (strides[name] for name in ("number", "t_start_ns", "t_end_ns"))
    between_ns = start_ns[1:] - end_ns[:-1]
    room_ns = ROOM_SHARE * float(np.median(np.diff(start_ns))) if len(strides) > 1 else math.inf
    goes_on = np.zeros(len(strides), np.bool_)
    goes_on[1:] = (np.diff(number) == 1) & (between_ns < room_ns) & own.seen[:-1]
    landed, left = np.sort(other.contact_ns[other.seen]), np.sort(other.foot_off_ns[other.seen])
    begin_ns = np.where(goes_on, _before(own.contact_ns), start_ns)
    last = np.searchsorted(landed, own.contact_ns) - 1
    before_ns = np.concatenate(([UNSEEN_NS], landed))[last + 1]
    step_s = (own.contact_ns - before_ns) / NS_PER_S
    known = own.seen & (last >= 0) & (step_s <= LONGEST_STRIDE_S) & (before_ns > begin_ns)
    stride_s = (own.contact_ns - begin_ns) / NS_PER_S
    walking = own.seen & goes_on & (stride_s > 0.0) & (stride_s <= LONGEST_STRIDE_S)
    # the other foot's swing within this foot's stance: both stand before and after it
    never = np.iinfo(np.int64).max
    lifted_ns = np.append(left, never)[np.searchsorted(left, begin_ns)]
    back_ns = np.append(landed, never)[np.searchsorted(landed, lifted_ns)]
    both = walking & (lifted_ns < own.foot_off_ns) & (back_ns <= own.foot_off_ns)
    support_ns = (lifted_ns - begin_ns) + (own.foot_off_ns - back_ns)
    flat_s = seconds_between(_before(own.foot_flat_ns), own.heel_rise_ns)
    return Steps(
        np.where(walking, stride_s, math.nan),
        np.where(walking, (own.foot_off_ns - begin_ns) / NS_PER_S, math.nan),
        np.where(known, step_s, math.nan),
        np.where(both, support_ns / NS_PER_S, math.nan),
        np.where(walking, flat_s, math.nan),
    )


def _before(t_ns: IntArray) -> IntArray:
    """Of each stride (S,) that of the one before."""
    return np.concatenate((np.full(min(len(t_ns), 1), UNSEEN_NS), t_ns[:-1]))


def seconds_between(begin_ns: IntArray, end_ns: IntArray) -> FloatArray:
    """The times (S,) from some instants to others, NaN where one of the two was not seen."""
    return np.where((begin_ns == UNSEEN_NS) | (end_ns == UNSEEN_NS), math.nan, (end_ns - begin_ns) / NS_PER_S)


def step_lengths(
    strides: Mapping[str, Table],
    swings: Mapping[str, Swings],
    span_ns: tuple[int, int],
    scales: Mapping[str, float],
) -> tuple[dict[str, FloatArray], str]:
    """Step lengths (m) of each of a foot's strides, by foot; and why there are none, else "".

    ``strides`` are all of each foot by time and ``swings`` theirs, ``span_ns`` the recording's first and last time,
    ``scales`` those of :func:`equalise_sides`.
    """
    why = _untied(strides, span_ns)
    hidden = [foot for foot in strides if not swings[foot].seen.all()]
    if why or hidden:
        return {}, why or f"{hidden[0]}: not every stride shows its contact"
    begin = min(own["t_start_ns"][0] for own in strides.values())
    end = max(own["t_end_ns"][-1] for own in strides.values())
    lengths = {foot: scales[foot] * own["stride_length_m"] for foot, own in strides.items()}
    distances = {foot: np.cumsum(np.concatenate(([0.0], own))) for foot, own in lengths.items()}
    found = {}
    for foot, other in permutations(strides, 2):
        contact_ns = swings[foot].contact_ns
        left_over = float(distances[foot][-1] - distances[other][-1])
        its = distances[other][np.searchsorted(swings[other].contact_ns, contact_ns)]
        found[foot] = distances[foot][1:] - its - left_over * (contact_ns - begin) / (end - begin)
    return found, ""


def _untied(strides: Mapping[str, Table], span_ns: tuple[int, int]) -> str:
    """Why the feet's strides cannot be laid side by side, "" if they can."""
    if len(strides) != 2 or not all(strides.values()):
        return "strides of one foot only"
    for foot, own in strides.items():
        start_ns, end_ns = own["t_start_ns"], own["t_end_ns"]
        if not own["valid"].all():
            return f"{foot}: not all strides are valid"
        if (np.abs(own["turn_rad"]) > MOST_TURN_RAD).any():
            return f"{foot}: the walk turns"
        if (start_ns[1:] - end_ns[:-1] > LONGEST_STANCE_S * NS_PER_S).any():
            return f"{foot}: the walk is interrupted"
        usual = float(np.median(np.diff(end_ns))) if len(own) > 1 else math.inf
        before, after = start_ns[0] - span_ns[0], span_ns[1] - end_ns[-1]
        # a recording that is cut off within a stance must not pass for one that ends in standing
        if min(before, after) < usual:
            return "no standing side by side both before and after the walk"
    return ""
