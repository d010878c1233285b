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
from fes.analysis.parameters.steps import LONGEST_STANCE_S, MOST_TURN_RAD, Step
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
    usual = float(np.median([stride.stride_length_m for stride in valid])) if valid else NAN
    motions = {n: Motion(path.t_ns, path.position_m, path.axes) for n, path in paths.items()}
    changes = _variations(valid, motions)
    rows = []
    for stride in valid:
        near = abs(stride.stride_length_m - usual) <= STEADY_SHARE * usual
        is_steady = bool(near and abs(stride.turn_rad) <= MOST_TURN_RAD)
        n, swing, common_m = stride.number, swings.get(stride.number), scale * stride.stride_length_m
        values = dict.fromkeys(STRIDE_KEYS, NAN)
        values |= {
            "stride_length_common_m": common_m,
            "toe_clearance_m": stride.toe_clearance_m,
            "heel_clearance_m": stride.heel_clearance_m,
            "height_gained_m": stride.height_gained_m,
            "turn_rad": stride.turn_rad,
            "lift_m": stride.clearance_m,
            "step_length_m": step_lengths_m.get(n, NAN),
        }
        values["position_variation_m"], values["orientation_variation_rad"] = changes.get(n, (NAN, NAN))
        if n in motions:
            values |= _of_motion(motions[n], swing, stride.foot.removesuffix("_foot"))
        if swing is not None:
            values |= times_of(swing, steps.get(n), common_m)
        off, contact = (NAN, NAN) if swing is None else (1e-9 * swing.foot_off_ns, 1e-9 * swing.contact_ns)
        times = 1e-9 * stride.t_start_ns, off, contact, 1e-9 * stride.t_end_ns
        rows.append(StrideParameters(stride.foot, n, *times, is_steady, stride.stride_length_m, values))
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


def times_of(swing: Swing, step: Step | None, length_m: float) -> dict[str, float]:
    """A stride's times and speed by the keys of :data:`~fes.analysis.parameters.definitions.DEFINITIONS`; without its
    step only the swing's."""
    swing_s = (swing.contact_ns - swing.foot_off_ns) / NS_PER_S
    found = {"swing_s": swing_s}
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
