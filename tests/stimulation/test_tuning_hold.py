"""Run-to-run's hold: the burst gives contact no more than contact needs, and the current has its own business."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from tuning_plant import BOUNDS, channel, charge_of, stride, tuning

from fes.config import Band
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.demand import Demand
from fes.stimulation.tuning.guardrails import strongest_drive
from fes.stimulation.tuning.report import TuningReport
from fes.stimulation.tuning.shape import WEAKEST_HOLD, BurstShape, Zones
from fes.stimulation.tuning.targets import PITCH, Measure, SwingTimes
from fes.stimulation.tuning.tuner import Tuner

PITCH_BAND = {"low": 4.0, "high": 25.0}
OWN_US = 300.0
ZONES = Zones(7, 14, 0.1, SwingTimes(0.3, 0.6, 0.8))
MOST = BOUNDS["current_ma"]["high"] / 30.0  # drive at the bound, of the session's


def foot(strides: int, pitch_per_uc: float, **changes: Any) -> tuple[Tuner, list[float], list[TuningReport]]:
    """Walk a foot whose toe answers to the burst's begin and whose contact to what it gives 0.8 s later."""
    tuner = Tuner(channel(tuning(**({"pitch_at_contact_deg": PITCH_BAND} | changes))))
    pitches, reports = [], []
    for number in range(strides):
        now = tuner.parameters
        first_uc, late_uc = (1e-3 * now.current_ma * now.widths_us[k] for k in (2, 16))
        toe_m, pitch_deg = 0.02 + 0.004 * (first_uc - 9.0), pitch_per_uc * (late_uc - 3.0)
        pitches.append(pitch_deg)
        one = stride(number, toe_m, pitch_deg, pre_swing_s=0.3, swing_s=0.6)
        report = tuner.observe(number, one, charge_of(now), 1.0)
        reports += [] if report is None else [report]
    return tuner, pitches, reports


def test_contact_gets_no_more_than_it_needs() -> None:
    tuner, pitches, reports = foot(40, 3.0)  # 18° at first
    widths = tuner.parameters.widths_us
    assert widths[0] == OWN_US
    assert OWN_US * WEAKEST_HOLD <= widths[-1] < 0.85 * OWN_US
    assert tuner.parameters.current_ma == pytest.approx(30.0, abs=2.0)  # the toe is where it should be
    assert min(pitches) >= PITCH_BAND["low"]
    told = next(report.text for report in reports if "pulse width 300 → 280 µs" in report.text)
    assert "foot pitch at contact 18 ° (target 4–25) in this stride, lately 18 °, 7 ° will do: " in told


def test_never_less_than_half() -> None:
    tuner, pitches, _ = foot(60, 6.0)
    assert min(tuner.parameters.widths_us) == pytest.approx(WEAKEST_HOLD * OWN_US, abs=1.0)
    assert pitches[-1] > 8.0


@pytest.mark.parametrize("bounds", [BOUNDS | {"pulse_width_us": {"low": OWN_US, "high": OWN_US}}])
def test_one_level_where_the_width_may_not_fall(bounds: dict[str, Any]) -> None:
    tuner, _, _ = foot(40, 3.0, bounds=bounds)
    assert set(tuner.parameters.widths_us) == {OWN_US}


def test_one_level_without_a_target_at_contact() -> None:
    tuner, _, _ = foot(40, 3.0, **{"pitch_at_contact_deg": None})
    assert set(tuner.parameters.widths_us) == {OWN_US}


def demands(toe: float, pitch: float) -> tuple[Demand, ...]:
    """What both are short of, as drives; the one that asks for most first."""
    clearance = Measure("toe clearance", 0.02, Band(low=0.012, high=0.035), 1e3, "mm")
    angle = Measure(PITCH, 12.0, Band(low=4.0, high=25.0), 1.0, "°")
    both = (
        Demand(clearance, 0.4, 2.0 * toe, 0.4, 0.1, 0.5, 0.5 + toe, 0.9),
        Demand(angle, 0.4, 2.0 * pitch, 0.2, 0.05, 0.5, 0.5 + pitch, 0.9),
    )
    return tuple(sorted(both, key=lambda demand: -demand.step))


def answered(base: BurstParameters, toe: float, pitch: float, **bounds: Any) -> BurstParameters:
    asked = tuning(pitch_at_contact_deg=PITCH_BAND, bounds=BOUNDS | bounds)
    own = channel(asked)
    return BurstShape(own, asked, strongest_drive(own, asked)).answered(base, demands(toe, pitch), ZONES, 1.0)


def held(hold_us: float, current_ma: float = 30.0) -> BurstParameters:
    """A burst with this hold from the zones' border on."""
    own = BurstParameters.for_channel(channel())
    return replace(own, current_ma=current_ma, widths_us=(OWN_US,) * 7 + (hold_us,) * 23)


def test_a_stronger_current_leaves_the_hold_as_strong_as_it_was() -> None:
    before = held(240.0)
    after = answered(before, 0.1, 0.0)
    assert after.current_ma > before.current_ma
    assert after.current_ma * after.widths_us[-1] == pytest.approx(before.current_ma * before.widths_us[-1])


def test_a_current_that_cannot_grow_weakens_no_hold() -> None:
    before = held(240.0, 40.0)
    assert answered(before, 0.9, 0.0) == before


def test_contact_asks_the_hold_first_and_the_current_when_that_is_full() -> None:
    before = held(240.0)
    after = answered(before, 0.0, 0.1)
    assert after.current_ma == before.current_ma
    assert after.widths_us[-1] == pytest.approx(240.0 + OWN_US * MOST * 0.6 * 0.1)
    full = answered(held(OWN_US), 0.0, 0.1)
    assert full.current_ma > 30.0
    assert set(full.widths_us) == {OWN_US}
