"""The compiled loop over internal steps: until something happens that needs a new plan, or the time asked for."""

import math

import numpy as np

from fes.estimation.numerics.jit import inlined, jit
from fes.estimation.numerics.records import Mat, Record, Vec
from fes.simulation.forward.dynamics import (
    CALF,
    CONTACT,
    DORSIFLEXORS,
    EVERTORS,
    FLAT,
    GRAVITY,
    NO_EVENT,
    PLAN_DUE,
    PRE_SWING,
    STANCE,
    STUMBLE,
    SWING,
    bump,
    heel_rise,
    muscle,
    plan,
    recruitment,
    smooth,
    step,
)

FLAT_RAD = math.radians(2.0)  # the truth's own criterion, see fes.simulation.truth
HEEL_UP_M = 0.005
CONTACT_FROM = 0.45  # share of the swing from which a heel on the ground is a contact
FOREFOOT_FROM = 0.92  # … and the forefoot: before that it drags
LIFTED_S = 0.15  # a burst may lift the foot so long before it would push off by itself
BELT_RADPS = 2.5  # the belt reaches a new speed in about two seconds
ROLL_AIR_RADPS, ROLL_GROUND_RADPS = 22.0, 45.0
TWIST_AIR_RADPS, TWIST_GROUND_RADPS = 16.0, 30.0
OUT_AT_FOOT_OFF, OUT_AT_CONTACT = 0.6, 0.3  # of the leg's greatest outward turn
OUT_UNTIL = 0.45  # share of the swing from which the leg turns back
HANGS_FROM_RAD, HANGS_RAD = math.radians(2.0), math.radians(16.0)  # plantarflexion in which a foot begins to invert


@inlined
def sideways(leg: Record, t: float, dt: float) -> None:
    """Lateral path, heading and roll: what the sagittal plane leaves out, without dynamics but for roll and twist.

    The leg turns about its long axis, outward as the heel rises until early swing, then back until the foot lies flat
    (Levens, Inman & Blosser, *J Bone Joint Surg* 30-A, 1948). The heel rises about the oblique line through the joints
    of the toes, which inverts the foot (Isman & Inman, *Bull Prosthet Res* 10-11, 1969).
    """
    u, w = (t - leg.swing_t) / leg.swing_s, 1.0 / leg.swing_s
    b, b1, b2 = bump(u)
    q, q1, q2 = smooth(u)
    leg.y = leg.across_m + leg.circle_m * b + leg.shift_m * q
    leg.vy = (leg.circle_m * b1 + leg.shift_m * q1) * w
    leg.ay = (leg.circle_m * b2 + leg.shift_m * q2) * w * w
    psi, _, _ = heel_rise(leg, t)
    twists, pace = 0.0, TWIST_GROUND_RADPS
    if leg.mode == PRE_SWING:
        twists = OUT_AT_FOOT_OFF * leg.twists_rad * psi / leg.rise_rad
    elif leg.mode == SWING:
        twists, pace = leg.twists_rad * (1.0 if u < OUT_UNTIL else OUT_AT_CONTACT), TWIST_AIR_RADPS
    leg.atwist = pace * pace * (leg.side * twists - leg.twist) - 2.0 * pace * leg.vtwist
    leg.vtwist += leg.atwist * dt
    leg.twist += leg.vtwist * dt
    leg.yaw = leg.yaw_rad + leg.swerve_rad * b + leg.turn_rad * q + leg.twist
    leg.vyaw = (leg.swerve_rad * b1 + leg.turn_rad * q1) * w + leg.vtwist
    leg.ayaw = (leg.swerve_rad * b2 + leg.turn_rad * q2) * w * w + leg.atwist
    stiff = ROLL_AIR_RADPS if leg.mode == SWING else ROLL_GROUND_RADPS
    # a foot that hangs inverts, for the ankle's axis is oblique; tibialis anterior inverts, the peronei evert
    hangs = min(max((leg.shank - leg.pitch - HANGS_FROM_RAD) / HANGS_RAD, 0.0), 1.0) if leg.mode == SWING else 0.0
    inverting = leg.inverts * leg.torque - leg.everting
    goal = leg.roll_goal - leg.side * (leg.hang_rad * hangs + leg.oblique * psi)
    leg.aroll = stiff * stiff * (goal - leg.roll) - 2.0 * stiff * leg.vroll
    leg.aroll -= leg.side * inverting * ROLL_AIR_RADPS * ROLL_AIR_RADPS / leg.roll_k
    leg.vroll += leg.aroll * dt
    leg.roll += leg.vroll * dt


