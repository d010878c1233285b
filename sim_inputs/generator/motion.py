"""Building blocks of a motion: smooth steps, pulses of speed, ringing and wander; twice continuously differentiable.

A channel (one coordinate over time) is a sum of such blocks. Each acts over a limited time and is constant outside
it, so a channel of hundreds of strides costs no more than its samples. Derivatives are exact, not by differences.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

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


class Block(Protocol):
    """One summand of a channel."""

    def add(self, t_s: FloatArray, value: FloatArray, rate: FloatArray, acceleration: FloatArray) -> None:
        """Add this block's value and derivatives at the ascending instants ``t_s`` (N,) into the arrays, in place."""


def step_value(u: FloatArray, m: int, n: int) -> FloatArray:
    """Integral from 0 to u of ``u^m (1-u)^n``, scaled to end at 1: the regularised incomplete beta, as a polynomial."""
    degree = m + n + 1
    total = np.zeros_like(u)
    for j in range(m + 1, degree + 1):
        total += math.comb(degree, j) * u**j * (1.0 - u) ** (degree - j)
    return total


def step_time(fraction: float, m: int, n: int) -> float:
    """The u in [0, 1] at which a step of shape (m, n) has covered ``fraction`` (0–1) of its height."""
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if step_value(np.array([middle]), m, n)[0] < fraction else (low, middle)
    return 0.5 * (low + high)


@dataclass(frozen=True, slots=True)
class Step:
    """Goes from 0 to ``amplitude`` between ``start_s`` and ``end_s``; its rate is a hump ``u^m (1-u)^n``.

    The rate peaks at ``u = m / (m + n)``; m and n of at least 2 keep the acceleration continuous.
    """

    start_s: float
    end_s: float
    amplitude: float
    m: int = 2
    n: int = 2

    def add(self, t_s: FloatArray, value: FloatArray, rate: FloatArray, acceleration: FloatArray) -> None:
        """See :class:`Block`."""
        first, last = np.searchsorted(t_s, [self.start_s, self.end_s])
        length = self.end_s - self.start_s
        u = (t_s[first:last] - self.start_s) / length
        m, n = self.m, self.n
        scale = self.amplitude * (m + n + 1) * math.comb(m + n, m)
        value[first:last] += self.amplitude * step_value(u, m, n)
        value[last:] += self.amplitude
        rate[first:last] += scale / length * u**m * (1.0 - u) ** n
        slope = u ** (m - 1) * (1.0 - u) ** (n - 1) * (m - (m + n) * u)
        acceleration[first:last] += scale / length**2 * slope


@dataclass(frozen=True, slots=True)
class Pulse:
    """Moves at ``speed``: the rate rises over ``start_s … full_s`` and falls over ``brake_s … end_s`` (m = n = 2)."""

    start_s: float
    full_s: float
    brake_s: float
    end_s: float
    speed: float

    @property
    def total(self) -> float:
        """How far it goes in all."""
        return self.speed * 0.5 * (self.brake_s + self.end_s - self.start_s - self.full_s)

    def add(self, t_s: FloatArray, value: FloatArray, rate: FloatArray, acceleration: FloatArray) -> None:
        """See :class:`Block`."""
        a, b, c, d = np.searchsorted(t_s, [self.start_s, self.full_s, self.brake_s, self.end_s])
        rise, fall = self.full_s - self.start_s, self.end_s - self.brake_s
        up = (t_s[a:b] - self.start_s) / rise
        down = (t_s[c:d] - self.brake_s) / fall
        before = self.speed * 0.5 * rise
        value[a:b] += self.speed * rise * _step_integral(up)
        value[b:c] += before + self.speed * (t_s[b:c] - self.full_s)
        plateau = before + self.speed * (self.brake_s - self.full_s)
        value[c:d] += plateau + self.speed * (t_s[c:d] - self.brake_s - fall * _step_integral(down))
        value[d:] += self.total
        rate[a:b] += self.speed * step_value(up, 2, 2)
        rate[b:c] += self.speed
        rate[c:d] += self.speed * (1.0 - step_value(down, 2, 2))
        acceleration[a:b] += self.speed / rise * 30.0 * (up * (1.0 - up)) ** 2
        acceleration[c:d] -= self.speed / fall * 30.0 * (down * (1.0 - down)) ** 2


