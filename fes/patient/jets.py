"""Quantities that carry their first and second time derivative: motion differentiated exactly, not by differences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fes.signals import FloatArray


@dataclass(frozen=True, slots=True)
class Jet:
    """A quantity over N instants with its first and second derivative by time in seconds, each (N,)."""

    value: FloatArray
    rate: FloatArray
    acceleration: FloatArray

    def __add__(self, other: Jet | float) -> Jet:
        if isinstance(other, Jet):
            return Jet(self.value + other.value, self.rate + other.rate, self.acceleration + other.acceleration)
        return Jet(self.value + other, self.rate, self.acceleration)

    def __neg__(self) -> Jet:
        return Jet(-self.value, -self.rate, -self.acceleration)

    def __sub__(self, other: Jet | float) -> Jet:
        return self + (-other)

    def __mul__(self, other: Jet | float) -> Jet:
        if isinstance(other, Jet):
            return Jet(
                self.value * other.value,
                self.rate * other.value + self.value * other.rate,
                self.acceleration * other.value + 2.0 * self.rate * other.rate + self.value * other.acceleration,
            )
        return Jet(self.value * other, self.rate * other, self.acceleration * other)

    def through(self, value: FloatArray, slope: FloatArray, curvature: FloatArray) -> Jet:
        """Chain rule: ``f(self)`` from f, f' and f'' taken at ``self.value``, each (N,)."""
        return Jet(value, slope * self.rate, slope * self.acceleration + curvature * self.rate**2)


def sin(x: Jet) -> Jet:
    """Sine of an angle in radians."""
    s, c = np.sin(x.value), np.cos(x.value)
    return x.through(s, c, -s)


def cos(x: Jet) -> Jet:
    """Cosine of an angle in radians."""
    s, c = np.sin(x.value), np.cos(x.value)
    return x.through(c, -s, -c)


def zeros(count: int) -> Jet:
    """A Jet that is and stays 0."""
    return Jet(np.zeros(count), np.zeros(count), np.zeros(count))
