"""Every drawable stride of a foot on the same points, with means and spreads: what the plots of strides show.

Strides run from mid-stance to mid-stance (0 to 100 %), each in its own frame: x along the stride, y to the left, z up.
Where in its stance a foot is quietest is a matter of chance, and would smear the mean of the swing. So each stride is
stretched to have its heel rise and its foot flat (entries into pre-swing and stance) where the foot's strides have them
on the mean; in between time runs evenly. Strides without both are stretched evenly. The same strides count as in the
gait parameters: valid, and steady where that is known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from fes.parameters.gait import GaitParameters
from fes.signals import NS_PER_S, FloatArray, StrideResult
from fes.view.gait import drawable, sorted_by_start
from statemachine.phases import Phase

POINTS = 101
_ENTRIES: Final = {
    Phase.PRE_SWING: "t_pre_swing_ns",
    Phase.SWING: "t_swing_ns",
    Phase.LOADING_RESPONSE: "t_loading_response_ns",
    Phase.STANCE: "t_stance_ns",
}


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
