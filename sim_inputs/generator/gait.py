"""One stride of one foot: its plan (times, landing spot, angles) written into the channels of a :class:`FootMotion`.

Angles are of the sole against the ground, toe-down positive. A stride is planned by four instants, each with a
physical meaning that :mod:`fes.simulation.truth` measures again on the finished path:

heel off → toe off → contact → flat, i.e. pre-swing, swing, loading response and stance begin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sim_inputs.generator.foot import FootMotion
from sim_inputs.generator.motion import Pulse, Ring, Step, evaluate, step_time

TILT_SEEN_RAD = math.radians(2.0)  # a sole tilted by this much stands 5 mm off at the other end: no longer flat


@dataclass(frozen=True, slots=True)
class StridePlan:
    """One stride from the stance before its swing to the stance after it. Times in s, lengths in m, angles in rad."""

    heel_off_s: float  # heel 5 mm up, end of the stance before
    toe_off_s: float  # the toe leaves the ground
    contact_s: float  # first contact, with whatever part of the sole comes first
    flat_s: float  # the sole lies flat again
    next_heel_off_s: float  # end of the stance after
    forward_m: float  # how far this swing carries the foot, in the walking frame
    sideways_m: float  # the same to the left
    push_rad: float  # greatest toe-down pitch, reached just after toe-off
    strike_rad: float  # pitch at contact (negative: heel first)
    dangle_rad: float  # how far the toe drops again in late swing, to arrive at ``strike_rad``
    invert_rad: float  # roll at contact, to be loaded flat
    turn_rad: float  # change of heading over the swing
    swerve_rad: float  # passing change of heading within the swing
    circumduction_m: float  # passing sideways excursion of the swing
    lift_m: float  # greatest clearance of the sole's lowest point in early swing
    toe_clearance_m: float  # least clearance of the sole's lowest point in mid-swing
    fall_mps: float  # downward speed at contact
    forward_mps: float  # forward speed of the landing foot at contact
    stop_s: float  # how long the ground takes to stop both
    ring_mps2: float  # size of the ringing after contact
    drift_rad: float  # pitch (forward rocking) gained over the stance after
    creep_m: float  # instep's creep forward over the stance after
    slow_share: float  # part of the push that is the slow heel rise; the rest is the quick push-off
    jolt_mps2: float  # size of the jolt that the other foot's contact sends through the deck as this heel rises
    contact: str  # what meets the ground first: "heel", "forefoot", "flat"; "soft" if no sensor could tell


def write_stride(motion: FootMotion, plan: StridePlan, previous_drift_rad: float, previous_creep_m: float) -> None:
    """Add one stride's blocks to ``motion``; the ``previous_*`` are what the stance before has gained."""
    _pitch(motion, plan, previous_drift_rad)
    _travel(motion, plan)
    _sideways(motion, plan)
    swing = plan.contact_s - plan.toe_off_s
    motion.add("shear", Step(plan.toe_off_s, plan.toe_off_s + 0.6 * swing, -previous_creep_m))
    motion.add("shear", Step(plan.flat_s, plan.next_heel_off_s, plan.creep_m))
    _ring(motion, plan)


def _pitch(motion: FootMotion, plan: StridePlan, drift: float) -> None:
    """Heel rise and push-off, toe-up in swing, the toe's drop if it dangles, and the roll down to flat."""
    heel_off, toe_off, contact = plan.heel_off_s, plan.toe_off_s, plan.contact_s
    pre_swing, swing = toe_off - heel_off, contact - toe_off
    push = plan.push_rad - 0.5 * drift
    slow, fast = plan.slow_share * push, (1.0 - plan.slow_share) * push
    motion.add("pitch", _heel_rise(heel_off, toe_off, 0.7 * slow, TILT_SEEN_RAD - 0.5 * drift))
    # the heel rises faster and faster: the rate has one peak only, at toe-off
    climb = Pulse(heel_off + 0.1 * pre_swing, toe_off - 0.02, toe_off - 0.02, toe_off + 0.06, 1.0)
    motion.add("pitch", replace(climb, speed=0.3 * slow / climb.total))
    # the push-off turns fastest (u = 0.6 of its hump) a few milliseconds before the toe leaves
    fast_length = min(0.22 + 0.9 * max(0.0, pre_swing - 0.25), 1.1 * pre_swing)
    fast_start = toe_off - 0.006 - 0.6 * fast_length
    motion.add("pitch", Step(fast_start, fast_start + fast_length, fast, m=3, n=2))

    rise = plan.push_rad - (plan.strike_rad - plan.dangle_rad)
    first = 0.75 * rise
    motion.add("pitch", Step(toe_off + 0.005, toe_off + 0.75 * swing, -first))
    motion.add("pitch", Step(toe_off + 0.42 * swing, contact - 0.05 * swing, first - rise))
    if plan.dangle_rad:
        motion.add("pitch", Step(toe_off + 0.6 * swing, contact + 0.01, plan.dangle_rad))
    start, end = _loading(plan)
    motion.add("pitch", Step(start, end, -plan.strike_rad - 0.5 * plan.drift_rad, n=3))
    motion.add("pitch", Step(plan.flat_s, plan.next_heel_off_s, plan.drift_rad))


