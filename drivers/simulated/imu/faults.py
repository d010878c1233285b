"""What a sensor with a fault shows instead of what it feels; no I/O, no clock. Simulated and real sensors share it.

``unit`` (values times this; 0 ends it), ``force_scaled`` / ``rate_scaled`` (one triad times this; 0 ends it), ``stuck``
(1: repeats itself), ``held`` / ``held_alive`` (a sum of 1, 2, 4 for the accelerometer's axes and 8, 16, 32 for the
gyroscope's: these keep what they showed last, to the bit or with noise; 0 ends it), ``clip`` (values held within ± this
share of full scale; 0 ends it), ``full`` (1: every value at the end of its range), ``nan`` / ``inf`` / ``doubled`` (so
many of the next samples), ``axes`` (1: sits turned, x measures what y did, y what z did; 0 ends it), ``dangling`` (1:
hangs from its cable and swings; 0 ends it), ``jumping`` (every eighth stamp is ahead by so many seconds; 0 ends it),
``tap`` (now: somebody knocks on it).

The faults of a simulated sensor, between the driver of a real one and whoever reads it: in a fault campaign only.

Of a line's faults all but ``garble``, whose frame every driver refuses: that is ``drop``. Of a sensor's all; further
``unsound`` (so many of the next samples are all NaN, as drivers pass on what a device calls unsound), ``drift`` (ppm
that its stamps run fast from now on), ``jump`` (its stamps, by so many seconds, once), ``reboot`` (now: silent for 0.3
s, then stamps from 0) and ``unplug`` (1: its line is gone, with every sensor on it; 0: it can be opened again).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

from drivers.imu.port import NOT_A_NUMBER, ImuLost, ImuPort
from drivers.simulated.lines import FaultValues, MessageFaults
from drivers.simulated.stimulator.firmware import NEVER
from fes.config import ImuDevice
from fes.signals import G_MPS2, NS_PER_S, RawSample, Vector3

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
ACC_NOISE, GYR_NOISE = 0.05, 0.02  # m/s², rad/s
JUMPING_EVERY: Final = 8  # more than one in twenty
TAP_S, TAP_RADPS = 0.06, 2.0
BOOT_NS: Final = 300_000_000
CABLE_M, CABLE_SWING_RAD, CABLE_SPIN_RADPS = 0.3, 0.4, 1.5  # a sensor that has come off and hangs below the knee
_NAN: Final = (math.nan, math.nan, math.nan)
_INF: Final = (math.inf, -math.inf, math.inf)


class SampleFaults:
    """One sensor's: ask :meth:`ahead_ns` and :meth:`doubled`, and :meth:`shown` after both, once for each sample.

    ``within``: the share of full scale that it cannot show more than when nothing is wrong.
    """

    def __init__(self, rate_hz: float, acc_range_g: float, gyr_range_dps: float, within: float = 1.0) -> None:
        self._rate_hz, self._within = rate_hz, within
        self._acc_range = acc_range_g * G_MPS2
        self._gyr_range = math.radians(gyr_range_dps)
        self._values = FaultValues(dict.fromkeys(LASTING, 0.0))
        self._last: tuple[Vector3, Vector3] | None = None
        self._held_at: tuple[float, ...] | None = None
        self._count = 0
        self._tapped = -math.inf  # the sample of the last knock

    def set(self, name: str, value: float) -> None:
        """Bring a fault about, or with 0 end it. ValueError: no such fault, or no number."""
        if name == "tap":
            self._tapped = self._count
        elif name not in LASTING or not math.isfinite(value):
            raise ValueError(f"fault {name!r} = {value!r} is not known; one of {', '.join(sorted(LASTING))}, tap")
        else:
            self._values[name] = value

    def ahead_ns(self) -> int:
        """By how much the next sample's stamp is ahead."""
        return int(self._values["jumping"] * NS_PER_S) if self._count % JUMPING_EVERY == 0 else 0

    def doubled(self) -> bool:
        """Whether this sample comes twice; asked once for each."""
        return self._values.use_up("doubled")

    def shown(self, acc: Vector3, gyr: Vector3) -> tuple[Vector3, Vector3, bool]:
        """Specific force (m/s²) and rate (rad/s) that it shows where it feels these; whether it says: clipped."""
        if self._last is None or not self._values["stuck"]:
            if (since_s := (self._count - self._tapped) / self._rate_hz) < TAP_S:
                knock = TAP_RADPS * math.sin(math.pi * since_s / TAP_S)
                gyr = gyr[0] + knock, gyr[1] + knock, gyr[2]
            self._last = acc, gyr
        acc, gyr = self._with_held_axes(*self._last)
        acc = _held(acc, self._values["force_scaled"] or 1.0, math.inf)
        gyr = _held(gyr, self._values["rate_scaled"] or 1.0, math.inf)
        factor, share = self._values["unit"] or 1.0, self._values["clip"] or self._within
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
            held_acc, held_gyr = _pendulum(self._count / self._rate_hz)
        if self._values.use_up("nan"):
            held_acc = _NAN
        if self._values.use_up("inf"):
            held_acc = held_gyr = _INF
        self._count += 1
        return held_acc, held_gyr, clipped

    def _with_held_axes(self, acc: Vector3, gyr: Vector3) -> tuple[Vector3, Vector3]:
        """What it feels, but for the axes that show what they did when the fault began."""
        axes = int(self._values["held"]) | int(self._values["held_alive"])
        if not axes:
            self._held_at = None
            return acc, gyr
        if self._held_at is None:
            self._held_at = acc + gyr
        # no living sensor repeats itself: this one's noise goes round in 97 samples
        alive = math.sin(self._count * math.tau * 31 / 97) if self._values["held_alive"] else 0.0
        x, y, z, p, q, r = (
            held + (ACC_NOISE if axis < 3 else GYR_NOISE) * alive if axes >> axis & 1 else felt
            for axis, (held, felt) in enumerate(zip(self._held_at, acc + gyr, strict=True))
        )
        return (x, y, z), (p, q, r)


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


