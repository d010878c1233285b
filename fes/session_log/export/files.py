"""Tables → a folder of CSV or Parquet files, one a table, and what the log's header and summary say as JSON."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from fes.session_log.export.tables import ANOTHER, Exported, Table, batches, finite_or_none
from fes.session_log.record import SessionLogError, not_made

ABOUT: Final = "session.json"


def to_csv(log: Path, folder: Path) -> Exported:
    """Write ``folder/TABLE.csv`` for every table that has rows; column names end with their units.

    What is not known is an empty cell, yes and no are true and false.

    Raises:
        SessionLogError: ``folder`` exists, cannot be written, or the log cannot be read.
    """
    exported, writers = Exported(), {}
    with _new_folder(folder), ExitStack() as files:
        for batch in batches(log, exported):
            name = batch.table.name
            if name not in writers:
                file = files.enter_context((folder / f"{name}.csv").open("x", encoding="utf-8", newline=""))
                writers[name] = csv.writer(file, lineterminator="\n")
                writers[name].writerow([column.name for column in batch.table.columns])
            writers[name].writerows(zip(*map(_csv_cells, batch.columns), strict=True))
        _about(folder, exported)
    return exported


def _csv_cells(values: list[Any]) -> list[Any]:
    return [str(value).lower() if isinstance(value, bool) else finite_or_none(value) for value in values]


def to_parquet(log: Path, folder: Path) -> Exported:
    """Write ``folder/TABLE.parquet`` for every table that has rows; each field's metadata says its unit.

    Raises:
        SessionLogError: ``folder`` exists, cannot be written, or the log cannot be read.
    """
    import pyarrow as pa
    from pyarrow import parquet

    exported: Exported = Exported()
    writers: dict[str, Any] = {}
    with _new_folder(folder), ExitStack() as files:
        for batch in batches(log, exported):
            name = batch.table.name
            if name not in writers:
                schema = _schema(batch.table, exported)
                writers[name] = files.enter_context(
                    parquet.ParquetWriter(folder / f"{name}.parquet", schema, compression="zstd")
                )
            schema = writers[name].schema
            arrays = [pa.array(values, kind.type) for values, kind in zip(batch.columns, schema, strict=True)]
            writers[name].write_table(pa.Table.from_arrays(arrays, schema=schema))
        _about(folder, exported)
    return exported


def _schema(table: Table, exported: Exported) -> Any:
    import pyarrow as pa

    kinds = {"int": pa.int64(), "float": pa.float64(), "bool": pa.bool_(), "text": pa.string()}
    about = json.dumps(finite_or_none(exported.header), ensure_ascii=False)
    return pa.schema(
        [pa.field(column.name, kinds[column.kind], metadata={"unit": column.unit}) for column in table.columns],
        metadata={"table": table.name, "session_header": about},
    )


@contextmanager
def _new_folder(folder: Path) -> Iterator[None]:
    """A folder that was not there before; OSErrors inside become SessionLogErrors that name it."""
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise not_made(folder, error, ANOTHER) from error
    try:
        yield
    except SessionLogError:
        if not any(folder.iterdir()):
            folder.rmdir()
        raise
    except OSError as error:
        raise SessionLogError(
            f"{folder}: cannot be written: {error.strerror or error}. What is in it is not complete: make "
            f"room and convert again into another folder"
        ) from error


def _about(folder: Path, exported: Exported) -> None:
    about = finite_or_none({"header": exported.header, "summary": exported.summary, "rows": exported.rows})
    (folder / ABOUT).write_text(json.dumps(about, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
