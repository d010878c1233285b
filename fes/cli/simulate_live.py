"""``fes simulate --live``: a virtual patient and a simulated stimulator that ``fes run`` in another terminal meets."""

from __future__ import annotations

import os
import select
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click

from drivers.imu.port import ImuLost
from drivers.stimulator.port import StimulatorLost
from fes.cli.exits import StoppedEarly, fail
from fes.cli.folders import fresh_folder
from fes.cli.interrupt import Interrupt
from fes.cli.loop_view import stride_line
from fes.estimation.calibration import CalibrationError
from fes.hil.patient_bench import PatientBench, start_patient_bench
from fes.live.keyboard import Terminal, standard_keys
from fes.patient.virtual import PatientSettings

LOOK_S: Final = 0.05
SPEED_STEP_MPS: Final = 0.1
KEYS: Final = "w walk · s stand · + − belt speed · e electrode slips (and back) · t tired muscle · q end"
WALKS_AFTER_S: Final = 30.0  # where nobody can press a key


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """Where to write, for how long (None: until told), which simulated stimulator."""

    out: Path
    name: str
    seconds: float | None = None
    stimulator: str = "can"


def simulate_live(settings: PatientSettings, options: LiveOptions) -> None:
    """Start both, write the session, tell how to meet them, then pass on what happens until the end.

    Raises:
        Problem: a device does not start, or the patient cannot be calibrated.
        StoppedEarly: a process has ended by itself.
    """
    folder = fresh_folder(options.out, options.name)
    keys = standard_keys()
    with ExitStack() as stack:
        interrupt = stack.enter_context(Interrupt())
        try:
            bench = start_patient_bench(settings, folder, stack, stimulator=options.stimulator, waits=True)
        except (ImuLost, StimulatorLost, CalibrationError) as error:
            fail(error)
        _tell(bench, keys)
        if keys is not None:
            stack.enter_context(Terminal(keys))
        try:
            _Live(bench, settings, keys).run(options.seconds, interrupt)
        except KeyboardInterrupt:
            click.echo("Ending.", err=True)
        except ImuLost as error:
            fail(error, StoppedEarly)
        patient = bench.patient
    summary = patient.summary
    if summary:
        click.echo(
            f"{summary['pulses']} pulses, {1e-3 * summary['charge_uc']:.2f} mC; the patient's process was "
            f"{summary['latest_ms']:.1f} ms late at most, over 5 ms {summary['late_5ms']} times in "
            f"{summary['intervals']}."
        )


def _tell(bench: PatientBench, keys: int | None) -> None:
    click.echo(
        f"The patient stands. In another terminal:\n\n    fes run {bench.session} --calibration {bench.calibration}\n"
    )
    click.echo("There: a arms (while the patient stands), + raises the intensity.")
    click.echo(f"Here:  {KEYS}" if keys is not None else f"It walks by itself after {WALKS_AFTER_S:.0f} s.")


class _Live:
    def __init__(self, bench: PatientBench, settings: PatientSettings, keys: int | None) -> None:
        self._bench = bench
        self._speed_mps = settings.speed_mps
        self._whole = settings.electrode_quality
        self._slipped = False
        self._keys = keys
        self._over = False

    def run(self, seconds: float | None, interrupt: Interrupt) -> None:
        """Until the time is over, or somebody ends it."""
        begin_s, walks = time.monotonic(), self._keys is not None
        while not self._over and (seconds is None or time.monotonic() - begin_s < seconds):
            if not walks and time.monotonic() - begin_s > WALKS_AFTER_S:
                walks = True
                self._do("walk")
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
                self._do("walk" if key == "w" else "stand")
            elif key in "+=-":
                step = -SPEED_STEP_MPS if key == "-" else SPEED_STEP_MPS
                self._speed_mps = round(min(max(self._speed_mps + step, 0.1), 2.0), 3)
                self._do("speed", self._speed_mps)
            elif key == "e":
                self._slipped = not self._slipped
                self._do("electrode", 0.6 * self._whole if self._slipped else self._whole)
            elif key == "t":
                self._do("fitness", 0.6)

    def _do(self, deed: str, value: float = 0.0) -> None:
        self._bench.patient.do(deed, value)
        shown: dict[str, Any] = {"speed": f" {value:g} m/s", "electrode": f" {value:.0%}", "fitness": f" {value:.0%}"}
        click.echo(f"          {deed}{shown.get(deed, '')}")
