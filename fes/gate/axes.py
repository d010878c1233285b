"""Did the sensor's axes change between two samples? Told by one jump that exchanged axes explain and gait does not.

Real force and rate jump too, at heel strikes, but neither before nor after such a jump are they smooth, and no exchange
of axes leads from the one sample to the other in both at once. Under a heel the force may turn right around and stay so
for two samples; but the rate goes on as it was, and so speaks against an exchange. ``benchmarks/wrong_unit.py`` counts
how often this tells, and on how many real recordings it speaks wrongly (docs/safety.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import permutations, product
from typing import Final

from fes.signals import ImuSample, Vector3

# with the first three of them 1.38 times as wide no real walk would be taken for an exchange yet
LEAST_JUMP: Final = 0.7  # of force and rate together, each squared and against its own size
SMOOTH: Final = 0.13  # of the jump: the steps before and after it are smaller
EXPLAINED: Final = 0.12  # of the jump: what an exchange of axes leaves of it
AGAINST: Final = 0.02  # of the rate's square: an exchange may miss the new rate by so much more than the old rate does
LEAST_FORCE_MPS2: Final = 4.0  # smaller forces and rates are not taken as larger jumps for their size
LEAST_RATE_RADPS: Final = 1.0
STEPS_AFTER: Final = 2  # that have to be smooth
MOST_APART_NS: Final = 12_500_000  # by the sensor's own clock, between two samples; in a longer time a foot may turn
_LEAST_FORCE2: Final = LEAST_FORCE_MPS2**2
_LEAST_RATE2: Final = LEAST_RATE_RADPS**2

# a box turned, never mirrored: (order, signs); a mirrored force alone is what many a hard heel strike looks like
_TURNS = tuple(
    (order, signs)
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if math.prod(signs) * (1.0 if order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1.0) > 0.0
)


@dataclass(slots=True)
class _Jump:
    """One that exchanged axes explain, and what has to follow it.

    Attributes:
        force: the square that a step of the force is measured by.
        rate: likewise for the rate.
        smooth: what a step after it may measure.
        steps: so many are still to come.
    """

    force: float
    rate: float
    smooth: float
    steps: int


class Axes:
    """The axes of one sensor, sample by sample."""

    def __init__(self) -> None:
        self._before: ImuSample | None = None
        self._step: tuple[float, float] | None = None  # the last one's square, of force and of rate
        self._jump: _Jump | None = None

    def fault(self, sample: ImuSample) -> str:
        """Take in a finite sample; in words that the axes changed two samples ago, "" when they did not."""
        before, last, jump = self._before, self._step, self._jump
        self._before = sample
        if before is None or not 0 < sample.t_sensor_ns - before.t_sensor_ns <= MOST_APART_NS:
            self._step = self._jump = None
            return ""
        force, rate = self._step = (
            _square_apart(sample.acc_mps2, before.acc_mps2),
            _square_apart(sample.gyr_radps, before.gyr_radps),
        )
        if jump is None:
            # most steps are too small already if held against the least sizes, and against any other they are smaller
            if last and force / _LEAST_FORCE2 + rate / _LEAST_RATE2 >= LEAST_JUMP:
                self._jump = _jump(before, sample, last, self._step)
            return ""
        jump.steps -= 1
        smooth = force / jump.force + rate / jump.rate <= jump.smooth
        if smooth and jump.steps:
            return ""
        self._jump = None
        return f"the axes of {sample.sensor} changed from one sample to the next: remounted?" if smooth else ""


def _jump(before: ImuSample, after: ImuSample, last: tuple[float, float], step: tuple[float, float]) -> _Jump | None:
    acc, gyr, acc_before, gyr_before = after.acc_mps2, after.gyr_radps, before.acc_mps2, before.gyr_radps
    force = max(_square(acc), _square(acc_before), _LEAST_FORCE2)
    rate = max(_square(gyr), _square(gyr_before), _LEAST_RATE2)
    size = step[0] / force + step[1] / rate
    smooth = SMOOTH * size
    if size < LEAST_JUMP or last[0] / force + last[1] / rate > smooth:
        return None
    most, rate_most = EXPLAINED * size, step[1] / rate + AGAINST
    for order, signs in _TURNS:
        rate_left = _square_apart(gyr, _exchanged(gyr_before, order, signs)) / rate
        left = rate_left + _square_apart(acc, _exchanged(acc_before, order, signs)) / force
        if rate_left <= rate_most and left <= most:
            return _Jump(force, rate, smooth, STEPS_AFTER)
    return None


def _square(a: Vector3) -> float:
    return a[0] * a[0] + a[1] * a[1] + a[2] * a[2]


def _square_apart(a: Vector3, b: Vector3) -> float:
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return x * x + y * y + z * z


def _exchanged(a: Vector3, order: tuple[int, ...], signs: tuple[float, ...]) -> Vector3:
    return (signs[0] * a[order[0]], signs[1] * a[order[1]], signs[2] * a[order[2]])
