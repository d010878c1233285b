"""Patients of a cohort: body, walk, muscles, electrodes and mountings drawn from published ranges, by number.

Of three neighbours one walks in one of the five slow hemiparetic patterns of Wang et al., in turn, so that any fifteen
in a row have all five. Ranges without a source in the comment are chosen within what adults show
(docs/virtual_patient.md).
"""

from __future__ import annotations

import math
from random import Random
from typing import Any, Final

from fes.signals import FOOT_SENSORS
from fes.simulation.forward.gait_patterns import PATTERNS
from fes.simulation.forward.settings import PLACEMENTS, MuscleSettings, PatientSettings
from fes.simulation.sensor import Placement

HEMIPARETIC: Final = tuple(name for name in PATTERNS if name != "none")
SLOWEST_MPS, FASTEST_SLOW_MPS = 0.21, 0.35  # of those five walks (Wang et al., Table 1)
EVERY_THIRD: Final = 3


def draw_patient(seed: int, number: int, **others: Any) -> PatientSettings:
    """The ``number``-th patient (0, 1, …) of the cohort ``seed``; ``others`` are settings by name and win.

    The same numbers give the same person; whether this one drags a foot only a walk tells.

    Raises:
        ValueError: a setting out of range.
        TypeError: no such setting.
    """
    r = Random(f"{seed}/{number}")
    height_m = min(max(r.gauss(1.69, 0.10), 1.48), 1.95)
    mass_kg = min(max(height_m**2 * r.gauss(26.5, 4.0), 42.0), 130.0)  # by body mass index
    drawn: dict[str, Any] = {
        "seed": r.randrange(1 << 30),
        "height_m": round(height_m, 3),
        "mass_kg": round(mass_kg, 1),
        "voluntary_dorsiflexion": r.choice((0.0, 0.0, 0.1, 0.3)),
        "spasticity": r.uniform(0.0, 0.8),
        "spasm_radps": r.uniform(1.2, 3.0),
        "compensation": r.uniform(0.2, 0.9),
        "variability": r.uniform(1.0, 1.8),
        "asymmetry": r.uniform(0.0, 0.05),
        "electrode_quality": r.uniform(0.6, 1.0),
        "inversion_share": r.gauss(0.15, 0.075)
        - r.uniform(0.0, 0.2),  # lever of 0.6 ± 0.3 cm; evertors reached as well
        "roll_stiffness_nm_per_rad": r.uniform(8.0, 20.0),
        "muscle": _muscle(r, 9.0, 15.0),
        "evertors": _muscle(r, 4.0, 8.0),
        "calf": _muscle(Random(f"{seed}/{number}/calf"), 15.0, 40.0),  # chosen: an eighth to a third of 120 N·m
        **draw_movement(Random(f"{seed}/{number}/movement")),
        "placements": {**PLACEMENTS, **{foot: _placement(r, PLACEMENTS[foot]) for foot in FOOT_SENSORS}},
    }
    if number % EVERY_THIRD == 0:
        name = HEMIPARETIC[number // EVERY_THIRD % len(HEMIPARETIC)]
        speed_mps = PATTERNS[name].speed_mps * r.uniform(0.85, 1.2)
        drawn |= {"pattern": name, "speed_mps": round(min(max(speed_mps, SLOWEST_MPS), FASTEST_SLOW_MPS), 3)}
        drawn["knee_flexion"] = 1.0  # what these walks' knees do is part of the pattern
    else:
        drawn["speed_mps"] = round(r.uniform(0.36, 1.3), 3)
    return PatientSettings(**{**drawn, **others})


def draw_movement(r: Random) -> dict[str, float]:
    """What makes two feet's signals differ at the same speed: how foot, shoe, sensor and knee of a patient move."""
    return {
        "shoe_stiffness": r.uniform(0.6, 1.2),  # a worn or soft sole, a hard one
        "strap_hz": r.uniform(20.0, 40.0),  # soft tissue of the leg: 10–50 Hz (Wakeling & Nigg 2001)
        "strap_damping": r.uniform(0.4, 1.0),
        "toe_break_deg": r.uniform(10.0, 30.0),  # 20–40° barefoot (Isman & Inman 1969), less in a shoe
        "leg_twist_deg": r.uniform(13.0, 25.0),  # of the tibia in space (Levens et al. 1948)
        "knee_flexion": r.uniform(0.68, 0.9),  # 42–56° in swing: after stroke it bends less (Olney & Richards 1996)
        "early_lift_m": 0.0,  # … and the toe passes no higher early than in mid-swing
    }


def _muscle(r: Random, low_nm: float, high_nm: float) -> MuscleSettings:
    threshold_uc = r.uniform(2.5, 5.0)
    return MuscleSettings(
        threshold_uc=threshold_uc,
        saturation_uc=threshold_uc + r.uniform(5.0, 8.0),
        chronaxie_us=min(max(r.gauss(459.0, 126.0), 200.0), 800.0),  # Mogyoros et al. 1996
        max_torque_nm=r.uniform(low_nm, high_nm),
        delay_s=r.uniform(0.02, 0.05),
        tau_calcium_s=r.uniform(0.022, 0.030),  # these three: a twitch of 0.1–0.2, contraction times of 50–70 ms
        tau_rise_s=r.uniform(0.055, 0.070),
        tau_fall_s=r.uniform(0.050, 0.070),
        fatigue_s=_log_uniform(r, 60.0, 400.0),  # by endurance times, see docs/virtual_patient_figures.md
        recovery_s=_log_uniform(r, 127.0, 1200.0),  # from Ding et al. 2003 on
    )


def _log_uniform(r: Random, low: float, high: float) -> float:
    return math.exp(r.uniform(math.log(low), math.log(high)))


def _placement(r: Random, usual: Placement) -> Placement:
    """Put on by hand: up to 1 cm and 8° off the usual place, 5° across the instep's slope."""
    x, y, z = (value + r.uniform(-0.01, 0.01) for value in usual.body_m)
    roll, pitch, yaw = usual.angles_deg
    angles = (roll + r.uniform(-8.0, 8.0), pitch + r.uniform(-5.0, 5.0), yaw + r.uniform(-8.0, 8.0))
    return Placement((x, y, max(z, 0.05)), angles)
