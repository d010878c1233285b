"""What goes between a session and its dashboard's process over a socket pair: the first byte says what it is.

To the dashboard: who is there (HELLO, once), the status that the terminal view gets too (STATUS, ten times a second),
what has happened since (DETAIL, with each status), and that it is over (END). To the session: commands, as JSON.
"""

import json
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from math import isfinite
from typing import Any, Final

import msgpack
import numpy as np

from fes.live.status import Status
from fes.signals import StrideResult

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
        rings = {name: [value for n, value in ring if n > number] for name, ring in self._rings.items()}
        frame: dict[str, Any] = {name: fresh for name, fresh in rings.items() if fresh}
        if self.newest is not None and self.heard_ns is not None:
            frame["status"] = self.newest.plain() | {"t_ms": self._ms(self.newest.t_ns)}
            frame["age_ms"] = round((now_ns - self.heard_ns) / NS_PER_MS)
        if self.ended:
            frame["ended"] = self.ended
        return frame

    def _ms(self, t_ns: int) -> float:
        return round((t_ns - (self.origin_ns or 0)) / NS_PER_MS, 1)


HELLO: Final = b"H"
STATUS: Final = b"S"
DETAIL: Final = b"D"
END: Final = b"E"
LARGEST: Final = 1 << 18
POINTS: Final = 48  # of a stride's path: more cannot be told apart on a screen
NAMES: Final = ("sent", "answered", "phases", "strides", "notes")
STRIDE: Final = (
    *("foot", "number", "t_end_ns", "stride_length_m", "clearance_m", "toe_clearance_m", "speed_mps"),
    *("valid", "reason"),
)


def hello(about: dict[str, Any]) -> bytes:
    """The first message: plain data."""
    return HELLO + json.dumps(about).encode()


def detail(happened: Mapping[str, Iterable[Any]]) -> bytes:
    """The message of what has happened since the last one, by name.

    ``sent`` is what the gate let out, ``answered`` what the stimulator says it delivers: (ns, channel, mA; 0: off).
    ``phases`` are (ns, foot, phase), ``notes`` (ns, severity or "mark", text), ``strides``
    :class:`fes.signals.StrideResult`.
    """
    plain = [list(map(_shown, happened[name])) if name == "strides" else list(happened[name]) for name in NAMES]
    return DETAIL + bytes(msgpack.packb(plain))


def read_hello(message: bytes) -> dict[str, Any]:
    """Back from the message. ValueError: it is none."""
    if message[:1] != HELLO:
        raise ValueError("the first message must be the session's")
    return dict(json.loads(message[1:]))


def read_detail(message: bytes) -> dict[str, list[Any]]:
    """Back from the message: lists by name; strides as dicts, None for NaN, their path x forward and z up in turn (m).

    ValueError: it is none.
    """
    try:
        happened = dict(zip(NAMES, msgpack.unpackb(message[1:]), strict=True))
        for stride in happened["strides"]:
            path_m = np.frombuffer(stride["path_m"], "<f4").astype(float)
            missing = [name for name, value in stride.items() if isinstance(value, float) and not isfinite(value)]
            stride |= dict.fromkeys(missing)
            stride["path_m"] = np.round(path_m, 4).tolist()
    except (TypeError, ValueError, AttributeError, KeyError, msgpack.UnpackException) as error:
        raise ValueError(f"no detail: {error}") from error
    return happened


def _shown(stride: StrideResult) -> dict[str, object]:
    """A stride's numbers as they are shown; made in the loop, so its path goes as packed numbers."""
    path = stride.trajectory_m[:: max(len(stride.trajectory_m) // POINTS, 1), ::2].astype("<f4")
    numbers = {name: getattr(stride, name) for name in STRIDE}
    return numbers | {"path_m": path.tobytes() if np.isfinite(path).all() else b""}
