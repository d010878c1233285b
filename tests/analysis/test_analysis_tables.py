"""Tables: rows, columns, Arrow and what a notebook shows."""

from __future__ import annotations

import math
import sys

import pytest

from fes.analysis.tables import Table
from fes.estimation.strides.schema import TABLE, Column

COLUMNS = (
    Column("foot", str, "", "which <foot>"),
    Column("number", int, "", "counts"),
    Column("length_m", float, "m", "how long", "Wang et al. 2013"),
)
ROWS = [{"foot": "left_foot", "number": k, "length_m": None if k == 2 else 1.0 + k} for k in range(4)]


def test_rows_columns_and_parts_of_a_table() -> None:
    table = Table.from_rows(COLUMNS, ROWS)
    assert len(table) == 4
    assert table.names == ("foot", "number", "length_m")
    assert table["number"].tolist() == [0, 1, 2, 3]
    assert math.isnan(table["length_m"][2])
    assert table[1] == ROWS[1]
    assert table[-1] == ROWS[3]
    assert table[1:3].rows()[0] == ROWS[1]
    assert [row["number"] for row in table] == [0, 1, 2, 3]


def test_what_is_not_there_is_refused() -> None:
    table = Table.from_rows(COLUMNS, ROWS)
    with pytest.raises(KeyError, match="there are foot"):
        table["width_m"]
    for number in (4, -5):
        with pytest.raises(IndexError, match="there are 4"):
            table[number]
    with pytest.raises(ValueError, match="no values of length_m"):
        Table(COLUMNS, {"foot": [], "number": []})
    with pytest.raises(ValueError, match="not of one length"):
        Table(COLUMNS, {"foot": ["a"], "number": [], "length_m": []})


def test_arrow_keeps_units_and_sources() -> None:
    arrow = Table.from_rows(COLUMNS, ROWS).to_arrow()
    metadata = arrow.schema.field("length_m").metadata
    assert metadata == {b"unit": b"m", b"description": b"how long", b"source": b"Wang et al. 2013"}
    assert arrow.column("number").to_pylist() == [0, 1, 2, 3]
    assert Table.from_rows(TABLE, []).to_arrow().num_rows == 0


def test_a_notebook_shows_the_first_rows() -> None:
    table = Table.from_rows(COLUMNS, ROWS * 10)
    html = table._repr_html_()
    assert html.count("<tr>") == 21
    assert "40 rows, the first 20 are shown" in html
    assert "which &lt;foot&gt;" in html
    assert repr(table) == "Table of 40 rows: foot, number, length_m"


def test_pandas_is_asked_for_only_when_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table.from_rows(COLUMNS, ROWS)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        table.to_pandas()
