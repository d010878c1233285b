"""What happened to a foot that answers less than it did, or otherwise: watched and named, never acted upon.

The last strides are held against earlier ones: by the foot's own answer, with which share of the drive of now would it
have stood then where it stands now? An electrode or lead that has slipped shows a share that fell at once and stays
low, one that dries or slides a share that falls over twenty strides. A calf in spasm gives the foot free again after
some strides, and is not named. A muscle that tires is the dose ledger's to notice, a sensor that moves its monitor's.
"""

from collections import deque
from statistics import median
from typing import Final, NamedTuple

from fes.config import Channel
from fes.stimulation.tuning.report import Seen
from fes.stimulation.tuning.settings import OWN, RuleSettings
from fes.stimulation.tuning.targets import ROLL, bands_per_drive, drives_of

SLIPPED: Final = "the electrodes or their lead: the foot is lifted less by the same stimulation"
DRIFTED: Final = "the electrodes, drying or sliding, or the muscle, tiring: the foot is lifted less and less"


class _Stride(NamedTuple):
    speed_mps: float
    seen: dict[str, tuple[float, float]]  # by measure: drive and level
    at_contact: dict[str, bool]


class FaultWatch:
    """One channel's foot."""

    def __init__(self, channel: Channel, settings: RuleSettings = OWN) -> None:
        self._channel, self._own = channel, settings
        self._strides: deque[_Stride] = deque(maxlen=settings.drift_lag + settings.earlier + 1)
        self._first: dict[str, list[tuple[float, float]]] = {}  # the climb tells how the foot answers
        self._doubts = ""

    def stride(self, seen: Seen) -> str:
        """Take in a stride; what most likely happened, "" for nothing."""
        if seen.reading is None or seen.skipped:
            return ""
        front, tail = drives_of(seen.given, self._channel)
        levels = {
            measure.name: (seen.intensity * (tail if measure.at_contact else front), measure.level)
            for measure in seen.reading.measures if measure.name != ROLL  # which is the other muscle's as well
        }  # fmt: skip
        self._strides.append(
            _Stride(seen.stride.speed_mps, levels, {m.name: m.at_contact for m in seen.reading.measures})
        )
        for name, pair in levels.items():
            first = self._first.setdefault(name, [])
            if len(first) < self._own.climb:
                first.append(pair)
        found = self._named()
        doubts, self._doubts = self._doubts, found  # what is named is seen twice
        if not found or found != doubts:
            return ""
        self._strides.clear()
        self._doubts = ""
        return found

    def _named(self) -> str:
        sudden, slow = self._lost(self._own.newest), self._lost(self._own.drift_lag)
        if sudden is None:
            return ""
        if sudden.share < self._own.slipped and sudden.stays:
            return SLIPPED
        return DRIFTED if slow is not None and slow.share < self._own.slipped and slow.stays else ""

    def _falls(self, lag: int, count: int) -> "list[_Fall]":
        """Of each measure, by how much the last strides lie below those that ended ``lag`` strides ago."""
        own, strides = self._own, list(self._strides)
        newest, then = strides[-count:], strides[-lag - own.earlier : -lag]
        usual_mps = median(each.speed_mps for each in newest)
        then = [each for each in then if abs(each.speed_mps - usual_mps) <= own.same_speed * usual_mps]
        falls = []
        for name, at_contact in strides[-1].at_contact.items():
            before = [each.seen[name] for each in then if name in each.seen]
            after = [each.seen[name] for each in newest if name in each.seen]
            if len(before) < own.enough or len(after) < count:
                continue
            slope = bands_per_drive(self._first[name], own)
            bare = [level - slope * drive for drive, level in before]
            usual = median(bare)
            least = own.least_sd_at_contact if at_contact else own.least_sd
            sd = max(1.4826 * median(abs(each - usual) for each in bare), least)
            drive = median(drive for drive, _ in after)
            falls.append(_Fall(at_contact, slope * drive, sd, [usual + slope * d - at for d, at in after]))
        return falls

    def _lost(self, lag: int) -> "_Lost | None":
        own = self._own
        if len(self._strides) < lag + own.enough:
            return None
        falls = [fall for fall in self._falls(lag, own.newest) if fall.all_of_it > own.little]
        if not falls:
            return None
        weight = sum((fall.all_of_it / fall.sd) ** 2 for fall in falls)
        lost = sum(median(fall.by) * fall.all_of_it / fall.sd**2 for fall in falls) / weight
        lead = max(falls, key=lambda fall: fall.all_of_it / fall.sd)
        stays = sorted(lead.by)[1] > own.stays * (1.0 - own.slipped) * lead.all_of_it
        return _Lost(1.0 - lost, stays)


class _Fall(NamedTuple):
    at_contact: bool
    all_of_it: float  # level by which the drive of now is believed to lift
    sd: float
    by: list[float]


class _Lost(NamedTuple):
    share: float
    stays: bool
