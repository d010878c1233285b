"""``fes simulate``: a virtual patient on a treadmill, recorded with its truth, or met live by ``fes run``."""

from __future__ import annotations

import json
import os
import select
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import click

from drivers.imu.port import ImuLost
from drivers.stimulator.port import StimulatorLost
from fes.cli.common import (
    LOG_SUFFIX,
    PATH,
    SENSOR_KINDS,
    SIDE,
    STIMULATORS,
    Interrupt,
    Number,
    Problem,
    StoppedEarly,
    choice,
    failing,
    fresh_folder,
    given_options,
    out_option,
    replay_progress,
    show_latched,
)
from fes.cli.demo import stride_line
from fes.cli.main import WANTS_LINUX
from fes.config import ConfigError, load_session
from fes.estimation.foot.calibration import CalibrationError
from fes.hil.closed_loop.bench import PatientBench, start_patient_bench
from fes.hil.closed_loop.one_process import walk_stimulated, write_strides
from fes.hil.closed_loop.patient_process import Life
from fes.live.inputs import Terminal, standard_keys
from fes.recording import RecordingError, write_recording
from fes.session_log import Note, SessionLogError
from fes.signals import NS_PER_S, Event, ImuSample
from fes.simulation import bundled_file
from fes.simulation.forward import PatientSettings, VirtualPatient, harm_of
from fes.simulation.forward.closed_loop import patient_events, recording_of, truth_of
from fes.simulation.forward.gait_patterns import PATTERNS
from fes.simulation.forward.settings import SEVERITIES, load_patient, settings_for
from fes.simulation.truth import write_truth

CONTROL: Final = ("none", "phase")
LOOK_S: Final = 0.05
SPEED_STEP_MPS: Final = 0.1
KEYS: Final = "w walk · s stand · + − belt speed · e electrode slips (and back) · t tired muscle · q end"
WALKS_AFTER_S: Final = 30.0  # where nobody can press a key


def simulate_live(
    settings: PatientSettings, options: Options, seconds: float | None, stimulator: str, sensors: str
) -> None:
    """Start patient and stimulator, write the session, then pass on what happens for ``seconds``, or until told.

    Raises:
        Problem: a device does not start, or the patient cannot be calibrated.
        StoppedEarly: a process has ended by itself.
    """
    folder = fresh_folder(options.out, options.name)
    keys = standard_keys()
    with ExitStack() as stack:
        interrupt = stack.enter_context(Interrupt())
        life = Life(waits=True, sensors=sensors)
        with failing(ImuLost, StimulatorLost, CalibrationError):
            bench = start_patient_bench(settings, folder, stack, life, stimulator=stimulator)
        meet = f"fes run {bench.session} --calibration {bench.calibration}"
        click.echo(f"The patient stands. In another terminal:\n\n    {meet}\n")
        click.echo("There: a arms (while the patient stands), + raises the intensity.")
        click.echo(f"Here:  {KEYS}" if keys is not None else f"It walks by itself after {WALKS_AFTER_S:.0f} s.")
        if keys is not None:
            stack.enter_context(Terminal(keys))
        try:
            with failing(ImuLost, kind=StoppedEarly):
                _Live(bench, settings, keys).run(seconds, interrupt)
        except KeyboardInterrupt:
            click.echo("Ending.", err=True)
    if summary := bench.patient.summary:
        click.echo(
            f"{summary['pulses']} pulses, {1e-3 * summary['charge_uc']:.2f} mC; the patient's process was "
            f"{summary['latest_ms']:.1f} ms late at most, over 5 ms {summary['late_5ms']} times in "
            f"{summary['intervals']}."
        )


