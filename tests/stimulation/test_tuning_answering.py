"""A foot that does not answer, for its electrode has come off, is not given ever more; one that answers late is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from random import Random

import numpy as np
import pytest
from tuning_plant import BAND, BOUNDS, channel, charge_of, stride, tuning

from fes.config import Band, Tuning
from fes.config import Session as Settings
from fes.signals import OperatorAct, OperatorAction
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.answering import LIKE_NONE, NO_ANSWER, AnswerMonitor
from fes.stimulation.tuning.guardrails import spent
from fes.stimulation.tuning.report import TuningReport
from fes.stimulation.tuning.response import Known, ResponseModel
from fes.stimulation.tuning.session import Tuners
from fes.stimulation.tuning.targets import PITCH as TOE_UP
from fes.stimulation.tuning.targets import Measure, Reading
from fes.stimulation.tuning.tuner import Tuner

SECOND = 1_000_000_000
PITCH = {"low": 4.0, "high": 25.0}


@dataclass
class Foot:
    """Clearance and pitch at contact from the drive that reaches the nerve; ``gained`` by the drive, in bands."""

    quality: float = 1.0
    threshold: float = 0.5
    saturation: float = 2.0
    bare: float = -0.5
    slope: float = 2.0
    noise: float = 0.04
    seed: int = 1
    fitness: float = 1.0
    tires: float = 0.0
    drags: bool = False
    _random: Random = field(init=False)

    def __post_init__(self) -> None:
        self._random = Random(self.seed)

    def walk(self, number: int, drive: float) -> tuple[float, float]:
        """Toe clearance in m and pitch at contact in °."""
        reached = min(max(self.quality * drive, self.threshold), self.saturation) - self.threshold
        level = self.bare + self.slope * self.fitness * reached
        self.fitness -= self.tires
        toe = level + self._random.gauss(0.0, 4.0 * self.noise)
        pitch = level + self._random.gauss(0.0, self.noise)
        if self.drags and number % 5 == 4:
            pitch -= 2.0  # a stumble: the foot falls
        return (
            max(BAND["low"] + toe * (BAND["high"] - BAND["low"]), 0.0),
            PITCH["low"] + pitch * (PITCH["high"] - PITCH["low"]),
        )


@dataclass
class Session:
    """A tuner and a foot; what was in force and what was said."""

    foot: Foot
    tuner: Tuner
    parameters: list[BurstParameters] = field(default_factory=list)
    reports: list[TuningReport] = field(default_factory=list)
    number: int = 0

    def walk(self, strides: int, *, stimulated: bool = True) -> Session:
        for _ in range(strides):
            now = self.tuner.parameters
            self.parameters.append(now)
            toe_m, pitch_deg = self.foot.walk(self.number, self.tuner.drive if stimulated else 0.0)
            walked = stride(self.number, toe_m, pitch_deg)
            charge_uc = charge_of(now) if stimulated else 0.0
            report = self.tuner.observe(self.number * SECOND, walked, charge_uc, 1.0 if stimulated else 0.0)
            if report is not None:
                self.reports.append(report)
            self.number += 1
        return self

    def said(self, words: str) -> list[TuningReport]:
        return [report for report in self.reports if words in report.text]

    @property
    def stopped(self) -> bool:
        return bool(self.said("tuning has stopped"))


def begun(foot: Foot, tuned: Tuning | None = None, **changes: object) -> Session:
    tuned = tuned or tuning(pitch_at_contact_deg=PITCH, **changes)
    return Session(foot, Tuner(channel(tuned)))


def strength(parameters: BurstParameters) -> float:
    return parameters.current_ma * max(parameters.widths_us)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("drags", [False, True])
@pytest.mark.parametrize("method", ["run_to_run", "learning"])
def test_no_answer_at_all_goes_back_and_stops(method: str, drags: bool, seed: int) -> None:
    done = begun(Foot(quality=0.0, drags=drags, seed=seed), method=method).walk(40)
    start = done.tuner.start
    assert done.tuner.frozen == f"{NO_ANSWER}: look at the electrodes"
    stop = done.said(f"{NO_ANSWER}: look at the electrodes; tuning has stopped and goes back")
    assert len(stop) == 1
    assert stop[0].severity == "warning"
    assert strength(done.tuner.parameters) <= strength(start)
    assert strength(done.parameters[-15]) <= strength(start)  # and long since
    for before, after in pairwise(done.parameters):
        assert abs(after.current_ma - before.current_ma) <= 2.0 + 1e-9
        assert all(abs(b - a) <= 20.0 + 1e-9 for a, b in zip(before.widths_us, after.widths_us, strict=True))


@pytest.mark.parametrize("act", [OperatorAction.FREEZE_TUNING, OperatorAction.SET_INTENSITY])
@pytest.mark.parametrize("method", ["run_to_run", "learning"])
def test_on_its_way_back_it_is_not_stopped_where_it_had_climbed_to(method: str, act: OperatorAction) -> None:
    """Another channel's tuning may be frozen meanwhile; when the electrode is put back, it gets no more for that."""
    done = begun(Foot(quality=0.0), method=method)
    while not done.stopped:
        done.walk(1)
    assert strength(done.tuner.parameters) > strength(done.tuner.start)
    own = channel(done.tuner.tuning)
    tuners = Tuners(Settings(name="a walk", channels=(own, own.model_copy(update={"number": 1}))))
    tuners.tuners[0] = done.tuner
    tuners.on_act(OperatorAct(0, OperatorAction.SET_INTENSITY, 1.0))
    tuners.on_act(OperatorAct(0, act, 0.5))
    assert tuners.tuners[1].frozen
    done.walk(12)
    assert strength(done.tuner.parameters) <= strength(done.tuner.start)
    assert done.tuner.frozen == f"{NO_ANSWER}: look at the electrodes"