CLOCK: Final = ("jump", "drift", "reboot")
UNTIL_ENDED: Final = (*LASTING, *sorted(MessageFaults.faults), "unsound", "drift", "unplug")
UNPLUGGED: Final = "unplugged by the fault campaign"


class StampFaults:
    """A device's clock with faults: its own time in ns in, what its stamps say out."""

    def __init__(self) -> None:
        self._offset_ns = self._since_ns = self._last_ns = 0
        self._drift = 0.0
        self._restarts = False

    def set(self, name: str, value: float) -> None:
        """``jump`` by seconds, once; ``drift`` in ppm from now on; ``reboot``: the next stamp is 0."""
        if name == "jump":
            self._offset_ns += round(value * NS_PER_S)
        elif name == "drift":
            self._offset_ns = self._ahead_ns(self._last_ns)
            self._since_ns, self._drift = self._last_ns, value * 1e-6
        else:
            self._restarts = True

    def stamp_ns(self, t_device_ns: int) -> int:
        """The next sample's."""
        self._last_ns = t_device_ns
        if self._restarts:
            self._restarts, self._since_ns, self._offset_ns = False, t_device_ns, -t_device_ns
        return t_device_ns + self._ahead_ns(t_device_ns)

    def _ahead_ns(self, t_device_ns: int) -> int:
        return self._offset_ns + round(self._drift * (t_device_ns - self._since_ns))


class _Faults:
    """One sensor's, from its line to its samples."""

    def __init__(self, device: ImuDevice) -> None:
        # within what it can measure its driver holds it; here nothing may change that has no fault
        self.samples = SampleFaults(device.rate_hz, device.acc_range_g, device.gyr_range_dps, within=math.inf)
        self.line = MessageFaults[RawSample]()
        self.stamps = StampFaults()
        self.counted = FaultValues(unsound=0.0)
        self.silent_until_ns = 0

    def sent(self, sample: RawSample) -> list[RawSample]:
        """The sample as the line gets it: twice where it is doubled."""
        twice = self.samples.doubled()
        t_device_ns = self.stamps.stamp_ns(sample.t_device_ns) + self.samples.ahead_ns()
        acc, gyr, _ = self.samples.shown(sample.acc_mps2, sample.gyr_radps)
        if self.counted.use_up("unsound"):
            acc = gyr = NOT_A_NUMBER
        return [replace(sample, t_device_ns=t_device_ns, acc_mps2=acc, gyr_radps=gyr)] * (2 if twice else 1)


class FaultedImu:
    """An open port with faults, that of :class:`~drivers.imu.port.ImuPort`; ``devices``: the settings of its sensors.

    Without a fault it gives every sample as the port does.
    """

    def __init__(self, port: ImuPort, devices: Sequence[ImuDevice]) -> None:
        self._port = port
        self.sensors = port.sensors
        self._faults: dict[str, _Faults] = {
            device.sensor: _Faults(device) for device in devices if device.sensor in port.sensors
        }
        self._unplugged = False

    @property
    def serials(self) -> Mapping[str, str]:
        """As the port's."""
        return self._port.serials

    @property
    def notices(self) -> Sequence[str]:
        """As the port's."""
        return self._port.notices

    def inject(self, t_ns: int, sensor: str, name: str, value: float) -> None:
        """Bring a fault of a sensor about, or with 0 end it. ValueError: no such fault, or a value that it has not."""
        faults = self._faults[sensor]
        if name == "unplug":
            self._unplugged = bool(value)
        elif name == "unsound":
            faults.counted[name] = value
        elif name in CLOCK:
            faults.stamps.set(name, value)
            if name == "reboot":
                faults.silent_until_ns = t_ns + BOOT_NS
        elif name in MessageFaults.faults:
            faults.line.set(name, value)
        else:
            faults.samples.set(name, value)

    def clear(self, t_ns: int, sensor: str) -> None:
        """End all faults of a sensor that last."""
        for name in UNTIL_ENDED:
            self.inject(t_ns, sensor, name, 0.0)

    def fileno(self) -> int | None:
        """As the port's; None, to be read at every tick, while a sample is held back."""
        waits = any(faults.line.next_deadline_ns() < NEVER for faults in self._faults.values())
        return None if waits or self._unplugged else self._port.fileno()

    def read(self, t_ns: int) -> list[RawSample]:
        """What has arrived by ``t_ns``, as the port's. ImuLost: the line broke, or is unplugged."""
        if self._unplugged:
            raise ImuLost(UNPLUGGED)
        out: list[RawSample] = []
        for sample in self._port.read(t_ns):
            faults = self._faults[sample.sensor]
            if t_ns >= faults.silent_until_ns:
                faults.line.send(t_ns, faults.sent(sample))
        for faults in self._faults.values():
            out += (replace(sample, t_host_ns=t_ns) for sample in faults.line.arrived(t_ns))
        return out

    def clock_answers(self) -> Sequence[tuple[str, int, int]]:
        """As the port's."""
        return self._port.clock_answers()

    def reopen(self) -> None:
        """As the port's. ImuLost: it is unplugged still."""
        if self._unplugged:
            raise ImuLost(UNPLUGGED)
        self._port.reopen()

    def close(self) -> None:
        """Release the line."""
        self._port.close()
