"""``fes analyse``: strides and phases of recordings, as files and as a report; a long recording chunk by chunk."""

from __future__ import annotations

import json
import math
import sys
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING, Any, Final, Literal

import click

from fes.analysis.bouts import Bout, Stride, bout_tables, bouts_of, walking_only
from fes.analysis.methods import Methods
from fes.analysis.pipeline import analyse, analyse_chunks, calibrations_of_chunks
from fes.analysis.results import Analysis
from fes.calibration.recording import labelled
from fes.cli.common import (
    FAILED,
    PATH,
    SIDE,
    Number,
    TableFile,
    choice,
    error_text,
    fail,
    fresh_folder,
    out_option,
    print_json,
    screen,
    utc_now,
    write_table,
)
from fes.cli.compile_ import compiled_ahead
from fes.config import Ground
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.zupt.detectors import Detector
from fes.recording import RecordingError, read_recording
from fes.recording.chunks import ALWAYS_NS, NEVER_NS, Chunk, keep_freed_memory, recording_chunks
from fes.walk_record import Finding, finite_or_none

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from fes.analysis.hemiparetic.walk import HemipareticWalk
    from fes.analysis.parameters.gait import ChunkedGait, GaitParameters
    from fes.analysis.tables import Table
    from fes.cli.common import Rows
    from fes.estimation.sensor_choice import Calibration
    from fes.recording import Recording

FORMATS = ("csv", "parquet", "json")
DETECTORS = ("shoe", "mv", "mag", "are", "gyr")
STRIDE_METHODS = ("maximum_likelihood", "constrained")
FILTERS = ("smoothed", "per-sample")
TABLES: Final[Mapping[str, Callable[[Analysis], Table]]] = {
    "strides": Analysis.stride_table,
    "phases": Analysis.phase_table,
    "events": Analysis.event_table,
    "path": Analysis.path_table,
    "events_causal": Analysis.causal_event_table,
}
Strides = dict[str, tuple[int, int, float]]  # by foot: all, valid, distance in m


@dataclass(frozen=True, slots=True)
class Options:
    """What is wanted of every recording."""

    out: Path
    kind: str
    as_json: bool
    uneven: bool
    incline: float | None
    hemiparetic: bool
    paretic_side: str | None
    sync_clocks: bool
    detector: str
    stride_method: Literal["maximum_likelihood", "constrained"]
    path_filter: str
    causal_events: bool
    bouts: bool
    report: bool
    correct: bool
    strict: bool

    def ground(self, recording: Recording) -> Ground:
        """What is walked on: as asked, else as the recording says."""
        if self.uneven or self.incline is not None:
            return Ground(free=self.uneven, incline_percent=self.incline or 0.0)
        return recording.ground

    def tables(self) -> list[str]:
        """Of :data:`TABLES` those that are wanted."""
        return [name for name in TABLES if name != "events_causal" or self.causal_events]


