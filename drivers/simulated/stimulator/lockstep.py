"""A simulated stimulator whose clock is the replay's: many times faster than real time, with the same result.

The replay sends the simulated node the time with a frame of its own (``SIM_TIME``: ns in 8 bytes, signed, most
significant first; only ever on a simulated bus) before each command, and waits for the answer. The node lets pulses,
leases and heartbeats fall due up to that time exactly as it would have in real time. Real hardware does not know the
frame, and is never driven in this way.
"""

import select
import struct
import time
from typing import Final

import can

from drivers.stimulator.can_port import CanStimulator
from drivers.stimulator.port import StimulatorLost
from fes.signals import NS_PER_S, StimAlive, StimCommand, StimStatus, WireFrame

SIM_TIME_ID: Final = 0x7F0
FALL_BACK_NS: Final = 2 * NS_PER_S  # a node that is sent no time for this long goes on by the computer's clock
POLL_S: Final = 0.05
ANSWER_WITHIN_NS: Final = 5 * NS_PER_S
_TIME = struct.Struct(">q")


def encode_sim_time(t_ns: int) -> bytes:
    """Payload of a ``SIM_TIME`` frame."""
    return _TIME.pack(t_ns)


class RealClock:
    """The node's time by the computer's monotonic clock; nobody sets it."""

    def now_ns(self) -> int:
        """Time as the node should see it, in ns; it never runs backward."""
        return time.monotonic_ns()

    def wait_s(self, deadline_ns: int) -> float:
        """How long the node may sleep before it must look again."""
        return max(0.0, (deadline_ns - self.now_ns()) / NS_PER_S)

    def set_time(self, data: bytes) -> None:
        """A ``SIM_TIME`` frame came: nothing."""


class BusClock(RealClock):
    """Real until the first ``SIM_TIME``, then as sent, and real again when no more are sent."""

    def __init__(self) -> None:
        self._now_ns = time.monotonic_ns()
        self._read_ns = self._now_ns  # real time at which _now_ns was right
        self._offset_ns: int | None = None

    def now_ns(self) -> int:
        """Time as the node should see it, in ns; it never runs backward."""
        real_ns = time.monotonic_ns()
        if self._offset_ns is not None and real_ns - self._read_ns > FALL_BACK_NS:
            self._offset_ns, self._read_ns = None, real_ns
        if self._offset_ns is None:
            self._now_ns += real_ns - self._read_ns
            self._read_ns = real_ns
        return self._now_ns

    def wait_s(self, deadline_ns: int) -> float:
        """Until the deadline while time is real; else until a frame comes, looking up now and then."""
        return POLL_S if self._offset_ns is not None else super().wait_s(deadline_ns)

    def set_time(self, data: bytes) -> None:
        """Advance to the time in the frame; the first one only says where the replay's time begins."""
        if len(data) != _TIME.size:
            return
        t_ns: int = _TIME.unpack(data)[0]
        now_ns = self.now_ns()
        if self._offset_ns is None:
            self._offset_ns = now_ns - t_ns
        self._now_ns = max(now_ns, t_ns + self._offset_ns)
        self._read_ns = time.monotonic_ns()


class LockstepStimulator(CanStimulator):
    """:class:`CanStimulator` to a node started with ``--clock bus``; :meth:`poll` waits for the answers."""

    def send(self, command: StimCommand) -> WireFrame:
        """Send the time, then the command."""
        self.set_time(command.t_ns)
        return super().send(command)

    def set_time(self, t_ns: int) -> None:
        """Advance the node to ``t_ns``."""
        message = can.Message(arbitration_id=SIM_TIME_ID, data=encode_sim_time(t_ns), is_extended_id=False)
        try:
            self._bus.send(message, timeout=0)
        except (can.CanError, OSError) as error:
            raise StimulatorLost(f"the virtual bus did not take the time: {error}") from error

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """All answers to what was sent; waits for the last of them.

        StimulatorLost: the node did not answer within five seconds of real time.
        """
        replies = super().poll(t_ns)
        give_up_ns = time.monotonic_ns() + ANSWER_WITHIN_NS
        while self.outstanding:
            if time.monotonic_ns() > give_up_ns:
                raise StimulatorLost("the simulated stimulator does not answer; has its process ended?")
            select.select([self._bus.fileno()], [], [], 0.01)
            replies += super().poll(t_ns)
        return replies
