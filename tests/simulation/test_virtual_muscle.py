"""The stimulated muscle against its own published time constants, and the passive ankle at rest."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fes.estimation.numerics.jit import jit
from fes.estimation.numerics.records import Record
from fes.signals import NS_PER_S
from fes.simulation.forward import DeliveredPulse, MuscleSettings, PatientSettings, VirtualPatient
from fes.simulation.forward.dynamics import (
    DAMPING_RATIO,
    LEG,
    MUSCLE,
    activation_at_40hz,
    damping,
    muscle,
    passive,
    recruitment,
)
from fes.simulation.forward.leg import body_of, muscle_of

DT = 0.0005


MUSCLES = [  # the ends of the ranges that patients are drawn from, and the usual one
    MuscleSettings(fatigue_s=math.inf),
    MuscleSettings(fatigue_s=math.inf, tau_calcium_s=0.022, tau_rise_s=0.055, tau_fall_s=0.05),
    MuscleSettings(fatigue_s=math.inf, tau_calcium_s=0.030, tau_rise_s=0.070, tau_fall_s=0.07),
]


def run(
    own: MuscleSettings, seconds: float, frequency_hz: float, share: float = 1.0, until_s: float = 1e9
) -> np.ndarray:
    """Activation, fitness and torque (N, 3) of a muscle pulled by a regular train, on the 0.5 ms grid."""
    one = np.zeros(1, MUSCLE)
    one[0] = muscle_of(own)
    one["recruited"] = share
    every = round(1.0 / frequency_hz / DT)
    out = np.empty((round(seconds / DT), 3))
    for k in range(len(out)):
        if k % every == 0 and k * DT < until_s:
            one["released"] += 1.0
        muscle(one[0], -0.3, 0.0, DT)
        out[k] = one["active"][0], one["fit"][0], one["torque"][0]
    return out


@settings(deadline=None)  # the first call compiles
@given(st.floats(0.0, 60.0), st.floats(0.0, 60.0))
def test_recruitment_never_falls_with_charge(a: float, b: float) -> None:
    low, high = sorted((a, b))
    assert 0.0 <= recruitment(low, 3.5, 11.0) <= recruitment(high, 3.5, 11.0) <= 1.0


def test_recruitment_has_a_threshold_and_saturates() -> None:
    assert recruitment(1.0, 3.5, 11.0) == 0.0
    assert recruitment(3.5, 3.5, 11.0) < 0.06
    assert recruitment(7.25, 3.5, 11.0) == pytest.approx(0.5, abs=0.03)
    assert recruitment(11.0, 3.5, 11.0) > 0.94
    assert recruitment(16.0, 3.5, 11.0) > 0.99


def test_a_short_pulse_needs_less_charge_and_more_current() -> None:
    own = MuscleSettings(chronaxie_us=300.0)
    assert own.equivalent_uc(6.0, 300.0) == pytest.approx(6.0)
    currents = [1e3 / own.equivalent_uc(1e-3 * width_us, width_us) for width_us in (75.0, 150.0, 300.0, 1e6)]
    rheobase = currents[-1]
    assert [one / rheobase for one in currents[:3]] == pytest.approx([5.0, 3.0, 2.0], rel=1e-3)  # chronaxie: twice
    charges = [current * width for current, width in zip(currents, (75.0, 150.0, 300.0, 1e6), strict=True)]
    assert charges == sorted(charges)


@pytest.mark.parametrize("own", MUSCLES)
def test_a_twitch_is_a_sixth_of_the_force_at_40_hz_and_grows_by_summation(own: MuscleSettings) -> None:
    fused = run(own, 1.0, 40.0)[round(0.8 / DT) :, 0].mean()
    twitch = run(own, 1.0, 1.0)[:, 0]
    assert 0.10 <= twitch.max() / fused <= 0.20
    assert 0.045 <= twitch.argmax() * DT <= 0.085  # contraction time
    two = run(own, 1.0, 40.0, until_s=0.03)[:, 0]
    assert two.max() > 2.0 * twitch.max()  # of two pulses 25 ms apart


@pytest.mark.parametrize("own", MUSCLES)
def test_half_the_frequency_gives_somewhat_more_than_half_the_force(own: MuscleSettings) -> None:
    force = {hz: run(own, 1.5, hz)[round(1.0 / DT) :, 0].mean() for hz in (10.0, 20.0, 40.0)}
    assert force[40.0] == pytest.approx(1.0, abs=0.01)
    assert 0.5 < force[20.0] < 0.75
    assert 0.15 < force[10.0] < 0.35


@jit
def walked(one: Record, seconds: float) -> None:
    """Bursts of 0.55 s at 40 Hz, one every 1.25 s."""
    for k in range(round(seconds / DT)):
        if k % 2500 < 1100 and k % 2500 % 50 == 0:
            one.released += 1.0
        muscle(one, -0.3, 0.0, DT)


def test_twenty_minutes_of_walking_tire_the_muscle() -> None:
    one = np.zeros(1, MUSCLE)
    one[0] = muscle_of(MuscleSettings())
    one["recruited"] = 0.8
    fit = []
    for _ in range(20):
        walked(one[0], 60.0)
        fit.append(float(one["fit"][0]))
    assert fit == sorted(fit, reverse=True)
    assert fit[1] > 0.85
    assert 0.5 < fit[-1] < 0.8


def test_the_step_response_has_the_time_constants_asked_for() -> None:
    own = MuscleSettings(tau_calcium_s=0.005, tau_rise_s=0.08, tau_fall_s=0.12, fatigue_s=math.inf)
    track = run(own, 1.6, 100.0, until_s=0.8)[:, 0]
    top = track[round(0.75 / DT)]
    assert np.argmax(track > 0.632 * top) * DT == pytest.approx(0.08, abs=0.02)
    falling = track[round(0.8 / DT) :]
    assert np.argmax(falling < 0.368 * top) * DT == pytest.approx(0.12 + 0.015, abs=0.025)


def test_force_grows_with_frequency_and_fuses() -> None:
    own = MuscleSettings(fatigue_s=math.inf)
    level, ripple = [], []
    for frequency in (10.0, 20.0, 40.0):
        steady = run(own, 1.5, frequency)[round(1.0 / DT) :, 0]
        level.append(steady.mean())
        ripple.append(np.ptp(steady) / steady.mean())
    assert level == sorted(level)
    assert level[2] == pytest.approx(1.0, abs=0.05)
    assert ripple[0] > 3 * ripple[2]


def test_fatigue_and_recovery() -> None:
    own = MuscleSettings(fatigue_s=10.0, recovery_s=20.0, fatigue_floor=0.3)
    fit = run(own, 60.0, 40.0, until_s=30.0)[:, 1]
    tired = fit[round(30.0 / DT) - 1]
    assert tired == pytest.approx(0.3 + 0.7 * math.exp(-3.0), abs=0.06)
    assert fit[-1] == pytest.approx(1.0 - (1.0 - tired) * math.exp(-1.5), abs=0.03)
    slower = run(own, 10.0, 20.0)[-1, 1]
    assert slower > run(own, 10.0, 40.0)[-1, 1]


def test_the_delay_is_the_electromechanical_one() -> None:
    for delay_s in (0.02, 0.06):
        patient = VirtualPatient(PatientSettings(muscle=MuscleSettings(delay_s=delay_s)))
        pulses = [DeliveredPulse(NS_PER_S + k * 25_000_000, 0, 40.0, 300.0) for k in range(8)]
        patient.advance(2 * NS_PER_S, pulses)
        trace = patient.trace("right_foot")
        first = trace["t_s"][np.argmax(trace["activation"] > 0.001)]
        assert first == pytest.approx(1.0 + delay_s, abs=0.008)


@settings(max_examples=20, deadline=None)
@given(st.floats(5.0, 60.0), st.floats(0.05, 1.0))
def test_torque_stays_within_what_the_muscle_has(frequency: float, share: float) -> None:
    own = MuscleSettings(max_torque_nm=14.0)
    most = share / activation_at_40hz(own.tau_calcium_s, own.tau_rise_s, own.tau_fall_s)  # fused, far above 40 Hz
    torque = run(own, 0.4, frequency, share)[:, 2]
    assert torque.min() >= 0.0
    assert torque.max() <= 14.0 * most


def test_a_free_foot_comes_to_rest_where_gravity_and_tissue_balance() -> None:
    from fes.simulation.forward.dynamics import BELT, SWING, plan, step

    legs, belt = np.zeros(1, LEG), np.zeros(1, BELT)
    legs[0] = body_of(PatientSettings(spasticity=0.0), affected=True)
    legs["mode"], legs["lift_m"], legs["swing_t"], legs["swing_s"] = SWING, 2.0, 1e6, 1.0  # held high in the air
    legs["z"], legs["pitch"], legs["hold"] = 2.0 - legs["thigh_m"] - legs["shank_m"], 0.3, 0.0
    energy = []
    for k in range(8000):
        plan(legs[0], belt[0], k * DT)
        step(legs[0], belt[0], k * DT, DT)
        energy.append(0.5 * float(legs["inertia"][0]) * float(legs["vpitch"][0]) ** 2)
    leg = legs[0]
    lever = leg["com_x"] * math.cos(leg["pitch"]) + 0.5 * leg["sole_m"] * math.sin(leg["pitch"])
    pull = (
        passive(leg["pitch"] - leg["shank"], leg["bend"], leg["stiff"], leg["short_rad"])
        - leg["foot_kg"] * 9.80665 * lever
    )
    assert abs(pull) < 0.02
    assert energy[-1] < 1e-8 < max(energy)
    assert math.degrees(leg["pitch"]) == pytest.approx(-20.0, abs=8.0)


@settings(deadline=None)
@given(st.floats(-1.2, 0.8), st.floats(0.0, 1.2))
def test_tight_tissue_keeps_the_damping_ratio(angle: float, knee: float) -> None:
    step, inertia = 1e-5, 0.0126
    slope = (passive(angle - step, knee, 1.0, 0.0) - passive(angle + step, knee, 1.0, 0.0)) / (2.0 * step)
    critical = 2.0 * math.sqrt(inertia * slope)
    assert damping(angle, knee, 1.0, 0.0, 0.5, inertia) == pytest.approx(max(0.5, DAMPING_RATIO * critical), rel=1e-3)


def test_the_end_of_the_range_does_not_throw_the_foot_back() -> None:
    inertia, pitch, rate, stored, fastest = 0.0126, math.radians(-62.0), 0.0, 0.0, 0.0
    for _ in range(400):
        pull = passive(pitch, 0.8, 1.0, 0.0)
        stored += max(pull, 0.0) * rate * DT
        rate += (pull - damping(pitch, 0.8, 1.0, 0.0, 0.5, inertia) * rate) / inertia * DT
        pitch += rate * DT
        fastest = max(fastest, rate)
    assert fastest < 0.6 * math.sqrt(2.0 * stored / inertia)  # of a spring that loses nothing
