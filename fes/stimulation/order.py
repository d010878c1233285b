"""Does the machine see this foot's cycle? Asked of every swing that it found; until it does, no burst begins.

A sensor put on turned, an axis with the wrong sign, a foot that scrapes along the floor: the machine still finds
"swings", and each of them starts a burst. What gives them away is that too many of the last ones were none:

- the phases did not come as T1, T2, T3, T4;
- the stride around it has no length that can be true (it leads backward, or its ends cannot both be at rest), or it
  carried the foot less far than any walker's usual stride;
- from foot off to foot off it took a quarter more or less time than the last ones usually did: what walks is even.
  (Foot off, because a heel may rise early, be put down and rise again within one stance.) If it took as long as the one
  before, to a tenth, that is another speed. After a stop the rhythm is learnt anew.

| state | what comes | next state |
|---|---|---|
| in order | ``POOR`` of the last ``LAST`` swings are none | in disorder |
| in disorder | ``AGAIN`` sound swings in a row | in order, and nothing before counts |

A swing is judged at the next heel rise, when its stride is known. One in which samples were missing is not judged, nor
one that held a stop, nor a heel that rose and was put back without a swing. Pure, causal; it only forbids. How soon it
speaks, and how often for nothing: ``benchmarks/safety/disorder.py``, docs/safety.md.
"""

from collections import Counter, deque
from typing import Final

from fes.signals import StrideResult
from statemachine.phases import PhaseChange, Transition

LAST: Final = 6  # swings
POOR: Final = 4  # of them: a stumble, a turn on the spot and a first step are three
AGAIN: Final = 3
TRAVELS_M: Final = 0.1  # the shortest steady walkers (S07, S19 of the stroke walks) make 0.12 m and more in nine of ten
UNEVEN: Final = 0.25  # of the usual cycle: on a belt 99 of 100 cycles of the sound are within 0.1, a shuffle's half
EVEN: Final = 0.1  # of the cycle before
REMEMBERED, USUAL_FROM = 12, 3  # cycles
STOPPED: Final = 2.5  # usual cycles: a longer one holds a stop
CYCLE: Final = [Transition.T1, Transition.T2, Transition.T3, Transition.T4]
NOTED: Final = "phases"  # the source of the notes that say so
MISSING: Final = "samples missing"  # how a stride's reason begins that says nothing of the foot
NO_TRAVEL, NO_CYCLE, NO_RHYTHM = "did not travel", "skipped a phase", "came out of rhythm"
REMEDY: Final = "see that the sensor sits on this foot as it did at calibration"


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
        self._off_ns = 0  # of the newest swing; 0 before the first, after a gap, and with a heel put back between
        self._cycle_ns = 0  # that ended with it, 0 where it is not known
        self._stride: StrideResult | None = None
        self.in_order = True
        self.reason = ""

    def on_stride(self, stride: StrideResult) -> None:
        """The stride around the newest swing; its heel rise comes before it and the next one after it."""
        self._stride = stride

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
        self._faults.append(fault)
        poor = Counter(filter(None, self._faults))
        if self.in_order and poor.total() >= POOR:
            self.in_order = False
            told = ", ".join(f"{count} {what}" for what, count in poor.most_common())
            self.reason = f"of its last {len(self._faults)} swings {told}"
        elif not self.in_order and not any(list(self._faults)[-AGAIN:]):
            self.in_order, self.reason = True, ""
            self._faults.clear()

    def describe(self) -> str:
        """For people, after the foot's name."""
        if self.in_order:
            return "is in order"
        return f"is in disorder: {self.reason}; no burst begins until {AGAIN} strides in a row are in order; {REMEDY}"
