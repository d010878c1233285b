"""What the page's process knows of the session: the newest of everything, in rings, handed on since a number. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final

from fes.live.dashboard.frames import Detail
from fes.live.status import Status

LEVELS: Final = 4096  # ten seconds of eight channels at 50 Hz
STRIDES: Final = 80
PHASES: Final = 256
NOTES: Final = 60
NS_PER_MS: Final = 1e6


class StateBuffer:
    """Fill it with :meth:`status` and :meth:`detail`; :meth:`since` is what one browser has not seen yet.

    Times go out as ms since ``origin_ns``, the first status's.
    """

    def __init__(self) -> None:
        self.newest: Status | None = None
        self.heard_ns: int | None = None
        self.ended = ""
        self.origin_ns: int | None = None
        self.number = 0
        self._rings: dict[str, deque[tuple[int, Any]]] = {
            "sent": deque(maxlen=LEVELS),
            "answered": deque(maxlen=LEVELS),
            "phases": deque(maxlen=PHASES),
            "strides": deque(maxlen=STRIDES),
            "notes": deque(maxlen=NOTES),
        }

    def status(self, status: Status, heard_ns: int) -> None:
        """The newest status, and when it came."""
        if self.origin_ns is None:
            self.origin_ns = status.t_ns
        self.newest = status
        self.heard_ns = heard_ns

    def detail(self, detail: Detail) -> None:
        """What has happened."""
        self.number += 1
        for name in ("sent", "answered", "phases", "notes"):
            self._keep(name, [[self._ms(t_ns), *rest] for t_ns, *rest in getattr(detail, name)])
        for stride in detail.strides:
            shown = asdict(stride)
            shown["t_ms"] = self._ms(shown.pop("t_end_ns"))
            self._keep("strides", [shown])

    def end(self, why: str) -> None:
        """The session is over."""
        self.ended = self.ended or why

    def since(self, number: int, now_ns: int) -> dict[str, Any]:
        """A frame: all that came after ``number``, and the newest status with its age."""
        found: dict[str, Any] = {
            name: fresh for name, ring in self._rings.items() if (fresh := [value for at, value in ring if at > number])
        }
        if self.newest is not None and self.heard_ns is not None:
            found["status"] = self.newest.plain() | {"t_ms": self._ms(self.newest.t_ns)}
            found["age_ms"] = round((now_ns - self.heard_ns) / NS_PER_MS)
        if self.ended:
            found["ended"] = self.ended
        return found

    def _keep(self, name: str, values: Sequence[Any]) -> None:
        self._rings[name].extend((self.number, value) for value in values)

    def _ms(self, t_ns: int) -> float:
        return round((t_ns - (self.origin_ns or 0)) / NS_PER_MS, 1)
