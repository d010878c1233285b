"""The gate and a sensor by radio: an age of its own, by when the data were measured, and limits of its own."""

from __future__ import annotations

from typing import Any

import pytest
from gate_bench import MS, Bench, make_channel, noise, unchecked_channel

from fes import limits
from fes.config import Channel
from fes.gate import SafetyGate
from fes.signals import OperatorAction

FOOT = "left_foot"
RADIO = limits.RADIO


class RadioBench(Bench):
    """The left foot's sensor is on a radio, the right one's on a cable."""

    def __init__(self, *channels: Channel, **more: Any) -> None:
        super().__init__(*channels, max_data_age_ms=500, by_radio=frozenset({FOOT}), **more)

    def came(self, old_ms: int) -> None:
        """A sample that was measured so long ago."""
        t_ns = self.t_ns - old_ms * MS
        turns_radps = float(t_ns // (10 * MS) % 15 == 0) + noise(t_ns)
        self.sample(t_sensor_ns=t_ns, acc_mps2=(noise(t_ns), 0.0, 9.8), gyr_radps=(0.0, 0.0, turns_radps))


@pytest.mark.requirement("SR-29")
def test_what_counts_is_when_it_was_measured_and_not_the_least_delayed_sample() -> None:
    bench = RadioBench(arm=False)
    for _ in range(10):
        bench.wait(20, sampling=False)
        bench.came(RADIO.max_data_age_ms)  # all come so late, from the first on
    bench.act(OperatorAction.ARM)
    bench.off()
    assert bench.ask(current_ma=0.5).on
    bench.t_ns += 1
    command = bench.ask(current_ma=0.5)
    assert command.refused.endswith("left_foot data 121 ms old: they come late, its radio is behind; limit 120 ms")
    assert not bench.gate.latched


@pytest.mark.requirement("SR-29")
def test_data_of_a_radio_that_is_behind_end_the_burst_and_latch_when_it_goes_on() -> None:
    bench = RadioBench(risen=False)
    assert bench.ask(current_ma=0.5).on
    bench.wait(30, sampling=False)
    bench.came(3)
    assert bench.ask(current_ma=0.5).on
    bench.wait(38, sampling=False)
    assert bench.ask(current_ma=0.5).on
    bench.wait(38, sampling=False)
    assert bench.ask(current_ma=0.5).on
    bench.wait(42, sampling=False)
    for _ in range(6):  # from 121 ms on, until 250 ms have passed: off, and said
        command = bench.ask(current_ma=0.5)
        assert not command.on
        assert "left_foot data" in command.refused
        assert not bench.gate.latched
        bench.wait(20, sampling=False)
    bench.came(30)  # the radio is there again; the burst is over all the same
    assert not bench.ask(current_ma=20.0).on
    bench.off()
    bench.wait(200, sampling=False)
    assert not bench.ask(current_ma=1.0).on
    bench.wait(60, sampling=False)
    bench.ask(current_ma=1.0)
    assert "data 260 ms old" in bench.gate.latched
    assert FOOT in bench.gate.doubted


@pytest.mark.requirement("SR-29")
def test_a_backlog_is_told_from_a_silence_and_from_a_clock_that_is_ahead() -> None:
    bench = RadioBench()
    bench.wait(180, sampling=False)
    bench.came(150)
    assert "they come late, its radio is behind" in bench.ask(current_ma=1.0).refused
    bench = RadioBench()
    bench.wait(180, sampling=False)
    assert "left_foot data 180 ms old, limit" in bench.ask(current_ma=1.0).refused
    bench = RadioBench()
    bench.wait(1100)
    for _ in range(3):
        bench.wait(10, sampling=False)
        bench.came(-150)
    assert "left_foot's clock went ahead by" in bench.gate.latched


def test_bunches_are_no_disorder() -> None:
    bench = RadioBench()
    for _ in range(50):
        bench.wait(80, sampling=False)
        for old_ms in range(75, -1, -10):
            bench.came(old_ms)
    assert bench.ask(current_ma=1.0).on


@pytest.mark.requirement("SR-09")
def test_a_cable_beside_a_radio_keeps_its_own_age() -> None:
    bench = RadioBench(make_channel(0), make_channel(1, "right_foot"))
    bench.wait(41, sampling=False)
    assert bench.ask(0, 1.0).on
    assert "right_foot data 41 ms old, limit 40 ms" in bench.ask(1, 1.0).refused
    assert bench.gate.latched


@pytest.mark.requirement("SR-29")
@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"current_ma": RADIO.max_current_ma + 0.5, "pulse_width_us": 100.0}, "current 60.5 mA, limit 60 mA"),
        ({"current_ma": 50.0, "pulse_width_us": 401.0}, "charge per phase 20.05 µC, limit 20 µC"),
    ],
)
def test_a_channel_by_radio_has_the_radios_limits_whatever_its_own_are(asked: dict[str, float], says: str) -> None:
    wide = unchecked_channel(
        max_current_ma=130.0, max_pulse_width_us=500.0, max_charge_per_phase_uc=65.0, max_rise_ma_per_s=1e6,
        max_current_density_ma_per_cm2=2.0, max_on_s=3.0, max_charge_per_minute_mc=100.0,
    )  # fmt: skip
    bench = RadioBench(wide)
    bench.wait(20)
    assert says in bench.ask(**asked).refused
    bench.rearm()
    bench.off()
    bench.wait(200)
    off_after_s = next(0.02 * step for step, command in enumerate(bench.hold(3.0, current_ma=20.0)) if not command.on)
    assert off_after_s == pytest.approx(RADIO.max_on_s, abs=0.04)
    state = bench.gate._channels[0]
    assert state.most_mc == RADIO.max_charge_per_minute_mc
    assert bench.off().validity_ms == RADIO.max_validity_ms


def test_without_a_radio_nothing_is_tighter() -> None:
    gate = SafetyGate((make_channel(),), max_data_age_ms=500, validity_ms=500)
    assert gate._channels[0].most is limits.CABLE
