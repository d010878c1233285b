"""Are a sensor's time stamps in order? Single slips are counted; too many within a second are a fault."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final

from fes.signals import NS_PER_S, ImuSample

WINDOW_NS: Final = NS_PER_S
MOST_SHARE: Final = 0.05
LEAST_SLIPS: Final = 3  # so that a window that has only begun does not condemn a single one
LEAST_JUMP_NS: Final = 35_000_000  # a stamp further ahead of the time waited than this, and than half of that time


@dataclass(slots=True)
class _Sensor:
    t_ns: int
    t_sensor_ns: int
    slips: deque[int] = field(default_factory=deque)  # arrival times of the slips within the window
    samples: deque[int] = field(default_factory=deque)  # arrival times of all samples within the window


class Stamps:
    """Counts stamps that are doubled, out of order, or ahead of the time that has passed, sensor by sensor.

    A gap is no slip: what was lost on the way shows in the data's age. ``slips`` counts all since the start.
    """

    def __init__(self) -> None:
        self.slips: dict[str, int] = {}
        self._sensors: dict[str, _Sensor] = {}

    def fault(self, sample: ImuSample) -> str:
        """Take in a sample; says so when more than 5 % of the last second's stamps were out of order."""
        known = self._sensors.get(sample.sensor)
        if known is None:
            self._sensors[sample.sensor] = _Sensor(sample.t_ns, sample.t_sensor_ns)
            self.slips[sample.sensor] = 0
            return ""
        t_ns, samples, slips = sample.t_ns, known.samples, known.slips
        step_ns, waited_ns = sample.t_sensor_ns - known.t_sensor_ns, t_ns - known.t_ns
        known.t_ns, known.t_sensor_ns = t_ns, sample.t_sensor_ns
        samples.append(t_ns)
        ahead_ns = step_ns - waited_ns
        if step_ns <= 0 or (ahead_ns > LEAST_JUMP_NS and ahead_ns > waited_ns // 2):
            self.slips[sample.sensor] += 1
            slips.append(t_ns)
        while t_ns - samples[0] > WINDOW_NS:  # at the latest it ends at this sample
            samples.popleft()
        while slips and t_ns - slips[0] > WINDOW_NS:
            slips.popleft()
        if len(slips) < LEAST_SLIPS or len(slips) <= MOST_SHARE * len(samples):
            return ""
        share = f"{len(slips)} of {len(samples)} within a second"
        return f"{sample.sensor}'s time stamps are out of order: {share}"
