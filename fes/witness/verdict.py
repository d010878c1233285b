"""What is wrong with a sensor, from when on, and how the samples would be without it.

Told is only what hardly any sound sensor on the feet of ``docs/witness.md`` showed: an estimate well outside of what
these gave, that lets the strides close much better, and that is one fault, or two of which each is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any, Final, Literal

import numpy as np

from fes.estimation.closures import GAIN, LAG, SCALE, SOUND, closures
from fes.recording.tracks import Track
from fes.signals import FloatArray, IntArray
from fes.witness.estimate import (
    FEWEST,
    SCATTER_LEAST,
    BoolVector,
    Fit,
    Fits,
    Spans,
    biases_of,
    estimate,
    misfit_of,
    spans_of,
)

Kind = Literal["lag", "gyr_gain", "gyr_bias", "acc_scale", "axes"]
LEAST: Final = {LAG: 0.011, GAIN: 0.075, SCALE: 0.05}  # farther off than any sound foot that rests and does not drag
SYSTEMATIC: Final = {LAG: 0.004, GAIN: 0.02, SCALE: 0.01}  # standard deviation between sound feet
SURE: Final = 3.0
GAINED: Final = 0.5  # by so much the misfit has to fall
GAINED_LATER: Final = 1.2  # in a few strides
OF_ONE: Final = 0.85  # of what two faults together explain, that one has to, where both are off
OF_TWO: Final = 1.0  # or by so much both together have to explain more than either
CLOSES: Final = -15.0  # a foot that closes no better shows nothing of its sensor
WINDOW: Final = 20  # strides, looked at by themselves
BIAS_LEAST_RADPS: Final = math.radians(6.0)  # a step of it
BIAS_SURE: Final = 6.0
FEWEST_OF_PART: Final = 5  # strides before and after a change
AXES_CLOSE: Final = -3.0
AXES_GAINED: Final = 3.0
AXES_GAINED_STRIDE: Final = 5.0
_IDENTITY: Final = np.eye(3)
_TURNS: Final = [
    np.diag(signs)[list(order)].astype(float)
    for order in permutations(range(3))
    for signs in product((1, -1), repeat=3)
]


@dataclass(frozen=True, eq=False)
class Lie:
    """One thing that a sensor says wrongly.

    Attributes:
        kind: what; ``value`` and ``sd`` are in SI (s, 1, rad/s, 1), of axes 0.
        from_ns: when it begins; None: it holds from the first stride on.
        strides: that it was seen in.
        axis: x, y or z, of a bias.
        acc_axes: (3, 3) takes what the accelerometer reads to what a sound one would, ``gyr_axes`` likewise.
        name: of axes, in words.
    """

    kind: Kind
    value: float = 0.0
    sd: float = 0.0
    from_ns: int | None = None
    strides: int = 0
    axis: str = ""
    acc_axes: FloatArray | None = None
    gyr_axes: FloatArray | None = None
    name: str = ""

    def describe(self) -> str:
        """In physical terms, without the sensor's name."""
        match self.kind:
            case "lag":
                late = "late" if self.value > 0 else "early"
                return f"the accelerometer is {1e3 * abs(self.value):.0f} ± {1e3 * self.sd:.0f} ms {late}"
            case "gyr_gain":
                low = "low" if self.value < 1 else "high"
                by = f"{100 * abs(self.value - 1):.0f} ± {100 * self.sd:.0f} %"
                return f"the gyroscope reads {by} {low}, or the stated rate is as much off"
            case "acc_scale":
                low = "low" if self.value < 1 else "high"
                return f"the accelerometer reads {100 * abs(self.value - 1):.0f} ± {100 * self.sd:.0f} % {low}"
            case "gyr_bias":
                by = f"{math.degrees(self.value):+.0f} ± {math.degrees(self.sd):.0f} deg/s"
                return f"the gyroscope's {self.axis} axis reads {by} more"
            case "axes":
                return self.name


@dataclass(frozen=True, eq=False)
class Testimony:
    """What the witness says of one sensor; ``silent`` is why it cannot tell, "" if it can."""

    lies: tuple[Lie, ...] = ()
    silent: str = ""
    strides: int = 0
    limit_radps: float = math.inf
    clipped: int = 0


def examine(track: Track, starts_ns: IntArray, ends_ns: IntArray) -> Testimony:
    """Hold a foot sensor's strides against what a sound sensor must give.

    Args:
        track: its samples.
        starts_ns: (K,) when its strides begin, whether they could be measured or not.
        ends_ns: (K,) when they end.
    """
    spans = spans_of(track, starts_ns, ends_ns)
    about: dict[str, Any] = {"strides": len(spans), "limit_radps": spans.limit_radps, "clipped": spans.clipped}
    if len(spans) < FEWEST:
        kept = f"{len(spans)} of {spans.found} strides are whole, off the limits and begin and end at rest"
        why = f"{kept}; {FEWEST} are needed"
        return Testimony(silent=why, **about)
    if (axes := _axes(spans)) is not None:
        return Testimony((axes,), **about)
    fits = estimate(spans)
    lies = list(_judged(fits, len(spans)))
    if not lies:
        lies = _later(spans)
    lies += _bias_step(spans)
    best = min(fits.both.misfit, fits.plain.misfit)
    silent = "" if best < CLOSES or lies else "its strides do not close well enough, whatever is assumed of the sensor"
    return Testimony(tuple(lies), silent, **about)


