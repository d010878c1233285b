"""The timing check: what is missed, extra, early or late is counted as such, and the exit code says so."""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given
from hypothesis import strategies as st

from fes.cli.main import main
from fes.evaluation.trigger_timing import (
    TRUTH_TOLERANCE_MS,
    Bounds,
    Mark,
    check_latency,
    heel_lifts,
    judge_timing,
    marks_of_commands,
    marks_of_phases,
    marks_of_truth,
    pair_times,
    timing_rows,
)
from fes.session_log.framing import RecordType
from fes.signals import StimCommand
from fes.simulation.truth import load_truth
from statemachine.phases import Phase, PhaseChange, Transition
from tests.replays import MS, TRIALS, rewritten


def run_fes(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [*map(str, arguments)])


NO_LATENCY = check_latency(np.zeros(0, np.int64), None)


def at(*times_ms: float, what: str = "T2", who: str = "left_foot") -> list[Mark]:
    return [Mark(round(t * MS), who, what) for t in times_ms]


def test_each_kind_of_error_is_counted() -> None:
    expected = at(1000, 2000, 3000, 4000, 5000)
    found = at(1010, 1900, 3100, 4600, 5000)
    (row,) = timing_rows(expected, found, {"T2": 60.0}, 1.0)
    assert (row.expected, row.found, row.missed, row.extra, row.early, row.late) == (5, 5, 1, 1, 1, 1)
    assert row.median_ms == pytest.approx(5.0)
    assert row.p5_ms == pytest.approx(np.percentile([10, -100, 100, 0], 5))
    assert row.p95_ms == pytest.approx(np.percentile([10, -100, 100, 0], 95))


def test_feet_and_transitions_are_kept_apart() -> None:
    expected = at(1000) + at(1000, what="T3") + at(1000, who="right_foot")
    found = at(1000, what="T3") + at(1005) + at(1000, who="channel 0", what="on")
    rows = {(row.who, row.what): row for row in timing_rows(expected, found, {}, 10.0)}
    assert {key: (row.missed, row.extra) for key, row in rows.items()} == {
        ("left_foot", "T2"): (0, 0),
        ("left_foot", "T3"): (0, 0),
        ("right_foot", "T2"): (1, 0),
        ("channel 0", "on"): (0, 1),
    }
    assert np.isnan(rows["right_foot", "T2"].median_ms)


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
    (row,) = timing_rows(at(*times), at(*found), {}, 50.0)
    assert (row.missed, row.extra) == (len(lost), 0)
    if found:
        assert row.median_ms == pytest.approx(shift)
        assert (row.early, row.late) == ((len(found), 0) if shift < -50 else (0, len(found) if shift > 50 else 0))


def test_bounds_are_held_against_the_sums() -> None:
    rows = timing_rows(at(1000, 2000, 3000), at(1100, 2000), {}, 60.0)
    broken = judge_timing("x", rows, NO_LATENCY, Bounds()).broken
    assert broken == ("1 missed, at most 0 may be", "1 late, at most 0 may be")
    assert judge_timing("x", rows, NO_LATENCY, Bounds(missed=1, late=1)).broken == ()
    assert judge_timing("x", (), NO_LATENCY, Bounds()).broken == (
        "there is nothing to compare: neither side has a transition",
    )