def _step_integral(u: FloatArray) -> FloatArray:
    """Integral of the (2, 2) step ``10u³ - 15u⁴ + 6u⁵``."""
    return u**4 * (2.5 - 3.0 * u + u * u)


@dataclass(frozen=True, slots=True)
class Ring:
    """A damped oscillation ``peak / w² · sin(w s) · e^(-s/decay)``, s being the time since ``start_s``.

    A factor ``1 - e^(-(s/rise)³)`` starts it without a jump. ``peak`` is about the greatest acceleration it causes,
    as long as ``rise_s`` is not far below 1/w.
    """

    start_s: float
    peak: float
    frequency_hz: float
    decay_s: float
    rise_s: float = 0.004

    def add(self, t_s: FloatArray, value: FloatArray, rate: FloatArray, acceleration: FloatArray) -> None:
        """See :class:`Block`."""
        first, last = np.searchsorted(t_s, [self.start_s, self.start_s + 14.0 * self.decay_s])
        s = t_s[first:last] - self.start_s
        w = 2.0 * math.pi * self.frequency_hz
        fade = np.exp(-s / self.decay_s)
        wave = Jet(
            np.sin(w * s) * fade,
            (w * np.cos(w * s) - np.sin(w * s) / self.decay_s) * fade,
            ((1.0 / self.decay_s**2 - w * w) * np.sin(w * s) - 2.0 * w / self.decay_s * np.cos(w * s)) * fade,
        )
        x = s / self.rise_s
        drop = np.exp(-(x**3))
        gate = Jet(1.0 - drop, 3.0 * x**2 * drop / self.rise_s, (6.0 * x - 9.0 * x**4) * drop / self.rise_s**2)
        both = wave * gate * (self.peak / w**2)
        value[first:last] += both.value
        rate[first:last] += both.rate
        acceleration[first:last] += both.acceleration


@dataclass(frozen=True, slots=True)
class Wander:
    """A cubic B-spline with free coefficients: sway, tremor, the shaking of a belt. Zero before and after its time.

    ``knots`` (K,) weigh the K humps; hump k is centred at ``start_s + (k + 2) · spacing_s`` and lasts 4 spacings.
    """

    start_s: float
    spacing_s: float
    knots: FloatArray

    def add(self, t_s: FloatArray, value: FloatArray, rate: FloatArray, acceleration: FloatArray) -> None:
        """See :class:`Block`."""
        h = self.spacing_s
        first, last = np.searchsorted(t_s, [self.start_s, self.start_s + h * (len(self.knots) + 3)])
        place = (t_s[first:last] - self.start_s) / h
        cell = np.minimum(place.astype(np.int64), len(self.knots) + 2)
        u = place - cell
        padded = np.concatenate([np.zeros(3), self.knots, np.zeros(3)])
        p0, p1, p2, p3 = (padded[cell + k] for k in range(4))
        v = 1.0 - u
        value[first:last] += (
            v**3 * p0 + (3 * u**3 - 6 * u**2 + 4) * p1 + (3 * v**3 - 6 * v**2 + 4) * p2 + u**3 * p3
        ) / 6
        rate[first:last] += (-(v**2) * p0 + (3 * u**2 - 4 * u) * p1 + (4 * v - 3 * v**2) * p2 + u**2 * p3) / (2 * h)
        acceleration[first:last] += (v * p0 + (3 * u - 2) * p1 + (3 * v - 2) * p2 + u * p3) / h**2


def wander(rng: np.random.Generator, start_s: float, end_s: float, spacing_s: float, size: float) -> Wander:
    """A random :class:`Wander` over ``start_s … end_s`` whose knots are normal with standard deviation ``size``."""
    count = max(1, int((end_s - start_s) / spacing_s) - 3)
    return Wander(start_s, spacing_s, rng.normal(0.0, size, count))


def evaluate(blocks: Sequence[Block], t_s: FloatArray) -> Jet:
    """The sum of ``blocks`` at the ascending instants ``t_s`` (N,) in seconds."""
    value, rate, acceleration = np.zeros_like(t_s), np.zeros_like(t_s), np.zeros_like(t_s)
    for block in blocks:
        block.add(t_s, value, rate, acceleration)
    return Jet(value, rate, acceleration)
