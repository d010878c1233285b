"""What the demands do to a burst: current and a hold, or a profile of pulse widths over the burst.

*Run-to-run* moves the current. Where the session's bounds let the pulse width fall below the channel's own and foot
pitch at contact has a target, the burst has two levels: full width until the foot has been carried over, then a *hold*
until the end, as strong as the pitch at contact needs, never stronger than the channel's own width.

*Learning* is sample-wise iterative learning of the pulse-width profile:

    u[k+1](t) = Q{u[k](t) + gain · G⁻¹ e[k](t + d)}

after Seel, Werner, Raisch & Schauer, *Control Engineering Practice* 48 (2016). ``e[k]`` is what each sample of the last
swing is short of its reference: the toe's height in mid-swing, foot pitch (or roll) where contact comes. ``G⁻¹`` turns
it into drive by the identified response (threshold and slope), ``d`` is the identified delay from pulse to movement;
before the end of mid-swing a pulse answers for all that is left of it.
The swing's length varies, so only what the last swing reached is updated (variable pass length). Q averages over
neighbours (no greater than 1 at any frequency), but lowers no bin that asks for more.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean, median_low
from typing import Final

from fes.config import Channel, Tuning
from fes.signals import StrideResult
from fes.stimulation.envelope import BIN_S, BurstParameters
from fes.stimulation.tuning.demand import Demand, in_mid_swing, late_demand, leading, room
from fes.stimulation.tuning.guardrails import QUANTUM_MA, QUANTUM_US, at_least, limited
from fes.stimulation.tuning.report import reason
from fes.stimulation.tuning.targets import Reading, SwingTimes, interpolate, swing_times

SIDE: Final = 0.15  # weight of each neighbour in Q
WEAKEST_HOLD: Final = 0.5  # of the channel's own width: less would hardly reach the muscle
REMEMBERED: Final = 5
HELD_BACK: Final = 0.99  # of the own width: a hold below it can still be raised
LOWERED: Final = 0.2  # of what one stride may change, within the bands: raised at once, lowered by fifths


@dataclass(frozen=True, slots=True)
class Zones:
    """Bins ``0 … carried`` carry the foot over in mid-swing, ``carried … reached`` hold it until contact.

    ``burst_s`` is when the burst began, since entry into pre-swing, as all the ``times``.
    """

    carried: int
    reached: int
    burst_s: float
    times: SwingTimes

    def means(self, widths: Sequence[float]) -> tuple[float, float]:
        """Mean width of each, the other's where one has no bins."""
        first, last = widths[: self.carried], widths[self.carried : self.reached]
        return fmean(first or last or widths), fmean(last or first or widths)


def zones_of(times: SwingTimes, burst_s: float, delay_s: float, bins: int) -> Zones:
    """Which bins the stride's mid-swing and its end are answerable to."""
    reached = min(max(int((times.contact_s - burst_s) / BIN_S + 0.5), 0), bins)
    carried = int((times.mid_swing_end_s - delay_s - burst_s) / BIN_S + 0.5)
    return Zones(min(max(carried, 0), reached), reached, burst_s, times)


def missing_drives(zones: Zones, delay_s: float, times_s: Sequence[float], missing: Sequence[float]) -> list[float]:
    """What each bin reached is short of, in drive: what the sample is that its pulses first move, a delay later.

    A foot that has been lifted has to be carried over: a pulse before the end of mid-swing answers for the most of all
    that is left of it, not for the toe's height on its way there, which the knee gives it. ``missing`` (N,) is what the
    samples at ``times_s`` (N,) since entry into pre-swing are short of; the first and the last answer beyond them.
    """
    found = []
    for k in range(zones.reached):
        at_s = zones.burst_s + (k + 0.5) * BIN_S + delay_s
        left = [m for t, m in zip(times_s, missing, strict=True) if at_s <= t <= zones.times.mid_swing_end_s]
        found.append(max(left) if left else interpolate(at_s, times_s, missing))
    return found


