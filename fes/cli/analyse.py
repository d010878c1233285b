"""``fes analyse``: strides and phases of recordings, as files and as a report."""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING, Literal

import click

from fes.analysis.methods import Methods
from fes.analysis.pipeline import analyse, calibrations_of, calibrations_of_chunks
from fes.analysis.results import Analysis
from fes.calibration.recording import stored_calibrations
from fes.cli.analyse_long import analyse_long
from fes.cli.common.exits import FAILED, error_text, fail, fresh_folder
from fes.cli.common.options import RenamedOptions
from fes.cli.common.show import poorly_measured
from fes.cli.common.table_file import write_table
from fes.cli.compile_ import compiled_ahead
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.zupt.detectors import Detector
from fes.memory import keep_freed_memory
from fes.recording import RecordingError, read_recording
from fes.recording.chunks import Chunk, recording_chunks

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fes.analysis.hemiparetic.walk import HemipareticWalk
    from fes.analysis.parameters.gait import GaitParameters
    from fes.estimation.sensor_choice import Calibration
    from fes.recording import Recording

FORMATS = ("csv", "parquet", "json")
DETECTORS = ("shoe", "mv", "mag", "are", "gyr")


@click.command(name="analyse", cls=RenamedOptions, former={"--afflicted": "--paretic-side", "--apart": "--sync-clocks"})
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--calibration", type=click.Path(path_type=Path), help="From fes calibrate. Default: from the recording.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("out"), show_default=True, help="Results go below."
)
@click.option("--format", "kind", type=click.Choice(FORMATS), default="csv", show_default=True, help="Of the tables.")
@click.option("--json", "as_json", is_flag=True, help="Print the strides as JSON instead of the table.")
@click.option("--stairs", "--slope", "uneven", is_flag=True, help="Strides end higher or lower than they began.")
@click.option("--hemiparetic", is_flag=True, help="Tell the paretic side; Wang et al.'s windows beside our strides.")
@click.option(
    "--paretic-side",
    type=click.Choice(["left", "right"]),
    help="The paretic side, where it is known; implies --hemiparetic.",
)
@click.option("--sync-clocks", is_flag=True, help="Each foot had its own clock: set the right one's by the walk.")
@click.option(
    "--detector",
    type=click.Choice(DETECTORS),
    default="shoe",
    show_default=True,
    help="Of zero velocity, for the path (Skog et al.).",
)
@click.option(
    "--stride-method",
    type=click.Choice(["maximum_likelihood", "constrained"]),
    default="maximum_likelihood",
    show_default=True,
    help="How a stride is integrated; constrained: Negård et al.'s alone.",
)
@click.option(
    "--path",
    "path_filter",
    type=click.Choice(["smoothed", "per-sample"]),
    default="smoothed",
    show_default=True,
    help="Filter and smooth the path over intervals, or from sample to sample.",
)
@click.option("--causal-events", is_flag=True, help="Also events as known on-line (Kumar et al.): events_causal.")
@click.option("--no-report", is_flag=True, help="Write no HTML report.")
def command(
    recordings: tuple[Path, ...],
    calibration: Path | None,
    out: Path,
    kind: str,
    as_json: bool,
    uneven: bool,
    hemiparetic: bool,
    paretic_side: str | None,
    sync_clocks: bool,
    detector: str,
    stride_method: Literal["maximum_likelihood", "constrained"],
    path_filter: str,
    causal_events: bool,
    no_report: bool,
) -> None:
    """Find phases and strides in RECORDINGS; write tables of strides, phase changes, events (initial contact, foot
    off), the path over the ground and gait parameters, and a report of each.

    With --hemiparetic, of a recording of both feet: which side is paretic and how sure that is, the symmetry of the
    sides, level ground and stairs told apart, and strides and paths by the method of Wang et al. (2013). Two feet whose
    sensors ran on clocks of their own are brought together with --sync-clocks, by knocks or by the walk itself.

    The ground is taken to be level: height that a stride seems to gain counts mostly as error. On stairs and slopes
    give --stairs or --slope (they do the same): the height gained is then measured, stride by stride.

    Where toe and heel are is taken from [geometry] in the sidecar, or else, on level ground, estimated from the walking
    itself, which takes the sensor to sit over the middle of the foot; the output says which.

    Who replicates a paper chooses with --detector, --stride-method and --path other methods than those of every report,
    and with --causal-events has a table of when contact and foot off would have been known while walking.

    A recording of more than half an hour is analysed in pieces, with a report of each: memory does not grow with it.

    One recording that cannot be used does not stop the others; the exit code is then 1 (2 if there was only one).
    """
    failures = 0
    keep_freed_memory()
    methods = Methods(Detector[detector.upper()], stride_method, path_filter == "per-sample", causal_events)
    for path in recordings:
        try:
            with compiled_ahead():
                # --sync-clocks and --hemiparetic look at the walk as a whole
                together = sync_clocks or hemiparetic or paretic_side is not None
                first = Chunk(read_recording(path)) if together else next(recording_chunks(path))
                recording = first.recording
                if not first.whole:
                    found = calibrations_of_chunks(recording_chunks(path), calibration, level=not uneven)
                elif calibration:
                    recording, found = stored_calibrations(calibration, recording)
                else:
                    recording, found = calibrations_of(recording, level=not uneven)
            if sync_clocks:
                recording = _one_clock(recording, found.calibrations)
        except (RecordingError, CalibrationError) as error:
            if len(recordings) == 1:
                fail(error)
            click.secho(f"Error: {error_text(error)}", fg="red", err=True)
            failures += 1
            continue
        for reason in found.missing.values():
            click.secho(f"Not calibrated, so not used: {reason}", fg="yellow", err=True)
        if sys.stderr.isatty():
            click.echo(f"Analysing {path.name} … (the first time on a computer takes a minute longer)", err=True)
        if not first.whole:
            del first, recording  # a piece that need not stay
            analyse_long(
                path, found, out, kind, level=not uneven, methods=methods, as_json=as_json, report=not no_report
            )
            continue
        result = analyse(recording, found.calibrations, level=not uneven, methods=methods)
        folder = fresh_folder(out, path.stem)
        write_table(result.stride_rows(), folder / f"strides.{kind}")
        write_table(result.phase_rows(), folder / f"phases.{kind}")
        write_table(result.event_rows(), folder / f"events.{kind}")
        write_table(result.path_rows(), folder / f"path.{kind}")
        if causal_events:
            write_table(result.causal_event_rows(), folder / f"events_causal.{kind}")
        hemiparetic = hemiparetic or paretic_side is not None
        gait = _gait(result, folder, kind, hemiparetic=hemiparetic, paretic_side=paretic_side)
        _show(result, gait, folder, as_json=as_json, report=not no_report)
    if failures:
        click.secho(f"{failures} of {len(recordings)} recordings could not be used.", fg="red", err=True)
        raise SystemExit(FAILED)


