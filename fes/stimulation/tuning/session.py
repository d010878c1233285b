"""All channels' tuners and the dose ledger: what the controller feeds and asks."""

import math
from collections.abc import Iterable

from fes.config import Session
from fes.signals import GROUND_ACTS, OperatorAct, OperatorAction, StimStatus, StrideResult
from fes.stimulation.dose import DoseLedger
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.report import TuningReport
from fes.stimulation.tuning.tuner import Tuner

_CHOICES = (OperatorAction.ACCEPT_SUGGESTION, OperatorAction.ROLL_BACK)
TUNING_ACTS = frozenset((OperatorAction.FREEZE_TUNING, OperatorAction.RESUME_TUNING, *_CHOICES))


class Tuners:
    """Of one session; channels without tuning, or with mode "off", are only booked."""

    def __init__(self, session: Session) -> None:
        self.ledger = DoseLedger(channel.number for channel in session.channels)
        self._intensity = 0.0
        self.latest: dict[tuple[int, str], TuningReport] = {}  # the newest of each kind, by channel and kind
        self._shares: dict[int, float] = {}  # of their bounds, as of the last stride
        self._start = {channel.number: BurstParameters.for_channel(channel) for channel in session.channels}
        feet = sorted({str(channel.foot) for channel in session.channels})
        self._channels_of = {foot: [c.number for c in session.channels if c.foot == foot] for foot in feet}
        self.tuners = {
            channel.number: Tuner(
                channel,
                session.stimulation.min_stride_length_m,
                session.stimulation.intensity,
                incline=None if session.ground.free else session.ground.incline,
                geometry=session.geometry.get(channel.foot),
            )
            for channel in session.channels
            if channel.tuning is not None and channel.tuning.mode != "off"
        }

    def parameters(self) -> dict[int, BurstParameters]:
        """What the next burst of each tuned channel is to have."""
        return {number: tuner.parameters for number, tuner in self.tuners.items()}

    def on_status(self, status: StimStatus) -> None:
        """The stimulator answered."""
        self.ledger.book(status)

    def on_act(self, act: OperatorAct) -> tuple[TuningReport, ...]:
        """A person acted; what does not concern the tuning may still disturb strides.

        Less by hand freezes it: it would bring back, stride by stride, what the person took away.
        """
        if act.action not in TUNING_ACTS:
            if act.action in GROUND_ACTS:
                incline = None if act.action is OperatorAction.FREE_GROUND else act.value
                for tuner in self.tuners.values():
                    tuner.ground_changed(act.t_ns, incline)
            elif act.action is not OperatorAction.SET_BELT_SPEED:
                for tuner in self.tuners.values():
                    tuner.operator_changed(act.t_ns)
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
        """All that go on. One that has stopped itself keeps its reason, and goes back to less, but not to more."""
        for tuner in self.tuners.values():
            if tuner.frozen:
                tuner.stay()
        return self._remember(tuner.freeze(t_ns, why) for tuner in self.tuners.values() if not tuner.frozen)

    def on_stride(self, t_ns: int, foot: str, stride: StrideResult, intensity: float) -> tuple[TuningReport, ...]:
        """A stride of this foot has been closed."""
        reports: list[TuningReport] = []
        shares = {
            number: self.tuners[number].share for number in self._channels_of.get(foot, ()) if number in self.tuners
        }
        changed = {number: abs(share - self._shares.get(number, share)) for number, share in shares.items()}
        self._shares |= shares
        for number in self._channels_of.get(foot, ()):
            electrode = self.ledger.electrodes[number]
            charge_uc = electrode.close_step(stride.t_start_ns, stride.t_end_ns)
            tuner = self.tuners.get(number)
            others_changed = sum(changed.values()) - changed.get(number, 0.0)
            report = tuner.observe(t_ns, stride, charge_uc, intensity, others_changed) if tuner else None
            if report is not None:
                reports.append(report)
            if not stride.valid or (report is not None and report.skipped):
                continue
            toe_m = stride.toe_clearance_m
            hint = electrode.respond(toe_m if math.isfinite(toe_m) else stride.clearance_m, charge_uc, intensity)
            if hint:
                now = tuner.parameters if tuner else self._start[number]
                reports.append(TuningReport(t_ns, number, "hint", hint, now, now))
        return self._remember(reports) if reports else ()

    def _remember(self, reports: Iterable[TuningReport]) -> tuple[TuningReport, ...]:
        new = tuple(reports)
        self.latest |= {(report.channel, report.kind): report for report in new}
        return new
