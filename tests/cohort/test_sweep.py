"""fes sweep: which settings there are, what a combination does, failing ones among good ones, resuming, the page."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given
from hypothesis import strategies as st
from pyarrow import parquet

from fes.cli import main
from fes.cohort.engine import cluster, run_tasks
from fes.cohort.store import CohortError, find_sources
from fes.cohort.sweep.grid import Point, change_thresholds, combinations_of, parse_axis, session_with, swept_names
from fes.cohort.sweep.table import RESULTS, combination_table, combinations, measures_in, sweep_page, sweep_store
from fes.cohort.sweep.task import Bench, Patient, Trial, burst_scores, patient_scores, truth_scores
from fes.cohort.task import DONE, FAILED, Outcome
from fes.config import ConfigError, load_session
from fes.evaluation.timing.marks import bursts_of
from fes.signals import NS_PER_S, StimRequest
from fes.simulation.truth import load_truth
from statemachine.guards import Thresholds
from statemachine.phases import Phase, PhaseChange, Transition

TRIALS = Path(__file__).parents[2] / "sim_inputs"
SESSION = TRIALS / "session.toml"
TRIAL = TRIALS / "soft_contact.parquet"
A = "stimulation.intensity"
TUNING = """
[channels.tuning]
mode = "act"
toe_clearance_m = { low = 0.020, high = 0.050 }
pitch_at_contact_deg = { low = 4.0, high = 25.0 }

