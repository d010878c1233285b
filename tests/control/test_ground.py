"""A person says during a session what is walked on: the strides from there on, and the same again in a replay."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from replays import SETTINGS

from fes.analysis.pipeline import calibrations_of
from fes.cli.replay.command import repeat
from fes.config import load_session, validate_session
from fes.control.controller import Controller
from fes.estimation.sensor_choice import Calibration
from fes.hil.closed_loop import one_process, processes
from fes.hil.closed_loop.one_process import patient, run_in_one_process
from fes.hil.closed_loop.processes import Happening, armed_protocol
from fes.hil.settings import patient_calibration, patient_session_text
from fes.recording import Recording
from fes.session_log import SessionWriter, iter_events, read_session
from fes.signals import GROUND_ACTS, NS_PER_S, Event, ImuSample, OperatorAct, OperatorAction, StrideResult
from fes.simulation.truth import Truth
from sim_inputs.generator.observe import observe
from sim_inputs.generator.session import new_session
from sim_inputs.generator.trials import IMU, INSTEP, SLOW_HEALTHY
from statemachine.phases import PhaseChange, Transition

FOOT = "right_foot"
INCLINE = 0.1
SCATTER = 0.02  # of the height gained, over the stride's length


@cache
def walked(incline_percent: float) -> tuple[Recording, Truth]:
    """A slow walk on a belt, and its truth."""
    session = new_session("incline", 9100, INSTEP)
    session.incline_percent = incline_percent
    session.stand(4.0)
    session.walk({FOOT: SLOW_HEALTHY}, 16, 0.8, ramp_s=2.0, early=False)
    session.stand(2.5)
    session.finish()
    return session.recording(200.0, IMU, ""), observe(session)


@cache
def calibration() -> dict[str, Calibration]:
    """From level ground, as a session that begins there has it."""
    return dict(calibrations_of(walked(0.0)[0])[1].calibrations)


@dataclass
class Walk:
    """What the controller made of some events."""

    controller: Controller
    decisions: list[str]
    strides: list[StrideResult]
    rises_ns: dict[int, int]  # when the heel rose for each stride, by its number

    def heights(self, first_ns: int, last_ns: int) -> list[float]:
        """Height gained per way, of the valid strides whose heel rose between these times."""
        return [
            stride.height_gained_m / stride.stride_length_m
            for stride in self.strides
            if stride.valid and first_ns <= self.rises_ns[stride.number] < last_ns
        ]


def controlled(events: list[Event]) -> Walk:
    """By a session that begins on level ground."""
    made = Walk(Controller(load_session(SETTINGS), calibration()), [], [], {})
    rose_ns = 0
    for event in events:
        decision = made.controller.step(event)
        made.decisions.append(repr(decision))
        for outcome in decision.outcomes:
            if isinstance(outcome, StrideResult):
                made.strides.append(outcome)
                made.rises_ns[outcome.number] = rose_ns
            elif isinstance(outcome, PhaseChange) and outcome.transition is Transition.T1:
                rose_ns = outcome.t_ns
    return made


def uphill(*acts: OperatorAct) -> list[Event]:
    """The walk on the incline, and what a person says meanwhile."""
    track = walked(100.0 * INCLINE)[0].tracks[FOOT]
    rows = zip(track.t_ns, track.t_sensor_ns, track.acc_mps2, track.gyr_radps, strict=True)
    samples: list[Event] = [
        ImuSample(int(t_ns), FOOT, int(own_ns), tuple(acc.tolist()), tuple(gyr.tolist()))
        for t_ns, own_ns, acc, gyr in rows
    ]
    return sorted([*samples, *acts], key=lambda event: event.t_ns)


def at(t_s: float, incline: float) -> OperatorAct:
    """Said at this time; NaN: free."""
    action = OperatorAction.FREE_GROUND if math.isnan(incline) else OperatorAction.SET_INCLINE
    return OperatorAct(int(t_s * NS_PER_S), action, 0.0 if math.isnan(incline) else incline)


@pytest.mark.requirement("SR-23")
def test_heights_are_free_of_the_slope_once_it_is_said() -> None:
    said = at(14.03, INCLINE)
    found = controlled(uphill(said))
    before, after = found.heights(0, said.t_ns), found.heights(said.t_ns, 2**62)
    assert len(before) >= 4
    assert len(after) >= 4
    assert max(map(abs, before)) < SCATTER, "the stride under way keeps the ground with which it began"
    assert after == pytest.approx([INCLINE] * len(after), abs=SCATTER)
    true = [stride for stride in walked(100.0 * INCLINE)[1].strides if stride.steady]
    errors: dict[bool, list[float]] = {False: [], True: []}
    for stride in found.strides:
        for other in true:
            swing_s = 1e-9 * (stride.t_swing_ns or 0)
            if stride.valid and other.t_pre_swing_s <= swing_s <= other.t_stance_s:
                errors[found.rises_ns[stride.number] >= said.t_ns].append(stride.clearance_m - other.clearance_m)
    assert len(errors[True]) >= 4
    assert abs(np.mean(errors[True])) < 0.01
    assert all(abs(stride.free_rise_m - INCLINE * stride.stride_length_m) < 0.06 for stride in found.strides[2:-1])


@pytest.mark.parametrize("t_s", np.linspace(12.0, 15.0, 7))
def test_no_stride_mixes_two_grounds_whenever_it_is_said(t_s: float) -> None:
    """A stride that is over, but not yet closed, has been walked on the ground before."""
    said = at(t_s, INCLINE)
    found = controlled(uphill(said))
    assert max(map(abs, found.heights(0, said.t_ns))) < SCATTER
    after = found.heights(said.t_ns, 2**62)
    assert after == pytest.approx([INCLINE] * len(after), abs=SCATTER)


def test_free_ground_and_back_to_level() -> None:
    free, level = at(10.0, math.nan), at(15.0, 0.0)
    found = controlled(uphill(free, level))
    between = found.heights(free.t_ns, level.t_ns)
    assert len(between) >= 3
    assert np.median(between) == pytest.approx(INCLINE, abs=0.05)
    assert min(map(abs, between)) > SCATTER
    assert max(map(abs, found.heights(level.t_ns, 2**62))) < SCATTER
    assert found.controller.incline == 0.0


def test_what_no_treadmill_does_is_held_to_what_a_session_may_say() -> None:
    controller = Controller(load_session(SETTINGS), calibration())
    controller.step(at(1.0, 3.0))
    assert controller.incline == 0.25
    controller.step(at(1.0, math.nan))
    assert math.isnan(controller.incline)


def test_the_same_events_read_back_from_a_log_give_the_same_decisions(tmp_path: Path) -> None:
    events = uphill(at(10.0, math.nan), at(14.03, INCLINE))
    writer = SessionWriter(tmp_path / "x.feslog", {})
    for event in events:
        writer.event(event)
    writer.close({})
    back = list(iter_events(tmp_path / "x.feslog"))
    assert [each for each in back if isinstance(each, OperatorAct)] == [at(10.0, math.nan), at(14.03, INCLINE)]
    one, other = controlled(events), controlled(back)
    assert one.decisions == other.decisions
    assert [each.trajectory_m.tobytes() for each in one.strides] == [
        each.trajectory_m.tobytes() for each in other.strides
    ]


def test_a_session_on_a_treadmill_that_was_tilted_repeats_to_the_last_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tuned and stimulated."""
    monkeypatch.setattr(processes, "COMMANDS", (*processes.COMMANDS, *GROUND_ACTS))
    monkeypatch.setattr(one_process, "_ACTS", {*one_process._ACTS, *GROUND_ACTS})
    settings = patient()
    text = patient_session_text(settings, current_ma=12.0, tuning="act")
    session = validate_session(tomllib.loads(text), tmp_path / "session.toml", text)
    found, log = patient_calibration(settings).calibrations, tmp_path / "x.feslog"
    happens = Happening(16.0, "set_incline", 0.05), Happening(19.0, "free_ground")
    run_in_one_process(settings, session, found, armed_protocol(21.0, happens), log, "2026-01-01T00:00:00")
    record = read_session(log)
    assert [act.action for act in record.acts if act.action in ("set_incline", "free_ground")] == [
        OperatorAction.SET_INCLINE,
        OperatorAction.FREE_GROUND,
    ]
    assert any("a person changed the ground meanwhile" in note.text for note in record.notes)
    again = repeat(log)
    assert again.strides > 5
    assert again.difference == ""
