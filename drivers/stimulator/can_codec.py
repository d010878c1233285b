"""Codec of the CAN stimulator: values ↔ frames, no I/O. The layout is ``fes_stimulator.dbc``, packed by cantools.

Our own protocol, as no profile for surface stimulation on CAN exists; its protection is described in ``e2e``. All
encoders return ``(identifier, 8 bytes)``. A value that a field cannot hold raises ``ValueError``: nothing wraps.
Physical values that fall between two steps are rounded down, never up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from importlib import resources
from typing import Final, TypeAlias, cast

from cantools.database.can import Database, Signal
from cantools.database.can import Message as DbcMessage

from drivers.stimulator import e2e
from fes.signals import StimCommand, WireFrame

PROTOCOL_VERSION: Final = 2
NO_SESSION: Final = 0
ECHOED_COUNTS: Final = 16  # answers name a command by the low 4 bits of its count


class Result(IntEnum):
    """What the node did with a command, or why it reports unasked (LEASE_EXPIRED, ON_TIME, OUTPUT_FAULT)."""

    OK = 0
    LEASE_EXPIRED = 1
    BAD_SESSION = 2
    BAD_COUNTER = 3
    OVER_LIMIT = 4
    BAD_VALIDITY = 5
    ON_TIME = 6
    FAULTED = 7
    OUTPUT_FAULT = 8


RESULT_TEXT: Final[dict[Result, str]] = {
    Result.OK: "",
    Result.LEASE_EXPIRED: "lease expired: no newer command came in time, the channel is off",
    Result.BAD_SESSION: "command refused: its session is not open at the stimulator",
    Result.BAD_COUNTER: "command refused: repeated, old, or more than two commands lost",
    Result.OVER_LIMIT: "command refused: over the stimulator's own limits, the channel is off",
    Result.BAD_VALIDITY: "command refused: its validity is 0 or longer than the stimulator allows, the channel is off",
    Result.ON_TIME: "on for too long: the stimulator keeps the channel off until it gets an off command",
    Result.FAULTED: "command refused: the stimulator has a fault and needs a new session",
    Result.OUTPUT_FAULT: "output stage fault: electrode or lead, the channel is off",
}


class Fault(IntFlag):
    """Flags of NODE_ALIVE; the last two speak of the newest SESSION_OPEN."""

    NONE = 0
    COUNTER = 1
    OUTPUT = 2
    VERSION = 4
    SESSION_USED = 8


FAULT_TEXT: Final[dict[Fault, str]] = {
    Fault.COUNTER: "too many wrong counters in a row, a new session is needed",
    Fault.OUTPUT: "output stage fault",
    Fault.VERSION: "the controller speaks another protocol version",
    Fault.SESSION_USED: "that session identifier was used before",
}


def fault_text(faults: int) -> str:
    """The flags in words, "" for none; unknown bits are named by number."""
    words = [text for flag, text in FAULT_TEXT.items() if faults & flag]
    unknown = faults & ~sum(FAULT_TEXT)
    if unknown:
        words.append(f"unknown fault flags 0x{unknown:02x}")
    return "; ".join(words)


@dataclass(frozen=True, slots=True)
class Command:
    """STIM_COMMAND. ``counter`` (0–127) runs over all channels of the controller and carries into ``session_id``."""

    counter: int
    session_id: int
    channel: int
    on: bool
    current_ma: float
    pulse_width_us: float
    frequency_hz: float
    validity_ms: int


@dataclass(frozen=True, slots=True)
class SessionOpen:
    """SESSION_OPEN. ``boot_id`` is the one read from NODE_ALIVE: only that node, only this boot, may accept."""

    version: int
    boot_id: int
    session_id: int


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

    ``counter`` is the command's modulo 16. ``session_id`` is the open session's, as opened; with BAD_SESSION, the
    command's own.
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


def _load() -> Database:
    database = Database(strict=True)
    database.add_dbc_string(resources.files(__package__).joinpath("fes_stimulator.dbc").read_text(encoding="ascii"))
    return database


DATABASE: Final = _load()
_COMMAND: Final = DATABASE.get_message_by_name("STIM_COMMAND")
_OPEN: Final = DATABASE.get_message_by_name("SESSION_OPEN")
_CHARGE: Final = DATABASE.get_message_by_name("STIM_CHARGE")
_STATUS: Final = DATABASE.get_message_by_name("STIM_STATUS")
_ALIVE: Final = DATABASE.get_message_by_name("NODE_ALIVE")

COMMAND_ID: Final = _COMMAND.frame_id
OPEN_ID: Final = _OPEN.frame_id
CHARGE_ID: Final = _CHARGE.frame_id
STATUS_ID: Final = _STATUS.frame_id
ALIVE_ID: Final = _ALIVE.frame_id
CONTROLLER_IDS: Final = frozenset((COMMAND_ID, OPEN_ID))
NODE_IDS: Final = frozenset((CHARGE_ID, STATUS_ID, ALIVE_ID))


def _step_and_most(signal: Signal) -> tuple[float, float]:
    return float(signal.scale), float(signal.scale) * (2**signal.length - 1)


CURRENT_STEP_MA, MAX_CURRENT_MA = _step_and_most(_COMMAND.get_signal_by_name("Current"))
PULSE_WIDTH_STEP_US, MAX_PULSE_WIDTH_US = _step_and_most(_COMMAND.get_signal_by_name("PulseWidth"))
FREQUENCY_STEP_HZ, MAX_FREQUENCY_HZ = _step_and_most(_COMMAND.get_signal_by_name("Frequency"))
CHARGE_STEP_UC: Final = CURRENT_STEP_MA * PULSE_WIDTH_STEP_US * 1e-3
CHARGE_TOTAL_STEPS: Final = 2**24
PULSES_TOTAL: Final = 2**8
VALIDITY_STEP_MS: Final = int(_COMMAND.get_signal_by_name("Validity").scale)
COUNTER_LOW: Final = _COMMAND.get_signal_by_name("Counter").length
_MOST: Final[dict[str, int]] = {s.name: 2**s.length - 1 for m in DATABASE.messages for s in m.signals}
_NAMES: Final = {  # of the fields whose values have another name here
    "Session": "session_id",
    "Boot": "boot_id",
    "PulsesTotal": "pulses_total",
    "ChargeTotal": "charge_total_steps",
}


def encode_command(command: StimCommand, number: int, session_id: int) -> Frame:
    """STIM_COMMAND of what the gate let out; an off command carries no current, width or frequency.

    Args:
        number: how many commands of the session went before, on all channels.
        session_id: as it was opened; the frame carries what :func:`~drivers.stimulator.e2e.carried` says.

    Raises:
        ValueError: a value is negative, not finite or beyond what its field holds.
    """
    carried_id, count = e2e.carried(
        _whole("session_id", session_id, _MOST["Session"], least=1), _whole("number", number, e2e.NUMBERS - 1)
    )
    return _pack(
        _COMMAND,
        Counter=count & 2**COUNTER_LOW - 1,
        CounterHigh=count >> COUNTER_LOW,
        Channel=command.channel,
        On=int(command.on),
        Session=carried_id,
        Validity=_steps("validity_ms", command.validity_ms, VALIDITY_STEP_MS, _MOST["Validity"]),
        **(_level_steps(command) if command.on else {"Current": 0, "PulseWidth": 0, "Frequency": 0}),
    )


def encode_open(boot_id: int, session_id: int, version: int = PROTOCOL_VERSION) -> Frame:
    """SESSION_OPEN in answer to the node that announced ``boot_id``.

    Raises:
        ValueError: a number is out of its field's range; session 0 means "none" and cannot be opened.
    """
    _whole("session_id", session_id, _MOST["Session"], least=1)
    return _pack(_OPEN, Version=version, Boot=boot_id, Session=session_id)


def encode_charge(charge: Charge) -> Frame:
    """STIM_CHARGE; the caller has reduced the totals to their moduli."""
    return _pack(
        _CHARGE,
        Counter=charge.counter,
        Channel=charge.channel,
        Session=charge.session_id,
        PulsesTotal=charge.pulses_total,
        ChargeTotal=charge.charge_total_steps,
    )


def encode_status(status: Status) -> Frame:
    """STIM_STATUS."""
    return _pack(
        _STATUS,
        Counter=status.counter,
        Channel=status.channel,
        On=int(status.on),
        Session=status.session_id,
        Result=int(status.result),
        **_level_steps(status),
    )


def encode_alive(alive: Alive) -> Frame:
    """NODE_ALIVE."""
    return _pack(
        _ALIVE,
        Counter=alive.counter,
        Version=alive.version,
        Boot=alive.boot_id,
        Session=alive.session_id,
        Rejected=alive.rejected,
        Faults=alive.faults,
    )


def decode(identifier: int, data: bytes) -> Message:
    """Any frame of this protocol.

    Raises:
        FrameRejected: unknown identifier, wrong length, wrong CRC, reserved bits set, or a result unknown here.
    """
    if identifier == COMMAND_ID:
        return _command(_unpack(_COMMAND, data))
    if identifier == STATUS_ID:
        raw = _unpack(_STATUS, data)
        try:
            result = Result(raw["Result"])
        except ValueError as error:
            raise FrameRejected(f"STIM_STATUS: unknown result {raw['Result']}") from error
        return Status(raw["Counter"], raw["Session"], raw["Channel"], bool(raw["On"]), *_levels(raw), result)
    if identifier == CHARGE_ID:
        raw = _unpack(_CHARGE, data)
        return Charge(raw["Counter"], raw["Session"], raw["Channel"], raw["PulsesTotal"], raw["ChargeTotal"])
    if identifier == ALIVE_ID:
        raw = _unpack(_ALIVE, data)
        return Alive(raw["Counter"], raw["Version"], raw["Boot"], raw["Session"], raw["Rejected"], raw["Faults"])
    if identifier == OPEN_ID:
        raw = _unpack(_OPEN, data)
        return SessionOpen(raw["Version"], raw["Boot"], raw["Session"])
    raise FrameRejected(f"identifier 0x{identifier:x} is none of this protocol's")


def decode_command(identifier: int, data: bytes) -> Command:
    """STIM_COMMAND only.

    Raises:
        FrameRejected: as for :func:`decode`, or it is another of the protocol's frames.
    """
    if identifier != COMMAND_ID:
        raise FrameRejected(f"identifier 0x{identifier:x} is not STIM_COMMAND (0x{COMMAND_ID:x})")
    return _command(_unpack(_COMMAND, data))


def logged_commands(frames: list[WireFrame]) -> list[tuple[StimCommand, int]]:
    """The commands among logged frames, as they read on the wire, each with the count by which answers name it.

    Raises:
        FrameRejected: a logged frame is no intact frame of this protocol.
    """
    commands = []
    for frame in frames:
        message = decode(frame.identifier, frame.data)
        if isinstance(message, Command):
            values = (message.on, message.current_ma, message.pulse_width_us, message.frequency_hz)
            command = StimCommand(frame.t_ns, message.channel, *values, message.validity_ms)
            commands.append((command, message.counter % ECHOED_COUNTS))
    return commands


def _command(raw: dict[str, int]) -> Command:
    count = raw["CounterHigh"] << COUNTER_LOW | raw["Counter"]
    validity_ms = raw["Validity"] * VALIDITY_STEP_MS
    return Command(count, raw["Session"], raw["Channel"], bool(raw["On"]), *_levels(raw), validity_ms)


def _levels(raw: dict[str, int]) -> tuple[float, float, float]:
    return (
        raw["Current"] * CURRENT_STEP_MA,
        raw["PulseWidth"] * PULSE_WIDTH_STEP_US,
        raw["Frequency"] * FREQUENCY_STEP_HZ,
    )


def _level_steps(levels: StimCommand | Status) -> dict[str, int]:
    """Current, width and frequency in steps."""
    return {
        "Current": _steps("current_ma", levels.current_ma, CURRENT_STEP_MA, _MOST["Current"]),
        "PulseWidth": _steps("pulse_width_us", levels.pulse_width_us, PULSE_WIDTH_STEP_US, _MOST["PulseWidth"]),
        "Frequency": _steps("frequency_hz", levels.frequency_hz, FREQUENCY_STEP_HZ, _MOST["Frequency"]),
    }


def _whole(name: str, value: int, most: int, least: int = 0) -> int:
    if not least <= value <= most:
        raise ValueError(f"{name} = {value} does not fit its field ({least} to {most})")
    return int(value)


def _steps(name: str, value: float, step: float, most: int) -> int:
    if not math.isfinite(value) or not 0.0 <= value < (most + 1) * step:
        raise ValueError(f"{name} = {value} does not fit its field (0 to {most * step:g})")
    return math.floor(value / step)


def _pack(message: DbcMessage, **raw: int) -> Frame:
    """The protected frame of these field values; ``Reserved`` is 0."""
    for name, value in raw.items():
        _whole(_NAMES.get(name, name.lower()), value, _MOST[name])
    raw |= {"Crc": 0, "Reserved": 0}
    identifier = message.frame_id
    return identifier, e2e.protect(identifier, message.encode(raw, scaling=False, strict=False))


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
