"""Is this foot known to be walking: each rule of the judge alone, then real ways of not walking."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from test_plan import ENDS

from fes.calibration.recording import calibrate_phase_sensors
from fes.config import Stimulation
from fes.control.controller import Controller
from fes.control.replay import session_for
from fes.recording import read_recording
from fes.recording.tracks import samples_of
from fes.signals import StrideResult
from fes.simulation.truth import load_truth
from fes.stimulation.walking import WalkingJudge
from statemachine.phases import PhaseChange, Transition

FOOT = "right_foot"
FOLDER = Path(__file__).resolve().parents[2] / "sim_inputs"


def stride(length_m: float = 1.0, turn_deg: float = 0.0, reason: str = "", number: int = 1) -> StrideResult:
    return StrideResult(
        foot=FOOT, number=number, t_start_ns=0, t_end_ns=1_000_000_000, stride_length_m=length_m, clearance_m=0.1,
        height_gained_m=0.0, turn_rad=math.radians(turn_deg), speed_mps=length_m, t_pre_swing_ns=None, t_swing_ns=None,
        t_loading_response_ns=None, t_stance_ns=None, valid=not reason, reason=reason,
    )  # fmt: skip


class Judged:
    """A judge and the time of its foot."""

    def __init__(self, **settings: float) -> None:
        self.judge = WalkingJudge(Stimulation.model_validate({"strides_before_start": 2} | settings))
        self.now_s = 0.0

    def go(self, transition: Transition, after_s: float = 0.0) -> bool:
        self.now_s += after_s
        return self.judge.on_phase(PhaseChange(round(self.now_s * 1e9), FOOT, transition, *ENDS[transition]))

    def step(self, result: StrideResult | None = None, stance_s: float = 0.5, end: Transition = Transition.T4) -> bool:
        """One stride as a tracker reports it: at T1 the stride before is closed first. Returns what T1 was answered."""
        self.now_s += stance_s
        if result is not None:
            self.judge.on_stride(result)
        permitted = self.go(Transition.T1)
        self.go(Transition.T2, 0.2)
        if end is Transition.T4:
            self.go(Transition.T3, 0.4)
        self.go(end, 0.1)
        return permitted


def walking(strides: int = 5, **settings: float) -> Judged:
    """A foot that has been walking with stances of half a second."""
    judged = Judged(**settings)
    judged.step()
    for _ in range(strides):
        judged.step(stride())
    assert judged.judge.walking
    return judged


def test_nobody_walks_before_a_stride_is_seen() -> None:
    judged = Judged()
    assert not judged.judge.walking
    assert judged.judge.reason == "no stride yet"
    assert not judged.step()


@pytest.mark.parametrize("needed", [1, 2, 5])
def test_that_many_good_strides_in_a_row(needed: int) -> None:
    judged = Judged(strides_before_start=needed)
    answers = [judged.step(stride() if k else None) for k in range(needed + 2)]
    assert answers == [False] * needed + [True, True]


def test_a_bad_stride_starts_the_count_again() -> None:
    judged = Judged(strides_before_start=3)
    answers = [judged.step(s) for s in (None, stride(), stride(), stride(0.1), stride(), stride(), stride(), stride())]
    assert answers == [False] * 6 + [True, True]


def test_none_needed_is_always_permitted() -> None:
    judged = Judged(strides_before_start=0)
    assert judged.step()
    assert judged.step(stride(0.01))


@pytest.mark.parametrize(
    ("settings", "result", "why"),
    [
        ({}, stride(0.149), "stride of 0.15 m"),
        ({}, stride(0.15), ""),
        ({"min_stride_length_m": 0.6}, stride(0.5), "stride of 0.50 m"),
        ({"min_stride_length_m": 0.4}, stride(0.5), ""),
        *(({}, stride(0.49, turn_deg), "") for turn_deg in (34.9, -34.9)),  # usual are strides of a metre
        ({}, stride(0.49, 35.1), "turned by 35°"),
        ({}, stride(0.49, -60.0), "turned by 60°"),
        ({"max_turn_deg": 90.0}, stride(0.3, 80.0), ""),
        ({}, stride(reason="samples missing for 60 ms", number=9), "stride 9 samples missing for 60 ms"),
    ],
)
def test_which_stride_is_none_of_walking(settings: dict[str, float], result: StrideResult, why: str) -> None:
    judged = walking(**settings)
    assert judged.step(result) is not bool(why)
    if why:
        assert judged.judge.reason == why


def test_a_curve_is_walked_on_but_begins_no_walk() -> None:
    judged = walking()
    assert all(judged.step(stride(0.5, turn_deg)) for turn_deg in (60.0, -120.0, 90.0))
    assert not judged.step(stride(0.49, 60.0))
    assert [judged.step(each) for each in (stride(0.9, 60.0), stride(), stride())] == [False, False, True]


def test_a_curves_short_strides_do_not_become_usual() -> None:
    judged = walking()
    for _ in range(9):
        judged.step(stride(0.5, 60.0))
    assert not judged.step(stride(0.3, 60.0))


def test_curves_alone_are_no_walk() -> None:
    judged = Judged(strides_before_start=1)
    assert not any(judged.step(stride(1.0, 60.0) if k else None) for k in range(6))


@pytest.mark.parametrize(("stance_s", "good"), [(2.99, True), (3.01, False)])
def test_after_three_seconds_a_pause_is_a_stop(stance_s: float, good: bool) -> None:
    judged = walking()
    assert judged.step(stride(), stance_s) is good
    if not good:
        assert judged.judge.reason == "stood for 3.0 s"
    else:
        assert judged.judge.walking
        assert judged.step(stride())


def test_a_pause_does_not_become_usual() -> None:
    judged = walking()
    for _ in range(6):
        judged.step(stride(), 2.5)
    assert stands_from(judged) == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize(("stance_s", "good"), [(3.5, True), (3.7, False)])
def test_who_walks_very_slowly_may_stand_for_longer(stance_s: float, good: bool) -> None:
    judged = Judged()
    for k in range(6):
        judged.step(stride() if k else None, 2.0)
    assert judged.step(stride(), stance_s) is good


def test_usual_is_the_median_of_the_last_five() -> None:
    judged = walking(6)
    for stance_s in (0.6, 0.6, 0.6, 0.6, 0.6):
        assert judged.step(stride(), stance_s)
    assert judged.step(stride(), 1.0)  # 1.67 times 0.6 s; twice the 0.5 s of before
    assert stands_from(judged) == pytest.approx(1.08, abs=0.02)


def test_after_a_stop_strides_are_counted_anew_and_stances_learnt_anew() -> None:
    judged = walking()
    assert not judged.step(stride(), 5.0)
    assert [judged.step(stride(), 1.0) for _ in range(3)] == [False, True, True]  # slower now, and that is usual


def test_a_lifted_heel_does_not_begin_a_new_stance() -> None:
    """Standing with a heel lifted now and then is standing: the stance is counted from the landing."""
    judged = walking()
    judged.judge.on_stride(stride())
    assert judged.go(Transition.T1, 0.5)
    judged.go(Transition.T5, 0.3)
    assert not judged.go(Transition.T1, 2.4)
    assert judged.judge.reason == "stood for 3.2 s"


def test_a_soft_landing_is_a_landing() -> None:
    judged = walking()
    assert judged.step(stride(), end=Transition.T6)
    assert judged.step(stride(), 0.5)
    assert not judged.step(stride(), 3.5)


def test_lost_data_are_a_stop() -> None:
    judged = walking()
    assert not judged.go(Transition.NONE, 0.5)
    assert judged.judge.reason == "data were lost"
    assert [judged.step(stride()) for _ in range(3)] == [False, True, True]


# --- recordings ------------------------------------------------------------------------------------------


def judged_recording(name: str) -> dict[str, list[tuple[float, bool]]]:
    """Per foot: each T1's time (s) and whether a burst was permitted."""
    recording = read_recording(FOLDER / f"{name}.parquet")
    calibrations = calibrate_phase_sensors(recording).calibrations
    controller = Controller(session_for(recording, None), calibrations)
    answers: dict[str, list[tuple[float, bool]]] = {}
    for foot, tracker in controller.trackers.items():
        judge = WalkingJudge(Stimulation())
        track = recording.tracks[foot]
        answers[foot] = []
        for outcome in tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps):
            if isinstance(outcome, StrideResult):
                judge.on_stride(outcome)
                continue
            permitted = judge.on_phase(outcome)
            if outcome.transition is Transition.T1:
                answers[foot].append((1e-9 * outcome.t_ns, permitted))
    return answers


