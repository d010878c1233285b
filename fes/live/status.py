"""What a session tells whoever watches it, ten times a second: one JSON datagram, never waited for.

What a person should know though nothing is latched: shown with every status, and noted in the log when it begins.

What a session's status says of the tuning and of the charge: per channel, in words where people read it. Pure.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from fes.gate import SafetyGate
from fes.live.sensors import SensorStream
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


VERSION = 1


def finite(value: Any) -> Any:
    """The same with None for every number that is none: a stride that was not measured is NaN, which JSON has not."""
    if isinstance(value, dict):
        return {name: finite(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True, slots=True)
class FootStatus:
    """One foot: its phase, last stride (m; None before the first), walking speed (m/s), and whether it walks."""

    phase: str
    walking: bool
    strides: int = 0
    stride_length_m: float | None = None
    speed_mps: float | None = None
    rate_hz: float = 0.0
    age_ms: float = 0.0


@dataclass(frozen=True, slots=True)
class TuningStatus:
    """One channel's tuning and charge; texts are "" where there is nothing to say.

    ``now``: the next burst's parameters. ``suggestion``: what would change, ``why`` with its reason. ``last_change``:
    the last change or roll-back with its reason, at ``last_change_ns``. Charges in µC: last step, minute, session.
    """

    mode: str = "off"
    frozen: str = ""
    now: str = ""
    suggestion: str = ""
    why: str = ""
    last_change: str = ""
    last_change_ns: int = 0
    hint: str = ""
    step_uc: float = 0.0
    minute_uc: float = 0.0
    session_uc: float = 0.0


@dataclass(frozen=True, slots=True)
class Status:
    """A session at one moment; latency is from a sample's reading to the last byte written, since it began."""

    t_ns: int
    state: str
    message: str = ""
    fault: str = ""
    intensity: float = 0.0
    channel: int = 0
    on: bool = False
    feet: dict[str, FootStatus] = field(default_factory=dict)
    belt_speed_mps: float | None = None
    latency_p50_ms: float | None = None
    latency_p99_ms: float | None = None
    lateness_p99_ms: float | None = None
    samples: int = 0
    stimulator: str = ""
    dropped_frames: int = 0
    tuning: dict[str, TuningStatus] = field(default_factory=dict)  # by channel number
    stops: int = 0  # emergency stops by order so far
    remarks: list[str] = field(default_factory=list)  # what to know though nothing is latched
    version: int = VERSION

    def plain(self) -> dict[str, Any]:
        """As data for JSON: null for what is no number."""
        found: dict[str, Any] = finite(asdict(self))
        return found

    def encode(self) -> bytes:
        """The datagram."""
        return json.dumps(self.plain(), separators=(",", ":"), allow_nan=False).encode()

    @staticmethod
    def decode(datagram: bytes) -> Status:
        """Back from the datagram.

        Raises:
            ValueError: it is none of this version.
        """
        try:
            data: dict[str, Any] = json.loads(datagram)
            if data["version"] != VERSION:
                raise ValueError(f"status of version {data['version']}, this program reads {VERSION}")
            feet = {name: FootStatus(**foot) for name, foot in data.pop("feet").items()}
            tuning = {number: TuningStatus(**one) for number, one in data.pop("tuning", {}).items()}
            return Status(**data, feet=feet, tuning=tuning)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"no status: {error}") from error


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
