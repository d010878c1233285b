"""Units a sidecar may name, and their size in SI."""

from __future__ import annotations

import math
from typing import Annotated, Final, Literal

from pydantic import BeforeValidator

from fes.signals import G_MPS2

ACC_UNITS: Final = {"m/s^2": 1.0, "g": G_MPS2, "mg": G_MPS2 * 1e-3}
GYR_UNITS: Final = {"rad/s": 1.0, "deg/s": math.pi / 180.0, "mdeg/s": math.pi / 180e3}
TIME_UNITS_NS: Final = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}

_SPELLINGS: Final = {
    "m/s2": "m/s^2",
    "m/s²": "m/s^2",
    "m/s/s": "m/s^2",
    "m/s**2": "m/s^2",
    "m s^-2": "m/s^2",
    "mps2": "m/s^2",
    "deg/sec": "deg/s",
    "degree/s": "deg/s",
    "degrees/s": "deg/s",
    "°/s": "deg/s",
    "dps": "deg/s",
    "mdps": "mdeg/s",
    "rad/sec": "rad/s",
    "rps": "rad/s",
    "µs": "us",
    "μs": "us",
    "sec": "s",
    "seconds": "s",
    "msec": "ms",
    "milliseconds": "ms",
    "usec": "us",
    "microseconds": "us",
    "nanoseconds": "ns",
}


def canonical(unit: object) -> object:
    """Return the spelling used here of a unit; what is no known spelling comes back as it was."""
    if isinstance(unit, str):
        plain = unit.strip()
        return _SPELLINGS.get(plain.lower(), plain if plain in ("g", "s") else plain.lower())
    return unit


def _unit(value: object, allowed: dict[str, float], si: str) -> str | float:
    unit = canonical(value)
    if isinstance(unit, str) and unit in allowed:
        return unit
    if isinstance(unit, (int, float)) and not isinstance(unit, bool) and 0 < unit < math.inf:
        return float(unit)
    names = ", ".join(f'"{name}"' for name in allowed)
    raise ValueError(f"must be {names}, or, for raw counts, the size of one count in {si}")


def _acc_unit(value: object) -> str | float:
    return _unit(value, ACC_UNITS, "m/s²")


def _gyr_unit(value: object) -> str | float:
    return _unit(value, GYR_UNITS, "rad/s")


AccUnit = Annotated[str | float, BeforeValidator(_acc_unit)]
GyrUnit = Annotated[str | float, BeforeValidator(_gyr_unit)]
TimeUnit = Annotated[Literal["s", "ms", "us", "ns"], BeforeValidator(canonical)]


def acc_factor(unit: str | float) -> float:
    """m/s² per unit; a number is its own factor (raw counts)."""
    return ACC_UNITS[unit] if isinstance(unit, str) else unit


def gyr_factor(unit: str | float) -> float:
    """rad/s per unit; a number is its own factor (raw counts)."""
    return GYR_UNITS[unit] if isinstance(unit, str) else unit