@click.command(name="analyse")
@click.argument("recordings", nargs=-1, required=True, type=PATH)
@click.option("--calibration", type=PATH, help="From fes calibrate. Default: from the recording.")
@out_option()
@choice("--format", "kind", of=FORMATS, help="Of the tables.")
@click.option("--json", "as_json", is_flag=True, help="Print the strides as JSON instead of the table.")
@click.option("--stairs", "--slope", "uneven", is_flag=True, help="Strides end higher or lower than they began.")
@click.option("--incline", type=Number(-25.0, 25.0), help="Of the treadmill, in percent, uphill positive.")
@click.option("--hemiparetic", is_flag=True, help="Tell the paretic side; Wang et al.'s windows beside our strides.")
@click.option("--paretic-side", type=SIDE, help="The paretic side, where it is known; implies --hemiparetic.")
@click.option("--sync-clocks", is_flag=True, help="Each foot had its own clock: set the right one's by the walk.")
@choice("--detector", of=DETECTORS, help="Of zero velocity, for the path (Skog et al.).")
@choice("--stride-method", of=STRIDE_METHODS, help="How a stride is integrated; constrained: Negård et al.'s alone.")
@choice(
    "--path", "path_filter", of=FILTERS, help="Filter and smooth the path over intervals, or from sample to sample."
)
@click.option("--causal-events", is_flag=True, help="Also events as known on-line (Kumar et al.): events_causal.")
@click.option("--bouts", is_flag=True, help="Of a free-living day: walking only, with bouts, turns, stairs and slopes.")
@click.option("--correct", is_flag=True, help="Undo what the witness finds wrong with a sensor, and say so.")
@click.option("--strict", is_flag=True, help="Exit with 1 where a finding is a warning or an alert.")
@click.option("--no-report", is_flag=True, help="Write no HTML report.")
def command(
    recordings: tuple[Path, ...], calibration: Path | None, hemiparetic: bool, no_report: bool, **chosen: Any
) -> None:
    """Find phases and strides in RECORDINGS; write tables of strides, phase changes, events (initial contact, foot
    off), the path over the ground and gait parameters, and a report of each.

    With --hemiparetic, of a recording of both feet: which side is paretic and how sure that is, the symmetry of the
    sides, level ground and stairs told apart, and strides and paths by the method of Wang et al. (2013). Two feet whose
    sensors ran on clocks of their own are brought together with --sync-clocks, by knocks or by the walk itself.

    The ground is what [ground] in the sidecar says, else level: height that a stride seems to gain counts mostly as
    error. On a treadmill that is inclined give --incline; on stairs and ramps --stairs or --slope (they do the same):
    the height gained is then measured, stride by stride. Clearance counts from the line between the stances; on stairs
    there is none.

    Where toe and heel are is taken from [geometry] in the sidecar, or else, on level ground, estimated from the walking
    itself, which takes the sensor to sit over the middle of the foot; the output says which.

    Who replicates a paper chooses with --detector, --stride-method and --path other methods than those of every report,
    and with --causal-events has a table of when contact and foot off would have been known while walking.

    With --bouts, of a day in which other things were done too, only what is walking yields strides, and there are
    tables of walking bouts, of turns, of stairs and slopes, and of means over bouts of each length.

    A recording of more than half an hour is analysed in pieces, with a report of each: memory does not grow with it.

    One recording that cannot be used does not stop the others; the exit code is then 1 (2 if there was only one).
    """
    if chosen["uneven"] and chosen["incline"] is not None:
        raise click.UsageError("--stairs (or --slope) and --incline are both given: keep --incline if it is known")
    hemiparetic = hemiparetic or chosen["paretic_side"] is not None
    asked = Options(hemiparetic=hemiparetic, report=not no_report, **chosen)
    failures, warned = 0, False
    keep_freed_memory()
    for path in recordings:
        try:
            warned |= _follow(*_begun(path, calibration, asked), fresh_folder(asked.out, path.stem), asked)
        except (RecordingError, CalibrationError) as error:
            if len(recordings) == 1:
                fail(error)
            click.secho(f"Error: {error_text(error)}", fg="red", err=True)
            failures += 1
    if failures:
        click.secho(f"{failures} of {len(recordings)} recordings could not be used.", fg="red", err=True)
    if failures or (asked.strict and warned):
        raise SystemExit(FAILED)


def _begun(path: Path, calibration: Path | None, asked: Options) -> tuple[Iterator[Analysis], bool]:
    """The analyses of a recording's chunks, each made when it is asked for, and whether there is one chunk only.

    RecordingError, CalibrationError: it cannot be used.
    """
    detector, per_sample = Detector[asked.detector.upper()], asked.path_filter == "per-sample"
    methods = Methods(detector, asked.stride_method, per_sample, asked.causal_events)
    with compiled_ahead():
        # --sync-clocks and --hemiparetic look at the walk as a whole
        together = asked.sync_clocks or asked.hemiparetic
        first = Chunk(read_recording(path)) if together else next(recording_chunks(path))
        ground = asked.ground(first.recording)
        chunks = [first] if first.whole else recording_chunks(path)
        found = calibrations_of_chunks(chunks, calibration, incline=ground.incline)
    recording = labelled(first.recording, found.sides)
    if asked.sync_clocks:
        recording = _one_clock(recording, found.calibrations)
    for reason in found.missing.values():
        click.secho(f"Not calibrated, so not used: {reason}", fg="yellow", err=True)
    if sys.stderr.isatty():
        click.echo(f"Analysing {path.name} … (the first time on a computer takes a minute longer)", err=True)
    how: dict[str, Any] = {"ground": ground, "methods": methods}
    if first.whole:
        return (analyse(one, found.calibrations, correct=asked.correct, **how) for one in (recording,)), True
    if asked.correct:
        click.secho("A long recording is not corrected: cut it to half an hour first.", fg="yellow", err=True)
    named = (replace(chunk, recording=labelled(chunk.recording, found.sides)) for chunk in recording_chunks(path))
    return analyse_chunks(named, found.calibrations, **how), False


