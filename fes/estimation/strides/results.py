"""From one foot's history to stride results: where a stride begins and ends, and what its numbers are.

Negård et al. (2005) integrate "from the beginning to the end of every step" and note that the foot is never wholly at
rest. Here the ends are the quietest tenths of a second of the stances around the swing, not the instants at which rest
happened to be detected, and the velocity there is that of a foot turning about its ground contact. The work is done in
``fes.estimation.strides.segmentation``.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from fes.config import FootGeometry
from fes.estimation.numerics.records import new_core
from fes.estimation.strides import integration, segmentation
from fes.estimation.strides.boundaries import REST_RADPS, UNSEEN_NS
from fes.estimation.strides.schema import COLUMNS, STRIDE
from fes.estimation.strides.segmentation import Out, SegmentationSettings
from fes.signals import FloatArray, StrideResult
from statemachine.phases import Phase

SENSOR_HEIGHT_M = 0.065  # of an instep sensor above the ground contact, where the session does not say
TOE_OUT_RAD = math.radians(7.0)  # most feet 5–10° (Morton, J Bone Joint Surg 14, 1932)
TRAJECTORY_POINTS = 101
Rows = np.ndarray[Any, np.dtype[Any]]
NAMES = STRIDE.names or ()
_LEFT = [column.name for column in COLUMNS if column.name.startswith("left_")]
HIDDEN = [column.name for column in COLUMNS if column.core and not column.shown]
_ENTRIES = [f"t_{phase.name.lower()}_ns" for phase in Phase]
UNKNOWN = {column.name: math.nan for column in COLUMNS if column.core and column.shown and column.kind is float}


@dataclass(frozen=True, slots=True)
class StrideSettings:
    """How strides of one foot are integrated.

    ``sensor_height_m``: height of the sensor above the ground contact; the end velocity is ``w × height``. ``incline``:
    what the ground rises per horizontal distance, NaN for stairs and unknown slopes. ``forward`` and ``up``: unit
    vectors towards the toe and up, foot flat, in the sensor frame (3,). ``method``: "maximum_likelihood" weighs all
    errors, "constrained" is Negård et al.'s, corrected. Where the foot has no true rest the stride's ``reason`` says
    so; it stays valid unless the foot turns faster than ``NO_REST_RADPS`` at its quietest.
    """

    forward: FloatArray
    up: FloatArray
    sensor_height_m: float = SENSOR_HEIGHT_M
    incline: float = 0.0
    geometry: FootGeometry | None = None
    method: Literal["maximum_likelihood", "constrained"] = "maximum_likelihood"

    def compiled(self, foot: str) -> SegmentationSettings:
        """For the compiler, of this foot's sensor."""
        known, (fx, fy, fz), (ux, uy, uz) = self.geometry, self.forward.tolist(), self.up.tolist()
        return SegmentationSettings(
            forward_x=fx,
            forward_y=fy,
            forward_z=fz,
            up_x=ux,
            up_y=uy,
            up_z=uz,
            sensor_height_m=self.sensor_height_m,
            constrained=self.method == "constrained",
            incline=self.incline,
            next_incline=self.incline,
            known=known is not None,
            toe_forward_m=known.toe_forward_m if known else 0.0,
            toe_up_m=known.toe_up_m if known else 0.0,
            heel_forward_m=known.heel_forward_m if known else 0.0,
            heel_up_m=known.heel_up_m if known else 0.0,
            toe_out_rad=toe_out_rad(foot),
        )


def toe_out_rad(foot: str) -> float:
    """How far a foot points from where its stride leads, to the left positive: outward by :data:`TOE_OUT_RAD`."""
    return TOE_OUT_RAD if foot.startswith("left") else -TOE_OUT_RAD


class StrideMaker:
    """Follows the phases of one foot and closes a stride when the stance after its swing is over, or a second old."""

    def __init__(self, foot: str, settings: StrideSettings) -> None:
        self.foot = foot
        self.settings = settings
        self.core = new_core(segmentation.STRIDE_STATE, settings=settings.compiled(foot))
        segmentation.restart(self.core, 0)

    def keep_in(self, core: Rows) -> None:
        """From now on keep all that evolves in this array (1,) of ``segmentation.STRIDE_STATE``."""
        core[:] = self.core
        self.core = core

    def set_incline(self, incline: float) -> None:
        """What the ground rises per horizontal distance (NaN: nobody knows), from the next heel rise on."""
        self.core["settings"]["next_incline"] = incline

    def stride_in(self, out: Out) -> StrideResult:
        """The only stride in ``out``."""
        return result_of(self.foot, out.strides[:1].tolist()[0], out.shapes[0].copy())


def result_of(foot: str, row: tuple[Any, ...], shape: FloatArray) -> StrideResult:
    """Result of one stride from its row and shape (``TRAJECTORY_POINTS``, 5), whose tilt is of the left side up."""
    columns: dict[str, Any] = dict(zip(NAMES, row, strict=True))
    valid, reason = columns["outcome"] == integration.SOLVED, ""
    if not valid or columns["residual_rate_radps"] > REST_RADPS:
        reason = reason_of(columns)
    left_over = tuple([columns[name] for name in _LEFT])
    columns["left_over"] = left_over if any(left_over) else ()
    for name in HIDDEN:
        del columns[name]
    if not valid:
        columns |= UNKNOWN
        shape = shape[:0]
    for name in _ENTRIES:
        if columns[name] == UNSEEN_NS:
            columns[name] = None
    trajectory, pitch = shape[:, :3].copy(), shape[:, 3].copy()
    roll = -shape[:, 4] if foot.startswith("left") else shape[:, 4].copy()  # inversion lifts the inner side
    return StrideResult(
        foot, valid=valid, reason=reason, trajectory_m=trajectory, pitch_rad=pitch, roll_rad=roll, **columns
    )


def reason_of(row: Mapping[str, Any]) -> str:
    """Why a stride is not valid, or not as good as others."""
    rate_radps = row["residual_rate_radps"]
    return {
        integration.SOLVED: f"no true rest: {rate_radps:.1f} rad/s at its quietest",
        integration.NO_SOLUTION: "the constraints cannot be met",
        integration.TILTED: f"the orientation is {math.degrees(row['tilt_rad']):.0f}° off at its end",
        integration.NO_LENGTH: f"{row['stride_length_m']:.2f} m is no stride length",
        integration.BACKWARD: f"went backward by {row['stride_length_m']:.2f} m",
        integration.NO_REST: f"the foot never rests: {rate_radps:.1f} rad/s at its quietest",
        segmentation.FORGOTTEN: "longer than the history kept",
        segmentation.NO_STRIDE_TIME: f"lasts {1e-9 * (row['t_end_ns'] - row['t_start_ns']):.2f} s",
        segmentation.GAP: f"samples missing for {1e3 * row['gap_s']:.0f} ms",
    }[row["outcome"]]
