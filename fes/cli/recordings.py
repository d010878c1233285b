"""``fes calibrate``: how the sensors sit and how this person moves; ``fes import`` and ``fes trials``: recordings."""

import math
from pathlib import Path
from typing import Any

import click

from fes.calibration.recording import SensorCalibrations, calibrate_all, save
from fes.cli.common import FAILED, PATH, SIDE, Problem, choice, fail, failing, print_json, writing
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from fes.estimation.sensor_choice import Calibration, phase_sensors
from fes.estimation.shank.calibration import ShankCalibration
from fes.estimation.shank.motion import ShankLevels
from fes.recording import RecordingError, read_recording


@click.command(name="calibrate")
@click.argument("recording", type=PATH)
@click.option("--out", type=PATH, help="Where to write. Default: RECORDING.calibration.json.")
@click.option("--stairs", is_flag=True, help="Over stairs or slopes: shank strides may end higher or lower.")
@click.option("--json", "as_json", is_flag=True, help="Print what was found as JSON instead of the table.")
def calibrate_command(recording: Path, out: Path | None, stairs: bool, as_json: bool) -> None:
    """Calibrate foot and shank sensors from RECORDING: a still second, then at least five strides straight ahead.

    Feet that the sidecar calls foot_a and foot_b are told apart by how they move; where that is not clear, nothing is
    written and a label is asked for. Use the result with --calibration of fes replay and fes analyse.
    """
    with failing(RecordingError, CalibrationError):
        walk = read_recording(recording)
        found = calibrate_all(walk, incline=math.nan if stairs else walk.ground.incline)
    for reason in found.missing.values():
        click.secho(f"Not calibrated: {reason}", fg="yellow", err=True)
    if found.swapped and found.verdict is not None:
        signs = f"{found.verdict.agreeing} of 4 signs, score {found.verdict.score:.2f}"
        remedy = "Check which sensor is on which foot before stimulating."
        click.secho(f"The two feet move as if they were swapped ({signs}). {remedy}", fg="red", err=True)
    target = out or recording.with_suffix(".calibration.json")
    save_calibrations(found, target)
    if as_json:
        verdict = found.verdict
        print_json(
            {
                "sensors": {sensor: calibration.to_dict() for sensor, calibration in found.calibrations.items()},
                "phase_sensors": phase_sensors(found.calibrations),
                "missing": found.missing,
                "sides": found.sides,
                "side_score": verdict.score if verdict else None,
                "side_signs_agreeing": verdict.agreeing if verdict else None,
                "swapped": found.swapped,
                "file": str(target),
            }
        )
        return
    _show(found)
    click.echo(f"Calibration  {target}")


def _show(found: SensorCalibrations) -> None:
    """The table, then each sensor by itself."""
    from rich.console import Console
    from rich.table import Table

    foot_of = {sensor: foot for foot, sensor in phase_sensors(found.calibrations).items()}
    table = Table("sensor", "phases of", "strides", "still second", "forward is sure", "push-off", "arm")
    for sensor, calibration in found.calibrations.items():
        if isinstance(calibration, ShankCalibration):
            push_off_radps, arm = calibration.levels.push_off_radps, f"{100 * calibration.arm.length_m:.0f} cm"
            arm += "" if calibration.arm.learnt else " (prior)"
        else:
            push_off_radps, arm = calibration.push_off_radps, "–"
        table.add_row(
            sensor,
            foot_of.get(sensor, "recorded only"),
            str(calibration.strides),
            "yes" if calibration.standing else "no",
            f"{calibration.axis_confidence:.0%}",
            f"{push_off_radps:.1f} rad/s",
            arm,
        )
    Console(width=110).print(table)
    for name, side in found.sides.items():
        evidence = "as given"
        if found.verdict is not None:
            evidence = f"{found.verdict.agreeing} of 4 signs agree, score {found.verdict.score:.2f} (sure from 0.30)"
        click.echo(f"{name} is the {side}: {evidence}")
    for calibration in found.calibrations.values():
        click.echo(describe(calibration))


def moves(levels: FootCalibration | ShankLevels, contact_mps3: float) -> str:
    """This person's measures, which the guards' limits are shares of."""
    return (
        f"push-off {levels.push_off_radps:.1f} rad/s, fall to mid-swing {levels.fall_radps:.1f} rad/s, "
        f"stride {levels.stride_s:.2f} s, contact {contact_mps3:.0f} m/s³"
    )


