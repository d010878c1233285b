"""Tuning as part of the controller: at stride boundaries only, logged in words, the same again in a replay."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import pytest
from replays import MS, SETTINGS, replay, same_outputs, trial, write_cut
from test_tuning_config import TUNED
from tuning_plant import stride

from fes.calibration.recording import calibrate_phase_sensors
from fes.config import Session, load_session
from fes.control.controller import Controller
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.signals import ImuSample, OperatorAct, OperatorAction, StimRequest, StimStatus, StrideResult
from statemachine.phases import Phase, PhaseChange, Transition

FOOT = "right_foot"
STRIDE_MS = 1400
CYCLE = (
    (200, Transition.T1, Phase.STANCE, Phase.PRE_SWING),
    (600, Transition.T2, Phase.PRE_SWING, Phase.SWING),
    (1100, Transition.T3, Phase.SWING, Phase.LOADING_RESPONSE),
    (1200, Transition.T4, Phase.LOADING_RESPONSE, Phase.STANCE),
)


@pytest.fixture(scope="module")
def calibrations() -> dict[str, FootCalibration]:
    return calibrate_phase_sensors(trial("example_csv")).calibrations


class WalkingFoot:
    """Stands in for the tracker: even strides, each closed with the heel rise after it, as the real one does."""

    def __init__(self, clearances_m: list[float]) -> None:
        self.foot, self.phase = FOOT, Phase.STANCE
        self._clearances_m = clearances_m

    def set_incline(self, incline: float) -> None:
        """Its strides are as they are."""

    def step(self, t_ns: int, acc_mps2: Any, gyr_radps: Any) -> list[PhaseChange | StrideResult]:
        number, ms = divmod(t_ns // MS, STRIDE_MS)
        outcomes: list[PhaseChange | StrideResult] = []
        for at_ms, transition, source, destination in CYCLE:
            if ms == at_ms:
                if transition is Transition.T1 and 0 < number <= len(self._clearances_m):
                    outcomes.append(stride(number - 1, self._clearances_m[number - 1]))
                self.phase = destination
                outcomes.append(PhaseChange(t_ns, FOOT, transition, source, destination))
        return outcomes


def tuned_session(mode: str = "act", **tuning: Any) -> Session:
    data = load_session(SETTINGS).model_dump()
    data["channels"][0]["tuning"] = {
        "mode": mode,
        "toe_clearance_m": {"low": 0.012, "high": 0.035},
        "bounds": {
            "current_ma": {"low": 10.0, "high": 36.0},
            "pulse_width_us": {"low": 200.0, "high": 350.0},
            "start_delay_s": {"low": 0.0, "high": 0.2},
            "extension_s": {"low": 0.0, "high": 0.1},
        },
    } | tuning
    data["stimulation"]["strides_before_start"] = 0
    return Session.model_validate(data)


class Walk:
    """The controller fed sample by sample, a stimulator that delivers what is asked for."""

    def __init__(self, session: Session, calibrations: dict[str, FootCalibration], clearances_m: list[float]) -> None:
        self.controller = Controller(session, calibrations)
        self.controller.trackers[FOOT] = cast(FootTracker, WalkingFoot(clearances_m))
        self.asked: list[tuple[int, StimRequest]] = []
        self.texts: list[str] = []

    def until(self, strides: int, acts: Iterable[OperatorAct] = ()) -> Walk:
        due = sorted(acts, key=lambda act: act.t_ns)
        for ms in range(0, strides * STRIDE_MS, 10):
            while due and due[0].t_ns <= ms * MS:
                act = due.pop(0)
                self.take(OperatorAct(ms * MS, act.action, act.value))
            self.take(ImuSample(ms * MS, FOOT, ms * MS, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)))
        return self

    def take(self, event: Any) -> None:
        decision = self.controller.step(event)
        self.texts += [report.text for report in decision.reports]
        for request in decision.requests:
            self.asked.append((event.t_ns, request))
            if request.on:
                charge_uc = request.current_ma * request.pulse_width_us * 1e-3
                levels = (request.current_ma, request.pulse_width_us, request.frequency_hz)
                self.controller.step(StimStatus(event.t_ns, request.channel, 0, True, *levels, 1, charge_uc))

    def peaks_ma(self) -> list[float]:
        """The greatest current of each stride's burst."""
        peaks: dict[int, float] = {}
        for t_ns, request in self.asked:
            number = t_ns // MS // STRIDE_MS
            peaks[number] = max(peaks.get(number, 0.0), request.current_ma)
        return [peaks[number] for number in sorted(peaks)]


def full(t_ms: int = 0) -> OperatorAct:
    return OperatorAct(t_ms * MS, OperatorAction.SET_INTENSITY, 1.0)


