"""The safety gate: arming, latching, antagonists, the stimulator's word."""

from __future__ import annotations

import ast
import math
import os
from pathlib import Path

import pytest
from gate_bench import (
    ASKED,
    MS,
    Bench,
    assert_held,
    assert_latched,
    make_channel,
)

import fes.gate
from fes.gate import SafetyGate
from fes.signals import (
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimRequest,
    StimStatus,
    SystemFault,
)


@pytest.fixture
def bench() -> Bench:
    return Bench()


# --- passing, arming, disarming ------------------------------------------------------------------------------------


def test_good_request_goes_through_unchanged(bench: Bench) -> None:
    bench.wait(20)
    assert bench.ask() == StimCommand(bench.t_ns, 0, True, 20.0, 300.0, 40.0, 60)


@pytest.mark.requirement("SR-01")
def test_starts_silent() -> None:
    bench = Bench(arm=False)
    bench.sample()
    assert (bench.gate.armed, bench.gate.arming_refused) == (False, "")
    assert (bench.gate.latched, bench.gate.latched_ns) == ("", None)
    assert bench.ask(current_ma=0.5).refused == "not armed"
    assert not bench.gate.latched


@pytest.mark.requirement("SR-01")
def test_off_always_passes_and_gives_no_reason(bench: Bench) -> None:
    assert bench.off() == StimCommand(bench.t_ns, 0, False, 0.0, 0.0, 0.0, 60)
    bench.gate.latch(bench.t_ns, "broken")
    assert bench.off().refused == ""
    assert bench.off(7).refused == ""
    assert bench.judge(StimRequest(0, False, math.nan, -1.0, math.inf)).refused == ""


def test_disarm_stops_without_a_latch(bench: Bench) -> None:
    bench.wait(20)
    assert bench.ask().on
    assert bench.gate.armed is True
    bench.act(OperatorAction.DISARM)
    assert bench.ask().refused == "not armed"
    assert (bench.gate.armed, bench.gate.latched) == (False, "")


@pytest.mark.requirement("SR-01")
def test_disarm_does_not_clear_a_latch(bench: Bench) -> None:
    bench.act(OperatorAction.EMERGENCY_STOP)
    bench.act(OperatorAction.DISARM)
    assert bench.gate.latched == "emergency stop"


@pytest.mark.requirement("SR-01", "SR-16")
def test_emergency_stop_latches_until_armed_by_hand(bench: Bench) -> None:
    bench.wait(20)
    bench.act(OperatorAction.EMERGENCY_STOP)
    assert_latched(bench, bench.ask(), "emergency stop")
    bench.rearm()
    assert (bench.gate.latched, bench.gate.latched_ns) == ("", None)


def test_first_reason_is_kept(bench: Bench) -> None:
    bench.gate.latch(5, "first")
    bench.gate.latch(6, "second")
    assert (bench.gate.latched, bench.gate.latched_ns) == ("first", 5)


def test_latch_without_a_reason_is_still_a_latch(bench: Bench) -> None:
    bench.gate.latch(bench.t_ns, "")
    assert bench.gate.latched == "fault of unknown reason"


def test_intensity_is_not_the_gates_business(bench: Bench) -> None:
    bench.wait(20)
    bench.act(OperatorAction.SET_INTENSITY, math.nan)
    assert bench.ask().on


@pytest.mark.requirement("SR-01")
def test_arming_is_refused_until_every_foot_has_been_heard() -> None:
    bench = Bench(make_channel(0), make_channel(1, "right_foot"), arm=False)
    bench.act(OperatorAction.ARM)
    assert bench.gate.arming_refused == "no data from left_foot"
    bench.observe(ImuSample(bench.t_ns, "left_foot", 0, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)))
    bench.act(OperatorAction.ARM)
    assert bench.gate.arming_refused == "no data from right_foot"
    assert bench.ask().refused == "not armed: no data from right_foot"
    bench.sample()
    bench.rearm()
    assert bench.gate.arming_refused == ""


def test_arming_is_refused_on_stale_data_and_keeps_the_latch(bench: Bench) -> None:
    bench.gate.latch(bench.t_ns, "broken")
    bench.wait(41, sampling=False)
    bench.act(OperatorAction.ARM)
    assert bench.gate.arming_refused == "left_foot data 41 ms old, limit 40 ms"
    assert bench.gate.latched == "broken"
    assert not bench.gate.armed


