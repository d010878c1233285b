"""Does the machine see this foot's cycle? Asked of every swing that it found; until it does, no burst begins.

A sensor put on turned, an axis with the wrong sign, a foot that scrapes along the floor: the machine still finds
"swings", and each of them starts a burst. What gives them away is that too many of the last ones were none:

- the phases did not come as T1, T2, T3, T4;
- the stride around it has no length that can be true (it leads backward, or its ends cannot both be at rest), or it
  carried the foot less far than any walker's usual stride;
- from foot off to foot off it took a quarter more or less time than the last ones usually did: what walks is even.
  (Foot off, because a heel may rise early, be put down and rise again within one stance.) If it took as long as the one
  before, to a tenth, that is another speed. After a stop the rhythm is learnt anew;
- from foot off to foot flat it took much more time than the last ones usually did;
- what the sensor's strapdown solution leaves over at its end is not what it was in this walk (:class:`Closing`).

| state | what comes | next state |
|---|---|---|
| in order | ``POOR`` of the last ``LAST`` swings are none, or ``ALIKE`` end too late or close otherwise | in disorder |
| in disorder | ``AGAIN`` sound swings in a row | in order, and nothing before counts |

A swing is judged at the next heel rise, when its stride is known. One in which samples were missing is not judged, nor
one that held a stop, nor a heel that rose and was put back without a swing. Pure, causal; it only forbids. How soon it
speaks, and how often for nothing: ``benchmarks/safety/disorder.py``, ``live_lies.py``, docs/safety.md.
"""

from collections import Counter, deque
from typing import Final

import numpy as np

from fes.signals import NS_PER_S, FloatArray, StrideResult
from statemachine.phases import Phase, PhaseChange, Transition

LAST: Final = 6  # swings
POOR: Final = 4  # of them: a stumble, a turn on the spot and a first step are three
AGAIN: Final = 3
TRAVELS_M: Final = 0.1  # the shortest steady walkers (S07, S19 of the stroke walks) make 0.12 m and more in nine of ten
UNEVEN: Final = 0.25  # of the usual cycle: on a belt 99 of 100 cycles of the sound are within 0.1, a shuffle's half
EVEN: Final = 0.1  # of the cycle before
REMEMBERED, USUAL_FROM = 12, 3  # cycles
LONGER, LATER_NS = 1.5, NS_PER_S // 10  # times the usual swing, and more: that long, and its end was not seen
GROWS_NS: Final = NS_PER_S // 50  # a stride, at most, is what is usual: a lie must not become so soon
STOPPED: Final = 2.5  # usual cycles: a longer one holds a stop
CYCLE: Final = [Transition.T1, Transition.T2, Transition.T3, Transition.T4]
NOTED: Final = "phases"  # the source of the notes that say so
MISSING: Final = "samples missing"  # how a stride's reason begins that says nothing of the foot
NO_TRAVEL, NO_CYCLE, NO_RHYTHM = "did not travel", "skipped a phase", "came out of rhythm"
NO_END: Final = "ended late"
NO_CLOSE: Final = "do not come to rest as those before did, by what the sensor says"
MUCH: Final = 20.0  # m/s: more than anything leaves over
REMEDY: Final = "see that the sensor sits on this foot as it did at calibration"
NEW_WALK: Final = "; if it does and the walk has changed, pause and go on"


# --- a sensor that changes --------------------------------------------------------------------------------------------
# Chosen on the known half of the persons of benchmarks/safety/witness.py; judged by live_lies.py.
ALIKE: Final = 3  # strides that are off in the same sense
OFF: Final = 4.0  # standard deviations that each of them is off along it
FAR: Final = 4.0  # a stride so far off is none that shows order again
KNOWN_FROM, KNOWN = 10, 20  # strides that show how this walk closes
CLOSES_SD: Final = np.array((0.25, 0.23, 0.08, 0.026, 0.028))  # of a person's strides, the median of persons
WORTH: Final = 10  # strides that this is worth beside the person's own
CLIPPED: Final = 3.0  # of the median deviation, as a standard deviation: a stumble does not widen what is usual
_USED: Final = [0, 1, 2, 4, 5]  # velocity and tilt; the height tells of the ground as well


class Closing:
    """Whether strides still close as this walk's did: a sensor that begins to lie carries the solution elsewhere.

    What a sound sensor would have left over at a stride's end (:mod:`fes.estimation.closures`) differs by person, for
    no foot is quite at rest, but it scatters little. A stride is held against the median and scatter of those before.
    ``far``: the newest is far off; ``other``: so are ``ALIKE`` in a row, in the same sense.
    """

    def __init__(self) -> None:
        self._known: deque[FloatArray] = deque(maxlen=KNOWN)
        self._newest: deque[FloatArray] = deque(maxlen=ALIKE)
        self.far = self.other = False

    def on_stride(self, left_over: tuple[float, ...], *, learns: bool) -> None:
        """Take in what a stride left over; only while it ``learns`` it becomes part of what is usual, later."""
        if learns and len(self._newest) == ALIKE:
            self._known.append(self._newest[0])
        self._newest.append(np.clip(np.nan_to_num(np.array(left_over)[_USED], nan=MUCH), -MUCH, MUCH))
        self.far = self.other = False
        if len(self._known) < KNOWN_FROM:
            return
        known = np.array(self._known)
        usual = np.median(known, axis=0)
        off = known - usual
        most = CLIPPED * 1.4826 * np.median(np.abs(off), axis=0)
        off = np.clip(off, -most, most)
        weight = np.linalg.inv((off.T @ off + WORTH * np.diag(CLOSES_SD**2)) / (len(known) + WORTH))
        apart = np.array(self._newest) - usual
        self.far = bool(apart[-1] @ weight @ apart[-1] > FAR * FAR)
        sense = weight @ np.median(apart, axis=0)
        size = float(np.median(apart, axis=0) @ sense)
        self.other = len(apart) == ALIKE and bool(np.min(apart @ sense) > OFF * np.sqrt(size) > 0.0)


