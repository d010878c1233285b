"""Quietest instants of rests, and of movements too long to be one swing, in compiled loops; where they come from
:mod:`fes.estimation.zupt` says."""

from __future__ import annotations

from typing import Any

from fes.estimation.compiled import jit


@jit
def _least(x: Any, begin: int, end: int) -> int:
    """The first least of ``x[begin:end]``."""
    at, least = begin, x[begin]
    for i in range(begin + 1, end):
        if x[i] < least:
            at, least = i, x[i]
    return at


@jit
def first_lasting(rest: Any, count: int) -> int:
    """The first sample with which ``rest`` (N,) has held for ``count`` samples in a row, 0 if there is none."""
    lasted = 0
    for i in range(rest.shape[0]):
        lasted = lasted + 1 if rest[i] else 0
        if lasted == count:
            return i
    return 0


@jit
def quietest_of_rests(rest: Any, energy: Any, apart: float, out: Any) -> int:
    """Fill ``out`` with where the ``energy`` (N,) is least in each rest; rests closer than ``apart`` samples are one.

    How many there are: at most half of the samples and one.
    """
    count, begin, end = 0, -1, -1
    for i in range(rest.shape[0]):
        if not rest[i]:
            continue
        if begin < 0:
            begin = i
        elif i > end and i - end >= apart:
            out[count] = _least(energy, begin, end)
            count, begin = count + 1, i
        end = i + 1
    if begin >= 0:
        out[count] = _least(energy, begin, end)
        count += 1
    return count


@jit
def rest_in_long_moves(rest: Any, energy: Any, longest: float, half: int, margin: int) -> None:
    """Mark ``half`` samples around the least ``energy`` of every movement of more than ``longest`` samples as rest.

    Then the same of its two halves. It is sought ``margin`` samples away from a movement's ends, more than ``half``.
    """
    n, begin, end = rest.shape[0], 0, 0
    while end <= n:
        if end < n and not rest[end]:
            end += 1
        elif end - begin > longest:
            quiet = _least(energy, begin + margin, end - margin)
            for i in range(quiet - half, min(quiet + half + 1, n)):
                rest[i] = True
            end = quiet - half  # its first half may be too long still
        else:
            begin, end = end + 1, end + 1
