"""``fes compile``: all compiled code made ahead, so that nobody waits for it at a command.

The very first analysis: its parts are compiled in processes side by side; and ``fes compile``'s list of all parts.

Compiling takes far longer than analysing, and one process compiles on one processor only. What each process has
compiled stands in the cache (:mod:`fes.estimation.numerics.jit`) for all. The processes are forks of this one, which
spares them loading numba again.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import click
from numba.core import event

from fes.analysis.parameters.gait import gait_parameters, mean_strides
from fes.analysis.pipeline import analyse, calibrations_of
from fes.cli.common.exits import FAILED
from fes.estimation.numerics.jit import CACHE
from fes.recording import read_recording, write_recording
from fes.recording.read import TABLE_SUFFIXES
from fes.report.summary import summarise
from fes.simulation.forward.closed_loop import calibration_walk
from fes.simulation.forward.settings import PatientSettings

AHEAD_PARTS = ("strides", "path", "events")


@contextmanager
def compiled_ahead(cache: Path) -> Iterator[None]:
    """Where nothing is compiled yet, do that beside and after what is done within, and wait for it at the end.

    ``cache`` is the compiler's folder. Should one of the processes fail, its part is compiled where it is needed.
    """
    if next(cache.glob("*/*.nbi"), None) is not None:
        yield
        return
    click.secho("First run: compiling, which takes some seconds (fes compile does it ahead) …", fg="yellow", err=True)
    with in_processes(AHEAD_PARTS) as left:
        yield
        for part in left:
            compile_part(part)


@contextmanager
def in_processes(parts: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Compile these in a process for each further processor; gives the parts left to this one. Waits at the end."""
    free = len(os.sched_getaffinity(0)) - 1 if "fork" in multiprocessing.get_all_start_methods() else 0
    helpers = []
    try:
        with suppress(OSError):
            for part in parts[:free]:
                helper = multiprocessing.get_context("fork").Process(target=_compile_quietly, args=(part,), daemon=True)
                helper.start()
                helpers.append(helper)
        yield parts[len(helpers) :]
        for helper in helpers:
            helper.join()
    finally:
        for helper in helpers:
            helper.kill()
            helper.join()


def _compile_quietly(part: str) -> None:
    """In a process of its own: what it might say would stand in the middle of what the command says."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    compile_part(part)


def compile_part(part: str) -> None:
    """Run one part of what is compiled on made-up steps.

    Raises:
        KeyError: there is no such part.
    """
    ways = {"strides": _strides, "path": _path, "events": _events, "session": _session}
    ways[part]()


def _strides() -> None:
    from fes.estimation.warm_up import made_up_foot, made_up_steps

    made_up_foot().walk(*made_up_steps()).strides()


def _path() -> None:
    from fes.analysis.stride_fusion import lengths_along
    from fes.estimation.warm_up import made_up_steps
    from fes.estimation.zupt.foot_trajectory import foot_samples

    t_ns, acc, gyr = made_up_steps()
    lengths_along(foot_samples(t_ns, acc, gyr), t_ns[[50]], t_ns[[250]])


def _events() -> None:
    from fes.estimation.events.offline import find_events
    from fes.estimation.warm_up import made_up_calibration, made_up_steps

    find_events(*made_up_steps(), made_up_calibration())


def _session() -> None:
    from fes.estimation.warm_up import warm_up

    warm_up()
    _strides()


PARTS = ("session", "path", "events")


class _NotCompiled(Exception):
    pass


class _Watch(event.Listener):
    def on_start(self, event: Any) -> None:
        raise _NotCompiled(event.data["dispatcher"].py_func.__qualname__)

    def on_end(self, event: Any) -> None:
        pass


@click.command(name="compile")
@click.option("--check", is_flag=True, help="Compile nothing, say whether something is missing; exit code 1 if so.")
def command(check: bool) -> None:
    """Compile the estimation for this processor and keep it, so that the first command starts as fast as any other.

    `make demo` and what else installs does this. Without it each command compiles what it needs at its first use, and
    that takes some seconds longer. It is done again after an update, and on another processor.
    """
    if check:
        with event.install_listener("numba:compile", _Watch()):
            try:
                _everything((), PARTS)
            except _NotCompiled as missing:
                click.echo(f"Not compiled: {missing}, perhaps more. Run: fes compile")
                raise SystemExit(FAILED) from None
        click.echo(f"All is compiled, in {CACHE}")
        return
    click.echo(f"Compiling for this processor, into {CACHE} …")
    _everything(PARTS, ())


def _everything(aside: tuple[str, ...], here: tuple[str, ...]) -> None:
    """Run all that is compiled: parts in processes of their own or here, then an analysis of a virtual patient, whose
    recording is written and read too."""
    with in_processes(aside) as left:
        walk, found = calibrations_of(calibration_walk(PatientSettings()))
        with tempfile.TemporaryDirectory() as folder:
            for suffix in TABLE_SUFFIXES:
                write_recording(walk, Path(folder, "walk").with_suffix(suffix), overwrite=True)
                read_recording(Path(folder, "walk").with_suffix(suffix))
        for part in (*left, *here):
            compile_part(part)
    result = analyse(walk, found.calibrations)
    mean_strides(result.strides, gait_parameters(result).strides)
    summarise(result.walk_record())
