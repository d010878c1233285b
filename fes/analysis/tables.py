"""Tables: columns of equal length, each with its unit and a sentence, for Python, pandas, Arrow and notebooks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fes.analysis.parameters.definitions import DEFINITIONS
from fes.estimation.strides import schema
from fes.estimation.strides.schema import Column
from fes.signals import StrideResult

if TYPE_CHECKING:
    import pyarrow as pa

ROWS_SHOWN = 20
_UNITS = {f"_{unit}": unit for unit in ("ns", "s", "m", "rad", "ms")}
_UNITS |= {"_mps": "m/s", "_nm": "N·m", "_ma": "mA", "_us": "µs", "_hz": "Hz", "_uc": "µC"}
_NOTHING: dict[type, Any] = {float: math.nan, int: 0, bool: False, str: ""}
_DTYPES: dict[type, Any] = {float: np.float64, int: np.int64, bool: np.bool_, str: object}


class Table:
    """Rows under named columns.

    ``len`` counts the rows, iteration and a whole number give a row as a mapping, a name gives a column as an array
    (N,), a slice gives a smaller table. A number that is not known is NaN. ``values`` are (N,) by the columns' names.

    Raises:
        ValueError: a column is missing, or not as long as the others.
    """

    def __init__(self, columns: Sequence[Column], values: Mapping[str, Any]) -> None:
        self.columns = tuple(columns)
        if missing := [column.name for column in self.columns if column.name not in values]:
            raise ValueError(f"no values of {', '.join(missing)}")
        self._values: dict[str, npt.NDArray[Any]] = {
            column.name: np.asarray(values[column.name], dtype=_DTYPES[column.kind]) for column in self.columns
        }
        if len({len(each) for each in self._values.values()}) > 1:
            raise ValueError("the columns are not of one length")

    @classmethod
    def from_rows(cls, columns: Sequence[Column], rows: Iterable[Mapping[str, Any]]) -> Table:
        """Of flat rows; what a row does not have, or has as None, is NaN, 0, False or ""."""
        listed = list(rows)

        def cell(row: Mapping[str, Any], column: Column) -> object:
            value = row.get(column.name)
            return _NOTHING[column.kind] if value is None else value

        return cls(columns, {column.name: [cell(row, column) for row in listed] for column in columns})

    @property
    def names(self) -> tuple[str, ...]:
        """Of the columns, in order."""
        return tuple(column.name for column in self.columns)

    def __len__(self) -> int:
        return len(self._values[self.columns[0].name]) if self.columns else 0

    def __iter__(self) -> Iterator[dict[str, Any]]:
        lists = (self._values[name].tolist() for name in self.names)
        return (dict(zip(self.names, row, strict=True)) for row in zip(*lists, strict=True))

    def __getitem__(self, key: str | int | slice | npt.NDArray[Any]) -> Any:
        """A column by its name, a row by its number, another table by a slice or an array of numbers or of bools.

        Raises:
            KeyError: no column of that name.
            IndexError: no row of that number.
        """
        if isinstance(key, str):
            if key not in self._values:
                raise KeyError(f"no column {key!r}; there are {', '.join(self.names)}")
            return self._values[key]
        if isinstance(key, slice | np.ndarray):
            return type(self)(self.columns, {name: values[key] for name, values in self._values.items()})
        if not -len(self) <= key < len(self):
            raise IndexError(f"no row {key}; there are {len(self)}")
        return next(iter(self[key : key + 1 or None]))

    def sorted_by(self, name: str) -> Table:
        """The rows by a column, those of one value in the order in which they are."""
        rows: Table = self[np.argsort(self[name], kind="stable")]
        return rows

    def rows(self) -> list[dict[str, Any]]:
        """All rows as mappings."""
        return list(self)

    def to_pandas(self) -> Any:
        """As a pandas data frame; what the columns are is in its ``attrs["columns"]``.

        Raises:
            ImportError: pandas is not installed.
        """
        try:
            pandas = import_module("pandas")
        except ImportError as error:
            raise ImportError("A data frame takes pandas: pip install pandas") from error
        frame = pandas.DataFrame(self._values)
        frame.attrs["columns"] = {column.name: describe(column) for column in self.columns}
        return frame

    def to_arrow(self) -> pa.Table:
        """As an Arrow table; each field's metadata hold its unit, description and source."""
        import pyarrow as pa

        kinds = {float: pa.float64(), int: pa.int64(), bool: pa.bool_(), str: pa.string()}
        fields = [
            pa.field(c.name, kinds[c.kind], metadata={"unit": c.unit, "description": c.text, "source": c.source})
            for c in self.columns
        ]
        arrays = [pa.array(self._values[one.name], one.type) for one in fields]
        return pa.Table.from_arrays(arrays, schema=pa.schema(fields))

    def __repr__(self) -> str:
        return f"{type(self).__name__} of {len(self)} rows: {', '.join(self.names)}"

    def _repr_html_(self) -> str:
        heads = "".join(f'<th title="{escape(describe(column))}">{escape(column.name)}</th>' for column in self.columns)
        body = "".join(
            "<tr>" + "".join(f"<td>{escape(_cell(value))}</td>" for value in row.values()) + "</tr>"
            for row in self[:ROWS_SHOWN]
        )
        more = f"<p>{len(self)} rows, the first {ROWS_SHOWN} are shown</p>" if len(self) > ROWS_SHOWN else ""
        return f"<table><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>{more}"


def by_column(strides: Sequence[StrideResult]) -> Table:
    """S strides, a row each, with the columns ``schema.RESULT``; a time that a stride has not is ``UNSEEN_NS``."""
    return Table(schema.RESULT, schema.result_columns(strides))


def join_tables(tables: Sequence[Table]) -> Table:
    """Tables of the same columns, one below the other."""
    first = tables[0]
    return Table(first.columns, {name: np.concatenate([table[name] for table in tables]) for name in first.names})


def table_of(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Rows of the same names as a table: times in ns become seconds, units are told by the names, and what a gait
    parameter is by its definition."""
    columns = []
    for name, value in (rows[0] if rows else {}).items():
        known = DEFINITIONS.get(name)
        unit = known.unit if known else next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
        text, source = (known.text, known.source) if known else (name.replace("_", " "), "")
        kind = bool if isinstance(value, bool) else int if isinstance(value, int) else str
        columns.append(Column(name, float if value is None or isinstance(value, float) else kind, unit, text, source))
    shown = [(column, column.in_table()) for column in columns]
    seconds = ({new.name: row[old.name] if old is new else 1e-9 * row[old.name] for old, new in shown} for row in rows)
    return Table.from_rows([new for _, new in shown], seconds)


def describe(column: Column) -> str:
    """What a column is, with its unit and source, in one line."""
    unit, source = f" ({column.unit})" if column.unit else "", f" [{column.source}]" if column.source else ""
    return f"{column.text}{unit}{source}"


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.4g}" if abs(value) < 1e4 else f"{value:.1f}"
    return str(value)
