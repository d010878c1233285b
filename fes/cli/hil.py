"""``fes hil``: a fault campaign."""

import signal
import sys
from pathlib import Path
from typing import Final

import click

from drivers.simulated.spawn import ImuKind
from drivers.stimulator.port import StimulatorLost
from fes.cli.common import (
    FAILED,
    PATH,
    SENSOR_KINDS,
    Problem,
    StoppedEarly,
    choice,
    failing,
    fresh_folder,
    interrupted,
    need_extra,
    out_option,
    print_json,
)
from fes.cli.replay.command import prepared
from fes.config import WIRELESS, ConfigError
from fes.estimation.foot.calibration import CalibrationError
from fes.hil.attempts import hardware_campaign, save_campaign, simulated_campaign
from fes.hil.campaign_bench import CampaignBroken
from fes.hil.controller import SIGNALS
from fes.hil.devices import TRANSPORTS, Unavailable, on_hardware
from fes.hil.results import Attempt, Campaign, Verdict, failure_reason, measured_times
from fes.hil.scenarios import BY_NAME, SCENARIOS, Scenario
from fes.recording import RecordingError

COLOURS: Final = {Verdict.MET: "green", Verdict.JITTER: "yellow", Verdict.FAILED: "red", Verdict.SKIPPED: "blue"}
REPEAT: Final = "Each fault so many times, each of its values once."