def _follow(analyses: Iterator[Analysis], whole: bool, folder: Path, asked: Options) -> bool:
    """Write the tables as the analyses come, and show what was found; what is kept does not grow with the recording.

    Whether a finding is a warning or an alert.
    """
    from fes.analysis.parameters.gait import ChunkedGait, gait_parameters

    kept, chunks, warned = list[Stride](), list[_ChunkSummary](), False
    tables: dict[str, Rows] = {}
    gait: ChunkedGait | None = None
    with ExitStack() as stack:
        names = [*asked.tables(), "parameters"]
        files = {name: stack.enter_context(TableFile(folder / f"{name}.{asked.kind}")) for name in names}
        for result in walking_only(analyses, kept) if asked.bouts else analyses:
            walk = _hemiparetic(result, asked)
            parameters = gait_parameters(result) if walk is None else walk.parameters
            gait = gait or ChunkedGait(result.recording.belt_speed_mps)
            gait.add(parameters, result.strides)
            for name in asked.tables():
                files[name].add(TABLES[name](result))
            files["parameters"].add(parameters.table if walk is None else walk.rows())
            if walk is not None:
                tables = {"windows": walk.window_rows(), "visualization": walk.track_rows()}
            every = parameters if whole else gait.parameters()
            if whole:
                warned = _show(result, parameters, walk, folder, asked, bouts_of(kept))
                continue
            chunks.append(_summarised(result))
            if not asked.bouts and (asked.report or asked.as_json):
                _report_chunk(result, parameters, folder, len(chunks), asked)
            del result, parameters  # or it would stay while the next chunk is worked on
    assert gait is not None
    bouts = bout_tables(bouts_of(kept)) if asked.bouts else {}
    tables |= {"parameters_summary": every.summary_rows(), **bouts}
    tables["mean_stride"] = [row for one in gait.mean_strides() for row in one.rows()]
    for name, rows in tables.items():
        write_table(rows, folder / f"{name}.{asked.kind}")
    return warned if whole else _show_chunks(chunks, every, folder, asked, bouts_of(kept))


def _hemiparetic(result: Analysis, asked: Options) -> HemipareticWalk | None:
    if not asked.hemiparetic:
        return None
    from fes.analysis.hemiparetic.walk import hemiparetic_walk

    try:
        return hemiparetic_walk(result, paretic=asked.paretic_side)
    except ValueError as error:
        click.secho(f"Not looked at as a hemiparetic walk: {error}", fg="yellow", err=True)
        return None


