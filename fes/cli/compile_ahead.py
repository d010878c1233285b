"""The very first analysis: its parts are compiled in processes side by side; and ``fes compile``'s list of all parts.

Compiling takes far longer than analysing, and one process compiles on one processor only. What each process has
compiled stands in the cache (:mod:`fes.estimation.compiled`) for all. The processes are forks of this one, which spares
them loading numba again.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import click

PARTS = ("strides", "path", "events")


@contextmanager
def compiled_ahead(cache: Path) -> Iterator[None]:
    """Where nothing is compiled yet, do that beside and after what is done within, and wait for it at the end.

    ``cache`` is the compiler's folder. Should one of the processes fail, its part is compiled where it is needed.
    """
    if next(cache.glob("*/*.nbi"), None) is not None:
        yield
        return
    click.secho("First run: compiling, which takes some seconds (fes compile does it ahead) …", fg="yellow", err=True)
    with in_processes(PARTS) as left:
        yield
        for part in left:
            compile_part(part)


@contextmanager
def in_processes(parts: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Compile these in a process for each further processor; gives the parts left to this one. Waits at the end."""
    free = len(os.sched_getaffinity(0)) - 1 if "fork" in multiprocessing.get_all_start_methods() else 0
    helpers = []
    if free > 0:
        from fes.estimation.compiled import load

        load()  # once for all
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
    from fes.estimation.warm import made_up_foot, made_up_steps

    made_up_foot().walk(*made_up_steps()).strides()


def _path() -> None:
    from fes.estimation.foot_way import foot_samples
    from fes.estimation.stride_fusion import lengths_along
    from fes.estimation.warm import made_up_steps

    t_ns, acc, gyr = made_up_steps()
    lengths_along(foot_samples(t_ns, acc, gyr), t_ns[[50]], t_ns[[250]])


def _events() -> None:
    from fes.estimation.events_offline import find_events
    from fes.estimation.warm import made_up_calibration, made_up_steps

    find_events(*made_up_steps(), made_up_calibration())


def _session() -> None:
    from fes.estimation.warm import warm_up

    warm_up()
    _strides()
