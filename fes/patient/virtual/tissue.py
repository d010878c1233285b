"""Relaxed tissue about the ankle, compiled: a spring that tightens at both ends of the range, and what it loses.

Scalar code only, so that bits do not differ.
"""

from __future__ import annotations

import math

from fes.estimation.compiled import jit

DAMPING_RATIO = 0.37  # what the foot's inertia, the tissue's stiffness and the usual damping make at a right angle


@jit
def passive(angle: float, knee: float, stiff: float, short: float) -> float:
    """Torque of relaxed tissue about the ankle, dorsiflexing positive, N·m: Riener & Edrich (1999).

    ``exp(2.1016 - 0.0843 a - 0.0176 k) - exp(-7.9763 + 0.1949 a + 0.0008 k) - 1.792`` plantarflexes, with ``a`` degrees
    of plantarflexion and ``k`` of knee flexion: the calf crosses both joints. ``stiff`` multiplies it, ``short`` (rad)
    is how much earlier a shortened calf pulls; 1 and 0 are normal. ``angle``, ``knee`` in rad, dorsiflexion positive.
    """
    a, k = -math.degrees(angle + short), math.degrees(knee)
    return -stiff * (math.exp(2.1016 - 0.0843 * a - 0.0176 * k) - math.exp(-7.9763 + 0.1949 * a + 0.0008 * k) - 1.792)


@jit
def damping(angle: float, knee: float, stiff: float, short: float, damp: float, inertia: float) -> float:
    """Of the ankle, N·m·s/rad: ``damp`` about the middle of its range, more towards the ends where tissue tightens.

    There viscosity grows with stiffness so that the damping ratio stays what it was (Weiss, Kearney & Hunter, *J
    Biomech* 19, 1986, and 21, 1988): the ends of the range are no springs that throw the foot back.
    """
    a, k = -math.degrees(angle + short), math.degrees(knee)
    slope = 0.0843 * math.exp(2.1016 - 0.0843 * a - 0.0176 * k) + 0.1949 * math.exp(-7.9763 + 0.1949 * a + 0.0008 * k)
    return max(damp, 2.0 * DAMPING_RATIO * math.sqrt(inertia * math.degrees(stiff * slope)))
