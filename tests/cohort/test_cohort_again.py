"""What makes a cohort do a recording again: each file that it rests on, settings, program; and what a crash leaves."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import fsspec
import pytest
from click.testing import CliRunner
from processes import gone_after_s
from pyarrow import parquet
from test_cohort import analysed, new_store

from fes.cli import main
from fes.cohort.store import (
    EVENTS,
    LARGEST_SIDECAR,
    RECORDINGS,
    STRIDES,
    Source,
    Store,
    files_named_in,
    find_sources,
    local_copy,
    program,
)
from fes.cohort.sweep.task import TRUTH_FILES
from fes.cohort.task import DONE, FAILED, Analysis, Settings, drop_replaced

TRIAL = Path(__file__).parents[2] / "sim_inputs" / "both_feet_100hz.parquet"
SECOND = "other.parquet"


def two_files(folder: Path, name: str = "walk") -> Path:
    """The bundled trial with the left foot in a file of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    table = parquet.read_table(TRIAL)
    sidecar = TRIAL.with_suffix(".toml").read_text(encoding="utf-8")
    left, right = ([n for n in table.column_names if not n.startswith(side)] for side in ("right", "left"))
    parquet.write_table(table.select(right), folder / f"{name}.parquet")
    parquet.write_table(table.select(left), folder / SECOND)
    text = sidecar.replace("[sensors.left_foot]", f'[sensors.left_foot]\nfile = "{SECOND}"')
    (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    return folder


def identity(folder: Path, settings: Settings | None = None) -> str:
    (source,) = find_sources([str(folder)])
    return source.identity((settings or Settings()).text())


def same_size_later(path: Path) -> None:
    """One byte changed; a clock that ticks coarsely shows it as well."""
    data, before = bytearray(path.read_bytes()), path.stat()
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 1_000_000))


def sidecar_kept_in_time(folder: Path) -> None:
    """Another sidecar of the same length and time, as by a copy that keeps times."""
    path = folder / "walk.toml"
    before = path.stat()
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("belt_speed_mps = 1.2", "belt_speed_mps = 1.3"), encoding="utf-8")
    assert path.read_text(encoding="utf-8") != text
    assert path.stat().st_size == before.st_size
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.parametrize(
    "change",
    [
        lambda folder: same_size_later(folder / "walk.parquet"),
        lambda folder: same_size_later(folder / SECOND),
        lambda folder: (folder / SECOND).unlink(),
        sidecar_kept_in_time,
    ],
)
def test_a_change_in_any_file_makes_it_another_recording(tmp_path: Path, change: Callable[[Path], None]) -> None:
    folder = two_files(tmp_path / "a")
    before = identity(folder)
    assert identity(folder) == before
    change(folder)
    assert identity(folder) != before


def test_settings_and_program_make_it_another_recording_and_touching_the_sidecar_does_not(tmp_path: Path) -> None:
    folder = two_files(tmp_path / "a")
    (source,) = find_sources([str(folder)])
    found = {identity(folder), identity(folder, Settings(level=False)), identity(folder, Settings(subject_from="P"))}
    found.add(Source(source.url, source.mark, "another").identity(Settings().text()))
    assert len(found) == 4
    (folder / "walk.toml").touch()
    assert identity(folder) in found