@click.command(name="hil")
@choice("--transport", of=TRANSPORTS)
@click.option("--channel", default="vcan0", show_default=True, help="The interface, for --transport socketcan.")
@click.option("--only", multiple=True, metavar="NAME", help="This fault only; may be given several times.")
@click.option("--repeat", type=click.IntRange(1, 1000), default=1, show_default=True, help=REPEAT)
@click.option("--closed-loop", is_flag=True, help="With a virtual patient, who feels what the stimulator delivers.")
@click.option("--recording", type=PATH, help="The sensor plays a walk out of this recording.")
@choice("--sensors", of=(*SENSOR_KINDS, *WIRELESS), help="Which simulated sensor is worn.")
@click.option("--list", "listing", is_flag=True, help="List the faults and end; [--hardware] on real devices too.")
@out_option("Results below.")
@click.option("--hardware", type=PATH, help="Real devices, as in this session file.")
@click.option("--calibration", type=PATH, help="Of the real sensors, or of --recording. Default: from that.")
@click.option("--walking", is_flag=True, help="With --hardware: somebody walks with the sensors and stands by turns.")
@click.option("--json", "as_json", is_flag=True, help="As JSON on stdout: what hil.json holds, or the faults.")
@click.option("--i-have-a-dummy-load", "dummy_load", is_flag=True, help="Nobody is connected to the stimulator.")
def command(
    transport: str,
    channel: str,
    only: tuple[str, ...],
    repeat: int,
    closed_loop: bool,
    recording: Path | None,
    sensors: ImuKind,
    listing: bool,
    out: Path,
    hardware: Path | None,
    calibration: Path | None,
    walking: bool,
    dummy_load: bool,
    as_json: bool,
) -> None:
    """Inject faults into a running session and measure, at the stimulator's end, how it answers.

    A simulated patient walks; sensor, stimulator and `fes run` each run in a process of their own, joined by the
    transport. Each fault strikes while current flows in a swing. The judge is the stimulator's own record. The table
    is printed and saved as hil.md and hil.json. With --closed-loop that patient is a virtual one, in a process of its
    own, whose foot answers to the pulses that the stimulator really delivered. With --recording the sensor plays a walk
    out of a recording that `fes replay` can read.

    With --hardware the devices are real and STIMULATE: only into a dummy load, bursts triggered by hand, sensors at
    rest unless they are --walking. Faults are the host's and, between driver and loop, the sensors'; the judge is what
    the stimulator says on its CAN bus, or else answers to the session.

    Exit code: 0 all as required, 1 a row is not, 2 unusable arguments or transport, 3 the campaign could not go on,
    130 interrupted.
    """
    if listing and as_json:
        told = {
            s.name: {
                "fault": s.fault,
                "required": s.response,
                "deadline_ms": s.deadline_ms,
                "hardware": on_hardware(s),
            }
            for s in SCENARIOS
        }
        print_json({"faults": told})
        return
    if listing:
        for scenario in SCENARIOS:
            deadline = "" if scenario.deadline_ms is None else f" (off within {scenario.deadline_ms:g} ms)"
            marked = " [--hardware]" if on_hardware(scenario) else ""
            click.echo(f"{scenario.name:<22} {scenario.fault}: {scenario.response}{deadline}{marked}")
        return
    if hardware is None:
        need_extra("analysis")
    unknown = [name for name in only if name not in BY_NAME]
    if unknown:
        raise Problem(f"--only {', '.join(unknown)}: no such fault. `fes hil --list` names them all.")
    scenarios = [scenario for scenario in SCENARIOS if not only or scenario.name in only]
    if recording is not None and (closed_loop or hardware is not None):
        other = "--closed-loop" if closed_loop else "--hardware"
        raise Problem(f"--recording and {other}: a recording does not answer to stimulation. Leave one out.")
    if walking and hardware is None:
        raise Problem("--walking is for --hardware: simulated sensors always walk.")
    if hardware is not None:
        if not dummy_load:
            raise Problem(
                "--hardware stimulates and provokes faults while it does. Connect a dummy load and nobody, then "
                "confirm with --i-have-a-dummy-load."
            )
        if calibration is None:
            raise Problem("--hardware needs --calibration FILE, from `fes calibrate`.")
        if only and (refused := [scenario.name for scenario in scenarios if not on_hardware(scenario)]):
            raise Problem(f"--only {', '.join(refused)}: needs simulated devices.")
        scenarios = list(filter(on_hardware, scenarios))
    if any(scenario.variant == "seen" for scenario in scenarios):  # on the dashboard
        need_extra("live")
    played = None
    if recording is not None:
        with failing(RecordingError, ConfigError, CalibrationError):
            whole, _, _, found = prepared(recording, None, calibration)
        played = whole, found
    folder = fresh_folder(out, f"hil-{'hardware' if hardware else transport}").resolve()
    for number in SIGNALS:  # a shell's background job ignores SIGINT else
        signal.signal(number, signal.default_int_handler)
    todo = scenarios, repeat, folder, _Progress(len(scenarios), repeat)
    try:
        unusable = failing(Unavailable, ConfigError, StimulatorLost, RecordingError, CalibrationError)
        with unusable, failing(CampaignBroken, kind=StoppedEarly):
            if hardware is not None and calibration is not None:
                campaign = hardware_campaign(hardware, calibration, *todo, walking=walking)
            else:
                campaign = simulated_campaign(transport, *todo, channel, closed_loop, played, sensors)
    except KeyboardInterrupt:
        interrupted(f"; everything is ended. Records so far: {folder}")
    data, text = save_campaign(campaign, folder)
    if as_json:
        click.echo(data.read_text(encoding="utf-8"))
    else:
        _print(campaign)
        click.echo(f"Table {text}\nData  {data}")
    if campaign.failed:
        raise SystemExit(FAILED)


class _Progress:
    """How far it has come, on stderr."""

    def __init__(self, rows: int, repeat: int) -> None:
        self._rows, self._repeat = rows, repeat
        self._names: list[str] = []

    def __call__(self, scenario: Scenario, n: int, found: Attempt | None) -> None:
        if scenario.name not in self._names:
            self._names.append(scenario.name)
        again = f" {n + 1}" if scenario.attempts(self._repeat) > 1 else ""
        place = f"[{len(self._names)}/{self._rows}] {scenario.name}{again}"
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
        within = f"{row.within()}/{len(times)}" if times else "–"
        said = f"[{COLOURS[verdict]}]" + (f"{verdict}: {reason}" if (reason := failure_reason(row)) else str(verdict))
        table.add_row(row.scenario.fault, row.scenario.response, deadline, measured_times(row), within, said)
    Console().print(table)
    for notice in campaign.notices:
        click.secho(notice, fg="yellow")
    click.echo(f"{campaign.baseline}; {campaign.seconds:.0f} s in all.")
