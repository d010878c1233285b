"""``fes timing``: check, baseline, compare."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
import numpy as np

from fes.cli.common import (
    FAILED,
    LOG_SUFFIX,
    PATH,
    Number,
    Problem,
    StoppedEarly,
    choice,
    failing,
    fresh_folder,
    options,
    out_option,
    print_json,
    screen,
    writing,
)
from fes.cli.replay.command import prepared, repeat
from fes.config import ConfigError, Session
from fes.control.replay import digest, session_for, settings_of
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.sensor_choice import Calibration, phase_sensors
from fes.estimation.warm_up import warm_up
from fes.evaluation.reference.table import ReferenceError
from fes.evaluation.timing.judgement import (
    ALLOWED,
    DECISIONS,
    KINDS,
    LATENCY,
    Baseline,
    Limits,
    Measured,
    RecordingTiming,
    as_baseline,
    as_recorded,
    baseline_text,
    in_words,
    joined,
    judge,
    junit,
    measure,
    read_baseline,
)
from fes.evaluation.timing.truth import (
    ExpectedMarks,
    TimingError,
    check_clock,
    companion_truth,
    expected_of_log,
    find_offset_s,
    read_truth,
    without_cut_ends,
)
from fes.recording import Recording, RecordingError
from fes.recording.can_log import CAN_SUFFIXES
from fes.recording.table import TABLE_SUFFIXES
from fes.session_log import SessionLogError, read_session

if TYPE_CHECKING:
    from rich.console import RenderableType

# --- The recordings of one timing command: found, replayed, and the truth of each ---------------------------


ROUNDS: Final = 3  # a latency that seems to have grown is measured so often again before anybody is told
LOG_TOLERANCE_MS: Final = 1.0  # against an earlier log, where nothing else is said


@dataclass(frozen=True, slots=True)
class Options:
    """How to measure: ``truth`` a file, or a folder that holds the recordings' truths; ``lag_s`` to add to its times.

    ``fit``: the clocks' offset is found from the events. ``recorded``: of a session log what it recorded, not what its
    events give today.
    """

    session: Path | None = None
    calibration: Path | None = None
    truth: Path | None = None
    plates: Mapping[int, str] | None = None
    lag_s: float | None = None
    fit: bool = False
    recorded: bool = False
    repeats: int = 3


@dataclass(frozen=True, eq=False)
class Case:
    """One recording measured: with what settings, its content's name, and how to measure it again."""

    name: str
    path: Path
    sha256: str
    settings: str
    session: Session
    measured: Measured
    truth: ExpectedMarks | None
    recording: Recording | None = None
    calibrations: Mapping[str, Calibration] | None = None

    def again(self, repeats: int) -> Case:
        """The same with its latencies measured once more; of each decision the quickest counts."""
        if self.recording is None or self.calibrations is None:
            return self
        more = measure(self.recording, self.session, self.calibrations, time.perf_counter_ns, repeats=repeats)
        quickest_ns = np.minimum(self.measured.latency_ns, more.latency_ns)
        return replace(self, measured=replace(self.measured, latency_ns=quickest_ns))


def find_recordings(given: Iterable[Path]) -> dict[str, Path]:
    """Recordings and session logs by name, those of a folder by their place in it.

    Problem: there is none, or two have one name.
    """
    found: dict[str, Path] = {}
    for path in given:
        if path.is_dir():
            inside = [each for each in sorted(path.rglob("*")) if _is_recording(each)]
            if not inside:
                wanted = ", ".join((*TABLE_SUFFIXES, *CAN_SUFFIXES))
                raise Problem(
                    f"{path}: no recording is below ({wanted}, each with its sidecar .toml; or {LOG_SUFFIX})."
                )
        elif path.is_file():
            inside = [path]
        else:
            raise Problem(f"{path}: is not there. Name recordings, session logs or folders of them.")
        for each in inside:
            name = (each.relative_to(path) if path.is_dir() else Path(each.name)).with_suffix("").as_posix()
            if name in found and found[name] != each:
                raise Problem(f"{each}: {found[name]} has the same name, {name!r}; check them one after the other.")
            found[name] = each
    return found


def _is_recording(path: Path) -> bool:
    if path.suffix == LOG_SUFFIX:
        return path.is_file()
    return path.suffix.lower() in TABLE_SUFFIXES + CAN_SUFFIXES and path.with_suffix(".toml").is_file()


