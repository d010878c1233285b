"""What is wrong with a sensor, from when on, and how the samples would be without it.

An estimate is uncertain by the scatter of the strides, which are alike in part: the strides of one foot err together,
so that many are worth 1 / ``ALIKE`` at most. Told is what is off by more than its uncertainty and by more than sound
sensors are, and is one fault, or two of which each is off by so much. What is only likely is said not to be known.

Also a foot's sensor heard while its owner walks: its newest strides, again after each one. Who asks often is wrong more
often: what lies is told when :data:`IN_A_ROW` hearings agree on it, and taken back when as many say without a doubt
that it does not.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any, Final, Literal

import numpy as np

from fes.estimation.closures import GAIN, LAG, SCALE, SOUND, closures
from fes.recording.tracks import Track
from fes.signals import NS_PER_S, FloatArray, IntArray
from fes.witness.estimate import (
    FEWEST,
    MOST,
    SCATTER_LEAST,
    BoolVector,
    Fit,
    Fits,
    Spans,
    biases_of,
    estimate,
    misfit_of,
    quiet_spans,
    spans_of,
)

Kind = Literal["lag", "gyr_gain", "gyr_bias", "acc_scale", "axes"]
# Chosen on the known half of the persons (docs/witness.md).
SURE: Final = 3.29  # standard deviations: one in a thousand, both sides
ALIKE: Final = 0.17  # correlation of the errors of two strides of a foot: by how sound feet scatter
LEAST: Final = {LAG: 0.013, GAIN: 0.075, SCALE: 0.05}  # moves stride length by 3.7, 3.2 and 3.3 %
BIAS_LEAST_RADPS: Final = math.radians(6.0)  # a step of it
SHARE: Final = 0.85  # of what lag and gain explain together, one alone has to
CLOSES: Final = -15.0  # a foot that closes no better shows nothing of its sensor
FEWEST_OF_PART: Final = 5  # strides before and after a change
AXES_CLOSE: Final = -6.0  # between quiet instants of whatever kind
AXES_GAINED: Final = 4.0
_NAMES: Final[dict[int, Kind]] = {LAG: "lag", GAIN: "gyr_gain", SCALE: "acc_scale"}
_IDENTITY: Final = np.eye(3)
_TURNS: Final = sorted(  # the simplest first: as they are, signs, exchanges
    (
        np.diag(signs)[list(order)].astype(float)
        for order in permutations(range(3))
        for signs in product((1, -1), repeat=3)
    ),
    key=lambda turn: (-np.abs(np.diag(turn)).sum(), -np.diag(turn).sum()),
)


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
    axes = _axes(quiet_spans(track))
    if axes is None or _closes(spans, axes.from_ns):
        axes = _axes(spans)
    if axes is not None:
        return Testimony((axes,), **about)
    if len(spans) < FEWEST:
        kept = f"{len(spans)} of {spans.found} strides are whole, off the limits and begin and end at rest"
        return Testimony(silent=f"{kept}; {FEWEST} are needed", **about)
    lies, doubt, _ = _judged(estimate(spans), len(spans))
    lies = _later(spans) or lies or _bias_step(spans)
    return Testimony(tuple(lies), "" if lies else doubt, **about)


def _uncertain(sd: float, strides: int) -> float:
    """The standard deviation of what strides show, from that of as many independent ones."""
    return sd * math.sqrt(1.0 + ALIKE * min(strides, MOST))


def _sure(gained: float, strides: int) -> bool:
    """Whether a gain, summed over strides, is one (likelihood ratio)."""
    return 2.0 * gained > SURE**2 * (1.0 + ALIKE * strides)


def _judged(fits: Fits, strides: int) -> tuple[list[Lie], str, Fit]:
    """Lag or gain, or both where each is needed, and the scale; where none is, why it cannot be told; the estimate."""
    if fits.both.misfit > CLOSES:
        return [], "its strides do not close well enough, whatever is assumed of the sensor", fits.plain
    used, doubt = min(strides, MOST), ""
    gained, one = fits.plain.misfit - fits.both.misfit, min(fits.lag, fits.gain, key=lambda fit: fit.misfit)
    fit, needed = fits.plain, []
    if _sure(used * gained, used):
        alone = fits.plain.misfit - one.misfit >= SHARE * gained
        fit = one if alone else fits.both
        needed = [LAG if one is fits.lag else GAIN] if alone else [LAG, GAIN]
    told = [_lie(fit, k, strides) for k in needed if _is_off(fit, k, strides)]
    if len(told) < len(needed):
        far = [_lie(fit, k, strides).describe() for k in needed if abs(fit.sensor[k] - SOUND[k]) > LEAST[k]]
        told, doubt = [], f"it may be that {' and '.join(far)}" if far else ""
    if all(_is_off(each, SCALE, strides) for each in (fits.plain, fit)):
        told.append(_lie(fit, SCALE, strides))
    return told, doubt, fit


def _is_off(fit: Fit, k: int, strides: int) -> bool:
    return abs(float(fit.sensor[k]) - SOUND[k]) > math.hypot(LEAST[k], SURE * _uncertain(float(fit.sd[k]), strides))


def _lie(fit: Fit, k: int, strides: int) -> Lie:
    return Lie(_NAMES[k], float(fit.sensor[k]), _uncertain(float(fit.sd[k]), strides), strides=strides)


def _later(spans: Spans) -> list[Lie]:
    """What the last strides show and the first ones do not, from the stride on at which it begins."""
    if len(spans) < 2 * FEWEST:
        return []
    lies, _, fit = _judged(estimate(spans.part(slice(-FEWEST, None))), FEWEST)
    if not lies:
        return []
    first = estimate(spans.part(slice(FEWEST))).plain
    for _ in range(2):
        begin = _begin(spans, first, fit)
        if not FEWEST_OF_PART <= begin <= len(spans) - FEWEST_OF_PART:
            return []
        rest = spans.part(slice(begin, None))
        again, _, refined = _judged(estimate(rest), len(rest))
        if not again and len(rest) >= FEWEST:  # all that is said to be so denies it
            return []
        lies, fit = (again, refined) if again else (lies, fit)
    return [replace(lie, from_ns=spans.t_ns(begin), strides=len(spans) - begin) for lie in lies]


def _begin(spans: Spans, before: Fit, after: Fit) -> int:
    """The stride at which an estimate takes the place of another; 0 where the strides before do not deny it."""
    tried = closures(spans.samples, spans.first, spans.last, np.array([before.sensor, after.sensor]))
    gained = _better(tried[0], tried[1])
    begin = _split(gained)
    return begin if _sure(-float(gained[:begin].sum()), begin) else 0


def _better(one: FloatArray, other: FloatArray) -> FloatArray:
    """(K,) by how much each stride's residuals (K, 6) are smaller in the other one."""
    gained: FloatArray = np.log((np.abs(one) + 10 * SCATTER_LEAST) / (np.abs(other) + 10 * SCATTER_LEAST)).sum(axis=1)
    return gained


