"""The stimulated dorsiflexors, compiled: from pulses to torque. Scalar code only, so that bits do not differ.

- Recruitment over charge: Durfee & MacLean, *IEEE Trans Biomed Eng* 36 (1989); so used by Riener & Fuhr, *IEEE Trans
  Rehabil Eng* 6 (1998).
- Calcium transients summed over pulses, then saturation: Ding, Wexler & Binder-Macleod, *J Appl Physiol* 88 (2000).
- Activation with its own time constants, fatigue and recovery: Riener, Quintern & Schmidt, *J Biomech* 29 (1996).
- Force against velocity: Hill's hyperbola for a muscle that shortens, up to 1.4 times as much for one stretched.

The electromechanical delay is applied where pulses are taken in (:mod:`fes.patient.virtual.patient`).
"""

from __future__ import annotations

import math
from typing import Any

from fes.estimation.compiled import jit

KM = 0.15  # calcium at which half of the saturated force is reached, in transients
GAIN_40HZ = (0.8 + KM) / 0.8  # so that full recruitment at 40 Hz is 1
BETA = 0.6  # how far fatigue depends on frequency (Riener et al.)
FASTEST_RADPS = 15.0  # unloaded: 10 fibre lengths of 6 cm a second on a lever of 4 cm
HILL = 4.0  # 1 / (a / F0) of Hill's hyperbola
STRETCHED = 1.4


@jit
def recruitment(charge_uc: float, threshold_uc: float, saturation_uc: float) -> float:
    """Share of the muscle that a pulse reaches, 0–1: a ramp from threshold to saturation with rounded corners.

    Durfee & MacLean (1989): ``c1 {(q - thr) atan[k (q - thr)] - (q - sat) atan[k (q - sat)]} + c2``, scaled to end at
    0 and 1, and nothing well below the threshold.
    """
    width = saturation_uc - threshold_uc
    k = 12.0 / width
    low, high = charge_uc - threshold_uc, charge_uc - saturation_uc
    value = 0.5 + (low * math.atan(k * low) - high * math.atan(k * high)) / (math.pi * width)
    if low < -0.25 * width:
        return 0.0
    return min(max(value - 0.028, 0.0) / (1.0 - 0.056), 1.0)


@jit
def force_at(dorsiflexing_radps: float) -> float:
    """Share of the isometric force while the ankle moves; dorsiflexing, the muscle shortens. Smooth at rest."""
    v = dorsiflexing_radps / FASTEST_RADPS
    if v >= 0.0:
        return max(1.0 - v, 0.0) / (1.0 + HILL * v)
    x = (1.0 + HILL) / (STRETCHED - 1.0) * v
    return 1.0 + (STRETCHED - 1.0) * x / (x - 1.0)


@jit
def muscle(leg: Any, dt: float) -> None:
    """One step of the stimulated muscle: calcium, activation, fitness and torque."""
    leg.calcium -= leg.calcium * dt / leg.tau_ca
    drive = min(leg.recruited * GAIN_40HZ * leg.calcium / (leg.calcium + KM), 1.05)
    tau = leg.tau_up if drive > leg.active else leg.tau_down
    leg.active += (drive - leg.active) * dt / tau
    pace = 1.0 - BETA + BETA * (0.01 * leg.calcium / leg.tau_ca) ** 2
    tired = min(leg.active * pace / (1.0 - BETA + BETA * 0.16), 1.0)  # 1 for all of it at 40 Hz
    leg.fit += dt * ((leg.fit_floor - leg.fit) * tired / leg.tau_fat + (1.0 - leg.fit) * (1.0 - tired) / leg.tau_rec)
    length = min(max(1.0 - 1.1 * (leg.pitch - leg.shank + 0.15), 0.4), 1.0)  # short in dorsiflexion, and weaker
    leg.torque = leg.torque_max * leg.fit * leg.active * length * force_at(leg.vpitch - leg.vshank)
