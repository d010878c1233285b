"""How this person's shank moves: the levels that the guards' thresholds are fitted to, from a short walk.

The counterpart of the foot's ``rest_gyr_radps``, ``min_toe_down_peak_radps``, ``rest_hold_s`` and
``contact_jerk_mps3``. All levels are ratios of what this walk shows, so that they go with the person, the walking speed
and the place of the sensor; the bounds only keep a strange walk from making a guard useless.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fes.estimation.numerics.records import new_core
from fes.estimation.shank import features
from fes.estimation.shank.features import ShankParameters
from fes.estimation.shank.motion import StrideSpan
from fes.signals import FloatArray, IntArray
from statemachine.guards import Thresholds

FLAT_TO_PEAK = 0.25  # the rest threshold lies this share of the way from mid-stance's rate to foot-off's …
FLAT_BOUNDS_RADPS = (0.4, 2.5)
STILL_PER_FLOOR = 1.8  # … and the ankle's at this multiple of what it shows in mid-stance
STILL_BOUNDS_MPS2 = (1.5, 8.0)
PUSH_OFF_SHARE = 0.4
CONTACT_SHARE = 0.3
CONTACT_BOUNDS_MPS3 = (150.0, 600.0)
HOLD_S = 0.03
LEAVE_LEAN = 1.2  # the shank's levels are fitted closer than the foot's: they are left sooner
LEAVE_ACC = 1.2
RISING_SHARE = 0.4  # a shank's contact comes before its lean has quite come to a stop
NEVER = Thresholds(rest_gyr_radps=0.0, rest_acc_mps2=0.0, contact_jerk_mps3=1e12)


@dataclass(frozen=True, slots=True)
class ShankLevels:
    """Levels of one person's shank; ``rest_*`` as the guards take them, the others as seen in the walk.

    Attributes:
        rest_lean_radps: the shank leans no faster while the foot is flat.
        rest_acc_mps2: the ankle's force is no further from gravity while the foot is flat.
        min_lean_peak_radps: below, no push-off has been seen.
        contact_jolt_mps3: a jump of the force above this is a contact.
        rest_hold_s: how long rest must last.
    """

    rest_lean_radps: float = 1.2
    rest_acc_mps2: float = 2.0
    min_lean_peak_radps: float = 1.0
    contact_jolt_mps3: float = 400.0
    rest_hold_s: float = HOLD_S

    def thresholds(self, *, swing_at_reversal: bool = False) -> Thresholds:
        """The guards' thresholds for this shank; all others at their defaults."""
        return Thresholds(
            rest_gyr_radps=self.rest_lean_radps,
            rest_acc_mps2=self.rest_acc_mps2,
            min_toe_down_peak_radps=self.min_lean_peak_radps,
            contact_jerk_mps3=self.contact_jolt_mps3,
            rest_hold_s=self.rest_hold_s,
            leave_gyr=LEAVE_LEAN,
            leave_acc=LEAVE_ACC,
            rising_share=RISING_SHARE,
            still_rate_radps=self.rest_lean_radps,
            swing_at_reversal=swing_at_reversal,
        )


def trace_of(parameters: ShankParameters, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> FloatArray:
    """Rate of lean (rad/s), the ankle's force beyond gravity (m/s²) and jolt (m/s³) at each sample, as for the guards.

    ``t_ns`` (N,) strictly increasing, ``acc_mps2`` and ``gyr_radps`` (N, 3) as measured. Returns (N, 4).
    """
    core = new_core(features.CORE, parameters=parameters, thresholds=NEVER)[0]
    trace = np.zeros((len(t_ns), 4))
    bias = np.array([parameters.acc_bias_x_mps2, parameters.acc_bias_y_mps2, parameters.acc_bias_z_mps2])
    head = slice(0, max(round(1.0 / parameters.sample_s), 1))
    features.start(core, int(t_ns[0]), *(acc_mps2[head].mean(axis=0) - bias).tolist())
    features.enter(core, 2)
    features.advance(core, t_ns, acc_mps2, gyr_radps, 0, len(t_ns), trace)
    return trace


def fit_levels(trace: FloatArray, spans: list[StrideSpan]) -> ShankLevels:
    """Fit the levels to the strides of a walk; without any the defaults."""
    if not spans:
        return ShankLevels()
    lean, excess, jolt = trace[:, 0], trace[:, 1], trace[:, 2]
    flat, still, peak, contact = [], [], [], []
    for span in spans:
        window = slice(max(span.first - span.half, 0), span.first + span.half + 1)
        flat.append(float(np.abs(lean[window]).mean()))
        still.append(float(np.median(excess[window])))
        peak.append(float(lean[span.first : span.swing + 1].max()))
        contact.append(float(jolt[span.swing : span.last + 1].max()))
    floor, top = float(np.median(flat)), float(np.median(peak))
    return ShankLevels(
        rest_lean_radps=_within(floor + FLAT_TO_PEAK * (top - floor), FLAT_BOUNDS_RADPS),
        rest_acc_mps2=_within(STILL_PER_FLOOR * float(np.median(still)), STILL_BOUNDS_MPS2),
        min_lean_peak_radps=PUSH_OFF_SHARE * top,
        contact_jolt_mps3=_within(CONTACT_SHARE * float(np.median(contact)), CONTACT_BOUNDS_MPS3),
    )


def _within(value: float, bounds: tuple[float, float]) -> float:
    return float(min(max(value, bounds[0]), bounds[1]))
