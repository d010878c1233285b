"""What was learnt, by walking speed: a stride at a speed once walked begins with what was right there.

Kept are the settings under which strides lay within all targets, by speed in steps of ``STEP_MPS``; between two known
speeds they are interpolated, beyond them the nearest one's count as far as ``NEAR_MPS``. Each ground that a person has
named has a memory of its own; strides on stairs and slopes that nobody named are never kept, nor do they walk with what
was learnt.
"""

from collections import deque
from statistics import median
from typing import Final

from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.guardrails import between

STEP_MPS: Final = 0.1
NEAR_MPS: Final = 0.15
OTHER: Final = 0.12  # of the speed so far, and a step at least: another speed
NEWEST: Final = 3
KEPT: Final = 0.7  # weight of what was known against the newest stride's


class SpeedMemory:
    """Of one channel: the settings that were right at each speed."""

    def __init__(self) -> None:
        self._right: dict[int, BurstParameters] = {}
        self._newest_mps: deque[float] = deque(maxlen=NEWEST)
        self._walked_mps = 0.0

    def changed(self, speed_mps: float) -> bool:
        """Take in a stride's speed; whether the person now walks at another one."""
        self._newest_mps.append(speed_mps)
        now_mps = median(self._newest_mps)
        most_mps = max(OTHER * self._walked_mps, STEP_MPS)
        other = self._walked_mps > 0.0 and abs(now_mps - self._walked_mps) > most_mps
        if other or not self._walked_mps:
            self._walked_mps = now_mps
        return other

    def keep(self, parameters: BurstParameters) -> None:
        """These settings were right at the speed walked now, unless the newest stride was walked at another."""
        if abs(self._newest_mps[-1] - self._walked_mps) > max(OTHER * self._walked_mps, STEP_MPS):
            return
        key = round(self._walked_mps / STEP_MPS)
        self._right[key] = between(parameters, self._right.get(key, parameters), KEPT)

    def forget(self) -> None:
        """Something has changed that speed did not: what was right is so no longer."""
        self._right.clear()

    def remembered(self) -> BurstParameters | None:
        """The settings that are right at the speed walked now, None where nothing near was walked."""
        at = self._walked_mps / STEP_MPS
        below = max((key for key in self._right if key <= at), default=None)
        above = min((key for key in self._right if key >= at), default=None)
        if below is not None and above is not None:
            share = (at - below) / (above - below) if above > below else 0.0
            return between(self._right[below], self._right[above], share)
        near = below if above is None else above
        if near is None or abs(near - at) * STEP_MPS > NEAR_MPS:
            return None
        return self._right[near]
