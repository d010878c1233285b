"""``fes exercise``: bursts by the clock, for who lies or sits, through the same loop, gate and stops as ``fes run``."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from fes.cli.common import PATH, Interrupt, failing, fresh_folder
from fes.cli.run.command import Options, finish, live_options, run_live
from fes.config import ConfigError, load_exercise
from fes.live.inputs import Terminal, standard_keys
from fes.live.supervised_line import SupervisorProcess


@click.command(name="exercise")
@click.argument("session", type=PATH)
@live_options
def command(session: Path, **options: Any) -> None:
    """Stimulate in cycles, as the [exercise] table of SESSION (TOML) says; the person lies or sits, no sensor is read.

    Nothing is stimulated until you arm it by hand (a) and raise the intensity (+), which starts at 0. SPACE stops at
    once, and so do Ctrl-C, the stop file and the stop button. After the last burst it is disarmed.

    Exit code: 0 ended as asked, 2 unusable settings or devices, 3 stopped early, 4 a fault of fes itself, 130
    interrupted.
    """
    run_exercise(session, Options(**options))


def run_exercise(path: Path, options: Options) -> Path:
    """Run a session of exercise; returns the session log's path. Raises as :func:`fes.cli.run.command.run_session`."""
    with failing(ConfigError):
        session = load_exercise(path)
    folder = fresh_folder(options.out or Path(session.live.folder), f"{path.stem}-exercise")
    with ExitStack() as stack:
        supervisor = stack.enter_context(SupervisorProcess())
        keys = options.keys_from if options.keys_from is not None else standard_keys()
        if keys is not None:
            stack.enter_context(Terminal(keys))
        interrupt = stack.enter_context(Interrupt())
        log_path, ended = run_live(session, {}, [], options, folder, keys, interrupt, supervisor, stack)
    finish(log_path, ended, report=options.report)
    return log_path
