"""One channel's settings, held: a rule proposes, and here is what may come of it.

Whatever a rule gives (nonsense, not-a-number, another type, an exception), the settings stay within the session's
bounds, change by no more with one stride than the session allows, and not at all against a person's word. A rule that
never comes back is the gate's to end, for no command follows then. The gate has the last word over all of this.
"""

import math
from dataclasses import replace
from typing import Final

from fes.config import Bounds, Channel, Tuning
from fes.stimulation.envelope import BurstParameters, difference
from fes.stimulation.tuning.report import Kind, Rule, Seen, TuningReport

QUANTA: Final = (0.5, 0.005, 0.005, 1.0)  # mA, s, s, µs: the devices' steps; less would be a change on paper only


def held(before: BurstParameters, wanted: object, tuning: Tuning) -> BurstParameters:
    """What may become of ``before`` with one stride on the way to ``wanted``.

    Raises:
        ValueError: it is none, or holds what is no number.
        TypeError: likewise.
    """
    bounds = tuning.bounds
    if not isinstance(wanted, BurstParameters) or bounds is None or len(wanted.widths_us) != len(before.widths_us):
        raise ValueError("what it proposes is no burst")
    most_s, (by_ma, by_s, _, by_us) = tuning.max_change_s, QUANTA
    return BurstParameters(
        _step(before.current_ma, wanted.current_ma, tuning.max_change_ma, by_ma, bounds.current_ma),
        _step(before.start_delay_s, wanted.start_delay_s, most_s, by_s, bounds.start_delay_s),
        _step(before.extension_s, wanted.extension_s, most_s, by_s, bounds.extension_s),
        tuple(
            _step(was, width, tuning.max_change_us, by_us, bounds.pulse_width_us)
            for was, width in zip(before.widths_us, wanted.widths_us, strict=True)
        ),
    )


def _step(before: float, wanted: float, most: float, quantum: float, bounds: Bounds) -> float:
    """``wanted`` on the grid of ``quantum`` (or of ``most``, where that is finer), no further than ``most`` away."""
    change = min(max(float(wanted) - before, -most), most)
    if not math.isfinite(float(wanted)):
        raise ValueError("what it proposes is no number")
    grid = min(quantum, most)
    # towards `before`, so that no rounding goes beyond; a value off the grid stays off it
    after = before + math.copysign(grid * int(abs(change) / grid + 1e-9), change)
    after = min(max(round(after, 6), bounds.low), bounds.high)
    return after if abs(after - before) <= most + 1e-9 else before


def strength(parameters: BurstParameters) -> float:
    """Charge of the burst's strongest pulse, nC."""
    return parameters.current_ma * max(parameters.widths_us)


class Tuner:
    """``parameters`` are what the next burst is to have; ``pending`` waits for a person; ``frozen``: why, or ""."""

    def __init__(self, channel: Channel, rule: Rule, usual_intensity: float = 1.0) -> None:
        self.channel, self.rule, self.tuning = channel, rule, channel.tuning or Tuning()
        self.start = self.parameters = BurstParameters.for_channel(channel)
        self.pending: BurstParameters | None = None
        self.frozen = ""
        self._usual_intensity = usual_intensity
        self._going_back = False  # it has stopped itself

    def observe(self, t_ns: int, seen: Seen) -> TuningReport | None:
        """Put a stride before the rule and hold what it proposes."""
        if self.frozen:
            stimulated = seen.stride.valid and seen.charge_uc > 0.0 and seen.intensity > 0.0
            return self._back(t_ns, "still going back") if self._going_back and stimulated else None
        before = self.parameters
        try:
            proposal = self.rule.stride(seen)
            if proposal is None:
                return None
            text, stop, wanted = str(proposal.text), bool(proposal.stop), proposal.wanted
            after = before if wanted is None else held(before, wanted, self.tuning)
        except Exception as error:  # whatever another's rule raises
            text, stop, after = f"its rule cannot be used ({type(error).__name__})", True, before
        if stop:
            self.freeze(t_ns, text)
            self._going_back = self.tuning.mode == "act"
            back = self._back(t_ns, f"{text}; tuning has stopped and goes back") if self._going_back else None
            return back or self._report(t_ns, "roll_back", f"{text}; tuning has stopped", before)
        lowered = seen.intensity < self._usual_intensity
        if lowered and strength(after) > max(strength(before), strength(self.start)):
            after = before  # with the intensity up again it would be far more at once
        changes = difference(before, after)
        if not changes:
            self.pending = None
            return self._report(t_ns, "skip" if seen.skipped else "hint", text, before) if wanted is None else None
        if self.tuning.mode == "suggest":
            known, self.pending = self.pending == after, after
            text = f"suggested: {text}: {changes}"
            return None if known else TuningReport(t_ns, self.channel.number, "suggestion", text, before, after)
        self.parameters = after
        return self._report(t_ns, "skip" if seen.skipped else "change", f"{text}: {changes}", before)

    def _back(self, t_ns: int, text: str) -> TuningReport | None:
        """A step towards the session's settings, nowhere stronger than now."""
        before, start = self.parameters, self.start
        widths = tuple(map(min, before.widths_us, start.widths_us))
        aim = replace(start, current_ma=min(before.current_ma, start.current_ma), widths_us=widths)
        self.parameters = held(before, aim, self.tuning)
        changes = difference(before, self.parameters)
        self._going_back = bool(changes)
        return self._report(t_ns, "roll_back", f"{text}: {changes}", before) if changes else None

    # --- what a person does: it counts at once, whatever the rule says -------------------------------------

    def freeze(self, t_ns: int, why: str = "on demand") -> TuningReport:
        """Nothing changes any more until :meth:`resume`."""
        self.frozen, self.pending, self._going_back = why, None, False
        text = f"tuning is frozen ({why}); the settings stay as they are"
        return self._report(t_ns, "frozen", text, self.parameters)

    def resume(self, t_ns: int) -> TuningReport:
        """Go on after a freeze."""
        self.frozen, self._going_back = "", False
        self.acted("resumed")
        return self._report(t_ns, "frozen", "tuning goes on", self.parameters)

    def accept(self, t_ns: int) -> TuningReport | None:
        """Put the pending suggestion in force for the next burst; None when there is none."""
        if self.pending is None or self.frozen:
            return None
        before, self.parameters, self.pending = self.parameters, self.pending, None
        changes = difference(before, self.parameters)
        return self._report(t_ns, "change", f"suggestion accepted by the operator: {changes}", before)

    def roll_back(self, t_ns: int) -> TuningReport:
        """Back to the session's own settings with the next burst, and freeze."""
        before, self.parameters = self.parameters, self.start
        self.freeze(t_ns, "rolled back by the operator")
        self.acted("rolled back")
        changes = difference(before, self.parameters) or "nothing had been changed"
        return self._report(t_ns, "roll_back", f"back to the session's settings, tuning is frozen: {changes}", before)

    def acted(self, what: str, incline: float | None = None) -> None:
        """Tell the rule what a person did: see :meth:`fes.stimulation.tuning.report.Rule.acted`."""
        try:
            self.rule.acted(what, incline)
        except Exception as error:  # as above
            self.frozen = f"its rule cannot be used ({type(error).__name__})"

    def _report(self, t_ns: int, kind: Kind, text: str, before: BurstParameters) -> TuningReport:
        return TuningReport(t_ns, self.channel.number, kind, text, before, self.parameters)
