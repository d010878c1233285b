"""A burst that ends before contact: by the longest of the last swings, never later than at contact, never blindly."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_plan import LOADING, MS, PRE_SWING, STANCE, SWING, Walk, make_channel
from test_plan_early_start import PRE_MS, SWING_MS
from test_plan_early_start import step as stride

from fes.stimulation.envelope import BurstParameters
from fes.stimulation.plan import EXPECTED_FROM, LATER_NS


def early(before_s: float, start_phase: str = "pre_swing") -> Walk:
    """A walk whose bursts begin to fall so long before contact; 20 mA, 100 ms up and down."""
    channel = make_channel(extension_s=0.0, start_phase=start_phase)
    walk = Walk(channel)
    walk.plan.set_parameters(0, replace(BurstParameters.for_channel(channel), extension_s=-before_s))
    return walk


def step(walk: Walk, swing_ms: int = SWING_MS, pre_ms: int = PRE_MS) -> dict[int, float]:
    """One stride; the current by ms since foot off."""
    found = stride(walk, pre_ms=pre_ms, swing_ms=swing_ms)
    return {ms - pre_ms: current for ms, current in found.items() if ms >= pre_ms}


def fall_begins(found: dict[int, float]) -> int:
    return max(ms for ms, current in found.items() if current == 20.0)


def test_the_fall_begins_before_contact_once_enough_swings_are_known() -> None:
    walk = early(0.08)
    begins = [fall_begins(step(walk)) for _ in range(EXPECTED_FROM + 2)]
    assert begins == [SWING_MS] * EXPECTED_FROM + [SWING_MS - 80] * 2


def test_the_longest_of_the_last_swings_is_expected() -> None:
    walk = early(0.08)
    for swing_ms in (500, 560, 500):
        step(walk, swing_ms)
    assert fall_begins(step(walk)) == 560 - 80
    for _ in range(EXPECTED_FROM):
        step(walk)
    assert fall_begins(step(walk)) == 500 - 80


def test_a_swing_that_ends_sooner_ends_the_burst_at_contact() -> None:
    walk = early(0.08)
    for _ in range(4):
        step(walk)
    found = step(walk, swing_ms=400)
    assert fall_begins(found) == 400
    assert found[450] == 10.0


def test_it_falls_even_while_contact_does_not_come() -> None:
    walk = early(0.08)
    for _ in range(4):
        step(walk)
    found = step(walk, swing_ms=900)
    assert fall_begins(found) == 420
    assert found[530] == 0.0


@pytest.mark.parametrize("start_phase", ["pre_swing", "stance"])
def test_a_lost_phase_forgets_what_was_expected(start_phase: str) -> None:
    walk = early(0.08, start_phase)
    for _ in range(4):
        step(walk)
    walk.lose()
    step(walk)  # a channel that starts with stance starts at its end
    assert fall_begins(step(walk)) == SWING_MS


@pytest.mark.parametrize("start_phase", ["pre_swing", "stance"])
def test_a_heel_that_rises_again_does_not_inherit_the_end_of_a_swing_without_contact(start_phase: str) -> None:
    walk = early(0.08, start_phase)
    for _ in range(4):
        step(walk)
    walk.enter(PRE_SWING)
    walk.current(walk.t_ms + PRE_MS)
    walk.enter(SWING)
    walk.current(walk.t_ms + 300)
    walk.enter(STANCE)
    found = step(walk, pre_ms=600)  # still in pre-swing when the swing before was expected to end
    assert found[0] == 20.0
    assert fall_begins(found) == SWING_MS - 80


def test_what_is_not_negative_waits_for_contact() -> None:
    walk = early(0.0)
    assert [fall_begins(step(walk)) for _ in range(6)] == [SWING_MS] * 6
    assert fall_begins(step(walk, swing_ms=590)) == 590
    assert fall_begins(step(walk, swing_ms=900)) == pytest.approx(1.25 * SWING_MS + LATER_NS / MS, abs=10)


def test_a_burst_that_starts_with_the_swing_can_end_before_contact_too() -> None:
    channel = make_channel(extension_s=0.0, start_phase="swing")
    walk = Walk(channel)
    walk.plan.set_parameters(0, replace(BurstParameters.for_channel(channel), extension_s=-0.08))
    assert [fall_begins(step(walk)) for _ in range(5)][-1] == SWING_MS - 80


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(st.integers(5, 60), st.integers(5, 90)), min_size=5, max_size=12),
    st.floats(0.0, 0.1),
    st.lists(st.sampled_from([False, False, False, True]), min_size=12, max_size=12),
)
def test_never_more_than_without_and_never_less_before_it_may_end(
    strides: list[tuple[int, int]], before_s: float, broken: list[bool]
) -> None:
    walks = (early(0.0), early(before_s))
    swings: list[int] = []
    for (pre_10ms, swing_10ms), breaks in zip(strides, broken, strict=False):
        swing_ms = 10 * swing_10ms
        longest_ms = max(swings[-EXPECTED_FROM:]) if len(swings) >= EXPECTED_FROM else swing_ms
        for walk in walks:
            walk.current(walk.t_ms + 200)
            walk.enter(PRE_SWING)
            walk.current(walk.t_ms + 10 * pre_10ms)
            walk.enter(SWING)
        for ms in range(0, swing_ms, 10):
            without, found = (walk.current(walk.t_ms + 10) for walk in walks)
            assert found <= without
            if ms + 10 <= longest_ms - 1e3 * before_s:
                assert found == without
        for walk in walks:
            walk.enter(STANCE if breaks else LOADING)
            if not breaks:
                walk.current(walk.t_ms + 100)
                walk.enter(STANCE)
        if not breaks:
            swings.append(swing_ms)
