"""Does the machine see this foot's cycle: each rule of the judge alone, then feet whose cycle it does not see."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_plan import ENDS

from fes.calibration.recording import calibrate_phase_sensors, save
from fes.config import Stimulation
from fes.control.controller import Controller
from fes.control.replay import session_for
from fes.estimation.foot.calibration import FootCalibration
from fes.recording.tracks import samples_of
from fes.report.findings import findings, session_json
from fes.report.summary import summarise
from fes.signals import StrideResult
from fes.stimulation.order import AGAIN, ALIKE, CLOSES_SD, KNOWN, KNOWN_FROM, OrderJudge
from fes.stimulation.walking import WalkingJudge
from statemachine.phases import PhaseChange, Transition
from tests.replays import replay, trial

FOOT = "left_foot"
T = Transition
CYCLE = (T.T1, T.T2, T.T3, T.T4)
GONE = (T.T1, T.T2, T.T6)
PUT_BACK = (T.T1, T.T5)


def stride(length_m: float = 1.0, reason: str = "", *, valid: bool | None = None) -> StrideResult:
    sound = not reason if valid is None else valid
    return StrideResult(FOOT, 1, 0, 1_000_000_000, length_m, turn_rad=0.0, valid=sound, reason=reason)


class Foot:
    """A foot whose judge is told of one cycle after the other."""

    def __init__(self, least_m: float = 0.15) -> None:
        self.walking = WalkingJudge(Stimulation(strides_before_start=0, min_stride_length_m=least_m))
        self.now_s = 0.0

    @property
    def order(self) -> OrderJudge:
        return self.walking.order

    def go(
        self,
        fired: tuple[Transition, ...] = CYCLE,
        result: StrideResult | None = None,
        cycle_s: float = 1.2,
        each_s: float = 0.1,
    ) -> bool:
        """One cycle from its heel rise on, then its stride. Whether a burst might begin with it."""
        permitted = [self._change(each, each_s * k) for k, each in enumerate(fired)]
        self.now_s += cycle_s
        self.walking.on_stride(result or stride())
        return permitted[0]

    def _change(self, each: Transition, after_s: float) -> bool:
        return self.walking.on_phase(PhaseChange(round((self.now_s + after_s) * 1e9), FOOT, each, *ENDS[each]))


@pytest.mark.parametrize("after_s", [0.6, 0.8, 1.6, 2.4])
def test_another_speed_is_no_disorder(after_s: float) -> None:
    foot = Foot()
    for cycle_s in [1.2] * 12 + [after_s] * 12:
        foot.go(cycle_s=cycle_s)
        assert foot.order.in_order


def test_what_was_usual_long_ago_does_not_excuse_a_foot_without_rhythm() -> None:
    foot = Foot()
    for cycle_s in [1.2] * 10 + [3.2, 4.7, 6.5] * 4:  # longer than a stop would be told from
        foot.go(cycle_s=cycle_s)
    assert not foot.order.in_order
    assert "came out of rhythm" in foot.order.reason


@pytest.mark.requirement("SR-25")
@pytest.mark.parametrize(
    ("poor", "words"),
    [
        ({"result": stride(reason="went backward by -1.00 m")}, "4 did not travel"),
        ({"result": stride(0.09)}, "4 did not travel"),
        ({"fired": GONE}, "4 skipped a phase"),
    ],
)
def test_four_poor_swings_of_the_last_six_end_order_and_three_sound_ones_restore_it(
    poor: dict[str, Any], words: str
) -> None:
    foot = Foot()
    for sound in (True, False, False, True, False, False):
        assert foot.go(**({} if sound else poor))
        assert foot.order.in_order
    assert not foot.go()  # at this heel rise the last of them is known
    assert foot.order.reason == f"of its last 6 swings {words}"
    assert not foot.walking.walking
    assert "in disorder" in foot.walking.describe()
    assert [foot.go(), foot.go(**poor), foot.go(), foot.go(), foot.go()] == [False] * 5
    assert foot.go()
    assert foot.order.in_order
    assert foot.order.reason == ""
    assert all(foot.go(**poor) for _ in range(4)), "nothing from before counts"


def test_cycles_that_differ_by_a_quarter_are_no_cycles() -> None:
    foot = Foot()
    for cycle_s in (1.2, 1.2, 1.2, 1.45, 1.45, 0.95, 0.95):
        foot.go(cycle_s=cycle_s)
    foot.go()
    assert foot.order.in_order
    for cycle_s in (1.6, 0.8, 1.6, 0.8, 1.2):
        foot.go(cycle_s=cycle_s)
    foot.go()
    assert foot.order.reason == "of its last 6 swings 4 came out of rhythm"


@pytest.mark.parametrize(
    "unjudged",
    [
        {"result": stride(reason="samples missing for 60 ms")},
        {"fired": PUT_BACK},
        {"fired": (T.T1, T.T2, T.NONE)},
        {"cycle_s": 4.0},
        {"result": stride(1.0, "no true rest: 1.0 rad/s at its quietest", valid=True)},
    ],
)
def test_gaps_stops_and_heels_put_back_say_nothing(unjudged: dict[str, Any]) -> None:
    foot = Foot()
    for _ in range(4):
        foot.go()
    for _ in range(8):
        foot.go(**unjudged)
        foot.go()
        foot.go()
    assert foot.order.in_order


@pytest.mark.parametrize(("least_m", "in_order"), [(0.15, False), (0.04, True)])
def test_a_session_for_short_strides_counts_them(least_m: float, in_order: bool) -> None:
    foot = Foot(least_m)
    for _ in range(7):
        foot.go(result=stride(0.06))
    assert foot.order.in_order is in_order


# --- feet that walk ---------------------------------------------------------------------------------------------------


def reversed_axis(calibration: object) -> FootCalibration:
    assert isinstance(calibration, FootCalibration)
    x, y, z = calibration.toe_down
    return replace(calibration, toe_down=(-x, -y, -z))


@pytest.mark.parametrize("name", ["negard_patient1", "negard_patient2", "both_feet_200hz", "soft_contact"])
def test_trials_in_order_are_never_named(name: str) -> None:
    recording = trial(name)
    calibrations = calibrate_phase_sensors(recording).calibrations
    controller = Controller(session_for(recording, None), calibrations)
    for sample in samples_of(recording, set(calibrations)):
        assert not controller.step(sample).notes
    assert controller.in_disorder() == []


@pytest.mark.requirement("SR-25")
def test_a_reversed_axis_is_named_once_logged_reported_and_no_burst_begins(tmp_path: Path) -> None:
    recording = trial("negard_patient2")
    stored = calibrate_phase_sensors(recording)
    calibration = tmp_path / "reversed.json"
    save(
        replace(stored, calibrations={sensor: reversed_axis(each) for sensor, each in stored.calibrations.items()}),
        calibration,
    )
    path = recording.path
    assert path is not None
    record = replay(path, tmp_path, calibration=calibration)
    told = [note for note in record.notes if note.source == "phases"]
    assert [note.severity for note in told] == ["warning"]
    assert "in disorder: of its last 4 swings 4 did not travel" in told[0].text
    swings = [c for c in record.phases if c.transition is T.T2 and c.t_ns <= told[0].t_ns]
    assert len(swings) <= 5
    assert not any(command.on and command.t_ns > told[0].t_ns for command in record.commands)
    summary = summarise(record)
    assert any(each.level == "warning" and "came into disorder" in each.text for each in findings(summary))
    assert "in disorder" in json.dumps(session_json(summary))


# --- a sensor that changes --------------------------------------------------------------------------------------------


def closing(off: float = 0.0, at: int = 0, seed: int = 0) -> StrideResult:
    """A stride that closes as this person's do, and ``off`` standard deviations of people elsewhere in one number."""
    noise = np.random.default_rng(seed).normal(size=5) * 0.3
    noise[at] += off
    left = (noise * CLOSES_SD).tolist()
    return replace(stride(), left_over=(*left[:3], 0.3, *left[3:]))  # the height may be anything


