"""What a session's status says of the tuning and of the charge: per channel, in words where people read it. Pure."""

from __future__ import annotations

from dataclasses import replace

from fes.live.status import TuningStatus
from fes.stimulation.parameters import BurstParameters
from fes.stimulation.tuning.reports import difference
from fes.stimulation.tuning.tuners import Tuners


def tuning_status(tuning: Tuners) -> dict[str, TuningStatus]:
    """Every channel by its number, also those that only have a ledger."""
    return {str(number): _of(tuning, number) for number in tuning.ledger.electrodes}


def _of(tuning: Tuners, number: int) -> TuningStatus:
    dose, tuner = tuning.ledger.electrodes[number], tuning.tuners.get(number)
    charge = TuningStatus(
        step_uc=round(dose.steps_uc[-1], 1) if dose.steps_uc else 0.0,
        minute_uc=round(dose.this_minute_uc, 1),
        session_uc=round(dose.session_uc, 1),
    )
    if tuner is None:
        return charge
    said = {kind: report.text for (channel, kind), report in tuning.said.items() if channel == number}
    changes = [tuning.said[number, kind] for kind in ("change", "roll_back") if (number, kind) in tuning.said]
    newest = max(changes, key=lambda report: report.t_ns, default=None)
    return replace(
        charge,
        mode=tuner.tuning.mode,
        frozen=tuner.frozen,
        now=in_words(tuner.parameters),
        suggestion="" if tuner.pending is None else difference(tuner.parameters, tuner.pending),
        why=said.get("suggestion", "") if tuner.pending is not None else "",
        last_change="" if newest is None else newest.text,
        last_change_ns=0 if newest is None else newest.t_ns,
        hint=said.get("hint", ""),
    )


def in_words(parameters: BurstParameters) -> str:
    """What the next burst is to have."""
    return f"{parameters.current_ma:.1f} mA, {parameters.mean_width_us:.0f} µs"
