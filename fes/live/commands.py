"""The states of a live session, what leads from one to another, and what an operator can command. No clock, no I/O.

*off*: nothing is decided yet. *shadow*: phases, strides and bursts are decided, none is delivered. *armed*: current is
allowed. *running*: a foot is judged to walk, so steps start bursts. *paused*: off by choice, one key from armed.
*stopped* (a person's emergency stop) and *fault* are latched: only a person's arming leads out of them.
"""

import json
import re
import unicodedata
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple


class State(StrEnum):
    """Where a session stands."""

    OFF = "off"
    SHADOW = "shadow"
    ARMED = "armed"
    RUNNING = "running"
    PAUSED = "paused"
    STOPPED = "stopped"
    FAULT = "fault"


class Cause(StrEnum):
    """What can move a session on."""

    READY = "calibrated and warm"
    ARM = "armed by hand"
    WALK = "walking"
    STAND = "not walking"
    PAUSE = "paused by hand"
    DISARM = "disarmed by hand"
    STOP = "emergency stop"
    FAULT = "fault"
    QUIT = "ended"


class Row(NamedTuple):
    """One transition."""

    source: State
    cause: Cause
    destination: State


TABLE: tuple[Row, ...] = (
    Row(State.OFF, Cause.READY, State.SHADOW),
    Row(State.SHADOW, Cause.ARM, State.ARMED),
    Row(State.ARMED, Cause.WALK, State.RUNNING),
    Row(State.RUNNING, Cause.STAND, State.ARMED),
    Row(State.ARMED, Cause.PAUSE, State.PAUSED),
    Row(State.RUNNING, Cause.PAUSE, State.PAUSED),
    Row(State.PAUSED, Cause.ARM, State.ARMED),
    Row(State.STOPPED, Cause.ARM, State.ARMED),
    Row(State.FAULT, Cause.ARM, State.ARMED),
    *(Row(state, Cause.DISARM, State.SHADOW) for state in (State.ARMED, State.RUNNING, State.PAUSED)),
    *(Row(state, Cause.STOP, State.STOPPED) for state in State if state is not State.STOPPED),
    *(Row(state, Cause.FAULT, State.FAULT) for state in State if state not in (State.STOPPED, State.FAULT)),
    *(Row(state, Cause.QUIT, State.OFF) for state in State if state is not State.OFF),
)
CURRENT_ALLOWED = frozenset((State.ARMED, State.RUNNING))

_NEXT = {(row.source, row.cause): row.destination for row in TABLE}


class SessionMachine:
    """Follows the table; a cause that has no row where the session stands changes nothing."""

    def __init__(self) -> None:
        self.state = State.OFF

    def may(self, cause: Cause) -> bool:
        """Whether the cause leads anywhere from here."""
        return (self.state, cause) in _NEXT

    def move(self, cause: Cause) -> bool:
        """Follow the cause; returns whether it led anywhere."""
        if not self.may(cause):
            return False
        self.state = _NEXT[self.state, cause]
        return True


class CommandKind(StrEnum):
    """What to do; what it means depends on the session's state."""

    STOP = "stop"
    ARM = "arm"
    DISARM = "disarm"
    PAUSE = "pause"  # and again: resume
    UP = "up"
    DOWN = "down"
    TEST = "test"
    TRIGGER = "trigger"
    CHANNEL = "channel"  # which one TEST, TRIGGER, ACCEPT_SUGGESTION and ROLL_BACK are for
    BELT = "belt"  # set to ``value`` m/s
    BELT_UP = "belt_up"
    BELT_DOWN = "belt_down"
    GROUND = "ground"  # an incline of ``value`` percent, uphill positive
    GROUND_FREE = "ground_free"  # stairs, ramps both ways
    QUIT = "quit"
    FREEZE_TUNING = "freeze_tuning"
    RESUME_TUNING = "resume_tuning"
    ACCEPT_SUGGESTION = "accept_suggestion"  # of the chosen channel
    ROLL_BACK = "roll_back"  # the chosen channel to the session's own settings
    MARK = "mark"  # its ``text`` into the log, and no more