def test_put_back_and_told_to_go_on_it_starts_from_the_sessions_settings_and_from_what_it_sees() -> None:
    done = begun(Foot(quality=0.0)).walk(40)
    done.foot.quality = 1.0
    done.walk(10)
    assert strength(done.tuner.parameters) <= strength(done.tuner.start)  # stopped is stopped
    done.tuner.resume(done.number * SECOND)
    first = len(done.parameters)
    done.walk(20)
    soon = done.parameters[first : first + 5]  # what was learnt from the lost foot would ask for more
    assert max(map(strength, soon)) <= strength(done.tuner.start)
    assert not done.tuner.frozen


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("method", ["run_to_run", "learning"])
@pytest.mark.parametrize(
    "foot",
    [
        Foot(threshold=1.15, slope=3.5),  # nothing below the threshold: a session set too low
        Foot(threshold=0.6, saturation=1.1, slope=0.8),  # near saturation: gains a little, reaches nothing
        Foot(slope=1.0, bare=-0.6),  # answers weakly
        Foot(slope=1.2, tires=0.003),
        Foot(slope=1.2, drags=True),
        Foot(bare=-0.2, slope=0.5),  # weaker than believed, but it answers
    ],
    ids=["late", "saturated", "weak", "tiring", "stumbling", "weakest"],
)
def test_who_answers_late_or_little_is_not_given_up(foot: Foot, method: str, seed: int) -> None:
    fresh = Foot(
        threshold=foot.threshold, saturation=foot.saturation, bare=foot.bare, slope=foot.slope, tires=foot.tires,
        drags=foot.drags, seed=seed,
    )  # fmt: skip
    done = begun(fresh, method=method).walk(3, stimulated=False).walk(60)
    assert not done.stopped
    assert strength(done.tuner.parameters) > strength(done.tuner.start)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("quality", [1.0, 0.0])
