"""From pulse to movement: how long after a pulse the foot's pitch answers, identified from stride to stride.

What a change of the burst does to the pitch is the change of the force, which follows the drive above the threshold
as a low-pass of first order does, some time later. For each of ``DELAYS_S`` the difference of two neighbouring strides'
pitch is held against the difference of their delayed, filtered drives; what that explains says how likely the delay is,
and the sum over the strides, which fades, with what is usual beforehand, how well it is known. Differences know nothing
of the walk itself, which is in both strides.
"""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from fes.signals import FloatArray
from fes.stimulation.tuning.response import Known

DELAYS_S: Final = np.arange(1, 14) * 0.02  # (D,)
USUAL_S, USUAL_SD_S = 0.15, 0.04  # electromechanical delay 20–50 ms, rise of the activation 50 ms, the foot's inertia
FORCE_S: Final = 0.05  # time constant of the low-pass
STEP_S: Final = 0.02  # of the samples compared
FADE: Final = 0.97  # weight of a pair of strides against the next one
NOISE_RAD: Final = math.radians(2.0)  # of one stride's pitch against the next one's …
ALIKE: Final = 8  # … which so many neighbouring samples share


class DelayEstimate:
    """Of one channel."""

    def __init__(self) -> None:
        self._pitch: FloatArray | None = None  # of the stride before, its sample's mean taken away …
        self._force: FloatArray | None = None  # … and what each delay says of its force (D, N)
        self._gg = np.zeros(len(DELAYS_S))
        self._gy = np.zeros(len(DELAYS_S))
        self._weights = np.exp(-0.5 * ((DELAYS_S - USUAL_S) / USUAL_SD_S) ** 2)
        self._usual = np.log(self._weights)

    def add(
        self, times_s: Sequence[float], pitch_rad: Sequence[float], drive_s: Sequence[float], effect: FloatArray
    ) -> None:
        """Take in a swing.

        Args:
            times_s: (K,) of the pitch, since entry into pre-swing, increasing.
            pitch_rad: (K,) of the foot, toe-up positive, until contact.
            drive_s: (M,) instants since entry into pre-swing, ``STEP_S`` apart.
            effect: (M,) the drive above the threshold there.
        """
        if len(times_s) < 4 or len(drive_s) < 4:
            return
        at_s = np.arange(times_s[0], times_s[-1], STEP_S)
        pitch = np.interp(at_s, times_s, pitch_rad)
        keep = math.exp(-STEP_S / FORCE_S)
        force, filtered = 0.0, np.zeros(len(effect))
        for k, value in enumerate(effect):
            force = keep * force + (1.0 - keep) * value
            filtered[k] = force
        forces = np.array([np.interp(at_s - d, drive_s, filtered, left=0.0) for d in DELAYS_S])
        if self._pitch is not None and self._force is not None:
            n = min(len(pitch), len(self._pitch))
            moved = pitch[:n] - self._pitch[:n]
            caused = forces[:, :n] - self._force[:, :n]
            moved = moved - moved.mean()
            caused = caused - caused.mean(axis=1, keepdims=True)
            self._gg = FADE * self._gg + (caused**2).sum(axis=1)
            self._gy = FADE * self._gy + caused @ moved
            explained = np.where(self._gy > 0.0, self._gy**2 / np.maximum(self._gg, 1e-12), 0.0)
            likely = self._usual + 0.5 * explained / (ALIKE * NOISE_RAD**2)
            self._weights = np.exp(likely - likely.max())
        self._pitch, self._force = pitch, forces

    def forget_last(self) -> None:
        """The next stride has no neighbour before it."""
        self._pitch = self._force = None

    @property
    def delay_s(self) -> Known:
        """Seconds from a pulse to what it does to the foot's pitch."""
        share = self._weights / self._weights.sum()
        middle = float(DELAYS_S @ share)
        return Known(middle, math.sqrt(float((DELAYS_S - middle) ** 2 @ share)))