def cases(recordings: Mapping[str, Path], options: Options) -> Iterator[Case]:
    """Each recording measured, one after the other.

    RecordingError, ConfigError, CalibrationError, SessionLogError, ReferenceError, TimingError: one is unusable.
    """
    if options.truth and options.truth.is_file() and len(recordings) > 1:
        raise TimingError(f"{options.truth}: is the truth of one recording, not of {len(recordings)}; name a folder.")
    for name, path in recordings.items():
        case = _of_log(name, path, options) if path.suffix == LOG_SUFFIX else _of_recording(name, path, options)
        if case.truth is not None:
            case = replace(case, truth=_in_time(case.truth, case.measured, options))
        yield case


def _of_recording(name: str, path: Path, options: Options) -> Case:
    recording, _, wanted, found = prepared(path, options.session, options.calibration)
    session = session_for(recording, wanted)
    known = set(phase_sensors(found.calibrations))
    for channel in session.channels:
        if channel.foot not in known:
            why = found.missing.get(channel.foot, "it has no sensor")
            raise TimingError(f"{path}: channel {channel.name!r} follows the {channel.foot}, but {why}.")
    truth = _truth_of(path, session, known, options)
    measured = replace(
        measure(recording, session, found.calibrations, time.perf_counter_ns, repeats=options.repeats), name=name
    )
    return Case(name, path, digest(path), _digest_of(session), session, measured, truth, recording, found.calibrations)


def _of_log(name: str, path: Path, options: Options) -> Case:
    """A session log: what its events give today, against what it recorded unless a truth is named."""
    record = read_session(path)
    try:
        session, calibrations, _ = settings_of(record.header, path)
    except (KeyError, TypeError, AttributeError) as error:
        raise TimingError(f"{path}: its header does not fit this version of fes ({error}).") from error
    if not record.samples:
        raise TimingError(f"{path}: holds no samples, so there is no timing to check.")
    truth = _truth_of(path, session, set(phase_sensors(calibrations)), options)
    if options.recorded:
        measured = as_recorded(name, record)
    else:
        measured = as_recorded(name, record, repeat(path).now)
        truth = truth or expected_of_log(record, f"what {path.name} recorded")
    return Case(name, path, digest(path), _digest_of(session), session, measured, truth)


def _digest_of(session: Session) -> str:
    return hashlib.sha256(session.model_dump_json().encode()).hexdigest()[:12]


def _truth_of(path: Path, session: Session, feet: set[str], options: Options) -> ExpectedMarks | None:
    file = options.truth or companion_truth(path)
    if file is not None and file.is_dir():
        folder, log = file, (file / path.name).with_suffix(LOG_SUFFIX)
        file = companion_truth(folder / path.name) or (log if log.is_file() else None)
        if file is None:
            raise TimingError(
                f"{folder}: holds no truth of {path.name} ({path.stem}.truth.parquet, .events.csv, .switch.csv, "
                f".mat.csv, .c3d or {LOG_SUFFIX})."
            )
    return read_truth(file, session, feet, plates=options.plates) if file is not None else None


def _in_time(truth: ExpectedMarks, measured: Measured, options: Options) -> ExpectedMarks:
    found = truth.judged(measured.marks) if truth.span_ns is None else measured.marks
    if options.fit:
        lag_s, caveat = find_offset_s(truth, found)
        if caveat:
            raise TimingError(f"{truth.source}: the offset of {lag_s:+.3f} s cannot be believed: {caveat}. Give --lag.")
        note = f"its clock is moved by {lag_s:+.4f} s, found from these events: their mean error went into it"
        truth = replace(truth.shifted(lag_s), notes=(*truth.notes, note))
    elif options.lag_s is not None:
        truth = truth.shifted(options.lag_s)
    else:
        truth = check_clock(truth, found)
    return without_cut_ends(truth, *measured.span_ns)


def judged(case: Case, baseline: Baseline | None, limits: Limits) -> tuple[RecordingTiming, Case]:
    """The outcome, and the case as it was measured in the end: a latency that seems too long is measured again."""
    if baseline is None and not limits.tolerance_ms and case.truth is not None and not case.truth.physical:
        kinds = {what for _, what in case.truth.kinds}
        limits = replace(limits, tolerance_ms=dict.fromkeys(kinds, LOG_TOLERANCE_MS))
    for _ in range(ROUNDS):
        outcome = judge(case.measured, case.truth, baseline, case.sha256, limits, case.settings)
        if case.recording is None or not any(f.against == DECISIONS for f in outcome.failures):
            break
        case = case.again(3)
    return judge(case.measured, case.truth, baseline, case.sha256, limits, case.settings), case


DEFAULT: Final = Path("timing.toml")
FAULTS: Final = (ConfigError, CalibrationError, ReferenceError, TimingError, RecordingError, SessionLogError)
WHOLE_TABLES: Final = 3  # of more recordings only those that failed are shown row by row


