"""How legs move: joint angles over the gait cycle, segment lengths, stride time against speed, hemiparetic patterns.

Sagittal angles: the values at the ends of the eight phases of gait that Perry & Burnfield (*Gait Analysis*, 2nd ed.,
2010, ch. 3–6) give for thigh, knee and ankle, with the peaks they place between them; a periodic cubic spline through
them, then its first harmonics (Winter, *Biomechanics and Motor Control of Human Movement*, 4th ed., 2009, found six
enough for gait), so that any number of derivatives is smooth. Segments and masses: Winter, table 4.1. Stride rate:
Grieve & Gear, *Ergonomics* 9 (1966): ``64.8 (v/h)^0.57`` strides a minute. Entered from memory of these works; which
numbers have been compared since is in docs/virtual_patient_figures.md.

The five hemiparetic walks of Wang et al. (Tables 1 and 2) are settings of the affected leg. The paper gives only
numbers: speed, stride length (SL), durations, the foot's greatest height (MHL) and rotation (MLR), and how much strides
differ (PV, OV). What moves those numbers here stands beside each; what a walk then shows follows from the model.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Final, NamedTuple

import numpy as np

from fes.signals import FloatArray


@dataclass(frozen=True, slots=True)
class Pattern:
    """How the affected leg departs from the normal one."""

    speed_mps: float = 0.8  # the walk's own speed (Table 1); what to choose for ``speed_mps``
    cycle_factor: float = 1.0  # stride time against a healthy person's at that speed (from SL and speed)
    stance_shift: float = 0.0  # share of the cycle that the affected leg stands less
    toe_off_deg: float = 62.0  # toe-down pitch at foot off at comfortable speed (MLR, from stance to the steepest)
    knee: float = 1.0  # share of the normal knee flexion in swing (a stiff knee has little)
    hike_m: float = 0.0  # lift of the whole leg by the pelvis in mid-swing, beyond the habitual compensation (MHL)
    circumduction_m: float = 0.015  # sideways excursion of the swing (MDD)
    swerve_deg: float = 3.0  # passing outward turn of the swing
    invert_deg: float = 6.0  # inversion of the foot that hangs in swing
    variation: float = 1.0  # stride-to-stride variation against the usual (PV, OV)


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


# per cent of the cycle and degrees: thigh flexion, knee flexion, ankle dorsiflexion
KEY_PERCENT: Final = (0.0, 6.0, 12.0, 21.0, 31.0, 40.0, 50.0, 56.0, 62.0, 68.0, 75.0, 81.0, 87.0, 94.0)
KEY_THIGH_DEG: Final = (22.0, 21.5, 18.0, 9.0, -1.0, -11.0, -19.0, -18.0, -10.0, 3.0, 16.0, 23.0, 26.0, 24.0)
KEY_KNEE_DEG: Final = (4.0, 12.0, 18.0, 15.0, 8.0, 5.0, 9.0, 20.0, 39.0, 55.0, 62.0, 51.0, 28.0, 6.0)
KEY_ANKLE_DEG: Final = (0.0, -5.0, -4.0, 1.0, 5.0, 9.0, 9.0, -2.0, -17.0, -14.0, -6.0, -1.0, 1.0, 1.0)
HARMONICS: Final = 7
TOE_OFF_SHARE: Final = 0.62  # of the cycle in the key values above
REFERENCE_SPEED_MPS: Final = 1.3  # at which they were taken

THIGH_OF_HEIGHT: Final = 0.245
SHANK_OF_HEIGHT: Final = 0.246
ANKLE_OF_HEIGHT: Final = 0.039
FOOT_OF_HEIGHT: Final = 0.152
FOOT_OF_MASS: Final = 0.0145
SHANK_OF_MASS: Final = 0.0465
SHOE_KG: Final = 0.35
SOLE_M: Final = 0.016


@cache
def harmonics(key_deg: tuple[float, ...]) -> FloatArray:
    """(1 + 2·HARMONICS,) mean, then cosine and sine of each harmonic, in rad: the periodic spline's Fourier series."""
    percent = np.array([*KEY_PERCENT, 100.0])
    value = np.radians([*key_deg, key_deg[0]])
    count = 400
    grid: FloatArray = np.arange(count, dtype=np.float64) / count
    curve = _periodic_spline(percent / 100.0, value, grid)
    out = [float(curve.mean())]
    for k in range(1, HARMONICS + 1):
        out += [
            2.0 * float((curve * np.cos(2.0 * math.pi * k * grid)).mean()),
            2.0 * float((curve * np.sin(2.0 * math.pi * k * grid)).mean()),
        ]
    return np.array(out)


def _periodic_spline(knots: FloatArray, value: FloatArray, at: FloatArray) -> FloatArray:
    """The periodic natural cubic spline through (K,) knots from 0 to 1, the last value repeating the first."""
    width = np.diff(knots)
    n = len(width)
    matrix, right = np.zeros((n, n)), np.zeros(n)
    slope = np.diff(value) / width
    for i in range(n):
        before, after = width[i - 1], width[i]
        matrix[i, i - 1] += before
        matrix[i, i] += 2.0 * (before + after)
        matrix[i, (i + 1) % n] += after
        right[i] = 6.0 * (slope[i] - slope[i - 1])
    bend = np.linalg.solve(matrix, right)
    bend = np.append(bend, bend[0])
    cell = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, n - 1)
    a, h = at - knots[cell], width[cell]
    first = slope[cell] - h * (2.0 * bend[cell] + bend[cell + 1]) / 6.0
    out: FloatArray = value[cell] + a * (first + a * (0.5 * bend[cell] + a * (bend[cell + 1] - bend[cell]) / (6.0 * h)))
    return out


class JointCurves(NamedTuple):
    """Fourier series in rad of thigh (forward positive), knee flexion and ankle (dorsiflexion positive)."""

    thigh: FloatArray
    knee: FloatArray
    ankle: FloatArray


def joint_curves(speed_mps: float, height_m: float, knee_share: float = 1.0) -> JointCurves:
    """The curves at a speed: the hip swings with the stride's length, the knee bends a little less when slow.

    Lelas et al. (*Gait & Posture* 17, 2003) found both to grow with speed, the hip's range more than the knee's peak.
    """
    thigh, knee, ankle = (harmonics(key_deg).copy() for key_deg in (KEY_THIGH_DEG, KEY_KNEE_DEG, KEY_ANKLE_DEG))
    share = stride_length_m(speed_mps, height_m) / stride_length_m(REFERENCE_SPEED_MPS, height_m)
    thigh[1:] *= 0.15 + 0.85 * share
    thigh[0] *= 0.5 + 0.5 * share
    knee *= knee_share * (0.60 + 0.40 * share)
    return JointCurves(thigh, knee, ankle)


def stride_time_s(speed_mps: float, height_m: float) -> float:
    """Grieve & Gear (1966); never over 3 s, for nobody stands still between strides."""
    return min(60.0 / (64.8 * math.pow(max(speed_mps, 0.05) / height_m, 0.57)), 3.0)


def stride_length_m(speed_mps: float, height_m: float) -> float:
    """What the stride time makes of the speed."""
    return speed_mps * stride_time_s(speed_mps, height_m)


def stance_share(speed_mps: float) -> float:
    """Share of the cycle on the ground: 62 % at 1.3 m/s, more when slow (Murray et al., *Am J Phys Med* 45, 1966)."""
    return min(max(0.70 - 0.062 * speed_mps, 0.58), 0.70)
