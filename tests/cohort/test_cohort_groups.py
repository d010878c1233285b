"""Cadence, steps, asymmetry and variability of a recording; groups held against each other, on the page too."""

from __future__ import annotations

import csv
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fes.cohort.page import EVERY, cliffs_delta, group_differences, holm, subject_values, write_pages
from fes.cohort.store import RECORDINGS, STRIDES, Store, find_sources
from fes.cohort.task import DONE, Settings, analyse_one
from fes.recording import read_recording, write_recording

TRIALS = Path(__file__).parents[2] / "sim_inputs"
TRIAL = "both_feet_100hz"


def true_strides() -> dict[str, list[dict[str, float]]]:
    """Of the steady walk, by foot; contacts are when the loading response begins."""
    found: dict[str, list[dict[str, float]]] = {}
    with (TRIALS / f"{TRIAL}.strides.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["steady"] == "yes" and row["walking"] == "yes":
                numbers = {key: float(value) for key, value in row.items() if key.startswith(("t_", "stride_length"))}
                found.setdefault(row["foot"], []).append(numbers)
    return found


def test_a_recordings_row_says_what_the_truth_says(tmp_path: Path) -> None:
    for suffix in (".parquet", ".toml"):
        shutil.copy(TRIALS / f"{TRIAL}{suffix}", tmp_path / f"walk{suffix}")
    sidecar = tmp_path / "walk.toml"
    text = sidecar.read_text(encoding="utf-8")
    sidecar.write_text(text.replace("[extra]", '[extra]\ngroup = "after"'), encoding="utf-8")
    store = Store(str(tmp_path / "out"))
    store.prepare({})
    (source,) = find_sources([str(tmp_path / "walk.parquet")])
    assert analyse_one(source, store, Settings()).status == DONE
    (row,) = store.table(RECORDINGS, store.finished()).to_pylist()
    true = true_strides()
    contacts = sorted(stride["t_loading_response_s"] for own in true.values() for stride in own)
    steps_s = np.diff(contacts)
    assert row["group"] == "after"
    assert row["step_time_s"] == pytest.approx(np.median(steps_s), abs=0.02)
    assert row["cadence_per_min"] == pytest.approx(60.0 / np.mean(steps_s), rel=0.03)
    swings = [np.mean([s["t_loading_response_s"] - s["t_swing_s"] for s in own]) for own in true.values()]
    expected = 100.0 * abs(swings[0] - swings[1]) / np.mean(swings)
    assert row["swing_symmetry_percent"] == pytest.approx(expected, abs=2.0)
    lengths = [[s["stride_length_m"] for s in own] for own in true.values()]
    lengths = [[one for one in own if abs(one / np.median(own) - 1) <= 0.3] for own in lengths]  # the last one halts
    variation = 100.0 * np.mean([np.std(own, ddof=1) / np.mean(own) for own in lengths])
    assert row["stride_length_cv_percent"] == pytest.approx(variation, abs=1.0)


def row(name: str, subject: str, group: str, cadence: float | None) -> dict[str, object]:
    blank = dict.fromkeys((measure.name for measure in EVERY), None)
    return {**blank, "recording": name, "subject": subject, "group": group, "cadence_per_min": cadence}


def cohort() -> list[dict[str, object]]:
    """Five slow and four fast subjects, of whom one has three recordings; one without a group, one without a value."""
    slow = [row(f"s{k}", f"S{k}", "stroke", 60.0 + k) for k in range(5)]
    fast = [row(f"h{k}", f"H{k}", "healthy", 110.0 + k) for k in range(4)]
    more = [row("h0b", "H0", "healthy", 0.0), row("h0c", "H0", "healthy", 300.0)]
    return [*slow, *fast, *more, row("x", "X", "", 500.0), row("y", "Y", "stroke", None)]


def test_a_subject_counts_once_by_the_median_of_the_recordings() -> None:
    found = subject_values(cohort(), "cadence_per_min")
    assert {name: sorted(values) for name, values in found.items()} == {
        "healthy": [110.0, 111.0, 112.0, 113.0], "stroke": [60.0, 61.0, 62.0, 63.0, 64.0],
    }  # fmt: skip


def test_groups_apart_have_the_whole_effect_and_the_least_p() -> None:
    (found,) = group_differences(cohort(), EVERY)
    assert (found.first, found.second, found.counts) == ("healthy", "stroke", (4, 5))
    assert found.medians == (111.5, 62.0)
    assert found.delta == 1.0
    assert found.p == pytest.approx(2.0 / math.comb(9, 4))  # two of all orders are as far apart


def test_fewer_than_three_subjects_are_compared_with_nobody() -> None:
    assert group_differences([each for each in cohort() if each["subject"] not in ("H2", "H3")], EVERY) == []
    assert group_differences([], EVERY) == []


def test_effect_and_adjusted_p_by_hand() -> None:
    assert cliffs_delta(np.array([1.0, 3.0]), np.array([2.0, 3.0])) == pytest.approx((1 - 2) / 4)
    # Holm's own order: 4 × 0.005, 3 × 0.01, 2 × 0.03, then the largest is no smaller than the one before
    assert holm(np.array([0.04, 0.01, 0.03, 0.005])) == pytest.approx([0.06, 0.03, 0.06, 0.02])
    assert holm(np.array([0.9, 0.8])) == pytest.approx([1.0, 1.0])


def test_the_page_shows_groups_and_every_measure(tmp_path: Path) -> None:
    store = Store(str(tmp_path))
    store.prepare({})
    for each in cohort():
        known = {"source": f"/x/{each['recording']}.csv", "name": each["recording"], "status": DONE, "duration_s": 60.0}
        stride = {"recording": each["recording"], "subject": each["subject"], "foot": "left_foot", "valid": True}
        stride |= {"t_start_s": 1.0, "t_end_s": 2.0, "stride_length_m": 1.0}
        counts = {"valid_strides": 1, "strides": 1, "samples": 6000}
        store.put(str(each["recording"]), {STRIDES: [stride], RECORDINGS: [{**each, **known, **counts}]})
    page = Path(write_pages(store, store.finished())).read_text(encoding="utf-8")
    part = page.split("<h2>Groups</h2>")[1].split("</section>")[0]
    assert "healthy (4), stroke (5)" in part
    assert "<td>111.5, 62.0</td><td>1.00</td><td>0.016</td>" in part
    assert all(measure.axis in page for measure in EVERY)
    assert "Cadence by recording" in page


def test_feet_with_clocks_of_their_own_are_brought_together(tmp_path: Path) -> None:
    recording = read_recording(TRIALS / f"{TRIAL}.parquet")
    late = replace(recording.tracks["right_foot"], t_ns=recording.tracks["right_foot"].t_ns + 300_000_000)
    late = replace(late, t_sensor_ns=late.t_sensor_ns + 300_000_000)
    tracks = {**recording.tracks, "right_foot": late}
    path = tmp_path / "walk.parquet"
    write_recording(replace(recording, tracks=tracks), path)
    rows = {}
    for sync in (False, True):
        store = Store(str(tmp_path / f"out_{sync}"))
        store.prepare({})
        (source,) = find_sources([str(path)])
        assert analyse_one(source, store, Settings(sync_clocks=sync)).status == DONE
        (rows[sync],) = store.table(RECORDINGS, store.finished()).to_pylist()
    assert rows[False]["step_time_symmetry_percent"] > 40.0
    assert rows[True]["step_time_symmetry_percent"] < 12.0
