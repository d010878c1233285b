"""``fes hil``: a fault campaign."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Final

import click

from drivers.stimulator.port import StimulatorLost
from fes.cli.common.exits import FAILED, INTERRUPTED, Problem, StoppedEarly, fail, fresh_folder
from fes.config import ConfigError
from fes.hil.campaign import hardware_campaign, save_campaign, simulated_campaign
from fes.hil.campaign_bench import CampaignBroken
from fes.hil.controller import SIGNALS
from fes.hil.devices import TRANSPORTS, Unavailable, host_side_scenarios
from fes.hil.results import Attempt, Campaign, Verdict, failure_reason, measured_times
from fes.hil.scenarios import BY_NAME, SCENARIOS, Scenario

COLOURS: Final = {Verdict.MET: "green", Verdict.JITTER: "yellow", Verdict.FAILED: "red", Verdict.SKIPPED: "blue"}


@click.command(name="hil")
@click.option("--transport", type=click.Choice(TRANSPORTS), default=TRANSPORTS[0], show_default=True)
@click.option("--channel", default="vcan0", show_default=True, help="The interface, for --transport socketcan.")
@click.option("--only", multiple=True, metavar="NAME", help="This fault only; may be given several times.")
@click.option(
    "--repeat",
    type=click.IntRange(1, 1000),
    default=1,
    show_default=True,
    help="Each fault so many times, each of its values once.",
)
@click.option("--closed-loop", is_flag=True, help="With a virtual patient, who feels what the stimulator delivers.")
@click.option("--list", "listing", is_flag=True, help="List the faults and end.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("out"), show_default=True, help="Results below.")
@click.option("--hardware", type=click.Path(path_type=Path), help="Real devices, as in this session file.")
@click.option("--calibration", type=click.Path(path_type=Path), help="Of the real sensors, from `fes calibrate`.")
@click.option("--i-have-a-dummy-load", "dummy_load", is_flag=True, help="Nobody is connected to the stimulator.")
def command(
    transport: str,
    channel: str,
    only: tuple[str, ...],
    repeat: int,
    closed_loop: bool,
    listing: bool,
    out: Path,
    hardware: Path | None,
    calibration: Path | None,
    dummy_load: bool,
) -> None:
    """Inject faults into a running session and measure, at the stimulator's end, how it answers.

    A simulated patient walks; sensor, stimulator and `fes run` each run in a process of their own, joined by the
    transport. Each fault strikes while current flows in a swing. The judge is the stimulator's own record. The table
    is printed and saved as hil.md and hil.json. With --closed-loop that patient is a virtual one, in a process of its
    own, whose foot answers to the pulses that the stimulator really delivered.

    With --hardware the devices are real and STIMULATE: only into a dummy load, bursts triggered by hand, sensors at
    rest, only the faults of the host's side; the judge is what the stimulator says on its CAN bus.

    Exit code: 0 all as required, 1 a row is not, 2 unusable arguments or transport, 3 the campaign could not go on,
    130 interrupted.
    """
    if listing:
        for scenario in SCENARIOS:
            deadline = "" if scenario.deadline_ms is None else f", within {scenario.deadline_ms:g} ms"
            click.echo(f"{scenario.name:<22} {scenario.fault}: {scenario.response}{deadline}")
        return
    unknown = [name for name in only if name not in BY_NAME]
    if unknown:
        raise Problem(f"--only {', '.join(unknown)}: no such fault. `fes hil --list` names them all.")
    scenarios = [scenario for scenario in SCENARIOS if not only or scenario.name in only]
    if hardware is not None:
        scenarios = _for_hardware(scenarios, only, calibration, dummy_load)
    folder = fresh_folder(out, f"hil-{'hardware' if hardware else transport}").resolve()
    for number in SIGNALS:  # a shell's background job ignores SIGINT else
        signal.signal(number, _interrupt)
    try:
        progress = _Progress(len(scenarios), repeat)
        if hardware is not None and calibration is not None:
            campaign = hardware_campaign(hardware, calibration, scenarios, repeat, folder, progress)
        else:
            campaign = simulated_campaign(
                transport, scenarios, repeat, folder, progress, channel, closed_loop=closed_loop
            )
    except (Unavailable, ConfigError, StimulatorLost) as error:
        fail(error)
    except CampaignBroken as error:
        fail(error, StoppedEarly)
    except KeyboardInterrupt:
        click.secho(f"Interrupted; everything is ended. Records so far: {folder}", fg="yellow", err=True)
        raise SystemExit(INTERRUPTED) from None
    as_json, as_text = save_campaign(campaign, folder)
    _print(campaign)
    click.echo(f"Table {as_text}\nData  {as_json}")
    if campaign.failed:
        raise SystemExit(FAILED)


def _for_hardware(
    scenarios: list[Scenario], only: tuple[str, ...], calibration: Path | None, dummy_load: bool
) -> list[Scenario]:
    """The rows that can be run on real devices.

    Raises:
        Problem: no dummy load confirmed, no calibration, or a row that needs simulated devices.
    """
    if not dummy_load:
        raise Problem(
            "--hardware stimulates and provokes faults while it does. Connect a dummy load and nobody, then confirm "
            "with --i-have-a-dummy-load."
        )
    if calibration is None:
        raise Problem("--hardware needs --calibration FILE, from `fes calibrate`.")
    possible = host_side_scenarios()
    if only and (refused := [scenario.name for scenario in scenarios if scenario not in possible]):
        raise Problem(f"--only {', '.join(refused)}: needs simulated devices.")
    return [scenario for scenario in scenarios if scenario in possible]


class _Progress:
    """How far it has come, on stderr."""

    def __init__(self, rows: int, repeat: int) -> None:
        self._rows = rows
        self._repeat = repeat
        self._names: list[str] = []

    def __call__(self, scenario: Scenario, n: int, found: Attempt | None) -> None:
        if scenario.name not in self._names:
            self._names.append(scenario.name)
        place = f"[{len(self._names)}/{self._rows}] {scenario.name}" + (
            f" {n + 1}" if scenario.attempts(self._repeat) > 1 else ""
        )
        if found is None:
            if sys.stderr.isatty():
                click.echo(f"\r\x1b[K{place} …", nl=False, err=True)
            return
        measured = "" if found.off_ms is None else f"{found.off_ms:.1f} ms"
        said = "; ".join(filter(None, (found.value, measured, found.notice, *found.faults)))
        start = "\r\x1b[K" if sys.stderr.isatty() else ""
        click.secho(f"{start}{place}: {said}", fg="red" if found.faults else None, err=True)


def _print(campaign: Campaign) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("fault", "required", "deadline", "off after", "in time", "verdict", title=f"{campaign.transport}")
    for row in campaign.rows:
        verdict = row.verdict(campaign.baseline.p999_ms)
        deadline = "–" if row.scenario.deadline_ms is None else f"{row.scenario.deadline_ms:g} ms"
        times = row.times_ms()
        said = f"{verdict}: {failure_reason(row)}" if failure_reason(row) else str(verdict)
        table.add_row(
            row.scenario.fault,
            row.scenario.response,
            deadline,
            measured_times(row),
            f"{row.within()}/{len(times)}" if times else "–",
            f"[{COLOURS[verdict]}]{said}",
        )
    Console().print(table)
    for notice in campaign.notices:
        click.secho(notice, fg="yellow")
    click.echo(f"{campaign.baseline}; {campaign.seconds:.0f} s in all.")


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
