"""What the demands do to the intensity, by method: current and a hold, or a profile of widths over the burst.

*Run-to-run* moves the current. Where the session's bounds let the pulse width fall below the channel's own and foot
pitch at contact has a target, the burst has two levels: full width until the foot has been carried over, then a *hold*
until the end, as strong as the pitch at contact needs, never stronger than the channel's own width.

*Learning* is iterative learning of the pulse-width profile over the burst: ``u[k+1](t) = Q{u[k](t) + L e[k](t + d)}``.
``d`` is about the delay from pulse to movement; the swing's length varies, so only what the last swing reached is
updated (variable pass length); inside the reference band the error is 0. It converges if ``|Q (1 - L G)| < 1``: with
``L = gain / slope`` and Q an average over neighbours (no greater than 1 at any frequency), for a true slope G from 0 to
``2 / gain`` times the estimated one. After Seel, Werner, Raisch & Schauer, *Control Engineering Practice* 48 (2016),
with a profile of widths and bands instead of a reference curve: until the end of mid-swing the error is the
clearance's, from there to contact the pitch's.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean, median_low
from typing import Final

from fes.config import Channel, Tuning
from fes.signals import StrideResult
from fes.stimulation.envelope import BIN_S, BurstParameters
from fes.stimulation.tuning.demand import Demand, in_mid_swing, late_demand, leading, reason, room
from fes.stimulation.tuning.guardrails import QUANTUM_MA, limited
from fes.stimulation.tuning.targets import Reading, swing_times

DELAY_S: Final = 0.15  # electromechanical delay 20–50 ms, rise of the activation 50 ms, and the foot's own inertia
SIDE: Final = 0.15  # weight of each neighbour in Q
MOST_AT_ONCE: Final = 1.0  # of the band: one bad moment must not move the profile further
WEAKEST_HOLD: Final = 0.5  # of the channel's own width: less would hardly reach the muscle
REMEMBERED: Final = 5
HELD_BACK: Final = 0.99  # of the own width: a hold below it can still be raised


@dataclass(frozen=True, slots=True)
class Zones:
    """Bins ``0 … middle`` carry the foot through mid-swing, ``middle … reached`` hold it until contact."""

    middle: int
    reached: int

    def means(self, widths: Sequence[float]) -> tuple[float, float]:
        """Mean width of each, the other's where one has no bins."""
        first, last = widths[: self.middle], widths[self.middle : self.reached]
        return fmean(first or last or widths), fmean(last or first or widths)


def zones_of(middle_s: float, contact_s: float, burst_s: float, bins: int) -> Zones:
    """Which bins the stride's mid-swing and its end are answerable to; ``burst_s`` is the burst's begin."""
    reached = min(max(int((contact_s - burst_s) / BIN_S + 0.5), 0), bins)
    middle = int((middle_s - DELAY_S - burst_s) / BIN_S + 0.5)
    return Zones(min(max(middle, 0), reached), reached)


def next_profile(
    widths: Sequence[float], zones: Zones, errors: tuple[float, float], slopes: tuple[float, float],
    base: float, gain: float,
) -> list[float]:  # fmt: skip
    """The next stride's profile in µs, before any limit or bound.

    ``widths`` and ``zones`` are the last stride's, ``errors`` those of each zone in bands, ``slopes`` in bands per
    drive; ``base`` is the width that counts as drive 1, ``gain`` the share of the error to take away at once: ``gain /
    slope`` is the learning gain L. The smoothing Q works on the bins reached; beyond them the profile goes on with the
    width of the last, which the next, longer swing will judge.
    """
    n = zones.reached
    raised = list(widths)
    for k in range(n):
        zone = 0 if k < zones.middle else 1
        raised[k] += base * gain / slopes[zone] * min(max(errors[zone], -MOST_AT_ONCE), MOST_AT_ONCE)
    smooth = list(widths)
    for k in range(n):
        before, after = raised[max(k - 1, 0)], raised[min(k + 1, n - 1)]
        smooth[k] = SIDE * before + (1.0 - 2.0 * SIDE) * raised[k] + SIDE * after
    if n:
        smooth[n:] = [smooth[n - 1]] * (len(smooth) - n)
    return smooth


class Intensity:
    """Of one channel: settings in, settings out."""

    def __init__(self, channel: Channel, tuning: Tuning) -> None:
        self._channel, self._tuning = channel, tuning
        self._own = BurstParameters.for_channel(channel)
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
        return zones_of(*times, burst_s, len(parameters.widths_us))

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
        late = late_demand(demands)
        if zones is not None and not demands[0].error and late is not None and late.error < 0.0:
            return late
        return demands[0]

    def answered(
        self, base: BurstParameters, demands: tuple[Demand, ...], zones: Zones | None, intensity: float
    ) -> BurstParameters:
        """``base`` with the intensity that the demands ask for, before any limit or bound."""
        if self._tuning.method == "learning":
            if zones is None:
                return base
            late, middle = late_demand(demands) or demands[0], in_mid_swing(demands)
            errors, slopes = (middle.error, late.error), (middle.slope, late.slope)
            width_us = self._channel.pulse_width_us / intensity
            gain = max(self._gain(late), self._gain(middle))
            profile = next_profile(base.widths_us, zones, errors, slopes, width_us, gain)
            return replace(base, widths_us=tuple(profile))
        # a hold that is held back is itself the answer to what contact asks for
        asks = in_mid_swing(demands) if self._holds_back(zones, base) else demands[0]
        others = tuple(demand for demand in demands if demand is not asks)
        step = min(self._gain(asks) * asks.step, room((asks, *others)) if zones is None else room((asks,)))
        current_ma = base.current_ma + step / intensity * self._own.current_ma
        after = limited(base, replace(base, current_ma=current_ma), self._tuning)
        hold = late_demand(demands)
        return after if zones is None or hold is None else self._held(base, after, hold, zones, intensity)

    def why_held(
        self, before: BurstParameters, after: BurstParameters, demands: tuple[Demand, ...], led: Demand
    ) -> str:
        """Why the hold changes, in words, where what led to the change says nothing about it; "" otherwise."""
        late = late_demand(demands)
        if self._tuning.method == "learning" or after.widths_us == before.widths_us or late in (None, led):
            return ""
        held = "the hold until contact as strong as it was"
        return f"; {reason(late) if late is not None and late.error else held}"

    def lessened(self, base: BurstParameters, error: float) -> BurstParameters:
        """All that one stride allows, away from where the last trial went."""
        sign = 1.0 if error > 0.0 else -1.0
        if self._tuning.method == "run_to_run":
            return replace(base, current_ma=base.current_ma + sign * self._tuning.max_change_ma)
        return replace(base, widths_us=tuple(width + sign * self._tuning.max_change_us for width in base.widths_us))

    def _gain(self, demand: Demand) -> float:
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
        error = min(max(late.error, -MOST_AT_ONCE), MOST_AT_ONCE)
        hold_us += own_us * self._tuning.gain * error / late.slope / intensity
        hold_us *= self._own.current_ma / max(after.current_ma, QUANTUM_MA)
        hold_us = min(max(hold_us, WEAKEST_HOLD * own_us), own_us)
        self._middles.append(zones.middle)
        full = median_low(self._middles)
        return replace(after, widths_us=(own_us,) * full + (hold_us,) * (len(base.widths_us) - full))
