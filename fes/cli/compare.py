"""``fes compare``: two sessions held against each other, as text or page; ``fes evaluate``: one against a reference."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from fes.cli.common import (
    FAILED,
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
    print_json,
    screen,
    write_table,
    writing,
)
from fes.session_log import SessionLogError, read_session

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import RenderableType

    from fes.evaluation.log_comparison import Comparison
    from fes.evaluation.reference.compare import Estimate
    from fes.evaluation.reference.evaluation import Evaluation

ROWS: Final = 30
BY_NUMBER: Final = (
    "No shift of the clocks brings the strides together: matched by number, times count from each stride's start."
)
SETTINGS_SHOWN: Final = 20
_TITLES: Final = ("length\ncm", "clear.\ncm", "T1\nms", "T2\nms", "T3\nms", "stance\nms", "on\nms", "off\nms")


@click.command(name="compare")
@click.argument("sessions", nargs=-1, required=True, metavar="A B…", type=PATH)
@click.option("--report", type=PATH, metavar="FILE", help="Write how the walks differ, as HTML.")
@click.option(
    "--label", "labels", multiple=True, metavar="WORDS", help="With --report: a session's name; once for each."
)
@click.option("--paretic-side", type=SIDE, help="With --report: symmetry from that side.")
@click.option("--all", "every", is_flag=True, help=f"Show all strides, not only the first {ROWS} that differ.")
@click.option("--json", "as_json", is_flag=True, help="Print the differences as JSON.")
def compare_command(
    sessions: tuple[Path, ...],
    report: Path | None,
    labels: tuple[str, ...],
    paretic_side: str | None,
    every: bool,
    as_json: bool,
) -> None:
    """Compare two session logs A and B: settings, strides, stimulation, bytes. Differences are B − A.

    Strides are matched by time, by the best shift if the clocks differ, else by number. When a log was made and how
    long decisions took makes no difference. Exit code: 0 identical, 1 different, 2 unusable input.

    With --report FILE it asks instead how the walks differ, before and after, with and without stimulation: means of
    each session, changes against the first with 95 % intervals, foot paths, phases, symmetry, charge, and what else
    differs. Sessions are then two to six logs (.feslog), folders that hold one, or recordings (CSV, Parquet), each
    analysed off-line in the same way. Exit code: 0 written, 2 unusable input.
    """
    if report is not None:
        _report(sessions, report, labels, paretic_side, as_json)
        return
    if labels or paretic_side:
        raise Problem("--label and --paretic-side belong to --report FILE")
    if len(sessions) != 2:
        raise Problem(f"name two session logs, not {len(sessions)}; for more say --report FILE")
    from fes.evaluation.log_comparison import compare_logs

    a, b = sessions
    with failing(SessionLogError):
        result = compare_logs(read_session(a), read_session(b))
    if as_json:
        print_json({"a": str(a), "b": str(b), **result.to_json()})
    else:
        screen().print(_difference_text(a, b, result, every))
    if not result.identical:
        raise SystemExit(FAILED)


def _report(
    paths: Sequence[Path], report: Path, labels: Sequence[str], paretic_side: str | None, as_json: bool
) -> None:
    from fes.report.comparison.page import MOST, compare_sessions, render_comparison
    from fes.report.comparison.session import ComparisonProblem, read_compared
    from fes.report.html import ReportError, write_page_file

    if not 2 <= len(paths) <= MOST:
        raise Problem(f"name two to {MOST} sessions, not {len(paths)}")
    if labels and len(labels) != len(paths):
        raise Problem(f"{len(labels)} labels for {len(paths)} sessions: give --label once for each, in their order")
    if len(set(labels)) < len(labels) or not all(label.strip() for label in labels):
        raise Problem("every --label must be different, and not empty")
    if report.resolve() in {path.resolve() for path in paths}:
        raise Problem(f"{report}: is one of the sessions; choose another --report")
    names = labels or [f"{chr(65 + k)} {path.stem if path.is_file() else path.name}" for k, path in enumerate(paths)]
    with failing(ComparisonProblem, ReportError):
        compared = [read_compared(path, name) for path, name in zip(paths, names, strict=True)]
        comparison = compare_sessions(compared, paretic=paretic_side)
        write_page_file(render_comparison(comparison), report, "Choose another --report.")
    if as_json:
        print_json({**comparison.to_json(), "report": str(report)}, allow_nan=False)
        return
    for finding in (*comparison.confounders, *comparison.changes):
        serious = finding.level in ("alert", "warning")
        click.secho(f"{'!' if serious else '·'} {finding.text}", fg="yellow" if serious else None)
    click.echo(f"Report {report}")


def _difference_text(a: Path, b: Path, result: Comparison, every: bool) -> RenderableType:
    from rich.console import Group
    from rich.text import Text

    lines: list[RenderableType] = [Text(f"A  {a}\nB  {b}")]
    if result.settings:
        shown = result.settings[:SETTINGS_SHOWN]
        lines.append(Text(f"{len(result.settings)} settings differ:", style="yellow"))
        lines += [Text(f"  {name}: {_short(one)} → {_short(other)}") for name, one, other in shown]
        if len(result.settings) > len(shown):
            lines.append(Text(f"  … and {len(result.settings) - len(shown)} more: --json shows them all"))
    else:
        lines.append(Text("The settings are the same."))
    if result.matched_by == "number":
        lines.append(Text(BY_NUMBER, style="yellow"))
    elif result.shift_s:
        lines.append(Text(f"B's clock is {result.shift_s:+.3f} s against A's; that is taken off.", style="yellow"))
    different = [each for each in result.pairs if not each.same]
    if different or every:
        lines.append(_table(result, every))
    for where, strides in (("A", result.only_a), ("B", result.only_b)):
        if strides:
            names = ", ".join(f"{s.foot} {s.number}" for s in strides[:8]) + (" …" if len(strides) > 8 else "")
            lines.append(Text(f"Only in {where}: {len(strides)} strides ({names})", style="yellow"))
    lines.append(Text(f"{len(result.pairs)} strides in both, {len(result.pairs) - len(different)} of them the same."))
    for what, difference in (("phases", result.phases), ("commands", result.commands), ("bytes", result.frames)):
        text = f"first difference: {difference}" if difference else "the same"
        lines.append(Text(f"{what.capitalize():<9} {text}", style="yellow" if difference else ""))
    lines.append(Text("Identical." if result.identical else "Different.", style="green" if result.identical else "red"))
    return Group(*lines)


def _short(value: object) -> str:
    text = "–" if value is None else str(value)
    return text if len(text) <= 40 else f"{text[:39]}…"


def _table(result: Comparison, every: bool) -> RenderableType:
    """A row per stride that differs (or all), the spread below; at most 80 columns wide."""
    from fes.evaluation.log_comparison import QUANTITIES
    from fes.report.tables import small_table
    from fes.report.text import number

    different = [each for each in result.pairs if every or not each.same]
    rows = different if every else different[:ROWS]
    left = f"; the first {ROWS} of {len(different)}" if len(rows) < len(different) else ""
    table = small_table(
        f"{'All strides' if every else 'Strides that differ'}, B − A{left}",
        "T1 to stance: entries into the phases; on, off: stimulation, greatest of the foot's channels.",
        ["\nfoot"],
        ["\nA", "\nB", "start\ns", "A's len.\nm", *_TITLES],
    )
    for each in rows:
        values = [number(each.differences[name], 2 if name.endswith("_cm") else 0) for name in QUANTITIES]
        foot = {"left_foot": "L", "right_foot": "R"}.get(each.foot, each.foot)
        begun, length = number(each.start_s, 1), number(each.length_m[0], 2)
        table.add_row(foot, str(each.number_a), str(each.number_b), begun, length, *values)
    table.add_section()
    for label, part in (("mean", "mean"), ("SD", "sd"), ("greatest", "greatest")):
        values = [number(getattr(result.spread(n), part), 2 if n.endswith("_cm") else 1) for n in QUANTITIES]
        table.add_row(label, "", "", "", "", *values, style="bold")
    return table


# --- ``fes evaluate`` ----------------------------------------------------------------------------------------


EVALUATION_COLUMNS: Final = 132
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
def evaluate_command(
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
    result = _orientation_of(recording, files)
    if result is None:
        estimate, own_belt = _estimate_of(recording, calibration, level=not uneven)
        default = f"{foot}_foot" if foot else (estimate.feet[0] if len(estimate.feet) == 1 else None)
        with failing(ReferenceError):
            reference = read_references(files, foot=default, markers=_markers(markers), up=up)
            chosen |= {"fit_lag": sync == "fit", "tolerance_s": 1e-3 * tolerance_ms}
            settings = Settings(belt_mps=belt_speed or own_belt, compare_belt=belt_speed is not None, **chosen)
            result = evaluate(estimate, reference, settings)
    _show_agreement(result, None if no_report else _write_agreement(result, out, recording), as_json=as_json)


def _orientation_of(recording: Path, files: Sequence[Path]) -> Evaluation | None:
    """The evaluation of orientations, which need no walk; None where the references are others."""
    from fes.evaluation.reference.evaluation import evaluate_orientation, only_orientations, read_orientation
    from fes.evaluation.reference.table import ReferenceError
    from fes.recording import RecordingError, read_recording

    with failing(ReferenceError, RecordingError):
        if only_orientations(files):
            return evaluate_orientation(read_recording(recording), [read_orientation(path) for path in files])
    return None


def _estimate_of(recording: Path, calibration: Path | None, *, level: bool) -> tuple[Estimate, float | None]:
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


def _write_agreement(result: Evaluation, out: Path, recording: Path) -> Path:
    from fes.report.agreement import agreement_json, pair_rows, render_page
    from fes.report.html import write_page_file

    folder = fresh_folder(out, f"{recording.stem}-evaluation")
    with writing(folder, kind=StoppedEarly):
        write_page_file(render_page(result), folder / "agreement.html", "Choose another --out.")
        text = json.dumps(agreement_json(result), indent=1, ensure_ascii=False, allow_nan=False)
        (folder / "agreement.json").write_text(text, encoding="utf-8")
        write_table(pair_rows(result), folder / "pairs.csv")
    return folder


def _show_agreement(result: Evaluation, folder: Path | None, *, as_json: bool) -> None:
    from fes.report.agreement import agreement_json, agreement_text

    if as_json:
        files = {"folder": str(folder) if folder else None}
        print_json({**agreement_json(result), "files": files}, allow_nan=False)
        return
    console = screen(EVALUATION_COLUMNS)
    console.print(agreement_text(result))
    if folder is not None:
        console.print(f"Page, JSON and pairs  {folder}", markup=False)
