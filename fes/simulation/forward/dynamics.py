"""The compiled integration of a leg: plan, ankle, muscle, ground. Scalar code only, so that bits do not differ.

A leg is a point (the ankle) that the rest of the body carries along a planned path through a spring and a damper, and a
rigid foot that turns about it. What acts on the foot: gravity, the swinging leg's inertia, passive tissue, voluntary
and stimulated dorsiflexors, the calf, its stretch reflex and its stimulation, and the ground at heel, ball and toe.
Semi-implicit Euler.

- Ground: Hertz's law of a sphere with damping that grows with depth (Hunt & Crossley, *J Appl Mech* 42, 1975); friction
  by bristles. In pre-swing the foot rolls over its ball and then, as the shoe bends no further, over its toe's tip.
- Recruitment over charge: Durfee & MacLean, *IEEE Trans Biomed Eng* 36 (1989); so used by Riener & Fuhr, *IEEE Trans
  Rehabil Eng* 6 (1998). Charge against pulse width: Weiss's law, :class:`fes.simulation.forward.MuscleSettings`.
- Calcium transients of second order summed over pulses: Ding, Wexler & Binder-Macleod, *J Appl Physiol* 88 (2000).
  Their saturation is cooperative: Bobet & Stein, *IEEE Trans Biomed Eng* 45 (1998); so a twitch is small.
- Activation with its own time constants, fatigue and recovery: Riener, Quintern & Schmidt, *J Biomech* 29 (1996).
- Force against velocity: Hill's hyperbola for a muscle that shortens, up to 1.4 times as much for one stretched.

Where the numbers come from: docs/virtual_patient_figures.md. One record per leg, one for the belt. Angles: foot pitch
and shank tilt toe-up/forward positive; ankle = pitch - shank, dorsiflexion positive. x is forward in the belt's frame,
z up from the ground. The electromechanical delay is applied where pulses come in
(:mod:`fes.simulation.forward.patient`).
"""

import math
from typing import Final

import numpy as np

from fes.estimation.numerics.jit import inlined, jit
from fes.estimation.numerics.records import Record, Vec

STANCE: Final = 0
PRE_SWING: Final = 1
SWING: Final = 2

NO_EVENT: Final = 0
PLAN_DUE: Final = 1  # a planned instant has come: heel off or foot off
CONTACT: Final = 2  # initial contact
STUMBLE: Final = 3
FLAT: Final = 4  # the foot lies flat

HARMONICS: Final = 7
SERIES: Final = 1 + 2 * HARMONICS

# --- fixed while the patient lives ----------------------------------------------------------------------
_BODY = (
    "thigh_m", "shank_m", "sole_m",  # segment lengths; ankle's height over the sole
    "heel_x", "ball_x", "toe_m",  # heel and ball ahead of the ankle, toe ahead of the ball
    "foot_kg", "com_x", "inertia", "moved_kg",  # the foot; its inertia about the ankle; what moves with the ankle
    "weight_n", "leg_k", "leg_d",  # load on one leg; how firmly the leg keeps to its path
    "short_rad", "stiff", "damp",  # passive ankle: how short and stiff the calf is beyond the normal
    "spastic", "spasm_nm", "spasm_radps",  # reflex gain; a spasm's torque, and the stretch that sets one off
    "own", "own_rad",  # share of voluntary dorsiflexion
    "side", "inverts", "roll_k",  # +1 left, -1 right; inversion to dorsiflexion torque; stiffness about the roll axis
    "sole", "strap_radps", "strap_damp",  # stiffness of shoe and heel pad against the usual; the sensor on its strap
    "oblique", "twists_rad",  # see :func:`fes.simulation.forward.integration.sideways`
    "slip", "trip_ns",  # friction coefficient; drag impulse at which the foot is caught, N·s
)  # fmt: skip
# --- set anew at each event of the stride ---------------------------------------------------------------
_PLAN = (
    "due_s",  # the next planned instant
    "phase0", "phase_t", "phase_rate",  # place in the gait cycle
    "stand_x",  # where the ankle stands, belt frame
    "load_t", "load_s", "unload_t", "unload_s", "load_share",  # weight goes on, and off
    "land_rad",  # pitch at contact
    "rise_t", "rise_s", "rise_rad",  # the heel's rise to foot off
    "swing_t", "swing_s", "lift_m", "hike_m", "fall_m", "early_m", "reach_m", "circle_m", "swerve_rad", "turn_rad",
    "shift_m",
    "across_m", "yaw_rad",  # where the swing starts from
    "offset_t", "offset_s", "roll_goal", "hang_rad",  # inversion of a level foot; beyond it, of one that hangs
)  # fmt: skip
# --- what evolves ---------------------------------------------------------------------------------------
_STATE = (
    "x", "vx", "ax", "z", "vz", "az", "pitch", "vpitch", "apitch", "roll", "vroll", "aroll", "toe_bend",
    "y", "vy", "ay", "yaw", "vyaw", "ayaw", "twist", "vtwist", "atwist", "shank", "vshank", "ashank",
    "xp", "vxp", "axp", "zp", "vzp", "azp", "nominal", "vnominal", "bend",
    "heel_at", "ball_at", "toe_at", "heel_n", "ball_n", "toe_n", "drag_n",  # bristle anchors (NaN: off the ground)
    "hold", "flat_t", "own_act", "stretch1", "stretch2", "spasm", "spasm_most",
    "torque", "everting", "plantar",  # of the stimulated muscles: dorsiflexing, everting, plantarflexing
    "calf",  # all torque that plantarflexes: the calf's own, its reflex, the stimulated
    "pushed_j", "opposed_j", "co_nms",  # of this stride: push-off, what the stimulation took of it, co-contraction
    "drag_s", "drag_ns", "tripped", "toe_z", "heel_z",
)  # fmt: skip