def _one_clock(recording: Recording, calibrations: Mapping[str, Calibration]) -> Recording:
    """The recording with the right foot set to the left one's clock; says what was done and how sure it is.

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


def _bouts_shown(bouts: list[Bout]) -> Any:
    """Bouts by their length, for the screen."""
    from rich.table import Table

    titles = ("bouts", "number", "minutes", "strides", "km", "turns", "cadence", "speed, m/s", "stride, m")
    table = Table(*titles, title="Walking bouts")
    for row in bout_tables(bouts)["bouts_by_length"]:
        numbers = [f"{row[f'{key}_mean']:.2f}" for key in ("speed_mps", "stride_length_m")]
        minutes, km = row["duration_s_sum"] / 60.0, row["distance_m_sum"] / 1000.0
        cells = (
            row["length"],
            str(row["bouts"]),
            f"{minutes:.1f}",
            str(row["strides"]),
            f"{km:.2f}",
            str(row["turns"]),
        )
        table.add_row(*cells, f"{row['cadence_per_min_mean']:.0f}", *numbers)
    return table


def _show(
    result: Analysis,
    parameters: GaitParameters,
    walk: HemipareticWalk | None,
    folder: Path,
    asked: Options,
    bouts: list[Bout],
) -> bool:
    """Print, and write the report; whether a finding is a warning or an alert."""
    from fes.report.findings import findings, session_json
    from fes.report.summary import summarise_session
    from fes.report.tables import stride_table, summary_block

    record = result.walk_record(utc_now())
    data, page = summarise_session(record), folder / "report.html"
    summary = data.summary
    warned = any(each.level in ("warning", "alert") for each in findings(summary))
    if asked.report:
        from fes.report.page import write_report

        write_report(record, page, data=data, paths=result.paths, gait=parameters, hemiparetic=walk)
    if asked.as_json:
        print_json(
            {
                **session_json(summary),
                "toe_and_heel": {foot: known.to_json() for foot, known in result.points.items()},
                "paths": result.path_summary(),
                "parameters": parameters.to_json(),
                **({} if walk is None else {"hemiparetic": walk.to_json()}),
                **(finite_or_none(bout_tables(bouts)) if asked.bouts else {}),
                "files": {"folder": str(folder)},
            }
        )
        return warned
    lines = [*_clearance_lines(result), *_path_lines(result)]
    tables = [*([_bouts_shown(bouts)] if asked.bouts else []), stride_table(summary), summary_block(summary)]
    _print_parameters(tables, parameters, walk, lines)
    click.echo(f"Tables  {folder}/")
    if asked.report:
        click.echo(f"Report  {page}  (open it in a browser)")
    return warned


def _print_parameters(
    tables: Iterable[Any], gait: GaitParameters, walk: HemipareticWalk | None, lines: Iterable[str]
) -> None:
    """These tables and the parameters', and the lines."""
    from fes.report.tables import parameter_lines, parameter_table

    console = screen()
    for table in (*tables, *([found] if (found := parameter_table(gait)).row_count else [])):
        console.print(table)
    for line in (*lines, *parameter_lines(gait, walk)):
        console.print(line, markup=False)


def _strides_by_foot(result: Analysis) -> Strides:
    found: Strides = {}
    for foot in dict.fromkeys(stride.foot for stride in result.strides):
        own = [stride for stride in result.strides if stride.foot == foot]
        valid = [stride.stride_length_m for stride in own if stride.valid]
        found[foot] = len(own), len(valid), math.fsum(valid)
    return found


def _clearance_lines(result: Analysis) -> list[str]:
    """How high toe and heel went, and how it is known where on the foot they are, in words."""
    lines = []
    for foot, known in result.points.items():
        valid = [stride for stride in result.strides if stride.valid and stride.foot == foot]
        measured = {"toe": [s.toe_clearance_m for s in valid], "heel": [s.heel_clearance_m for s in valid]}
        heights = {name: [100.0 * m for m in values if m == m] for name, values in measured.items()}
        said = (f"{name} {mean(cm):.1f} ± {stdev(cm):.1f} cm" for name, cm in heights.items() if len(cm) > 1)
        lines.append(f"Clearance, {foot.removesuffix('_foot')}: {'; '.join([*said, known.describe()])}")
    return lines


def _path_lines(result: Analysis) -> list[str]:
    """How far each foot went, and where it ended, in words."""
    lines = []
    for foot, path in result.paths.items():
        line = (
            f"Path, {foot.removesuffix('_foot')}: {path.distance_m:.2f} m, ends {path.closure_m:.2f} m from its start"
        )
        if gaps := len(path.seen_ns) - 1:
            line += f" ({gaps} gap{'s' if gaps > 1 else ''}, in which nobody knows where it went)"
        if not result.ground.level:
            gained = [s.height_gained_m for s in result.strides if s.valid and s.foot == foot]
            line += f", {path.height_gained_m:+.2f} m in height ({sum(gained):+.2f} m in {len(gained)} valid strides)"
        lines.append(line)
    lines += [f"Clock, {sensor}: {text}" for sensor, text in result.clock_notes().items()]
    return lines + [f"No path: {reason}" for reason in result.no_path.values()]


