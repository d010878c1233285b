"""A session's status for people, ten times a second as one JSON datagram. No clock, no I/O."""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from fes.walk_record import finite_or_none

VERSION = 1


def percent_of(incline: float) -> float | None:
    """An incline (rise per horizontal distance) in percent, as people set it; None where it is NaN: nobody knows it."""
    return None if math.isnan(incline) else round(100.0 * incline, 3)


def ground_text(incline_percent: float | None) -> str:
    """What is walked on, in words; None: nobody knows its incline."""
    if incline_percent is None:
        return "stairs or ramps"
    return f"an incline of {incline_percent:+g} %" if incline_percent else "level"


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
    remedy: str = ""  # what to do about the fault
    intensity: float = 0.0
    channel: int = 0
    on: bool = False
    feet: dict[str, FootStatus] = field(default_factory=dict)
    belt_speed_mps: float | None = None
    incline_percent: float | None = 0.0  # what the strides are measured with; None: stairs, ramps both ways
    latency_p50_ms: float | None = None
    latency_p99_ms: float | None = None
    lateness_p99_ms: float | None = None
    samples: int = 0
    stimulator: str = ""
    dropped_frames: int = 0
    tuning: dict[str, TuningStatus] = field(default_factory=dict)  # by channel number
    stops: int = 0  # emergency stops by command so far
    notices: list[str] = field(default_factory=list)  # what to know though nothing is latched
    version: int = VERSION

    def plain(self) -> dict[str, Any]:
        """As data for JSON: null for what is no number."""
        found: dict[str, Any] = finite_or_none(asdict(self))
        return found

    def encode(self) -> bytes:
        """The datagram."""
        return json.dumps(self.plain(), separators=(",", ":"), allow_nan=False).encode()

    @staticmethod
    def decode(datagram: bytes) -> Status:
        """Back from the datagram. ValueError: it is none of this version."""
        try:
            data: dict[str, Any] = json.loads(datagram)
            if data["version"] != VERSION:
                raise ValueError(f"status of version {data['version']}, this program reads {VERSION}")
            feet = {name: FootStatus(**foot) for name, foot in data.pop("feet").items()}
            tuning = {number: TuningStatus(**one) for number, one in data.pop("tuning", {}).items()}
            return Status(**data, feet=feet, tuning=tuning)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"no status: {error}") from error


# --- What to do about a fault or a refusal, for whoever stands beside the session. No clock, no I/O ---------


_COMPUTER: Final = "Close other programs; `fes doctor` says what this computer does not grant."
_LINE: Final = "Check plug, battery and range; its line is opened again by itself. Then arm again."
_READ: Final = "Look at the sensor's link and at `fes doctor`, which reads every sensor for two seconds."
_UNIT: Final = "Check the sensor's unit and ranges in its own settings and in the session file."
_MOUNT: Final = "Put the sensor back as it was at calibration, or calibrate again."
_FELT: Final = "See that the sensor sits firmly; if it does, switch it off and on, or take another one. Then arm again."
_SIDES: Final = "End the session, put each sensor on its own foot, and begin anew."
_RESTART: Final = "Switch the sensor off and on, then arm again."
_LEADS: Final = "Check electrodes, leads and plugs, then arm again."
_DEVICE: Final = "Switch the stimulator off and on, check its supply, then arm again."
_REQUEST: Final = "The plan asked for more than a limit allows; check the channel's settings, and keep the log."

REMEDIES: Final[tuple[tuple[str, str], ...]] = (  # the first whose words are found
    (r"controller stalled|command was .* late|lease expired|too late", _COMPUTER),
    (r"start a new session|did not switch off", "End the session and begin anew; keep the log."),
    (r"are their sensors exchanged", _SIDES),
    (r"sensor lost|no data from", _LINE),
    (r"clock of .* jumped|clock went|time stamps are out of order|dated .* ahead", _RESTART),
    (r"data \d+ ms old|too few samples|samples in the last second|silent for", _READ),
    (r"is frozen|non-finite", _RESTART),
    (r"unit|saturated|is it scaled", _UNIT),
    (r"does not feel it|do not fit|does it dangle", _FELT),
    (r"remounted|tilted", _MOUNT),
    (r"stimulator lost", "Check the stimulator's plug and supply; it is opened again by itself. Then arm again."),
    (r"electrode|lead", _LEADS),
    (r"pulses that nobody asked for|delivers", "Switch the stimulator off at its own switch before anything else."),
    (r"stimulator (fault|restarted|does not answer)", _DEVICE),
    (r"time ran backward", "Do not set this computer's clock during a session; arm again."),
    (r"moves \(", "Stand still for a second."),
    (
        r"the foot rests|without a swing|swings of the foot|nobody asked|a person asked for",
        "The plan asked for current where the foot's movement, or a person, asks for none; keep the log.",
    ),
    (r"mA|µC|µs|mC| Hz|on for|off for|never together|has no channel|must be true or false", _REQUEST),
)


def remedy(fault: str) -> str:
    """What to do about it; "" where nothing is known but to arm again."""
    return next((what for words, what in REMEDIES if re.search(words, fault)), "")


def with_remedy(text: str) -> str:
    """The words of a fault, which may be a question, as a sentence, and what to do about it."""
    return f"{text}{'' if text.endswith(('?', '.')) else '.'} {remedy(text)}".rstrip()
