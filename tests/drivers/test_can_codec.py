from __future__ import annotations

import math
from itertools import combinations
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.stimulator import can_codec, e2e
from drivers.stimulator.can_codec import (
    Alive,
    Charge,
    Command,
    Frame,
    FrameRejected,
    Result,
    SessionOpen,
    Status,
    fault_text,
)
from drivers.stimulator.can_port import ByteSink
from fes import limits
from fes.signals import StimCommand, WireFrame

ON = StimCommand(t_ns=0, channel=1, on=True, current_ma=30.0, pulse_width_us=300.0, frequency_hz=40.0, validity_ms=60)
OFF = StimCommand(t_ns=0, channel=1, on=False, current_ma=30.0, pulse_width_us=300.0, frequency_hz=40.0, validity_ms=60)


def bitwise_crc(data: bytes) -> int:
    """CRC-8H2F once more, as long division bit by bit."""
    register = 0xFF
    for byte in data:
        for bit in range(7, -1, -1):
            top = (register >> 7) ^ (byte >> bit) & 1
            register = (register << 1) & 0xFF
            if top:
                register ^= 0x2F
    return register ^ 0xFF


def test_crc_has_the_published_check_value() -> None:
    assert e2e.crc8h2f(b"123456789") == 0xDF


@given(st.binary(max_size=40))
def test_crc_table_equals_long_division(data: bytes) -> None:
    assert e2e.crc8h2f(data) == bitwise_crc(data)


def test_a_row_of_the_table_is_a_byte_divided() -> None:
    assert e2e.crc8_table(0x2F) == bytes(bitwise_crc(bytes((byte ^ 0xFF,))) ^ 0xFF for byte in range(256))


GOLDEN = [
    # CRC, low count 3 | channel 1 | on, session 0x1234, then 60 steps, 300 µs, 40 Hz, issued at 0, high count 5
    (can_codec.encode_command(ON, 0x53, 0x1234), 0x120, "919334123c58a2a0"),
    (can_codec.encode_command(OFF, 4, 0x1234), 0x120, "7a14341200000000"),
    (can_codec.encode_command(ON, 3 * 128 + 4, 0xFFFE), 0x120, "cf9402003c58a200"),
    (can_codec.encode_open(77, 0x1234), 0x128, "f5f300004d003412"),
    (can_codec.encode(Alive(5, 1, 77, 0x1234, 255, 9)), 0x1B0, "33154d003412ff09"),
    (can_codec.encode(Status(3, 0x1234, 1, True, 30.0, 300.0, 40.0, Result.OK)), 0x1A1, "7f9334123c58a200"),
    (can_codec.encode(Charge(3, 0x1234, 1, 2, 36000)), 0x1A0, "2913341202a08c00"),
]


@pytest.mark.parametrize(("frame", "identifier", "payload"), GOLDEN)
def test_golden_frames(frame: Frame, identifier: int, payload: str) -> None:
    assert frame[0] == identifier
    assert frame[1].hex() == payload
    assert frame[1][0] == bitwise_crc(frame[1][1:] + identifier.to_bytes(2, "big"))


def test_command_layout_is_the_one_documented() -> None:
    word = int.from_bytes(can_codec.encode_command(ON, 0x53, 0x1234)[1], "little")
    fields = [(8, 4), (12, 3), (15, 1), (16, 16), (32, 9), (41, 9), (50, 7), (57, 4), (61, 3)]
    assert [word >> start & (1 << length) - 1 for start, length in fields] == [3, 1, 1, 0x1234, 60, 300, 40, 0, 5]


@pytest.mark.requirement("SR-14")
@given(st.integers(1, 65535), st.integers(0, e2e.NUMBERS - 1))
@example(65535, 127)
@example(65535, 128)
@example(1, e2e.NUMBERS - 1)
def test_a_command_s_number_is_its_count_and_its_session(session_id: int, number: int) -> None:
    command = can_codec.decode(*can_codec.encode_command(ON, number, session_id))
    assert command.counter == number % 128
    assert 1 <= command.session_id <= 65535
    assert e2e.command_number(session_id, command.session_id, command.counter) == number
    if number + 1 < e2e.NUMBERS:
        carried_id, count = e2e.carried(session_id, number + 1)
        follows = command.session_id % 65535 + 1 if command.counter == 127 else command.session_id
        assert (carried_id, count) == (follows, (command.counter + 1) % 128)


def test_off_carries_no_levels_and_off_reads_back_as_off() -> None:
    command = can_codec.decode(*can_codec.encode_command(OFF, 4, 0x1234))
    assert command == Command(4, 0x1234, 1, False, 0.0, 0.0, 0.0, 0)