def _one_clock(recording: Recording, calibrations: Mapping[str, Calibration]) -> Recording:
    """The recording with the right foot set to the left one's clock; says what was done and how sure it is.

    Raises:
        CalibrationError: it cannot be told.
    """
    from fes.analysis.hemiparetic.sync import synchronised

    try:
        together, found = synchronised(recording, calibrations)
    except ValueError as error:
        raise CalibrationError(f"The feet cannot be brought together: {error}") from error
    sure = "" if found.sure else ". NOT SURE which stride belongs to which: knock the sensors together next time"
    click.secho(
        f"Right foot's clock set forward by {found.offset_s:.3f} s (by {found.method}, "
        f"off by up to {found.expected_s:.2f} s){sure}",
        fg=None if found.sure else "yellow",
        err=True,
    )
    return together


def _gait(
    result: Analysis, folder: Path, kind: str, *, hemiparetic: bool, paretic_side: str | None
) -> tuple[GaitParameters, HemipareticWalk | None]:
    """Work out the gait parameters, as a hemiparetic walk's if asked, and write their tables."""
    from fes.analysis.parameters.gait import gait_parameters, mean_strides

    walk = None
    if hemiparetic:
        from fes.analysis.hemiparetic.walk import hemiparetic_walk

        try:
            walk = hemiparetic_walk(result, paretic=paretic_side)
        except ValueError as error:
            click.secho(f"Not looked at as a hemiparetic walk: {error}", fg="yellow", err=True)
    parameters = gait_parameters(result) if walk is None else walk.parameters
    write_table(parameters.rows() if walk is None else walk.rows(), folder / f"parameters.{kind}")
    write_table(parameters.summary_rows(), folder / f"parameters_summary.{kind}")
    mean = [row for one in mean_strides(result.strides, parameters.strides) for row in one.rows()]
    write_table(mean, folder / f"mean_stride.{kind}")
    if walk is not None:
        write_table(walk.window_rows(), folder / f"windows.{kind}")
        write_table(walk.track_rows(), folder / f"visualization.{kind}")
    return parameters, walk


