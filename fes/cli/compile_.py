"""``fes compile``: all compiled code made ahead, so that nobody waits for it at a command."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import click
from numba.core import event

from fes.analysis import analyse, calibrations_of
from fes.cli.compile_ahead import compile_part, in_processes
from fes.cli.exits import FAILED
from fes.estimation.compiled import CACHE
from fes.parameters.gait import gait_parameters
from fes.parameters.mean_stride import mean_strides
from fes.patient.virtual.closed_loop import calibration_walk
from fes.patient.virtual.settings import PatientSettings
from fes.recording import read_recording, write_recording
from fes.recording.read import TABLE_SUFFIXES
from fes.view.summary import summarise

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
    summarise(result.record(""))
