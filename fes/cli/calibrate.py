"""``fes calibrate``: how the sensors sit and how this person moves, from a short recording."""

from __future__ import annotations

import json
from pathlib import Path

import click

from fes.cli.exits import Problem, fail
from fes.estimation.calibration import CalibrationError, FootCalibration
from fes.recording import RecordingError, read_recording
from fes.replay import calibrate

FORMAT = 1


@click.command(name="calibrate")
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Where to write. Default: RECORDING.calibration.json.")
def command(recording: Path, out: Path | None) -> None:
    """Calibrate the foot sensors from RECORDING: a still second, then at least five strides straight ahead."""
    try:
        found, missing = calibrate(read_recording(recording))
    except (RecordingError, CalibrationError) as error:
        fail(error)
    for reason in missing.values():
        click.secho(f"Not calibrated: {reason}", fg="yellow", err=True)
    for calibration in found.values():
        click.echo(describe(calibration))
    target = out or recording.with_suffix(".calibration.json")
    save_calibrations(found, target)
    click.echo(f"Calibration  {target}")


def describe(calibration: FootCalibration) -> str:
    """A calibration in words."""
    still = (
        "a still second was found" if calibration.standing else "nobody stood still: the gyroscope's bias is taken as 0"
    )
    rate = ", ".join(f"{1000 * b:+.1f}" for b in calibration.gyr_bias_radps)
    force = ", ".join(f"{b:+.3f}" for b in calibration.acc_bias_mps2)
    up = ", ".join(f"{v:+.2f}" for v in calibration.up)
    axis = ", ".join(f"{v:+.2f}" for v in calibration.toe_down)
    return "\n".join(
        (
            f"{calibration.sensor}: from {calibration.strides} strides; {still}",
            f"  up ({up}), toe-down about ({axis}) in the sensor's axes, sign {calibration.axis_confidence:.0%} sure",
            f"  bias: gyroscope ({rate}) mrad/s, accelerometer ({force}) m/s²",
            f"  at rest below {calibration.rest_gyr_radps:.2f} rad/s for {1000 * calibration.rest_hold_s:.0f} ms; "
            f"push-off from {calibration.min_toe_down_peak_radps:.1f} rad/s; "
            f"contact from {calibration.contact_jump_mps3:.0f} m/s³",
        )
    )


def save_calibrations(calibrations: dict[str, FootCalibration], path: Path) -> None:
    """Write calibrations as JSON.

    Raises:
        Problem: the file cannot be written.
    """
    data = {"format": FORMAT, "feet": {foot: calibration.to_dict() for foot, calibration in calibrations.items()}}
    try:
        path.write_text(json.dumps(data, indent=1), encoding="utf-8")
    except OSError as error:
        raise Problem(f"{path}: cannot be written: {error.strerror}. Choose another place with --out.") from error


def load_calibrations(path: Path) -> dict[str, FootCalibration]:
    """Read what :func:`save_calibrations` wrote.

    Raises:
        CalibrationError: missing, not JSON, or not a calibration of this format.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["format"] != FORMAT:
            raise CalibrationError(
                f"{path}: is of format {data['format']}, this version reads {FORMAT}. Calibrate anew."
            )
        return {foot: FootCalibration.from_dict(values) for foot, values in data["feet"].items()}
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}. Make one with fes calibrate.") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, CalibrationError):
            raise
        raise CalibrationError(f"{path}: is no calibration ({error}). Make one with fes calibrate.") from error
