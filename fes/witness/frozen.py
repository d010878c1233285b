"""Samples that a sensor repeats to the bit, and a gyroscope that reads nothing at all while it turns slowly."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np

from fes.estimation.numerics.filters import runs
from fes.recording.tracks import PER_SAMPLE, Track
from fes.signals import G_MPS2, FloatArray

FROZEN_NS: Final = 60_000_000  # both triads bit-equal for so long; no real sensor did so for 40 ms (docs/safety.md)
RESTS_RADPS, RESTS_MPS2 = 0.1, 0.5  # a foot that turns or is pushed by less may rest
LEAVES_RADPS, LEAVES_MPS2 = 0.5, 3.0  # in one sample no foot begins to move by more
DEAD_SHARE: Final = 0.05  # of an axis' samples that are exactly 0
LEAST_BAND_RADPS: Final = 0.005  # 0.3 deg/s
OVER_RESOLUTION: Final = 4.0  # the band is so many times the finest step between two readings


def frozen_rows(track: Track) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """(N,) samples that only repeat what was read before, in stretches of 60 ms and more."""
    columns = (*track.acc_mps2.T, *track.gyr_radps.T)
    same = np.append(False, np.logical_and.reduce([column[1:] == column[:-1] for column in columns]))
    for begin, end in runs(same).tolist():
        brief = track.t_sensor_ns[end - 1] - track.t_sensor_ns[begin - 1] < FROZEN_NS
        if brief or _rests(np.column_stack([column[begin - 1 : end + 1] for column in columns])):
            same[begin:end] = False
    return same


def _rests(values: FloatArray) -> bool:
    """Whether a repeated stretch (N, 6) may be rest: of a sensor without noise, as a formula makes it, and such a one
    does not jump as the rest ends."""
    force, rate = np.linalg.norm(values[0, :3]), np.linalg.norm(values[0, 3:])
    leaves = np.abs(values[-1] - values[0])
    still = rate < RESTS_RADPS and abs(force - G_MPS2) < RESTS_MPS2
    return bool(still and leaves[3:].max() < LEAVES_RADPS and leaves[:3].max() < LEAVES_MPS2)


def without_frozen(track: Track) -> Track:
    """The track without what is only repeated, as if that had been lost; the same object where nothing is."""
    frozen = frozen_rows(track)
    if not frozen.any():
        return track
    return replace(track, **{name: getattr(track, name)[~frozen] for name in PER_SAMPLE})


def dead_band_radps(track: Track) -> float:
    """Below which rate the gyroscope reads exactly 0; 0 where it does not."""
    bands = [_band(axis) for axis in track.gyr_radps.T]
    return max(bands) if min(bands) > 0.0 else 0.0


def _band(axis: FloatArray) -> float:
    sizes = np.abs(axis[np.isfinite(axis)])
    if not sizes.size or np.count_nonzero(sizes == 0.0) < DEAD_SHARE * sizes.size:
        return 0.0
    least = float(np.min(sizes[sizes > 0.0], initial=np.inf))
    levels = np.unique(sizes[sizes > 0.0])
    finest = float(np.min(np.diff(levels), initial=np.inf))
    return least if LEAST_BAND_RADPS < least < np.inf and least > OVER_RESOLUTION * finest else 0.0
