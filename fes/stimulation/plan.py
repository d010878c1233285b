"""Which current, when: gait phases become bursts of stimulation, one envelope per channel.

How one channel's burst comes and goes, after the trapezoid of the drop-foot stimulators:

- the foot enters ``start_phase``, and stimulation is permitted: a burst starts ``start_delay_s`` later;
- it enters ``stop_phase``: the burst goes on for ``extension_s`` and then falls; one not yet started is dropped;
- with a negative ``extension_s`` it falls that long before the entry into ``stop_phase`` is expected, which is as long
  after the entry into the phase before as the longest of the last times; not known, or sooner there: at the entry;
- it enters a phase outside start … stop, or its phase was lost (``Transition.NONE``): off at once;
- it enters ``start_phase`` again: off at once, and a new burst.

A burst starts late rather than break a rule that the gate would enforce: not before its channel has been off for
``min_off_s``, and not while a channel that it must never be on with has a burst. One that has gone off is over.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from fes.config import PHASE_ORDER, Channel
from fes.signals import StimRequest
from fes.stimulation.envelope import Envelope, round_down, to_ns
from fes.stimulation.parameters import BurstParameters
from statemachine.phases import Phase, PhaseChange, Transition

FREQUENCY_STEP_HZ = 1.0
LATEST_NS = 500_000_000  # a burst that would have to wait longer, for a rest or an antagonist, is of another moment
LOST = Transition.NONE
EXPECTED_FROM = 3  # strides; the longest of their times counts, for to end late is to end at contact


@dataclass(slots=True, eq=False)
class _Line:
    """One channel and where it stands; ``on`` and ``off_since_ns`` are what was last requested and since when.

    ``by_hand_ns`` is how long a burst asked for by hand lasts before it falls; one to ``adopt`` passes to the phases.
    ``steady``, the burst last asked for, stays on until ``steady_ns`` once it is. ``upcoming`` are the parameters of
    the next burst, ``taken`` those of the burst awaited or under way. ``before`` is the phase before the stop phase,
    entered at ``before_ns`` in this cycle; ``approaches_ns`` is how long it took last.
    """

    channel: Channel
    start: Phase
    stop: Phase
    run: frozenset[Phase]
    before: Phase
    upcoming: BurstParameters
    taken: BurstParameters
    partners: tuple[_Line, ...] = ()
    awaited_ns: int | None = None
    burst: Envelope | None = None
    steady: Envelope | None = None
    steady_ns: int = 0
    on: bool = False
    off_since_ns: int | None = None
    by_hand_ns: int | None = None
    adopt: bool = False
    before_ns: int | None = None
    approaches_ns: deque[int] = field(default_factory=lambda: deque(maxlen=EXPECTED_FROM))

    def note(self, change: PhaseChange) -> None:
        """How long the phase before the stop phase takes; a cycle that was lost, or went another way, is forgotten."""
        if change.transition == LOST or change.destination not in self.run:
            self.before_ns = None
            if change.transition == LOST:
                self.approaches_ns.clear()
        elif change.destination == self.stop:
            if self.before_ns is not None:
                self.approaches_ns.append(change.t_ns - self.before_ns)
            self.before_ns = None
        elif change.destination == self.before:
            self.before_ns = change.t_ns
        elif change.destination == self.start:
            self.before_ns = None

    def due_ns(self) -> int | None:
        """When this cycle's burst is to fall though the stop phase has not come; None for not before it."""
        early_ns = to_ns(-self.taken.extension_s)
        if early_ns <= 0 or self.before_ns is None or len(self.approaches_ns) < EXPECTED_FROM:
            return None
        return self.before_ns + max(max(self.approaches_ns) - early_ns, 0)


