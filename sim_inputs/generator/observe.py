"""Measure the truth on a finished session: strides, phases and poses at 100 Hz, and the lab's reference marker."""

from __future__ import annotations

import math

import numpy as np

from fes.signals import NS_PER_S, FloatArray, IntArray
from fes.simulation.sensor import mounting, quaternions
from fes.simulation.truth import HEEL_UP_M, TILT_RAD, FootTruth, Truth, TruthStride
from sim_inputs.generator.foot import FootPath, stack
from sim_inputs.generator.gait import StridePlan
from sim_inputs.generator.session import Session
from statemachine.phases import Phase

FINE_HZ = 1000.0
TRUTH_HZ = 100.0
REFERENCE_HZ = 25.0
REFERENCE_NOISE_M = 0.0015


def observe(session: Session, *, reference: str = "") -> Truth:
    """The truth of a finished session; ``reference`` names the foot that carries the lab's marker, "" for none."""
    feet, strides = {}, []
    for name in session.feet:
        observed = _ObservedFoot(session, name)
        mine = observed.strides()
        strides += mine
        feet[name] = observed.foot_truth(mine)
    strides.sort(key=lambda stride: (stride.t_pre_swing_s, stride.foot))
    marker = lab_reference(session, reference) if reference else np.zeros((0, 4))
    return Truth(session.name, feet, strides, session.activities, marker)


def lab_reference(session: Session, foot: str) -> FloatArray:
    """(N, 4): t and x, y, z of the sensor in the lab at 25 Hz, with the noise of an ultrasonic system.

    Negård et al. (2005) had such a system and moved it into the belt's frame by ``p + v t`` (Eq. 21).
    """
    t_s = np.arange(int(session.now_s * REFERENCE_HZ) + 1) / REFERENCE_HZ
    position, _, _ = stack(session.path(foot, t_s).sensor(session.rocker, session.placements[foot].body_m))
    position[:, 0] -= session.belt_travel(t_s).value
    return np.column_stack([t_s, position + session.rng.normal(0.0, REFERENCE_NOISE_M, position.shape)])


class _ObservedFoot:
    """One foot's path on a 1 kHz grid, with what the criteria need."""

    def __init__(self, session: Session, name: str) -> None:
        self.session, self.name = session, name
        self.t_s = np.arange(int(session.now_s * FINE_HZ) + 1) / FINE_HZ
        path = session.path(name, self.t_s)
        self.path: FootPath = path
        self.sensor, velocity, _ = stack(path.sensor(session.rocker, session.placements[name].body_m))
        self.toe = stack(path.point(session.rocker, session.toe_m))[0]
        self.heel = stack(path.point(session.rocker, session.heel_m))[0]
        speed = np.linalg.norm(velocity, axis=1)
        self.speed = np.convolve(speed, np.full(51, 1 / 51), mode="same")
        self.tilt = np.hypot(path.channels["pitch"].value, path.channels["roll"].value)
        self.heel_up = self.heel[:, 2] - session.heel_m[2]
        self.off_flat = (self.tilt > TILT_RAD) | (self.heel_up > HEEL_UP_M)

    def index(self, t_s: float) -> int:
        return min(max(round(t_s * FINE_HZ), 0), len(self.t_s) - 1)

    def strides(self) -> list[TruthStride]:
        plans = self.session.feet[self.name].plans
        strides = []
        flat = self.index(max(0.05, plans[0].heel_off_s - 0.45)) if plans else 0
        for number, plan in enumerate(plans):
            following = plans[number + 1].toe_off_s if number + 1 < len(plans) else plan.flat_s + 0.35
            heel_off = self.last(self.heel_up > HEEL_UP_M, False, flat, self.index(plan.toe_off_s))
            now_flat = self.last(self.off_flat, True, self.index(plan.contact_s), self.index(plan.flat_s + 0.15))
            if number + 1 < len(plans):
                next_off = self.last(self.heel_up > HEEL_UP_M, False, now_flat, self.index(following))
            else:
                next_off = self.index(following)
            strides.append(self.stride(number + 1, plan, (flat, heel_off, now_flat, next_off)))
            flat = now_flat
        return strides

    def last(self, condition: np.ndarray[tuple[int], np.dtype[np.bool_]], value: bool, start: int, end: int) -> int:
        """One past the last index in start … end where ``condition`` is ``value``; ``start`` if nowhere."""
        where = np.flatnonzero(condition[start:end] == value)
        return start + int(where[-1]) + 1 if len(where) else start

    def quietest(self, start: int, end: int) -> int:
        margin = min(30, max(0, (end - start) // 4))
        window = self.speed[start + margin : max(end - margin, start + margin + 1)]
        return start + margin + int(np.argmin(window))

    def stride(self, number: int, plan: StridePlan, marks: tuple[int, int, int, int]) -> TruthStride:
        flat, heel_off, now_flat, next_off = marks
        start, end = self.quietest(flat, heel_off), self.quietest(now_flat, next_off)
        swing = plan.contact_s - plan.toe_off_s
        middle = slice(self.index(plan.toe_off_s + 0.3 * swing), self.index(plan.toe_off_s + 0.8 * swing))
        contact = self.index(plan.contact_s)
        yaw = self.path.channels["yaw"].value
        t_start, t_end = float(self.t_s[start]), float(self.t_s[end])
        belt = self.session.belt
        walking = any(a.walking and a.start_s - 0.1 <= plan.toe_off_s <= a.end_s for a in self.session.activities)
        return TruthStride(
            foot=self.name,
            number=number,
            t_start_s=t_start,
            t_end_s=t_end,
            t_pre_swing_s=float(self.t_s[heel_off]),
            t_swing_s=plan.toe_off_s,
            t_loading_response_s=plan.contact_s,
            t_stance_s=max(plan.contact_s, float(self.t_s[now_flat])),
            stride_length_m=float(np.hypot(*(self.sensor[end] - self.sensor[start])[:2])),
            clearance_m=float(self.sensor[start:end, 2].max() - self.sensor[start, 2]),
            toe_clearance_m=float(self.toe[middle, 2].min() - self.session.toe_m[2]),
            heel_clearance_m=float(self.heel_up[start:end].max()),
            foot_strike_deg=-math.degrees(float(self.path.channels["pitch"].value[contact])),
            turn_deg=math.degrees(float(yaw[end] - yaw[start])),
            contact=plan.contact,
            steady=belt.steady(t_start, t_end) if belt else False,
            walking=walking,
        )

    def phases(self, strides: list[TruthStride]) -> IntArray:
        """(N,) on the fine grid; a heel in the air outside a swing is pre-swing, whether or not a swing follows."""
        phase = np.where(self.heel_up > HEEL_UP_M, int(Phase.PRE_SWING), int(Phase.STANCE))
        for stride in strides:
            off, contact, flat = (
                self.index(t) for t in (stride.t_swing_s, stride.t_loading_response_s, stride.t_stance_s)
            )
            phase[off:contact] = int(Phase.SWING)
            phase[contact:flat] = int(Phase.LOADING_RESPONSE)
        return phase

    def foot_truth(self, strides: list[TruthStride]) -> FootTruth:
        pick = slice(None, None, round(FINE_HZ / TRUTH_HZ))
        mount = mounting(*self.session.placements[self.name].angles_deg)
        rotations = self.path.sensor_rotation()[pick] @ mount
        return FootTruth(
            np.round(self.t_s[pick] * NS_PER_S).astype(np.int64),
            self.sensor[pick],
            self.toe[pick],
            self.heel[pick],
            quaternions(rotations),
            self.phases(strides)[pick],
        )
