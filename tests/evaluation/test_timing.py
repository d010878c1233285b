"""The timing workbench: missed, extra and moved events are counted as such, four plants are found, nothing else."""

from __future__ import annotations

import json
import shutil
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given
from hypothesis import strategies as st

from fes.calibration.recording import calibrate_phase_sensors
from fes.cli.main import main
from fes.config import Session, load_session, validate_session
from fes.control.controller import Controller, Decision
from fes.control.replay import session_for
from fes.estimation.sensor_choice import Calibration
from fes.estimation.tracking.tracker import Outcome, Tracker
from fes.evaluation.timing.judgement import (
    LATENCY,
    Baseline,
    Failure,
    Limits,
    Measured,
    RecordingBaseline,
    RecordingTiming,
    as_baseline,
    baseline_text,
    judge,
    measure,
    read_baseline,
)
from fes.evaluation.timing.marks import (
    Mark,
    Spread,
    heel_lifts,
    marks_of_commands,
    marks_of_phases,
    marks_of_truth,
    pair_times,
    timing_rows,
)
from fes.evaluation.timing.truth import (
    TimingError,
    check_clock,
    find_offset_s,
    marks_of_channels,
    read_truth,
    without_cut_ends,
)
from fes.session_log.framing import RecordType
from fes.signals import NS_PER_S, Event, ImuSample, StimCommand, Vector3
from fes.simulation.truth import load_truth
from statemachine.phases import Phase, PhaseChange, Transition
from tests.replays import MS, SETTINGS, TRIALS, rewritten, trial

ROOT = Path(__file__).resolve().parents[2]
FEET = ["left_foot", "right_foot"]


def run_fes(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [*map(str, arguments)])


def at(*times_ms: float, what: str = "T2", who: str = "left_foot") -> list[Mark]:
    return [Mark(round(t * MS), who, what) for t in times_ms]


def test_each_kind_of_error_is_counted() -> None:
    expected = at(1000, 2000, 3000, 4000, 5000)
    found = at(1010, 1900, 3100, 4600, 5000)
    (row,) = timing_rows(expected, found, {"T2": 60.0})
    assert (row.missed_ns.tolist(), row.extra_ns.tolist(), row.moved) == ([4000 * MS], [4600 * MS], 2)
    spread = row.spread
    assert (spread.expected, spread.found, spread.missed, spread.extra) == (5, 5, 1, 1)
    errors = np.array([10.0, -100.0, 100.0, 0.0])
    assert spread.bias_ms == pytest.approx(errors.mean())
    assert spread.upper_ms == pytest.approx(errors.mean() + 1.96 * errors.std(ddof=1))
    (may_lack,) = timing_rows(expected, found, {}, optional={expected[3]})
    assert (len(may_lack.missed_ns), may_lack.moved) == (0, 0)


def test_feet_and_transitions_are_kept_apart() -> None:
    expected = at(1000) + at(1000, what="T3") + at(1000, who="right_foot")
    found = at(1000, what="T3") + at(1005) + at(1000, who="channel 0", what="on")
    rows = {(row.who, row.what): row for row in timing_rows(expected, found, {})}
    assert {key: (row.spread.missed, row.spread.extra) for key, row in rows.items()} == {
        ("left_foot", "T2"): (0, 0),
        ("left_foot", "T3"): (0, 0),
        ("right_foot", "T2"): (1, 0),
        ("channel 0", "on"): (0, 1),
    }
    assert np.isnan(rows["right_foot", "T2"].spread.bias_ms)


@given(
    st.lists(st.integers(0, 5000), max_size=30).map(sorted),
    st.lists(st.integers(0, 5000), max_size=30).map(sorted),
    st.integers(1, 600),
)
def test_pairs_are_one_to_one_and_near(expected: list[int], found: list[int], window: int) -> None:
    a, b = np.array(expected, np.int64), np.array(found, np.int64)
    pairs = pair_times(a, b, window)
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)
    assert all(abs(expected[i] - found[j]) <= window for i, j in pairs)
    single = {i for i, _ in pairs}, {j for _, j in pairs}
    for i, t in enumerate(expected):  # no two that are left over belong together
        assert i in single[0] or all(j in single[1] for j, u in enumerate(found) if abs(t - u) <= window)