def test_a_foot_that_drags_gets_more_with_the_next_stride(calibrations: dict[str, FootCalibration]) -> None:
    walk = Walk(tuned_session(), calibrations, [0.002] * 8).until(7, [full()])
    # stride 0 was the first after standing; stride 1's result comes with the heel rise of stride 2
    assert walk.peaks_ma() == [30.0, 30.0, 32.0, 34.0, 36.0, 36.0, 36.0]
    assert any("toe clearance 2 mm (target 12–35), 22 mm is aimed at, more is needed" in text for text in walk.texts)


def test_within_a_burst_the_current_never_leaves_its_plateau(calibrations: dict[str, FootCalibration]) -> None:
    walk = Walk(tuned_session(), calibrations, [0.002] * 8).until(7, [full()])
    for number, peak_ma in enumerate(walk.peaks_ma()):
        plateau = [
            request.current_ma
            for t_ns, request in walk.asked
            if number * STRIDE_MS + 400 <= t_ns // MS <= number * STRIDE_MS + 1100
        ]
        assert set(plateau) == {peak_ma}


def test_suggesting_changes_nothing_until_a_person_accepts(calibrations: dict[str, FootCalibration]) -> None:
    accept = OperatorAct((5 * STRIDE_MS + 700) * MS, OperatorAction.ACCEPT_SUGGESTION, 0.0)
    walk = Walk(tuned_session("suggest"), calibrations, [0.002] * 9).until(8, [full(), accept])
    assert walk.peaks_ma() == [30.0] * 6 + [32.0] * 2  # accepted in mid-burst: the burst under way stays as it is
    assert any(text.startswith("suggested: ") for text in walk.texts)
    assert any("accepted by the operator" in text for text in walk.texts)


def test_freezing_and_rolling_back(calibrations: dict[str, FootCalibration]) -> None:
    freeze = OperatorAct(3 * STRIDE_MS * MS, OperatorAction.FREEZE_TUNING)
    back = OperatorAct(5 * STRIDE_MS * MS, OperatorAction.ROLL_BACK, 0.0)
    walk = Walk(tuned_session(), calibrations, [0.002] * 9).until(8, [full(), freeze, back])
    assert walk.peaks_ma() == [30.0, 30.0, 32.0, 32.0, 32.0, 30.0, 30.0, 30.0]


def test_an_act_of_tuning_does_not_end_a_burst(calibrations: dict[str, FootCalibration]) -> None:
    freeze = OperatorAct(800 * MS, OperatorAction.FREEZE_TUNING)
    walk = Walk(tuned_session(), calibrations, []).until(1, [full(), freeze])
    assert all(request.on for t_ns, request in walk.asked if 300 <= t_ns // MS <= 1100)


def test_without_tuning_the_charge_is_booked_all_the_same(calibrations: dict[str, FootCalibration]) -> None:
    session = tuned_session("off")
    walk = Walk(session, calibrations, [0.002] * 4).until(4, [full()])
    assert set(walk.peaks_ma()) == {30.0}
    assert not walk.texts
    dose = walk.controller.tuning.ledger.electrodes[0]
    assert len(dose.steps_uc) == 3
    assert dose.session_uc > sum(dose.steps_uc) > 0.0


def test_a_pulse_width_profile_reaches_the_stimulator(calibrations: dict[str, FootCalibration]) -> None:
    walk = Walk(tuned_session(method="learning"), calibrations, [0.002] * 8).until(7, [full()])
    widths = [max(r.pulse_width_us for t_ns, r in walk.asked if t_ns // MS // STRIDE_MS == n) for n in range(7)]
    assert widths[:3] == [300.0, 300.0, 320.0]
    assert max(widths) <= 350.0
    assert set(walk.peaks_ma()) == {30.0}


@pytest.mark.parametrize("mode", ["act", "suggest"])
def test_a_replay_with_tuning_is_the_same_twice_and_says_why(tmp_path: Path, mode: str) -> None:
    settings = tmp_path / "tuned.toml"
    geometry = (
        "\n[geometry.right_foot]\ntoe_forward_m = 0.13\ntoe_up_m = -0.06\nheel_forward_m = -0.13\nheel_up_m = -0.06\n"
    )
    settings.write_text(SETTINGS.read_text() + TUNED.replace("suggest", mode) + geometry)
    path = write_cut(tmp_path, 30.0)
    one, other = (replay(path, tmp_path / name, settings, stimulator="simulated") for name in ("one", "other"))
    notes = [note.text for note in one.notes if note.source == "tuning"]
    assert notes
    assert notes == [note.text for note in other.notes if note.source == "tuning"]
    assert same_outputs(one, other)
    peaks = {command.current_ma for command in one.commands if command.on}
    assert max(peaks) <= 36.0
    if mode == "suggest":
        assert max(peaks) == 30.0
        assert any("suggested" in note for note in notes)
    else:
        assert any("→" in note for note in notes)
