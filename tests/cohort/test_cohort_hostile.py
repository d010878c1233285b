"""Cohorts and sweeps under hostile hands: names, storages, schedulers, grids, what others do to the results."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from distributed import Client, LocalCluster
from pyarrow import parquet
from test_cohort import analysed, lay, new_store

from fes.cli import main
from fes.cli.common import STOPPED, UNUSABLE
from fes.cohort.engine import cluster, ended_after, run_tasks
from fes.cohort.page import write_pages
from fes.cohort.store import RECORDINGS, STRIDES, CohortError, Source, Store, find_sources
from fes.cohort.sweep.grid import combinations_of, parse_axis
from fes.cohort.task import DONE, FAILED, Outcome, Rows, Task
from fes.recording import RecordingError
from fes.recording.sidecar import load_sidecar

TRIALS = Path(__file__).parents[2] / "sim_inputs"


@pytest.mark.parametrize(
    "name", [os.fsdecode(b"walk\xff"), "<script>alert(1)</script>".replace("/", "\u2215"), "Ω 歩行 #%41?", "x" * 240]
)
def test_a_name_of_any_kind_is_analysed_and_told(tmp_path: Path, name: str) -> None:
    """Names that are no UTF-8 among them: they were an error in keeping the row, which ended everything.

    Parquet files of such a name cannot be opened; that is then the reason.
    """
    folder = lay(tmp_path / name, name)
    store, outcome = analysed(folder, tmp_path / "out", subject_from="([^/]+)/[^/]*$")
    store.prepare({"recordings": [str(folder)]})
    if name.isprintable():
        assert outcome.status == DONE, outcome.reason
    else:
        assert "walk" in outcome.reason
    (folder / f"{name}.parquet").write_bytes(b"PAR1 torn")
    assert analysed(folder, tmp_path / "out")[1].status == FAILED
    page = Path(write_pages(store, store.finished())).read_text(encoding="utf-8")
    assert "<script>" not in page
    assert len(list((tmp_path / "out" / "subjects").iterdir())) == len(
        {row["subject"] for row in store.table(RECORDINGS, store.finished()).to_pylist()}
    )


def test_a_folder_may_have_brackets_in_its_name(tmp_path: Path) -> None:
    folder = lay(tmp_path / "visit[1]*", "walk")
    assert len(find_sources([str(folder)])) == len(find_sources([str(folder / "walk.parquet")])) == 1


def test_a_sidecar_that_is_a_pipe_holds_nobody_up(tmp_path: Path) -> None:
    folder = lay(tmp_path / "a", "walk")
    (folder / "walk.toml").unlink()
    os.mkfifo(folder / "walk.toml")
    assert len(find_sources([str(folder)])) == 1
    with pytest.raises(RecordingError, match="is no file"):
        load_sidecar(folder / "walk.toml")


@pytest.mark.parametrize("pattern", ["(", r"(?P<subject>\d+", "*"])
def test_a_pattern_that_is_none_is_refused_at_once(tmp_path: Path, pattern: str) -> None:
    folder = lay(tmp_path / "a", "walk")
    given = ["cohort", str(folder), "--out", str(tmp_path / "out"), "--subject-from", pattern]
    result = CliRunner().invoke(main, given)
    assert result.exit_code == 2
    assert "no regular expression" in result.output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("pattern", [r"(P\d+)?/walk", r"(?P<subject>P\d+)?/walk"])
def test_a_group_that_finds_nothing_is_no_subject(pattern: str) -> None:
    assert Source("/d/walk.csv", "").subject(pattern) == ""


@pytest.mark.parametrize("place", ["s3://bucket/x", "http://127.0.0.1:9/x.csv", "zip://*.csv::/nowhere.zip", "az://x"])
def test_a_storage_that_cannot_be_had_is_told(tmp_path: Path, place: str) -> None:
    for given in ([place, "--out", str(tmp_path / "out")], [str(lay(tmp_path / "a", "walk")), "--out", place]):
        result = CliRunner().invoke(main, ["cohort", *given])
        assert result.exit_code == 2, result.output
        assert place in result.output


def test_results_in_memory_are_refused(tmp_path: Path) -> None:
    """Workers would keep them where nobody finds them; it said that 0 of 0 were analysed, and that all was well."""
    result = CliRunner().invoke(main, ["cohort", str(lay(tmp_path / "a", "walk")), "--out", "memory://out"])
    assert result.exit_code == 2
    assert "memory of its own" in result.output


def test_a_storage_with_errors_of_its_own_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    class NoCredentialsError(Exception):
        """As of a cloud's library: no OSError."""

    def refused(_: str) -> None:
        raise NoCredentialsError

    monkeypatch.setattr("fsspec.core.url_to_fs", refused)
    with pytest.raises(CohortError, match="NoCredentialsError"):
        find_sources(["s3://bucket"])


