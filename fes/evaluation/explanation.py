"""Why a session did what it did at one instant: its log run again up to there, and each part asked what it saw.

The phases' guards by their own terms, the walking judge, the plan, the gate and the tuning. Nothing is decided here:
what is told is the state of the parts that decided.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from fes.config import PHASE_ORDER, Channel, Session
from fes.control.runner import Runner
from fes.evaluation.log_comparison import ReplayOutput
from fes.evaluation.timing.marks import bursts_of
from fes.live.status import with_remedy
from fes.signals import NS_PER_S, Event, ImuSample
from fes.stimulation.envelope import difference
from fes.walk_record import Note
from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, PhaseChange
from statemachine.table import TABLE
from statemachine.terms import Terms, terms_of

AROUND_NS: Final = 3 * NS_PER_S // 2  # what is drawn, before and after
LATELY_NS: Final = 2 * NS_PER_S  # a refusal so long ago is still told
OLD_NS: Final = 5 * NS_PER_S  # a sample so long ago tells nothing any more


@dataclass(frozen=True)
class GuardThen:
    """One guard at the sample; ``asked``: it leaves the phase in which the foot was."""

    transition: str
    asked: bool
    terms: Terms


@dataclass(frozen=True)
class FootThen:
    """One foot at its newest sample; ``phase`` before it, since ``since_s``; ``fired`` at this sample, else ""."""

    foot: str
    sensor: str
    sample_s: float
    phase: str
    since_s: float
    fired: str
    guards: tuple[GuardThen, ...]
    thresholds: Thresholds
    walking: str

    def sentences(self) -> list[str]:
        """Which phase, what fired or why not, and whether the foot was known to walk."""
        name, asked = self.foot.replace("_", " "), [guard for guard in self.guards if guard.asked]
        since = f" since {self.since_s:.3f} s" if self.since_s == self.since_s else ""
        lines = [f"The {name} was in {_words(self.phase)}{since} (sample of {self.sample_s:.3f} s)."]
        for guard in asked:
            if guard.transition == self.fired:
                lines.append(f"{guard.transition} fired at this sample.")
            elif not guard.terms.holds:
                lines.append(f"{guard.transition} did not fire: {guard.terms.why_not()}.")
        return [*lines, f"The {name} {self.walking}."]


@dataclass(frozen=True)
class ChannelThen:
    """One channel: whether it was on, what was refused last, and why it was as it was, in words."""

    channel: int
    name: str
    on: bool
    current_ma: float
    refused: str
    why: str


@dataclass(frozen=True)
class TuningThen:
    """One tuned channel: ``why`` its settings are what they were, and what changed them, by time."""

    channel: int
    name: str
    why: str
    changes: tuple[tuple[float, str], ...]


@dataclass(frozen=True)
class Explanation:
    """Everything about one instant; ``trace`` of each foot: (time s, toe-down rate rad/s, phase) about it.

    ``bursts``: (channel, from s, to s) there. Times are the session's.
    """

    at_s: float
    feet: tuple[FootThen, ...]
    channels: tuple[ChannelThen, ...]
    tuning: tuple[TuningThen, ...]
    gate: str
    trace: dict[str, list[tuple[float, float, int]]]
    bursts: list[tuple[int, float, float]]

    def sentences(self) -> list[str]:
        """The answer: stimulation first, for that is what is mostly asked."""
        lines = [channel.why for channel in self.channels] + [self.gate]
        for foot in self.feet:
            lines += foot.sentences()
        return lines + [tuned.why for tuned in self.tuning]


@dataclass
class _Seen:
    """What a foot's newest sample brought."""

    sample_ns: int
    before: Phase
    saw: Features
    thresholds: Thresholds
    fired: str

    def guards(self) -> tuple[GuardThen, ...]:
        """Every guard's comparisons."""
        return tuple(
            GuardThen(row.transition.name, row.source is self.before, terms_of(row.guard, self.saw, self.thresholds))
            for row in TABLE
        )


