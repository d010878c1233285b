"""What a session's status says beside the signals: notices, the tuning, the charge. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fes.gate import SafetyGate
from fes.live.sensors import SensorStream
from fes.live.status import TuningStatus
from fes.live.stimulator import Electrodes
from fes.signals import Event
from fes.stimulation.parameters import BurstParameters
from fes.stimulation.tuning.reports import difference
from fes.stimulation.tuning.session import Tuners


class Notices:
    """Faulty samples and lost lines of sensors that drive no channel, electrodes that nothing is known of yet.

    ``lasting``: what else holds until the session ends.
    """

    def __init__(self, gate: SafetyGate, electrodes: Electrodes) -> None:
        self.electrodes = electrodes
        self.lines: Sequence[SensorStream] = ()
        self.lasting: list[str] = []
        self._gate = gate
        self._losses: dict[SensorStream, int] = {}

    def take(self, event: Event) -> None:
        """An event passes by."""
        self.electrodes.note(event)

    def now(self) -> list[str]:
        """All that holds now."""
        flags = [
            f"{sensor}: {flag.samples} faulty samples, the newest: {flag.fault}; it drives no channel"
            for sensor, flag in self._gate.flagged.items()
        ]
        remarks = [*flags, *(line.why_lost for line in self.lines), self.electrodes.unknown(), *self.lasting]
        return [remark for remark in remarks if remark]

    def new_losses(self) -> list[str]:
        """Lines lost since the last call whose loss is no fault; the others' are events."""
        new = []
        for line in self.lines:
            if line.losses != self._losses.get(line, 0):
                self._losses[line] = line.losses
                if not line.needed:
                    new.append(f"{line.why_lost or ', '.join(line.sensors)}; it drives no channel")
        return new


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
