"""``fes demo``: the main job with nothing to set up: a bundled trial, or a virtual patient in closed loop."""

from __future__ import annotations

import json
import sys
import tomllib
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import click

from drivers.imu.port import ImuLost
from drivers.stimulator.port import StimulatorLost
from fes.cli.common import (
    LOG_SUFFIX,
    STIMULATORS,
    Interrupt,
    Number,
    Problem,
    StoppedEarly,
    choice,
    failing,
    fresh_folder,
    interrupted,
    out_option,
    utc_now,
    writing,
)
from fes.config import validate_session
from fes.hil.campaign_bench import CampaignBroken
from fes.hil.closed_loop import one_process
from fes.hil.closed_loop.bench import start_patient_bench
from fes.hil.closed_loop.one_process import LOW_MM, outcome, run_in_one_process
from fes.hil.closed_loop.patient_process import Life
from fes.hil.closed_loop.processes import Protocol, run_between_processes
from fes.hil.settings import patient_calibration, patient_session_text
from fes.live.status import Status
from fes.session_log import Note, SessionLogError, read_session
from fes.signals import NS_PER_S
from fes.simulation import bundled_file
from fes.simulation.forward import PatientSettings, VirtualStride

if TYPE_CHECKING:
    from rich.console import Console, Group
    from rich.live import Live

# --- A closed-loop run as people see it: a live picture in a terminal, plain lines elsewhere ----------------


STRIDES_SHOWN: Final = 14
FEWEST_STRIDES: Final = 5  # in a low terminal; rather fewer texts
TEXTS_SHOWN: Final = 4
BAR_MM: Final = 30.0
BAR: Final = 30


def stride_line(stride: VirtualStride) -> str:
    """One stride in one line."""
    return (
        f"{stride.t_flat_ns / NS_PER_S:6.1f} s  stride {stride.number:3d}  toe {1e3 * stride.toe_clearance_m:5.1f} mm  "
        f"{stride.charge_uc:4.0f} µC  {outcome(stride)}"
    )


class LoopView:
    """Use as a context manager; :meth:`stride`, :meth:`text` and :meth:`state` show what happens.

    Args:
        title: above the picture.
        live: draw a picture; None: where stdout is a terminal.
        quiet: show nothing.
    """

    def __init__(self, title: str, *, live: bool | None = None, quiet: bool = False) -> None:
        self._title = title
        self._draws = not quiet and (sys.stdout.isatty() if live is None else live)
        self._prints = not quiet and not self._draws
        self._live: Live | None = None
        self._strides: list[VirtualStride] = []
        self._texts: list[str] = []
        self._state = ""

    def stride(self, stride: VirtualStride) -> None:
        """A stride of the affected foot is complete."""
        self._strides = [*self._strides, stride][-STRIDES_SHOWN:]
        if self._prints:
            click.echo(stride_line(stride))
        self._draw()

    def text(self, t_s: float, text: str) -> None:
        """A text about the tuning or the patient."""
        self._texts = [*self._texts, f"{t_s:6.1f} s  {text}"][-TEXTS_SHOWN:]
        if self._prints:
            click.echo(f"{t_s:6.1f} s  → {text}")
        self._draw()

    def state(self, text: str) -> None:
        """Where the session stands; lines are printed only when it changes."""
        if text != self._state and self._prints:
            click.echo(f"          session: {text}")
        self._state = text
        self._draw()

    def __enter__(self) -> Self:
        if self._draws:
            from rich.live import Live

            self._live = Live(auto_refresh=False, transient=False)
            self._live.start()
        elif self._prints:
            click.echo(self._title)
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def _draw(self) -> None:
        if self._live is not None:
            self._live.update(self.picture(self._live.console), refresh=True)

    def picture(self, console: Console) -> Group:
        """One frame, no higher than the terminal: what was said last is never cut off; older strides make room."""
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        colours = {"stumbled": "bold red", "dragged": "red", "low": "yellow", "clears": "green"}
        above = [Text(self._title, "bold"), Text(self._state, "cyan")]
        below = [Text(text, "dim") for text in self._texts[:-1]] + [Text(text) for text in self._texts[-1:]]

        def lines(texts: list[Text]) -> int:
            return sum(len(text.wrap(console, console.width)) for text in texts)

        room = console.height - lines(above) - 2  # the table's head, and the cursor's line
        while len(below) > 1 and room - lines(below) < FEWEST_STRIDES:
            below.pop(0)
        shown = self._strides[-min(max(room - lines(below), 1), STRIDES_SHOWN) :]
        table = Table("stride", "toe clearance", "mm", "charge (µC)", "", box=None, pad_edge=False)
        for stride in shown:
            height_mm, what = 1e3 * stride.toe_clearance_m, outcome(stride)
            filled = round(min(max(height_mm, 0.0), BAR_MM) / BAR_MM * BAR)
            bar = Text("━" * filled + " " * (BAR - filled), colours[what])
            said = Text(what, colours[what])
            table.add_row(str(stride.number), bar, f"{height_mm:.0f}", f"{stride.charge_uc:.0f}", said)
        return Group(*above, table, *below)


