"""Units a sidecar may name, and their size in SI; whether they are what it says: gravity and turning rates tell.

Wrong units would not crash: they would give wrong phases, and stimulation at the wrong moment. So they are refused.
Single time stamps that are wrong among right ones are found here too, by the usual interval of a sensor's stamps.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from pydantic import BeforeValidator

from fes.recording.tracks import RecordingError
from fes.signals import G_MPS2, NS_PER_S, FloatArray, IntArray

ACC_UNITS: Final = {"m/s^2": 1.0, "g": G_MPS2, "mg": G_MPS2 * 1e-3}
GYR_UNITS: Final = {"rad/s": 1.0, "deg/s": math.pi / 180.0, "mdeg/s": math.pi / 180e3}
TIME_UNITS_NS: Final = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
SAMPLES: Final = "samples"  # a counter's unit: the rate says how long one lasts

_SPELT: Final = {
    "m/s^2": ("m/s2", "m/s²", "m/s/s", "m/s**2", "m s^-2", "mps2"),
    "deg/s": ("deg/sec", "degree/s", "degrees/s", "°/s", "dps"),
    "mdeg/s": ("mdps",),
    "rad/s": ("rad/sec", "rps"),
    "s": ("sec", "seconds"),
    "ms": ("msec", "milliseconds"),
    "us": ("µs", "μs", "usec", "microseconds"),
    "ns": ("nanoseconds",),
}
_SPELLINGS: Final = {spelling: unit for unit, spellings in _SPELT.items() for spelling in spellings}


def canonical(unit: object) -> object:
    """Return the spelling used here of a unit; what is no known spelling comes back as it was."""
    if isinstance(unit, str):
        plain = unit.strip()
        return _SPELLINGS.get(plain.lower(), plain if plain in ("g", "s") else plain.lower())
    return unit


def _unit(value: object, allowed: Mapping[str, float], si: str) -> str | float:
    unit = canonical(value)
    if isinstance(unit, str) and unit in allowed:
        return unit
    if isinstance(unit, (int, float)) and not isinstance(unit, bool) and 0 < unit < math.inf:
        return float(unit)
    names = ", ".join(f'"{name}"' for name in allowed)
    raise ValueError(f"must be {names}, or, for counts, the size of one count in {si}")


AccUnit = Annotated[str | float, BeforeValidator(lambda value: _unit(value, ACC_UNITS, "m/s²"))]
GyrUnit = Annotated[str | float, BeforeValidator(lambda value: _unit(value, GYR_UNITS, "rad/s"))]
TimeUnit = Annotated[str | float, BeforeValidator(lambda value: _unit(value, {**TIME_UNITS_NS, SAMPLES: 1}, "s"))]


def acc_factor(unit: str | float) -> float:
    """m/s² per unit; a number is its own factor (raw counts)."""
    return ACC_UNITS[unit] if isinstance(unit, str) else unit


def time_factor_ns(unit: str | float, rate_hz: float | None) -> float:
    """Nanoseconds per unit; a number is seconds per count, and “samples” come at the rate."""
    if unit == SAMPLES:
        return NS_PER_S / (rate_hz or 1.0)
    return TIME_UNITS_NS[unit] if isinstance(unit, str) else unit * NS_PER_S


def gyr_factor(unit: str | float) -> float:
    """rad/s per unit; a number is its own factor (raw counts)."""
    return GYR_UNITS[unit] if isinstance(unit, str) else unit


WINDOW_S = 0.15  # the foot is flat for about 0.3 s of every stride: a window fits in whatever its phase
QUIET_SHARE = 0.05
GRAVITY_BAND = (0.75, 1.33)  # quiet shanks and lively feet still read within it, g and m/s² are a factor 9.8 apart
MAX_RATE_RADPS = 60.0  # 3400 deg/s: no leg turns so fast, no usual sensor measures it
MOVING_MPS2 = 3.0  # walking feet leave 1 g by more than 10 m/s², idle ones by less than 1
MIN_MOVING_RADPS = 0.35  # 20 deg/s: a foot that walks peaks at 200 to 600
SAMPLED_S = 10.0  # of a long recording so long stretches are looked at …
STRETCHES = 24  # … so many of them, evenly apart: units do not change in between


@dataclass(frozen=True)
class _Spreads:
    """Squared lengths (M,) of what was looked at of a sensor, and its spread (K,) in windows of ``window`` samples."""

    squares: FloatArray
    spread: FloatArray
    window: int

    def relative(self) -> FloatArray:
        """The spread (K,) as a share of the usual one, so that no unit is needed."""
        return self.spread / (float(np.median(self.spread)) or 1.0)

    def size_in(self, windows: IntArray) -> float:
        """The usual length in some of the windows."""
        within = self.squares[: len(self.spread) * self.window].reshape(-1, self.window)
        return float(np.median(np.sqrt(within[windows]).ravel()))


def quiet_level(acc: FloatArray, gyr: FloatArray, rate_hz: float) -> tuple[float, float]:
    """Return medians over the quietest windows of (N, 3) raw vectors: of their lengths, in the units of the file.

    Quietness is the spread of the acceleration in a window and its turning rate, each relative to its median over
    the file, so that no unit is needed to rank by it.
    """
    return _quiet(*_window_spreads(acc, gyr, rate_hz, len(acc)))


def _window_spreads(acc: FloatArray, gyr: FloatArray, rate_hz: float, size: int) -> tuple[_Spreads, _Spreads]:
    """Look at evenly spread stretches of ``size`` rows, or at all (N, 3) of them where they are no more."""
    from fes.estimation.numerics.filters import spreads  # here, for who only writes recordings needs no compiler

    size = min(size, len(acc))
    begins = np.linspace(0, len(acc) - size, STRETCHES).astype(np.int64)
    if len(acc) <= STRETCHES * size:
        begins, size = begins[:1], len(acc)
    window = min(max(4, round(WINDOW_S * rate_hz)), len(begins) * size)

    def spreads_of(vectors: FloatArray) -> _Spreads:
        squares = np.empty(len(begins) * size)
        spread = np.empty(len(squares) // window)
        spreads(np.ascontiguousarray(vectors), begins, size, window, squares, spread)
        return _Spreads(squares, spread, window)

    return spreads_of(acc), spreads_of(gyr)


def _quiet(acc: _Spreads, gyr: _Spreads) -> tuple[float, float]:
    restless = acc.relative() + gyr.relative()
    last = max(1, math.ceil(QUIET_SHARE * len(restless))) - 1
    chosen = np.flatnonzero(restless <= np.partition(restless, last)[last])
    return acc.size_in(chosen), gyr.size_in(chosen)


GRAVITY_GONE: Final = (
    "gravity was subtracted by the device (“linear”, “free” or “user” acceleration): its mean is nearly 0. Export the "
    "stream that has it in, called “raw”, “total” or “accelerometer”"
)
_MEAN_SHARE: Final = 0.15  # of the usual size; a foot that walks keeps gravity's direction: 0.6 and more


def gravity_subtracted(acc: FloatArray) -> bool:
    """Whether (N, 3) readings of a moving sensor, in any unit, have no gravity in them."""
    usual = float(np.median(np.linalg.norm(acc, axis=1))) if len(acc) else 0.0
    return usual > 0.0 and float(np.linalg.norm(acc.mean(axis=0))) < _MEAN_SHARE * usual


def check_units(
    where: str, acc: FloatArray, gyr: FloatArray, rate_hz: float, acc_unit: str | float, gyr_unit: str | float
) -> None:
    """Check (N, 3) vectors in the file's units against what the sidecar says of them.

    Of more than four minutes, stretches from beginning to end that make four minutes together are looked at.

    Raises:
        RecordingError: gravity or the turning rates do not fit; the message says which unit would.
    """
    of_acc, of_gyr = _window_spreads(acc, gyr, rate_hz, round(SAMPLED_S * rate_hz))
    factors = acc_factor(acc_unit), gyr_factor(gyr_unit)
    low, high = (G_MPS2 * bound for bound in GRAVITY_BAND)
    quiet_mps2 = _quiet(of_acc, of_gyr)[0] * factors[0]
    if not low <= quiet_mps2 <= high and gravity_subtracted(acc):
        raise RecordingError(f"{where}: {GRAVITY_GONE}")
    _check_gravity(where, _quiet(of_acc, of_gyr), acc_unit, factors[0])
    _check_turning(where, of_acc.squares, of_gyr.squares, gyr_unit, factors)


def _check_gravity(where: str, quiet: tuple[float, float], unit: str | float, factor: float) -> None:
    acc, gyr = quiet
    low, high = (G_MPS2 * bound for bound in GRAVITY_BAND)
    if low <= acc * factor <= high:
        return
    reading = f"{where}: at rest the accelerometer reads {acc:.4g}"
    for other, size in ACC_UNITS.items():
        if low <= acc * size <= high:
            raise RecordingError(
                f"{reading}, which looks like {other} (gravity is {G_MPS2 / size:.4g} {other}), but acc_unit = "
                f'{_shown(unit)}: set acc_unit = "{other}"'
            )
    for other, size in ACC_UNITS.items():
        if acc < 0.2 * gyr and low <= gyr * size <= high:
            raise RecordingError(
                f"{reading} and the gyroscope {gyr:.4g}, which looks like gravity in {other}: the columns of acc "
                f"and gyr are swapped; exchange the two lists"
            )
    if acc * factor < 0.25 * G_MPS2:
        raise RecordingError(
            f"{reading} {_shown(unit)}: gravity is missing. Either acc names the wrong columns, or the sensor was told "
            f"to subtract gravity (“linear” or “free” acceleration): export the raw acceleration"
        )
    raise RecordingError(
        f"{reading} {_shown(unit)} where gravity ({G_MPS2 / factor:.4g}) is due. Check the columns of acc and "
        f"acc_unit; if these are raw counts, say acc_unit = {G_MPS2 / acc:.4g} (m/s² per count)"
    )


def _check_turning(
    where: str, acc_squares: FloatArray, squares: FloatArray, unit: str | float, factors: tuple[float, float]
) -> None:
    factor = factors[1]
    # a percentile lies between two of the values, which are not sought out where a glance tells enough
    fast = np.count_nonzero(squares >= (MIN_MOVING_RADPS / factor) ** 2) > 0.01 * (len(squares) - 1) + 1
    if fast and squares.max() <= (MAX_RATE_RADPS / factor) ** 2:
        return
    peak = float(np.percentile(np.sqrt(squares), 99.0))
    fitting = next((other for other, size in GYR_UNITS.items() if 1.0 <= peak * size <= 40.0), "")  # of a walking leg
    fix = f'this looks like {fitting}: set gyr_unit = "{fitting}"' if fitting else "check gyr and gyr_unit"
    if peak * factor > MAX_RATE_RADPS:
        raise RecordingError(
            f"{where}: the gyroscope's peaks of {peak:.4g} (99th percentile) with gyr_unit = {_shown(unit)} would be "
            f"{math.degrees(peak * factor):.0f} deg/s, more than any leg turns; {fix}"
        )
    moved = float(np.percentile(np.abs(factors[0] * np.sqrt(acc_squares) - G_MPS2), 99.0))
    if moved > MOVING_MPS2 and peak * factor < MIN_MOVING_RADPS:
        raise RecordingError(
            f"{where}: the accelerometer shows movement ({moved:.1f} m/s² beside gravity), but the gyroscope's peaks "
            f"of {peak:.4g} with gyr_unit = {_shown(unit)} would be only {math.degrees(peak * factor):.2g} deg/s; {fix}"
        )


def _shown(unit: str | float) -> str:
    return f'"{unit}"' if isinstance(unit, str) else f"{unit:g}"


MAX_BACKWARD_SHARE = 0.05
MAX_BACKWARD_JUMP_NS = NS_PER_S
GAP_INTERVALS: Final = 1.5  # usual intervals: from there on a sample is missing
_BUNCH: Final = 8  # stamps that may come in a bunch, as radios and Android bring them
_ONE_BETWEEN: Final = (1.5, 4.5)  # usual intervals from neighbour to neighbour: the sample belongs between them
FAR_INTERVALS: Final = 5.0  # more than jitter and swapped packets; what is nearer is counted as backward or irregular


def usual_interval_ns(stamps_ns: IntArray) -> float:
    """The usual interval of (N,) increasing stamps, whatever bunches they come in; N is 2 or more."""
    over = min(_BUNCH, stamps_ns.size - 1)
    return float(np.median(stamps_ns[over:] - stamps_ns[:-over])) / over


def repaired(stamps_ns: IntArray, *, doubled: bool = False) -> tuple[IntArray, int]:
    """Put single wrong stamps of (N,) between their neighbours; the same array where none is wrong, and how many.

    A stamp is wrong that is more than ``FAR_INTERVALS`` from where its neighbours say, where these are so far apart
    that a sample is due between them. The first and the last, which have one neighbour, are wrong where they are
    further off than all others lie apart: a stall of seconds before the last sample is none. Two samples in the wrong
    order and a clock that jumps for good are none either. What is off by less is left as a live session has it.

    Args:
        stamps_ns: as the file has them.
        doubled: the stamp of the sample before is wrong too, where a sample is due.
    """
    steps = stamps_ns[1:] - stamps_ns[:-1]
    if stamps_ns.size < 4:
        return stamps_ns, 0
    rest_ns = int(np.abs(stamps_ns[-2] - stamps_ns[1]))
    if steps.min() > 0 and max(steps[0], steps[-1]) <= rest_ns:
        return stamps_ns, 0
    forward = steps[steps > 0]
    if not forward.size:
        return stamps_ns, 0
    usual_ns = float(np.median(forward))
    before, at, after = stamps_ns[:-2], stamps_ns[1:-1], stamps_ns[2:]
    apart, due = after - before, before + (after - before) // 2
    wrong = (np.abs(at - due) > FAR_INTERVALS * usual_ns) | (doubled & (at == before))
    wrong &= (apart >= _ONE_BETWEEN[0] * usual_ns) & (apart <= _ONE_BETWEEN[1] * usual_ns)
    out = stamps_ns.copy()
    out[1:-1][wrong] = due[wrong]
    count = int(np.count_nonzero(wrong))
    for end, neighbour, next_one in ((0, 1, 2), (-1, -2, -3)):
        step = int(out[neighbour] - out[next_one])
        follows = 0 < abs(step) <= _ONE_BETWEEN[0] * usual_ns and (step < 0) == (end == 0)
        if follows and abs(int(out[end]) - int(out[neighbour]) - step) > rest_ns:
            out[end] = out[neighbour] + step
            count += 1
    return (out, count) if count else (stamps_ns, 0)


def refuse_wild_clock(steps: IntArray, backward: IntArray, where: str, place: Callable[[int], str]) -> None:
    """Refuse steps (N - 1,) of a clock of which those at ``backward`` (K,), one or more, go back too far or too often.

    Raises:
        RecordingError: they do; ``place`` tells where a stamp stands in the file.
    """
    furthest = int(backward[np.argmin(steps[backward])])
    back_s = -float(steps[furthest]) / NS_PER_S
    if back_s > MAX_BACKWARD_JUMP_NS / NS_PER_S:
        raise RecordingError(
            f"{where}: {place(furthest + 1)}: the clock jumps back {back_s:.3f} s. "
            f"If two recordings follow each other there, split the file; if the clock restarted, correct its times."
        )
    if backward.size > MAX_BACKWARD_SHARE * steps.size:
        raise RecordingError(
            f"{where}: time goes backward {backward.size} times in {steps.size + 1} samples, first at "
            f"{place(int(backward[0]) + 1)}; at most {MAX_BACKWARD_SHARE:.0%} can be handled. "
            f"Sort the rows by time, or leave time_column out and state rate_hz."
        )
