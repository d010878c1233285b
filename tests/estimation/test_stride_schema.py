"""The columns of a stride, stated once: what carries them has the same names, in the docs too."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path

import numpy as np

from fes.estimation.strides.schema import COLUMNS, STRIDE, TABLE, markdown, table_row
from fes.session_log.codec import decode, encode
from fes.signals import StrideResult

DOCS = Path(__file__).resolve().parents[2] / "docs" / "strides.md"
PATH = {"x_m", "y_m", "z_m", "heading_rad"}
RESULT = StrideResult(
    "left_foot", 3, 10, 2_000_000_000, 1.2, 0.1, 0.0, 0.02, 1.1, 5, None, 6, 7, 0.02, 0.2, True, "why",
    np.zeros((101, 3)), np.zeros(101),
)  # fmt: skip


def test_a_stride_has_the_columns_that_the_schema_states() -> None:
    carried = {field.name for field in fields(StrideResult)} - {"trajectory_m", "pitch_rad"}
    assert carried == {column.name for column in COLUMNS if column.shown} - PATH
    assert len({column.name for column in COLUMNS}) == len(COLUMNS)
    assert set(STRIDE.names or ()) >= carried - {"foot", "valid", "reason"}


def test_a_row_of_the_table_is_in_seconds() -> None:
    row = table_row(RESULT)
    assert set(row) | PATH == {column.name for column in TABLE}
    assert (row["t_end_s"], row["t_pre_swing_s"], row["t_swing_s"]) == (2.0, 5e-9, None)
    assert row["stride_length_m"] == 1.2
    assert all(column.text and (column.unit or column.kind is not float) for column in TABLE)
    assert not math.isnan(row["speed_mps"])


def test_a_log_carries_the_same_columns() -> None:
    kind, payload = encode(RESULT)
    assert decode(kind, memoryview(payload)) == RESULT


def test_the_page_shows_the_columns() -> None:
    assert markdown() in DOCS.read_text(encoding="utf-8"), "write it anew from fes.estimation.strides.schema.markdown()"
