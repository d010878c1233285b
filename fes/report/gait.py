"""The gait parameters of a session log, from the strides that are in it.

``fes analyse`` works them out from the samples (:mod:`fes.analysis.parameters`). A log's strides were finished while
the session ran: foot off and initial contact are the entries into swing and loading response that the controller saw,
orientation is kept as pitch only, and step lengths cannot be told. The definitions are the same.

Every drawable stride of a foot on the same points, with means and spreads: what the plots of strides show.

Strides run from mid-stance to mid-stance (0 to 100 %), each in its own frame: x along the stride, y to the left, z up.
Where in its stance a foot is quietest is a matter of chance, and would smear the mean of the swing. So each stride is
stretched to have its heel rise and its foot flat (entries into pre-swing and stance) where the foot's strides have them
on the mean; in between time runs evenly. Strides without both are stretched evenly. The same strides count as in the
gait parameters: valid, and steady where that is known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np

from fes.analysis.parameters.contacts import Swing
from fes.analysis.parameters.definitions import STRIDE_KEYS
from fes.analysis.parameters.gait import GaitParameters
from fes.analysis.parameters.motion import warped
from fes.analysis.parameters.steps import LONGEST_STANCE_S, MOST_TURN_RAD, Step, equalise_sides, steps_by_number
from fes.analysis.parameters.strides import STEADY_SHARE, StrideParameters, times_of
from fes.analysis.parameters.summary import statistics_of, symmetry, walk_of
from fes.signals import FOOT_SENSORS, NS_PER_S, FloatArray, StrideResult
from statemachine.phases import Phase

NAN = float("nan")
NO_STEP_LENGTHS = "the sensors of a session do not tell how far apart the feet are; fes analyse looks for it"
POINTS = 101
_ENTRIES: Final = {
    Phase.PRE_SWING: "t_pre_swing_ns",
    Phase.SWING: "t_swing_ns",
    Phase.LOADING_RESPONSE: "t_loading_response_ns",
    Phase.STANCE: "t_stance_ns",
}


def gait_of_strides(strides: Sequence[StrideResult], belt_speed_mps: float = NAN) -> GaitParameters:
    """The parameters of all feet in ``strides``; of shanks there are none."""
    by_foot = {foot: sorted_by_start(strides, foot) for foot in FOOT_SENSORS}
    every = {foot: own for foot, own in by_foot.items() if any(stride.valid for stride in own)}
    scales = equalise_sides(every)
    valid = {foot: [stride for stride in own if stride.valid] for foot, own in every.items()}
    swings = {
        foot: {stride.number: swing for stride in own if (swing := _swing(stride)) is not None}
        for foot, own in valid.items()
    }
    rows = {}
    for foot, own in valid.items():
        others = next((list(swings[other].values()) for other in valid if other != foot), [])
        rows[foot] = _parameters(own, swings[foot], steps_by_number(own, swings[foot], others), scales[foot])
    feet = {foot: statistics_of(own) for foot, own in rows.items()}
    belt = belt_speed_mps if math.isfinite(belt_speed_mps) else None
    return GaitParameters(rows, feet, symmetry(feet), walk_of(rows, belt), None, NO_STEP_LENGTHS, scales)


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
    strides: Sequence[StrideResult], swings: Mapping[int, Swing], steps: Mapping[int, Step], scale: float
) -> list[StrideParameters]:
    lengths = np.array([stride.stride_length_m for stride in strides])
    usual = float(np.nanmedian(lengths)) if np.isfinite(lengths).any() else NAN
    changes = _variations(strides)
    rows = []
    for stride in strides:
        swing, step, common_m = swings.get(stride.number), steps[stride.number], scale * stride.stride_length_m
        values = dict.fromkeys(STRIDE_KEYS, NAN) | {
            "stride_length_common_m": common_m,
            "toe_clearance_m": stride.toe_clearance_m,
            "heel_clearance_m": stride.heel_clearance_m,
            "height_gained_m": stride.height_gained_m,
            "turn_rad": stride.turn_rad,
            "lift_m": stride.clearance_m,
            "position_variation_m": changes.get(stride.number, NAN),
        }
        values |= _of_path(stride, swing) if drawable(stride) else {}
        values |= times_of(swing, step, common_m) if swing is not None else {}
        off, contact = (NAN, NAN) if swing is None else (1e-9 * swing.foot_off_ns, 1e-9 * swing.contact_ns)
        near = abs(stride.stride_length_m - usual) <= STEADY_SHARE * usual
        steady = bool(near and abs(stride.turn_rad) <= MOST_TURN_RAD)
        start_s, end_s = 1e-9 * stride.t_start_ns, 1e-9 * stride.t_end_ns
        rows.append(
            StrideParameters(
                stride.foot, stride.number, start_s, off, contact, end_s, steady, stride.stride_length_m, values
            )
        )
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


@dataclass(frozen=True)
class FootCurves:
    """S strides of one foot at POINTS places.

    Attributes:
        foot: its name.
        numbers: of the strides, (S,).
        path_m: (S, POINTS, 3).
        pitch_rad: (S, POINTS), toe up positive, 0 at the start.
        speed_mps: (S, POINTS) forwards, along the stride.
        entries_percent: by phase, mean place of the entry into it, so stretched; only phases that were seen.
    """

    foot: str
    numbers: tuple[int, ...]
    path_m: FloatArray
    pitch_rad: FloatArray
    speed_mps: FloatArray
    entries_percent: Mapping[Phase, float]

    @property
    def count(self) -> int:
        """How many strides there are."""
        return len(self.numbers)

    @cached_property
    def mean_path_m(self) -> FloatArray:
        """(POINTS, 3)."""
        return np.asarray(self.path_m.mean(axis=0))

    @cached_property
    def sd_path_m(self) -> FloatArray:
        """(POINTS, 3), n − 1; zero of a single stride."""
        return spread_of(self.path_m)


def spread_of(values: FloatArray) -> FloatArray:
    """Standard deviation (n − 1) over the first axis; zero of a single row."""
    return np.asarray(values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[1:]))


def foot_curves(
    strides: Sequence[StrideResult], gait: GaitParameters | None, feet: Sequence[str]
) -> dict[str, FootCurves]:
    """Of each of ``feet`` that has a stride to draw."""
    found = {}
    for foot in feet:
        own = [stride for stride in sorted_by_start(strides, foot) if drawable(stride)]
        if gait is not None and foot in gait.strides:
            steady = {row.number for row in gait.strides[foot] if row.steady}
            own = [stride for stride in own if stride.number in steady] or own
        own = [stride for stride in own if stride.t_end_ns > stride.t_start_ns]
        if own:
            found[foot] = _curves(foot, own)
    return found


def _curves(foot: str, strides: Sequence[StrideResult]) -> FootCurves:
    entries = {phase: _shares(strides, name) for phase, name in _ENTRIES.items()}
    ends = np.column_stack((entries[Phase.PRE_SWING], entries[Phase.STANCE]))
    whole = np.isfinite(ends).all(axis=1) & (ends[:, 0] > 0.0) & (ends[:, 0] < ends[:, 1]) & (ends[:, 1] < 1.0)
    usual = ends[whole].mean(axis=0) if whole.any() else np.array([0.3, 0.7])
    at = np.linspace(0.0, 1.0, POINTS)
    paths, pitches, speeds = [], [], []
    for stride, own, stretched in zip(strides, ends, whole.tolist(), strict=True):
        to, since = ([0.0, *usual, 1.0], [0.0, *own, 1.0]) if stretched else ([0.0, 1.0], [0.0, 1.0])
        taken = np.interp(at, to, since)
        places = np.linspace(0.0, 1.0, len(stride.pitch_rad))
        seconds = (stride.t_end_ns - stride.t_start_ns) / NS_PER_S
        speed = np.gradient(stride.trajectory_m[:, 0], seconds / (len(places) - 1))
        paths.append(np.column_stack([np.interp(taken, places, column) for column in stride.trajectory_m.T]))
        pitches.append(np.interp(taken, places, stride.pitch_rad))
        speeds.append(np.interp(taken, places, speed))
    return FootCurves(
        foot,
        tuple(stride.number for stride in strides),
        np.array(paths),
        np.array(pitches),
        np.array(speeds),
        {
            phase: 100.0 * float(np.mean([np.interp(s, [0.0, *own, 1.0], [0.0, *usual, 1.0]) for s, own in seen]))
            for phase, shares in entries.items()
            if (seen := [(s, own) for s, own in zip(shares[whole], ends[whole], strict=True) if np.isfinite(s)])
        },
    )


def _shares(strides: Sequence[StrideResult], name: str) -> FloatArray:
    """(S,) when in the stride an entry was, 0 … 1; NaN where it was not seen."""
    return np.array(
        [
            np.nan if (t_ns := getattr(stride, name)) is None else (t_ns - stride.t_start_ns) / _length_ns(stride)
            for stride in strides
        ],
        dtype=np.float64,
    )


def _length_ns(stride: StrideResult) -> int:
    return stride.t_end_ns - stride.t_start_ns