LEG: Final = np.dtype(
    [("mode", np.int64), ("flat", np.int64)]
    + [(name, np.float64) for name in (*_BODY, *_PLAN, *_STATE)]
    + [(name, np.float64, (6,)) for name in ("offset_x", "offset_z", "offset_shank")]
    + [(name, np.float64, (SERIES,)) for name in ("thigh", "knee", "ankle")]
)
# a stimulated muscle: what it is, and what evolves. DORSIFLEXORS, EVERTORS and CALF are those of the affected leg.
MUSCLE: Final = np.dtype(
    [(name, np.float64) for name in (
        "threshold_uc", "saturation_uc", "torque_max", "tau_ca", "tau_up", "tau_down", "tau_fat", "tau_rec",
        "fit_floor", "gain",  # the last: of the activation, so that it is 1 at 40 Hz
        "released", "calcium", "recruited", "active", "fit", "torque",
    )]
)  # fmt: skip
DORSIFLEXORS: Final = 0
EVERTORS: Final = 1
CALF: Final = 2
BELT: Final = np.dtype([(name, np.float64) for name in ("x", "v", "a", "goal")] + [("pulse", np.int64)])

TRACE: Final = (
    "x_m", "y_m", "z_m", "pitch_rad", "roll_rad", "yaw_rad", "shank_rad", "toe_m", "heel_m", "activation", "torque_nm",
    "fitness", "load_n", "mode",
)  # fmt: skip


# Hertz's law of a sphere, N/m^1.5: half the weight presses a heel in by 8 mm; see docs/virtual_patient_figures.md.
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


@inlined
def damping(angle: float, knee: float, stiff: float, short: float, damp: float, inertia: float) -> float:
    """Of the ankle, N·m·s/rad: ``damp`` about the middle of its range, more towards the ends where tissue tightens.

    There viscosity grows with stiffness so that the damping ratio stays what it was (Weiss, Kearney & Hunter, *J
    Biomech* 19, 1986, and 21, 1988): the ends of the range are no springs that throw the foot back.
    """
    a, k = -math.degrees(angle + short), math.degrees(knee)
    slope = 0.0843 * math.exp(2.1016 - 0.0843 * a - 0.0176 * k) + 0.1949 * math.exp(-7.9763 + 0.1949 * a + 0.0008 * k)
    return max(damp, 2.0 * DAMPING_RATIO * math.sqrt(inertia * math.degrees(stiff * slope)))


HALF_CALCIUM = 0.55  # at which half of the saturated force is reached: a twitch is 0.1–0.2 of the force at 40 Hz
BETA = 0.6  # how far fatigue depends on frequency (Riener et al.)
FASTEST_RADPS = 15.0  # unloaded: 10 fibre lengths of 6 cm a second on a lever of 4 cm
HILL = 4.0  # 1 / (a / F0) of Hill's hyperbola
STRETCHED = 1.4