def walked(strides: int = KNOWN) -> Foot:
    foot = Foot()
    for k in range(strides):
        foot.go(result=closing(seed=k))
    return foot


@pytest.mark.requirement("SR-25")
@pytest.mark.parametrize("at", range(5))
def test_strides_that_close_elsewhere_stop_bursts(at: int) -> None:
    foot = walked()
    permitted = [foot.go(result=closing(30.0, at, 100 + k)) for k in range(ALIKE + 2)]
    assert permitted == [True] * ALIKE + [False] * 2
    assert "do not come to rest" in foot.order.describe()
    assert "pause and go on" in foot.order.describe()


def test_one_stumble_stops_nothing() -> None:
    foot = walked()
    for k in range(12):
        assert foot.go(result=closing(50.0 * (k % 3 == 0), k % 5, 200 + k))


OTHERWISE = pytest.mark.parametrize(("off", "each_s"), [(30.0, 0.1), (0.0, 0.3)], ids=["elsewhere", "ended late"])


def test_they_begin_again_when_strides_close_as_before() -> None:
    foot = walked()
    for k in range(8):
        foot.go(result=closing(30.0, 0, 100 + k))
    assert not foot.order.in_order
    for k in range(5):
        foot.go(result=closing(seed=300 + k))
    assert foot.order.in_order