[channels.tuning.bounds]
current_ma = { low = 10.0, high = 40.0 }
pulse_width_us = { low = 300.0, high = 300.0 }
start_delay_s = { low = 0.0, high = 0.0 }
extension_s = { low = 0.06, high = 0.06 }
"""


def sweep(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["sweep", *map(str, arguments)])


def bench(path: Path = SESSION, seconds: float = 0.0) -> Bench:
    return Bench(load_session(path), str(path), seconds)


def tuned(folder: Path) -> Path:
    path = folder / "tuned.toml"
    path.write_text(SESSION.read_text(encoding="utf-8") + TUNING, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("asked", "values"),
    [
        ("phases.swing_begins=peak,reversal", ("peak", "reversal")),
        ("stimulation.strides_before_start=1,2,2", (1, 2)),
        ("channels.tuning.gain=0.2:0.8:4", (0.2, 0.4, 0.6, 0.8)),
        ("channels.0.tuning.timing=true", (True,)),
        ("thresholds.heel_rise_share=x0.8,0.5", ("x0.8", 0.5)),
    ],
)
def test_values_are_read_as_the_session_file_would(asked: str, values: tuple[object, ...]) -> None:
    assert parse_axis(asked).values == values


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ("channels.tuning.gian=1", "channels.tuning.gain"),
        ("phases.T2_pitch_rate_radps=1.0", "thresholds."),
        ("stimulation.strides=1", "stimulation.strides_before_start"),
        ("channels.limits.max_current_ma=90", "no setting that can be swept"),
        ("phases.swing_begins", "NAME=VALUE"),
        ("phases.swing_begins=", "NAME=VALUE"),
        ("channels.tuning.gain=0.1,,0.2", "missing"),
        ("channels.tuning.gain=a:b:3", "no number"),
        ("channels.tuning.gain=0:1:1", "COUNT"),
        ("channels.tuning.gain=x1.2", "write the value itself"),
        ("thresholds.heel_rise_share=inf", "no number"),
    ],
)
def test_what_is_no_setting_is_told_with_the_nearest(asked: str, told: str) -> None:
    with pytest.raises(CohortError, match=r"--set") as caught:
        parse_axis(asked)
    assert told in str(caught.value)


def test_every_name_can_be_set() -> None:
    for name in swept_names():
        assert parse_axis(f"{name}=1").name == name
    assert not [name for name in swept_names() if "limits" in name or name.endswith(".foot")]


@given(st.lists(st.integers(1, 5), min_size=1, max_size=4), st.integers(1, 40), st.integers(0, 9))
def test_a_sample_is_part_of_the_grid_and_the_same_for_the_same_seed(sizes: list[int], count: int, seed: int) -> None:
    chosen = ("thresholds.heel_rise_share", "thresholds.rest_share", "stimulation.intensity", "channels.fall_s")
    axes = [
        parse_axis(f"{name}={','.join(str(k) for k in range(size))}") for name, size in zip(chosen, sizes, strict=False)
    ]
    grid, drawn = combinations_of(axes), combinations_of(axes, count, seed)
    assert grid[0] == drawn[0] == Point()
    assert len(set(grid)) == len(grid) == 1 + int(np.prod(sizes))
    assert len(set(drawn)) == len(drawn) == 1 + min(count, len(grid) - 1)
    assert set(drawn) <= set(grid)
    assert drawn == combinations_of(axes, count, seed)
    assert len({point.identity for point in grid}) == len(grid)


def test_too_many_combinations_and_a_setting_named_twice_are_refused() -> None:
    axes = [parse_axis(f"{name}=0:1:400") for name in ("thresholds.heel_rise_share", "thresholds.rest_share")]
    with pytest.raises(CohortError, match=r"160000 combinations.*--sample"):
        combinations_of(axes)
    assert len(combinations_of(axes, 5)) == 6
    with pytest.raises(CohortError, match="twice"):
        combinations_of([axes[0], axes[0]])


def test_a_combination_changes_what_it_names_and_nothing_else(tmp_path: Path) -> None:
    base = load_session(tuned(tmp_path))
    point = Point((("channels.tuning.gain", 0.3), ("stimulation.strides_before_start", 4), ("channels.0.fall_s", 0.2)))
    session = session_with(base, point, SESSION)
    assert session.channels[0].tuning is not None
    assert (session.channels[0].tuning.gain, session.channels[0].fall_s) == (0.3, 0.2)
    assert session.stimulation.strides_before_start == 4
    back = session_with(
        session,
        Point((("channels.tuning.gain", 0.8), ("stimulation.strides_before_start", 1), ("channels.fall_s", 0.1))),
        SESSION,
    )
    assert back == base
    with pytest.raises(ConfigError, match="over this channel's limit"):
        session_with(base, Point((("channels.current_ma", 60.0),)), SESSION)
    with pytest.raises(CohortError, match="no such channel"):
        session_with(base, Point((("channels.5.fall_s", 0.1),)), SESSION)
    with pytest.raises(CohortError, match="has no tuning"):
        session_with(load_session(SESSION), Point((("channels.tuning.gain", 0.3),)), SESSION)


def test_thresholds_by_value_by_factor_and_of_the_wrong_kind() -> None:
    own = Thresholds(rest_share=0.1)
    new = change_thresholds(own, {"rest_share": "x1.2", "shortest_swing_share": 0.2, "swing_at_reversal": True})
    assert new == own._replace(rest_share=0.12, shortest_swing_share=0.2, swing_at_reversal=True)
    for wrong in (
        {"shortest_swing_share": "soon"},
        {"shortest_swing_share": True},
        {"swing_at_reversal": 1},
        {"shortest_swing_share": -1.0},
    ):
        with pytest.raises(CohortError, match="must be"):
            change_thresholds(own, dict(wrong))


def test_scores_against_the_truth_count_what_was_made_wrong() -> None:
    truth = load_truth(TRIAL)
    foot = next(iter(truth.feet))
    known = truth.strides_of(foot)

    def change(t_s: float, transition: Transition) -> PhaseChange:
        return PhaseChange(round(t_s * NS_PER_S), foot, transition, Phase.STANCE, Phase.STANCE)

    perfect = [change(s.t_swing_s, Transition.T2) for s in known]
    late = [change(s.t_swing_s + 0.1, Transition.T2) for s in known[:3]]
    found = truth_scores(truth, {foot}, [*late, *perfect[4:], change(known[-1].t_swing_s + 9.0, Transition.T2)], [])
    everything = truth_scores(truth, {foot}, perfect, [])
    assert everything["foot_off_error_ms"] == pytest.approx(0.0, abs=1e-5)
    assert found["off"] == 3
    assert found["extra"] == 1
    assert found["missed"] == (everything["missed"] or 0) + 1
    assert found["error_p95_ms"] == pytest.approx(100.0, abs=0.01)


def test_bursts_are_held_against_the_swings() -> None:
    truth = load_truth(TRIAL)
    foot = next(iter(truth.feet))
    walked = [stride for stride in truth.strides_of(foot) if stride.walking]
    asked: list[tuple[int, StimRequest]] = [(0, StimRequest(0, on=True)), (NS_PER_S // 10, StimRequest(0, on=False))]
    for stride in walked[1:]:
        asked.append((round(stride.t_swing_s * NS_PER_S), StimRequest(0, on=True)))
        asked.append((round(stride.t_loading_response_s * NS_PER_S), StimRequest(0, on=False)))
    scores = burst_scores(bursts_of(asked), {0: foot}, truth)
    assert scores == {"bursts": len(walked), "swings_without": 1, "bursts_without": 1}
    assert bursts_of([(5, StimRequest(1, on=True)), (9, StimRequest(1, on=True))]) == {1: [(5, 9)]}
    assert burst_scores({}, {0: foot}, None) == {"bursts": 0, "swings_without": None, "bursts_without": None}


def test_no_stride_scores_as_unknown() -> None:
    assert patient_scores([], 0, latched=False)["in_band"] is None


def row(settings: dict[str, object], status: str = DONE, **figures: object) -> dict[str, object]:
    return {"settings": json.dumps(settings), "status": status, "reason": "" if status == DONE else "no", **figures}


def test_combinations_are_ordered_and_the_efficient_ones_marked() -> None:
    rows = [
        row({A: 1}, marks=100, missed=1, extra=0, off=0, error_ms=30.0),
        row({A: 1}, marks=100, missed=0, extra=1, off=2, error_ms=50.0),
        row({A: 2}, marks=200, missed=2, extra=0, off=0, error_ms=60.0),
        row({A: 3}, marks=200, missed=9, extra=0, off=0, error_ms=10.0),
        row({A: 4}, marks=200, missed=9, extra=0, off=0, error_ms=70.0),
        row({A: 5}, marks=100, missed=0, extra=0, off=0, error_ms=1.0),
        row({A: 5}, status=FAILED),
    ]
    measures = measures_in(rows)
    found = combinations(rows, measures)
    assert [one.settings[A] for one in found] == [2, 1, 3, 4, 5]
    assert [one.efficient for one in found] == [True, True, True, False, False]
    assert found[1].figures["wrong"] == pytest.approx(4 / 200)
    assert found[1].figures["error_ms"] == pytest.approx(40.0)
    assert (found[-1].failed, found[-1].reasons) == (1, ("no",))
    table = combination_table(found, measures)
    assert table[A].to_pylist() == [2.0, 1.0, 3.0, 4.0, 5.0]
    page = sweep_page([parse_axis(f"{A}=1,2,3,4,5")], found, measures, ["<b>"], "A <i>")
    assert "<b>" not in page
    assert "A <i>" not in page
    assert page.count("◆") == 3 + 1, "and once in the words"


def test_thresholds_change_what_a_recording_shows(tmp_path: Path) -> None:
    (source,) = find_sources([str(TRIAL)])
    store = sweep_store(str(tmp_path))
    store.prepare({})
    tried = [
        Point(),
        Point((("thresholds.heel_rise_share", "x1"),)),
        Point(tuple((f"thresholds.{share}", 50.0) for share in ("push_off_share", "toe_up_share", "rest_share"))),
    ]
    tried.append(Point((("stimulation.strides_before_start", 0),)))
    tried.append(Point((("stimulation.strides_before_start", 20),)))
    for point in tried:
        assert Trial(store, source, point, bench()).done().status == DONE
    by = {row["settings"]: row for row in store.table(RESULTS, store.finished()).to_pylist()}
    plain, same, never, soon, late = (by[point.text()] for point in tried)
    figures = [name for name in plain if name not in ("result", "combination", "settings")]
    assert [plain[name] for name in figures] == [same[name] for name in figures]
    assert plain["valid_strides"] > 25
    assert never["strides"] == 0, "nobody pushes off like that, nor pulls the toe up"
    for name in ("strides", "missed", "extra", "off", "error_ms"):
        assert soon[name] == plain[name], "sample by sample gives what the whole block gives"
    assert soon["bursts"] > late["bursts"]
    assert soon["swings_without"] < late["swings_without"]


def test_a_patient_answers_to_the_settings_and_is_the_same_again(tmp_path: Path) -> None:
    store = sweep_store(str(tmp_path / "out"))
    store.prepare({})
    settings = bench(tuned(tmp_path), 15.0)
    weak, strong = (Point((("channels.current_ma", current),)) for current in (10.0, 30.0))
    for point in (weak, strong):
        assert Trial(store, Patient(1, 7), point, settings).done().status == DONE
    by = {row["settings"]: row for row in store.table(RESULTS, store.finished()).to_pylist()}
    assert by[weak.text()]["strides"] > 5
    assert by[weak.text()]["charge_uc"] < by[strong.text()]["charge_uc"]
    assert Patient(1, 7).settings("left_foot", 2) == Patient(1, 7).settings("left_foot", 2)
    assert Patient(1, 7).settings("left_foot", 2) != Patient(2, 7).settings("left_foot", 2)


def test_another_session_file_is_another_trial(tmp_path: Path) -> None:
    """By what it says: a copy elsewhere is the same, a changed one is not, whatever its time."""
    point, case = Point((("stimulation.intensity", 0.5),)), Patient(1, 7)
    path = tmp_path / "session.toml"
    path.write_text(SESSION.read_text(encoding="utf-8"), encoding="utf-8")
    assert bench(path).identity(case, point) == bench().identity(case, point)
    before, time = bench(path).identity(case, point), path.stat()
    path.write_text(path.read_text(encoding="utf-8").replace("extension_s = 0.06", "extension_s = 0.07"), "utf-8")
    os.utime(path, ns=(time.st_atime_ns, time.st_mtime_ns))
    assert bench(path).identity(case, point) != before
    assert replace(bench(), program="another").identity(case, point) != before


def test_a_failing_combination_stops_nothing_and_what_is_finished_is_not_done_again(tmp_path: Path) -> None:
    for path in TRIALS.glob("soft_contact.*"):
        shutil.copy(path, tmp_path / path.name)
    (tmp_path / "torn.parquet").write_bytes(b"PAR1 torn")
    shutil.copy(tmp_path / "soft_contact.toml", tmp_path / "torn.toml")
    recording, out = tmp_path / "soft_contact.parquet", tmp_path / "out"
    first = sweep(SESSION, recording, "--set", "phases.swing_begins=peak,never", "--out", out, "--workers", "1")
    assert first.exit_code == 1, first.output
    assert "'peak' or 'reversal'" in first.stderr
    assert "1 of 3 trials failed" in first.stderr
    kept = {path: path.stat().st_mtime_ns for path in (out / RESULTS).iterdir()}
    more = ["--set", "phases.swing_begins=peak,reversal", "--out", out, "--workers", "1"]
    second = sweep(SESSION, recording, tmp_path / "torn.parquet", *more)
    assert "2 of 6 are finished already" in second.stderr
    assert "torn.parquet" in second.stderr
    assert second.exit_code == 1
    assert kept.items() <= {path: path.stat().st_mtime_ns for path in (out / RESULTS).iterdir()}.items()
    table = parquet.read_table(out / "combinations.parquet").to_pylist()
    assert [row["phases.swing_begins"] for row in table] == [None, "peak", "reversal"]
    assert {row["failed"] for row in table} == {1}
    assert "torn.parquet" in (out / "index.html").read_text(encoding="utf-8")


class Done(Trial):
    def done(self) -> Outcome:
        return Outcome(self.key, self.name, DONE)


class Dies(Trial):
    def done(self) -> Outcome:
        os._exit(1)


@pytest.mark.slow
def test_what_kills_its_process_is_given_up_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fes.cohort.engine.DEATHS", 0)
    monkeypatch.setattr("fes.cohort.engine.BATCHES", 1)
    store, settings = sweep_store(str(tmp_path / "out")), bench()
    store.prepare({})
    (source,) = find_sources([str(TRIAL)])
    told = [Point((("stimulation.intensity", 0.05 * number),)) for number in range(12)]  # the first go by themselves
    tasks = [(Dies if number == 9 else Done)(store, source, point, settings) for number, point in enumerate(told)]
    with cluster(1) as client:
        outcomes = run_tasks(client, tasks, lambda _: None)
    assert sorted(outcome.status for outcome in outcomes) == [*[DONE] * 11, FAILED]
    (given_up,) = store.table(RESULTS, store.finished()).to_pylist()
    assert given_up["settings"] == told[9].text()
    assert "died" in given_up["reason"]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([SESSION, TRIAL], "Nothing to sweep"),
        ([SESSION, "--set", "stimulation.intensity=1"], "RECORDINGS"),
        ([SESSION, TRIAL, "--patients", "2", "--set", "stimulation.intensity=1"], "one of the two"),
        ([SESSION, "nowhere.csv", "--set", "stimulation.intensity=1"], "no recording"),
        (["nowhere.toml", TRIAL, "--set", "stimulation.intensity=1"], "nowhere.toml"),
        ([SESSION, TRIAL, "--set", "stimulation.intensty=1"], "stimulation.intensity"),
    ],
)
def test_what_cannot_be_used_is_told_at_once(arguments: list[object], told: str) -> None:
    result = sweep(*map(str, arguments))
    assert result.exit_code == 2
    assert told in result.stderr


def test_the_names_are_listed() -> None:
    result = sweep("--names")
    assert result.exit_code == 0
    assert result.output.split() == swept_names()
