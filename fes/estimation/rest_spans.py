"""Quietest instants of rests, and of movements too long to be one swing, in compiled loops; where they come from
:mod:`fes.estimation.zupt` says."""

from __future__ import annotations

from typing import Any

import numpy as np

from fes.estimation.compiled import jit


@jit
def _least(x: Any, begin: int, end: int) -> int:
    """The first least of ``x[begin:end]``."""
    at = begin
    for i in range(begin + 1, end):
        if x[i] < x[at]:
            at = i
    return at


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

    Then the same of its two halves. It is sought ``margin`` samples away from a movement's ends.
    """
    n, begin = rest.shape[0], 0
    todo = np.empty((64, 2), np.int64)
    while begin < n:
        end = begin
        while end < n and not rest[end]:
            end += 1
        after = end + 1
        todo[0, 0], todo[0, 1] = begin, end
        count = 1
        while count > 0:
            count -= 1
            a, b = todo[count, 0], todo[count, 1]
            if b - a <= longest:
                continue
            quiet = _least(energy, a + margin, b - margin)
            for i in range(quiet - half, min(quiet + half + 1, n)):
                rest[i] = True
            if count + 2 > todo.shape[0]:
                more = np.empty((2 * todo.shape[0], 2), np.int64)
                more[:count] = todo[:count]
                todo = more
            todo[count, 0], todo[count, 1] = a, quiet - half
            todo[count + 1, 0], todo[count + 1, 1] = quiet + half + 1, b
            count += 2
        begin = after
