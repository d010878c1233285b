"""The columns of a stride, stated once: what carries them has the same names, in the docs too."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from fes.estimation.strides.schema import COLUMNS, LIVE_TABLE, STRIDE, TABLE, markdown, table_row
from fes.session_log.codec import decode, encode
from fes.signals import StrideResult

DOCS = Path(__file__).resolve().parents[2] / "docs" / "strides.md"
PATH = {"x_m", "y_m", "z_m", "heading_rad"}
LIVE = {f"t_{phase}_live_s" for phase in ("pre_swing", "swing", "loading_response", "stance")}
RESULT = StrideResult(
    "left_foot", 3, 10, 2_000_000_000, 1.2, 0.1, 0.0, 0.02, 1.1, 5, None, 6, 7, 0.02, 0.2, True, "why",
    np.zeros((101, 3)), np.zeros(101),
)  # fmt: skip


def test_a_stride_has_the_columns_that_the_schema_states() -> None:
    carried = {field.name for field in fields(StrideResult)} - {"trajectory_m", "pitch_rad", "roll_rad", "left_over"}
    assert carried == {column.name for column in COLUMNS if column.shown} - PATH - LIVE
    assert len({column.name for column in COLUMNS}) == len(COLUMNS)
    assert set(STRIDE.names or ()) >= carried - {"foot", "valid", "reason"}


def test_a_row_of_the_table_is_in_seconds() -> None:
    row = table_row(RESULT)
    assert set(row) | PATH == {column.name for column in LIVE_TABLE} == {column.name for column in TABLE} - LIVE
    assert "off-line" not in " ".join(column.text for column in LIVE_TABLE)
    assert (row["t_end_s"], row["t_pre_swing_s"], row["t_swing_s"]) == (2.0, 5e-9, None)
    assert row["stride_length_m"] == 1.2
    assert all(column.text and (column.unit or column.kind is not float) for column in TABLE)
    assert not math.isnan(row["speed_mps"])


def test_a_log_carries_the_same_columns() -> None:
    kind, payload = encode(RESULT)
    assert decode(kind, memoryview(payload)) == RESULT


def test_a_log_from_before_the_roll_is_read() -> None:
    angles = np.linspace(0.0, 0.5, 101)
    stride = replace(RESULT, pitch_rad=angles, roll_rad=-angles)
    kind, payload = encode(stride)
    now, before = decode(kind, memoryview(payload)), decode(kind, memoryview(payload)[: -4 * 101])
    assert isinstance(now, StrideResult)
    assert isinstance(before, StrideResult)
    assert now.roll_rad == pytest.approx(-angles, abs=1e-7)
    assert before == RESULT
    assert (len(before.roll_rad), len(before.trajectory_m)) == (0, 101)
    assert np.array_equal(before.pitch_rad, now.pitch_rad)
    with pytest.raises(ValueError, match="length"):
        decode(kind, memoryview(payload)[:-4])


def test_the_page_shows_the_columns() -> None:
    assert markdown() in DOCS.read_text(encoding="utf-8"), "write it anew from fes.estimation.strides.schema.markdown()"
