"""Quietest instants of rests and of long movements, against the same in plain numpy."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from fes.estimation.zupt.thresholds import mark_missed_stances, quietest_instants

REST = st.integers(40, 200).flatmap(lambda n: arrays.arrays(np.bool_, n))


def spans_of(mask):
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    return edges[0::2].tolist(), edges[1::2].tolist()


@settings(deadline=None)
@given(REST, st.integers(0, 5), st.integers(0, 2**32 - 1))
def test_the_quietest_of_every_rest(rest, apart, seed):
    energy = np.random.default_rng(seed).integers(0, 9, len(rest)).astype(np.float64)
    out = np.empty(len(rest) // 2 + 1, np.int64)
    found = out[: quietest_instants(rest, energy, float(apart), out)]
    joined: list[list[int]] = []
    for begin, end in zip(*spans_of(rest), strict=True):
        if joined and begin - joined[-1][1] < apart:
            joined[-1][1] = end
        else:
            joined.append([begin, end])
    assert found.tolist() == [begin + int(energy[begin:end].argmin()) for begin, end in joined]


@settings(deadline=None)
@given(REST, st.integers(12, 40), st.integers(0, 2**32 - 1))
def test_long_movements_are_split_at_their_quietest(rest, longest, seed):
    energy = np.random.default_rng(seed).random(len(rest))
    half, margin = 1, round(0.32 * longest)
    expected = rest.copy()
    todo = list(zip(*spans_of(~rest), strict=True))
    while todo:
        begin, end = todo.pop()
        if end - begin > longest:
            quiet = begin + margin + int(np.argmin(energy[begin + margin : end - margin]))
            expected[quiet - half : quiet + half + 1] = True
            todo += [(begin, quiet - half), (quiet + half + 1, end)]
    found = rest.copy()
    mark_missed_stances(found, energy, float(longest), half, margin)
    assert np.array_equal(found, expected)
