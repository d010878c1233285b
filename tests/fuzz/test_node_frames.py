"""Frames that nobody sent: flipped, repeated, reordered, played back, random. The simulated stimulator executes none.

In process, on the node's own logic: what counts is what its channels deliver, not what it answers.
"""

from __future__ import annotations

import itertools
import math
import random
from typing import Any

import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.simulated.stimulator.firmware import MAX_COUNTER_STEP, StimulatorNode
from drivers.stimulator import can_codec, e2e
from drivers.stimulator.can_codec import Frame, Result, Status
from fes.signals import StimCommand

MS = 1_000_000
BOOT, SESSION, LATER = 77, 0x1234, 0x4321
IDENTIFIER_BITS, BITS = 11, 64
EXECUTED = ("on", "level", "off", "session", "fault")


def command(
    channel: int = 1, on: bool = True, current_ma: float = 20.0, width_us: float = 300.0, t_ns: int = 0
) -> StimCommand:
    return StimCommand(t_ns, channel, on, current_ma, width_us, 40.0, 60)


def opened(session_id: int = SESSION) -> StimulatorNode:
    node = StimulatorNode(BOOT, 0)
    node.receive(0, *can_codec.encode_open(BOOT, session_id))
    assert node.session_id == session_id
    node.take_record()
    return node


def outputs(node: StimulatorNode) -> list[Any]:
    return [(c.on, c.levels, c.lease_end_ns, c.answers, c.blocked, c.must_be_off) for c in node.channels] + [
        node.session_id
    ]


def executed(node: StimulatorNode) -> int:
    return sum(entry.event in EXECUTED for entry in node.take_record())


def result_of(frames: list[Frame]) -> Result:
    statuses = [m for m in (can_codec.decode(*frame) for frame in frames) if isinstance(m, Status)]
    return statuses[-1].result


