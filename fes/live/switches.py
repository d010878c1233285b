"""How a foot switch differs from the sensor's phases: contact against loading response, release against swing."""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from statistics import median
from typing import Any, Final

from fes.signals import FootSwitchEvent
from statemachine.phases import Phase, PhaseChange

PAIRED_WITHIN_NS: Final = 300_000_000  # half of a quick stride


class SwitchComparison:
    """Collects both; a few hundred numbers for an hour of walking."""

    def __init__(self) -> None:
        self._switch: dict[tuple[str, str], list[int]] = defaultdict(list)
        self._phase: dict[tuple[str, str], list[int]] = defaultdict(list)

    def switch(self, event: FootSwitchEvent) -> None:
        """The switch closed or opened."""
        if event.pressed is None:
            return
        self._switch[event.foot, "contact" if event.pressed else "release"].append(event.t_ns)

    def phase(self, change: PhaseChange) -> None:
        """The sensor told a phase."""
        what = {Phase.LOADING_RESPONSE: "contact", Phase.SWING: "release"}.get(change.destination)
        if what is not None:
            self._phase[change.foot, what].append(change.t_ns)

    def to_dict(self) -> dict[str, Any]:
        """By foot and kind: the sensor's delay behind the switch (ms; median, least, most), and what had no pair."""
        found: dict[str, Any] = {}
        for (foot, what), switched in self._switch.items():
            told = sorted(self._phase[foot, what])
            delays_ms = [delay * 1e-6 for t_ns in switched if (delay := _nearest(told, t_ns)) is not None]
            entry: dict[str, Any] = {"pairs": len(delays_ms), "switch_only": len(switched) - len(delays_ms)}
            entry["sensor_only"] = max(len(told) - len(delays_ms), 0)
            if delays_ms:
                entry["delay_ms"] = [round(f(delays_ms), 1) for f in (median, min, max)]
            found.setdefault(foot, {})[what] = entry
        return found


def _nearest(times_ns: list[int], t_ns: int) -> int | None:
    """How much later than ``t_ns`` the nearest of the times is; None if none is near enough."""
    at = bisect_left(times_ns, t_ns)
    near = [other - t_ns for other in times_ns[max(at - 1, 0) : at + 1]]
    best = min(near, key=abs, default=None)
    return best if best is not None and abs(best) <= PAIRED_WITHIN_NS else None
