"""Compiled rules of :mod:`fes.estimation.events_offline`, which says what they are; positions are sample indices."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.compiled import jit, jit_ieee
from fes.estimation.filters import PADDING, Section, begun, moving_sums, pass_back, passed

NEIGHBOURS = 10  # falls before and after that say what is typical
TOE_DOWN_SHARE = 0.2  # of the fall is push-off's toe-down rate; less, and the swing before goes on
REST_SHARE = 0.06  # of the typical greatest rate: below, the foot rests between two steps …
FLAT_SHARE = 0.03  # the same: below, loading is over for certain
FLAT_S = 0.1  # … if for this long: a slow swing turns at about zero
FO_FALL_SHARE = 0.75  # of push-off's peak
HEEL_SHARE = 0.2  # of push-off's peak: a toe-down peak after contact above it is a heel strike
SOFT_SHARE = 0.1  # the same: a swing's rate has died down once it is below
TURN_SHARE = 0.04  # the same: the rate at which it has turned
IMPACT_SHARE = 0.3  # of this walk's typical jump at contact: a jump above it is an impact …
IMPACT_MPS3 = 150.0  # … if above this as well
IMPACT_ONSET_SHARE = 0.3  # of the jump: there the impact begins
NONE = -1.0  # where there is no instant


class Signals(NamedTuple):
    """What the rules look at, (N,) each: the toe-down rate smoothed in three ways, its energy, the force's jump."""

    shape: Any
    feature: Any
    turn: Any
    energy: Any
    jump: Any


