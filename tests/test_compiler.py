"""Compiled functions borrow the arrays that they are given: nothing is counted, nothing is lost."""

from __future__ import annotations

import gc
import sys
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.compiled import jit, jit_ieee


class Pair(NamedTuple):
    """Two arrays."""

    one: Any
    other: Any


@jit
def _tail(x: Any, begin: int) -> Any:
    return x[begin:]


@jit
def _sums(pair: Pair, out: Any) -> float:
    own = np.empty(3)
    for k in range(3):
        own[k] = 0.0
    for i in range(pair.one.shape[0]):
        row = pair.one[i]
        for k in range(3):
            own[k] += row[k] * pair.other[i]
    for k in range(3):
        out[k] = own[k]
    total: float = own[0] + own[1] + own[2]
    return total


@jit_ieee
def _last_of_tail(x: Any) -> float:
    last: float = _tail(x, 1)[-1]
    return last


def test_a_part_that_is_given_back_outlives_what_it_is_a_part_of() -> None:
    """It owns the memory, though its whole was only lent."""
    tails = [_tail(np.full(1000, float(k)), 10) for k in range(50)]
    gc.collect()
    assert all(len(tail) == 990 and (tail == k).all() for k, tail in enumerate(tails))
    assert _last_of_tail(np.arange(5.0)) == 4.0


def test_no_reference_is_kept_or_lost() -> None:
    """Neither to arrays nor to those in a tuple."""
    pair, out = Pair(np.ones((20, 3)), np.arange(20.0)), np.empty(3)
    before = [sys.getrefcount(array) for array in (*pair, out)]
    for _ in range(100):
        assert _sums(pair, out) == 3 * 190.0
    assert out.tolist() == [190.0] * 3
    assert [sys.getrefcount(array) for array in (*pair, out)] == before
