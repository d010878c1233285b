"""``fes evaluate``: how far what was estimated agrees with a reference."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fes.cli.common import (
    LOG_SUFFIX,
    PATH,
    SIDE,
    Number,
    Problem,
    StoppedEarly,
    choice,
    failing,
    fresh_folder,
    out_option,
    writing,
)
from fes.cli.show import print_json, screen, write_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fes.evaluation.reference.compare import Estimate
    from fes.evaluation.reference.evaluation import Evaluation

PIPED_COLUMNS = 132
_POSITIVE = Number(min=0, min_open=True)


@click.command(name="evaluate")
@click.argument("recording", type=PATH)
@click.option("--reference", "references", multiple=True, type=PATH, help="CSV or C3D, may be given again.")
@click.option("--calibration", type=PATH, help="From fes calibrate. Default: from the recording.")
@click.option("--foot", type=SIDE, help="Whose a reference is that does not say.")
@click.option("--marker", "markers", multiple=True, metavar="LABEL=FOOT.POINT", help="C3D: as LHEE=left_foot.heel.")
@click.option("--up", type=click.Choice(["x", "y", "z"]), default="z", show_default=True, help="C3D: vertical axis.")
@choice("--frame", of=("auto", "lab", "ground"), help="Of paths.")
@click.option("--belt-speed", type=_POSITIVE, help="Of the treadmill, m/s. Default: the recording's own.")
@click.option("--belt-axis", type=click.Choice(["+x", "-x", "+y", "-y"]), help="Walking direction in the lab.")
@choice("--sync", of=("check", "fit"), help="Of the clocks.")
@click.option("--lag", "lag_s", type=Number(), help="Seconds to add to the reference's times.")
@click.option(
    "--max-lag", "most_lag_s", type=_POSITIVE, default=10.0, show_default=True, help="Seconds to search, either way."
)
@click.option("--tolerance-ms", type=_POSITIVE, default=150.0, show_default=True, help="Between events of a pair.")
@click.option("--stairs", "--slope", "uneven", is_flag=True, help="Strides end higher or lower than they began.")
@out_option()
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON instead of the table.")
@click.option("--no-report", is_flag=True, help="Write no files.")
def command(
    recording: Path,
    references: tuple[Path, ...],
    calibration: Path | None,
    foot: str | None,
    markers: tuple[str, ...],
    up: str,
    belt_speed: float | None,
    sync: str,
    tolerance_ms: float,
    uneven: bool,
    out: Path,
    as_json: bool,
    no_report: bool,
    **chosen: Any,
) -> None:
    """Analyse RECORDING (or take a session log as it was) and hold it against references.

    Without --reference: the files beside the recording, as fes import writes them (NAME.events.csv, NAME.strides.csv,
    NAME.path.csv, NAME.reference.csv, NAME.belt.csv, NAME.mat.csv, NAME.switch.csv, NAME.orientation.csv,
    NAME.end.csv, NAME.c3d). What a CSV is, its columns tell: strides, events, footfalls of a step mat, foot switches,
    a marker's path, a belt's speed, a sensor's orientation, where the walk ended.

    Writes a page, all numbers as JSON, and the pairs as a table.
    """
    from fes.evaluation.reference.evaluation import Settings, evaluate
    from fes.evaluation.reference.read import companion_references, read_references
    from fes.evaluation.reference.table import ReferenceError

    if chosen["lag_s"] is not None and sync == "fit":
        raise Problem("--lag gives the lag, --sync fit finds it; choose one")
    files = list(references) or companion_references(recording)
    if not files and belt_speed is None:
        raise Problem(f"{recording}: no reference lies beside it. Name one: --reference FILE, or --belt-speed M/S")
    result = _oriented(recording, files)
    if result is None:
        estimate, own_belt = _estimated(recording, calibration, level=not uneven)
        default = f"{foot}_foot" if foot else (estimate.feet[0] if len(estimate.feet) == 1 else None)
        with failing(ReferenceError):
            reference = read_references(files, foot=default, markers=_markers(markers), up=up)
            chosen |= {"fit_lag": sync == "fit", "tolerance_s": 1e-3 * tolerance_ms}
            settings = Settings(belt_mps=belt_speed or own_belt, compare_belt=belt_speed is not None, **chosen)
            result = evaluate(estimate, reference, settings)
    _show(result, None if no_report else _written(result, out, recording), as_json=as_json)


def _oriented(recording: Path, files: Sequence[Path]) -> Evaluation | None:
    """The evaluation of orientations, which need no walk; None where the references are others."""
    from fes.evaluation.reference.evaluation import evaluate_orientation, only_orientations, read_orientation
    from fes.evaluation.reference.table import ReferenceError
    from fes.recording import RecordingError, read_recording

    with failing(ReferenceError, RecordingError):
        if only_orientations(files):
            return evaluate_orientation(read_recording(recording), [read_orientation(path) for path in files])
    return None


def _estimated(recording: Path, calibration: Path | None, *, level: bool) -> tuple[Estimate, float | None]:
    """What a session log says, or what an analysis finds; and the belt's speed, if the recording states it."""
    from fes.evaluation.reference.compare import from_analysis, from_session

    if recording.suffix == LOG_SUFFIX:
        from fes.session_log import SessionLogError, read_session

        with failing(SessionLogError):
            record = read_session(recording)
        belt = record.header.get("recording", {}).get("belt_speed_mps")
        return from_session(record, str(recording)), float(belt) if belt else None
    from fes.analysis.pipeline import analyse, calibrations_of
    from fes.calibration.recording import stored_calibrations
    from fes.config import Ground
    from fes.estimation.foot.calibration import CalibrationError
    from fes.recording import RecordingError, read_recording

    with failing(RecordingError, CalibrationError):
        read = read_recording(recording)
        ground = read.ground if level else Ground(free=True)
        read, found = (
            stored_calibrations(calibration, read) if calibration else calibrations_of(read, incline=ground.incline)
        )
    for reason in found.missing.values():
        click.secho(f"Not calibrated, so not used: {reason}", fg="yellow", err=True)
    return from_analysis(analyse(read, found.calibrations, ground=ground)), read.belt_speed_mps


