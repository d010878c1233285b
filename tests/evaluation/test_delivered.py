from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fes.evaluation.delivered import DIFFERENCES_LISTED, compare_delivered
from fes.signals import StimCommand, StimStatus

PERIOD_NS = 20_000_000
Sent = list[tuple[StimCommand, int]]


def session(count: int, channels: int = 2) -> Sent:
    """Commands of all channels in turn, one counter over them all; every fifth of a channel is off."""
    sent = []
    for number in range(count):
        on = (number // channels) % 5 != 4
        current_ma = 10.0 + 0.5 * (number % 40)
        sent.append(
            (
                StimCommand(
                    t_ns=number // channels * PERIOD_NS,
                    channel=number % channels,
                    on=on,
                    current_ma=current_ma if on else 0.0,
                    pulse_width_us=300.0 if on else 0.0,
                    frequency_hz=40.0 if on else 0.0,
                    validity_ms=60,
                ),
                number % 16,
            )
        )
    return sent


def answers(sent: Sent, delay_ns: int = 1_000_000) -> list[StimStatus]:
    return [
        StimStatus(
            command.t_ns + delay_ns,
            command.channel,
            counter,
            command.on,
            command.current_ma,
            command.pulse_width_us,
            command.frequency_hz,
            pulses=1,
            charge_uc=2.5,
        )
        for command, counter in sent
    ]


def test_all_delivered_as_commanded() -> None:
    sent = session(200)
    result = compare_delivered(sent, answers(sent))
    assert result.ok
    assert (result.commands, result.matched, result.missing, result.different, result.unasked) == (200, 200, 0, 0, 0)
    assert result.pulses == {0: 100, 1: 100}
    assert result.charge_uc == pytest.approx({0: 250.0, 1: 250.0})


def test_nothing_sent_and_nothing_said_is_fine() -> None:
    assert compare_delivered([], []).ok


def test_silence_is_not_fine() -> None:
    result = compare_delivered(session(10), [])
    assert not result.ok
    assert result.missing == 10


@given(st.integers(1, 4), st.sets(st.integers(0, 199), max_size=150), st.integers(0, 60_000_000))
def test_lost_answers_are_missing_and_shift_no_other(channels: int, lost: set[int], delay_ns: int) -> None:
    sent = session(200, channels)
    said = [status for position, status in enumerate(answers(sent, delay_ns)) if position not in lost]
    result = compare_delivered(sent, said)
    assert result.missing == len(lost)
    assert result.matched == 200 - len(lost)
    assert result.different == result.unasked == 0
    assert result.ok == (not lost)


def test_many_lost_answers_in_a_row_shift_nothing() -> None:
    sent = session(200)
    said = answers(sent)
    result = compare_delivered(sent, said[:20] + said[100:])
    assert (result.missing, result.matched, result.different) == (80, 120, 0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"current_ma": 5.0}, "current commanded"),
        ({"pulse_width_us": 301.0}, "pulse width commanded 300 µs, delivered 301 µs"),
        ({"frequency_hz": 20.0}, "frequency commanded 40 Hz, delivered 20 Hz"),
        ({"on": False}, "commanded on, delivered off"),
        ({"fault": "output stage fault"}, "output stage fault"),
    ],
)
def test_every_kind_of_difference_is_seen_and_named(changes: dict[str, Any], words: str) -> None:
    sent = session(40)
    said = answers(sent)
    said[12] = replace(said[12], **changes)
    result = compare_delivered(sent, said)
    assert not result.ok
    assert (result.different, result.matched, result.missing) == (1, 39, 0)
    assert words in result.differences[0].what
    assert result.differences[0].command is sent[12][0]


def test_a_channel_that_should_be_off_and_is_on_is_seen() -> None:
    sent = session(40)
    said = answers(sent)
    assert not sent[8][0].on
    said[8] = replace(said[8], on=True, current_ma=1.0)
    assert compare_delivered(sent, said).differences[0].what == "commanded off, delivered on"


def test_the_end_of_a_lease_is_no_answer_but_its_charge_counts() -> None:
    sent = session(30)
    said = answers(sent)
    expired = StimStatus(10**12, 1, said[-1].counter, False, 0.0, 0.0, 0.0, 3, 7.5, "lease expired")
    result = compare_delivered(sent, [*said, expired])
    assert result.ok
    assert result.unasked == 1
    assert result.pulses[1] == 15 + 3
    assert result.charge_uc[1] == pytest.approx(15 * 2.5 + 7.5)


def test_an_answer_before_its_command_answers_nothing() -> None:
    sent = session(8)
    result = compare_delivered(sent, answers(sent, delay_ns=-1))
    assert (result.missing, result.unasked) == (8, 8)


def test_differences_are_counted_beyond_those_listed() -> None:
    sent = session(100)
    result = compare_delivered(sent, [replace(status, fault="x") for status in answers(sent)])
    assert result.different == 100
    assert len(result.differences) == DIFFERENCES_LISTED
    assert result.missing == 0