@given(st.lists(st.integers(0, 100), min_size=1, max_size=20), st.integers(-290, 290), st.data())
def test_known_shifts_and_losses_come_out(steps: list[int], shift: int, data: st.DataObject) -> None:
    times = np.cumsum([1000 + step for step in steps]).tolist()
    lost = data.draw(st.sets(st.sampled_from(range(len(times)))))
    found = [t + shift for k, t in enumerate(times) if k not in lost]
    (row,) = timing_rows(at(*times), at(*found), {"T2": 50.0})
    assert (len(row.missed_ns), len(row.extra_ns)) == (len(lost), 0)
    if found:
        assert row.spread.bias_ms == pytest.approx(shift)
        assert row.moved == (len(found) if abs(shift) > 50 else 0)


def test_marks_of_what_was_done() -> None:
    anew = PhaseChange(5, "left_foot", Transition.NONE, Phase.SWING, Phase.STANCE)
    fired = PhaseChange(7, "left_foot", Transition.T1, Phase.STANCE, Phase.PRE_SWING)
    assert marks_of_phases([anew, fired]) == [Mark(7, "left_foot", "T1")]
    commands = [StimCommand(t, t % 2, t in (3, 4, 5), 1.0, 1.0, 1.0, 60) for t in range(8)]
    assert marks_of_commands(commands) == [
        Mark(3, "channel 1", "on"),
        Mark(4, "channel 0", "on"),
        Mark(6, "channel 0", "off"),
        Mark(7, "channel 1", "off"),
    ]
    t_ns, phase = np.arange(10) * 10, np.array([0, 1, 1, 0, 0, 1, 2, 3, 0, 1])
    assert heel_lifts(t_ns, phase, "left_foot") == [Mark(10, "left_foot", "T1"), Mark(30, "left_foot", "T5")]


def test_the_truth_of_the_bundled_trials() -> None:
    truth = load_truth(TRIALS / "not_walking.parquet")
    marks = marks_of_truth(truth, set(FEET))
    both = [mark for mark in marks if mark.what == "T5"]
    assert 7 <= len(both) <= 14, "seven heel lifts, and weight shifts"
    assert {mark.who for mark in marks_of_truth(truth, {"left_foot"})} == {"left_foot"}
    soft = marks_of_truth(load_truth(TRIALS / "soft_contact.parquet"), {"right_foot"})
    assert [sum(mark.what == what for mark in soft) for what in ("T1", "T2", "T3", "T4", "T6")] == [30, 30, 0, 0, 30]


# ---- four plants, and none


class Clock:
    """Every look at it takes ten microseconds; a plant can make it jump."""

    def __init__(self) -> None:
        self.t_ns = 0

    def __call__(self) -> int:
        self.t_ns += 10_000
        return self.t_ns


class Slow(Controller):
    """Every 50th decision takes a millisecond longer, of the clock that it is given."""

    clock: Clock
    samples = 0

    def step(self, event: Event) -> Decision:
        if isinstance(event, ImuSample):
            self.samples += 1
            self.clock.t_ns += MS if self.samples % 50 == 0 else 0
        return super().step(event)


GUARD_NS, ENVELOPE_S = 20 * MS, 0.010


class ChangedTracker:
    """A tracker of which one thing is changed; all else is its own."""

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker

    def __getattr__(self, name: str) -> Any:
        return getattr(self._tracker, name)


class LateGuard(ChangedTracker):
    """One guard fires 20 ms later, at the first sample from then on; what follows waits for it."""

    def __init__(self, tracker: Tracker, late: Transition) -> None:
        super().__init__(tracker)
        self._late, self._held, self._until_ns = late, list[Outcome](), 0

    def step(self, t_ns: int, acc_mps2: Vector3, gyr_radps: Vector3) -> list[Outcome]:
        """As :meth:`Tracker.step`."""
        for outcome in self._tracker.step(t_ns, acc_mps2, gyr_radps):
            fired = isinstance(outcome, PhaseChange) and outcome.transition == self._late
            if fired and t_ns >= self._until_ns:
                self._until_ns = t_ns + GUARD_NS
            self._held.append(outcome)
        if t_ns < self._until_ns:
            return []
        out = [replace(each, t_ns=t_ns) if isinstance(each, PhaseChange) else each for each in self._held]
        self._held = []
        return out