def test_the_program_is_known_by_its_sources(tmp_path: Path) -> None:
    """In a copy: a line changed anywhere is another program, though the version is the same."""
    for package in ("fes", "drivers", "statemachine"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(Path(__file__).parents[2] / package, tmp_path / package, ignore=ignored)
    code = "from fes.cohort.store import program; print(program())"

    def told() -> str:
        asked = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True,
            env=dict(os.environ) | {"PYTHONPATH": str(tmp_path)},
        )  # fmt: skip
        return asked.stdout.strip()

    first = told()
    path = tmp_path / "statemachine" / "guards.py"
    path.write_text(path.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    assert told() != first
    assert told().split("+")[0] == first.split("+")[0] == program().split("+")[0]


def test_a_truth_counts_where_results_rest_on_it(tmp_path: Path) -> None:
    folder = two_files(tmp_path / "a")
    truth = folder / "walk.strides.csv"
    truth.write_text("a", encoding="utf-8")
    (plain,), (with_truth,) = find_sources([str(folder)]), find_sources([str(folder)], TRUTH_FILES)
    truth.write_text("ab", encoding="utf-8")
    assert find_sources([str(folder)]) == [plain]
    assert find_sources([str(folder)], TRUTH_FILES) != [with_truth]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (b'[sensors.left_foot]\nfile = "b.csv"\n[sensors.right_foot]\nfile = "a.csv"', ("a.csv", "b.csv")),
        (b'\xef\xbb\xbf[can]\ndbc = "../x.dbc"', ("../x.dbc",)),
        (b'[sensors.left_foot]\nfile = 3\n[can]\ndbc = ""', ()),
        (b"sensors = 3\ncan = []", ()),
        (b"x =", ()),
        (b"\xff\xfe", ()),
        (b"x = " + b"[" * 100_000, ()),
    ],
)
def test_what_a_sidecar_names(text: bytes, names: tuple[str, ...]) -> None:
    assert files_named_in(text) == names


def test_a_sidecar_of_any_size_is_survived(tmp_path: Path) -> None:
    folder = two_files(tmp_path / "a")
    before = identity(folder)
    with (folder / "walk.toml").open("ab") as file:
        file.write(b"#" * (LARGEST_SIDECAR + 1))
    assert identity(folder) != before


def test_a_recordings_further_files_are_fetched_too(tmp_path: Path) -> None:
    """From memory and from an archive, the rows are those of the files."""
    folder = two_files(tmp_path / "a")
    memory = fsspec.filesystem("memory")
    archive = tmp_path / "walks.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for path in folder.iterdir():
            file.write(path, f"deep/{path.name}")
            memory.pipe_file(f"/again/deep/{path.name}", path.read_bytes())
    strides = []
    for number, place in enumerate((str(folder), "memory://again", f"zip://deep/walk.parquet::{archive}")):
        (source,) = [each for each in find_sources([place]) if each.path.stem == "walk"]
        store = new_store(f"memory://again_results{number}")
        outcome = Analysis(store, source, Settings()).done()
        assert outcome.status == DONE, outcome.reason
        rows = store.table(STRIDES, store.finished()).to_pylist()
        assert len(rows) > 20
        assert len(store.table(EVENTS, store.finished()))
        strides.append([{**row, "recording": "", "subject": ""} for row in rows])
    assert {row["foot"] for row in strides[0]} == {"left_foot", "right_foot"}
    assert strides[0] == strides[1] == strides[2]
    (before,) = [each for each in find_sources(["memory://again"]) if each.path.stem == "walk"]
    memory.pipe_file(f"/again/deep/{SECOND}", b"PAR1")
    (after,) = [each for each in find_sources(["memory://again"]) if each.path.stem == "walk"]
    assert before.mark != after.mark


@pytest.mark.parametrize("dbc", ["x.dbc", "sub/x.dbc", "../x.dbc", "../../x.dbc"])
def test_a_dbc_comes_along_from_where_the_sidecar_says(dbc: str) -> None:
    memory = fsspec.filesystem("memory")
    root = f"/dbc{dbc.count('.')}{dbc.count('/')}"
    memory.pipe_file(f"{root}/study/P1/walk.log", b"(0.0) can0 101#00")
    memory.pipe_file(f"{root}/study/P1/walk.toml", f'[can]\ndbc = "{dbc}"'.encode())
    memory.pipe_file(os.path.normpath(f"{root}/study/P1/{dbc}"), b"a DBC")
    (source,) = find_sources([f"memory:/{root}"])
    with local_copy(source) as path:
        assert (path.parent / dbc).read_bytes() == b"a DBC"


@pytest.mark.parametrize("name", ["/{}/x.dbc", "../../../../../../../../../../../{}/x.dbc"])
def test_nothing_is_written_where_a_sidecar_wants_it(tmp_path: Path, name: str) -> None:
    memory = fsspec.filesystem("memory")
    outside = name.format(str(tmp_path).lstrip("/"))
    memory.pipe_file("/evil/walk.log", b"(0.0) can0 101#00")
    memory.pipe_file("/evil/walk.toml", f'[can]\ndbc = "{outside}"'.encode())
    memory.pipe_file(f"{tmp_path}/x.dbc", b"mine")
    (source,) = find_sources(["memory://evil"])
    with local_copy(source) as path:
        assert path.read_bytes()
    assert not list(tmp_path.iterdir())


