"""One recording's timing held against its baseline and a truth: rows for people, failures in words for machines.

A replay is deterministic, so a recording that the baseline knows is paired with its own events of then, one by one.
Against a truth it is the distribution that counts: bias and 95 % limits may change by the tolerance. A recording that
the baseline does not know may be as far from the mean bias of its walkers as one more walker would be, and the
tolerance beside. The baseline is a TOML file that its user keeps in version control.
"""

import math
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np

from fes import __version__
from fes.config import Session
from fes.control.controller import Controller
from fes.control.replay import log_header
from fes.control.runner import Runner, armed_after, with_ticks
from fes.estimation.sensor_choice import Calibration, shank_phase_sensors
from fes.evaluation.log_comparison import ReplayOutput
from fes.evaluation.timing.marks import (
    Mark,
    Spread,
    TimingRow,
    by_foot,
    marks_of_commands,
    marks_of_phases,
    timing_rows,
)
from fes.evaluation.timing.truth import ExpectedMarks, TimingError
from fes.gate import gate_of
from fes.recording import Recording
from fes.recording.tracks import samples_of
from fes.recording.write import toml_value
from fes.session_log import SessionRecord
from fes.signals import NS_PER_S, SHANK_SENSORS, IntArray, StimAlive, StimCommand, StimStatus, WireFrame
from fes.walk_record import SampleArrays, WalkRecord, finite_or_none

# --- A recording through the loop to see when things happen: marks, and how long each decision takes --------


ARM_AFTER_S: Final = 0.5
CREATED: Final = "2000-01-01T00:00:00+00:00"  # the same run, the same bytes
_NO_FRAME: Final = 0


@dataclass(frozen=True, eq=False)
class Measured:
    """When things happened in one recording; ``record`` is all that pages show of it.

    ``latency_ns`` (N,): of each sample, from its release to the last byte written.
    """

    name: str
    record: WalkRecord
    marks: tuple[Mark, ...]
    latency_ns: IntArray

    @property
    def span_ns(self) -> tuple[int, int]:
        """The recording's first and last sample."""
        times = [each.t_ns for each in self.record.samples.values() if each.t_ns.size]
        return min(int(t[0]) for t in times), max(int(t[-1]) for t in times)


class _NoStimulator:
    """Nothing is sent anywhere."""

    def send(self, command: StimCommand) -> WireFrame:
        """No frame."""
        return WireFrame(command.t_ns, _NO_FRAME, b"")

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """Nobody answers."""
        return []


