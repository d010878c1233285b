"""The safety gate, rule by rule, each at its boundary."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fes.gate
from fes.config import Channel, ChannelLimits, ImuDevice
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
    Tick,
)

MS = 1_000_000
HUGE: Any = pytest.param(10**5000, id="huge")  # too long for Python to print
ASKED = StimRequest(0, True, 20.0, 300.0, 40.0)


def noise(t_ns: int) -> float:
    """No living sensor repeats itself."""
    return 1e-9 * (t_ns % 1_000_003)


def make_limits(**changes: float) -> dict[str, Any]:
    return {
        "max_current_ma": 30.0,
        "max_pulse_width_us": 400.0,
        "max_frequency_hz": 50.0,
        "max_charge_per_phase_uc": 10.0,
        "max_charge_per_minute_mc": 50.0,
        "max_current_density_ma_per_cm2": 1.0,
        "max_rise_ma_per_s": 1000.0,
        "max_on_s": 2.0,
        "min_off_s": 0.1,
    } | changes


def make_channel(number: int = 0, foot: str = "left_foot", **changes: Any) -> Channel:
    own = changes.pop("limits", {})
    settings = {
        "name": f"channel {number}",
        "number": number,
        "foot": foot,
        "electrode_area_cm2": 25.0,
        "current_ma": 20.0,
        "pulse_width_us": 300.0,
        "frequency_hz": 40.0,
        "limits": make_limits(**own),
    }
    return Channel.model_validate(settings | changes)


def unchecked_channel(**own: float) -> Channel:
    """A channel whose limits no validation has seen."""
    checked = make_channel()
    return checked.model_copy(update={"limits": ChannelLimits.model_construct(**make_limits(**own))})


class Bench:
    """A gate with a clock and sensors that keep sending."""

    def __init__(
        self, *channels: Channel, max_data_age_ms: int = 40, validity_ms: int = 60, arm: bool = True, **more: Any
    ) -> None:
        self.channels = channels or (make_channel(),)
        self.gate = SafetyGate(self.channels, max_data_age_ms=max_data_age_ms, validity_ms=validity_ms, **more)
        self.t_ns = 1_000 * MS
        if arm:
            self.sample()
            self.act(OperatorAction.ARM)
            for channel in self.channels:
                self.off(channel.number)

    def observe(self, event: Event) -> None:
        self.gate.observe(event)

    def act(self, action: OperatorAction, value: float = 0.0) -> None:
        self.observe(OperatorAct(self.t_ns, action, value))

    def sample(self, **changes: Any) -> None:
        for sensor in sorted({channel.foot for channel in self.channels}):
            plain = ImuSample(self.t_ns, sensor, self.t_ns - 3 * MS, (0.0, 0.0, 9.8), (0.0, 0.0, noise(self.t_ns)))
            self.observe(replace(plain, **changes))

    def wait(self, ms: float, *, sampling: bool = True) -> None:
        """Let time pass, with a sample at its end."""
        self.t_ns += round(ms * MS)
        if sampling:
            self.sample()

    def judge(self, request: StimRequest) -> StimCommand:
        return self.gate.judge(self.t_ns, request)

    def ask(self, number: int = 0, current_ma: float = 20.0, **changes: Any) -> StimCommand:
        return self.judge(replace(ASKED, channel=number, current_ma=current_ma, **changes))

    def off(self, number: int = 0) -> StimCommand:
        return self.judge(StimRequest(number, False))

    def hold(
        self, seconds: float, number: int = 0, current_ma: float = 20.0, step_ms: int = 20
    ) -> Iterator[StimCommand]:
        for _ in range(round(seconds * 1000 / step_ms)):
            self.wait(step_ms)
            yield self.ask(number, current_ma)

    def rearm(self) -> None:
        self.act(OperatorAction.ARM)
        assert self.gate.armed


@pytest.fixture
def bench() -> Bench:
    return Bench()


def assert_latched(bench: Bench, command: StimCommand, reason: str) -> None:
    assert command == StimCommand(bench.t_ns, command.channel, False, 0.0, 0.0, 0.0, 60, command.refused)
    assert reason in command.refused
    assert bench.gate.latched == command.refused
    assert bench.gate.latched_ns == bench.t_ns
    assert not bench.gate.armed
    bench.wait(20)
    assert bench.ask(current_ma=0.5).refused == bench.gate.latched, "stays latched"


def assert_held(bench: Bench, command: StimCommand, reason: str) -> None:
    assert not command.on
    assert reason in command.refused
    assert bench.gate.latched == ""
    assert bench.gate.armed


# --- passing, arming, disarming -----------------------------------------------------------------------------


def test_good_request_goes_through_unchanged(bench: Bench) -> None:
    bench.wait(20)
    assert bench.ask() == StimCommand(bench.t_ns, 0, True, 20.0, 300.0, 40.0, 60)


def test_starts_silent() -> None:
    bench = Bench(arm=False)
    bench.sample()
    assert not bench.gate.armed
    assert (bench.gate.latched, bench.gate.latched_ns) == ("", None)
    assert bench.ask(current_ma=0.5).refused == "not armed"
    assert not bench.gate.latched


def test_off_always_passes_and_gives_no_reason(bench: Bench) -> None:
    assert bench.off() == StimCommand(bench.t_ns, 0, False, 0.0, 0.0, 0.0, 60)
    bench.gate.latch(bench.t_ns, "broken")
    assert bench.off().refused == ""
    assert bench.off(7).refused == ""
    assert bench.judge(StimRequest(0, False, math.nan, -1.0, math.inf)).refused == ""


def test_disarm_stops_without_a_latch(bench: Bench) -> None:
    bench.wait(20)
    assert bench.ask().on
    bench.act(OperatorAction.DISARM)
    assert bench.ask().refused == "not armed"
    assert bench.gate.latched == ""


def test_disarm_does_not_clear_a_latch(bench: Bench) -> None:
    bench.act(OperatorAction.EMERGENCY_STOP)
    bench.act(OperatorAction.DISARM)
    assert bench.gate.latched == "emergency stop"


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


# --- data ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("vector", ["acc_mps2", "gyr_radps"])
def test_non_finite_sample_latches(bench: Bench, bad: float, vector: str) -> None:
    bench.wait(20, sampling=False)
    bench.sample(**{vector: (0.0, bad, 0.0)})
    assert_latched(bench, bench.ask(), "non-finite sample from left_foot")


def test_data_at_the_age_limit_pass_and_beyond_it_latch(bench: Bench) -> None:
    bench.wait(40, sampling=False)
    assert bench.ask(current_ma=1.0).on
    bench.t_ns += 1
    assert_latched(bench, bench.ask(current_ma=1.0), "left_foot data 41 ms old, limit 40 ms")


def test_sessions_tighter_age_counts_and_a_looser_one_does_not() -> None:
    for asked_ms, limit_ms in ((15, 15), (500, 40)):
        bench = Bench(max_data_age_ms=asked_ms)
        bench.wait(limit_ms, sampling=False)
        assert bench.ask(current_ma=1.0).on
        bench.wait(1, sampling=False)
        assert_latched(bench, bench.ask(current_ma=1.0), f"limit {limit_ms} ms")


def test_stale_data_do_not_latch_while_nothing_is_asked(bench: Bench) -> None:
    bench.wait(500, sampling=False)
    assert bench.off().refused == ""
    assert bench.gate.armed


def test_other_foots_data_do_not_count() -> None:
    bench = Bench(make_channel(0), make_channel(1, "right_foot"))
    bench.wait(41, sampling=False)
    bench.observe(ImuSample(bench.t_ns, "right_foot", bench.t_ns - 3 * MS, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)))
    assert bench.ask(1, 1.0).on
    assert_latched(bench, bench.ask(0, 1.0), "left_foot data 41 ms old")


def test_queue_drained_late_shows_on_the_sensors_own_clock(bench: Bench) -> None:
    sent_ns = bench.t_ns
    bench.wait(200, sampling=False)
    for i in range(1, 80):  # all arrive now; the newest was sent 42 ms ago
        bench.sample(t_sensor_ns=sent_ns - 3 * MS + i * 2 * MS)
    assert_latched(bench, bench.ask(current_ma=1.0), "left_foot data 42 ms old by the sensor's own clock, limit 40 ms")
    bench.sample(t_sensor_ns=bench.t_ns - 3 * MS)
    bench.rearm()


def test_first_samples_delay_is_learnt_away() -> None:
    """The first sample came 300 ms late; the mapping is that of the least delayed one."""
    bench = Bench(arm=False)
    bench.sample(t_sensor_ns=bench.t_ns - 300 * MS)
    bench.wait(2)
    bench.rearm()
    bench.off()
    bench.wait(43, sampling=False)
    bench.sample(t_sensor_ns=bench.t_ns - 3 * MS - 41 * MS)
    assert_latched(bench, bench.ask(current_ma=1.0), "own clock")


def test_honest_drift_of_the_sensors_clock_is_no_delay(bench: Bench) -> None:
    for second in range(1, 1000):  # 100 ms in 1000 s
        bench.wait(1000, sampling=False)
        bench.sample(t_sensor_ns=bench.t_ns - 3 * MS - second * MS // 10)
    assert bench.ask(current_ma=1.0).on


def test_slight_disorder_of_stamps_is_tolerated(bench: Bench) -> None:
    bench.wait(20)
    bench.sample(t_sensor_ns=bench.t_ns - 43 * MS)  # 40 ms before the newest
    assert bench.ask().on


def test_sensor_that_restarts_latches_and_can_be_armed_again(bench: Bench) -> None:
    for _ in range(3):
        bench.wait(8, sampling=False)
        bench.sample(t_sensor_ns=bench.t_ns - 900 * MS)
    assert_latched(bench, bench.ask(), "left_foot's clock went back by 873 ms")
    bench.sample(t_sensor_ns=bench.t_ns - 900 * MS)
    bench.rearm()


def test_clock_set_ahead_latches_and_can_be_armed_again(bench: Bench) -> None:
    bench.wait(600)
    bench.wait(600)
    for _ in range(3):
        bench.wait(8, sampling=False)
        bench.sample(t_sensor_ns=bench.t_ns + 897 * MS)
    assert_latched(bench, bench.ask(), "left_foot's clock went ahead by 900 ms")
    bench.rearm()


@pytest.mark.parametrize("wild_ms", [10_000, 45, -45, -10_000])
def test_one_wild_stamp_is_counted_and_has_no_effect(bench: Bench, wild_ms: int) -> None:
    for _ in range(60):
        bench.wait(20)
    bench.wait(20, sampling=False)
    bench.sample(t_sensor_ns=bench.t_ns - 3 * MS + wild_ms * MS)
    for _ in range(20):
        assert bench.ask(current_ma=1.0).on
        bench.wait(20)
    assert bench.gate.latched == ""
    assert bench.gate.slips["left_foot"] in (1, 2), "there, and back again"


@pytest.mark.parametrize(("every", "latches"), [(2, True), (8, True), (30, False), (60, False)])
@pytest.mark.parametrize("kind", ["doubled", "swapped", "ahead"])
def test_more_than_one_in_twenty_stamps_out_of_order_latches_within_a_second(
    bench: Bench, every: int, latches: bool, kind: str
) -> None:
    """An outlier is two slips, one there and one back, except a doubled stamp; so one in forty is the bound there."""
    every = every * 2 if kind != "doubled" and not latches else every
    slip_ns = {"doubled": 0, "swapped": -6 * MS, "ahead": 200 * MS}[kind]
    for _ in range(130):
        bench.wait(10)
    begun_ns, last_ns = bench.t_ns, bench.t_ns - 3 * MS
    for k in range(1, 400):
        bench.wait(10, sampling=False)
        stamp_ns = last_ns + slip_ns if k % every == 0 else bench.t_ns - 3 * MS
        bench.sample(t_sensor_ns=stamp_ns)
        last_ns = bench.t_ns - 3 * MS
        if bench.gate.latched:
            break
    assert bool(bench.gate.latched) is latches
    if latches:
        assert "time stamps are out of order" in bench.gate.latched
        assert bench.t_ns - begun_ns <= 1_100 * MS


def test_time_running_backward_between_events_latches(bench: Bench) -> None:
    bench.observe(Tick(bench.t_ns))
    assert bench.gate.armed, "the same time again is no step back"
    bench.observe(Tick(bench.t_ns - 2 * MS))
    assert bench.gate.latched == "time ran backward by 2 ms"


def test_arming_from_the_past_does_not_stand(bench: Bench) -> None:
    bench.observe(Tick(bench.t_ns + 2 * MS))
    bench.act(OperatorAction.ARM)
    assert not bench.gate.armed
    assert bench.gate.latched == "time ran backward by 2 ms"


@pytest.mark.parametrize("before", ["event", "judgement"])
def test_judging_in_the_past_latches(bench: Bench, before: str) -> None:
    bench.t_ns += 5 * MS
    if before == "event":
        bench.observe(Tick(bench.t_ns))
    else:
        bench.off()
    bench.t_ns -= MS
    command = bench.ask(current_ma=0.5)
    assert command.refused == "time ran backward by 1 ms"
    assert not command.on


def test_data_dated_ahead_do_not_arm(bench: Bench) -> None:
    bench.wait(100)
    bench.t_ns -= 50 * MS
    bench.observe(Tick(bench.t_ns))
    bench.act(OperatorAction.ARM)
    assert bench.gate.arming_refused == "left_foot data are dated 50 ms ahead"


# --- the stimulator's word ----------------------------------------------------------------------------------


def test_status_and_heartbeat_without_a_fault_change_nothing(bench: Bench) -> None:
    bench.wait(20)
    bench.observe(StimStatus(bench.t_ns, 0, 1, True, 30.0, 300.0, 50.0))
    bench.observe(StimStatus(bench.t_ns, 5, 1, True, 99.0, 300.0, 50.0))  # a channel of somebody else's session
    bench.observe(StimStatus(bench.t_ns, 0, 1, False, 0.0, 0.0, 0.0))
    bench.observe(StimStatus(bench.t_ns, 0, 1, True, 0.0, 0.0, 0.0))  # on, and its first pulse still to come
    bench.observe(StimAlive(bench.t_ns, 77, 0))
    bench.observe(StimAlive(bench.t_ns, 77, 3))
    assert bench.ask().on


def test_fault_in_a_status_latches(bench: Bench) -> None:
    bench.wait(20)
    bench.observe(StimStatus(bench.t_ns, 3, 1, False, 0.0, 0.0, 0.0, fault="electrode"))
    assert_latched(bench, bench.ask(), "stimulator fault on channel 3: electrode")


def test_fault_in_a_heartbeat_latches(bench: Bench) -> None:
    bench.observe(StimAlive(bench.t_ns, 77, 0, "high voltage"))
    assert_latched(bench, bench.ask(), "stimulator fault: high voltage")


def test_restart_of_the_stimulator_latches_once(bench: Bench) -> None:
    bench.observe(StimAlive(bench.t_ns, 77, 0))
    bench.observe(StimAlive(bench.t_ns, 78, 0))
    assert_latched(bench, bench.ask(), "stimulator restarted")
    bench.rearm()
    bench.observe(StimAlive(bench.t_ns, 78, 0))
    assert bench.gate.armed


@pytest.mark.parametrize(
    ("delivered", "reason"),
    [
        ((30.5, 300.0, 40.0), "channel 0: stimulator delivers current 30.5 mA, limit 30 mA"),
        ((20.0, 401.0, 40.0), "channel 0: stimulator delivers pulse width 401 µs, limit 400 µs"),
        ((20.0, 300.0, 51.0), "channel 0: stimulator delivers frequency 51 Hz, limit 50 Hz"),
        ((30.0, 400.0, 50.0), "channel 0: stimulator delivers charge per phase 12 µC, limit 10 µC"),
        ((math.nan, 300.0, 40.0), "channel 0: stimulator delivers current nan mA, limit 30 mA"),
        ((20.0, -300.0, 40.0), "channel 0: stimulator delivers a pulse of negative size"),
    ],
)
def test_delivering_over_a_limit_latches(bench: Bench, delivered: tuple[float, float, float], reason: str) -> None:
    bench.observe(StimStatus(bench.t_ns, 0, 1, True, *delivered))
    assert bench.gate.latched == reason


# --- what one request may ask for ---------------------------------------------------------------------------


@pytest.mark.parametrize("field", ["current_ma", "pulse_width_us", "frequency_hz"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1.0, 0.0, 1e300, HUGE, True, None, "20", [1]])
def test_no_number_latches_and_never_raises(bench: Bench, field: str, value: Any) -> None:
    bench.wait(20)
    assert_latched(bench, bench.judge(replace(ASKED, **{field: value})), "must be a number above 0")


@pytest.mark.parametrize("on", [1, None, "yes", np.True_, HUGE])
def test_on_must_be_true_or_false(bench: Bench, on: Any) -> None:
    bench.wait(20)
    assert_latched(bench, bench.judge(replace(ASKED, on=on)), "must be true or false")


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


WIDE = {
    "max_current_ma": 130.0,
    "max_pulse_width_us": 500.0,
    "max_frequency_hz": 100.0,
    "max_charge_per_phase_uc": 65.0,
    "max_charge_per_minute_mc": 100.0,
    "max_current_density_ma_per_cm2": 2.0,
    "max_rise_ma_per_s": 2000.0,
    "max_on_s": 3.0,
}
LOOSE = dict.fromkeys(WIDE, 1000000.0) | {"min_off_s": 0.0}
BROKEN = dict.fromkeys((*WIDE, "min_off_s"), math.nan)


def ready(channel: Channel, until_ma: float) -> Bench:
    """A bench on which this channel has risen slowly enough to be let out at ``until_ma``."""
    bench = Bench(channel)
    line = bench.gate._lines[0]
    bench.wait(20)
    line.ramp_ma = until_ma
    return bench


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


def test_every_cap_takes_its_number_from_the_limits() -> None:
    from fes import limits

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


# --- rise ---------------------------------------------------------------------------------------------------


def test_rise_is_limited_by_the_time_since_the_last_command_and_one_step(bench: Bench) -> None:
    bench.wait(10)  # 1000 mA/s: 10 mA and a step of 0.5 mA
    assert bench.ask(current_ma=10.5).on
    bench.wait(5)
    assert bench.ask(current_ma=15.5).on, "the step is granted once, over the line and not over the last command"
    bench.wait(5)
    assert_latched(bench, bench.ask(current_ma=21.0), "channel 0: rise to 21 mA too fast, at most 20.5 mA by now")


def test_rise_within_one_instant_is_one_step_however_often_asked(bench: Bench) -> None:
    assert bench.ask(current_ma=0.5).on
    assert bench.ask(current_ma=0.5).on
    assert_latched(bench, bench.ask(current_ma=1.0), "rise")


def test_first_command_ever_may_be_one_step() -> None:
    for current_ma, passes in ((0.5, True), (1.0, False)):
        bench = Bench(arm=False)
        bench.sample()
        bench.rearm()
        assert bench.ask(current_ma=current_ma).on is passes
        assert bool(bench.gate.latched) is not passes


def test_absolute_rise_limit_holds() -> None:
    channel = unchecked_channel(**LOOSE)
    bench = Bench(channel)
    bench.wait(5)
    assert bench.ask(current_ma=10.5).on
    bench.wait(5)
    assert_latched(bench, bench.ask(current_ma=21.5), "at most 20.5 mA")


def test_time_without_commands_counts_as_one_validity_at_most() -> None:
    channel = make_channel(limits={"max_rise_ma_per_s": 200.0})
    bench = Bench(channel)
    for _ in range(50):
        bench.wait(20)
    assert bench.ask(current_ma=12.5).on
    bench = Bench(channel)
    for _ in range(50):
        bench.wait(20)
    assert_latched(bench, bench.ask(current_ma=13.0), "at most 12.5 mA")


def test_fall_and_rise_again_within_a_burst(bench: Bench) -> None:
    bench.wait(20)
    assert bench.ask(current_ma=20.0).on
    bench.wait(1)
    assert bench.ask(current_ma=2.0).on, "a fall may be as steep as it likes"
    bench.wait(10)
    assert_latched(bench, bench.ask(current_ma=13.0), "at most 12.5 mA")


# --- times on and off ---------------------------------------------------------------------------------------


def test_burst_may_last_its_limit_and_no_longer(bench: Bench) -> None:
    bench.wait(20)
    assert bench.ask().on
    assert all(command.on for command in bench.hold(2.0))
    bench.wait(10)
    assert_latched(bench, bench.ask(), "channel 0: on for 2.01 s, limit 2 s")


def test_absolute_on_time_holds() -> None:
    bench = Bench(unchecked_channel(**LOOSE))
    bench.wait(20)
    assert bench.ask().on
    assert all(command.on for command in bench.hold(3.0))
    bench.wait(20)
    assert_latched(bench, bench.ask(), "on for 3.02 s, limit 3 s")


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


def test_absolute_off_time_holds() -> None:
    bench = Bench(unchecked_channel(**LOOSE))
    bench.wait(20)
    assert bench.ask(current_ma=5.0).on
    bench.off()
    bench.wait(49)
    assert_held(bench, bench.ask(current_ma=0.5), "off for 0.049 s, at least 0.05 s")
    bench.wait(1)
    assert bench.ask(current_ma=0.5).on


def test_burst_held_back_that_missed_its_ramp_waits_for_the_next(bench: Bench) -> None:
    bench.wait(20)
    assert bench.ask().on
    bench.off()
    bench.wait(10)
    assert_held(bench, bench.ask(current_ma=10.0), "off for 0.01 s")
    for _ in range(8):
        bench.wait(10)
        assert_held(bench, bench.ask(current_ma=20.0), "off for 0.0")
    for _ in range(5):
        bench.wait(10)
        assert_held(bench, bench.ask(current_ma=20.0), "rise to 20 mA too fast, at most 10.5 mA by now")
    bench.off()
    bench.wait(10)
    assert bench.ask(current_ma=10.0).on


def test_a_held_back_burst_has_no_other_privilege(bench: Bench) -> None:
    bench.wait(20)
    assert bench.ask().on
    bench.off()
    bench.wait(20)
    assert_held(bench, bench.ask(current_ma=10.0), "off for")
    bench.wait(20)
    assert_latched(bench, bench.ask(current_ma=31.0), "current 31 mA")


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


def test_command_that_ran_out_ends_the_burst() -> None:
    bench = Bench(make_channel(limits={"max_rise_ma_per_s": 200.0}))
    bench.wait(60)
    assert bench.ask(current_ma=12.0).on
    bench.wait(60)
    assert bench.ask(current_ma=24.0).on, "held to its last moment"
    bench.wait(61)
    assert_held(bench, bench.ask(current_ma=24.0), "off for 0.001 s")
    bench.wait(99)
    assert_held(bench, bench.ask(current_ma=24.0), "rise to 24 mA too fast, at most 12.5 mA by now")
    bench.off()
    bench.wait(20)
    assert bench.ask(current_ma=4.0).on


# --- antagonists --------------------------------------------------------------------------------------------


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


# --- the module itself --------------------------------------------------------------------------------------


def test_gate_imports_nothing_that_could_bend_it() -> None:
    """Signals, limits, settings and a little of the standard library; above all no clock and no I/O."""
    allowed = {"fes", "fes.config", "fes.signals", "math", "dataclasses", "typing", "__future__"}
    allowed |= {"collections", "collections.abc"}
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


# --- a sensor that repeats itself ------------------------------------------------------------------------


def frozen_for(bench: Bench, ms: int, step_ms: int = 4) -> None:
    """Fresh stamps, old values."""
    still = {"acc_mps2": (0.1, 0.2, 9.7), "gyr_radps": (0.01, 0.02, 0.03)}
    bench.sample(**still)
    for _ in range(ms // step_ms):
        bench.wait(step_ms, sampling=False)
        bench.sample(**still)


def test_frozen_sensor_is_no_ground_for_stimulating() -> None:
    bench = Bench()
    frozen_for(bench, 76)
    assert bench.gate.latched == ""
    bench.wait(4, sampling=False)
    bench.sample(acc_mps2=(0.1, 0.2, 9.7), gyr_radps=(0.01, 0.02, 0.03))
    assert bench.gate.latched == "left_foot is frozen: the same values for 80 ms, limit 80 ms"
    assert not bench.gate.armed


def test_nobody_can_arm_on_a_frozen_sensor_and_one_that_lives_again_may() -> None:
    bench = Bench(arm=False)
    frozen_for(bench, 100)
    bench.act(OperatorAction.ARM)
    assert "frozen" in bench.gate.arming_refused
    bench.wait(4)
    bench.act(OperatorAction.ARM)
    assert bench.gate.arming_refused == ""
    assert bench.gate.armed


@pytest.mark.parametrize("changing", ["acc_mps2", "gyr_radps"])
def test_one_value_that_moves_is_life(changing: str) -> None:
    bench = Bench()
    for k in range(100):
        bench.wait(4, sampling=False)
        bench.sample(**({"acc_mps2": (0.0, 0.0, 9.8), "gyr_radps": (0.0, 0.0, 0.0)} | {changing: (0.0, 1e-3 * k, 9.0)}))
    assert bench.gate.latched == ""


# --- numbers that cannot be ------------------------------------------------------------------------------


DEVICE = ImuDevice(sensor="left_foot", device="xbus", port="tty", rate_hz=100, acc_range_g=16, gyr_range_dps=2000)
WITHIN = 80  # ms that something must last to count


def send(bench: Bench, ms: int, acc: tuple[float, float, float], gyr: tuple[float, float, float]) -> str:
    """The same numbers, with a living sensor's noise, every 4 ms; what latched."""
    for _ in range(ms // 4):
        bench.wait(4, sampling=False)
        alive = noise(bench.t_ns)
        bench.sample(acc_mps2=(acc[0], acc[1], acc[2] + alive), gyr_radps=(gyr[0] + alive, gyr[1], gyr[2]))
    return bench.gate.latched


IMPOSSIBLE = [
    pytest.param((0.3, 0.2, 0.96), (0.0, 0.0, 0.0), "is its unit g", id="g for m/s2"),
    pytest.param((0.0, 0.0, 96.2), (0.0, 0.0, 0.0), "wrong unit", id="m/s2 scaled by g again"),
    pytest.param((0.0, 0.0, -156.9), (0.0, 0.0, 0.0), "saturated|wrong unit", id="acc at its range"),
    pytest.param((9.8, 0.0, 0.0), (0.0, -34.9, 0.0), "saturated", id="gyr at its range"),
]


@pytest.mark.parametrize(("acc", "gyr", "says"), IMPOSSIBLE)
def test_what_cannot_be_latches_within_100_ms_and_no_sooner_than_80(
    acc: tuple[float, float, float], gyr: tuple[float, float, float], says: str
) -> None:
    assert send(Bench(devices=(DEVICE,)), WITHIN, acc, gyr) == ""
    assert re.search(says, send(Bench(devices=(DEVICE,)), WITHIN + 4, acc, gyr))


@pytest.mark.parametrize(("acc", "gyr", "says"), IMPOSSIBLE)
def test_what_is_interrupted_is_no_fault(
    acc: tuple[float, float, float], gyr: tuple[float, float, float], says: str
) -> None:
    bench = Bench(devices=(DEVICE,))
    for _ in range(10):
        send(bench, WITHIN, acc, gyr)
        bench.wait(4)
    assert bench.gate.latched == ""


def test_saturation_needs_the_ranges() -> None:
    assert send(Bench(), 200, (9.8, 0.0, 0.0), (0.0, -34.9, 0.0)) == ""


def test_no_foot_turns_at_40_radians_a_second(bench: Bench) -> None:
    assert send(bench, 4, (0.0, 0.0, 9.8), (0.0, 40.0, 0.0)) == ""
    assert "is its unit °/s" in send(bench, 4, (0.0, 0.0, 9.8), (0.0, -40.1, 0.0))


@pytest.mark.parametrize(("tilt_deg", "passes"), [(0, True), (30, True), (60, True), (70, False), (180, False)])
def test_sensor_that_rests_turned_over_cannot_time_a_burst(tilt_deg: float, passes: bool) -> None:
    bench = Bench(up={"left_foot": (0.0, 0.0, 1.0)})
    tilt = math.radians(tilt_deg)
    send(bench, 100, (9.8 * math.sin(tilt), 0.0, 9.8 * math.cos(tilt)), (0.0, 0.0, 0.0))
    assert bench.gate.latched == "", "a foot may rest so"
    command = bench.ask(current_ma=1.0)
    assert command.on is passes
    assert ("remounted" in bench.gate.latched) is not passes
    if not passes:
        bench.act(OperatorAction.ARM)
        assert "remounted" in bench.gate.arming_refused


@pytest.mark.parametrize(
    ("acc", "gyr"), [((0.0, 0.0, -12.0), (0.0, 0.0, 0.0)), ((0.0, 0.0, -9.8), (0.0, 0.6, 0.0))], ids=["force", "rate"]
)
def test_a_moving_foot_may_be_turned_over(acc: tuple[float, float, float], gyr: tuple[float, float, float]) -> None:
    bench = Bench(up={"left_foot": (0.0, 0.0, 1.0)})
    send(bench, 200, acc, gyr)
    assert bench.ask(current_ma=1.0).on


def test_shank_that_drives_a_foots_channel_is_the_one_that_counts() -> None:
    bench = Bench(arm=False, driven_by={"left_foot": "left_shank"})
    bench.sample()
    bench.act(OperatorAction.ARM)
    assert bench.gate.arming_refused == "no data from left_shank"
    bench.sample(sensor="left_shank")
    bench.rearm()
    bench.off()
    assert bench.ask(current_ma=0.5).on
    for _ in range(5):
        bench.wait(20)
    assert_latched(bench, bench.ask(current_ma=1.0), "left_shank data 100 ms old")


# --- charge within a minute ------------------------------------------------------------------------------


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
