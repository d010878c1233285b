"""Opening what a live session names: its sensors' lines, its stop button.

``--dashboard``: a session or a replay in a browser.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import click

from drivers.imu.open import ON_CAN, WITHOUT_LINE, open_imus
from drivers.imu.port import ImuLost, ImuPort
from drivers.stimulator.bus import BusError
from fes.cli.common import Command, Problem, failing, need_extra
from fes.config import ConfigError, Session, Switch
from fes.control.clock_sync import SensorClock
from fes.estimation.sensor_choice import phase_sensors
from fes.live.source import Imu, Input, SensorStream
from fes.signals import Event

if TYPE_CHECKING:
    from fes.live.dashboard.process import DashboardProcess
    from fes.live.session import LiveSession


def dashboard_options(command: Command) -> Command:
    """``--dashboard`` and ``--dashboard-port``."""
    port = click.option(
        "--dashboard-port", type=click.IntRange(0, 65535), default=0, help="The dashboard's port. Default: a free one."
    )
    said = "Serve the dashboard to a browser on this computer."
    return click.option("--dashboard", is_flag=True, callback=_servable, help=said)(port(command))


def _servable(_: click.Context, __: click.Parameter, asked: bool) -> bool:
    if asked:
        need_extra("live", "--dashboard")
    return asked


def open_dashboard(
    folder: Path, session: Session, mode: str, port: int, stack: ExitStack, calibrated: Iterable[str] = ()
) -> DashboardProcess:
    """Start the dashboard's process and print its address; ``stack`` ends it.

    For ``mode`` and ``calibrated`` see :func:`fes.live.dashboard.process.about_session`.

    Problem: the port is taken, or the folder cannot be written.
    """
    from fes.live.dashboard.process import LINK_NAME, DashboardProcess, about_session

    try:
        dashboard = stack.enter_context(DashboardProcess(folder, about_session(session, mode, calibrated), port))
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


class SensorFaults(Input, Protocol):
    """What stands between a session's sensors and its loop in a fault campaign on real devices, and nowhere else.

    The program that ``fes hil --hardware`` starts hands it over; no setting, option or extension names one.
    """

    dummy_load: bool  # somebody has confirmed that nobody is connected to the stimulator

    def between(self, ports: Sequence[ImuPort], session: Session) -> Sequence[Imu]:
        """Ports in the place of these."""

    def observe(self, event: Event) -> None:
        """As the supervisor does, before anybody acts on it."""


def open_sensors(session: Session, stack: ExitStack, faults: SensorFaults | None = None) -> list[SensorStream]:
    """Open every line that a sensor of the session is on; ``stack`` closes them.

    Problem: one cannot be opened; or ``faults`` without a dummy load.
    """
    if faults is not None and not faults.dummy_load:
        raise Problem("Sensors' faults are injected by `fes hil --hardware … --i-have-a-dummy-load` alone.")
    with failing(ImuLost, BusError, ConfigError, ValueError):
        opened = open_imus(session.sensors, session.bus)
    ports = opened if faults is None else faults.between(opened, session)
    phase_sensor_of = phase_sensors(str(device.sensor) for device in session.sensors)
    # what no channel follows must not stop the therapy of a sound foot; without channels there is none to stop
    needed = frozenset(phase_sensor_of[channel.foot] for channel in session.channels if channel.foot in phase_sensor_of)
    streams = []
    for port in ports:
        stream = SensorStream(port, SensorClock, ImuLost, needed, session.by_radio)
        stack.callback(stream.close)
        streams.append(stream)
    return streams


def stop_switch_settings(text: str) -> Switch:
    """The stop button's settings from ``can_bit:0x1F0:3``, ``serial_cts:/dev/ttyUSB1``; ``:low`` behind it inverts.

    ConfigError: it is of another form.
    """
    source, *rest = text.split(":")
    pressed = rest.pop() if rest and rest[-1] in ("high", "low") else "high"
    where: dict[str, object] = {"port": ":".join(rest)}
    try:
        if source == "can_bit":
            identifier, bit = rest
            where = {"identifier": int(identifier, 0), "bit": int(bit)}
        return Switch.model_validate({"source": source, "pressed": pressed, **where})
    except ValueError as error:
        raise ConfigError(
            f"--stop-input {text}: must be can_bit:IDENTIFIER:BIT, serial_cts:PORT or serial_dsr:PORT, and may end in "
            f":low for a button that is pressed when the level is low"
        ) from error


def serial_ports_of(session: Session) -> list[str]:
    """The serial ports that the session's sensors and stimulator are on, each once."""
    ports = [each.port for each in session.sensors if each.device not in (*ON_CAN, *WITHOUT_LINE)]
    ports += [session.stimulator.port] if session.stimulator.device not in ("can", "canopen") else []
    return list(dict.fromkeys(port for port in ports if "://" not in port))
