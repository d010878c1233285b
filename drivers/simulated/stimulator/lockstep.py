"""A simulated stimulator whose clock is the replay's: many times faster than real time, with the same result.

The replay tells the simulated node what time it is with a frame of its own (``SIM_TIME``, only ever on a virtual bus)
before each command, and waits for the answer. The node lets pulses, leases and heartbeats fall due up to that time
exactly as it would have in real time. Real hardware does not know the frame, and is never driven in this way.
"""

from __future__ import annotations

import select
import time
from typing import Final

import can

from drivers.simulated.stimulator.node_clock import SIM_TIME_ID, encode_sim_time
from drivers.stimulator.can_port import CanStimulator
from drivers.stimulator.port import StimulatorLost
from fes.signals import NS_PER_S, StimAlive, StimCommand, StimStatus, WireFrame

ANSWER_WITHIN_NS: Final = 5 * NS_PER_S


class LockstepStimulator(CanStimulator):
    """:class:`CanStimulator` to a node started with ``--clock bus``; :meth:`poll` waits for the answers."""

    def __init__(self, bus: can.BusABC, session_id: int) -> None:
        super().__init__(bus, session_id)
        self._bus_of_time = bus

    def send(self, command: StimCommand) -> WireFrame:
        """Tell the time, then the command."""
        self.tell(command.t_ns)
        return super().send(command)

    def tell(self, t_ns: int) -> None:
        """Advance the node to ``t_ns``."""
        message = can.Message(arbitration_id=SIM_TIME_ID, data=encode_sim_time(t_ns), is_extended_id=False)
        try:
            self._bus_of_time.send(message, timeout=0)
        except (can.CanError, OSError) as error:
            raise StimulatorLost(f"the virtual bus did not take the time: {error}") from error

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """All answers to what was sent; waits for the last of them.

        Raises:
            StimulatorLost: the node did not answer within five seconds of real time.
        """
        replies = super().poll(t_ns)
        give_up_ns = time.monotonic_ns() + ANSWER_WITHIN_NS
        while self.outstanding:
            if time.monotonic_ns() > give_up_ns:
                raise StimulatorLost("the simulated stimulator does not answer; has its process ended?")
            select.select([self._bus_of_time.fileno()], [], [], 0.01)
            replies += super().poll(t_ns)
        return replies
