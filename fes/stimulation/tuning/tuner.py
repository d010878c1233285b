"""One channel's tuner: a stride in, at most one bounded change of the next burst's parameters out, with the reason.

Deterministic and without a clock: the same strides, charges and acts give the same changes, live and in replay.
"""

from dataclasses import dataclass, replace
from typing import Final, Literal

from fes.config import Channel, Tuning
from fes.signals import StrideResult
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.answering import AnswerMonitor
from fes.stimulation.tuning.demand import Demand, Response, Responses, at_contact, in_mid_swing, reason
from fes.stimulation.tuning.faults import FaultWatch
from fes.stimulation.tuning.guardrails import (
    HarmMonitor,
    at_most,
    drive_of,
    limited,
    outside,
    peak_of,
    share_used,
    strongest_drive,
)
from fes.stimulation.tuning.intensity import Intensity, Zones
from fes.stimulation.tuning.targets import NO_CHARGE, Reading, StrideFilter, jolted, read_stride
from fes.stimulation.tuning.timing import SPENT, Lowering, SpeedTiming

Kind = Literal["change", "suggestion", "skip", "hint", "roll_back", "fault", "frozen"]


@dataclass(frozen=True, slots=True)
class TuningReport:
    """One thing the tuning did, would do, or did not do, and why.

    ``before`` and ``after`` are the parameters of the next burst, the same unless ``kind`` is "change" or "roll_back"
    (then they are in force) or "suggestion" (then ``after`` waits for a person).
    """

    t_ns: int
    channel: int
    kind: Kind
    text: str
    before: BurstParameters
    after: BurstParameters

    @property
    def severity(self) -> str:
        """For the session log."""
        return "warning" if self.kind in ("hint", "roll_back", "fault") else "info"


def difference(before: BurstParameters, after: BurstParameters) -> str:
    """What changes, in words; "" for nothing."""
    changes = []
    if after.current_ma != before.current_ma:
        changes.append(f"current {before.current_ma:.1f} → {after.current_ma:.1f} mA")
    moved = [(b, a) for b, a in zip(before.widths_us, after.widths_us, strict=True) if a != b]
    if moved:
        most = max(moved, key=lambda pair: abs(pair[1] - pair[0]))
        changes.append(
            f"pulse width {most[0]:.0f} → {most[1]:.0f} µs where it changes most "
            f"(mean {before.mean_width_us:.0f} → {after.mean_width_us:.0f} µs)"
        )
    for name, key in (("start delay", "start_delay_s"), ("extension", "extension_s")):
        was, becomes = getattr(before, key), getattr(after, key)
        if was != becomes:
            changes.append(f"{name} {1e3 * was:.0f} → {1e3 * becomes:.0f} ms")
    return ", ".join(changes)


SPARED: Final = 6  # strides after a fault in which nothing is lowered
HOLD_STRIDES: Final = 4  # after a roll-back, before the next attempt
MOST_ROLL_BACKS: Final = 3
NEAR_AIM: Final = 0.5  # of the band: nearer than this a change must show its effect before the next
UNREACHED_STRIDES: Final = 5
TIMING_DEAD_S: Final = 0.015
JOLTS: Final = 2  # strides in a row whose contact cannot be true: stimulation jerks the foot up
OUTLIER: Final = 1.5  # of the band, or OUTLIER_SDS of the noise: once it may be chance, twice it is not
OUTLIER_SDS: Final = 6.0


