"""``--dashboard``: a session or a replay in a browser."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

from fes.cli.common.exits import Problem

if TYPE_CHECKING:
    from fes.config import Session
    from fes.live.dashboard.process import DashboardProcess
    from fes.live.session import LiveSession

FORMER_OPTIONS: Final = {"--page": "--dashboard", "--page-port": "--dashboard-port"}

Command = TypeVar("Command", bound=Callable[..., Any])


def dashboard_options(command: Command) -> Command:
    """``--dashboard`` and ``--dashboard-port``."""
    port = click.option(
        "--dashboard-port", type=click.IntRange(0, 65535), default=0, help="The dashboard's port. Default: a free one."
    )
    dashboard = click.option("--dashboard", is_flag=True, help="Serve the dashboard to a browser on this computer.")
    return dashboard(port(command))


def open_dashboard(folder: Path, session: Session, mode: str, port: int, stack: ExitStack) -> DashboardProcess:
    """Start the dashboard's process and print its address; ``stack`` ends it. ``mode``: live or replay.

    Raises:
        Problem: the port is taken, or the folder cannot be written.
    """
    from fes.live.dashboard.process import LINK_NAME, DashboardProcess, about_session

    try:
        dashboard = stack.enter_context(DashboardProcess(folder, about_session(session, mode), port))
    except OSError as error:
        raise Problem(f"--dashboard-port {port}: cannot be served: {error.strerror}. Choose another port.") from error
    click.secho(f"Dashboard  {dashboard.url}", bold=True, err=True)
    click.echo(f"           opens once; {folder / LINK_NAME} has the link for another browser", err=True)
    return dashboard


def add_dashboard(live: LiveSession, dashboard: DashboardProcess) -> None:
    """Show the session on the dashboard, and execute what is commanded there."""
    from fes.live.dashboard.stream import DashboardCommands
    from fes.session_log import Note

    def on_refused(t_ns: int, text: str) -> None:
        live.monitor.note(Note(t_ns, "warning", "dashboard", text))

    stream = dashboard.stream
    live.monitor.dashboard = stream
    live.add_input(DashboardCommands(stream, live.operator.execute, lambda: live.operator.state, on_refused))
