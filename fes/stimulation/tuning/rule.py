"""The tuning's own rule: what is missing is given, what is too much is slowly taken away, stride by stride.

It grew from the plain rule of an independent comparison; what was added to it is in the table and in the settings.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from enum import Enum
from itertools import pairwise
from statistics import median
from typing import Final

from fes.config import Channel, Tuning
from fes.signals import NS_PER_S, StrideResult
from fes.stimulation.envelope import BIN_S, BurstParameters
from fes.stimulation.tuning.report import Proposal, Seen
from fes.stimulation.tuning.settings import OWN, RuleSettings
from fes.stimulation.tuning.targets import PITCH, ROLL, Drives, Measure, Reading, bands_per_drive, drives_of
from fes.stimulation.tuning.usable import JOLTED, NO_CHARGE


class State(Enum):
    """What the rule is about."""

    FOLLOW = "what is missing is given, what is too much is taken away"
    SPARE = "a fault was named: given as ever, nothing taken away"
    BACK = "on ground that was walked on before: to what was right there"


class Event(Enum):
    """What happened."""

    FAULT = "the watch named something"
    SPARED = "that is some strides ago"
    GROUND = "a person told of ground that was walked on before"
    THERE = "what was right there is in force"


_S, _E = State, Event
TRANSITIONS: Final[Mapping[State, Mapping[Event, State]]] = {  # what a state does not list changes nothing
    _S.FOLLOW: {_E.FAULT: _S.SPARE, _E.GROUND: _S.BACK},
    _S.SPARE: {_E.SPARED: _S.FOLLOW, _E.GROUND: _S.BACK},
    _S.BACK: {_E.THERE: _S.FOLLOW, _E.FAULT: _S.SPARE},
}


class OwnRule:
    """Follows one channel's foot."""

    def __init__(self, channel: Channel, incline: float | None = 0.0, settings: RuleSettings = OWN) -> None:
        self.state = State.FOLLOW
        self._channel, self._tuning, self._own = channel, channel.tuning or Tuning(), settings
        self._start = self._newest = self._target = BurstParameters.for_channel(channel)  # BACK goes to the target
        self._ground, self._by_ground = incline, {incline: self._start}
        self._answers: dict[str, deque[tuple[float, float]]] = {}  # drive and level, by measure
        self._phases: deque[tuple[float, ...]] = deque(maxlen=settings.remembered)  # pre-swing, swing, loading; s
        self._bare: list[float] = []  # levels without stimulation
        self._since_fault = self._jolts = self._spent = self._vain = self._untaught = 0

    def acted(self, what: str, incline: float | None = None) -> None:
        """A person acted."""
        self._spent = self._vain = self._untaught = 0
        self._answers.clear()  # on other ground, or from other settings, the foot answers otherwise
        if what != "ground":
            self.state = State.FOLLOW
            self._by_ground.clear()
        elif incline != self._ground:
            self._by_ground[self._ground] = self._target if self.state is State.BACK else self._newest
            self._ground = incline
            if incline in self._by_ground:
                self._target = self._by_ground[incline]
                self._on(Event.GROUND)

    def _on(self, event: Event) -> None:
        self.state = TRANSITIONS[self.state].get(event, self.state)

    def stride(self, seen: Seen) -> Proposal | None:
        """The newest stride; what is to come of it."""
        self._newest = seen.given
        if seen.reading is None or seen.skipped:
            return self._skipped(seen)
        self._untaught = self._jolts = 0
        if seen.noticed:
            self._answers.clear()  # the foot answers otherwise now
        drives = drives_of(seen.given, self._channel)
        for measure in seen.reading.measures:
            answers = self._answers.setdefault(measure.name, deque(maxlen=self._own.answers))
            answers.append((seen.intensity * drives.behind(measure), measure.level))
        if (phases_s := phases_of(seen.stride)) is not None:
            self._phases.append(phases_s)
        self._since_fault = 0 if seen.noticed else self._since_fault + 1
        if seen.noticed or self._since_fault >= self._own.spared:
            self._on(Event.FAULT if seen.noticed else Event.SPARED)
        if said := self._in_vain(seen.reading):
            return said
        wanted, why = self._to_the_target(seen) if self.state is State.BACK else self._wanted(seen, seen.reading)
        return self._timed(seen.stride, wanted, why)

    def _skipped(self, seen: Seen) -> Proposal:
        """A stride that teaches nothing leaves all as it is, but when stimulation may jerk the foot."""
        text, given, own = f"stride {seen.stride.number} skipped: {seen.skipped}", seen.given, self._own
        if seen.skipped == NO_CHARGE and seen.reading is not None:
            self._bare.append(seen.reading.level)
        self._untaught += seen.charge_uc > 0.0
        self._jolts = self._jolts + 1 if JOLTED in seen.skipped else 0
        if self._jolts >= own.twice:
            return Proposal(f"{text}, stimulation may jerk the foot; less", self._burst(given, Drives(0.0, 0.0)))
        if self._untaught and self._untaught % own.untaught == 0:
            text += f"; {self._untaught} strides in a row have taught nothing and the settings stay as they are"
        return Proposal(text)

    def _in_vain(self, reading: Reading) -> Proposal | None:
        """At the bound and still short: a hint, and the end where the foot does not answer at all."""
        own, text = self._own, reading.measures[0].text()
        spent = max(drives_of(self._newest, self._channel)) >= own.spent and reading.level < 0.0
        bare = median(self._bare) + own.answered if self._bare else own.no_answer
        self._spent = self._spent + 1 if spent else 0
        self._vain = self._vain + 1 if spent and reading.level < bare else 0
        if self._vain == own.vain:
            text += ": the foot does not answer to all that the bounds allow, look at the electrodes"
            return Proposal(text, stop=True)
        if self._spent == own.vain:
            return Proposal(f"{text} is not reached at the upper bound: look at electrodes, fatigue and target")
        return None

    def _to_the_target(self, seen: Seen) -> tuple[BurstParameters, str]:
        """Settings from before, but nothing to less while something lies below its band."""
        now, aim = drives_of(seen.given, self._channel), drives_of(self._target, self._channel)
        if seen.reading is not None and seen.reading.level < 0.0:
            aim = Drives(max(now.front, aim.front), max(now.tail, aim.tail))
        if max(abs(now.front - aim.front), abs(now.tail - aim.tail)) < self._own.there:
            self._on(Event.THERE)
        return self._burst(seen.given, aim), "this was right before on this ground"

    def _wanted(self, seen: Seen, reading: Reading) -> tuple[BurstParameters, str]:
        """Front and tail, each by what it answers for, and why; "" for no change.

        The front follows the toe's clearance, and the pitch too as long as the tail is no weaker and the toe lies no
        higher than ``pitch_leads``. The tail follows the pitch and never exceeds the front.
        """
        lifts = next((measure for measure in reading.measures if measure.name != PITCH), reading.measures[0])
        holds = next((measure for measure in reading.measures if measure.name == PITCH), lifts)
        own, (front, tail) = self._own, drives_of(seen.given, self._channel)
        if tail >= front - own.there and lifts.level < own.pitch_leads and self._lacks(holds) > self._lacks(lifts):
            lifts = holds
        steps = {measure: self._step(measure) for measure in (lifts, holds)}
        front += steps[lifts]
        wanted = self._burst(seen.given, Drives(front, min(tail + steps[holds], front)))
        return wanted, "; ".join(self._why(measure) for measure, step in steps.items() if step)

    def _lacks(self, measure: Measure) -> float:
        return self._aim(measure) - measure.level

    def _step(self, measure: Measure) -> float:
        """By how much the drive of what a measure answers for is to change."""
        own, answers, newest = self._own, self._answers[measure.name], self._lacks(measure)
        errors = [self._aim(measure) - level for _, level in answers][-own.surely :]
        usual = median(errors[-own.lately :])
        bands = max(bands_per_drive(answers, own), 1.0 / own.drive_per_band)  # never further than the usual foot's
        if newest > own.near:
            return self._tuning.gain * newest / bands
        surely = max(newest, usual) < -own.far or (len(errors) == own.surely and max(errors) < -own.much)
        return max(usual / bands, -own.eased) if surely and self.state is not State.SPARE else 0.0

    def _aim(self, measure: Measure) -> float:
        own = self._own
        return {PITCH: own.pitch_aim, ROLL: own.roll_aim}.get(measure.name, own.toe_aim)

    def _why(self, measure: Measure) -> str:
        then = "more is needed" if self._lacks(measure) > 0.0 else "less will do"
        return f"{measure.text()}, {measure.format_level(self._aim(measure))} is aimed at, {then}"

    def _usual_phases_s(self) -> tuple[float, float, float]:
        pre, swing, loading = (median(each) for each in zip(*self._phases, strict=True))
        return pre, swing, loading

    def _timed(self, stride: StrideResult, wanted: BurstParameters, why: str) -> Proposal:
        """Start and end with the phases: up early in the swing, the force gone as the foot lies flat."""
        own = self._own
        if not self._tuning.timing or not self._phases:
            return Proposal(why, wanted)
        pre_s, swing_s, loading_s = self._usual_phases_s()
        delay_s = max(pre_s + own.up_at * swing_s - own.answer_s - self._channel.rise_s, 0.0)
        delay_s = delay_s if self._channel.start_phase == "pre_swing" else 0.0
        wanted = replace(wanted, start_delay_s=delay_s, extension_s=loading_s - own.outlives_s)
        return Proposal(why or f"timing follows the speed ({stride.speed_mps:.1f} m/s)", wanted)

    def _burst(self, base: BurstParameters, drives: Drives) -> BurstParameters:
        """``base`` with these drives, before any limit or bound."""
        bounds, carried = self._tuning.bounds, len(base.widths_us)
        assert bounds is not None
        if self._phases:
            pre_s, swing_s, _ = self._usual_phases_s()
            begun_s = base.start_delay_s + (pre_s if self._channel.start_phase == "swing" else 0.0)
            bins = round((pre_s + self._own.carried * swing_s - self._own.answer_s - begun_s) / BIN_S)
            carried = min(max(bins, 0), carried)
        front, most_us = min(drives.front, 1.0), bounds.pulse_width_us.high
        first_us, last_us = front * most_us, drives.tail * most_us
        if self._tuning.method == "run_to_run":
            base = replace(base, current_ma=front * bounds.current_ma.high)
            first_us = self._channel.pulse_width_us
            last_us = first_us * min(drives.tail / max(front, 0.01), 1.0)
        return replace(base, widths_us=(first_us,) * carried + (last_us,) * (len(base.widths_us) - carried))


def phases_of(stride: StrideResult) -> tuple[float, ...] | None:
    """Seconds of pre-swing, swing and loading response; None where the stride did not pass all of them."""
    at = (stride.t_pre_swing_ns, stride.t_swing_ns, stride.t_loading_response_ns, stride.t_stance_ns)
    times = [t_ns for t_ns in at if t_ns is not None]
    whole = len(times) == len(at) and stride.t_end_ns > stride.t_start_ns
    return tuple((b - a) / NS_PER_S for a, b in pairwise(times)) if whole else None
