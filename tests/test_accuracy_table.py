"""The accuracy table: rows from errors, what passes between us and the peers, and how it is shown."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "benchmarks" / "accuracy" / "accuracy_table.py"


def test_a_row_counts_what_is_finite():
    from benchmarks.accuracy.accuracy_rows import row_of

    row = row_of("set", "length", "cm", "fes x", "causal", [1.0, -2.0, np.nan, 4.0], recall=0.75)
    assert (row.n, row.bias, row.worst, row.recall) == (3, 1.0, 4.0, 0.75)
    assert row.sd == pytest.approx(3.0)
    assert row.rmse == pytest.approx(math.sqrt(7.0))
    assert row.ours
    nothing = row_of("set", "length", "cm", "peer", "causal", [])
    assert nothing.n == 0
    assert nothing.note == "nothing found"
    assert not nothing.ours


def test_bars_hold_for_every_method_alike():
    from benchmarks.accuracy.accuracy_rows import LENGTH_OWN, row_of, with_bar

    good = row_of("gaitmap_walk", LENGTH_OWN, "cm", "fes x", "causal", [1.0, -1.5], 1.0)
    missed_one = row_of("gaitmap_walk", LENGTH_OWN, "cm", "peer", "off-line", [0.1, 0.1], 0.98)
    assert with_bar(good).bar_met is True
    assert with_bar(missed_one).bar_met is False
    assert with_bar(row_of("xio_walk", LENGTH_OWN, "cm", "fes x", "causal", [1.0])).bar_met is None


def test_cases_and_results_survive_their_files_and_a_failure_is_told(tmp_path):
    from benchmarks.peers.exchange import Case, Method, run_all

    rng = np.random.default_rng(1)
    case = Case(
        "a-b", "left", 204.8, rng.normal(size=(9, 3)), rng.normal(size=(9, 3)), np.array([[0, 8]]), ("borders",)
    )
    case.write(tmp_path)
    again = Case.read(tmp_path / "a-b.case.npz")
    assert (again.name, again.side, again.rate_hz, again.tasks) == ("a-b", "left", 204.8, ("borders",))
    assert np.array_equal(again.acc_mps2, case.acc_mps2)

    def fails(_case):
        raise RuntimeError("no such filter\nsecond line")

    run_all(
        tmp_path,
        [
            Method("works", "borders", "causal", lambda c: {"length_m": np.array([float(len(c.acc_mps2))])}),
            Method("fails / badly", "borders", "off-line", fails),
            Method("never asked", "events", "causal", fails),
        ],
    )
    results = {str(data["method"]): dict(data) for data in map(np.load, tmp_path.glob("*.result.npz"))}
    assert set(results) == {"works", "fails / badly"}
    assert results["works"]["length_m"].tolist() == [9.0]
    assert str(results["fails / badly"]["error"]) == "RuntimeError: no such filter"


def test_judging_lengths_lifts_and_failures(tmp_path):
    from benchmarks.peers.cases import Asked, judge, strides_hit
    from benchmarks.peers.exchange import Case, Method, run_all

    zeros = np.zeros((9, 3))
    borders = np.array([[0, 4], [4, 8]])
    cases = [Case(name, "left", 100.0, zeros, zeros, borders, ("borders",)) for name in ("one", "two")]
    for case in cases:
        case.write(tmp_path)

    def run(case):
        if case.name == "two":
            raise ValueError("lost")
        return {"length_m": np.array([1.02, 0.98]), "lift_m": np.array([0.1, np.nan])}

    run_all(tmp_path, [Method("peer", "borders", "causal", run)])
    truth = {"length_m": np.array([1.0, 1.0]), "lift_m": np.array([0.09, 0.1])}
    rows = judge(tmp_path, [Asked(case, "set", **truth) for case in cases])
    length, lift, failure = rows
    assert (length.n, length.rmse, length.recall) == (2, pytest.approx(2.0), 1.0)
    assert (lift.n, lift.bias, lift.recall) == (1, pytest.approx(1.0), 0.5)
    assert failure.note == "failed on 1 of 2 recordings: ValueError: lost"
    assert strides_hit(np.array([0.5, 1.5, 2.5]), np.array([[0.0, 1.0], [2.0, 3.0]])) == 2


def test_our_ends_are_the_quietest_instants_nearby_and_the_truth_is_taken_there():
    from benchmarks.lib.real_sets import PathWalk
    from benchmarks.peers.cases import OUR_ENDS, Asked, at_our_ends
    from benchmarks.peers.exchange import Case
    from fes.datasets.common import even_track

    rate_hz, n = 100.0, 400
    gyr = np.full((n, 3), 2.0)
    for quiet in (104, 297):  # 40 ms after and 30 ms before what the reference says
        gyr[quiet - 4 : quiet + 6] = 0.1
    track = even_track("right_foot", rate_hz, np.tile([0.0, 0.0, 9.81], (n, 1)), gyr)
    way = np.zeros((n, 3))
    way[:, 0] = np.linspace(0.0, 3.99, n)  # a centimetre a sample: a border moved by one shows
    walk = PathWalk("set", "one", track, position_m=way, rate_hz=rate_hz, at_sensor=True)
    borders = np.array([[100, 300], [100, 300]])
    asked = Asked(
        Case("one", "right", rate_hz, track.acc_mps2, track.gyr_radps, borders, ("borders",)),
        "set",
        length_m=np.array([2.0, np.nan]),
        walk=walk,
    )
    moved = at_our_ends(asked)
    assert moved.case.tasks == (OUR_ENDS,)
    assert moved.case.name != asked.case.name
    assert np.abs(moved.case.borders[0] - [104, 297]).max() <= 1
    assert moved.length_m[0] == pytest.approx(0.01 * np.diff(moved.case.borders[0])[0], abs=0.005)
    assert np.isnan(moved.length_m[1])


def test_a_table_lists_the_least_error_first_and_its_bar():
    from benchmarks.accuracy.accuracy_rows import Row, in_order, tables, verdicts

    rows = in_order(
        [
            Row("b", "length", "cm", "peer", "off-line", n=2, rmse=1.0, bar="RMSE ≤ 2", bar_met=True),
            Row("b", "length", "cm", "fes x", "causal", n=2, rmse=3.0, bar="RMSE ≤ 2", bar_met=False),
            Row("a", "rest", "%", "fes y", "causal", n=1, bias=5.0),
            Row("b", "length", "cm", "broken", "causal", note="failed"),
        ]
    )
    assert verdicts(rows) == ["b, length: RMSE ≤ 2: NOT MET by any of our methods"]
    rest, length = tables(rows)
    assert (rest.title, length.title) == ("a: rest (%)", "b: length (cm); bar: RMSE ≤ 2")
    assert list(length.columns[0].cells) == ["peer", "**fes x**", "broken"]


def test_without_recordings_it_says_so(tmp_path):
    done = subprocess.run(
        [sys.executable, TABLE, "--data", tmp_path, "--json", tmp_path / "x.json"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 3
    assert "No recordings" in done.stderr
    assert not (tmp_path / "x.json").exists()


def test_the_lock_holds_hashes_and_no_address():
    text = (ROOT / "locks/peers.lock").read_text()
    assert "://" not in text
    names = {line.split("==")[0] for line in text.splitlines() if "==" in line and not line.startswith(" ")}
    assert {"gaitmap", "gaitmap-mad", "imufusion", "vqf", "ahrs"} <= names
    assert text.count("--hash=sha256:") >= len(names)
