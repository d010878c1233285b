"""What time it is for the simulated stimulator: its computer's, or, in lockstep, what a replay tells it.

In lockstep a frame of its own, ``SIM_TIME``, carries the replay's time in ns (8 bytes, signed, most significant
first). It is only ever sent on virtual buses; no real device knows it.
"""

from __future__ import annotations

import struct
import time
from typing import Final, Protocol

from fes.signals import NS_PER_S

SIM_TIME_ID: Final = 0x7F0
FALL_BACK_NS: Final = 2 * NS_PER_S  # a node that is told no time for this long goes on by the computer's clock
POLL_S: Final = 0.05
_TIME = struct.Struct(">q")


def encode_sim_time(t_ns: int) -> bytes:
    """Payload of a ``SIM_TIME`` frame."""
    return _TIME.pack(t_ns)


class NodeClock(Protocol):
    """The node's time, never running backward."""

    def now_ns(self) -> int:
        """Time in ns."""

    def wait_s(self, deadline_ns: int) -> float:
        """How long the node may sleep before it must look again."""

    def told(self, data: bytes) -> None:
        """A ``SIM_TIME`` frame came."""


class RealClock:
    """The computer's monotonic clock; nobody tells it the time."""

    def now_ns(self) -> int:
        """Monotonic time in ns."""
        return time.monotonic_ns()

    def wait_s(self, deadline_ns: int) -> float:
        """Until the deadline."""
        return max(0.0, (deadline_ns - time.monotonic_ns()) / NS_PER_S)

    def told(self, data: bytes) -> None:
        """Not listened to."""


class BusClock:
    """Real until the first ``SIM_TIME``, then as told, and real again when told no more."""

    def __init__(self) -> None:
        self._now_ns = time.monotonic_ns()
        self._looked_ns = self._now_ns  # real time at which _now_ns was right
        self._offset_ns: int | None = None

    def now_ns(self) -> int:
        """Time as the node should see it, in ns."""
        real_ns = time.monotonic_ns()
        if self._offset_ns is not None and real_ns - self._looked_ns > FALL_BACK_NS:
            self._offset_ns = None
            self._looked_ns = real_ns
        if self._offset_ns is None:
            self._now_ns += real_ns - self._looked_ns
            self._looked_ns = real_ns
        return self._now_ns

    def wait_s(self, deadline_ns: int) -> float:
        """Until the deadline while time is real; else until a frame comes, looking up now and then."""
        if self._offset_ns is not None:
            return POLL_S
        return max(0.0, (deadline_ns - self.now_ns()) / NS_PER_S)

    def told(self, data: bytes) -> None:
        """Advance to the time in the frame; the first one only says where the replay's time begins."""
        if len(data) != _TIME.size:
            return
        t_ns: int = _TIME.unpack(data)[0]
        now_ns = self.now_ns()
        if self._offset_ns is None:
            self._offset_ns = now_ns - t_ns
        self._now_ns = max(now_ns, t_ns + self._offset_ns)
        self._looked_ns = time.monotonic_ns()
