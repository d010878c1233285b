"""Whether the foot answers to stimulation at all: one whose electrode has come off must not be given ever more.

By the identified response: nearly all that the bound allows has been given over some strides, no target is
reached nor was before, and all that stimulation can be believed to lift the foot by is less than the weakest foot's
answer. A foot whose threshold lies above the session's setting answers to nothing below it, so it is searched for
upward first. A foot that has reached its targets answers; one that tires is given what the bound allows. It is lost
once it lies, though more is given than it needed then, among its strides without stimulation, or, where these are not
known, far below where it was; and, once a fault was found, where more since then did not lift it as it should have.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from operator import itemgetter
from statistics import median
from typing import Final, TypeAlias

from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.guardrails import at_most, drive_of
from fes.stimulation.tuning.response import ResponseModel
from fes.stimulation.tuning.targets import ROLL, Reading

SEARCHED: Final = 0.8  # of the bound: no threshold is looked for above
STRIDES: Final = 5  # below the target, so many of them in a row …
AT_LAST: Final = 3  # … and so many with nearly all that the bound allows
WEAKEST: Final = 0.5  # bands that nearly all of the bound lifts the weakest foot by
SDS: Final = 2.0
BARE: Final = 6  # strides without stimulation that are remembered
BARE_NEEDED: Final = 3
LIFTS: Final = 0.25  # bands above the strides with the least stimulation: such a foot answers, however little it may be
LOST_STRIDES: Final = 3
LOST: Final = 0.25  # of what stimulation lifted the foot by is left at most …
LIFTED: Final = 0.35  # … which was so many bands
FELL, FAR = 0.5, 0.6  # bands, in every measure: with the bound spent, and with more than when last reached
MORE: Final = 0.15  # of the bound: a loose electrode would have been made up for
NOW: Final = 5  # newest strides, held against those that a fault was told by
SHOULD: Final = 0.1  # bands that what was given since should have lifted the foot by, less a standard deviation …
ANSWERED: Final = 0.1  # … of which so much has to come
REACHED: Final = 3  # strides in a row within the targets: this foot answers, or needs nothing

_Stride: TypeAlias = tuple[Mapping[str, float], Mapping[str, float]]  # drives and levels
NO_ANSWER: Final = "the foot does not answer to stronger stimulation"
LIKE_NONE: Final = "the foot moves as it does without stimulation"


class AnswerMonitor:
    """Whether one channel's foot answers, stride by stride."""

    def __init__(self) -> None:
        # drive, settings and whether the bound was spent, since the targets were last reached
        self._run: deque[tuple[float, BurstParameters, bool]] = deque(maxlen=16)
        self._reached: deque[_Stride] = deque(maxlen=REACHED)  # that last reached the targets
        self._in_a_row = 0  # strides that reached them
        self._has_answered = False
        self._newest: deque[Mapping[str, float]] = deque(maxlen=LOST_STRIDES)
        self._bare: deque[Mapping[str, float]] = deque(maxlen=BARE)
        self._weakest: list[tuple[float, Mapping[str, float]]] = []  # the strides with the least drive
        self._before: ResponseModel | None = None  # the response before a fault …
        self._then: list[_Stride] = []  # … the strides that it was told by …
        self._now: deque[_Stride] = deque(maxlen=NOW)  # … and the newest since

    def forget(self) -> None:
        """A person is looking after it, or has: what was seen no longer holds, but for strides without stimulation."""
        self._run.clear()
        self._newest.clear()
        self._reached.clear()
        self._in_a_row, self._has_answered = 0, False
        self._weakest.clear()
        self._before = None

    def other_walk(self) -> None:
        """Another speed or ground: levels are not to be held against those reached before."""
        self._reached.clear()

    def fault(self, before: ResponseModel, strides: Iterable[tuple[Reading, Mapping[str, float]]]) -> None:
        """Something lowered the foot in these strides; ``before`` is how it answered then."""
        self._before = before
        self._then = [(drives, reading.levels) for reading, drives in strides]
        self._now.clear()

    def add_bare(self, reading: Reading | str) -> None:
        """A stride in which nothing was delivered; one that could not be read says nothing."""
        if not isinstance(reading, str):
            self._bare.append(reading.levels)

    def stride(
        self, reading: Reading, drives: Mapping[str, float], parameters: BurstParameters, model: ResponseModel,
        *, spent: bool,
    ) -> str:  # fmt: skip
        """Take in a valid stride that the model knows; says so when the foot does not answer.

        ``spent``: whether ``parameters``, under which it was walked, are at the intensity's upper bound.
        """
        drive = min(drives.values())
        self._newest.append(reading.levels)
        self._now.append((drives, reading.levels))
        self._weakest = sorted([*self._weakest, (drive, reading.levels)], key=itemgetter(0))[:BARE_NEEDED]
        if reading.level >= 0.0:
            self._run.clear()
            self._reached.append((drives, reading.levels))
            self._in_a_row += 1
            if self._in_a_row >= REACHED:
                self._has_answered, self._before = True, None
            return ""
        self._in_a_row = 0
        self._run.append((drive, parameters, spent))
        if (not self._has_answered and self._in_vain(reading, drives, model)) or self._in_vain_since_the_fault():
            return NO_ANSWER
        return LIKE_NONE if self._lost(reading.levels, drives) else ""

    def before(self, own: BurstParameters) -> BurstParameters:
        """The settings before the climb, the intensity at most the session's ``own``."""
        weakest = min((each for _, each, _ in self._run), key=lambda one: drive_of(one, own), default=own)
        return at_most(weakest, own)

    def _in_vain(self, reading: Reading, drives: Mapping[str, float], model: ResponseModel) -> bool:
        last = list(self._run)[-AT_LAST:]
        if len(self._run) < STRIDES or not (last[-1][2] or min(drive for drive, _, _ in last) >= SEARCHED):
            return False
        if any(model.expected(name, drives[name]).value >= 0.0 for name in reading.levels):
            return False  # this target is reached: the foot is being lifted
        if self._lifts(reading):
            return False
        gained = [model.gained(name, drives[name]) for name in reading.levels]
        if any(each.value > WEAKEST for each in gained):
            return False
        known = [each.value + SDS * each.sd <= WEAKEST for each in gained]
        if all(spent for _, _, spent in last):
            return any(known)  # nothing is left to give; who is known best says it, a toe's height scatters for long
        return all(known) and all(each.value - SDS * each.sd <= 0.0 for each in gained)  # who answers may with more

    def _in_vain_since_the_fault(self) -> bool:
        """Whether in no measure a fair part has come of what the response before the fault lets expect of it."""
        if self._before is None or len(self._now) < NOW:
            return False
        answered, then, now = [], self._then, self._now
        for name in then[0][1]:
            missing = any(name not in levels for _, levels in (*then, *now))
            if name == ROLL or missing or not self._before.knows(name):
                continue
            lift = median(levels[name] for _, levels in now) - min(levels[name] for _, levels in then)
            drive = [median(drives[name] for drives, _ in part) for part in (then, now)]
            slope = self._before.slope(name)
            should = self._before.expected(name, drive[1]).value - self._before.expected(name, drive[0]).value
            should *= max(1.0 - slope.sd / max(abs(slope.value), 1e-6), 0.0)
            if should > SHOULD and drive[1] >= drive[0] + MORE:
                answered.append(lift > ANSWERED * should)
        return bool(answered) and not any(answered)

    def _lifts(self, reading: Reading) -> bool:
        """Whether the newest strides lie above those with the least stimulation, or none, in any measure."""
        for name in reading.levels:
            least = self._without(name)
            weakest = [levels[name] for _, levels in self._weakest if name in levels]
            least = median(weakest) if least is None and weakest else least
            newest = [levels[name] for levels in self._newest if name in levels]
            if least is not None and newest and median(newest) - least > LIFTS:
                return True
        return False

    def _lost(self, levels: Mapping[str, float], drives: Mapping[str, float]) -> bool:
        """Whether the newest strides lie where those without stimulation did, or, of a foot whose bound is spent, far
        below where it was in every measure, though no less is given than when the targets were last reached."""
        all_given = [spent for _, _, spent in list(self._run)[-LOST_STRIDES:]].count(True) == LOST_STRIDES
        fell = []
        for name in levels:
            newest = [levels[name] for levels in self._newest if name in levels]
            reached = [(levels[name], drives[name]) for drives, levels in self._reached if name in levels]
            if len(reached) < REACHED or len(newest) < LOST_STRIDES:
                fell.append(False)
                continue
            level, drive = (median(each) for each in zip(*reached, strict=True))
            bare, more = self._without(name), drives[name] >= drive + MORE
            if bare is None:
                fell.append(level - max(newest) > (FELL if all_given else FAR) and (more or all_given))
            elif level - bare >= LIFTED and max(newest) - bare < LOST * (level - bare) and (more or all_given):
                return True
        return bool(fell) and all(fell)

    def _without(self, name: str) -> float | None:
        """The level without stimulation; None where too little was seen of it."""
        levels = [levels[name] for levels in self._bare if name in levels]
        return median(levels) if len(levels) >= BARE_NEEDED else None