def test_what_was_done_anew_replaces_what_was_there(tmp_path: Path) -> None:
    """The folder is read as one table by others: no recording may be in it twice; nobody else's may go."""
    folder = two_files(tmp_path / "a")
    store, _ = analysed(folder, tmp_path / "out")
    sources = find_sources([str(folder)])
    store.put("others", {RECORDINGS: [{"recording": "others", "source": "file:///elsewhere", "status": FAILED}]})
    assert drop_replaced(store, sources, Settings()) == 0
    (folder / "walk.toml").write_text((folder / "walk.toml").read_text(encoding="utf-8") + "\n", encoding="utf-8")
    sources = find_sources([str(folder)])
    assert drop_replaced(store, sources, Settings()) == 0, "not done anew yet"
    Analysis(store, sources[0], Settings()).done()
    assert drop_replaced(store, sources, Settings()) == 1
    assert store.finished() == {"others", sources[0].identity(Settings().text())}
    for table in (STRIDES, EVENTS):
        assert len(list((tmp_path / "out" / table).iterdir())) == 1
        whole = parquet.read_table(tmp_path / "out" / table)
        assert set(whole["recording"].to_pylist()) == {sources[0].identity(Settings().text())}


def group_of(leader: int) -> list[int]:
    """The processes of a process group."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            if int(path.read_text().rpartition(")")[2].split()[2]) == leader:
                found.append(int(path.parent.name))
    return found


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc on this system")
def test_after_a_kill_of_everything_only_the_rest_is_done(tmp_path: Path) -> None:
    """The command and its workers are killed outright in the middle; the same command does the rest and no more."""
    folder, out = tmp_path / "a", tmp_path / "out"
    count, some = 40, 8  # what is left takes seconds: long enough to be killed in the middle of
    folder.mkdir()
    for number in range(count):
        for suffix in (".parquet", ".toml"):
            shutil.copy(TRIAL.with_suffix(suffix), folder / f"walk{number:02d}{suffix}")
    (folder / "walk05.parquet").write_bytes(b"PAR1 torn")
    command = [str(Path(sys.executable).with_name("fes")), "cohort", str(folder), "--out", str(out), "--workers", "2"]
    kept = out / RECORDINGS

    def finished() -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in kept.glob("*.parquet")} if kept.is_dir() else {}

    first = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while len(finished()) < some:
            assert first.poll() is None, "ended by itself before it could be killed"
            time.sleep(0.01)
    finally:
        group = group_of(first.pid)
        os.killpg(first.pid, signal.SIGKILL)
        first.wait()
    gone_after_s(group, time.monotonic_ns())  # one that was writing may still have put its file in place
    before = finished()
    assert some <= len(before) < count
    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.returncode == 1, again.stderr
    assert f"{len(before)} of {count} are finished already" in again.stderr
    assert f"{count - 1} of {count} recordings analysed" in again.stdout
    assert "walk05.parquet" in again.stderr
    after = finished()
    assert len(after) == count
    assert {name: after[name] for name in before} == before
    rows = parquet.read_table(kept).to_pylist()
    assert sorted(row["status"] for row in rows) == [DONE] * (count - 1) + [FAILED]


def test_a_folder_that_lets_nothing_go_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one without rights: no fault of the program, and in words."""
    folder, out = two_files(tmp_path / "a"), tmp_path / "out"
    store, _ = analysed(folder, out)
    (source,) = find_sources([str(folder)])
    store.put("old", {RECORDINGS: [{"recording": "old", "source": source.url, "status": DONE}]})

    def refused(_: Store, __: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Store, "remove", refused)
    result = CliRunner().invoke(main, ["cohort", str(folder), "--out", str(out)])
    assert result.exit_code == 2
    assert "cannot be kept there" in result.output
    monkeypatch.undo()
    result = CliRunner().invoke(main, ["cohort", str(folder), "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "1 of 1 are finished already" in result.stderr
    assert "1 results of earlier files" in result.stderr
    assert store.finished() == {source.identity(Settings().text())}
