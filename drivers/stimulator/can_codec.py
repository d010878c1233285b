"""Codec of the CAN stimulator: values ↔ frames, no I/O. The layout is ``fes_stimulator.dbc``, packed by cantools.

Our own protocol, as no profile for surface stimulation on CAN exists; its protection is described in ``e2e``. All
encoders return ``(identifier, 8 bytes)``. A value that a field cannot hold raises ``ValueError``: nothing wraps.
Physical values that fall between two steps are rounded down, never up.
"""

import math
from dataclasses import dataclass, fields
from enum import IntFlag
from importlib import resources
from typing import Any, Final, TypeAlias, cast

from cantools.database.can import Database
from cantools.database.can import Message as DbcMessage

from drivers.stimulator import e2e
from drivers.stimulator.port import WordedEnum
from fes import limits
from fes.signals import StimCommand, WireFrame

PROTOCOL_VERSION: Final = 3
NO_SESSION: Final = 0


class Result(WordedEnum):
    """What the node did with a command, or why it reports unasked (LEASE_EXPIRED, ON_TIME, OUTPUT_FAULT)."""

    OK = 0, ""
    LEASE_EXPIRED = 1, "lease expired: no newer command came in time, the channel is off"
    BAD_SESSION = 2, "command refused: its session is not open at the stimulator"
    BAD_COUNTER = 3, "command refused: repeated, old, or more than two commands lost"
    OVER_LIMIT = 4, "command refused: over the stimulator's own limits, the channel is off"
    STALE = 5, "command refused: it came later than its validity allows, the channel is off"
    ON_TIME = 6, "on for too long: the stimulator keeps the channel off until it gets an off command"
    FAULTED = 7, "command refused: the stimulator has a fault and needs a new session"
    OUTPUT_FAULT = 8, "output stage fault: electrode or lead, the channel is off"


class Fault(IntFlag):
    """Flags of NODE_ALIVE; VERSION, SESSION_USED and VALIDITY speak of the newest SESSION_OPEN."""

    NONE = 0
    COUNTER = 1
    OUTPUT = 2
    VERSION = 4
    SESSION_USED = 8
    VALIDITY = 16
    LATE = 32


FAULT_TEXT: Final[dict[Fault, str]] = {
    Fault.COUNTER: "too many wrong counters in a row, a new session is needed",
    Fault.OUTPUT: "output stage fault",
    Fault.VERSION: "the controller speaks another protocol version",
    Fault.SESSION_USED: "that session identifier was used before",
    Fault.VALIDITY: "the session's validity is 0 or longer than the stimulator allows",
    Fault.LATE: "commands come later than their validity allows, or a clock jumped: a new session is needed",
}


def fault_text(faults: int) -> str:
    """The flags in words, "" for none; unknown bits are named by number."""
    words = [text for flag, text in FAULT_TEXT.items() if faults & flag]
    if unknown := faults & ~sum(FAULT_TEXT):
        words.append(f"unknown fault flags 0x{unknown:02x}")
    return "; ".join(words)


@dataclass(frozen=True, slots=True)
class Command:
    """STIM_COMMAND. ``counter`` (0–127) runs over all channels of the controller and carries into ``session_id``.

    ``issued_ms``: when it was decided by the controller's clock, modulo 256 in steps of 16.
    """

    counter: int
    session_id: int
    channel: int
    on: bool
    current_ma: float
    pulse_width_us: float
    frequency_hz: float
    issued_ms: int


@dataclass(frozen=True, slots=True)
class SessionOpen:
    """SESSION_OPEN. ``boot_id`` is the one read from NODE_ALIVE: only that node, only this boot, may accept.

    ``validity_ms``, of all its commands: so long a channel stays on without another, and so old one may come.
    """

    version: int
    boot_id: int
    session_id: int
    validity_ms: int


@dataclass(frozen=True, slots=True)
class Charge:
    """STIM_CHARGE, always sent just before its STIM_STATUS.

    Running totals of the channel since the session was opened, modulo 256 pulses and modulo 2²⁴ steps of 0.5 nC
    (one phase): a lost frame loses no charge, the next one makes up for it.
    """

    counter: int
    session_id: int
    channel: int
    pulses_total: int
    charge_total_steps: int


@dataclass(frozen=True, slots=True)
class Status:
    """STIM_STATUS: what the channel delivers from now on.

    ``counter`` and ``session_id`` are the command's own, so that an answer belongs to one command of a session only.
    """

    counter: int
    session_id: int
    channel: int
    on: bool
    current_ma: float
    pulse_width_us: float
    frequency_hz: float
    result: Result


