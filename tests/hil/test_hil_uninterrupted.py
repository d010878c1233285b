"""Ctrl-C while a process is being started leaves none that nobody ends."""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import Any, cast

import pytest

from fes.hil import controller as controller_module
from fes.hil.campaign_bench import CampaignBench
from fes.hil.closed_loop.bench import PatientBench
from fes.hil.closed_loop.processes import run_between_processes
from fes.hil.controller import SIGNALS, uninterrupted


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_waits_and_is_not_lost(number: int) -> None:
    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    def come_twice() -> None:
        with uninterrupted():
            signal.raise_signal(number)
            signal.raise_signal(number)
            done.append("all of it")

    before = signal.signal(number, interrupt)
    done: list[str] = []
    try:
        with pytest.raises(KeyboardInterrupt):
            come_twice()
        assert signal.getsignal(number) is interrupt
    finally:
        signal.signal(number, before)
    assert done == ["all of it"]


@pytest.mark.parametrize("moment", ["entering", "leaving"])
def test_a_signal_that_acts_while_handlers_change_leaves_no_other_signal_deaf(
    moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The handlers change one after the other, and a signal may come between any two."""
    acted: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        acted.append(number)
        raise KeyboardInterrupt

    real = signal.signal

    def interrupted(number: int, handler: Any) -> Any:
        was = real(number, handler)
        if number == signal.SIGINT and (handler is interrupt) == (moment == "leaving"):
            monkeypatch.setattr(signal, "signal", real)
            signal.raise_signal(signal.SIGINT if moment == "leaving" else signal.SIGTERM)
        return was

    def enter() -> None:
        monkeypatch.setattr(signal, "signal", interrupted)
        with uninterrupted():
            pass

    before = {number: real(number, interrupt) for number in SIGNALS}
    try:
        with pytest.raises(KeyboardInterrupt):
            enter()
        for number in SIGNALS:
            acted.clear()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(number)
            assert acted == [number]
    finally:
        for number, handler in before.items():
            real(number, handler)


def test_what_is_ignored_stays_ignored_and_is_inherited_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with uninterrupted():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_in_another_thread_it_does_nothing() -> None:
    handlers = []

    def enter() -> None:
        with uninterrupted():
            handlers.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert handlers == [signal.getsignal(signal.SIGINT)]


@pytest.fixture
def interrupted_starts(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Every process started is interrupted from within Popen, when the child runs already; all that were started."""
    started: list[subprocess.Popen[bytes]] = []
    real = subprocess.Popen

    def interrupted(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        started.append(real(*arguments, **options))
        signal.raise_signal(signal.SIGINT)
        return started[-1]

    monkeypatch.setattr(controller_module, "_START", "import time; time.sleep(60)")
    monkeypatch.setattr(controller_module.subprocess, "Popen", interrupted)
    yield started
    for process in started:
        process.kill()
        process.wait()


class OnlyFiles:
    """As much of a bench as starting a session needs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.calibration = self.session = folder / "not read"

    def session_file(self, number: int, variant: str) -> Path:
        """Nobody reads it."""
        return self.folder / "not read"


def test_a_rig_interrupted_while_it_starts_a_session_ends_it(
    tmp_path: Path, interrupted_starts: list[subprocess.Popen[bytes]]
) -> None:
    with ExitStack() as stack:
        bench = CampaignBench(cast(Any, OnlyFiles(tmp_path)), frozenset(), stack)
        stack.callback(bench.end_session)
        with pytest.raises(KeyboardInterrupt):
            bench.start("")
    (process,) = interrupted_starts
    assert process.poll() is not None


def test_a_closed_loop_run_interrupted_while_it_starts_its_session_ends_it(
    tmp_path: Path, interrupted_starts: list[subprocess.Popen[bytes]]
) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_between_processes(cast(PatientBench, OnlyFiles(tmp_path)), cast(Any, None))
    (process,) = interrupted_starts
    assert process.poll() is not None
