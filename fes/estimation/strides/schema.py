"""Every column of a stride once: its name, kind, unit, meaning and source.

The record that compiled code fills (:data:`STRIDE`), the columns of ``strides.csv`` and its like (:data:`TABLE`), those
of a session's strides (:data:`LIVE_TABLE`), and the table in ``docs/strides.md`` are made from :data:`COLUMNS`.
:class:`fes.signals.StrideResult` and the session log's record of a stride carry the same names; a test compares them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.signals import StrideResult

NEGARD = "Negård et al. 2005"


class Column(NamedTuple):
    """One column of a table.

    Attributes:
        name: with the unit at its end.
        kind: float, int, bool or str.
        unit: "" where there is none.
        text: what it is, in a sentence.
        source: who defines it so: paper and equation; "" where nobody had to.
        core: compiled code fills it in.
        shown: tables have it; times are in seconds there.
    """

    name: str
    kind: type
    unit: str
    text: str
    source: str = ""
    core: bool = False
    shown: bool = True

    def in_table(self) -> Column:
        """As tables show it: integer nanoseconds become seconds."""
        if self.unit != "ns":
            return self
        return self._replace(name=self.name.removesuffix("ns") + "s", kind=float, unit="s")


def _stamp(name: str, text: str, source: str = "") -> Column:
    return Column(name, int, "ns", text, source, core=True)


def _measure(name: str, unit: str, text: str, source: str = "") -> Column:
    return Column(name, float, unit, text, source, core=True)


def _live(name: str, transition: str) -> Column:
    return Column(name, float, "s", f"when the live phase machine said so ({transition})", f"{NEGARD}, Fig. 5")


def _inner(name: str, kind: type, unit: str, text: str) -> Column:
    return Column(name, kind, unit, text, core=True, shown=False)


COLUMNS: Final = (
    Column("foot", str, "", "the sensor that it is from: a foot's, or a shank's where the foot has none"),
    Column("number", int, "", "counts the strides of a sensor from 1", core=True),
    Column("valid", bool, "", "whether the numbers may be used; they are empty if not"),
    Column("reason", str, "", "why it is not valid, or not as good as others"),
    _stamp("t_start_ns", "where it begins: the quietest instant of the stance before its swing", NEGARD),
    _stamp("t_end_ns", "where it ends: the quietest instant of the stance after its swing", NEGARD),
    _stamp(
        "t_pre_swing_ns",
        "heel off, the entry into pre-swing, found off-line; empty where it was not seen",
        f"{NEGARD}, Fig. 5",
    ),
    _stamp("t_swing_ns", "foot off, the entry into swing, likewise", f"{NEGARD}, Fig. 5"),
    _stamp("t_loading_response_ns", "initial contact, the entry into loading response, likewise", f"{NEGARD}, Fig. 5"),
    _stamp("t_stance_ns", "foot flat, the entry into stance, likewise", f"{NEGARD}, Fig. 5"),
    _live("t_pre_swing_live_s", "T1"),
    _live("t_swing_live_s", "T2"),
    _live("t_loading_response_live_s", "T3"),
    _live("t_stance_live_s", "T4, or T6 where no contact was seen"),
    _measure("stride_length_m", "m", "horizontal distance of the sensor from start to end", f"{NEGARD}, Eq. (20)"),
    _measure("stride_length_sd_m", "m", "its uncertainty, one standard deviation; empty of a shank's"),
    _measure("speed_mps", "m/s", "stride length over the time from the end of the stride before", "Perry & Burnfield"),
    _measure("clearance_m", "m", "greatest height of the sensor over the line from its start to its end", NEGARD),
    _measure("toe_clearance_m", "m", "least height of the toe in mid-swing; empty on stairs", "Winter 1992"),
    _measure("heel_clearance_m", "m", "greatest height of the heel", "Mariani et al. 2012"),
    _measure("height_gained_m", "m", "height of its end above its start", "Wang et al. 2013"),
    _measure("free_rise_m", "m", "the same by the sensor alone, whatever the ground is said to be; empty of a shank's"),
    _measure("turn_rad", "rad", "change of the foot's heading, to the left positive"),
    Column("x_m", float, "m", "where it ends on the foot's path: ahead of the path's start"),
    Column("y_m", float, "m", "to the left of the path's start"),
    Column("z_m", float, "m", "above the path's start"),
    Column("heading_rad", float, "rad", "where the toe points there, from x towards y"),
    _inner("outcome", int, "", "``SOLVED``, or why it was not solved: the numbers of segmentation and integration"),
    _inner("changes", int, "", "how many phase changes came before it"),
    _inner("first", int, "", "the first row of its trajectory"),
    _inner("rows", int, "", "how many rows its trajectory has"),
    _inner("gap_s", float, "s", "the longest time between two of its samples"),
    _inner("tilt_rad", float, "rad", "how far the orientation is off at its end"),
    _inner("residual_rate_radps", float, "rad/s", "the rate at the end that is the less quiet one"),
    *(
        _inner(name, float, unit, f"what a sound sensor at rest would have left over: {text}; 0 unless it has a shape")
        for name, unit, text in (
            ("left_forward_mps", "m/s", "velocity forward"),
            ("left_sideways_mps", "m/s", "velocity to the left"),
            ("left_up_mps", "m/s", "velocity up"),
            ("left_height_m", "m", "height"),
            ("left_pitch", "", "tilt forward, a sine"),
            ("left_roll", "", "tilt to the left, a sine"),
        )
    ),
)

TABLE: Final = tuple(column.in_table() for column in COLUMNS if column.shown)
LIVE_TABLE: Final = tuple(
    column._replace(text=column.text.replace(", found off-line", "").removesuffix(", likewise"))
    for column in TABLE
    if not column.name.endswith("_live_s")
)
RESULT: Final = tuple(c for c in COLUMNS if c.shown and c.name in StrideResult.__dataclass_fields__)
_DTYPES: Final[dict[type, Any]] = {int: np.int64, float: np.float64, str: object, bool: np.bool_}
STRIDE: Final = np.dtype([(column.name, _DTYPES[column.kind]) for column in COLUMNS if column.core], align=True)
_SHOWN: Final = [(column.name, column.in_table().name, column.unit == "ns") for column in RESULT]


def table_row(stride: StrideResult) -> dict[str, Any]:
    """A stride's columns of :data:`LIVE_TABLE`, but where it lies on a path; a time that it has not is None."""
    row: dict[str, Any] = {}
    for name, shown, is_time in _SHOWN:
        value = getattr(stride, name)
        row[shown] = 1e-9 * value if is_time and value is not None else value
    return row


def result_columns(strides: Sequence[StrideResult]) -> dict[str, npt.NDArray[Any]]:
    """The columns :data:`RESULT` of S strides, (S,) each, times in ns; one that a stride has not is ``UNSEEN_NS``."""
    columns: dict[str, npt.NDArray[Any]] = {}
    for column in RESULT:
        values = [getattr(stride, column.name) for stride in strides]
        if column.unit == "ns":
            values = [UNSEEN_NS if value is None else value for value in values]
        columns[column.name] = np.array(values, _DTYPES[column.kind])
    return columns


def table_columns(columns: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Of :func:`result_columns` those of :data:`LIVE_TABLE`, times in s; one that a stride has not is NaN."""
    return {
        shown: np.where(columns[name] == UNSEEN_NS, np.nan, 1e-9 * columns[name]) if is_time else columns[name]
        for name, shown, is_time in _SHOWN
    }


def markdown() -> str:
    """The table of ``docs/strides.md``."""
    rows = [
        f"| `{column.name}` | {column.unit or column.kind.__name__} | {column.text} | {column.source} |"
        for column in TABLE
    ]
    return "\n".join(["| column | unit | what it is | source |", "|---|---|---|---|", *rows])
