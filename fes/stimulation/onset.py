"""When will this heel rise? Learnt from a person's own strides, so that a burst may begin before the rise is seen.

The machine sees a heel rise some 25 ms late, and a burst still has to climb. Two things say beforehand that it comes:

- the time since contact: the heel rises when it has risen after the last contacts (their median);
- the foot: before T1 fires, its turn and its rate pass shares of T1's limits. Where one is not passed yet, the heel
  does not rise sooner than it usually did (median) after that was passed.

The latest of all these is what is expected, anew at every sample. It says itself whether it may be used: it notes of
every stance how far off it was, used or not, and a stance in which no heel rose makes it begin anew. Pure, causal; its
clock is the sensor's. ``benchmarks/loop/predicted_onset.py`` judges each person with a lead that the others chose; the
other constants were set with all of them in view.
"""

from collections import deque
from statistics import median
from typing import Final

from statemachine.phases import PhaseChange, Transition

MS: Final = 1_000_000  # ns
LEAD_NS: Final = 40 * MS  # a burst begins so long before the heel is expected to rise
FALSE_NS: Final = 150 * MS  # a start after which the heel does not rise for so long was false
NEAR_NS: Final = 60 * MS  # a heel rise no further than this from when it was expected was foreseen
SHARES: Final = (0.125, 0.25, 0.5, 0.75)  # of T1's limits, that the foot's turn and rate pass
REMEMBERED, KNOWN_FROM = 10, 5  # heel rises
JUDGED, PROVEN_FROM, MAY_MISS = 20, 10, 1  # stances: so many of the last are judged, once there are so many
GAP_NS: Final = 40 * MS  # after a longer silence nobody knows what the foot has passed; the gate goes by the same
ONSET, EACH_ONSET = "onset", "onsets"  # the sources of the notes: what changes, and each stride's


