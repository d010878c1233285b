"""What the demands do to the intensity, by method: current and a hold, or a profile of widths over the burst.

Run-to-run moves the current. Where the session's bounds let the pulse width fall below the channel's own and foot pitch
at contact has a target, the burst has two levels: full width until the foot has been carried over, then a *hold* until
the end, which the pitch at contact is answerable to. One current for both is too much for one of them: the hold is as
strong as contact needs, never stronger than the channel's own width.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from statistics import median_low
from typing import Final

from fes.config import Channel, Tuning
from fes.signals import StrideResult
from fes.stimulation.parameters import BurstParameters
from fes.stimulation.tuning.demand import Demand, in_mid_swing, leading, reason, room
from fes.stimulation.tuning.guardrails import QUANTUM_MA, limited
from fes.stimulation.tuning.learning import MOST_AT_ONCE, Zones, next_profile, zones_of
from fes.stimulation.tuning.targets import Reading, swing_times

WEAKEST_HOLD: Final = 0.5  # of the channel's own width: less would hardly reach the muscle
REMEMBERED: Final = 5
HELD_BACK: Final = 0.99  # of the own width: a hold below it can still be raised


class Intensity:
    """Of one channel: settings in, settings out."""

    def __init__(self, channel: Channel, tuning: Tuning) -> None:
        self._channel, self._tuning = channel, tuning
        self._own = BurstParameters.of(channel)
        learns, bounds = tuning.method == "learning", tuning.bounds
        may_fall = bounds is not None and bounds.pulse_width_us.low < channel.pulse_width_us
        self._middles: deque[int] = deque(maxlen=REMEMBERED)  # so that the hold's begin does not follow every stride
        self._zoned = learns or (may_fall and tuning.pitch_at_contact_deg is not None)

    def zones(self, stride: StrideResult, parameters: BurstParameters) -> Zones | None:
        """Which part of the profile this stride's mid-swing and its end were answerable to; None for one drive."""
        times = swing_times(stride) if self._zoned else None
        if times is None:
            return None
        burst_s = parameters.start_delay_s
        if self._channel.start_phase == "swing" and stride.t_pre_swing_ns is not None:
            burst_s += 1e-9 * ((stride.t_swing_ns or stride.t_pre_swing_ns) - stride.t_pre_swing_ns)
        return zones_of(times, burst_s, len(parameters.widths_us))

    def drives(
        self, reading: Reading, zones: Zones | None, parameters: BurstParameters, intensity: float
    ) -> dict[str, float]:
        """The drive that each measure has seen: the pitch at contact the late part's, the others the first's."""
        widths = parameters.widths_us
        full = intensity * parameters.current_ma / self._own.current_ma / self._own.mean_width_us
        first, last = (parameters.mean_width_us,) * 2 if zones is None else zones.means(widths)
        return {measure.name: full * (last if measure.at_contact else first) for measure in reading.measures}

    def leader(self, demands: tuple[Demand, ...], zones: Zones | None, parameters: BurstParameters) -> Demand:
        """The demand that a change is for, and that says why."""
        if self._tuning.method == "learning":
            return leading(demands)
        middle = in_mid_swing(demands)
        if self._holds_back(zones, parameters):
            return middle if middle.error else next((demand for demand in demands if demand.error), middle)
        late = _late(demands)
        if zones is not None and not demands[0].error and late is not None and late.error < 0.0:
            return late
        return demands[0]

    def answered(
        self, base: BurstParameters, demands: tuple[Demand, ...], zones: Zones | None, intensity: float
    ) -> BurstParameters:
        """``base`` with the intensity that the demands ask for, before any limit or bound."""
        if self._tuning.method == "learning":
            return base if zones is None else self._reshaped(base, demands, zones, intensity)
        # a hold that is held back is itself the answer to what contact asks for
        asks = in_mid_swing(demands) if self._holds_back(zones, base) else demands[0]
        others = tuple(demand for demand in demands if demand is not asks)
        step = min(self._tuning.gain * asks.step, room((asks, *others)) if zones is None else room((asks,)))
        current_ma = base.current_ma + step / intensity * self._own.current_ma
        after = limited(base, replace(base, current_ma=current_ma), self._tuning)
        late = _late(demands)
        return after if zones is None or late is None else self._held(base, after, late, zones, intensity)

    def why_held(
        self, before: BurstParameters, after: BurstParameters, demands: tuple[Demand, ...], led: Demand
    ) -> str:
        """Why the hold changes, in words, where what led to the change says nothing about it; "" otherwise."""
        late = _late(demands)
        if self._tuning.method == "learning" or after.widths_us == before.widths_us or late in (None, led):
            return ""
        return (
            f"; {reason(late)}" if late is not None and late.error else "; the hold until contact as strong as it was"
        )

    def lessened(self, base: BurstParameters, error: float) -> BurstParameters:
        """All that one stride allows, away from where the last trial went."""
        sign = 1.0 if error > 0.0 else -1.0
        if self._tuning.method == "run_to_run":
            return replace(base, current_ma=base.current_ma + sign * self._tuning.max_change_ma)
        return replace(base, widths_us=tuple(width + sign * self._tuning.max_change_us for width in base.widths_us))

    def _holds_back(self, zones: Zones | None, parameters: BurstParameters) -> bool:
        return zones is not None and zones.means(parameters.widths_us)[1] < HELD_BACK * self._channel.pulse_width_us

    def _held(
        self, base: BurstParameters, after: BurstParameters, late: Demand, zones: Zones, intensity: float
    ) -> BurstParameters:
        """``after`` with the hold that contact needs, whatever the current does meanwhile."""
        own_us, drive_of_us = self._channel.pulse_width_us, base.current_ma / self._own.current_ma
        hold_us = zones.means(base.widths_us)[1] * drive_of_us
        error = min(max(late.error, -MOST_AT_ONCE), MOST_AT_ONCE)
        hold_us += own_us * self._tuning.gain * error / late.slope / intensity
        hold_us *= self._own.current_ma / max(after.current_ma, QUANTUM_MA)
        hold_us = min(max(hold_us, WEAKEST_HOLD * own_us), own_us)
        self._middles.append(zones.middle)
        full = median_low(self._middles)
        return replace(after, widths_us=(own_us,) * full + (hold_us,) * (len(base.widths_us) - full))

    def _reshaped(
        self, base: BurstParameters, demands: tuple[Demand, ...], zones: Zones, intensity: float
    ) -> BurstParameters:
        late = _late(demands) or demands[0]
        middle = in_mid_swing(demands)
        width_us = self._channel.pulse_width_us / intensity
        profile = next_profile(
            base.widths_us, zones, (middle.error, late.error), (middle.slope, late.slope), width_us, self._tuning.gain
        )
        return replace(base, widths_us=tuple(profile))


def _late(demands: tuple[Demand, ...]) -> Demand | None:
    return next((demand for demand in demands if demand.measure.at_contact), None)
