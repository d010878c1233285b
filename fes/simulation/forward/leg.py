"""One leg's plans: what its next stance, heel rise and swing shall be, written into its record at each event."""

import math
from dataclasses import dataclass

import numpy as np

from fes.estimation.numerics.records import Vec
from fes.signals import G_MPS2, FloatArray, Vector3
from fes.simulation.forward import gait_patterns as normative
from fes.simulation.forward.dynamics import HEEL_M, LEG, MUSCLE, PRE_SWING, STANCE, SWING, activation_at_40hz
from fes.simulation.forward.gait_patterns import Pattern
from fes.simulation.forward.integration import plan_at
from fes.simulation.forward.settings import MuscleSettings, PatientSettings


def quintic(at_start: list[float], span_s: float) -> list[float]:
    """Coefficients by ``u = t/span`` of the quintic with this value, rate and acceleration at 0 and none at 1."""
    a, b, c = at_start[0], at_start[1] * span_s, 0.5 * at_start[2] * span_s * span_s
    return [a, b, c, -10 * a - 6 * b - 3 * c, 15 * a + 8 * b + 3 * c, -6 * a - 3 * b - c]


def curve_at(series: FloatArray, phase: FloatArray) -> FloatArray:
    """A Fourier series (see :func:`fes.simulation.forward.gait_patterns.harmonics`) at (N,) phases of the cycle."""
    k = np.arange(1, (len(series) - 1) // 2 + 1)
    angle = 2.0 * math.pi * np.outer(phase, k)
    return np.asarray(series[0] + np.cos(angle) @ series[1::2] + np.sin(angle) @ series[2::2])


STANDING_RAD = math.radians(-3.0)  # the shank of a standing leg
STILL_S = 0.6  # from the last step's landing until the shank rests
_STANCES = np.linspace(0.02, 0.5, 481)  # phases at which a foot lies flat
STANDING_PHASE = 0.30  # of the cycle, whose joint angles a standing leg has
LOADING_S = 0.11
PRE_SWING_SHARE = 0.17  # of the cycle, from heel off to foot off
LANDING_MPS = -0.25  # the ankle's vertical speed at contact, at the least
CLEARANCE_M = 0.017  # mean least toe clearance of healthy walkers (Winter, *Phys Ther* 72, 1992: 1.3 cm)
HALF_WIDTH_M = 0.08
TO_PLAN = 0.55  # share of the swing until the foot is on its planned path, where it begins on it
NEAR_S = 0.4  # … the whole swing where it begins as far away from it as the belt goes in this time
_EARLY, _MIDDLE = np.linspace(0.24, 0.38, 8), np.linspace(0.44, 0.75, 16)
LOST_LIFT_M = 0.05  # by how much lower the foot would pass without any push-off: the knee swings by it
LOST_REACH_M = 0.15  # … and by how much shorter the step would be
TOE_OUT_RAD = math.radians(7.0)
ZERO: Vector3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Swing:
    """What one swing shall be, beyond the normal curves; times s, lengths m.

    ``habit`` is the share of the lift with which a hanging foot just clears that the person has made a habit.
    """

    begin_s: float
    end_s: float
    clearance_m: float
    extra_lift_m: float
    habit: float
    reach_m: float
    turn_rad: float
    swerve_rad: float
    circle_m: float
    shift_m: float
    lost: float = (
        0.0  # share of the push-off's work that stimulation has taken: the knee bends less, the step is shorter
    )


def calf_of(spasticity: float) -> dict[str, float]:
    """The fields of a leg's record that spasticity (0–1) sets: stiffer and shorter (Lorentzen et al., 2010)."""
    return {
        "short_rad": 0.12 * spasticity, "stiff": 1.0 + 0.9 * spasticity, "damp": 0.50 + 0.25 * spasticity,
        "spastic": 5.0 * spasticity, "spasm_nm": 12.0 * spasticity,
    }  # fmt: skip


def body_of(settings: PatientSettings, *, affected: bool) -> np.void:
    """A leg's record with its fixed part filled in, standing."""
    leg: np.void = np.zeros(1, LEG)[0]
    height, mass = settings.height_m, settings.mass_kg
    foot_kg = normative.FOOT_OF_MASS * mass + normative.SHOE_KG
    length = normative.FOOT_OF_HEIGHT * height
    sole = normative.ANKLE_OF_HEIGHT * height + normative.SOLE_M
    ball, heel = 0.48 * length, -0.24 * length
    com = 0.19 * length
    own = settings.voluntary_dorsiflexion if affected else 1.0
    fixed = {
        "thigh_m": normative.THIGH_OF_HEIGHT * height, "shank_m": normative.SHANK_OF_HEIGHT * height, "sole_m": sole,
        "heel_x": heel, "ball_x": ball, "toe_m": 0.24 * length, "foot_kg": foot_kg, "com_x": com,
        "inertia": foot_kg * (com**2 + (0.5 * sole) ** 2 + (0.25 * length) ** 2),
        "moved_kg": foot_kg + 0.5 * normative.SHANK_OF_MASS * mass,
        "weight_n": 0.97 * mass * G_MPS2, "leg_k": 3000.0, "leg_d": 150.0,
        **calf_of(settings.spasticity if affected else 0.0), "spasm_radps": settings.spasm_radps, "own": own,
        "inverts": settings.inversion_share, "roll_k": settings.roll_stiffness_nm_per_rad,
        "sole": settings.shoe_stiffness, "strap_radps": 2.0 * math.pi * settings.strap_hz,
        "strap_damp": settings.strap_damping, "oblique": math.sin(math.radians(settings.toe_break_deg)),
        "twists_rad": math.radians(settings.leg_twist_deg),
        "slip": 0.8, "trip_ns": 1.1,
        "mode": STANCE, "flat": 1, "due_s": math.inf, "phase0": STANDING_PHASE, "load_share": 0.5, "load_t": math.inf,
        "load_s": 1.0, "unload_t": math.inf, "unload_s": 1.0, "rise_t": math.inf, "rise_s": 1.0, "swing_t": -10.0,
        "swing_s": 1.0, "offset_s": 1.0, "offset_t": -10.0, "flat_t": -10.0, "hold": 1.0, "toe_bend": 1.0,
        "x": 0.0, "z": sole, "heel_at": math.nan, "ball_at": math.nan, "toe_at": math.nan,
    }  # fmt: skip
    for name, value in fixed.items():
        leg[name] = value
    return leg


def muscle_of(settings: MuscleSettings) -> np.void:
    """A stimulated muscle's record, fresh and at rest."""
    one: np.void = np.zeros(1, MUSCLE)[0]
    fixed = {
        "threshold_uc": settings.threshold_uc, "saturation_uc": settings.saturation_uc,
        "torque_max": settings.max_torque_nm, "tau_ca": settings.tau_calcium_s, "tau_up": settings.tau_rise_s,
        "tau_down": settings.tau_fall_s, "tau_fat": settings.fatigue_s, "tau_rec": settings.recovery_s,
        "fit_floor": settings.fatigue_floor, "fit": 1.0,
        "gain": 1.0 / activation_at_40hz(settings.tau_calcium_s, settings.tau_rise_s, settings.tau_fall_s),
    }  # fmt: skip
    for name, value in fixed.items():
        one[name] = value
    return one


class Planner:
    """Writes plans into ``legs[side]``; knows the curves of the present speed and nothing of the random numbers."""

    def __init__(self, settings: PatientSettings, pattern: Pattern, legs: Vec, belt: Vec, side: int) -> None:
        self.settings = settings
        self.affected = (side == 0) == (settings.side == "left")
        self.pattern = pattern if self.affected else Pattern()
        self.legs, self.belt, self.side = legs, belt, side
        self.sign = 1.0 if side == 0 else -1.0
        self.leg = legs[side]
        self.need_m = 0.0  # lift with which a hanging foot just clears, beyond the normal one
        self.set_speed(settings.speed_mps)
        self.leg["side"] = self.sign
        self.leg["across_m"], self.leg["yaw_rad"] = self.sign * HALF_WIDTH_M, self.sign * TOE_OUT_RAD
        # stand with the shank at this tilt, for good
        self.leg["thigh"], self.leg["knee"], self.leg["ankle"] = self._curves
        plan_at(legs, belt, side, -10.0)
        self.leg["offset_shank"] = [STANDING_RAD - self.leg["shank"], 0, 0, 0, 0, 0]
        self.leg["offset_t"], self.leg["offset_s"] = -10.0, 1e12

    def set_speed(self, speed_mps: float) -> None:
        """Take the joint curves of this speed, from the next event on."""
        self.speed_mps = speed_mps
        knee = self.pattern.knee * self.settings.knee_flexion
        self._curves = normative.joint_curves(speed_mps, self.settings.height_m, knee)

    def stance(self, t_s: float, next_rise_s: float, next_off_s: float, support_s: float) -> None:
        """The foot has met the ground at ``t_s``: load it, let it lie, and know when its heel shall rise."""
        leg = self.leg
        before = self._now(t_s)
        heel = float(leg["heel_n"]) > 0.0
        c, s, h = math.cos(leg["pitch"]), math.sin(leg["pitch"]), float(leg["sole_m"])
        if heel:  # it rolls over the round heel until it lies flat
            middle = float(leg["heel_x"]) + HEEL_M
            stand_x = float(leg["x"]) + middle * c + (h - HEEL_M) * s + HEEL_M * float(leg["pitch"]) - middle
        else:
            stand_x = float(leg["x"]) + float(leg["ball_x"]) * (c - 1.0) + h * s
        leg["mode"], leg["flat"], leg["stand_x"] = STANCE, 0, stand_x
        leg["due_s"], leg["rise_t"] = next_rise_s, next_rise_s
        leg["load_t"], leg["load_s"], leg["load_share"] = t_s, max(0.9 * support_s, 0.08), 0.0
        leg["land_rad"] = leg["pitch"]
        leg["unload_s"] = support_s
        leg["unload_t"] = next_off_s - support_s
        leg["hold"] = 0.0
        # the ground, not the plan, stops the landing foot: the plan stands still from now on
        self._phase(t_s, 0.0, normative.TOE_OFF_SHARE / max(next_off_s - t_s, 0.1))
        still = (float(leg["x"]) - stand_x, 0.0, 0.0), (float(leg["z"]) - h, 0.0, 0.0)
        self._fade(t_s, LOADING_S, still, before[2])

    def stand(self, t_s: float) -> None:
        """No further step: the shank comes to rest as it was before the walk, and the weight stays."""
        leg = self.leg
        before = self._now(t_s)
        leg["due_s"] = leg["rise_t"] = leg["unload_t"] = math.inf
        thigh, knee, _ = (curve_at(series, _STANCES) for series in self._curves)
        self._phase(t_s, float(_STANCES[np.abs(thigh - knee - STANDING_RAD).argmin()]), 0.0)
        self._fade(t_s, STILL_S, (ZERO, ZERO), before[2])

    def rise(self, t_s: float, off_s: float, stride_share: float, support_s: float) -> None:
        """The heel begins to rise; the foot shall leave at ``off_s``."""
        leg = self.leg
        before = self._now(t_s)
        leg["mode"], leg["flat"] = PRE_SWING, 1
        leg["rise_t"], leg["rise_s"], leg["due_s"] = t_s, off_s - t_s, off_s
        leg["rise_rad"] = math.radians(self.pattern.toe_off_deg) * (0.45 + 0.55 * stride_share)
        leg["unload_t"], leg["unload_s"] = off_s - support_s, support_s
        leg["stand_x"] += float(leg["x"]) - before[0][0]  # from where it really is
        share = normative.TOE_OFF_SHARE
        phase = float(leg["phase0"]) + float(leg["phase_rate"]) * (t_s - float(leg["phase_t"]))
        phase = min(phase, share - 0.12) if phase < share else share - 0.12
        self._phase(t_s, phase, (share - phase) / (off_s - t_s))
        self._fade(t_s, off_s - t_s, (ZERO, ZERO), before[2])

    def swing(self, swing: Swing) -> None:
        """The foot leaves the ground and shall land as ``swing`` says."""
        leg, t_s = self.leg, swing.begin_s
        before = self._now(t_s)
        span = swing.end_s - t_s
        leg["mode"], leg["flat"], leg["due_s"] = SWING, 0, math.inf
        leg["swing_t"], leg["swing_s"] = t_s, span
        leg["across_m"], leg["yaw_rad"] = leg["y"], leg["yaw"] - leg["twist"]
        leg["reach_m"], leg["circle_m"], leg["shift_m"] = swing.reach_m, self.sign * swing.circle_m, swing.shift_m
        leg["swerve_rad"], leg["turn_rad"] = self.sign * swing.swerve_rad, swing.turn_rad
        leg["drag_s"] = leg["drag_ns"] = leg["tripped"] = 0.0
        share = normative.TOE_OFF_SHARE
        self._phase(t_s, share, (1.0 - share) / span)
        leg["lift_m"], leg["hike_m"] = self.hip_m(), 0.0
        e = 1e-4  # the ankle's upward speed as the swing ends, by the joint curves alone
        thigh, knee, _ = (curve_at(series, np.array([1.0 - e, 1.0])) for series in self._curves)
        high = -leg["thigh_m"] * np.cos(thigh) - leg["shank_m"] * np.cos(thigh - knee)
        landing_mps = float(high[1] - high[0]) / e * float(leg["phase_rate"])
        leg["fall_m"] = max(landing_mps - LANDING_MPS, 0.0) * span
        here = (float(leg["x"]), float(leg["vx"]), before[0][2]), (float(leg["z"]), float(leg["vz"]), before[1][2])
        # the farther it begins from its planned path, the later it is there: ahead, as from standing, or behind, as
        # after a stumble that cut the last step short
        leg["offset_x"] = 0.0
        away_m = abs(float(leg["x"]) - self._now(t_s)[0][0])
        to_plan = TO_PLAN + (1.0 - TO_PLAN) * min(away_m / (NEAR_S * self.speed_mps), 1.0)
        self._fade(t_s, to_plan * span, here, before[2])
        leg["early_m"] = 0.0
        first_m = swing.clearance_m + self.settings.early_lift_m
        for _ in range(3):  # each depends a little on the other
            leg["hike_m"] = 0.0
            leg["hike_m"] = self._needed(swing.clearance_m, _MIDDLE)
            leg["early_m"] += max(self._needed(first_m, _EARLY), -float(leg["early_m"]))
        leg["hike_m"] = 0.0
        normal, hanging = self._needed(swing.clearance_m, _MIDDLE), self._needed(0.0, _MIDDLE, hanging=True)
        self.need_m = max(hanging - normal, 0.0) * (1.0 - float(leg["own"]))
        leg["hike_m"] = normal + swing.habit * self.need_m + swing.extra_lift_m - LOST_LIFT_M * swing.lost

    def trip(self, t_s: float, short_m: float) -> None:
        """The toe is caught: the swing goes on from where it is, and lands short by ``short_m``."""
        leg = self.leg
        before = self._now(t_s)
        leg["tripped"] = 1.0
        leg["reach_m"] -= short_m
        left = max(float(leg["swing_t"] + leg["swing_s"]) - t_s, 0.08)
        here = (float(leg["x"]), float(leg["vx"]), 0.0), (float(leg["z"]), float(leg["vz"]), before[1][2])
        self._fade(t_s, left, here, before[2])

    def reach(self, end_s: float, belt_m: float, target_m: float) -> float:
        """How far beyond the normal landing place (m) lies ``target_m``, when the belt will have gone ``belt_m``."""
        thigh, knee, _ = (float(curve_at(series, np.ones(1))[0]) for series in self._curves)
        ahead = float(self.leg["thigh_m"]) * math.sin(thigh) + float(self.leg["shank_m"]) * math.sin(thigh - knee)
        return target_m - belt_m - ahead

    def hip_m(self) -> float:
        """Height of the hip over the ground (m) at which the heel just touches as the swing ends, the ankle normal."""
        leg, one = self.leg, np.ones(1)
        thigh, knee, ankle = (float(curve_at(series, one)[0]) for series in self._curves)
        shank = thigh - knee
        pitch = shank + ankle
        above = float(leg["thigh_m"]) * math.cos(thigh) + float(leg["shank_m"]) * math.cos(shank)
        middle, high = float(leg["heel_x"]) + HEEL_M, float(leg["sole_m"]) - HEEL_M
        return above + high * math.cos(pitch) + HEEL_M - middle * math.sin(max(pitch, 0.0))

    def _needed(self, clearance_m: float, u: FloatArray, *, hanging: bool = False) -> float:
        """How much of the early or the middle lift (m) gives this toe clearance over the part ``u`` of the swing.

        From the path planned so far, the ankle at its normal angle or ``hanging``.
        """
        leg = self.leg
        share = normative.TOE_OFF_SHARE
        thigh, knee, ankle = (curve_at(series, share + (1.0 - share) * u) for series in self._curves)
        shank = thigh - knee
        v = np.minimum(u * leg["swing_s"] / leg["offset_s"], 1.0)
        off = np.where(v < 1.0, np.polynomial.polynomial.polyval(v, leg["offset_z"]), 0.0)
        high = leg["lift_m"] - leg["thigh_m"] * np.cos(thigh) - leg["shank_m"] * np.cos(shank) + off
        pitch = shank + (self.hanging_rad(knee) if hanging else ankle)
        toe = high + (leg["ball_x"] + leg["toe_m"]) * np.sin(pitch) - leg["sole_m"] * np.cos(pitch)
        middle, first = 64.0 * (u * (1.0 - u)) ** 3, 198.8 * u**3 * (1.0 - u) ** 5
        toe += leg["fall_m"] * u**5 * (1.0 - u) + leg["hike_m"] * middle + leg["early_m"] * first
        return max(float(((clearance_m - toe) / (first if u is _EARLY else middle)).max()), -0.08)

    def hanging_rad(self, knee_rad: FloatArray) -> FloatArray:
        """The ankle's angles where a foot without muscles hangs, at these angles of the knee; see :func:`passive`."""
        leg = self.leg
        left = 1.792 - float(leg["foot_kg"] * G_MPS2 * leg["com_x"] / leg["stiff"])
        a_deg = (2.1016 - 0.0176 * np.degrees(knee_rad) - math.log(max(left, 0.1))) / 0.0843
        return np.asarray(-np.radians(a_deg) - float(leg["short_rad"]))

    def _phase(self, t_s: float, phase: float, rate: float) -> None:
        leg = self.leg
        leg["thigh"], leg["knee"], leg["ankle"] = self._curves
        leg["phase0"], leg["phase_t"], leg["phase_rate"] = phase, t_s, rate

    def _now(self, t_s: float) -> tuple[Vector3, ...]:
        """The plan as it is: ankle x, z and shank, each with two derivatives."""
        plan_at(self.legs, self.belt, self.side, t_s)
        leg = self.leg
        names = (("xp", "vxp", "axp"), ("zp", "vzp", "azp"), ("shank", "vshank", "ashank"))
        return tuple((float(leg[a]), float(leg[b]), float(leg[c])) for a, b, c in names)

    def _fade(self, t_s: float, span_s: float, path: tuple[Vector3, Vector3], shank: Vector3) -> None:
        """Go on from ``path`` and ``shank`` and be on the new plan after ``span_s``, without a jump.

        ``path`` on the ground is against the new plan, in swing absolute, as ``shank`` always is.
        """
        leg = self.leg
        names = ("offset_x", "offset_z", "offset_shank")
        for name in names:
            leg[name] = 0.0
        leg["offset_t"], leg["offset_s"] = t_s, span_s
        new = self._now(t_s)
        base = (new[0], new[1]) if leg["mode"] == SWING else (ZERO, ZERO)
        for name, was, now in zip(names, (*path, shank), (*base, new[2]), strict=True):
            leg[name] = quintic([a - b for a, b in zip(was, now, strict=True)], span_s)
