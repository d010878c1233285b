"""The very first analysis compiles in processes of its own, and none is left behind."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import pytest

from fes.cli import compile_ahead
from fes.cli.compile_ahead import PARTS, compile_part, compiled_ahead

Started = list[subprocess.Popen[bytes]]
ENDLESS = "import time; time.sleep(60)"


def stand_in(monkeypatch: pytest.MonkeyPatch, code: str) -> Started:
    """Processes that run this code stand in for those that compile."""
    processes: Started = []
    real = subprocess.Popen

    def start(command: list[str], **rest: Any) -> subprocess.Popen[bytes]:
        assert command[:3] == [sys.executable, "-m", "fes.cli.compile_ahead"]
        processes.append(real([sys.executable, "-c", code], **rest))
        return processes[-1]

    monkeypatch.setattr(compile_ahead.subprocess, "Popen", start)
    return processes


def test_what_is_compiled_is_not_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    started = stand_in(monkeypatch, ENDLESS)
    (tmp_path / "estimation_1").mkdir()
    (tmp_path / "estimation_1" / "kernel.nbi").touch()
    with compiled_ahead(tmp_path):
        assert not started
    assert capfd.readouterr().err == ""


def test_an_empty_cache_is_filled_and_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    started = stand_in(monkeypatch, "")
    with compiled_ahead(tmp_path / "not there yet"):
        assert len(started) == len(PARTS)
    assert [process.returncode for process in started] == [0, 0]
    assert "First run: compiling" in capfd.readouterr().err


def test_an_error_leaves_no_process_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started = stand_in(monkeypatch, ENDLESS)

    def interrupted() -> None:
        with compiled_ahead(tmp_path):
            assert [process.poll() for process in started] == [None, None]
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [process.returncode for process in started] == [-9, -9]


def test_without_processes_it_goes_on_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError("no more processes")

    monkeypatch.setattr(compile_ahead.subprocess, "Popen", refuse)
    done = []
    with compiled_ahead(tmp_path):
        done.append(True)
    assert done


def test_the_parts_compile_what_an_analysis_needs() -> None:
    """Each in a process as it is started; what it has compiled lies where this one looks for it."""
    for part in PARTS:
        subprocess.run([sys.executable, "-m", "fes.cli.compile_ahead", part], check=True, capture_output=True)
    compiled = {path.name.partition("-")[0] for path in Path(vars(numba.config)["CACHE_DIR"]).glob("*/*.nbi")}
    assert {"foot._advance", "history._take_in", "stride_solution.solve_span"} <= compiled
    assert {"zupt_step_filter.forward_steps", "zupt_step_smooth.smooth_steps"} <= compiled
    with pytest.raises(KeyError):
        compile_part("nothing")
