"""Orientation filters as peers: each with its defaults, the force integrated stride by stride without its drift.

    .venv-peers/bin/python benchmarks/peers/run_orientation.py FOLDER

imufusion comes with its makers' own way from orientation to position (x-io, Gait-Tracking): rest wherever the
acceleration stays below 3 m/s² for 0.1 s, the velocity's drift between two rests taken as linear. For the others,
and once for imufusion too, the velocity is made zero at the ends of each stride, and the height equal, with a drift
linear in time.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import ahrs
import imufusion
import numpy as np
import vqf
from exchange import G_MPS2, Arrays, Case, Method, run_all

MOVING_MPS2 = 3.0
MARGIN_S = 0.1
SETTLE_S, FIRST_S, STILL_RADPS = 4.0, 0.25, 0.2


def settled(orientation: Callable[[Case], np.ndarray]) -> Callable[[Case], np.ndarray]:
    """The filter as after standing for 4 s: the first 0.25 s, where still, is held for that long before the recording.

    Some filters take about 3 s to start up, and some recordings walk off sooner.
    """

    def run(case: Case) -> np.ndarray:
        first = round(FIRST_S * case.rate_hz)
        if np.abs(case.gyr_radps[:first]).max() > STILL_RADPS:
            return orientation(case)
        added = round(SETTLE_S * case.rate_hz)
        still = np.tile(case.acc_mps2[:first].mean(axis=0), (added, 1))
        longer = replace(
            case,
            acc_mps2=np.vstack((still, case.acc_mps2)),
            gyr_radps=np.vstack((np.zeros((added, 3)), case.gyr_radps)),
        )
        return orientation(longer)[added:]

    return run


def by_vqf(case: Case) -> np.ndarray:
    found = vqf.VQF(1.0 / case.rate_hz).updateBatch(_c(case.gyr_radps), _c(case.acc_mps2))
    return np.asarray(found["quat6D"])


def by_offline_vqf(case: Case) -> np.ndarray:
    """Its variant that runs both ways."""
    found = vqf.offlineVQF(_c(case.gyr_radps), _c(case.acc_mps2), None, 1.0 / case.rate_hz)
    return np.asarray(found["quat6D"])


def by_madgwick(case: Case) -> np.ndarray:
    return np.asarray(ahrs.filters.Madgwick(gyr=case.gyr_radps, acc=case.acc_mps2, frequency=case.rate_hz).Q)


def by_ekf(case: Case) -> np.ndarray:
    return np.asarray(ahrs.filters.EKF(gyr=case.gyr_radps, acc=case.acc_mps2, frequency=case.rate_hz).Q)


def by_imufusion(case: Case) -> np.ndarray:
    """With the settings of its makers' gait example and its own bias correction."""
    settings = imufusion.AhrsSettings(
        sample_rate=case.rate_hz, gain=0.5, acceleration_rejection=10.0, rejection_timeout=5.0
    )
    filtered = imufusion.Ahrs().set_settings(settings)
    bias = imufusion.Bias().set_settings(imufusion.BiasSettings(sample_rate=case.rate_hz))
    out = np.empty((len(case.acc_mps2), 4))
    for k, (rate, force) in enumerate(zip(np.degrees(case.gyr_radps), case.acc_mps2 / G_MPS2, strict=True)):
        filtered.update_no_magnetometer(bias.update(rate), force)
        out[k] = filtered.get_quaternion()
    return out


def _c(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=float)


def acceleration(case: Case, quaternions: np.ndarray) -> np.ndarray:
    """In the world (N, 3), m/s², without gravity; quaternions (N, 4) wxyz from sensor to world."""
    w, v, f = quaternions[:, :1], quaternions[:, 1:], case.acc_mps2
    t = 2.0 * np.cross(v, f)
    return f + w * t + np.cross(v, t) - np.array([0.0, 0.0, G_MPS2])


