"""What an operator can order, from the keyboard or over the control socket, as plain values."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final


class Ask(StrEnum):
    """One thing to do; what it means depends on the session's state."""

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
    QUIT = "quit"
    FREEZE_TUNING = "freeze_tuning"
    RESUME_TUNING = "resume_tuning"
    ACCEPT_SUGGESTION = "accept_suggestion"  # of the chosen channel
    ROLL_BACK = "roll_back"  # the chosen channel to the session's own settings


@dataclass(frozen=True, slots=True)
class Order:
    """An ask with its ``value`` and where it came from, in words."""

    ask: Ask
    value: float = 0.0
    origin: str = "key"


KEYS: Final = {
    " ": Ask.STOP,
    "a": Ask.ARM,
    "d": Ask.DISARM,
    "p": Ask.PAUSE,
    "+": Ask.UP,
    "=": Ask.UP,
    "-": Ask.DOWN,
    "b": Ask.TEST,
    "t": Ask.TRIGGER,
    ">": Ask.BELT_UP,
    "<": Ask.BELT_DOWN,
    "q": Ask.QUIT,
    "f": Ask.FREEZE_TUNING,
    "g": Ask.RESUME_TUNING,
    "y": Ask.ACCEPT_SUGGESTION,
    "r": Ask.ROLL_BACK,
}
ESCAPE: Final = re.compile(rb"[\x1b\x8f\x9b]")  # what an arrow, an F key, the keypad, Alt with a letter begins with
NEEDS_CONFIRMATION: Final = frozenset(  # all that can lead to more current
    (Ask.ARM, Ask.UP, Ask.TEST, Ask.TRIGGER, Ask.RESUME_TUNING, Ask.ACCEPT_SUGGESTION, Ask.ROLL_BACK)
)
CONTROL: Final = "control"  # the origin of what comes through the control socket
LONGEST_ORDER: Final = 1024
LARGEST_VALUE: Final = 1e9


class OrderRefused(ValueError):
    """The message is no order; the text says why."""


def orders_of_keys(typed: bytes) -> list[Order]:
    """The orders in what was typed; a stop among them comes first. Keys that mean nothing are passed over.

    Behind an escape only a stop counts: what a terminal sends for a key that is no letter ends in letters that are
    orders.
    """
    orders: list[Order] = []
    escape = ESCAPE.search(typed)
    end = escape.start() if escape else len(typed)
    for key in typed[:end].decode("latin-1") + " " * (b" " in typed[end:]):
        if key.isdecimal() and key <= "7":
            orders.append(Order(Ask.CHANNEL, float(key)))
        elif key in KEYS:
            orders.append(Order(KEYS[key]))
    return sorted(orders, key=lambda order: order.ask is not Ask.STOP)


def order_of_message(message: bytes) -> Order:
    """The order in a control message ``{"ask": "up", "value": 0, "confirm": true}``.

    Raises:
        OrderRefused: it is none, or one that needs ``"confirm": true`` and has it not.
    """
    if len(message) > LONGEST_ORDER:
        raise OrderRefused(f"an order has at most {LONGEST_ORDER} bytes")
    try:
        data = json.loads(message)
    except (ValueError, RecursionError) as error:
        raise OrderRefused(f"not JSON: {error}") from error
    if not isinstance(data, dict) or data.get("ask") not in list(Ask):
        raise OrderRefused(f'an order is {{"ask": …}} with one of {", ".join(Ask)}')
    ask, value = Ask(data["ask"]), data.get("value", 0.0)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST_VALUE:
        raise OrderRefused(f"value must be a number of at most {LARGEST_VALUE:.0e}")
    if ask in NEEDS_CONFIRMATION and data.get("confirm") is not True:
        raise OrderRefused(f'{ask} can lead to more current and needs "confirm": true')
    return Order(ask, float(value), CONTROL)
