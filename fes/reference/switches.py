"""Foot switches and pressure under the sole, sampled → initial contact and foot off."""

from __future__ import annotations

import numpy as np

from fes.reference.types import ReferenceError, ReferenceEvent
from fes.signals import FloatArray

ON_SHARE, OFF_SHARE = 0.6, 0.4  # of the way from the released to the pressed level: hysteresis
BOUNCE_S = 0.05  # shorter pauses and touches are bouncing contacts


def switch_events(source: str, foot: str, t_s: FloatArray, signals: list[FloatArray]) -> list[ReferenceEvent]:
    """The foot is down while any of its switches is pressed: IC where the first closes, FO where the last opens.

    Args:
        source: the file, for messages.
        foot: whose.
        t_s: (N,) increasing.
        signals: (N,) each; two levels, or a pressure of which the 2nd and 98th percentile are taken for the levels.

    Raises:
        ReferenceError: none of the switches ever changes.
    """
    down = np.zeros(len(t_s), dtype=bool)
    changed = False
    for values in signals:
        low, high = np.nanpercentile(values, [2.0, 98.0]) if np.isfinite(values).any() else (0.0, 0.0)
        if high > low:
            changed = True
            down |= _pressed((values - low) / (high - low))
    if not changed:
        raise ReferenceError(f"{source}: the switches of the {foot.replace('_', ' ')} never change; is one broken?")
    edges = np.flatnonzero(np.diff(down.astype(np.int8)))
    bounds = _without_bounces(t_s, edges)
    events = []
    for k in bounds:
        what = "IC" if down[k + 1] else "FO"
        events.append(ReferenceEvent(float(0.5 * (t_s[k] + t_s[k + 1])), foot, what))
    return events


def _pressed(level: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Schmitt trigger over a level of 0 to 1; a missing sample keeps the state."""
    state = np.where(level >= ON_SHARE, 1, np.where(level <= OFF_SHARE, 0, -1))
    known = np.flatnonzero(state >= 0)
    if not len(known):
        return np.zeros(len(level), dtype=bool)
    last = np.maximum.accumulate(np.where(state >= 0, np.arange(len(level)), known[0]))
    return np.asarray(state[last] == 1)


def _without_bounces(t_s: FloatArray, edges: np.ndarray[tuple[int], np.dtype[np.int64]]) -> list[int]:
    """Edges that are not followed by their opposite within ``BOUNCE_S``, nor such opposites."""
    kept: list[int] = []
    for k in edges.tolist():
        if kept and t_s[k + 1] - t_s[kept[-1] + 1] < BOUNCE_S:
            kept.pop()
        else:
            kept.append(k)
    return kept
