"""Which current, when: gait phases become bursts of stimulation, one envelope per channel.

A burst comes and goes after the trapezoid of the drop-foot stimulators:

- the foot enters ``start_phase``, and stimulation is permitted: a burst starts ``start_delay_s`` later;
- it enters ``stop_phase``: the burst goes on for ``extension_s`` and then falls; one not yet started is dropped;
- with a negative ``extension_s`` it falls that long before the entry into ``stop_phase`` is expected, which is as long
  after the entry into the phase before as the longest of the last times; not known, or sooner there: at the entry;
- it enters a phase outside start … stop, or its phase was lost (``Transition.NONE``): off at once;
- it enters ``start_phase`` again: off at once, and a new burst.

With ``onset = "predicted"`` a burst may begin before the entry into ``start_phase``, when the heel is about to rise
(:meth:`StimulationPlan.begin_early`). If that has not come ``FALSE_NS`` later, the burst is off at once. If it comes,
the burst goes on, but lasts no longer for it: of ``extension_s`` as much is left out as it began early. Where that is
more than all of it, the burst lasts no longer than the longest of the last ones, had they begun at the entry.

Every burst falls by prediction where no sample has said so sooner: a quarter of the usual time and ``LATER_NS`` after
the entry into ``stop_phase`` usually comes after the newest phase; once it falls it does not rise again. Of a foot in
``late``, whose samples come late, ``extension_s`` after the entry into ``stop_phase`` is expected, by the longest of
the last times from the start phase and from the phase before, of which the sooner counts. So none starts before these
are known.

It begins with one step of the device, at once, and rises from there: the gate grants nothing for the time before.

A burst starts late rather than break a rule that the gate would enforce: not before its channel has been off for
``min_off_s``, and not while a channel that it must never be on with has a burst. One that has gone off is over.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

from fes.config import PHASE_ORDER, Channel
from fes.signals import NS_PER_S, OperatorAction, StimRequest
from fes.stimulation.envelope import BurstParameters, Envelope, round_down, to_ns
from fes.stimulation.onset import FALSE_NS
from statemachine.phases import Phase, PhaseChange, Transition

FREQUENCY_STEP_HZ = 1.0
LATEST_NS = 500_000_000  # a burst that would have to wait longer, for a rest or an antagonist, is of another moment
BY_HAND_NS = {OperatorAction.TEST_BURST: NS_PER_S // 2, OperatorAction.TRIGGER: NS_PER_S}  # until it falls
LOST = Transition.NONE
EXPECTED_FROM = 3  # strides; the longest of their times counts, for to end late is to end at contact
LASTED = 10  # strides; by radio the longest counts, for to end before contact may let the toe catch
LATER_NS = 100_000_000  # and a quarter of the usual time later: the end was not seen, and the burst falls
GROWS_NS = 20_000_000  # a stride, at most, is what is usual
NEVER_NS = 1 << 62


@dataclass(slots=True, eq=False)
class _ChannelState:
    """One channel and where it stands; ``on`` and ``off_since_ns`` are what was last requested and since when.

    ``by_hand_ns`` is how long a burst asked for by hand lasts before it falls; one to ``adopt`` passes to the phases.
    ``steady``, the burst last asked for, stays on until ``steady_ns`` once it is. ``upcoming`` are the parameters of
    the next burst, ``taken`` those of the burst awaited or under way. ``before`` is the phase before the stop phase.
    ``entered_ns`` is when this cycle entered each phase of the burst, ``lasted_ns`` how long it was from there to the
    stop phase last, ``usual_ns`` the median; ``latest_ns`` is when a burst is to fall though that has
    not been seen, ``held`` where nothing may put it off, for it began early. ``late``: the samples come late, so that
    the end is always predicted.
    """

    channel: Channel
    start: Phase
    stop: Phase
    run: frozenset[Phase]
    before: Phase
    upcoming: BurstParameters
    taken: BurstParameters
    late: bool = False
    partners: tuple[_ChannelState, ...] = ()
    awaited_ns: int | None = None
    burst: Envelope | None = None
    steady: Envelope | None = None
    steady_ns: int = 0
    on: bool = False
    off_since_ns: int | None = None
    by_hand_ns: int | None = None
    adopt: bool = False
    entered_ns: dict[Phase, int] = field(default_factory=dict)
    lasted_ns: dict[Phase, deque[int]] = field(default_factory=dict)
    usual_ns: dict[Phase, int] = field(default_factory=dict)
    latest_ns: int | None = None
    held: bool = False

    def note(self, change: PhaseChange) -> None:
        """How long the phases up to the stop phase take; a cycle that was lost, or went another way, is forgotten."""
        phase, t_ns = change.destination, change.t_ns
        if change.transition == LOST or phase not in self.run:
            self.entered_ns.clear()
            self.latest_ns = None
            if change.transition == LOST:
                self.lasted_ns.clear()
        elif phase == self.stop:
            for entered, since_ns in self.entered_ns.items():
                lasted_ns = self.lasted_ns.setdefault(entered, deque(maxlen=LASTED))
                # what lasts longer because its end is not seen must not become usual soon
                most_ns = self.usual_ns[entered] + GROWS_NS if len(lasted_ns) >= EXPECTED_FROM else NEVER_NS
                lasted_ns.append(t_ns - since_ns)
                self.usual_ns[entered] = min(sorted(lasted_ns)[len(lasted_ns) // 2], most_ns)
            self.entered_ns.clear()
        else:
            if phase == self.start:
                self.entered_ns.clear()
            self.entered_ns[phase] = t_ns

    def due_ns(self) -> int | None:
        """When this cycle's burst is to fall though the stop phase has not come; None for not before it."""
        early_ns, last_ns = to_ns(-self.taken.extension_s), list(self.lasted_ns.get(self.before, ()))[-EXPECTED_FROM:]
        waits = early_ns <= 0 and not self.late
        if waits or self.before not in self.entered_ns or len(last_ns) < EXPECTED_FROM:
            return self.latest_ns
        due_ns = self.entered_ns[self.before] + max(max(last_ns) - early_ns, 0)
        return due_ns if self.latest_ns is None else min(due_ns, self.latest_ns)

    @property
    def foreseen(self) -> bool:
        """Whether it is known when a burst that starts now is to fall, as far as that has to be known."""
        return not self.late or len(self.lasted_ns.get(self.before, ())) >= EXPECTED_FROM

    def bound(self, phase: Phase, t_ns: int) -> None:
        """A phase of the burst was entered: note when the burst falls at the latest."""
        if self.lasted_ns.get(phase):
            longest_ns = max(self.lasted_ns[phase]) if self.late else self.usual_ns[phase] * 5 // 4 + LATER_NS
            due_ns = t_ns + longest_ns + max(to_ns(self.taken.extension_s), 0)
            # by cable a phase that took its time is over, whatever was foreseen
            kept = (self.late or self.held) and self.latest_ns is not None
            self.latest_ns = min(self.latest_ns or due_ns, due_ns) if kept else due_ns

    def confirmed(self, t_ns: int) -> Envelope | None:
        """The burst that began early and is still on at the entry into the start phase, as it goes on; None if none."""
        burst = self.burst
        if burst is None or not self.held or burst.over(t_ns):
            return None
        left_ns = burst.extension_ns - max(t_ns - burst.t_start_ns, 0)
        self.held = left_ns < 0
        self.bound(self.start, t_ns)
        whole = Envelope.for_channel(self.channel, burst.t_start_ns, burst.intensity, self.taken, self.latest_ns)
        return replace(whole, extension_ns=max(left_ns, 0))


