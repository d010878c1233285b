"""What goes between a session and its dashboard's process over a socket pair: the first byte says what it is.

To the dashboard: who is there (HELLO, once), the status that the terminal view gets too (STATUS, ten times a second),
what has happened since (DETAIL, with each status), and that it is over (END). To the session: commands, as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from math import isfinite
from typing import Any, Final

import msgpack
import numpy as np

from fes.signals import StrideResult

HELLO: Final = b"H"
STATUS: Final = b"S"
DETAIL: Final = b"D"
END: Final = b"E"
LARGEST: Final = 1 << 18
POINTS: Final = 48  # of a stride's path: more cannot be told apart on a screen
NAMES: Final = ("sent", "answered", "phases", "strides", "notes")


def hello(about: dict[str, Any]) -> bytes:
    """The first message: plain data."""
    return HELLO + json.dumps(about).encode()


def detail(happened: Mapping[str, Iterable[Any]]) -> bytes:
    """The message of what has happened since the last one, by name.

    ``sent`` is what the gate let out, ``answered`` what the stimulator says it delivers: (ns, channel, mA; 0: off).
    ``phases`` are (ns, foot, phase), ``notes`` (ns, severity, text), ``strides`` :class:`fes.signals.StrideResult`.
    """
    plain = [list(happened[name]) for name in NAMES]
    plain[NAMES.index("strides")] = [_shown(stride) for stride in happened["strides"]]
    packed: bytes = msgpack.packb(plain)
    return DETAIL + packed


def read_hello(message: bytes) -> dict[str, Any]:
    """Back from the message.

    Raises:
        ValueError: it is none.
    """
    if message[:1] != HELLO:
        raise ValueError("the first message must be the session's")
    about: dict[str, Any] = json.loads(message[1:])
    return about


def read_detail(message: bytes) -> dict[str, list[Any]]:
    """Back from the message: lists by name; strides as dicts, None for NaN, their path x forward and z up in turn (m).

    Raises:
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
    return {
        "foot": stride.foot,
        "number": stride.number,
        "t_end_ns": stride.t_end_ns,
        "length_m": stride.stride_length_m,
        "clearance_m": stride.clearance_m,
        "toe_clearance_m": stride.toe_clearance_m,
        "speed_mps": stride.speed_mps,
        "valid": stride.valid,
        "reason": stride.reason,
        "path_m": path.tobytes() if np.isfinite(path).all() else b"",
    }
