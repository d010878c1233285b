"""``[thresholds]``: what may be set, what it does, where it is shown, and that the log keeps every value."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from replays import SETTINGS, cut, replay, trial

from fes.cli.cohort import apply_best
from fes.cli.common import Problem
from fes.cohort.sweep.table import Combination
from fes.config import ConfigError, load_session
from fes.config.thresholds import changed_thresholds, describe_thresholds, with_thresholds_table
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.sensor_choice import calibration_from_dict
from fes.estimation.tracking.phase_features import FOLLOW, LEAST, MOST
from fes.recording import write_recording
from fes.report.findings import findings
from fes.report.page import render_report
from fes.report.summary import summarise
from statemachine.guards import Thresholds


def session(folder: Path, table: str) -> Path:
    path = folder / "session.toml"
    path.write_text(f"{SETTINGS.read_text()}\n[thresholds]\n{table}\n")
    return path


def test_numbers_factors_and_flags() -> None:
    own = Thresholds()._replace(fall_radps=10.0)
    new = changed_thresholds(
        own, {"fall_radps": "x1.2", "heel_rise_share": 0.3, "swing_at_reversal": True, "origin": "somebody"}
    )
    assert new == own._replace(fall_radps=12.0, heel_rise_share=0.3, swing_at_reversal=True)
    assert changed_thresholds(own, {}) == own


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("heel_rise = 0.3", "heel_rise is no threshold; perhaps heel_rise_"),
        ("heel_rise_share = 5.0", "outside 0.25 to 4 times the default"),
        ('fall_radps = "x9"', "outside 0.25 to 4 times the default"),
        ('fall_radps = "many"', "must be a number, 0 or more"),
        ("swing_at_reversal = 1.0", "must be true or false"),
        ("rest_share = true", "must be a number, 0 or more"),
        ("rest_share = -1.0", "must be a number, 0 or more"),
    ],
)
def test_what_is_refused_and_with_which_words(tmp_path: Path, table: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_session(session(tmp_path, table))


def test_a_session_that_sets_none_reads_as_it_did() -> None:
    assert "thresholds" not in load_session(SETTINGS).model_dump_json()


def test_a_file_gets_a_new_table_and_loses_the_old_one() -> None:
    text = with_thresholds_table("a = 1\n[thresholds]\nrest_share = 0.2\n\n[live]\nb = 2\n", {"fall_radps": "x1.2"})
    assert text == 'a = 1\n[live]\nb = 2\n\n[thresholds]\nfall_radps = "x1.2"\n'
    assert (
        describe_thresholds({"rest_share": 0.2, "origin": "me"})
        == "thresholds of the session: rest_share 0.2 (from: me)"
    )
    assert describe_thresholds({}) == describe_thresholds({"origin": "me"}) == ""


def test_they_hold_in_a_session_are_shown_and_every_value_is_in_the_log(tmp_path: Path) -> None:
    path = tmp_path / "walk.parquet"
    write_recording(cut(trial("negard_patient2"), 0.0, 30.0), path)
    usual = replay(path, tmp_path / "a")
    table = 'flat_rad = 0.02\nfall_radps = "x1.1"\norigin = "a test"'
    record = replay(path, tmp_path / "b", session(tmp_path, table))
    assert [c.t_ns for c in record.phases] != [c.t_ns for c in usual.phases], "they decide"
    summary = summarise(record)
    line = "Thresholds of the session: flat_rad 0.02, fall_radps x1.1 (from: a test)."
    assert line in [finding.text for finding in findings(summary)]
    page = render_report(record)
    assert line[:-1] in page
    assert "These measures followed the strides" in page

    foot = calibration_from_dict(record.header["calibration"]["right_foot"])
    assert isinstance(foot, FootCalibration)
    calibration = foot.thresholds()
    landings = [change for change in record.phases if change.destination.name == "STANCE"]
    notes = [note for note in record.notes if note.source == "thresholds"]
    assert [note.t_ns for note in notes] == [change.t_ns for change in landings], "one at each landing"
    rows = {row.name: row for row in summary.measures}
    assert rows["fall_radps"].begin == pytest.approx(1.1 * calibration.fall_radps)
    for row in rows.values():
        assert row.strides == len(landings)
        assert (
            LEAST * row.begin <= row.bounds[0] <= row.least <= row.last <= row.most <= row.bounds[1] <= MOST * row.begin
        )
    falls = [float(note.text.split("fall_radps ")[1].split(",")[0]) for note in notes]
    steps = [abs(b - a) for a, b in pairwise(falls)]
    assert max(steps) > 0.0
    assert max(steps) < FOLLOW * 1.6 * max(falls)
    assert not [notice for notice in summary.notices if notice.source == "thresholds"], "a table, not hundreds of notes"


def combination(**settings: object) -> Combination:
    return Combination({name.replace("__", "."): value for name, value in settings.items()}, {}, 1, 0, ())


def test_the_best_of_a_sweep_is_written_with_its_origin(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "best.toml"
    with pytest.raises(Problem, match="nothing to write"):
        apply_best([combination(), combination(thresholds__jerk_share=0.2)], SETTINGS, target, 1)
    best = combination(thresholds__jerk_share=0.2, thresholds__fall_radps="x1.1", phases__swing_begins="reversal")
    apply_best([best, combination()], session(tmp_path, "rest_share = 0.2\njerk_share = 0.9"), target, 3)
    assert load_session(target).thresholds == {
        "rest_share": 0.2,
        "jerk_share": 0.2,
        "fall_radps": "x1.1",
        "origin": "fes sweep: best of 2 combinations on 3 cases",
    }
    assert load_session(target).phases.swing_begins == "peak"
    assert "no thresholds: phases.swing_begins" in capsys.readouterr().out
    apply_best([best, combination()], SETTINGS, target, 3, as_json=True)
    assert capsys.readouterr().out == "", "stdout holds the JSON alone"
    with pytest.raises(Problem, match=r"outside 0\.25 to 4 times"):
        apply_best([combination(thresholds__jerk_share=9.0)], SETTINGS, target, 1)
