"""What each sample of a swing is short of, held against the reference that its targets make: for iterative learning.

The reference asks for nothing that the targets do not: in mid-swing the toe's height over the ground, from the end of
mid-swing to contact the foot's pitch, and for evertors, from three fifths of the swing on, its roll. Each sample's
distance from the aim is that of the stride's measure, and what the sample lies beside the sample that was measured.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from fes.config import FootGeometry
from fes.signals import MID_SWING_BEGIN, BoolArray, FloatArray, StrideResult
from fes.stimulation.tuning.demand import DEAD, DEAD_ABOVE, Demand
from fes.stimulation.tuning.response import ResponseModel
from fes.stimulation.tuning.targets import PITCH, ROLL, SwingTimes, interpolate, times_ns

ROLLED_FROM: Final = 0.6  # of the swing: from there on the foot turns to what it lands with


class Missing(NamedTuple):
    """``drives`` (N,) that samples at ``times_s`` (N,) since entry into pre-swing are short of, < 0 for too much."""

    times_s: list[float]
    drives: list[float]


def missing_drive(
    stride: StrideResult, times: SwingTimes, demands: Sequence[Demand], model: ResponseModel,
    geometry: FootGeometry | None, gain: float,
) -> Missing:  # fmt: skip
    """Of one swing; ``gain`` is the share of it that is to be taken away at once, of a level below its band all."""
    assert stride.t_pre_swing_ns is not None  # or there were no ``times``
    at_s = 1e-9 * (np.array(times_ns(stride)) - stride.t_pre_swing_ns)
    swing = (at_s - times.foot_off_s) / (times.contact_s - times.foot_off_s)
    found: list[tuple[float, float]] = []
    for demand in demands:
        begin, end = MID_SWING_BEGIN, times.share(times.mid_swing_end_s)
        if demand.measure.at_contact:
            begin, end = (ROLLED_FROM if demand.measure.name == ROLL else end), 1.0
        inside = (swing >= begin) & (swing <= end)
        if not inside.any():
            continue
        beside = _beside(demand, stride, at_s, inside, geometry, times)
        error = demand.aim - demand.usual - beside
        error[(error >= -DEAD_ABOVE) & (error <= DEAD)] = 0.0
        expected = model.expected(demand.measure.name, demand.drive).value
        drives = model.least_drives(demand.measure.name, expected + error) - demand.drive
        drives = np.where(error > 0.0, np.maximum(drives, 0.0), np.where(error < 0.0, np.minimum(drives, 0.0), 0.0))
        drives *= np.where(demand.usual + beside < 0.0, 1.0, gain)
        found += zip(at_s[inside].tolist(), drives.tolist(), strict=True)
    found.sort()
    return Missing([t for t, _ in found], [drive for _, drive in found])


def _beside(
    demand: Demand, stride: StrideResult, at_s: FloatArray, inside: BoolArray, geometry: FootGeometry | None,
    times: SwingTimes,
) -> FloatArray:  # fmt: skip
    """How far each sample's level lies beside the stride's measure, in bands."""
    measure = demand.measure
    span = measure.band.high - measure.band.low
    if measure.name in (PITCH, ROLL):
        angles = np.degrees(stride.pitch_rad if measure.name == PITCH else -stride.roll_rad)
        at_contact = interpolate(times.contact_s, at_s.tolist(), angles.tolist())
        return np.asarray((angles[inside] - at_contact) / span)
    if geometry is None:
        return np.zeros(int(inside.sum()))
    heights = toe_heights_m(stride, geometry)[inside]
    least = max(heights.min(), stride.toe_clearance_m)  # where it stands lower it asks as measured
    return np.asarray(np.maximum(heights - least, 0.0) / span)


def toe_heights_m(stride: StrideResult, geometry: FootGeometry) -> FloatArray:
    """The toe's height over where it stood, (K,), by the sensor's path and the foot's pitch."""
    pitch = stride.pitch_rad
    rise = geometry.toe_forward_m * np.sin(pitch) + geometry.toe_up_m * (np.cos(pitch) - 1.0)
    return np.asarray(stride.trajectory_m[:, 2] + rise)