class StimulationPlan:
    """Bursts from phases; a deterministic function of the calls made, in non-decreasing time.

    A burst's parameters (current, widths, frequency, times, intensity) are taken when it starts and stay, but a lower
    intensity acts at once; a higher one waits for the next burst.

    Args:
        channels: the session's channels, with distinct numbers.
        current_step_ma: the device's step of current; requests are rounded down to it, and below one step is off.
        pulse_width_step_us: its step of pulse width.
    """

    def __init__(
        self, channels: tuple[Channel, ...], *, current_step_ma: float = 0.5, pulse_width_step_us: float = 1.0
    ) -> None:
        self._current_step_ma = current_step_ma
        self._pulse_width_step_us = pulse_width_step_us
        self._lines = tuple(_line(channel) for channel in channels)
        self._asked_ns: int | None = None
        for line in self._lines:
            line.partners = tuple(other for other in self._lines if _exclusive(line.channel, other.channel))

    def on_phase(self, change: PhaseChange, *, permitted: bool) -> None:
        """A foot changed phase. Without ``permitted`` no burst starts with this entry, nor later in the same cycle."""
        for line in self._lines:
            if line.channel.foot != change.foot:
                continue
            line.note(change)
            lost = change.transition == LOST
            if lost or change.destination not in line.run:
                line.awaited_ns, line.burst = None, None
            elif change.destination == line.start:
                if line.adopt and line.burst is not None and not line.burst.falls(change.t_ns):
                    line.burst = line.burst.unstopped()
                else:
                    line.burst, line.taken = None, line.upcoming
                    line.awaited_ns = change.t_ns + to_ns(line.taken.start_delay_s) if permitted else None
                line.by_hand_ns, line.adopt = None, False
            elif change.destination == line.stop:
                line.awaited_ns = None
                line.burst = line.burst.stopped(change.t_ns) if line.burst else None
            if line.burst is not None and change.destination == line.before:
                line.burst = line.burst.due(line.due_ns())

    def start(self, number: float, t_ns: int, hold_ns: int, *, adopt: bool) -> None:
        """Start a burst of one channel by hand; it falls after ``hold_ns``, and what the foot does may end it sooner.

        With ``adopt`` a foot that enters the start phase meanwhile makes it the burst of its step.
        """
        for line in self._lines:
            if line.channel.number == number and line.burst is None:
                line.awaited_ns, line.by_hand_ns, line.adopt = t_ns, hold_ns, adopt
                line.taken = line.upcoming

    def set_parameters(self, number: int, parameters: BurstParameters) -> None:
        """What one channel's bursts are to have from the next entry into its start phase on; no burst changes."""
        for line in self._lines:
            if line.channel.number == number:
                line.upcoming = parameters

    def cancel(self, foot: str | None = None) -> None:
        """End every burst of a foot (None: of both) at once; the next entry into a start phase may start another."""
        for line in self._lines:
            if foot in (None, line.channel.foot):
                line.awaited_ns, line.burst = None, None

    def due(self, t_ns: int, intensity: float) -> bool:
        """Whether a channel would go on or off now, against what :meth:`requests` last said; changes nothing.

        Lets the controller send at once at such a moment and otherwise keep to its command period.
        """
        for line in self._lines:
            burst = line.burst
            # the usual cases, at every sample: nothing to come, what starts now and has no current yet, what goes on
            if burst is None:
                if not line.on and line.awaited_ns in (None, t_ns):
                    continue
            elif line.on and burst is line.steady and t_ns < line.steady_ns and intensity >= burst.intensity:
                continue
            burst = self._burst(line, t_ns, intensity)
            if (burst is not None and self._is_on(burst, t_ns)) != line.on:
                return True
        return False

    def requests(self, t_ns: int, intensity: float) -> tuple[StimRequest, ...]:
        """One request per channel, in the session's order; call it when they are sent, for the plan remembers them.

        Args:
            t_ns: now; no earlier than in any call before.
            intensity: the operator's setting, 0–1; anything else is clipped, not-a-number is 0.
        """
        requests = tuple([self._commit(line, t_ns, intensity) for line in self._lines])
        self._asked_ns = t_ns
        return requests

    def _commit(self, line: _Line, t_ns: int, intensity: float) -> StimRequest:
        burst, pulse = self._burst(line, t_ns, intensity), None
        if burst is not None:
            line.awaited_ns = None
            if burst is not line.steady:
                line.steady, line.steady_ns = burst, burst.steady_until_ns(self._pulse_width_step_us)
            pulse = self._pulse(burst, t_ns)
            if pulse is None and (line.on or burst.over(t_ns)):
                burst = None
        if line.on and pulse is None:
            line.off_since_ns = t_ns
        line.burst, line.on = burst, pulse is not None
        number = line.channel.number
        return StimRequest(number, False) if pulse is None else StimRequest(number, True, *pulse)

    def _burst(self, line: _Line, t_ns: int, intensity: float) -> Envelope | None:
        """The burst under way, or the awaited one if it can start by now."""
        intensity = min(intensity, 1.0) if intensity > 0.0 else 0.0
        if line.burst is not None:
            return line.burst.dimmed(intensity)
        if line.awaited_ns is None or line.on:
            return None
        for other in line.partners:
            if other.on or other.burst is not None:
                return None
        t_start_ns = line.awaited_ns
        if self._asked_ns is not None:  # the rise counts from the last command, at which the channel was off
            t_start_ns = max(t_start_ns, self._asked_ns)
        if line.off_since_ns is not None:
            t_start_ns = max(t_start_ns, line.off_since_ns + to_ns(line.channel.limits.min_off_s))
        if t_start_ns > t_ns or t_start_ns - line.awaited_ns > LATEST_NS:
            return None
        if line.by_hand_ns is not None:
            return Envelope.of(line.channel, t_start_ns, intensity, line.taken).stopped(t_start_ns + line.by_hand_ns)
        return Envelope.of(line.channel, t_start_ns, intensity, line.taken, line.due_ns())

    def _is_on(self, burst: Envelope, t_ns: int) -> bool:
        """Whether :meth:`_pulse` is not None: nothing of it is less than the device's step."""
        return (
            burst.level_ma(t_ns) >= self._current_step_ma
            and burst.width_us(t_ns) >= self._pulse_width_step_us
            and burst.frequency_hz >= FREQUENCY_STEP_HZ
        )

    def _pulse(self, burst: Envelope, t_ns: int) -> tuple[float, float, float] | None:
        """Current (mA), width (µs) and frequency (Hz) in the device's steps; None where one is nothing."""
        current_ma = round_down(burst.level_ma(t_ns), self._current_step_ma)
        pulse_width_us = round_down(burst.width_us(t_ns), self._pulse_width_step_us)
        frequency_hz = round_down(burst.frequency_hz, FREQUENCY_STEP_HZ)
        if current_ma <= 0.0 or pulse_width_us <= 0.0 or frequency_hz <= 0.0:
            return None
        return current_ma, pulse_width_us, frequency_hz


def _line(channel: Channel) -> _Line:
    first = PHASE_ORDER.index(channel.start_phase)
    length = (PHASE_ORDER.index(channel.stop_phase) - first) % len(PHASE_ORDER) + 1
    run = [Phase[PHASE_ORDER[(first + i) % len(PHASE_ORDER)].upper()] for i in range(length)]
    own = BurstParameters.of(channel)
    return _Line(channel, run[0], run[-1], frozenset(run), run[-2], own, own)


def _exclusive(one: Channel, other: Channel) -> bool:
    return other.number in one.never_with or one.number in other.never_with
