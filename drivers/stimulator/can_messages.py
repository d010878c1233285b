"""The values that the CAN stimulator's five frames carry; no bytes here (those: ``can_codec``)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Final, TypeAlias

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