def flipped(frame: Frame, *bits: int) -> Frame:
    """The frame with some of its 75 bits turned over; 64 and up are the identifier's."""
    identifier, data = frame[0], bytearray(frame[1])
    for bit in bits:
        if bit < BITS:
            data[bit // 8] ^= 1 << bit % 8
        else:
            identifier ^= 1 << (bit - BITS)
    return identifier, bytes(data)


COMMANDS = {
    "on": command(),
    "strongest": command(7, True, 130.0, 500.0),
    "weakest": command(0, True, 0.5, 1.0),
    "off": command(on=False),
}


@pytest.mark.requirement("SR-14")
@pytest.mark.parametrize("counter", examples((0, 126), (0, 1, 13, 14, 15, 16, 62, 63, 124, 125, 126, 127, 128)))
@pytest.mark.parametrize("kind", COMMANDS)
def test_no_command_with_one_or_two_flipped_bits_is_executed(kind: str, counter: int) -> None:
    node = opened()
    for before in range(counter):
        node.receive(0, *can_codec.encode_command(command(before % 2 + 1), before, SESSION))
    good = can_codec.encode_command(COMMANDS[kind], counter, SESSION)
    node.take_record()
    state = outputs(node)
    for flips in itertools.chain(
        itertools.combinations(range(BITS + IDENTIFIER_BITS), 1),
        itertools.combinations(range(BITS + IDENTIFIER_BITS), 2),
    ):
        node.receive(0, *flipped(good, *flips))
        assert outputs(node) == state, flips
    assert executed(node) == 0
    assert result_of(node.receive(0, *good)) is Result.OK, "it was a good command all along"


@pytest.mark.requirement("SR-14")
def test_no_opening_of_a_session_with_one_or_two_flipped_bits_is_executed() -> None:
    node = opened()
    node.receive(0, *can_codec.encode_command(command(), 0, SESSION))
    node.take_record()
    good = can_codec.encode_open(BOOT, SESSION + 1)
    state = outputs(node)
    for count in (1, 2):
        for flips in itertools.combinations(range(BITS + IDENTIFIER_BITS), count):
            node.receive(0, *flipped(good, *flips))
            assert outputs(node) == state, flips
    assert executed(node) == 0
    node.receive(0, *good)
    assert node.session_id == SESSION + 1


@pytest.mark.requirement("SR-14")
def test_repeated_command_is_not_executed_again() -> None:
    node = opened()
    for number in range(300):
        frame = can_codec.encode_command(command(number % 8, number % 3 != 0, t_ns=number * MS), number, SESSION)
        assert result_of(node.receive(number * MS, *frame)) is Result.OK
        state = outputs(node)
        node.take_record()
        for _ in range(3):
            assert result_of(node.receive(number * MS + MS // 2, *frame)) is Result.BAD_COUNTER
        assert outputs(node) == state, "not even its lease is renewed"
        assert executed(node) == 0


REFUSED = (Result.BAD_COUNTER, Result.BAD_SESSION)


@pytest.mark.requirement("SR-14")
@pytest.mark.parametrize("session_id", examples((65_530,), (65_530, SESSION)))
def test_command_that_comes_again_any_number_of_frames_late_is_refused(session_id: int) -> None:
    """1 to 4095 frames late and more: also where the count comes round, and where the identifier goes up."""
    node, latest = opened(session_id), 4500
    frames = [
        can_codec.encode_command(command(n % 2, True, 10.0 + n % 4, t_ns=n * MS // 5), n, session_id)
        for n in range(3 * latest)
    ]
    late = 0
    for number, frame in enumerate(frames[: latest + examples(1, 8) * latest // 4]):
        t_ns = number * MS // 5
        assert result_of(node.receive(t_ns, *frame)) is Result.OK
        if number < latest:
            continue
        state = outputs(node)
        node.take_record()
        for _ in range(4):  # five in a row would end the session
            late = late % latest + 1
            assert result_of(node.receive(t_ns, *frames[number - late])) in REFUSED, (number, late)
        assert outputs(node) == state, "not even its lease is renewed"
        assert executed(node) == 0


@pytest.mark.requirement("SR-14")
@pytest.mark.parametrize("held", examples((20, 120, 127), tuple(range(120, 136))))
def test_command_that_is_held_back_is_refused_whenever_it_comes(held: int) -> None:
    """It never acted before; but newer ones have."""
    node = opened()
    frames = [
        can_codec.encode_command(command(n % 2, True, 10.0 + n % 4, t_ns=n * MS), n, SESSION) for n in range(held + 600)
    ]
    for number, frame in enumerate(frames):
        if number != held:
            assert result_of(node.receive(number * MS, *frame)) is Result.OK
        if number > held:
            state = outputs(node)
            node.take_record()
            assert result_of(node.receive(number * MS, *frames[held])) in REFUSED
            assert outputs(node) == state
            assert executed(node) == 0


class Wire:
    """A controller, its node, and somebody who remembers every frame; a controller opens a new session when it must."""

    def __init__(self) -> None:
        self.node = StimulatorNode(BOOT, 0)
        self.t_ns = 0
        self.session_id = 0
        self.number = 0
        self.heard: list[Frame] = []

    def open(self, session_id: int) -> None:
        """A new session; under the next free identifier, if that was used."""
        self.session_id, self.number = session_id, 0
        while True:
            self._hear(can_codec.encode_open(BOOT, self.session_id))
            if self.node.session_id == self.session_id and not self.node.flags:
                break
            self.session_id = self.session_id % 65_535 + 1
        self.node.take_record()

    def commands(self, count: int, lost: int = 0) -> None:
        """The next ones after ``lost`` that nobody but the adversary heard; all act, unless the session was ended."""
        for position in range(lost + count):
            self.t_ns += 5 * MS
            self.node.advance(self.t_ns)
            frame = can_codec.encode_command(
                command(self.number % 8, self.number % 3 != 0, 1.0 + self.number % 40, t_ns=self.t_ns),
                self.number,
                self.session_id,
            )
            self.number += 1
            if position < lost:
                self.heard.append(frame)
            elif result_of(self._hear(frame)) is not Result.OK:
                assert self.node.session_id == 0
                assert not any(channel.on for channel in self.node.channels)
                self.open(self.session_id)
                break
        self.node.take_record()

    def again(self, which: int, alike: bool) -> None:
        """A frame from earlier, of any session: it is refused, and at most, the session is ended.

        ``alike``: of those that carry one of the next three counts, first those that carry the next three numbers.
        """
        self.t_ns += MS
        self.node.advance(self.t_ns)
        self.node.take_record()
        known = self.heard[::-1]
        if alike:
            nexts = [e2e.carried(self.session_id, self.number + step) for step in range(3)]
            counts = [count for _, count in nexts]
            known = [f for f in known if f[0] == can_codec.COMMAND_ID and said(f)[1] in counts]
            known.sort(key=lambda frame: said(frame) not in nexts)
        if not known:
            return
        before = outputs(self.node)
        identifier, data = known[which % len(known)]
        answers = self.node.receive(self.t_ns, identifier, data)
        if identifier == can_codec.COMMAND_ID:
            assert result_of(answers) in (*REFUSED, Result.FAULTED)
        done = [entry.event for entry in self.node.take_record() if entry.event in EXECUTED]
        if self.node.session_id:
            assert outputs(self.node) == before
            assert done == []
        else:
            assert set(done) <= {"fault"}
            assert not any(channel.on for channel in self.node.channels)

    def _hear(self, frame: Frame) -> list[Frame]:
        self.heard.append(frame)
        return self.node.receive(self.t_ns, *frame)


def said(frame: Frame) -> tuple[int, int]:
    message = can_codec.decode(*frame)
    return message.session_id, message.counter


def acts() -> st.SearchStrategy[tuple[str, int, int]]:
    counts = st.sampled_from((1, 2, 10, 60, 126, 127, 128, 129))
    near = st.integers(-2, 2).map(lambda off: SESSION + off)
    return st.one_of(
        st.tuples(st.just("commands"), counts, st.integers(0, 2)),
        st.tuples(st.just("commands"), counts, st.integers(0, 2)),
        st.tuples(st.just("again"), st.integers(0, 2000), st.just(0)),
        st.tuples(st.just("again"), st.sampled_from((0, 1, 12, 13, 14, 15, 16)), st.just(0)),
        st.tuples(st.just("alike"), st.integers(0, 4), st.just(0)),
        st.tuples(st.just("open"), st.one_of(near, st.integers(1, 65_535)), st.just(0)),
    )


@pytest.mark.requirement("SR-14")
@given(st.lists(acts(), min_size=8, max_size=40))
@settings(max_examples=examples(100, 3000), deadline=None)
def test_adversary_who_repeats_any_earlier_frame_at_any_time_makes_nothing_happen(
    acted: list[tuple[str, int, int]],
) -> None:
    wire = Wire()
    wire.open(SESSION)
    for act, value, lost in acted:
        match act:
            case "commands":
                wire.commands(value, lost)
            case "again" | "alike":
                wire.again(value, act == "alike")
            case _:
                wire.open(value)


@pytest.mark.requirement("SR-14")
@given(st.lists(st.integers(0, 11), min_size=2, max_size=40), st.one_of(st.integers(0, 15), st.integers(110, 135)))
@settings(max_examples=examples(100, 3000), deadline=None)
def test_reordered_commands_act_in_ascending_order_only(order: list[int], start: int) -> None:
    """Any order and repetition of twelve commands: one that is older than what acted last never acts."""
    node = opened()
    for number in range(start):
        node.receive(0, *can_codec.encode_command(command(0, False), number, SESSION))
    frames = [can_codec.encode_command(command(n % 8), start + n, SESSION) for n in range(12)]
    newest = -1
    for number in order:
        before = outputs(node)
        acted = result_of(node.receive(MS, *frames[number])) is Result.OK
        if acted:
            assert newest < number <= newest + MAX_COUNTER_STEP
            newest = number
        elif node.session_id == SESSION:
            assert outputs(node) == before
        else:
            assert not any(channel.on for channel in node.channels), "five wrong counts in a row end the session"
            break


@pytest.mark.requirement("SR-14")
@pytest.mark.parametrize("reboot", [False, True])
def test_old_session_played_back_from_any_frame_executes_nothing(reboot: bool) -> None:
    capture = [can_codec.encode_open(BOOT, SESSION)]
    capture += [can_codec.encode_command(command(n % 8, n % 5 != 4), n, SESSION) for n in range(200)]
    for start in range(0, len(capture), examples(5, 1)):
        node = StimulatorNode(BOOT + reboot, 0)
        if not reboot:
            for frame in capture:
                node.receive(0, *frame)
        node.receive(0, *can_codec.encode_open(BOOT + reboot, LATER))
        node.receive(0, *can_codec.encode_command(command(3, True), 0, LATER))
        node.take_record()
        state = outputs(node)
        for frame in capture[start:]:
            node.receive(MS, *frame)
        assert outputs(node) == state
        assert executed(node) == 0


# --- random frames ------------------------------------------------------------------------------------------

CRC_SHARE = 2.0**-8
SESSION_SHARE = 2.0**-16
COUNT_SHARE = MAX_COUNTER_STEP / 128


def at_most(expected: float) -> float:
    """Five standard deviations over what is expected of independent rare events."""
    return expected + 5.0 * math.sqrt(expected) + 5.0


def assert_within_limits(node: StimulatorNode, t_ns: int) -> None:
    for channel in node.channels:
        current_ma, width_us, frequency_hz = channel.levels
        assert 0.0 <= current_ma <= 130.0
        assert 0.0 <= width_us <= 500.0
        assert 0.0 <= frequency_hz <= 100.0
        assert not channel.on or channel.lease_end_ns <= t_ns + 60 * MS


@pytest.mark.requirement("SR-14")
def test_random_frames_pass_the_check_as_rarely_as_stated(capsys: pytest.CaptureFixture[str]) -> None:
    """Under a controller's identifier 2⁻⁸ pass the CRC; 2⁻¹⁶ of these name the session: none is executed."""
    count = examples(50_000, 1_000_000)
    node, generator = opened(), random.Random(31)
    intact = 0
    for number in range(count):
        identifier = generator.choice((can_codec.COMMAND_ID, can_codec.OPEN_ID))
        data = generator.randbytes(8)
        intact += e2e.is_intact(identifier, data)
        node.receive(number * 1000, identifier, data)
        node.take_record()
        assert not any(channel.on for channel in node.channels)
    assert node.session_id == SESSION
    assert intact <= at_most(count * CRC_SHARE)
    assert count * CRC_SHARE * SESSION_SHARE * COUNT_SHARE < 0.02, "expected number of executed commands"
    with capsys.disabled():
        print(f"\n{count} random frames: {intact} passed the CRC (2⁻⁸: {count * CRC_SHARE:.0f}), 0 executed")


@pytest.mark.requirement("SR-14")
def test_random_frames_that_know_the_session_stay_within_count_and_limits(capsys: pytest.CaptureFixture[str]) -> None:
    """Random but for the session's two bytes: 2⁻⁸ · 3/128 act, and nothing beyond the node's limits comes out."""
    count = examples(50_000, 1_000_000)
    node, generator = opened(), random.Random(32)
    session_id, acted = SESSION, 0
    for number in range(count):
        t_ns = number * 100_000
        data = generator.randbytes(2) + session_id.to_bytes(2, "little") + generator.randbytes(4)
        node.receive(t_ns, can_codec.COMMAND_ID, data)
        for entry in node.take_record():
            acted += entry.event in ("on", "level")
        assert_within_limits(node, t_ns)
        if node.session_id != session_id:  # five wrong counts in a row ended it
            session_id = session_id % 65_535 + 1
            node.receive(t_ns, *can_codec.encode_open(BOOT, session_id))
            node.take_record()
    assert acted <= at_most(count * CRC_SHARE * COUNT_SHARE)
    with capsys.disabled():
        bound = count * CRC_SHARE * COUNT_SHARE
        print(f"\n{count} random frames of the open session: {acted} switched a channel on (bound {bound:.0f})")
