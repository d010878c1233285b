"""How a session begins."""

from __future__ import annotations

import math

import pytest
from pydantic import ValidationError

from fes.config import ChannelLimits, Session
from fes.control.controller import Controller
from fes.signals import OperatorAct, OperatorAction


@pytest.mark.requirement("SR-17")
def test_intensity_starts_at_nothing() -> None:
    assert Controller(Session(name="x"), {}).intensity == 0.0


@pytest.mark.requirement("SR-17")
@pytest.mark.parametrize(("asked", "set_to"), [(0.5, 0.5), (7.0, 1.0), (-1.0, 0.0), (math.nan, 0.0), (math.inf, 1.0)])
def test_intensity_stays_between_nothing_and_all(asked: float, set_to: float) -> None:
    controller = Controller(Session(name="x"), {})
    controller.step(OperatorAct(0, OperatorAction.SET_INTENSITY, asked))
    assert controller.intensity == set_to


LIMITS = {
    "max_current_ma": 30.0,
    "max_pulse_width_us": 400.0,
    "max_frequency_hz": 50.0,
    "max_charge_per_phase_uc": 10.0,
    "max_charge_per_minute_mc": 50.0,
    "max_current_density_ma_per_cm2": 1.0,
    "max_rise_ma_per_s": 1000.0,
    "max_on_s": 2.0,
    "min_off_s": 0.1,
}


@pytest.mark.requirement("SR-17")
@pytest.mark.parametrize("missing", sorted(ChannelLimits.model_fields))
def test_each_single_limit_must_be_stated(missing: str) -> None:
    assert ChannelLimits.model_validate(LIMITS)
    with pytest.raises(ValidationError, match=missing):
        ChannelLimits.model_validate({name: value for name, value in LIMITS.items() if name != missing})
