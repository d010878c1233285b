"""Show a session log: table and summary, or JSON, and the report; whether the gate latched.

A table of flat rows as CSV, Parquet or JSON, written at once or as the rows come.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, Self

import click

from fes.cli.common import StoppedEarly, writing
from fes.walk_record import finite_or_none

if TYPE_CHECKING:
    from pyarrow.parquet import ParquetWriter
    from rich.console import Console
    from rich.table import Table

    from fes.analysis.tables import Table as Columns
    from fes.report.quality import Notice

    Rows = list[dict[str, Any]] | Columns

PIPED_COLUMNS: Final = 110  # where no terminal says how wide it is


def screen(piped_columns: int = PIPED_COLUMNS) -> Console:
    """Stdout, as wide as its terminal."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else piped_columns, emoji=False)


def narrow_table(title: str, caption: str, texts: Sequence[str], numbers: Sequence[str]) -> Table:
    """A table that keeps to 80 columns: of texts, then of numbers, by their titles."""
    from rich import box
    from rich.table import Table

    left: dict[str, Any] = {"caption_justify": "left", "title_justify": "left"}
    table = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, padding=0, pad_edge=False, show_edge=False, **left)
    for name in texts:
        table.add_column(name, no_wrap=True)
    for name in numbers:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def print_json(data: Mapping[str, Any], *, allow_nan: bool = True) -> None:
    """On stdout, for programs."""
    click.echo(json.dumps(data, indent=2, ensure_ascii=False, allow_nan=allow_nan))


def write_table(rows: Rows, path: Path) -> None:
    """Write flat rows, the format by the suffix; a number that is none becomes empty or null."""
    with TableFile(path) as file:
        file.add(rows)


class TableFile:
    """A table that grows: rows of the same names, in the format that the suffix says."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._text: IO[str] | None = None
        self._parquet: ParquetWriter | None = None
        self._empty = True

    def __enter__(self) -> Self:
        if self._path.suffix != ".parquet":
            self._text = self._path.open("w", encoding="utf-8", newline="")
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._text is not None:
            if self._path.suffix == ".json":
                self._text.write("[]" if self._empty else "\n]")
            elif self._empty:
                self._text.write("\n")
            self._text.close()
        elif self._parquet is not None:
            self._parquet.close()
        elif kind is None:
            import pyarrow as pa
            from pyarrow import parquet

            parquet.write_table(pa.table({}), self._path)

    def add(self, rows: Rows) -> None:
        """Write these below what is there."""
        if not rows:
            return
        plain = [{key: finite_or_none(value) for key, value in row.items()} for row in rows]
        if self._text is None:
            self._add_parquet(plain)
        elif self._path.suffix == ".json":
            text = json.dumps(plain, indent=1, ensure_ascii=False)
            self._text.write(("" if self._empty else ",") + text[1 if not self._empty else 0 : -2])
        else:
            writer = csv.DictWriter(self._text, fieldnames=list(rows[0]), lineterminator="\n")
            if self._empty:
                writer.writeheader()
            cells = [{k: str(v).lower() if isinstance(v, bool) else v for k, v in row.items()} for row in plain]
            writer.writerows(cells)  # as `fes convert` writes them
        self._empty = False

    def _add_parquet(self, rows: list[dict[str, Any]]) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        if self._parquet is None:
            schema = pa.Table.from_pylist(rows).schema
            known = [pa.field(f.name, pa.float64() if pa.types.is_null(f.type) else f.type) for f in schema]
            self._parquet = parquet.ParquetWriter(self._path, pa.schema(known))
        self._parquet.write_table(pa.Table.from_pylist(rows, schema=self._parquet.schema))


GATE: Final = "gate"
LATCHED: Final = "off until armed again: "  # as fes.control.runner notes it
ARMED_AGAIN: Final = "armed again"


def latched(notices: Iterable[Notice]) -> str:
    """How often and when the gate latched, and whether it stayed so; "" when it never did. Times are the session's."""
    of_gate = [each for each in notices if each.source == GATE]
    latches = [each for each in of_gate if each.text.startswith(LATCHED)]
    if not latches:
        return ""
    first, last = latches[0], latches[-1]
    rearmed = next((each.time_s for each in of_gate if each.text == ARMED_AGAIN and each.time_s >= last.time_s), None)
    times = "once" if len(latches) == 1 else f"{len(latches)} times, first"
    what = f"The gate latched {times} at {first.time_s:.3f} s: {first.text.removeprefix(LATCHED)}."
    if rearmed is None:
        return f"{what} Nothing was stimulated from {last.time_s:.3f} s to the end."
    return f"{what} It was last armed again at {rearmed:.3f} s."


def show_latched(notices: Iterable[Notice]) -> None:
    """On stderr: the exit code says nothing of it, for a gate that stops did its work."""
    if text := latched(notices):
        click.secho(text, fg="red", bold=True, err=True)


def show(
    log_path: Path, *, as_json: bool, report: Path | None, more: dict[str, Any] | None = None
) -> tuple[Notice, ...]:
    """Print what a session log holds and write its report; ``more`` joins the JSON. Returns the log's notices.

    Raises:
        SessionLogError: the log cannot be read.
        StoppedEarly: the report cannot be written.
    """
    from fes.report.summary import summarise
    from fes.report.tables import stride_table, summary_block
    from fes.session_log import read_session

    record = read_session(log_path)
    summary = summarise(record)
    if report is not None:
        from fes.report.page import write_report

        remedy = f". The session log is whole: make room, then `fes report {log_path}`."
        with writing(report, remedy, StoppedEarly):
            write_report(record, report)
    if as_json:
        files = {"session_log": str(log_path), "report": str(report) if report else None}
        print_json({**summary.to_json(), **(more or {}), "files": files})
        return summary.notices
    console = screen()
    console.print(stride_table(summary))
    console.print(summary_block(summary))
    console.print(f"Session log  {log_path}")
    if report is not None:
        console.print(f"Report       {report}  (open it in a browser)")
    return summary.notices
