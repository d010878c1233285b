"""``fes analyse`` of a recording of more than half an hour: the same tables, chunk by chunk, and a report of each."""

from __future__ import annotations

import json
import math
import sys
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fes.analysis.methods import Methods
from fes.analysis.pipeline import analyse_chunks
from fes.analysis.results import Analysis
from fes.calibration.recording import SensorCalibrations, labelled
from fes.cli.common.exits import fresh_folder
from fes.cli.common.show import poorly_measured
from fes.cli.common.table_file import TableFile, write_table
from fes.recording.chunks import ALWAYS_NS, NEVER_NS, Chunk, recording_chunks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from fes.analysis.parameters.gait import ChunkedGait, GaitParameters

TABLES = ("strides", "phases", "events", "path", "parameters")


def analyse_long(
    path: Path,
    found: SensorCalibrations,
    out: Path,
    kind: str,
    *,
    level: bool,
    methods: Methods,
    as_json: bool,
    report: bool,
) -> None:
    """Analyse chunk by chunk and write the tables as they come; what is kept does not grow with the recording."""
    from fes.analysis.parameters.gait import ChunkedGait, gait_parameters

    folder = fresh_folder(out, path.stem)
    named = (replace(chunk, recording=labelled(chunk.recording, found.sides)) for chunk in recording_chunks(path))
    chunks: list[_ChunkSummary] = []
    gait: ChunkedGait | None = None
    tables = (*TABLES, "events_causal") if methods.causal_events else TABLES
    with ExitStack() as stack:
        files = {name: stack.enter_context(TableFile(folder / f"{name}.{kind}")) for name in tables}
        for result in analyse_chunks(named, found.calibrations, level=level, methods=methods):
            parameters = gait_parameters(result)
            if gait is None:
                gait = ChunkedGait(result.recording.belt_speed_mps)
            gait.add(parameters, result.strides)
            files["strides"].add(result.stride_rows())
            files["phases"].add(result.phase_rows())
            files["events"].add(result.event_rows())
            files["path"].add(result.path_rows())
            if methods.causal_events:
                files["events_causal"].add(result.causal_event_rows())
            files["parameters"].add(parameters.rows())
            chunks.append(_ChunkSummary.summarise(result, len(chunks) + 1))
            _report(result, parameters, folder, chunks[-1], as_json=as_json, report=report)
            del result, parameters  # or it would stay while the next chunk is worked on
    assert gait is not None
    every = gait.parameters()
    write_table(every.summary_rows(), folder / f"parameters_summary.{kind}")
    write_table([row for one in gait.mean_strides() for row in one.rows()], folder / f"mean_stride.{kind}")
    if as_json:
        last = {"parameters": every.to_json(), "files": {"folder": str(folder)}}
        click.echo("],\n" + json.dumps(last, indent=2, ensure_ascii=False)[2:])
        return
    _show(chunks, every, folder, report=report)


@dataclass(frozen=True)
class _ChunkSummary:
    """What stays of a chunk for the table on the screen."""

    number: int
    begin_s: float
    end_s: float
    strides: dict[str, tuple[int, int, float]] = field(default_factory=dict)  # all, valid, distance in m
    no_path: tuple[str, ...] = ()
    points: tuple[str, ...] = ()  # where toe and heel are, in words

    @staticmethod
    def summarise(result: Analysis, number: int) -> _ChunkSummary:
        """What is said of one chunk."""
        chunk = result.chunk or Chunk(result.recording)
        tracks = result.recording.tracks.values()
        first = min(int(track.t_sensor_ns[0]) for track in tracks)
        last = max(int(track.t_sensor_ns[-1]) for track in tracks)
        begin = first if chunk.begin_ns == ALWAYS_NS else chunk.begin_ns
        end = last if chunk.end_ns == NEVER_NS else chunk.end_ns
        feet = {}
        for foot in dict.fromkeys(stride.foot for stride in result.strides):
            own = [stride for stride in result.strides if stride.foot == foot]
            valid = [stride.stride_length_m for stride in own if stride.valid]
            feet[foot] = len(own), len(valid), math.fsum(valid)
        return _ChunkSummary(number, 1e-9 * begin, 1e-9 * end, feet, tuple(result.no_path.values()), _points(result))


def _report(
    result: Analysis, parameters: GaitParameters, folder: Path, summary: _ChunkSummary, *, as_json: bool, report: bool
) -> None:
    """One chunk's report, and its numbers where JSON is asked for."""
    if not (report or as_json):
        return
    record = result.walk_record(datetime.now(UTC).isoformat(timespec="seconds"))
    if report:
        from fes.report.page import write_report

        write_report(record, folder / f"report-{summary.number:02d}.html", paths=result.paths, gait=parameters)
    if as_json:
        from fes.report.summary import summarise

        one: dict[str, Any] = {
            **summarise(record).to_json(),
            "toe_and_heel": {foot: known.to_json() for foot, known in result.points.items()},
            "parameters": parameters.to_json(),
        }
        click.echo('{"pieces": [' if summary.number == 1 else ",")
        click.echo(json.dumps(one, indent=2, ensure_ascii=False), nl=False)


def _show(chunks: list[_ChunkSummary], every: GaitParameters, folder: Path, *, report: bool) -> None:
    from rich.console import Console
    from rich.table import Table

    from fes.cli.common.show import PIPED_COLUMNS
    from fes.report.tables import parameter_lines, parameter_table

    screen = Console(width=None if sys.stdout.isatty() else PIPED_COLUMNS)
    feet = list(dict.fromkeys(foot for each in chunks for foot in each.strides))
    columns = [text for foot in feet for text in (f"{foot}, strides", "measured", "distance, m")]
    table = Table("chunk", "from s", "to s", *columns, title="Chunks")
    for each in chunks:
        cells = [each.strides.get(foot, (0, 0, 0.0)) for foot in feet]
        shown = [text for count, valid, distance_m in cells for text in (str(count), str(valid), f"{distance_m:.1f}")]
        table.add_row(str(each.number), f"{each.begin_s:.0f}", f"{each.end_s:.0f}", *shown)
    screen.print(table)
    if (parameters := parameter_table(every)).row_count:
        screen.print(parameters)
    for line in (*chunks[-1].points, *parameter_lines(every, None), *_no_paths(chunks)):
        screen.print(line, markup=False)
    counted = {
        foot: (sum(of[0] for of in found), sum(of[1] for of in found))
        for foot in feet
        for found in [[each.strides[foot] for each in chunks if foot in each.strides]]
    }
    for line in poorly_measured(counted):
        screen.print(line, markup=False, style="yellow")
    click.echo(f"Tables  {folder}/")
    if report:
        click.echo(f"Reports {folder / 'report-01.html'} and on, one a chunk  (open them in a browser)")


def _points(result: Analysis) -> tuple[str, ...]:
    return tuple(
        f"Clearance, {foot.removesuffix('_foot')}: {points.describe()}" for foot, points in result.points.items()
    )


def _no_paths(chunks: list[_ChunkSummary]) -> Iterator[str]:
    for each in chunks:
        yield from (f"No path in chunk {each.number}: {reason}" for reason in each.no_path)