@pytest.mark.parametrize(
    ("method", "low"),
    [("run_to_run", {"current_ma": 10.0}), ("learning", {"pulse_width_us": 100.0})],
)
def test_a_foot_that_does_not_answer_below_its_threshold_is_searched_for_upwards(
    method: str, low: dict[str, float], quality: float, seed: int
) -> None:
    """Begun at a quarter of the bound, nothing answers below half of it; a lost foot stops it all the same."""
    tuned = tuning(pitch_at_contact_deg=PITCH, method=method, max_change_ma=5.0, max_change_us=50.0)
    foot = Foot(quality=quality, threshold=2.2, saturation=6.0, slope=1.2, seed=seed)
    done = Session(foot, Tuner(channel(tuned, **low))).walk(3, stimulated=False).walk(40)
    assert done.stopped == (quality == 0.0)
    if quality:
        now = done.tuner.drive
        assert -0.5 + 1.2 * (now - 2.2) > 0.0
        assert strength(done.parameters[3 + 8]) > 2.2 * strength(done.tuner.start)
    else:
        assert strength(done.tuner.parameters) <= strength(done.tuner.start)
    for before, after in pairwise(done.parameters):
        assert abs(after.current_ma - before.current_ma) <= 5.0 + 1e-9
        assert all(abs(b - a) <= 50.0 + 1e-9 for a, b in zip(before.widths_us, after.widths_us, strict=True))


@pytest.mark.parametrize("method", ["run_to_run", "learning"])
def test_an_electrode_that_falls_off_in_a_good_walk(method: str) -> None:
    done = begun(Foot(), method=method).walk(6, stimulated=False).walk(20)
    assert not done.tuner.frozen
    at = len(done.parameters)
    done.foot.quality = 0.0
    done.walk(30)
    assert done.stopped
    assert "look at the electrodes" in done.tuner.frozen
    assert strength(done.tuner.parameters) <= strength(done.tuner.start)
    most = max(map(strength, done.parameters[at:]))
    assert most <= 1.5 * strength(done.parameters[at])


def test_what_has_come_off_is_named_and_the_tuning_stops_before_long() -> None:
    done = begun(Foot(slope=1.2)).walk(6, stimulated=False).walk(10)  # a climb, with more to come …
    assert strength(done.tuner.parameters) > 1.1 * strength(done.tuner.start)
    done.foot.quality = 0.0
    done.walk(20)
    assert done.said("most likely the electrodes")
    assert len(done.said("look at the electrodes; tuning has stopped")) == 1
    assert strength(done.tuner.parameters) <= strength(done.tuner.start)


@pytest.mark.parametrize("quality", [0.7, 0.8])
@pytest.mark.parametrize("method", ["run_to_run", "learning"])
def test_an_electrode_that_loosens_is_made_up_for(method: str, quality: float) -> None:
    done = begun(Foot(slope=2.5), method=method).walk(6, stimulated=False).walk(20)
    done.foot.quality = quality
    done.walk(30)
    assert not done.stopped
    assert strength(done.tuner.parameters) > strength(done.tuner.start)


def test_suggestions_stop_and_nothing_moves_without_a_person() -> None:
    done = begun(Foot(quality=0.0), mode="suggest")
    for _ in range(25):
        done.walk(1)
        before = done.tuner.parameters
        if done.tuner.pending is not None:
            done.tuner.accept(done.number * SECOND)
        if done.stopped:
            break
    assert done.stopped
    assert done.tuner.parameters == before
    assert done.tuner.pending is None
    done.walk(10)
    assert done.tuner.parameters == before


def test_not_reached_below_the_bound_is_not_said_to_be_at_it() -> None:
    tuned = tuning(pitch_at_contact_deg=PITCH, bounds=BOUNDS | {"pulse_width_us": {"low": 300.0, "high": 300.0}})
    tuner = Tuner(channel(tuned))
    reports = []
    for number in range(30):  # the toe is up already, the heel does not come first: one current for both
        walked = stride(number, 0.0345, 2.0 + 0.1 * (number % 2))
        if report := tuner.observe(number * SECOND, walked, charge_of(tuner.parameters), 1.0):
            reports.append(report)
    hints = [report.text for report in reports if report.kind == "hint"]
    assert tuner.parameters.current_ma < BOUNDS["current_ma"]["high"]
    assert len(hints) == 1
    assert "is not reached below the upper bound" in hints[0]