@inlined
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


@inlined
def force_at(dorsiflexing_radps: float) -> float:
    """Share of the isometric force while the ankle moves; dorsiflexing, the muscle shortens. Smooth at rest."""
    v = dorsiflexing_radps / FASTEST_RADPS
    if v >= 0.0:
        return max(1.0 - v, 0.0) / (1.0 + HILL * v)
    x = (1.0 + HILL) / (STRETCHED - 1.0) * v
    return 1.0 + (STRETCHED - 1.0) * x / (x - 1.0)


@inlined
def saturation(calcium: float) -> float:
    """Share of the greatest force at this much calcium, with a Hill coefficient of 2 (Bobet & Stein, 1998)."""
    return calcium * calcium / (calcium * calcium + HALF_CALCIUM * HALF_CALCIUM)


@inlined
def muscle(one: Record, angle: float, rate: float, dt: float) -> None:
    """One step of a stimulated muscle: calcium, activation, fitness and torque.

    ``angle``, ``rate`` of its joint (rad, rad/s), positive where it is short and shortens.
    """
    one.released -= one.released * dt / one.tau_ca
    one.calcium += (one.released - one.calcium) * dt / one.tau_ca
    drive = one.recruited * one.gain * saturation(one.calcium)
    tau = one.tau_up if drive > one.active else one.tau_down
    one.active += (drive - one.active) * dt / tau
    pace = 1.0 - BETA + BETA * (0.01 * one.calcium / one.tau_ca) ** 2
    tired = min(one.active * pace / (1.0 - BETA + BETA * 0.16), 1.0)  # 1 for all of it at 40 Hz
    one.fit += dt * ((one.fit_floor - one.fit) * tired / one.tau_fat + (1.0 - one.fit) * (1.0 - tired) / one.tau_rec)
    length = min(max(1.0 - 1.1 * (angle + 0.15), 0.4), 1.0)  # short, and weaker
    one.torque = one.torque_max * one.fit * one.active * length * force_at(rate)


@jit
def activation_at_40hz(tau_ca: float, tau_up: float, tau_down: float) -> float:
    """Mean activation, before its gain, in a fused contraction at 40 Hz; integrated with the step of the patient."""
    dt, every, steps = 0.0005, 50, 4000
    released, calcium, active, total = 0.0, 0.0, 0.0, 0.0
    for k in range(steps):
        if k % every == 0:
            released += 1.0
        released -= released * dt / tau_ca
        calcium += (released - calcium) * dt / tau_ca
        drive = saturation(calcium)
        active += (drive - active) * dt / (tau_up if drive > active else tau_down)
        if k >= steps - 10 * every:
            total += active
    return total / (10 * every)


TURN = 2.0 * math.pi
GRAVITY = 9.80665
BEND_RAD = math.radians(45.0)  # how far a shod forefoot bends at the toes' joints before it rolls over the toe's tip
HOLD_NM_PER_RAD = 320.0  # quasi-stiffness of the loaded ankle, about 5 N·m a degree
HOLD_NMS_PER_RAD = 6.0
LOWER_NM_PER_RAD, LOWER_NMS_PER_RAD = 120.0, 6.0  # of dorsiflexors that let the foot down
SPASM_RISES_S, SPASM_LASTS_S = 0.03, 0.25
RELEASED = 0.08  # share of its stiffness that the calf has left where the foot leaves the ground
FALL_MPS = 0.5  # how fast a foot goes on down that has not met the ground when it should
EARLY = 0.2  # share of the swing in which the toe leaves the ground: no dragging yet
LET_GO = 0.05  # share of the swing in which the toes cease to press


@jit
def fourier(series: Vec, phase: float) -> tuple[float, float, float]:
    """Value and first two derivatives by cycle of a Fourier series at ``phase`` (1 is one cycle)."""
    angle = TURN * phase
    c1, s1 = math.cos(angle), math.sin(angle)
    c, s = 1.0, 0.0
    value, slope, bend = series[0], 0.0, 0.0
    for k in range(1, HARMONICS + 1):
        c, s = c * c1 - s * s1, s * c1 + c * s1
        a, b = series[2 * k - 1], series[2 * k]
        w = TURN * k
        value += a * c + b * s
        slope += w * (b * c - a * s)
        bend -= w * w * (a * c + b * s)
    return value, slope, bend