RECORDINGS: Final = click.argument("recordings", nargs=-1, required=True, metavar="RECORDING…", type=PATH)
_BESIDE = "Settings (TOML). Default: session.toml beside each recording."
SESSION: Final = click.option("--session", type=PATH, help=_BESIDE)
TOLERANCE: Final = click.option(
    "--tolerance-ms", multiple=True, metavar="[NAME=]MS", help="As 5, T3=10 or latency_p99=0.5."
)
HOW_TO_MEASURE: Final = options(  # what is replayed, and against what
    click.option("--calibration", type=PATH, help="From fes calibrate. Default: from the recording."),
    click.option("--truth", type=PATH, help="File, or folder of them. Default: what lies beside the recording."),
    click.option("--plate", "plates", multiple=True, metavar="N=SIDE", help="C3D: force plate 1 is left …"),
    click.option("--lag", "lag_s", type=Number(), help="Seconds to add to the truth's times."),
    choice("--sync", of=("check", "fit"), help="Of the truth's clock."),
    click.option("--as-recorded", "recorded", is_flag=True, help="Session logs: what they did, not today's replay."),
    click.option("--json", "as_json", is_flag=True, help="Print the results as JSON."),
)
HOW_TO_JUDGE: Final = options(  # tolerances, and what is written
    TOLERANCE,
    click.option("--allow", multiple=True, metavar="NAME=N", help="So many may be missed, extra or moved."),
    click.option("--latency-budget-ms", type=Number(min=0, min_open=True), help="For 99 % of the decisions."),
    click.option("--junit", type=PATH, metavar="FILE", help="Write JUnit XML, for CI."),
    out_option("The page goes below."),
    click.option("--no-report", is_flag=True, help="Write no page."),
)


@click.group(name="timing")
def command() -> None:
    """When transitions and stimulation happen: against a truth, and against how it was.

    RECORDING is a recording, a session log (.feslog) or a folder of them. A truth is a simulation's .truth.parquet, CSV
    of events, foot switches or force, C3D, or an earlier session log.
    """


@command.command(name="baseline")
@RECORDINGS
@click.option("--baseline", "file", type=PATH, default=DEFAULT, show_default=True, help="Written, or added to.")
@SESSION
@TOLERANCE
@HOW_TO_MEASURE
def baseline_command(
    recordings: tuple[Path, ...], file: Path, tolerance_ms: tuple[str, ...], as_json: bool, **chosen: Any
) -> None:
    """Write how timing is now into a file to be kept in version control.

    What the file knows already stays: its tolerances, and recordings that are not named.
    """
    from fes.report.text import count_of

    options = _options(chosen)
    given = _tolerances(tolerance_ms)
    with failing(*FAULTS):
        old = read_baseline(file) if file.is_file() else None
    new, outcomes = {}, list[Any]()
    for case, outcome in _outcomes(recordings, options, None, Limits()):
        subject = case.recording.subject if case.recording else ""
        new[case.name] = as_baseline(outcome, case.sha256, case.settings, subject)
        outcomes.append(outcome)
    with writing(file, ". Choose another --baseline.", StoppedEarly):
        file.write_text(baseline_text(joined(old, new, given)), encoding="utf-8")
    if as_json:
        print_json({"baseline": str(file), "recordings": [each.to_json() for each in outcomes]}, allow_nan=False)
        return
    _show(outcomes, ("found", "true"))
    click.echo(f"Baseline  {file}: {count_of(len(new), 'recording')} written. Keep it in version control.")


@command.command(name="check")
@RECORDINGS
@click.option("--baseline", "file", type=PATH, help="From fes timing baseline.")
@SESSION
@HOW_TO_MEASURE
@HOW_TO_JUDGE
def check_command(recordings: tuple[Path, ...], file: Path | None, as_json: bool, **chosen: Any) -> None:
    """Replay and hold against the truth and the baseline.

    Without --baseline and --tolerance-ms nothing is judged: figures only. An earlier log as the truth allows 1 ms.

    Exit code: 0 all is well, 1 a check failed, 2 unusable input, 130 interrupted.
    """
    judging = {name: chosen.pop(name) for name in _JUDGING}
    options = _options(chosen)
    with failing(*FAULTS):
        baseline = read_baseline(file) if file else None
    limits = _limits(judging, baseline)
    outcomes = [outcome for _, outcome in _outcomes(recordings, options, baseline, limits)]
    absent = sorted(set(baseline.recordings) - {each.name for each in outcomes}) if baseline else []
    _finish(outcomes, judging, as_json, ("now", "baseline"), {"not_checked": absent})
    if absent:
        click.secho(f"Of the baseline not checked here: {in_words(absent)}.", fg="yellow", err=True)
    _end(outcomes)


