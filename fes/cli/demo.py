"""``fes demo``: the main job with nothing to set up: a bundled trial, or a virtual patient in closed loop."""

from __future__ import annotations

from pathlib import Path

import click

from fes.cli.exits import Problem
from fes.cli.ranges import Number

TRIAL = "negard_patient2"


@click.command(name="demo")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("out"), show_default=True, help="Results go below."
)
@click.option("--speed", type=Number(min=0.01), help="1 = as recorded. Default: as fast as it goes.")
@click.option(
    "--closed-loop", is_flag=True, help="A virtual patient instead: it stumbles, the controller tunes itself."
)
@click.option(
    "--fast", is_flag=True, help="With --closed-loop: in seconds, by an injected clock, with the same result."
)
@click.option(
    "--stimulator",
    type=click.Choice(["can", "p24_low_level", "rehastim2"]),
    default="can",
    show_default=True,
    help="With --closed-loop, in real time: which simulated stimulator.",
)
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
        from fes.cli.demo_loop import Options as LoopOptions
        from fes.cli.demo_loop import demo_closed_loop

        demo_closed_loop(LoopOptions(out, fast, stimulator, as_json=as_json))
        return
    if fast or as_json:
        raise Problem(
            "--fast and --json go with --closed-loop; a replay is as fast as it can be unless --speed says so."
        )
    from fes.cli.replay import Options, replay_recording

    trials = Path(__file__).resolve().parents[2] / "sim_inputs"
    recording = trials / f"{TRIAL}.parquet"
    if not recording.is_file():
        raise Problem(f"{recording} is missing: the demo needs the project's folder, not only the installed package.")
    click.echo("A simulated stroke patient with a drop foot walks at 1.5 km/h; the foot's IMU times the stimulation.")
    replay_recording(recording, Options(out=out, speed=speed, session=trials / "session.toml"))