@inlined
def happened(leg: Record, t: float) -> int:
    """What of this leg needs a new plan now."""
    if leg.mode == SWING:
        u = (t - leg.swing_t) / leg.swing_s
        forefoot = leg.ball_n > 0.0 or leg.toe_n > 0.0
        if (leg.heel_n > 0.0 and u > CONTACT_FROM) or (forefoot and u > FOREFOOT_FROM):
            return CONTACT
        if leg.drag_ns > leg.trip_ns and leg.tripped == 0.0 and u < 0.8:
            return STUMBLE
        return NO_EVENT
    if leg.mode == STANCE and leg.flat == 0:
        tilt = math.hypot(leg.pitch, leg.roll)
        if tilt < FLAT_RAD and leg.heel_z < HEEL_UP_M and leg.ball_n > 0.0 and leg.heel_n > 0.0:
            return FLAT
    lifted = leg.mode == PRE_SWING and t > leg.due_s - LIFTED_S and leg.heel_n + leg.ball_n + leg.toe_n <= 0.0
    if t >= leg.due_s or lifted:
        return PLAN_DUE
    return NO_EVENT


@jit
def feel(out: Vec, leg: Record, belt_a: float, tilt: float, turn: float, turn1: float, px: float, py: float, pz: float,
         with_roll: float) -> None:  # fmt: skip
    """Specific force (m/s²) and angular rate (rad/s) in the segment's axes, at ``p`` m from the ankle; into ``out``.

    ``tilt`` is toe-up/forward positive, with its derivatives ``turn``, ``turn1``; ``with_roll`` 1 for the foot, 0 for
    the shank. Rotation ``Rz(yaw) Rx(roll) Ry(pitch)`` as in :mod:`sim_inputs.generator.foot`.
    """
    p, p1, p2 = -tilt, -turn, -turn1
    r, r1, r2 = with_roll * leg.roll, with_roll * leg.vroll, with_roll * leg.aroll
    y1, y2 = leg.vyaw, leg.ayaw
    sp, cp, sr, cr = math.sin(p), math.cos(p), math.sin(r), math.cos(r)
    sw, cw = math.sin(leg.yaw), math.cos(leg.yaw)
    wx = r1 * cp - y1 * cr * sp
    wy = p1 + y1 * sr
    wz = r1 * sp + y1 * cr * cp
    ux = r2 * cp - r1 * p1 * sp - y2 * cr * sp + y1 * r1 * sr * sp - y1 * p1 * cr * cp
    uy = p2 + y2 * sr + y1 * r1 * cr
    uz = r2 * sp + r1 * p1 * cp + y2 * cr * cp - y1 * r1 * sr * cp - y1 * p1 * cr * sp
    ax, ay, az = leg.ax - belt_a, leg.ay, leg.az + GRAVITY
    fx = ax * (cw * cp - sw * sr * sp) + ay * (sw * cp + cw * sr * sp) - az * cr * sp
    fy = -ax * sw * cr + ay * cw * cr + az * sr
    fz = ax * (cw * sp + sw * sr * cp) + ay * (sw * sp - cw * sr * cp) + az * cr * cp
    cx, cy, cz = wy * pz - wz * py, wz * px - wx * pz, wx * py - wy * px
    out[0] = fx + uy * pz - uz * py + wy * cz - wz * cy
    out[1] = fy + uz * px - ux * pz + wz * cx - wx * cz
    out[2] = fz + ux * py - uy * px + wx * cy - wy * cx
    out[3], out[4], out[5] = wx, wy, wz


@jit
def strapped(strap: Mat, values: Vec, radps: float, damping: float, dt: float) -> None:
    """The force (m/s²) that a sensor feels on a strap that gives way as a damped spring; in place.

    ``strap`` (3, 2): how far, and how fast, it has moved against the segment along each axis.
    """
    for k in range(3):
        strap[k, 1] -= (radps * (radps * strap[k, 0] + 2.0 * damping * strap[k, 1]) + values[k]) * dt
        strap[k, 0] += strap[k, 1] * dt
        values[k] = -radps * (radps * strap[k, 0] + 2.0 * damping * strap[k, 1])


@jit
def low_pass(filter_: Mat, values: Mat, b0: float, a1: float, a2: float) -> None:
    """A second-order Butterworth step (transposed direct form) on 6 values, in place; ``filter_`` (6, 2) its memory."""
    for k in range(6):
        x = values[k]
        y = b0 * x + filter_[k, 0]
        filter_[k, 0] = 2.0 * b0 * x - a1 * y + filter_[k, 1]
        filter_[k, 1] = b0 * x - a2 * y
        values[k] = y


