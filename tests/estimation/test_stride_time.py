"""How long a stride took: the rest between two strides of a walk belongs to it, standing does not."""

from __future__ import annotations

from statistics import median

import pytest

from fes.analysis.pipeline import analyse, calibrations_of
from fes.estimation.strides.boundaries import stride_time_ns
from fes.signals import FOOT_SENSORS, NS_PER_S
from fes.simulation.forward import VirtualPatient, settings_for
from fes.simulation.forward.closed_loop import recording_of


@pytest.mark.parametrize(
    ("before_ns", "time_ns"),
    [(None, 100), (1000, 100), (940, 160), (900, 200), (899, 100), (1001, 100), (1050, 100)],
)
def test_a_rest_no_longer_than_the_stride_is_part_of_it(before_ns: int | None, time_ns: int) -> None:
    assert stride_time_ns(1000, 1100, before_ns) == time_ns


@pytest.mark.parametrize("speed_mps", [0.2, 0.6])
def test_in_slow_walking_the_speed_is_the_belts(speed_mps: float) -> None:
    patient = VirtualPatient(settings_for("moderate", speed_mps=speed_mps, seed=4))
    samples = patient.advance(60 * NS_PER_S)
    recording, found = calibrations_of(recording_of(patient, samples, "walk", ""))
    strides = [stride for stride in analyse(recording, found.calibrations).strides if stride.valid]
    for foot in FOOT_SENSORS:
        mine = [stride for stride in strides if stride.foot == foot][3:-1]
        assert median(stride.speed_mps for stride in mine) == pytest.approx(speed_mps, rel=0.05)