def test_the_latency_budget_is_for_99_percent() -> None:
    rows = timing_rows(at(1000), at(1000), {}, 60.0)
    latency_ns = np.full(1000, MS // 2)
    latency_ns[:9] = 20 * MS
    latency = check_latency(latency_ns, 1.0)
    assert (latency.over, latency.max_ms, latency.p50_ms) == (9, 20.0, 0.5)
    assert judge_timing("x", rows, latency, Bounds(latency_budget_ms=1.0)).broken == ()
    latency_ns[:11] = 20 * MS
    slow = judge_timing("x", rows, check_latency(latency_ns, 1.0), Bounds(latency_budget_ms=1.0))
    assert "99 % of the decisions took 20.00 ms, the budget is 1 ms" in slow.broken
    unknown = judge_timing("x", rows, NO_LATENCY, Bounds(latency_budget_ms=1.0))
    assert "no decision's latency is recorded" in unknown.broken[0]


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
    marks = marks_of_truth(truth, {"left_foot", "right_foot"})
    both = [mark for mark in marks if mark.what == "T5"]
    assert 7 <= len(both) <= 14, "seven heel lifts, and weight shifts"
    assert {mark.who for mark in marks_of_truth(truth, {"left_foot"})} == {"left_foot"}
    soft = marks_of_truth(load_truth(TRIALS / "soft_contact.parquet"), {"right_foot"})
    assert [sum(mark.what == what for mark in soft) for what in ("T1", "T2", "T3", "T4", "T6")] == [30, 30, 0, 0, 30]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundled trial replayed with its timing checked: within the default bounds, and said so."""
    out = tmp_path_factory.mktemp("timing")
    trial = TRIALS / "negard_patient2.parquet"
    done = run_fes("replay", trial, "--check-timing", "--json", "--no-report", "--stimulator", "none", "--out", out)
    assert done.exit_code == 0, done.stderr
    assert "Timing: within its bounds" in done.stderr
    timing = json.loads(done.stdout)["timing"]
    assert timing["against"] == "the truth of negard_patient2.parquet"
    rows = {row["what"]: row for row in timing["rows"]}
    assert sorted(rows) == ["T1", "T2", "T3", "T4"]
    for what, row in rows.items():
        assert (row["expected"], row["found"], row["missed"], row["extra"]) == (45, 45, 0, 0)
        assert row["tolerance_ms"] == TRUTH_TOLERANCE_MS[what]
    assert timing["latency"]["steps"] > 45_000
    return next(out.glob("*/session.feslog"))


def test_bounds_decide_the_exit_code(log: Path, tmp_path: Path) -> None:
    trial = TRIALS / "example_csv.csv"
    common = ("replay", trial, "--check-timing", "--no-report", "--stimulator", "none", "--out", tmp_path)
    common += ("--tolerance-ms", "60")
    tight = run_fes(*common)
    assert tight.exit_code == 1
    assert "late, at most 0 may be" in tight.stderr
    assert "Timing against the truth of example_csv.csv" in tight.stdout
    assert run_fes(*common, "--max-late", "10").exit_code == 0
    slow = run_fes(*common, "--max-late", "10", "--latency-budget-ms", "0.000001")
    assert slow.exit_code == 1
    assert "the budget is 1e-06 ms" in slow.stderr


def test_a_log_against_itself_and_against_a_changed_one(log: Path, tmp_path: Path) -> None:
    own = run_fes("replay", log, "--check-timing", "--json")
    assert own.exit_code == 0, own.stderr
    rows = json.loads(own.stdout)["timing"]["rows"]
    assert {row["what"] for row in rows} >= {"T1", "T2", "T3", "T4", "on", "off"}
    assert all(row["median_ms"] == row["p95_ms"] == row["missed"] == 0 for row in rows)

    dice = random.Random(3)

    def change(kind: int, payload: bytes) -> bytes:
        """The earlier log had every T2 30 ms sooner."""
        if kind == RecordType.PHASE and payload[9] == Transition.T2:
            t_ns = int.from_bytes(payload[:8], "little") - 30 * MS - dice.randrange(1000)
            return t_ns.to_bytes(8, "little") + payload[8:]
        return payload

    earlier = rewritten(log, tmp_path / "earlier.feslog", change)
    other = run_fes("replay", log, "--check-timing", "--against", earlier, "--json")
    assert other.exit_code == 1
    rows = {row["what"]: row for row in json.loads(other.stdout)["timing"]["rows"]}
    assert rows["T2"]["late"] == 45
    assert rows["T2"]["median_ms"] == pytest.approx(30, abs=0.01)
    assert rows["T3"]["late"] == 0
    assert run_fes("replay", log, "--check-timing", "--against", earlier, "--tolerance-ms", "40").exit_code == 0
    changed = run_fes("replay", earlier, "--check-timing", "--tolerance-ms", "40")
    assert changed.exit_code == 0, "with a timing check it is the timing that counts, not the bytes"
    assert "Not the same when replayed" in changed.stderr


def test_a_log_against_the_truth_of_its_recording(log: Path) -> None:
    done = run_fes("replay", log, "--check-timing", "--against", TRIALS / "negard_patient2.parquet", "--json")
    assert done.exit_code == 0, done.stderr
    assert {row["what"] for row in json.loads(done.stdout)["timing"]["rows"]} == {"T1", "T2", "T3", "T4"}


def test_nothing_to_compare_with_is_said_at_once(log: Path, tmp_path: Path) -> None:
    for name in ("example_csv.csv", "example_csv.toml"):
        (tmp_path / name).write_bytes((TRIALS / name).read_bytes())
    without = run_fes("replay", tmp_path / "example_csv.csv", "--check-timing", "--out", tmp_path / "out")
    assert without.exit_code == 2
    assert "has no truth beside it" in without.stderr
    assert not (tmp_path / "out").exists(), "before anything is replayed"
    unasked = run_fes("replay", log, "--max-late", "3")
    assert unasked.exit_code == 2
    assert "--max-late has a meaning only with --check-timing" in unasked.stderr
    gone = run_fes("replay", log, "--check-timing", "--against", tmp_path / "gone.feslog")
    assert gone.exit_code == 2
    assert "cannot be read" in gone.stderr
