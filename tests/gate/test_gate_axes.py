"""Axes that change from one sample to the next: told two samples later, and never by a jump of another kind."""

from __future__ import annotations

import math
from itertools import permutations, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from judges import Axes

from fes.gate.plausibility import BOUNDS, Plausibility
from fes.signals import ImuSample, Vector3

MS = 1_000_000
ZERO: Vector3 = (0.0, 0.0, 0.0)
FORCE: Vector3 = (6.0, -7.0, 12.0)
RATE: Vector3 = (3.0, 5.0, -2.0)
TURNED = ((-7.0, 12.0, 6.0), (5.0, -2.0, 3.0))  # y, z, x of them
Exchange = tuple[tuple[int, ...], tuple[float, ...]]


def turns(exchange: Exchange) -> bool:
    """Whether a box can be put so; the others are mirrored."""
    order, signs = exchange
    axes_of = np.eye(3)[list(order)] * np.array(signs)[:, None]
    return bool(np.linalg.det(axes_of) > 0.0)


ALL: list[Exchange] = list(product(permutations(range(3)), product((1.0, -1.0), repeat=3)))
EXCHANGES = [exchange for exchange in ALL if turns(exchange)]
MIRRORED = [exchange for exchange in ALL if not turns(exchange)]
MIRRORED.remove(((0, 1, 2), (-1.0, -1.0, -1.0)))  # of the values below, half a turn comes close to it
SAID = "the axes of left_foot changed from one sample to the next: remounted?"
Pair = tuple[Vector3, Vector3]


def exchanged(a: Vector3, order: tuple[int, ...], signs: tuple[float, ...]) -> Vector3:
    return (signs[0] * a[order[0]], signs[1] * a[order[1]], signs[2] * a[order[2]])


def moved(a: Vector3, by: float, axis: int = 0) -> Vector3:
    return (a[0] + by * (axis == 0), a[1] + by * (axis == 1), a[2] + by * (axis == 2))


def apart(a: Vector3, b: Vector3) -> float:
    return sum((x - y) ** 2 for x, y in zip(a, b, strict=True))


def told(pairs: list[Pair], step_ns: int = 10 * MS, **bounds: Any) -> list[int]:
    """At which of these samples it is said that the axes changed."""
    judge, at = Axes(bounds=BOUNDS._replace(**bounds)), []
    for k, (acc, gyr) in enumerate(pairs):
        said = judge.fault(ImuSample(0, "left_foot", 5 + k * step_ns, acc, gyr))
        assert said in ("", SAID)
        if said:
            at.append(k)
    return at


@pytest.mark.parametrize(("order", "signs"), EXCHANGES)
def test_every_exchange_is_told_two_samples_later_and_once(order: tuple[int, ...], signs: tuple[float, ...]) -> None:
    before = [(moved(FORCE, 0.3 * k), moved(RATE, 0.1 * k, 1)) for k in range(10)]
    changed = [(exchanged(acc, order, signs), exchanged(gyr, order, signs)) for acc, gyr in before[5:]]
    same = (order, signs) == EXCHANGES[0]
    assert told(before[:5] + changed) == ([] if same else [7])
    assert told(before) == []


@pytest.mark.parametrize(("order", "signs"), MIRRORED)
def test_what_is_mirrored_is_not_told(order: tuple[int, ...], signs: tuple[float, ...]) -> None:
    """So that a hard heel strike, which may turn the force around, is none."""
    mirrored = exchanged(FORCE, order, signs), exchanged(RATE, order, signs)
    assert told([(FORCE, RATE)] * 3 + [mirrored] * 4) == []


def one_jump(acc: Vector3, gyr: Vector3, before: int = 2, after: int = 3) -> list[int]:
    """Still, then other values, still."""
    return told([(FORCE, RATE)] * before + [(acc, gyr)] * after)


def test_a_jump_that_no_exchange_explains_is_a_heel_strike() -> None:
    acc, gyr = TURNED
    assert one_jump(acc, gyr) == [4]
    assert one_jump((-30.0, 12.0, 6.0), gyr) == [], "of another size"
    assert one_jump(FORCE, gyr) == [], "the force does not go along"
    assert one_jump(acc, RATE) == [], "the rate does not go along"
    assert one_jump(acc, (-2.0, 3.0, 5.0)) == [], "each goes its own way"


