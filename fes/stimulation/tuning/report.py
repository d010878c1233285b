"""What the tuning says: each change with its reason, what was identified, in the units that people read."""

from dataclasses import dataclass
from typing import Literal

from fes.config import Tuning
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.demand import Demand
from fes.stimulation.tuning.response import Known, ResponseModel
from fes.stimulation.tuning.targets import PITCH, ROLL

Kind = Literal["change", "suggestion", "skip", "hint", "roll_back", "fault", "frozen", "identified"]


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
    def skipped(self) -> bool:
        """Whether its stride taught nothing, though the settings may have changed for it."""
        return " skipped: " in self.text

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


def reason(demand: Demand, *, stand_in: str = "") -> str:
    """Why the intensity changes, in words: the newest value, the usual one, and what follows."""
    measure, error = demand.measure, demand.error
    span = measure.band.high - measure.band.low

    def value(level: float) -> str:
        return f"{(measure.band.low + level * span) * measure.scale:.0f} {measure.unit}"

    if error < 0.0:
        why = f"lately {value(demand.usual)}, {value(demand.aim)} will do"
    elif demand.usual < 0.0:
        why = f"lately {value(demand.usual)}, more is needed"
    else:
        differ = max(demand.noise * span * measure.scale, 1.0)
        why = (
            f"lately {value(demand.usual)}; strides differ by some {differ:.0f} {measure.unit}, so "
            f"{value(demand.aim)} is aimed at"
        )
    text = f"{measure.text()} in this stride, {why}"
    return f"{text} ({stand_in})" if stand_in else text


def identified(model: ResponseModel, delay_s: Known, tuning: Tuning) -> str:
    """Threshold, slopes and delay with their standard deviations, in words; "" where nothing is known."""
    bounds = tuning.bounds
    if bounds is None or not model.strides:
        return ""
    most, unit = (bounds.current_ma.high, "mA") if tuning.method == "run_to_run" else (bounds.pulse_width_us.high, "µs")
    parts = [f"threshold {most * model.threshold.value:.0f} ± {most * model.threshold.sd:.0f} {unit}"]
    for name, (span, shown) in _spans(tuning).items():
        if model.knows(name):
            slope = model.slope(name)
            parts.append(f"{name} {span * slope.value / most:.2g} ± {span * slope.sd / most:.1g} {shown}/{unit}")
    parts.append(f"answer {1e3 * delay_s.value:.0f} ± {1e3 * delay_s.sd:.0f} ms after the pulse")
    return "identified: " + ", ".join(parts)


def _spans(tuning: Tuning) -> dict[str, tuple[float, str]]:
    """By measure, its band's width in the unit that people read, and that unit."""
    found = {
        "toe clearance": (tuning.toe_clearance_m, 1e3, "mm"), "sensor lift": (tuning.sensor_clearance_m, 1e3, "mm"),
        PITCH: (tuning.pitch_at_contact_deg, 1.0, "°"), ROLL: (tuning.eversion_at_contact_deg, 1.0, "°"),
    }  # fmt: skip
    return {name: (scale * (band.high - band.low), unit) for name, (band, scale, unit) in found.items() if band}
