"""A simulated inertial sensor with its own clock: time in, messages out; no I/O.

Faults, besides the line's own (:mod:`drivers.simulated.lines`) and those of its samples
(:mod:`drivers.simulated.imu.faults`): ``reboot`` (now: silent for 0.3 s, then clock and counter from 0), ``drift``
(ppm of its clock from now on), ``jump`` (its clock, by so many seconds, once). ``stand``: its wearer stays within the
first so many seconds of the signal, in which they stand, once they come there; 0: goes on at their end. A sensor that
sends whole numbers, as most do on CAN, has no ``nan`` and no ``inf``: what it cannot measure it sends as the end of its
range, or not at all.

The radio between a simulated sensor and its host: time and commands in, notifications out; no I/O, no clock.

Faults, beside the sensor's and the line's: ``interval`` (s between moments), ``fails`` (share of them), ``away`` (s
from now), ``lose`` (notifications).

A connection has a moment every so often (7.5 to 50 ms), at which what waits in the sensor's buffer is sent, four
notifications of 244 bytes at most. A moment that fails costs nothing but time: the link sends again, first in, first
out. What the host's own system loses is gone: whole notifications, with the packages whose bytes they held.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from drivers.simulated.imu.faults import BOOT_NS, LASTING, SampleFaults
from drivers.simulated.imu.wire import Reading, Wire
from drivers.simulated.lines import Device
from fes.signals import NS_PER_S, FloatArray, Vector3

if TYPE_CHECKING:
    from fes.recording import Track

FAULTS: Final = frozenset((*LASTING, "tap", "reboot", "drift", "jump", "stand"))
NOT_FINITE: Final = ("nan", "inf")


class Signal(Protocol):
    """What a sensor feels: ``rate_hz`` samples a second, ``size`` of them, then again from the first."""

    @property
    def rate_hz(self) -> float:
        """Samples a second."""

    @property
    def size(self) -> int:
        """Samples until it begins again."""

    def sample(self, number: int) -> tuple[Vector3, Vector3]:
        """Specific force in m/s² and rate in rad/s of the ``number``-th sample."""


@dataclass(frozen=True, slots=True)
class ImuSignal:
    """What a sensor feels, played round and round: a recording's track, or a simulated walker's foot.

    Specific force (N, 3) in m/s² and rate (N, 3) in rad/s, ``rate_hz`` samples a second.
    """

    rate_hz: float
    acc_mps2: FloatArray
    gyr_radps: FloatArray

    @property
    def size(self) -> int:
        """N."""
        return len(self.acc_mps2)

    def sample(self, number: int) -> tuple[Vector3, Vector3]:
        """The ``number``-th sample from the start, beginning again at the end."""
        ax, ay, az = self.acc_mps2[number % self.size].tolist()
        gx, gy, gz = self.gyr_radps[number % self.size].tolist()
        return (ax, ay, az), (gx, gy, gz)


def recorded_signal(path: Path, sensor: str, rate_hz: float) -> ImuSignal:
    """A track of a recording, at ``rate_hz``. ValueError: no such track, or the recording cannot be used."""
    from fes.recording import read_recording

    tracks = read_recording(path).tracks
    if sensor not in tracks:
        raise ValueError(f"{path}: has no {sensor}; it has {', '.join(tracks)}")
    return even_signal(tracks[sensor], rate_hz)


def even_signal(track: Track, rate_hz: float) -> ImuSignal:
    """A track at ``rate_hz``, by linear interpolation."""
    t_s = (track.t_sensor_ns - track.t_sensor_ns[0]) * 1e-9
    grid_s = np.arange(int(float(t_s.max()) * rate_hz) + 1) / rate_hz
    order = np.argsort(t_s, kind="stable")
    columns = [np.interp(grid_s, t_s[order], axis[order]) for axis in (*track.acc_mps2.T, *track.gyr_radps.T)]
    return ImuSignal(rate_hz, np.stack(columns[:3], axis=1), np.stack(columns[3:], axis=1))


def walking_signal(sensor: str, rate_hz: float, seed: int = 7) -> ImuSignal:
    """Four seconds of standing, twelve of walking on a treadmill, standing again; the same for the same seed."""
    from fes.simulation.forward import recorded_walk, settings_for

    every = max(round(2000.0 / rate_hz), 2)  # a virtual patient's sensors sample every so many of its own steps
    patient = settings_for("healthy", seed=seed, speed_mps=1.0, sensors=(sensor,), rate_hz=2000.0 / every)
    track = recorded_walk(patient, 12.0, 4.0, "simulated", "simulated").tracks[sensor]
    return even_signal(track, rate_hz)


class SimulatedImu(Device):
    """Call :meth:`advance` at every deadline and :meth:`receive` for bytes from the host; both return messages."""

    def __init__(
        self,
        wire: Wire,
        signal: Signal,
        t_ns: int,
        *,
        offset_s: float = 0.0,
        drift_ppm: float = 0.0,
        acc_range_g: float = 16.0,
        gyr_range_dps: float = 2000.0,
        jumped: Callable[[int, int], None] = lambda t_ns, played: None,
    ) -> None:
        """``jumped`` is called with time and number in the signal of each sample that does not follow on the last."""
        self._wire = wire
        self._signal = signal
        self._faults = SampleFaults(signal.rate_hz, acc_range_g, gyr_range_dps)
        self._stand_s = 0.0
        self._played = 0
        self._jumped = jumped
        self._start(t_ns, int(offset_s * NS_PER_S), drift_ppm)

    def _start(self, t_ns: int, device_ns: int, drift_ppm: float) -> None:
        # the sampling beat is the device's crystal's: its drift changes the interval too
        self._t0_ns, self._device0_ns, self._drift = t_ns, device_ns, drift_ppm * 1e-6
        self._counter = self._beat = 0
        self._follows: int | None = None  # the number in the signal that would be no jump

    def next_deadline_ns(self) -> int:
        """When the next sample is taken."""
        own_ns = self._beat * NS_PER_S / self._signal.rate_hz
        return self._t0_ns + round(own_ns / (1.0 + self._drift))

    def _own_ns(self) -> int:
        return self._device0_ns + round(self._beat * NS_PER_S / self._signal.rate_hz)

    def advance(self, t_ns: int) -> list[bytes]:
        """All samples due by ``t_ns``."""
        out: list[bytes] = []
        while self.next_deadline_ns() <= t_ns:
            own_ns = self._own_ns()
            if self._played != self._follows:
                self._jumped(self.next_deadline_ns(), self._played)
            self._follows = self._played + 1
            twice = self._faults.doubled()
            messages = self._wire.encode(self._reading(own_ns + self._faults.ahead_ns()))
            out += messages + (messages if twice else [])
            self._counter += 1
            self._beat += 1
            played = (self._played + 1) % self._signal.size
            self._played = 0 if played == self._standing_samples else played
        return out

    def receive(self, t_ns: int, data: bytes) -> list[bytes]:
        """Bytes from the host."""
        own_ns = self._device0_ns + round((t_ns - self._t0_ns) * (1.0 + self._drift))
        return self._wire.answer(data, own_ns)

    def set_fault(self, t_ns: int, name: str, value: float) -> list[bytes]:
        """Bring a fault about, or with 0 end it. ValueError: no such fault, or none that this sensor can have."""
        if name in NOT_FINITE and value and not self._wire.carries_nan:
            raise ValueError(
                f"fault {name!r} does not exist here: this sensor sends whole numbers, which have none. What it can do "
                "instead: full (the end of its range) or mute (nothing)"
            )
        if name in self._wire.faults and value >= 0:
            self._wire.set_fault(name, value)
            return []
        if name not in FAULTS or not math.isfinite(value):
            raise ValueError(f"fault {name!r} = {value!r} is not known; one of {', '.join(sorted(FAULTS))}")
        if name == "reboot":
            self._start(t_ns + BOOT_NS, 0, self._drift * 1e6)
            return self._wire.boot()
        if name in ("jump", "drift"):
            own_ns = self._own_ns() + (int(value * NS_PER_S) if name == "jump" else 0)
            counter = self._counter
            self._start(self.next_deadline_ns(), own_ns, value if name == "drift" else self._drift * 1e6)
            self._counter = counter
            return []
        if name == "stand":
            if not value:
                self._played = max(self._played, self._standing_samples) % self._signal.size
            self._stand_s = value
            return []
        self._faults.set(name, value)
        return []

    @property
    def _standing_samples(self) -> int:
        """How many samples of the signal are of standing, by the fault ``stand``."""
        return round(self._stand_s * self._signal.rate_hz)

    def _reading(self, own_ns: int) -> Reading:
        acc, gyr, clipped = self._faults.shown(*self._signal.sample(self._played))
        return Reading(self._counter, own_ns, acc, gyr, clipped, self.next_deadline_ns())


LONGEST: Final = 244  # bytes of a notification, the first of which counts its real-time packages
AT_ONCE: Final = 4  # notifications at one moment of the connection
NO_REAL_TIME: Final = b"\xff"


def record(characteristic: int, value: bytes) -> bytes:
    """A value of a characteristic on a line: both numbers have two bytes, the least significant first."""
    return struct.pack("<HH", characteristic, len(value)) + value


def records(data: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """The records that are complete, characteristic and value, and what is left."""
    found = []
    while len(data) >= 4 and len(data) >= (end := 4 + int.from_bytes(data[2:4], "little")):
        found.append((int.from_bytes(data[:2], "little"), data[4:end]))
        data = data[end:]
    return found, data


@dataclass
class Radio(Device):
    """One connection; its moments are ``interval_s`` apart, and a share ``fails`` of them fails.

    ``away_until_ns``: until then all fail (a burst, a body in between). ``lose``: so many of the next notifications the
    host's system loses. ``whole``: each message is a notification as it is, or a Capture2Go's stream is cut into such.
    ``characteristics``: of what the host writes and of notifications, which then are records of a line; None: they are
    as they are.
    """

    imu: SimulatedImu
    t_ns: int
    interval_s: float = 0.03
    fails: float = 0.0
    seed: int = 1
    away_until_ns: int = 0
    lose: int = 0
    whole: bool = False
    characteristics: tuple[int, int] | None = None
    _waiting: list[bytes] = field(default_factory=list)
    _written: bytes = b""

    def __post_init__(self) -> None:
        self._chance = random.Random(self.seed)

    def receive(self, t_ns: int, data: bytes) -> list[bytes]:
        """A command; its answer waits its turn."""
        if self.characteristics is not None:
            values, self._written = records(self._written + data)
            data = b"".join(value for number, value in values if number == self.characteristics[0])
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
                    out.append(record(self.characteristics[1], sent) if self.characteristics else sent)
        self._waiting += self.imu.advance(t_ns)
        return out

    def _next(self) -> bytes:
        if self.whole:
            return self._waiting.pop(0)
        stream = b"".join(self._waiting)
        self._waiting = [stream[LONGEST - 1 :]] if len(stream) >= LONGEST else []
        return NO_REAL_TIME + stream[: LONGEST - 1]
