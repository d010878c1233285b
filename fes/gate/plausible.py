"""Can these numbers come from this sensor, on this foot, mounted as it was? Units, range, mounting.

Every bound was held against real recordings (docs/safety.md): gait never comes near them, a wrong unit is beyond them
at once or within 80 ms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from fes.config import ImuDevice
from fes.signals import G_MPS2, ImuSample, Vector3

SUSTAINED_MS: Final = 80  # what one knock, one clipped heel strike or one free fall of the foot never lasts
LEAST_FORCE_MPS2: Final = 3.5  # mostly below it for 80 ms: g taken for m/s²; real feet, 30 ms at most
MOST_FORCE_MPS2: Final = 60.0  # above it for 80 ms: m/s² scaled by g once more; real feet, 30 ms at most
MOST_RATE_RADPS: Final = 40.0  # in any one sample: degrees taken for radians; real feet turn at 13, shanks at 20
AT_RANGE: Final = 0.995  # of the range that the session states
REST_RATE_RADPS: Final = 0.5
REST_FORCE_MPS2: Final = 1.5  # of gravity
MOST_TILT_RAD: Final = math.radians(65)  # at rest, from where it was at calibration; real feet reach 23°, shanks 30°
_TILT: Final = f"{math.degrees(MOST_TILT_RAD):.0f}°"


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


@dataclass(slots=True)
class _Mostly:
    """How long something has been so, all in all, where half of the time that it was not is taken off again.

    In m/s² a foot's swing is never weak for long; in g it is, but for the spikes between.
    """

    before_ns: int | None = None
    so_ns: int = 0
    was_so: bool = False

    def so(self, t_ns: int, is_so: bool) -> bool:
        """Whether it has now been so for long enough."""
        passed_ns = max(t_ns - self.before_ns, 0) if self.before_ns is not None else 0
        if not is_so:
            self.so_ns = max(self.so_ns - passed_ns // 2, 0)
        elif self.was_so:
            self.so_ns += passed_ns
        self.before_ns, self.was_so = t_ns, is_so
        return is_so and self.so_ns >= SUSTAINED_MS * 1_000_000


class Plausibility:
    """One sensor's samples against what is possible.

    Args:
        device: its settings, for its ranges; without them saturation cannot be told.
        up: the upward direction in the sensor's frame when it was calibrated; without it the mounting is not judged.
    """

    def __init__(self, device: ImuDevice | None, up: Vector3 | None) -> None:
        self._acc_range_mps2 = AT_RANGE * device.acc_range_g * G_MPS2 if device else math.inf
        self._gyr_range_radps = AT_RANGE * math.radians(device.gyr_range_dps) if device else math.inf
        self._up = up
        self.doubt = ""  # no fault by itself: a foot may rest so, but not one that walks
        self._weak = _Mostly()
        self._strong, self._saturated, self._tilted = _Lasting(), _Lasting(), _Lasting()

    def fault(self, sample: ImuSample) -> str:
        """Take in a finite sample; what cannot be, in words, "" when all can."""
        t_ns, name = sample.t_ns, sample.sensor
        x, y, z = sample.acc_mps2
        force_mps2 = math.sqrt(x * x + y * y + z * z)
        rate_radps = max(map(abs, sample.gyr_radps))
        at_range = rate_radps >= self._gyr_range_radps or max(abs(x), abs(y), abs(z)) >= self._acc_range_mps2
        weak = self._weak.so(t_ns, force_mps2 < LEAST_FORCE_MPS2)
        strong = self._strong.so(t_ns, force_mps2 > MOST_FORCE_MPS2)
        saturated = self._saturated.so(t_ns, at_range)
        tilted = self._tilted.so(t_ns, self._rests_tilted(sample, force_mps2))
        self.doubt = f"{name} rests turned by more than {_TILT} from its calibration: remounted?" if tilted else ""
        if rate_radps > MOST_RATE_RADPS:
            return f"{name} turns at {rate_radps:.0f} rad/s, which no foot does: is its unit °/s?"
        if weak:
            return f"{name} shows {force_mps2:.2g} m/s² and less than gravity for {SUSTAINED_MS} ms: is its unit g?"
        if strong:
            return (
                f"{name} shows {force_mps2:.0f} m/s² and more than a foot can take for {SUSTAINED_MS} ms: wrong unit?"
            )
        if saturated:
            return f"{name} is saturated: at the end of its range for {SUSTAINED_MS} ms"
        return ""

    def _rests_tilted(self, sample: ImuSample, force_mps2: float) -> bool:
        if self._up is None or abs(force_mps2 - G_MPS2) > REST_FORCE_MPS2:
            return False
        if max(map(abs, sample.gyr_radps)) > REST_RATE_RADPS:
            return False
        along = sum(a * u for a, u in zip(sample.acc_mps2, self._up, strict=True))
        return along < force_mps2 * math.cos(MOST_TILT_RAD)


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
            known = Plausibility(self._devices.get(sample.sensor), self._up.get(sample.sensor))
            self._sensors[sample.sensor] = known
        return known.fault(sample)

    def doubt(self, sensor: str) -> str:
        """Why this sensor's data are no ground for stimulating now; "" when they are."""
        known = self._sensors.get(sensor)
        return known.doubt if known else ""