class _Live:
    def __init__(self, bench: PatientBench, settings: PatientSettings, keys: int | None) -> None:
        self._bench, self._keys = bench, keys
        self._speed_mps, self._whole = settings.speed_mps, settings.electrode_quality
        self._slipped = self._over = False

    def run(self, seconds: float | None, interrupt: Interrupt) -> None:
        """Until the time is over, or somebody ends it."""
        begin_s, walks = time.monotonic(), self._keys is not None
        while not self._over and (seconds is None or time.monotonic() - begin_s < seconds):
            if not walks and time.monotonic() - begin_s > WALKS_AFTER_S:
                walks = True
                self._intervene("walk")
            if self._keys is None:
                time.sleep(LOOK_S)
            elif select.select([self._keys], [], [], LOOK_S)[0]:
                self._typed(os.read(self._keys, 64))
            for stride in self._bench.patient.new_strides():
                click.echo(stride_line(stride))
            for name, each in (("patient", self._bench.patient), ("stimulator", self._bench.stimulator)):
                if each.process.poll() is not None:
                    raise ImuLost(f"the {name}'s process has ended")
            interrupt.check()

    def _typed(self, typed: bytes) -> None:
        if not typed:
            self._keys = None
        for key in typed.decode("latin-1"):
            if key == "q":
                self._over = True
            elif key in "ws":
                self._intervene("walk" if key == "w" else "stand")
            elif key in "+=-":
                step = -SPEED_STEP_MPS if key == "-" else SPEED_STEP_MPS
                self._speed_mps = round(min(max(self._speed_mps + step, 0.1), 2.0), 3)
                self._intervene("speed", self._speed_mps)
            elif key == "e":
                self._slipped = not self._slipped
                self._intervene("electrode", 0.6 * self._whole if self._slipped else self._whole)
            elif key == "t":
                self._intervene("fitness", 0.6)

    def _intervene(self, what: str, value: float = 0.0) -> None:
        self._bench.patient.intervene(what, value)
        shown: dict[str, Any] = {"speed": f" {value:g} m/s", "electrode": f" {value:.0%}", "fitness": f" {value:.0%}"}
        click.echo(f"          {what}{shown.get(what, '')}")


@dataclass(frozen=True, slots=True)
class Options:
    """What to write, and where."""

    seconds: float
    out: Path
    name: str
    stimulate: str
    session: Path | None
    overwrite: bool
    as_json: bool


@click.command(name="simulate")
@click.argument("patient", required=False, type=PATH)
@click.option("--severity", type=click.Choice(list(SEVERITIES)), help="Drop foot from none to severe.  [moderate]")
@click.option("--pattern", type=click.Choice(list(PATTERNS)), help="One of the five hemiparetic walks of Wang et al.")
@click.option("--speed", "speed_mps", type=Number(0.1, 2.0), help="Belt speed (m/s).")
@click.option("--side", type=SIDE, help="The affected side.  [right]")
@click.option("--seed", type=click.IntRange(min=0), help="Fixes every random number.  [1]")
@click.option("--rate", "rate_hz", type=Number(20, 1000), help="Samples a second, a divisor of 2000.  [100]")
@click.option("--seconds", type=Number(5, 7200), default=60.0, show_default=True, help="How long.")
@choice("--stimulate", of=CONTROL, help="phase: by the controller, in closed loop with a simulated stimulator.")
@click.option("--live", is_flag=True, help="In real time, as devices that `fes run` meets in another terminal.")
@choice("--stimulator", of=STIMULATORS, help="With --live: which simulated stimulator.")
@choice("--sensors", of=(*SENSOR_KINDS, "capture2go_ble"), help="With --live: which simulated sensors.")
@click.option("--session", type=PATH, help="Settings of the stimulation (TOML).")
@out_option("Folder.")
@click.option("--name", default="simulated", show_default=True, help="Name of the files.")
@click.option("--overwrite", is_flag=True, help="Replace files of that name.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def command(
    patient: Path | None, severity: str | None, live: bool, stimulator: str, sensors: str, **chosen: Any
) -> None:
    """Let a virtual patient walk and record foot and shank sensors of both legs, with the truth.

    PATIENT is a settings file (TOML, table [patient]); options win over it. Writes NAME.parquet with its sidecar, the
    truth as `fes trials` does, NAME.virtual.csv (every stride: drag, stumble, angles, charge) and, stimulated, the
    session log.

    With --live nothing is recorded here: patient and stimulator run as processes until q or --seconds, and a session
    file for them is written to OUT/NAME-001.
    """
    given = {name: chosen.pop(name) for name in ("pattern", "speed_mps", "side", "seed", "rate_hz")}
    others = {name: value for name, value in given.items() if value is not None}
    options = Options(**chosen)
    on_line = given_options()
    if live and sys.platform != "linux":
        raise Problem(WANTS_LINUX.format("simulate --live"))
    if live and (idle := sorted(on_line & {"stimulate", "session", "overwrite", "as_json"})):
        named = "json" if idle[0] == "as_json" else idle[0]
        raise Problem(f"--{named} has no meaning with --live, which writes a session for `fes run` into a new folder.")
    if not live and (idle := sorted(on_line & {"stimulator", "sensors"})):
        raise Problem(f"--{idle[0]} goes with --live.")
    if "session" in on_line and options.stimulate == "none":
        raise Problem("--session goes with --stimulate phase.")
    with failing(ValueError):
        if patient is not None:
            settings = load_patient(patient, **({"severity": severity} if severity else {}), **others)
        else:
            settings = settings_for(severity or "moderate", **others)
    if live:
        simulate_live(settings, options, options.seconds if "seconds" in on_line else None, stimulator, sensors)
        return
    simulate(settings, options)