@dataclass(frozen=True, slots=True)
class OperatorCommand:
    """One command with its ``value``, where it came from, for people, and a mark's ``text`` ("": its number)."""

    kind: CommandKind
    value: float = 0.0
    origin: str = "key"
    text: str = ""


KEYS: Final = {
    key: CommandKind(name)
    for keys, name in (
        (" ", "stop"), ("a", "arm"), ("d", "disarm"), ("p", "pause"), ("+=", "up"), ("-", "down"), ("b", "test"),
        ("t", "trigger"), (">", "belt_up"), ("<", "belt_down"), ("q", "quit"), ("f", "freeze_tuning"),
        ("g", "resume_tuning"), ("y", "accept_suggestion"), ("r", "roll_back"),
        ("m", "mark"),
    )
    for key in keys
}  # fmt: skip
ESCAPE: Final = re.compile(rb"[\x1b\x8f\x9b]")  # what an arrow, an F key, the keypad, Alt with a letter begins with
NEEDS_CONFIRMATION: Final = frozenset(  # all that can lead to more current
    CommandKind(kind) for kind in ("arm", "up", "test", "trigger", "resume_tuning", "accept_suggestion", "roll_back")
)
CONTROL: Final = "control"  # the origin of what comes through the control socket
LONGEST_MESSAGE: Final = 1024
LARGEST_VALUE: Final = 1e9
LONGEST_MARK: Final = 80  # characters: a line of the report's list, and of a terminal
FORMULA: Final = "=+-@"  # what a spreadsheet that opens the table would compute


class CommandRefused(ValueError):
    """The message is no command; the text says why."""


def commands_of_keys(typed: bytes) -> list[OperatorCommand]:
    """The commands in what was typed; a stop among them comes first. Keys that mean nothing are passed over.

    Behind an escape only a stop counts: what a terminal sends for a key that is no letter may end in a letter.
    """
    commands: list[OperatorCommand] = []
    escape = ESCAPE.search(typed)
    end = escape.start() if escape else len(typed)
    for key in typed[:end].decode("latin-1") + " " * (b" " in typed[end:]):
        if key.isdecimal() and key <= "7":
            commands.append(OperatorCommand(CommandKind.CHANNEL, float(key)))
        elif key in KEYS:
            commands.append(OperatorCommand(KEYS[key]))
    return sorted(commands, key=lambda command: command.kind is not CommandKind.STOP)


def mark_text(said: object) -> str:
    """A mark's text on one line: without control characters, marks of direction and what is no character.

    CommandRefused: it is no text, too long, or begins like a formula.
    """
    if not isinstance(said, str):
        raise CommandRefused("a mark's text must be a text")
    if len(said) > LONGEST_MARK:
        raise CommandRefused(f"a mark has at most {LONGEST_MARK} characters")
    text = " ".join("".join(" " if unicodedata.category(each)[0] == "C" else each for each in said).split())
    if text.startswith(tuple(FORMULA)):
        raise CommandRefused(
            f"a mark does not begin with any of {' '.join(FORMULA)}: a spreadsheet takes that for a formula"
        )
    return text


def command_of_message(message: bytes) -> OperatorCommand:
    """The command in a control message ``{"ask": "up", "value": 0, "confirm": true}``; a mark has a ``text``.

    CommandRefused: it is none, or one that needs ``"confirm": true`` and has it not.
    """
    if len(message) > LONGEST_MESSAGE:
        raise CommandRefused(f"a command has at most {LONGEST_MESSAGE} bytes")
    try:
        data = json.loads(message)
    except (ValueError, RecursionError) as error:
        raise CommandRefused(f"not JSON: {error}") from error
    if not isinstance(data, dict) or data.get("ask") not in list(CommandKind):
        raise CommandRefused(f'a command is {{"ask": …}} with one of {", ".join(CommandKind)}')
    kind, value = CommandKind(data["ask"]), data.get("value", 0.0)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST_VALUE:
        raise CommandRefused(f"value must be a number of at most {LARGEST_VALUE:.0e}")
    if kind in NEEDS_CONFIRMATION and data.get("confirm") is not True:
        raise CommandRefused(f'{kind} can lead to more current and needs "confirm": true')
    text = mark_text(data.get("text", "")) if kind is CommandKind.MARK else ""
    return OperatorCommand(kind, float(value), CONTROL, text)
