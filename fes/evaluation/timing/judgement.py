"""One recording's timing held against its baseline and a truth: rows for people, failures in words for machines.

A replay is deterministic. So a recording that the baseline knows is paired with its own events of then: one event that
is missed among thousands, or moved, is a change of the program. Against a truth it is the distribution that counts:
bias and 95 % limits may change by the tolerance. A recording that the baseline does not know is held against the
biases of its walkers: it may be as far from their mean as one more walker would be, and the tolerance beside.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np

from fes.evaluation.timing.baseline import ALLOWED, LATENCY, Baseline, RecordingBaseline
from fes.evaluation.timing.marks import Spread, TimingRow, timing_rows
from fes.evaluation.timing.replayed import Measured
from fes.evaluation.timing.truth import ExpectedMarks
from fes.signals import IntArray
from fes.walk_record import finite_or_none

BASELINE, TRUTH, DECISIONS = "baseline", "truth", "latency"  # what a row is held against
TOO_FEW: Final = 5  # pairs; fewer say nothing of a spread


@dataclass(frozen=True, slots=True)
class Failure:
    """What is not as it should be: ``against`` baseline, truth or latency, whose mark, which, and a sentence."""

    against: str
    who: str
    what: str
    text: str


@dataclass(frozen=True, slots=True)
class Latency:
    """From a sample's release to the decision, ms; NaN where none is known. ``p99_before_ms``: the baseline's."""

    steps: int
    p50_ms: float
    p99_ms: float
    max_ms: float
    p99_before_ms: float = math.nan


def latency_percentiles(latency_ns: IntArray, before_ms: float = math.nan) -> Latency:
    """Percentiles of latencies (N,)."""
    ms = 1e-6 * latency_ns.astype(np.float64)
    p50, p99, most = np.percentile(ms, [50, 99, 100]).tolist() if len(ms) else (math.nan,) * 3
    return Latency(len(ms), p50, p99, most, before_ms)


@dataclass(frozen=True, slots=True)
class Limits:
    """What is allowed: tolerances in ms by kind (a kind without one is not judged), counts, and a latency's budget."""

    tolerance_ms: Mapping[str, float] = field(default_factory=dict)
    allowed: Mapping[str, int] = field(default_factory=lambda: dict(ALLOWED))
    latency_budget_ms: float | None = None


@dataclass(frozen=True, eq=False)
class RecordingTiming:
    """One recording's outcome. ``own``: against its events in the baseline; ``true``: against the truth."""

    name: str
    truth: str
    own: tuple[TimingRow, ...]
    true: tuple[TimingRow, ...]
    before: tuple[Spread, ...]
    latency: Latency
    failures: tuple[Failure, ...]
    notes: tuple[str, ...]
    measured: Measured
    judged: bool

    def to_json(self) -> dict[str, Any]:
        """Plain values, None for what is not known."""
        plain: dict[str, Any] = finite_or_none(
            {
                "recording": self.name,
                "truth": self.truth,
                "judged": self.judged,
                "failures": [asdict(each) for each in self.failures],
                "notes": list(self.notes),
                "latency": asdict(self.latency),
                "against_baseline": [row.to_json() for row in self.own],
                "against_truth": [row.to_json() for row in self.true],
                "baseline_against_truth": [asdict(spread) for spread in self.before],
            }
        )
        return plain