def next_profile(widths: Sequence[float], steps_us: Sequence[float]) -> list[float]:
    """The next stride's profile in µs, before any limit or bound.

    ``steps_us`` are the changes of the bins that the last swing reached. Q works on these, but takes nothing from a bin
    that asks for more; beyond them the profile goes on with the width of the last, which the next, longer swing will
    judge.
    """
    n = len(steps_us)
    raised = [width + step for width, step in zip(widths, steps_us, strict=False)]
    smooth = list(widths)
    for k in range(n):
        before, after = raised[max(k - 1, 0)], raised[min(k + 1, n - 1)]
        smooth[k] = SIDE * before + (1.0 - 2.0 * SIDE) * raised[k] + SIDE * after
        if steps_us[k] > 0.0:
            smooth[k] = max(smooth[k], widths[k])
    if n:
        smooth[n:] = [smooth[n - 1]] * (len(smooth) - n)
    return smooth


class BurstShape:
    """Of one channel: settings in, settings out. Drives are shares of the upper bound, at full intensity."""

    def __init__(self, channel: Channel, tuning: Tuning, most: float) -> None:
        self._channel, self._tuning, self._most = channel, tuning, most
        self._own = BurstParameters.for_channel(channel)
        self._learns, bounds = tuning.method == "learning", tuning.bounds
        may_fall = bounds is not None and bounds.pulse_width_us.low < channel.pulse_width_us
        self._carried: deque[int] = deque(maxlen=REMEMBERED)  # so that the hold's begin does not follow every stride
        self._zoned = self._learns or (may_fall and tuning.pitch_at_contact_deg is not None)

    def zones(self, stride: StrideResult, parameters: BurstParameters, delay_s: float) -> Zones | None:
        """Which part of the profile this stride's mid-swing and its end were answerable to; None for one drive."""
        times = swing_times(stride) if self._zoned else None
        if times is None:
            return None
        return zones_of(times, self.begins_s(times, parameters), delay_s, len(parameters.widths_us))

    def begins_s(self, times: SwingTimes, parameters: BurstParameters) -> float:
        """When the burst began, since entry into pre-swing."""
        return parameters.start_delay_s + (times.foot_off_s if self._channel.start_phase == "swing" else 0.0)

    def drive_per_us(self, parameters: BurstParameters, intensity: float) -> float:
        """What a microsecond of pulse width is worth at this current, as a share of the upper bound."""
        return intensity * parameters.current_ma / self._own.current_ma / self._own.mean_width_us / self._most

    def drives(
        self, reading: Reading, zones: Zones | None, parameters: BurstParameters, intensity: float
    ) -> dict[str, float]:
        """The drive that each measure has seen: what is measured at contact the late part's, the others the first's."""
        per_us = self.drive_per_us(parameters, intensity)
        first, last = (parameters.mean_width_us,) * 2 if zones is None else zones.means(parameters.widths_us)
        return {measure.name: per_us * (last if measure.at_contact else first) for measure in reading.measures}

    def leader(self, demands: tuple[Demand, ...], zones: Zones | None, parameters: BurstParameters) -> Demand:
        """The demand that a change is for, and that says why."""
        if self._learns:
            return leading(demands)
        middle = in_mid_swing(demands)
        if self._holds_back(zones, parameters):
            return middle if middle.error else next((demand for demand in demands if demand.error), middle)
        late = late_demand(demands)
        if zones is not None and not demands[0].error and late is not None and late.error < 0.0:
            return late
        return demands[0]

    def answered(
        self, base: BurstParameters, demands: tuple[Demand, ...], zones: Zones | None, intensity: float
    ) -> BurstParameters:
        """Run-to-run: ``base`` with the current and the hold that the demands ask for, before any limit or bound."""
        # a hold that is held back is itself the answer to what contact asks for
        asks = in_mid_swing(demands) if self._holds_back(zones, base) else demands[0]
        drive = asks.drive + self.gain(asks) * asks.step
        if zones is None:
            drive = min(drive, max(room((asks, *(each for each in demands if each is not asks))), asks.drive))
        step = (drive - asks.drive) * self._most / intensity
        after = limited(base, replace(base, current_ma=base.current_ma + step * self._own.current_ma), self._tuning)
        hold = late_demand(demands)
        return after if zones is None or hold is None else self._held(base, after, hold, zones, intensity)

    def learnt(
        self, base: BurstParameters, zones: Zones, delay_s: float, times_s: Sequence[float],
        missing: Sequence[float], intensity: float, *, at_once: bool, short: bool,
    ) -> BurstParameters:  # fmt: skip
        """Learning: ``base`` with the profile that the last swing's samples ask for, before any limit or bound.

        ``at_once``: whether all that is too much may go at once, for a measure lies above its band and none below;
        ``short``: whether mid-swing's lies below, so that nothing is lowered: what is too much for contact may help.
        """
        per_drive_us = self._channel.pulse_width_us * self._most / intensity
        most_us = self._tuning.max_change_us
        least_us = -most_us if at_once else -max(LOWERED * most_us, min(QUANTUM_US, most_us))
        least_us = 0.0 if short else least_us
        drives = missing_drives(zones, delay_s, times_s, missing)
        steps_us = [max(per_drive_us * step, least_us) for step in drives]
        after = replace(base, widths_us=tuple(next_profile(base.widths_us, steps_us)))
        return at_least(after, base) if short else after

    def why_held(
        self, before: BurstParameters, after: BurstParameters, demands: tuple[Demand, ...], led: Demand
    ) -> str:
        """Why the hold changes, in words, where what led to the change says nothing about it; "" otherwise."""
        late = late_demand(demands)
        if self._learns or after.widths_us == before.widths_us or late in (None, led):
            return ""
        held = "the hold until contact as strong as it was"
        return f"; {reason(late) if late is not None and late.error else held}"

    def lessened(self, base: BurstParameters) -> BurstParameters:
        """As little as one stride allows."""
        if not self._learns:
            return replace(base, current_ma=base.current_ma - self._tuning.max_change_ma)
        return replace(base, widths_us=tuple(width - self._tuning.max_change_us for width in base.widths_us))

    def even(self, base: BurstParameters) -> BurstParameters:
        """For a speed that nothing is known of: everywhere as strong as where ``base`` is strongest, begun no later
        than the session says."""
        widths_us = (max(base.widths_us),) * len(base.widths_us)
        return replace(base, widths_us=widths_us, start_delay_s=min(base.start_delay_s, self._own.start_delay_s))

    def scaled(self, base: BurstParameters, factor: float) -> BurstParameters:
        """``base`` with its strength times this."""
        if not self._learns:
            return replace(base, current_ma=base.current_ma * factor)
        return replace(base, widths_us=tuple(width * factor for width in base.widths_us))

    def gain(self, demand: Demand) -> float:
        """Below the band all that is missing is given at once, as far as one stride may."""
        return 1.0 if demand.usual < 0.0 else self._tuning.gain

    def _holds_back(self, zones: Zones | None, parameters: BurstParameters) -> bool:
        return zones is not None and zones.means(parameters.widths_us)[1] < HELD_BACK * self._channel.pulse_width_us

    def _held(
        self, base: BurstParameters, after: BurstParameters, late: Demand, zones: Zones, intensity: float
    ) -> BurstParameters:
        """``after`` with the hold that contact needs, whatever the current does meanwhile."""
        own_us, drive_of_us = self._channel.pulse_width_us, base.current_ma / self._own.current_ma
        hold_us = zones.means(base.widths_us)[1] * drive_of_us
        hold_us += own_us * self._most * self.gain(late) * late.step / intensity
        hold_us *= self._own.current_ma / max(after.current_ma, QUANTUM_MA)
        hold_us = min(max(hold_us, WEAKEST_HOLD * own_us), own_us)
        self._carried.append(zones.carried)
        full = median_low(self._carried)
        return replace(after, widths_us=(own_us,) * full + (hold_us,) * (len(base.widths_us) - full))
