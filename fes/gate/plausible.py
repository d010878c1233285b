"""Can these numbers come from this sensor, on this foot, mounted as it was? Units, range, mounting.

Every bound was held against real recordings (docs/safety.md): gait never comes near them; a wrong unit is beyond them
at once, or after the 80 ms that :mod:`fes.gate.force` takes; :mod:`fes.gate.axes` sees axes change.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from fes.config import ImuDevice
from fes.gate.axes import Axes
from fes.gate.force import Force
from fes.signals import G_MPS2, ImuSample, Vector3

SUSTAINED_MS: Final = 80  # what one knock, one clipped heel strike or one free fall of the foot never lasts
MOST_RATE_RADPS: Final = 40.0  # in any one sample: degrees taken for radians; real feet turn at 13, shanks at 20
FAST_RADPS: Final = 15.0  # about one axis for 80 ms: a turn in 0.4 s; real feet never are, shanks for one sample
AT_RANGE: Final = 0.995  # of the range that the session states
REST_RATE_RADPS: Final = 0.5
REST_FORCE_MPS2: Final = 1.5  # of gravity
MOST_TILT_RAD: Final = math.radians(65)  # at rest, from where it was at calibration; real feet reach 23°, shanks 30°
MEAN_NS: Final = (
    300_000_000  # over which gravity shows through a walk: the mean force of real legs tilts by 55° at most
)
MOST_STEP_NS: Final = 40_000_000  # one sample after a silence does not stand for all of it
_TILT: Final = f"{math.degrees(MOST_TILT_RAD):.0f}°"
_UPRIGHT: Final = math.cos(MOST_TILT_RAD)


@dataclass(slots=True)
class _Lasting:
    """How long something has been so."""

    since_ns: int | None = None

    def so(self, t_ns: int, is_so: bool) -> bool:
        """Whether it has now been so for long enough."""
        if not is_so:
            self.since_ns = None
            return False
        if self.since_ns is None:
            self.since_ns = t_ns
        return t_ns - self.since_ns >= SUSTAINED_MS * 1_000_000


class Plausibility:
    """One sensor's samples against what is possible.

    Args:
        sensor: its name.
        device: its settings, for its ranges; without them saturation cannot be told.
        up: the upward direction in the sensor's frame when it was calibrated; without it the mounting is not judged.
    """

    def __init__(self, sensor: str, device: ImuDevice | None, up: Vector3 | None) -> None:
        self._acc_range_mps2 = AT_RANGE * device.acc_range_g * G_MPS2 if device else math.inf
        self._gyr_range_radps = AT_RANGE * math.radians(device.gyr_range_dps) if device else math.inf
        self._up = up
        self.doubt = ""  # no fault by itself: a foot may rest so, but not one that walks
        self._force = Force(sensor, device.acc_range_g if device else math.inf)
        self._axes = Axes()
        self._fast, self._saturated, self._tilted = _Lasting(), _Lasting(), _Lasting()
        self._mean_mps2 = self._upright()
        self._mean_ns: int | None = None

    def fault(self, sample: ImuSample) -> str:
        """Take in a finite sample; what cannot be, in words, "" when all can."""
        t_ns, name = sample.t_ns, sample.sensor
        x, y, z = sample.acc_mps2
        force_mps2 = math.sqrt(x * x + y * y + z * z)
        most_mps2, rate_radps = _largest(sample.acc_mps2), _largest(sample.gyr_radps)
        at_range = rate_radps >= self._gyr_range_radps or most_mps2 >= self._acc_range_mps2
        wrong_unit, exchanged = self._force.fault(sample, force_mps2, most_mps2), self._axes.fault(sample)
        fast = self._fast.so(t_ns, rate_radps > FAST_RADPS)
        saturated = self._saturated.so(t_ns, at_range)
        tilted = self._tilted.so(t_ns, self._rests_tilted(x, y, z, force_mps2, rate_radps))
        moves_tilted = self._moves_tilted(x, y, z, t_ns)
        does = "rests" if tilted else "moves" if moves_tilted else ""
        self.doubt = f"{name} {does} turned by more than {_TILT} from its calibration: remounted?" if does else ""
        if rate_radps > MOST_RATE_RADPS:
            return f"{name} turns at {rate_radps:.0f} rad/s, which no foot does: is its unit °/s?"
        if wrong_unit:
            return wrong_unit
        if exchanged:
            return exchanged
        if saturated:
            return f"{name} is saturated: at the end of its range for {SUSTAINED_MS} ms"
        if fast:
            return f"{name} turns at more than {FAST_RADPS:.0f} rad/s for {SUSTAINED_MS} ms: is its unit °/s?"
        return ""

    def _rests_tilted(self, x: float, y: float, z: float, force_mps2: float, rate_radps: float) -> bool:
        if self._up is None or rate_radps > REST_RATE_RADPS or abs(force_mps2 - G_MPS2) > REST_FORCE_MPS2:
            return False
        ux, uy, uz = self._up
        return x * ux + y * uy + z * uz < force_mps2 * _UPRIGHT

    def _moves_tilted(self, x: float, y: float, z: float, t_ns: int) -> bool:
        """Whether the force, averaged over about 0.3 s, comes from elsewhere than gravity does in anybody's gait.

        A stance need not hold a rest: of stroke survivors' shanks, most do not.
        """
        if self._up is None:
            return False
        before_ns, self._mean_ns = self._mean_ns, t_ns
        step_ns = t_ns - before_ns if before_ns is not None else 0
        if step_ns > MOST_STEP_NS:
            step_ns = MOST_STEP_NS
        elif step_ns < 0:
            step_ns = 0
        share = step_ns / MEAN_NS
        (mx, my, mz), (ux, uy, uz) = self._mean_mps2, self._up
        mx, my, mz = mx + share * (x - mx), my + share * (y - my), mz + share * (z - mz)
        size = math.sqrt(mx * mx + my * my + mz * mz)
        if not size < math.inf:  # told as a fault of its own; a mean would never forget it
            self._mean_mps2 = self._upright()
            return False
        self._mean_mps2 = (mx, my, mz)
        return mx * ux + my * uy + mz * uz < size * _UPRIGHT

    def _upright(self) -> Vector3:
        x, y, z = self._up or (0.0, 0.0, 0.0)
        return (G_MPS2 * x, G_MPS2 * y, G_MPS2 * z)


class Plausible:
    """All sensors' plausibility.

    Args:
        devices: the session's sensors; one that is not among them is judged without ranges.
        up: the calibrated upward directions by sensor.
    """

    def __init__(self, devices: tuple[ImuDevice, ...], up: Mapping[str, Vector3]) -> None:
        self._devices = {str(device.sensor): device for device in devices}
        self._up = dict(up)
        self._sensors: dict[str, Plausibility] = {}

    def fault(self, sample: ImuSample) -> str:
        """Take in a sample; see :meth:`Plausibility.fault`."""
        known = self._sensors.get(sample.sensor)
        if known is None:
            known = Plausibility(sample.sensor, self._devices.get(sample.sensor), self._up.get(sample.sensor))
            self._sensors[sample.sensor] = known
        return known.fault(sample)

    def doubt(self, sensor: str) -> str:
        """Why this sensor's data are no ground for stimulating now; "" when they are."""
        known = self._sensors.get(sensor)
        return known.doubt if known else ""


def _largest(a: Vector3) -> float:
    """Of the three sizes; as ``max``, which takes three times as long."""
    x, y, z = a
    most, y, z = abs(x), abs(y), abs(z)
    if y > most:
        most = y
    return z if z > most else most
