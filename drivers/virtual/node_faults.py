"""What a simulated stimulator can be told to do wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

_KINDS: Final[dict[str, Callable[[str], float]]] = {
    "electrode": int,
    "weak": int,
    "drop": int,
    "reboot": float,
    "mute": float,
}


@dataclass(frozen=True, slots=True)
class NodeFaults:
    """Faults by name; a value below 0 (or 0 for ``drop``) means that the node is sound.

    ``electrode``: this channel's output stage refuses every on command. ``weak``: this channel delivers half of the
    current. ``drop``: every so-manieth STIM_STATUS is lost. ``reboot`` / ``mute``: so many seconds after its start
    the node restarts with another boot id / sends nothing any more.
    """

    electrode: int = -1
    weak: int = -1
    drop: int = 0
    reboot: float = -1.0
    mute: float = -1.0


def parse_faults(text: str) -> NodeFaults:
    """``"electrode=2,reboot=1.5"`` → faults; "" → none.

    Raises:
        ValueError: an unknown name or a value that is no number.
    """
    values: dict[str, float] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = item.partition("=")
        if name not in _KINDS or not equals:
            raise ValueError(f"fault {item!r} is not known; write NAME=NUMBER with one of: {', '.join(_KINDS)}")
        try:
            values[name] = _KINDS[name](value)
        except ValueError:
            raise ValueError(f"fault {item!r}: {value!r} is not a number as {name} needs it") from None
    return NodeFaults(
        electrode=int(values.get("electrode", -1)),
        weak=int(values.get("weak", -1)),
        drop=int(values.get("drop", 0)),
        reboot=values.get("reboot", -1.0),
        mute=values.get("mute", -1.0),
    )
