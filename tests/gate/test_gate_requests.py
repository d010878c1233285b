"""The safety gate on what is asked for, each limit at its boundary."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gate_bench import (
    ASKED,
    BROKEN,
    LOOSE,
    MS,
    WIDE,
    Bench,
    assert_held,
    assert_latched,
    make_channel,
    ready,
    unchecked_channel,
)

import fes.gate
from fes import limits
from fes.signals import OperatorAction, StimCommand, StimRequest

HUGE: Any = pytest.param(10**5000, id="huge")  # too long for Python to print


@pytest.fixture
def bench() -> Bench:
    return Bench()


# --- what one request may ask for ----------------------------------------------------------------------------------


@pytest.mark.requirement("SR-04")
@pytest.mark.parametrize("field", ["current_ma", "pulse_width_us", "frequency_hz"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1.0, 0.0, 1e300, HUGE, True, None, "20", [1]])
def test_no_number_latches_and_never_raises(bench: Bench, field: str, value: Any) -> None:
    bench.wait(20)
    assert_latched(bench, bench.judge(replace(ASKED, **{field: value})), "must be a number above 0")


@pytest.mark.parametrize(
    ("on", "shown"),
    [
        (1, "1"),
        (None, "None"),
        ("yes", "'yes'"),
        (np.True_, "np.True_"),
        pytest.param(10**5000, "a huge number", id="huge"),
    ],
)
def test_on_must_be_true_or_false(bench: Bench, on: Any, shown: str) -> None:
    bench.wait(20)
    command = bench.judge(replace(ASKED, on=on))
    assert_latched(bench, command, f"channel 0: on is {shown}, must be true or false")


@pytest.mark.parametrize("number", [1, 7, -1])
def test_unknown_channel_latches(bench: Bench, number: int) -> None:
    bench.wait(20)
    command = bench.ask(number)
    assert command.channel == number
    assert_latched(bench, command, "the session has no channel")


@pytest.mark.parametrize("number", [False, 0.0, math.nan, "0", None, [0], HUGE])
def test_channel_that_is_no_plain_number_latches(bench: Bench, number: Any) -> None:
    bench.wait(20)
    command = bench.judge(replace(ASKED, channel=number))
    assert command.channel == -1
    assert_latched(bench, command, "the session has no channel")


@pytest.mark.requirement("SR-04")
@pytest.mark.parametrize(
    ("own", "fits", "exceeds", "reason"),
    [
        ({}, {"current_ma": 30.0}, {"current_ma": 30.01}, "current 30.01 mA, limit 30 mA"),
        ({}, {"pulse_width_us": 400.0}, {"pulse_width_us": 401.0}, "pulse width 401 µs, limit 400 µs"),
        ({}, {"frequency_hz": 50.0}, {"frequency_hz": 50.5}, "frequency 50.5 Hz, limit 50 Hz"),
        (
            {},
            {"current_ma": 25.0, "pulse_width_us": 400.0},
            {"current_ma": 25.5, "pulse_width_us": 400.0},
            "charge per phase 10.2 µC, limit 10 µC",
        ),
        (
            {"max_current_density_ma_per_cm2": 0.2},
            {"current_ma": 30.0},
            {"current_ma": 30.0, "frequency_hz": 49.0},
            "current density 0.2058 mA/cm² r.m.s., limit 0.2 mA/cm² r.m.s.",
        ),
    ],
)
def test_the_sessions_own_limits(
    own: dict[str, float], fits: dict[str, Any], exceeds: dict[str, Any], reason: str
) -> None:
    assert ready(make_channel(limits=own), 30.0).judge(replace(ASKED, **fits)).refused == ""
    bench = ready(make_channel(limits=own), 30.0)
    assert_latched(bench, bench.judge(replace(ASKED, **exceeds)), f"channel 0: {reason}")


@pytest.mark.requirement("SR-04")
@pytest.mark.parametrize("own", [WIDE, LOOSE, BROKEN], ids=["widest", "loose", "not-a-number"])
@pytest.mark.parametrize(
    ("fits", "exceeds", "reason"),
    [
        ((130.0, 100.0, 10.0), (130.5, 100.0, 10.0), "current 130.5 mA, limit 130 mA"),
        ((10.0, 500.0, 10.0), (10.0, 501.0, 10.0), "pulse width 501 µs, limit 500 µs"),
        ((10.0, 100.0, 100.0), (10.0, 100.0, 101.0), "frequency 101 Hz, limit 100 Hz"),
        ((60.0, 500.0, 50.0), (225.0, 500.0, 50.0), "current 225 mA, limit 130 mA"),
        ((130.0, 500.0, 2.0), (130.0, 500.5, 2.0), "pulse width 500.5 µs"),
        ((100.0, 500.0, 2.0), (130.0, 500.0, 30.0), "current density"),
    ],
)
def test_the_absolute_limits_hold_whatever_the_session_says(
    own: dict[str, float], fits: tuple[float, float, float], exceeds: tuple[float, float, float], reason: str
) -> None:
    channel = unchecked_channel(**own).model_copy(update={"electrode_area_cm2": 11.0})
    bench = ready(channel, 130.0)
    assert bench.judge(StimRequest(0, True, *fits)).refused == ""
    bench = ready(channel, 130.0)
    assert_latched(bench, bench.judge(StimRequest(0, True, *exceeds)), reason)


@pytest.mark.parametrize(
    ("constant", "value", "reason"),
    [
        ("MAX_CHARGE_PER_PHASE_UC", 5.9, "charge per phase 6 µC, limit 5.9 µC"),
        ("MAX_PULSE_ENERGY_MJ", 0.11, "pulse energy 0.12 mJ, limit 0.11 mJ"),
    ],
)
def test_caps_that_the_widths_and_currents_of_today_never_reach(
    monkeypatch: pytest.MonkeyPatch, constant: str, value: float, reason: str
) -> None:
    """At 130 mA and 500 µs the pulse energy is 8.5 mJ: the check is proved against a lower constant."""
    table = fes.gate.electrical.CAPS
    what = reason.rsplit(" ", 5)[0]
    lowered = tuple(
        replace(cap, absolute=value, own=lambda own: math.inf) if cap.what == what else cap for cap in table
    )
    assert lowered != table
    monkeypatch.setattr(fes.gate.electrical, "CAPS", lowered)
    bench = ready(make_channel(limits=WIDE), 20.0)
    assert_latched(bench, bench.ask(), reason)


@pytest.mark.requirement("SR-04")
def test_every_cap_takes_its_number_from_the_limits() -> None:
    caps = {cap.what: cap.absolute for cap in fes.gate.electrical.CAPS}
    assert caps == {
        "current": limits.MAX_CURRENT_MA,
        "pulse width": limits.MAX_PULSE_WIDTH_US,
        "frequency": limits.MAX_FREQUENCY_HZ,
        "charge per phase": limits.MAX_CHARGE_PER_PHASE_UC,
        "current density": limits.MAX_CURRENT_DENSITY_MA_PER_CM2,
        "pulse energy": limits.MAX_PULSE_ENERGY_MJ,
    }


@pytest.mark.parametrize(("asked_ms", "given_ms"), [(40, 40), (60, 60), (1000, 60)])
def test_validity_is_the_settings_up_to_the_absolute_limit(asked_ms: int, given_ms: int) -> None:
    bench = Bench(validity_ms=asked_ms)
    bench.wait(20)
    assert bench.ask().validity_ms == given_ms
    assert bench.off().validity_ms == given_ms


# --- rise ----------------------------------------------------------------------------------------------------------


@pytest.mark.requirement("SR-05")
def test_rise_is_limited_by_the_time_since_the_last_command_and_one_step() -> None:
    bench = Bench(risen=False)
    bench.wait(10)
    assert bench.ask(current_ma=0.5).on
    bench.wait(10)  # 1000 mA/s: 10 mA and a step of 0.5 mA
    assert bench.ask(current_ma=10.5).on
    bench.wait(5)
    assert bench.ask(current_ma=15.5).on, "the step is granted once, over the line and not over the last command"
    bench.wait(5)
    assert_latched(bench, bench.ask(current_ma=21.0), "channel 0: rise to 21 mA too fast, at most 20.5 mA by now")


@pytest.mark.requirement("SR-05")
@pytest.mark.parametrize("rise_ma_per_s", [400.0, 2000.0])
@pytest.mark.parametrize("gap_ms", [20, 60, 5000])
def test_a_gap_without_a_command_grants_no_rise(rise_ma_per_s: float, gap_ms: int) -> None:
    for current_ma, passes in ((0.5, True), (1.0, False)):
        bench = Bench(make_channel(limits={"max_rise_ma_per_s": rise_ma_per_s}), risen=False)
        bench.wait(gap_ms)
        command = bench.ask(current_ma=current_ma)
        assert command.on is passes
        if not passes:
            assert_latched(bench, command, "rise to 1 mA too fast, at most 0.5 mA by now")


# so many ms pass; or so many mA are asked for, and let out, or held back or latched for a reason; or off is asked for
OFF = "off"
Step = float | str | tuple[float] | tuple[float, Callable[[Bench, StimCommand, str], None], str]
SLOW = {"limits": {"max_rise_ma_per_s": 200.0}}
BURSTS: dict[str, tuple[Callable[[], Bench], list[Step]]] = {
    "a command that ran out grants no rise either": (lambda: Bench(risen=False), [
        10, (0.5,), 61, (20.0, assert_held, "off for 0.001 s"),
        100, (1.0, assert_held, "rise to 1 mA too fast, at most 0.5 mA by now"), (0.5,),
    ]),
    "within one instant a rise is one step, however often asked": (Bench, [
        (0.5,), (0.5,), (1.0, assert_latched, "rise"),
    ]),
    "the absolute limit of the rise holds": (lambda: Bench(unchecked_channel(**LOOSE)), [
        5, (10.5,), 5, (21.5, assert_latched, "at most 20.5 mA"),
    ]),
    "within a burst time without commands counts as one validity": (
        lambda: Bench(make_channel(**SLOW), risen=False), [(0.5,), 60, (12.5,)]
    ),
    "and no longer": (lambda: Bench(make_channel(**SLOW), risen=False), [
        (0.5,), 60, (13.0, assert_latched, "at most 12.5 mA by now")
    ]),
    "a fall may be as steep as it likes, and the rise again counts from there": (Bench, [
        20, (20.0,), 1, (2.0,), 10, (13.0, assert_latched, "at most 12.5 mA"),
    ]),
    "the absolute on time holds": (lambda: Bench(unchecked_channel(**LOOSE)), [
        20, (20.0,), *([20, (20.0,)] * 150), 20, (20.0, assert_latched, "on for 3.02 s, limit 3 s"),
    ]),
    "the absolute off time holds": (lambda: Bench(unchecked_channel(**LOOSE)), [
        20, (5.0,), OFF, 49, (0.5, assert_held, "off for 0.049 s, at least 0.05 s"), 1, (0.5,),
    ]),
    "a burst held back that missed its ramp waits for the next": (Bench, [
        20, (20.0,), OFF, 10, (10.0, assert_held, "off for 0.01 s"),
        *([10, (20.0, assert_held, "off for 0.0")] * 8),
        *([10, (20.0, assert_held, "rise to 20 mA too fast, at most 10.5 mA by now")] * 5),
        OFF, 10, (10.0,),
    ]),
    "a held back burst has no other privilege": (Bench, [
        20, (20.0,), OFF, 20, (10.0, assert_held, "off for"), 20, (31.0, assert_latched, "current 31 mA"),
    ]),
    "a command that ran out ends the burst": (lambda: ready(make_channel(**SLOW), 12.0), [
        (12.0,), 60, (24.0,),  # held to its last moment
        61, (24.0, assert_held, "off for 0.001 s"),
        99, (24.0, assert_held, "rise to 24 mA too fast, at most 4.5 mA by now"),
        OFF, 20, (4.0,),
    ]),
}  # fmt: skip


@pytest.mark.requirement("SR-05", "SR-06")
@pytest.mark.parametrize("what", BURSTS)
def test_a_bursts_rise_and_times(what: str) -> None:
    begin, steps = BURSTS[what]
    bench = begin()
    for step in steps:
        if isinstance(step, tuple):
            command = bench.ask(current_ma=step[0])
            if len(step) == 1:
                assert command.on, command.refused
            else:
                step[1](bench, command, step[2])
        elif isinstance(step, str):
            bench.off()
        else:
            bench.wait(step)


@pytest.mark.requirement("SR-05")
@pytest.mark.parametrize(
    ("step_ma", "most_ma"), [(0.1, 0.5), (0.5, 0.5), (1.0, 1.0), (2.0, 2.0), (3.0, 2.0), (float("nan"), 0.5)]
)
def test_the_step_that_is_granted_is_the_devices_own_within_bounds(step_ma: float, most_ma: float) -> None:
    """A device of coarser steps can rise only by them; what calls itself coarser than any is not believed."""
    for current_ma in (most_ma, most_ma + 0.1):
        bench = Bench(arm=False, current_step_ma=step_ma)
        bench.sample()
        bench.rearm()
        assert bench.ask(current_ma=current_ma).on is (current_ma == most_ma)
        assert bool(bench.gate.latched) is (current_ma != most_ma)


# --- times on and off ----------------------------------------------------------------------------------------------


@pytest.mark.requirement("SR-06")
def test_burst_may_last_its_limit_and_no_longer(bench: Bench) -> None:
    bench.wait(20)
    assert bench.ask().on
    assert all(command.on for command in bench.hold(2.0))
    bench.wait(10)
    assert_latched(bench, bench.ask(), "channel 0: on for 2.01 s, limit 2 s")


@pytest.mark.requirement("SR-06")
def test_next_burst_must_wait_and_may_then_start_late(bench: Bench) -> None:
    bench.wait(20)
    assert bench.ask(current_ma=5.0).on
    bench.wait(20)
    bench.off()
    bench.wait(20)
    assert_held(bench, bench.ask(current_ma=0.5), "channel 0: off for 0.02 s, at least 0.1 s")
    bench.wait(79)
    assert_held(bench, bench.ask(current_ma=0.5), "off for 0.099 s")
    bench.wait(1)
    assert bench.ask(current_ma=0.5).on


@pytest.mark.requirement("SR-05")
def test_a_burst_that_was_held_back_is_as_any_other_once_it_is_on() -> None:
    bench = Bench(risen=False)
    assert bench.ask(current_ma=0.5).on
    bench.off()
    bench.wait(20)
    assert_held(bench, bench.ask(current_ma=0.5), "off for")
    bench.wait(80)
    assert bench.ask(current_ma=0.5).on
    bench.wait(10)
    assert_latched(bench, bench.ask(current_ma=20.0), "rise to 20 mA too fast, at most 10.5 mA by now")


def test_arming_in_the_middle_of_a_burst_neither_starts_it_nor_latches(bench: Bench) -> None:
    bench.act(OperatorAction.DISARM)
    for _ in range(3):
        bench.wait(10)
        assert bench.ask(current_ma=20.0).refused == "not armed"
    bench.rearm()
    bench.wait(10)
    assert_held(bench, bench.ask(current_ma=20.0), "rise")
    bench.off()
    bench.wait(20)
    assert bench.ask(current_ma=20.0).on


# --- charge within a minute ----------------------------------------------------------------------------------------


@pytest.mark.requirement("SR-07")
def test_charge_of_a_minute_is_capped_and_runs_out_after_it() -> None:
    channel = make_channel(limits={"max_charge_per_minute_mc": 0.24, "max_on_s": 3.0})  # 1 s of 20 mA, 300 µs, 40 Hz
    bench = Bench(channel)
    on_ns = 0
    while bench.gate.latched == "" and on_ns < 2_000 * MS:
        bench.wait(20)
        bench.ask(current_ma=min(20.0, 0.5 + on_ns / MS))
        on_ns += 20 * MS
    assert re.fullmatch(r"channel 0: 0\.24\d* mC within a minute, limit 0\.24 mC", bench.gate.latched)
    assert 1_000 * MS <= on_ns <= 1_040 * MS
    bench.wait(59_000)
    bench.rearm()
    assert_latched(bench, bench.ask(current_ma=1.0), "within a minute")
    bench.wait(3_000)
    bench.rearm()
    assert bench.ask(current_ma=1.0).on


def test_command_that_is_not_renewed_counts_for_its_validity_only() -> None:
    channel = make_channel(limits={"max_charge_per_minute_mc": 1e-3 * 240.0 * 0.06 * 2.5})
    bench = Bench(channel)
    for _ in range(3):
        bench.wait(500)
        assert bench.ask(current_ma=20.0).on is False or bench.gate.latched == ""
        bench.off()
    assert bench.gate.latched == ""


@pytest.mark.requirement("SR-07")
def test_absolute_charge_of_a_minute_holds() -> None:
    """60 mA, 500 µs, 100 Hz is 3 mC/s: 100 mC within a minute, though the session would allow a million."""
    bench = Bench(unchecked_channel(**LOOSE))
    spent_mc = 0.0
    for _ in range(20):
        for step in range(1, 126):
            bench.wait(20)
            command = bench.judge(StimRequest(0, True, min(60.0, 40.0 * step), 500.0, 100.0))
            spent_mc += 0.02 * 1e-3 * command.current_ma * 500.0 * 1e-3 * 100.0
        bench.off()
        bench.wait(100)
    assert 99.0 < spent_mc < 101.0
    assert "limit 100 mC" in bench.gate.latched
