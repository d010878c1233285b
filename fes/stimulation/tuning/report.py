"""What the tuning says: each change with its reason, what was identified, in the units that people read."""

from dataclasses import dataclass
from typing import Final, Literal

from fes.config import Tuning
from fes.stimulation.envelope import BIN_S, BurstParameters
from fes.stimulation.tuning.delay import USUAL_SD_S
from fes.stimulation.tuning.demand import Demand
from fes.stimulation.tuning.response import SLOPE_SD, THRESHOLDS, Known, ResponseModel
from fes.stimulation.tuning.targets import PITCH, ROLL

LEARNT: Final = 0.75  # of what was uncertain beforehand: more is not known yet
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
    moved = [a - b for b, a in zip(before.widths_us, after.widths_us, strict=True)]
    if any(moved):
        k = max(range(len(moved)), key=lambda k: abs(moved[k]))
        width = f"pulse width {before.widths_us[k]:.0f} → {after.widths_us[k]:.0f} µs"
        even = len(set(before.widths_us)) == len(set(after.widths_us)) == 1
        mean = f"mean {before.mean_width_us:.0f} → {after.mean_width_us:.0f} µs"
        changes.append(width if even else f"{width} {k * BIN_S:.2f} s into the burst, where it changes most ({mean})")
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
    """Threshold, slopes and delay with their standard deviations, or that they are not known yet; "" at first."""
    bounds = tuning.bounds
    if bounds is None or not model.strides:
        return ""
    most, unit = (bounds.current_ma.high, "mA") if tuning.method == "run_to_run" else (bounds.pulse_width_us.high, "µs")
    known, unknown = [], []
    if model.threshold.sd < LEARNT * THRESHOLDS.std():
        known.append(f"threshold {most * model.threshold.value:.0f} ± {most * model.threshold.sd:.0f} {unit}")
    else:
        unknown.append("the threshold")
    for name, (span, shown) in _spans(tuning).items():
        if not model.knows(name):
            continue
        slope = model.slope(name)
        if slope.sd < min(abs(slope.value), LEARNT * SLOPE_SD):
            known.append(f"{name} {span * slope.value / most:.2g} ± {span * slope.sd / most:.1g} {shown}/{unit}")
        else:
            unknown.append(f"what lifts {name}" if name not in (PITCH, ROLL) else f"what changes {name}")
    if delay_s.sd < LEARNT * USUAL_SD_S:
        known.append(f"answer {1e3 * delay_s.value:.0f} ± {1e3 * delay_s.sd:.0f} ms after the pulse")
    else:
        unknown.append("the delay")
    parts = [", ".join(known)] if known else []
    return "identified: " + "; ".join(parts + ([f"not known yet: {', '.join(unknown)}"] if unknown else []))


def _spans(tuning: Tuning) -> dict[str, tuple[float, str]]:
    """By measure, its band's width in the unit that people read, and that unit."""
    found = {
        "toe clearance": (tuning.toe_clearance_m, 1e3, "mm"), "sensor lift": (tuning.sensor_clearance_m, 1e3, "mm"),
        PITCH: (tuning.pitch_at_contact_deg, 1.0, "°"), ROLL: (tuning.eversion_at_contact_deg, 1.0, "°"),
    }  # fmt: skip
    return {name: (scale * (band.high - band.low), unit) for name, (band, scale, unit) in found.items() if band}