@jit
def fade(c: Vec, start: float, span: float, t: float) -> tuple[float, float, float]:
    """Value, rate and acceleration of a polynomial ``c`` over ``u = (t - start)/span``; 0 from u = 1 on."""
    u = (t - start) / span
    if u >= 1.0:
        return 0.0, 0.0, 0.0
    value = c[0] + u * (c[1] + u * (c[2] + u * (c[3] + u * (c[4] + u * c[5]))))
    rate = c[1] + u * (2 * c[2] + u * (3 * c[3] + u * (4 * c[4] + u * 5 * c[5])))
    acc = 2 * c[2] + u * (6 * c[3] + u * (12 * c[4] + u * 20 * c[5]))
    return value, rate / span, acc / (span * span)


@jit
def smooth(u: float) -> tuple[float, float, float]:
    """The quintic step from 0 to 1 with its first two derivatives; flat outside."""
    if u <= 0.0:
        return 0.0, 0.0, 0.0
    if u >= 1.0:
        return 1.0, 0.0, 0.0
    v = u * (1.0 - u)
    return u * u * u * (10.0 + u * (6.0 * u - 15.0)), 30.0 * v * v, 60.0 * v * (1.0 - 2.0 * u)


@jit
def bump(u: float) -> tuple[float, float, float]:
    """``64 u³(1-u)³``, 1 in the middle, with its first two derivatives; 0 outside 0 … 1."""
    if u <= 0.0 or u >= 1.0:
        return 0.0, 0.0, 0.0
    v = u * (1.0 - u)
    return 64.0 * v * v * v, 192.0 * v * v * (1.0 - 2.0 * u), 384.0 * v * (1.0 - 5.0 * v)


@inlined
def lowering(u: float) -> tuple[float, float, float]:
    """``u⁵(1-u)``: up a little late in swing, then down with slope -1 at its end; with its first two derivatives."""
    if u <= 0.0 or u >= 1.0:
        return 0.0, 0.0, 0.0
    return u**5 * (1.0 - u), u**4 * (5.0 - 6.0 * u), u**3 * (20.0 - 30.0 * u)


@inlined
def early(u: float) -> tuple[float, float, float]:
    """``u³(1-u)⁵`` scaled to 1 at its peak, three eighths of the way, with its first two derivatives."""
    if u <= 0.0 or u >= 1.0:
        return 0.0, 0.0, 0.0
    v = 1.0 - u
    c = 198.8 * u * v * v * v
    return c * u * u * v * v, c * u * v * (3.0 - 8.0 * u), c * (6.0 - 42.0 * u + 56.0 * u * u)


