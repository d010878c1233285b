"""The five hemiparetic walks of Wang et al. (Tables 1 and 2) as settings of the affected leg.

The paper gives no names, only numbers: speed, stride length, durations, the foot's greatest height (MHL) and rotation
(MLR), and how much strides differ (PV, OV). What moves those numbers here stands beside each; what a walk then shows
follows from the model.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Pattern:
    """How the affected leg departs from the normal one.

    Attributes:
        speed_mps: the walk's own speed (Table 1); what to choose for ``speed_mps``.
        cycle_factor: stride time against a healthy person's at that speed (from SL and speed).
        stance_shift: share of the cycle that the affected leg stands less.
        toe_off_deg: toe-down pitch at foot off at comfortable speed (MLR, from stance to the steepest).
        knee: share of the normal knee flexion in swing (a stiff knee has little).
        hike_m: lift of the whole leg by the pelvis in mid-swing, beyond the habitual compensation (MHL).
        circumduction_m: sideways excursion of the swing (MDD).
        swerve_deg: passing outward turn of the swing.
        invert_deg: inversion of the foot that hangs in swing.
        variation: stride-to-stride variation against the usual (PV, OV).
    """

    speed_mps: float = 0.8
    cycle_factor: float = 1.0
    stance_shift: float = 0.0
    toe_off_deg: float = 62.0
    knee: float = 1.0
    hike_m: float = 0.0
    circumduction_m: float = 0.015
    swerve_deg: float = 3.0
    invert_deg: float = 6.0
    variation: float = 1.0


PATTERNS: Final[dict[str, Pattern]] = {
    "none": Pattern(),
    # a weak push-off and a stiff knee
    "hemiparetic_1": Pattern(0.30, 1.05, 0.04, 44.0, 0.80, 0.0, 0.03, 4.0, 8.0, 1.3),
    # the heel rises well, the toe stays down longest
    "hemiparetic_2": Pattern(0.28, 1.05, 0.06, 60.0, 0.85, -0.004, 0.03, 4.0, 9.0, 1.2),
    # swung out sideways, every stride different, hardly any push-off
    "hemiparetic_3": Pattern(0.28, 0.98, 0.02, 25.0, 0.60, 0.0, 0.09, 12.0, 12.0, 2.4),
    # the whole leg hiked high, and slowly
    "hemiparetic_4": Pattern(0.21, 1.10, 0.05, 48.0, 0.90, 0.035, 0.03, 4.0, 8.0, 1.6),
    # short flat steps
    "hemiparetic_5": Pattern(0.25, 0.98, 0.03, 32.0, 0.65, -0.002, 0.02, 3.0, 8.0, 1.2),
}