def test_every_limit_of_the_project_can_be_expressed_and_so_can_more() -> None:
    """Otherwise the node's own limits could never be put to the test."""
    assert limits.MAX_CURRENT_MA < can_codec.MAX_CURRENT_MA
    assert limits.MAX_PULSE_WIDTH_US < can_codec.MAX_PULSE_WIDTH_US
    assert limits.MAX_FREQUENCY_HZ < can_codec.MAX_FREQUENCY_HZ
    frame = can_codec.encode_command(StimCommand(0, 7, True, 130.0, 500.0, 100.0, limits.MAX_VALIDITY_MS), 15, 65535)
    assert can_codec.decode(*frame) == Command(15, 65535, 7, True, 130.0, 500.0, 100.0, 0)


@pytest.mark.requirement("SR-14")
@pytest.mark.parametrize("frame", [case[0] for case in GOLDEN])
@pytest.mark.parametrize("flipped", [1, 2, 3])
def test_up_to_three_flipped_bits_are_always_seen(frame: Frame, flipped: int) -> None:
    identifier, data = frame
    word = int.from_bytes(data, "little")
    for bits in combinations(range(64), flipped):
        damaged = (word ^ sum(1 << bit for bit in bits)).to_bytes(8, "little")
        assert not e2e.is_intact(identifier, damaged)


def test_flipped_frames_are_refused_by_the_decoder_too() -> None:
    identifier, data = can_codec.encode_command(ON, 3, 0x1234)
    for bits in combinations(range(64), 2):
        damaged = (int.from_bytes(data, "little") ^ sum(1 << bit for bit in bits)).to_bytes(8, "little")
        with pytest.raises(FrameRejected, match="CRC"):
            can_codec.decode(identifier, damaged)


def test_another_identifier_length_or_frame_is_refused() -> None:
    identifier, data = can_codec.encode_command(ON, 3, 0x1234)
    for other in range(2048):
        if other != identifier:
            with pytest.raises(FrameRejected):
                can_codec.decode(other, data)
    for length in (*range(8), 9, 12, 64):
        with pytest.raises(FrameRejected, match="bytes instead of 8"):
            can_codec.decode(identifier, (data * 8)[:length])


def test_reserved_bits_and_unknown_results_are_refused() -> None:
    data = can_codec.encode_open(77, 0x1234)[1]
    with pytest.raises(FrameRejected, match="reserved"):
        can_codec.decode(can_codec.OPEN_ID, e2e.protect(can_codec.OPEN_ID, data[:3] + b"\x01" + data[4:]))
    data = can_codec.encode(Status(3, 1, 1, False, 0.0, 0.0, 0.0, Result.OK))[1]
    with pytest.raises(FrameRejected, match="unknown result 10"):
        can_codec.decode(can_codec.STATUS_ID, e2e.protect(can_codec.STATUS_ID, data[:7] + bytes([10 << 1])))


WRONG: list[dict[str, Any]] = [
    {"current_ma": 256.0},
    {"current_ma": -0.5},
    {"current_ma": math.nan},
    {"current_ma": math.inf},
    {"pulse_width_us": 512.0},
    {"frequency_hz": 128.0},
    {"frequency_hz": -1e-9},
    {"channel": 8},
    {"channel": -1},
]


@pytest.mark.parametrize("values", WRONG)
def test_values_beyond_a_field_raise_and_never_wrap(values: dict[str, Any]) -> None:
    good: dict[str, Any] = {"channel": 1, "current_ma": 20.0, "pulse_width_us": 300.0, "frequency_hz": 40.0}
    command = StimCommand(t_ns=0, on=True, **(good | {"validity_ms": 60} | values))
    with pytest.raises(ValueError, match="does not fit its field"):
        can_codec.encode_command(command, 0, 1)


@pytest.mark.parametrize(("counter", "session_id"), [(e2e.NUMBERS, 1), (-1, 1), (0, 0), (0, 65536)])
def test_counter_and_session_beyond_their_fields_raise(counter: int, session_id: int) -> None:
    with pytest.raises(ValueError, match="does not fit its field"):
        can_codec.encode_command(ON, counter, session_id)