@jit
def plan(leg: Record, belt: Record, t: float) -> None:
    """Where the leg wants the ankle and the shank at ``t`` s: path in the belt's frame, with two derivatives."""
    rate = leg.phase_rate
    phase = leg.phase0 + rate * (t - leg.phase_t)
    thigh, thigh1, thigh2 = fourier(leg.thigh, phase)
    knee, knee1, knee2 = fourier(leg.knee, phase)
    shank, shank1, shank2 = thigh - knee, thigh1 - knee1, thigh2 - knee2
    off, off1, off2 = fade(leg.offset_shank, leg.offset_t, leg.offset_s, t)
    leg.shank = shank + off
    leg.vshank = shank1 * rate + off1
    leg.ashank = shank2 * rate * rate + off2
    nominal, nominal1, _ = fourier(leg.ankle, phase)
    leg.nominal, leg.vnominal, leg.bend = nominal, nominal1 * rate, knee
    ox, ox1, ox2 = fade(leg.offset_x, leg.offset_t, leg.offset_s, t)
    oz, oz1, oz2 = fade(leg.offset_z, leg.offset_t, leg.offset_s, t)
    if leg.mode == SWING:
        st, ct, ss, cs = math.sin(thigh), math.cos(thigh), math.sin(shank), math.cos(shank)
        a, b = leg.thigh_m, leg.shank_m
        u = (t - leg.swing_t) / leg.swing_s
        reach, reach1, reach2 = smooth(u)
        hike, hike1, hike2 = bump(u)
        w = 1.0 / leg.swing_s
        late = max(t - leg.swing_t - leg.swing_s, 0.0)
        fall, fall1, fall2 = lowering(u)
        knee_up, knee_up1, knee_up2 = early(u)
        leg.xp = belt.x + a * st + b * ss + leg.reach_m * reach + ox
        leg.vxp = belt.v + (a * ct * thigh1 + b * cs * shank1) * rate + leg.reach_m * reach1 * w + ox1
        leg.axp = belt.a + leg.reach_m * reach2 * w * w + ox2 + rate * rate * (
            a * (ct * thigh2 - st * thigh1 * thigh1) + b * (cs * shank2 - ss * shank1 * shank1)
        )  # fmt: skip
        leg.zp = leg.lift_m - a * ct - b * cs + oz - FALL_MPS * late
        leg.zp += leg.hike_m * hike + leg.fall_m * fall + leg.early_m * knee_up
        leg.vzp = (a * st * thigh1 + b * ss * shank1) * rate + oz1 - (FALL_MPS if late > 0.0 else 0.0)
        leg.vzp += (leg.hike_m * hike1 + leg.fall_m * fall1 + leg.early_m * knee_up1) * w
        leg.azp = (leg.hike_m * hike2 + leg.fall_m * fall2 + leg.early_m * knee_up2) * w * w + oz2 + rate * rate * (
            a * (st * thigh2 + ct * thigh1 * thigh1) + b * (ss * shank2 + cs * shank1 * shank1)
        )  # fmt: skip
        return
    # on the ground the ankle stands, then turns about the ball, and the ball about the toe's tip
    psi, psi1, psi2 = heel_rise(leg, t)
    s, c = math.sin(psi), math.cos(psi)
    x1, z1 = leg.ball_x * s + leg.sole_m * c, leg.ball_x * c - leg.sole_m * s
    bent = math.tanh(psi / BEND_RAD)
    toes, slope = psi - BEND_RAD * bent, bent * bent
    toes1 = slope * psi1
    toes2 = slope * psi2 + 2.0 * bent * (1.0 - slope) / BEND_RAD * psi1 * psi1
    ts, tc = leg.toe_m * math.sin(toes), leg.toe_m * math.cos(toes)
    leg.xp = leg.stand_x + leg.ball_x * (1.0 - c) + leg.sole_m * s + leg.toe_m - tc + ox
    leg.vxp = x1 * psi1 + ts * toes1 + ox1
    leg.axp = x1 * psi2 + z1 * psi1 * psi1 + ts * toes2 + tc * toes1 * toes1 + ox2
    leg.zp = leg.ball_x * s + leg.sole_m * c + ts + oz
    leg.vzp = z1 * psi1 + tc * toes1 + oz1
    leg.azp = z1 * psi2 - x1 * psi1 * psi1 + tc * toes2 - ts * toes1 * toes1 + oz2


@jit
def heel_rise(leg: Record, t: float) -> tuple[float, float, float]:
    """The planned toe-down pitch in pre-swing: slow first, fastest as the foot leaves."""
    if leg.mode != PRE_SWING:
        return 0.0, 0.0, 0.0
    u, w = (t - leg.rise_t) / leg.rise_s, 1.0 / leg.rise_s
    a = leg.rise_rad
    return a * u * u * (1.3 - 0.3 * u), a * u * (2.6 - 0.9 * u) * w, a * (2.6 - 1.8 * u) * w * w


@inlined
def load(leg: Record, t: float) -> float:
    """Weight on this leg, N."""
    if leg.mode == SWING:
        return 0.0
    on, _, _ = smooth((t - leg.load_t) / leg.load_s)
    off, _, _ = smooth((t - leg.unload_t) / leg.unload_s)
    weight: float = leg.weight_n * (leg.load_share + (1.0 - leg.load_share) * on) * (1.0 - off)
    return weight


