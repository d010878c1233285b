"""The end of the burst before contact: only while the heel comes first and the toe comes down no faster."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from tuning_plant import BOUNDS, channel, charge_of, stride, tuning

from fes.signals import StrideResult
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.timing import FASTER, SOONEST_S, Lowering, SpeedTiming, lowering_radps
from fes.stimulation.tuning.tuner import Tuner

SECOND = 1_000_000_000
EARLY = BOUNDS | {"extension_s": {"low": -0.1, "high": 0.2}}
PITCH = {"low": 4.0, "high": 25.0}
CONTACT_S, FLAT_S, DURATION_S = 1.1, 1.2, 1.4  # of the plant's stride: its heel rises after 0.2 s


def landing(number: int, pitch_deg: float = 12.0, lowered_in_s: float = 0.1) -> StrideResult:
    """A stride whose foot comes down from its pitch at contact to flat at an even rate."""
    at_s = np.linspace(0.0, DURATION_S, 101)
    share = np.clip(1.0 - (at_s - CONTACT_S) / lowered_in_s, 0.0, 1.0)
    return stride(number, 0.022, pitch_deg, pitch_rad=math.radians(pitch_deg) * share)


def test_the_rate_is_the_fastest_between_contact_and_flat() -> None:
    assert lowering_radps(landing(0)) == pytest.approx(math.radians(12.0) / 0.1, rel=0.02)
    assert lowering_radps(landing(0, lowered_in_s=0.05)) == pytest.approx(math.radians(12.0) / 0.05, rel=0.1)
    assert lowering_radps(stride(0, 0.022, 12.0)) == 0.0
    assert math.isnan(lowering_radps(stride(0, 0.022, t_loading_response_ns=None)))
    assert math.isnan(lowering_radps(stride(0, 0.022, t_stance_ns=None)))


def test_nothing_to_hold_it_against_is_too_fast() -> None:
    lowering = Lowering()
    for number in range(2):
        lowering.add(landing(number), 0.0)
    assert lowering.too_fast
    assert not lowering.well
    lowering.add(landing(2), 0.0)
    assert not lowering.too_fast
    assert lowering.well


def test_between_well_and_too_fast_it_stays_as_it_is() -> None:
    for share, too_fast, well in ((1.0, False, True), (1.2, False, False), (1.1 * FASTER, True, False)):
        lowering = Lowering()
        for number in range(5):
            lowering.add(landing(number), 0.02)
        for number in range(5, 8):
            lowering.add(landing(number, 12.0 * share), -0.05)
        assert (lowering.too_fast, lowering.well) == (too_fast, well)


def extension_s(timing: SpeedTiming) -> float:
    return timing.wanted("pre_swing", 0.15, 0.1)[1]


def test_the_end_is_brought_forward_step_by_step_and_taken_back_when_the_toe_comes_first() -> None:
    timing, lowering = SpeedTiming(), Lowering()
    for number in range(4):
        timing.add(landing(number))
        lowering.add(landing(number), 0.0)
    found = [extension_s(timing)]
    for _ in range(6):
        timing.bring_forward(0.3, 0.0, lowering, found[-1])
        found.append(extension_s(timing))
    assert found == pytest.approx([0.0, -0.025, -0.05, -0.075, -0.1, -0.1, -0.1])
    assert found[-1] == -SOONEST_S
    assert "left out" in timing.reason(-0.02)
    assert "left out" not in timing.reason(0.0)
    timing.bring_forward(0.05, 0.1, lowering, -SOONEST_S)  # still reached, though more is asked for
    assert extension_s(timing) == -SOONEST_S
    timing.bring_forward(-0.05, 0.1, lowering, -SOONEST_S)
    assert "given back, for the heel must come first" in timing.reason(-0.075)
    assert extension_s(timing) == pytest.approx(-0.075)
    for _ in range(6):
        timing.bring_forward(None, 0.0, lowering, extension_s(timing))
    assert extension_s(timing) == 0.0


def walked(tuner: Tuner, strides: int, foot: Callable[[int, BurstParameters], StrideResult]) -> list[float]:
    found = []
    for number in range(strides):
        found.append(tuner.parameters.extension_s)
        tuner.observe(number * SECOND, foot(number, tuner.parameters), charge_of(tuner.parameters), 1.0)
    return found


def test_the_burst_ends_before_contact_where_the_session_allows_it() -> None:
    allowed = Tuner(channel(tuning(timing=True, pitch_at_contact_deg=PITCH, bounds=EARLY)))
    found = walked(allowed, 30, lambda number, _: landing(number))
    assert found[0] == allowed.start.extension_s
    assert found[-1] == pytest.approx(-0.1)
    refused = Tuner(channel(tuning(timing=True, pitch_at_contact_deg=PITCH)))
    assert min(walked(refused, 30, lambda number, _: landing(number))) == 0.0


def test_a_foot_that_slaps_gets_its_pulses_back() -> None:
    def slaps(number: int, parameters: BurstParameters) -> StrideResult:
        return landing(number, lowered_in_s=0.1 if parameters.extension_s >= 0.0 else 0.06)

    tuner = Tuner(channel(tuning(timing=True, pitch_at_contact_deg=PITCH, bounds=EARLY)))
    found = walked(tuner, 60, slaps)
    assert min(found) < 0.0
    assert found.count(min(found)) < 10
    assert sum(value >= -0.03 for value in found[10:]) > 0.6 * len(found[10:])


def test_a_foot_that_comes_down_toe_first_gets_its_pulses_back() -> None:
    def drops(number: int, parameters: BurstParameters) -> StrideResult:
        return landing(number, 12.0 if parameters.extension_s > -0.05 else 2.0)

    tuner = Tuner(channel(tuning(timing=True, pitch_at_contact_deg=PITCH, bounds=EARLY, method="run_to_run")))
    found = walked(tuner, 40, drops)
    early = [n for n, value in enumerate(found) if value <= -0.05]
    assert early
    assert found[early[0] + 1] > found[early[0]]
    assert sum(value <= -0.05 for value in found[10:]) <= 0.5 * len(found[10:])