class MissedStride(ChangedTracker):
    """One stride, by its number, is not seen: none of its transitions, and no result."""

    def __init__(self, tracker: Tracker, number: int) -> None:
        super().__init__(tracker)
        self._number, self._begun = number, 0

    def step(self, t_ns: int, acc_mps2: Vector3, gyr_radps: Vector3) -> list[Outcome]:
        """As :meth:`Tracker.step`."""
        out = []
        for outcome in self._tracker.step(t_ns, acc_mps2, gyr_radps):
            if isinstance(outcome, PhaseChange) and outcome.transition == Transition.T1:
                self._begun += 1
            if self._begun != self._number:
                out.append(outcome)
        return out


ControllerMaker = Callable[[Session, Mapping[str, Calibration]], Controller]


def controller_with(change: Callable[[str, Tracker], ChangedTracker]) -> ControllerMaker:
    """Controllers whose trackers are changed."""

    def made(session: Session, calibrations: Mapping[str, Calibration]) -> Controller:
        controller = Controller(session, calibrations)
        changed: dict[str, Any] = {foot: change(foot, tracker) for foot, tracker in controller.trackers.items()}
        controller.trackers = changed
        return controller

    return made


def late_envelope(session: Session, calibrations: Mapping[str, Calibration]) -> Controller:
    """A controller whose envelopes start 10 ms after what the session asks for."""
    channels = [each.model_copy(update={"start_delay_s": each.start_delay_s + ENVELOPE_S}) for each in session.channels]
    return Controller(session.model_copy(update={"channels": tuple(channels)}), calibrations)


def late_guard(late: Transition) -> ControllerMaker:
    return controller_with(lambda foot, tracker: LateGuard(tracker, late))


def missed_stride(number: int) -> ControllerMaker:
    """On the right foot."""
    return controller_with(lambda foot, tracker: MissedStride(tracker, number if foot == "right_foot" else 0))


def both_feet_session() -> Session:
    """The bundled settings, with the same channel on the left foot too."""
    head, channel = SETTINGS.read_text(encoding="utf-8").split("[[channels]]")
    left = channel.replace("right", "left").replace("number = 0", "number = 1")
    return validate_session(tomllib.loads(f"{head}[[channels]]{channel}\n[[channels]]{left}"), Path("both feet"))


@pytest.fixture(scope="module")
def walk():
    """A bundled walk of two feet with a channel on each: how to measure it, its truth, and its baseline from a file."""
    recording = trial("both_feet_100hz")
    calibrations = calibrate_phase_sensors(recording).calibrations
    session = session_for(recording, both_feet_session())
    truth = read_truth(TRIALS / "both_feet_100hz.truth.parquet", session, FEET)

    def measured(maker=Controller, clock: Clock | None = None) -> Measured:
        return measure(recording, session, calibrations, clock or Clock(), repeats=1, controller_of=maker)

    return measured, truth


@pytest.fixture(scope="module")
def baseline(walk, tmp_path_factory: pytest.TempPathFactory) -> Baseline:
    measured, truth = walk
    outcome = judge(measured(), truth, None, "sha", Limits())
    assert not outcome.failures
    assert not outcome.judged
    file = tmp_path_factory.mktemp("baseline") / "timing.toml"
    file.write_text(baseline_text(Baseline({outcome.name: as_baseline(outcome, "sha", "")})))
    return read_baseline(file)


def checked(walk, baseline: Baseline, maker=Controller, clock: Clock | None = None) -> RecordingTiming:
    measured, truth = walk
    outcome = judge(measured(maker, clock), truth, baseline, "sha", Limits(baseline.tolerance_ms, baseline.allowed))
    assert outcome.judged
    return outcome


def kinds(failures: tuple[Failure, ...]) -> set[str]:
    return {failure.what for failure in failures}


def test_unchanged_code_raises_no_alarm(walk, baseline) -> None:
    outcome = checked(walk, baseline)
    assert outcome.failures == ()
    assert {row.what for row in outcome.own} == {"T1", "T2", "T3", "T4", "on", "off"}
    assert all(np.abs(row.error_ms).max() <= 0.06 for row in outcome.own), "a tenth of a millisecond in the file"
    edges = [row.spread for row in outcome.true if row.what == "on"]
    assert [(edge.missed, edge.extra) for edge in edges] == [(0, 0), (0, 0)]


@pytest.mark.parametrize("late", ["T1", "T2", "T3", "T4"])
def test_a_guard_20_ms_later_is_found(walk, baseline, late: str) -> None:
    outcome = checked(walk, baseline, late_guard(Transition[late]))
    assert late in kinds(outcome.failures)
    for row in outcome.own:
        if row.what == late:
            assert row.moved == len(row.pairs_ns) > 40
            assert row.spread.bias_ms == pytest.approx(20.0, abs=0.1)


