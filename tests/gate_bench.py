"""A gate on a bench: a channel, a clock that the test moves, and sensors that keep sending."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from fes.config import Channel, ChannelLimits
from fes.gate import SafetyGate
from fes.signals import NS_PER_S, Event, ImuSample, OperatorAct, OperatorAction, StimCommand, StimRequest

MS = 1_000_000
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
        self,
        *channels: Channel,
        max_data_age_ms: int = 40,
        validity_ms: int = 60,
        arm: bool = True,
        risen: bool = True,
        **more: Any,
    ) -> None:
        self.risen = risen
        self.rests, self.turned_ns = False, -NS_PER_S
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
            plain = ImuSample(
                self.t_ns, sensor, self.t_ns - 3 * MS, (noise(self.t_ns), 0.0, 9.8), (0.0, 0.0, self.turns_radps())
            )
            self.observe(plain._replace(**changes))

    def turns_radps(self) -> float:
        """About the vertical: by jerks of 1 rad/s, which go on as one long swing, or at rest."""
        if self.rests or self.t_ns - self.turned_ns < 150 * MS:
            return noise(self.t_ns)
        self.turned_ns = self.t_ns
        return 1.0 + noise(self.t_ns)

    def wait(self, ms: float, *, sampling: bool = True) -> None:
        """Let time pass, with a sample at its end, and often enough before."""
        end_ns = self.t_ns + round(ms * MS)
        while sampling and end_ns - self.t_ns > 200 * MS:
            self.t_ns += 200 * MS
            self.sample()
        self.t_ns = end_ns
        if self.risen:  # a burst that is not asked for yet has had its rise: most tests are of something else
            for state in self.gate._channels.values():
                if not state.on:
                    state.ramp_ma += min(ms, 20.0) * 1e-3 * state.most_rise_ma_per_s
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
    state = bench.gate._channels[0]
    bench.wait(20)
    state.ramp_ma = until_ma
    return bench