def explain(
    runner: Runner, events: Iterable[Event], now: ReplayOutput, session: Session, notes: Iterable[Note],
    origin_ns: int, at_ns: int,
) -> Explanation:  # fmt: skip
    """Run ``events`` through ``runner`` until just behind ``at_ns`` and say how things stood there.

    ValueError: no event comes before ``at_ns``.
    """
    controller = runner.controller
    foot_of = {tracker.foot: foot for foot, tracker in controller.trackers.items()}
    moment = _Moment(runner, now, session, list(notes), origin_ns, at_ns)
    trace: dict[str, list[tuple[float, float, int]]] = {foot: [] for foot in controller.trackers}
    found: Explanation | None = None
    changes = 0
    for event in events:
        if event.t_ns > at_ns and found is None:
            found = moment.explanation()
        if event.t_ns > at_ns + AROUND_NS:
            break
        foot = foot_of.get(event.sensor, "") if isinstance(event, ImuSample) else ""
        near = bool(foot) and event.t_ns >= at_ns - OLD_NS
        before = controller.phase(foot) if near else Phase.STANCE
        runner.handle(event)
        fired = ""
        for change in now.phases[changes:]:
            who = foot_of[change.foot]
            moment.entered[who] = change, controller.judge(who).describe()
            fired = change.transition.name
        changes = len(now.phases)
        if near:
            saw, limits = controller.trackers[foot].seen()
            if event.t_ns >= at_ns - AROUND_NS:
                trace[foot].append((moment.seconds(event.t_ns), saw.toe_down_radps, int(controller.phase(foot))))
            if found is None:
                moment.seen[foot] = _Seen(event.t_ns, before, saw, limits, fired)
    found = found or moment.explanation()
    found.trace.update(trace)
    for number, spans in bursts_of((command.t_ns, command) for command in now.commands).items():
        near_spans = [span for span in spans if span[1] > at_ns - AROUND_NS]
        found.bursts.extend((number, moment.seconds(begin), moment.seconds(end)) for begin, end in near_spans)
    return found