def test_a_damaged_part_is_named_with_what_to_do(tmp_path: Path) -> None:
    folder, out = lay(tmp_path / "a", "walk"), tmp_path / "out"
    analysed(folder, out)
    (part,) = (out / RECORDINGS).iterdir()
    part.write_bytes(part.read_bytes()[:-9])
    result = CliRunner().invoke(main, ["cohort", str(folder), "--out", str(out)])
    assert result.exit_code == 2
    assert f"Delete {part}" in result.output


def test_a_bit_that_fell_over_in_a_part_is_no_number(tmp_path: Path) -> None:
    """Half of such bits gave other numbers without a word; others an error that named no part."""
    rows = [{"recording": "r", "subject": "s", "number": k, "speed_mps": 1.0 + 0.001 * k} for k in range(300)]
    store = new_store(tmp_path)
    store.put("r", {STRIDES: rows, RECORDINGS: [{"recording": "r"}]})
    part, whole = tmp_path / STRIDES / "r.parquet", store.table(STRIDES, ["r"])
    good, pages = part.read_bytes(), parquet.read_metadata(part).row_group(0)
    for column in (pages.column(k) for k in range(pages.num_columns)):
        last = (column.dictionary_page_offset or column.data_page_offset) + column.total_compressed_size - 1
        part.write_bytes(good[:last] + bytes([good[last] ^ 4]) + good[last + 1 :])
        with pytest.raises(CohortError, match=f"{part}: is damaged"):
            store.table(STRIDES, ["r"])
    part.write_bytes(good)
    assert store.table(STRIDES, ["r"]).equals(whole)


