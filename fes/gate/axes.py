"""Did the sensor's axes change between two samples? Told by one jump that exchanged axes explain and gait does not.

Real force and rate jump too, at heel strikes, but neither before nor after such a jump are they smooth, and no exchange
of axes leads from the one sample to the other in both at once. ``benchmarks/wrong_unit.py`` counts how often it tells,
and on how many real recordings it speaks wrongly (docs/safety.md).
"""

from __future__ import annotations

from itertools import permutations, product
from typing import Final

from fes.signals import ImuSample, Vector3

LEAST_JUMP: Final = 0.7  # of force and rate together, each squared and against its own size
SMOOTH: Final = 0.13  # of the jump: the steps before and after it are smaller; nearest real case 0.18
EXPLAINED: Final = 0.1  # of the jump: what an exchange of axes leaves of it; nearest real case 0.17
LEAST_FORCE_MPS2: Final = 4.0  # smaller forces and rates are not taken as larger jumps for their size
LEAST_RATE_RADPS: Final = 1.0
STEPS_AFTER: Final = 2  # that have to be smooth
MOST_APART_NS: Final = 12_500_000  # by the sensor's own clock, between two samples; in a longer time a foot may turn

_ORDERS = tuple(permutations(range(3)))
_SIGNS = tuple(product((1.0, -1.0), repeat=3))


class Axes:
    """The axes of one sensor, sample by sample."""

    def __init__(self) -> None:
        self._acc: Vector3 = (0.0, 0.0, 0.0)
        self._gyr: Vector3 = (0.0, 0.0, 0.0)
        self._step = (0.0, 0.0)  # the last one's square, of force and of rate
        self._t_sensor_ns: int | None = None
        self._steps = 0  # without a gap
        self._after = 0  # smooth steps still to come after a jump, 0: there was none
        self._jump = self._force = self._rate = 0.0  # of that jump: its size, and the squares that it is measured by

    def fault(self, sample: ImuSample) -> str:
        """Take in a finite sample; in words that the axes changed two samples ago, "" when they did not."""
        acc, gyr, before_ns = sample.acc_mps2, sample.gyr_radps, self._t_sensor_ns
        step = (_square_apart(acc, self._acc), _square_apart(gyr, self._gyr))
        said = ""
        if before_ns is None or not 0 < sample.t_sensor_ns - before_ns <= MOST_APART_NS:
            self._steps = self._after = 0
        else:
            self._steps += 1
            if self._after:
                smooth = step[0] / self._force + step[1] / self._rate <= SMOOTH * self._jump
                self._after = self._after - 1 if smooth else 0
                if smooth and not self._after:
                    said = f"the axes of {sample.sensor} changed from one sample to the next: remounted?"
            elif self._steps > 1:
                self._look_for_jump(acc, gyr, step)
        self._acc, self._gyr, self._step, self._t_sensor_ns = acc, gyr, step, sample.t_sensor_ns
        return said

    def _look_for_jump(self, acc: Vector3, gyr: Vector3, step: tuple[float, float]) -> None:
        force = max(_square(acc), _square(self._acc), LEAST_FORCE_MPS2**2)
        rate = max(_square(gyr), _square(self._gyr), LEAST_RATE_RADPS**2)
        jump = step[0] / force + step[1] / rate
        if jump < LEAST_JUMP or self._step[0] / force + self._step[1] / rate > SMOOTH * jump:
            return
        left = min(
            _square_apart(acc, _exchanged(self._acc, order, signs)) / force
            + _square_apart(gyr, _exchanged(self._gyr, order, signs)) / rate
            for order in _ORDERS
            for signs in _SIGNS
        )
        if left <= EXPLAINED * jump:
            self._after, self._jump, self._force, self._rate = STEPS_AFTER, jump, force, rate


def _square(a: Vector3) -> float:
    return a[0] * a[0] + a[1] * a[1] + a[2] * a[2]


def _square_apart(a: Vector3, b: Vector3) -> float:
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return x * x + y * y + z * z


def _exchanged(a: Vector3, order: tuple[int, ...], signs: tuple[float, ...]) -> Vector3:
    return (signs[0] * a[order[0]], signs[1] * a[order[1]], signs[2] * a[order[2]])