def judge(
    measured: Measured,
    truth: ExpectedMarks | None,
    baseline: Baseline | None,
    sha256: str,
    limits: Limits,
    settings: str = "",
) -> RecordingTiming:
    """Hold one recording against what there is.

    ``sha256`` names its content: a recording of the baseline's name with other content is another recording.
    """
    before = baseline.recordings.get(measured.name) if baseline else None
    notes: list[str] = []
    if before is not None and before.sha256 != sha256:
        notes.append("its content is not that of the baseline's recording of this name: judged as a new one")
        before = None
    elif before is None and baseline is not None:
        notes.append("the baseline does not know it: judged by how its recordings lie against their truths")
    if before is not None and settings and before.settings != settings:
        notes.append("the settings differ from the baseline's")
    failures: list[Failure] = []
    own: tuple[TimingRow, ...] = ()
    if before is not None:
        own = timing_rows(before.marks, measured.marks, limits.tolerance_ms)
        for row in own:
            failures += _own_failures(row, limits)
        if not before.marks and not measured.marks:
            failures.append(Failure(BASELINE, "", "", "neither side has a transition: there is nothing to compare"))
    true: tuple[TimingRow, ...] = ()
    if truth is not None:
        true = timing_rows(truth.marks, truth.judged(measured.marks), limits.tolerance_ms, truth.optional)
        notes += truth.notes
        paired, alone = sum(len(row.pairs_ns) for row in true), sum(len(row.missed_ns) for row in true)
        if alone > paired:
            notes.append("most events of the truth have no partner: is it another recording's truth, or clock?")
        for row in true:
            failures += _true_failures(row, len(true), before, baseline, limits, notes)
    p99_before_ms = before.latency_p99_ms if before else _worst_latency(baseline)
    latency = latency_percentiles(measured.latency_ns, p99_before_ms)
    failures += _latency_failures(latency, limits)
    judged = bool(baseline or limits.tolerance_ms or limits.latency_budget_ms is not None)
    spreads = before.spreads if before else ()
    source = truth.source if truth else ""
    return RecordingTiming(
        measured.name, source, own, true, spreads, latency, tuple(failures), tuple(notes), measured, judged
    )


def _own_failures(row: TimingRow, limits: Limits) -> list[Failure]:
    texts = _counted(row, limits, 0, 0)
    error_ms = row.error_ms
    if row.moved > limits.allowed["moved"]:
        off = error_ms[np.abs(error_ms) > row.tolerance_ms]
        worst = float(error_ms[np.abs(error_ms).argmax()])
        texts.append(
            f"{row.moved} of {len(error_ms)} moved by more than {row.tolerance_ms:g} ms, on average "
            f"{off.mean():+.1f} ms, at most {worst:+.1f} ms"
        )
    return [Failure(BASELINE, row.who, row.what, text) for text in texts]


def _counted(row: TimingRow, limits: Limits, missed: int, extra: int) -> list[str]:
    """What is missed or extra beyond what was, and what is allowed."""
    texts = []
    for name, times_ns, was in (("missed", row.missed_ns, missed), ("extra", row.extra_ns, extra)):
        if len(times_ns) > was + limits.allowed[name]:
            at = ", ".join(f"{1e-9 * t:.2f}" for t in times_ns[:3].tolist()) + (" …" if len(times_ns) > 3 else "")
            then = f", {was} in the baseline" if was else ""
            texts.append(f"{len(times_ns)} {name} (at {at} s){then}; {limits.allowed[name]} may be")
    return texts


def _true_failures(
    row: TimingRow,
    rows: int,
    before: RecordingBaseline | None,
    baseline: Baseline | None,
    limits: Limits,
    notes: list[str],
) -> list[Failure]:
    most_ms = limits.tolerance_ms.get(row.what)
    texts: list[str] = []
    if before is not None:
        was = next((each for each in before.spreads if (each.who, each.what) == (row.who, row.what)), None)
        if was is None:
            if before.spreads:
                texts += _counted(row, limits, 0, 0)
        else:
            texts += _counted(row, limits, was.missed, was.extra)
            texts += _changes(was, row.spread, most_ms)
    elif baseline is not None:
        texts += _unusual(row, rows, baseline, most_ms, notes)
    elif most_ms is not None:
        texts += _counted(row, limits, 0, 0)
        if row.moved > limits.allowed["moved"]:
            texts.append(f"{row.moved} of {len(row.pairs_ns)} are more than {most_ms:g} ms off")
    return [Failure(TRUTH, row.who, row.what, text) for text in texts]


