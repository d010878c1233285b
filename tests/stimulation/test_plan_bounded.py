"""Bursts of a foot whose samples come late: they fall by prediction, and none starts before there is one."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_plan import LOADING, MS, PRE_SWING, STANCE, SWING, Walk, make_channel

from statemachine.phases import PhaseChange, Transition

PRE_MS, SWING_MS, REST_MS, EXTENSION_MS, FALL_MS = 200, 400, 600, 60, 100


def bounded(**changes: Any) -> Walk:
    return Walk(make_channel(onset="predicted", **changes), bounded=frozenset({"left_foot"}))


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
                entered = PhaseChange((t1_ms + at_ms) * MS, "left_foot", _transition(phase), walk.phase, phase)
                walk.phase = phase
                walk.plan.on_phase(entered, permitted=True)
        if walk.current(t1_ms + ms) > 0.0:
            found.append(ms)
    return found


def _transition(phase: Any) -> Transition:
    by_phase = {PRE_SWING: Transition.T1, SWING: Transition.T2, LOADING: Transition.T3, STANCE: Transition.T4}
    return by_phase[phase]


@pytest.mark.requirement("SR-30")
def test_none_starts_before_its_end_can_be_predicted() -> None:
    walk = bounded()
    assert [bool(step(walk)) for _ in range(5)] == [False, False, False, True, True]
    lost = PhaseChange(walk.t_ms * MS, "left_foot", Transition.NONE, walk.phase, STANCE)
    walk.plan.on_phase(lost, permitted=False)
    walk.phase = STANCE
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
def test_prediction_only_shortens(swings_ms: list[int], last_ms: int, seen: bool, late_ms: int) -> None:
    plain, walk = Walk(make_channel(onset="predicted")), bounded()
    for swing_ms in swings_ms:
        step(plain, swing_ms=swing_ms)
        step(walk, swing_ms=swing_ms)
    without = step(plain, swing_ms=last_ms, seen=seen, late_ms=late_ms)
    found = step(walk, swing_ms=last_ms, seen=seen, late_ms=late_ms)
    assert set(found) <= set(without)
    assert found[-1] <= PRE_MS + max(swings_ms) + EXTENSION_MS + FALL_MS + 5