@dataclass(frozen=True, slots=True)
class Alive:
    """NODE_ALIVE. ``session_id`` is the open session (0: none), ``rejected`` saturates at 255."""

    counter: int
    version: int
    boot_id: int
    session_id: int
    rejected: int
    faults: int


Frame: TypeAlias = tuple[int, bytes]
Message: TypeAlias = Command | SessionOpen | Charge | Status | Alive


class FrameRejected(ValueError):
    """Bytes that are no frame of this protocol; the message says why."""


DATABASE: Final = Database(strict=True)
DATABASE.add_dbc_string(resources.files(__package__).joinpath("fes_stimulator.dbc").read_text(encoding="ascii"))
_OF_TYPE: Final[dict[type[Message], DbcMessage]] = {
    Command: DATABASE.get_message_by_name("STIM_COMMAND"),
    SessionOpen: DATABASE.get_message_by_name("SESSION_OPEN"),
    Charge: DATABASE.get_message_by_name("STIM_CHARGE"),
    Status: DATABASE.get_message_by_name("STIM_STATUS"),
    Alive: DATABASE.get_message_by_name("NODE_ALIVE"),
}
COMMAND_ID, OPEN_ID, CHARGE_ID, STATUS_ID, ALIVE_ID = (message.frame_id for message in _OF_TYPE.values())
CONTROLLER_IDS: Final = frozenset((COMMAND_ID, OPEN_ID))
NODE_IDS: Final = frozenset((CHARGE_ID, STATUS_ID, ALIVE_ID))
_TYPES: Final = {message.frame_id: kind for kind, message in _OF_TYPE.items()}
_SIGNALS: Final = {
    "counter": "Counter", "session_id": "Session", "channel": "Channel", "on": "On", "current_ma": "Current",
    "pulse_width_us": "PulseWidth", "frequency_hz": "Frequency", "validity_ms": "Validity", "issued_ms": "Issued",
    "result": "Result",
    "version": "Version", "boot_id": "Boot", "pulses_total": "PulsesTotal", "charge_total_steps": "ChargeTotal",
    "rejected": "Rejected", "faults": "Faults",
}  # fmt: skip
_FIELDS: Final = {kind: [(field.name, _SIGNALS[field.name]) for field in fields(kind)] for kind in _OF_TYPE}
_MOST: Final[dict[str, int]] = {s.name: 2**s.length - 1 for m in DATABASE.messages for s in m.signals}
_COMMAND: Final = _OF_TYPE[Command]
CURRENT_STEP_MA, PULSE_WIDTH_STEP_US, FREQUENCY_STEP_HZ = (
    float(_COMMAND.get_signal_by_name(name).scale) for name in ("Current", "PulseWidth", "Frequency")
)
MAX_CURRENT_MA: Final = CURRENT_STEP_MA * _MOST["Current"]
MAX_PULSE_WIDTH_US: Final = PULSE_WIDTH_STEP_US * _MOST["PulseWidth"]
MAX_FREQUENCY_HZ: Final = FREQUENCY_STEP_HZ * _MOST["Frequency"]
CHARGE_STEP_UC: Final = CURRENT_STEP_MA * PULSE_WIDTH_STEP_US * 1e-3
CHARGE_TOTAL_STEPS: Final = 2**24
PULSES_TOTAL: Final = 2**8
VALIDITY_STEP_MS: Final = int(_OF_TYPE[SessionOpen].get_signal_by_name("Validity").scale)
ISSUED_STEP_MS: Final = int(_COMMAND.get_signal_by_name("Issued").scale)
ISSUED_STEPS: Final = _MOST["Issued"] + 1
COUNTER_LOW: Final = _COMMAND.get_signal_by_name("Counter").length
_STEPS: Final[dict[str, float]] = {
    "Current": CURRENT_STEP_MA,
    "PulseWidth": PULSE_WIDTH_STEP_US,
    "Frequency": FREQUENCY_STEP_HZ,
    "Validity": VALIDITY_STEP_MS,
    "Issued": ISSUED_STEP_MS,
}


def encode_command(command: StimCommand, number: int, session_id: int, begun_ns: int = 0) -> Frame:
    """STIM_COMMAND of what the gate let out; an off command carries no current, width or frequency.

    Args:
        number: how many commands of the session went before, on all channels.
        begun_ns: when the session's first command was decided; its time of issue counts from there.
        session_id: as it was opened; the frame carries what :func:`~drivers.stimulator.e2e.carried` says.

    Raises:
        ValueError: a value is negative, not finite or beyond what its field holds.
    """
    carried_id, count = e2e.carried(
        _whole("session_id", session_id, _MOST["Session"], least=1), _whole("number", number, e2e.NUMBERS - 1)
    )
    levels = (command.current_ma, command.pulse_width_us, command.frequency_hz) if command.on else (0.0, 0.0, 0.0)
    issued_ms = (command.t_ns - begun_ns) // (ISSUED_STEP_MS * 1_000_000) % ISSUED_STEPS * ISSUED_STEP_MS
    return encode(Command(count, carried_id, command.channel, command.on, *levels, issued_ms))


