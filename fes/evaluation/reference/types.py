"""What a reference knows: events, strides, paths of markers, a belt's speed; times in s on its own clock."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from fes.signals import FloatArray

EVENTS: Final = ("IC", "FO")  # initial contact, foot off
POINTS: Final = ("sensor", "heel", "toe")


class ReferenceError(ValueError):
    """A reference cannot be used; the message names the file, the place and what would be right."""


@dataclass(frozen=True, slots=True, order=True)
class ReferenceEvent:
    """Initial contact (``IC``) or foot off (``FO``) of one foot."""

    t_s: float
    foot: str
    what: str


@dataclass(frozen=True, slots=True)
class ReferenceStride:
    """One stride of one foot; ``values`` by the names of :data:`fes.evaluation.reference.evaluation.QUANTITIES`, SI.

    ``usable`` is False where the reference itself says that its numbers do not hold (a belt that changes its speed).
    """

    foot: str
    t_start_s: float
    t_end_s: float
    values: dict[str, float]
    usable: bool = True


@dataclass(frozen=True, slots=True, order=True)
class ReferenceEnd:
    """Where a walk ended, seen from where it began: horizontal ``distance_m`` and ``height_m``, NaN if not known."""

    foot: str
    distance_m: float
    height_m: float


@dataclass(frozen=True, slots=True, eq=False)
class MarkerPath:
    """Where a point of a foot was: (N,) increasing times and (N, 3) in m, z up; NaN rows where it was not seen.

    ``frame`` is "lab" (a treadmill's belt moves below it) or "ground" (the ground, or the belt's own frame).
    """

    foot: str
    point: str
    t_s: FloatArray
    position_m: FloatArray
    frame: str = "ground"

    @property
    def rate_hz(self) -> float:
        """One over the usual (median) interval."""
        return 1.0 / float(np.median(np.diff(self.t_s)))


@dataclass(frozen=True, eq=False)
class Reference:
    """All that one or several reference files say.

    Attributes:
        sources: the files, for people.
        events: in order of time.
        strides: in order of time.
        paths: one per foot and point.
        belt: (N, 2) time (s) and speed (m/s) of a treadmill's belt; empty where unknown.
        notes: what was assumed on reading, in words.
        ends: where whole walks ended.
    """

    sources: tuple[str, ...] = ()
    events: tuple[ReferenceEvent, ...] = ()
    strides: tuple[ReferenceStride, ...] = ()
    paths: tuple[MarkerPath, ...] = ()
    belt: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    notes: tuple[str, ...] = ()
    ends: tuple[ReferenceEnd, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.events or self.strides or self.paths or len(self.belt) or self.ends)

    def joined(self, other: Reference) -> Reference:
        """Both together.

        Raises:
            ReferenceError: both hold the same marker, or a belt.
        """
        twice = {(p.foot, p.point) for p in self.paths} & {(p.foot, p.point) for p in other.paths}
        if twice or (len(self.belt) and len(other.belt)):
            what = " ".join(next(iter(twice))).replace("_", " ") if twice else "the belt's speed"
            raise ReferenceError(
                f"{', '.join(other.sources)}: {what} is in {', '.join(self.sources)} as well; keep one"
            )
        return Reference(
            self.sources + other.sources,
            tuple(sorted(self.events + other.events)),
            tuple(sorted(self.strides + other.strides, key=lambda stride: stride.t_start_s)),
            self.paths + other.paths,
            self.belt if len(self.belt) else other.belt,
            self.notes + other.notes,
            self.ends + other.ends,
        )

    def shifted(self, lag_s: float) -> Reference:
        """The same on a clock that is ``lag_s`` ahead: every time plus ``lag_s``."""
        belt = self.belt + np.array([lag_s, 0.0]) if len(self.belt) else self.belt
        return replace(
            self,
            events=tuple(replace(event, t_s=event.t_s + lag_s) for event in self.events),
            strides=tuple(
                replace(stride, t_start_s=stride.t_start_s + lag_s, t_end_s=stride.t_end_s + lag_s)
                for stride in self.strides
            ),
            paths=tuple(replace(path, t_s=path.t_s + lag_s) for path in self.paths),
            belt=belt,
        )