def test_an_envelope_10_ms_later_is_found(walk, baseline) -> None:
    outcome = checked(walk, baseline, late_envelope)
    assert kinds(outcome.failures) == {"on"}
    assert {failure.against for failure in outcome.failures} == {"baseline", "truth"}


def test_one_missed_stride_is_found(walk, baseline) -> None:
    outcome = checked(walk, baseline, missed_stride(20))
    assert {"T1", "T2", "T3", "T4"} <= kinds(outcome.failures)
    missed = [row.spread.missed for row in outcome.own if row.what == "T2"]
    assert sorted(missed) == [0, 1]
    assert sum(row.moved for row in outcome.own if row.who.endswith("foot")) == 0


def test_a_latency_that_grew_by_1_ms_is_found(walk, baseline) -> None:
    clock = Clock()

    def slow(session: Session, calibrations: Mapping[str, Calibration]) -> Controller:
        controller = Slow(session, calibrations)
        controller.clock = clock
        return controller

    outcome = checked(walk, baseline, slow, clock)
    assert [(f.against, f.what) for f in outcome.failures] == [("latency", LATENCY)]
    assert outcome.latency.p99_ms - outcome.latency.p99_before_ms == pytest.approx(1.0, abs=0.01)


def test_a_walk_that_the_baseline_does_not_know(walk, baseline) -> None:
    measured, truth = walk
    known = baseline.recordings["both_feet_100hz"]
    others = {
        f"other{k}": replace(
            known, spreads=tuple(replace(s, bias_ms=s.bias_ms + 0.3 * (k - 3.0)) for s in known.spreads)
        )
        for k in range(7)
    }
    family = replace(baseline, recordings=others)
    limits = Limits(baseline.tolerance_ms, baseline.allowed)
    assert judge(measured(), truth, family, "new", limits).failures == ()
    late = judge(measured(late_guard(Transition.T2)), truth, family, "new", limits)
    assert "T2" in kinds(late.failures)
    assert "where the baseline's walkers have" in late.failures[0].text
    few = replace(baseline, recordings=dict(list(others.items())[:2]))
    unsure = judge(measured(), truth, few, "new", limits)
    assert unsure.failures == ()
    assert any("too few walkers" in note for note in unsure.notes)


def test_recordings_of_one_walker_count_as_one() -> None:
    """Ten walks each of a few walkers who differ tell of so many walkers, not of ten times as many."""
    rng = np.random.default_rng(5)

    def recording(bias_ms: float, subject: str) -> RecordingBaseline:
        spread = Spread("left_foot", "T1", 50, 50, 0, 0, bias_ms, 1.0, bias_ms - 2.0, bias_ms + 2.0)
        return RecordingBaseline("", "", "truth", 0.1, (spread,), (), subject)

    strange = {"named": 0, "as if all were walkers": 0}
    for _ in range(400):
        walkers = rng.normal(0.0, 10.0, 7)
        new_ms = rng.normal(0.0, 10.0) + rng.normal(0.0, 1.0)
        for which, count in strange.items():
            known = {
                f"{walker} {walk}": recording(bias + rng.normal(0.0, 1.0), f"w{walker}" if which == "named" else "")
                for walker, bias in enumerate(walkers)
                for walk in range(10)
            }
            middle_ms, reach_ms = Baseline(known).usual_bias_ms("left_foot", "T1")
            strange[which] = count + (abs(new_ms - middle_ms) > reach_ms)
    assert strange["named"] <= 3, "one in a thousand"
    assert strange["as if all were walkers"] > strange["named"]
    four = {name: each for name, each in known.items() if int(name[0]) < 4}
    named = {name: replace(each, subject=f"w{name[0]}") for name, each in four.items()}
    assert np.isnan(Baseline(named).usual_bias_ms("left_foot", "T1")[0]), "40 recordings, four walkers"


# ---- the baseline's file