def _heel_rise(heel_off: float, toe_off: float, angle: float, seen: float) -> Pulse:
    """The slow part of the push, begun so early that it has turned the foot by ``seen`` just at heel off."""
    rise, brake, end = 0.45 * (toe_off - heel_off), toe_off - 0.02, toe_off + 0.06
    low, high = 0.0, 1.0
    for _ in range(40):
        part = 0.5 * (low + high)
        start = heel_off - part * rise
        unit = Pulse(start, start + rise, brake, end, 1.0)
        speed = angle / unit.total
        turned = float(evaluate([unit], np.array([heel_off])).value[0]) * speed
        low, high = (part, high) if turned < seen else (low, part)
    return Pulse(start, start + rise, brake, end, speed)


def _loading(plan: StridePlan) -> tuple[float, float]:
    """When the roll down to flat starts and ends, so that the sole is within the seen tilt just at ``flat_s``."""
    tilt = math.hypot(plan.strike_rad, plan.invert_rad)
    share = 1.0 - TILT_SEEN_RAD / max(tilt, 1.5 * TILT_SEEN_RAD)
    start = plan.contact_s - 0.008
    return start, start + (plan.flat_s - start) / step_time(share, 2, 3)


def _travel(motion: FootMotion, plan: StridePlan) -> None:
    """Forward and upward: off the ground at toe-off, stopped by the ground within ``stop_s`` of contact."""
    toe_off, contact = plan.toe_off_s, plan.contact_s
    swing = contact - toe_off
    landing = Pulse(contact - 0.5 * swing, contact, contact, contact + plan.stop_s, plan.forward_mps)
    # the toe, hardly loaded any more, begins to slip forward just before it leaves the ground: 1–3 mm
    carry = (toe_off - 0.04, toe_off + 0.42 * swing, contact - 0.52 * swing, contact)
    unit = Pulse(*carry, 1.0)
    motion.add("along", landing, Pulse(*carry, (plan.forward_m - landing.total) / unit.total))

    motion.add("air", Step(toe_off, toe_off + 0.45 * swing, 1.0), Step(contact - 0.35 * swing, contact, -1.0))
    approach = max(0.10, 0.25 * swing)
    fall = Pulse(contact - approach, contact, contact, contact + plan.stop_s, -plan.fall_mps)
    high, low, last = plan.lift_m, plan.toe_clearance_m, -fall.total
    motion.add(
        "lift",
        Step(toe_off, toe_off + 0.35 * swing, high),
        Step(toe_off + 0.25 * swing, toe_off + 0.55 * swing, low - high),
        Step(toe_off + 0.50 * swing, contact - 0.5 * approach, last - low),
        fall,
    )


def _sideways(motion: FootMotion, plan: StridePlan) -> None:
    """Circumduction, landing spot, heading and inversion."""
    toe_off, contact = plan.toe_off_s, plan.contact_s
    middle = 0.5 * (toe_off + contact)
    motion.add(
        "across",
        Step(toe_off, middle, plan.circumduction_m),
        Step(middle, contact, -plan.circumduction_m),
        Step(toe_off, contact, plan.sideways_m),
    )
    motion.add(
        "yaw",
        Step(toe_off, middle, plan.swerve_rad),
        Step(middle, contact, -plan.swerve_rad),
        Step(toe_off, contact, plan.turn_rad),
    )
    start, end = _loading(plan)
    motion.add("roll", Step(toe_off, contact, plan.invert_rad), Step(start, end, -plan.invert_rad, n=3))


def _ring(motion: FootMotion, plan: StridePlan) -> None:
    """Shoe and soft tissue ring after contact, and again, weaker, when the rest of the sole slaps down."""
    # the other foot lands as this heel rises (double support): that shakes the deck
    motion.add("bounce", Ring(plan.heel_off_s + 0.04, plan.jolt_mps2, 21.0, 0.045, rise_s=0.012))
    if plan.ring_mps2 <= 0.0:
        return
    size = plan.ring_mps2
    motion.add("bounce", Ring(plan.contact_s, size, 34.0, 0.016))
    motion.add("shear", Ring(plan.contact_s + 0.002, -0.6 * size, 27.0, 0.018))
    motion.add("nod", Ring(plan.contact_s, 3.0 * size, 30.0, 0.014))
    slap = plan.contact_s + 0.6 * (plan.flat_s - plan.contact_s)
    motion.add("bounce", Ring(slap, 0.3 * size, 40.0, 0.014))