def strides(orientation: Callable[[Case], np.ndarray]) -> Callable[[Case], Arrays]:
    """Length and lift (m) between the borders."""

    def run(case: Case) -> Arrays:
        force = acceleration(case, settled(orientation)(case))
        out = [dedrifted(force[first : last + 1], case.rate_hz) for first, last in case.borders]
        length, lift = np.array(out).T
        return {"length_m": length, "lift_m": lift}

    return run


def dedrifted(force: np.ndarray, rate_hz: float) -> tuple[float, float]:
    """Length and lift (m) of one stride with velocity zero at both ends and equal heights."""
    share = np.linspace(0.0, 1.0, len(force))[:, None]
    velocity = cumulative(force) / rate_hz
    velocity -= share * velocity[-1]
    position = cumulative(velocity) / rate_hz
    height = position[:, 2] - share[:, 0] * position[-1, 2]
    return float(np.hypot(*position[-1, :2])), float(height.max())


def cumulative(values: np.ndarray) -> np.ndarray:
    """Trapezoid sums from 0."""
    return np.concatenate((np.zeros((1, 3)), np.cumsum(0.5 * (values[1:] + values[:-1]), axis=0)))


def x_io_position(case: Case) -> np.ndarray:
    """Position (N, 3) in m by x-io's way."""
    force = acceleration(case, settled(by_imufusion)(case))
    margin = int(MARGIN_S * case.rate_hz)
    moving = np.linalg.norm(force, axis=1) > MOVING_MPS2
    near = np.convolve(moving, np.ones(2 * margin + 1), "same") > 0.5
    edges = np.flatnonzero(np.diff(np.concatenate(([False], near, [False])).astype(int)))
    velocity = np.zeros_like(force)
    for first, last in zip(edges[0::2], edges[1::2], strict=True):
        part = np.cumsum(force[first:last], axis=0) / case.rate_hz
        velocity[first:last] = part - np.linspace(0.0, 1.0, last - first)[:, None] * part[-1]
    return np.cumsum(velocity, axis=0) / case.rate_hz


def x_io(case: Case) -> Arrays:
    """Length and lift (m) between the borders."""
    position = x_io_position(case)
    rows = [position[first : last + 1] - position[first] for first, last in case.borders]
    length = [float(np.hypot(*row[-1, :2])) for row in rows]
    return {"length_m": np.array(length), "lift_m": np.array([float(row[:, 2].max()) for row in rows])}


def x_io_closure(case: Case) -> Arrays:
    """Where the whole recording ends, from where it begins (m)."""
    position = x_io_position(case)
    return {"end_m": position[-1] - position[0]}


def attitude(orientation: Callable[[Case], np.ndarray]) -> Callable[[Case], Arrays]:
    """Orientation (N, 4) wxyz from sensor to world."""
    return lambda case: {"q": settled(orientation)(case)}


METHODS = [
    Method("VQF", "orientation", "causal", attitude(by_vqf)),
    Method("VQF off-line", "orientation", "off-line", attitude(by_offline_vqf)),
    Method("imufusion, settings of x-io's example", "orientation", "causal", attitude(by_imufusion)),
    Method("ahrs Madgwick", "orientation", "causal", attitude(by_madgwick)),
    Method("ahrs EKF", "orientation", "causal", attitude(by_ekf)),
    Method("imufusion, x-io's method", "borders", "causal", x_io),
    Method("imufusion, linear dedrift", "borders", "causal", strides(by_imufusion)),
    Method("VQF, linear dedrift", "borders", "causal", strides(by_vqf)),
    Method("VQF off-line, linear dedrift", "borders", "off-line", strides(by_offline_vqf)),
    Method("VQF off-line, linear dedrift, our ends", "our ends", "off-line", strides(by_offline_vqf)),
    Method("ahrs Madgwick, linear dedrift", "borders", "causal", strides(by_madgwick)),
    Method("ahrs EKF, linear dedrift", "borders", "causal", strides(by_ekf)),
    Method("imufusion, x-io's method", "closure", "causal", x_io_closure),
]

if __name__ == "__main__":
    run_all(Path(sys.argv[1]), METHODS)
