"""The CAN stimulator's port, frame by frame, on a bus that gives what it is told to."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any, cast

import can
import pytest

from drivers.stimulator import can_codec
from drivers.stimulator.can_codec import Alive, Fault, Frame, Result, Status
from drivers.stimulator.can_port import (
    ANSWER_WITHIN_MS,
    HEARTBEAT_WITHIN_MS,
    REMEMBERED,
    ByteSink,
    CanStimulator,
    CommandAnswers,
)
from drivers.stimulator.port import StimulatorLost
from fes.signals import NS_PER_S, StimAlive, StimCommand, StimStatus, WireFrame

MS = 1_000_000
BOOT, SESSION = 77, 0x1234
COMMAND = StimCommand(0, 1, True, 20.0, 300.0, 40.0, 60)


class ScriptedBus:
    """Gives the frames of ``arriving``, one a call; keeps what is sent."""

    channel_info = "a scripted bus"

    def __init__(self) -> None:
        self.arriving: deque[can.Message | None] = deque()
        self.sent: list[Frame] = []
        self.shut_down = 0
        self.trouble: Exception | None = None

    def add(self, *frames: Frame, **flags: Any) -> None:
        for identifier, data in frames:
            flags = {"is_extended_id": False} | flags
            self.arriving.append(can.Message(arbitration_id=identifier, data=data, **flags))

    def recv(self, timeout: float) -> can.Message | None:
        return self.arriving.popleft() if self.arriving else None

    def send(self, message: can.Message, timeout: float) -> None:
        self.sent.append((message.arbitration_id, bytes(message.data)))

    def shutdown(self) -> None:
        self.shut_down += 1
        if self.trouble:
            raise self.trouble


def port_on(bus: ScriptedBus, **more: Any) -> CanStimulator:
    return CanStimulator(cast(can.BusABC, bus), SESSION, **more)


def alive(counter: int, session_id: int = 0, faults: Fault = Fault.NONE, boot_id: int = BOOT) -> Frame:
    return can_codec.encode(Alive(counter, can_codec.PROTOCOL_VERSION, boot_id, session_id, 0, faults))


def status(counter: int, session_id: int = SESSION, result: Result = Result.OK, **changes: Any) -> Frame:
    answer = Status(counter, session_id, 1, True, 20.0, 300.0, 40.0, result)
    return can_codec.encode(replace(answer, **changes))


def ticking(step_ms: float = 10.0) -> Any:
    times = iter(range(0, 10**12, round(step_ms * MS)))
    return lambda: next(times)


# --- opening ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("boot_id", [1, 2, BOOT])
def test_opens_at_the_first_heartbeat_and_again_at_every_third_without_our_session(boot_id: int) -> None:
    bus = ScriptedBus()
    bus.add(*(alive(k % 16, boot_id=boot_id) for k in range(8)), alive(8, SESSION, boot_id=boot_id))
    handshake = port_on(bus, validity_ms=40).open(3, clock_ns=ticking())
    opening = can_codec.encode_open(boot_id, SESSION, validity_ms=40)
    assert bus.sent == [opening] * 3, "after heartbeats 1, 4 and 7"
    assert handshake.frames == (WireFrame(3, *opening),) * 3
    assert len(handshake.alive) == 9


def test_a_node_that_restarts_meanwhile_is_opened_again_at_once() -> None:
    bus = ScriptedBus()
    bus.add(alive(0), alive(0, boot_id=BOOT + 1), alive(1, boot_id=BOOT + 1), alive(2, SESSION, boot_id=BOOT + 1))
    port_on(bus).open(0, clock_ns=ticking())
    assert bus.sent == [can_codec.encode_open(BOOT, SESSION), can_codec.encode_open(BOOT + 1, SESSION)]


def test_other_frames_before_the_heartbeat_are_passed_over() -> None:
    bus = ScriptedBus()
    bus.add((0x100, bytes(8)), status(0, 99), alive(0), alive(1, SESSION))
    port_on(bus).open(0, clock_ns=ticking())
    assert len(bus.sent) == 1


def test_waits_two_seconds_where_nothing_else_is_said() -> None:
    bus, times = ScriptedBus(), list[int]()

    def clock() -> int:
        times.append(len(times) * 100 * MS)
        return times[-1]

    with pytest.raises(
        StimulatorLost,
        match=r"no stimulator was heard on a scripted bus within 2 s \(0 other frames.*powered.*bit rate",
    ):
        port_on(bus).open(0, clock_ns=clock)
    assert times[-1] == 2 * NS_PER_S


def test_a_node_that_gives_no_reason_is_said_to_give_none() -> None:
    bus = ScriptedBus()
    bus.add(alive(0))
    with pytest.raises(StimulatorLost) as lost:
        port_on(bus).open(0, timeout_s=0.5, clock_ns=ticking(100))
    assert str(lost.value) == (
        f"the stimulator on a scripted bus (boot id {BOOT}) did not open session {SESSION} within 0.5 s: it named no "
        "reason; does another controller use it?"
    )


def test_the_heartbeat_that_opened_the_session_is_no_second_one() -> None:
    bus = ScriptedBus()
    port = opened(bus)
    bus.add(alive(1, SESSION))
    assert port.poll(0) == []
    assert port.foreign == 1


def opened(bus: ScriptedBus, **more: Any) -> CanStimulator:
    port = port_on(bus, **more)
    bus.add(alive(0), alive(1, SESSION))
    port.open(0, clock_ns=ticking())
    bus.sent.clear()
    return port


# --- commands -----------------------------------------------------------------------------------------------


def test_a_commands_age_counts_from_the_sessions_first() -> None:
    frames = []
    for begun_ns in (0, 5 * NS_PER_S + 3 * MS):
        bus = ScriptedBus()
        port = port_on(bus)
        sent = [port.send(replace(COMMAND, t_ns=begun_ns + step_ns)) for step_ns in (0, 100 * MS, 700 * MS)]
        assert [frame.t_ns - begun_ns for frame in sent] == [0, 100 * MS, 700 * MS]
        frames.append(bus.sent)
    assert frames[0] == frames[1]
    assert len({data[2:] for _, data in frames[0]}) == 3


def test_validity_is_what_the_session_was_opened_with_to_its_step() -> None:
    step_ms = can_codec.VALIDITY_STEP_MS
    port = port_on(ScriptedBus(), validity_ms=4 * step_ms + step_ms // 2)
    port.send(replace(COMMAND, validity_ms=4 * step_ms))
    with pytest.raises(ValueError, match="the session was opened with"):
        port.send(replace(COMMAND, validity_ms=4 * step_ms - 1))


def test_no_more_commands_are_remembered_than_are_sent_until_one_is_overdue() -> None:
    port = port_on(ScriptedBus())
    for _ in range(REMEMBERED + 50):
        port.send(COMMAND)
    assert port.outstanding == REMEMBERED


# --- what arrives -------------------------------------------------------------------------------------------


def test_repeated_heartbeats_are_counted_and_what_comes_behind_them_is_read() -> None:
    bus = ScriptedBus()
    port = opened(bus)
    port.send(COMMAND)
    bus.add(alive(1, SESSION), alive(1, SESSION), alive(1, SESSION), status(0))
    bus.add(alive(2, SESSION), alive(2, SESSION))
    events = port.poll(9)
    assert port.foreign == 4
    assert events == [
        StimStatus(9, 1, 0, True, 20.0, 300.0, 40.0, 0, 0.0, ""),
        StimAlive(9, BOOT, 0, ""),
    ]


def test_an_answer_comes_once_and_to_a_command_that_was_sent() -> None:
    bus = ScriptedBus()
    port = opened(bus)
    port.send(COMMAND)
    port.send(COMMAND)
    bus.add(status(0), status(0), status(1), status(0), status(2), status(3))
    events = port.poll(0)
    assert [(event.channel, event.counter) for event in events if isinstance(event, StimStatus)] == [(1, 0), (1, 1)]
    assert port.foreign == 4


def test_answers_of_another_session_are_foreign() -> None:
    bus = ScriptedBus()
    port = opened(bus)
    port.send(COMMAND)
    bus.add(status(0, SESSION + 1), status(0, SESSION - 1), status(0, SESSION + 1, Result.BAD_SESSION))
    assert port.poll(0) == []
    assert port.foreign == 3
    assert port.outstanding == 1


@pytest.mark.parametrize("flags", [{"is_extended_id": True}, {"is_remote_frame": True}])
def test_extended_and_remote_frames_are_none_of_the_nodes(flags: dict[str, bool]) -> None:
    bus = ScriptedBus()
    port = opened(bus)
    identifier, data = alive(2, SESSION)
    bus.add((identifier, b"" if "is_remote_frame" in flags else data), **flags)
    bus.add((can_codec.COMMAND_ID, data))
    assert port.poll(0) == []
    assert port.foreign == 1, "a controller's own frame, which multicast gives back, is none"


def test_what_differs_is_told_in_one_sentence() -> None:
    bus = ScriptedBus()
    port = opened(bus)
    port.send(COMMAND)
    bus.add(status(0, current_ma=10.0, pulse_width_us=200.0))
    (answer,) = port.poll(0)
    assert answer.fault == ("current commanded 20 mA, delivered 10 mA, pulse width commanded 300 µs, delivered 200 µs")


def test_late_answers_and_a_silent_heartbeat_are_events_of_their_own() -> None:
    bus = ScriptedBus()
    port = opened(bus, in_real_time=True)
    port.send(COMMAND)
    port.send(COMMAND)
    late_ns = (ANSWER_WITHIN_MS + 1) * MS
    fault = f"no answer within {ANSWER_WITHIN_MS} ms"
    assert port.poll(late_ns) == [StimStatus(late_ns, 1, 2, False, 0.0, 0.0, 0.0, fault=fault)]
    silent_ns = (HEARTBEAT_WITHIN_MS + 1) * MS
    assert port.poll(silent_ns) == [
        StimAlive(silent_ns, BOOT, 0, f"no heartbeat for {HEARTBEAT_WITHIN_MS} ms"),
    ]


@pytest.mark.parametrize(("faults", "says"), [(Fault.NONE, "{gone}"), (Fault.SESSION_USED, "{gone}; {used}")])
def test_a_node_without_our_session_is_told_and_then_lost(faults: Fault, says: str) -> None:
    bus = ScriptedBus()
    port = opened(bus, in_real_time=True)
    bus.add(alive(2, SESSION + 1, faults))
    (event,) = port.poll(0)
    gone = "the stimulator has not our session open (it restarted, or another controller took it)"
    assert event.fault == says.format(gone=gone, used=can_codec.fault_text(Fault.SESSION_USED))
    with pytest.raises(StimulatorLost, match="has not our session open"):
        port.poll(0)


# --- the end ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("trouble", [None, can.CanError("gone"), OSError("gone")])
def test_the_bus_is_shut_down_once_though_its_adapter_is_gone(trouble: Exception | None) -> None:
    bus = ScriptedBus()
    bus.trouble = trouble
    port = port_on(bus)
    port.close()
    port.close()
    assert bus.shut_down == 1
    assert bus.sent == []


def test_without_a_device_the_bytes_are_the_same() -> None:
    sink, bus = ByteSink(SESSION, validity_ms=40), ScriptedBus()
    assert sink.open(7, BOOT) == WireFrame(7, *can_codec.encode_open(BOOT, SESSION, validity_ms=40))
    port = port_on(bus, validity_ms=40)
    for t_ns in (5, 20 * MS):
        assert sink.send(replace(COMMAND, t_ns=t_ns)) == port.send(replace(COMMAND, t_ns=t_ns))


# --- which answers are wrong, which are late, and when the heartbeat counts as silent -----------------------

STATUS = Status(3, 7, 1, True, 20.0, 300.0, 40.0, Result.OK)


def waiting(*, in_real_time: bool = True) -> CommandAnswers:
    answers = CommandAnswers(in_real_time=in_real_time)
    answers.sent(3, COMMAND)
    return answers


def test_a_fitting_answer_settles_its_channels_older_commands_and_no_others() -> None:
    answers = CommandAnswers(in_real_time=True)
    for counter, channel in ((1, 1), (2, 0), (3, 1), (4, 1)):
        answers.sent(counter, replace(COMMAND, channel=channel))
    assert answers.settle(3, STATUS) == ""
    assert len(answers) == 2
    assert answers.settle(2, replace(STATUS, counter=2, channel=0)) == ""
    assert answers.settle(4, replace(STATUS, counter=4)) == ""
    assert len(answers) == 0


@pytest.mark.requirement("SR-13")
@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"on": False}, "commanded on, delivered off"),
        ({"current_ma": 20.5}, "current commanded 20 mA, delivered 20.5 mA"),
        ({"current_ma": 10.0}, "current commanded 20 mA, delivered 10 mA"),
        ({"pulse_width_us": 301.0}, "pulse width commanded 300 µs, delivered 301 µs"),
        ({"frequency_hz": 41.0}, "frequency commanded 40 Hz, delivered 41 Hz"),
        ({"current_ma": 20.25}, ""),
        ({"on": False, "result": Result.ON_TIME}, ""),
    ],
)
def test_an_answer_must_say_what_was_commanded(changes: dict[str, Any], says: str) -> None:
    assert waiting().settle(3, replace(STATUS, **changes)) == says


def test_delivering_when_off_was_commanded_is_a_difference() -> None:
    answers = CommandAnswers(in_real_time=True)
    answers.sent(3, StimCommand(0, 1, False, 0.0, 0.0, 0.0, 60))
    assert answers.settle(3, STATUS) == "commanded off, delivered on"


@pytest.mark.parametrize("status", [replace(STATUS, counter=4), replace(STATUS, channel=2)])
def test_an_answer_to_nothing_is_held_against_nothing(status: Status) -> None:
    answers = waiting()
    assert answers.settle(status.counter, status) == ""
    assert len(answers) == 1


@pytest.mark.requirement("SR-13")
def test_a_late_answer_is_told_once() -> None:
    answers = waiting()
    assert answers.overdue(ANSWER_WITHIN_MS * MS) is None
    assert answers.overdue(ANSWER_WITHIN_MS * MS + 1) is COMMAND
    assert answers.overdue(10 * ANSWER_WITHIN_MS * MS) is None


@pytest.mark.requirement("SR-13")
@pytest.mark.parametrize("period_ms", [20, 30])
def test_one_lost_answer_is_made_good_by_the_next_command_and_two_are_told_well_within_100_ms(period_ms: int) -> None:
    for lost in (1, 2):
        answers, told_ms = CommandAnswers(in_real_time=True), None
        for t_ms in range(0, 200):
            number = t_ms // period_ms
            if t_ms % period_ms == 0:
                answers.sent(number, replace(COMMAND, t_ns=t_ms * MS))
            if t_ms % period_ms == 12 and number >= lost:  # a loaded bus
                assert answers.settle(number, STATUS) == ""
            if told_ms is None and answers.overdue(t_ms * MS) is not None:
                told_ms = t_ms
        assert told_ms == (None if lost == 1 else ANSWER_WITHIN_MS + 1)


@pytest.mark.requirement("SR-13")
@pytest.mark.parametrize("silent", [1, 8])
@pytest.mark.parametrize(("channels", "period_ms"), [(1, 20), (8, 20), (4, 10), (8, 10)])
def test_silence_is_told_however_many_commands_are_sent(channels: int, period_ms: int, silent: int) -> None:
    """The first ``silent`` channels are never answered, the others at once."""
    answers, number = CommandAnswers(in_real_time=True), 0
    for t_ms in range(200):
        for channel in range(channels if t_ms % period_ms == 0 else 0):
            answers.sent(number, replace(COMMAND, t_ns=t_ms * MS, channel=channel))
            if channel >= silent:
                assert answers.settle(number, replace(STATUS, channel=channel)) == ""
            number += 1
        if late := answers.overdue(t_ms * MS):
            assert (t_ms, late.channel) == (ANSWER_WITHIN_MS + 1, 0)
            return
    pytest.fail("never told")


@pytest.mark.requirement("SR-13")
def test_an_answers_time_counts_from_when_the_command_was_written() -> None:
    answers = CommandAnswers(in_real_time=True)
    answers.sent(3, COMMAND, 30 * MS)
    assert answers.overdue((30 + ANSWER_WITHIN_MS) * MS) is None
    assert answers.overdue((30 + ANSWER_WITHIN_MS) * MS + 1) is COMMAND


def test_nothing_is_late_where_times_are_not_the_walls() -> None:
    answers = waiting(in_real_time=False)
    answers.heartbeat(0)
    assert answers.overdue(10_000 * MS) is None
    assert not answers.silent(10_000 * MS)


def test_heartbeat() -> None:
    answers = waiting()
    assert not answers.silent(10_000 * MS), "none was heard yet: that is the handshake's affair"
    answers.heartbeat(0)
    assert not answers.silent(HEARTBEAT_WITHIN_MS * MS)
    assert answers.silent(HEARTBEAT_WITHIN_MS * MS + 1)
    assert not answers.silent(HEARTBEAT_WITHIN_MS * MS + 2), "told once for each such silence"
