"""``fes demo``: the main job on a bundled trial, with nothing to set up."""

from __future__ import annotations

from pathlib import Path

import click

from fes.cli.exits import Problem

TRIAL = "negard_patient2"


@click.command(name="demo")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("out"), show_default=True, help="Results go below."
)
@click.option("--speed", type=click.FloatRange(min=0.01), help="1 = as recorded. Default: as fast as it goes.")
def command(out: Path, speed: float | None) -> None:
    """Replay a drop-foot patient's treadmill trial into a simulated stimulator, and write the report."""
    from fes.cli.replay import Options, replay_recording

    trials = Path(__file__).resolve().parents[2] / "sim_inputs"
    recording = trials / f"{TRIAL}.parquet"
    if not recording.is_file():
        raise Problem(f"{recording} is missing: the demo needs the project's folder, not only the installed package.")
    click.echo("A simulated stroke patient with a drop foot walks at 1.5 km/h; the foot's IMU times the stimulation.")
    replay_recording(recording, Options(out=out, speed=speed, session=trials / "session.toml"))