@jit
def run(
    legs: Vec, belts: Vec, begin: int, end: int, dt: float, pulse_step: Vec, pulse_uc: Vec, pulse_of: Vec,
    muscles: Vec, affected: int, places: Mat, straps: Mat, filters: Mat, taps: Vec, values: Mat, every: int,
    samples: Mat, trace_every: int, trace: Mat,
) -> tuple[int, int, int]:  # fmt: skip
    """Advance from step ``begin`` to ``end`` at most; returns the step reached, the leg and what happened to it.

    Args:
        legs: (2,) records, left then right; belts: (1,) record.
        pulse_step, pulse_uc, pulse_of: when (internal step) each pulse starts to pull, its charge at the nerve, and of
            which muscle.
        muscles: (3,) records of the affected leg.
        affected: the leg that is stimulated.
        places: (4, 3) sensors from the ankle, in SENSORS' order; straps (4, 3, 2), see :func:`strapped`.
        filters: (4, 6, 2) memory of their low-pass, taps (3,).
        values: (4, 6) the sensors' newest values.
        every, samples: a row (4, 6) of ``samples`` each so many steps, row 0 belonging to the first after ``begin``.
        trace_every, trace: likewise (2, 14) per row.
    """
    sample, row = 0, 0
    belt = belts[0]
    for number in range(begin, end):
        t = number * dt
        belt.a += (BELT_RADPS * BELT_RADPS * (belt.goal - belt.v) - 2.0 * BELT_RADPS * belt.a) * dt
        belt.v += belt.a * dt
        belt.x += belt.v * dt
        while belt.pulse < pulse_step.size and pulse_step[belt.pulse] <= number:
            one = muscles[pulse_of[belt.pulse]]
            share = recruitment(pulse_uc[belt.pulse], one.threshold_uc, one.saturation_uc)
            if share > 0.0:
                one.recruited = share
                one.released += 1.0
            belt.pulse += 1
        lame = legs[affected]
        muscle(muscles[DORSIFLEXORS], lame.pitch - lame.shank, lame.vpitch - lame.vshank, dt)
        muscle(muscles[EVERTORS], lame.side * lame.roll, lame.side * lame.vroll, dt)
        muscle(muscles[CALF], lame.shank - lame.pitch, lame.vshank - lame.vpitch, dt)
        lame.torque, lame.everting = muscles[DORSIFLEXORS].torque, muscles[EVERTORS].torque
        lame.plantar = muscles[CALF].torque
        who, what = -1, NO_EVENT
        for side in range(2):
            leg = legs[side]
            plan(leg, belt, t)
            step(leg, belt, t, dt)
            sideways(leg, t, dt)
            if what == NO_EVENT:
                what = happened(leg, t + dt)
                who = side
            foot, shank = values[side], values[2 + side]
            a = places[side]
            feel(foot, leg, belt.a, leg.pitch, leg.vpitch, leg.apitch, a[0], a[1], a[2], 1.0)
            strapped(straps[side], foot, leg.strap_radps, leg.strap_damp, dt)
            low_pass(filters[side], foot, taps[0], taps[1], taps[2])
            a = places[2 + side]
            feel(shank, leg, belt.a, leg.shank, leg.vshank, leg.ashank, a[0], a[1], a[2], 0.0)
            strapped(straps[2 + side], shank, leg.strap_radps, leg.strap_damp, dt)
            low_pass(filters[2 + side], shank, taps[0], taps[1], taps[2])
        done = number + 1
        if done % every == 0:
            for sensor in range(4):  # not as slices: their check of shapes would take seconds to compile
                for axis in range(6):
                    samples[sample, sensor, axis] = values[sensor, axis]
            sample += 1
        if done % trace_every == 0:
            for side in range(2):
                leg = legs[side]
                note = trace[row, side]
                note[0], note[1], note[2], note[3] = leg.x, leg.y, leg.z, leg.pitch
                note[4], note[5], note[6], note[7], note[8] = leg.roll, leg.yaw, leg.shank, leg.toe_z, leg.heel_z
                note[9], note[10], note[11] = 0.0, leg.torque, 1.0
                if side == affected:
                    note[9], note[11] = muscles[DORSIFLEXORS].active, muscles[DORSIFLEXORS].fit
                note[12], note[13] = leg.heel_n + leg.ball_n + leg.toe_n, leg.mode + 10.0 * leg.flat
            row += 1
        if what != NO_EVENT:
            return done, who, what
    return end, -1, NO_EVENT


@jit
def plan_at(legs: Vec, belt: Vec, side: int, t: float) -> None:
    """Put one leg's plan for ``t`` s into its record; ``belt`` (1,)."""
    plan(legs[side], belt[0], t)


def to_rest_m(belt: np.void) -> float:
    """How far a braking belt (record of ``layout.BELT``, goal 0) goes on until it rests.

    ``v'' + 2 w v' + w² v = 0`` integrated once, from now to for ever.
    """
    return float(belt["a"] + 2.0 * BELT_RADPS * belt["v"]) / BELT_RADPS**2


def travel_m(belt: np.void, seconds: float) -> float:
    """How far a braking belt goes in this time."""
    gone = math.exp(-BELT_RADPS * seconds)
    slope = float(belt["a"] + BELT_RADPS * belt["v"])
    v = (float(belt["v"]) + slope * seconds) * gone
    a = slope * gone - BELT_RADPS * v
    return to_rest_m(belt) - (a + 2.0 * BELT_RADPS * v) / BELT_RADPS**2
