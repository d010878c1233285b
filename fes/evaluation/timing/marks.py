"""Marks: one moment of one kind of one foot or channel; expected and found ones paired, and how far they are apart.

Expected and found marks of the same kind are paired one to one, nearest first, at most ``WINDOW_MS`` or 1.5 times the
tolerance apart. An expected mark without a partner is missed, a found one without is extra.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from fes.evaluation.agreement import differences
from fes.signals import NS_PER_S, FloatArray, IntArray, StimCommand, StimRequest
from fes.simulation.truth import Truth
from fes.walk_record import finite_or_none
from statemachine.phases import Phase, PhaseChange, Transition

WINDOW_MS: Final = 300.0
# What a sweep allows against a physical truth (heel 5 mm up, toe-off, contact, sole flat), either way. A sensor shows
# contact and toe-off at once; a heel that rises slowly, and a sole that is flat but still rocks, show later.
TRUTH_TOLERANCE_MS: Final = {"T1": 250.0, "T2": 60.0, "T3": 60.0, "T4": 250.0, "T5": 250.0, "T6": 250.0}
EDGES: Final = ("on", "off")
_MS: Final = 1e-6
Burst = tuple[int, int]  # from when on to when off, ns


@dataclass(frozen=True, slots=True, order=True)
class Mark:
    """One moment: ``who`` is a foot or a channel, ``what`` T1–T6, on or off."""

    t_ns: int
    who: str
    what: str


@dataclass(frozen=True, slots=True)
class Spread:
    """How one kind of mark lies against what was expected: counts, and errors (found − expected, ms) of the pairs.

    ``lower_ms`` and ``upper_ms`` are the 95 % limits, bias ± 1.96 SD; NaN where there are too few pairs.
    """

    who: str
    what: str
    expected: int
    found: int
    missed: int
    extra: int
    bias_ms: float
    sd_ms: float
    lower_ms: float
    upper_ms: float


@dataclass(frozen=True, slots=True, eq=False)
class TimingRow:
    """One kind of mark: ``pairs_ns`` (P, 2) expected and found, ``missed_ns`` and ``extra_ns`` what has no partner."""

    who: str
    what: str
    pairs_ns: IntArray
    missed_ns: IntArray
    extra_ns: IntArray
    tolerance_ms: float

    @property
    def error_ms(self) -> FloatArray:
        """Found − expected of the pairs (P,)."""
        return np.asarray(_MS * (self.pairs_ns[:, 1] - self.pairs_ns[:, 0]))

    @property
    def moved(self) -> int:
        """How many pairs are further apart than the tolerance."""
        return int((np.abs(self.error_ms) > self.tolerance_ms).sum())

    @property
    def spread(self) -> Spread:
        """Counts, bias, spread and limits."""
        pairs, missed, extra = len(self.pairs_ns), len(self.missed_ns), len(self.extra_ns)
        error = differences(np.zeros(pairs), self.error_ms)
        limits = error.lower_limit.value, error.upper_limit.value
        counts = pairs + missed, pairs + extra, missed, extra
        return Spread(self.who, self.what, *counts, error.bias.value, error.sd, *limits)

    def to_json(self) -> dict[str, Any]:
        """Plain values; times in s."""
        spread = {item: getattr(self.spread, item) for item in Spread.__slots__}
        times = {"missed_s": (1e-9 * self.missed_ns).tolist(), "extra_s": (1e-9 * self.extra_ns).tolist()}
        most = float(np.abs(self.error_ms).max()) if len(self.pairs_ns) else float("nan")
        moved = {"moved": self.moved, "worst_ms": most, "tolerance_ms": self.tolerance_ms}
        plain: dict[str, Any] = finite_or_none(spread | moved | times)
        return plain


def marks_of_phases(phases: Iterable[PhaseChange]) -> list[Mark]:
    """The transitions that fired; beginning anew after a silence is none."""
    return [Mark(each.t_ns, each.foot, each.transition.name) for each in phases if each.transition != Transition.NONE]


def marks_of_commands(commands: Iterable[StimCommand]) -> list[Mark]:
    """Where each channel was switched on and off."""
    marks, is_on = [], dict[int, bool]()
    for each in commands:
        if each.on != is_on.get(each.channel, False):
            marks.append(Mark(each.t_ns, f"channel {each.channel}", "on" if each.on else "off"))
        is_on[each.channel] = each.on
    return marks


def bursts_of(asked: Iterable[tuple[int, StimRequest | StimCommand]]) -> dict[int, list[Burst]]:
    """From when on to when off each channel was asked to be on, by channel number, from requests by time (ns)."""
    since: dict[int, int] = {}
    found: dict[int, list[Burst]] = {}
    last_ns = 0
    for t_ns, each in asked:
        last_ns = t_ns
        if each.on:
            since.setdefault(each.channel, t_ns)
        elif each.channel in since:
            found.setdefault(each.channel, []).append((since.pop(each.channel), t_ns))
    for channel, begin_ns in since.items():
        found.setdefault(channel, []).append((begin_ns, last_ns))
    return found


def heel_lifts(t_ns: IntArray, phase: IntArray, foot: str) -> list[Mark]:
    """T1 and T5 of heels lifted and put back, from a truth's series of phases, both (N,)."""
    change = np.flatnonzero(np.diff(phase)) + 1
    marks = []
    for k, at in enumerate(change[:-1].tolist()):
        until = int(change[k + 1])
        if (phase[at - 1], phase[at], phase[until]) == (Phase.STANCE, Phase.PRE_SWING, Phase.STANCE):
            marks += [Mark(int(t_ns[at]), foot, "T1"), Mark(int(t_ns[until]), foot, "T5")]
    return marks