def test_a_full_disk_is_left_no_fuller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = new_store(tmp_path)

    def half(path: Path, data: memoryview) -> int:
        with path.open("wb") as file:
            file.write(bytes(data)[: len(data) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(OSError, match="No space left"):
        store.put("r", {RECORDINGS: [{"recording": "r"}]})
    assert not list((tmp_path / RECORDINGS).iterdir())


def test_results_that_another_run_took_away_are_missed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs at once with other settings in one folder; the one whose results were replaced said all was well."""
    folder, out = lay(tmp_path / "a", "walk"), tmp_path / "out"
    analysed(folder, out)

    def other_run(mine: Store, *_: object) -> int:
        mine.remove(mine.finished())
        return 0

    monkeypatch.setattr("fes.cohort.task.drop_replaced", other_run)
    result = CliRunner().invoke(main, ["cohort", str(folder), "--out", str(out)])
    assert result.exit_code == 1, result.output
    assert "0 of 1 recordings analysed" in result.output
    assert "1 results are gone" in result.output


@pytest.fixture
def http_port() -> Iterator[int]:
    """Something that listens and is no scheduler."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            try:
                while True:
                    connection, _ = server.accept()
                    with connection:
                        connection.sendall(b"HTTP/1.0 200 OK\r\n\r\nnothing here\r\n")
            except OSError:
                return

        threading.Thread(target=answer, daemon=True).start()
        yield server.getsockname()[1]


@pytest.mark.usefixtures("collected")
def test_what_is_no_scheduler_is_told(http_port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A web server's answer was taken for the length of an array, and was a fault of the program."""
    monkeypatch.setattr("fes.cohort.engine.CONNECT_S", 1.0)
    with pytest.raises(CohortError, match="no Dask scheduler answers"), cluster(1, f"tcp://127.0.0.1:{http_port}"):
        pass


def test_ctrl_c_is_for_the_process_that_was_asked(capfd: pytest.CaptureFixture[str]) -> None:
    """Workers got it too: each ended with a trace of forty lines."""
    with cluster(1) as client:
        (worker,) = client.run(os.getpid).values()
        os.kill(worker, signal.SIGINT)
        assert list(client.run(os.getpid).values()) == [worker]
    assert "KeyboardInterrupt" not in capfd.readouterr().err  # Dask may trace what ends late, on a busy machine


@dataclass(frozen=True)
class Numbered(Task):
    """A task that keeps nothing; ``does`` what is asked of it with its number."""

    number: int
    does: Callable[[int], object]

    @property
    def key(self) -> str:
        return str(self.number)

    name = key

    def tables(self) -> Rows:
        raise NotImplementedError

    def row(self, status: str, reason: str = "") -> dict[str, Any]:
        raise NotImplementedError

    def done(self) -> Outcome:
        self.does(self.number)
        return Outcome(self.key, self.key, DONE)

    def failed(self, reason: str) -> Outcome:
        return Outcome(self.key, self.key, FAILED, reason)


def numbered(numbers: Iterable[int], does: Callable[[int], object]) -> list[Numbered]:
    return [Numbered(Store("place"), number, does) for number in numbers]


def strange(number: int) -> None:
    """Ends with an error of no kind that anybody foresaw, on every third."""
    if number % 3 == 0:
        raise LookupError(f"strange {number}")


def waits(_: int) -> None:
    threading.Event().wait(0.05)


@pytest.fixture
def threads() -> Iterator[Client]:
    """A cluster in this process."""
    options = {"processes": False, "dashboard_address": None, "silence_logs": 60}
    with LocalCluster(n_workers=1, threads_per_worker=1, **options) as own, Client(own) as client:
        yield client


def test_an_error_nobody_foresaw_costs_one_task_only(threads: Client) -> None:
    outcomes = run_tasks(threads, numbered(range(40), strange), lambda _: None)
    found = {outcome.identity: outcome for outcome in outcomes}
    assert sorted(found) == sorted(map(str, range(40)))
    for key, outcome in found.items():
        assert outcome.status == (DONE if int(key) % 3 else FAILED)
        assert outcome.reason == ("" if int(key) % 3 else f"LookupError: strange {key}")


def hangs(number: int) -> None:
    """Where no other thread gets a turn, as in a compiled loop; every fifth, else it is done."""
    if number % 5 == 0:
        sum(repeat(0))


@pytest.mark.slow
def test_what_hangs_is_ended_and_costs_nobody_else() -> None:
    with cluster(2, limit_s=2.0) as client:
        outcomes = run_tasks(client, numbered(range(1, 9), hangs), lambda _: None, limit_s=2.0)
    assert sorted(outcome.identity for outcome in outcomes) == [str(number) for number in range(1, 9)]
    assert {one.identity: one.reason for one in outcomes if one.status != DONE} == {"5": "took longer than 2 s"}


def left_s() -> float:
    return signal.getitimer(signal.ITIMER_REAL)[0]


def test_the_limit_is_for_each_piece_of_work_the_nearest_counts() -> None:
    def quicker() -> None:
        with ended_after(500.0):
            seen.append(left_s())

    seen: list[float] = []
    with ended_after(1000.0):
        seen.append(left_s())
        other = threading.Thread(target=quicker)
        other.start()
        other.join()
        seen.append(left_s())
        with ended_after(None):
            seen.append(left_s())
    assert [500 < seen[0] <= 1000, 0 < seen[1] <= 500, 500 < seen[2] <= seen[0], 0 < seen[3] <= seen[2]] == [True] * 4
    assert left_s() == 0.0


def test_the_limit_ends_what_lets_no_other_thread_have_a_turn() -> None:
    program = (
        "from itertools import repeat; from fes.cohort.engine import ended_after\nwith ended_after(0.1): sum(repeat(0))"
    )
    done = subprocess.run([sys.executable, "-c", program], timeout=60, check=False)
    assert done.returncode == -signal.SIGALRM


def test_a_scheduler_that_goes_away_is_told(threads: Client) -> None:
    heard: list[Outcome] = []

    def tell(outcome: Outcome) -> None:
        heard.append(outcome)
        if len(heard) == 3:
            own, loop = threads.cluster, threads.loop
            assert own is not None
            assert loop is not None
            loop.add_callback(own.close)

    with pytest.raises(CohortError, match=r"scheduler is gone.* are kept; run the same command again"):
        run_tasks(threads, numbered(range(200), waits), tell)
    assert 3 <= len(heard) < 200


@pytest.mark.parametrize(
    "given",
    [["cohort"], ["sweep", str(TRIALS / "session.toml"), "--set", "phases.swing_begins=peak"]],
    ids=["cohort", "sweep"],
)
def test_no_room_for_the_results_is_an_early_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: Client, given: list[str]
) -> None:
    """Not an unusable input: work was done and is kept, and the same command goes on from there."""

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("fes.cohort.engine.cluster", lambda *_: nullcontext(threads))
    monkeypatch.setattr(Store, "put", full)
    command = [*given, str(lay(tmp_path / "a", "walk")), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == STOPPED, result.output
    assert "results cannot be kept" in result.stderr
    monkeypatch.setattr(Store, "prepare", full)
    result = CliRunner().invoke(main, command)
    assert result.exit_code == UNUSABLE, result.output


@pytest.mark.parametrize(
    "asked",
    [
        "thresholds.heel_rise_share=0:1:" + "9" * 5000,
        "thresholds.heel_rise_share=0:1:1",
        "thresholds.heel_rise_share=1e400",
        "thresholds.heel_rise_share=x1.2.3",
        "thresholds.heel_rise_share=,",
        "thresholds.nothing=1",
        "channels.²..gain=1",
        "=1",
        "thresholds.heel_rise_share",
    ],
)
def test_a_grid_of_nonsense_is_refused_in_words(asked: str) -> None:
    with pytest.raises(CohortError, match=r"^--set"):
        parse_axis(asked)


@pytest.mark.parametrize("text", ["[" * 100_000, "9" * 5000])
def test_what_toml_cannot_read_is_a_word(text: str) -> None:
    """Which the session then refuses, combination by combination."""
    assert parse_axis(f"phases.swing_begins={text}").values == (text,)


@pytest.mark.parametrize(("count", "sample"), [(10_000, None), (10_000, 10), (1000, 2_000_000), (1000, None)])
def test_more_than_can_be_tried_is_refused(count: int, sample: int | None) -> None:
    axes = [
        parse_axis(f"thresholds.{name}=0:1:{count}")
        for name in ("rest_share", "heel_rise_share", "push_off_share", "slowed_share")
    ]
    axes = axes if count > 1000 else axes[:3]
    with pytest.raises(CohortError, match="combinations are"):
        combinations_of(
            [*axes, parse_axis("phases.swing_begins=peak,reversal"), parse_axis(f"channels.tuning.gain=0:1:{count}")],
            sample,
        )


def test_a_sweep_on_more_than_memory_holds_is_refused(tmp_path: Path) -> None:
    given = ["sweep", str(TRIALS / "session.toml"), "--patients", "10000", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main, [*given, "--set", "thresholds.heel_rise_share=0:1:200"])
    assert result.exit_code == 2, result.output
    assert not (tmp_path / "out").exists()
