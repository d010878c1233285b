"""The height over a stride, solved by itself once the orientation is settled.

Heights hang on the vertical velocity alone, and what spoils it is mostly one thing: the impact at the heel, which is
over in hundredths of a second, clips the sensor, outruns it, and lets it shake on its shoe. What was measured then is
worth little, before and after it much. So the error that the end shows (the foot is at rest, and as high as it
began) belongs there, and swing keeps the height that it was lifted to. In the common solution of
``fes.estimation.likely`` it cannot all go there, because the same samples also bear on tilt and length.

Two equations, velocity and height at the end. Each sample's noise grows with the fastest change of the specific force
that is not long past; no threshold says what an impact is, so soft and hard contacts need no settings of their own.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.compiled import jit_fused
from fes.estimation.rotation import to_world
from fes.signals import G_MPS2


class HeightNoise(NamedTuple):
    """Standard deviations. Half or twice of each leaves the SD against 53 lifts seen optically at 3.2 to 3.9 mm."""

    push_mps2_rthz: float = 0.02  # of a quiet sensor
    shaken_share: float = 0.3  # of a jump of the specific force between samples that may be wrong, …
    shaken_s: float = 0.03  # … and over which time that dies away
    bias_mps2: float = 0.03  # of the vertical over a stride
    end_height_m: float = 0.005


@jit_fused
def settle_height(
    t_ns: Any, acc: Any, quaternion: Any, end_velocities: Any, end_variances: Any, noise: HeightNoise, out: Any
) -> bool:
    """Heights and vertical velocities of a stride on level ground.

    Args:
        t_ns: (N,) time stamps.
        acc: (N, 3) specific force in m/s², free of calibrated bias.
        quaternion: (N, 4) the settled orientation.
        end_velocities: (2,) vertical, m/s, at the start and at the end, as the lever arm says.
        end_variances: (2,) of them, (m/s)².
        noise: sizes of the other errors.
        out: (N, 2) to be filled: vertical velocity in m/s, height in m above the start.

    Returns:
        False where there is nothing to integrate.
    """
    n = t_ns.shape[0]
    if n < 3 or t_ns[n - 1] <= t_ns[0]:
        return False
    last = n - 1
    pushes = np.zeros(n)  # variance of each interval's velocity increment
    shaken, before, fades, fades_s = 0.0, 0.0, 0.0, 0.0
    out[0, 0], out[0, 1] = end_velocities[0], 0.0
    for i in range(n):
        _, _, up = to_world(
            quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3], acc[i, 0], acc[i, 1], acc[i, 2]
        )
        if i > 0:
            dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
            jx, jy, jz = acc[i, 0] - acc[i - 1, 0], acc[i, 1] - acc[i - 1, 1], acc[i, 2] - acc[i - 1, 2]
            if dt_s != fades_s:
                fades, fades_s = math.exp(-dt_s / noise.shaken_s), dt_s
            shaken = max(math.sqrt(jx * jx + jy * jy + jz * jz), shaken * fades)
            pushes[i] = noise.push_mps2_rthz**2 * dt_s + (noise.shaken_share * shaken * dt_s) ** 2
            out[i, 0] = out[i - 1, 0] + dt_s * (0.5 * (before + up) - G_MPS2)
            out[i, 1] = out[i - 1, 1] + 0.5 * dt_s * (out[i - 1, 0] + out[i, 0])
        before = up
    span_s = 1e-9 * (t_ns[last] - t_ns[0])
    start, bias = end_variances[0], noise.bias_mps2 * noise.bias_mps2
    vv = start + end_variances[1] + bias * span_s * span_s
    vh = start * span_s + 0.5 * bias * span_s * span_s * span_s
    hh = start * span_s * span_s + 0.25 * bias * span_s**4 + noise.end_height_m**2
    for i in range(1, n):
        left_s = 1e-9 * (t_ns[last] - 0.5 * (t_ns[i - 1] + t_ns[i]))
        vv += pushes[i]
        vh += pushes[i] * left_s
        hh += pushes[i] * left_s * left_s
    determinant = vv * hh - vh * vh
    if not determinant > 0.0:
        return False
    dv, dh = end_velocities[1] - out[last, 0], -out[last, 1]
    along_v, along_h = (hh * dv - vh * dh) / determinant, (vv * dh - vh * dv) / determinant
    correction = start * (along_v + span_s * along_h)
    per_s = bias * (span_s * along_v + 0.5 * span_s * span_s * along_h)
    out[0, 0] += correction
    for i in range(1, n):
        left_s, dt_s = 1e-9 * (t_ns[last] - 0.5 * (t_ns[i - 1] + t_ns[i])), 1e-9 * (t_ns[i] - t_ns[i - 1])
        correction += pushes[i] * (along_v + left_s * along_h) + per_s * dt_s
        out[i, 0] += correction
        out[i, 1] = out[i - 1, 1] + 0.5 * dt_s * (out[i - 1, 0] + out[i, 0])
    return True
