"""Sessions side by side: what changed is found, what stands in the way is said, and the page holds it all."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import report_records as make
from click.testing import CliRunner, Result

from fes.cli import main
from fes.evaluation.agreement import difference, mean_of
from fes.report.comparison.page import (
    SessionComparison,
    compare_sessions,
    height_curve,
    pitch_curve,
    render_comparison,
    sketch,
)
from fes.report.comparison.session import (
    AS_DECIDED,
    OFF_LINE,
    ComparedSession,
    ComparisonProblem,
    detectable_change,
    of_record,
    read_compared,
    with_the_same_timing,
)
from fes.session_log import SessionRecord
from fes.signals import StrideResult

TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"


def record(
    *, longer_m: float = 0.0, belt_mps: float = make.BELT_MPS, subject: str = "P07", **more: Any
) -> SessionRecord:
    """A walk by hand, both feet, stimulated; its strides longer, without samples, so that they stand as they are."""
    walk = make.walk(30, **more)
    walk.samples = {}
    walk.header["session"]["subject"] = subject
    walk.header["recording"]["belt_speed_mps"] = belt_mps
    walk.strides = [replace(s, stride_length_m=s.stride_length_m + longer_m) for s in walk.strides]
    return walk


def compared(label: str, **more: Any) -> ComparedSession:
    return of_record(record(**more), label, Path(f"{label}.feslog"))


@pytest.fixture(scope="module")
def both() -> SessionComparison:
    return compare_sessions([compared("before"), compared("after", longer_m=0.1, belt_mps=0.65, seed=9)])


def row(comparison: SessionComparison, key: str, side: str = "left") -> Any:
    return next(each for each in comparison.parameters if each.about.key == key and each.side == side)


def test_a_change_is_found_with_its_interval(both):
    found = row(both, "stride_length_common_m")
    assert found.means[0].n == 30
    assert found.changes[0].value == pytest.approx(0.1, abs=0.02)
    assert found.clear(0)
    assert found.changes[0] == difference(*found.means)
    assert row(both, "lift_m").changes[0].value == pytest.approx(0.0, abs=0.01)
    assert any("Stride length †, left: 0.63 (before) → 0.73 m (after)" in f.text for f in both.changes)


def test_what_stands_in_the_way_is_said(both):
    text = " ".join(finding.text for finding in both.confounders)
    assert "differ in belt speed by 0.20 m/s (0.45 and 0.65): parameters marked †" in text
    assert both.speed_differs
    people = compare_sessions([compared("a"), compared("b", subject="P08")])
    assert people.confounders[0].level == "alert"
    assert "two people" in people.confounders[0].text
    assert not people.speed_differs
    torn = record()
    torn.complete, torn.lost = False, "the last 2 s"
    cut = compare_sessions([compared("a"), of_record(torn, "b", Path("b.feslog"))])
    assert any(
        f.level == "alert" and f.text.startswith("b: The session log has no proper end") for f in cut.confounders
    )


def test_one_session_with_and_one_without_stimulation():
    off = record()
    off.commands, off.statuses = [], []
    result = compare_sessions([of_record(off, "off", Path("off")), compared("on")])
    page = render_comparison(result)
    assert "stimulation: none" in page
    assert re.search(r"stimulation: 9\d % of strides, up to 20.0 mA", page)
    told = result.to_json()["sessions"]
    assert [each["stimulated_share"] for each in told] == [0.0, pytest.approx(28 / 30)]
    assert told[1]["channels"][0]["charge_uc"] > 1000


def test_a_log_without_samples_is_taken_as_it_was_decided_and_that_is_told(both):
    assert {session.how for session in both.sessions} == {AS_DECIDED}
    mixed = compare_sessions([both.sessions[0], replace(both.sessions[1], how=OFF_LINE)])
    assert any("methods differ" in finding.text for finding in mixed.confounders)
    left = both.sessions[1].sides["left"]
    shank = replace(both.sessions[1], sides={**both.sessions[1].sides, "left": replace(left, sensor="left_shank")})
    told = compare_sessions([both.sessions[0], shank]).confounders
    assert any("those of the left foot sensor, after's of the left shank's" in finding.text for finding in told)
    empty = record()
    empty.strides = []
    with pytest.raises(ComparisonProblem, match="holds no stride that can be used"):
        of_record(empty, "x", Path("x.feslog"))


def test_symmetry_before_and_after(both):
    found = next(each for each in both.symmetry if each.about.key == "lift_m")
    assert (found.first, found.second) == ("left", "right")
    assert found.indices[0].value == pytest.approx(200 * 0.02 / 0.22, abs=6.0)  # the right foot is lifted 2 cm less
    turned = compare_sessions(both.sessions, paretic="right")
    other = next(each for each in turned.symmetry if each.about.key == "lift_m")
    assert other.indices[0].value == pytest.approx(-found.indices[0].value)


def test_events_that_were_not_found_off_line_in_one_session_are_used_in_none(both):
    known = {"swing_s": np.full(30, 0.5), "stance_s": np.full(30, 0.9)}
    lost = {"swing_s": np.full(30, np.nan), "stance_s": np.full(30, np.nan)}
    first, second = both.sessions
    good = replace(first, sides={"left": replace(first.sides["left"], values=known, by_phases=known)})
    bad = replace(second, sides={"left": replace(second.sides["left"], values=lost, by_phases=known)})
    kept, why = with_the_same_timing([good, good])
    assert not why
    assert kept == [good, good]
    changed, why = with_the_same_timing([good, bad])
    assert "after, left: foot off and contact were found off-line in only 0 of 30" in why
    assert changed[1].sides["left"].values is known


def test_the_least_detectable_change_is_only_given_where_somebody_measured_it():
    assert detectable_change("swing_share", 0.5, belt=True).value == 0.042
    assert detectable_change("speed_mps", 0.5, belt=True) is None
    assert [detectable_change("speed_mps", v, belt=False).value for v in (0.3, 0.6, 1.0)] == [0.05, 0.11, 0.21]
    assert detectable_change("toe_clearance_m", 0.5, belt=False) is None


def test_curves_are_of_the_strides():
    strides = [make.stride(k, 1.4 * k, clearance_m=c) for k, c in enumerate((0.10, 0.12, 0.14))]
    height, pitch = height_curve(strides), pitch_curve(strides)
    assert height.mean.max() == pytest.approx(12.0, abs=0.2)
    assert height.sd[height.mean.argmax()] == pytest.approx(2.0, abs=0.1)
    assert height.x[-1] == pytest.approx(make.LENGTH_M, abs=0.01)
    assert pitch.mean.min() == pytest.approx(-58, abs=3)
    bare: list[StrideResult] = [replace(s, trajectory_m=np.zeros((0, 3)), pitch_rad=np.zeros(0)) for s in strides]
    assert height_curve(bare) is None
    assert pitch_curve(bare) is None
    assert sketch(difference(mean_of([1.0]), mean_of([2.0])), 1.0, "#000") == ""


def test_the_page_is_whole_safe_and_always_the_same(both):
    hostile = replace(both.sessions[1], label='<script>alert("x")</script>')
    page = render_comparison(compare_sessions([both.sessions[0], hostile]))
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert not re.search(r"https?://|url\(|@import", page)
    assert page == render_comparison(compare_sessions([both.sessions[0], hostile]))
    assert page.count('tabindex="0"') > 20  # definitions open by keyboard, too
    for name in ("Foot height, left", "Foot pitch, right", "Symmetry", "mC", "Welch"):
        assert name in page
    three = render_comparison(compare_sessions([*both.sessions, compared("later", seed=4)]))
    assert "after against before." in three
    assert "later against before." in three


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(main, ["compare", *map(str, arguments)])


def test_the_command_on_recordings(tmp_path):
    out = tmp_path / "page.html"
    trial = TRIALS / "both_feet_100hz.parquet"
    done = run(trial, trial, "--report", out, "--json", "--label", "one", "--label", "two")
    assert done.exit_code == 0, done.output
    told = json.loads(done.output, parse_constant=pytest.fail)
    assert out.stat().st_size > 50_000
    assert [each["label"] for each in told["sessions"]] == ["one", "two"]
    changes = [change for each in told["parameters"] for change in each["changes"]]
    assert len(changes) > 40
    assert all(change["value"] in (0.0, None) and not change["clear"] for change in changes)
    assert {each["side"] for each in told["parameters"]} == {"left", "right"}
    assert read_compared(trial, "x").how == OFF_LINE


def test_what_the_command_refuses(tmp_path):
    trial = TRIALS / "example_csv.csv"
    page = tmp_path / "x.html"
    (tmp_path / "empty").mkdir()
    for arguments, message in (
        ((trial, "--report", page), "two to 6 sessions, not 1"),
        ((*[trial] * 7, "--report", page), "two to 6 sessions, not 7"),
        ((trial, trial, "--report", page, "--label", "a"), "1 labels for 2 sessions"),
        ((trial, trial, "--report", page, "--label", "a", "--label", "a"), "must be different"),
        ((trial, trial, "--report", trial), "is one of the sessions"),
        ((trial, tmp_path / "gone.feslog", "--report", page), "gone.feslog"),
        ((trial, tmp_path / "empty", "--report", page), "holds 0 session logs"),
        ((trial, trial, "--label", "a"), "belong to --report"),
        ((trial, trial, trial), "two session logs, not 3"),
    ):
        done = run(*arguments)
        assert done.exit_code == 2, (arguments, done.output)
        assert message in done.output.replace("\n", " ")
    assert not page.exists()
