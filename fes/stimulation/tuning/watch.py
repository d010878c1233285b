"""What happened to a foot that answers less than it did, or otherwise: watched and named, never acted upon.

The last strides are held against earlier ones: by the foot's own answer, with which share of the drive of now would it
have stood then where it stands now? An electrode or lead that has slipped shows a share that fell at once and stays
low, one that dries or slides a share that falls over twenty strides. A calf in spasm gives the foot free again after
some strides, and is not named. A muscle that tires is the dose ledger's to notice, a sensor that moves its monitor's.
"""

from collections import deque
from statistics import median
from typing import Final

from fes.config import Channel
from fes.stimulation.tuning.report import Seen
from fes.stimulation.tuning.settings import OWN, RuleSettings
from fes.stimulation.tuning.targets import ROLL, bands_per_drive, drives_of

SLIPPED: Final = "the electrodes or their lead: the foot is lifted less by the same stimulation"
DRIFTED: Final = "the electrodes, drying or sliding, or the muscle, tiring: the foot is lifted less and less"
Answers = dict[str, tuple[float, float]]


class FaultWatch:
    """One channel's foot."""

    def __init__(self, channel: Channel, settings: RuleSettings = OWN) -> None:
        self._channel, self._own = channel, settings
        # of each stride its speed, and by measure the drive and the level
        self._strides: deque[tuple[float, Answers]] = deque(maxlen=settings.drift_lag + settings.earlier + 1)
        self._first: dict[str, list[tuple[float, float]]] = {}  # these tell how the foot answers
        self._doubts = ""

    def stride(self, seen: Seen) -> str:
        """Take in a stride; what most likely happened, "" for nothing."""
        if seen.reading is None or seen.skipped:
            return ""
        drives = drives_of(seen.given, self._channel)
        answers = {
            measure.name: (seen.intensity * drives.behind(measure), measure.level)
            for measure in seen.reading.measures if measure.name != ROLL  # which is the other muscle's as well
        }  # fmt: skip
        self._strides.append((seen.stride.speed_mps, answers))
        for name, answer in answers.items():
            if len(first := self._first.setdefault(name, [])) < self._own.answers:
                first.append(answer)
        found = SLIPPED if self._lost(self._own.newest) else DRIFTED if self._lost(self._own.drift_lag) else ""
        doubts, self._doubts = self._doubts, found  # what is named is seen twice
        if not found or found != doubts:
            return ""
        self._strides.clear()
        self._doubts = ""
        return found

    def _lost(self, lag: int) -> bool:
        """Whether the last strides show less of the drive than those that ended ``lag`` strides ago, all but one."""
        own, strides = self._own, list(self._strides)
        newest, then = strides[-own.newest :], strides[-lag - own.earlier : -lag]
        if len(strides) < lag + own.enough:
            return False
        usual_mps = median(speed_mps for speed_mps, _ in newest)
        then = [each for each in then if abs(each[0] - usual_mps) <= own.same_speed * usual_mps]
        lost = weights = surest = 0.0
        stays = False
        for name in strides[-1][1]:
            before = [answers[name] for _, answers in then if name in answers]
            after = [answers[name] for _, answers in newest if name in answers]
            slope = max(bands_per_drive(self._first[name], own), own.flattest)
            lifted = slope * median(drive for drive, _ in after)  # level by which the drive of now is believed to lift
            if len(before) < own.enough or len(after) < own.newest or lifted <= 0.0:
                continue
            bare = [level - slope * drive for drive, level in before]
            usual = median(bare)
            sd = max(1.4826 * median(abs(each - usual) for each in bare), own.least_sd)
            falls = sorted(usual + slope * drive - level for drive, level in after)
            lost, weights = lost + median(falls) * lifted / sd**2, weights + (lifted / sd) ** 2
            if lifted / sd > surest:
                surest, stays = lifted / sd, falls[1] > own.stays * (1.0 - own.slipped) * lifted
        return stays and 1.0 - lost / weights < own.slipped
