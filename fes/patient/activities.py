"""What people do besides walking: stand, shift their weight, turn on the spot, lift a heel, sit down, get up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fes.patient.gait import StridePlan, write_stride
from fes.patient.motion import Pulse, Ring, Step
from fes.patient.walk import HALF_WIDTH_M, Foot


@dataclass(frozen=True, slots=True)
class Activity:
    """From ``start_s`` to ``end_s`` the person does ``activity``; ``walking`` says whether that is walking."""

    start_s: float
    end_s: float
    activity: str
    walking: bool


def weight_shifts(rng: np.random.Generator, feet: list[Foot], start_s: float, count: int) -> float:
    """Lean from foot to foot: a degree or two of roll, less of pitch, flat on the ground. Returns when it ends."""
    t = start_s
    for number in range(count):
        length = float(rng.uniform(0.9, 1.4))
        lean = math.radians(float(rng.uniform(0.8, 1.8))) * (-1.0 if number % 2 else 1.0)
        sag = math.radians(float(rng.uniform(-0.5, 0.9)))
        for foot in feet:
            foot.motion.add("roll", Step(t, t + 0.5 * length, lean), Step(t + 0.5 * length, t + length, -lean))
            foot.motion.add("pitch", Step(t, t + 0.6 * length, sag), Step(t + 0.6 * length, t + length, -sag))
        t += length + 0.2
    return t


def turn_on_the_spot(rng: np.random.Generator, feet: list[Foot], start_s: float, turn_deg: float, steps: int) -> float:
    """Turn by ``turn_deg`` in ``steps`` small steps of each foot, one foot after the other. Returns when it ends."""
    t = start_s
    centre = sum(foot.along_m for foot in feet) / len(feet)
    for number in range(steps):
        for foot in feet:
            heading = foot.heading_rad + math.radians(turn_deg) * (number + 1) / steps
            heel_off = t
            toe_off = heel_off + float(rng.uniform(0.22, 0.28))
            contact = toe_off + float(rng.uniform(0.28, 0.36))
            flat = contact + float(rng.uniform(0.06, 0.10))
            along = centre - math.sin(heading) * foot.side * HALF_WIDTH_M
            across = math.cos(heading) * foot.side * HALF_WIDTH_M
            yaw = heading + foot.side * math.radians(7.0 + float(rng.normal(0.0, 2.0)))
            plan = StridePlan(
                heel_off_s=heel_off, toe_off_s=toe_off, contact_s=contact, flat_s=flat, next_heel_off_s=flat + 0.3,
                forward_m=along - foot.along_m, sideways_m=across - foot.across_m,
                push_rad=math.radians(float(rng.uniform(14.0, 22.0))),
                strike_rad=math.radians(float(rng.uniform(2.5, 6.0))), dangle_rad=0.0, invert_rad=math.radians(2.0),
                turn_rad=yaw - foot.yaw_rad, swerve_rad=0.0,
                circumduction_m=0.0, lift_m=0.03, toe_clearance_m=0.02, fall_mps=float(rng.uniform(0.15, 0.3)),
                forward_mps=0.0, stop_s=0.02, ring_mps2=6.0, drift_rad=0.0, creep_m=0.0,
                slow_share=0.4, jolt_mps2=0.0, contact="forefoot",
            )  # fmt: skip
            write_stride(foot.motion, plan, foot.drift_rad, foot.creep_m)
            foot.plans.append(plan)
            foot.along_m, foot.across_m, foot.yaw_rad = along, across, yaw
            foot.drift_rad, foot.creep_m = 0.0, 0.0
            t = flat + float(rng.uniform(0.10, 0.25))
    for foot in feet:
        foot.heading_rad += math.radians(turn_deg)
    return t


def heel_lift(foot: Foot, start_s: float, height_deg: float, up_s: float, hold_s: float, down_s: float) -> float:
    """Lift the heel with the toe on the ground and put it back; quick ones hit the ground. Returns when it ends."""
    height = math.radians(height_deg)
    top = start_s + up_s
    foot.motion.add("pitch", Step(start_s, top, height))
    if down_s > 0.5:
        foot.motion.add("pitch", Step(top + hold_s, top + hold_s + down_s, -height))
        return top + hold_s + down_s
    landing = top + hold_s + down_s
    unit = Pulse(top + hold_s, landing - 0.1 * down_s, landing, landing + 0.03, 1.0)
    foot.motion.add("pitch", Pulse(top + hold_s, landing - 0.1 * down_s, landing, landing + 0.03, -height / unit.total))
    foot.motion.add("bounce", Ring(landing, 8.0, 33.0, 0.016))
    return landing + 0.03


def sit_and_stand(
    rng: np.random.Generator, feet: list[Foot], start_s: float, seated_s: float
) -> tuple[float, float, float]:
    """Sit down, stay ``seated_s``, get up: feet slide, toes come up, heels come up. Returns the three ends.

    Whatever slid and tilted goes back, so the person stands as before.
    """
    down_end = start_s + 2.2
    up_start = down_end + seated_s
    up_end = up_start + 2.4
    for foot in feet:
        delay = float(rng.uniform(0.0, 0.25))
        slide = float(rng.uniform(0.05, 0.10))
        tip = math.radians(float(rng.uniform(6.0, 12.0)))
        rise = math.radians(float(rng.uniform(8.0, 15.0)))
        rest = math.radians(float(rng.uniform(-4.0, -2.0)))
        # lowering: toes come up while the weight goes back, the feet shuffle forward
        foot.motion.add("pitch", Step(start_s + 0.3 + delay, start_s + 1.2 + delay, -tip))
        foot.motion.add("pitch", Step(start_s + 1.3 + delay, start_s + 1.9 + delay, tip + rest))
        foot.motion.add("along", Step(start_s + 0.6 + delay, start_s + 1.5 + delay, slide))
        # seated: the legs are never quite still
        wag = start_s + 2.2 + float(rng.uniform(0.3, 0.5)) * seated_s
        foot.motion.add(
            "pitch", Step(wag, wag + 0.5, math.radians(5.0)), Step(wag + 0.6, wag + 1.3, math.radians(-5.0))
        )
        # getting up: the feet are drawn back, heels lift, then stand
        foot.motion.add("along", Step(up_start + delay, up_start + 0.7 + delay, -slide))
        foot.motion.add("pitch", Step(up_start + delay, up_start + 0.7 + delay, rise - rest))
        foot.motion.add("pitch", Step(up_start + 0.9 + delay, up_start + 1.8 + delay, -rise))
    return down_end, up_start, up_end
