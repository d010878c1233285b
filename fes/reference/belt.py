"""From the laboratory's frame to the belt's: Negård et al. (2005), Eq. (21), ``p_belt = p_lab + v t`` along the walk.

While a foot stands on a belt, it moves backward with it; the walking direction is therefore the horizontal axis along
which the standing foot loses ``v t``. It is found from the marker itself, and the speed that is left to the standing
foot afterwards tells whether direction and speed were right.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fes.reference.types import MarkerPath, ReferenceError
from fes.signals import FloatArray

AXES: Final = {"+x": (1.0, 0.0), "-x": (-1.0, 0.0), "+y": (0.0, 1.0), "-y": (0.0, -1.0)}
MOST_LEFT_SHARE: Final = 0.25  # of the belt's speed: more left to the standing foot means a wrong direction or speed
STANDING_PERCENT: Final = 30.0


@dataclass(frozen=True, slots=True)
class OnBelt:
    """A path in the belt's frame, the axis walked along, and the standing foot's median speed there (m/s)."""

    path: MarkerPath
    axis: str
    standing_mps: float


def to_belt(path: MarkerPath, belt: FloatArray, axis: str | None = None) -> OnBelt:
    """Move a path of the lab to the belt's frame.

    Args:
        path: in the lab's frame.
        belt: (N, 2) times (s) and speed (m/s); before the first and after the last time the speed stays as it is.
        axis: "+x", "-x", "+y" or "-y", the direction of walking; None: found from the standing foot.

    Raises:
        ReferenceError: the standing foot does not move with the belt, along any axis or the one given.
    """
    way = _way(belt, path.t_s)
    fastest = float(np.abs(belt[:, 1]).max())
    tried = []
    for name in [axis] if axis else list(AXES):
        moved = path.position_m.copy()
        moved[:, :2] += way[:, None] * np.array(AXES[name])
        candidate = replace(path, position_m=moved, frame="ground")
        tried.append(OnBelt(candidate, name, standing_speed(candidate)))
    best = min(tried, key=lambda each: each.standing_mps)
    if not best.standing_mps <= MOST_LEFT_SHARE * fastest:
        raise ReferenceError(
            f"the {path.point} marker of the {path.foot.replace('_', ' ')} does not stand still on the belt: with its "
            f"speed of {fastest:.2f} m/s taken off along {best.axis}, the standing foot still moves at "
            f"{best.standing_mps:.2f} m/s. Check the belt's speed, or say --frame ground if there was no treadmill"
        )
    return best


def looks_like_lab(path: MarkerPath, belt: FloatArray) -> bool:
    """Whether a path stays where the treadmill is, instead of going as far as the belt ran."""
    seen = np.flatnonzero(np.isfinite(path.position_m).all(axis=1))
    if len(seen) < 2:
        return False
    way = _way(belt, path.t_s[seen])
    gone = float(np.linalg.norm(np.ptp(path.position_m[seen, :2], axis=0)))
    return gone < 0.5 * float(np.ptp(way))


def standing_speed(path: MarkerPath) -> float:
    """Median horizontal speed (m/s) over the slowest part of a path: what is left to a standing foot."""
    speed = horizontal_speed(path)
    speed = speed[np.isfinite(speed)]
    if not len(speed):
        return float("inf")
    return float(np.median(speed[speed <= np.percentile(speed, STANDING_PERCENT)]))


def horizontal_speed(path: MarkerPath, over_s: float = 0.08) -> FloatArray:
    """Horizontal speed (N,) in m/s, as a difference over ``over_s``; NaN at the ends and where the marker is unseen."""
    reach = max(round(0.5 * over_s * path.rate_hz), 1)
    speed = np.full(len(path.t_s), np.nan)
    if len(speed) > 2 * reach:
        step = path.position_m[2 * reach :, :2] - path.position_m[: -2 * reach, :2]
        speed[reach:-reach] = np.hypot(*step.T) / (path.t_s[2 * reach :] - path.t_s[: -2 * reach])
    return speed


def _way(belt: FloatArray, t_s: FloatArray) -> FloatArray:
    """How far the belt has run at each time (N,), from the first of them."""
    knots = np.unique(np.concatenate([belt[:, 0], t_s]))
    speed = np.interp(knots, belt[:, 0], belt[:, 1])
    run = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(knots))])
    at = np.interp(t_s, knots, run)
    return np.asarray(at - at[0])
