"""Tuning beside the operator's intensity: less by hand stays less, and more by hand is no surprise."""

from __future__ import annotations

import pytest
from tuning_plant import Plant, channel, charge_of, stride, tuning

from fes.config import Session, Stimulation
from fes.signals import NS_PER_S, OperatorAct, OperatorAction
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.session import Tuners

OWN_UC = 9.0  # the channel's own 30 mA for 300 µs


class Walk:
    """Strides of a plain foot with one tuned channel, and a hand on the intensity."""

    def __init__(self, method: str, plant: Plant) -> None:
        own = channel(tuning(method=method))
        self.tuners = Tuners(Session(name="a walk", channels=(own,), stimulation=Stimulation(intensity=1.0)))
        self.plant, self.intensity, self.number = plant, 0.0, 0
        self.told: list[str] = []

    def set(self, intensity: float) -> Walk:
        self.intensity = intensity
        act = OperatorAct(self._now_ns, OperatorAction.SET_INTENSITY, intensity)
        self.told += [report.text for report in self.tuners.on_act(act)]
        return self

    def resume(self) -> Walk:
        self.tuners.on_act(OperatorAct(self._now_ns, OperatorAction.RESUME_TUNING))
        return self

    def walk(self, strides: int) -> Walk:
        tuner = self.tuners.tuners[0]
        for _ in range(strides):
            one = stride(self.number, self.plant.clearance_m(tuner.parameters, self.intensity))
            charge_uc = charge_of(tuner.parameters, self.intensity)
            self.tuners.ledger.electrodes[0].close_step(one.t_start_ns, one.t_end_ns)
            tuner.observe(one.t_end_ns, one, charge_uc, self.intensity)
            self.number += 1
        return self

    @property
    def _now_ns(self) -> int:
        return round(1.4 * self.number * NS_PER_S) + 1

    @property
    def charge_uc(self) -> float:
        """Of a pulse of the next burst."""
        return charge_of(self.tuners.tuners[0].parameters, self.intensity) / 30


@pytest.mark.parametrize("method", ["run_to_run", "learning"])
def test_what_a_person_took_away_is_not_brought_back(method: str):
    walk = Walk(method, Plant(baseline_m=-0.01)).set(1.0).walk(15)
    before_uc = walk.charge_uc
    walk.set(0.6)
    assert walk.charge_uc == pytest.approx(0.6 * before_uc)
    assert any("lowered by hand" in text for text in walk.told)
    walk.walk(15)
    assert walk.charge_uc == pytest.approx(0.6 * before_uc)
    walk.set(1.0)
    assert walk.charge_uc == pytest.approx(before_uc)


class Hopeless(Plant):
    """Worse with every change in either direction."""

    def clearance_m(self, parameters: BurstParameters, intensity: float = 1.0) -> float:
        return 0.008 - 0.003 * abs(parameters.current_ma - 30.0)


def test_one_that_stopped_itself_does_not_bring_it_back_either():
    walk = Walk("run_to_run", Hopeless()).set(1.0)
    tuner = walk.tuners.tuners[0]
    for _ in range(200):
        if tuner.frozen:
            break
        walk.walk(1)
    assert "stopped itself" in tuner.frozen
    assert tuner.parameters.current_ma > tuner.start.current_ma  # on its way back to that
    before_uc = walk.set(0.6).charge_uc
    walk.walk(10)
    assert walk.charge_uc < before_uc
    assert tuner.parameters == tuner.start
    assert "stopped itself" in tuner.frozen


@pytest.mark.parametrize("method", ["run_to_run", "learning"])
def test_below_the_sessions_intensity_nothing_is_stronger_than_the_sessions_own(method: str):
    """Else raising the intensity to what the session names would give far more than the session names."""
    walk = Walk(method, Plant(baseline_m=-0.04)).set(0.4).walk(20).set(1.0)
    assert walk.charge_uc <= OWN_UC + 1e-9
    walk.walk(15)
    assert walk.charge_uc > OWN_UC  # this foot needs more, and gets it stride by stride
    strong_uc = walk.charge_uc
    walk.set(0.5).resume().walk(20).set(1.0)
    assert walk.charge_uc <= strong_uc + 1e-9


def test_arming_at_nothing_and_raising_is_no_lowering():
    walk = Walk("run_to_run", Plant()).set(0.0).set(0.5).set(1.0).set(0.0).set(0.3)
    assert walk.told == []
    assert not walk.tuners.tuners[0].frozen