@command.command(name="compare")
@RECORDINGS
@click.option("--session", "sessions", type=PATH, multiple=True, required=True, help="Settings (TOML); give two.")
@HOW_TO_MEASURE
@HOW_TO_JUDGE
def compare_command(recordings: tuple[Path, ...], sessions: tuple[Path, ...], as_json: bool, **chosen: Any) -> None:
    """Two versions of the settings side by side, on the same recordings: differences are second − first.

    Exit code: 0 compared, 1 they differ by more than --tolerance-ms, 2 unusable input.
    """
    if len(sessions) != 2:
        raise Problem(f"name two settings, --session A.toml --session B.toml, not {len(sessions)}")
    judging = {name: chosen.pop(name) for name in _JUDGING}
    one, other = (_options({**chosen, "session": session}) for session in sessions)
    first = {
        case.name: as_baseline(outcome, case.sha256, "") for case, outcome in _outcomes(recordings, one, None, Limits())
    }
    limits = _limits(judging, None)
    outcomes = [outcome for _, outcome in _outcomes(recordings, other, Baseline(first), limits)]
    names = sessions[1].stem, sessions[0].stem
    names = names if names[0] != names[1] else (str(sessions[1]), str(sessions[0]))
    _finish(outcomes, judging, as_json, names, {"first": str(sessions[0]), "second": str(sessions[1])})
    _end([replace(each, judged=bool(limits.tolerance_ms)) for each in outcomes])


_JUDGING: Final = ("tolerance_ms", "allow", "latency_budget_ms", "junit", "out", "no_report")


def _options(chosen: dict[str, Any]) -> Options:
    if chosen["lag_s"] is not None and chosen["sync"] == "fit":
        raise Problem("--lag gives the offset, --sync fit finds it; choose one")
    plates = {}
    for text in chosen.pop("plates"):
        number, _, side = text.partition("=")
        if not number.isdigit() or side not in ("left", "right"):
            raise Problem(f"--plate {text}: say NUMBER=left or NUMBER=right, as 1=left")
        plates[int(number)] = f"{side}_foot"
    return Options(fit=chosen.pop("sync") == "fit", plates=plates or None, **chosen)


def _tolerances(given: Sequence[str]) -> dict[str, float]:
    """Milliseconds by kind; a number alone is for all transitions and edges."""
    found: dict[str, float] = {}
    for text in given:
        name, equals, value = text.rpartition("=")
        wanted = [name] if equals else [kind for kind in KINDS if kind != LATENCY]
        try:
            ms = float(value)
        except ValueError:
            ms = -1.0
        if not 0.0 <= ms < 1e6 or (equals and name not in KINDS):
            raise Problem(f"--tolerance-ms {text}: say MS or NAME=MS; names: {', '.join(KINDS)}")
        found |= dict.fromkeys(wanted, ms)
    return found


def _limits(judging: dict[str, Any], baseline: Baseline | None) -> Limits:
    allowed = dict(baseline.allowed if baseline else ALLOWED)
    for text in judging["allow"]:
        name, _, count = text.partition("=")
        if name not in allowed or not count.isdigit():
            raise Problem(f"--allow {text}: say NAME=COUNT; names: {', '.join(allowed)}")
        allowed[name] = int(count)
    before = baseline.tolerance_ms if baseline else {}
    return Limits({**before, **_tolerances(judging["tolerance_ms"])}, allowed, judging["latency_budget_ms"])


def _outcomes(
    recordings: Sequence[Path], options: Options, baseline: Baseline | None, limits: Limits
) -> list[tuple[Case, RecordingTiming]]:
    found = find_recordings(recordings)
    warm_up()
    done = []
    with failing(*FAULTS):
        for case in cases(found, options):
            outcome, case = judged(case, baseline, limits)
            done.append((replace(case, recording=None), outcome))
            if len(found) > 1:
                click.echo(f"{len(done)} of {len(found)}  {case.name}", err=True)
    return done


