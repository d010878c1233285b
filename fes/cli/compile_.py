"""``fes compile``: all compiled code made ahead; and the first analysis, which makes its own beside its work.

One process compiles on one processor only, so parts are compiled in processes of their own, which keep what they have
made (:mod:`fes.estimation.numerics.jit`) for all.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import click

from fes.cli.common import FAILED, need_extra, processors
from fes.estimation.numerics.jit import KEPT, compiled_here

AHEAD_PARTS = ("strides", "path", "events")
NOT_KEPT = "Compiled code cannot be kept on this computer; see the warning above."


@contextmanager
def compiled_ahead() -> Iterator[None]:
    """Where nothing is compiled yet, do that beside and after what is done within, and wait for it at the end.

    Should one of the processes fail, its part is compiled where it is needed.
    """
    if KEPT is None or not KEPT.is_empty():
        yield
        return
    click.secho("First run: compiling, which takes a minute (fes compile does it ahead) …", fg="yellow", err=True)
    with in_processes(AHEAD_PARTS, processors() - 1) as left:
        yield
    KEPT.fetch()
    for part in left:
        compile_part(part)


@contextmanager
def in_processes(parts: tuple[str, ...], most: int) -> Iterator[tuple[str, ...]]:
    """Compile the first of these, at most so many, each in a process; gives the other parts. Waits at the end."""
    helpers: list[subprocess.Popen[bytes]] = []
    try:
        with suppress(OSError):
            for part in parts[:most]:
                helpers.append(_compiling(part))
        yield parts[len(helpers) :]
        for helper in helpers:
            helper.wait()
    finally:
        for helper in helpers:
            helper.kill()
            helper.wait()


def _compiling(part: str) -> subprocess.Popen[bytes]:
    """A process that compiles a part; what it might say would stand in the middle of what the command says."""
    code = f"from fes.cli.compile_ import compile_part; compile_part({part!r})"
    silent = subprocess.DEVNULL
    return subprocess.Popen([sys.executable, "-c", code], stdin=silent, stdout=silent, stderr=silent)


def compile_part(part: str) -> None:
    """Run one part of what is compiled, on made-up steps; "analysis" on a virtual patient, written and read too.

    KeyError: there is no such part.
    """
    from fes.analysis.ground_path import lengths_along
    from fes.estimation.events.offline import find_events
    from fes.estimation.warm_up import made_up_calibration, made_up_foot, made_up_steps, warm_up
    from fes.estimation.zupt.foot_trajectory import foot_samples

    match part:
        case "strides":
            made_up_foot().track(*made_up_steps()).strides()
        case "path":
            t_ns, acc, gyr = made_up_steps()
            lengths_along(foot_samples(t_ns, acc, gyr), t_ns[[50]], t_ns[[250]])
        case "events":
            find_events(*made_up_steps(), made_up_calibration())
        case "simulation":
            from fes.simulation.forward.closed_loop import calibration_walk
            from fes.simulation.forward.settings import PatientSettings

            calibration_walk(PatientSettings())
        case "session":
            from fes.gate.plausibility import Plausibility

            warm_up()
            Plausibility("left_foot", None, None)
            made_up_foot().track(*made_up_steps()).strides()
        case "analysis":
            from fes.analysis.parameters.gait import gait_parameters, mean_strides
            from fes.analysis.pipeline import analyse, calibrations_of
            from fes.recording import read_recording, write_recording
            from fes.recording.table import TABLE_SUFFIXES
            from fes.report.summary import summarise
            from fes.simulation.forward.closed_loop import calibration_walk
            from fes.simulation.forward.settings import PatientSettings

            walk, found = calibrations_of(calibration_walk(PatientSettings()))
            with tempfile.TemporaryDirectory() as folder:
                for suffix in TABLE_SUFFIXES:
                    write_recording(walk, Path(folder, "walk").with_suffix(suffix), overwrite=True)
                    read_recording(Path(folder, "walk").with_suffix(suffix))
            result = analyse(walk, found.calibrations)
            mean_strides(result.strides, gait_parameters(result).strides)
            summarise(result.walk_record())
        case _:
            raise KeyError(part)


FIRST_PARTS: tuple[str, ...] = ("session", "path", "events", "simulation")  # the strides are in the session
ALL_PARTS = (*FIRST_PARTS, "analysis")  # which calls what is in the others, too


@click.command(name="compile")
@click.option("--check", is_flag=True, help="Only say whether something is missing; exit code 1 if so.")
def command(check: bool) -> None:
    """Compile the estimation for this processor and keep it, so that the first command starts as fast as any other.

    `make demo` and what else installs does this. Without it each command compiles what it needs at its first use, and
    that takes up to a minute longer. It is done again after an update, and on another processor.
    """
    need_extra("fast")
    if KEPT is None:
        click.secho(NOT_KEPT, fg="red", err=True)
        raise SystemExit(FAILED)
    if check:
        missing = "everything" if KEPT.is_empty() else ""
        for part in () if missing else ALL_PARTS:
            compile_part(part)
            if made := compiled_here():
                missing = f"{made[0]}, perhaps more"
                break
        if missing:
            click.echo(f"Not compiled: {missing}. Run: fes compile")
            raise SystemExit(FAILED)
        click.echo(f"All is compiled, in {KEPT.root}")
        return
    click.echo(f"Compiling for this processor, into {KEPT.root} …")
    parts, together = FIRST_PARTS, processors()
    while parts and together > 1:
        with in_processes(parts, together) as left:
            pass
        if left == parts:  # no process can be started
            break
        parts = left
    KEPT.fetch()
    for part in ALL_PARTS:  # what the processes have left out
        compile_part(part)