class Tuner:
    """Follows one channel's foot. ``parameters`` are what the next burst is to have.

    ``usual_intensity`` is the session's, at which its settings are meant; below it nothing gets stronger than they are.
    Strides shorter than ``min_stride_length_m`` are no walking. ``free_ground``: nothing is known of it.
    """

    def __init__(
        self,
        channel: Channel,
        min_stride_length_m: float = 0.15,
        usual_intensity: float = 1.0,
        *,
        free_ground: bool = False,
    ) -> None:
        self.channel = channel
        self.tuning = channel.tuning or Tuning()
        self.start = BurstParameters.for_channel(channel)
        self.parameters = self.start
        self.pending: BurstParameters | None = None
        self.frozen = ""
        most = strongest_drive(channel, self.tuning)
        self.response = Response(most=most)
        self._responses = Responses(most)
        self._usual_intensity = usual_intensity
        self._intensity = Intensity(channel, self.tuning)
        self._filter = StrideFilter(self.tuning, min_stride_length_m, free_ground=free_ground)
        self._timing = SpeedTiming()
        self._lowering = Lowering()
        self._harm = HarmMonitor()
        self._answers = AnswerMonitor(most)
        self._faults = FaultWatch(most)
        self._spared = 0  # strides in which nothing is lowered, for a fault was found
        self._returning: BurstParameters | None = None
        self._lost = False  # the foot did not answer
        self._hold = 0
        self._settle = 0
        self._roll_backs = 0
        self._unreached = 0
        self._odd = 0.0
        self._jolts = 0

    # --- what a person does -------------------------------------------------------------------------------

    def operator_changed(self, t_ns: int) -> None:
        """The intensity was set, or stimulation switched: strides that saw it teach nothing."""
        self._filter.operator_changed(t_ns)

    def freeze(self, t_ns: int, why: str = "on demand") -> TuningReport:
        """Nothing changes any more until :meth:`resume`."""
        self.frozen, self.pending, self._returning = why, None, None
        self._harm.forget()
        self._answers.forget()
        return self._report(t_ns, "frozen", f"tuning is frozen ({why}); the settings stay as they are")

    def stay(self) -> None:
        """Stopped by itself: on its way back, only what makes it weaker still counts."""
        if self._returning is not None:
            self._returning = at_most(self._returning, self.parameters)

    def resume(self, t_ns: int) -> TuningReport:
        """Go on after a freeze; where the foot did not answer, without what was learnt meanwhile."""
        if self._lost:
            self._lost = False
            self._forget_responses()
        self.frozen, self._roll_backs = "", 0
        return self._report(t_ns, "frozen", "tuning goes on")

    def accept(self, t_ns: int) -> TuningReport | None:
        """Put the pending suggestion in force for the next burst; None when there is none."""
        if self.pending is None or self.frozen:
            return None
        before, self.parameters, self.pending = self.parameters, self.pending, None
        self._settle = 1
        changes = difference(before, self.parameters)
        return self._report(t_ns, "change", f"suggestion accepted by the operator: {changes}", before)

    def roll_back(self, t_ns: int) -> TuningReport:
        """Back to the session's own settings with the next burst, and freeze."""
        before, self.parameters = self.parameters, self.start
        self.freeze(t_ns, "rolled back by the operator")
        changes = difference(before, self.parameters) or "nothing had been changed"
        return self._report(t_ns, "roll_back", f"back to the session's settings, tuning is frozen: {changes}", before)

    # --- what the foot does -------------------------------------------------------------------------------

    def observe(self, t_ns: int, stride: StrideResult, charge_uc: float, intensity: float) -> TuningReport | None:
        """Take in the newest stride of the channel's foot; what came of it, None when there is nothing to report.

        It was walked under :attr:`parameters`, ``charge_uc`` delivered in it, at the operator's ``intensity`` (0–1).
        """
        if self.tuning.mode == "off":
            return None
        drive = self.drive * intensity
        why = self._filter.why_skip(stride, charge_uc, drive)
        if why == NO_CHARGE:
            self._answers.add_bare(read_stride(stride, self.tuning))
        stopped = self.frozen and stride.valid and charge_uc > 0.0 and drive > 0.0
        if stopped and self._returning is not None and (report := self._still_returning(t_ns)):
            return report  # it has stopped itself: whatever the stride was like, less is on the way
        if why:
            return self._report(t_ns, "skip", f"stride {stride.number} skipped: {why}")
        if why := jolted(stride):
            return self._on_jolt(t_ns, stride, why, drive)
        self._jolts = 0
        reading = read_stride(stride, self.tuning)
        if isinstance(reading, str):
            return self._report(t_ns, "skip", f"stride {stride.number} skipped: {reading}")
        if self._unlike_the_others(reading.level, drive):
            text = f"stride {stride.number} skipped: {reading.measures[0].text()} is unlike the strides before"
            return self._report(t_ns, "skip", text)
        zones = self._intensity.zones(stride, self.parameters)
        drives = self._intensity.drives(reading, zones, self.parameters, intensity)
        fault = self._faults.stride(stride, reading, drives)
        self._spared = SPARED if fault else max(self._spared - 1, 0)
        if fault:
            self._forget_responses()
            self._harm.forget()
        self.response.add(drive, reading.level)
        self._responses.add(reading, drives)
        self._timing.add(stride)
        self._lowering.add(stride, self.parameters.extension_s)
        harmful = self._harm.stride(drive, self.response)
        spent = share_used(self.parameters, self.tuning) >= SPENT
        if not self.frozen and (why := self._answers.stride(reading, drives, self.parameters, spent=spent)):
            return self._stop(t_ns, why)
        if self._returning is not None and (report := self._still_returning(t_ns)):
            return report
        if self.frozen:
            return None
        if harmful is not None and self.tuning.mode == "act":
            return self._roll_back_to(t_ns, harmful, reading)
        report = self._tune(t_ns, reading, self._responses.demands(reading, drives), drive, zones, intensity)
        return self._with_fault(t_ns, stride, fault, report) if fault else report

    def _with_fault(self, t_ns: int, stride: StrideResult, fault: str, change: TuningReport | None) -> TuningReport:
        """The fault's name, and what was done about it in the same stride."""
        text = f"stride {stride.number}: something has changed that stimulation did not: most likely {fault}"
        if change is None:
            return self._report(t_ns, "fault", f"{text}; look at it")
        if change.kind != "change":
            return replace(change, text=f"{change.text}; {text}")
        return replace(change, kind="fault", text=f"{text}; look at it. {change.text}")

    def _forget_responses(self) -> None:
        self.response.forget()
        self._responses.forget()

    @property
    def drive(self) -> float:
        """Stimulation in force relative to the session's, at full intensity."""
        return drive_of(self.parameters, self.start)

    def _on_jolt(self, t_ns: int, stride: StrideResult, why: str, drive: float) -> TuningReport | None:
        """One such stride may be chance and teaches nothing; when they go on, less is the way out."""
        self._jolts += 1
        if self._jolts >= JOLTS and not self.frozen and self._returning is None:
            after = limited(self.parameters, self._intensity.lessened(self.parameters, -1.0), self.tuning)
            if changes := difference(self.parameters, after):
                self._forget_responses()
                text = f"stride {stride.number}: {why}; stimulation may jerk the foot up, less is tried: {changes}"
                return self._propose(t_ns, after, text, drive, 0.0)
        return self._report(t_ns, "skip", f"stride {stride.number} skipped: {why}")

    def _unlike_the_others(self, level: float, drive: float) -> bool:
        """Whether this stride stands alone; two of the same kind in a row are believed."""
        odd, before = 0.0, self._odd
        if self.response.count >= 3:
            off = level - self.response.level_at(drive)
            odd = off if abs(off) > max(OUTLIER, OUTLIER_SDS * self.response.noise) else 0.0
        self._odd = odd
        return odd != 0.0 and odd * before <= 0.0

    def _roll_back_to(self, t_ns: int, parameters: BurstParameters, reading: Reading) -> TuningReport:
        before = self.parameters
        self._returning, self._hold = parameters, HOLD_STRIDES
        self._roll_backs += 1
        text = f"{reading.measures[0].text()} has got worse with the last changes"
        if self._roll_backs > MOST_ROLL_BACKS:
            self.freeze(t_ns, f"stopped itself after {self._roll_backs} roll-backs")
            self._returning = self.start
            text += " once more; tuning stops itself and goes back to the session's settings, look at the electrodes"
        self._return()
        changes = difference(before, self.parameters)
        return self._report(t_ns, "roll_back", f"{text}: rolled back, {changes}", before)

    def _stop(self, t_ns: int, why: str) -> TuningReport:
        """The foot does not answer: nothing is raised any more, and what was raised is taken back."""
        before, weaker = self.parameters, self._answers.before(self.start)
        self.freeze(t_ns, f"{why}: look at the electrodes")
        self._lost = True
        text = f"{why}: look at the electrodes; tuning has stopped"
        if self.tuning.mode == "act":
            self._returning = weaker
            self._return()
        changes = difference(before, self.parameters)
        return self._report(t_ns, "roll_back", f"{text} and goes back: {changes}" if changes else text, before)

    def _return(self) -> None:
        """A step on the way back; each stride no further than any change may go."""
        if self._returning is not None:
            self.parameters = limited(self.parameters, self._returning, self.tuning)
            if self.parameters == self._returning or not difference(self.parameters, self._returning):
                self._returning = None

    def _still_returning(self, t_ns: int) -> TuningReport | None:
        before = self.parameters
        self._return()
        changes = difference(before, self.parameters)
        return self._report(t_ns, "roll_back", f"still going back: {changes}", before) if changes else None

    def _tune(
        self, t_ns: int, reading: Reading, demands: tuple[Demand, ...], drive: float, zones: Zones | None,
        intensity: float,
    ) -> TuningReport | None:  # fmt: skip
        before = self.parameters
        if self._hold:
            self._hold -= 1
            if not self._hold:
                self._harm.returned(self.response)
        inverted = self._harm.inverted
        worst = demands[0] if inverted else self._intensity.leader(demands, zones, before)
        error = 0.0 if self._hold or (self._spared and worst.error < 0.0 and not inverted) else worst.error
        if inverted and outside(self.response.level_at(drive)) == 0.0:
            error = 0.0  # this foot answers the other way round: inside the band nothing is to be gained
        if self._settle and abs(error) < NEAR_AIM and outside(reading.level) == 0.0:
            error = 0.0
        self._settle = max(self._settle - 1, 0)
        if not self._hold:
            self._timing.put_off(demands[0].error, share_used(before, self.tuning), in_mid_swing(demands).slope)
            self._timing.bring_forward(*at_contact(demands), self._lowering, before.extension_s)
        wanted = before
        if self.tuning.timing and self._timing.enough_strides:
            channel = self.channel
            delay_s, extension_s = self._timing.wanted(channel.start_phase, channel.rise_s, channel.fall_s)
            if abs(delay_s - before.start_delay_s) > TIMING_DEAD_S:
                wanted = replace(wanted, start_delay_s=delay_s)
            if abs(extension_s - before.extension_s) > TIMING_DEAD_S:
                wanted = replace(wanted, extension_s=extension_s)
        if error and inverted:
            error = -error
            wanted = self._intensity.lessened(wanted, error)
        elif error:
            wanted = self._intensity.answered(wanted, demands, zones, intensity)
        after = limited(before, wanted, self.tuning)
        if intensity < self._usual_intensity and peak_of(after, self.start) > max(peak_of(before, self.start), 1.0):
            after = before  # with the intensity up again it would be far more at once
        if changes := difference(before, after):
            why = self._timing.reason(after.extension_s)
            if error:
                why = reason(replace(worst, error=error), inverted=inverted, stand_in=reading.stand_in)
                why += self._intensity.why_held(before, after, demands, worst)
            return self._propose(t_ns, after, f"{why}: {changes}", drive, error)
        self.pending = None
        return self._hint_if_unreached(t_ns, reading)

    def _propose(self, t_ns: int, after: BurstParameters, text: str, drive: float, error: float) -> TuningReport | None:
        before = self.parameters
        if self.tuning.mode == "suggest":
            if self.pending == after:
                return None
            self.pending = after
            return TuningReport(t_ns, self.channel.number, "suggestion", f"suggested: {text}", before, after)
        if error:
            self._harm.changed(before, drive, error, self.response)
            self._settle = 1
        self.parameters = after
        return self._report(t_ns, "change", text, before)

    def _hint_if_unreached(self, t_ns: int, reading: Reading) -> TuningReport | None:
        self._unreached = self._unreached + 1 if reading.level < 0.0 else 0
        if self._unreached != UNREACHED_STRIDES or self._hold:
            return None
        if share_used(self.parameters, self.tuning) >= SPENT:
            where = "at the upper bound: look at electrodes, fatigue and target"
        else:
            where = "below the upper bound: look at electrodes, the other target and the intensity set by hand"
        return self._report(t_ns, "hint", f"{reading.measures[0].text()} is not reached {where}")

    def _report(self, t_ns: int, kind: Kind, text: str, before: BurstParameters | None = None) -> TuningReport:
        return TuningReport(t_ns, self.channel.number, kind, text, before or self.parameters, self.parameters)
