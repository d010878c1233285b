"""The lever arm of a shank sensor: from the point that the shank turns about in mid-stance to the sensor.

Source: Wu, Wang and Pottie, Eq. (5) ``v = w × r`` in the sensor frame and Eq. (8), ``r`` by least squares from a short
walk. Departures from the print:

- Their velocity comes from one integration from rest to rest, which a treadmill does not have, and which drifts. So
  within each stance window the *shape* of the velocity counts (its vertical offset is known on level ground), and,
  where the walk begins and ends standing, Wu's velocity itself.
- A shank that turns evenly in stance does not show the arm: the fit has a prior, a bound and a verdict.
- The model limits the fit, not noise that more strides would average out. So the information is the mean over the
  windows, never their sum.

On ``stroke_treadmill`` the belt implies arms of 0.25–0.31 m at 0.8–1.2 m/s and 0.34–0.40 m at 1.6 m/s. The arm learnt
is that of the ankle rocker; in the heel and forefoot rockers it is 0.1 to 0.3 m longer.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fes.estimation.numerics.filters import moving_mean
from fes.estimation.numerics.rotation import from_gravity, rotate_all
from fes.estimation.shank.motion import StrideSpan, from_rest, levelled, still_spans
from fes.estimation.strides.integration import integrate, orient
from fes.signals import FloatArray, IntArray, Vector3

SHAPE_HALF_WINDOW_S = 0.25
SHAPE_PER_STRIDE = 0.22
SHAPE_SMOOTHING_S = 0.2  # the soft tissue's wobble is shorter
SHAPE_SD_MPS = 0.02  # of the ankle's own velocity about its mean over a window
ANCHOR_SD_MPS = 0.025  # of the velocity in the middle of a walk from rest to rest
LONGEST_ANCHORED_S = 20.0
LEAST_MPS = 0.3  # that a stride covers at the very least
MIN_WINDOWS = 4
ARM_BOUNDS_M = (0.04, 0.5)
MOST_PRIOR_SD = 3.0
LEAST_GAIN = 0.1  # of the way from prior to data; below, the walk says nothing about the length


@dataclass(frozen=True, slots=True)
class ArmPrior:
    """What is expected of the arm before anything is measured: length along the shank, and SDs, in m."""

    length_m: float = 0.30
    length_sd_m: float = 0.05
    forward_sd_m: float = 0.05
    left_sd_m: float = 0.02


SHANK = ArmPrior()


@dataclass(frozen=True, slots=True)
class ArmEstimate:
    """A lever arm that is safe to use.

    Attributes:
        arm_m: from the centre of rotation to the sensor, sensor frame.
        length_m: of the arm along the shank's long axis.
        learnt: False where the prior was taken instead.
        reason: why, "" where learnt.
        condition: of the stacked, weighted ``[w]×`` of Eq. (8): its largest singular value over its smallest, inf where
            some direction does not show at all.
        length_data_m: what the data alone say of the length (NaN if nothing), for judging the fit.
        length_data_sd_m: and how well they know it, inf if they do not.
        windows: stance windows used; anchored: those of them in walks from rest to rest.
    """

    arm_m: Vector3
    length_m: float
    learnt: bool
    reason: str
    condition: float
    length_data_m: float
    length_data_sd_m: float
    windows: int
    anchored: int


def learn_arm(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: list[StrideSpan], up: FloatArray, left: FloatArray,
    *, level: bool = True,
) -> ArmEstimate:  # fmt: skip
    """Learn the arm from the strides of a short walk.

    Args:
        t_ns: (N,) strictly increasing.
        acc: (N, 3) specific force, m/s², free of bias.
        gyr: (N, 3) rad/s, free of bias.
        spans: the strides, from :func:`fes.estimation.shank.motion.stride_spans`.
        up: (3,) unit vector along the shank, upward, sensor frame.
        left: (3,) unit mediolateral axis to the person's left, sensor frame.
        level: whether the walk is on level ground.
    """
    prior = SHANK
    axes = np.stack((np.cross(left, up), left, up))  # rows: forward, left, up in the sensor frame
    expected = np.array([0.0, 0.0, prior.length_m])
    precision = np.diag([prior.forward_sd_m**-2.0, prior.left_sd_m**-2.0, prior.length_sd_m**-2.0])
    shapes = [rows for span in spans if span.quiet for rows in _shape_rows(t_ns, acc, gyr, span, level)]
    anchored = _anchored_rows(t_ns, acc, gyr, spans, level)
    information, pull = np.zeros((3, 3)), np.zeros(3)
    for rows, sd in ((shapes, SHAPE_SD_MPS), (anchored, ANCHOR_SD_MPS)):
        for matrix, velocity in rows:
            a = matrix @ axes.T
            weight = 3.0 / (len(velocity) * len(rows) * sd**2)
            information += weight * a.T @ a
            pull += weight * a.T @ velocity
    eigenvalues = np.linalg.eigvalsh(information)
    condition = float(np.sqrt(eigenvalues[-1] / eigenvalues[0])) if eigenvalues[0] > 0.0 else math.inf
    length_data, length_sd = _length_alone(information, pull, precision)
    arm = np.linalg.solve(information + precision, pull + precision @ expected)
    windows = len(shapes) + len(anchored)
    gain = prior.length_sd_m**2 / (prior.length_sd_m**2 + length_sd**2)
    reason = ""
    if windows < MIN_WINDOWS:
        reason = f"{windows} stance windows, {MIN_WINDOWS} are needed"
    elif gain < LEAST_GAIN:
        reason = f"the rate hardly changes in stance: the length is known to ±{length_sd:.2f} m only"
    elif not ARM_BOUNDS_M[0] <= arm[2] <= ARM_BOUNDS_M[1]:
        reason = f"{arm[2]:.2f} m along the shank is no lever arm"
    elif np.any(np.abs(arm - expected) > MOST_PRIOR_SD / np.sqrt(np.diag(precision))):
        reason = f"{np.round(arm, 2).tolist()} m is further from where such a sensor sits than is credible"
    if reason:
        arm = expected
    x, y, z = (axes.T @ arm).tolist()
    shown = condition, length_data, length_sd, windows, len(anchored)
    return ArmEstimate((x, y, z), float(arm[2]), not reason, reason, *shown)


def _length_alone(information: FloatArray, pull: FloatArray, precision: FloatArray) -> tuple[float, float]:
    """Length along the shank by the data, and its SD, with the prior on the two other components only."""
    total = information + precision * np.array([1.0, 1.0, 0.0])
    cross = np.linalg.solve(total[:2, :2], total[:2, 2])
    known = float(total[2, 2] - total[2, :2] @ cross)
    if known <= 1e-9 * float(information[2, 2]):  # also where there is nothing at all
        return math.nan, math.inf
    return float((pull[2] - cross @ pull[:2]) / known), known**-0.5


def _in_world(quaternions: FloatArray, rates: FloatArray) -> FloatArray:
    """``R [w]×`` (N, 3, 3): velocity in the world per metre of arm in the sensor frame."""
    return np.stack([rotate_all(quaternions, np.cross(rates, axis)) for axis in np.eye(3)], axis=2)


def _shape_rows(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, span: StrideSpan, level: bool
) -> list[tuple[FloatArray, FloatArray]]:
    """Rows (m, 3) and values (m,) of the two stance windows of one stride; none where the recording is too short."""
    n = span.last - span.first
    rate_hz = 1e9 * n / float(t_ns[span.last] - t_ns[span.first])
    margin = max(round(0.5 * SHAPE_SMOOTHING_S * rate_hz), 1)
    reach = round(min(SHAPE_HALF_WINDOW_S * rate_hz, SHAPE_PER_STRIDE * n))
    if span.first - reach < 0 or span.last + reach >= len(t_ns) or reach <= margin + 1:
        return []
    begin, end = span.first - reach, span.last + reach + 1
    quaternions = levelled(t_ns, acc, gyr, (span.first, span.last), reach)
    velocity, position = from_rest(t_ns[begin:end], acc[begin:end], quaternions)
    stride_s = 1e-9 * float(t_ns[span.last] - t_ns[span.first])
    velocity[:, 2] -= (position[-1 - reach, 2] - position[reach, 2]) / stride_s
    per_metre = _in_world(quaternions, gyr[begin:end])
    rows = []
    for at in (reach, len(position) - 1 - reach):
        window = slice(at - reach, at + reach + 1)
        a = moving_mean(per_metre[window], 2 * margin + 1)[margin:-margin]
        v = moving_mean(velocity[window], 2 * margin + 1)[margin:-margin]
        free = np.array([1.0, 1.0, 0.0 if level else 1.0])
        a = a - free[:, None] * a.mean(axis=0)
        v = v - free * v.mean(axis=0)
        rows.append((a.reshape(-1, 3), v.reshape(-1)))
    return rows


def _anchored_rows(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: list[StrideSpan], level: bool
) -> list[tuple[FloatArray, FloatArray]]:
    """Wu's own rows: ``v = w × r`` in the stances of walks that begin and end standing, velocity zero at both ends."""
    if len(spans) < 2:
        return []
    rate_hz = 1e9 * (len(t_ns) - 1) / float(t_ns[-1] - t_ns[0])
    rows: list[tuple[FloatArray, FloatArray]] = []
    for before, after in pairwise(still_spans(acc, gyr, rate_hz)):
        begin, end = before[1], after[0]
        inside = [s for s in spans if begin <= s.swing <= end and s.quiet]
        if len(inside) < 2 or (end - begin) > LONGEST_ANCHORED_S * rate_hz:
            continue
        t = np.ascontiguousarray(t_ns[begin : end + 1])
        quaternions = np.empty((len(t), 4))
        start = np.array(from_gravity(*acc[before[0] : before[1] + 1].mean(axis=0)))
        fx, fy, fz = acc[after[0] : after[1] + 1].mean(axis=0)
        orient(t, gyr[begin : end + 1], start, fx, fy, fz, 1.0, quaternions)
        velocity, position, gamma = np.empty((len(t), 3)), np.empty((len(t), 3)), np.empty((2, 3))
        zero = np.zeros(3)
        if not integrate(
            t, acc[begin : end + 1], quaternions, zero, zero, 0.0 if level else math.nan, velocity, position, gamma
        ):
            continue
        # standing on a belt that starts and stops is no rest in the belt's frame: the walk then leads nowhere
        least_m = LEAST_MPS * float(np.median([1e-9 * (t_ns[s.last] - t_ns[s.first]) for s in inside]))
        if np.hypot(position[-1, 0], position[-1, 1]) < 0.5 * len(inside) * least_m:
            continue
        per_metre = _in_world(quaternions, gyr[begin : end + 1])
        for span in inside[:-1]:
            window = slice(max(span.last - span.half - begin, 0), span.last + span.half + 1 - begin)
            rows.append((per_metre[window].mean(axis=0), velocity[window].mean(axis=0)))
    return rows