def simulate(settings: PatientSettings, options: Options) -> None:
    """Walk, write, and say what came of it.

    Problem: files in the way, an unusable session, a foot that cannot be calibrated.
    """
    if Path(options.name).name != options.name or "." in options.name or not options.name:
        raise Problem(f"--name {options.name!r}: a plain name without folder and dot, e.g. patient_7.")
    folder = options.out
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Problem(f"{folder}: cannot be made: {error.strerror}. Choose another with --out.") from error
    there = sorted(path for path in folder.iterdir() if path.name.startswith(f"{options.name}."))
    if there and not options.overwrite:
        raise Problem(f"{there[0]}: is there already. Choose another --name, or --overwrite.")
    (folder / f"{options.name}{LOG_SUFFIX}").unlink(missing_ok=True)
    walker = VirtualPatient(settings)
    samples: list[ImuSample] = []
    end_ns = round(options.seconds * NS_PER_S)
    try:
        with (
            failing(SessionLogError, kind=StoppedEarly),
            Interrupt() as interrupt,
            replay_progress(options.name, 0, end_ns, options.as_json) as reached,
        ):

            def after(event: Event) -> None:
                reached(event.t_ns)
                interrupt.check()

            _walk(walker, samples, options, after)
    except KeyboardInterrupt:
        click.secho("Interrupted; what was walked so far is written.", fg="yellow", err=True)
    with failing(RecordingError, ValueError, OSError, kind=StoppedEarly):
        what = f"Virtual patient, {settings.speed_mps:g} m/s, stimulation: {options.stimulate}"
        recording = recording_of(walker, samples, options.name, what)
        write_recording(recording, folder / f"{options.name}.parquet", overwrite=True)
        write_truth(truth_of(walker, options.name), folder)
        write_strides(folder / f"{options.name}.virtual.csv", walker.strides)
    _show(walker, settings, folder, options)


def _walk(walker: VirtualPatient, samples: list[ImuSample], options: Options, after: Callable[[Event], None]) -> None:
    if options.stimulate == "none":
        for event in patient_events(walker, None, options.seconds, samples.append):
            after(event)
        return
    from fes.estimation.warm_up import warm_up
    from fes.report.quality import Notice

    notes: list[Note] = []
    log, name = options.out / f"{options.name}{LOG_SUFFIX}", options.name
    told: dict[str, Any] = {"on_sample": samples.append, "on_note": notes.append, "after": after}
    try:
        with failing(ConfigError, CalibrationError):
            session = load_session(options.session or bundled_file("session.toml"))
            if options.session is None:
                session = session.model_copy(update={"name": f"Virtual patient, {name}"})
            warm_up()
            walk_stimulated(walker, session, options.seconds, log, name=name, **told)
    finally:
        show_latched(Notice(note.t_ns / NS_PER_S, note.severity, note.source, note.text) for note in notes)


def _show(walker: VirtualPatient, settings: PatientSettings, folder: Path, options: Options) -> None:
    mine = [stride for stride in walker.strides if stride.foot == settings.affected_foot and stride.walking]
    clearance = sorted(100.0 * stride.toe_clearance_m for stride in mine)
    result = {
        "recording": str(folder / f"{options.name}.parquet"),
        "seconds": 1e-9 * walker.now_ns,
        "affected_foot": settings.affected_foot,
        "strides": len(mine),
        "dragged": sum(stride.dragged for stride in mine),
        "stumbled": sum(stride.stumbled for stride in mine),
        "median_toe_clearance_cm": round(clearance[len(clearance) // 2], 2) if clearance else None,
        "charge_uc": round(sum(stride.charge_uc for stride in mine), 1),
        "fitness": round(walker.fitness, 3),
        "harm": {key: round(value, 3) for key, value in asdict(harm_of(mine)).items()},
    }
    if options.as_json:
        click.echo(json.dumps(result, indent=2))
        return
    click.echo(
        f"{result['recording']}: {result['strides']} strides of the {result['affected_foot']}, "
        f"{result['dragged']} dragged, {result['stumbled']} stumbled, "
        + (f"toe clearance {result['median_toe_clearance_cm']} cm on the median, " if mine else "")
        + f"{result['charge_uc']} µC."
    )
