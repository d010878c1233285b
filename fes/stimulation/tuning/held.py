"""One channel's settings, held: a rule proposes, and here is what may come of it.

Whatever a rule gives (nonsense, not-a-number, an exception), the settings stay within the session's bounds, change by
no more with one stride than the session allows, and not at all against a person's word. A rule that never comes back is
the gate's to end, for no command follows then. The gate has the last word over all of this.
"""

import math
from dataclasses import replace

from fes.config import Bounds, Channel, Tuning
from fes.stimulation.envelope import BurstParameters, difference
from fes.stimulation.tuning.report import Kind, Rule, Seen, TuningReport


def held(was: BurstParameters, to: object, tuning: Tuning) -> BurstParameters:
    """What may become of a burst with one stride on the way to ``to``; raises ValueError where that is none."""
    may = tuning.bounds
    if not isinstance(to, BurstParameters) or may is None or len(to.widths_us) != len(was.widths_us):
        raise ValueError("what it proposes is no burst")
    widths = zip(was.widths_us, to.widths_us, strict=True)
    return BurstParameters(  # in the devices' steps; less would be a change on paper only
        _step(was.current_ma, to.current_ma, tuning.max_change_ma, 0.5, may.current_ma),
        _step(was.start_delay_s, to.start_delay_s, tuning.max_change_s, 0.005, may.start_delay_s),
        _step(was.extension_s, to.extension_s, tuning.max_change_s, 0.005, may.extension_s),
        tuple(_step(old, new, tuning.max_change_us, 1.0, may.pulse_width_us) for old, new in widths),
    )


def _step(before: float, wanted: float, most: float, grid: float, bounds: Bounds) -> float:
    change, grid = min(max(float(wanted) - before, -most), most), min(grid, most)
    if not math.isfinite(float(wanted)):
        raise ValueError("what it proposes is no number")
    # towards `before`, so that no rounding goes beyond; a value off the grid stays off it
    after = round(before + math.copysign(grid * int(abs(change) / grid + 1e-9), change), 6)
    after = min(max(after, bounds.low), bounds.high)
    return after if abs(after - before) <= most + 1e-9 else before


class Tuner:
    """``parameters`` are what the next burst is to have; ``pending`` waits for a person; ``frozen``: why, or ""."""

    def __init__(self, channel: Channel, rule: Rule, usual_intensity: float = 1.0) -> None:
        self.channel, self.rule, self.tuning = channel, rule, channel.tuning or Tuning()
        self.start = self.parameters = BurstParameters.for_channel(channel)
        self.pending: BurstParameters | None = None
        self.frozen, self._going_back, self._usual_intensity = "", False, usual_intensity

    def observe(self, t_ns: int, seen: Seen) -> TuningReport | None:
        """Put a stride before the rule and hold what it proposes."""
        before, text = self.parameters, "still going back"
        if self.frozen:
            stimulated = seen.stride.valid and seen.charge_uc > 0.0 and seen.intensity > 0.0
            return self._back(t_ns, text) if self._going_back and stimulated else None
        try:
            if (proposal := self.rule.stride(seen)) is None:
                return None
            text, stop, wanted = str(proposal.text), bool(proposal.stop), proposal.wanted
            after = before if wanted is None else held(before, wanted, self.tuning)
        except Exception as error:  # whatever another's rule raises
            text, stop = f"its rule cannot be used ({type(error).__name__})", True
        if stop:
            self.freeze(t_ns, text)
            self._going_back = self.tuning.mode == "act"
            back = self._back(t_ns, f"{text}; tuning has stopped and goes back") if self._going_back else None
            return back or self._take(t_ns, "roll_back", before, f"{text}; tuning has stopped")
        if seen.intensity < self._usual_intensity and after.strength_nc > max(
            before.strength_nc, self.start.strength_nc
        ):
            after = before  # with the intensity up again it would be far more at once
        known, self.pending = self.pending == after, None
        if after == before:
            return self._take(t_ns, "skip" if seen.skipped else "hint", after, text) if wanted is None else None
        if self.tuning.mode == "act":
            return self._take(t_ns, "skip" if seen.skipped else "change", after, text)
        self.pending, text = after, f"suggested: {text}: {difference(before, after)}"
        return None if known else TuningReport(t_ns, self.channel.number, "suggestion", text, before, after)

    def _back(self, t_ns: int, text: str) -> TuningReport | None:
        """A step towards the session's settings, nowhere stronger than now."""
        before, start = self.parameters, self.start
        widths_us = tuple(map(min, before.widths_us, start.widths_us))
        less = replace(start, current_ma=min(before.current_ma, start.current_ma), widths_us=widths_us)
        self._going_back = (after := held(before, less, self.tuning)) != before
        return self._take(t_ns, "roll_back", after, text) if self._going_back else None

    def _take(self, t_ns: int, kind: Kind, after: BurstParameters, text: str) -> TuningReport:
        before, self.parameters = self.parameters, after
        said = f"{text}: {difference(before, after)}" if after != before else text
        return TuningReport(t_ns, self.channel.number, kind, said, before, after)

    # --- what a person does: it counts at once, whatever the rule says -------------------------------------

    def freeze(self, t_ns: int, why: str = "on demand") -> TuningReport:
        """Nothing changes any more until :meth:`resume`."""
        self.frozen, self.pending, self._going_back = why, None, False
        text = f"tuning is frozen ({why}); the settings stay as they are"
        return self._take(t_ns, "frozen", self.parameters, text)

    def resume(self, t_ns: int) -> TuningReport:
        """Go on after a freeze."""
        self.frozen, self._going_back = "", False
        self.acted("resumed")
        return self._take(t_ns, "frozen", self.parameters, "tuning goes on")

    def accept(self, t_ns: int) -> TuningReport | None:
        """Put the pending suggestion in force for the next burst; None when there is none."""
        if (after := self.pending) is None or self.frozen:
            return None
        self.pending = None
        return self._take(t_ns, "change", after, "suggestion accepted by the operator")

    def roll_back(self, t_ns: int) -> TuningReport:
        """Back to the session's own settings with the next burst, and freeze."""
        self.freeze(t_ns, "rolled back by the operator")
        self.acted("rolled back")
        return self._take(t_ns, "roll_back", self.start, "back to the session's settings, tuning is frozen")

    def acted(self, what: str, incline: float | None = None) -> None:
        """Tell the rule what a person did: see :meth:`fes.stimulation.tuning.report.Rule.acted`."""
        try:
            self.rule.acted(what, incline)
        except Exception as error:  # as above
            self.frozen = f"its rule cannot be used ({type(error).__name__})"