def test_no_burst_while_standing_turning_sitting_and_on_lifted_heels() -> None:
    walks = [a for a in load_truth(FOLDER / "not_walking.parquet").activities if a.walking]
    assert len(walks) == 1
    for foot, answers in judged_recording("not_walking").items():
        permitted = [t for t, permitted in answers if permitted]
        assert permitted, foot
        assert all(walks[0].start_s <= t <= walks[0].end_s for t in permitted), foot
        in_walk = [permitted for t, permitted in answers if walks[0].start_s <= t <= walks[0].end_s]
        assert np.count_nonzero(in_walk) >= 6, foot
        assert len(answers) - len(in_walk) >= 8, foot  # there was something to refuse


@pytest.mark.parametrize("name", ["negard_patient1", "negard_patient2", "both_feet_200hz", "soft_contact"])
def test_who_walks_is_permitted_from_the_second_stride_on(name: str) -> None:
    for answers in judged_recording(name).values():
        permitted = [permitted for _, permitted in answers]
        assert not permitted[0]
        assert np.mean(permitted[2:]) > 0.95


def test_strides_are_closed_before_the_heel_rise_that_closes_them_is_judged() -> None:
    """The maker hands over the stride at T1, so that it counts for the burst which this T1 may start."""
    recording = read_recording(FOLDER / "negard_patient1.parquet")
    calibrations = calibrate_phase_sensors(recording).calibrations
    tracker = Controller(session_for(recording, None), calibrations).trackers[FOOT]
    track = recording.tracks[FOOT]
    outcomes = tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    followers = [
        b.transition for a, b in pairwise(outcomes) if isinstance(a, StrideResult) and isinstance(b, PhaseChange)
    ]
    assert len(followers) == 39  # all but the last stride, which the timer closes
    assert set(followers) == {Transition.T1}