@OTHERWISE
def test_what_lies_does_not_become_usual(off: float, each_s: float) -> None:
    foot = walked()
    for k in range(60):
        foot.go(result=closing(off, 0, 100 + k), each_s=each_s)
    assert not foot.order.in_order
    assert "pause and go on" in foot.order.describe()


@OTHERWISE
def test_a_person_who_arms_takes_the_walk_as_it_is(off: float, each_s: float) -> None:
    foot = walked()
    for k in range(8):
        foot.go(result=closing(off, 0, 100 + k), each_s=each_s)
    assert not foot.order.in_order
    foot.order.begin_anew()
    for k in range(5):
        foot.go(result=closing(off, 0, 400 + k), each_s=each_s)
    assert foot.order.in_order


def test_nobody_is_judged_by_few_strides_or_none() -> None:
    foot = walked(KNOWN_FROM - ALIKE)
    for k in range(2 * ALIKE - 1):
        assert foot.go(result=closing(30.0, 0, 100 + k))
    shank = Foot()
    for _ in range(KNOWN):
        assert shank.go()


def test_swings_whose_end_is_not_seen_stop_bursts_until_they_end_in_time() -> None:
    foot = walked()
    for _ in range(ALIKE):
        foot.go(each_s=0.3)
        assert foot.order.in_order
    assert not foot.go(each_s=0.3)
    assert "3 strides ended late" in foot.order.describe()
    for k in range(AGAIN + 1):
        foot.go(result=closing(seed=200 + k))
    assert foot.order.in_order


@pytest.mark.parametrize("slower", [1.5, 1.6, 1.8])
def test_a_slower_walk_ends_its_swings_in_time(slower: float) -> None:
    foot = walked()
    for k in range(20):
        foot.go(result=closing(seed=500 + k), cycle_s=1.2 * slower, each_s=0.1 * slower)
        assert foot.order.in_order


def test_going_on_forgets_nothing_of_a_foot_in_order() -> None:
    foot = walked()
    foot.order.begin_anew()
    for k in range(ALIKE + 2):
        foot.go(result=closing(30.0, 0, 100 + k))
    assert not foot.order.in_order


def test_a_solution_that_is_no_number_is_far_off() -> None:
    foot = walked()
    for _ in range(ALIKE + 2):
        foot.go(result=replace(stride(), left_over=(math.nan,) * 6))
    assert not foot.order.in_order
