"""The commands as a user meets them: exit codes, where words go, and messages that name file, place and fix."""

from __future__ import annotations

import errno
import json
import resource
import subprocess
from collections.abc import Callable
from pathlib import Path

import click
import pytest
import report_records as make
from click.testing import CliRunner, Result
from replays import FES, SETTINGS, TRIALS, both_feet, one_sample_changed, rewritten, run_fes, trial, write_cut
from rich.console import Console
from test_sciencemode_ports import KINDS, MS, Bench, command

import fes.report.page
from drivers.stimulator.p24_port import LowLevelStimulator, MidLevelStimulator
from drivers.stimulator.rehastim2_port import RehaStim2
from drivers.stimulator.sciencemode import ScienceModePort
from fes.cli import main
from fes.cli.common import BROKEN, FAILED, INTERRUPTED, OK, STOPPED, UNUSABLE, Problem, StoppedEarly
from fes.cli.main import COMMANDS, LazyGroup
from fes.cli.replay.stimulators import LoggedLine
from fes.cli.run.command import finish, write_report
from fes.recording import write_recording
from fes.report.summary import summarise
from fes.report.tables import closing_block
from fes.session_log import Note, SessionRecord, SessionWriter, read_session
from fes.signals import OperatorAct, OperatorAction, WireFrame

CSV = TRIALS / "example_csv.csv"


def call(*arguments: str | Path) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def refused(result: Result, code: int, *words: str) -> str:
    """Check that a command ended with this code and one message, no traceback; returns the message."""
    assert result.exit_code == code, result.output
    assert isinstance(result.exception, SystemExit)
    message = result.stderr
    assert "Traceback" not in message
    for word in words:
        assert word in message, message
    return message


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("cli")
    result = call("replay", CSV, "--session", SETTINGS, "--stimulator", "none", "--no-report", "--out", out)
    assert result.exit_code == OK, result.output
    return out / "example_csv-001" / "session.feslog"


def test_help_names_every_command_and_every_command_has_help() -> None:
    result = call("--help")
    assert result.exit_code == OK
    for name in COMMANDS:
        assert f"\n  {name} " in result.stdout
        assert "Usage:" in call(name, "--help").stdout
    assert call("--version").stdout.startswith("fes, version ")
    assert call("nonsense").exit_code == UNUSABLE
    assert "130" in call("replay", "--help").stdout


# --- results ------------------------------------------------------------------------------------------------


def test_a_replay_prints_table_and_summary_and_leaves_log_and_report(tmp_path: Path) -> None:
    result = call("replay", CSV, "--session", SETTINGS, "--stimulator", "none", "--out", tmp_path)
    assert result.exit_code == OK
    folder = tmp_path / "example_csv-001"
    assert sorted(path.name for path in folder.iterdir()) == ["report.html", "session.feslog"]
    assert read_session(folder / "session.feslog").complete
    assert "<html" in (folder / "report.html").read_text(encoding="utf-8")[:500]
    assert "Strides" in result.stdout
    assert "never outside pre-swing" in result.stdout
    widths = [len(line.rstrip()) for line in result.stdout.splitlines() if str(tmp_path) not in line]
    assert 80 < max(widths) <= 110, "a pipe gets lines of a sane width"
    assert "\x1b" not in result.stdout
    assert result.stderr == ""


def test_json_is_json_and_nothing_else_on_stdout(tmp_path: Path) -> None:
    path = write_cut(tmp_path)
    done = call("replay", path, "--stimulator", "none", "--json", "--no-report", "--out", tmp_path)
    assert done.exit_code == OK
    found = json.loads(done.stdout)
    assert found["complete"] is True
    assert Path(found["files"]["session_log"]).is_file()
    assert found["files"]["report"] is None
    assert "Nothing is stimulated" in done.stderr  # no session.toml beside it, and that is said
    assert "Traceback" not in done.stderr


