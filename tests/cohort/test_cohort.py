"""fes cohort: finding recordings on any storage, results that survive crashes, one bad recording among good ones."""

from __future__ import annotations

import csv
import math
import os
import shutil
import signal
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fes.cli import main
from fes.cohort.engine import cluster, run_tasks
from fes.cohort.page import EVERY, cliffs_delta, group_differences, holm, subject_values, write_pages
from fes.cohort.store import RECORDINGS, STRIDES, CohortError, Source, Store, find_sources
from fes.cohort.task import DONE, FAILED, Analysis, Outcome, Settings
from fes.recording import read_recording, write_recording

TRIALS = Path(__file__).parents[2] / "sim_inputs"
TRIAL = "both_feet_100hz"


def lay(folder: Path, *names: str) -> Path:
    """Copies of one bundled trial, each with its sidecar."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        for suffix in (".parquet", ".toml"):
            shutil.copy(TRIALS / f"{TRIAL}{suffix}", folder / f"{name}{suffix}")
    return folder


def new_store(folder: Path | str) -> Store:
    store = Store(str(folder))
    store.prepare({})
    return store


def analysed(place: Path, out: Path | str, **settings: object) -> tuple[Store, Outcome]:
    """The only recording at a place, analysed into a new store."""
    store = new_store(out)
    (source,) = find_sources([str(place)])
    return store, Analysis(store, source, Settings(**settings)).done()


def rows(store: Store, table: str = RECORDINGS) -> list[dict[str, object]]:
    return list(store.table(table, store.finished()).to_pylist())


def test_folders_globs_and_files_are_found_once_and_only_with_a_sidecar(tmp_path: Path) -> None:
    folder = lay(tmp_path / "a", "one", "two")
    (folder / "truth.parquet").write_bytes(b"no sidecar")
    found = find_sources([str(folder), str(folder / "*.parquet"), str(folder / "one.parquet")])
    assert [source.path.name for source in found] == ["one.parquet", "two.parquet"]
    assert find_sources([str(folder / "truth.parquet")])[0].path.name == "truth.parquet", "a file named outright counts"


def test_text_counts_where_its_sidecar_is_no_other_file_s(tmp_path: Path) -> None:
    folder = lay(tmp_path / "a", "one", "two")
    (folder / "one.txt").write_text("notes beside one.parquet")
    (folder / "two.parquet").rename(folder / "two.txt")
    assert [source.path.name for source in find_sources([str(folder)])] == ["one.parquet", "two.txt"]


@pytest.mark.parametrize("pattern", ["{}/nothing", "{}/*.blf", "nowhere://x"])
def test_nothing_found_is_an_error_that_says_where(tmp_path: Path, pattern: str) -> None:
    with pytest.raises(CohortError, match=r"no recording|cannot be opened"):
        find_sources([pattern.format(tmp_path)])


@pytest.mark.parametrize(
    ("url", "pattern", "subject"),
    [
        ("file:///d/P07/walk1.csv", r"/(P\d+)/", "P07"),
        ("s3://b/x_sub-12_run.csv", r"sub-(?P<subject>\d+)", "12"),
        ("/d/walk1.csv", "Z", ""),
    ],
)
def test_the_subject_is_found_in_the_address(url: str, pattern: str, subject: str) -> None:
    assert Source(url, "").subject(pattern) == subject


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda folder: (folder / "one.toml").write_text("x ="), "TOML"),
        (lambda folder: (folder / "one.parquet").write_bytes(b"PAR1 torn"), "one.parquet"),
        (lambda folder: (folder / "one.parquet").write_bytes(b""), "one.parquet"),
    ],
)
def test_a_bad_recording_is_a_row_with_its_reason(tmp_path: Path, spoil: object, word: str) -> None:
    folder = lay(tmp_path / "a", "one")
    assert callable(spoil)
    spoil(folder)
    store, outcome = analysed(folder / "one.parquet", tmp_path / "out")
    assert outcome.status == FAILED
    (row,) = rows(store)
    assert word in str(row["reason"])
    assert row["subject"] == "a"


def test_half_a_recordings_results_count_as_none(tmp_path: Path) -> None:
    folder, store = lay(tmp_path / "a", "one"), new_store(tmp_path / "out")
    (source,) = find_sources([str(folder)])
    identity = source.identity(Settings().text())
    store.put(identity, {STRIDES: []})
    (tmp_path / "out" / RECORDINGS / f".{identity}.part").write_bytes(b"PAR1")
    (tmp_path / "out" / RECORDINGS / "cut.parquet").touch()  # as a power cut may leave it
    assert store.finished() == set()
    Analysis(store, source, Settings()).done()
    assert store.finished() == {identity}
    assert len(rows(store, STRIDES)) > 20


def test_two_that_do_the_same_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    store = new_store(tmp_path / "out")
    with ThreadPoolExecutor(4) as pool:
        for _ in pool.map(lambda _: store.put("same", {STRIDES: [], RECORDINGS: []}), range(200)):
            pass
    assert store.finished() == {"same"}
    assert sorted(path.name for path in (tmp_path / "out" / STRIDES).iterdir()) == ["same.parquet"]


def test_a_killed_worker_loses_nothing_and_what_is_finished_is_not_done_again(tmp_path: Path) -> None:
    names = [f"walk{number}" for number in range(8)]
    folder, store, settings = lay(tmp_path / "a", *names), new_store(tmp_path / "out"), Settings()
    (folder / "walk3.parquet").write_bytes(b"PAR1 torn")
    sources = find_sources([str(folder)])
    killed: list[int] = []
    with cluster(2) as client:
        victim = next(iter(client.run(os.getpid).values()))

        def tell(outcome: Outcome) -> None:
            if not killed:
                killed.append(victim)
                os.kill(victim, signal.SIGKILL)

        outcomes = run_tasks(client, [Analysis(store, source, settings) for source in sources], tell)
    assert killed
    assert sorted(outcome.identity for outcome in outcomes) == sorted(s.identity(settings.text()) for s in sources)
    found = rows(store)
    assert [row["status"] for row in sorted(found, key=lambda row: str(row["source"]))] == [
        FAILED if name == "walk3" else DONE for name in names
    ]
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / RECORDINGS).iterdir()}
    assert len(before) == len(names)

    result = CliRunner().invoke(main, ["cohort", str(folder), "--out", str(tmp_path / "out")])
    assert result.exit_code == 1, result.output
    assert "8 of 8 are finished already" in result.stderr
    assert "7 of 8 recordings analysed" in result.output
    assert "walk3.parquet" in result.stderr
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / RECORDINGS).iterdir()}
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "walk3.parquet" in page
    assert "7 of 8" in page


def test_pages_name_outliers_and_a_page_a_subject(tmp_path: Path) -> None:
    store = new_store(tmp_path)
    for number in range(12):
        length_m = 2.4 if number == 5 else 1.2 + 0.01 * number
        subject = "A <b>" if number < 6 else "B"
        of = {"recording": f"r{number}", "subject": subject}
        stride = {"foot": "left_foot", "valid": True, "t_start_s": 1.0, "t_end_s": 2.0, "stride_length_m": length_m}
        row = {**of, "source": f"/x/{number}.csv", "name": f"walk {number}", "status": DONE, "duration_s": 60.0}
        row |= {"stride_length_m": length_m, "valid_strides": 1, "strides": 1, "samples": 6000, "clipped": 3 * number}
        store.put(f"r{number}", {STRIDES: [{**of, **stride}], RECORDINGS: [row]})
    place = write_pages(store, store.finished())
    page = Path(place).read_text(encoding="utf-8")
    assert "Far from the others" in page
    assert "stride length 2.40 m" in page
    assert "walk 4<" not in page.split("Distributions")[0], "not an outlier"
    assert "A <b>" not in page, "escaped"
    pages = sorted(path.name for path in (tmp_path / "subjects").iterdir())
    assert len(pages) == 2
    assert "33 samples clipped" in (tmp_path / "subjects" / pages[1]).read_text(encoding="utf-8")


# --- Cadence, steps, asymmetry and variability of a recording; groups held against each other ---


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
    lay(tmp_path, "walk")
    sidecar = tmp_path / "walk.toml"
    text = sidecar.read_text(encoding="utf-8")
    sidecar.write_text(text.replace("[extra]", '[extra]\ngroup = "after"'), encoding="utf-8")
    store, outcome = analysed(tmp_path / "walk.parquet", tmp_path / "out")
    assert outcome.status == DONE
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
    store = new_store(tmp_path)
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
        store, outcome = analysed(path, tmp_path / f"out_{sync}", sync_clocks=sync)
        assert outcome.status == DONE
        (rows[sync],) = store.table(RECORDINGS, store.finished()).to_pylist()
    assert rows[False]["step_time_symmetry_percent"] > 40.0
    assert rows[True]["step_time_symmetry_percent"] < 12.0
