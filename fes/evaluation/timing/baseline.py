"""The baseline of timing, a TOML file that its user keeps in version control: tolerances, spreads and every event.

What a check compares with: of each recording its own events, to be paired one by one, and how they lay against the
truth; over all recordings how far one may be from the others.
"""

import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes import __version__
from fes.evaluation.timing.marks import Mark, Spread
from fes.evaluation.timing.truth import TimingError
from fes.recording.write import toml_value
from fes.signals import NS_PER_S

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
    """Read a baseline.

    Raises:
        TimingError: it is none, or a tolerance is no number; says where.
    """
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