def test_a_reader_that_goes_away_is_no_traceback(log: Path) -> None:
    head = subprocess.Popen(["head", "-c", "10"], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
    done = subprocess.run([*FES, "replay", str(log), "--json"], stdout=head.stdin, stderr=subprocess.PIPE, text=True)
    assert head.stdin is not None
    head.stdin.close()
    head.wait(10)
    assert "Traceback" not in done.stderr


def test_the_session_beside_the_recording_is_used(tmp_path: Path) -> None:
    path = write_cut(tmp_path)
    (tmp_path / "session.toml").write_text(SETTINGS.read_text())
    result = call("replay", path, "--stimulator", "none", "--no-report", "--json", "--out", tmp_path)
    assert json.loads(result.stdout)["channels"][0]["bursts"]
    assert result.stderr == ""


def test_a_log_is_replayed_and_reported(log: Path, tmp_path: Path) -> None:
    result = call("replay", log)
    assert result.exit_code == OK
    assert "commands are the same byte for byte" in result.stderr
    as_json = call("replay", log, "--json")
    assert json.loads(as_json.stdout)["replayed"]["difference"] == ""
    report = call("report", log, "--out", tmp_path / "again.html")
    assert report.exit_code == OK
    assert (tmp_path / "again.html").stat().st_size > 10_000


def test_a_tampered_log_fails_and_says_so(log: Path, tmp_path: Path) -> None:
    at_ns = next(change.t_ns for change in read_session(log).phases if change.destination.name == "SWING")
    changed = rewritten(
        log, tmp_path / "changed.feslog", one_sample_changed(lambda was: was._replace(acc_mps2=(9.0, 9.0, 9.0)), at_ns)
    )
    refused(call("replay", changed), FAILED, "Not the same when replayed", "recorded")
    assert json.loads(call("replay", changed, "--json").stdout)["replayed"]["difference"]


def test_a_torn_log_works_up_to_its_tear(log: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.feslog"
    torn.write_bytes(log.read_bytes()[:-3000])
    result = call("replay", torn)
    assert result.exit_code == OK
    said = " ".join(result.stdout.split())  # wherever the lines were broken
    assert "no proper end" in said
    assert "Lost: the last " in said


# --- refusals -----------------------------------------------------------------------------------------------


def garbage(folder: Path, name: str) -> Path:
    path = folder / name
    path.write_bytes(bytes((number * 131 + number // 7) % 256 for number in range(3000)))
    path.with_suffix(".toml").write_text((TRIALS / "example_csv.toml").read_text())
    return path


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: folder / "none.parquet", ("none.parquet: is not there",)),
        (lambda folder: folder, ("is a folder", ".csv, .parquet")),
        (lambda folder: garbage(folder, "notes.txt"), ("notes.txt: is none of the formats",)),
        (lambda folder: garbage(folder, "g.parquet"), ("g.parquet: is not a Parquet file",)),
        (lambda folder: garbage(folder, "g.csv"), ("g.csv: is binary, not CSV",)),
        (lambda folder: garbage(folder, "g.feslog"), ("g.feslog: is not a session log",)),
        (lambda folder: folder / "none.feslog", ("none.feslog: cannot be read", "Name an existing")),
        (lambda folder: write_cut(folder, 3.0), ("cut.parquet: right_foot: 0 strides", "Record at least five strides")),
    ],
)
def test_unusable_recordings(tmp_path: Path, make: Callable[[Path], Path], words: tuple[str, ...]) -> None:
    path = make(tmp_path)
    result = call("replay", path, *(() if path.suffix == ".feslog" else ("--out", tmp_path / "out")))
    refused(result, UNUSABLE, *words)
    assert result.stdout == ""
    assert not (tmp_path / "out").exists(), "nothing was done"


def test_a_recording_without_its_sidecar_gets_one_to_fill_in(tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text(CSV.read_text())
    refused(
        call("replay", tmp_path / "mine.csv"), UNUSABLE, "mine.toml was missing", "[sensors", "No answer is missing"
    )
    assert call("calibrate", tmp_path / "mine.csv", "--out", tmp_path / "c.json").exit_code == OK


@pytest.mark.parametrize(
    ("was", "becomes", "words"),
    [
        ("current_ma = 30.0", "current_ma = 300.0", ("mine.toml:17: channels[0].current_ma = 300.0", "130")),
        ("current_ma = 30.0", "curent_ma = 30.0", ("mine.toml:17: channels[0].curent_ma", "is not a setting")),
        ("max_on_s = 3.0\n", "", ("channels[0].limits.max_on_s", "missing")),
        ("[stimulation]", "[stimulation", ("mine.toml: is not valid TOML", "line 4")),
        ('foot = "right_foot"', 'foot = "third_foot"', ("mine.toml:14: channels[0].foot", "left_foot")),
    ],
)
def test_wrong_settings_name_line_key_and_what_is_allowed(
    tmp_path: Path, was: str, becomes: str, words: tuple[str, ...]
) -> None:
    settings = tmp_path / "mine.toml"
    text = SETTINGS.read_text()
    assert was in text
    settings.write_text(text.replace(was, becomes, 1))
    refused(call("replay", CSV, "--session", settings, "--out", tmp_path / "out"), UNUSABLE, *words)


def test_missing_settings(tmp_path: Path) -> None:
    refused(call("replay", CSV, "--session", tmp_path / "none.toml"), UNUSABLE, "none.toml: cannot be read")


def test_settings_for_the_other_foot_stimulate_nothing_and_say_so(tmp_path: Path) -> None:
    left = tmp_path / "left.toml"
    left.write_text(SETTINGS.read_text().replace("right", "left"))
    result = call("replay", CSV, "--session", left, "--no-report", "--out", tmp_path)
    assert result.exit_code == OK
    assert "Nothing is stimulated" in result.stderr
    assert "left.toml has no channel for a foot in this recording" in result.stderr


def test_a_channel_without_its_sensor_is_named(tmp_path: Path) -> None:
    both = tmp_path / "both.toml"
    both.write_text(both_feet(SETTINGS.read_text()))
    result = call("replay", CSV, "--session", both, "--stimulator", "none", "--no-report", "--out", tmp_path)
    assert result.exit_code == OK
    assert "Left out, for the recording has no sensor on that foot: Tibialis anterior, left." in result.stderr


@pytest.mark.parametrize("option", [("--speed", "1"), ("--session", "x"), ("--stimulator", "none"), ("--no-report",)])
def test_options_that_mean_nothing_for_a_log_are_refused(log: Path, option: tuple[str, ...]) -> None:
    refused(call("replay", log, *option), UNUSABLE, f"{option[0]} has no meaning for a session log")


@pytest.mark.parametrize(
    "arguments", [("replay",), ("replay", "x", "--speed", "0"), ("replay", "x", "--stimulator", "tens"), ("report",)]
)
def test_wrong_arguments(arguments: tuple[str, ...]) -> None:
    refused(call(*arguments), UNUSABLE, "Usage: ")


NUMBERS = [
    pytest.param(name, option.opts[0], id=f"{name} {option.opts[0]}")
    for name, command in ((name, main.get_command(click.Context(main), name)) for name in COMMANDS)
    for option in (command.params if command else ())
    if isinstance(option.type, click.types.FloatParamType)
]


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
@pytest.mark.parametrize(("name", "option"), NUMBERS)
def test_no_option_takes_what_is_no_number(name: str, option: str, value: str) -> None:
    command = main.get_command(click.Context(main), name)
    arguments = [each for each in (command.params if command else ()) if isinstance(each, click.Argument)]
    result = call(name, f"{option}={value}", *["nowhere"] * len(arguments))
    words = refused(result, UNUSABLE, option)
    assert "finite" in words or "not in the range" in words


def test_results_that_cannot_be_written(log: Path, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    refused(call("replay", CSV, "--out", file), UNUSABLE, "file: is a file", "--out")
    refused(call("replay", CSV, "--out", "/proc/nowhere"), UNUSABLE, "/proc/nowhere", "--out")
    refused(call("report", log, "--out", "/proc/nowhere/r.html"), UNUSABLE, "/proc/nowhere/r.html", "--out")
    refused(call("trials", "/proc/nowhere"), UNUSABLE, "/proc/nowhere: cannot be written")


def full_disk(size: int) -> Callable[[], None]:
    """No file may grow over so many bytes, as on a full disk."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def test_a_full_disk_ends_the_session_and_keeps_what_there_is(tmp_path: Path) -> None:
    path = write_cut(tmp_path)
    run_fes("replay", path, "--session", SETTINGS, "--stimulator", "none", "--out", tmp_path / "compiled")
    done = run_fes(  # the limit holds for the compiler's files too, so all is compiled by now
        "replay", path, "--session", SETTINGS, "--stimulator", "none", "--out", tmp_path, preexec_fn=full_disk(100_000)
    )
    assert done.returncode == STOPPED
    assert "cannot be written any more" in done.stderr
    assert "make room" in done.stderr
    assert "Traceback" not in done.stderr
    left = tmp_path / "cut-001" / "session.feslog"
    record = read_session(left)
    assert not record.complete
    assert record.samples["right_foot"].t_ns.size > 1000
    assert call("replay", left).exit_code == OK  # the same bytes as far as they go


def test_a_report_that_finds_no_room_leaves_the_log_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(fes.report.page, "write_report", full)
    result = call("replay", CSV, "--session", SETTINGS, "--stimulator", "none", "--out", tmp_path)
    refused(result, STOPPED, "report.html: cannot be written: No space left", "`fes report ")
    assert read_session(tmp_path / "example_csv-001" / "session.feslog").complete


# --- the unforeseen -----------------------------------------------------------------------------------------


def group_with(error: BaseException) -> LazyGroup:
    def fail() -> None:
        raise error

    class Group(LazyGroup):
        def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
            return click.Command(cmd_name, callback=fail)

    return Group(name="fes")


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (ZeroDivisionError("oops"), BROKEN, "ZeroDivisionError at test_cli.py"),
        (MemoryError(), BROKEN, "MemoryError"),
        (KeyboardInterrupt(), INTERRUPTED, "Interrupted."),
        (Problem("said already"), UNUSABLE, "Error: said already"),
    ],
)
def test_no_error_ends_in_a_traceback(error: BaseException, code: int, says: str) -> None:
    result = CliRunner().invoke(group_with(error), ["x"])
    assert result.exit_code == code
    assert says in result.stderr
    assert "Traceback" not in result.stderr


def test_the_trace_is_there_for_who_wants_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FES_TRACEBACK", "1")
    assert isinstance(CliRunner().invoke(group_with(ZeroDivisionError("oops")), ["x"]).exception, ZeroDivisionError)


def test_trials_come_out_as_they_are_bundled(tmp_path: Path) -> None:
    assert call("trials", tmp_path, "--only", "example_csv").exit_code == OK
    assert (tmp_path / CSV.name).read_bytes() == CSV.read_bytes()


def test_a_recording_written_by_fes_is_replayed_by_fes(tmp_path: Path) -> None:
    write_recording(trial("example_csv"), tmp_path / "again.parquet")
    assert call("replay", tmp_path / "again.parquet", "--no-report", "--out", tmp_path).exit_code == OK


# --- What `fes run` says and writes at its end ---


def said_of(record: SessionRecord) -> list[str]:
    console = Console(width=200, record=True)
    console.print(closing_block(summarise(record)))
    return console.export_text().splitlines()


def test_a_good_session_is_told_in_a_few_lines() -> None:
    record = make.walk(20)
    record.acts = [OperatorAct(make.at(1.0), OperatorAction.TEST_BURST, 0.0)]
    lines = said_of(record)
    assert len(lines) <= 10
    text = "\n".join(lines)
    assert "left foot: 20 strides (20 valid), 0.63 ± 0.02 m" in text
    assert "TA left: 18 bursts" in text
    assert "mC" in text
    assert "by hand: 1 test burst" in text
    assert lines[-1].startswith("✓ no fault")


def test_what_to_look_at_comes_with_it_and_what_is_much_is_counted() -> None:
    record = make.walk(20)
    record.notes += [Note(make.at(t_s), "fault", "gate", "controller stalled for 50 ms") for t_s in (3, 4)]
    record.complete = False
    for number in range(12):
        record.summary[f"check {number}"] = {}
    lines = said_of(record)
    assert len(lines) <= 14
    assert any("2 faults noted" in line and "Close other programs" in line for line in lines)
    assert any("no proper end" in line for line in lines)
    assert not any("no fault" in line for line in lines)


def write_log(record: SessionRecord, path: Path) -> Path:
    log = SessionWriter(path, record.header)
    for change in record.phases:
        log.phase(change)
    for stride in record.strides:
        log.stride(stride)
    log.close({"ended": "complete"})
    return path


def test_the_report_stands_beside_the_log_and_what_happened_is_said(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write_report(write_log(make.walk(6), tmp_path / "session.feslog"))
    said = capfd.readouterr().out
    assert "left foot: 6 strides (6 valid)" in said
    assert (tmp_path / "report.html").read_text(encoding="utf-8").count("<html") == 1


def test_an_alarm_comes_before_the_report_and_is_followed_by_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr("fes.cli.run.command.write_report", lambda path: said.append(capfd.readouterr().err))
    with pytest.raises(StoppedEarly):
        finish(tmp_path / "session.feslog", "the disk is full", report=True)
    assert len(said) == 1
    assert "ALARM" in said[0]


def test_a_log_of_which_no_report_can_be_made_ends_in_words(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_report(tmp_path / "session.feslog")
    said = capfd.readouterr()
    assert "There is no report" in said.err
    assert "Traceback" not in said.out + said.err


# --- A serial port told again what it was told and what it heard sends the same bytes ---


@pytest.mark.parametrize("silent", [(), (20, 24), (20, 40)], ids=["well", "two answers lost", "mute for 0.4 s"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_was_heard_decides_what_goes_out(kind: str, silent: tuple[int, ...]) -> None:
    bench, line = Bench(kind), LoggedLine()
    if kind == "low":
        again: ScienceModePort = LowLevelStimulator(line, 7)
    elif kind == "mid":
        again = MidLevelStimulator(line, 7, accept_watchdog_s=2.0)
    else:
        again = RehaStim2(line, 7, (1,))
    again.resume(bench.handshake.frames)
    sent: list[WireFrame] = []
    repeated: list[WireFrame] = []
    withheld = 0  # pulses that the queue had no room for
    for turn in range(60):
        bench.line.faults.set("mute", float(bool(silent) and silent[0] <= turn < silent[1]))
        one = command(bench.t_ns, on=turn % 30 < 25, current_ma=5.0 + turn % 3)
        sent.append(bench.port.send(one))
        repeated.append(again.send(one))
        for _ in range(10):
            bench.line.advance(bench.t_ns + 2 * MS)
            events = bench.port.poll(bench.t_ns)
            withheld += sum("none was added" in event.fault for event in events)
            line.brings += bench.port.heard
            assert again.poll(bench.t_ns) == events
    assert repeated == sent
    assert bool(withheld) == bool(silent)
