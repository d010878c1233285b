"""Are the data behind a decision fresh? Judged on the host's clock and on the sensor's own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from fes.signals import ImuSample

MAX_CLOCK_DRIFT_PPM: Final = 200  # of a sensor's clock against the host's; a crystal keeps within 100


@dataclass(slots=True)
class _Sensor:
    """``offset_ns`` is the least arrival − stamp seen, the mapping of the least delayed sample.

    It may creep up with the clocks' drift, or an hour of honest drift would look like a delay.
    """

    t_ns: int
    t_sensor_ns: int
    offset_ns: int
    finite: bool


class Freshness:
    """What each sensor sent last, and when.

    A queue drained late delivers old data that have only just arrived; the sensor's own stamps give it away.

    Args:
        max_age_ns: how old the newest sample may be, on either clock.
    """

    def __init__(self, max_age_ns: int) -> None:
        self._max_age_ns = max_age_ns
        self._sensors: dict[str, _Sensor] = {}

    def note(self, sample: ImuSample) -> str:
        """Take in a sample; returns what is wrong with it, "" when nothing is."""
        finite = all(map(math.isfinite, (*sample.acc_mps2, *sample.gyr_radps)))
        offset_ns = sample.t_ns - sample.t_sensor_ns
        fault = "" if finite else f"non-finite sample from {sample.sensor}"
        known = self._sensors.get(sample.sensor)
        back_ns = known.t_sensor_ns - sample.t_sensor_ns if known else 0
        if known is None or back_ns > self._max_age_ns:
            # more than disorder on the way: the sensor restarted or its clock was set; its mapping starts anew
            self._sensors[sample.sensor] = _Sensor(sample.t_ns, sample.t_sensor_ns, offset_ns, finite)
            return fault or (f"{sample.sensor}'s clock went back by {back_ns / 1e6:.0f} ms" if known else "")
        drift_ns = max(sample.t_ns - known.t_ns, 0) * MAX_CLOCK_DRIFT_PPM // 1_000_000
        known.offset_ns = min(offset_ns, known.offset_ns + drift_ns)
        known.t_sensor_ns = max(sample.t_sensor_ns, known.t_sensor_ns)
        known.t_ns, known.finite = sample.t_ns, finite
        return fault

    def doubt(self, sensor: str, t_ns: int) -> str:
        """Why this sensor's data are no ground for stimulating at ``t_ns``; "" when they are."""
        known = self._sensors.get(sensor)
        if known is None:
            return f"no data from {sensor}"
        if not known.finite:
            return f"non-finite sample from {sensor}"
        limit = f"limit {self._max_age_ns / 1e6:.0f} ms"
        arrival_ns = t_ns - known.t_ns
        if arrival_ns < 0:
            return f"{sensor} data are dated {-arrival_ns / 1e6:.3g} ms ahead"
        if arrival_ns > self._max_age_ns:
            return f"{sensor} data {math.ceil(arrival_ns / 1e6)} ms old, {limit}"
        age_ns = t_ns - known.t_sensor_ns - known.offset_ns
        if age_ns > self._max_age_ns:
            return f"{sensor} data {math.ceil(age_ns / 1e6)} ms old by the sensor's own clock, {limit}"
        return ""
