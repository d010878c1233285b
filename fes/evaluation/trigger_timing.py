"""How far triggers are from where they should be: transitions and stimulation against a truth or an earlier log.

A *mark* is one moment of one kind of one foot or channel. Expected and found marks of the same kind are paired one to
one, nearest first, at most ``WINDOW_MS`` or 1.5 times the tolerance apart. An expected mark without a partner is
missed, a found one without is extra. The latency of the decisions is held against a budget.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.session_log import SessionRecord, read_session
from fes.signals import NS_PER_S, FloatArray, IntArray, StimCommand
from fes.simulation.truth import Truth, load_truth
from fes.walk_record import finite_or_none
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
        plain: dict[str, Any] = finite_or_none(asdict(self))
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


def timing_rows(
    expected: Sequence[Mark], found: Sequence[Mark], tolerance_ms: Mapping[str, float], other_ms: float
) -> tuple[TimingRow, ...]:
    """A row for each kind of mark that is expected or found, by name; ``other_ms`` for kinds without a tolerance."""
    rows = []
    for who, what in sorted({(mark.who, mark.what) for mark in (*expected, *found)}):
        most_ms = tolerance_ms.get(what, other_ms)
        should, did, error_ms = mark_errors(who, what, expected, found, most_ms)
        p5, median, p95 = np.percentile(error_ms, [5, 50, 95]).tolist() if error_ms.size else (float("nan"),) * 3
        unpaired = should - error_ms.size, did - error_ms.size
        off = int((error_ms < -most_ms).sum()), int((error_ms > most_ms).sum())
        rows.append(TimingRow(who, what, should, did, *unpaired, *off, median, p5, p95, most_ms))
    return tuple(rows)


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


class TimingError(ValueError):
    """There is nothing to compare with; the text says why."""


@dataclass(frozen=True, slots=True)
class TimingOptions:
    """What to hold the timing against; ``against`` None: the recording's own truth, of a log what it recorded."""

    against: Path | None = None
    tolerance_ms: float | None = None
    bounds: Bounds = field(default_factory=Bounds)


@dataclass(frozen=True, slots=True)
class Expected:
    """What should have happened: ``source`` for people, the marks, and whether they are a physical truth."""

    source: str
    marks: list[Mark]
    physical: bool


def expected_of(options: TimingOptions, default: Path | Expected, sensors: Iterable[str]) -> Expected:
    """What is expected of these sensors: what ``options`` name, else ``default``; of a path what that session log did,
    or what the truth beside that recording says.

    Raises:
        SessionLogError: the log cannot be read.
        TimingError: there is nothing to compare with.
    """
    path = options.against or default
    if isinstance(path, Expected):
        return path
    if path.suffix == ".feslog":
        return Expected(str(path), _marks_recorded(read_session(path)), False)
    try:
        marks = marks_of_truth(load_truth(path), {_foot(sensor) for sensor in sensors})
    except FileNotFoundError as error:
        raise TimingError(
            f"{path} has no truth beside it to check the timing against ({Path(str(error).split(': ')[0]).name} is not "
            f"there). Name an earlier session log: --against LOG"
        ) from error
    except (ValueError, KeyError, OSError) as error:
        raise TimingError(f"{path}: its truth cannot be read: {error}") from error
    return Expected(f"the truth of {path.name}", marks, True)


def check_timing(
    record: SessionRecord,
    options: TimingOptions,
    expected: Expected,
    phases: Sequence[PhaseChange] | None = None,
    commands: Iterable[StimCommand] | None = None,
) -> TimingCheck:
    """Compare a session with what is expected; its latencies count.

    ``phases`` and ``commands``: what fired and what went out, if not the record's.

    Raises:
        TimingError: the two tell of different times.
    """
    fired = marks_of_phases(record.phases if phases is None else phases)
    found = [Mark(mark.t_ns, _foot(mark.who) if expected.physical else mark.who, mark.what) for mark in fired]
    if not expected.physical:
        found += marks_of_commands(record.commands if commands is None else commands)
    if expected.marks and found:
        should, did = ((1e-9 * min(marks).t_ns, 1e-9 * max(marks).t_ns) for marks in (expected.marks, found))
        if did[0] > should[1] or did[1] < should[0]:
            raise TimingError(
                f"{expected.source} tells of another time than this session ({should[0]:.1f}–{should[1]:.1f} s and "
                f"{did[0]:.1f}–{did[1]:.1f} s). Compare logs of the same recording; of two sessions, use `fes compare`."
            )
    tolerances = {} if options.tolerance_ms or not expected.physical else TRUTH_TOLERANCE_MS
    rows = timing_rows(expected.marks, found, tolerances, options.tolerance_ms or LOG_TOLERANCE_MS)
    latency = check_latency(record.latency_ns, options.bounds.latency_budget_ms)
    return judge_timing(expected.source, rows, latency, options.bounds)


def check_replayed(
    path: Path, options: TimingOptions, phases: list[PhaseChange], commands: list[StimCommand]
) -> TimingCheck:
    """Compare what a log's replay gave with the log itself, or with what ``options`` name.

    Raises:
        SessionLogError: the log cannot be read.
        TimingError: there is nothing to compare with.
    """
    record = read_session(path)
    own = Expected(f"what {path.name} recorded", _marks_recorded(record), False)
    expected = expected_of(options, own, record.header.get("calibration", {}))
    return check_timing(record, options, expected, phases, commands)


def _marks_recorded(record: SessionRecord) -> list[Mark]:
    return [*marks_of_phases(record.phases), *marks_of_commands(record.commands)]


def _foot(sensor: str) -> str:
    """The foot that a sensor tells of."""
    return sensor.replace("_shank", "_foot")
