"""The stimulated calf: more push-off from pulses at heel rise, and a toe that is pulled down by pulses in swing."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import median

import pytest
from virtual_walks import STEP_NS, affected

from fes.signals import NS_PER_S
from fes.simulation.forward import (
    DeliveredPulse,
    MuscleSettings,
    PatientSettings,
    VirtualPatient,
    VirtualStride,
    harm_of,
    settings_for,
)

CALF = 1
PATIENT = settings_for("moderate", seed=5, calf_channel=CALF)  # does not drag by itself


def strides(settings: PatientSettings, begin: str, burst_s: float, current_ma: float = 35.0) -> list[VirtualStride]:
    """A walk of 25 s with 40 Hz on the calf for ``burst_s`` from each event ``begin`` of the affected foot on."""
    patient = VirtualPatient(settings)
    seen = 0
    for t_ns in range(STEP_NS, 25 * NS_PER_S + 1, STEP_NS):
        begun = [e.t_ns for e in patient.events[seen:] if e.foot == settings.affected_foot and e.kind == begin]
        seen = len(patient.events)
        pulses = [
            DeliveredPulse(begin_ns + k * 25_000_000, CALF, current_ma, 300.0)
            for begin_ns in begun
            for k in range(round(burst_s / 0.025))
        ]
        patient.advance(t_ns, pulses)
    return affected(patient)


def test_no_electrode_on_the_calf_means_that_its_pulses_do_nothing() -> None:
    bare = replace(PATIENT, calf_channel=None)
    assert strides(bare, "heel_off", 0.1) == strides(PATIENT, "heel_off", 0.0)


def test_pulses_at_heel_rise_raise_the_push_off_with_their_strength() -> None:
    walks = [strides(PATIENT, "heel_off", 0.1, current_ma) for current_ma in (0.0, 20.0, 35.0)]
    pushed_j = [median(one.push_off_j for one in walk) for walk in walks]
    assert pushed_j == sorted(pushed_j)
    assert pushed_j[2] > pushed_j[0] + 0.3
    off_rad = [median(one.pitch_at_foot_off_rad for one in walk) for walk in walks]
    assert off_rad[2] < off_rad[0] - math.radians(1.0)
    assert harm_of(walks[2]).drags == 0


def test_a_burst_through_swing_pulls_the_toe_down() -> None:
    without, through = (strides(PATIENT, "foot_off", burst_s) for burst_s in (0.0, 0.3))
    assert median(one.toe_clearance_m for one in through) < median(one.toe_clearance_m for one in without) - 0.01
    assert harm_of(without).drags == 0
    assert harm_of(through).drags > len(through) / 2


def test_both_muscles_at_once_are_counted_as_co_contraction() -> None:
    def impulse_nms(*channels: int) -> float:
        patient = VirtualPatient(replace(PATIENT, spasticity=0.0))
        patient.advance(7 * NS_PER_S)
        while (patient.events[-1].foot, patient.events[-1].kind) != ("right_foot", "foot_off"):
            patient.advance(patient.now_ns + STEP_NS)
        begin_ns = patient.now_ns
        patient.advance(
            begin_ns + 2 * NS_PER_S,
            [DeliveredPulse(begin_ns + k * 25_000_000, c, 30.0, 300.0) for k in range(10) for c in channels],
        )
        return max(one.co_contraction_nms for one in patient.strides if one.t_contact_ns > begin_ns)

    assert impulse_nms(0, CALF) > impulse_nms(0) + 0.3


def test_the_calf_tires_and_recovers() -> None:
    tired = replace(PATIENT, calf=MuscleSettings(max_torque_nm=25.0, fatigue_s=5.0))
    fresh_j, tired_j = (
        median(one.push_off_j for one in strides(settings, "heel_off", 0.1)[-5:]) for settings in (PATIENT, tired)
    )
    assert tired_j < fresh_j - 0.05


def test_two_muscles_cannot_share_a_channel() -> None:
    with pytest.raises(ValueError, match=r"calf_channel = 0 is the dorsiflexors' channel already"):
        PatientSettings(calf_channel=0)
    with pytest.raises(ValueError, match=r"calf_channel = 1 is the evertors' channel already"):
        PatientSettings(evertor_channel=1, calf_channel=1)
    with pytest.raises(ValueError, match="calf_channel = 8: must be a whole number from 0 to 7"):
        PatientSettings(calf_channel=8)
    with pytest.raises(ValueError, match=r"calf\.saturation_uc"):
        PatientSettings(calf=MuscleSettings(threshold_uc=12.0))