def _split(gained: FloatArray) -> int:
    """The stride from which on the gain adds up to most."""
    return int(np.argmax(np.cumsum(gained[::-1])[::-1])) if gained.size else 0


def _axes(spans: Spans) -> Lie | None:
    """Axes with a wrong sign, exchanged or left-handed: of all ways to put them one that closes, where as they are the
    strides do not; of those that are not surely worse, the simplest."""
    if len(spans) > MOST + FEWEST and _axes(spans.thinned(MOST, FEWEST)) is None:
        return None
    tried = closures(spans.samples, spans.first, spans.last, np.tile(SOUND, (len(_TURNS), 1)), np.array(_TURNS))
    tried = np.nan_to_num(tried, nan=1e3)
    gained = np.array([_better(tried[0], each) for each in tried])
    begins = [_split(each) for each in gained]
    best = max(range(len(_TURNS)), key=lambda k: float(gained[k, begins[k] :].sum()))
    begin = begins[best]
    count = len(spans) - begin
    if count < FEWEST_OF_PART or not _sure(float(gained[best, begin:].sum()), count):
        return None
    worse = (gained[best, begin:] - gained[1:, begin:]).sum(axis=1).tolist()
    best = next(k for k, by in enumerate(worse, 1) if not _sure(by, count))
    best_misfit = float(misfit_of(tried[best, begin:]))
    if best_misfit > AXES_CLOSE or _plainly(spans.part(slice(begin, None))) - best_misfit < AXES_GAINED:
        return None
    acc_axes, gyr_axes, name = _named(_TURNS[best])
    whole = begin < FEWEST_OF_PART
    return Lie(
        "axes", from_ns=None if whole else spans.t_ns(begin), strides=len(spans) if whole else count,
        acc_axes=acc_axes, gyr_axes=gyr_axes, name=name,
    )  # fmt: skip


def _plainly(part: Spans) -> float:
    """The misfit of strides as they are, without a bias or with what the gyroscope reads at rest."""
    rests = np.array((SOUND, (0.0, 1.0, *part.rest_radps, 1.0)))
    return float(np.nan_to_num(misfit_of(closures(part.samples, part.first, part.last, rests)), nan=1e3).min())


def _closes(spans: Spans, from_ns: int | None) -> bool:
    """Whether the phase machine's own strides close from an instant on: then the axes are right."""
    begin = 0 if from_ns is None else int(np.searchsorted([spans.t_ns(k) for k in range(len(spans))], from_ns))
    return len(spans) - begin >= FEWEST_OF_PART and _plainly(spans.part(slice(begin, None))) < AXES_CLOSE