def test_what_an_exchange_leaves_is_an_eighth_of_the_jump_at_most() -> None:
    def changed(rest_mps2: float) -> Vector3:
        return (-7.0, 12.0 - rest_mps2, 6.0)

    def left(rest_mps2: float) -> float:
        of_force = [apart(changed(rest_mps2), exchanged(FORCE, *exchange)) for exchange in EXCHANGES]
        return min(of_force) / apart(changed(rest_mps2), FORCE)

    limit = next(r / 1000 for r in range(12_000) if left(r / 1000) > 0.09)
    for rest_mps2, at in ((limit - 0.002, [4]), (limit, [])):
        assert told([(FORCE, ZERO)] * 2 + [(changed(rest_mps2), ZERO)] * 3) == at


@pytest.mark.parametrize(("changed", "limit"), [(0.0, 0.2127), (0.2, 0.3357)])
def test_a_force_that_turns_around_is_no_exchange_where_the_rate_speaks_against_it(
    changed: float, limit: float
) -> None:
    """Under a heel. Half a turn about y leads there, and from rate (w, 3, 0) to (-w, 3, 0).

    That may be farther from the new rate than the old one is by 0.02 of the square, 9 + w².
    """
    down, up = (0.0, 0.0, -10.0), (0.0, 0.0, 10.0)

    def with_rate(w: float) -> list[int]:
        return told([(up, (w, 3.0, 0.0))] * 2 + [(down, (w - changed, 3.0, 0.0))] * 3)

    assert with_rate(limit - 0.001) == [4]
    assert with_rate(limit + 0.001) == []
    assert with_rate(0.9) == [], "all in all the exchange would explain it"


@pytest.mark.parametrize("before", [0, 1, 2])
def test_two_samples_have_to_come_before(before: int) -> None:
    assert one_jump(*TURNED, before) == ([4] if before == 2 else [])


def test_a_jump_back_is_a_knock() -> None:
    still, turned = (FORCE, RATE), TURNED
    assert told([still] * 3 + [turned] + [still] * 5) == []
    assert told([still] * 3 + [turned] * 2 + [still] * 5) == []
    assert told([still] * 3 + [turned] * 3 + [still] * 5) == [5, 8]


def test_a_jolt_from_which_the_force_comes_back_is_none() -> None:
    """As of a foot that is pulled off the ground while it hardly turns: two samples after it, it is on its way back."""
    before, after = ((2.1, -0.3, 12.7), (0.0, 0.3, 0.0)), ((-14.0, -1.3, 5.9), (0.0, 0.46, 0.0))
    half, back = (-8.1, -0.9, 6.9), (-2.6, -0.6, 9.0)
    assert told([before] * 3 + [after] * 3) == [5]
    assert told([before] * 3 + [after] + [(half, after[1])] * 2) == [5]
    assert told([before] * 3 + [after] + [(half, after[1]), (back, after[1])]) == []


@pytest.mark.parametrize(
    ("of_force", "of_rate", "is_told"),
    [(0.5, 0.5, True), (0.5, 0.51, False), (0.51, 0.5, False), (0.6, 0.3, True), (0.3, 0.6, True), (0.7, 0.4, False)],
)
def test_two_samples_later_it_is_no_nearer_to_what_was(of_force: float, of_rate: float, is_told: bool) -> None:
    """Two axes exchanged, and on the straight way back by these shares; each counts by its own size: half of both."""

    def at(of_force: float, of_rate: float) -> Pair:
        return (4.0 * of_force, 4.0 - 4.0 * of_force, 0.0), (2.0 * of_rate, 2.0 - 2.0 * of_rate, 0.0)

    assert told([at(1.0, 1.0)] * 3 + [at(0.0, 0.0), at(0.5 * of_force, 0.5 * of_rate), at(of_force, of_rate)]) == (
        [5] if is_told else []
    )


JUMP = (13**2 + 19**2 + 6**2) / 229 + (2**2 + 7**2 + 5**2) / 38
FORCE_STEP, RATE_STEP = math.sqrt(0.13 * JUMP * 229), math.sqrt(0.13 * JUMP * 38)


