"""The gait parameters of a session log, from the strides that are in it.

``fes analyse`` works them out from the samples (:mod:`fes.parameters`). A log's strides were finished while the session
ran: foot off and initial contact are the entries into swing and loading response that the controller saw, orientation
is kept as pitch only, and step lengths cannot be told. The definitions are the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from fes.parameters.common_way import common_way
from fes.parameters.contacts import Swing
from fes.parameters.definitions import STRIDE_KEYS
from fes.parameters.gait import GaitParameters
from fes.parameters.steps import LONGEST_STANCE_S, MOST_TURN_RAD, Step, steps_by_number
from fes.parameters.strides import STEADY_SHARE, StrideParameters, times_of
from fes.parameters.summary import statistics_of, symmetry, walk_of
from fes.parameters.variation import warped
from fes.signals import FOOT_SENSORS, NS_PER_S, FloatArray, StrideResult

NAN = float("nan")
NO_STEP_LENGTHS = "the sensors of a session do not tell how far apart the feet are; fes analyse looks for it"


def gait_of_strides(strides: Sequence[StrideResult], belt_speed_mps: float = NAN) -> GaitParameters:
    """The parameters of all feet in ``strides``; of shanks there are none."""
    by_foot = {foot: sorted_by_start(strides, foot) for foot in FOOT_SENSORS}
    every = common_way({foot: own for foot, own in by_foot.items() if any(stride.valid for stride in own)})
    valid = {foot: [stride for stride in own if stride.valid] for foot, own in every.items()}
    swings = {
        foot: {stride.number: swing for stride in own if (swing := _swing(stride)) is not None}
        for foot, own in valid.items()
    }
    rows = {}
    for foot, own in valid.items():
        others = next((list(swings[other].values()) for other in valid if other != foot), [])
        rows[foot] = _parameters(own, swings[foot], steps_by_number(own, swings[foot], others))
    feet = {foot: statistics_of(own) for foot, own in rows.items()}
    belt = belt_speed_mps if math.isfinite(belt_speed_mps) else None
    return GaitParameters(rows, feet, symmetry(feet), walk_of(rows, belt), None, NO_STEP_LENGTHS)


def sorted_by_start(strides: Sequence[StrideResult], foot: str) -> list[StrideResult]:
    """One foot's strides by time."""
    return sorted((stride for stride in strides if stride.foot == foot), key=lambda stride: stride.t_start_ns)


def drawable(stride: StrideResult) -> bool:
    """Whether the stride is valid and has a whole path to draw."""
    points = len(stride.trajectory_m)
    return (
        stride.valid
        and points > 1
        and stride.pitch_rad.shape == (points,)
        and bool(np.isfinite(stride.trajectory_m).all() and np.isfinite(stride.pitch_rad).all())
    )


def _swing(stride: StrideResult) -> Swing | None:
    off, contact = stride.t_swing_ns, stride.t_loading_response_ns
    if off is None or contact is None or not off < contact:
        return None
    return Swing(off, (off + contact) // 2, contact, True)


def _parameters(
    strides: Sequence[StrideResult], swings: Mapping[int, Swing], steps: Mapping[int, Step]
) -> list[StrideParameters]:
    lengths = np.array([stride.stride_length_m for stride in strides])
    usual = float(np.nanmedian(lengths)) if np.isfinite(lengths).any() else NAN
    changes = _variations(strides)
    rows = []
    for stride in strides:
        swing, step = swings.get(stride.number), steps[stride.number]
        values = dict.fromkeys(STRIDE_KEYS, NAN) | {
            "stride_length_m": stride.stride_length_m,
            "toe_clearance_m": stride.toe_clearance_m,
            "heel_clearance_m": stride.heel_clearance_m,
            "height_gained_m": stride.height_gained_m,
            "turn_rad": stride.turn_rad,
            "lift_m": stride.clearance_m,
            "position_variation_m": changes.get(stride.number, NAN),
        }
        values |= _of_path(stride, swing) if drawable(stride) else {}
        values |= times_of(swing, step, stride.stride_length_m) if swing is not None else {}
        off, contact = (NAN, NAN) if swing is None else (1e-9 * swing.foot_off_ns, 1e-9 * swing.contact_ns)
        near = abs(stride.stride_length_m - usual) <= STEADY_SHARE * usual
        steady = bool(near and abs(stride.turn_rad) <= MOST_TURN_RAD)
        start_s, end_s = 1e-9 * stride.t_start_ns, 1e-9 * stride.t_end_ns
        rows.append(StrideParameters(stride.foot, stride.number, start_s, off, contact, end_s, steady, values))
    return rows


def _of_path(stride: StrideResult, swing: Swing | None) -> dict[str, float]:
    """A stride's path has x along the stride, y to the left and z up already."""
    outward = stride.trajectory_m[:, 1] * (1.0 if stride.foot.startswith("left") else -1.0)
    pitch = stride.pitch_rad - stride.pitch_rad[0]
    found = {
        "deviation_m": float(np.abs(outward).max()),
        "circumduction_m": float(outward.max()),
        "heel_rotation_rad": float(-pitch.min()),
    }
    if swing is not None:
        places = np.linspace(0.0, float(stride.t_end_ns - stride.t_start_ns), len(pitch))
        for key, at_ns in (("angle_off_rad", swing.foot_off_ns), ("angle_contact_rad", swing.contact_ns)):
            found[key] = float(np.interp(float(at_ns - stride.t_start_ns), places, pitch))
    return found


def _variations(strides: Sequence[StrideResult]) -> Mapping[int, float]:
    """PV (m) of each stride against the one before, by number; neighbours only."""
    found = {}
    for before, after in pairwise(strides):
        near = after.number == before.number + 1 and after.t_start_ns - before.t_end_ns < LONGEST_STANCE_S * NS_PER_S
        if near and drawable(before) and drawable(after):
            one, other = before.trajectory_m, after.trajectory_m
            i, j = warped(_unit(one[:, 0]), _unit(other[:, 0]))
            found[after.number] = float(np.sqrt(np.mean(np.sum((other[j] - one[i]) ** 2, axis=1))))
    return found


def _unit(values: FloatArray) -> FloatArray:
    low, high = float(values.min()), float(values.max())
    return np.asarray((values - low) / max(high - low, 1e-9))
