"""The live page's parts without a process: who may do what, what is kept, what goes between session and page."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import count
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fes.live.commands import CommandKind as Kind
from fes.live.commands import OperatorCommand, State
from fes.live.dashboard.access import Access, Confirmations, Role, Situation
from fes.live.dashboard.frames import (
    DETAIL,
    LARGEST,
    NAMES,
    STATUS,
    STRIDES,
    StateBuffer,
    detail,
    hello,
    read_detail,
    read_hello,
)
from fes.live.dashboard.replay import ReplayLog
from fes.live.dashboard.server import COMMANDS_A_SECOND, MessageHandler, Outcome
from fes.live.dashboard.stream import AT_ONCE, LEVELS_KEPT, STRIDES_KEPT, DashboardCommands, DashboardStream
from fes.live.dashboard.stream import RESUME_MESSAGE as RESUME
from fes.live.status import FootStatus, Status
from fes.session_log import Note
from fes.signals import NS_PER_S, Event, OperatorAct, OperatorAction, StimCommand, StimStatus, StrideResult
from statemachine.phases import Phase, PhaseChange, Transition

MS = 1_000_000
SHOWN = Status(t_ns=7 * NS_PER_S, state="armed", intensity=0.2)
ABOUT = {"mode": "live", "most_intensity": 0.6, "intensity_step": 0.05, "name": "x"}


def stride(number: int = 1, **changes: Any) -> StrideResult:
    trajectory = np.linspace((0.0, 0.0, 0.0), (1.25, 0.1, 0.02), 101)
    made = StrideResult("right_foot", number, 0, number * NS_PER_S, 1.234567, 0.0765, 0.0, 0.0, 0.61, 1, 2, 3, 4)
    return replace(made, trajectory_m=trajectory, **changes)


def fresh() -> Any:
    numbers = count(1)
    return lambda: f"fresh-{next(numbers)}"


# --- links and confirmations ------------------------------------------------------------------------------


def test_a_link_works_once_and_the_newest_controls() -> None:
    access = Access("first", fresh())
    one = access.enter("first")
    assert one
    assert access.role(one) is Role.CONTROL
    assert access.enter("first") == ""
    assert access.enter("") == ""
    two = access.enter(access.token)
    assert (access.role(one), access.role(two)) == (Role.WATCH, Role.CONTROL)
    assert access.role("") is Role.NOBODY
    assert access.role(two + "x") is Role.NOBODY


@given(st.text())
def test_nothing_guessed_gets_in(token: str) -> None:
    access = Access("the-token", fresh())
    if token != "the-token":
        assert access.enter(token) == ""
    assert access.role(token) is Role.NOBODY


@given(st.floats(0, 1), st.floats(0, 1), st.integers(0, 20_000))
def test_a_confirmation_counts_once_soon_and_for_what_was_seen(before: float, now: float, after_ms: int) -> None:
    confirmations = Confirmations(fresh())
    identifier = confirmations.ask("up", Situation("current", before), 0)
    what, why = confirmations.answer(identifier, Situation("current", now), after_ms * MS)
    assert (what == "up") == (after_ms <= 10_000 and abs(before - now) < 1e-6)
    assert bool(what) != bool(why)
    assert confirmations.answer(identifier, Situation("current", now), after_ms * MS)[0] == ""


# --- what a browser says ----------------------------------------------------------------------------------


class Browser:
    """One browser at a handler, and the clock."""

    def __init__(self, access: Access, **about: Any) -> None:
        self.t_ns = 0
        self.status: Status | None = SHOWN
        self.age_ns = 0
        self.handler = MessageHandler(access, {**ABOUT, **about}, lambda t_ns: (self.status, self.age_ns), fresh())

    def say(self, **message: Any) -> Outcome:
        self.t_ns += NS_PER_S
        return self.handler.handle(json.dumps(message), self.t_ns)

    def asked(self, ask: str) -> str:
        """What it is asked back."""
        reply = self.say(ask=ask).reply
        assert reply is not None
        assert "question" in reply, reply
        return str(reply["question"]["id"])


@pytest.fixture
def access() -> Access:
    return Access("link", fresh())


@pytest.fixture
def browser(access: Access) -> Browser:
    made = Browser(access)
    outcome = made.say(token="link")
    assert outcome.entered
    assert outcome.reply
    assert outcome.reply["hello"]["name"] == "x"
    return made


@pytest.mark.parametrize("ask", ["arm", "up", "resume"])
def test_what_raises_needs_the_newest_link_and_a_confirmation(access: Access, browser: Browser, ask: str) -> None:
    stranger, old = Browser(access), browser
    for message in ({"ask": ask}, {"ask": ask, "confirm": True}, {"confirm": "fresh-1"}):
        assert stranger.say(**message).command == b""
    assert browser.say(ask=ask, confirm="").command == b""
    assert (
        browser.say(confirm=browser.asked(ask)).command
        == json.dumps({"ask": ask, "confirm": True}, separators=(",", ":")).encode()
    )
    identifier = old.asked(ask)
    newest = Browser(access)
    assert newest.say(token=access.token).entered
    assert old.say(confirm=identifier).command == b""  # asked while it still controlled
    assert "another browser" in str(old.say(ask=ask).reply)
    assert newest.say(confirm=newest.asked(ask)).command


def test_who_controls_says_what_is_walked_on_and_is_not_asked_back(access: Access, browser: Browser) -> None:
    for value in (10, -25.0, 0, 7.5):
        assert json.loads(browser.say(ask="ground", value=value).command) == {"ask": "ground", "value": value}
    assert json.loads(browser.say(ask="ground_free").command) == {"ask": "ground_free"}
    for slip in (None, "10", True, 25.1, -100, 10**400, float("nan"), [10]):
        outcome = browser.say(ask="ground", value=slip)
        assert outcome.command == b""
        assert "from -25 to 25 percent" in str(outcome.reply)
    newest = Browser(access)
    assert newest.say(token=access.token).entered
    for message in ({"ask": "ground", "value": 5}, {"ask": "ground_free"}):
        assert "another browser" in str(browser.say(**message).reply)
        assert Browser(access).say(**message).command == b""
        assert newest.say(**message).command
    newest.age_ns = 2 * NS_PER_S
    assert "nothing is heard" in str(newest.say(ask="ground", value=5).reply)
    replay = Browser(access, mode="replay")
    assert replay.say(token=access.token).entered
    assert "only be stopped" in str(replay.say(ask="ground_free").reply)


@pytest.mark.parametrize("state", ["shadow", "stopped", "fault"])
def test_a_stop_makes_every_question_void(browser: Browser, state: str) -> None:
    """Wherever it was pressed, and also where the session stood stopped already."""
    browser.status = replace(SHOWN, state=state, stops=1)
    identifier = browser.asked("arm")
    browser.status = replace(SHOWN, state=state, stops=2)
    assert browser.say(confirm=identifier).command == b""
    identifier = browser.asked("arm")
    assert browser.say(ask="stop").stop
    assert browser.say(confirm=identifier).command == b"", "before any status tells of it"
    assert browser.say(confirm=browser.asked("arm")).command


def test_an_old_link_may_still_lower_and_pause_and_none_may_not(access: Access, browser: Browser) -> None:
    assert Browser(access).say(token=access.token).entered
    for ask in ("pause", "down", "disarm"):
        assert json.loads(browser.say(ask=ask).command) == {"ask": ask}
        assert Browser(access).say(ask=ask).command == b""


@pytest.mark.parametrize(
    "first", [{}, {"token": "wrong"}, {"secret": "stale"}, {"token": "link"}, {"token": ["link"]}, {"secret": None}]
)
def test_a_stop_needs_nothing(access: Access, first: dict[str, Any]) -> None:
    browser = Browser(access)
    browser.say(**first)
    browser.status = None
    for _ in range(3 * COMMANDS_A_SECOND):
        assert browser.handler.handle('{"ask":"stop"}', browser.t_ns).stop


def test_a_raise_is_refused_at_the_bound_and_where_nothing_is_known(browser: Browser) -> None:
    browser.status = replace(SHOWN, intensity=0.6)
    assert "60% is the most" in str(browser.say(ask="up").reply)
    browser.status = SHOWN
    identifier = browser.asked("up")
    browser.status = replace(SHOWN, intensity=0.25)
    assert "changed" in str(browser.say(confirm=identifier).reply)
    identifier = browser.asked("up")
    browser.status = replace(SHOWN, intensity=0.25, state="running")  # the patient began to walk: as was asked
    assert browser.say(confirm=identifier).command
    identifier = browser.asked("up")
    browser.status = replace(SHOWN, intensity=0.25, state="fault")
    assert "changed" in str(browser.say(confirm=identifier).reply)
    browser.age_ns = 2 * NS_PER_S
    assert "nothing is heard" in str(browser.say(ask="up").reply)


def test_too_many_orders_are_let_fall_but_no_stop(browser: Browser) -> None:
    outcomes = [browser.handler.handle('{"ask":"down"}', browser.t_ns) for _ in range(50)]
    assert sum(bool(outcome.command) for outcome in outcomes) <= COMMANDS_A_SECOND
    assert browser.handler.handle('{"ask":"stop"}', browser.t_ns).stop


def test_a_replay_can_only_be_stopped(access: Access) -> None:
    browser = Browser(access, mode="replay")
    browser.say(token="link")
    assert browser.say(ask="pause").command == b""
    assert browser.say(ask="arm").command == b""
    assert browser.say(ask="stop").stop


@given(st.text() | st.builds(json.dumps, st.recursive(st.none() | st.text() | st.floats(), st.lists)))
@example("[" * 500)
@example('{"ask":"stop"' + " " * 1000 + "}")
def test_nonsense_orders_nothing(text: str) -> None:
    access = Access("link", fresh())
    browser = Browser(access)
    browser.say(token="link")
    outcome = browser.handler.handle(text, browser.t_ns)
    assert not outcome.command
    assert not outcome.stop
    assert outcome.reply


# --- between session and page -----------------------------------------------------------------------------


@pytest.fixture
def pair() -> Iterator[tuple[DashboardStream, socket.socket]]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.settimeout(1.0)
    with ours, theirs:
        yield DashboardStream(ours), theirs


def test_what_the_log_sees_arrives_with_its_numbers(pair: tuple[DashboardStream, socket.socket]) -> None:
    stream, page = pair
    stream.command(StimCommand(5, 0, True, 12.5, 300.0, 40.0, 60))
    stream.command(StimCommand(6, 0, False, 12.5, 300.0, 40.0, 60))
    stream.event(StimStatus(7, 0, 1, True, 12.0, 300.0, 40.0))
    stream.phase(PhaseChange(8, "right_foot", Transition.T1, Phase.STANCE, Phase.PRE_SWING))
    stream.stride(stride(3, toe_clearance_m=float("nan")))
    stream.note(Note(9, "fault", "gate", "why"))
    stream.send(SHOWN.encode())
    first = page.recv(LARGEST)
    assert first[:1] == STATUS
    assert Status.decode(first[1:]) == SHOWN
    told = read_detail(page.recv(LARGEST))
    assert [list(each) for each in told["sent"]] == [[5, 0, 12.5], [6, 0, 0.0]]
    assert [list(each) for each in told["answered"]] == [[7, 0, 12.0]]
    assert [list(each) for each in told["phases"]] == [[8, "right_foot", "pre_swing"]]
    assert [list(each) for each in told["notes"]] == [[9, "fault", "why"]]
    (one,) = told["strides"]
    assert (one["stride_length_m"], one["clearance_m"]) == (1.234567, 0.0765)
    assert (one["toe_clearance_m"], one["valid"]) == (None, True)
    assert one["path_m"][-2:] == pytest.approx((1.25, 0.02), abs=1e-3)
    stream.send(SHOWN.encode())
    page.recv(LARGEST)
    assert read_detail(page.recv(LARGEST))["strides"] == []


def test_a_page_that_does_not_read_costs_no_memory_and_catches_up(pair: tuple[DashboardStream, socket.socket]) -> None:
    stream, page = pair
    for number in range(3000):
        stream.command(StimCommand(number, 0, True, 1.0, 300.0, 40.0, 60))
        stream.stride(stride(number))
        stream.send(SHOWN.encode())
    assert stream.dropped > 1000
    assert not stream.lost
    page.setblocking(False)
    with suppress(BlockingIOError):
        while page.recv(LARGEST):
            pass
    stream.send(SHOWN.encode())
    page.recv(LARGEST)
    told = read_detail(page.recv(LARGEST))
    assert len(told["sent"]) <= LEVELS_KEPT
    assert [each["number"] for each in told["strides"]] == list(range(3000 - STRIDES_KEPT, 3000))


def test_a_replay_shows_at_its_end_what_came_since_the_status_before(
    pair: tuple[DashboardStream, socket.socket],
) -> None:
    stream, theirs = pair
    controller, gate = Mock(intensity=0.3, incline=0.0), Mock(latched="", armed=True)
    shown = ReplayLog(Mock(), stream, controller, gate, {}, {}, None)
    shown.publish(0, 0)
    assert theirs.recv(LARGEST)[:1] + theirs.recv(LARGEST)[:1] == STATUS + DETAIL
    shown.stride(stride(1))
    shown.publish(50 * MS, 50 * MS)
    theirs.setblocking(False)
    with pytest.raises(BlockingIOError):
        theirs.recv(LARGEST)
    shown.publish(60 * MS, 60 * MS, last=True)
    assert theirs.recv(LARGEST)[:1] == STATUS
    assert [each["number"] for each in read_detail(theirs.recv(LARGEST))["strides"]] == [1]


def test_a_dead_page_is_lost_and_no_more(pair: tuple[DashboardStream, socket.socket]) -> None:
    stream, page = pair
    page.close()
    stream.send(SHOWN.encode())
    stream.send(SHOWN.encode())
    assert stream.lost


class Session:
    """What commands are carried out on."""

    def __init__(self, stream: DashboardStream) -> None:
        self.state = State.RUNNING
        self.done: list[tuple[Kind, str]] = []
        self.confused: list[str] = []
        self.commands = DashboardCommands(
            stream, self.execute, lambda: self.state, lambda t_ns, text: self.confused.append(text)
        )

    def execute(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        self.done.append((command.kind, command.origin))
        return [OperatorAct(t_ns, OperatorAction.EMERGENCY_STOP)] if command.kind is Kind.STOP else []


def test_a_stop_comes_first_once_and_alone(pair: tuple[DashboardStream, socket.socket]) -> None:
    stream, page = pair
    session = Session(stream)
    for message in (b'{"ask":"up","confirm":true}', b'{"ask":"stop"}', b'{"ask":"stop"}', b'{"ask":"down"}'):
        page.send(message)
    assert session.commands.read_events(5) == [OperatorAct(5, OperatorAction.EMERGENCY_STOP)]
    assert session.done == [(Kind.STOP, "dashboard")]


def test_the_session_itself_asks_for_confirmation_and_knows_nine_orders(
    pair: tuple[DashboardStream, socket.socket],
) -> None:
    stream, page = pair
    session = Session(stream)
    for ask in Kind:
        page.send(json.dumps({"ask": ask}).encode())
        session.commands.read_events(0)
        page.send(json.dumps({"ask": ask, "confirm": True}).encode())
        session.commands.read_events(0)
    assert {ask for ask, _ in session.done} == {
        Kind.STOP,
        Kind.ARM,
        Kind.DISARM,
        Kind.PAUSE,
        Kind.UP,
        Kind.DOWN,
        Kind.GROUND,
        Kind.GROUND_FREE,
        Kind.MARK,
    }
    assert session.done.count((Kind.UP, "dashboard")) == 1
    assert session.done.count((Kind.ARM, "dashboard")) == 1
    assert session.confused


def test_the_incline_comes_through_with_its_value(pair: tuple[DashboardStream, socket.socket]) -> None:
    stream, page = pair
    commands: list[OperatorCommand] = []

    def execute(command: OperatorCommand, t_ns: int) -> list[Event]:
        commands.append(command)
        return []

    page.send(b'{"ask":"ground","value":-7.5}')
    DashboardCommands(stream, execute, lambda: State.RUNNING).read_events(0)
    assert commands == [OperatorCommand(Kind.GROUND, -7.5, "dashboard")]


def test_pause_never_goes_on_and_going_on_never_pauses(pair: tuple[DashboardStream, socket.socket]) -> None:
    stream, page = pair
    session = Session(stream)
    for state, message, carried in (
        (State.RUNNING, b'{"ask":"pause"}', True),
        (State.PAUSED, b'{"ask":"pause"}', False),
        (State.RUNNING, RESUME, False),
        (State.PAUSED, RESUME, True),
        (State.PAUSED, b'{"ask":"resume"}', False),
    ):
        session.state = state
        session.done.clear()
        page.send(message)
        session.commands.read_events(0)
        assert bool(session.done) == carried, (state, message)


@given(st.lists(st.binary(max_size=600), max_size=40))
def test_whatever_the_page_sends_the_loop_reads_a_little_and_goes_on(messages: list[bytes]) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        theirs.setblocking(False)
        session = Session(DashboardStream(ours))
        sent = 0
        for message in messages:
            try:
                sent += bool(theirs.send(message))
            except BlockingIOError:
                break
        events = session.commands.read_events(0)
        assert len(events) <= 1
        assert len(session.confused) <= AT_ONCE


# --- the page's memory ------------------------------------------------------------------------------------


def happened(**lists: list[Any]) -> dict[str, list[Any]]:
    return read_detail(detail({name: lists.get(name, []) for name in NAMES}))


def test_the_buffer_tells_each_browser_what_it_has_not_seen_and_keeps_little() -> None:
    buffer = StateBuffer()
    buffer.status(SHOWN, 100 * MS)
    for number in range(500):
        buffer.detail(happened(sent=[(number * MS, 0, 1.0)], strides=[stride(number)]))
    whole = buffer.since(0, 350 * MS)
    assert len(whole["strides"]) == STRIDES
    assert whole["age_ms"] == 250
    assert whole["status"]["state"] == "armed"
    seen = buffer.number
    buffer.detail(happened(phases=[(8 * NS_PER_S, "right_foot", "swing")]))
    assert buffer.since(seen, 0)["phases"] == [[1000.0, "right_foot", "swing"]]
    assert "strides" not in buffer.since(seen, 0)
    buffer.end("over")
    buffer.end("again")
    assert buffer.since(seen, 0)["ended"] == "over"
    json.dumps(whole, allow_nan=False)


def test_what_is_no_number_is_none_in_a_frame() -> None:
    buffer = StateBuffer()
    foot = FootStatus("stance", False, 1, float("nan"), float("nan"), 500.0, float("inf"))
    buffer.status(replace(SHOWN, feet={"left_foot": foot}, latency_p50_ms=float("nan")), 0)
    buffer.detail(happened(strides=[stride(1, stride_length_m=float("nan"), speed_mps=float("nan"))]))
    frame = buffer.since(0, 0)
    json.dumps(frame, allow_nan=False)
    assert frame["status"]["feet"]["left_foot"]["stride_length_m"] is None
    assert frame["strides"][0]["stride_length_m"] is None


@given(st.binary(max_size=200))
def test_a_damaged_message_is_refused(noise: bytes) -> None:
    with pytest.raises(ValueError):
        read_hello(DETAIL + noise)
    with suppress(ValueError):
        read_detail(DETAIL + noise)
    assert read_hello(hello({"name": "ä"})) == {"name": "ä"}


def test_before_arming_it_asks_on_which_leg_the_only_sensor_is(access: Access) -> None:
    browser = Browser(access, ask_side="Is it on the right leg?")
    browser.say(token="link")
    reply = browser.say(ask="arm").reply
    assert reply is not None
    assert reply["question"]["text"].startswith("Is it on the right leg? Arm the stimulator?")