@pytest.mark.parametrize("at", [2, 4, 5])
@pytest.mark.parametrize("by", [(FORCE_STEP, 0.0), (0.0, RATE_STEP)], ids=["force", "rate"])
@pytest.mark.parametrize(("share", "is_told"), [(0.999, True), (1.001, False)])
def test_the_steps_about_it_are_below_an_eighth_of_it(
    at: int, by: tuple[float, float], share: float, is_told: bool
) -> None:
    """A jump by 566/229 + 78/38 at sample 3, and a step at another sample; one after those does not matter."""
    pairs = [(FORCE, RATE)] * 3 + [TURNED] * 4
    for k in range(at) if at < 3 else range(at, len(pairs)):
        acc, gyr = pairs[k]
        pairs[k] = moved(acc, share * by[0], 2), moved(gyr, share * by[1], 2)
    assert told(pairs) == [5] * is_told
    assert told([*pairs[:6], (moved(pairs[5][0], 50.0, 2), pairs[5][1])]) == [5] * is_told


@pytest.mark.parametrize("of_rate", [False, True])
def test_a_jump_has_a_least_size(of_rate: bool) -> None:
    """Two axes exchanged that are nearly alike: force (f, f + d) to (f + d, f) jumps by 2 d²."""
    # size squared 25 + (d - 5)², jump 2 (10 - d)²
    limit = next(d / 1000 for d in range(10_000) if 2 * (10 - d / 1000) ** 2 < 0.7 * (25 + (d / 1000 - 5) ** 2))
    for d, at in ((limit - 0.002, [4]), (limit, [])):
        one, other = (5.0, -5.0 + d, 0.0), (-5.0 + d, 5.0, 0.0)
        still, turned = ((ZERO, one), (ZERO, other)) if of_rate else ((one, ZERO), (other, ZERO))
        assert told([still] * 2 + [turned] * 3) == at


@pytest.mark.parametrize("bounds", [{}, *({"least_force2": each**2, "least_rate2": each**2} for each in (2.0, 3.0))])
@pytest.mark.parametrize(("share", "at"), [(0.593, [4]), (0.590, [])])
def test_small_forces_and_rates_do_not_count_as_jumps(bounds: dict[str, float], share: float, at: list[int]) -> None:
    """Of the least size, two axes exchanged jump by 2; a size of 0.5916 of it just reaches 0.7."""
    least = BOUNDS._replace(**bounds)
    force, rate = share * math.sqrt(least.least_force2), share * math.sqrt(least.least_rate2)
    assert told([((force, 0.0, 0.0), ZERO)] * 2 + [((0.0, force, 0.0), ZERO)] * 3, **bounds) == at
    assert told([(ZERO, (rate, 0.0, 0.0))] * 2 + [(ZERO, (0.0, rate, 0.0))] * 3, **bounds) == at


@pytest.mark.parametrize("some", [(FORCE, ZERO), (ZERO, RATE)])
def test_the_larger_of_both_sizes_counts(some: Pair) -> None:
    """What vanishes leaves nothing that an exchange could not explain, and jumps by its own size at most."""
    assert told([some] * 2 + [(ZERO, ZERO)] * 3) == []
    assert told([(ZERO, ZERO)] * 2 + [some] * 3) == []


def test_at_a_bound_it_is_still_told() -> None:
    """With bounds that binary numbers can hold: the jump is 2 of its size, or 3 halves with a third of them left."""
    zero, along, across = ZERO, (4.0, 0.0, 0.0), (0.0, 4.0, 0.0)
    jump: dict[str, Any] = {"least_jump": 2.0}
    assert told([(along, zero)] * 2 + [(across, zero)] * 3, **jump) == [4]
    jump["smooth"] = 0.125
    assert told([(moved(along, -2.0), zero), (along, zero)] + [(across, zero)] * 3, **jump) == [4]
    assert told([(along, zero)] * 2 + [(across, zero)] + [(moved(across, 2.0, 2), zero)] * 2, **jump) == [4]
    assert told([(along, zero)] * 2 + [((0.0, 4.0, 4.0), zero)] * 3, smooth=0.125, explained=1 / 3) == [4]
    assert told([(along, zero)] * 2 + [(across, zero)] * 3, smooth=0.125, against=0.0) == [4]