def encode_open(
    boot_id: int, session_id: int, version: int = PROTOCOL_VERSION, validity_ms: int = limits.MAX_VALIDITY_MS
) -> Frame:
    """SESSION_OPEN in answer to the node that announced ``boot_id``.

    ValueError: a number is out of its field's range; session 0 means "none" and cannot be opened.
    """
    _whole("session_id", session_id, _MOST["Session"], least=1)
    return encode(SessionOpen(version, boot_id, session_id, validity_ms))


def encode(message: Message) -> Frame:
    """The protected frame of any message; ``Reserved`` is 0. The caller has reduced a charge's totals to their moduli.

    ValueError: a value is negative, not finite or beyond what its field holds.
    """
    raw = {"Crc": 0, "Reserved": 0}
    for name, signal in _FIELDS[type(message)]:
        value = getattr(message, name)
        if isinstance(message, (Command, Status)) and name == "counter":
            raw["CounterHigh"] = _whole(name, value >> COUNTER_LOW, _MOST["CounterHigh"])
            value &= 2**COUNTER_LOW - 1
        step = _STEPS.get(signal)
        raw[signal] = _whole(name, value, _MOST[signal]) if step is None else _steps(name, value, step, _MOST[signal])
    layout = _OF_TYPE[type(message)]
    return layout.frame_id, e2e.protect(layout.frame_id, layout.encode(raw, scaling=False, strict=False))


def decode(identifier: int, data: bytes) -> Message:
    """Any frame of this protocol.

    FrameRejected: unknown identifier, wrong length, wrong CRC, reserved bits set, or a result unknown here.
    """
    kind = _TYPES.get(identifier)
    if kind is None:
        raise FrameRejected(f"identifier 0x{identifier:x} is none of this protocol's")
    raw = _unpack(_OF_TYPE[kind], data)
    values: dict[str, Any] = {name: raw[signal] * _STEPS.get(signal, 1) for name, signal in _FIELDS[kind]}
    if "on" in values:
        values["on"] = bool(values["on"])
    if kind in (Command, Status):
        values["counter"] |= raw["CounterHigh"] << COUNTER_LOW
    if kind is Status:
        try:
            values["result"] = Result(raw["Result"])
        except ValueError as error:
            raise FrameRejected(f"STIM_STATUS: unknown result {raw['Result']}") from error
    return kind(**values)


def logged_commands(frames: list[WireFrame]) -> list[tuple[StimCommand, int]]:
    """The commands among logged frames, as they read on the wire, each with the count by which answers name it.

    FrameRejected: a logged frame is no intact frame of this protocol.
    """
    commands = []
    validity_ms = limits.MAX_VALIDITY_MS
    for frame in frames:
        message = decode(frame.identifier, frame.data)
        if isinstance(message, SessionOpen):
            validity_ms = message.validity_ms or validity_ms
        if isinstance(message, Command):
            values = (message.on, message.current_ma, message.pulse_width_us, message.frequency_hz)
            command = StimCommand(frame.t_ns, message.channel, *values, validity_ms)
            commands.append((command, message.counter % e2e.COUNTS))
    return commands


def _whole(name: str, value: int, most: int, least: int = 0) -> int:
    if not least <= value <= most:
        raise ValueError(f"{name} = {value} does not fit its field ({least} to {most})")
    return int(value)


def _steps(name: str, value: float, step: float, most: int) -> int:
    if not math.isfinite(value) or not 0.0 <= value < (most + 1) * step:
        raise ValueError(f"{name} = {value} does not fit its field (0 to {most * step:g})")
    return math.floor(value / step)


def _unpack(message: DbcMessage, data: bytes) -> dict[str, int]:
    if len(data) != e2e.FRAME_LENGTH:
        raise FrameRejected(f"{message.name}: {len(data)} bytes instead of {e2e.FRAME_LENGTH}")
    if not e2e.is_intact(message.frame_id, data):
        raise FrameRejected(f"{message.name}: wrong CRC")
    # without choices and scaling, and with no multiplexed message in the file, every value is a plain int
    raw = cast(dict[str, int], message.decode(data, decode_choices=False, scaling=False))
    if raw.get("Reserved", 0):
        raise FrameRejected(f"{message.name}: reserved bits are set")
    return raw
