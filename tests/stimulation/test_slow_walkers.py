"""Wang's five slow walks with a tuned channel: the gait is not broken, and every swing is stimulated to its end."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.loop.closed_loop_walk import walk
from benchmarks.loop.tuning import session_of
from benchmarks.loop.tuning_cohort import patient
from fes.simulation.forward import VirtualPatient
from fes.simulation.forward.gait_patterns import PATTERNS

SEED, STRIDES = 17, 25
SETTLED = 10  # strides: the first ones of hemiparetic_1 end twice (T6), and three in order must come after that
STIMULATED = 0.7  # of a swing: from the last pulse before its middle to the last one in it


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(name for name in PATTERNS if name.startswith("hemiparetic")))
def test_stimulation_does_not_break_a_slow_gait(name: str) -> None:
    settings, calibration, _ = patient(
        SEED, lambda drawn: replace(drawn, pattern=name, speed_mps=PATTERNS[name].speed_mps)
    )
    geometry = VirtualPatient(settings).geometry["right_foot"]
    for method in ("none", "tuner"):
        done = walk(settings, session_of(geometry, method), calibration, 240.0, STRIDES)
        assert done.put_back == 0, "no heel rise became a heel put back"
        assert done.latched == ""
        assert len(done.strides) == STRIDES
    pulses_ns = [pulse.t_ns for pulse in done.pulses]
    for stride in done.strides[SETTLED:]:
        begun_ns, ended_ns = stride.t_foot_off_ns, stride.t_contact_ns
        in_swing = [t_ns for t_ns in pulses_ns if begun_ns <= t_ns <= ended_ns]
        assert in_swing, f"stride {stride.number} had no burst"
        assert in_swing[-1] - begun_ns > STIMULATED * (ended_ns - begun_ns), f"stride {stride.number}: cut short"


@pytest.mark.slow
def test_the_toe_is_measured_in_mid_swing_where_stimulation_lets_foot_off_be_seen_early() -> None:
    """A foot whose heel rises against a strong burst swings, for the phases, long before its toe leaves the ground."""
    name = "hemiparetic_3"
    settings, calibration, _ = patient(
        SEED, lambda drawn: replace(drawn, pattern=name, speed_mps=PATTERNS[name].speed_mps)
    )
    session = session_of(VirtualPatient(settings).geometry["right_foot"], "fixed", 45.0)
    done = walk(settings, session, calibration, 240.0, 20)
    above_mm = []
    for measured in done.measured:
        if measured.t_loading_response_ns is not None:
            true = min(done.strides, key=lambda one: abs(one.t_contact_ns - measured.t_loading_response_ns))
            above_mm.append(1e3 * (measured.toe_clearance_m - true.toe_clearance_m))
    assert len(above_mm) > 12
    assert max(abs(each) for each in above_mm) < 15.0
