"""When will this heel rise? Learnt from a person's own strides, so that a burst may begin before the rise is seen.

The machine sees a heel rise some 25 ms late, and a burst still has to climb. Two things say beforehand that it comes:

- the time since contact: the heel rises when it has risen after the last contacts (their median);
- the foot: before T1 fires, its turn and its rate pass shares of T1's limits. One not passed yet takes as long from here
  as it usually took (median) from its passing to the heel rise, so the heel does not rise sooner than that.

The later of all of them is what is expected, anew at every sample. A mean weighted by their spreads was tried: what
passes early by chance then speaks as loud, and 6 of 100 starts were false where the later of all makes 1 in 1,000.

It says so by itself whether it may be used. Of every stance it notes how far off it was, used or not. One stance after
which no heel rose makes it begin anew. Pure, causal: its clock is the sensor's. The constants were chosen without the
person judged (``benchmarks/predicted_onset.py``, docs/phases.md).
"""

from collections import deque
from statistics import median
from typing import Final

from fes.signals import NS_PER_S
from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, PhaseChange, Transition

LEAD_NS: Final = 40_000_000  # a burst begins so long before the heel is expected to rise
FALSE_NS: Final = 150_000_000  # a start after which the heel does not rise for so long was false
NEAR_NS: Final = 60_000_000  # a heel rise so far from when it was expected was expected well
ONSET: Final = "onset"  # the source of the notes that say so
SHARES: Final = (0.125, 0.25, 0.5, 0.75)  # of T1's limits, that the foot's turn and rate pass
REMEMBERED, KNOWN_FROM = 10, 5  # heel rises
JUDGED, PROVEN_FROM, MAY_MISS = 20, 10, 1  # stances: so many of the last are judged, once there are so many
GAP_NS: Final = 40_000_000  # after a longer silence nobody knows what the foot has passed; the gate goes by the same


class OnsetPredictor:
    """Follows one foot; see the module.

    Attributes:
        expected_ns: when the heel is expected to rise, as this stance last told; None while nothing is known.
        began_ns: when a burst was to begin in this stance; None where it was not.
        used: whether it did begin; the controller says so.
        said: severity and text of what is to be noted; who reads them takes them away.
    """

    def __init__(self) -> None:
        self._ahead_ns: list[deque[int]] = [deque(maxlen=REMEMBERED) for _ in range(1 + 2 * len(SHARES))]
        self._usual_ns = [0.0] * len(self._ahead_ns)
        self._off_ns: deque[float] = deque(maxlen=JUDGED)
        self._contact_ns: int | None = None
        self._newest_ns = 0
        self.said: list[tuple[str, str]] = []
        self.in_use = False
        self.watching = False
        self._why_anew = ""
        self._new_stance()
        self._judge()

    def _new_stance(self) -> None:
        self._passed_ns: list[int | None] = [None] * len(self._ahead_ns)
        self.expected_ns: float | None = None
        self.began_ns: int | None = None
        self.used = self._false = False

    def on_phase(self, change: PhaseChange, permitted: bool) -> None:
        """Follow a phase change; ``permitted``: it may start a burst."""
        watched, self.watching = self.watching, False
        if change.transition is Transition.NONE:
            self._contact_ns = None
            self._begin_anew("data were lost")
        elif change.transition is Transition.T3:
            self._contact_ns = change.t_ns
        elif change.transition is Transition.T4 and self._contact_ns is not None:
            self.watching, self._newest_ns = True, change.t_ns
            self._new_stance()
            self._passed_ns[0] = self._contact_ns
        elif change.destination is Phase.STANCE:
            self._contact_ns = None
        elif change.transition is Transition.T1 and watched:
            self._risen(change.t_ns, permitted)

    def _risen(self, t_ns: int, permitted: bool) -> None:
        if self.expected_ns is not None and not self._false:
            self._off_ns.append(self.expected_ns - t_ns)
            if self.used and self.began_ns is not None:
                late_ms = 1e-6 * (t_ns - self.expected_ns)
                self.said.append(("info", f"began {1e-6 * (t_ns - self.began_ns):.0f} ms before the heel rose, "
                                          f"which came {abs(late_ms):.0f} ms {'later' if late_ms > 0 else 'sooner'} "
                                          "than expected"))  # fmt: skip
        if permitted:
            for ahead_ns, passed_ns in zip(self._ahead_ns, self._passed_ns, strict=True):
                ahead_ns.append(0 if passed_ns is None else t_ns - passed_ns)
            self._usual_ns = [median(ahead_ns) for ahead_ns in self._ahead_ns]
        self._judge()

    def _judge(self) -> None:
        missed = sum(abs(off_ns) > NEAR_NS for off_ns in self._off_ns)
        known, near = len(self._off_ns), f"{1e-6 * NEAR_NS:.0f} ms"
        if known < PROVEN_FROM:
            self._say(False, f"{self._why_anew}{known} of {PROVEN_FROM} heel rises have shown how well it is foreseen")
        elif missed > MAY_MISS:
            self._say(False, f"of the last {known} heel rises {missed} came more than {near} from when expected")
        else:
            self._say(True, f"of the last {known} heel rises {known - missed} came within {near} of when expected")

    def _say(self, in_use: bool, reason: str) -> None:
        self.reason = reason
        if in_use is not self.in_use:
            self.in_use = in_use
            self.said.append(("info", self.describe()))

    def _begin_anew(self, why: str) -> None:
        self._off_ns.clear()
        self._why_anew = f"{why}; since then "
        self._judge()

    def starts(self, t_ns: int, seen: Features, limits: Thresholds) -> bool:
        """Whether a burst is to begin at this sample: once a stance, whether it may be used or not."""
        if not self.watching or t_ns <= self._newest_ns:
            return False
        if t_ns - self._newest_ns > GAP_NS:
            self.watching = False
            return False
        self._newest_ns = t_ns
        rate_radps = limits.heel_rise_share * max(limits.push_off_radps, 0.5 * limits.fall_radps)
        turned, turns = seen.turned_rad / limits.heel_rise_rad, seen.toe_down_radps / rate_radps
        for at, share in enumerate(SHARES, start=1):
            for which, value in ((at, turned), (at + len(SHARES), turns)):
                if value < share:
                    self._passed_ns[which] = None
                elif self._passed_ns[which] is None:
                    self._passed_ns[which] = t_ns
        if self.began_ns is not None:
            if not self._false and t_ns - self.began_ns > FALSE_NS:
                self._false = True
                ms = f"{1e-6 * FALSE_NS:.0f} ms"
                if self.used:
                    self.said.append(("warning", f"began early, but no heel rose within {ms}: stopped"))
                self._begin_anew(f"no heel rose within {ms} of when a burst {'began' if self.used else 'would begin'}")
            return False
        if len(self._ahead_ns[0]) < KNOWN_FROM:
            return False
        self.expected_ns = max(
            (t_ns if passed_ns is None else self._contact_ns or t_ns) + usual_ns
            for which, (passed_ns, usual_ns) in enumerate(zip(self._passed_ns, self._usual_ns, strict=True))
            if which == 0 or passed_ns is None
        )
        if t_ns < self.expected_ns - LEAD_NS:
            return False
        self.began_ns = t_ns
        return True

    def describe(self) -> str:
        """For people, after the foot's name."""
        return f"onset is {'predicted' if self.in_use else 'detected, not predicted'}: {self.reason}"
