"""The very first analysis: what comes after the calibration is compiled in two processes beside this one.

Compiling takes far longer than analysing, and one process compiles on one processor only. What each process has
compiled stands in the cache (:mod:`fes.estimation.compiled`) for all.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import click

PARTS = ("strides", "path")


@contextmanager
def compiled_ahead(cache: Path) -> Iterator[None]:
    """Where nothing is compiled yet, do that beside what is done within, and wait for it at the end.

    ``cache`` is the compiler's folder. Should one of the processes fail, its part is compiled where it is needed.
    """
    if next(cache.glob("*/*.nbi"), None) is not None:
        yield
        return
    click.secho("First run: compiling, which takes some seconds …", fg="yellow", err=True)
    helpers: list[subprocess.Popen[bytes]] = []
    try:
        for part in PARTS:
            with suppress(OSError):
                command = [sys.executable, "-m", "fes.cli.compile_ahead", part]
                nowhere = subprocess.DEVNULL
                helpers.append(subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere))
        yield
        for helper in helpers:
            helper.wait()
    finally:
        for helper in helpers:
            helper.kill()
            helper.wait()


def compile_part(part: str) -> None:
    """Run one part of an analysis on made-up steps.

    Raises:
        KeyError: there is no such part.
    """
    from fes.estimation.foot_way import foot_samples
    from fes.estimation.stride_fusion import lengths_along
    from fes.estimation.warm import made_up_foot, made_up_steps

    t_ns, acc, gyr = made_up_steps()

    def path() -> None:
        lengths_along(foot_samples(t_ns, acc, gyr), t_ns[[50]], t_ns[[250]])

    {"strides": lambda: made_up_foot().walk(t_ns, acc, gyr).strides(), "path": path}[part]()


if __name__ == "__main__":
    compile_part(sys.argv[1])
