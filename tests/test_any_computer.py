"""Analysis where nothing of Linux is there: its modules and calls taken away, Windows' line ends, its lock on files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from fes.simulation import bundled_file

# What Windows' Python does not have. The stand-in for msvcrt locks one byte from where the file stands, and gives up.
WITHOUT_LINUX = """
import ctypes, errno, fcntl, importlib.abc, multiprocessing, os, pathlib, signal, socket, subprocess, sys, types
import serial  # it has a half of its own for Windows

class Blocked(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in ("fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocked())
waited = []

def locking(descriptor, mode, size, flock=fcntl.flock, exclusive=fcntl.LOCK_EX, at_once=fcntl.LOCK_NB):
    assert size == 1 and os.lseek(descriptor, 0, os.SEEK_CUR) == 0
    try:
        flock(descriptor, exclusive | at_once)
    except BlockingIOError:
        if mode == 2:
            raise PermissionError(errno.EACCES, "Permission denied") from None
        waited.append(True)  # for ten seconds, on Windows
        raise OSError(errno.EDEADLK, "Resource deadlock avoided") from None

for name in ("fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"):
    sys.modules.pop(name, None)
sys.modules["msvcrt"] = types.SimpleNamespace(LK_LOCK=1, LK_NBLCK=2, locking=locking)
GONE = {
    os: ("fork", "forkpty", "getuid", "geteuid", "getpgrp", "sched_getaffinity", "sched_setaffinity",
         "sched_setscheduler", "eventfd", "openpty", "ttyname", "O_NOCTTY"),
    signal: ("SIGALRM", "SIGCONT", "SIGHUP", "SIGSTOP", "SIGUSR1", "setitimer", "ITIMER_REAL"),
    socket: ("AF_UNIX",),
}
for module, names in GONE.items():
    for name in names:
        if hasattr(module, name):
            delattr(module, name)

def no_such_library(name=None, *more, loads=ctypes.CDLL, **options):
    if name is None:
        raise TypeError("argument of type 'NoneType' is not iterable")
    return loads(name, *more, **options)

ctypes.CDLL = no_such_library
"""
COMMAND = "from fes.cli import main; main(sys.argv[1:])"


def run_without_linux(program: str, *arguments: str, folder: Path) -> str:
    """Its output; it must end well."""
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_LINUX + program, *arguments], cwd=folder, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled walk as a CSV with Windows' line ends, and its sidecar."""
    from fes.recording import read_recording, write_recording

    path = tmp_path_factory.mktemp("a folder") / "Gang 1.csv"
    write_recording(read_recording(bundled_file("both_feet_100hz.parquet")), path)
    for each in (path, path.with_suffix(".toml")):
        each.write_bytes(each.read_bytes().replace(b"\n", b"\r\n"))
    return path


@pytest.mark.parametrize(
    "program",
    [
        COMMAND,
        "import fes; result = fes.analyse(sys.argv[2]); result.report('page.html'); print('Tables')",
    ],
    ids=["fes analyse", "notebook"],
)
def test_a_walk_is_analysed(program: str, walk: Path, tmp_path: Path) -> None:
    said = run_without_linux(program, "analyse", str(walk), folder=tmp_path)
    assert "Tables" in said
    assert [*tmp_path.rglob("*.html")]


ON_FILES = (
    "analyse", "cohort", "compare", "logs", "recordings", "replay.command", "simulate", "demo", "compile_",
)  # fmt: skip


def test_commands_on_files_are_imported(tmp_path: Path) -> None:
    names = ", ".join(f"fes.cli.{name}" for name in ON_FILES)
    run_without_linux(f"import fes.notebook, fes.hil.closed_loop.one_process, {names}", folder=tmp_path)


@pytest.mark.parametrize("command", [["run"], ["exercise"], ["doctor"], ["hil"], ["qualify"], ["simulate", "--live"]])
def test_live_says_why_it_wants_linux(command: list[str], tmp_path: Path) -> None:
    program = """
import click.testing, fes.cli.simulate
from fes.cli import main
sys.platform = "win32"
result = click.testing.CliRunner().invoke(main, sys.argv[1:])
print(result.exit_code, result.output)
"""
    said = run_without_linux(program, *command, folder=tmp_path)
    assert said.startswith("2 ")
    assert "wants Linux" in said
    assert "SCHED_FIFO" in said


def test_a_lock_on_windows(tmp_path: Path) -> None:
    """One that somebody holds is told as elsewhere, and waited for longer than Windows waits."""
    program = """
import threading
from fes.estimation.numerics.jit import lock
one, other = open("lock", "a"), open("lock", "a")
one.write("x")
one.flush()
lock(one)
try:
    lock(other, wait=False)
except BlockingIOError:
    print("held")
threading.Timer(0.2, one.close).start()
lock(other)
print("had" if waited else "not waited")
"""
    assert run_without_linux(program, folder=tmp_path).split() == ["held", "had"]


def test_a_time_limit_holds_without_an_alarm(tmp_path: Path) -> None:
    """Whatever holds the interpreter; and what ended in time goes on."""
    program = """
from itertools import repeat
import time
from fes.cohort.engine import ended_after
with ended_after(0.2):
    pass
time.sleep(0.4)
print("went on", flush=True)
with ended_after(0.2):
    sum(repeat(0))
"""
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_LINUX + program], cwd=tmp_path, capture_output=True, text=True, timeout=120,
        check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (1, "went on\n", "")