@dataclass(frozen=True)
class _ChunkSummary:
    """What stays of a chunk for the table on the screen; ``points``: where toe and heel are, in words."""

    begin_s: float
    end_s: float
    strides: Strides
    no_path: tuple[str, ...]
    points: tuple[str, ...]
    findings: tuple[Finding, ...]


def _summarised(result: Analysis) -> _ChunkSummary:
    from fes.report.findings import merged

    chunk = result.chunk or Chunk(result.recording)
    tracks = result.recording.tracks.values()
    begin, end = chunk.begin_ns, chunk.end_ns
    begin = min(int(track.t_sensor_ns[0]) for track in tracks) if begin == ALWAYS_NS else begin
    end = max(int(track.t_sensor_ns[-1]) for track in tracks) if end == NEVER_NS else end
    points = (f"Clearance, {foot.removesuffix('_foot')}: {known.describe()}" for foot, known in result.points.items())
    strides, no_path = _strides_by_foot(result), tuple(result.no_path.values())
    return _ChunkSummary(1e-9 * begin, 1e-9 * end, strides, no_path, tuple(points), merged(result.findings))


def _report_chunk(result: Analysis, parameters: GaitParameters, folder: Path, number: int, asked: Options) -> None:
    """One chunk's report, and its numbers where JSON is asked for."""
    record = result.walk_record(utc_now())
    if asked.report:
        from fes.report.page import write_report

        write_report(record, folder / f"report-{number:02d}.html", paths=result.paths, gait=parameters)
    if asked.as_json:
        from fes.report.findings import session_json
        from fes.report.summary import summarise

        one = {
            **session_json(summarise(record)),
            "toe_and_heel": {foot: known.to_json() for foot, known in result.points.items()},
            "parameters": parameters.to_json(),
        }
        click.echo('{"pieces": [' if number == 1 else ",")
        click.echo(json.dumps(one, indent=2, ensure_ascii=False), nl=False)


def _show_chunks(
    chunks: list[_ChunkSummary], every: GaitParameters, folder: Path, asked: Options, bouts: list[Bout]
) -> bool:
    """Print what all chunks come to; whether a sensor's finding is a warning or an alert."""
    from rich.table import Table

    from fes.report.tables import MARKS

    warned = any(finding.level in ("warning", "alert") for each in chunks for finding in each.findings)
    last = {"parameters": every.to_json(), "files": {"folder": str(folder)}}
    if asked.bouts and asked.as_json:
        print_json({**last, **finite_or_none(bout_tables(bouts))})
        return warned
    if asked.as_json:
        click.echo("],\n" + json.dumps(last, indent=2, ensure_ascii=False)[2:])
        return warned
    feet = list(dict.fromkeys(foot for each in chunks for foot in each.strides))
    columns = [text for foot in feet for text in (f"{foot}, strides", "measured", "distance, m")]
    table = Table("chunk", "from s", "to s", *columns, title="Chunks")
    for number, each in enumerate(chunks, start=1):
        cells = [each.strides.get(foot, (0, 0, 0.0)) for foot in feet]
        shown = [text for count, valid, distance_m in cells for text in (str(count), str(valid), f"{distance_m:.1f}")]
        table.add_row(str(number), f"{each.begin_s:.0f}", f"{each.end_s:.0f}", *shown)
    no_path = [f"No path in chunk {k}: {reason}" for k, each in enumerate(chunks, start=1) for reason in each.no_path]
    told = [
        f"{MARKS[finding.level][0]} Chunk {k}: {finding.text}"
        for k, each in enumerate(chunks, start=1)
        for finding in each.findings
    ]
    tables = [*([_bouts_shown(bouts)] if asked.bouts else []), table]
    _print_parameters(tables, every, None, [*chunks[-1].points, *no_path, *told])
    click.echo(f"Tables  {folder}/")
    if asked.report and not asked.bouts:
        click.echo(f"Reports {folder / 'report-01.html'} and on, one a chunk  (open them in a browser)")
    return warned
