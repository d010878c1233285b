"""What the dashboard's process knows of the session: the newest of everything, handed on since a number."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final

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
        kept = {"sent": LEVELS, "answered": LEVELS, "phases": PHASES, "strides": STRIDES, "notes": NOTES}
        self._rings: dict[str, deque[tuple[int, Any]]] = {name: deque(maxlen=most) for name, most in kept.items()}

    def status(self, status: Status, heard_ns: int) -> None:
        """The newest status, and when it came."""
        if self.origin_ns is None:
            self.origin_ns = status.t_ns
        self.newest = status
        self.heard_ns = heard_ns

    def detail(self, happened: Mapping[str, Sequence[Any]]) -> None:
        """What has happened; see :func:`fes.live.dashboard.frames.read_detail`."""
        self.number += 1
        for name, values in happened.items():
            if name == "strides":
                shown = [stride | {"t_ms": self._ms(stride.pop("t_end_ns"))} for stride in values]
            else:
                shown = [[self._ms(t_ns), *rest] for t_ns, *rest in values]
            self._rings[name].extend((self.number, value) for value in shown)

    def end(self, why: str) -> None:
        """The session is over."""
        self.ended = self.ended or why

    def since(self, number: int, now_ns: int) -> dict[str, Any]:
        """A frame: all that came after ``number``, and the newest status with its age."""
        frame: dict[str, Any] = {
            name: fresh
            for name, ring in self._rings.items()
            if (fresh := [value for number_of, value in ring if number_of > number])
        }
        if self.newest is not None and self.heard_ns is not None:
            frame["status"] = self.newest.plain() | {"t_ms": self._ms(self.newest.t_ns)}
            frame["age_ms"] = round((now_ns - self.heard_ns) / NS_PER_MS)
        if self.ended:
            frame["ended"] = self.ended
        return frame

    def _ms(self, t_ns: int) -> float:
        return round((t_ns - (self.origin_ns or 0)) / NS_PER_MS, 1)