@given(
    channel=st.integers(0, 7),
    on=st.booleans(),
    current_ma=st.floats(0, 255.99),
    pulse_width_us=st.floats(0, 511.99),
    frequency_hz=st.floats(0, 127.99),
    t_ns=st.integers(0, 10**12),
    counter=st.integers(0, 127),
    session_id=st.integers(1, 65535),
)
def test_commands_round_trip_rounded_down(
    channel: int,
    on: bool,
    current_ma: float,
    pulse_width_us: float,
    frequency_hz: float,
    t_ns: int,
    counter: int,
    session_id: int,
) -> None:
    command = StimCommand(t_ns, channel, on, current_ma, pulse_width_us, frequency_hz, 60)
    got = can_codec.decode(*can_codec.encode_command(command, counter, session_id))
    assert (got.channel, got.on, got.issued_ms) == (channel, on, t_ns // (16 * 1_000_000) % 16 * 16)
    assert (got.counter, got.session_id) == (counter, session_id)
    if on:
        assert got.current_ma <= current_ma < got.current_ma + 0.5
        assert got.pulse_width_us <= pulse_width_us < got.pulse_width_us + 1.0
        assert got.frequency_hz <= frequency_hz < got.frequency_hz + 1.0
        again = StimCommand(t_ns, channel, on, got.current_ma, got.pulse_width_us, got.frequency_hz, 60)
        assert can_codec.encode_command(again, counter, session_id) == can_codec.encode_command(
            command, counter, session_id
        )
    else:
        assert (got.current_ma, got.pulse_width_us, got.frequency_hz) == (0.0, 0.0, 0.0)


BYTES, IDENTIFIERS = st.integers(0, 255), st.integers(0, 65535)


@given(
    st.one_of(
        st.builds(Alive, st.integers(0, 15), st.just(1), IDENTIFIERS, IDENTIFIERS, BYTES, BYTES),
        st.builds(Charge, st.integers(0, 15), IDENTIFIERS, st.integers(0, 7), BYTES, st.integers(0, 2**24 - 1)),
        st.builds(
            Status,
            counter=st.integers(0, 127),
            session_id=IDENTIFIERS,
            channel=st.integers(0, 7),
            on=st.booleans(),
            current_ma=st.integers(0, 511).map(lambda steps: steps * 0.5),
            pulse_width_us=st.integers(0, 511).map(float),
            frequency_hz=st.integers(0, 127).map(float),
            result=st.sampled_from(Result),
        ),
    )
)
def test_what_the_node_says_round_trips(message: Alive | Charge | Status) -> None:
    assert can_codec.decode(*can_codec.encode(message)) == message


def test_open_round_trips() -> None:
    assert can_codec.decode(*can_codec.encode_open(65535, 1)) == SessionOpen(3, 65535, 1, 60)


def test_commands_are_found_among_logged_frames() -> None:
    sink = ByteSink(0x1234)
    frames = [sink.open(5, 77), *(sink.send(ON) for _ in range(20)), sink.send(OFF)]
    commands = can_codec.logged_commands(frames)
    assert [counter for _, counter in commands] == list(range(21))
    assert commands[0][0] == ON
    assert not commands[-1][0].on
    with pytest.raises(FrameRejected):
        can_codec.logged_commands([WireFrame(0, 0x120, bytes(8))])


def test_byte_sink_is_deterministic_and_a_refused_command_takes_no_count() -> None:
    one, other = ByteSink(7), ByteSink(7)
    too_much = StimCommand(0, 1, True, 300.0, 300.0, 40.0, 60)
    assert one.send(ON) == other.send(ON)
    with pytest.raises(ValueError, match="current_ma"):
        one.send(too_much)
    assert one.send(OFF) == other.send(OFF)
    assert one.poll(0) == []
    assert ByteSink(8).send(ON).data != ByteSink(7).send(ON).data


def test_a_check_that_told_ages_apart_would_be_used_up() -> None:
    """Why the whole number is sent: were 8 bits of it only in the CRC, flips would make old frames into good ones."""
    word = int.from_bytes(can_codec.encode_command(ON, 3, 0x1234)[1], "little")

    def syndrome(age: int, flips: int) -> int:
        data = (word ^ flips).to_bytes(8, "little")
        return e2e.crc8h2f(data[1:] + can_codec.COMMAND_ID.to_bytes(2, "big") + bytes((age,))) ^ data[0]

    levels = [bit for bit in range(64) if not (8 <= bit < 12 or 16 <= bit < 32)]  # the session and the 4 bits sent
    flips = [1 << bit for bit in levels] + [1 << one | 1 << other for one, other in combinations(levels, 2)]
    reached = {syndrome(0, each) ^ syndrome(0, 0) for each in flips}
    assert sum(syndrome(age, 0) ^ syndrome(0, 0) in reached for age in range(1, 256)) == 171


def test_fault_flags_read_as_words() -> None:
    assert fault_text(0) == ""
    assert "output stage" in fault_text(2)
    assert "0xc0" in fault_text(0xF0)