@inlined
def ankle_torque(leg: Record, t: float, weight: float, lever: float, dt: float) -> float:
    """All torques of tissue about the ankle, dorsiflexing positive, N·m."""
    angle, rate = leg.pitch - leg.shank, leg.vpitch - leg.vshank
    held = min(max(angle, -1.2), 0.8)
    out: float = passive(held, leg.bend, leg.stiff, leg.short_rad)
    out -= damping(held, leg.bend, leg.stiff, leg.short_rad, leg.damp, leg.inertia) * rate
    # the stretch reflex of the calf, some 40 ms late
    leg.stretch1 += (rate - leg.stretch1) * dt / 0.02
    leg.stretch2 += (leg.stretch1 - leg.stretch2) * dt / 0.02
    # and, stretched fast enough, a spasm that outlasts the stretch
    if leg.stretch2 > leg.spasm_radps:
        leg.spasm += (1.0 - leg.spasm) * dt / SPASM_RISES_S
    else:
        leg.spasm -= leg.spasm * dt / SPASM_LASTS_S
    if leg.mode == SWING:
        leg.spasm_most = max(leg.spasm_most, leg.spasm)
    reflex = leg.spastic * max(leg.stretch2 - 0.6, 0.0) + leg.spasm_nm * leg.spasm
    out -= reflex
    # voluntary dorsiflexors hold the normal angle, from just before foot off until the foot lies flat
    wanted = 1.0 if leg.mode == SWING or (leg.mode == STANCE and leg.flat == 0) else 0.0
    leg.own_act += (wanted - leg.own_act) * dt / 0.04
    needed = leg.foot_kg * GRAVITY * leg.com_x
    if leg.mode == STANCE and leg.flat == 0 and leg.land_rad > 0.0:
        # the heel rocker: stretched, they let the foot down until it lies flat as the leg takes the weight
        left = max(1.0 - (t - leg.load_t) / leg.load_s, 0.0)
        needed -= out + left * weight * (leg.heel_x + HEEL_M)
        needed += LOWER_NM_PER_RAD * (leg.land_rad * left * left - leg.pitch)
        needed -= LOWER_NMS_PER_RAD * (2.0 * leg.land_rad * left / leg.load_s + leg.vpitch)
    else:
        needed -= passive(leg.nominal, leg.bend, leg.stiff, leg.short_rad)
        needed += 30.0 * (leg.nominal - angle) + 0.9 * (leg.vnominal - rate)
    out += leg.own * leg.own_act * min(max(needed, 0.0), 28.0)
    out += leg.torque - leg.plantar
    # the calf of a standing leg: it carries the weight where the plan wants it, and lifts the heel
    push = 0.0
    if leg.mode == SWING:
        leg.hold -= leg.hold * dt / 0.015
    else:
        if leg.flat or leg.ball_n > 0.0:
            leg.hold += (1.0 - leg.hold) * dt / 0.03
        psi, psi1, _ = heel_rise(leg, t)
        # as the other leg takes the weight the calf lets go: late in push-off little is left to oppose it
        firm = 1.0
        if leg.mode == PRE_SWING:
            firm = RELEASED + (1.0 - RELEASED) * min(weight / leg.weight_n, 1.0)
        hold = firm * (HOLD_NM_PER_RAD * (-psi - leg.pitch) + HOLD_NMS_PER_RAD * (-psi1 - leg.vpitch))
        push = leg.hold * (hold - weight * lever)
        out += push
    leg.calf = max(-push, 0.0) + reflex + leg.plantar
    leg.co_nms += min(leg.torque, leg.calf) * dt
    if leg.mode == PRE_SWING:
        leg.pushed_j += max(leg.plantar - push, 0.0) * max(-rate, 0.0) * dt
        leg.opposed_j += leg.torque * max(-rate, 0.0) * dt
    return out


@inlined
def toes_press(leg: Record, t: float) -> float:
    """Share of their stiffness with which the toes press on the ground; without a jump at heel rise and foot off.

    The bending shoe presses them down in pre-swing. Unloaded at foot off, they press again when they meet the ground.
    """
    if leg.mode == PRE_SWING:
        psi, _, _ = heel_rise(leg, t)
        firm, _, _ = smooth(psi / BEND_RAD)
        return firm
    u = (t - leg.swing_t) / leg.swing_s
    if u < LET_GO:
        pressed, _, _ = smooth(leg.rise_rad / BEND_RAD)
        gone, _, _ = smooth(u / LET_GO)
        return pressed * (1.0 - gone)
    firm, _, _ = smooth((u - LET_GO) / EARLY)
    return firm