@jit_ieee
def look(
    acc: Any, gyr: Any, bias: Any, axis: Any, rate_hz: float, lag: int, window: int,
    one: Section, two: Section, three: Section, turning: Any, energy: Any, jump: Any,
) -> bool:  # fmt: skip
    """Of specific force and angular rate (N, 3) the rate about ``axis`` (3,) without ``bias`` (3,), low-passed in three
    ways without lag: ``turning`` (3, N and ``PADDING`` at both ends); the mean of the rate's square over ``window``
    samples; and the change of the force over ``lag`` samples, per second, that ends at a sample.

    False if any of them is not finite.
    """
    n, per, off = jump.shape[0], rate_hz / lag, 0.0
    bx, by, bz, ux, uy, uz = bias[0], bias[1], bias[2], axis[0], axis[1], axis[2]
    early_u = late_u = early_v = late_v = early_w = late_w = 0.0
    for i in range(-PADDING, n + PADDING):
        if 0 <= i < n:
            x, y, z = gyr[i, 0] - bx, gyr[i, 1] - by, gyr[i, 2] - bz
            rate, energy[i] = x * ux + y * uy + z * uz, x * x + y * y + z * z
            total = (x + y + z) + (acc[i, 0] + acc[i, 1] + acc[i, 2])
            off += total - total  # nothing, if all are finite
            before = max(i - lag, 0)
            x, y, z = acc[i, 0] - acc[before, 0], acc[i, 1] - acc[before, 1], acc[i, 2] - acc[before, 2]
            jump[i] = math.sqrt(x * x + y * y + z * z) * per if i >= lag else 0.0
        else:  # the ends are padded with their odd reflection
            end, at = (0, -i) if i < 0 else (n - 1, 2 * (n - 1) - i)
            x, y = 2.0 * gyr[end, 0] - gyr[at, 0] - bx, 2.0 * gyr[end, 1] - gyr[at, 1] - by
            z = 2.0 * gyr[end, 2] - gyr[at, 2] - bz
            rate = x * ux + y * uy + z * uz
        if i == -PADDING:
            early_u, late_u = begun(rate, one)
            early_v, late_v = begun(rate, two)
            early_w, late_w = begun(rate, three)
        j = i + PADDING
        turning[0, j], early_u, late_u = passed(rate, one, early_u, late_u)
        turning[1, j], early_v, late_v = passed(rate, two, early_v, late_v)
        turning[2, j], early_w, late_w = passed(rate, three, early_w, late_w)
    pass_back(one, two, three, turning)
    moving_sums(energy, window, window - window // 2 - 1, 1.0 / window, energy)
    return not math.isnan(off)


@jit
def greatest_at(x: Any, begin: int, end: int) -> int:
    """The first greatest of ``x[begin:end]``."""
    at, greatest = begin, x[begin]
    for i in range(begin + 1, min(end, x.shape[0])):
        if x[i] > greatest:
            at, greatest = i, x[i]
    return at


@jit
def all_greatest_at(x: Any, begins: Any, ends: Any, out: Any) -> None:
    """As :func:`greatest_at` of K spans."""
    for k in range(begins.shape[0]):
        out[k] = greatest_at(x, begins[k], ends[k])


@jit
def typical_falls(falls: Any, out: Any) -> None:
    """At each of K falls the median of the upper third of it and its neighbours: some of the peaks are not swings."""
    near, n, end = np.empty(2 * NEIGHBOURS + 1), 0, 0  # rising
    for k in range(falls.shape[0]):
        if k > NEIGHBOURS:  # one is no neighbour any more
            j = 0
            while near[j] < falls[k - NEIGHBOURS - 1]:
                j += 1
            n -= 1
            while j < n:
                near[j] = near[j + 1]
                j += 1
        while end < min(k + NEIGHBOURS + 1, falls.shape[0]):
            j = n
            while j > 0 and near[j - 1] > falls[end]:
                near[j] = near[j - 1]
                j -= 1
            near[j] = falls[end]
            n, end = n + 1, end + 1
        upper = min(max(3, n // 3), n)
        out[k] = 0.5 * (near[n - upper + upper // 2] + near[n - upper + (upper - 1) // 2])


@jit
def join_swings(shape: Any, falls: Any, offs: Any, mids: Any, kept: Any) -> int:
    """Fill ``kept`` (K, 2) with (push-off's peak, mid-swing) of every swing; how many they are.

    A fall before which the foot has not turned toe-down belongs to the swing before.
    """
    count = 0
    for k in range(mids.shape[0]):
        off, mid = offs[k], mids[k]
        if count > 0:
            last, before = kept[count - 1, 1], mid - 1
            while before > last and shape[before] < TOE_DOWN_SHARE * falls[k]:
                before -= 1
            if shape[before] < TOE_DOWN_SHARE * falls[k]:
                if shape[mid] < shape[last]:
                    kept[count - 1, 1] = mid
                continue
            if off <= last:
                continue
        if off < mid:
            kept[count, 0], kept[count, 1] = off, mid
            count += 1
    return count


@jit
def _share(part: float, whole: float) -> float:
    return min(max(part / whole, 0.0), 1.0) if whole > 0.0 else 0.0


@jit
def _foot_off(x: Any, push_off: int, around: int) -> float:
    """Half-way between push-off's last peak and the fall to a share of its greatest."""
    top = greatest_at(x, max(push_off - around, 1), push_off + around)
    level = FO_FALL_SHARE * x[top]
    below = top
    while below + 1 < x.shape[0] and x[below] > level:
        below += 1
    crossing = below - 1 + _share(x[below - 1] - level, x[below - 1] - x[below])
    last = below - 1
    while last > top and not (x[last] >= x[last - 1] and x[last] >= x[last + 1]):
        last -= 1
    peak = float(last)
    if 0 < last < x.shape[0] - 1:
        left, right = x[last - 1], x[last + 1]
        bend = left - 2.0 * x[last] + right
        if bend < 0.0:
            peak += min(max(0.5 * (left - right) / bend, -0.5), 0.5)
    return 0.5 * (peak + crossing)


@jit
def _rising(x: Any, sign: float, level: float, begin: int, end: int, first: bool) -> float:
    """Where ``sign · x - level`` last (or first) rises through 0 in ``begin`` … ``end``, or NONE; between samples."""
    at = -1
    for i in range(begin, end):
        if sign * x[i] - level < 0.0 and sign * x[i + 1] - level >= 0.0:
            at = i
            if first:
                break
    if at < 0:
        return NONE
    here, there = sign * x[at] - level, sign * x[at + 1] - level
    before: float = (at - begin) - here / (there - here)
    return begin + before


@jit
def _contact(
    s: Signals, push_off: int, mid: int, end: int, cut_off: bool, run: int, peak_rate: float, typical_jump: float
) -> tuple[float, bool]:
    """IC after a mid-swing and before ``end``, and whether the heel struck first.

    ``cut_off``: the recording ends at ``end``; NONE where it does so before the contact has been seen. ``run``: samples
    for which rest must last.
    """
    quietest, least = mid, s.energy[mid]
    for i in range(mid, end + 1):
        if s.energy[i] < least:
            quietest, least = i, s.energy[i]
    if cut_off and least > (2.0 * REST_SHARE * peak_rate) ** 2:
        return NONE, False
    over, flat, level = quietest, 0, max(2.0 * least, (FLAT_SHARE * peak_rate) ** 2)
    for i in range(mid, end + 1):  # where the first rest of some length ends its first part
        flat = flat + 1 if s.energy[i] <= level else 0
        if flat >= run:
            over = i
            break
    strongest = s.shape[push_off]
    loading = greatest_at(s.shape, mid, over + 1)
    if s.shape[loading] > HEEL_SHARE * strongest:
        at = _rising(s.turn, 1.0, TURN_SHARE * strongest, mid, loading, False)
        if at != NONE:
            return at, True
    impact = greatest_at(s.jump, mid, over + 1)
    if s.jump[impact] > max(IMPACT_SHARE * typical_jump, IMPACT_MPS3):
        level = IMPACT_ONSET_SHARE * s.jump[impact]
        while impact > mid + 1 and s.jump[impact - 1] > level:
            impact -= 1
        before, after = s.jump[impact - 1], s.jump[impact]
        return impact - _share(after - level, after - before), False  # between samples: it began before this one
    # a soft contact: the heel begins to drop (or, failing that, the foot has come to rest)
    top = mid
    while top < over and (s.shape[top + 1] > s.shape[top] or s.shape[top] < -SOFT_SHARE * strongest):
        top += 1
    at = _rising(s.turn, -1.0, 0.0, top, over, True)
    if at == NONE:
        at = _rising(s.turn, 1.0, 0.0, mid, over, False)
    return (at if at != NONE else float(over)), False


@jit
def _time_ns(t_ns: Any, at: float) -> int:
    """The time of a place between samples."""
    before = max(min(int(at), t_ns.shape[0] - 2), 0)
    since: float = np.rint((t_ns[before + 1] - t_ns[before]) * (at - before) + (t_ns[before] - t_ns[0]))
    time_ns: int = int(since) + t_ns[0]
    return time_ns


@jit
def instants(
    t_ns: Any, s: Signals, falls: Any, peaks: Any, mids: Any, rate_hz: float, lead: float,
    peak_rate: float, typical_jump: float, swings: Any, offs: Any, out: Any, heels: Any,
) -> int:  # fmt: skip
    """Fill ``out`` (K, 3) with the times of FO, mid-swing and IC, and ``heels`` (K,) with whether the heel struck
    first; how many of the swings have them.

    ``falls``, ``peaks``, ``mids`` (K,) as for :func:`join_swings`; ``lead`` goes onto the IC of a heel strike;
    ``swings`` (K, 2) and ``offs`` (K,) are worked in.
    """
    joined, count, last = join_swings(s.shape, falls, peaks, mids, swings), 0, s.shape.shape[0] - 1
    around, run = round(0.1 * rate_hz), max(round(FLAT_S * rate_hz), 1)
    for k in range(joined):
        off = _foot_off(s.feature, swings[k, 0], around)
        if off < swings[k, 1] and (count == 0 or off > swings[count - 1, 1] + 2):
            swings[count, 0], swings[count, 1] = swings[k, 0], swings[k, 1]
            offs[count] = off
            count += 1
    found = 0
    for k in range(count):
        cut_off = k + 1 == count
        end = last if cut_off else int(offs[k + 1])
        mid = swings[k, 1]
        at, heel = _contact(s, swings[k, 0], mid, end, cut_off, run, peak_rate, typical_jump)
        if at != NONE:
            at = min(max(at + (lead if heel else 0.0), mid + 1.0), end - 0.5)
            out[found, 0], out[found, 1], out[found, 2] = _time_ns(t_ns, offs[k]), t_ns[mid], _time_ns(t_ns, at)
            heels[found] = heel
            found += 1
    return found
