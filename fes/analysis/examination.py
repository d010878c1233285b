"""The sensors of an analysis before the witness: what lies, what that does to the numbers, and what to do about it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Final, Protocol

import numpy as np

from fes.analysis.tables import Table
from fes.recording import Recording
from fes.recording.at_once import at_once
from fes.recording.tracks import Track
from fes.signals import FOOT_SENSORS, StrideResult
from fes.walk_record import Finding
from fes.witness import Lie, Testimony, corrected, examine
from fes.witness.estimate import FEWEST
from fes.witness.frozen import dead_band_radps, frozen_rows
from fes.witness.verdict import SURE


class Analysis(Protocol):
    """What is examined: :class:`fes.analysis.results.Analysis`."""

    @property
    def recording(self) -> Recording: ...  # noqa: D102

    @property
    def raw(self) -> dict[str, Track]: ...  # noqa: D102

    @property
    def corrections(self) -> Mapping[str, tuple[Lie, ...]]: ...  # noqa: D102

    @property
    def uncorrected(self) -> Mapping[str, Mapping[str, float]]: ...  # noqa: D102

    @property
    def blocks(self) -> Any: ...  # noqa: D102

    @property
    def strides(self) -> list[StrideResult]: ...  # noqa: D102

    @property
    def stride_columns(self) -> Table: ...  # noqa: D102

    @property
    def testimonies(self) -> dict[str, Testimony]: ...  # noqa: D102


# Of the speed: on a belt two sound feet were measured apart by 6 % at most, in 20 walks.
APART: Final = 0.08
STRAIGHT_RAD: Final = math.radians(10.0)  # of a stride: in a curve the outer foot goes farther
GREAT: Final = 0.05  # of a key number: what is more has to be looked at before the numbers are used
_REMEDIES: Final = {
    "lag": "read both triads from one stream with one clock, or analyse with --correct",
    "gyr_gain": "check the gyroscope's unit and range and the stated rate, or analyse with --correct",
    "acc_scale": "check the accelerometer's unit and range, or analyse with --correct",
    "gyr_bias": "record anew, with a second of standing at the begin and end, or analyse with --correct",
    "axes": "check the order and the signs of the columns in the sidecar, or analyse with --correct",
}
_NUMBERS: Final = (
    ("stride length", "stride_length_m", 1.0, "m", 2),
    ("toe clearance", "toe_clearance_m", 100.0, "cm", 1),
)


def testimonies(result: Analysis) -> dict[str, Testimony]:
    """What the witness says of every foot sensor that has strides."""

    def examined(sensor: str) -> Testimony:
        rows = result.blocks[sensor].rows
        return examine(result.recording.tracks[sensor], rows["t_start_ns"], rows["t_end_ns"])

    return at_once(examined, (sensor for sensor, block in result.blocks.items() if len(block.rows)))


def without_lies(recording: Recording, lies: Mapping[str, tuple[Lie, ...]]) -> Recording:
    """The recording as sound sensors would have given it."""
    tracks = {name: corrected(track, lies.get(name, ())) for name, track in recording.tracks.items()}
    return replace(recording, tracks=tracks)


def sensor_findings(result: Analysis, anew: Callable[[Recording], Analysis]) -> tuple[Finding, ...]:
    """All findings about the sensors of an analysis; ``anew`` analyses a corrected recording as this one was."""
    told = result.testimonies
    lying = {sensor: each.lies for sensor, each in told.items() if each.lies}
    sound: Analysis | None = None
    if lying:
        try:
            sound = anew(without_lies(result.recording, lying))
        except ValueError:  # it cannot be calibrated: what it would do to the numbers is not known
            sound = None
    found: list[Finding] = []
    for sensor, track in result.raw.items():
        found += _as_read(sensor, track)
    for sensor, lies in result.corrections.items():
        found += [_finding(sensor, lie, result, None, result.uncorrected, done=True) for lie in lies]
    for sensor, each in told.items():
        found += [_finding(sensor, lie, result, sound, None) for lie in each.lies]
        if each.silent:
            text = f"Sensor {_name(sensor)}: whether it is sound cannot be told: {each.silent}."
            found.append(Finding("info", text, code="cannot_tell", sensor=sensor, cause=each.silent))
    return (*found, *([] if lying else _feet_apart(result.stride_columns)))


def _feet_apart(strides: Table) -> Iterator[Finding]:
    """Both feet of a walk go equally far in the same time: where they do not, one of them is measured wrongly."""
    straight = strides["valid"] & (np.abs(strides["turn_rad"]) < STRAIGHT_RAD)
    left, right = (strides[straight & (strides["foot"] == foot)] for foot in FOOT_SENSORS)
    if min(len(left), len(right)) < FEWEST:
        return
    middle_ns = (left["t_start_ns"] + left["t_end_ns"]) // 2
    at = np.searchsorted(right["t_start_ns"], middle_ns, side="right") - 1
    beside = (at >= 0) & (right["t_end_ns"][at] >= middle_ns)  # the right foot's stride in whose time it was walked
    pairs = np.column_stack((left["speed_mps"][beside], right["speed_mps"][at[beside]]))
    pairs = pairs[np.isfinite(pairs).all(axis=1)]
    if len(pairs) < FEWEST:
        return
    farther, other = ("left", "right") if pairs[:, 0].sum() > pairs[:, 1].sum() else ("right", "left")
    one, two = pairs.T if farther == "left" else pairs.T[::-1]
    share = one.sum() / two.sum() - 1.0
    sd = np.std(one - (1.0 + share) * two, ddof=1) / (two.mean() * math.sqrt(len(pairs)))
    if share < max(APART, SURE * sd):
        return
    cause = f"in {len(pairs)} straight strides the {farther} foot went {share:.1%} ± {sd:.1%} farther than the {other}"
    effect = "one foot's stride lengths, speeds and clearances are wrong, and so is their symmetry"
    remedy = "see which sensor sits loosely or drags, or measure a walk of known length; on a split belt it is no fault"
    text = f"Feet: {cause}, though both walk the same way: {effect}. {_upper(remedy)}."
    yield Finding("alert", text, False, "feet_apart", ", ".join(FOOT_SENSORS), cause, effect, remedy)


def _finding(
    sensor: str, lie: Lie, result: Analysis, sound: Analysis | None, before: Mapping[str, Mapping[str, float]] | None,
    *, done: bool = False,
) -> Finding:  # fmt: skip
    own = key_numbers(result, sensor)
    other = key_numbers(sound, sensor) if sound is not None else dict((before or {}).get(sensor, {}))
    as_read, mended = (other, own) if done else (own, other)
    share = _share(as_read, mended)
    effect = "; ".join(_effects(as_read, mended))
    cause = lie.describe()
    since = ""
    if lie.from_ns is not None:
        since = f" from {1e-9 * (lie.from_ns - int(result.recording.tracks[sensor].t_sensor_ns[0])):.1f} s on"
    text = f"Sensor {_name(sensor)}: {cause}{since}"
    if done:
        text += f". Corrected: {effect or 'the numbers hardly change'}."
        return Finding("info", text, False, lie.kind, sensor, cause + since, effect, "", True)
    grave = lie.kind == "axes" or not math.isfinite(share) or share > GREAT
    remedy = _REMEDIES[lie.kind]
    text += f". {_upper(effect)}. {_upper(remedy)}." if effect else f". {_upper(remedy)}."
    return Finding("alert" if grave else "warning", text, False, lie.kind, sensor, cause + since, effect, remedy)


def key_numbers(result: Analysis, sensor: str) -> dict[str, float]:
    """Means over a sensor's valid strides, and how many these are."""
    valid = [stride for stride in result.strides if stride.valid and stride.foot == sensor]
    found: dict[str, float] = {"strides": len(valid)}
    for _, name, factor, _, _ in _NUMBERS:
        values = np.array([getattr(stride, name) for stride in valid], dtype=float)
        values = values[np.isfinite(values)]
        found[name] = factor * float(values.mean()) if values.size else math.nan
    return found


