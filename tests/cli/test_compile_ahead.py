"""The first analysis compiles in processes of its own, and none is left behind; `fes compile` leaves nothing to do."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from fes.cli import compile_ as compile_ahead
from fes.cli.compile_ import AHEAD_PARTS as PARTS
from fes.cli.compile_ import compile_part, compiled_ahead

SEVERAL = {0, 1, 2, 3}
UNTIL_STOPPED = [sys.executable, "-c", "import sys; sys.stdin.readline()"]


class Kept:
    """Stands in for the kept code: notes when others' is fetched."""

    def __init__(self, empty: bool) -> None:
        self.empty, self.fetched = empty, 0

    def is_empty(self) -> bool:
        return self.empty

    def fetch(self) -> None:
        self.fetched += 1


class StandIns:
    """Processes that wait until they are told stand in for those that compile; ``here`` is compiled in this one."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, empty: bool = True, processors: set[int] = SEVERAL) -> None:
        self.kept, self.here = Kept(empty), list[str]()
        self.helpers: list[subprocess.Popen[bytes]] = []
        monkeypatch.setattr(compile_ahead, "KEPT", self.kept)
        monkeypatch.setattr(compile_ahead, "_compiling", self.start)
        monkeypatch.setattr(compile_ahead, "compile_part", self.here.append)
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: processors)

    def start(self, part: str) -> subprocess.Popen[bytes]:
        assert part in PARTS
        self.helpers.append(subprocess.Popen(UNTIL_STOPPED, stdin=subprocess.PIPE))
        return self.helpers[-1]

    def go_on(self) -> None:
        for helper in self.helpers:
            assert helper.poll() is None
            assert helper.stdin is not None
            helper.stdin.close()

    @property
    def over(self) -> bool:
        return all(helper.returncode is not None for helper in self.helpers)


def test_what_is_compiled_is_not_compiled_again(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    made = StandIns(monkeypatch, empty=False)
    with compiled_ahead():
        pass
    assert not made.helpers
    assert not made.here
    assert capfd.readouterr().err == ""


def test_an_empty_cache_is_filled_and_waited_for(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    made = StandIns(monkeypatch)
    with compiled_ahead():
        assert len(made.helpers) == len(PARTS)
        assert not made.kept.fetched
        made.go_on()
    assert made.over
    assert made.kept.fetched == 1
    assert not made.here
    assert "First run: compiling" in capfd.readouterr().err


def test_each_processor_gets_one_part(monkeypatch: pytest.MonkeyPatch) -> None:
    made = StandIns(monkeypatch, processors={0, 1})
    with compiled_ahead():
        assert len(made.helpers) == 1
        made.go_on()
    assert tuple(made.here) == PARTS[1:]


def test_an_error_leaves_no_process_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    made = StandIns(monkeypatch)

    def interrupted() -> None:
        with compiled_ahead():
            assert len(made.helpers) == len(PARTS)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert made.over


def test_without_processes_it_goes_on_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    made = StandIns(monkeypatch)

    def refuse(part: str) -> Any:
        raise OSError("no more processes")

    monkeypatch.setattr(compile_ahead, "_compiling", refuse)
    with compiled_ahead():
        assert not made.here
    assert tuple(made.here) == PARTS


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
    there = sorted(cache.glob("fes-gait/*/kept/*/*"))
    assert there
    checked = run(*FES, "compile", "--check", cache=cache)
    assert checked.returncode == 0, checked.stdout
    trial = Path(__file__).resolve().parents[2] / "sim_inputs" / "both_feet_200hz.parquet"
    analysed = run(*FES, "analyse", str(trial), "--out", str(tmp_path / "out"), cache=cache)
    assert analysed.returncode == 0, analysed.stderr
    assert "compiling" not in analysed.stderr
    assert sorted(cache.glob("fes-gait/*/kept/*/*")) == there


SOLVED = """
import numpy as np
from fes.estimation.numerics.filters import solve
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
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.stat().st_size]


def test_no_such_part() -> None:
    with pytest.raises(KeyError):
        compile_part("nothing")
