"""`fes run` refuses what cannot run, and its loop loads nothing heavy."""

from __future__ import annotations

import itertools
import math
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner
from hypothesis import example, given
from hypothesis import strategies as st
from live_parts import MS, FakeStimulator, Lost
from replays import SETTINGS, trial
from test_live_operator import CALIBRATION, FOOT, RATE_HZ, Bench, settings

from fes.cli.common import UNUSABLE
from fes.cli.run.command import command
from fes.cli.run.devices import stop_switch_settings
from fes.config import ConfigError, ImuDevice, load_session
from fes.live.commands import CURRENT_ALLOWED, TABLE, Cause, OperatorCommand, SessionMachine, State
from fes.live.commands import CommandKind as Kind
from fes.live.inputs import Keyboard, StopFile
from fes.live.log_pipe import PipedLog
from fes.live.operator import ASKED
from fes.live.session import Calibrating, LiveSession
from fes.live.source import LiveStimulator
from fes.session_log import read_session
from fes.signals import Event, ImuSample, OperatorAct, OperatorAction, SystemFault, Vector3

SENSOR = (
    '[[sensors]]\nsensor = "right_foot"\ndevice = "xbus"\nport = "/dev/nothing-here"\nrate_hz = 100\n'
    "acc_range_g = 16\ngyr_range_dps = 2000\n"
)
LIMITS = [
    "max_current_ma",
    "max_pulse_width_us",
    "max_frequency_hz",
    "max_charge_per_phase_uc",
    "max_current_density_ma_per_cm2",
    "max_rise_ma_per_s",
    "max_on_s",
    "min_off_s",
]


def run(folder: Path, text: str, *options: str) -> tuple[int, str]:
    path = folder / "session.toml"
    path.write_text(text)
    done = CliRunner().invoke(command, [str(path), "--out", str(folder / "out"), *options])
    return done.exit_code, done.output


@pytest.mark.parametrize("limit", LIMITS)
def test_a_missing_limit_means_refusing_to_start(tmp_path: Path, limit: str) -> None:
    text = "\n".join(line for line in SETTINGS.read_text().splitlines() if not line.startswith(limit))
    code, said = run(tmp_path, f"{text}\n{SENSOR}")
    assert code == UNUSABLE
    assert f"{limit}: is required and missing" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "stored", "names"),
    [
        ("", "", "[[sensors]]"),
        (SENSOR.replace("right", "left"), "", "right_foot"),  # which a channel follows
        (f"\n{SENSOR}", "", "/dev/nothing-here"),
        (f"\n{SENSOR}", "{}", "c.json"),
    ],
    ids=["no sensors", "a channel without one", "one that cannot be opened", "a calibration that is none"],
)
def test_what_cannot_run_is_refused_with_its_name(tmp_path: Path, text: str, stored: str, names: str) -> None:
    (tmp_path / "c.json").write_text(stored)
    options = ["--calibration", str(tmp_path / "c.json")] if stored else []
    code, said = run(tmp_path, SETTINGS.read_text() + text, *options)
    assert code == UNUSABLE
    assert names in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("can_bit:0x1F0:3", ("can_bit", 0x1F0, 3, "high")),
        ("can_bit:496:3:low", ("can_bit", 496, 3, "low")),
        ("serial_cts:/dev/ttyUSB0", ("serial_cts", 0, 0, "high")),
        ("serial_dsr:socket://host:5000:low", ("serial_dsr", 0, 0, "low")),
    ],
)
def test_a_stop_button_is_described_in_one_word(text: str, expected: tuple[str, int, int, str]) -> None:
    settings = stop_switch_settings(text)
    assert (settings.source, settings.identifier, settings.bit, settings.pressed) == expected
    if text.startswith("serial"):
        assert settings.port == text.removesuffix(":low").split(":", 1)[1]


@pytest.mark.parametrize("text", ["", "can_bit", "can_bit:9999:1", "can_bit:1:64", "can_bit:x:1", "gpio:3"])
def test_what_is_no_stop_button_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="must be can_bit"):
        stop_switch_settings(text)


def test_the_live_loop_loads_nothing_heavy() -> None:
    heavy = ("pandas", "pyarrow", "jinja2", "scipy.linalg", "scipy.signal", "rich.live", "matplotlib")
    code = f"import fes.cli.run.command, sys; print([name for name in {heavy!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


# --- Calibration at a session's beginning: found from the newest minute, whatever came before it ---


NS_PER_S = 1_000_000_000