class OrderJudge:
    """Follows one foot's phases and strides and says whether they are a cycle.

    Args:
        least_m: a session that counts shorter strides than :data:`TRAVELS_M` as walking means them.
    """

    def __init__(self, least_m: float = TRAVELS_M) -> None:
        self._travels_m = min(TRAVELS_M, least_m)
        self._faults: deque[str] = deque(maxlen=LAST)  # of each of the last swings, "" for none
        self._cycles_ns: deque[int] = deque(maxlen=REMEMBERED)  # from foot off to foot off
        self._fired: list[Transition] = []  # since the heel rose; empty where that was not seen
        self._swings_ns: deque[int] = deque(maxlen=REMEMBERED)  # from foot off to foot flat
        self._swing_ns = self._late = 0  # of the newest; how many in a row ended late
        self._off_ns = 0  # of the newest swing; 0 before the first, after a gap, and with a heel put back between
        self._cycle_ns = 0  # that ended with it, 0 where it is not known
        self._stride: StrideResult | None = None
        self._closing = Closing()
        self.in_order = True
        self.reason = ""

    def on_stride(self, stride: StrideResult) -> None:
        """The stride around the newest swing; its heel rise comes before it and the next one after it."""
        self._stride = stride
        if stride.left_over and not stride.reason.startswith(MISSING):
            self._closing.on_stride(stride.left_over, learns=self.in_order)

    def begin_anew(self) -> None:
        """A person has armed, or gone on: of a foot in disorder what its strides are now counts, whatever they were."""
        if not self.in_order:
            self._closing, self._late = Closing(), 0
            self._swings_ns.clear()

    def on_phase(self, change: PhaseChange) -> None:
        """Follow a phase change; a heel rise may end or restore order."""
        if change.transition is Transition.NONE:
            self._fired, self._off_ns = [], 0
        elif change.transition is Transition.T1:
            if Transition.T2 in self._fired and not (self._stride and self._stride.reason.startswith(MISSING)):
                self._judge()
            self._fired, self._stride = [change.transition], None
        elif self._fired:
            self._fired.append(change.transition)
            if change.destination is Phase.STANCE and self._off_ns:
                self._swing_ns = change.t_ns - self._off_ns
            if change.transition is Transition.T5:
                self._off_ns = 0
            elif change.transition is Transition.T2:
                self._cycle_ns = change.t_ns - self._off_ns if self._off_ns else 0
                self._off_ns = change.t_ns

    def _judge(self) -> None:
        """The swing that the heel rise now has ended; what its stride carried weighs most, for it tells what to do."""
        stride, cycle_ns, usual_ns = self._stride, self._cycle_ns, 0
        if cycle_ns and len(self._cycles_ns) >= USUAL_FROM:
            usual_ns = sorted(self._cycles_ns)[len(self._cycles_ns) // 2]
        fault = ""
        if stride is None or not stride.valid or stride.stride_length_m < self._travels_m:
            fault = NO_TRAVEL
        elif self._fired != CYCLE:
            fault = NO_CYCLE
        elif usual_ns and cycle_ns > STOPPED * usual_ns:
            self._cycles_ns.clear()
            return
        elif usual_ns and abs(cycle_ns - usual_ns) > UNEVEN * usual_ns:
            before_ns = self._cycles_ns[-1]
            fault = NO_RHYTHM if abs(cycle_ns - before_ns) > EVEN * before_ns else ""
        if cycle_ns:
            self._cycles_ns.append(cycle_ns)
        swing_ns = self._swing_ns
        if len(self._swings_ns) >= USUAL_FROM:
            swing_usual_ns = sorted(self._swings_ns)[len(self._swings_ns) // 2]
            slower = max(cycle_ns / usual_ns, 1.0) if usual_ns else 1.0  # an end that is not seen lengthens no cycle
            late = usual_ns > 0 and swing_ns > LONGER * swing_usual_ns * slower + LATER_NS
            self._late = self._late + 1 if late else 0
            swing_ns = min(swing_ns, swing_usual_ns + max(GROWS_NS, int(swing_usual_ns * (slower - 1.0))))
        if self.in_order:  # what ends late in disorder is not to become usual
            self._swings_ns.append(swing_ns)
        else:
            fault = fault or (NO_END if self._late else NO_CLOSE if self._closing.far else "")
        self._faults.append(fault)
        poor = Counter(filter(None, self._faults))
        if self.in_order and (self._closing.other or self._late >= ALIKE):
            self.in_order = False
            self.reason = f"its last {ALIKE} strides {NO_CLOSE if self._closing.other else NO_END}"
            self._faults.clear()
        elif self.in_order and poor.total() >= POOR:
            self.in_order = False
            told = ", ".join(f"{count} {what}" for what, count in poor.most_common())
            self.reason = f"of its last {len(self._faults)} swings {told}"
        elif not self.in_order and len(self._faults) >= AGAIN and not any(list(self._faults)[-AGAIN:]):
            self.in_order, self.reason = True, ""
            self._faults.clear()

    def describe(self) -> str:
        """For people, after the foot's name."""
        if self.in_order:
            return "is in order"
        remedy = REMEDY + NEW_WALK * self.reason.endswith((NO_CLOSE, NO_END))
        return f"is in disorder: {self.reason}; no burst begins until {AGAIN} strides in a row are in order; {remedy}"
