"""Our small filters against scipy's, whose results they must give."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import maximum_filter1d
from scipy.signal import butter, find_peaks, sosfiltfilt

from fes.estimation.events.offline import filter_signals
from fes.estimation.foot.features import STATE, FootParameters
from fes.estimation.numerics.filters import (
    PADDING,
    falls_apart,
    greatest_at_each,
    likeness,
    low_pass,
    moving_sums,
)
from fes.estimation.numerics.records import core_type, new_core, record_type, struct_of
from fes.estimation.tracking.tracker import FULL, LARGEST_VALUE, RESTART_GAP_NS, SILENCE, History, SampleCounts, Samples
from fes.signals import FloatArray, IntArray
from statemachine.guards import Thresholds

ANY = st.floats(-50.0, 50.0)
FEW = st.sampled_from([-1.5, 0.0, 0.5, 1.0, 2.0])  # so that ties and flat tops are common


def signals(least: int, elements: st.SearchStrategy[float] = ANY) -> st.SearchStrategy[FloatArray]:
    return arrays(np.float64, st.integers(least, 200), elements=elements)


CUTOFF_HZ = st.floats(1.0, 100.0)


@settings(deadline=None)
@given(x=signals(PADDING + 1), rate_hz=st.floats(25.0, 2000.0), cutoffs_hz=st.tuples(CUTOFF_HZ, CUTOFF_HZ, CUTOFF_HZ))
def test_the_low_passes_are_scipys(x: FloatArray, rate_hz: float, cutoffs_hz: tuple[float, float, float]) -> None:
    bias, axis = np.array([0.1, -0.2, 0.3]), np.array([0.0, 1.0, 0.0])
    gyr = np.column_stack((0.0 * x, x, 0.0 * x)) + bias
    one, two, three = (low_pass(rate_hz, cutoff_hz) for cutoff_hz in cutoffs_hz)
    turning, energy, jump = np.empty((3, len(x) + 2 * PADDING)), np.empty(len(x)), np.empty(len(x))
    acc = np.cumsum(gyr, axis=0)
    assert filter_signals(acc, gyr, bias, axis, rate_hz, 2, 3, one, two, three, turning, energy, jump)
    for found, cutoff_hz in zip(turning[:, PADDING:-PADDING], cutoffs_hz, strict=True):
        sections = butter(2, min(cutoff_hz, 0.45 * rate_hz), fs=rate_hz, output="sos")
        assert found == pytest.approx(sosfiltfilt(sections, x), rel=1e-8, abs=1e-8)
    assert energy == pytest.approx(np.convolve(x**2, np.full(3, 1.0 / 3.0), "same"), rel=1e-9, abs=1e-9)
    jumped = 0.5 * rate_hz * np.linalg.norm(acc[2:] - acc[:-2], axis=1)
    assert jump == pytest.approx(np.concatenate((np.zeros(2), jumped)), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("of_force", [False, True])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("at", [0, 7, 29])
def test_what_is_not_finite_is_seen_anywhere(of_force: bool, bad: float, at: int) -> None:
    acc, gyr = np.ones((30, 3)), np.ones((30, 3))
    arrays_ = np.empty((3, 30 + 2 * PADDING)), np.empty(30), np.empty(30)
    section = low_pass(100.0, 8.0)
    for column in range(3):
        assert filter_signals(acc, gyr, np.zeros(3), np.ones(3), 100.0, 2, 3, section, section, section, *arrays_)
        (acc if of_force else gyr)[at, column] = bad
        assert not filter_signals(acc, gyr, np.zeros(3), np.ones(3), 100.0, 2, 3, section, section, section, *arrays_)
        (acc if of_force else gyr)[at, column] = 1.0


@settings(deadline=None)
@given(x=signals(1), count=st.integers(1, 40), data=st.data())
def test_moving_sums_are_a_convolution(x: FloatArray, count: int, data: st.DataObject) -> None:
    ahead = data.draw(st.integers(0, count - 1))
    out = np.full(len(x), np.nan)
    moving_sums(x, count, ahead, 0.5, out)
    whole = np.convolve(x, np.full(count, 0.5))
    assert out == pytest.approx(whole[ahead : ahead + len(x)], rel=1e-12, abs=1e-11)


@settings(deadline=None)
@given(x=st.one_of(signals(1), signals(1, FEW)), half=st.integers(0, 40), apart=st.integers(1, 30))
def test_falls_and_their_peaks_are_scipys(x: FloatArray, half: int, apart: int) -> None:
    n = 2 * half + 1
    below = maximum_filter1d(x, n, origin=half) - x
    at, fall = falls_apart(x, n, apart)
    assert np.array_equal(at, find_peaks(below, distance=apart)[0])
    assert np.array_equal(fall, below[at])


def test_no_samples_do_not_fall() -> None:
    assert [len(found) for found in falls_apart(np.zeros(0), 5, 3)] == [0, 0]


# --- Which samples a tracker uses, and what it keeps of them ---


STEP_NS = 10_000_000
TOLD_NS = (-2 * STEP_NS, 0, STEP_NS, 2 * STEP_NS, RESTART_GAP_NS, RESTART_GAP_NS + 1)
ROW = tuple[int, float, bool]


def fed(history: History, t_ns: IntArray, values: FloatArray, cuts: list[int]) -> list[ROW]:
    """Give samples in blocks, as a tracker does; all that were taken: time, value, and whether it began anew."""
    seen: list[ROW] = []
    at, anew = 0, False
    for begin, end in pairwise([0, *sorted(cuts), len(t_ns)]):
        acc = np.repeat(values[begin:end, None], 3, axis=1)
        taken = 0
        while taken < end - begin:
            taken, outcome = history.store(Samples(t_ns[begin:end], acc, -acc), taken)
            for row in range(at, history.filled):
                seen.append((int(history.arrays.t_ns[row]), float(history.arrays.acc[row, 1]), anew))
                assert history.arrays.gyr[row, 2] == -seen[-1][1]
                anew = False
            if outcome == SILENCE:
                history.restart(int(t_ns[begin + taken]))
                anew = True
            elif outcome == FULL:
                history.forget_half()
            at = history.filled
    return seen


def expected(t_ns: IntArray, values: FloatArray) -> tuple[list[ROW], SampleCounts]:
    """The same in plain words."""
    seen: list[ROW] = []
    counts = SampleCounts()
    for t, value in zip(t_ns.tolist(), values.tolist(), strict=True):
        if not abs(value) < LARGEST_VALUE:
            counts.not_finite += 1
        elif seen and t <= seen[-1][0]:
            counts.doubled_or_backward += 1
        else:
            seen.append((t, value, not seen or t - seen[-1][0] > RESTART_GAP_NS))
            counts.used += 1
    return seen, counts


@settings(deadline=None)
@given(
    steps=st.lists(
        st.tuples(st.sampled_from(TOLD_NS), st.sampled_from([1.0, -3.0, np.nan, np.inf, LARGEST_VALUE])), max_size=150
    ),
    cuts=st.lists(st.integers(0, 150), max_size=6),
    start_ns=st.sampled_from([-(10**15), 0, 10**18]),
)
def test_samples_used_are_those_of_the_plain_rule(
    steps: list[tuple[int, float]], cuts: list[int], start_ns: int
) -> None:
    t_ns = np.cumsum(np.array([start_ns, *(step for step, _ in steps)], np.int64))
    values = np.array([1.0, *(value for _, value in steps)])
    history = History(rate_hz=1.0)  # 64 rows, so that they fill up
    seen, counts = expected(t_ns, values)
    assert fed(history, t_ns, values, [min(cut, len(t_ns)) for cut in cuts]) == seen
    assert history.counts(0) == counts


def test_what_is_forgotten_is_the_older_half() -> None:
    history = History(rate_hz=1.0)
    t_ns = STEP_NS * np.arange(64)
    fed(history, t_ns, np.arange(64.0), [])
    kept = history.arrays
    kept.trace[:, 0] = np.arange(64.0)
    history.forget_half()
    assert history.filled == 32
    for column in (kept.t_ns / STEP_NS, kept.acc[:, 0], -kept.gyr[:, 0], kept.trace[:, 0]):
        assert np.array_equal(column[:32], np.arange(32.0, 64.0))


@pytest.mark.parametrize(("first_ns", "then_ns"), [(-(2**62) - 1, 2**62), (-(2**63) + 1, 2**63 - 1)])
def test_stamps_too_far_apart_to_subtract_are_a_silence(first_ns: int, then_ns: int) -> None:
    seen = fed(History(100.0), np.array([first_ns, then_ns]), np.ones(2), [])
    assert seen == [(first_ns, 1.0, True), (then_ns, 1.0, True)]


def test_a_core_holds_its_parts_under_their_own_names() -> None:
    parameters = FootParameters(*map(float, range(10)), jerk_lag=2)
    thresholds = Thresholds(swing_at_reversal=True, push_off_radps=5.0)
    kind = core_type(STATE, parameters=FootParameters, thresholds=Thresholds)
    core = new_core(kind, parameters=parameters, thresholds=thresholds)
    assert FootParameters(*core["parameters"][0].tolist()) == parameters
    assert Thresholds(*core["thresholds"][0].tolist()) == thresholds
    assert core["thresholds"].dtype["swing_at_reversal"] == np.bool_
    assert core["parameters"].dtype["jerk_lag"] == np.int64
    assert not core["state"]["samples"][0]


def test_a_struct_reads_and_writes_what_numpy_would() -> None:
    inner = record_type([("flag", np.bool_), ("x", np.float64)])
    kind = record_type(
        [("n", np.int64), ("flag", np.bool_), ("m", np.float64, (2, 2)), ("inner", inner), ("k", np.int64)]
    )
    row = np.zeros(1, kind)
    struct_of(kind, "n", "flag").pack_into(row.view(np.uint8).data, 0, 7, True)
    row["m"], row["inner"]["x"], row["k"] = [[1.0, 2.0], [3.0, 4.0]], 5.0, -1
    data = row.view(np.uint8).data
    assert struct_of(kind).unpack_from(data) == (7, True, 1.0, 2.0, 3.0, 4.0, False, 5.0, -1)
    assert struct_of(kind, "n", "inner", "k").unpack_from(data) == (7, False, 5.0, -1)
    assert row[0].inner.x == 5.0  # an attribute without the compiler as well


@settings(deadline=None)
@given(st.integers(1, 60), st.integers(0, 30), st.integers(1, 80), st.integers(0, 2**32 - 1))
def test_likeness_is_the_correlation_with_itself(n: int, shortest: int, lags: int, seed: int) -> None:
    x, found = np.random.default_rng(seed).normal(size=n), np.empty(lags)
    likeness(x, min(shortest, n), found)
    wanted = np.concatenate((np.correlate(x, x, "full")[n - 1 :], np.zeros(shortest + lags)))[min(shortest, n) :][:lags]
    assert np.allclose(found, wanted, rtol=1e-12, atol=1e-12)


def test_the_greatest_of_each_span_is_its_first_and_spans_end_with_the_signal() -> None:
    x = np.array([0.0, 3.0, 1.0, 3.0, 2.0])
    assert greatest_at_each(x, np.array([0, 2, 4]), np.array([5, 4, 9])).tolist() == [1, 3, 4]