def _changes(was: Spread, now: Spread, most_ms: float | None) -> list[str]:
    texts = []
    for name, label in (("bias_ms", "bias"), ("lower_ms", "lower 95 % limit"), ("upper_ms", "upper 95 % limit")):
        one, other = getattr(was, name), getattr(now, name)
        change = other - one
        outward = {"bias_ms": abs(change), "lower_ms": -change, "upper_ms": change}[name]
        if most_ms is not None and outward > most_ms:
            texts.append(f"{label} {other:+.1f} ms, was {one:+.1f} ms; it may change by {most_ms:g} ms")
    return texts


def _unusual(row: TimingRow, rows: int, baseline: Baseline, most_ms: float | None, notes: list[str]) -> list[str]:
    """A recording that the baseline does not know, one of its ``rows`` against the baseline's walkers."""
    middle_ms, reach_ms = baseline.usual_bias_ms(row.who, row.what, rows)
    if len(row.pairs_ns) < TOO_FEW or most_ms is None:
        return []
    if not math.isfinite(middle_ms):
        notes.append(f"{row.who} {row.what}: too few walkers in the baseline have it to judge another")
        return []
    bias_ms = row.spread.bias_ms
    if abs(bias_ms - middle_ms) <= most_ms + reach_ms:
        return []
    return [f"bias {bias_ms:+.1f} ms, where the baseline's walkers have {middle_ms:+.1f} ± {most_ms + reach_ms:.1f} ms"]


def _worst_latency(baseline: Baseline | None) -> float:
    known = [each.latency_p99_ms for each in baseline.recordings.values()] if baseline else []
    return max((ms for ms in known if math.isfinite(ms)), default=math.nan)


def _latency_failures(latency: Latency, limits: Limits) -> list[Failure]:
    texts = []
    most_ms, budget_ms = limits.tolerance_ms.get(LATENCY), limits.latency_budget_ms
    if most_ms is not None and latency.p99_ms > latency.p99_before_ms + most_ms:
        texts.append(
            f"99 % of the decisions took up to {latency.p99_ms:.2f} ms, once {latency.p99_before_ms:.2f} ms; "
            f"it may grow by {most_ms:g} ms"
        )
    if budget_ms is not None and not latency.steps:
        texts.append("no decision's latency is recorded, so its budget cannot be checked")
    elif budget_ms is not None and latency.p99_ms > budget_ms:
        texts.append(f"99 % of the decisions took up to {latency.p99_ms:.2f} ms, the budget is {budget_ms:g} ms")
    return [Failure(DECISIONS, "", LATENCY, text) for text in texts]


def as_baseline(timing: RecordingTiming, sha256: str, settings: str, subject: str = "") -> RecordingBaseline:
    """What a recording's outcome is as a baseline; ``subject``: who walked."""
    spreads = tuple(row.spread for row in timing.true)
    return RecordingBaseline(
        sha256, settings, timing.truth, timing.latency.p99_ms, spreads, tuple(sorted(timing.measured.marks)), subject
    )


def junit(outcomes: Sequence[RecordingTiming]) -> str:
    """JUnit XML: a suite for each recording, a case for each kind of mark and the latency."""
    from xml.etree import ElementTree

    root = ElementTree.Element("testsuites", name="fes timing")
    for each in outcomes:
        cases = [(BASELINE, row.who, row.what) for row in each.own] + [(TRUTH, row.who, row.what) for row in each.true]
        cases += [(DECISIONS, "", LATENCY)] if each.latency.steps else []
        cases += [key for f in each.failures if (key := (f.against, f.who, f.what)) not in cases]
        suite = ElementTree.SubElement(root, "testsuite", name=each.name, tests=str(len(cases)), errors="0")
        broken = 0
        for against, who, what in cases:
            name = f"{who.replace('_', ' ')} {what}".strip()
            case = ElementTree.SubElement(suite, "testcase", classname=f"{each.name}.{against}", name=name)
            texts = [f.text for f in each.failures if (f.against, f.who, f.what) == (against, who, what)]
            broken += bool(texts)
            if texts:
                ElementTree.SubElement(case, "failure", message="; ".join(texts)).text = "\n".join(texts)
        suite.set("failures", str(broken))
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
