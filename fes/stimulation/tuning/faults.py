"""What happened to a foot that from one stride to the next answers less than it did, whatever was changed meanwhile.

The last two strides are held against what the response identified before both expected under the drive that each has
seen: what a change of stimulation does is in that already, and what is left is no change's doing. An electrode that
lifts less lowers the foot in mid-swing and at contact, so that the sum of both tells it long before either could; a
sensor that has turned shows another pitch on the same path, a leg that lifts less lowers the path alone.
"""

import math
from collections import deque
from collections.abc import Mapping
from copy import deepcopy
from typing import Final

from fes.stimulation.tuning.response import ResponseModel
from fes.stimulation.tuning.targets import ROLL, Measure, Reading

KNOWN: Final = 8  # strides, before anything can be told
LAST: Final = 2
TOGETHER: Final = 4.0  # standard deviations of a stride, mean of the last ones, of both measures …
AS_WELL: Final = 0.5  # … each by at least so many, …
SHARE: Final = 0.125  # … and by so much of the other's: beside a great fall of the one, chance moves the other as well
ALONE: Final = 8.0
LEAST_SD: Final = 0.10  # of the band; strides that agree by chance do not make a measure exact
LEAST_SD_AT_CONTACT: Final = 0.03

ELECTRODE: Final = "the electrodes or their lead: the foot is lifted less by the same stimulation"
MOUNTING: Final = "the sensor's mounting: the foot's pitch has changed and its path has not"
PERSON: Final = "the person: the leg lifts less, the foot's pitch is as before"


class FaultWatch:
    """One channel's foot, stride by stride."""

    def __init__(self) -> None:
        self._earlier: deque[ResponseModel] = deque(maxlen=LAST)  # as they were before each of the last strides
        self._last: deque[tuple[Reading, Mapping[str, float]]] = deque(maxlen=LAST)

    def forget(self) -> None:
        """Another speed, or a fault that is named: begin anew."""
        self._earlier.clear()
        self._last.clear()

    @property
    def before(self) -> ResponseModel:
        """The response as it was before the strides that a fault was told by."""
        return self._earlier[0]

    @property
    def strides(self) -> tuple[tuple[Reading, Mapping[str, float]], ...]:
        """The strides that a fault was told by, and their drives."""
        return tuple(self._last)

    def stride(self, reading: Reading, drives: Mapping[str, float], model: ResponseModel) -> str:
        """Take in a valid stride, before ``model`` does; what most likely happened, "" for nothing."""
        self._earlier.append(deepcopy(model))
        self._last.append((reading, dict(drives)))
        if len(self._last) < LAST or self._earlier[0].strides < KNOWN:
            return ""
        fell = {}
        for measure in reading.measures:
            if (sds := self._fell_sds(measure)) is not None:
                fell[measure.at_contact] = sds
        return _name(fell)

    def _fell_sds(self, measure: Measure) -> float | None:
        """By how much the last strides lie below what was expected, in standard deviations; None if unknown."""
        model, name, short = self._earlier[0], measure.name, 0.0
        if name == ROLL or not model.knows(name):
            return None  # the foot's roll follows the other muscle as well
        least = LEAST_SD_AT_CONTACT if measure.at_contact else LEAST_SD
        for reading, drives in self._last:
            if name not in reading.levels:
                return None
            expected = model.expected(name, drives[name])
            deviation = math.hypot(max(model.noise(name), least), expected.sd)
            short += (expected.value - reading.levels[name]) / deviation
        return short / LAST


def _name(fell: Mapping[bool, float]) -> str:
    """What it most likely is, by what measured at contact (True) and in mid-swing (False) has fallen by."""
    if not fell:
        return ""
    least, most = min(fell.values()), max(fell.values())
    if len(fell) > 1 and least >= max(AS_WELL, SHARE * most) and sum(fell.values()) > TOGETHER:
        return ELECTRODE
    if most <= ALONE:
        return ""
    if len(fell) < 2:
        return ELECTRODE
    return MOUNTING if fell[True] > fell[False] else PERSON
