"""The ground under one round point of the foot, compiled. Scalar code only, so that bits do not differ.

Hertz's law of a sphere with damping that grows with depth (Hunt & Crossley, *J Appl Mech* 42, 1975); friction by
bristles. Where the numbers come from: docs/virtual_patient.md.
"""

from __future__ import annotations

import math

from fes.estimation.compiled import jit

# Hertz's law of a sphere, N/m^1.5: half the weight presses a heel in by 8 mm; see docs/virtual_patient.md.
# The ball is two of them, beside the first and the fifth toe, and gives way by 5 mm.
HEEL_N_PER_M15, BALL_N_PER_M15, TOE_N_PER_M15 = 5.5e5, 1.1e6, 2.0e5
HEEL_M = 0.035  # radius of the heel, over which the foot rolls
GROUND_DAMP_S_PER_M = 1.8
BRISTLE_N_PER_M = 4.0e4
BRISTLE_NS_PER_M = 120.0


@jit
def touch(at: float, x: float, z: float, vx: float, vz: float, stiff: float, slip: float) -> tuple[float, float, float]:
    """Force of the ground on one round point (forward, up) and its bristle's new anchor (NaN: in the air)."""
    if z >= 0.0:
        return 0.0, 0.0, math.nan
    up = max(-stiff * z * math.sqrt(-z) * (1.0 - GROUND_DAMP_S_PER_M * vz), 0.0)
    if at != at:
        at = x
    forward = -BRISTLE_N_PER_M * (x - at) - BRISTLE_NS_PER_M * vx
    most = slip * up
    if abs(forward) > most:
        forward = most if forward > 0.0 else -most
        at = x + (forward + BRISTLE_NS_PER_M * vx) / BRISTLE_N_PER_M
        if abs(x - at) > 0.004:
            at = x + (0.004 if at > x else -0.004)
    return forward, up, at