@inlined
def step(leg: Record, belt: Record, t: float, dt: float) -> None:
    """Advance one leg from ``t`` to ``t + dt``; ``plan`` for ``t`` and ``muscle`` come before it."""
    h, c, s = leg.sole_m, math.cos(leg.pitch), math.sin(leg.pitch)
    # the heel is round: the ground presses below its middle, the sole's flat part beginning there
    middle = leg.heel_x + HEEL_M
    hx, hz = middle * c + (h - HEEL_M) * s, middle * s - (h - HEEL_M) * c - HEEL_M
    bx, bz = leg.ball_x * c + h * s, leg.ball_x * s - h * c
    # the toes bend as the heel rises and straighten early in swing
    leg.toe_bend += ((0.0 if leg.mode == SWING else 1.0) - leg.toe_bend) * dt / 0.07
    toes = leg.pitch
    if toes < 0.0:
        toes -= leg.toe_bend * BEND_RAD * math.tanh(toes / BEND_RAD)
    tx, tz = bx + leg.toe_m * math.cos(toes), bz + leg.toe_m * math.sin(toes)
    w = leg.vpitch
    rolled = leg.x + hx + HEEL_M * leg.pitch
    fx, fz, leg.heel_at = touch(
        leg.heel_at, rolled, leg.z + hz, leg.vx - w * hz, leg.vz + w * hx, leg.sole * HEEL_N_PER_M15, leg.slip
    )
    gx, gz, leg.ball_at = touch(
        leg.ball_at, leg.x + bx, leg.z + bz, leg.vx - w * bz, leg.vz + w * bx, leg.sole * BALL_N_PER_M15, leg.slip
    )
    px, pz = 0.0, 0.0
    if leg.mode != STANCE:
        firm = toes_press(leg, t)
        px, pz, leg.toe_at = touch(
            leg.toe_at, leg.x + tx, leg.z + tz, leg.vx - w * tz, leg.vz + w * tx, TOE_N_PER_M15 * firm, leg.slip
        )
    else:
        leg.toe_at = math.nan
    leg.heel_n, leg.ball_n, leg.toe_n = fz, gz, pz
    leg.heel_z = leg.z + (hz if s > 0.0 else leg.heel_x * s - h * c)
    leg.toe_z = min(leg.z + tz, leg.z + bz)
    weight = load(leg, t)
    forward = (t - leg.flat_t) / max(leg.rise_t - leg.flat_t, 0.05) if leg.flat else 0.0
    share, _, _ = smooth(forward)
    lever = 0.02 + share * (0.98 * leg.ball_x - 0.02)
    if leg.mode == PRE_SWING:  # from the ball to the toe's tip as the shoe bends
        psi, _, _ = heel_rise(leg, t)
        lever = bx + (tx - bx) * math.tanh(psi / BEND_RAD) ** 2
    moved = leg.moved_kg
    leg.ax = leg.axp + (fx + gx + px - leg.leg_k * (leg.x - leg.xp) - leg.leg_d * (leg.vx - leg.vxp)) / moved
    leg.az = leg.azp + (fz + gz + pz - weight - leg.leg_k * (leg.z - leg.zp) - leg.leg_d * (leg.vz - leg.vzp)) / moved
    turn = ankle_torque(leg, t, weight, lever, dt)
    turn += hx * fz - hz * fx + bx * gz - bz * gx + tx * pz - tz * px
    com_x, com_z = leg.com_x * c + 0.5 * h * s, leg.com_x * s - 0.5 * h * c
    turn -= leg.foot_kg * (com_x * (leg.az + GRAVITY) - com_z * leg.ax)
    leg.apitch = turn / leg.inertia
    leg.vx += leg.ax * dt
    leg.vz += leg.az * dt
    leg.vpitch += leg.apitch * dt
    leg.x += leg.vx * dt
    leg.z += leg.vz * dt
    leg.pitch += leg.vpitch * dt
    if leg.mode == SWING and (gz > 0.0 or pz > 0.0) and t - leg.swing_t > EARLY * leg.swing_s:
        leg.drag_s += dt
        leg.drag_ns += abs(gx + px) * dt