def _named(turn: FloatArray) -> tuple[FloatArray, FloatArray, str]:
    """How accelerometer and gyroscope are put right, and what was wrong, the simplest of what comes to the same.

    A turn of the gyroscope against the accelerometer comes to the same as the negative one of the accelerometer, seen
    in a mirror: the sign of one axis of the accelerometer as the signs of the two others of the gyroscope.
    """
    if np.array_equal(np.abs(turn), _IDENTITY):
        wrong = [axis for axis, sign in zip("xyz", np.diag(turn), strict=True) if sign < 0]
        if len(wrong) == 3:
            mirror = np.diag([1.0, 1.0, -1.0])
            name = "its axes are left-handed (one of both triads is mirrored), or the gyroscope's sense of turning is"
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
    splits = np.arange(FEWEST_OF_PART, len(spans) - FEWEST_OF_PART + 1)
    apart = -(-splits.size // MOST)  # of many strides some first, then those near the best of them
    best = _parting(biases, splits[::apart])
    at = _parting(biases, splits[np.abs(splits - best) < apart])
    before, after = biases[:at], biases[at:]
    steps = np.median(after, axis=0) - np.median(before, axis=0)
    axis = int(np.argmax(np.abs(steps)))
    step, before, after = float(steps[axis]), before[:, axis], after[:, axis]
    noise = 1.4826 * max(float(np.median(np.abs(part - np.median(part)))) for part in (before, after))
    sd = 1.25 * noise * math.hypot(*(_uncertain(1.0, len(part)) / math.sqrt(len(part)) for part in (before, after)))
    if abs(step) < math.hypot(BIAS_LEAST_RADPS, SURE * sd):
        return []
    return [Lie("gyr_bias", step, sd, spans.t_ns(at), len(after), "xyz"[axis])]


def _parting(values: FloatArray, splits: IntArray) -> int:
    """The split on whose two sides the values (K, 3) scatter least about their medians."""
    scatter = [sum(np.abs(part - np.median(part, axis=0)).sum() for part in np.split(values, [k])) for k in splits]
    return int(splits[np.argmin(scatter)])


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


KEPT_NS: Final = 120 * NS_PER_S  # of samples: as many strides as an estimate is made from, of a slow walker
HEARD: Final = 2 * FEWEST  # strides: what begins in the middle of them is told from what always was
IN_A_ROW: Final = 5  # hearings: single ones err (docs/witness.md)


class Hearing:
    """One foot's sensor; ``lies`` is what it surely says wrongly, ``unknown`` why it cannot be told, "" if it can."""

    def __init__(self, sensor: str, rate_hz: float) -> None:
        self.sensor, self.lies, self.unknown = sensor, "", _too_few(0)
        self._rate_hz = rate_hz
        self._t_ns: IntArray = np.empty(0, np.int64)
        self._values: FloatArray = np.empty((0, 6))
        self._strides: deque[tuple[int, int]] = deque(maxlen=HEARD)
        self._heard: deque[tuple[str, ...] | None] = deque(maxlen=IN_A_ROW)  # kinds of lies; None: not known
        self._told: tuple[str, ...] = ()
        self._is_new = False

    def add(self, t_ns: IntArray, values: FloatArray, strides: Sequence[tuple[int, int]]) -> None:
        """Samples by the sensor's own stamps (N,), force and rate (N, 6), and begin and end of strides in them."""
        self._t_ns, self._values = np.concatenate((self._t_ns, t_ns)), np.concatenate((self._values, values))
        if t_ns.size:
            kept = self._t_ns > t_ns[-1] - KEPT_NS
            self._t_ns, self._values = self._t_ns[kept], self._values[kept]
        self._strides.extend(strides)
        self._is_new |= bool(strides)

    def hear(self) -> bool:
        """Examine what is there; whether ``lies`` or ``unknown`` says something else now."""
        if not self._is_new:
            return False
        self._is_new = False
        before = self.lies, self.unknown
        borders = np.array([each for each in self._strides if each[0] >= self._t_ns[0]], np.int64).reshape(-1, 2)
        if len(borders) < FEWEST:
            self.unknown = _too_few(len(borders))
            return before != (self.lies, self.unknown)
        track = Track(self.sensor, self._rate_hz, self._t_ns, self._t_ns, self._values[:, :3], self._values[:, 3:])
        told = examine(track, borders[:, 0], borders[:, 1])
        kinds = tuple(lie.kind for lie in told.lies)
        self._heard.append(None if told.silent else kinds)
        if kinds != self._told and list(self._heard) == [kinds] * IN_A_ROW:
            self._told, self.lies = kinds, " and ".join(lie.describe() for lie in told.lies)
        self.unknown = "" if self.lies else told.silent
        return before != (self.lies, self.unknown)


def _too_few(strides: int) -> str:
    return f"{strides} of {FEWEST} strides"