def _share(as_read: Mapping[str, float], mended: Mapping[str, float]) -> float:
    if not mended:
        return math.nan
    lengths = as_read["stride_length_m"], mended["stride_length_m"]
    lost = 1.0 - as_read["strides"] / max(mended["strides"], 1.0)
    return max(abs(lengths[0] / lengths[1] - 1.0), lost)


def _effects(as_read: Mapping[str, float], mended: Mapping[str, float]) -> Iterator[str]:
    if not mended:
        return
    for words, name, _, unit, digits in _NUMBERS:
        wrong, right = as_read[name], mended[name]
        if math.isfinite(wrong + right) and abs(wrong - right) >= 0.5 * 10.0**-digits:
            share = f" ({100 * (wrong / right - 1):+.0f} %)" if abs(right) > 1e-9 and unit == "m" else ""
            yield f"{words} {wrong:.{digits}f} {unit} as read, {right:.{digits}f} {unit} without it{share}"
    if as_read["strides"] != mended["strides"]:
        yield f"{as_read['strides']:.0f} strides measured as read, {mended['strides']:.0f} without it"


def _as_read(sensor: str, track: Track) -> Iterator[Finding]:
    """What its samples tell by themselves."""
    frozen = frozen_rows(track)
    if frozen.any():
        begins = int(np.count_nonzero(np.diff(frozen.astype(np.int8)) == 1))
        lost_s = float(np.count_nonzero(frozen)) / track.rate_hz
        cause = f"it repeated one reading {begins} times, {lost_s:.1f} s in all"
        effect = "the strides there are left out, those beside are whole"
        text = f"Sensor {_name(sensor)}: {cause}: frozen. These samples count as lost; {effect}."
        about: dict[str, Any] = {"code": "frozen", "sensor": sensor, "cause": cause, "effect": effect}
        yield Finding("warning", text, **about, remedy="check the sensor's link")
    if band := dead_band_radps(track):
        cause = f"the gyroscope reads exactly 0 below {math.degrees(band):.1f} deg/s, a dead band"
        text = f"Sensor {_name(sensor)}: {cause}."
        yield Finding("info", text, code="dead_band", sensor=sensor, cause=cause)
    if count := track.quality.repaired:
        cause = f"{count} single time stamp{'s' if count > 1 else ''} far from the others, put between the neighbours"
        text = f"Sensor {_name(sensor)}: {cause}. Check the sensor's clock."
        yield Finding("warning", text, code="stamps", sensor=sensor, cause=cause, remedy="check the sensor's clock")


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]


def _name(sensor: str) -> str:
    return sensor.replace("_", " ")