def test_a_foot_that_stirs_just_after_landing_starts_no_burst_and_goes_on_walking() -> None:
    feet = Judged(strides_before_start=2)
    for number in range(1, 5):
        feet.step(stride(number=number), stance_s=0.5)
    assert not feet.go(Transition.T1, 0.05)  # the heel settles: a tenth of the usual stance
    feet.go(Transition.T5, 0.1)
    assert feet.go(Transition.T1, 0.35)  # the real heel rise, half a second after landing


# --- standing is noticed ---------------------------------------------------------------------------------


def stands_from(judged: Judged, at_most_s: float = 10.0) -> float:
    """How long after the last phase change the judge says that the foot does not walk."""
    began_s = judged.now_s
    while judged.judge.walking and judged.now_s - began_s < at_most_s:
        judged.now_s += 0.01
        judged.judge.on_time(round(judged.now_s * 1e9))
    return judged.now_s - began_s


def test_who_walks_faster_after_one_long_stance_is_permitted_from_the_next_stride_on() -> None:
    """The stance after the first step of all is a standing one; a swing that follows a shorter one tells."""
    judged = Judged(strides_before_start=1)
    judged.step()
    judged.step(stride(), stance_s=1.5)
    assert [judged.step(stride(), stance_s=0.4) for _ in range(4)] == [False, True, True, True]


def test_a_stance_that_lasts_ends_walking_though_no_step_comes() -> None:
    judged = walking()  # with stances of half a second
    assert stands_from(judged) == pytest.approx(0.9, abs=0.02)
    assert judged.judge.reason == "stands for 0.9 s"
    judged.judge.on_stride(stride())  # closed by its timer, as nobody steps on
    assert not judged.judge.walking
    assert not judged.go(Transition.T1, 5.0)  # the stride before the stop says nothing of the one after it
    assert judged.judge.reason.startswith("stood for ")


def test_who_walks_on_is_never_said_to_stand() -> None:
    judged = walking()
    for _ in range(5):
        judged.judge.on_stride(stride())
        for transition, after_s in (
            (Transition.T1, 0.85),
            (Transition.T2, 0.9),
            (Transition.T3, 0.9),
            (Transition.T4, 0.9),
        ):
            for _ in range(round(after_s / 0.01)):
                judged.now_s += 0.01
                judged.judge.on_time(round(judged.now_s * 1e9))
                assert judged.judge.walking
            assert judged.go(transition)


@pytest.mark.parametrize("phases", [(), ("T1",), ("T1", "T2"), ("T1", "T2", "T3")])
def test_no_phase_of_walking_lasts_three_seconds(phases: tuple[str, ...]) -> None:
    judged = walking()
    for name in phases:
        judged.go(Transition[name], 0.2)
    assert stands_from(judged) < 3.02


def test_the_first_stride_alone_knows_no_usual_stance_and_ends_walking_after_three_seconds() -> None:
    judged = Judged(strides_before_start=1)
    judged.step()
    judged.judge.on_stride(stride())
    assert judged.judge.walking
    assert stands_from(judged) == pytest.approx(3.0, abs=0.02)
    assert not judged.go(Transition.T1, 10.0)


def test_a_heel_lifted_in_standing_is_standing() -> None:
    judged = walking()
    stands_from(judged)
    for _ in range(3):
        assert not judged.go(Transition.T1, 3.0)
        judged.go(Transition.T5, 0.3)
        assert not judged.judge.walking


def test_where_no_strides_are_asked_for_every_step_is_permitted_and_standing_is_noticed_all_the_same() -> None:
    judged = Judged(strides_before_start=0)
    assert not judged.judge.walking
    assert judged.go(Transition.T1, 1.0)
    judged.go(Transition.T2, 0.2)
    assert judged.judge.walking
    judged.go(Transition.T6, 0.5)
    assert stands_from(judged) < 3.02
    assert judged.go(Transition.T1, 10.0)


def test_after_the_walk_of_a_recording_both_feet_stand() -> None:
    recording = read_recording(FOLDER / "not_walking.parquet")
    walk = next(a for a in load_truth(FOLDER / "not_walking.parquet").activities if a.walking)
    controller = Controller(session_for(recording, None), calibrate_phase_sensors(recording).calibrations)
    walked, walks_after = set(), {}
    for event in samples_of(recording, set(recording.tracks)):
        controller.step(event)
        for foot in controller.trackers:
            if controller.walking(foot):
                walked.add(foot)
                walks_after[foot] = 1e-9 * event.t_ns - walk.end_s
    assert walked == set(controller.trackers)
    assert all(after_s < 3.0 for after_s in walks_after.values()), walks_after
