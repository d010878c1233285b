"""A foot's sensor before the witness while its owner walks: its newest strides, again after each one. No clock, no I/O.

Who asks often is wrong more often: what lies is told when :data:`IN_A_ROW` hearings agree on it, and taken back when as
many say without a doubt that it does not.
"""

from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from fes.recording.tracks import Track
from fes.signals import NS_PER_S, FloatArray, IntArray
from fes.witness.estimate import FEWEST
from fes.witness.verdict import examine

KEPT_NS: Final = 120 * NS_PER_S  # of samples: as many strides as an estimate is made from, of a slow walker
HEARD: Final = 2 * FEWEST  # strides: what begins in the middle of them is told from what always was
IN_A_ROW: Final = 5  # hearings: single ones err (docs/witness.md)


class Hearing:
    """One foot's sensor; ``lies`` is what it surely says wrongly, ``unknown`` why it cannot be told, "" if it can."""

    def __init__(self, sensor: str, rate_hz: float) -> None:
        self.sensor, self.lies, self.unknown = sensor, "", _too_few(0)
        self._rate_hz = rate_hz
        self._t_ns: IntArray = np.empty(0, np.int64)
        self._values: FloatArray = np.empty((0, 6))
        self._strides: deque[tuple[int, int]] = deque(maxlen=HEARD)
        self._heard: deque[tuple[str, ...] | None] = deque(maxlen=IN_A_ROW)  # kinds of lies; None: not known
        self._told: tuple[str, ...] = ()
        self._is_new = False

    def add(self, t_ns: IntArray, values: FloatArray, strides: Sequence[tuple[int, int]]) -> None:
        """Samples by the sensor's own stamps (N,), force and rate (N, 6), and begin and end of strides in them."""
        self._t_ns, self._values = np.concatenate((self._t_ns, t_ns)), np.concatenate((self._values, values))
        if t_ns.size:
            kept = self._t_ns > t_ns[-1] - KEPT_NS
            self._t_ns, self._values = self._t_ns[kept], self._values[kept]
        self._strides.extend(strides)
        self._is_new |= bool(strides)

    def hear(self) -> bool:
        """Examine what is there; whether ``lies`` or ``unknown`` says something else now."""
        if not self._is_new:
            return False
        self._is_new = False
        before = self.lies, self.unknown
        borders = np.array([each for each in self._strides if each[0] >= self._t_ns[0]], np.int64).reshape(-1, 2)
        if len(borders) < FEWEST:
            self.unknown = _too_few(len(borders))
            return before != (self.lies, self.unknown)
        track = Track(self.sensor, self._rate_hz, self._t_ns, self._t_ns, self._values[:, :3], self._values[:, 3:])
        told = examine(track, borders[:, 0], borders[:, 1])
        kinds = tuple(lie.kind for lie in told.lies)
        self._heard.append(None if told.silent else kinds)
        if kinds != self._told and list(self._heard) == [kinds] * IN_A_ROW:
            self._told, self.lies = kinds, " and ".join(lie.describe() for lie in told.lies)
        self.unknown = "" if self.lies else told.silent
        return before != (self.lies, self.unknown)


def _too_few(strides: int) -> str:
    return f"{strides} of {FEWEST} strides"
