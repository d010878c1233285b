"""Which of two feet is the left one, from how they move: for recordings whose sensors are not labelled.

No paper: four signs of a mirror-symmetric body, each turned so that a left foot gives the greater value. Between
foot-off and contact a foot rolls outward (it lands on the outer heel); it points outward of where it goes; it leaves
the ground moving outward; and it swings in an outward bow. Only the difference between the two feet counts, so that
what both have in common (a tilted belt, a turn) drops out. Nothing is known of the sensors' mounting: the axes are
those of the calibration, towards the toe and up.

Measured on 15 recordings of 5 people: see ``benchmarks/accuracy/shank_phases.py``. That is few people. Where the signs
do not agree clearly, no side is told: a wrong side stimulates the wrong leg.
"""

from dataclasses import dataclass

import numpy as np

from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.numerics.rotation import rotate_all
from fes.estimation.shank.motion import travelled
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.signals import FloatArray, IntArray, StrideResult

MIN_STRIDES = 5
MIN_LENGTH_M = 0.3
MOST_TURN_RAD = 0.35
USUAL_DIFFERENCE = np.array([0.3, 0.2, 0.12, 0.05])  # roll and toe-out (rad), outward start (m/s), bow (m)
MIN_SCORE = 0.3
MIN_AGREEING = 3


@dataclass(frozen=True, slots=True)
class SideVerdict:
    """Which of two feet is left.

    Attributes:
        left: 0 or 1, the foot that moves like a left one.
        score: 0–1, mean of the four votes, each at most 1.
        agreeing: how many of the four signs say so.
        differences: left less right in rad, rad, m/s, m.
    """

    left: int
    score: float
    agreeing: int
    differences: tuple[float, float, float, float]

    @property
    def sure(self) -> bool:
        """Whether this is clear enough to go by."""
        return self.score >= MIN_SCORE and self.agreeing >= MIN_AGREEING


def tell_sides(one: FloatArray, other: FloatArray) -> SideVerdict:
    """Compare the signs (4,) of two feet, from :func:`side_signs`."""
    difference = one - other
    votes = np.clip(difference / USUAL_DIFFERENCE, -1.0, 1.0)
    left = 0 if votes.sum() >= 0.0 else 1
    turn = 1.0 - 2.0 * left
    a, b, c, d = (float(v) for v in turn * difference)
    return SideVerdict(left, float(abs(votes.mean())), int(np.count_nonzero(turn * votes > 0.0)), (a, b, c, d))


def side_signs(
    t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray, calibration: FootCalibration
) -> FloatArray | None:
    """The four signs of one foot (4,): medians over its straight strides; None with fewer than five of them.

    ``t_ns`` (N,) strictly increasing, ``acc_mps2`` and ``gyr_radps`` (N, 3) as measured.
    """
    forward, up = calibration.forward(), np.array(calibration.up)
    tracker = FootTracker(calibration, StrideMaker(calibration.sensor, StrideSettings(forward=forward, up=up)))
    outcomes = tracker.advance(t_ns, acc_mps2, gyr_radps)
    strides = [s for s in outcomes if isinstance(s, StrideResult)]
    acc, gyr = acc_mps2 - np.array(calibration.acc_bias_mps2), gyr_radps - tracker.gyr_bias_radps
    found = [signs for s in strides if (signs := stride_signs(t_ns, acc, gyr, s, forward)) is not None]
    return np.median(np.array(found), axis=0) if len(found) >= MIN_STRIDES else None


def stride_signs(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, stride: StrideResult, forward: FloatArray
) -> FloatArray | None:
    """Roll and toe-out (rad), outward velocity at foot-off (m/s) and bow (m) of one straight stride, for a left foot.

    ``acc`` and ``gyr`` (N, 3) less their zeros, at ``t_ns`` (N,); None where the stride cannot tell.
    """
    if not stride.valid or stride.stride_length_m < MIN_LENGTH_M or abs(stride.turn_rad) > MOST_TURN_RAD:
        return None
    contact_ns = stride.t_loading_response_ns or stride.t_stance_ns
    if stride.t_swing_ns is None or contact_ns is None:
        return None
    first, last = (int(k) for k in np.searchsorted(t_ns, (stride.t_start_ns, stride.t_end_ns)))
    off, contact = (int(k) - first for k in np.searchsorted(t_ns, (stride.t_swing_ns, contact_ns)))
    found = travelled(t_ns, acc, gyr, (first, last))
    if found is None:
        return None
    quaternions, velocity, position = found
    direction = position[-1, :2]
    length = float(np.hypot(direction[0], direction[1]))
    if length < MIN_LENGTH_M or not 0 < off < contact < len(position):
        return None
    leftward = np.array([-direction[1], direction[0]]) / length
    toe = rotate_all(quaternions[:1], forward)[0]
    toe_out = float(np.arctan2(direction[0] * toe[1] - direction[1] * toe[0], direction @ toe[:2]))
    step_s = 1e-9 * np.diff(t_ns[first + off : first + contact + 1])
    roll = float((gyr[first + off : first + contact] @ forward) @ step_s)
    across = position[:, :2] @ leftward
    return np.array([-roll, toe_out, float(velocity[off, :2] @ leftward), float(across.max() + across.min())])