def _finish(
    outcomes: Sequence[RecordingTiming],
    judging: dict[str, Any],
    as_json: bool,
    names: tuple[str, str],
    more: dict[str, Any],
) -> None:
    """Write JUnit and the page, and print; ``names``: what is checked, and what it is held against."""
    page = None
    if not judging["no_report"]:
        from fes.report.html import ReportError
        from fes.report.timing import write_timing_pages

        with failing(ReportError, kind=StoppedEarly):
            page = write_timing_pages(outcomes, fresh_folder(judging["out"], "timing"), names)
    if file := judging["junit"]:
        with writing(file, ". Choose another --junit.", StoppedEarly):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(junit(outcomes), encoding="utf-8")
    if as_json:
        files = {"page": str(page) if page else None, "junit": str(file) if file else None}
        print_json({"recordings": [each.to_json() for each in outcomes], **more, "files": files}, allow_nan=False)
        return
    _show(outcomes, names)
    if page:
        click.echo(f"Page  {page}  (open it in a browser)")


def _show(outcomes: Sequence[RecordingTiming], names: tuple[str, str]) -> None:
    console = screen()
    if len(outcomes) > WHOLE_TABLES:
        console.print(_overview(outcomes))
    for each in outcomes:
        if len(outcomes) <= WHOLE_TABLES or each.failures:
            console.print(recording_table(each, names))
        for note in each.notes:
            click.secho(f"{each.name}: {note}.", fg="yellow", err=True)


def _end(outcomes: Sequence[RecordingTiming]) -> None:
    """Say what failed, and end with exit code 1 if anything did."""
    for each in outcomes:
        for failure in each.failures:
            whose = f"{failure.who.replace('_', ' ')} {failure.what}".strip()
            click.secho(f"{each.name}, {whose}, against the {failure.against}: {failure.text}.", fg="red", err=True)
    if any(each.failures for each in outcomes):
        raise SystemExit(FAILED)
    if not any(each.judged for each in outcomes):
        click.secho("Nothing is judged: no --baseline and no --tolerance-ms. These are figures only.", err=True)
        return
    click.secho("Timing: within its bounds.", err=True)


def _overview(outcomes: Sequence[RecordingTiming]) -> RenderableType:
    from fes.report.tables import small_table
    from fes.report.text import number
    from fes.report.timing import totals

    titles = ("events", "missed", "extra", "moved", "worst\nms", "p99\nms", "failed")
    caption = "of the baseline's events; without a baseline, of the truth's."
    table = small_table("Timing", caption, ["recording"], titles)
    for each in outcomes:
        errors = [float(abs(row.error_ms).max()) for row in each.own or each.true if len(row.pairs_ns)]
        shown = [str(count) if count else "·" for count in totals(each).values()]
        shown += [number(max(errors, default=float("nan")), 1), number(each.latency.p99_ms, 2)]
        table.add_row(each.name, *shown, str(len(each.failures) or "·"), style="red" if each.failures else "")
    return table


def recording_table(timing: RecordingTiming, names: tuple[str, str]) -> RenderableType:
    """A row for each kind of mark, at most 80 columns wide, and the latency."""
    from rich.console import Group
    from rich.text import Text

    from fes.report.tables import small_table
    from fes.report.text import number
    from fes.report.timing import row_numbers

    parts: list[RenderableType] = []
    failed = {(f.against, f.who, f.what) for f in timing.failures}
    truth = f"errors: found − true. before: {names[1]}. limits: bias ± 1.96 SD."
    baseline = f"differences: {names[0]} − {names[1]}, event by event. moved: beyond the tolerance."
    of_truth = ("bias\nms", "SD\nms", "limits\nms", "", "before:\nbias", "limits\nms", "")
    of_baseline = ("\nmoved", "mean\nms", "SD\nms", "worst\nms", "tol.\nms")
    for against, rows, title, caption, titles in (
        ("truth", timing.true, f" against {timing.truth}", truth, of_truth),
        ("baseline", timing.own, f": {names[0]} − {names[1]}", baseline, of_baseline),
    ):
        columns = ("exp-\nected", "\nmissed", "\nextra", *titles)
        table = small_table(f"{timing.name}{title}", caption, ["\nwho", "\nwhat"], columns)
        for row in rows:
            counts, values = row_numbers(timing, row, against)
            told = [str(counts[0]), *(str(count) if count else "·" for count in counts[1:])]
            style = "red" if (against, row.who, row.what) in failed else ""
            table.add_row(row.who.replace("_", " "), row.what, *told, *(number(v, 1) for v in values), style=style)
        parts += [table] if rows else []
    late = timing.latency
    before_text = "" if late.p99_before_ms != late.p99_before_ms else f" (before: {late.p99_before_ms:.2f})"
    text = f"Decisions: median {late.p50_ms:.2f} ms, p99 {late.p99_ms:.2f}{before_text}, at most {late.max_ms:.2f}."
    parts.append(Text(text if late.steps else "Decisions: no latency recorded."))
    return Group(*parts)
