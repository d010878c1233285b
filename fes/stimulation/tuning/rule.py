"""The tuning's own rule: what is missing is given, what is too much is slowly taken away, one stride at a time.

The table says what the rule is about after a stride; :meth:`OwnRule._wanted` is what it then does.
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
from fes.stimulation.ground import UNEVEN_GROUND
from fes.stimulation.tuning.report import Proposal, Seen
from fes.stimulation.tuning.settings import OWN, RuleSettings
from fes.stimulation.tuning.targets import PITCH, ROLL, Drives, Measure, Reading, bands_per_drive, drives_of
from fes.stimulation.tuning.usable import JOLTED, NO_CHARGE, OTHER_SPEED


class State(Enum):
    """What the rule is about."""

    CLIMB = "something lies below its band: what is missing is given, as far as one stride may"
    HOLD = "nothing does: of what is missing to the aim, the session's share is given"
    EASE = "something is too much: a little is taken away there"
    SPARE = "a fault was noticed: given as ever, nothing taken away"
    AWAY = "on a stair or slope that nobody told of: to the session's own settings"
    BACK = "settings from before are right again: to those"


class Event(Enum):
    """What a stride showed."""

    SHORT = "something lies below its band"
    GOOD = "nothing does"
    MUCH = "something is too much, as it was lately, and nothing lies below its band unless this lies above its own"
    FAULT = "the watch noticed something"
    SPARED = "that is some strides ago"
    UNEVEN = "the second stride in a row on a stair or slope"
    KNOWN = "even ground again, or other ground that a person told of"
    THERE = "these settings are in force"


_S, _E = State, Event
TRANSITIONS: Final[Mapping[State, Mapping[Event, State]]] = {  # what a state does not list changes nothing
    _S.CLIMB: {_E.GOOD: _S.HOLD, _E.MUCH: _S.EASE, _E.FAULT: _S.SPARE, _E.UNEVEN: _S.AWAY, _E.KNOWN: _S.BACK},
    _S.HOLD: {_E.SHORT: _S.CLIMB, _E.MUCH: _S.EASE, _E.FAULT: _S.SPARE, _E.UNEVEN: _S.AWAY, _E.KNOWN: _S.BACK},
    _S.EASE: {_E.SHORT: _S.CLIMB, _E.GOOD: _S.HOLD, _E.FAULT: _S.SPARE, _E.UNEVEN: _S.AWAY, _E.KNOWN: _S.BACK},
    _S.SPARE: {_E.SPARED: _S.HOLD, _E.UNEVEN: _S.AWAY, _E.KNOWN: _S.BACK},
    _S.AWAY: {_E.KNOWN: _S.BACK},
    _S.BACK: {_E.THERE: _S.HOLD, _E.FAULT: _S.SPARE, _E.UNEVEN: _S.AWAY},
}


class OwnRule:
    """Follows one channel's foot."""

    def __init__(self, channel: Channel, incline: float | None = 0.0, settings: RuleSettings = OWN) -> None:
        self.state = State.HOLD
        self._channel, self._tuning, self._own = channel, channel.tuning or Tuning(), settings
        self._start = self._newest = BurstParameters.for_channel(channel)
        self._target = self._start  # where BACK goes to
        self._ground, self._by_ground = incline, {incline: self._start}
        self._answers: dict[str, deque[tuple[float, float]]] = {}  # drive and level
        self._phases: deque[tuple[float, ...]] = deque(maxlen=settings.remembered)  # pre-swing, swing, loading: shares
        self._durations_s: deque[float] = deque(maxlen=settings.lately)
        self._carried: int | None = None  # bins of the front
        self._bare: list[float] = []  # levels without stimulation
        self._since_fault = self._uneven = self._jolts = self._spent = self._vain = self._untaught = 0

    def acted(self, what: str, incline: float | None = None) -> None:
        """A person acted."""
        self._spent = self._vain = self._untaught = 0
        if what != "ground":
            self.state = State.HOLD
            self._by_ground.clear()
        elif incline != self._ground:
            self._by_ground[self._ground] = self._target if self.state in (State.AWAY, State.BACK) else self._newest
            self._ground, self._target = incline, self._by_ground.get(incline, self._start)
            self.state = State.BACK

    def _on(self, event: Event) -> None:
        self.state = TRANSITIONS[self.state].get(event, self.state)

    def stride(self, seen: Seen) -> Proposal | None:
        """The newest stride; what is to come of it."""
        self._newest = seen.given
        if seen.reading is None or seen.skipped:
            return self._skipped(seen)
        if self.state is State.AWAY:
            self._on(Event.KNOWN)
        self._untaught = self._uneven = self._jolts = 0
        self._learn(seen, seen.reading)
        self._judge(seen, seen.reading)
        if said := self._in_vain(seen.reading):
            return said
        wanted, why = self._to_the_target(seen) if self.state is State.BACK else self._wanted(seen, seen.reading)
        return self._timed(seen.stride, wanted, why)

    def _skipped(self, seen: Seen) -> Proposal:
        """A stride that teaches nothing leaves all as it is, but on other ground, at another speed and when jerked."""
        text, given, own = f"stride {seen.stride.number} skipped: {seen.skipped}", seen.given, self._own
        if seen.skipped == NO_CHARGE and seen.reading is not None:
            self._bare.append(seen.reading.level)
        self._untaught += seen.charge_uc > 0.0
        self._uneven = self._uneven + 1 if UNEVEN_GROUND in seen.skipped else 0
        self._jolts = self._jolts + 1 if JOLTED in seen.skipped else 0
        if self._uneven == own.twice:
            self._target = self._target if self.state is State.BACK else given
            self._on(Event.UNEVEN)
        if self.state is State.AWAY:
            return Proposal(f"{text}; the session's own settings there", self._start)
        if self._jolts >= own.twice:
            return Proposal(f"{text}, stimulation may jerk the foot; less", self._burst(given, Drives(0.0, 0.0)))
        if OTHER_SPEED in seen.skipped:
            even = replace(given, start_delay_s=min(given.start_delay_s, self._start.start_delay_s))
            strongest = max(drives_of(given, self._channel))
            return Proposal(f"{text}; even until this speed is known", self._burst(even, Drives(strongest, strongest)))
        if self._untaught and self._untaught % own.untaught == 0:
            text += f"; {self._untaught} strides in a row have taught nothing and the settings stay as they are"
        return Proposal(text)

    def _learn(self, seen: Seen, reading: Reading) -> None:
        """How this foot answers, and how long its phases last."""
        drives, own = drives_of(seen.given, self._channel), self._own
        for measure in reading.measures:
            drive = seen.intensity * (drives.tail if measure.at_contact else drives.front)
            self._answers.setdefault(measure.name, deque(maxlen=own.remembered)).append((drive, measure.level))
        if (phases_s := phases_of(seen.stride)) is None:
            return
        self._durations_s.append((seen.stride.t_end_ns - seen.stride.t_start_ns) / NS_PER_S)
        self._phases.append(tuple(each_s / self._durations_s[-1] for each_s in phases_s))
        pre_s, swing_s, _ = self._usual_phases_s()
        begun_s = seen.given.start_delay_s + (pre_s if self._channel.start_phase == "swing" else 0.0)
        bins = (pre_s + own.carried_until * swing_s - own.answer_s - begun_s) / BIN_S
        if self._carried is None or abs(bins - self._carried) > 1.0:  # a border that follows every stride says nothing
            self._carried = max(round(bins), 0)

    def _judge(self, seen: Seen, reading: Reading) -> None:
        """What this stride showed, into the table."""
        if self._since_fault:
            self._since_fault -= 1
            if not self._since_fault:
                self._on(Event.SPARED)
        if seen.noticed:
            self._since_fault = self._own.spared
            self._on(Event.FAULT)
        much = [measure for measure in reading.measures if self._too_much(measure)]
        above = any(min(measure.level, self._usual(measure.name)) > 1.0 for measure in much)
        short = reading.level < 0.0
        self._on(Event.MUCH if much and (above or not short) else Event.SHORT if short else Event.GOOD)

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
        if self._spent == own.unreached:
            return Proposal(f"{text} is not reached at the upper bound: look at electrodes, fatigue and target")
        return None

    # --- what follows -------------------------------------------------------------------------------------

    def _to_the_target(self, seen: Seen) -> tuple[BurstParameters, str]:
        """Settings from before, but nothing to less while something lies below its band."""
        now, aim = drives_of(seen.given, self._channel), drives_of(self._target, self._channel)
        if seen.reading is not None and seen.reading.level < 0.0:
            aim = Drives(max(now.front, aim.front), max(now.tail, aim.tail))
        if max(abs(now.front - aim.front), abs(now.tail - aim.tail)) < self._own.there:
            self._on(Event.THERE)
        return self._burst(seen.given, aim), "this was right before on this ground"

    def _wanted(self, seen: Seen, reading: Reading) -> tuple[BurstParameters, str]:
        """Front and tail, each by what it answers for, and why; "" for no change."""
        pitch = next((measure for measure in reading.measures if measure.name == PITCH), None)
        lifts = next((measure for measure in reading.measures if measure is not pitch), pitch)
        assert lifts is not None
        now = drives_of(seen.given, self._channel)
        steps = [(lifts, self._step(lifts))]
        front = tail = steps[0][1]
        if pitch is not None and pitch is not lifts:
            tail = self._step(pitch)
            steps.append((pitch, tail))
            room = (self._own.pitch_leads - self._usual(lifts.name)) / self._bands(lifts.name)
            if now.tail >= now.front - self._own.there:
                front = max(front, min(tail, room))  # as far as the toe may rise for the pitch
        strong = now.front + front / seen.intensity
        wanted = self._burst(seen.given, Drives(strong, min(now.tail + tail / seen.intensity, strong)))
        return wanted, "; ".join(self._why(measure) for measure, step in steps if step)

    def _step(self, measure: Measure) -> float:
        """By how much the drive of what a measure answers for is to change."""
        own, error = self._own, self._aim(measure) - self._usual(measure.name)
        if error > own.near:
            return (1.0 if self.state is State.CLIMB else self._tuning.gain) * error / self._bands(measure.name)
        if self.state is State.EASE and self._too_much(measure):
            return max(error / self._bands(measure.name), -(own.eased if measure.level <= 1.0 else 1.0))
        return 0.0

    def _too_much(self, measure: Measure) -> bool:
        """Whether a measure is more than is aimed at, in this stride and lately."""
        return min(measure.level, self._usual(measure.name)) > self._aim(measure) + self._own.much

    def _usual(self, name: str) -> float:
        """Level of the last strides, had all been walked with the drive of the newest."""
        seen, bands = list(self._answers[name]), self._bands(name)
        return median(level + bands * (seen[-1][0] - drive) for drive, level in seen[-self._own.lately :])

    def _bands(self, name: str) -> float:
        return bands_per_drive(self._answers[name], self._own)

    def _aim(self, measure: Measure) -> float:
        own = self._own
        return {PITCH: own.pitch_aim, ROLL: own.roll_aim}.get(measure.name, own.toe_aim)

    def _why(self, measure: Measure) -> str:
        aim, usual = self._aim(measure), self._usual(measure.name)
        then = f"{measure.format_level(aim)} will do"
        if usual < aim:
            then = "more is needed" if usual < 0.0 else f"{measure.format_level(aim)} is aimed at"
        return f"{measure.text()} in this stride, lately {measure.format_level(usual)}, {then}"

    def _usual_phases_s(self) -> tuple[float, float, float]:
        pre, swing, loading = (median(each) * median(self._durations_s) for each in zip(*self._phases, strict=True))
        return pre, swing, loading

    def _timed(self, stride: StrideResult, wanted: BurstParameters, why: str) -> Proposal:
        """Start and end with the phases: up by a quarter of the swing, the force gone as the foot lies flat."""
        own = self._own
        if not self._tuning.timing or len(self._phases) < own.lately:
            return Proposal(why, wanted)
        pre_s, swing_s, loading_s = self._usual_phases_s()
        pre = [shares[0] for shares in self._phases]
        early_s = own.early * median(abs(each - median(pre)) for each in pre) * median(self._durations_s)
        delay_s = max(pre_s - early_s + own.up_at * swing_s - own.answer_s - self._channel.rise_s, 0.0)
        delay_s = delay_s if self._channel.start_phase == "pre_swing" else 0.0
        extension_s = loading_s - own.outlives_s
        if abs(delay_s - wanted.start_delay_s) > own.timing_dead_s:
            wanted = replace(wanted, start_delay_s=delay_s)
        if abs(extension_s - wanted.extension_s) > own.timing_dead_s:
            wanted = replace(wanted, extension_s=extension_s)
        speed = f"{stride.speed_mps:.1f} m/s, stride {median(self._durations_s):.2f} s"
        return Proposal(why or f"timing follows the speed ({speed})", wanted)

    def _burst(self, base: BurstParameters, drives: Drives) -> BurstParameters:
        """``base`` with these drives, before any limit or bound."""
        bounds, count = self._tuning.bounds, len(base.widths_us)
        assert bounds is not None
        carried = count if self._carried is None else min(self._carried, count)
        front, most_us = min(drives.front, 1.0), bounds.pulse_width_us.high
        first_us, last_us = front * most_us, drives.tail * most_us
        if self._tuning.method == "run_to_run":
            base = replace(base, current_ma=front * bounds.current_ma.high)
            first_us = self._channel.pulse_width_us
            last_us = first_us * min(drives.tail / max(front, 0.01), 1.0)
        return replace(base, widths_us=(first_us,) * carried + (last_us,) * (count - carried))


def phases_of(stride: StrideResult) -> tuple[float, ...] | None:
    """Seconds of pre-swing, swing and loading response; None where the stride did not pass all of them."""
    at = (stride.t_pre_swing_ns, stride.t_swing_ns, stride.t_loading_response_ns, stride.t_stance_ns)
    times = [t_ns for t_ns in at if t_ns is not None]
    if len(times) < len(at) or stride.t_end_ns <= stride.t_start_ns:
        return None
    return tuple((b - a) / NS_PER_S for a, b in pairwise(times))