@pytest.mark.parametrize(("method", "inverted_deg"), [("run_to_run", 4.9), ("learning", 4.0)])
def test_a_channel_that_moves_nothing_says_that_its_bound_is_spent_though_the_foot_lies_in_its_band(
    method: str, inverted_deg: float
) -> None:
    tuned = tuning(method=method, toe_clearance_m=None, eversion_at_contact_deg={"low": -5.0, "high": 5.0})
    tuner, reports, random = Tuner(channel(tuned)), [], Random(1)
    for number in range(60):
        roll = np.full(101, math.radians(inverted_deg + random.gauss(0.0, 0.3)))  # whatever is given
        walked = stride(number, 0.02, roll_rad=roll)
        if report := tuner.observe(number * SECOND, walked, charge_of(tuner.parameters), 1.0):
            reports.append(report)
    (hint,) = (report.text for report in reports if report.kind == "hint")
    assert "lies in its band, what is aimed at there is not reached at the upper bound" in hint
    assert spent(tuner.parameters, tuned)


@pytest.mark.parametrize(("drives", "lost"), [([0.9] * 3, True), ([0.8] * 3, False), ([0.9, 0.9, 0.8], False)])
@pytest.mark.parametrize(("level", "bare"), [(-0.5, True), (-0.2, False)])
def test_a_foot_among_the_strides_without_stimulation_is_lost_once_more_did_not_help(
    drives: list[float], lost: bool, level: float, bare: bool
) -> None:
    answering, model, own = AnswerMonitor(), ResponseModel(), BurstParameters.for_channel(channel())

    def reading(at: float) -> Reading:
        band = Band(**PITCH)
        return Reading((Measure(TOE_UP, PITCH["low"] + at * (PITCH["high"] - PITCH["low"]), band, 1.0, "°"),))

    for _ in range(3):
        answering.add_bare(reading(-0.48))
    for _ in range(8):
        assert answering.stride(reading(0.1), {TOE_UP: 0.7}, own, model, spent=False) == ""
    said = [answering.stride(reading(level), {TOE_UP: drive}, own, model, spent=False) for drive in drives]
    assert said == ["", "", LIKE_NONE if lost and bare else ""]


class Doubts(ResponseModel):
    """A response that has come to believe that stimulation does nothing, as of a muscle that tires the while."""

    def gained(self, name: str, drive: float) -> Known:
        return Known(0.0, 0.05)


@pytest.mark.parametrize("lifted_by", [0.2, 0.3])
def test_a_foot_that_is_lifted_by_all_the_bound_allows_is_not_given_up(lifted_by: float) -> None:
    """A quarter of a band above what the least stimulation leaves: less would be worse for it."""
    monitor, model, said = AnswerMonitor(), Doubts(), set()
    own = BurstParameters(30.0, 0.0, 0.0, (300.0,))
    for number in range(16):
        drives, level = ({"toe": 0.2}, -0.6) if number < 3 else ({"toe": 1.0}, -0.6 + lifted_by)
        reading = Reading((Measure("toe", 0.02 + 0.03 * level, Band(low=0.02, high=0.05), 1e3, "mm"),))
        model.add(reading, drives)
        said.add(monitor.stride(reading, drives, own, model, spent=number >= 3))
    assert (NO_ANSWER in said) == (lifted_by < 0.25)


@pytest.mark.parametrize("reached", [2, 3])
def test_a_foot_that_has_reached_its_targets_answers_though_it_tires_at_the_bound(reached: int) -> None:
    monitor, model, said = AnswerMonitor(), Doubts(), set()
    own = BurstParameters(30.0, 0.0, 0.0, (300.0,))
    for number in range(16):
        level = 0.1 if number < reached else -0.05
        reading = Reading((Measure("toe", 0.02 + 0.03 * level, Band(low=0.02, high=0.05), 1e3, "mm"),))
        model.add(reading, {"toe": 1.0})
        said.add(monitor.stride(reading, {"toe": 1.0}, own, model, spent=True))
    assert (NO_ANSWER in said) == (reached < 3)


def fallen(slope: float, levels: list[float], drives: list[float]) -> list[str]:
    """What is said of a foot that answered by this slope until a fault in the first two of these strides."""
    monitor, model = AnswerMonitor(), ResponseModel()
    own, band = BurstParameters.for_channel(channel()), Band(**PITCH)

    def reading(at: float) -> Reading:
        return Reading((Measure(TOE_UP, PITCH["low"] + at * (PITCH["high"] - PITCH["low"]), band, 1.0, "°"),))

    for drive in (0.2, 0.3, 0.4, 0.5, 0.6, 0.55, 0.6, 0.5, 0.6):
        level = -0.9 + slope * drive
        model.add(reading(level), {TOE_UP: drive})
        monitor.stride(reading(level), {TOE_UP: drive}, own, model, spent=False)
    seen = [(reading(level), {TOE_UP: drive}) for level, drive in zip(levels, drives, strict=True)]
    monitor.fault(model, seen[:2])
    return [monitor.stride(one, at, own, model, spent=False) for one, at in seen[1:]]


