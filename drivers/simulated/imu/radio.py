"""The radio between a simulated sensor and its host: time and commands in, notifications out; no I/O, no clock.

Faults, beside the sensor's and the line's: ``interval`` (s between moments), ``fails`` (share of them), ``away`` (s
from now), ``lose`` (notifications).

A connection has a moment every so often (7.5 to 50 ms), at which what waits in the sensor's buffer is sent, four
notifications of 244 bytes at most. A moment that fails costs nothing but time: the link sends again, first in, first
out. What the host's own system loses is gone: whole notifications, with the packages whose bytes they held.
"""

import math
import random
from dataclasses import dataclass, field
from typing import Final

from drivers.simulated.imu.device import SimulatedImu
from drivers.simulated.lines import Device
from fes.signals import NS_PER_S

LONGEST: Final = 244  # bytes of a notification, the first of which counts its real-time packages
AT_ONCE: Final = 4  # notifications at one moment of the connection
NO_REAL_TIME: Final = b"\xff"


@dataclass
class Radio(Device):
    """One connection; its moments are ``interval_s`` apart, and a share ``fails`` of them fails.

    ``away_until_ns``: until then all fail (a burst, a body in between). ``lose``: so many of the next notifications the
    host's system loses. ``framed``: each after its length in two bytes, for a line. ``whole``: each message is a
    notification as it is, or a Capture2Go's stream is cut into such.
    """

    imu: SimulatedImu
    t_ns: int
    interval_s: float = 0.03
    fails: float = 0.0
    seed: int = 1
    away_until_ns: int = 0
    lose: int = 0
    framed: bool = False
    whole: bool = False
    _waiting: list[bytes] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._chance = random.Random(self.seed)

    def receive(self, t_ns: int, data: bytes) -> list[bytes]:
        """A command; its answer waits its turn."""
        self._waiting += self.imu.receive(t_ns, data)
        return []

    def set_fault(self, t_ns: int, name: str, value: float) -> list[bytes]:
        """One of its own, or the sensor's, whose loss of power empties the buffer."""
        match name:
            case "interval":
                self.interval_s = value
            case "fails":
                self.fails = value
            case "away":
                self.away_until_ns = t_ns + round(value * NS_PER_S)
            case "lose":
                self.lose = round(value)
            case _:
                if name == "reboot":
                    self._waiting.clear()
                self._waiting += self.imu.set_fault(t_ns, name, value)
        return []

    def next_deadline_ns(self) -> int:
        """The next moment, or sample."""
        return min(self.next_moment_ns(), self.imu.next_deadline_ns())

    def next_moment_ns(self) -> int:
        """When something may be sent next."""
        return self.t_ns + math.ceil(self.interval_s * NS_PER_S)

    def advance(self, t_ns: int) -> list[bytes]:
        """The notifications that have reached the host's program by ``t_ns``, in order."""
        out: list[bytes] = []
        while self.next_moment_ns() <= t_ns:
            self.t_ns = self.next_moment_ns()
            self._waiting += self.imu.advance(self.t_ns)
            if self.t_ns < self.away_until_ns or self._chance.random() < self.fails:
                continue
            for _ in range(AT_ONCE):
                if not self._waiting:
                    break
                sent = self._next()
                if self.lose:
                    self.lose -= 1
                else:
                    out.append(len(sent).to_bytes(2, "little") + sent if self.framed else sent)
        self._waiting += self.imu.advance(t_ns)
        return out

    def _next(self) -> bytes:
        if self.whole:
            return self._waiting.pop(0)
        stream = b"".join(self._waiting)
        self._waiting = [stream[LONGEST - 1 :]] if len(stream) >= LONGEST else []
        return NO_REAL_TIME + stream[: LONGEST - 1]