def test_a_baseline_is_read_back_and_its_tolerances_are_the_users(tmp_path: Path) -> None:
    spread = Spread("left_foot", "T2", 3, 3, 0, 0, 1.5, 0.5, 0.5, 2.5)
    marks = tuple(at(1000.2, 2000, 3000))
    one = Baseline({'a "walk"/1': RecordingBaseline("ab", "cd", "truth", 0.25, (spread,), marks, "Ann")})
    file = tmp_path / "timing.toml"
    file.write_text(baseline_text(one))
    again = read_baseline(file)
    assert again.recordings['a "walk"/1'].marks == tuple(at(1000.2, 2000, 3000)), "a tenth of a millisecond"
    assert again.recordings['a "walk"/1'].spreads == (spread,)
    assert again.recordings['a "walk"/1'].subject == "Ann"
    file.write_text(
        baseline_text(one).replace("T2 = 5.0", "T2 = 12.5").replace("missed = 0\nextra", "missed = 3\nextra")
    )
    edited = read_baseline(file)
    assert (edited.tolerance_ms["T2"], edited.tolerance_ms["T3"], edited.allowed["missed"]) == (12.5, 5.0, 3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is no baseline of timing"),
        ("format = [", "is no baseline"),
        ('format = 1\n[recordings.a]\nsha256 = "x"', "is damaged"),
        ("format = 1\n[tolerance_ms]\nT9 = 1\n[recordings]", "'T9' is none of T1"),
        ("format = 1\n[tolerance_ms]\nT1 = -1\n[recordings]", "must be a number, 0 or more"),
        ("format = 1\n[tolerance_ms]\nT1 = true\n[recordings]", "must be a number, 0 or more"),
    ],
)
def test_a_file_that_is_no_baseline(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "timing.toml"
    file.write_text(text)
    with pytest.raises(TimingError, match=said):
        read_baseline(file)


# ---- any truth


@pytest.fixture(scope="module")
def patient() -> tuple[Session, list[Mark]]:
    """The bundled settings, and the true transitions of one patient's right foot."""
    return load_session(SETTINGS), marks_of_truth(load_truth(TRIALS / "negard_patient2.parquet"), {"right_foot"})


def edges_of(marks: tuple[Mark, ...] | list[Mark], what: str) -> list[int]:
    return [mark.t_ns for mark in marks if mark.what == what]


def test_edges_are_what_the_plan_makes_of_the_true_phases(patient) -> None:
    session, true = patient
    expected = read_truth(TRIALS / "negard_patient2.parquet", session, ["right_foot"])
    on, off = edges_of(expected.marks, "on"), edges_of(expected.marks, "off")
    assert on == edges_of(true, "T1")
    channel = session.channels[0]
    latest = [t + round((channel.extension_s + channel.fall_s) * NS_PER_S) for t in edges_of(true, "T3")]
    assert all(t <= most and t <= flat for t, most, flat in zip(off, latest, edges_of(true, "T4"), strict=True))
    first = session.stimulation.strides_before_start + 1
    assert {mark.t_ns for mark in expected.optional if mark.what == "on"} == set(on[:first])


def test_measured_events_by_any_name(patient, tmp_path: Path) -> None:
    session, true = patient
    names = {"T1": "Heel rise", "T2": "toe-off", "T3": "IC", "T4": "foot flat"}
    rows = [f"right;{names[m.what]};{1e-6 * m.t_ns:.3f}".replace(".", ",") for m in true]
    file = tmp_path / "walk.events.csv"
    file.write_text("\n".join(["foot;event;t_ms", *rows]))
    measured = read_truth(file, session, ["right_foot"])
    assert [(m.who, m.what) for m in measured.marks if m.what.startswith("T")] == [
        (m.who, m.what) for m in sorted(true)
    ]
    assert len(edges_of(measured.marks, "on")) == 45
    contacts = [m for m in true if m.what in ("T2", "T3")]
    file.write_text("foot,event,t_s\n" + "\n".join(f"right,{m.what},{1e-9 * m.t_ns}" for m in contacts))
    few = read_truth(file, session, ["right_foot"])
    assert few.kinds == {("right_foot", "T2"), ("right_foot", "T3")}
    assert few.notes == (
        "channel 0 on is not judged: the truth has no T1",
        "channel 0 off is not judged: the truth has no T4",
    )
    file.write_text("channel,event,t_s\n0,on,1.5\n0,off,2.5\nchannel 0,on,3.5\n")
    assert read_truth(file, session, ["right_foot"]).marks[0] == Mark(1_500_000_000, "channel 0", "on")


def test_switches_at_heel_and_toe_show_four_transitions() -> None:
    t_s = np.arange(0.0, 10.0, 0.01)
    phase = t_s % 1.0
    heel, toe = (phase < 0.4).astype(float), ((phase > 0.1) & (phase < 0.6)).astype(float)
    marks = marks_of_channels("x", "left_foot", t_s, {"left_heel": heel, "left_toe": toe})
    for what, expected in {"T1": 0.4, "T2": 0.6, "T3": 0.0, "T4": 0.11}.items():
        found = [(1e-9 * t) % 1.0 for t in edges_of(marks, what)]
        assert len(found) >= 8
        assert np.allclose([min(abs(f - expected), 1.0 - abs(f - expected)) for f in found], 0.0, atol=0.016)
    both = marks_of_channels("x", "left_foot", t_s, {"left_switch": np.maximum(heel, toe)})
    assert {mark.what for mark in both} == {"T2", "T3"}


def test_force_counts_from_20_n_between_the_samples() -> None:
    t_s = np.arange(0.0, 4.0, 0.01)
    force = np.clip(1000.0 * np.sin(np.pi * (t_s - 0.5)), 0.0, None)
    marks = marks_of_channels("x", "left_foot", t_s, {"left_fz_n": -force})
    rise_s = 0.5 + np.arcsin(0.02) / np.pi
    assert 1e-9 * edges_of(marks, "T3")[0] == pytest.approx(rise_s, abs=1e-3)
    assert 1e-9 * edges_of(marks, "T2")[0] == pytest.approx(2.0 - rise_s, abs=1e-3)
    with pytest.raises(ValueError, match=r"never passes 20 N.*is it in N"):
        marks_of_channels("x", "left_foot", t_s, {"left_fz": force / 1000.0})


def test_c3d_events_switches_and_plates(patient, tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d", reason="reading C3D is an extra")
    session, _ = patient
    c3d, path = ezc3d.c3d(), tmp_path / "walk.c3d"
    t_s = np.arange(1000) / 100.0
    c3d["parameters"]["POINT"]["RATE"]["value"] = [100]
    c3d["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    c3d["parameters"]["POINT"]["LABELS"]["value"] = ("C7",)
    c3d["data"]["points"] = np.ones((4, 1, 1000))
    c3d["parameters"]["ANALOG"]["RATE"]["value"] = [100]
    c3d["parameters"]["ANALOG"]["LABELS"]["value"] = ("Right.Heel", "EMG1")
    c3d["data"]["analogs"] = np.array([[(t_s % 1.0 < 0.5).astype(float), t_s]])
    c3d.write(str(path))
    marks = read_truth(path, session, ["right_foot"]).marks
    assert {mark.what for mark in marks} == {"T2", "T3"}
    assert 1e-9 * edges_of(marks, "T3")[0] == pytest.approx(1.0, abs=0.011)
    with pytest.raises(TimingError, match="has 0 force plates, no number 1"):
        read_truth(path, session, ["right_foot"], plates={1: "right_foot"})
    with pytest.raises(TimingError, match="no event of the left foot"):
        read_truth(path, session, ["left_foot"])
    c3d["parameters"]["ANALOG"]["LABELS"]["value"] = ("EMG2", "EMG1")
    c3d.write(str(path))
    with pytest.raises(TimingError, match=r"none of its analog channels.*--plate 1=left"):
        read_truth(path, session, ["right_foot"])


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("walk.csv", "a,b\n1,2\n", "tell of no events"),
        ("walk.csv", "foot,event,t_s\n", "holds no row"),
        ("walk.csv", "foot,event,t_s\nright,hop,1\n", "'hop' is no event known here"),
        ("walk.csv", "foot,event,t_s\nmiddle,IC,1\n", "'middle' is no foot"),
        ("walk.csv", "foot,event,t_s\nleft,IC,1\n", "has no event of the right foot"),
        ("walk.csv", "channel,event,t_s\n0,IC,1\n", "on or off are"),
        ("walk.csv", "t_s,right_heel\n0,1\n1,1\n2,1\n", "never change; is one broken"),
        ("walk.csv", "t_s,right_heel\n0,1\n0,1\n2,1\n", "must be numbers that increase"),
        ("walk.csv", "foot,event\nright,IC\n", "need a column of times"),
        ("walk.parquet", "", "without truth beside it"),
        ("walk.txt.gz", "", "is no truth known here"),
    ],
)
def test_a_truth_that_cannot_be_used_says_why(patient, tmp_path: Path, name: str, text: str, said: str) -> None:
    file = tmp_path / name
    file.write_text(text)
    with pytest.raises(ValueError, match=said):
        read_truth(file, patient[0], ["right_foot"])


def test_a_truth_of_another_clock_is_refused_with_its_offset(patient) -> None:
    session, _ = patient
    truth = read_truth(TRIALS / "negard_patient2.parquet", session, ["right_foot"])
    for off_s in (0.7, -3.0, 1000.0):
        found = [replace(mark, t_ns=mark.t_ns + round(off_s * NS_PER_S)) for mark in truth.marks]
        lag_s, caveat = find_offset_s(truth, found)
        assert (lag_s, caveat) == (pytest.approx(off_s, abs=0.02), "")
        with pytest.raises(TimingError, match=rf"--lag \{'+' if off_s > 0 else '-'}"):
            check_clock(truth, found)
        check_clock(truth.shifted(off_s), found)
    cut = without_cut_ends(truth, 20 * NS_PER_S, 30 * NS_PER_S)
    assert all(20 * NS_PER_S <= mark.t_ns <= 30 * NS_PER_S for mark in cut.marks)
    assert "lie outside the recording" in cut.notes[-1]


# ---- from a user's seat


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder: two recordings with truth, settings, and a baseline made by the command."""
    folder = tmp_path_factory.mktemp("project")
    (folder / "walks").mkdir()
    for name in ("example_csv", "soft_contact"):
        for file in TRIALS.glob(f"{name}.*"):
            shutil.copy(file, folder / "walks" / file.name)
    shutil.copy(SETTINGS, folder / "session.toml")
    made = run_fes(
        "timing", "baseline", folder / "walks", "--session", folder / "session.toml",
        "--baseline", folder / "timing.toml", "--tolerance-ms", "T4=8", "--tolerance-ms", "latency_p99=50",
    )  # fmt: skip
    assert made.exit_code == 0, made.output
    assert "2 recordings written" in made.stdout
    return folder


def test_a_folder_is_checked_by_one_command(project: Path, tmp_path: Path) -> None:
    common = ("timing", "check", project / "walks", "--session", project / "session.toml", "--out", tmp_path)
    done = run_fes(*common, "--baseline", project / "timing.toml", "--junit", tmp_path / "ci" / "timing.xml")
    assert done.exit_code == 0, done.output
    assert "Timing: within its bounds" in done.stderr
    suites = ElementTree.parse(tmp_path / "ci" / "timing.xml").getroot()
    assert [suite.get("name") for suite in suites] == ["example_csv", "soft_contact"]
    assert {suite.get("failures") for suite in suites} == {"0"}
    assert "T6" in {case.get("name", "").split()[-1] for case in suites[1]}
    page = tmp_path / "timing-001" / "index.html"
    assert 'href="example_csv.html#at=' in page.read_text()
    text = (page.parent / "example_csv.html").read_text()
    assert "data-at=" in text
    assert "<svg" in text
    assert "http://" not in text.replace("http://www.w3.org", "")
    first = read_baseline(project / "timing.toml")
    assert (first.tolerance_ms["T4"], first.tolerance_ms["T1"]) == (8.0, 5.0)


def test_changed_settings_fail_the_check_and_are_compared_side_by_side(project: Path, tmp_path: Path) -> None:
    later = tmp_path / "later.toml"
    text = (project / "session.toml").read_text()
    later.write_text(text.replace('start_phase = "pre_swing"', 'start_phase = "pre_swing"\nstart_delay_s = 0.02'))
    recording = project / "walks" / "soft_contact.parquet"
    done = run_fes(
        "timing", "check", recording, "--session", later, "--baseline", project / "timing.toml",
        "--json", "--no-report", "--junit", tmp_path / "timing.xml",
    )  # fmt: skip
    assert done.exit_code == 1, done.output
    (outcome,) = json.loads(done.stdout)["recordings"]
    assert {(each["who"], each["what"]) for each in outcome["failures"]} == {("channel 0", "on")}
    assert "the settings differ from the baseline's" in outcome["notes"]
    assert json.loads(done.stdout)["not_checked"] == ["example_csv"]
    assert "moved by more than 5 ms" in (tmp_path / "timing.xml").read_text()
    both = ("timing", "compare", recording, "--session", project / "session.toml", "--session", later)
    side = run_fes(*both, "--out", tmp_path)
    assert side.exit_code == 0, side.output
    assert "later − session" in side.stdout
    rows = json.loads(run_fes(*both, "--no-report", "--json").stdout)["recordings"][0]["against_baseline"]
    shift = {row["what"]: row["bias_ms"] for row in rows}
    assert (shift["on"], shift["T1"]) == (pytest.approx(20.0, abs=0.1), pytest.approx(0.0, abs=0.1))
    assert run_fes(*both, "--no-report", "--tolerance-ms", "5").exit_code == 1


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundled trial's session log."""
    out = tmp_path_factory.mktemp("log")
    done = run_fes("replay", TRIALS / "soft_contact.parquet", "--no-report", "--stimulator", "none", "--out", out)
    assert done.exit_code == 0, done.output
    return next(out.glob("*/session.feslog"))


def test_a_log_is_held_against_itself_an_earlier_one_and_a_truth(log: Path, tmp_path: Path) -> None:
    own = run_fes("timing", "check", log, "--no-report", "--json")
    assert own.exit_code == 0, own.output
    (outcome,) = json.loads(own.stdout)["recordings"]
    assert all(row["missed"] == row["extra"] == row["worst_ms"] == 0 for row in outcome["against_truth"])
    assert outcome["latency"]["steps"] > 10_000

    def change(kind: int, payload: bytes) -> bytes:
        """The earlier log had every T2 30 ms sooner."""
        if kind == RecordType.PHASE and payload[9] == Transition.T2:
            return (int.from_bytes(payload[:8], "little") - 30 * MS).to_bytes(8, "little") + payload[8:]
        return payload

    earlier = rewritten(log, tmp_path / "earlier.feslog", change)
    other = run_fes("timing", "check", log, "--no-report", "--truth", earlier)
    assert other.exit_code == 1
    assert "T2, against the truth: 30 of 30 are more than 1 ms off" in other.stderr
    assert run_fes("timing", "check", log, "--no-report", "--truth", earlier, "--tolerance-ms", "40").exit_code == 0
    true = run_fes("timing", "check", log, "--no-report", "--as-recorded", "--truth", TRIALS / "soft_contact.parquet")
    assert true.exit_code == 0
    assert "Nothing is judged" in true.stderr


def test_input_that_cannot_be_used_is_said_at_once(project: Path, log: Path, tmp_path: Path) -> None:
    walk = project / "walks" / "example_csv.csv"
    (tmp_path / "empty").mkdir()
    shifted = tmp_path / "example_csv.events.csv"
    truth = marks_of_truth(load_truth(walk), {"right_foot"})
    rows = [f"right,{m.what},{1e-9 * m.t_ns + 5000.0}" for m in truth]
    shifted.write_text("\n".join(["foot,event,t_s", *rows]))
    for arguments, said in (
        ((tmp_path / "gone.csv",), "is not there"),
        ((tmp_path / "empty",), "no recording is below"),
        ((walk, TRIALS / "example_csv.csv"), "has the same name"),
        ((walk, "--baseline", tmp_path / "gone.toml"), "writes one"),
        ((walk, "--baseline", walk.with_suffix(".toml")), "is no baseline of timing"),
        ((walk, "--truth", tmp_path / "gone.csv"), "is not there. Name a truth's file"),
        ((walk, "--truth", tmp_path / "empty"), "holds no truth of example_csv.csv"),
        ((walk, "--truth", shifted), "The events ask for --lag -"),
        ((project / "walks", "--truth", shifted), "is the truth of one recording"),
        ((walk, "--tolerance-ms", "T9=3"), "say MS or NAME=MS"),
        ((walk, "--allow", "late=3"), "say NAME=COUNT"),
        ((walk, "--plate", "left"), "say NUMBER=left"),
        ((walk, "--lag", "1", "--sync", "fit"), "choose one"),
    ):
        done = run_fes("timing", "check", *arguments, "--no-report")
        assert done.exit_code == 2, (arguments, done.output)
        assert said in done.stderr, (arguments, done.stderr)
    other = run_fes("timing", "check", walk, "--truth", log, "--no-report")
    assert other.exit_code == 1
    assert "is it another recording's truth" in other.stderr
    fitted = run_fes("timing", "check", walk, "--truth", shifted, "--lag", "-5000", "--no-report", "--json")
    assert fitted.exit_code == 0, fitted.output
    rows_of = {row["what"]: row for row in json.loads(fitted.stdout)["recordings"][0]["against_truth"]}
    assert (rows_of["T2"]["missed"], rows_of["T2"]["expected"]) == (0, 5)