def _show(
    result: Analysis,
    gait: tuple[GaitParameters, HemipareticWalk | None],
    folder: Path,
    *,
    as_json: bool,
    report: bool,
) -> None:
    from fes.report.summary import summarise
    from fes.report.tables import stride_table, summary_block

    record = result.walk_record(datetime.now(UTC).isoformat(timespec="seconds"))
    if report:
        from fes.report.page import write_report

        write_report(record, folder / "report.html", paths=result.paths, gait=gait[0], hemiparetic=gait[1])
    summary = summarise(record)
    parameters, walk = gait
    if as_json:
        told = {
            **summary.to_json(),
            "toe_and_heel": {foot: known.to_json() for foot, known in result.points.items()},
            "paths": result.path_summary(),
            "parameters": parameters.to_json(),
            **({} if walk is None else {"hemiparetic": walk.to_json()}),
            "files": {"folder": str(folder)},
        }
        click.echo(json.dumps(told, indent=2, ensure_ascii=False))
        return
    from rich.console import Console

    from fes.cli.common.show import PIPED_COLUMNS
    from fes.report.tables import parameter_lines, parameter_table

    screen = Console(width=None if sys.stdout.isatty() else PIPED_COLUMNS)
    screen.print(stride_table(summary))
    screen.print(summary_block(summary))
    if (table := parameter_table(parameters)).row_count:
        screen.print(table)
    for line in (*_clearance_lines(result), *_path_lines(result), *parameter_lines(parameters, walk)):
        screen.print(line, markup=False)
    for line in poorly_measured(_counted(result)):
        screen.print(line, markup=False, style="yellow")
    click.echo(f"Tables  {folder}/")
    if report:
        click.echo(f"Report  {folder / 'report.html'}  (open it in a browser)")


def _counted(result: Analysis) -> dict[str, tuple[int, int]]:
    """By sensor: strides, and how many of them are valid."""
    found: dict[str, tuple[int, int]] = {}
    for stride in result.strides:
        count, valid = found.get(stride.foot, (0, 0))
        found[stride.foot] = count + 1, valid + stride.valid
    return found


def _clearance_lines(result: Analysis) -> list[str]:
    """How high toe and heel went, and how it is known where on the foot they are, in words."""
    lines = []
    for foot, known in result.points.items():
        valid = [stride for stride in result.strides if stride.valid and stride.foot == foot]
        heights = {
            "toe": [100.0 * s.toe_clearance_m for s in valid if s.toe_clearance_m == s.toe_clearance_m],
            "heel": [100.0 * s.heel_clearance_m for s in valid if s.heel_clearance_m == s.heel_clearance_m],
        }
        said = (f"{name} {mean(cm):.1f} ± {stdev(cm):.1f} cm" for name, cm in heights.items() if len(cm) > 1)
        lines.append(f"Clearance, {foot.removesuffix('_foot')}: {'; '.join([*said, known.describe()])}")
    return lines


def _path_lines(result: Analysis) -> list[str]:
    """How far each foot went, and where it ended, in words."""
    lines = []
    for foot, path in result.paths.items():
        side = foot.removesuffix("_foot")
        line = f"Path, {side}: {path.distance_m:.2f} m, ends {path.closure_m:.2f} m from its start"
        gained = [s.height_gained_m for s in result.strides if s.valid and s.foot == foot]
        if not result.level:
            line += f", {path.height_gained_m:+.2f} m in height ({sum(gained):+.2f} m in {len(gained)} valid strides)"
        lines.append(line)
    return lines + [f"No path: {reason}" for reason in result.no_path.values()]