def measure(
    recording: Recording,
    session: Session,
    calibrations: Mapping[str, Calibration],
    clock_ns: Callable[[], int],
    *,
    repeats: int = 3,
    controller_of: Callable[[Session, Mapping[str, Calibration]], Controller] = Controller,
) -> Measured:
    """Replay a recording, armed after half a second, ``repeats`` times.

    The marks are those of the first run; every run gives the same. Of each decision the quickest time counts, so that
    what else the machine does meanwhile, which hits another decision each time, is left out. ``clock_ns`` measures it.

    ConfigError: the calibrations fit no controller.
    """
    up = {sensor: each.up for sensor, each in calibrations.items()}
    sensors = set(calibrations) | (set(recording.tracks) & set(SHANK_SENSORS))
    first: ReplayOutput | None = None
    latency_ns = np.zeros(0, np.int64)
    for _ in range(repeats):
        out = ReplayOutput()
        gate = gate_of(session, up, shank_phase_sensors(calibrations))
        runner = Runner(controller_of(session, calibrations), gate, _NoStimulator(), out, clock_ns)
        runner.run(
            armed_after(with_ticks(samples_of(recording, sensors)), ARM_AFTER_S, session.stimulation.intensity),
            lambda event: None,
        )
        own_ns = np.array(out.latencies_ns, np.int64)
        latency_ns = own_ns if first is None else np.minimum(latency_ns, own_ns)
        first = first or out
    assert first is not None, "repeated at least once"
    record = WalkRecord(
        log_header(recording, "", session, calibrations, 1, CREATED),
        samples={
            name: SampleArrays(track.t_ns, track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
            for name, track in recording.tracks.items()
        },
        phases=first.phases,
        strides=first.strides,
        commands=first.commands,
        latency_ns=latency_ns,
        complete=True,
    )
    marks = (*marks_of_phases(first.phases), *marks_of_commands(first.commands))
    return Measured(recording.name, record, by_foot(marks), latency_ns)


def as_recorded(name: str, record: SessionRecord, again: ReplayOutput | None = None) -> Measured:
    """What a session did, or what its events gave ``again``; the latencies are the session's own either way."""
    phases = record.phases if again is None else again.phases
    commands = record.commands if again is None else again.commands
    shown = replace(record, phases=phases, commands=commands)
    marks = (*marks_of_phases(phases), *marks_of_commands(commands))
    return Measured(name, shown, by_foot(marks), record.latency_ns)


BASELINE, TRUTH, DECISIONS = "baseline", "truth", "latency"  # what a row is held against
FORMAT: Final = 1
LATENCY: Final = "latency_p99"
COUNTED: Final = ("missed", "extra", "moved")
KINDS: Final = ("T1", "T2", "T3", "T4", "T5", "T6", "on", "off", LATENCY)
TOLERANCE_MS: Final = {**dict.fromkeys(KINDS, 5.0), LATENCY: 0.5}
ALLOWED: Final = dict.fromkeys(COUNTED, 0)
LEAST_WALKERS: Final = 5  # to say how far a recording of one more may be from theirs
STRANGE: Final = 0.001  # of unchanged recordings of another walker lie beyond in any of what is judged
PER_LINE: Final = 10
_HEAD: Final = """\
# Timing as it was, by `fes timing baseline` of fes {version}. Keep this file in version control.
# `fes timing check --baseline THIS RECORDING…` compares with it. The tolerances and what is allowed are yours to edit:
# an event further than the tolerance from where it was has moved; bias and limits against the truth may change by it.
"""


@dataclass(frozen=True, slots=True, eq=False)
class RecordingBaseline:
    """One recording as it was: its file's digest, its events, and how they lay against a truth (none: empty).

    ``subject``: who walked; recordings of the same subject are alike. Empty: nobody else's.
    """

    sha256: str
    settings: str
    truth: str
    latency_p99_ms: float
    spreads: tuple[Spread, ...]
    marks: tuple[Mark, ...]
    subject: str = ""


@dataclass(frozen=True, eq=False)
class Baseline:
    """Tolerances (ms), how many events may be missed, extra or moved, and the recordings by name."""

    recordings: Mapping[str, RecordingBaseline]
    tolerance_ms: Mapping[str, float] = field(default_factory=lambda: dict(TOLERANCE_MS))
    allowed: Mapping[str, int] = field(default_factory=lambda: dict(ALLOWED))

    def usual_bias_ms(self, who: str, what: str, judged: int = 1) -> tuple[float, float]:
        """Middle of the walkers' biases, and how far one recording of another walker may be from it (ms).

        NaN where too few walkers are known. ``judged``: how many biases of that recording are held against theirs, for
        by chance alone any of them may be strange. The recordings of one walker resemble each other: what counts is
        how many walkers there are, each with the mean of its recordings, and beside that how these differ.
        """
        by_walker: dict[str, list[float]] = {}
        for name, each in self.recordings.items():
            biases = [s.bias_ms for s in each.spreads if (s.who, s.what) == (who, what) and math.isfinite(s.bias_ms)]
            by_walker.setdefault(each.subject or f"recording {name}", []).extend(biases)
        walkers = [np.array(biases) for biases in by_walker.values() if biases]
        if len(walkers) < LEAST_WALKERS:
            return float("nan"), float("nan")
        from scipy.stats import t as student

        means = np.array([biases.mean() for biases in walkers])
        spare = sum(len(biases) - 1 for biases in walkers)
        within = sum(float(((biases - biases.mean()) ** 2).sum()) for biases in walkers) / max(spare, 1)
        sd = math.sqrt(float(means.var(ddof=1)) * (1.0 + 1.0 / len(walkers)) + within)
        return float(means.mean()), float(student.isf(0.5 * STRANGE / judged, len(walkers) - 1)) * sd


def baseline_text(baseline: Baseline) -> str:
    """The file's text; the same baseline, the same bytes."""
    lines = [_HEAD.format(version=__version__), f"format = {FORMAT}", "", "[tolerance_ms]"]
    lines += [f"{name} = {toml_value(float(value))}" for name, value in baseline.tolerance_ms.items()]
    lines += ["", "[allowed]", *(f"{name} = {count}" for name, count in baseline.allowed.items())]
    for name, each in sorted(baseline.recordings.items()):
        key = toml_value(name)
        lines += ["", f"[recordings.{key}]"]
        lines += [f"{item} = {toml_value(getattr(each, item))}" for item in ("sha256", "settings", "truth")]
        lines += [f"subject = {toml_value(each.subject)}"] if each.subject else []
        lines.append(f"latency_p99_ms = {_number(each.latency_p99_ms)}")
        if each.spreads:
            lines.append("against_truth = [  # found − true, ms")
            lines += [f"  {{ {', '.join(_cells(spread))} }}," for spread in each.spreads]
            lines.append("]")
        lines.append(f"[recordings.{key}.events_s]")
        for who, what in sorted({(mark.who, mark.what) for mark in each.marks}):
            times = [f"{1e-9 * m.t_ns:.4f}" for m in each.marks if (m.who, m.what) == (who, what)]
            rows = [", ".join(times[k : k + PER_LINE]) for k in range(0, len(times), PER_LINE)]
            lines += [f"{toml_value(f'{who} {what}')} = [", *(f"  {row}," for row in rows), "]"]
    return "\n".join(lines) + "\n"


def _cells(spread: Spread) -> Iterable[str]:
    for name, value in asdict(spread).items():
        yield f"{name} = {_number(value) if isinstance(value, float) else toml_value(value)}"


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "nan"


def read_baseline(path: Path) -> Baseline:
    """Read a baseline. TimingError: it is none, or a tolerance is no number; says where."""
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise TimingError(
            f"{path}: cannot be read: {error.strerror or error}. `fes timing baseline RECORDING… --baseline {path}` "
            f"writes one."
        ) from error
    except ValueError as error:
        raise TimingError(f"{path}: is no baseline: {error}.") from error
    if data.get("format") != FORMAT or not isinstance(data.get("recordings"), dict):
        raise TimingError(f"{path}: is no baseline of timing (format = {FORMAT} and recordings are missing).")
    try:
        tolerance_ms = {**TOLERANCE_MS, **_numbers(path, data.get("tolerance_ms", {}), TOLERANCE_MS)}
        counts = _numbers(path, data.get("allowed", {}), ALLOWED)
        allowed = {**ALLOWED, **{name: int(count) for name, count in counts.items()}}
        recordings = {name: _recording(each) for name, each in data["recordings"].items()}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, TimingError):
            raise
        raise TimingError(f"{path}: is damaged: {error}. Write it anew: fes timing baseline.") from error
    return Baseline(recordings, tolerance_ms, allowed)


