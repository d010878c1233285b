"""The plan and its envelope at the nanosecond; bursts by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest
from test_plan import LOADING, MS, PRE_SWING, STANCE, make_channel

from fes.config import Channel
from fes.stimulation.envelope import BIN_S, BurstParameters, Envelope
from fes.stimulation.plan import StimulationPlan
from statemachine.phases import Phase, PhaseChange, Transition

RISE = FALL = 100 * MS
S = 1000 * MS


def envelope(**changes: int) -> Envelope:
    plain = {"rise_ns": RISE, "extension_ns": 0, "fall_ns": FALL, "max_on_ns": 2000 * MS} | changes
    return Envelope(t_start_ns=1000, parameters=BurstParameters(20.0, 0.0, 0.0, (300.0,)), frequency_hz=40.0, **plain)


def test_before_its_start_a_burst_has_its_first_width() -> None:
    parameters = BurstParameters(20.0, 0.0, 0.0, (100.0, 200.0, 300.0))
    assert [parameters.width_us(t_s) for t_s in (-2.0 * BIN_S, -0.5 * BIN_S, 0.0, BIN_S)] == [
        100.0,
        100.0,
        100.0,
        200.0,
    ]


def test_rise_begins_at_nothing() -> None:
    assert envelope().level_ma(999) == envelope().level_ma(1000) == 0.0
    assert envelope().level_ma(1001) == pytest.approx(20.0 / RISE)


def test_fall_of_no_length_is_over_one_nanosecond_later() -> None:
    cut = envelope(fall_ns=0).stopped(1000 + RISE)
    assert cut.level_ma(1000 + RISE) == 20.0
    assert cut.level_ma(1000 + RISE + 1) == 0.0
    assert not cut.over(1000 + RISE)
    assert cut.over(1000 + RISE + 1)


def test_it_is_over_when_the_fall_is_complete_and_the_first_stop_counts() -> None:
    stopped = envelope().stopped(1000 + RISE).stopped(1000 + 5 * RISE)
    assert stopped.t_stop_ns == 1000 + RISE
    assert not stopped.over(1000 + RISE + FALL - 1)
    assert stopped.over(1000 + RISE + FALL)
    assert [stopped.falls(1000 + RISE + ns) for ns in (-1, 0, 1)] == [False, True, True]


class Bench:
    """A plan asked at chosen times (ms)."""

    def __init__(self, *channels: Channel) -> None:
        self.plan = StimulationPlan(channels or (make_channel(),))
        self.plan.requests(0, 1.0)

    def enter(self, at_ms: float, source: Phase, to: Phase, transition: Transition) -> None:
        self.plan.on_phase(PhaseChange(round(at_ms * MS), "left_foot", transition, source, to), permitted=True)

    def current(self, at_ms: float, intensity: float = 1.0, number: int = 0) -> float:
        requests = self.plan.requests(round(at_ms * MS), intensity)
        return next(one.current_ma for one in requests if one.channel == number)


def test_least_time_off_counts_from_the_request_that_was_off() -> None:
    bench = Bench(make_channel(start_phase="stance", stop_phase="swing"))
    bench.enter(20, LOADING, STANCE, Transition.T4)
    for at_ms in range(20, 201, 20):
        bench.current(at_ms)
    bench.enter(210, STANCE, PRE_SWING, Transition.T1)
    bench.enter(210, PRE_SWING, STANCE, Transition.T5)
    assert bench.current(220) == 0.0
    for at_ms in (240, 260, 280, 300):
        assert bench.current(at_ms) == 0.0
    assert bench.current(319.999) == 0.0
    bench.current(320)
    assert bench.current(340) == 4.0, "20 ms of a rise that began 100 ms after the off"


# --- by hand ------------------------------------------------------------------------------------------------


def test_burst_by_hand_is_of_the_channel_named_and_of_no_other() -> None:
    bench = Bench(make_channel(0), make_channel(1))
    bench.plan.start(1, 20 * MS, 300 * MS, adopt=False)
    bench.current(20)
    assert bench.current(200, number=1) == 20.0
    assert bench.current(220, number=0) == 0.0


def test_antagonists_that_are_due_at_the_same_moment_do_not_start_together() -> None:
    bench = Bench(make_channel(0, never_with=[1]), make_channel(1))
    bench.enter(20, STANCE, PRE_SWING, Transition.T1)
    for at_ms in range(20, 400, 10):
        requests = bench.plan.requests(at_ms * MS, 1.0)
        assert not all(request.on for request in requests)
    assert requests[0].on


def test_an_antagonist_waits_for_a_burst_that_has_begun_with_pulses_too_narrow_for_the_device() -> None:
    bench = Bench(make_channel(1), make_channel(0, never_with=[1]))
    own = BurstParameters.for_channel(make_channel())
    bench.plan.set_parameters(1, replace(own, widths_us=(0.4, 0.4, 300.0)))
    bench.enter(20, STANCE, PRE_SWING, Transition.T1)
    assert [[one.on for one in bench.plan.requests(at_ms * MS, 1.0)] for at_ms in (20, 60, 130)] == [
        [False, False], [False, False], [True, False],
    ]  # fmt: skip


def test_an_antagonist_waits_for_one_whose_end_was_not_sent_yet() -> None:
    bench = Bench(make_channel(0, never_with=[1]), make_channel(1))
    bench.plan.start(1, 20 * MS, 500 * MS, adopt=False)
    bench.plan.requests(120 * MS, 1.0)
    bench.plan.cancel()
    bench.plan.start(0, 130 * MS, 500 * MS, adopt=False)
    assert [[one.on for one in bench.plan.requests(at_ms * MS, 1.0)] for at_ms in (130, 140)] == [
        [False, False], [True, False],
    ]  # fmt: skip


# --- parameters that change from burst to burst -----------------------------------------------------------------


def tuned(start_delay_s: float = 0.0) -> BurstParameters:
    return BurstParameters(30.0, start_delay_s, 0.06, (100.0, 200.0, 300.0))


def widths_us(bench: Bench, *at_ms: float) -> list[float]:
    return [next(iter(bench.plan.requests(round(ms * MS), 1.0))).pulse_width_us for ms in at_ms]


def test_the_profile_counts_from_the_start_of_the_burst_and_its_last_width_stays() -> None:
    bench, bin_ms = Bench(), BIN_S * 1e3
    bench.plan.set_parameters(0, tuned())
    bench.enter(1000, STANCE, PRE_SWING, Transition.T1)
    assert widths_us(bench, 999, 1000) == [0.0, 100.0]
    found = widths_us(
        bench, 1000 + bin_ms - 1, 1000 + bin_ms, 1000 + 2 * bin_ms - 1, 1000 + 2 * bin_ms, 1000 + 9 * bin_ms
    )
    assert found == [100.0, 200.0, 200.0, 300.0, 300.0]


def test_new_parameters_wait_for_the_next_entry_and_leave_other_channels_alone() -> None:
    bench = Bench(make_channel(), make_channel(number=1))
    bench.enter(1000, STANCE, PRE_SWING, Transition.T1)
    bench.current(1000)
    bench.plan.set_parameters(0, tuned())
    assert bench.current(1200) == 20.0, "the burst under way keeps its own"
    bench.enter(1500, PRE_SWING, STANCE, Transition.T5)
    bench.current(1500)
    bench.enter(3000, STANCE, PRE_SWING, Transition.T1)
    bench.current(3000)
    assert bench.current(3200, number=0) == 30.0
    assert bench.current(3200, number=1) == 20.0


def test_the_delay_of_new_parameters_counts_from_the_entry() -> None:
    bench = Bench()
    bench.plan.set_parameters(0, tuned(start_delay_s=0.2))
    bench.enter(1000, STANCE, PRE_SWING, Transition.T1)
    assert [bench.current(ms) for ms in (1100, 1199, 1200)] == [0.0, 0.0, 0.5]


def test_a_burst_by_hand_takes_the_newest_parameters() -> None:
    bench = Bench()
    bench.plan.set_parameters(0, tuned())
    bench.plan.start(0, 1000 * MS, 500 * MS, adopt=False)
    bench.current(1000)
    assert bench.current(1200) == 30.0


def test_unless_told_otherwise_a_burst_is_as_the_session_has_it() -> None:
    bench = Bench()
    bench.plan.start(0, 1000 * MS, 500 * MS, adopt=False)
    bench.current(1000)
    assert bench.current(1200) == 20.0
    assert widths_us(bench, 1220) == [300.0]


# --- a burst that is replaced ---------------------------------------------------------------------------------------


def own_burst() -> Envelope:
    """Stopped, and due besides; no number of it is a default."""
    parameters = replace(BurstParameters.for_channel(make_channel()), current_ma=20.0)
    return Envelope(5 * S, parameters, 40.0, S // 10, S // 50, S // 5, 2 * S, 0.9, 6 * S, 7 * S)


def test_a_burst_that_is_replaced_keeps_all_else() -> None:
    burst = own_burst()
    assert burst.dimmed(0.5) == replace(burst, intensity=0.5)
    assert burst.unstopped() == replace(burst, t_stop_ns=None)
    assert burst.due(8 * S) == replace(burst, t_due_ns=8 * S)
    assert burst.due(None) == replace(burst, t_due_ns=None)
    assert burst.unstopped().stopped(9 * S) == replace(burst, t_stop_ns=9 * S)


def test_a_burst_that_falls_while_it_rises_falls_from_there() -> None:
    """Half of the rise of a tenth of a second, then a fall of a fifth: after half of that a quarter is left."""
    burst = replace(own_burst(), t_stop_ns=5 * S + S // 20, extension_ns=0)
    assert burst.level_ma(5 * S + S // 20) == pytest.approx(0.9 * 10.0)
    assert burst.level_ma(5 * S + S // 20 + S // 10) == pytest.approx(0.9 * 5.0)
