"""``fes``: the group of commands; each is imported only when it is called, so that ``fes --help`` is quick."""

import difflib
import gc
import importlib
import os
import sys
from typing import Any, Final

import click

from fes import __version__
from fes.cli.common import EXTRAS, INTERRUPTED, Broken, Problem, needing, without_extra

COMMANDS: Final = {
    "demo": ("fes.cli.demo", "Replay a bundled trial into a simulated stimulator and write its report."),
    "run": ("fes.cli.run.command", "A live session: sensors, phases, stimulation. STIMULATES once armed by hand."),
    "exercise": ("fes.cli.run.command", "Bursts by the clock, lying or sitting. STIMULATES once armed by hand."),
    "devices": ("fes.cli.devices", "What is connected: serial ports, CAN interfaces, LSL streams."),
    "doctor": (
        "fes.cli.doctor",
        "Before a session: ports, buses, rates, clocks, disk, permissions, with remedies.",
    ),
    "qualify": ("fes.cli.qualify", "One device gone through by steps; evidence. STIMULATES, into a dummy load."),
    "replay": ("fes.cli.replay.command", "Replay a recording or a session log: phases, strides, stimulation, report."),
    "timing": (
        "fes.cli.timing",
        "When transitions and stimulation happen: against a truth, and against a baseline kept in version control.",
    ),
    "analyse": ("fes.cli.analyse", "Find phases and strides in recordings; tables and a report of each."),
    "evaluate": ("fes.cli.compare", "Hold a recording against a reference: bias, limits of agreement, ICC, figures."),
    "import": ("fes.cli.recordings", "Public data sets, as downloaded, into recordings and references."),
    "calibrate": ("fes.cli.recordings", "How the sensors sit and how this person moves, from a short recording."),
    "hil": ("fes.cli.hil", "A fault campaign: faults into a running session, judged at the stimulator's end."),
    "explain": (
        "fes.cli.logs",
        "Why a session did what it did at one instant: guards, walking, gate, tuning.",
    ),
    "report": ("fes.cli.logs", "Write the report of a session log again."),
    "compare": ("fes.cli.compare", "Two session logs' differences, stride by stride."),
    "convert": (
        "fes.cli.logs",
        "A session log as CSV, Parquet, MCAP, C3D or BIDS, for other programs.",
    ),
    "anonymise": (
        "fes.cli.logs",
        "A session log without names, dates and ports; its replay is the same.",
    ),
    "recover": ("fes.cli.logs", "Repair a torn session log and say what was lost."),
    "simulate": ("fes.cli.simulate", "A virtual patient walks: sensors, truth, stimulation in closed loop."),
    "cohort": ("fes.cli.cohort", "Analyse thousands of recordings with many processes; one data set, pages."),
    "sweep": (
        "fes.cli.cohort",
        "Many settings tried on recordings or virtual patients; the best, and their trade-off.",
    ),
    "compile": ("fes.cli.compile_", "Compile for this processor, ahead of the first command; installing does it."),
    "trials": (
        "fes.cli.recordings",
        "Generate the bundled recordings, with their truth, from their seeds.",
    ),
}


LIVE: Final = ("run", "exercise", "doctor", "hil", "qualify")
OF_ANALYSIS: Final = ("demo", "timing", "analyse", "evaluate", "import", "calibrate", "simulate", "trials")
WANTS_LINUX: Final = (
    "fes {} wants Linux. A live session relies on what only Linux gives it: a priority that other programs cannot take "
    "(SCHED_FIFO), memory that is never swapped out (mlockall), processes that are told when the session dies "
    "(PR_SET_PDEATHSIG). Without them nothing would promise when stimulation ends. What works on files (fes analyse, "
    "cohort, evaluate, report, replay …) and notebooks run on this computer too."
)
FEWER_COLLECTIONS: Final = (
    300_000  # new objects between two: more than a short command makes, and hardly any is garbage
)


class LazyGroup(click.Group):
    """Lists the commands without importing them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names, in the order of the table."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one command."""
        if cmd_name not in COMMANDS:
            return None
        if cmd_name in LIVE and sys.platform != "linux":
            raise Problem(WANTS_LINUX.format(cmd_name))
        module = importlib.import_module(COMMANDS[cmd_name][0])
        command = getattr(module, f"{cmd_name}_command", None) or module.command  # in a file of several by its name
        if not isinstance(command, click.Command):
            return None
        return needing(command, "analysis") if cmd_name in OF_ANALYSIS else command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """As click does, with the nearest name for one that does not exist."""
        name = args[0] if args else ""
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        if name and not name.startswith("-") and name not in COMMANDS and near:
            ctx.fail(f"No such command {name!r}. Did you mean {near[0]!r}?")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; nothing that it meets ends in a traceback."""
        if os.environ.get("NO_COLOR"):
            ctx.color = False
        gc.set_threshold(FEWER_COLLECTIONS)
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            click.secho("Interrupted.", fg="yellow", err=True)
            raise SystemExit(INTERRUPTED) from None
        except (click.ClickException, click.Abort, click.exceptions.Exit, BrokenPipeError):
            raise  # click knows these
        except ModuleNotFoundError as error:  # a part of a command, of which the rest needs no extra
            missing = (error.name or "").partition(".")[0]
            extra = next((name for name, libraries in EXTRAS.items() if missing in libraries), "")
            if not extra:
                raise Broken(error) from error
            raise Problem(without_extra("this", extra)) from error
        except Exception as error:
            if os.environ.get("FES_TRACEBACK"):
                raise
            raise Broken(error) from error

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The table, straight."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="fes")
def main() -> None:
    """Functional electrical stimulation timed by how the patient walks.

    Research software, not a medical device.
    """
