"""How high the sensor rises, where the reference tracks another point of the foot: through a fitted lever arm.

The arm (3,) is what fits best, by least squares, the heights of all samples of many strides: three numbers, found from
the same recordings, so that the mean error says little and the spread is the figure to look at.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.signal import medfilt

from benchmarks.accuracy.stroke_treadmill import data_folder
from benchmarks.lib.real_sets import PathWalk, pyshoe_vicon
from fes.calibration.recording import calibrate_track
from fes.signals import FloatArray, StrideResult


def fitted(estimates: list[FloatArray], references: list[FloatArray], arms: list[FloatArray]) -> list[float]:
    """Errors (m) of the greatest height of each stride after the best arm.

    Per stride: heights (K,) of sensor and tracked point above their start, and the change (K, M) of the vertical part
    of each of the arm's components.
    """
    if not estimates:
        return []
    rows = [estimate - reference for estimate, reference in zip(estimates, references, strict=True)]
    arm = np.linalg.lstsq(np.vstack(arms), np.concatenate(rows), rcond=None)[0]
    return [
        float(estimate.max() - (reference + rise @ arm).max())
        for estimate, reference, rise in zip(estimates, references, arms, strict=True)
    ]


def _rows(walk: PathWalk, stride: StrideResult, path: FloatArray) -> FloatArray:
    first, last = (round(1e-9 * t_ns * walk.rate_hz) for t_ns in (stride.t_start_ns, stride.t_end_ns))
    return path[first : last + 1]


def _heights(stride: StrideResult, count: int) -> FloatArray:
    at = np.linspace(0.0, 1.0, count)
    return np.interp(at, np.linspace(0.0, 1.0, len(stride.trajectory_m)), stride.trajectory_m[:, 2])


def arm_fitted(walk: PathWalk, strides: list[StrideResult]) -> list[float]:
    """Errors of the lift (m) with the arm from the tracked point to the sensor fitted to this foot's strides."""
    if walk.frame is None:
        return []
    references = [_rows(walk, s, walk.position_m)[:, 2] for s in strides]
    vertical = [_rows(walk, s, walk.frame[:, 2, :]) for s in strides]
    return fitted(
        [_heights(s, len(z)) for s, z in zip(strides, references, strict=True)],
        [z - np.median(z[:3]) for z in references],
        [v - np.median(v[:3], axis=0) for v in vertical],
    )


def glitch_m(height: FloatArray) -> float:
    """By how much a single sample of a reference (N,) leaves its neighbours: the greatest distance from a median of 5.

    A foot's own movement leaves a millimetre at 200 Hz.
    """
    return float(np.abs(height - medfilt(height, 5))[2:-2].max())


def clearance_errors(
    method: Any, strides_of: Callable[..., list[StrideResult]], most_glitch_m: float = float("inf")
) -> dict[str, list[float]]:
    """PyShoe's clearance (m), the marker's arm fitted over all walks in the foot's sagittal plane.

    The orientation is the estimate's pitch; strides with a glitch of the reference, over 8 m/s, are left out, and those
    where :func:`glitch_m` of its height is more than ``most_glitch_m``.
    """
    estimates, references, arms = [], [], []
    for walk in pyshoe_vicon(data_folder()):
        if not isinstance(walk, PathWalk):
            continue
        for stride in strides_of(walk.track, calibrate_track(walk.track), method):
            if not np.isfinite(walk.true_length_m(stride)):
                continue
            height = _rows(walk, stride, walk.position_m)[:, 2]
            if glitch_m(height) > most_glitch_m:
                continue
            at = np.linspace(0.0, 1.0, len(height))
            pitch = np.interp(at, np.linspace(0.0, 1.0, len(stride.pitch_rad)), stride.pitch_rad)
            level = height - np.median(height[:6]) - at * (np.median(height[-6:]) - np.median(height[:6]))
            estimates.append(_heights(stride, len(height)))
            references.append(level)
            arms.append(-np.column_stack((np.sin(pitch), np.cos(pitch) - 1.0)))
    errors = fitted(estimates, references, arms)
    return {"pyshoe_vicon, clearance": errors} if errors else {}
