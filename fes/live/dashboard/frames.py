"""What goes between a session and its page's process: whole messages over a socket pair, the first byte says which.

To the page: who is there (HELLO, once), the status that the terminal view gets too (STATUS, ten times a second), what
has happened since (DETAIL, with each status), and that it is over (END). To the session: orders, as JSON.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

import msgpack
import numpy as np

from fes.signals import StrideResult

HELLO: Final = b"H"
STATUS: Final = b"S"
DETAIL: Final = b"D"
END: Final = b"E"
LARGEST: Final = 1 << 18
POINTS: Final = 48  # of a stride's path: more cannot be told apart on a screen

Level: TypeAlias = tuple[int, int, float]
"""Time (ns), channel, current (mA; 0: off)."""


@dataclass(frozen=True, slots=True)
class Stride:
    """A stride as it is shown: the numbers of its result, None for NaN; ``path_m`` is x forward and z up, in turn."""

    foot: str
    number: int
    t_end_ns: int
    length_m: float | None
    clearance_m: float | None
    toe_clearance_m: float | None
    speed_mps: float | None
    valid: bool
    reason: str
    path_m: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Detail:
    """What has happened since the last one.

    ``sent`` is what the gate let out, ``answered`` what the stimulator says it delivers; ``phases`` are (ns, foot,
    phase), ``notes`` (ns, severity, text).
    """

    sent: Sequence[Level] = ()
    answered: Sequence[Level] = ()
    phases: Sequence[tuple[int, str, str]] = ()
    strides: Sequence[Stride] = ()
    notes: Sequence[tuple[int, str, str]] = field(default_factory=tuple)


def hello(about: dict[str, Any]) -> bytes:
    """The first message: plain data."""
    return HELLO + json.dumps(about).encode()


def detail(
    sent: Iterable[Level],
    answered: Iterable[Level],
    phases: Iterable[tuple[int, str, str]],
    strides: Iterable[StrideResult],
    notes: Iterable[tuple[int, str, str]],
) -> bytes:
    """The message; made in the loop, so a stride's path goes as packed numbers."""
    shown = [_of(stride) for stride in strides]
    packed: bytes = msgpack.packb((list(sent), list(answered), list(phases), shown, list(notes)))
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


def read_detail(message: bytes) -> Detail:
    """Back from the message.

    Raises:
        ValueError: it is none.
    """
    try:
        sent, answered, phases, strides, notes = msgpack.unpackb(message[1:])
        return Detail(sent, answered, phases, [_stride(each) for each in strides], notes)
    except (TypeError, ValueError, msgpack.UnpackException) as error:
        raise ValueError(f"no detail: {error}") from error


def _of(stride: StrideResult) -> tuple[object, ...]:
    path = stride.trajectory_m[:: max(len(stride.trajectory_m) // POINTS, 1), ::2].astype("<f4")
    return (
        stride.foot,
        stride.number,
        stride.t_end_ns,
        stride.stride_length_m,
        stride.clearance_m,
        stride.toe_clearance_m,
        stride.speed_mps,
        stride.valid,
        stride.reason,
        path.tobytes() if np.isfinite(path).all() else b"",
    )


def _stride(values: Sequence[Any]) -> Stride:
    foot, number, t_end_ns, *numbers, valid, reason, path = values
    length_m, clearance_m, toe_clearance_m, speed_mps = (
        float(each) if math.isfinite(each) else None for each in numbers
    )
    path_m = tuple(np.round(np.frombuffer(path, "<f4").astype(float), 4).tolist())
    return Stride(foot, number, t_end_ns, length_m, clearance_m, toe_clearance_m, speed_mps, valid, reason, path_m)