def _markers(given: tuple[str, ...]) -> dict[str, tuple[str, str]] | None:
    found = {}
    for text in given:
        parts = re.fullmatch(r"(.+)=(left_foot|right_foot)\.(sensor|heel|toe)", text)
        if parts is None:
            raise Problem(f"--marker {text}: say LABEL=FOOT.POINT, as LHEE=left_foot.heel; points: sensor, heel, toe")
        found[parts[1]] = (parts[2], parts[3])
    return found or None


def _written(result: Evaluation, out: Path, recording: Path) -> Path:
    from fes.report.agreement import agreement_json, pair_rows, render_page
    from fes.report.html import write_page_file

    folder = fresh_folder(out, f"{recording.stem}-evaluation")
    with writing(folder, kind=StoppedEarly):
        write_page_file(render_page(result), folder / "agreement.html", "Choose another --out.")
        text = json.dumps(agreement_json(result), indent=1, ensure_ascii=False, allow_nan=False)
        (folder / "agreement.json").write_text(text, encoding="utf-8")
        write_table(pair_rows(result), folder / "pairs.csv")
    return folder


def _show(result: Evaluation, folder: Path | None, *, as_json: bool) -> None:
    from fes.report.agreement import agreement_json, agreement_text

    if as_json:
        files = {"folder": str(folder) if folder else None}
        print_json({**agreement_json(result), "files": files}, allow_nan=False)
        return
    console = screen(PIPED_COLUMNS)
    console.print(agreement_text(result))
    if folder is not None:
        console.print(f"Page, JSON and pairs  {folder}", markup=False)