def test_failed_attempt_at_arming_disarms(bench: Bench) -> None:
    bench.wait(50, sampling=False)
    bench.act(OperatorAction.ARM)
    assert not bench.gate.armed


def test_arming_is_refused_on_a_non_finite_sample(bench: Bench) -> None:
    bench.sample(gyr_radps=(0.0, math.inf, 0.0))
    bench.act(OperatorAction.ARM)
    assert bench.gate.arming_refused == "non-finite sample from left_foot"
    bench.wait(2)
    bench.rearm()


def test_session_without_channels_arms_and_passes_nothing() -> None:
    gate = SafetyGate((), max_data_age_ms=40, validity_ms=60)
    gate.observe(OperatorAct(0, OperatorAction.ARM))
    assert gate.armed
    assert gate.judge(0, ASKED).refused == "the session has no channel 0"


# --- the stimulator's word -----------------------------------------------------------------------------------------


def test_status_and_heartbeat_without_a_fault_change_nothing(bench: Bench) -> None:
    bench.wait(20)
    bench.observe(StimStatus(bench.t_ns, 0, 1, True, 30.0, 300.0, 50.0))
    bench.observe(StimStatus(bench.t_ns, 5, 1, True, 99.0, 300.0, 50.0))  # a channel of somebody else's session
    bench.observe(StimStatus(bench.t_ns, 0, 1, False, 0.0, 0.0, 0.0))
    bench.observe(StimStatus(bench.t_ns, 0, 1, True, 0.0, 0.0, 0.0))  # on, and its first pulse still to come
    bench.observe(StimAlive(bench.t_ns, 77, 0))
    bench.observe(StimAlive(bench.t_ns, 77, 3))
    assert bench.ask().on


@pytest.mark.requirement("SR-13")
def test_fault_in_a_status_latches(bench: Bench) -> None:
    bench.wait(20)
    bench.observe(StimStatus(bench.t_ns, 3, 1, False, 0.0, 0.0, 0.0, fault="electrode"))
    assert_latched(bench, bench.ask(), "stimulator fault on channel 3: electrode")


LATE_NS = 7_000 * MS


@pytest.mark.parametrize(
    ("event", "says"),
    [
        (StimAlive(LATE_NS, 2, 0), "stimulator restarted"),
        (StimAlive(LATE_NS, 1, 0, "voltage"), "stimulator fault: voltage"),
        (StimStatus(LATE_NS, 3, 1, False, 0.0, 0.0, 0.0, fault="lead"), "stimulator fault on channel 3: lead"),
        (StimStatus(LATE_NS, 0, 1, True, 31.0, 1.0, 1.0), "channel 0: stimulator delivers current 31 mA, limit 30 mA"),
        (OperatorAct(LATE_NS, OperatorAction.EMERGENCY_STOP), "emergency stop"),
        (SystemFault(LATE_NS, "the loop stalled for 120 ms"), "the loop stalled for 120 ms"),
    ],
)  # fmt: skip
def test_every_latch_says_when_and_in_these_words(bench: Bench, event: Event, says: str) -> None:
    bench.observe(StimAlive(bench.t_ns, 1, 0))
    bench.observe(event)
    assert (bench.gate.latched, bench.gate.latched_ns, bench.gate.armed) == (says, LATE_NS, False)
    bench.t_ns = LATE_NS
    assert bench.ask(current_ma=0.5).refused == says


@pytest.mark.requirement("SR-13")
def test_restart_of_the_stimulator_latches_once(bench: Bench) -> None:
    bench.observe(StimAlive(bench.t_ns, 77, 0))
    bench.observe(StimAlive(bench.t_ns, 78, 0))
    assert_latched(bench, bench.ask(), "stimulator restarted")
    bench.rearm()
    bench.observe(StimAlive(bench.t_ns, 78, 0))
    assert bench.gate.armed


