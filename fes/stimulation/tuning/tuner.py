"""One channel's tuner: a stride in, at most one bounded change of the next burst's parameters out, with the reason.

Deterministic and without a clock: the same strides, charges and acts give the same changes, live and in replay.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from fes.config import Channel, FootGeometry, Tuning
from fes.signals import StrideResult
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.answering import AnswerMonitor
from fes.stimulation.tuning.delay import STEP_S, DelayEstimate
from fes.stimulation.tuning.demand import Demand, at_contact, demands_of
from fes.stimulation.tuning.faults import FaultWatch
from fes.stimulation.tuning.guardrails import (
    at_least,
    at_most,
    drive_of,
    limited,
    outside,
    peak_of,
    spent,
    strongest_drive,
)
from fes.stimulation.tuning.memory import SpeedMemory
from fes.stimulation.tuning.reference import missing_drive
from fes.stimulation.tuning.report import Kind, TuningReport, difference, identified, reason
from fes.stimulation.tuning.response import ResponseModel
from fes.stimulation.tuning.shape import BurstShape, Zones
from fes.stimulation.tuning.targets import Measure, Reading, read_stride, swing_times, times_ns
from fes.stimulation.tuning.timing import Lowering, SpeedTiming
from fes.stimulation.tuning.usable import NO_CHARGE, OTHER_SPEED, UNEVEN_GROUND, StrideFilter, jolted

SPARED: Final = 6  # strides after a fault in which nothing is lowered
NEAR_AIM: Final = 0.5  # of the band: nearer than this a change must show its effect before the next
UNREACHED_STRIDES: Final = 5
REACHED_STRIDES: Final = 5  # in a row: what was rolled back before is made good
TIMING_DEAD_S: Final = 0.015
JOLTS: Final = 2  # strides in a row whose contact cannot be true: stimulation jerks the foot up
OUTLIER: Final = 1.5  # of the band, or OUTLIER_SDS of the noise: once it may be chance, twice it is not
OUTLIER_SDS: Final = 6.0
UNEVEN: Final = 2  # strides in a row on a stair or slope: what was learnt on even ground is put away
CONTRARY_SDS: Final = 2.0  # that far below nothing is the slope of a foot that more stimulation makes worse
CLIMBED: Final = 0.08  # of the bound: less has not been tried
EXCITATION: Final = 0.02  # of the bound, 0.5 to 1 mA: too little to be felt as a change
STILL: Final = 4  # strides without a change, before one is made for the sake of knowing
UNKNOWN: Final = 0.5  # of a slope's value is its standard deviation
REPORTED_EVERY: Final = 10  # strides, what was identified
UNTAUGHT: Final = 10  # stimulated strides in a row that teach nothing: then, and as often again, a person is told
MOST_ROLL_BACKS: Final = 3  # or answers to a jerked foot, the targets not reached in between; then it stops itself


class Tuner:
    """Follows one channel's foot. ``parameters`` are what the next burst is to have.

    ``usual_intensity`` is the session's, at which its settings are meant; below it nothing gets stronger than they are.
    Strides shorter than ``min_stride_length_m`` are no walking. ``incline``: of the ground; None: unknown.
    """

    def __init__(
        self,
        channel: Channel,
        min_stride_length_m: float = 0.15,
        usual_intensity: float = 1.0,
        *,
        incline: float | None = 0.0,
        geometry: FootGeometry | None = None,
    ) -> None:
        self.channel = channel
        self.tuning = channel.tuning or Tuning()
        self.start = BurstParameters.for_channel(channel)
        self.parameters = self.start
        self.pending: BurstParameters | None = None
        self.frozen = ""
        self.model = ResponseModel()
        self.delay = DelayEstimate()
        self.geometry = geometry
        self._usual_intensity = usual_intensity
        self._most = strongest_drive(channel, self.tuning)
        self._shape = BurstShape(channel, self.tuning, self._most)
        self._filter = StrideFilter(self.tuning, min_stride_length_m, free_ground=incline is None)
        self._timing = SpeedTiming()
        self._lowering = Lowering()
        self._answers = AnswerMonitor()
        self.faults = FaultWatch()
        self.memory = SpeedMemory()
        self._spared = 0  # strides in which nothing is lowered, for a fault was found
        self._returning: BurstParameters | None = None
        self._put_away: BurstParameters | None = None  # what was learnt on this ground, while it is put away
        self._ground = incline
        self._by_ground: dict[float | None, tuple[BurstParameters, SpeedMemory]] = {}  # what was right on others
        self._climb: BurstParameters | None = None  # the weakest settings since it was last lowered
        self._lost = False  # the foot did not answer
        self._roll_backs = 0
        self._reached = 0
        self._settle = 0
        self.still = 0  # strides since the last change
        self._reported = 0  # strides known when last it was said what is identified
        self._excited = 1.0  # which way the next excitation goes
        self._unreached = 0
        self._uneven = 0
        self._untaught = 0
        self._aside: frozenset[str] = frozenset()  # measures at contact that are left out
        self._odd = 0.0
        self._jolts = 0

    # --- what a person does -------------------------------------------------------------------------------

    def operator_changed(self, t_ns: int) -> None:
        """The intensity was set, or stimulation switched: strides that saw it teach nothing."""
        self._filter.operator_changed(t_ns)

    def ground_changed(self, t_ns: int, incline: float | None) -> None:
        """Other ground is walked on (None: nothing is known of it): strides that saw the change teach nothing.

        What was learnt stays with the ground that it was learnt on. From the next stride on, step by step, what was
        right on this one before is in force, or else the session's own settings. ``incline`` is rise over run.
        """
        self._filter.ground_changed(t_ns, free=incline is None)
        if incline == self._ground:
            return
        self._by_ground[self._ground] = self._returning or self._put_away or self.parameters, self.memory
        known = self._by_ground.get(incline, (self.start, SpeedMemory()))
        self._ground, self.memory = incline, known[1]
        self._answers.other_walk()
        if self.tuning.mode == "act" and not self.frozen:
            self._put_away, self._climb = known[0], None
            self.model.shake()

    def freeze(self, t_ns: int, why: str = "on demand") -> TuningReport:
        """Nothing changes any more until :meth:`resume`."""
        self.frozen, self.pending = why, None
        self._returning = self._put_away = None  # what was in force before does not come back by itself
        self._by_ground.clear()
        self._answers.forget()
        self.memory.forget()
        return self._report(t_ns, "frozen", f"tuning is frozen ({why}); the settings stay as they are")

    def stay(self) -> None:
        """Stopped by itself: on its way back, only what makes it weaker still counts."""
        if self._returning is not None:
            self._returning = at_most(self._returning, self.parameters)

    def resume(self, t_ns: int) -> TuningReport:
        """Go on after a freeze; where the foot did not answer, without what was learnt meanwhile."""
        if self._lost:
            self._lost = False
            self.model, self._reported = ResponseModel(), 0
        self.frozen, self._climb, self._roll_backs = "", None, 0
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

    def observe(
        self, t_ns: int, stride: StrideResult, charge_uc: float, intensity: float, others_changed: float = 0.0
    ) -> TuningReport | None:
        """Take in the newest stride of the channel's foot; what came of it, None when there is nothing to report.

        It was walked under :attr:`parameters`, ``charge_uc`` delivered in it, at the operator's ``intensity`` (0–1);
        ``others_changed``: by how much of their range other channels on the foot have changed since the stride before.
        """
        if self.tuning.mode == "off":
            return None
        drive = self.drive * intensity
        why = self._filter.why_skip(stride, charge_uc, drive)
        if why == NO_CHARGE:
            self._on_bare(read_stride(stride, self.tuning))
        stopped = self.frozen and stride.valid and charge_uc > 0.0 and drive > 0.0
        if stopped and self._returning is not None and (report := self._still_returning(t_ns)):
            return report  # it has stopped itself: whatever the stride was like, less is on the way
        self._untaught += charge_uc > 0.0
        if why:
            return self._on_skip(t_ns, stride, why, intensity if charge_uc > 0.0 else 0.0)
        self._uneven = 0
        if why := jolted(stride):
            return self._on_jolt(t_ns, stride, why)
        self._jolts = 0
        reading = read_stride(stride, self.tuning)
        if isinstance(reading, str):
            return self._skip(t_ns, f"stride {stride.number} skipped: {reading}")
        zones = self._shape.zones(stride, self.parameters, self.delay.delay_s.value)
        drives = self._shape.drives(reading, zones, self.parameters, intensity)
        if self._unlike_the_others(reading, drives):
            text = f"stride {stride.number} skipped: {reading.measures[0].text()} is unlike the strides before"
            return self._skip(t_ns, text)
        self._untaught = 0
        other_speed = self.memory.changed(stride.speed_mps)
        if other_speed:
            self.faults.forget()
            self._answers.other_walk()
        fault = self.faults.stride(reading, drives, self.model)
        self._spared = SPARED if fault else max(self._spared - 1, 0)
        if fault:
            if not self.frozen:
                self._answers.fault(self.faults.before, self.faults.strides)
            self.memory.forget()
            self._by_ground.clear()
        if fault or other_speed:
            self.faults.forget()
            self.model.shake()
            self._climb = None
        self.model.add(reading, drives, others_changed)
        self._learn_delay(stride, intensity)
        report = self._on_reading(t_ns, stride, reading, drives, zones, intensity, other_speed=other_speed)
        return self._with_fault(t_ns, stride, fault, report) if fault else report

    def _on_reading(
        self, t_ns: int, stride: StrideResult, reading: Reading, drives: Mapping[str, float], zones: Zones | None,
        intensity: float, *, other_speed: bool,
    ) -> TuningReport | None:  # fmt: skip
        """What follows from a stride that the response has taken in."""
        if why := self._set_aside(reading):
            return self._report(t_ns, "hint", f"stride {stride.number}: {why}")
        reading = reading.without(self._aside)
        self._timing.add(stride)
        self._lowering.add(stride, self.parameters.extension_s)
        self._reached = self._reached + 1 if reading.level >= 0.0 else 0
        if self._reached >= REACHED_STRIDES:
            self._roll_backs = 0
        if 0.0 <= reading.level <= 1.0 and not self._spared:
            self.memory.keep(self.parameters)
        all_given = spent(self.parameters, self.tuning)
        if not self.frozen and (
            why := self._answers.stride(reading, drives, self.parameters, self.model, spent=all_given)
        ):
            return self._stop(t_ns, why)
        if self._returning is not None and (report := self._still_returning(t_ns)):
            return report
        if self.frozen:
            return None
        if self._put_away is not None:
            self._returning, self._put_away = self._put_away, None
            return self._still_returning(t_ns)
        if self.tuning.mode == "act" and (report := self._contrary(t_ns, reading)):
            return report
        known = self.memory.remembered() if other_speed else None
        if known is not None and reading.level < 0.0:  # then it may only strengthen
            now = self.parameters
            known = at_least(replace(now, current_ma=known.current_ma, widths_us=known.widths_us), now)
            known = known if difference(now, limited(now, known, self.tuning)) else None
        return self._tune(t_ns, stride, reading, demands_of(self.model, reading, drives), zones, intensity, known)

    def _on_bare(self, reading: Reading | str) -> None:
        """A stride without stimulation changes nothing, but shows the level that stimulation starts from."""
        self._answers.add_bare(reading)
        if not isinstance(reading, str):
            self.model.add(reading, dict.fromkeys(reading.levels, 0.0))

    def _on_skip(self, t_ns: int, stride: StrideResult, why: str, given: float) -> TuningReport:
        """On stairs and slopes that the session does not say, its own settings; what was learnt waits meanwhile.

        At another speed the burst becomes even, for what was learnt of its shape holds at the old one. ``given`` is the
        intensity that the stride was stimulated at, 0 for not at all.
        """
        self.delay.forget_last()
        text, before, what = f"stride {stride.number} skipped: {why}", self.parameters, ""
        self._uneven = self._uneven + 1 if UNEVEN_GROUND in why else 0
        if self.tuning.mode == "act" and not self.frozen:
            if self._uneven >= UNEVEN:
                if self._put_away is None:
                    self._put_away = before
                self.parameters, what = limited(before, self.start, self.tuning), "the session's own settings there"
            elif OTHER_SPEED in why and given > 0.0 and self._put_away is None and self._returning is None:
                even = self._shape.even(before)
                if given < self._usual_intensity:  # with the intensity up again it would be more than the session's
                    even = at_most(even, at_least(before, self.start))
                self.parameters = replace(limited(before, even, self.tuning), start_delay_s=even.start_delay_s)
                what = "even until this speed is known"
        changes = difference(before, self.parameters)
        if changes:
            return self._report(t_ns, "change", f"{text}; {what}: {changes}", before)
        return self._skip(t_ns, text)

    def _skip(self, t_ns: int, text: str) -> TuningReport:
        """The stride teaches nothing; after many in a row a person is told that nobody learns."""
        if self._untaught < UNTAUGHT or self.frozen:
            return self._report(t_ns, "skip", text)
        text += f"; {self._untaught} strides in a row have taught nothing and the settings stay as they are"
        self._untaught = 0
        return self._report(t_ns, "hint", f"{text}: where the foot stumbles in each, begin with more current")

    def _learn_delay(self, stride: StrideResult, intensity: float) -> None:
        """Hold this swing's pitch against the stride's before, and so the drives that both had."""
        times = swing_times(stride)
        if times is None or stride.t_pre_swing_ns is None:
            return
        burst_s = self._shape.begins_s(times, self.parameters)
        at_s = np.arange(0.0, times.contact_s, STEP_S)
        widths_us = np.array([self.parameters.width_us(t - burst_s) for t in at_s])
        rise = np.clip((at_s - burst_s) / self.channel.rise_s, 0.0, 1.0)
        drives = self._shape.drive_per_us(self.parameters, intensity) * widths_us * rise
        effect = np.maximum(drives - self.model.threshold.value, 0.0)
        pitch_s = 1e-9 * (np.array(times_ns(stride)) - stride.t_pre_swing_ns)
        inside = (pitch_s >= 0.0) & (pitch_s <= times.contact_s)
        angle = stride.pitch_rad if self.tuning.eversion_at_contact_deg is None else -stride.roll_rad
        if len(angle) == len(pitch_s):
            self.delay.add(pitch_s[inside].tolist(), angle[inside].tolist(), at_s.tolist(), effect)

    def _with_fault(self, t_ns: int, stride: StrideResult, fault: str, change: TuningReport | None) -> TuningReport:
        """The fault's name, and what was done about it in the same stride."""
        text = f"stride {stride.number}: something has changed that stimulation did not: most likely {fault}"
        if change is None:
            return self._report(t_ns, "fault", f"{text}; look at it")
        if change.kind not in ("change", "identified", "hint"):
            return replace(change, text=f"{change.text}; {text}")
        return replace(change, kind="fault", text=f"{text}; look at it. {change.text}")

    @property
    def drive(self) -> float:
        """Stimulation in force relative to the session's, at full intensity."""
        return drive_of(self.parameters, self.start)

    @property
    def share(self) -> float:
        """Stimulation in force as a share of its upper bound, at full intensity."""
        return self.drive / self._most

    def _on_jolt(self, t_ns: int, stride: StrideResult, why: str) -> TuningReport | None:
        """One such stride may be chance and teaches nothing; when they go on, less is the way out."""
        self._jolts += 1
        if self._jolts >= JOLTS and not self.frozen and self._returning is None:
            after = limited(self.parameters, self._shape.lessened(self.parameters), self.tuning)
            if changes := difference(self.parameters, after):
                self.model.shake()
                text = f"stride {stride.number}: {why}; stimulation may jerk the foot up"
                if self.tuning.mode == "act" and self._jolts == JOLTS and self._once_too_often(t_ns):
                    return self._roll_back_to(self.start, t_ns, text)
                return self._propose(t_ns, after, f"{text}, less is tried: {changes}")
        return self._skip(t_ns, f"stride {stride.number} skipped: {why}")

    def _unlike_the_others(self, reading: Reading, drives: Mapping[str, float]) -> bool:
        """Whether this stride stands alone; two of the same kind in a row are believed."""
        odd, before = 0.0, self._odd
        worst = reading.measures[0]
        if self.model.strides >= 3 and self.model.knows(worst.name):
            off = worst.level - self.model.expected(worst.name, drives[worst.name]).value
            odd = off if abs(off) > max(OUTLIER, OUTLIER_SDS * self.model.noise(worst.name)) else 0.0
        self._odd = odd
        return odd != 0.0 and odd * before <= 0.0

    def _set_aside(self, reading: Reading) -> str:
        """Leave out what gets worse at contact by the stimulation that lifts the toe; why, when it is another one."""
        slopes = {measure.name: self.model.slope(measure.name) for measure in reading.measures}
        lifts = any(slopes[each.name].value > slopes[each.name].sd for each in reading.measures if not each.at_contact)
        before, self._aside = self._aside, frozenset(
            each.name
            for each in reading.measures
            if each.at_contact and lifts and slopes[each.name].value + CONTRARY_SDS * slopes[each.name].sd < 0.0
        )  # fmt: skip
        names = " and ".join(self._aside - before)
        return names and f"{names} gets worse by what lifts the toe and is left out: look at the sensor's calibration"

    def _contrary(self, t_ns: int, reading: Reading) -> TuningReport | None:
        """Back to before the climb, where the climb itself is known to have made the foot worse."""
        worst = reading.measures[0]
        slope = self.model.slope(worst.name)
        if self._climb is None or slope.value + CONTRARY_SDS * slope.sd >= 0.0 or outside(worst.level) == 0.0:
            return None
        settings = self._climb
        if drive_of(self.parameters, settings) - 1.0 < CLIMBED:
            return None
        if self._once_too_often(t_ns):
            settings = at_most(settings, self.start)
        return self._roll_back_to(settings, t_ns, f"{worst.text()} has got worse the more stimulation was given")

    def _once_too_often(self, t_ns: int) -> bool:
        """Count a roll-back; after too many what this foot asks for is not what does it good, and the tuning stops."""
        self._roll_backs += 1
        if self._roll_backs > MOST_ROLL_BACKS:
            self.freeze(t_ns, f"stopped itself after {self._roll_backs} roll-backs")
        return bool(self.frozen)

    def _roll_back_to(self, settings: BurstParameters, t_ns: int, why: str) -> TuningReport:
        """To these settings, step by step, or to less where less is in force."""
        before = self.parameters
        self._returning, self._climb = at_most(settings, before), None
        self._return()
        if self.frozen:
            why += " again; tuning has stopped itself and goes back, look at the electrodes"
        changes = difference(before, self.parameters) or "nothing had been raised"
        return self._report(t_ns, "roll_back", f"{why}: rolled back, {changes}", before)

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
        self, t_ns: int, stride: StrideResult, reading: Reading, demands: tuple[Demand, ...], zones: Zones | None,
        intensity: float, known: BurstParameters | None,
    ) -> TuningReport | None:  # fmt: skip
        before, asks_to_know = self.parameters, ""
        worst = self._shape.leader(demands, zones, before)
        error = 0.0 if self._spared and worst.error < 0.0 else worst.error
        if self._settle and abs(error) < NEAR_AIM and outside(reading.level) == 0.0:
            error = 0.0
        self._settle = max(self._settle - 1, 0)
        self._timing.bring_forward(*at_contact(demands), self._lowering, before.extension_s)
        wanted = before
        if self.tuning.timing and self._timing.enough_strides:
            channel = self.channel
            delay_s, extension_s = self._timing.wanted(channel.start_phase, channel.rise_s, channel.fall_s)
            if abs(delay_s - before.start_delay_s) > TIMING_DEAD_S:
                wanted = replace(wanted, start_delay_s=delay_s)
            if abs(extension_s - before.extension_s) > TIMING_DEAD_S:
                wanted = replace(wanted, extension_s=extension_s)
        if known is not None:
            wanted = known
        elif error:
            wanted = self._answered(wanted, stride, demands, zones, intensity)
        elif asks_to_know := self._worth_knowing(demands):
            wanted = self._shape.scaled(wanted, 1.0 + self._excited * EXCITATION / max(demands[0].drive, EXCITATION))
            self._excited = -self._excited
        after = limited(before, wanted, self.tuning)
        if self._spared:
            after = at_least(after, before)  # the hold, or a part of the profile, that less would do for
        if intensity < self._usual_intensity and peak_of(after, self.start) > max(peak_of(before, self.start), 1.0):
            after = before  # with the intensity up again it would be far more at once
        if changes := difference(before, after):
            why = self._timing.reason(after.extension_s)
            if known is not None:
                why = f"at {stride.speed_mps:.1f} m/s this was right before"
            elif asks_to_know:
                why = asks_to_know
            elif error:
                why = reason(replace(worst, error=error), stand_in=reading.stand_in)
                why += self._shape.why_held(before, after, demands, worst)
            return self._propose(t_ns, after, f"{why}: {changes}")
        self.pending = None
        return self._hint_if_unreached(t_ns, reading, worst.measure if error > 0.0 else None) or self._identified(t_ns)

    def _worth_knowing(self, demands: tuple[Demand, ...]) -> str:
        """Why a step too small to be felt is made though nothing is missing; "" for none."""
        self.still += 1
        name = demands[0].measure.name
        slope = self.model.slope(name)
        if self.still <= STILL or self._spared or slope.sd <= UNKNOWN * abs(slope.value):
            return ""
        self.still = 0
        return f"how {name} answers is not known well, a small step tells more"

    def _answered(
        self, wanted: BurstParameters, stride: StrideResult, demands: tuple[Demand, ...], zones: Zones | None,
        intensity: float,
    ) -> BurstParameters:  # fmt: skip
        """``wanted`` with the intensity that the demands ask for, by the channel's method."""
        if self.tuning.method == "run_to_run":
            return self._shape.answered(wanted, demands, zones, intensity)
        if zones is None:
            return wanted
        missing = missing_drive(stride, zones.times, demands, self.model, self.geometry, self.tuning.gain)
        if not missing.times_s:
            return wanted
        levels = [level for demand in demands for level in (demand.usual, demand.measure.level)]
        at_once = max(levels) > 1.0 and min(levels) >= 0.0
        short = any(demand.usual < 0.0 for demand in demands if not demand.measure.at_contact)
        delay_s = self.delay.delay_s.value
        return self._shape.learnt(wanted, zones, delay_s, *missing, intensity, at_once=at_once, short=short)

    def _propose(self, t_ns: int, after: BurstParameters, text: str) -> TuningReport | None:
        before = self.parameters
        if self.tuning.mode == "suggest":
            if self.pending == after:
                return None
            self.pending = after
            return TuningReport(t_ns, self.channel.number, "suggestion", f"suggested: {text}", before, after)
        if drive_of(after, before) != 1.0:
            self._settle, self.still = 1, 0
        if drive_of(after, before) < 1.0 or self._climb is None:
            self._climb = after if drive_of(after, before) < 1.0 else before
        self.parameters = after
        return self._report(t_ns, "change", text, before)

    def _identified(self, t_ns: int) -> TuningReport | None:
        """What is known of this foot's answer, now and then."""
        if self.model.strides - self._reported < REPORTED_EVERY:
            return None
        self._reported = self.model.strides
        return self._report(t_ns, "identified", identified(self.model, self.delay.delay_s, self.tuning))

    def _hint_if_unreached(self, t_ns: int, reading: Reading, asks: Measure | None) -> TuningReport | None:
        """``asks``: what asks for more, be it within its band; None where nothing does."""
        all_given = spent(self.parameters, self.tuning)
        self._unreached = self._unreached + 1 if reading.level < 0.0 or (asks is not None and all_given) else 0
        if self._unreached != UNREACHED_STRIDES:
            return None
        where = "below the upper bound: look at electrodes, the other target and the intensity set by hand"
        if all_given:
            where = "at the upper bound: look at electrodes, fatigue and target"
        measure = asks if asks is not None and reading.level >= 0.0 else reading.measures[0]
        text = measure.text()
        if 0.0 <= measure.level <= 1.0:
            text += " lies in its band, what is aimed at there"
        return self._report(t_ns, "hint", f"{text} is not reached {where}")

    def _report(self, t_ns: int, kind: Kind, text: str, before: BurstParameters | None = None) -> TuningReport:
        return TuningReport(t_ns, self.channel.number, kind, text, before or self.parameters, self.parameters)
