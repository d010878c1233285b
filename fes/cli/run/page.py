"""``--page``: the browser's page of a session or a replay."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from fes.cli.common.exits import Problem

if TYPE_CHECKING:
    from fes.config import Session
    from fes.live.dashboard.process import PageProcess
    from fes.live.session import LiveSession

Command = TypeVar("Command", bound=Callable[..., Any])


def page_options(command: Command) -> Command:
    """``--page`` and ``--page-port``."""
    port = click.option(
        "--page-port", type=click.IntRange(0, 65535), default=0, help="The page's port. Default: a free one."
    )
    page = click.option("--page", is_flag=True, help="Serve the live page to a browser on this computer.")
    return page(port(command))


def open_page(folder: Path, about: dict[str, Any], port: int, stack: ExitStack) -> PageProcess:
    """Start the page's process and say where the page is; ``stack`` ends it.

    Raises:
        Problem: the port is taken, or the folder cannot be written.
    """
    from fes.live.dashboard.process import LINK_NAME, PageProcess

    try:
        page = stack.enter_context(PageProcess(folder, about, port))
    except OSError as error:
        raise Problem(f"--page-port {port}: no page can be served: {error.strerror}. Choose another port.") from error
    click.secho(f"Page  {page.url}", bold=True, err=True)
    click.echo(f"      opens once; {folder / LINK_NAME} has the link for another browser", err=True)
    return page


def about_session(session: Session, mode: str) -> dict[str, Any]:
    """What the page has to know before anything happens; see :mod:`fes.live.dashboard.process`."""
    from fes.live.dashboard.process import about_session as about

    return about(session, mode)


def add_page(live: LiveSession, page: PageProcess) -> None:
    """Show the session on the page, and carry out what is ordered there."""
    from fes.live.dashboard.message_handler import DashboardCommands
    from fes.session_log import Note

    def confused(t_ns: int, text: str) -> None:
        live.monitor.note(Note(t_ns, "warning", "page", text))

    live.monitor.page = page.feed
    live.add_input(DashboardCommands(page.feed, live.operator.order, lambda: live.operator.state, confused))
