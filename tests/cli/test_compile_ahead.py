"""The first analysis compiles in processes of its own, and none is left behind; `fes compile` leaves nothing to do."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fes.cli import compile_ as compile_ahead
from fes.cli.compile_ import AHEAD_PARTS as PARTS
from fes.cli.compile_ import compile_part, compiled_ahead

SEVERAL = {0, 1, 2, 3}


def part_is(monkeypatch: pytest.MonkeyPatch, over: Path, processors: set[int] = SEVERAL) -> list[str]:
    """Something that takes until a file is there stands in for compiling; gives what is compiled in this process."""
    here = os.getpid()
    done: list[str] = []

    def stand_in(part: str) -> None:
        if os.getpid() == here:
            done.append(part)
            return
        while not over.exists():
            time.sleep(0.005)

    monkeypatch.setattr(compile_ahead, "compile_part", stand_in)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: processors)
    return done


def test_what_is_compiled_is_not_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    part_is(monkeypatch, tmp_path / "never")
    (tmp_path / "estimation_1").mkdir()
    (tmp_path / "estimation_1" / "kernel.nbi").touch()
    with compiled_ahead(tmp_path):
        assert not multiprocessing.active_children()
    assert capfd.readouterr().err == ""


def test_an_empty_cache_is_filled_and_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    done = part_is(monkeypatch, tmp_path / "over")
    with compiled_ahead(tmp_path / "not there yet"):
        assert len(multiprocessing.active_children()) == len(PARTS)
        (tmp_path / "over").touch()
    assert not multiprocessing.active_children()
    assert not done
    assert "First run: compiling" in capfd.readouterr().err


def test_each_processor_gets_one_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = part_is(monkeypatch, tmp_path / "over", {0, 1})
    with compiled_ahead(tmp_path):
        assert len(multiprocessing.active_children()) == 1
        (tmp_path / "over").touch()
    assert tuple(done) == PARTS[1:]


def test_an_error_leaves_no_process_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part_is(monkeypatch, tmp_path / "never")

    def interrupted() -> None:
        with compiled_ahead(tmp_path):
            assert len(multiprocessing.active_children()) == len(PARTS)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not multiprocessing.active_children()


def test_without_processes_it_goes_on_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = part_is(monkeypatch, tmp_path / "never")

    def refuse() -> int:
        raise OSError("no more processes")

    monkeypatch.setattr(os, "fork", refuse)
    with compiled_ahead(tmp_path):
        assert not done
    assert tuple(done) == PARTS


def run(*command: str, cache: Path) -> subprocess.CompletedProcess[str]:
    where = {**os.environ, "XDG_CACHE_HOME": str(cache), "TMPDIR": str(cache.parent)}
    return subprocess.run([sys.executable, *command], env=where, capture_output=True, text=True, check=False)


FES = ("-c", "from fes.cli import main; main()")


@pytest.mark.slow
def test_after_compiling_ahead_nothing_is_left_to_compile(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    missing = run(*FES, "compile", "--check", cache=cache)
    assert missing.returncode == 1
    assert missing.stdout.startswith("Not compiled: ")
    done = run(*FES, "compile", cache=cache)
    assert done.returncode == 0, done.stderr
    there = sorted(cache.glob("fes-gait/*/*/*"))
    checked = run(*FES, "compile", "--check", cache=cache)
    assert checked.returncode == 0, checked.stdout
    trial = Path(__file__).resolve().parents[2] / "sim_inputs" / "both_feet_200hz.parquet"
    analysed = run(*FES, "analyse", str(trial), "--out", str(tmp_path / "out"), cache=cache)
    assert analysed.returncode == 0, analysed.stderr
    assert "compiling" not in analysed.stderr
    assert sorted(cache.glob("fes-gait/*/*/*")) == there


SOLVED = """
import numpy as np
from fes.estimation.numerics.linear import solve
system = np.array([[2.0, 0.0, 4.0], [0.0, 4.0, 4.0]])
assert solve(system, 2) and system[:, 2].tolist() == [2.0, 1.0]
assert solve(np.array([[1.0, 1.0]])[:, ::1], 1) and solve(np.ones((4, 2))[::2], 1)
"""
FULL = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))\n"


def test_a_cache_that_cannot_be_made_is_said_once(tmp_path: Path) -> None:
    """A file where the cache's folder should be, and in the folder for temporary files as well: work goes on."""
    cache = tmp_path / "cache"
    cache.write_text("in the way")
    (tmp_path / f"fes-gait-{os.getuid()}").write_text("in the way")
    done = run("-c", SOLVED, cache=cache)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("Compiled code cannot be kept") == 1


def test_a_full_disk_is_said_once_and_stops_nothing(tmp_path: Path) -> None:
    """No byte can be written to any file: what a full disk does, where folders and empty files can still be made."""
    done = run("-c", FULL + SOLVED, cache=tmp_path / "cache")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("Compiled code cannot be kept") == 1
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_no_such_part() -> None:
    with pytest.raises(KeyError):
        compile_part("nothing")
