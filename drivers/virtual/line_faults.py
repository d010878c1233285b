"""What can go wrong between a simulated device and its host, on command: the bytes, not the device.

``garble`` / ``drop`` / ``reorder``: so many of the next messages have a bit flipped, are lost, or change places with
the one after. ``delay``: every message comes so many seconds late. ``mute``: 1, none comes at all; 0, all again.
"""

from __future__ import annotations

import heapq
from typing import Final

from drivers.virtual.output_channel import NEVER
from fes.signals import NS_PER_S

LINE_FAULTS: Final = frozenset(("garble", "drop", "reorder", "delay", "mute"))


class LineFaults:
    """Messages in, the bytes that come out at the other end; no I/O, no clock."""

    def __init__(self) -> None:
        self._values = dict.fromkeys(LINE_FAULTS, 0.0)
        self._waiting: list[tuple[int, int, bytes]] = []
        self._held = b""
        self._order = 0

    def set(self, name: str, value: float) -> None:
        """Bring a fault about, or with 0 end it.

        Raises:
            ValueError: no such fault, or a value below 0.
        """
        if name not in LINE_FAULTS or not value >= 0:
            raise ValueError(
                f"fault {name!r} = {value!r} is not known; one of {', '.join(sorted(LINE_FAULTS))}, 0 or more"
            )
        self._values[name] = value

    def send(self, t_ns: int, messages: list[bytes]) -> None:
        """The device sends these."""
        for message in messages:
            if self._values["mute"]:
                continue
            if self._take("drop"):
                continue
            if self._take("garble"):
                flipped = bytearray(message)
                flipped[len(flipped) // 2] ^= 0x10
                message = bytes(flipped)
            if not self._held and self._take("reorder"):
                self._held = message
                continue
            self._push(t_ns, message)
            if self._held:
                self._push(t_ns, self._held)
                self._held = b""

    def due(self, t_ns: int) -> bytes:
        """What has got through by now."""
        out = b""
        while self._waiting and self._waiting[0][0] <= t_ns:
            out += heapq.heappop(self._waiting)[2]
        return out

    def next_deadline_ns(self) -> int:
        """When :meth:`due` has something next."""
        return self._waiting[0][0] if self._waiting else NEVER

    def _push(self, t_ns: int, message: bytes) -> None:
        self._order += 1
        heapq.heappush(self._waiting, (t_ns + int(self._values["delay"] * NS_PER_S), self._order, message))

    def _take(self, name: str) -> bool:
        if self._values[name] < 1:
            return False
        self._values[name] -= 1
        return True


def parse_line_faults(text: str) -> list[tuple[str, float]]:
    """``"electrode=2,delay=0.2"`` → names and values; "" → none.

    Raises:
        ValueError: not of that form.
    """
    faults: list[tuple[str, float]] = []
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = item.partition("=")
        try:
            faults.append((name, float(value)))
        except ValueError:
            raise ValueError(f"fault {item!r}: write NAME=NUMBER") from None
        if not equals:
            raise ValueError(f"fault {item!r}: write NAME=NUMBER")
    return faults