@pytest.mark.parametrize(
    ("levels", "drives", "lost"),
    [
        ([-0.1] * 10, [0.5, 0.5, 0.6, 0.7, *[0.8] * 6], True),
        ([-0.1] * 10, [0.5, 0.5, 0.55, *[0.6] * 7], False),  # too little was tried
        ([-0.3, -0.3, -0.25, -0.2, *[-0.1] * 6], [0.5, 0.5, 0.6, 0.7, *[0.8] * 6], False),  # a slip: it answers less
    ],
)
def test_after_a_fault_it_is_given_up_once_more_does_nothing(
    levels: list[float], drives: list[float], lost: bool
) -> None:
    assert (NO_ANSWER in fallen(2.0, levels, drives)) == lost


@pytest.mark.parametrize("to", [-0.6, 0.05])
@pytest.mark.parametrize("spent", [False, True])
def test_a_foot_far_below_where_it_was_is_lost_though_nothing_is_known_of_it_without_stimulation(
    to: float, spent: bool
) -> None:
    answering, model, own = AnswerMonitor(), ResponseModel(), BurstParameters.for_channel(channel())
    bands = {TOE_UP: Band(**PITCH), "toe": Band(low=0.02, high=0.05)}

    def reading(pitch: float, toe: float) -> Reading:
        levels = {TOE_UP: pitch, "toe": toe}
        measures = [
            Measure(name, band.low + levels[name] * (band.high - band.low), band, 1.0, "")
            for name, band in bands.items()
        ]
        return Reading(tuple(sorted(measures, key=lambda measure: measure.level)))

    drives = dict.fromkeys(bands, 0.7)
    for _ in range(6):
        assert answering.stride(reading(0.2, 0.3), drives, own, model, spent=False) == ""
    said = {answering.stride(reading(to, -0.4), drives, own, model, spent=spent) for _ in range(4)}
    assert (LIKE_NONE in said) == (to < 0.0 and spent)


@pytest.mark.parametrize("bare", [0, 6])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("method", ["run_to_run", "learning"])
def test_an_electrode_that_peels_off_slowly_stops_the_tuning_too(method: str, seed: int, bare: int) -> None:
    done = begun(Foot(bare=-0.8, slope=2.5, seed=seed), method=method).walk(bare, stimulated=False).walk(20)
    for left in range(39, -1, -1):
        done.foot.slope = 2.5 * left / 40.0
        done.walk(1)
    done.walk(100)
    assert done.stopped
    assert strength(done.tuner.parameters) <= strength(done.tuner.start)


def test_a_fault_told_by_a_measure_that_was_never_seen_before_is_no_error() -> None:
    tuner = Tuner(channel(tuning(pitch_at_contact_deg=PITCH)))
    for number in range(30):
        unseen = number < 13
        toe_m, pitch_deg = (float("nan"), 8.0) if unseen else (0.012, -1.0 - 0.1 * number)
        tuner.observe(number * SECOND, stride(number, toe_m, pitch_deg), charge_of(tuner.parameters), 1.0)


def test_what_was_seen_before_a_person_looked_after_it_counts_no_more() -> None:
    monitor, model = AnswerMonitor(), Doubts()
    own = BurstParameters(30.0, 0.0, 0.0, (300.0,))

    def walk(level: float, strides: int) -> set[str]:
        reading = Reading((Measure("toe", 0.02 + 0.03 * level, Band(low=0.02, high=0.05), 1e3, "mm"),))
        said = set()
        for _ in range(strides):
            model.add(reading, {"toe": 1.0})
            said.add(monitor.stride(reading, {"toe": 1.0}, own, model, spent=True))
        return said

    walk(0.1, 3)
    monitor.forget()
    walk(0.1, 1)
    assert NO_ANSWER in walk(-0.05, 16)
