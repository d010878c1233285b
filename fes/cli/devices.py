"""``fes devices``: what is connected, and what of a session's devices is among it."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import click

from drivers.discover import CanChannel, LslStream, SerialPort, can_channels, lsl_streams, serial_ports
from fes.cli.common import FAILED, PATH, failing, not_there
from fes.config import WIRELESS, Bus, ConfigError, Session, load_session

ON_CAN = ("xsens_can", "dbc_can", "can", "canopen")


@dataclass(frozen=True, slots=True)
class Connected:
    """What was found; ``streams`` is None where Lab Streaming Layer is not installed."""

    ports: list[SerialPort]
    buses: list[CanChannel]
    streams: list[LslStream] | None


@dataclass(frozen=True, slots=True)
class Wanted:
    """A device of the session: ``found`` is None where its line cannot be looked for without opening it."""

    name: str
    where: str
    found: bool | None
    said: str


@click.command(name="devices")
@click.argument("session", type=PATH, required=False)
@click.option("--json", "as_json", is_flag=True, help="As JSON on stdout.")
def command(session: Path | None, as_json: bool) -> None:
    """List serial ports, CAN interfaces and LSL streams; with SESSION (TOML) also which of its devices are there.

    Nothing is opened. `fes doctor SESSION` opens and measures them.

    Exit code: 0, 1 a device of SESSION is not there, 2 unusable settings.
    """
    with failing(ConfigError):
        settings = load_session(session) if session else None
    connected = Connected(serial_ports(), can_channels(), lsl_streams())
    wanted = wanted_by(settings, connected) if settings else []
    if as_json:
        found = asdict(connected)
        data = {"serial_ports": found["ports"], "can": found["buses"], "lsl": found["streams"]}
        click.echo(json.dumps(data | {"session": [asdict(each) for each in wanted]}, indent=2))
    else:
        _show(connected, wanted)
    if any(each.found is False for each in wanted):
        raise SystemExit(FAILED)


def wanted_by(session: Session, connected: Connected) -> list[Wanted]:
    """Each device that the session names, and whether it is among what is connected."""
    wanted = []
    for sensor in session.sensors:
        name, port = str(sensor.sensor), sensor.port
        if sensor.device == "lsl":
            wanted.append(_stream(name, port, connected))
        elif sensor.device in WIRELESS:
            wanted.append(Wanted(name, port, None, "a sensor by radio; it is only known once it is looked for"))
        elif sensor.device in ON_CAN:
            interface, _, channel = port.partition(":")
            bus = session.bus if port == "bus" else Bus(interface=interface, channel=channel)
            wanted.append(_bus(name, bus, connected))
        else:
            wanted.append(_line(name, port, connected))
    on_bus, port = session.stimulator.device in ON_CAN, session.stimulator.port
    wanted.append(_bus("stimulator", session.bus, connected) if on_bus else _line("stimulator", port, connected))
    switches = [(f"{switch.foot}'s switch", switch) for switch in session.foot_switches]
    for name, switch in [*switches, *([("stop button", session.live.stop_button)] if session.live.stop_button else [])]:
        on_bus = switch.source == "can_bit"
        wanted.append(_bus(name, session.bus, connected) if on_bus else _line(name, switch.port, connected))
    return wanted


def _line(name: str, port: str, connected: Connected) -> Wanted:
    if "://" in port:
        return Wanted(name, port, None, "a network address; it is only known once it is opened")
    known = next((each for each in connected.ports if Path(each.port).resolve() == Path(port).resolve()), None)
    if known is not None:
        return Wanted(name, port, True, " ".join(part for part in (known.description, known.maker) if part))
    why = not_there(port)
    return Wanted(name, port, not why, why or "is there")


def _bus(name: str, bus: Bus, connected: Connected) -> Wanted:
    where = f"{bus.interface} {bus.channel}"
    listed = [each for each in connected.buses if each.interface == bus.interface]
    if bus.interface == "socketcan" or listed:
        match = next((each for each in listed if each.channel == bus.channel), None)
        if match is None:
            return Wanted(name, where, False, "there is no such interface")
        return Wanted(name, where, match.state != "down", f"is {match.state}" if match.state else "is there")
    if bus.interface == "slcan":
        return _line(name, bus.channel.partition("@")[0], connected)
    return Wanted(name, where, None, "it is only known once it is opened")


def _stream(name: str, stream: str, connected: Connected) -> Wanted:
    if connected.streams is None:
        return Wanted(name, stream, False, "LSL is not installed: pip install 'fes-gait[lsl]'")
    there = any(each.name == stream for each in connected.streams)
    return Wanted(name, stream, there, "is there" if there else "no stream of this name answers")


def _show(connected: Connected, wanted: list[Wanted]) -> None:
    click.secho("Serial ports", bold=True)
    for port in connected.ports:
        click.echo(f"  {port.port:<16}{port.usb or '–':<11}{port.maker or '–':<9}{port.description}")
    click.secho("CAN interfaces", bold=True)
    for bus in connected.buses:
        click.echo(f"  {bus.interface:<16}{bus.channel:<20}{bus.state}")
    click.secho("LSL streams", bold=True)
    for stream in connected.streams or []:
        click.echo(f"  {stream.name:<16}{stream.kind}, {stream.channels} channels at {stream.rate_hz:g} Hz")
    if connected.streams is None:
        click.echo("  not looked for: pip install 'fes-gait[lsl]'")

    if wanted:
        click.secho("The session's devices", bold=True)
    for each in wanted:
        word, colour = {True: ("found", "green"), False: ("MISSING", "red"), None: ("unknown", "yellow")}[each.found]
        click.echo(f"  {click.style(f'{word:<9}', fg=colour)}{each.name:<14}{each.where}: {each.said}")