@pytest.mark.parametrize(
    ("apart_ns", "seen"),
    [(BOUNDS.most_apart_ns, True), (BOUNDS.most_apart_ns + 1, False), (1, True), (0, False), (-9, False)],
)
def test_only_samples_that_follow_each_other_are_compared(apart_ns: int, seen: bool) -> None:
    pairs = [(FORCE, RATE)] * 2 + [TURNED] * 3
    assert told(pairs, apart_ns) == ([4] if seen else [])


@pytest.mark.parametrize("gap_at", range(6))
def test_a_gap_begins_anew(gap_at: int) -> None:
    judge, said, t_ns = Axes(), [], 0
    for k in range(6):
        t_ns += 100 * MS if k == gap_at else 10 * MS
        acc, gyr = (FORCE, RATE) if k < 3 else TURNED
        said.append(bool(judge.fault(ImuSample(0, "left_foot", t_ns, acc, gyr))))
    assert said == [False] * 5 + [gap_at in (0, 1)]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
def test_what_is_no_number_is_no_exchange_and_is_forgotten(bad: float) -> None:
    still, turned = (FORCE, RATE), TURNED
    for wrong in ((moved(FORCE, bad), RATE), (FORCE, moved(RATE, bad))):
        assert told([still, wrong, still, still, still] + [turned] * 3) == [7]
        assert told([still, still, wrong, wrong, wrong]) == []


def test_it_is_a_fault_of_the_sensor_whether_calibrated_or_not() -> None:
    judge = Plausibility("left_foot", None, None)
    said = [
        judge.fault(ImuSample(k * 10 * MS, "left_foot", k * 10 * MS, *pair))
        for k, pair in enumerate([(FORCE, RATE)] * 3 + [TURNED] * 3)
    ]
    assert said == ["", "", "", "", "", SAID]


def expected(pairs: list[Pair]) -> list[int]:
    """The rule over a whole list: where a jump stands between smooth steps, and an exchange explains it."""
    at, k = [], 2
    while k < len(pairs) - 2:
        (acc, gyr), (acc_before, gyr_before) = pairs[k], pairs[k - 1]
        force, rate = (
            max(apart(a, (0, 0, 0)), apart(b, (0, 0, 0)), least**2)
            for a, b, least in ((acc, acc_before, 4.0), (gyr, gyr_before, 1.0))
        )
        before, jump, first, second = (
            apart(pairs[i][0], pairs[i - 1][0]) / force + apart(pairs[i][1], pairs[i - 1][1]) / rate
            for i in range(k - 1, k + 3)
        )
        explained = [
            each
            for each in EXCHANGES
            if (of_rate := apart(gyr, exchanged(gyr_before, *each)) / rate) <= apart(gyr, gyr_before) / rate + 0.02
            and apart(acc, exchanged(acc_before, *each)) / force + of_rate <= 0.09 * jump
        ]
        if jump < 0.7 or before > 0.13 * jump or not explained:
            k += 1
        elif first > 0.13 * jump:
            k += 2
        else:
            to_exchanged, to_before = (
                apart(pairs[k + 2][0], a) / force + apart(pairs[k + 2][1], b) / rate
                for a, b in (
                    (exchanged(acc_before, *explained[0]), exchanged(gyr_before, *explained[0])),
                    (acc_before, gyr_before),
                )
            )
            at += [k + 2] * (second <= 0.13 * jump and to_exchanged <= to_before)
            k += 3
    return at


drift = st.tuples(st.just("drift"), st.floats(-3.0, 3.0), st.integers(0, 2))
knock = st.tuples(st.just("knock"), st.floats(-30.0, 30.0), st.integers(0, 2))
exchange = st.tuples(st.just("exchange"), st.sampled_from(EXCHANGES), st.just(0))


@given(st.lists(st.one_of(drift, drift, drift, exchange, knock), min_size=5, max_size=25))
def test_it_speaks_exactly_where_the_rule_does(changes: list[tuple[str, Any, int]]) -> None:
    acc, gyr, pairs = FORCE, RATE, []
    for kind, how, axis in changes:
        if kind == "exchange":
            acc, gyr = exchanged(acc, *how), exchanged(gyr, *how)
        else:
            acc, gyr = moved(acc, how, axis), moved(gyr, 0.3 * how, 2 - axis)
        pairs.append((acc, gyr))
    assert told(pairs) == expected(pairs)
