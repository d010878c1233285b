"""A simulated inertial sensor with its own clock: time in, messages out; no I/O.

Faults, besides the line's own (:mod:`drivers.simulated.lines`): ``reboot`` (now: silent for 0.3 s, then clock and
counter from 0), ``unit`` (values times this; 0 ends it), ``force_scaled`` / ``rate_scaled`` (one triad times this; 0
ends it), ``stuck`` (1: repeats itself), ``held`` / ``held_alive`` (a sum of 1, 2, 4 for the accelerometer's axes and
8, 16, 32 for the gyroscope's: these keep what they showed last, to the bit or with noise; 0 ends it), ``clip`` (values
held within ± this share of full scale; 0 ends it), ``full`` (1: every value at the end of its range), ``nan`` / ``inf``
/ ``doubled`` (so many of the next samples), ``axes`` (1: sits turned, x measures what y did, y what z did; 0 ends it),
``dangling`` (1: hangs from its cable and swings; 0 ends it), ``tap`` (now: somebody knocks on it), ``drift``
(ppm of its clock from now on), ``jump`` (its clock, by so many seconds, once), ``jumping`` (every eighth stamp is
ahead by so many seconds; 0 ends it). ``stand``: its wearer stays within the first so many seconds of the signal, in
which they stand, once they come there; 0: goes on at their end. A sensor that sends whole numbers, as most do on CAN,
has no ``nan`` and no ``inf``: what it cannot measure it sends as the end of its range, or not at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from drivers.simulated.imu.wire import Reading, Wire
from drivers.simulated.lines import Device, FaultValues
from fes.signals import G_MPS2, NS_PER_S, FloatArray, Vector3

if TYPE_CHECKING:
    from fes.recording import Track

LASTING: Final = (
    "unit",
    "force_scaled",
    "rate_scaled",
    "stuck",
    "held",
    "held_alive",
    "clip",
    "full",
    "nan",
    "inf",
    "doubled",
    "axes",
    "dangling",
    "jumping",
)  # until set to 0
FAULTS: Final = frozenset((*LASTING, "tap", "reboot", "drift", "jump", "stand"))
NOT_FINITE: Final = ("nan", "inf")
ACC_NOISE, GYR_NOISE = 0.05, 0.02  # m/s², rad/s
JUMPING_EVERY: Final = 8  # more than one in twenty
TAP_S, TAP_RADPS = 0.06, 2.0
BOOT_NS: Final = 300_000_000
CABLE_M, CABLE_SWING_RAD, CABLE_SPIN_RADPS = 0.3, 0.4, 1.5  # a sensor that has come off and hangs below the knee
_NAN: Final = (math.nan, math.nan, math.nan)
_INF: Final = (math.inf, -math.inf, math.inf)


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
        self._acc_range = acc_range_g * G_MPS2
        self._gyr_range = math.radians(gyr_range_dps)
        self._values = FaultValues(dict.fromkeys(FAULTS, 0.0))
        self._last: tuple[Vector3, Vector3] = signal.sample(0)
        self._played = 0
        self._held_at: tuple[float, ...] | None = None
        self._jumped = jumped
        self._start(t_ns, int(offset_s * NS_PER_S), drift_ppm)

    def _start(self, t_ns: int, device_ns: int, drift_ppm: float) -> None:
        # the sampling beat is the device's crystal's: its drift changes the interval too
        self._t0_ns, self._device0_ns, self._drift = t_ns, device_ns, drift_ppm * 1e-6
        self._counter = self._beat = 0
        self._tapped = -math.inf  # the beat of the last knock
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
            if self._values["jumping"] and self._counter % JUMPING_EVERY == 0:
                own_ns += int(self._values["jumping"] * NS_PER_S)
            messages = self._wire.encode(self._reading(own_ns))
            out += messages + (messages if self._values.use_up("doubled") else [])
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
        if name == "tap":
            self._tapped = self._beat
            return []
        if name == "reboot":
            self._start(t_ns + BOOT_NS, 0, self._drift * 1e6)
            return self._wire.boot()
        if name in ("jump", "drift"):
            own_ns = self._own_ns() + (int(value * NS_PER_S) if name == "jump" else 0)
            counter = self._counter
            self._start(self.next_deadline_ns(), own_ns, value if name == "drift" else self._drift * 1e6)
            self._counter = counter
            return []
        if name == "stand" and not value:
            self._played = max(self._played, self._standing_samples) % self._signal.size
        self._values[name] = value
        return []

    @property
    def _standing_samples(self) -> int:
        """How many samples of the signal are of standing, by the fault ``stand``."""
        return round(self._values["stand"] * self._signal.rate_hz)

    def _with_held_axes(self, acc: Vector3, gyr: Vector3) -> tuple[Vector3, Vector3]:
        """What it feels, but for the axes that show what they did when the fault began."""
        axes = int(self._values["held"]) | int(self._values["held_alive"])
        if not axes:
            self._held_at = None
            return acc, gyr
        if self._held_at is None:
            self._held_at = acc + gyr
        # no living sensor repeats itself: this one's noise goes round in 97 samples
        alive = math.sin(self._counter * math.tau * 31 / 97) if self._values["held_alive"] else 0.0
        x, y, z, p, q, r = (
            held + (ACC_NOISE if axis < 3 else GYR_NOISE) * alive if axes >> axis & 1 else felt
            for axis, (held, felt) in enumerate(zip(self._held_at, acc + gyr, strict=True))
        )
        return (x, y, z), (p, q, r)

    def _reading(self, own_ns: int) -> Reading:
        if not self._values["stuck"]:
            acc, gyr = self._signal.sample(self._played)
            if (since_s := (self._beat - self._tapped) / self._signal.rate_hz) < TAP_S:
                knock = TAP_RADPS * math.sin(math.pi * since_s / TAP_S)
                gyr = gyr[0] + knock, gyr[1] + knock, gyr[2]
            self._last = acc, gyr
        acc, gyr = self._with_held_axes(*self._last)
        acc = _held(acc, self._values["force_scaled"] or 1.0, math.inf)
        gyr = _held(gyr, self._values["rate_scaled"] or 1.0, math.inf)
        factor, share = self._values["unit"] or 1.0, self._values["clip"] or 1.0
        held_acc = _held(acc, factor, share * self._acc_range)
        held_gyr = _held(gyr, factor, share * self._gyr_range)
        clipped = self._values["clip"] > 0 and (held_acc != acc or held_gyr != gyr)
        if self._values["unit"]:
            held_acc, held_gyr = _held(acc, factor, math.inf), _held(gyr, factor, math.inf)
        if self._values["full"]:
            held_acc, held_gyr = _held(acc, 1e9, self._acc_range), _held(gyr, 1e9, self._gyr_range)
        if self._values["axes"]:
            held_acc, held_gyr = (*held_acc[1:], held_acc[0]), (*held_gyr[1:], held_gyr[0])
        if self._values["dangling"]:
            held_acc, held_gyr = _pendulum(self._counter / self._signal.rate_hz)
        if self._values.use_up("nan"):
            held_acc = _NAN
        if self._values.use_up("inf"):
            held_acc = held_gyr = _INF
        return Reading(self._counter, own_ns, held_acc, held_gyr, clipped, self.next_deadline_ns())


def _pendulum(t_s: float) -> tuple[Vector3, Vector3]:
    """Force and rate of a small weight on a cable along its x axis: it feels nothing but the cable's pull."""
    omega_radps = math.sqrt(G_MPS2 / CABLE_M)
    angle_rad, spun_rad = CABLE_SWING_RAD * math.sin(omega_radps * t_s), CABLE_SPIN_RADPS * t_s
    rate_radps = CABLE_SWING_RAD * omega_radps * math.cos(omega_radps * t_s)
    alive = math.sin(t_s * math.tau * 31.0)
    pull_mps2 = G_MPS2 * math.cos(angle_rad) + CABLE_M * rate_radps**2
    force = (pull_mps2 + ACC_NOISE * alive, ACC_NOISE * alive, -ACC_NOISE * alive)
    return force, (
        CABLE_SPIN_RADPS + GYR_NOISE * alive,
        rate_radps * math.cos(spun_rad),
        -rate_radps * math.sin(spun_rad),
    )


def _held(values: Vector3, factor: float, most: float) -> Vector3:
    x, y, z = (min(max(v * factor, -most), most) for v in values)
    return x, y, z
