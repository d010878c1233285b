"""Whatever the features are, the phase follows the table; compiled and plain guards agree on any number."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fes.calibration.recording import calibrate_track
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.estimation.tracking import phase_features as kernel
from fes.recording import read_recording
from statemachine.guards import Features, Thresholds
from statemachine.machine import GaitPhaseMachine, GuardDisagreement
from statemachine.phases import Phase, PhaseChange, Transition
from statemachine.table import TABLE

P = Thresholds()
ROWS = {(row.source, row.transition, row.destination) for row in TABLE}
LIMITS = [0.0, *P, *(-x for x in P), math.inf, -math.inf, math.nan]
NUMBERS = st.one_of(st.sampled_from(LIMITS), st.floats(-2000.0, 2000.0), st.floats(-3.0, 3.0))
FEATURES = st.builds(Features, *[NUMBERS] * 9, st.booleans())


@pytest.mark.requirement("SR-03")
@settings(deadline=None)
@given(st.lists(FEATURES, min_size=1, max_size=40))
def test_random_features_never_leave_the_table(stream: list[Features]) -> None:
    machine = GaitPhaseMachine("right_foot")
    for t_ns, x in enumerate(stream):
        source = machine.phase
        number = kernel.first_transition(int(source), x, P)
        assert number == next((r.transition for r in TABLE if r.source is source and r.guard(x, P)), 0)
        if number:
            change = machine.fire(Transition(number), t_ns, x, P)
            assert (change.source, change.transition, change.destination) in ROWS
            assert change.source is source
            assert change.destination is machine.phase
        else:
            assert machine.phase is source


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from(Transition), FEATURES), max_size=40))
def test_only_rows_whose_guard_holds_are_granted(
    asked: list[tuple[Transition, Features]],
) -> None:
    machine = GaitPhaseMachine("right_foot")
    for transition, x in asked:
        source = machine.phase
        row = next((r for r in TABLE if r.source is source and r.transition is transition), None)
        try:
            change = machine.fire(transition, 0, x, P)
        except GuardDisagreement:
            assert row is None or not row.guard(x, P)
            assert machine.phase is source
        else:
            assert row is not None
            assert row.guard(x, P)
            assert machine.phase is change.destination is row.destination


CALIBRATION = calibrate_track(
    read_recording(Path(__file__).parents[2] / "sim_inputs" / "example_csv.csv").tracks["right_foot"]
)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    parts=st.lists(
        st.tuples(st.integers(1, 60), st.floats(0.0, 12.0), st.floats(0.0, 40.0), st.integers(1, 60)),
        min_size=1,
        max_size=12,
    ),
)
def test_random_samples_never_leave_the_table(seed: int, parts: list[tuple[int, float, float, int]]) -> None:
    """Noise, rest and silence in any order: the changes make one chain of table rows, and times go forward."""
    rng = np.random.default_rng(seed)
    tracker = FootTracker(
        CALIBRATION, StrideMaker(CALIBRATION.sensor, StrideSettings(CALIBRATION.forward(), np.array(CALIBRATION.up)))
    )
    phase, newest, t_ns = Phase.STANCE, -1, 0
    for count, turning, shaking, pause in parts:
        stamps = t_ns + np.arange(count) * 10_000_000
        acc = np.array([0.0, 0.0, 9.81]) + shaking * rng.normal(size=(count, 3))
        for outcome in tracker.advance(stamps, acc, turning * rng.normal(size=(count, 3))):
            if isinstance(outcome, PhaseChange):
                assert outcome.source is phase
                row = (outcome.source, outcome.transition, outcome.destination)
                assert row in ROWS or row == (phase, Transition.NONE, Phase.STANCE)
                assert outcome.t_ns >= newest  # equal where the first sample after a silence already moves
                phase, newest = outcome.destination, outcome.t_ns
        t_ns = int(stamps[-1]) + pause * 10_000_000
    assert tracker.phase is phase