@dataclass
class _Moment:
    """The session's parts as they stand at ``at_ns``; ``entered``: by foot, its newest change, and what its judge said.

    Times are told in s since ``origin_ns``.
    """

    runner: Runner
    now: ReplayOutput
    session: Session
    notes: list[Note]
    origin_ns: int
    at_ns: int
    seen: dict[str, _Seen] = field(default_factory=dict)
    entered: dict[str, tuple[PhaseChange, str]] = field(default_factory=dict)

    def seconds(self, t_ns: float) -> float:
        return (t_ns - self.origin_ns) / NS_PER_S

    def explanation(self) -> Explanation:
        """How things stand."""
        if not self.runner.t_ns:
            raise ValueError("nothing had happened by then")
        channels = tuple(map(self._channel, self.session.channels))
        tuners = self.runner.controller.tuning.tuners
        tuning = tuple(self._tuned(channel) for channel in self.session.channels if channel.number in tuners)
        feet = tuple(self._foot(foot, saw) for foot, saw in self.seen.items())
        return Explanation(self.seconds(self.at_ns), feet, channels, tuning, self._gate(), {}, [])

    def _foot(self, foot: str, saw: _Seen) -> FootThen:
        controller = self.runner.controller
        sensor = controller.trackers[foot].foot
        at = [change.t_ns for change in self.now.phases if change.foot == sensor and change.t_ns < saw.sample_ns]
        since_s = self.seconds(at[-1]) if at else float("nan")
        where = foot, sensor, self.seconds(saw.sample_ns), saw.before.name.lower(), since_s
        return FootThen(*where, saw.fired, saw.guards(), saw.thresholds, controller.judge(foot).describe())

    def _gate(self) -> str:
        gate = self.runner.gate
        if gate.latched:
            since = "" if gate.latched_ns is None else f" since {self.seconds(gate.latched_ns):.3f} s"
            told = with_remedy(f"The gate was latched{since}: {gate.latched}")
            again = f" Arming again was refused: {gate.arming_refused}" if gate.arming_refused else ""
            return told + (with_remedy(again) if again else "")
        if gate.armed:
            return "The gate was armed."
        return with_remedy(f"The gate was not armed{f': {gate.arming_refused}' if gate.arming_refused else ''}")

    def _channel(self, channel: Channel) -> ChannelThen:
        commands = self.now.commands
        own = [command for command in commands if command.channel == channel.number and command.t_ns <= self.at_ns]
        last = own[-1] if own else None
        refused = next((each for each in reversed(own) if each.refused and each.t_ns > self.at_ns - LATELY_NS), None)

        def made(on: bool, how: str) -> ChannelThen:
            lately = f" Refused at {self.seconds(refused.t_ns):.3f} s: {refused.refused}." if refused else ""
            ma = last.current_ma if last and on else 0.0
            text = f"{channel.name}: {how}" + (lately if refused is not None and refused is not last else "")
            text += self._foreseen(channel)
            return ChannelThen(channel.number, channel.name, on, ma, refused.refused if refused else "", text)

        if last is not None and last.on and self.at_ns - last.t_ns <= last.validity_ms * 1_000_000:
            begun = last.t_ns
            for command in reversed(own):
                if not command.on:
                    break
                begun = command.t_ns
            return made(True, f"on with {last.current_ma:.1f} mA, since {self.seconds(begun):.3f} s.")
        if last is not None and last.refused:
            return made(False, with_remedy(f"off, the gate refused it: {last.refused}"))
        return made(False, f"off, {self._not_asked(channel)}.")

    def _foreseen(self, channel: Channel) -> str:
        """Of a channel with a predicted onset: whether it is predicted, what was expected of the stride, what came."""
        onset = self.runner.controller.onsets.get(str(channel.foot))
        if onset is None or channel.onset != "predicted":
            return ""

        def when(t_ns: float | None) -> str:
            return f"at {self.seconds(t_ns or 0):.3f} s"

        text = f" Its {onset.describe()}."
        if onset.expected_ns is not None:
            text += f" The heel was expected to rise {when(onset.expected_ns)}"
            text += f"; the burst was asked for early, {when(onset.began_ns)}" if onset.used else ""
            text += f"; it rose {when(onset.came_ns)}." if onset.came_ns is not None else "."
        return text

    def _not_asked(self, channel: Channel) -> str:
        """Why nothing was asked of the gate."""
        foot, controller = str(channel.foot), self.runner.controller
        name = foot.replace("_", " ")
        if foot not in controller.trackers:
            return f"for no sensor tells the phases of the {name}"
        phase = controller.phase(foot).name.lower()
        at = PHASE_ORDER.index(channel.start_phase)
        count = (PHASE_ORDER.index(channel.stop_phase) - at) % len(PHASE_ORDER) + 1
        asked_in = [PHASE_ORDER[(at + step) % len(PHASE_ORDER)] for step in range(count)]
        if phase not in asked_in:
            window = f"{_words(channel.start_phase)} … {_words(channel.stop_phase)}"
            return f"for the {name} was in {_words(phase)}; it is stimulated in {window}"
        if controller.intensity <= 0.0:
            return "for the intensity was 0"
        change, said = self.entered.get(foot, (None, ""))
        if change is not None and not said.startswith("walks"):
            where = f"when {_words(change.destination.name.lower())} began at {self.seconds(change.t_ns):.3f} s"
            return f"for {where} the {name} was {said}"
        return "for its burst had not begun yet, was over, or was not permitted when the phase began"

    def _tuned(self, channel: Channel) -> TuningThen:
        tuner, mark = self.runner.controller.tuning.tuners[channel.number], f"channel {channel.number}: "
        own = [n for n in self.notes if n.source == "tuning" and n.t_ns <= self.at_ns and n.text.startswith(mark)]
        texts = [(self.seconds(note.t_ns), note.text.removeprefix(mark)) for note in own]
        changes = tuple((t_s, text) for t_s, text in texts if " → " in text and not text.startswith("suggested"))
        went = difference(tuner.start, tuner.parameters)
        words = f"{channel.name}: tuning had changed nothing"
        if went:
            words = f"{channel.name}: tuning had gone from the session's settings to {went} in {len(changes)} changes"
            words += f", the last at {changes[-1][0]:.1f} s: {changes[-1][1]}" if changes else ""
        if tuner.frozen:
            words += f"; frozen: {tuner.frozen}"
        skipped = next(((t_s, text) for t_s, text in reversed(texts) if " skipped: " in text), None)
        if skipped is not None and (not changes or skipped[0] > changes[-1][0]):
            words += f"; {skipped[1]}"
        return TuningThen(channel.number, channel.name, f"{words}.", changes)


def _words(phase: str) -> str:
    return phase.replace("pre_swing", "pre-swing").replace("_", " ")
