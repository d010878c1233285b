"""The mean stride of each foot and its spread: Figure 5 of Wang et al. (2013), from the project's own strides.

Strides are stretched to the same length in time, each in its own frame: x along it, y to the left, z up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fes.parameters.strides import StrideParameters
from fes.signals import FloatArray, StrideResult

LEAST_STRIDES = 2


@dataclass(frozen=True, slots=True)
class MeanStride:
    """K points of one foot's steady strides: ``mean`` and ``sd`` (K, 4) of x, y, z (m) and pitch (rad), of ``n``."""

    foot: str
    mean: FloatArray
    sd: FloatArray
    n: int

    def rows(self) -> list[dict[str, Any]]:
        """One flat row per point, units in the names."""
        names = ("x_m", "y_m", "z_m", "pitch_rad")
        share = np.linspace(0.0, 100.0, len(self.mean))
        return [
            {
                "foot": self.foot,
                "stride_percent": float(at),
                **{name: float(value) for name, value in zip(names, mean, strict=True)},
                **{f"{name}_sd": float(value) for name, value in zip(names, sd, strict=True)},
                "strides": self.n,
            }
            for at, mean, sd in zip(share, self.mean, self.sd, strict=True)
        ]


def mean_strides(
    strides: Sequence[StrideResult], parameters: Mapping[str, Sequence[StrideParameters]]
) -> list[MeanStride]:
    """Of every foot with at least two steady strides.

    Args:
        strides: all strides, of all feet.
        parameters: by foot, which of them are steady.
    """
    out = []
    for foot, rows in parameters.items():
        steady = {row.number for row in rows if row.steady}
        own = [s for s in strides if s.foot == foot and s.number in steady and len(s.trajectory_m)]
        if len(own) < LEAST_STRIDES:
            continue
        every = np.array([np.column_stack((s.trajectory_m, s.pitch_rad)) for s in own])
        out.append(MeanStride(foot, every.mean(axis=0), every.std(axis=0, ddof=1), len(own)))
    return out
