"""The gait parameters of single strides: one record per stride and side.

A stride runs from mid-stance to mid-stance and holds one swing. Times of contact belong to the stride that they end:
its stride time, stance and double support are those between the contact before and its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np

from fes.analysis.parameters.contacts import Motion, Swing, variation
from fes.analysis.parameters.definitions import STRIDE_KEYS
from fes.analysis.parameters.steps import LONGEST_STANCE_S, MOST_TURN_RAD, Step, seconds_between
from fes.estimation.clearance.clearance import FootPath
from fes.signals import NS_PER_S, StrideResult

NAN = float("nan")
STEADY_SHARE = 0.3


@dataclass(frozen=True, slots=True)
class StrideParameters:
    """One stride.

    ``values`` holds every key of :data:`fes.analysis.parameters.definitions.STRIDE_KEYS`, SI units, NaN where it is not
    known. ``steady``: within 30 % of the median stride's length, and turning by no more than 20°; only such count in
    means. ``stride_length_m`` is the measured one, before it is scaled to ``stride_length_common_m``.
    """

    foot: str
    number: int
    t_start_s: float
    t_foot_off_s: float
    t_contact_s: float
    t_end_s: float
    steady: bool
    stride_length_m: float
    values: Mapping[str, float]

    @property
    def side(self) -> str:
        """ "left" or "right"."""
        return self.foot.removesuffix("_foot")

    def row(self) -> dict[str, Any]:
        """One flat row, units in the names."""
        return {name: getattr(self, name) for name in _ROW} | dict(self.values)


_KEPT = ("toe_clearance_m", "heel_clearance_m", "height_gained_m", "turn_rad")
_ROW = tuple(field.name for field in fields(StrideParameters) if field.name != "values")


def stride_parameters(
    strides: Sequence[StrideResult],
    paths: Mapping[int, FootPath],
    swings: Mapping[int, Swing],
    steps: Mapping[int, Step],
    step_lengths_m: Mapping[int, float],
    scale: float = 1.0,
) -> list[StrideParameters]:
    """The parameters of one foot's valid strides, in order of time, as ``strides`` are; the others by stride number.

    ``scale`` is of the stride lengths (:func:`fes.analysis.parameters.steps.equalise_sides`).
    """
    valid = [stride for stride in strides if stride.valid]
    motions = {n: Motion(path.t_ns, path.position_m, path.axes) for n, path in paths.items()}
    changes, found = _variations(valid, motions), dict[int, dict[str, float]]()
    for n, side in ((stride.number, stride.foot.removesuffix("_foot")) for stride in valid):
        found[n] = _of_motion(motions[n], swings.get(n), side) if n in motions else {}
        found[n] |= dict(zip(("position_variation_m", "orientation_variation_rad"), changes.get(n, ()), strict=False))
        found[n]["step_length_m"] = step_lengths_m.get(n, NAN)
    return with_motion(valid, found, swings, steps, scale)


def with_motion(
    strides: Sequence[StrideResult],
    motion: Mapping[int, dict[str, float]],
    swings: Mapping[int, Swing],
    steps: Mapping[int, Step],
    scale: float = 1.0,
) -> list[StrideParameters]:
    """As :func:`stride_parameters` of valid strides, ``motion`` being what the trajectory of each shows, by key."""
    lengths = np.array([stride.stride_length_m for stride in strides])
    usual = float(np.nanmedian(lengths)) if np.isfinite(lengths).any() else NAN
    rows = []
    for stride in strides:
        n, swing, common_m = stride.number, swings.get(stride.number), scale * stride.stride_length_m
        values = dict.fromkeys(STRIDE_KEYS, NAN) | {name: getattr(stride, name) for name in _KEPT}
        values |= {"stride_length_common_m": common_m, "lift_m": stride.clearance_m} | motion[n]
        values |= _times_of(swing, steps.get(n), common_m) if swing is not None else {}
        near = abs(stride.stride_length_m - usual) <= STEADY_SHARE * usual
        steady = bool(near and abs(stride.turn_rad) <= MOST_TURN_RAD)
        off, contact = (NAN, NAN) if swing is None else (1e-9 * swing.foot_off_ns, 1e-9 * swing.contact_ns)
        times = 1e-9 * stride.t_start_ns, off, contact, 1e-9 * stride.t_end_ns
        rows.append(StrideParameters(stride.foot, n, *times, steady, stride.stride_length_m, values))
    return rows


def _of_motion(motion: Motion, swing: Swing | None, side: str) -> dict[str, float]:
    found = {
        "deviation_m": motion.deviation_m(),
        "circumduction_m": motion.circumduction_m(side),
        "heel_rotation_rad": motion.heel_rotation_rad(),
    }
    if swing is not None:
        pitch, t = motion.pitch_rad(), (motion.t_ns - motion.t_ns[0]).astype(np.float64)
        for key, at_ns in (("angle_off_rad", swing.foot_off_ns), ("angle_contact_rad", swing.contact_ns)):
            found[key] = float(np.interp(float(at_ns - motion.t_ns[0]), t, pitch))
    return found


def _times_of(swing: Swing, step: Step | None, length_m: float) -> dict[str, float]:
    """A stride's times and speed by the keys of :data:`~fes.analysis.parameters.definitions.DEFINITIONS`; without its
    step only the swing's."""
    swing_s = (swing.contact_ns - swing.foot_off_ns) / NS_PER_S
    found = {
        "swing_s": swing_s,
        "loading_response_s": seconds_between(swing.contact_ns, swing.foot_flat_ns),
        "pre_swing_s": seconds_between(swing.heel_rise_ns, swing.foot_off_ns),
    }
    if step is not None:
        shares = {"swing": swing_s, "stance": step.stance_s, "double_support": step.double_support_s}
        found |= asdict(step) | {"speed_mps": length_m / step.stride_time_s}
        found |= {f"{name}_share": value / step.stride_time_s for name, value in shares.items()}
    return found


def _variations(strides: Sequence[StrideResult], motions: Mapping[int, Motion]) -> dict[int, tuple[float, float]]:
    """PV (m) and OV (rad) of each stride against the one before, by number; neighbours only."""
    found = {}
    for before, after in pairwise(strides):
        near = after.number == before.number + 1 and before.number in motions and after.number in motions
        if near and after.t_start_ns - before.t_end_ns < LONGEST_STANCE_S * NS_PER_S:
            found[after.number] = variation(motions[before.number], motions[after.number])
    return found
