"""All channels' tuners and the dose ledger: what the controller feeds and asks."""

import math
from collections.abc import Iterable
from dataclasses import replace

from fes.config import Channel, Session
from fes.extensions import load_extension
from fes.signals import GROUND_ACTS, OperatorAct, OperatorAction, StimStatus, StrideResult
from fes.stimulation.dose import DoseLedger
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.held import Tuner
from fes.stimulation.tuning.report import Rule, Seen, TuningReport
from fes.stimulation.tuning.rule import OwnRule
from fes.stimulation.tuning.targets import read_stride
from fes.stimulation.tuning.usable import NO_CHARGE, StrideFilter
from fes.stimulation.tuning.watch import FaultWatch

_CHOICES = (OperatorAction.ACCEPT_SUGGESTION, OperatorAction.ROLL_BACK)
TUNING_ACTS = frozenset((OperatorAction.FREEZE_TUNING, OperatorAction.RESUME_TUNING, *_CHOICES))


class Tuners:
    """Of one session; channels without tuning, or with mode "off", are only booked."""

    def __init__(self, session: Session) -> None:
        self.ledger = DoseLedger(channel.number for channel in session.channels)
        self._intensity = 0.0
        self.latest: dict[tuple[int, str], TuningReport] = {}  # the newest of each kind, by channel and kind
        self._start = {channel.number: BurstParameters.for_channel(channel) for channel in session.channels}
        feet = sorted({str(channel.foot) for channel in session.channels})
        self._channels_of = {foot: [c.number for c in session.channels if c.foot == foot] for foot in feet}
        free, incline, least_m = session.ground.free, session.ground.incline, session.stimulation.min_stride_length_m
        tuned = [each for each in session.channels if each.tuning is not None and each.tuning.mode != "off"]
        usual = session.stimulation.intensity
        self.tuners = {each.number: Tuner(each, rule_of(each, None if free else incline), usual) for each in tuned}
        self._watches = {each.number: FaultWatch(each) for each in tuned}
        self._filters = {c.number: StrideFilter(c.tuning, least_m, free_ground=free) for c in tuned if c.tuning}

    def parameters(self) -> dict[int, BurstParameters]:
        """What the next burst of each tuned channel is to have."""
        return {number: tuner.parameters for number, tuner in self.tuners.items()}

    def on_status(self, status: StimStatus) -> None:
        """The stimulator answered."""
        self.ledger.book(status)

    def on_act(self, act: OperatorAct) -> tuple[TuningReport, ...]:
        """A person acted. Less by hand freezes the tuning, which would bring back what the person took away."""
        if act.action not in TUNING_ACTS:
            if act.action in GROUND_ACTS:
                incline = None if act.action is OperatorAction.FREE_GROUND else act.value
                for number, tuner in self.tuners.items():
                    self._filters[number].ground_changed(act.t_ns, free=incline is None)
                    self._watches[number] = FaultWatch(tuner.channel)  # on other ground the foot answers otherwise
                    tuner.acted("ground", incline)
            elif act.action is not OperatorAction.SET_BELT_SPEED:
                for number, each in self._filters.items():
                    each.operator_changed(act.t_ns)
                    if act.action is OperatorAction.ARM:  # what was before the stop is another walk
                        self._watches[number] = FaultWatch(self.tuners[number].channel)
            if act.action is not OperatorAction.SET_INTENSITY:
                return ()
            lowered, self._intensity = 0.0 < act.value < self._intensity, act.value
            return self._freeze(act.t_ns, "the intensity was lowered by hand") if lowered else ()
        if act.action is OperatorAction.FREEZE_TUNING:
            return self._freeze(act.t_ns, act.why or "on demand")
        if act.action is OperatorAction.RESUME_TUNING:
            return self._remember(tuner.resume(act.t_ns) for tuner in self.tuners.values() if tuner.frozen)
        chosen = next((tuner for number, tuner in self.tuners.items() if number == act.value), None)
        if chosen is None:
            return ()
        done = chosen.accept(act.t_ns) if act.action is OperatorAction.ACCEPT_SUGGESTION else chosen.roll_back(act.t_ns)
        return () if done is None else self._remember((done,))

    def _freeze(self, t_ns: int, why: str) -> tuple[TuningReport, ...]:
        """All that go on; one that has stopped itself keeps its reason, and goes on going back to less."""
        return self._remember(tuner.freeze(t_ns, why) for tuner in self.tuners.values() if not tuner.frozen)

    def on_stride(self, t_ns: int, foot: str, stride: StrideResult, intensity: float) -> tuple[TuningReport, ...]:
        """A stride of this foot has been closed."""
        reports: list[TuningReport] = []
        for number in self._channels_of.get(foot, ()):
            electrode = self.ledger.electrodes[number]
            charge_uc = electrode.close_step(stride.t_start_ns, stride.t_end_ns)
            tuner, skipped = self.tuners.get(number), False
            if tuner is not None:
                seen = self._seen(number, tuner, stride, charge_uc, intensity)
                skipped = bool(seen.skipped)
                if seen.noticed:
                    text = "something has changed that stimulation did not: most likely "
                    text, now = f"stride {stride.number}: {text}{seen.noticed}; look at it", tuner.parameters
                    reports.append(TuningReport(t_ns, number, "fault", text, now, now))
                report = tuner.observe(t_ns, seen)
                reports += [report] if report is not None else []
            if not stride.valid or skipped:
                continue
            toe_m = stride.toe_clearance_m
            hint = electrode.respond(toe_m if math.isfinite(toe_m) else stride.clearance_m, charge_uc, intensity)
            if hint:
                now = tuner.parameters if tuner else self._start[number]
                reports.append(TuningReport(t_ns, number, "hint", hint, now, now))
        return self._remember(reports) if reports else ()

    def _seen(self, number: int, tuner: Tuner, stride: StrideResult, charge_uc: float, intensity: float) -> Seen:
        given = tuner.parameters
        skipped = self._filters[number].why_skip(stride, charge_uc, intensity * given.strength_nc)
        read = read_stride(stride, tuner.tuning) if skipped in ("", NO_CHARGE) else skipped
        reading = None if isinstance(read, str) else read
        skipped = skipped or (read if isinstance(read, str) else "")
        seen = Seen(stride, reading, given, charge_uc, intensity, skipped)
        return replace(seen, noticed=self._watches[number].stride(seen))

    def _remember(self, reports: Iterable[TuningReport]) -> tuple[TuningReport, ...]:
        new = tuple(reports)
        self.latest |= {(report.channel, report.kind): report for report in new}
        return new


def rule_of(channel: Channel, incline: float | None) -> Rule:
    """Our own rule for the channel, or the one that its settings name.

    Raises:
        ExtensionError: it cannot be had.
    """
    name = channel.tuning.rule if channel.tuning else ""
    rule: Rule = load_extension("tuner", name)(channel, incline) if name else OwnRule(channel, incline)
    return rule
