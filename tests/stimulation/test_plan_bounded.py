"""Bursts whose end is not seen fall by prediction; where the samples come late none starts before there is one."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_plan import LOADING, MS, PRE_SWING, STANCE, SWING, TRANSITIONS, Walk, make_channel

from fes.stimulation.plan import GROWS_NS, LASTED, LATER_NS
from statemachine.phases import PhaseChange

PRE_MS, SWING_MS, REST_MS, EXTENSION_MS, FALL_MS = 200, 400, 600, 60, 100


def bounded(**changes: Any) -> Walk:
    return Walk(make_channel(onset="predicted", **changes), late=frozenset({"left_foot"}))


def step(walk: Walk, pre_ms: int = PRE_MS, swing_ms: int = SWING_MS, seen: bool = True, late_ms: int = 0) -> list[int]:
    """One stride; at which ms since T1 there is current. Not ``seen``: no phase is told after foot off."""
    walk.current(walk.t_ms + REST_MS)
    t1_ms, found = walk.t_ms, list[int]()
    ends_ms = pre_ms + swing_ms
    told = {0: PRE_SWING, pre_ms: SWING} | ({ends_ms: LOADING, ends_ms + 200: STANCE} if seen else {})
    for ms in range(ends_ms + 1500):
        walk.current(t1_ms + ms)
        for at_ms, phase in told.items():
            if ms == at_ms + late_ms:  # the plan is told when it was, by then
                source, walk.phase = walk.phase, phase
                entered = PhaseChange((t1_ms + at_ms) * MS, "left_foot", TRANSITIONS[source, phase], source, phase)
                walk.plan.on_phase(entered, permitted=True)
        if walk.current(t1_ms + ms) > 0.0:
            found.append(ms)
    return found


@pytest.mark.requirement("SR-30")
def test_none_starts_before_its_end_can_be_predicted() -> None:
    walk = bounded()
    assert [bool(step(walk)) for _ in range(5)] == [False, False, False, True, True]
    walk.lose()
    assert [bool(step(walk)) for _ in range(4)] == [False, False, False, True]


@pytest.mark.requirement("SR-30")
def test_a_burst_falls_by_prediction_where_no_contact_is_seen() -> None:
    walk = bounded()
    for swing_ms in (SWING_MS, SWING_MS + 30, SWING_MS):
        step(walk, swing_ms=swing_ms)
    last = step(walk, seen=False)[-1]
    assert last == pytest.approx(PRE_MS + SWING_MS + 30 + EXTENSION_MS + FALL_MS, abs=5)


@pytest.mark.requirement("SR-30")
@pytest.mark.parametrize("late_ms", [0, 50, 110])
def test_a_contact_told_late_ends_it_as_if_told_at_once(late_ms: int) -> None:
    prompt, late = bounded(), bounded()
    for walk in (prompt, late):
        for _ in range(3):
            step(walk, swing_ms=SWING_MS + 200)
    on_prompt, on_late = step(prompt), step(late, late_ms=late_ms)
    assert on_late[-1] <= max(on_prompt[-1], PRE_MS + SWING_MS + late_ms + 1)
    assert on_late[0] == on_prompt[0] + late_ms


@pytest.mark.requirement("SR-30")
@settings(max_examples=50, deadline=None)
@given(
    swings_ms=st.lists(st.integers(250, 600), min_size=3, max_size=6),
    last_ms=st.integers(250, 600),
    seen=st.booleans(),
    late_ms=st.integers(0, 120),
)
def test_late_samples_never_lengthen_a_burst(swings_ms: list[int], last_ms: int, seen: bool, late_ms: int) -> None:
    walk = bounded()
    for swing_ms in swings_ms:
        step(walk, swing_ms=swing_ms)
    found = step(walk, swing_ms=last_ms, seen=seen, late_ms=late_ms)
    assert found[-1] <= PRE_MS + max(swings_ms) + EXTENSION_MS + FALL_MS + 5
    if seen:
        assert found[-1] <= PRE_MS + last_ms + late_ms + EXTENSION_MS + FALL_MS + 5


# --- by cable ---------------------------------------------------------------------------------------------------------
AFTER_MS = LATER_NS // MS + EXTENSION_MS + FALL_MS


@pytest.mark.requirement("SR-30")
@settings(max_examples=50, deadline=None)
@given(swings_ms=st.lists(st.integers(250, 600), min_size=4, max_size=12))
def test_an_end_that_is_not_seen_is_a_quarter_and_a_tenth_of_a_second_after_the_usual(swings_ms: list[int]) -> None:
    walk = Walk(make_channel())
    ended = [step(walk, swing_ms=swing_ms)[-1] for swing_ms in swings_ms]
    usual_ms = sorted(swings_ms[-LASTED:])[len(swings_ms[-LASTED:]) // 2]
    assert step(walk, seen=False)[-1] <= PRE_MS + 1.25 * usual_ms + AFTER_MS + 5
    assert all(
        end <= PRE_MS + swing_ms + EXTENSION_MS + FALL_MS + 5 for end, swing_ms in zip(ended, swings_ms, strict=True)
    )


@pytest.mark.requirement("SR-30")
def test_what_lasts_longer_becomes_usual_slowly() -> None:
    walk = Walk(make_channel())
    for _ in range(LASTED):
        step(walk)
    found = [step(walk, swing_ms=1000)[-1] for _ in range(9)]
    assert found[0] == pytest.approx(PRE_MS + 1.25 * SWING_MS + AFTER_MS, abs=5)
    assert all(later - earlier <= 1.25 * GROWS_NS / MS + 1 for earlier, later in pairwise(found))
    assert found[-1] > found[0]


@pytest.mark.requirement("SR-30")
def test_the_first_bursts_by_cable_need_no_prediction() -> None:
    walk = Walk(make_channel())
    assert step(walk)


@pytest.mark.requirement("SR-30")
@pytest.mark.parametrize("pre_ms", range(700, 1100, 20))
def test_a_burst_that_falls_does_not_rise_again(pre_ms: int) -> None:
    walk = Walk(make_channel())
    for _ in range(LASTED):
        step(walk)
    walk.current(walk.t_ms + REST_MS)
    walk.enter(PRE_SWING)
    t1_ms, levels = walk.t_ms, list[float]()
    for ms in range(1, pre_ms + SWING_MS):
        levels.append(walk.current(t1_ms + ms))
        if ms == pre_ms:
            walk.enter(SWING)
    top = levels.index(max(levels))
    assert levels[top:] == sorted(levels[top:], reverse=True)
