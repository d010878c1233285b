"""Sources of events: silence made audible, the operator of a replay, waiting on a clock."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fes.control.runner import CLOSING_S, TICK_NS, armed_after, paced, with_ticks
from fes.signals import Event, ImuSample, OperatorAct, OperatorAction, Tick

MS = 1_000_000
CLOSING = int(CLOSING_S * 1e9) // TICK_NS


def sample(t_ns: int) -> ImuSample:
    return ImuSample(t_ns, "left_foot", t_ns, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))


def samples(*times_ms: float) -> list[Event]:
    return [sample(int(ms * MS)) for ms in times_ms]


def test_a_steady_stream_has_no_ticks_but_the_closing_ones() -> None:
    stream = samples(*range(0, 100, 10))
    out = list(with_ticks(stream))
    assert out[:10] == stream
    assert out[10:] == [Tick((90 + 10 * k) * MS) for k in range(1, CLOSING + 1)]


@pytest.mark.parametrize(
    ("gap_ms", "ticks_ms"), [(15, []), (16, [10]), (20, [10]), (25, [10]), (26, [10, 20]), (60, [10, 20, 30, 40, 50])]
)
def test_a_silence_is_filled_exactly(gap_ms: int, ticks_ms: list[int]) -> None:
    out = list(with_ticks(samples(0, gap_ms)))
    assert out[: -CLOSING or None] == [sample(0), *(Tick(ms * MS) for ms in ticks_ms), sample(gap_ms * MS)]


@given(st.lists(st.integers(0, 200 * MS), min_size=1, max_size=40))
def test_no_silence_is_left_and_nothing_is_lost(gaps_ns: list[int]) -> None:
    t_ns = 0
    stream: list[Event] = []
    for gap_ns in gaps_ns:
        t_ns += gap_ns
        stream.append(sample(t_ns))
    out = list(with_ticks(stream))
    assert [event for event in out if isinstance(event, ImuSample)] == stream
    steps = [after.t_ns - before.t_ns for before, after in pairwise(out)]
    assert all(0 <= step <= 1.5 * TICK_NS for step in steps)
    assert out[-1].t_ns == stream[-1].t_ns + int(CLOSING_S * 1e9)


def test_nothing_has_no_ticks() -> None:
    assert list(with_ticks([])) == []


def test_the_operator_arms_once_and_then_sets_the_intensity() -> None:
    out = list(armed_after(samples(100, 110, 120, 130), 0.015, 0.7))
    arm = OperatorAct(120 * MS, OperatorAction.ARM)
    assert out == [
        *samples(100, 110, 120),
        arm,
        OperatorAct(120 * MS, OperatorAction.SET_INTENSITY, 0.7),
        sample(130 * MS),
    ]


def test_arming_at_once() -> None:
    out = list(armed_after(samples(5, 10), 0.0, 1.0))
    assert [event.t_ns // MS for event in out if isinstance(event, OperatorAct)] == [5, 5]


@pytest.mark.parametrize(("rearm_after_s", "acts_ms"), [(None, [0]), (0.03, [0, 80]), (0.0, [0, 60])])
def test_arming_again_after_a_fault(rearm_after_s: float | None, acts_ms: list[int]) -> None:
    gate = {"latched": False}
    out: list[Event] = []
    for event in armed_after(samples(*range(0, 200, 10)), 0.0, 1.0, rearm_after_s, lambda: gate["latched"]):
        out.append(event)
        if isinstance(event, ImuSample) and event.t_ns == 50 * MS:
            gate["latched"] = True
        if isinstance(event, OperatorAct) and event.action is OperatorAction.ARM:
            gate["latched"] = False
    assert [event.t_ns // MS for event in out if getattr(event, "action", None) is OperatorAction.ARM] == acts_ms


def test_a_fault_that_stays_is_armed_against_again_and_again() -> None:
    out = armed_after(samples(*range(0, 200, 10)), 0.0, 1.0, 0.05, lambda: True)
    arms = [event.t_ns // MS for event in out if getattr(event, "action", None) is OperatorAction.ARM]
    assert arms == [0, 60, 120, 180]


class FakeClock:
    """Only waiting passes time."""

    def __init__(self, now_ns: int) -> None:
        self.t_ns = now_ns
        self.waits: list[int] = []

    def now_ns(self) -> int:
        return self.t_ns

    def wait_until_ns(self, t_ns: int) -> None:
        self.waits.append(t_ns)
        self.t_ns = max(self.t_ns, t_ns)


@pytest.mark.parametrize(("speed", "scale"), [(1.0, 1.0), (2.0, 0.5), (0.1, 10.0)])
def test_paced_waits_for_each_event_as_asked(speed: float, scale: float) -> None:
    clock = FakeClock(7_000)
    stream = samples(1000, 1002, 1010, 1010, 1500)
    assert list(paced(stream, clock, speed)) == stream
    assert clock.waits == [7_000 + int(ms * MS * scale) for ms in (0, 2, 10, 10, 500)]


def test_paced_hands_on_nothing_before_its_time_and_does_not_drift() -> None:
    clock = FakeClock(0)
    seen: list[int] = []

    def slow() -> Iterator[Event]:
        for event in samples(*range(0, 100, 10)):
            yield event
            clock.t_ns += 13 * MS if event.t_ns == 30 * MS else 1 * MS  # handling takes time, once too long

    for event in paced(slow(), clock, 1.0):
        assert clock.t_ns >= event.t_ns
        seen.append(clock.t_ns - event.t_ns)
    assert seen[4] == 3 * MS
    assert seen[-1] == 0
