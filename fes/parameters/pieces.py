"""The gait parameters of a recording that was analysed in pieces: means and spreads of all, kept as sums."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fes.parameters.definitions import STRIDE_KEYS
from fes.parameters.gait import GaitParameters
from fes.parameters.mean_stride import MeanStride, mean_strides
from fes.parameters.strides import NAN, StrideParameters
from fes.parameters.summary import NO_CV, Statistic, Travelled, symmetry, travelled, walk_of_sums
from fes.signals import StrideResult


class GaitInPieces:
    """Adds up the parameters of piece after piece; what it keeps does not grow with them.

    Which strides are steady is asked within each piece.
    """

    def __init__(self, belt_mps: float | None) -> None:
        self._belt_mps = belt_mps
        self._feet: dict[str, dict[str, Statistic]] = {}
        self._travelled: dict[str, Travelled] = {}
        self._means: dict[str, MeanStride] = {}
        self._no_step_lengths = ""
        self._step_lengths = False

    def add(self, parameters: GaitParameters, strides: Sequence[StrideResult]) -> None:
        """One more piece: its parameters, and all of its strides."""
        for foot, found in parameters.feet.items():
            known = self._feet.get(foot)
            self._feet[foot] = (
                found if known is None else {k: _cv(k, together(known[k], found[k])) for k in STRIDE_KEYS}
            )
        for foot, rows in parameters.strides.items():
            self._travelled[foot] = self._travelled.get(foot, Travelled()) + travelled(rows)
        for one in mean_strides(strides, parameters.strides):
            before = self._means.get(one.foot)
            self._means[one.foot] = one if before is None else _mean_together(before, one)
        self._step_lengths = self._step_lengths or not parameters.no_step_lengths
        self._no_step_lengths = parameters.no_step_lengths

    def parameters(self) -> GaitParameters:
        """Of all pieces; the strides themselves are not kept."""
        none: dict[str, list[StrideParameters]] = {foot: [] for foot in self._feet}
        walk = walk_of_sums(self._travelled.values(), self._belt_mps)
        why = "" if self._step_lengths else self._no_step_lengths
        return GaitParameters(none, self._feet, symmetry(self._feet), walk, None, why)

    def mean_strides(self) -> list[MeanStride]:
        """The mean stride of each foot over all pieces."""
        return list(self._means.values())


def together(one: Statistic, other: Statistic) -> Statistic:
    """Of two sets of values as if they were one (Chan, Golub and LeVeque 1983)."""
    if not one.n or not other.n:
        return one if one.n else other
    n, apart = one.n + other.n, other.mean - one.mean
    squares = sum((each.n - 1) * each.sd**2 for each in (one, other) if each.n > 1) + apart**2 * one.n * other.n / n
    mean, sd = one.mean + apart * other.n / n, math.sqrt(squares / (n - 1))
    return Statistic(mean, sd, sd / abs(mean) if mean else NAN, n)


def _cv(key: str, value: Statistic) -> Statistic:
    return replace(value, cv=NAN) if key in NO_CV else value


def _mean_together(one: MeanStride, other: MeanStride) -> MeanStride:
    n, apart = one.n + other.n, other.mean - one.mean
    squares = (one.n - 1) * one.sd**2 + (other.n - 1) * other.sd**2 + apart**2 * one.n * other.n / n
    return MeanStride(one.foot, one.mean + apart * other.n / n, np.sqrt(squares / (n - 1)), n)