@pytest.mark.requirement("SR-13")
@pytest.mark.parametrize(
    ("delivered", "reason"),
    [
        ((30.5, 300.0, 40.0), "channel 0: stimulator delivers current 30.5 mA, limit 30 mA"),
        ((20.0, 401.0, 40.0), "channel 0: stimulator delivers pulse width 401 µs, limit 400 µs"),
        ((20.0, 300.0, 51.0), "channel 0: stimulator delivers frequency 51 Hz, limit 50 Hz"),
        ((30.0, 400.0, 50.0), "channel 0: stimulator delivers charge per phase 12 µC, limit 10 µC"),
        ((math.nan, 300.0, 40.0), "channel 0: stimulator delivers current nan mA, limit 30 mA"),
        *(
            (pulse, "channel 0: stimulator delivers a pulse of negative size")
            for pulse in ((-1.0, 300.0, 40.0), (20.0, -1.0, 40.0), (20.0, 300.0, -1.0))
        ),
    ],
)
def test_delivering_over_a_limit_latches(bench: Bench, delivered: tuple[float, float, float], reason: str) -> None:
    bench.observe(StimStatus(bench.t_ns, 0, 1, True, *delivered))
    assert bench.gate.latched == reason


def delivered(bench: Bench, pulses: int = 1, number: int = 0) -> None:
    bench.observe(StimStatus(bench.t_ns, number, 1, True, 20.0, 300.0, 40.0, pulses=pulses))


UNASKED = "channel 0: stimulator delivers pulses that nobody asked for"


@pytest.mark.requirement("SR-13")
def test_pulses_that_nobody_asked_for_latch(bench: Bench) -> None:
    delivered(bench, pulses=0)  # on, without a pulse
    delivered(bench, number=5)  # a channel of somebody else's session
    assert bench.gate.latched == ""
    delivered(bench)
    assert bench.gate.latched == UNASKED
    assert bench.gate.latched_ns == bench.t_ns


@pytest.mark.requirement("SR-13")
@pytest.mark.parametrize(("late_ms", "latched"), [(250, ""), (251, UNASKED)])
def test_an_answer_may_come_a_little_after_the_burst_that_it_tells_of(
    bench: Bench, late_ms: float, latched: str
) -> None:
    bench.wait(20)
    assert bench.ask().on
    delivered(bench)
    bench.wait(20)
    bench.off()
    bench.wait(late_ms)
    delivered(bench)
    assert bench.gate.latched == latched


# --- antagonists ---------------------------------------------------------------------------------------------------


@pytest.mark.requirement("SR-08")
@pytest.mark.parametrize(("first", "second"), [(0, 1), (1, 0)])
def test_antagonists_are_never_on_together_whoever_names_whom(first: int, second: int) -> None:
    bench = Bench(make_channel(0, never_with=[1]), make_channel(1), make_channel(2))
    bench.wait(20)
    assert bench.ask(first).on
    assert_held(bench, bench.ask(second), f"channel {second}: never together with channel {first}, which is on")
    assert bench.ask(2).on
    bench.off(first)
    bench.off(second)
    bench.wait(100)
    bench.off(first)
    bench.off(second)
    bench.wait(20)
    assert bench.ask(second).on
    assert_held(bench, bench.ask(first), "never together")


@pytest.mark.requirement("SR-08")
def test_antagonist_whose_command_ran_out_is_off() -> None:
    bench = Bench(make_channel(0, never_with=[1]), make_channel(1))
    bench.wait(20)
    assert bench.ask(0).on
    bench.wait(60)
    assert_held(bench, bench.ask(1, 0.5), "never together")
    bench.t_ns += 1
    assert bench.ask(1, 0.5).on


def test_partner_that_the_gate_does_not_know_is_ignored() -> None:
    bench = Bench(make_channel(0, never_with=[6]))
    bench.wait(20)
    assert bench.ask().on


# --- the module itself ---------------------------------------------------------------------------------------------


@pytest.mark.skipif("MUTANT_UNDER_TEST" in os.environ, reason="mutmut adds an import of its own to what it mutates")
def test_gate_imports_nothing_that_could_bend_it() -> None:
    """Signals, limits, settings, arithmetic and a little of the standard library; above all no clock and no I/O."""
    allowed = {"fes", "fes.config", "fes.signals", "math", "dataclasses", "typing", "__future__"}
    allowed |= {"collections", "collections.abc", "itertools", "numpy"}
    allowed |= {"fes.estimation.numerics.jit", "fes.estimation.numerics.records"}
    for module in Path(fes.gate.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
                assert node.module != "fes" or [alias.name for alias in node.names] == ["limits"]
            else:
                continue
            assert all(name in allowed or name.startswith("fes.gate.") for name in names), (module, names)