def standing_then_walking(stand_s: float) -> tuple[Calibrating, Iterator[ImuSample]]:
    """A calibration of one foot, and its samples: the first half second again and again, then the walk."""
    recording = trial("negard_patient2")
    ((foot, track),) = recording.tracks.items()
    device = ImuDevice(sensor=foot, device="xbus", port="x", rate_hz=track.rate_hz, acc_range_g=16, gyr_range_dps=2000)
    settings = load_session(SETTINGS).model_copy(update={"sensors": (device,)})
    step_ns, half = round(NS_PER_S / track.rate_hz), int(track.rate_hz / 2)

    def samples() -> Iterator[ImuSample]:
        standing = [number % half for number in range(int(stand_s * track.rate_hz))]
        for number, row in enumerate([*standing, *range(len(track.t_ns))]):
            acc, gyr = track.acc_mps2[row].tolist(), track.gyr_radps[row].tolist()
            yield ImuSample(number * step_ns, foot, number * step_ns, tuple(acc), tuple(gyr))

    return Calibrating(settings, 6), samples()


def give(finding: Calibrating, sample: ImuSample) -> None:
    finding.add_event(sample)
    if finding._thread is not None:  # what it tries is done before the next sample: the test knows no race
        finding._thread.join()


def test_who_stands_for_over_a_minute_first_is_calibrated_all_the_same() -> None:
    finding, samples = standing_then_walking(70.0)
    for sample in samples:
        give(finding, sample)
        if finding.done:
            return
    raise AssertionError(finding.message)


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_sample_that_is_no_number_is_left_out(wrong: float) -> None:
    finding, samples = standing_then_walking(2.0)
    for number, sample in enumerate(samples):
        spoilt: Vector3 = (0.0, wrong, 0.0)
        if number == 100:
            sample = ImuSample(sample.t_ns, sample.sensor, sample.t_sensor_ns, spoilt, sample.gyr_radps)
        if number == 110:
            sample = ImuSample(sample.t_ns, sample.sensor, sample.t_sensor_ns, sample.acc_mps2, spoilt)
        give(finding, sample)
        if finding.done:
            return
    raise AssertionError(finding.message)


# --- The session's states: every cause in every state, and no way to current but by hand ---


LATCHED = (State.STOPPED, State.FAULT)


@pytest.mark.parametrize(("state", "cause"), list(itertools.product(State, Cause)))
def test_every_cause_in_every_state_does_what_the_table_says(state: State, cause: Cause) -> None:
    machine = SessionMachine()
    machine.state = state
    rows = [row for row in TABLE if (row.source, row.cause) == (state, cause)]
    assert len(rows) <= 1
    assert machine.may(cause) is bool(rows)
    assert machine.move(cause) is bool(rows)
    assert machine.state is (rows[0].destination if rows else state)


@pytest.mark.requirement("SR-01")
def test_only_arming_by_hand_leads_to_current() -> None:
    into = [row for row in TABLE if row.destination in CURRENT_ALLOWED and row.source not in CURRENT_ALLOWED]
    assert {row.cause for row in into} == {Cause.ARM}
    assert {row.source for row in into} == {State.SHADOW, State.PAUSED, *LATCHED}


@pytest.mark.requirement("SR-01")
def test_a_latch_is_left_only_by_hand() -> None:
    for state in LATCHED:
        out = {row.cause for row in TABLE if row.source is state and row.destination not in LATCHED}
        assert out == {Cause.ARM, Cause.QUIT}


@pytest.mark.requirement("SR-01", "SR-16")
@pytest.mark.parametrize("state", sorted(CURRENT_ALLOWED))
@pytest.mark.parametrize("cause", [Cause.STOP, Cause.FAULT, Cause.PAUSE, Cause.DISARM, Cause.QUIT])
def test_from_current_every_way_off_is_open(state: State, cause: Cause) -> None:
    machine = SessionMachine()
    machine.state = state
    assert machine.move(cause)
    assert machine.state not in CURRENT_ALLOWED


@pytest.mark.requirement("SR-01")
@given(st.lists(st.sampled_from(list(Cause))))
def test_without_an_arm_after_the_last_stop_there_is_no_current(causes: list[Cause]) -> None:
    machine = SessionMachine()
    for cause in causes:
        machine.move(cause)
    offs = [number for number, cause in enumerate(causes) if cause in (Cause.STOP, Cause.FAULT)]
    since = causes[offs[-1] + 1 :] if offs else causes
    if Cause.ARM not in since:
        assert machine.state not in CURRENT_ALLOWED