def pair_times(expected_ns: IntArray, found_ns: IntArray, window_ns: float) -> list[tuple[int, int]]:
    """Indices (expected, found) of the pairs, nearest first, each used once; both (N,) and (M,) sorted."""
    low = np.searchsorted(found_ns, expected_ns - int(window_ns), side="left")
    high = np.searchsorted(found_ns, expected_ns + int(window_ns), side="right")
    near = [(i, j) for i in range(len(expected_ns)) for j in range(int(low[i]), int(high[i]))]
    near.sort(key=lambda ij: (abs(int(found_ns[ij[1]]) - int(expected_ns[ij[0]])), ij))
    pairs, used_expected, used_found = [], set[int](), set[int]()
    for i, j in near:
        if i not in used_expected and j not in used_found:
            used_expected.add(i)
            used_found.add(j)
            pairs.append((i, j))
    return sorted(pairs)


def timing_rows(
    expected: Sequence[Mark], found: Sequence[Mark], tolerance_ms: Mapping[str, float], optional: Collection[Mark] = ()
) -> tuple[TimingRow, ...]:
    """A row for each kind of mark that is expected or found, by name; no tolerance for a kind: none is too far.

    ``optional``: expected marks that are not missed where they have no partner.
    """
    rows = []
    for who, what in sorted({(mark.who, mark.what) for mark in (*expected, *found)}):
        most_ms = tolerance_ms.get(what, float("inf"))
        should, did = (
            np.array(sorted(mark.t_ns for mark in marks if (mark.who, mark.what) == (who, what)), np.int64)
            for marks in (expected, found)
        )
        reach_ms = WINDOW_MS if most_ms == float("inf") else max(WINDOW_MS, 1.5 * most_ms)
        pairs = np.array(pair_times(should, did, reach_ms / _MS), np.int64).reshape(-1, 2)
        missed, extra = np.delete(should, pairs[:, 0]), np.delete(did, pairs[:, 1])
        may_lack = [mark.t_ns for mark in optional if (mark.who, mark.what) == (who, what)]
        both = np.column_stack([should[pairs[:, 0]], did[pairs[:, 1]]])
        rows.append(TimingRow(who, what, both, missed[~np.isin(missed, may_lack)], extra, most_ms))
    return tuple(rows)


def marks_of_truth(truth: Truth, feet: set[str]) -> list[Mark]:
    """The transitions that these feet really made; a soft contact, which no sensor sees, ends by T6."""
    marks = []
    for stride in truth.strides:
        if stride.foot not in feet:
            continue
        times_s = {"T1": stride.t_pre_swing_s, "T2": stride.t_swing_s}
        if stride.loading_detectable:
            times_s |= {"T3": stride.t_loading_response_s, "T4": stride.t_stance_s}
        else:
            times_s["T6"] = stride.t_stance_s
        marks += [Mark(round(t_s * NS_PER_S), stride.foot, what) for what, t_s in times_s.items()]
    for foot, true in truth.feet.items():
        if foot in feet:
            marks += heel_lifts(true.t_ns, true.phase, foot)
    return sorted(marks)


def foot_of_sensor(sensor: str) -> str:
    """The foot that a sensor tells of."""
    return sensor.replace("_shank", "_foot")


def by_foot(marks: Iterable[Mark]) -> tuple[Mark, ...]:
    """Marks under the name of the foot, whichever of its sensors told; by time."""
    return tuple(sorted(Mark(mark.t_ns, foot_of_sensor(mark.who), mark.what) for mark in marks))
