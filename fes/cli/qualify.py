"""``fes qualify``: one device measured and handled step by step, evidence of it, and the page made of all evidence."""

import json
import platform
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any, Final

import click

from fes import __version__
from fes.cli.common import FAILED, PATH, Problem, StoppedEarly, failing, interrupted, utc_now, writing
from fes.config import ConfigError, ImuDevice, Session, load_session

SIMULATED: Final = ("xbus", "ximu3", "capture2go", "witmotion", "can", "p24_low_level", "p24_mid_level", "rehastim2")
VIRTUAL_BUSES: Final = ("udp_multicast", "loopback", "virtual")
STIMULATES: Final = (
    "qualifying a stimulator STIMULATES. Connect a dummy load (1 kΩ, 1 W) with an oscilloscope across it, and nobody; "
    "then confirm with --i-have-a-dummy-load."
)


@click.command(name="qualify")
@click.argument("session", type=PATH, required=False)
@click.option("--device", "name", metavar="NAME", help="Of SESSION: a sensor's place (right_foot …), or stimulator.")
@click.option(
    "--channel", type=click.IntRange(0, 7), default=0, show_default=True, help="The stimulator's, on the load."
)
@click.option("--by", default="", metavar="TEXT", help="Who does the steps and reads; needed with SESSION.")
@click.option("--serial", default="", metavar="TEXT", help="Where the device does not say its own.")
@click.option("--firmware", default="", metavar="TEXT", help="Where the device does not say its own.")
@click.option("--simulated", type=click.Choice(SIMULATED), help="A simulated device and person instead of SESSION.")
@click.option("--page", type=PATH, metavar="FOLDER", help="Print the page of all evidence in FOLDER, and end.")
@click.option(
    "--key", type=PATH, help="A file with your laboratory's key: evidence is signed, or its signature checked."
)
@click.option("--out", type=PATH, default=Path("out"), show_default=True, help="The evidence is written there.")
@click.option("--i-have-a-dummy-load", "dummy_load", is_flag=True, help="Nobody is connected to the stimulator.")
def command(
    session: Path | None,
    name: str | None,
    channel: int,
    by: str,
    serial: str,
    firmware: str,
    simulated: str | None,
    page: Path | None,
    key: Path | None,
    out: Path,
    dummy_load: bool,
) -> None:
    """Qualify one device of SESSION (TOML), step by step, and write evidence of what it does.

    A sensor is laid down, struck, set on its sides, turned and shaken: identity, rate, clock, losses, delay, range,
    dead band, axes, gains. A stimulator STIMULATES a dummy load, within the limits of its channel in SESSION, and a
    person reads the oscilloscope: currents, widths, when pulses end after off, after an emergency stop, without
    commands.

    Exit code: 0 nothing deviates, 1 something does, 2 unusable arguments or settings, 3 it could not be ended, 130
    interrupted.
    """
    from fes.qualify.evidence import EvidenceRefused, hardware_page

    if sum(each is not None for each in (session, simulated, page)) != 1:
        raise Problem("name one of: SESSION with --device, --simulated KIND, or --page FOLDER.")
    secret = b""
    if key is not None:
        try:
            secret = key.read_bytes()
        except OSError as error:
            raise Problem(f"--key {key}: cannot be read: {error.strerror}.") from error
    if page is not None:
        with failing(EvidenceRefused, ValueError):
            click.echo(hardware_page(page, secret), nl=False)
        return
    try:
        with _stopping():
            if simulated is not None:
                what, settings, figures = _simulated(simulated)
                found = (simulated, True, by or "a simulated person")
            else:
                what, settings, figures = _real(session, name, channel, by, dummy_load=dummy_load)
                found = (f"{session and session.stem}-{name}", _is_virtual(settings), by)
    except KeyboardInterrupt:
        interrupted("; everything is off, and no evidence is written.")
    stem, virtual, person = found
    about = {"what": what, "simulated": virtual, "settings": settings, "when": utc_now(), "by": person}
    about |= {"serial": figures.get("serial", "") or serial, "firmware": figures.get("firmware", "") or firmware}
    about["with"] = f"fes {__version__}, Python {platform.python_version()}, {sys.platform}"
    _finish(about | {"figures": figures}, stem, out, secret)


