"""A table of flat rows as CSV, Parquet or JSON, written at once or as the rows come."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self


def write_table(rows: list[dict[str, Any]], path: Path) -> None:
    """Write flat rows, the format by the suffix; a number that is none becomes empty or null."""
    with TableFile(path) as file:
        file.add(rows)


class TableFile:
    """A table that grows: rows of the same names, in the format that the suffix says."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._text: IO[str] | None = None
        self._parquet: Any = None
        self._empty = True

    def __enter__(self) -> Self:
        if self._path.suffix != ".parquet":
            self._text = self._path.open("w", encoding="utf-8", newline="")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
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

    def add(self, rows: list[dict[str, Any]]) -> None:
        """Write these below what is there."""
        if not rows:
            return
        if self._text is None:
            self._add_parquet(rows)
        elif self._path.suffix == ".json":
            text = json.dumps([_plain(row) for row in rows], indent=1, ensure_ascii=False)
            self._text.write(("" if self._empty else ",") + text[1 if not self._empty else 0 : -2])
        else:
            writer = csv.DictWriter(self._text, fieldnames=list(rows[0]), lineterminator="\n")
            if self._empty:
                writer.writeheader()
            writer.writerows(_plain(row) for row in rows)
        self._empty = False

    def _add_parquet(self, rows: list[dict[str, Any]]) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        plain = [_plain(row) for row in rows]
        if self._parquet is None:
            table = pa.Table.from_pylist(plain)
            known = [pa.field(f.name, pa.float64() if pa.types.is_null(f.type) else f.type) for f in table.schema]
            self._parquet = parquet.ParquetWriter(self._path, pa.schema(known))
        self._parquet.write_table(pa.Table.from_pylist(plain, schema=self._parquet.schema))


def _plain(row: dict[str, Any]) -> dict[str, Any]:
    return {key: None if isinstance(value, float) and value != value else value for key, value in row.items()}