def _judged(fits: Fits, strides: int, least: float = GAINED) -> list[Lie]:
    """Lag or gain, or both where each is needed; else the scale."""
    both = fits.both
    lags, gains, twos = (fits.plain.misfit - fit.misfit for fit in (fits.lag, fits.gain, both))
    far = {k: abs(both.sensor[k] - SOUND[k]) / LEAST[k] for k in (LAG, GAIN)}
    found: list[Lie] = []
    if both.misfit < CLOSES:
        if min(far.values()) > 1.0 and twos - max(lags, gains) > OF_TWO:
            found = [_lie("lag", both, LAG, strides), _lie("gyr_gain", both, GAIN, strides)]
        else:
            k = LAG if far[LAG] > far[GAIN] else GAIN
            one, gained = (fits.lag, lags) if k == LAG else (fits.gain, gains)
            alone = min(far.values()) <= 1.0 or gained >= OF_ONE * twos
            if gained > least and alone and far[k] > 0.85 and _is_off(one, k):
                found = [_lie("lag" if k == LAG else "gyr_gain", one, k, strides)]
    if _is_off(fits.plain, SCALE) and _is_off(both, SCALE):
        found.append(_lie("acc_scale", both, SCALE, strides))
    return found


def _is_off(fit: Fit, k: int) -> bool:
    off = abs(float(fit.sensor[k]) - SOUND[k])
    return off > max(LEAST[k], SURE * math.hypot(float(fit.sd[k]), SYSTEMATIC[k]))


def _lie(kind: Kind, fit: Fit, k: int, strides: int) -> Lie:
    return Lie(kind, float(fit.sensor[k]), math.hypot(float(fit.sd[k]), SYSTEMATIC[k]), strides=strides)


def _later(spans: Spans) -> list[Lie]:
    """What shows only in the last strides: of windows the first from which on all say the same."""
    if len(spans) < 2 * WINDOW:
        return []
    begins = list(range(0, len(spans) - WINDOW + 1, WINDOW))
    told = [_judged(estimate(spans.part(slice(at, at + WINDOW))), WINDOW, GAINED_LATER) for at in begins]
    for at, lies in zip(begins, told, strict=True):
        kinds = [{lie.kind for lie in each} for each in told[begins.index(at) :]]
        same = set.intersection(*kinds) if kinds else set()
        if at and same and lies:
            rest = spans.part(slice(at, None))
            now = _judged(estimate(rest), len(rest)) if len(rest) >= FEWEST else lies
            lies = [lie for lie in now if lie.kind in same] or [lie for lie in lies if lie.kind in same]
            begin = _begin(spans, lies, at)
            return [replace(lie, from_ns=spans.t_ns(begin), strides=len(spans) - begin) for lie in lies]
    return []


def _begin(spans: Spans, lies: list[Lie], seen: int) -> int:
    """The stride from which on the lies explain more than their absence."""
    sensor = np.array(SOUND)
    for lie in lies:
        sensor[{"lag": LAG, "gyr_gain": GAIN, "acc_scale": SCALE}[lie.kind]] = lie.value
    tried = closures(spans.samples, spans.first, spans.last, np.array([SOUND, sensor]))
    return _split(_better(tried[0], tried[1]), seen)


def _better(one: FloatArray, other: FloatArray) -> FloatArray:
    """(K,) by how much each stride's residuals (K, 6) are smaller in the other one."""
    gained: FloatArray = np.log((np.abs(one) + 10 * SCATTER_LEAST) / (np.abs(other) + 10 * SCATTER_LEAST)).sum(axis=1)
    return gained


def _split(gained: FloatArray, near: int | None = None) -> int:
    """The stride from which on the gain adds up to most."""
    rest = np.cumsum(gained[::-1])[::-1]
    low, high = (0, len(gained)) if near is None else (max(near - WINDOW, 0), near + 1)
    return low + int(np.argmax(rest[low:high]))


def _axes(spans: Spans) -> Lie | None:
    """Axes with a wrong sign, exchanged or left-handed: of all ways to put them, one that closes far better."""
    tried = closures(spans.samples, spans.first, spans.last, np.tile(SOUND, (len(_TURNS), 1)), np.array(_TURNS))
    tried = np.nan_to_num(tried, nan=1e3)
    plain = next(k for k, turn in enumerate(_TURNS) if np.array_equal(turn, _IDENTITY))
    best: tuple[float, int, int] | None = None
    for k in range(len(_TURNS)):
        gained = _better(tried[plain], tried[k])
        begin = _split(gained)
        if k != plain and (best is None or gained[begin:].sum() > best[0]):
            best = float(gained[begin:].sum()), k, begin
    assert best is not None
    _, k, begin = best
    count = len(spans) - begin
    if count < FEWEST_OF_PART:
        return None
    part = spans.part(slice(begin, None))
    rests = np.array((SOUND, (0.0, 1.0, *spans.rest_radps, 1.0)))  # without a bias, and with what it reads at rest
    plainly = float(np.nan_to_num(misfit_of(closures(part.samples, part.first, part.last, rests)), nan=1e3).min())
    best_misfit = float(misfit_of(tried[k, begin:]))
    if best_misfit > AXES_CLOSE or plainly - best_misfit < AXES_GAINED:
        return None
    if np.median(_better(tried[plain], tried[k])[begin:]) < AXES_GAINED_STRIDE:
        return None
    acc_axes, gyr_axes, name = _named(_TURNS[k])
    whole = begin < FEWEST_OF_PART
    return Lie(
        "axes", from_ns=None if whole else spans.t_ns(begin), strides=len(spans) if whole else count,
        acc_axes=acc_axes, gyr_axes=gyr_axes, name=name,
    )  # fmt: skip