class StimulationPlan:
    """Bursts from phases; a deterministic function of the calls made, in non-decreasing time.

    A burst's parameters (current, widths, frequency, times, intensity) are taken when it starts and stay, but a lower
    intensity acts at once; a higher one waits for the next burst.

    Args:
        channels: the session's channels, with distinct numbers.
        current_step_ma: the device's step of current; requests are rounded down to it, and below one step is off.
        pulse_width_step_us: its step of pulse width.
        late: feet whose samples come late.
    """

    def __init__(
        self,
        channels: tuple[Channel, ...],
        *,
        current_step_ma: float = 0.5,
        pulse_width_step_us: float = 1.0,
        late: frozenset[str] = frozenset(),
    ) -> None:
        self._current_step_ma = current_step_ma
        self._pulse_width_step_us = pulse_width_step_us
        self._states = tuple(_state_of(channel) for channel in channels)
        for state in self._states:
            state.late = state.channel.foot in late
            state.partners = tuple(other for other in self._states if _exclusive(state.channel, other.channel))

    def on_phase(self, change: PhaseChange, *, permitted: bool) -> None:
        """A foot changed phase. Without ``permitted`` no burst starts with this entry, nor later in the same cycle."""
        for state in self._states:
            if state.channel.foot != change.foot:
                continue
            state.note(change)
            lost = change.transition == LOST
            if lost or change.destination not in state.run:
                state.awaited_ns, state.burst = None, None
            elif change.destination == state.start:
                if state.adopt and state.burst is not None and not state.burst.falls(change.t_ns):
                    state.burst, state.latest_ns, state.held = state.burst.unstopped(), None, False
                    state.bound(state.start, change.t_ns)
                elif permitted and (confirmed := state.confirmed(change.t_ns)):
                    state.burst = confirmed
                else:
                    state.burst, state.latest_ns, state.held, state.taken = None, None, False, state.upcoming
                    state.bound(state.start, change.t_ns)
                    starts = permitted and state.foreseen
                    state.awaited_ns = change.t_ns + to_ns(state.taken.start_delay_s) if starts else None
                state.by_hand_ns, state.adopt = None, False
            elif change.destination == state.stop:
                state.awaited_ns = None
                state.burst = state.burst.stopped(change.t_ns) if state.burst else None
            else:
                state.bound(change.destination, change.t_ns)
            bounded = change.destination in (state.before, *state.entered_ns)
            if state.burst is not None and bounded and not state.burst.falls(change.t_ns):
                state.burst = state.burst.due(state.due_ns())

    def begin_early(self, foot: str, t_ns: int, intensity: float) -> bool:
        """This foot's heel is about to rise: begin now what its predicted channels would begin then.

        Nothing begins that could not begin now (an antagonist, a rest), nor before a stride has shown how long it may
        last. Returns whether any burst did.
        """
        begun = False
        for state in self._states:
            busy = state.on or state.burst is not None or state.awaited_ns is not None
            if busy or state.channel.onset != "predicted" or state.channel.foot != foot:
                continue
            if not state.foreseen or not state.lasted_ns.get(state.start):
                continue
            state.taken, state.awaited_ns, state.latest_ns, state.held = state.upcoming, t_ns, None, True
            state.by_hand_ns, state.adopt = None, False
            burst, state.awaited_ns = self._burst(state, t_ns, intensity), None
            if burst is not None and self._pulse(burst, t_ns):
                state.latest_ns = t_ns + max(state.lasted_ns[state.start]) + burst.extension_ns
                most_ns = min(FALSE_NS, burst.max_on_ns)  # until the heel has risen, and off without a ramp
                state.burst, begun = replace(burst, max_on_ns=most_ns, fall_ns=0, t_due_ns=state.latest_ns), True
        return begun

    def start(self, number: float, t_ns: int, hold_ns: int, *, adopt: bool) -> None:
        """Start a burst of one channel by hand; it falls after ``hold_ns``, and what the foot does may end it sooner.

        With ``adopt`` a foot that enters the start phase meanwhile makes it the burst of its step.
        """
        for state in self._states:
            if state.channel.number == number and state.burst is None:
                state.awaited_ns, state.by_hand_ns, state.adopt = t_ns, hold_ns, adopt
                state.taken, state.latest_ns = state.upcoming, None

    def set_parameters(self, number: int, parameters: BurstParameters) -> None:
        """What one channel's bursts are to have from the next entry into its start phase on; no burst changes."""
        for state in self._states:
            if state.channel.number == number:
                state.upcoming = parameters

    def cancel(self, foot: str | None = None) -> None:
        """End every burst of a foot (None: of both) at once; the next entry into a start phase may start another."""
        for state in self._states:
            if foot in (None, state.channel.foot):
                state.awaited_ns, state.burst = None, None

    def due(self, t_ns: int, intensity: float) -> bool:
        """Whether a channel would go on or off now, against what :meth:`requests` last said; changes nothing.

        Lets the controller send at once at such a moment and otherwise keep to its command period.
        """
        for state in self._states:
            burst = state.burst
            # the usual cases, at every sample: nothing to come, what goes on
            if burst is None:
                if not state.on and state.awaited_ns is None:
                    continue
            elif state.on and burst is state.steady and t_ns < state.steady_ns and intensity >= burst.intensity:
                continue
            burst = self._burst(state, t_ns, intensity)
            if (burst is not None and self._pulse(burst, t_ns) is not None) != state.on:
                return True
        return False

    def requests(self, t_ns: int, intensity: float) -> tuple[StimRequest, ...]:
        """One request per channel, in the session's order; call it when they are sent, for the plan remembers them.

        Args:
            t_ns: now; no earlier than in any call before.
            intensity: the operator's setting, 0–1; anything else is clipped, not-a-number is 0.
        """
        return tuple([self._commit(state, t_ns, intensity) for state in self._states])

    def _commit(self, state: _ChannelState, t_ns: int, intensity: float) -> StimRequest:
        burst, pulse = self._burst(state, t_ns, intensity), None
        if burst is not None:
            state.awaited_ns = None
            if burst is not state.steady:
                state.steady, state.steady_ns = burst, burst.steady_until_ns(self._pulse_width_step_us)
            pulse = self._pulse(burst, t_ns)
            if pulse is None and (state.on or burst.over(t_ns)):
                burst = None
        if state.on and pulse is None:
            state.off_since_ns = t_ns
        state.burst, state.on = burst, pulse is not None
        number = state.channel.number
        return StimRequest(number, False) if pulse is None else StimRequest(number, True, *pulse)

    def _burst(self, state: _ChannelState, t_ns: int, intensity: float) -> Envelope | None:
        """The burst under way, or the awaited one if it can start by now."""
        intensity = min(intensity, 1.0) if intensity > 0.0 else 0.0
        if state.burst is not None:
            return state.burst.dimmed(intensity)
        if state.awaited_ns is None or state.on:
            return None
        for other in state.partners:
            if other.on or other.burst is not None:
                return None
        t_start_ns = state.awaited_ns
        if state.off_since_ns is not None:
            t_start_ns = max(t_start_ns, state.off_since_ns + to_ns(state.channel.limits.min_off_s))
        if t_start_ns > t_ns or t_ns - state.awaited_ns > LATEST_NS:
            return None
        t_start_ns = t_ns  # it rises from its first command on: the gate grants nothing for the time before
        if state.by_hand_ns is not None:
            return Envelope.for_channel(state.channel, t_start_ns, intensity, state.taken).stopped(
                t_start_ns + state.by_hand_ns
            )
        return Envelope.for_channel(state.channel, t_start_ns, intensity, state.taken, state.due_ns())

    def _level_ma(self, burst: Envelope, t_ns: int) -> float:
        """The envelope's current; at its foot one step of the device, for there the gate begins to count the rise."""
        level_ma, step_ma = burst.level_ma(t_ns), self._current_step_ma
        if level_ma >= step_ma:
            return level_ma
        rises = burst.t_start_ns <= t_ns < min(burst.t_start_ns + burst.rise_ns, burst.t_fall_ns)
        return step_ma if rises and step_ma <= burst.parameters.current_ma * burst.intensity else level_ma

    def _pulse(self, burst: Envelope, t_ns: int) -> tuple[float, float, float] | None:
        """Current (mA), width (µs) and frequency (Hz) in the device's steps; None where one is nothing."""
        current_ma = round_down(self._level_ma(burst, t_ns), self._current_step_ma)
        pulse_width_us = round_down(burst.width_us(t_ns), self._pulse_width_step_us)
        frequency_hz = round_down(burst.frequency_hz, FREQUENCY_STEP_HZ)
        if current_ma <= 0.0 or pulse_width_us <= 0.0 or frequency_hz <= 0.0:
            return None
        return current_ma, pulse_width_us, frequency_hz


def _state_of(channel: Channel) -> _ChannelState:
    first = PHASE_ORDER.index(channel.start_phase)
    length = (PHASE_ORDER.index(channel.stop_phase) - first) % len(PHASE_ORDER) + 1
    run = [Phase[PHASE_ORDER[(first + i) % len(PHASE_ORDER)].upper()] for i in range(length)]
    own = BurstParameters.for_channel(channel)
    return _ChannelState(channel, run[0], run[-1], frozenset(run), run[-2], own, own)


def _exclusive(one: Channel, other: Channel) -> bool:
    return other.number in one.never_with or one.number in other.never_with
