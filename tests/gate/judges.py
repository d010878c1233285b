"""The gate's compiled rules one by one, each on a record of its own."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import count
from typing import Any

import numpy as np

from fes.config import ImuDevice
from fes.estimation.numerics.records import handed, new_core
from fes.gate.bounds import AXIS_DEAD, AXIS_FROZEN, CORE, EXCHANGED, SAID, Bounds, pack_sample, sentence
from fes.gate.coherence import coherent, forget_person, misfit, restart, still_axis
from fes.gate.plausibility import BOUNDS, axes_changed, place_of, wrong_unit
from fes.signals import NS_PER_S, ImuSample, Vector3

Six = tuple[float, float, float, float, float, float]  # force and rate


class Judge:
    """A record of one sensor that nothing has been said of yet."""

    def __init__(
        self, sensor: str = "left_foot", range_g: float = math.inf, bounds: Bounds = BOUNDS, up: Vector3 | None = None
    ) -> None:
        place = place_of(sensor, None, up)
        if range_g < math.inf:
            device = ImuDevice(
                sensor="left_foot", device="xbus", port="x", rate_hz=100, acc_range_g=range_g, gyr_range_dps=2000
            )
            place = place_of(sensor, device, up)
        self.sensor = sensor
        core = new_core(CORE, bounds=bounds, place=place)
        self.one: Any = handed(core)[0]
        self.memory = core.view(np.uint8).data
        forget_person(self.one)
        restart(self.one)

    def take(self, sample: ImuSample) -> None:
        pack_sample(self.memory, 0, sample.t_ns, sample.t_sensor_ns, *sample.acc_mps2, *sample.gyr_radps)

    def said(self, code: int) -> str:
        return sentence(code, self.sensor, float(self.one.value))


class Coherence(Judge):
    """The two triads against each other."""

    def fault(self, sample: ImuSample) -> str:
        self.take(sample)
        return self.said(coherent(self.one))

    def over(self, values: Iterable[Six], t_ns: int = NS_PER_S, step_ns: int = 10_000_000) -> list[str]:
        """What is said of each of these; by default at 100 Hz."""
        return [
            self.fault(ImuSample(now_ns, self.sensor, now_ns, (x, y, z), (p, q, r)))
            for now_ns, (x, y, z, p, q, r) in zip(count(t_ns, step_ns), values, strict=False)
        ]

    @property
    def not_ready(self) -> str:
        return self.said(int(self.one.frozen))


class MeanForce(Judge):
    """The mean force, turned along."""

    def wrong(self, force: Vector3, rate: Vector3, rate_radps: float, block_ns: int) -> float:
        return misfit(self.one, *force, *rate, rate_radps, block_ns)


class Stillness(Judge):
    """Axes that are still while the others move."""

    def stuck(self, means: Six, block_ns: int) -> int:
        return still_axis(self.one, *means, block_ns)


class Force(Judge):
    """The force's unit."""

    def fault(self, sample: ImuSample, force_mps2: float, most_mps2: float) -> str:
        self.take(sample)
        self.one.value = force_mps2
        return self.said(wrong_unit(self.one, force_mps2, most_mps2))


class Axes(Judge):
    """Axes that are exchanged."""

    def fault(self, sample: ImuSample) -> str:
        self.take(sample)
        return self.said(EXCHANGED if axes_changed(self.one) else 0)


def all_codes() -> list[int]:
    """Of which there are words."""
    return [code + axis for code in SAID for axis in range(1 if code < AXIS_FROZEN else 3 if code == AXIS_DEAD else 6)]
