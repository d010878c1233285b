"""Faults inside the loop, on a virtual patient: safe, and nothing is learnt from bad strides."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import pytest

from fes.config import Session
from fes.estimation.foot.calibration import FootCalibration
from fes.signals import NS_PER_S
from fes.simulation.forward import PatientSettings, VirtualPatient
from fes.stimulation.tuning.report import TuningReport

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
try:
    from closed_loop_walk import Walk, calibration_of, walk
    from loop_faults import FAULTS, Fault, suffer
    from tuning import session_of
    from tuning_cohort import patient
finally:
    sys.path.remove(str(BENCHMARKS))

PATIENT = PatientSettings(seed=3, speed_mps=0.8, sensors=("right_foot",))
AT_S = 35.0  # some twenty strides are walked by then


@pytest.fixture(scope="module")
def calibration() -> FootCalibration:
    return calibration_of(PATIENT)


def walked(calibration: FootCalibration, strides: int = 40, **faults: Any) -> Walk:
    geometry = VirtualPatient(PATIENT).geometry["right_foot"]
    return walk(PATIENT, session_of(geometry, "run-to-run"), calibration, 120.0, strides, **faults)


def once(act: Callable[[VirtualPatient], None], at_s: float = AT_S) -> Callable[[VirtualPatient, int], None]:
    done: list[int] = []

    def during(patient: VirtualPatient, t_ns: int) -> None:
        if t_ns >= at_s * NS_PER_S and not done:
            done.append(t_ns)
            act(patient)

    return during


def after(done: Walk, at_s: float = AT_S) -> list[TuningReport]:
    return [report for report in done.reports if report.t_ns >= at_s * NS_PER_S]


def drags_at_the_end(done: Walk) -> int:
    return sum(one.dragged or one.stumbled for one in done.strides[-8:])


def within_bounds(done: Walk) -> bool:
    tuned = session_of(VirtualPatient(PATIENT).geometry["right_foot"], "run-to-run").channels[0].tuning
    assert tuned is not None
    assert tuned.bounds is not None
    bounds = tuned.bounds.current_ma
    return all(bounds.low <= report.after.current_ma <= bounds.high for report in done.reports)


def test_a_drop_foot_patient_drags_without_and_clears_with_it(calibration: FootCalibration) -> None:
    bare = walk(PATIENT, Session(name="none"), calibration, 60.0, 25)
    assert drags_at_the_end(bare) >= 3
    done = walked(calibration, 25)
    assert drags_at_the_end(done) == 0
    assert within_bounds(done)
    assert not done.refused
    assert not done.latched


def test_an_electrode_that_comes_loose_is_made_up_for(calibration: FootCalibration) -> None:
    done = walked(calibration, during=once(lambda patient: patient.set_electrode_quality(0.75)))
    raised = [report for report in after(done) if report.kind == "change"]
    assert raised[-1].after.current_ma > raised[0].before.current_ma
    assert drags_at_the_end(done) == 0
    assert within_bounds(done)


def test_an_electrode_that_is_off_stops_the_tuning_and_is_no_surprise_when_put_back(
    calibration: FootCalibration,
) -> None:
    off, back = once(lambda patient: patient.set_electrode_quality(0.0), 0.0), 45.0
    on = once(lambda patient: patient.set_electrode_quality(1.0), back)

    def during(patient: VirtualPatient, t_ns: int) -> None:
        off(patient, t_ns)
        on(patient, t_ns)

    done = walked(calibration, during=during)
    stopped = [report for report in done.reports if "look at the electrodes; tuning has stopped" in report.text]
    assert len(stopped) == 1
    assert stopped[0].t_ns < back * NS_PER_S
    assert max(report.after.current_ma for report in done.reports) > 33.0  # it did climb
    assert done.reports[-1].after.current_ma <= 30.0
    assert max(pulse.current_ma for pulse in done.pulses if pulse.t_ns >= back * NS_PER_S) <= 30.0
    assert not done.latched


def test_sudden_fatigue_is_made_up_for(calibration: FootCalibration) -> None:
    done = walked(calibration, during=once(lambda patient: patient.set_fitness(0.65)))
    assert any(report.after.current_ma > report.before.current_ma for report in after(done))
    assert drags_at_the_end(done) == 0
    assert within_bounds(done)


def test_turning_teaches_nothing(calibration: FootCalibration) -> None:
    done = walked(calibration, 32, during=once(lambda patient: patient.turn(1.5)))
    assert any("turned by" in report.text for report in after(done) if report.kind == "skip")
    assert drags_at_the_end(done) == 0


def test_after_a_stop_the_first_stride_teaches_nothing(calibration: FootCalibration) -> None:
    stop, go = once(lambda patient: patient.stop()), once(lambda patient: patient.walk(), AT_S + 6.0)

    def during(patient: VirtualPatient, t_ns: int) -> None:
        stop(patient, t_ns)
        go(patient, t_ns)

    done = walked(calibration, 36, during=during)
    assert any("after standing" in report.text for report in after(done, AT_S + 6.0))
    assert within_bounds(done)


def test_a_speed_step_is_no_reason_to_change_the_current_at_once(calibration: FootCalibration) -> None:
    done = walked(calibration, during=once(lambda patient: patient.set_speed(1.2)))
    assert any("the speed changed" in report.text for report in after(done))
    assert drags_at_the_end(done) == 0
    assert within_bounds(done)


@pytest.mark.parametrize("at_s", [35.0, 35.4, 35.8, 36.2])
def test_a_sensor_that_falls_silent_teaches_nothing(calibration: FootCalibration, at_s: float) -> None:
    silent_ns = (round(at_s * NS_PER_S), round((at_s + 1.5) * NS_PER_S))
    done = walked(calibration, 36, lost=lambda t_ns: silent_ns[0] <= t_ns < silent_ns[1])
    spanning = [one for one in done.measured if one.t_start_ns < silent_ns[1] and one.t_end_ns > silent_ns[0]]
    assert not any(one.valid for one in spanning)
    gap = [one for one in done.strides if silent_ns[0] < one.t_heel_off_ns < silent_ns[1]]
    usual_uc = median(one.charge_uc for one in done.strides[5:15])
    # without fresh data no burst begins; what is booked is the end of the one before, past its contact
    assert all(one.charge_uc < 0.4 * usual_uc for one in gap)
    soon = [report for report in after(done, at_s) if report.t_ns < silent_ns[1] + 2 * NS_PER_S]
    assert {report.kind for report in soon} <= {"skip"}
    assert within_bounds(done)
    if not done.latched:  # in mid-burst the gate latches, and a person must arm again
        assert drags_at_the_end(done) == 0


@pytest.fixture(scope="module", params=[4, 7])
def person(request: pytest.FixtureRequest) -> tuple[int, PatientSettings, FootCalibration]:
    """Two of the cohort: the benchmark loop_faults.py has ten and longer walks."""
    settings, found, _ = patient(request.param)
    return request.param, settings, found


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_is_safe_and_bad_strides_change_nothing(
    person: tuple[int, PatientSettings, FootCalibration], fault: Fault
) -> None:
    number, settings, found = person
    session = session_of(VirtualPatient(settings).geometry["right_foot"], "run-to-run", 26.0)
    outcome = suffer(number, settings, session, found, fault, before=8, strides=16)
    assert outcome.safe == ""
    assert outcome.learnt_from_bad == 0
    if fault.spoils_s:
        assert outcome.spoilt_ma == outcome.before_ma
