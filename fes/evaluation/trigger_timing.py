"""How far triggers are from where they should be: transitions and stimulation against a truth or an earlier log.

A *mark* is one moment of one kind of one foot or channel. Expected and found marks of the same kind are paired one to
one, nearest first, at most ``WINDOW_MS`` or 1.5 times the tolerance apart. An expected mark without a partner is
missed, a found one without is extra.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from fes.signals import NS_PER_S, FloatArray, IntArray, StimCommand
from fes.simulation.truth import Truth
from statemachine.phases import Phase, PhaseChange, Transition

WINDOW_MS: Final = 300.0
# What is allowed against a physical truth (heel 5 mm up, toe-off, contact, sole flat), either way. A sensor shows
# contact and toe-off at once; a heel that rises slowly, and a sole that is flat but still rocks, show later.
TRUTH_TOLERANCE_MS: Final = {"T1": 250.0, "T2": 60.0, "T3": 60.0, "T4": 250.0, "T5": 250.0, "T6": 250.0}
LOG_TOLERANCE_MS: Final = 1.0
_MS: Final = 1e-6


@dataclass(frozen=True, slots=True, order=True)
class Mark:
    """One moment: ``who`` is a foot or a channel, ``what`` T1–T6, on or off."""

    t_ns: int
    who: str
    what: str


@dataclass(frozen=True, slots=True)
class TimingRow:
    """One kind of mark of one foot or channel; ``early`` and ``late`` count pairs beyond the tolerance.

    Errors are found − expected in ms, NaN without a pair.
    """

    who: str
    what: str
    expected: int
    found: int
    missed: int
    extra: int
    early: int
    late: int
    median_ms: float
    p5_ms: float
    p95_ms: float
    tolerance_ms: float


@dataclass(frozen=True, slots=True)
class LatencyCheck:
    """From a sample's arrival to the decision, ms; ``over`` counts steps beyond the budget (0 without one)."""

    steps: int
    p50_ms: float
    p99_ms: float
    p999_ms: float
    max_ms: float
    over: int
    budget_ms: float | None


@dataclass(frozen=True, slots=True)
class Bounds:
    """How many of all marks may be missed, extra, early or late, and what 99 % of the latencies must not exceed."""

    missed: int = 0
    extra: int = 0
    early: int = 0
    late: int = 0
    latency_budget_ms: float | None = None


@dataclass(frozen=True, slots=True)
class TimingCheck:
    """The outcome: a row for each kind of mark, the latency, and what bound is broken in words."""

    against: str
    rows: tuple[TimingRow, ...]
    latency: LatencyCheck
    broken: tuple[str, ...] = ()

    def total(self, name: str) -> int:
        """The sum of one count over all rows."""
        return sum(int(getattr(row, name)) for row in self.rows)

    def to_json(self) -> dict[str, Any]:
        """Plain values, None for what is not known."""
        rows = [_without_nan(asdict(row)) for row in self.rows]
        latency = _without_nan(asdict(self.latency))
        return {"against": self.against, "rows": rows, "latency": latency, "broken": list(self.broken)}


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
    expected: Sequence[Mark], found: Sequence[Mark], tolerance_ms: Mapping[str, float], other_ms: float
) -> tuple[TimingRow, ...]:
    """A row for each kind of mark that is expected or found, by name; ``other_ms`` for kinds without a tolerance."""
    kinds = sorted({(mark.who, mark.what) for mark in (*expected, *found)})
    return tuple(_row(who, what, expected, found, tolerance_ms.get(what, other_ms)) for who, what in kinds)


def mark_errors(
    who: str, what: str, expected: Sequence[Mark], found: Sequence[Mark], tolerance_ms: float
) -> tuple[int, int, FloatArray]:
    """How many marks of a kind are expected and found, and found − expected (ms) of their pairs (P,)."""
    should, did = (
        np.array(sorted(mark.t_ns for mark in marks if (mark.who, mark.what) == (who, what)), np.int64)
        for marks in (expected, found)
    )
    pairs = pair_times(should, did, max(WINDOW_MS, 1.5 * tolerance_ms) / _MS)
    error_ms = np.array([int(did[j]) - int(should[i]) for i, j in pairs], np.float64) * _MS
    return len(should), len(did), error_ms


def _row(who: str, what: str, expected: Sequence[Mark], found: Sequence[Mark], tolerance_ms: float) -> TimingRow:
    should, did, error_ms = mark_errors(who, what, expected, found, tolerance_ms)
    p5, median, p95 = np.percentile(error_ms, [5, 50, 95]).tolist() if error_ms.size else (float("nan"),) * 3
    return TimingRow(
        who=who,
        what=what,
        expected=should,
        found=did,
        missed=should - error_ms.size,
        extra=did - error_ms.size,
        early=int((error_ms < -tolerance_ms).sum()),
        late=int((error_ms > tolerance_ms).sum()),
        median_ms=median,
        p5_ms=p5,
        p95_ms=p95,
        tolerance_ms=tolerance_ms,
    )


def check_latency(latency_ns: IntArray, budget_ms: float | None) -> LatencyCheck:
    """The latencies' percentiles; NaN where there are none."""
    ms = latency_ns.astype(np.float64) * _MS
    p50, p99, p999, most = np.percentile(ms, [50, 99, 99.9, 100]).tolist() if len(ms) else (float("nan"),) * 4
    over = 0 if budget_ms is None else int((ms > budget_ms).sum())
    return LatencyCheck(len(ms), p50, p99, p999, most, over, budget_ms)


def judge_timing(against: str, rows: Sequence[TimingRow], latency: LatencyCheck, bounds: Bounds) -> TimingCheck:
    """Hold the numbers against the bounds."""
    check = TimingCheck(against, tuple(rows), latency)
    broken = []
    for name in ("missed", "extra", "early", "late"):
        count, most = check.total(name), int(getattr(bounds, name))
        if count > most:
            broken.append(f"{count} {name}, at most {most} may be")
    budget_ms = bounds.latency_budget_ms
    if budget_ms is not None and not latency.steps:
        broken.append("no decision's latency is recorded, so its budget cannot be checked")
    elif budget_ms is not None and latency.p99_ms > budget_ms:
        broken.append(f"99 % of the decisions took {latency.p99_ms:.2f} ms, the budget is {budget_ms:g} ms")
    if not rows:
        broken.append("there is nothing to compare: neither side has a transition")
    return TimingCheck(against, tuple(rows), latency, tuple(broken))


def _without_nan(values: dict[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(value, float) and not np.isfinite(value) else value for k, value in values.items()}


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