def describe(calibration: Calibration) -> str:
    """A calibration for people."""
    rate = ", ".join(f"{1000 * b:+.1f}" for b in calibration.gyr_bias_radps)
    force = ", ".join(f"{b:+.3f}" for b in calibration.acc_bias_mps2)
    up = ", ".join(f"{v:+.2f}" for v in calibration.up)
    if isinstance(calibration, ShankCalibration):
        turning, axis, unseen, sd_rad = "left", calibration.left, "from the drift between strides", 0.0
        arm, levels = calibration.arm, calibration.levels
        how = f"learnt from {arm.windows} stances" if arm.learnt else f"taken from the prior: {arm.reason}"
        more = [
            f"  flat below {levels.rest_lean_radps:.2f} rad/s; " + moves(levels, levels.contact_jolt_mps3),
            f"  arm {100 * arm.length_m:.1f} cm, {how}; condition {arm.condition:.1f}",
        ]
    else:
        turning, axis, unseen = "toe-down about", calibration.toe_down, "that by which gravity closes over the strides"
        sd_rad = calibration.axis_sd_rad
        more = ["  " + moves(calibration, calibration.contact_jerk_mps3)]
    standing = calibration.standing
    still = "a still second was found" if standing else f"nobody stood still: the gyroscope's bias is {unseen}"
    across, known = ", ".join(f"{v:+.2f}" for v in axis), f", known to ±{math.degrees(sd_rad):.0f}°" if sd_rad else ""
    lines = [
        f"{calibration.sensor}: from {calibration.strides} strides; {still}",
        f"  up ({up}), {turning} ({across}) in the sensor's axes, "
        f"{calibration.axis_confidence:.0%} of the travel along forward{known}",
        f"  bias: gyroscope ({rate}) mrad/s, accelerometer ({force}) m/s²",
    ]
    return "\n".join([*lines, *more])


def save_calibrations(found: SensorCalibrations, path: Path) -> None:
    """Write calibrations as JSON. Raises Problem: the file cannot be written."""
    with writing(path, ". Choose another place with --out."):
        save(found, path)


@click.command(name="import")
@click.argument("name", metavar="NAME")
@click.argument("files", nargs=-1, type=PATH)
@click.option("--out", type=PATH, help="Folder for what is made.")
@choice("--format", "form", of=("parquet", "csv"))
@click.option("--foot", type=SIDE, help="Whose, where the data set does not say. Default: right.")
@click.option("--overwrite", is_flag=True, help="Replace what is there.")
@click.option("--json", "as_json", is_flag=True, help="Print what was made as JSON.")
def import_command(
    name: str, files: tuple[Path, ...], out: Path | None, form: str, foot: str | None, overwrite: bool, as_json: bool
) -> None:
    """Turn FILES (or a folder) of the data set NAME into recordings with sidecars, and references beside them.

    NAME is gaitmap, stroke_treadmill, pyshoe, ruler, broad, xio, footswitch_treadmill or stroke_walks, or what another
    package brings; `fes import list` says what each is. Units become SI, axes stay the sensors' own, known defects are
    noted in the sidecar. The data keeps its own licence, which is named.

    One file that cannot be used does not stop the others; the exit code is then 1 (2 if there was only one).
    """
    from fes.datasets import ImportProblem, data_set, data_sets, files_of, read_file, write_imported

    with failing(ImportProblem):
        known = data_sets() if name == "list" else {name: data_set(name)}
    if name == "list" and as_json:
        print_json({"data_sets": {each.name: {"about": each.about, **each.provenance()} for each in known.values()}})
        return
    if name == "list":
        for each in known.values():
            click.echo(f"{each.name:<21} {each.about}\n{'':<21} {each.source}; licence: {each.licence}")
        return
    if not files or out is None:
        what = "name the files of the data set (or their folder) and where to write"
        raise Problem(f"{what}: fes import NAME FILES --out DIR")
    about = known[name]
    made: list[dict[str, Any]] = []
    failures = 0
    with failing(ImportProblem):
        todo = files_of(name, files)
    for file in todo:
        try:
            imported = read_file(name, file, foot=foot)
            written = write_imported(imported, out, about.provenance(), form=form, overwrite=overwrite)
        except ImportProblem as error:
            if len(todo) == 1:
                fail(error)
            click.secho(f"Error: {error}", fg="red", err=True)
            failures += 1
            continue
        references = [str(path) for path in written[2:]]
        made.append({"recording": str(written[0]), "references": references, "notes": list(imported.notes)})
        if not as_json:
            click.echo(f"{written[0]}" + "".join(f"\n  reference {path.name}" for path in written[2:]))
            for note in imported.notes:
                click.echo(f"  note: {note}")
    if as_json:
        print_json({**about.provenance(), "made": made})
    else:
        click.echo(f"From {about.source}; licence: {about.licence}")
    if failures:
        click.secho(f"{failures} of {len(todo)} files could not be used.", fg="red", err=True)
        raise SystemExit(FAILED)


@click.command(name="trials")
@click.argument("folder", type=PATH)
@click.option("--only", help="One trial by name.")
def trials_command(folder: Path, only: str | None) -> None:
    """Write the bundled recordings, with their truth, to FOLDER; the same seeds give the same bytes."""
    try:
        from sim_inputs.generator.trials import main as generate
    except ImportError:
        what = "What makes the bundled recordings is part of the project's folder: run make trials there."
        raise Problem(what) from None
    with writing(folder, ". Choose another folder."):
        code = generate([str(folder), *(("--only", only) if only else ())])
    raise SystemExit(code)
