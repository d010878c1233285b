"""What happened to a foot that from one stride to the next answers less than it did, although nothing was taken away.

The last two strides of every measure are held against the ten before, in standard deviations of these; what a lower
drive takes from the level is allowed for, and a fall that comes with a raise is the raise's own matter
(:class:`fes.stimulation.tuning.guardrails.HarmMonitor`). An electrode that lifts less lowers the foot in mid-swing and
at contact, so that the sum of both tells it long before either could; a sensor that has turned shows another pitch on
the same path, a leg that lifts less lowers the path alone.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from statistics import fmean, median, stdev
from typing import Final

from fes.signals import StrideResult
from fes.stimulation.tuning.targets import Reading

BEFORE: Final = 10
KNOWN: Final = 6  # of them, before anything can be told
LAST: Final = 2
TOGETHER: Final = 5.0  # standard deviations, of both measures …
AS_WELL: Final = 0.5  # … each by at least so many
ALONE: Final = 8.0
LEAST_SD: Final = 0.10  # of the band; strides that agree by chance do not make a measure exact
LEAST_SD_AT_CONTACT: Final = 0.03
SLOPE: Final = 0.8  # bands that a drive of 1 is worth at most: what was taken away explains so much of a fall
SLOPE_AT_CONTACT: Final = 0.3
RAISED: Final = 0.04  # of the drive's whole range, from one stride to the next
OTHER_SPEED: Final = 0.12

ELECTRODE: Final = "the electrodes or their lead: the foot is lifted less by the same stimulation"
MOUNTING: Final = "the sensor's mounting: the foot's pitch has changed and its path has not"
PERSON: Final = "the person: the leg lifts less, the foot's pitch is as before"

Seen = tuple[Mapping[str, float], Mapping[str, float]]  # a stride's levels, and the drives they have seen


class FaultWatch:
    """One channel's foot, stride by stride; ``most`` is the drive at the intensity's upper bound."""

    def __init__(self, most: float) -> None:
        self._most = most
        self._strides: deque[Seen] = deque(maxlen=BEFORE + LAST)
        self._speeds_mps: deque[float] = deque(maxlen=BEFORE)

    def stride(self, stride: StrideResult, reading: Reading, drives: Mapping[str, float]) -> str:
        """Take in a valid stride; what most likely happened, "" for nothing."""
        if self._speeds_mps:
            usual_mps = median(self._speeds_mps)
            if abs(stride.speed_mps - usual_mps) > OTHER_SPEED * usual_mps:
                self._strides.clear()
                self._speeds_mps.clear()
        self._speeds_mps.append(stride.speed_mps)
        self._strides.append((reading.levels, dict(drives)))
        before, last = list(self._strides)[:-LAST], list(self._strides)[-LAST:]
        fell = {}
        for measure in reading.measures:
            sds = self._fell_sds(measure.name, before, last, at_contact=measure.at_contact)
            if sds is not None:
                fell[measure.at_contact] = sds
        fault = _name(fell)
        if fault:
            for _ in before:
                self._strides.popleft()
        return fault

    def _fell_sds(self, name: str, before: Sequence[Seen], last: Sequence[Seen], *, at_contact: bool) -> float | None:
        """By how much the last strides lie below those before, in their standard deviations; None if unknown."""
        before = [seen for seen in before if name in seen[0]]
        if len(before) < KNOWN or any(name not in levels for levels, _ in last):
            return None
        if last[0][1][name] > before[-1][1][name] + RAISED * self._most:
            return None
        levels = [seen[0][name] for seen in before]
        usual, drive = median(levels), median(seen[1][name] for seen in before)
        slope, least = (SLOPE_AT_CONTACT, LEAST_SD_AT_CONTACT) if at_contact else (SLOPE, LEAST_SD)
        robust = 1.4826 * median(abs(level - usual) for level in levels)
        deviation = max(least, robust, 0.7 * stdev(levels))
        short = fmean(usual + slope * min(drives[name] - drive, 0.0) - at[name] for at, drives in last)
        return short / deviation


def _name(fell: Mapping[bool, float]) -> str:
    """What it most likely is, by what measured at contact (True) and in mid-swing (False) has fallen by."""
    if not fell:
        return ""
    least, most = min(fell.values()), max(fell.values())
    if len(fell) > 1 and least >= AS_WELL and sum(fell.values()) > TOGETHER:
        return ELECTRODE
    if most <= ALONE:
        return ""
    if len(fell) < 2:
        return ELECTRODE
    return MOUNTING if fell[True] > fell[False] else PERSON