def _numbers(path: Path, table: Any, known: Mapping[str, float]) -> dict[str, float]:
    if not isinstance(table, dict):
        raise TimingError(f"{path}: [tolerance_ms] and [allowed] are tables.")
    for name, value in table.items():
        if name not in known:
            raise TimingError(f"{path}: {name!r} is none of {', '.join(known)}.")
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
            raise TimingError(f"{path}: {name} = {value!r} must be a number, 0 or more.")
    return {name: float(value) for name, value in table.items()}


def _recording(data: Mapping[str, Any]) -> RecordingBaseline:
    marks = [
        Mark(round(t_s * NS_PER_S), *kind.rsplit(" ", 1)) for kind, times in data["events_s"].items() for t_s in times
    ]
    spreads = tuple(Spread(**row) for row in data.get("against_truth", []))
    sha256, settings, truth = (str(data[name]) for name in ("sha256", "settings", "truth"))
    latency_p99_ms, subject = float(data["latency_p99_ms"]), str(data.get("subject", ""))
    return RecordingBaseline(sha256, settings, truth, latency_p99_ms, spreads, tuple(sorted(marks)), subject)


def joined(old: Baseline | None, new: Mapping[str, RecordingBaseline], given_ms: Mapping[str, float]) -> Baseline:
    """New recordings among the old ones, whose tolerances stay unless others are given."""
    if old is None:
        return Baseline(dict(new), {**TOLERANCE_MS, **given_ms})
    return Baseline({**old.recordings, **new}, {**old.tolerance_ms, **given_ms}, old.allowed)


def in_words(names: Sequence[str]) -> str:
    """A few names, and how many more."""
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


# --- the judgement ---------------------------------------------------------------------------------------------


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
