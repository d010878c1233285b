"""What a person should know though nothing is latched: shown with every status, and noted in the log when it begins."""

from __future__ import annotations

from collections.abc import Sequence

from fes.gate import SafetyGate
from fes.live.electrodes import Electrodes
from fes.live.sensors import SensorLine
from fes.signals import Event


class Remarks:
    """Faulty samples and lost lines of sensors that drive no channel, electrodes that nothing is known of yet.

    ``lasting``: what else holds until the session ends.
    """

    def __init__(self, gate: SafetyGate, electrodes: Electrodes) -> None:
        self.electrodes = electrodes
        self.lines: Sequence[SensorLine] = ()
        self.lasting: list[str] = []
        self._gate = gate
        self._losses: dict[SensorLine, int] = {}

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