# --- After a sensor's fault, arming asks for proof that it is gone: a tap that is seen when it happens ---


LOST = f"{FOOT}: sensor lost: unplugged"


class TappedBench(Bench):
    """Its sensor was lost and came back; ``late_ms`` is how late its data come since."""

    def __init__(self, late_ms: int = 0) -> None:
        super().__init__()
        self.late_ms = late_ms
        self.armed()
        self.handle(SystemFault(self.t_ns, LOST))
        assert self.operator.state is State.FAULT
        self.stand(2.0)

    def tap(self) -> None:
        """It shows for 60 ms, as late as the data come."""
        self.stand(0.001 * self.late_ms)
        for _ in range(6):
            self.t_ns += 10 * MS
            self.handle(
                ImuSample(
                    self.t_ns, FOOT, self.t_ns, (0.0, 0.0, 9.81 + 1e-12 * self.t_ns), (2.0, 1e-9 * self.t_ns, 0.0)
                )
            )

    def tap_and_press(self) -> None:
        """Both in the same moment."""
        assert self.command(Kind.ARM) == []
        self.tap()


@pytest.mark.requirement("SR-27")
def test_the_key_alone_does_not_arm_after_a_sensors_fault() -> None:
    bench = TappedBench()
    for _ in range(3):
        assert bench.command(Kind.ARM) == []
        assert ASKED in bench.operator.message
        bench.stand(3.0)
        assert "no tap" in bench.operator.message
        assert not bench.gate.armed


@pytest.mark.requirement("SR-27")
def test_a_tap_with_the_key_is_the_proof_and_then_the_key_arms() -> None:
    bench = TappedBench()
    bench.tap_and_press()
    assert "the tap was seen" in bench.operator.message
    assert not bench.gate.armed
    assert bench.command(Kind.ARM) == []
    assert "moves" in bench.operator.message, "it must rest again"
    bench.stand(1.1)
    bench.command(Kind.ARM)
    assert bench.gate.armed, bench.operator.message
    assert any("a tap seen +10 ms from the key" in note.text for note in bench.notes)
    bench.handle(SystemFault(bench.t_ns, LOST))  # and the next fault asks anew
    bench.stand(2.0)
    assert bench.command(Kind.ARM) == []


@pytest.mark.requirement("SR-27")
def test_a_tap_just_before_the_key_counts_and_one_long_before_does_not() -> None:
    bench = TappedBench()
    bench.tap()
    bench.command(Kind.ARM)
    bench.stand(0.02)
    assert "the tap was seen" in bench.operator.message
    other = TappedBench()
    other.tap()
    other.stand(0.1)
    other.command(Kind.ARM)
    other.stand(3.0)
    assert "no tap" in other.operator.message


@pytest.mark.requirement("SR-27")
@pytest.mark.parametrize("late_ms", [50, 100, 600])
def test_data_that_come_late_are_told_by_their_tap(late_ms: int) -> None:
    bench = TappedBench(late_ms)
    bench.tap_and_press()
    assert f"seen {late_ms + 10} ms after the key" in bench.operator.message
    bench.stand(1.1)
    assert bench.command(Kind.ARM) == []
    assert not bench.gate.armed


@pytest.mark.requirement("SR-27")
def test_who_taps_again_and_again_does_not_meet_a_delay_by_chance() -> None:
    bench = TappedBench()
    for number in range(20):
        bench.tap()
        bench.stand(0.54)
        if number:  # the tap before is seen now, by a line that is 0.6 s late
            bench.command(Kind.ARM)
    bench.stand(3.0)
    assert FOOT in bench.gate.doubted


@pytest.mark.requirement("SR-27")
@pytest.mark.parametrize("what", ["non-finite", "frozen", "turned"])
def test_every_fault_of_a_sensor_that_a_channel_follows_asks_for_it(what: str) -> None:
    bench = Bench().armed()
    nan = float("nan")
    for _ in range(round(0.3 * RATE_HZ)):
        bench.t_ns += 10 * MS
        force = {"non-finite": (nan, nan, nan), "frozen": (0.0, 0.0, 9.8), "turned": (0.0, 0.0, 9.8)}[what]
        rate = (0.0, 0.0, 50.0 + 1e-9 * bench.t_ns) if what == "turned" else (0.0, 0.0, 0.0)
        bench.handle(ImuSample(bench.t_ns, FOOT, bench.t_ns, force, rate))
    assert bench.gate.doubted == {FOOT}
    bench.stand(2.0)
    assert bench.command(Kind.ARM) == []


