"""Answers of the CAN stimulator: which are wrong, which are late, and when its heartbeat counts as silent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from drivers.stimulator.can_codec import Result, Status
from drivers.stimulator.can_port import ANSWER_WITHIN_MS, HEARTBEAT_WITHIN_MS, CommandAnswers
from fes.signals import StimCommand

MS = 1_000_000
COMMAND = StimCommand(0, 1, True, 20.0, 300.0, 40.0, 60)
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
