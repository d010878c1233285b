"""What a session's status says beside the signals: notices, the tuning, the charge. No clock, no I/O."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

from fes.gate import SafetyGate
from fes.live.sensors import SensorStream
from fes.live.status import TuningStatus
from fes.live.stimulator import Electrodes
from fes.signals import NS_PER_S
from fes.stimulation.envelope import BurstParameters, difference
from fes.stimulation.tuning.session import Tuners

SHOWN_NS: Final = 5 * NS_PER_S  # after the newest faulty sample; the log has the first, and its end how many


class Notices:
    """What a person should know though nothing is latched: shown with every status, logged when it begins.

    Faulty samples and lost lines of sensors that no channel follows, what sensors say of themselves, electrodes of
    which nothing is known yet, and what the controller says ``of_feet``. A line goes when what it tells of is over.
    ``lasting``: what else holds until the session ends.
    """

    def __init__(self, gate: SafetyGate, electrodes: Electrodes, of_feet: Callable[[], list[str]]) -> None:
        self.electrodes = electrodes
        self.streams: Sequence[SensorStream] = ()
        self.lasting: list[str] = []
        self.log = ""  # what its disk is behind with
        self.proof: Callable[[], str] = str  # what a person has to show before arming
        self.witness: Callable[[], list[str]] = list  # what it says of the foot sensors
        self._gate = gate
        self._of_feet = of_feet
        self._losses: dict[SensorStream, int] = {}

    def now(self, t_ns: int) -> list[str]:
        """All that holds at ``t_ns``."""
        flags = [
            f"{sensor}: {flag.samples} faulty samples, the newest: {flag.fault}; it drives no channel"
            for sensor, flag in self._gate.flagged.items()
            if t_ns - flag.t_ns < SHOWN_NS
        ]
        lost = (stream.why_lost for stream in self.streams)
        of_session = self.electrodes.unknown(), self.log, self.proof(), *self.lasting
        of_sensors = (notice for stream in self.streams for notice in stream.notices)
        return list(filter(None, (*self._of_feet(), *flags, *lost, *of_sensors, *self.witness(), *of_session)))

    def new_losses(self) -> list[str]:
        """Lines lost since the last call whose loss is no fault; the others' are events."""
        new = []
        for stream in self.streams:
            if stream.losses != self._losses.get(stream, 0):
                self._losses[stream] = stream.losses
                if not stream.needed:
                    new.append(f"{stream.why_lost or ', '.join(stream.sensors)}; it drives no channel")
        return new


def tuning_status(tuning: Tuners) -> dict[str, TuningStatus]:
    """Every channel by its number, also those that only have a ledger."""
    return {str(number): _channel_status(tuning, number) for number in tuning.ledger.electrodes}


def _channel_status(tuning: Tuners, number: int) -> TuningStatus:
    dose, tuner = tuning.ledger.electrodes[number], tuning.tuners.get(number)
    charge = TuningStatus(
        step_uc=round(dose.steps_uc[-1], 1) if dose.steps_uc else 0.0,
        minute_uc=round(dose.this_minute_uc, 1),
        session_uc=round(dose.session_uc, 1),
    )
    if tuner is None:
        return charge
    texts = {kind: report.text for (channel, kind), report in tuning.latest.items() if channel == number}
    changes = [
        tuning.latest[number, kind] for kind in ("change", "roll_back", "fault") if (number, kind) in tuning.latest
    ]
    newest = max(changes, key=lambda report: report.t_ns, default=None)
    return replace(
        charge,
        mode=tuner.tuning.mode,
        frozen=tuner.frozen,
        now=describe_parameters(tuner.parameters),
        suggestion="" if tuner.pending is None else difference(tuner.parameters, tuner.pending),
        why=texts.get("suggestion", "") if tuner.pending is not None else "",
        last_change="" if newest is None else newest.text,
        last_change_ns=0 if newest is None else newest.t_ns,
        hint=texts.get("fault", "") or texts.get("hint", ""),
    )


def describe_parameters(parameters: BurstParameters) -> str:
    """Current and pulse width for people."""
    return f"{parameters.current_ma:.1f} mA, {parameters.mean_width_us:.0f} µs"