GO_ON: Final = 3  # times, where a busy computer makes the session switch off
LONGEST_FOLDER: Final = 85  # its socket's name has 107 bytes at most
TITLE: Final = (
    "A simulated drop-foot patient on a treadmill, 0.8 m/s: the affected foot, stride by stride.\n"
    "The strides' toe heights are the true ones; the controller measures some 1 mm more, and aims at that.\n"
    f"A stride clears where the toe passes {LOW_MM:.0f} mm or more above the ground, or else is low, dragged or "
    "stumbled.\nSeconds are the patient's; the report's are of its log, which may begin some seconds before the walk."
)


def demo_closed_loop(out: Path, *, fast: bool, stimulator: str, as_json: bool) -> None:
    """Run it, show it, write log and report: by an injected clock, or in real time between processes.

    Raises:
        Problem: the folder cannot be used, or a device does not start.
        StoppedEarly: the session switched off before the end.
        SystemExit: interrupted.
    """
    folder = fresh_folder(out, "closed_loop").resolve()
    if not fast and len(str(folder).encode()) > LONGEST_FOLDER:
        raise Problem(f"{folder}: the name is too long for a control socket. Choose a shorter one with --out.")
    settings, plan = one_process.patient(), one_process.demo_protocol(one_process.SECONDS)
    strides: list[VirtualStride] = []
    try:
        with (
            failing(SessionLogError, kind=StoppedEarly),
            Interrupt() as interrupt,
            LoopView(TITLE, quiet=as_json) as view,
        ):

            def on_stride(stride: VirtualStride) -> None:
                if stride.t_flat_ns > one_process.SLIPS_S * NS_PER_S > (strides[-1].t_flat_ns if strides else 0):
                    view.text(
                        one_process.SLIPS_S,
                        f"an electrode has slipped: {one_process.SLIPS_TO:.0%} of the charge reaches the nerve",
                    )
                strides.append(stride)
                view.stride(stride)

            if fast:
                log = _in_one_process(settings, plan, folder, view, on_stride, interrupt)
                more: dict[str, Any] = {}
            else:
                log, more = _between_processes(settings, plan, folder, view, on_stride, interrupt, stimulator)
    except KeyboardInterrupt:
        one_process.write_strides(folder / "patient.strides.csv", strides)
        for begun in sorted(folder.rglob(f"session{LOG_SUFFIX}")):
            with suppress(SessionLogError):  # too short for a header: there is nothing to report
                _report(begun, folder / "report.html")
        interrupted(f"; everything is ended. What there is: {folder}")
    one_process.write_strides(folder / "patient.strides.csv", strides)
    result = {**one_process.result_of(strides), **more, "session_log": str(log), "report": str(folder / "report.html")}
    _report(log, folder / "report.html")
    (folder / "result.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    _show(result, as_json=as_json)


def _in_one_process(
    settings: PatientSettings, plan: Protocol, folder: Path, view: LoopView, on_stride: Any, interrupt: Interrupt
) -> Path:
    from fes.estimation.warm_up import warm_up

    text = patient_session_text(settings, current_ma=one_process.CURRENT_MA)
    (folder / "session.toml").write_text(text, encoding="utf-8")
    session = validate_session(tomllib.loads(text), folder / "session.toml", text)
    view.state("on injected time, in one process")
    calibrations = patient_calibration(settings).calibrations
    warm_up()

    def on_note(note: Note) -> None:
        if note.source == "tuning" and " skipped: " not in note.text:
            view.text(note.t_ns / NS_PER_S, note.text.partition(": ")[2])

    log = folder / f"session{LOG_SUFFIX}"
    told = {"on_stride": on_stride, "on_note": on_note, "after": lambda event: interrupt.check()}
    run_in_one_process(settings, session, calibrations, plan, log, utc_now(), **told)
    return log


def _between_processes(
    settings: PatientSettings,
    plan: Protocol,
    folder: Path,
    view: LoopView,
    on_stride: Any,
    interrupt: Interrupt,
    stimulator: str,
) -> tuple[Path, dict[str, Any]]:
    view.state("starting patient, stimulator and controller, each a process of its own")
    shown: dict[str, str] = {}

    def on_status(status: Status) -> None:
        now_s = max(bench.patient.now_s, 0.0) if bench.patient.start_ns < status.t_ns else 0.0
        channel = status.tuning.get(str(settings.channel))
        burst = f", next burst {channel.now}" if channel else ""
        view.state(f"{status.state}, intensity {status.intensity:.0%}{burst}")
        for text in (channel.last_change, channel.hint) if channel else ():
            if text and shown.get(text[:24]) != text:
                shown[text[:24]] = text
                view.text(now_s, text)

    with failing(ImuLost, StimulatorLost), failing(CampaignBroken, kind=StoppedEarly), ExitStack() as stack:
        bench = start_patient_bench(
            settings, folder, stack, Life(held=True), stimulator=stimulator, current_ma=one_process.CURRENT_MA
        )
        ran = run_between_processes(
            bench, plan, on_stride=on_stride, on_status=on_status, on_tick=interrupt.check, most_rearms=GO_ON
        )
    return ran.log, {"patient_process": ran.punctuality, "interruptions": list(ran.interruptions)}


def _report(log: Path, path: Path) -> None:
    from fes.report.page import write_report

    with writing(path, f". The log is whole: {log}", StoppedEarly):
        write_report(read_session(log), path)


def _story(result: dict[str, Any]) -> str:
    """What happened, in a sentence or two for people."""
    from fes.report.text import count_of

    first, last = result["first_8_strides"], result["last_10_strides"]
    bad, still = first["dragged"], last["dragged"]
    cleared, recovered = result["strides_until_clear"], result["strides_until_clear_again"]
    story = f"At first the toe dragged ({bad} of 8 strides, {count_of(first['stumbled'], 'stumble')}). "
    story += f"Stimulation tuned itself; from stride {cleared} on it cleared. " if cleared else "It was not cleared. "
    if recovered is not None:
        story += f"After the electrode slipped it took {count_of(recovered, 'stride')} to clear again. "
    return story + ("No stride of the last ten dragged." if not still else f"{still} of the last ten dragged.")


def _show(result: dict[str, Any], *, as_json: bool) -> None:
    from fes.report.text import count_of

    if as_json:
        click.echo(json.dumps(result, indent=2))
        return
    names = {
        "first_8_strides": "the first 8 strides",
        "before_the_slip": "10 strides before the electrode slipped",
        "last_10_strides": "the last 10 strides",
    }
    for key, name in names.items():
        part = result[key]
        click.echo(
            f"{name}: {part['dragged']} dragged, {part['stumbled']} stumbled, toe clearance "
            f"{part['median_toe_clearance_mm']} mm, {part['charge_uc_a_step']} µC a step (medians)"
        )
    click.echo(_story(result))
    harm = result["harm"]
    click.echo(
        f"Harm in {harm['strides']} strides: {count_of(harm['stumbles'], 'stumble')}, "
        f"{count_of(harm['drags'], 'drag')}, {count_of(harm['early_bursts'], 'burst')} against the push-off "
        f"({harm['push_off_lost']:.0%} of its work lost), "
        f"{count_of(harm['inverted_contacts'], 'landing')} inverted by more than 5° (one channel lifts, none everts), "
        f"{count_of(harm['spasms'], 'spasm')}, "
        f"co-contraction {harm['co_contraction_nms']:.1f} N·m·s and {harm['charge_uc']:.0f} µC a stride."
    )
    if process := result.get("patient_process"):
        click.echo(
            f"The patient's process was {process['latest_ms']:.1f} ms late at most, over 5 ms {process['late_5ms']} "
            f"times in {process['intervals']}; {process['pulses']} pulses reached it, {process['pulses_late']} late."
        )
    for reason in result.get("interruptions", ()):
        click.secho(f"Switched off on the way, and armed again by hand while the patient stood: {reason}", fg="yellow")
    click.echo(f"Session log  {result['session_log']}\nReport       {result['report']}  (open it in a browser)")


TRIAL = "negard_patient2.parquet"


@click.command(name="demo")
@out_option()
@click.option("--speed", type=Number(min=0.01), help="1 = as recorded. Default: as fast as it goes.")
@click.option(
    "--closed-loop", is_flag=True, help="A virtual patient instead: it stumbles, the controller tunes itself."
)
@click.option("--fast", is_flag=True, help="With --closed-loop: in seconds, by an injected clock.")
@choice("--stimulator", of=STIMULATORS, help="With --closed-loop, in real time: which simulated stimulator.")
@click.option("--json", "as_json", is_flag=True, help="With --closed-loop: print the result as JSON.")
def command(out: Path, speed: float | None, closed_loop: bool, fast: bool, stimulator: str, as_json: bool) -> None:
    """Replay a drop-foot patient's treadmill trial into a simulated stimulator, and write the report.

    With --closed-loop a virtual patient with a drop foot walks for 80 seconds: patient, stimulator and `fes run`, each
    in a process of its own, joined by the devices' own lines. The current to begin with is too low, the toe catches;
    the controller raises it stride by stride, and again when an electrode slips.
    """
    if closed_loop:
        if speed is not None:
            raise Problem("--speed has no meaning with --closed-loop: it runs in real time, or with --fast.")
        demo_closed_loop(out, fast=fast, stimulator=stimulator, as_json=as_json)
        return
    if fast or as_json:
        raise Problem(
            "--fast and --json go with --closed-loop; a replay is as fast as it can be unless --speed says so."
        )
    from fes.cli.replay.command import Options as ReplayOptions
    from fes.cli.replay.command import replay_recording

    click.echo("A simulated stroke patient with a drop foot walks at 1.5 km/h; the foot's IMU times the stimulation.")
    replay_recording(bundled_file(TRIAL), ReplayOptions(out=out, speed=speed, session=bundled_file("session.toml")))