class OnsetPredictor:
    """Follows one foot.

    Args:
        lead_ns: a burst begins so long before the heel is expected to rise.

    Attributes:
        expected_ns: when the heel is expected to rise, or was in this stride; None while nothing is known.
        began_ns: when a burst was to begin for it; None where it was not.
        came_ns: when the heel rose; None as long as it has not.
        used: whether the burst did begin; the controller says so.
        in_use: whether what is expected may be used.
        watching: whether the foot stands, and the heel may rise.
        said: severity, source and text of what is to be noted; who reads them takes them away.
    """

    def __init__(self, lead_ns: int = LEAD_NS) -> None:
        self._lead_ns = lead_ns
        self._ahead_ns: list[deque[int]] = [deque(maxlen=REMEMBERED) for _ in range(1 + 2 * len(SHARES))]
        self._usual_ns = [0.0] * len(self._ahead_ns)
        self._off_ns: deque[float] = deque(maxlen=JUDGED)
        self._contact_ns = self._newest_ns = 0
        self._why_anew = ""
        self.said: list[tuple[str, str, str]] = []
        self.in_use = self.watching = False
        self._new_stance()
        self._judge()

    def _new_stance(self) -> None:
        self._passed_ns: list[int | None] = [self._contact_ns] + [None] * (2 * len(SHARES))
        self.expected_ns: float | None = None
        self.began_ns: int | None = None
        self.came_ns: int | None = None
        self.used = self._false = False

    def on_phase(self, change: PhaseChange, permitted: bool) -> None:
        """Follow a phase change; ``permitted``: it may start a burst."""
        stood, self.watching = self.watching, False
        if change.transition is Transition.NONE:
            self._begin_anew("data were lost")
        elif change.transition is Transition.T3:
            self._contact_ns = change.t_ns
        elif change.transition is Transition.T4:
            self.watching, self._newest_ns = True, change.t_ns
            self._new_stance()
        elif change.transition is Transition.T1 and stood:
            self._risen(change.t_ns, permitted)

    def _risen(self, t_ns: int, permitted: bool) -> None:
        self.came_ns = t_ns
        if self.expected_ns is not None and not self._false:
            off_ns = self.expected_ns - t_ns
            self._off_ns.append(off_ns)
            if self.used and self.began_ns is not None:
                before, off = (t_ns - self.began_ns) / MS, abs(off_ns) / MS
                came = f"T1 came {off:.0f} ms {'sooner' if off_ns > 0 else 'later'} than expected"
                self.said.append(("info", EACH_ONSET, f"{came}, {before:.0f} ms after the burst was asked for"))
        if permitted:
            for ahead_ns, passed_ns in zip(self._ahead_ns, self._passed_ns, strict=True):
                ahead_ns.append(0 if passed_ns is None else t_ns - passed_ns)
            self._usual_ns = [median(ahead_ns) for ahead_ns in self._ahead_ns]
        self._judge()

    def starts(self, t_ns: int, turned: float, turns: float, now_ns: int | None = None) -> bool:
        """Whether a burst is to begin at this sample of stance: once a stance, whether it may be used or not.

        Args:
            t_ns: when the sample was measured.
            now_ns: what time it is, where that is later.
            turned: how far the foot has turned toe-down since it stood still, as a share of T1's limit.
            turns: how fast it turns so, likewise.
        """
        if not self.watching or t_ns <= self._newest_ns:
            return False
        if t_ns - self._newest_ns > GAP_NS:
            self.watching = False
            return False
        self._newest_ns = t_ns
        self._pass(t_ns, turned, turns)
        if self.began_ns is not None:
            if not self._false and t_ns - self.began_ns > FALSE_NS:
                self._false_start()
            return False
        if len(self._ahead_ns[0]) < KNOWN_FROM:
            return False
        yet_ns = [usual_ns for usual_ns, passed in zip(self._usual_ns, self._passed_ns, strict=True) if passed is None]
        self.expected_ns = max(self._contact_ns + self._usual_ns[0], t_ns + max(yet_ns, default=0.0))
        return self.reached(t_ns if now_ns is None else now_ns)

    def reached(self, now_ns: int) -> bool:
        """Whether the time for a burst has come by now, for all that the newest sample has shown; once a stance."""
        if not self.watching or self.began_ns is not None or self.expected_ns is None:
            return False
        if now_ns < self.expected_ns - self._lead_ns:
            return False
        self.began_ns = now_ns
        return True

    def _pass(self, t_ns: int, turned: float, turns: float) -> None:
        """Note what of T1's limits the foot has passed; what it falls below again it has not."""
        for which, value in enumerate([turned] * len(SHARES) + [turns] * len(SHARES)):
            if value < SHARES[which % len(SHARES)]:
                self._passed_ns[1 + which] = None
            elif self._passed_ns[1 + which] is None:
                self._passed_ns[1 + which] = t_ns

    def _false_start(self) -> None:
        self._false = True
        ms = f"{FALSE_NS // MS} ms"
        if self.used:
            self.said.append(("warning", ONSET, f"a burst was asked for early, but no heel rose within {ms}: stopped"))
        self._begin_anew(
            f"no heel rose within {ms} of when a burst {'was' if self.used else 'would have been'} asked for"
        )

    def _begin_anew(self, why: str) -> None:
        self._off_ns.clear()
        self._why_anew = f"{why}; since then "
        self._judge()

    def _judge(self) -> None:
        """Whether the last stances allow it to be used: 5–95 % of them were foreseen."""
        known, missed = len(self._off_ns), sum(abs(off_ns) > NEAR_NS for off_ns in self._off_ns)
        if known < PROVEN_FROM:
            self.reason = f"{self._why_anew}{known} of {PROVEN_FROM} heel rises have shown how well they are foreseen"
        else:
            near = f"came within {NEAR_NS // MS} ms of when they were expected"
            self.reason = f"{known - missed} of the last {known} heel rises {near}"
        in_use, self.in_use = self.in_use, known >= PROVEN_FROM and missed <= MAY_MISS
        if self.in_use is not in_use:
            self.said.append(("info", ONSET, self.describe()))

    def describe(self) -> str:
        """For people, after the foot's name."""
        return f"onset is {'predicted' if self.in_use else 'detected, not predicted'}: {self.reason}"
