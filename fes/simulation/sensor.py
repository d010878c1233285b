"""An inertial sensor: from the true motion of the point where it sits to the numbers it would deliver.

Order of effects: true signals on a fine grid → bandwidth → sampling (at jittered instants) → misalignment, scale
error, bias and its random walk, white noise → range → quantisation → lost and doubled samples. Each can be off.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from fes.estimation.numerics.rotation import quaternions_of
from fes.signals import G_MPS2, FloatArray, Vector3

FINE_HZ = 4000.0


@dataclass(frozen=True, slots=True)
class ImuModel:
    """What is wrong with the sensor; every 0 (or None) switches an effect off.

    Densities and errors are typical of consumer MEMS units (0.007 °/s/√Hz, 120 µg/√Hz, 16 bit).
    """

    gyr_noise_radps_rthz: float = math.radians(0.007)  # white noise density, rad/s/√Hz
    acc_noise_mps2_rthz: float = 120e-6 * G_MPS2  # white noise density, m/s²/√Hz
    gyr_bias_radps: float = math.radians(0.5)  # greatest constant bias per axis; drawn uniformly within ±
    acc_bias_mps2: float = 0.15  # greatest constant bias per axis
    gyr_walk_radps_rts: float = math.radians(0.003)  # bias random walk, rad/s/√s
    acc_walk_mps2_rts: float = 2e-4  # bias random walk, m/s²/√s
    scale_error: float = 0.003  # standard deviation of the scale factors' error
    cross_axis: float = 0.002  # standard deviation of the off-diagonal sensitivities
    acc_range_mps2: float | None = 16.0 * G_MPS2  # full scale ±, None for unlimited
    gyr_range_radps: float | None = math.radians(2000.0)  # full scale ±, None for unlimited
    bits: int = 16  # resolution over the full scale; 0 switches quantisation off. Needs both ranges.
    bandwidth: float = 0.4  # cut-off of the linear-phase low-pass as a share of the sampling rate; 0 is off
    # standard deviation of the instant of sampling around the regular grid; the stamps tell the truth
    jitter_s: float = 0.0
    lost: float = 0.0  # share of samples that never arrive
    doubled: float = 0.0  # share of samples that arrive twice with the same stamp


PERFECT = replace(
    ImuModel(), gyr_noise_radps_rthz=0.0, acc_noise_mps2_rthz=0.0, gyr_bias_radps=0.0, acc_bias_mps2=0.0,
    gyr_walk_radps_rts=0.0, acc_walk_mps2_rts=0.0, scale_error=0.0, cross_axis=0.0, acc_range_mps2=None,
    gyr_range_radps=None, bits=0, bandwidth=0.0,
)  # fmt: skip


def draw_sensitivity(rng: np.random.Generator, model: ImuModel) -> FloatArray:
    """(3, 3) scale factors and cross-axis sensitivities of one sensor triad."""
    out: FloatArray = np.diag(1.0 + model.scale_error * rng.normal(size=3))
    return out + model.cross_axis * rng.normal(size=(3, 3)) * (1.0 - np.eye(3))


def mounting(roll_deg: float, pitch_deg: float, yaw_deg: float) -> FloatArray:
    """(3, 3) segment from sensor: ``Rz(yaw) Ry(pitch) Rx(roll)`` with angles in degrees."""
    r, p, y = (math.radians(angle) for angle in (roll_deg, pitch_deg, yaw_deg))
    about_x = np.array([[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]])
    about_y = np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]])
    about_z = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]])
    turned: FloatArray = about_z @ about_y @ about_x
    return turned


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a foot's sensor sits: ``body_m`` in the foot frame (x forward, y left, z up from the sole below the ankle).

    ``angles_deg`` are roll, pitch, yaw of the sensor against the foot; an instep slopes down forward by about 20°.
    """

    body_m: Vector3 = (0.070, 0.0, 0.068)
    angles_deg: Vector3 = (0.0, 20.0, 0.0)


def rotation(pitch: FloatArray, roll: FloatArray, yaw: FloatArray) -> FloatArray:
    """(N, 3, 3) ``Rz(yaw) Rx(roll) Ry(pitch)`` from angles (N,) in rad."""
    sp, cp = np.sin(pitch), np.cos(pitch)
    sr, cr = np.sin(roll), np.cos(roll)
    sw, cw = np.sin(yaw), np.cos(yaw)
    rows = [
        [cw * cp - sw * sr * sp, -sw * cr, cw * sp + sw * sr * cp],
        [sw * cp + cw * sr * sp, cw * cr, sw * sp - cw * sr * cp],
        [-cr * sp, sr, cr * cp],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternions(rotations: FloatArray) -> FloatArray:
    """(N, 4) unit quaternions wxyz of rotation matrices (N, 3, 3), without jumps of sign."""
    q = quaternions_of(rotations)
    if q[0, 0] < 0:
        q[0] = -q[0]
    turn = np.sum(q[1:] * q[:-1], axis=1) < 0
    q[1:][np.cumsum(turn) % 2 == 1] *= -1.0
    return q
