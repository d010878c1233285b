"""The session's states: every cause in every state, and no way to current but by hand."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fes.live.commands import CURRENT_ALLOWED, TABLE, Cause, SessionMachine, State

LATCHED = (State.STOPPED, State.FAULT)


@pytest.mark.parametrize(("state", "cause"), list(itertools.product(State, Cause)))
def test_every_cause_in_every_state_does_what_the_table_says(state: State, cause: Cause) -> None:
    machine = SessionMachine()
    machine.state = state
    rows = [row for row in TABLE if (row.source, row.cause) == (state, cause)]
    assert len(rows) <= 1
    assert machine.may(cause) is bool(rows)
    assert machine.move(cause) is bool(rows)
    assert machine.state is (rows[0].destination if rows else state)


@pytest.mark.requirement("SR-01")
def test_only_arming_by_hand_leads_to_current() -> None:
    into = [row for row in TABLE if row.destination in CURRENT_ALLOWED and row.source not in CURRENT_ALLOWED]
    assert {row.cause for row in into} == {Cause.ARM}
    assert {row.source for row in into} == {State.SHADOW, State.PAUSED, *LATCHED}


@pytest.mark.requirement("SR-01")
def test_a_latch_is_left_only_by_hand() -> None:
    for state in LATCHED:
        out = {row.cause for row in TABLE if row.source is state and row.destination not in LATCHED}
        assert out == {Cause.ARM, Cause.QUIT}


@pytest.mark.requirement("SR-01", "SR-16")
@pytest.mark.parametrize("state", sorted(CURRENT_ALLOWED))
@pytest.mark.parametrize("cause", [Cause.STOP, Cause.FAULT, Cause.PAUSE, Cause.DISARM, Cause.QUIT])
def test_from_current_every_way_off_is_open(state: State, cause: Cause) -> None:
    machine = SessionMachine()
    machine.state = state
    assert machine.move(cause)
    assert machine.state not in CURRENT_ALLOWED


@pytest.mark.requirement("SR-01")
@given(st.lists(st.sampled_from(list(Cause))))
def test_without_an_arm_after_the_last_stop_there_is_no_current(causes: list[Cause]) -> None:
    machine = SessionMachine()
    for cause in causes:
        machine.move(cause)
    offs = [number for number, cause in enumerate(causes) if cause in (Cause.STOP, Cause.FAULT)]
    since = causes[offs[-1] + 1 :] if offs else causes
    if Cause.ARM not in since:
        assert machine.state not in CURRENT_ALLOWED


def test_a_session_starts_off_and_gets_ready_before_it_can_be_armed() -> None:
    machine = SessionMachine()
    assert machine.state is State.OFF
    assert not machine.move(Cause.ARM)
    assert machine.move(Cause.READY)
    assert machine.move(Cause.ARM)
    assert machine.state is State.ARMED