def test_a_stop_and_a_stimulators_fault_are_no_fault_of_a_sensor() -> None:
    bench = Bench().armed()
    bench.command(Kind.STOP)
    bench.handle(SystemFault(bench.t_ns, "stimulator lost: unplugged"))
    bench.stand(2.0)
    bench.command(Kind.ARM)
    assert bench.gate.armed


# --- Keys over real pseudo-terminals: the terminal's mode, what is left of it, what counts as a command ---


SESSION = """
import os, sys, time
from fes.live.inputs import Keyboard, Terminal
with Terminal(0):
    keys = Keyboard(0, lambda command, t_ns: [command.kind])
    print("ready", flush=True)
    asked = []
    while not asked:
        asked = keys.read_events(0)
        time.sleep(0.005)
    print("asked", *asked, flush=True)
    keys.close()
"""


@pytest.fixture
def pair() -> Iterator[tuple[int, int]]:
    master, slave = pty.openpty()
    yield master, slave
    os.close(master)
    os.close(slave)


class Carried:
    """Keeps the commands."""

    def __init__(self) -> None:
        self.commands: list[OperatorCommand] = []

    def __call__(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        self.commands.append(command)
        return []

    @property
    def asks(self) -> list[Kind]:
        return [command.kind for command in self.commands]


def read_until(master: int, text: bytes, timeout_s: float = 20.0) -> bytes:
    heard, end_s = b"", time.monotonic() + timeout_s
    while text not in heard:
        assert time.monotonic() < end_s, heard
        if select.select([master], [], [], 0.1)[0]:
            heard += os.read(master, 4096)
    return heard


def wait_for(what: Callable[[], bool], timeout_s: float = 10.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not what():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def waits_for_enter(descriptor: int) -> bool:
    return bool(termios.tcgetattr(descriptor)[3] & termios.ICANON)


@pytest.mark.requirement("SR-16")
def test_after_ctrl_z_and_fg_the_space_bar_stops_without_enter() -> None:
    """The shell's part, which stops the job, takes the terminal back into its own mode and goes on, is played here."""
    pid, master = pty.fork()
    if pid == 0:
        os.execv(sys.executable, [sys.executable, "-c", SESSION])
    try:
        read_until(master, b"ready")
        assert not waits_for_enter(master)
        os.kill(pid, signal.SIGSTOP)
        assert os.WIFSTOPPED(os.waitpid(pid, os.WUNTRACED)[1])
        mode = termios.tcgetattr(master)
        mode[3] |= termios.ICANON | termios.ECHO
        termios.tcsetattr(master, termios.TCSANOW, mode)
        os.kill(pid, signal.SIGCONT)
        wait_for(lambda: not waits_for_enter(master))
        os.write(master, b" ")
        read_until(master, b"asked stop")
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(master)


def test_the_terminal_is_left_as_it_was(pair: tuple[int, int]) -> None:
    """Its mode, and that reading from it waits, which the shell and the view share."""
    master, slave = pair
    session = subprocess.Popen((sys.executable, "-c", SESSION), stdin=slave, stdout=slave)
    read_until(master, b"ready")
    assert os.get_blocking(slave), "nor is it changed meanwhile"
    assert not waits_for_enter(slave)
    os.write(master, b" ")
    assert session.wait(10) == 0
    assert os.get_blocking(slave)
    assert waits_for_enter(slave)


def test_a_pipe_is_left_as_it_was() -> None:
    read_end, write_end = os.pipe()
    carried = Carried()
    keys = Keyboard(read_end, carried)
    assert keys.read_events(0) == []  # and does not wait
    os.write(write_end, b"p")
    keys.read_events(0)
    assert carried.asks == [Kind.PAUSE]
    keys.close()
    keys.close()
    assert os.get_blocking(read_end)
    assert (keys.fileno(), keys.read_events(0)) == (None, [])
    os.close(read_end)
    os.close(write_end)


def test_a_terminal_that_has_gone_is_the_end_of_the_keys() -> None:
    master, slave = pty.openpty()
    keys = Keyboard(slave, Carried())
    os.close(master)
    assert keys.read_events(0) == []
    assert keys.fileno() is None
    keys.close()
    os.close(slave)


SEQUENCES = {
    "Shift+Down in rxvt": b"\x1b[b",
    "Delete": b"\x1b[3~",
    "Ctrl+Up": b"\x1b[1;5A",
    "Ctrl+Up in rxvt": b"\x1bOa",
    "Alt+a": b"\x1ba",
    "keypad 0": b"\x1bOp",
    "F5": b"\x1b[15~",
    "F1 on a Linux console": b"\x1b[[A",
    "F1 with eight-bit controls": b"\x8fP",
    "Shift+Down with eight-bit controls": b"\x9bb",
}
AGAIN_MS = 200


def typed_in_pieces(pieces: list[tuple[bytes, int]]) -> list[Kind]:
    """What keys command that come over a pipe, each piece so many ms after the one before."""
    read_end, write_end = os.pipe()
    carried, t_ns = Carried(), 0
    keys = Keyboard(read_end, carried)
    for piece, pause_ms in pieces:
        t_ns += pause_ms * 1_000_000
        os.write(write_end, piece)
        keys.read_events(t_ns)
    os.close(write_end)
    keys.close()
    os.close(read_end)
    return carried.asks


@pytest.mark.parametrize("name", SEQUENCES)
def test_a_key_that_is_no_letter_is_no_order_however_its_bytes_come(name: str) -> None:
    sequence = SEQUENCES[name]
    assert typed_in_pieces([(sequence, 0)]) == []
    for cut in range(1, len(sequence)):
        assert typed_in_pieces([(sequence[:cut], 0), (sequence[cut:], 30)]) == []
        assert typed_in_pieces([(sequence[:cut], 0), (b" ", 1), (sequence[cut:], 30)]) == [Kind.STOP]
    assert typed_in_pieces([(sequence, 0), (b"p", AGAIN_MS)]) == [Kind.PAUSE], "and then keys count again"


@pytest.mark.requirement("SR-16")
@given(st.binary(max_size=60), st.lists(st.integers(1, 59), max_size=4))
@example(b"[b a", [1, 2])
@example(b"a\x1b", [1])  # the end of one sequence and the beginning of the next in one piece
def test_behind_an_escape_nothing_is_an_order_but_a_stop_always(rest: bytes, cuts: list[int]) -> None:
    typed = b"\x1b" + rest
    edges = [0, *sorted(set(cuts)), len(typed)]
    pieces = [typed[a:b] for a, b in itertools.pairwise(edges) if typed[a:b]]
    asked = typed_in_pieces([(piece, 40 * bool(number)) for number, piece in enumerate(pieces)])
    assert set(asked) == ({Kind.STOP} if b" " in rest else set())


@pytest.mark.requirement("SR-16")
@given(st.binary(max_size=60), st.binary(max_size=60))
def test_a_space_anywhere_is_a_stop_and_comes_first(before: bytes, after: bytes) -> None:
    assert typed_in_pieces([(before + b" " + after, 0)])[0] is Kind.STOP


# --- The keyboard, and with it the stop key, goes in mid-session ---


@pytest.fixture
def live(tmp_path: Path) -> Iterator[LiveSession]:
    log = PipedLog(tmp_path / "session.feslog", {})
    stimulator = LiveStimulator(FakeStimulator(), Lost, time.monotonic_ns)
    yield LiveSession(settings(), {FOOT: CALIBRATION}, log, stimulator, time.monotonic_ns)
    log.close({})


def without_keys(live: LiveSession) -> list[object]:
    """What their end makes happen."""
    read_end, write_end = os.pipe()
    os.close(write_end)
    live.add_keys(read_end)
    keys = live._inputs[-1]
    events = [*keys.read_events(5), *keys.read_events(6)]
    for event in events:
        live.runner.handle(event)
        live.operator.follow(event)
    os.close(read_end)
    return list(events)


def test_it_is_noted_and_shown_with_what_else_stops(live: LiveSession, tmp_path: Path) -> None:
    live.add_input(StopFile(tmp_path / "stop", live.operator.execute))
    live.add_control(tmp_path / "c.sock")
    assert without_keys(live) == []
    said = "the keyboard is gone; stop by file or control socket"
    assert live.operator.message == said
    assert said in live.notices.now(0), "with every status from now on"
    assert live.operator.state is not State.STOPPED
    live._log.close({})
    (note,) = [note for note in read_session(tmp_path / "session.feslog").notes if note.severity == "warning"]
    assert note.text == said


@pytest.mark.requirement("SR-16")
def test_where_nothing_else_stops_it_is_a_stop_and_nothing_arms(live: LiveSession) -> None:
    assert without_keys(live) == [OperatorAct(5, OperatorAction.EMERGENCY_STOP)]
    assert live.operator.state is State.STOPPED
    assert live.gate.latched == "emergency stop"
    assert "the keyboard is gone, and there is no other stop" in "; ".join(live.operator.reasons_not_ready(7))
