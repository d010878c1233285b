"""Where toe and heel are on a foot, how that is known, and their clearance in a whole recording."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fes.config import FootGeometry
from fes.estimation.clearance.clearance import (
    HEEL,
    TOE,
    FootPaths,
    arms_of,
    clearances,
    contact_heights,
    contact_levels,
)
from fes.estimation.clearance.geometry import EstimatedGeometry, estimate_geometry
from fes.estimation.numerics.rotation import rotate_all
from fes.estimation.strides.integration import MOST_INCLINE
from fes.signals import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class ToeAndHeel:
    """One foot's toe and heel, seen from the sensor.

    ``geometry`` is None where they are not known, and ``reason`` says why. ``estimate`` is None where the recording's
    sidecar gives the geometry; then nothing is estimated. ``levels``: the heights were shifted to the recording's
    contact levels (see :mod:`fes.estimation.clearance.clearance`).
    """

    geometry: FootGeometry | None
    estimate: EstimatedGeometry | None = None
    levels: bool = False
    reason: str = ""

    @property
    def measured(self) -> bool:
        """Whether all of it was given, or seen in this recording: nothing assumed."""
        return self.geometry is not None and (self.estimate is None or self.estimate.observed)

    def to_json(self) -> dict[str, Any]:
        """Plain values, units in the names; ``source`` is "given", "estimated" or "unknown"."""
        if self.geometry is None:
            return {"source": "unknown", "reason": self.reason}
        known: dict[str, Any] = {
            "source": "given" if self.estimate is None else "estimated",
            "contact_levels": self.levels,
            "geometry": self.geometry.model_dump(),
        }
        if self.estimate is not None:
            names = ("toe_forward_sd_m", "heel_forward_sd_m", "height_sd_m", "strides", "observed", "reason")
            known |= {name: getattr(self.estimate, name) for name in names}
        return known

    def describe(self) -> str:
        """One sentence for people."""
        if self.geometry is None:
            return f"toe and heel not known: {self.reason}"
        if self.estimate is None:
            return "toe and heel as the sidecar's [geometry] gives them"
        found, sd = self.geometry, self.estimate
        said = (
            f"toe and heel estimated from {sd.strides} strides: "
            f"toe {100 * found.toe_forward_m:.1f} ± {100 * sd.toe_forward_sd_m:.1f} cm ahead of the sensor, "
            f"heel {-100 * found.heel_forward_m:.1f} ± {100 * sd.heel_forward_sd_m:.1f} cm behind, "
            f"sensor {-100 * found.toe_up_m:.1f} ± {100 * sd.height_sd_m:.1f} cm above the sole"
        )
        return said if sd.observed else f"{said}. Partly assumed, not measured: {sd.reason}"


def point_heights(paths: FootPaths, given: FootGeometry | None, *, level: bool) -> tuple[FloatArray | None, ToeAndHeel]:
    """Clearance of toe and heel (K, 2) of strides with these paths, None if not known, and where the two are.

    Where the ground is not level, heights count from the line between the stances of each stride. Strides too steep for
    that are on stairs: they have no clearance, and show neither toe nor heel, for there a foot pushes off, and lands,
    with another part of the sole.
    """
    if not level and len(paths):
        paths, sloping = laid_level(paths)
        found, points = point_heights(paths, given, level=True)
        if found is None:
            return None, points if sloping.any() else ToeAndHeel(None, reason="they do not show on stairs")
        heights = np.full((len(sloping), 2), np.nan)
        heights[sloping] = found
        return heights, points
    if not len(paths):
        return None, ToeAndHeel(None, reason="no stride could be used")
    estimate = estimate_geometry(paths) if given is None else None
    geometry = given if estimate is None else estimate.geometry
    assert geometry is not None
    arms = arms_of(geometry)
    heights = contact_heights(paths, arms)
    levels = contact_levels(heights)
    return clearances(paths, arms, levels, heights)[:, [TOE, HEEL]], ToeAndHeel(geometry, estimate, levels is not None)


def laid_level(paths: FootPaths) -> tuple[FootPaths, BoolArray]:
    """The strides on slopes as if those were level: each turned until its end is as high as its start.

    The foot's axes are turned alike where it did not lie flat in them: a sole lies on the slope, whatever ground it was
    calibrated on.

    Returns:
        The paths that are left, and which they are (K,): those that rise more steeply than any slope are on stairs.
    """
    ends = paths.position_m[paths.spans[:, 1] - 1] - paths.position_m[paths.spans[:, 0]]
    along_m = np.hypot(ends[:, 0], ends[:, 1])
    sloping = np.abs(ends[:, 2]) <= MOST_INCLINE * along_m
    position, quaternion, leans = paths.position_m.copy(), paths.quaternion.copy(), []
    for k in np.flatnonzero(sloping).tolist():
        own, angle = slice(*paths.spans[k].tolist()), math.atan2(ends[k, 2], along_m[k])
        axis = np.array((-ends[k, 1], ends[k, 0], 0.0)) / max(along_m[k], 1e-9)
        w, (x, y, z) = math.cos(0.5 * angle), (math.sin(0.5 * angle) * axis).tolist()
        product = np.array(((w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)))
        quaternion[own] = paths.quaternion[own] @ product
        position[own] = paths.position_m[own] @ _turn(axis, angle).T
        leans.append(math.asin(rotate_all(quaternion[own][:1], paths.foot[:, 0])[0, 2]))
    lean = float(np.median(np.array(leans))) if leans else 0.0
    foot = np.ascontiguousarray(_turn(paths.foot[:, 1], lean) @ paths.foot)
    kept = replace(
        paths, numbers=paths.numbers[sloping], spans=paths.spans[sloping], swings_ns=paths.swings_ns[sloping],
        position_m=position, quaternion=quaternion, foot=foot,
    )  # fmt: skip
    return kept, sloping


def _turn(axis: FloatArray, angle: float) -> FloatArray:
    """The matrix (3, 3) that turns by an angle (rad) about a unit axis (3,)."""
    x, y, z = axis.tolist()
    cross = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross))
