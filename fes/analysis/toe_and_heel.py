"""Where toe and heel are on a foot, how that is known, and their clearance in a whole recording."""

from dataclasses import dataclass
from typing import Any

from fes.config import FootGeometry
from fes.estimation.clearance.clearance import (
    HEEL,
    TOE,
    AnyPaths,
    arms_of,
    clearances,
    contact_heights,
    contact_levels,
    join_paths,
)
from fes.estimation.clearance.geometry import EstimatedGeometry, estimate_geometry
from fes.signals import FloatArray


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


def point_heights(paths: AnyPaths, given: FootGeometry | None, *, level: bool) -> tuple[FloatArray | None, ToeAndHeel]:
    """Clearance of toe and heel (K, 2) of strides with these paths, None if not known, and where the two are.

    Without a ``given`` geometry it is estimated from the paths, on level ground only: on stairs a foot pushes off, and
    lands, with another part of the sole. ``level`` False also leaves the heights as they are, for where strides climb
    by different amounts the recording has no common level to shift to.
    """
    if not len(paths):
        return None, ToeAndHeel(None, reason="no stride could be used")
    if given is None and not level:
        return None, ToeAndHeel(None, reason="they show on level ground only; give [geometry] in the sidecar")
    paths = join_paths(paths)
    estimate = estimate_geometry(paths) if given is None else None
    geometry = given if estimate is None else estimate.geometry
    assert geometry is not None
    arms = arms_of(geometry)
    heights = contact_heights(paths, arms) if level else None
    levels = None if heights is None else contact_levels(heights)
    return clearances(paths, arms, levels, heights)[:, [TOE, HEEL]], ToeAndHeel(geometry, estimate, levels is not None)
