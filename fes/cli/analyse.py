"""``fes analyse``: strides and phases of recordings, as files and as a report."""

from __future__ import annotations

import csv
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from fes.analysis import Analysis, analyse
from fes.cli.exits import FAILED, Problem
from fes.cli.replay import fresh_folder
from fes.estimation.calibration import CalibrationError, FootCalibration
from fes.recording import Recording, RecordingError, read_recording
from fes.replay import calibrate

FORMATS = ("csv", "parquet", "json")


@click.command(name="analyse")
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--calibration", type=click.Path(path_type=Path), help="From fes calibrate. Default: from the recording.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("out"), show_default=True, help="Results go below."
)
@click.option("--format", "kind", type=click.Choice(FORMATS), default="csv", show_default=True, help="Of the tables.")
@click.option("--json", "as_json", is_flag=True, help="Print the strides as JSON instead of the table.")
@click.option("--no-report", is_flag=True, help="Write no HTML report.")
def command(
    recordings: tuple[Path, ...], calibration: Path | None, out: Path, kind: str, as_json: bool, no_report: bool
) -> None:
    """Find phases and strides in RECORDINGS; write tables of strides, phase changes and events (initial contact,
    foot off), and a report of each.

    One recording that cannot be used does not stop the others; the exit code is then 1 (2 if there was only one).
    """
    failures = 0
    for path in recordings:
        try:
            recording = read_recording(path)
            calibrations = _calibrations(recording, calibration)
        except (RecordingError, CalibrationError) as error:
            if len(recordings) == 1:
                raise Problem(str(error)) from error
            click.secho(f"Error: {error}", fg="red", err=True)
            failures += 1
            continue
        result = analyse(recording, calibrations)
        folder = fresh_folder(out, path.stem)
        write_table(result.stride_rows(), folder / f"strides.{kind}")
        write_table(result.phase_rows(), folder / f"phases.{kind}")
        write_table(result.event_rows(), folder / f"events.{kind}")
        _show(result, folder, as_json=as_json, report=not no_report)
    if failures:
        click.secho(f"{failures} of {len(recordings)} recordings could not be used.", fg="red", err=True)
        raise SystemExit(FAILED)


def _calibrations(recording: Recording, path: Path | None) -> dict[str, FootCalibration]:
    from fes.cli.calibrate import load_calibrations

    if path is None:
        found, missing = calibrate(recording)
        for reason in missing.values():
            click.secho(f"Not calibrated, so not used: {reason}", fg="yellow", err=True)
        return found
    known = {foot: c for foot, c in load_calibrations(path).items() if foot in recording.tracks}
    if not known:
        raise CalibrationError(
            f"{path}: calibrates none of the sensors in {recording.path}: {', '.join(recording.tracks)}"
        )
    return known


def write_table(rows: list[dict[str, Any]], path: Path) -> None:
    """Write flat rows as CSV, Parquet or JSON, by the suffix; a number that is none becomes empty or null."""
    if path.suffix == ".json":
        path.write_text(json.dumps([_plain(row) for row in rows], indent=1, ensure_ascii=False), encoding="utf-8")
    elif path.suffix == ".parquet":
        import pyarrow as pa
        from pyarrow import parquet

        parquet.write_table(pa.Table.from_pylist([_plain(row) for row in rows]), path)
    else:
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else [], lineterminator="\n")
            writer.writeheader()
            writer.writerows(_plain(row) for row in rows)


def _plain(row: dict[str, Any]) -> dict[str, Any]:
    return {key: None if isinstance(value, float) and value != value else value for key, value in row.items()}


def _show(result: Analysis, folder: Path, *, as_json: bool, report: bool) -> None:
    from fes.view.summary import summarise
    from fes.view.tables import stride_table, summary_block

    record = result.record(datetime.now(UTC).isoformat(timespec="seconds"))
    if report:
        from fes.view.report import write_report

        write_report(record, folder / "report.html")
    summary = summarise(record)
    if as_json:
        click.echo(json.dumps({**summary.to_json(), "files": {"folder": str(folder)}}, indent=2, ensure_ascii=False))
        return
    from rich.console import Console

    from fes.cli.show import PIPED_COLUMNS

    screen = Console(width=None if sys.stdout.isatty() else PIPED_COLUMNS)
    screen.print(stride_table(summary))
    screen.print(summary_block(summary))
    screen.print(f"Tables and report  {folder}")