def _named(turn: FloatArray) -> tuple[FloatArray, FloatArray, str]:
    """How accelerometer and gyroscope are put right, and what was wrong, the simplest of what comes to the same.

    A turn of the gyroscope against the accelerometer comes to the same as the negative one of the accelerometer, seen
    in a mirror: the sign of one axis of the accelerometer as the signs of the two others of the gyroscope.
    """
    if np.array_equal(np.abs(turn), _IDENTITY):
        wrong = [axis for axis, sign in zip("xyz", np.diag(turn), strict=True) if sign < 0]
        if len(wrong) == 3:
            mirror = np.diag([1.0, 1.0, -1.0])
            name = (
                "its axes are left-handed (one axis of both triads is mirrored), or the gyroscope's sense of turning is"
            )
            return mirror, mirror, name
        if len(wrong) == 2:
            (axis,) = set("xyz") - set(wrong)
            return -turn @ _IDENTITY, _IDENTITY, f"the accelerometer's {axis} axis has the wrong sign"
        return _IDENTITY, turn, f"the gyroscope's {wrong[0]} axis has the wrong sign"
    moved = [axis for axis, row in zip("xyz", np.abs(turn), strict=True) if row["xyz".index(axis)] == 0]
    signs = turn.sum(axis=1)
    if len(moved) == 2 and (signs < 0).all():
        return -turn, _IDENTITY, f"the accelerometer's {moved[0]} and {moved[1]} axes are exchanged"
    if len(moved) == 2:
        more = "" if (signs > 0).all() else ", and signs changed"
        return _IDENTITY, turn, f"the gyroscope's {moved[0]} and {moved[1]} axes are exchanged{more}"
    return _IDENTITY, turn, "the gyroscope's axes stand in another order than the accelerometer's"


def _bias_step(spans: Spans) -> list[Lie]:
    """The axis of the gyroscope whose bias changes for good at some stride; a constant one is calibrated away."""
    biases = biases_of(spans)
    count = len(spans)
    splits = range(FEWEST_OF_PART, count - FEWEST_OF_PART + 1)
    steps = [np.median(biases[k:], axis=0) - np.median(biases[:k], axis=0) for k in splits]
    left = [np.abs(biases[:k] - np.median(biases[:k], axis=0)).sum() for k in splits]
    right = [np.abs(biases[k:] - np.median(biases[k:], axis=0)).sum() for k in splits]
    best = int(np.argmin(np.add(left, right)))
    at, axis = splits[best], int(np.argmax(np.abs(steps[best])))
    step, before, after = float(steps[best][axis]), biases[:at, axis], biases[at:, axis]
    noise = 1.4826 * max(float(np.median(np.abs(part - np.median(part)))) for part in (before, after))
    sd = 1.25 * noise * math.sqrt(1.0 / len(before) + 1.0 / len(after))
    if abs(step) < max(BIAS_LEAST_RADPS, 2.0 * noise, BIAS_SURE * sd):
        return []
    return [Lie("gyr_bias", step, max(sd, math.radians(0.5)), spans.t_ns(at), len(after), "xyz"[axis])]


def corrected(track: Track, lies: tuple[Lie, ...]) -> Track:
    """The samples as a sound sensor would have given them, as far as the lies can be undone: all of them can."""
    acc, gyr = track.acc_mps2.copy(), track.gyr_radps.copy()
    t_ns = track.t_sensor_ns
    for lie in lies:
        own: BoolVector = t_ns >= (t_ns[0] if lie.from_ns is None else lie.from_ns)
        match lie.kind:
            case "lag":
                at = t_ns[own] + 1e9 * lie.value
                newest = np.maximum.accumulate(t_ns)
                acc[own] = np.column_stack([np.interp(at, newest, axis) for axis in track.acc_mps2.T])
            case "gyr_gain":
                gyr[own] /= lie.value
            case "acc_scale":
                acc[own] /= lie.value
            case "gyr_bias":
                gyr[own, "xyz".index(lie.axis)] -= lie.value
            case "axes":
                assert lie.acc_axes is not None
                assert lie.gyr_axes is not None
                acc[own], gyr[own] = acc[own] @ lie.acc_axes.T, gyr[own] @ lie.gyr_axes.T
    return replace(track, acc_mps2=acc, gyr_radps=gyr)