def _finish(evidence: dict[str, Any], stem: str, out: Path, key: bytes) -> None:
    """Write the evidence, show it, and say what deviates."""
    from fes.qualify.evidence import findings, finite, sealed, shown

    evidence["figures"] = finite(evidence["figures"])
    with failing(ValueError):
        data = sealed(evidence, key)
    with writing(out, ". Choose another folder with --out.", StoppedEarly):
        out.mkdir(parents=True, exist_ok=True)
        names = (f"{stem}-{evidence['when'][:10]}{'' if n == 1 else f'-{n}'}.json" for n in count(1))
        path = next(out / name for name in names if not (out / name).exists())  # evidence is never written over
        path.write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    for name, value in data["figures"].items():
        click.echo(f"{name.replace('_', ' '):<26}{shown(value)}")
    deviating = findings(data)
    for finding in deviating:
        click.secho(f"DEVIATES  {finding.name.replace('_', ' ')}: {finding.text}", fg="red")
    if not deviating:
        click.secho("Nothing deviates.", fg="green")
    click.echo(f"Evidence  {path}  (sha256 {data['digest'][:12]})")
    if data["simulated"]:
        click.echo("          of a simulated device: it says nothing of a real one")
    if deviating:
        raise SystemExit(FAILED)


@contextmanager
def _stopping() -> Iterator[None]:
    """What is wrong with settings ends the command at once; what is wrong later, as one that had begun."""
    from drivers.imu.port import ImuLost
    from drivers.stimulator.bus import BusError
    from drivers.stimulator.port import StimulatorLost
    from fes.qualify.sensor import NotQualified

    with failing(ConfigError), failing(ImuLost, StimulatorLost, BusError, NotQualified, kind=StoppedEarly):
        yield


def _simulated(kind: str) -> tuple[str, dict[str, Any], dict[str, Any]]:
    from fes.qualify import simulated

    if kind in simulated.SENSORS:
        sensor = simulated.simulated_sensor(kind)
        return "sensor", sensor.device.model_dump(mode="json"), sensor.figures()
    stimulator = simulated.simulated_stimulator(kind)
    return "stimulator", _of_stimulator(stimulator.session), stimulator.figures()


def _of_stimulator(session: Session) -> dict[str, Any]:
    """Of a session what the evidence of its stimulator holds."""
    settings = session.stimulator.model_dump(mode="json")
    on_bus = session.stimulator.device in ("can", "canopen")
    limits = session.channels[0].limits.model_dump(mode="json")
    return settings | {"limits": limits} | ({"bus": session.bus.model_dump(mode="json")} if on_bus else {})


def _real(
    path: Path | None, name: str | None, channel: int, by: str, *, dummy_load: bool
) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """What kind it is, its settings, its figures."""
    from fes.qualify.sensor import RealTime, TerminalPerson

    if path is None or not name or not by.strip():
        raise Problem("SESSION needs --device, a sensor's place or stimulator, and --by, who does the steps.")
    session = load_session(path)
    places = {str(device.sensor): device for device in session.sensors}
    if name == "stimulator":
        if not dummy_load:
            raise Problem(STIMULATES)
        return _real_stimulator(session, path, channel, RealTime(), TerminalPerson())
    if name not in places:
        raise Problem(f"--device {name}: {path} has {', '.join((*places, 'stimulator'))}.")
    return _real_sensor(session, places[name], RealTime(), TerminalPerson())


def _real_sensor(session: Session, device: ImuDevice, clock: Any, person: Any) -> tuple[str, dict[str, Any], Any]:
    from drivers.imu.open import open_imus
    from fes.qualify.sensor import SensorBench

    with failing(ValueError):
        port = open_imus([device], session.bus)[0]
    try:
        figures = SensorBench(device, port, clock, person).figures()
    finally:
        port.close()
    settings = device.model_dump(mode="json")
    return "sensor", settings | ({"bus": session.bus.model_dump(mode="json")} if device.port == "bus" else {}), figures


def _real_stimulator(
    session: Session, path: Path, channel: int, clock: Any, person: Any
) -> tuple[str, dict[str, Any], dict[str, Any]]:
    from drivers.stimulator.open import open_session
    from fes.qualify.stimulator import StimulatorBench, exercise_of

    alone = exercise_of(session, channel, path)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # else nobody would say off
    bench = StimulatorBench(alone, lambda t_ns: open_session(alone.stimulator, alone, t_ns).port, clock, person)
    return "stimulator", _of_stimulator(alone), bench.figures()


def _is_virtual(settings: dict[str, Any]) -> bool:
    """Whether its line is one that no real device is on: a pseudo-terminal, this computer's own network, no wire."""
    port, bus = str(settings.get("port", "")), settings.get("bus")
    if bus is not None and port in ("", "bus"):
        return bus["interface"] in VIRTUAL_BUSES or str(bus["channel"]).startswith("vcan")
    local = any(f"//{host}" in port for host in ("127.", "localhost", "[::1]"))
    return local or Path(port).resolve().parent == Path("/dev/pts")
