"""`fes replay` as a process of its own with a stimulator on a bus: killed, interrupted, repeated."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from processes import alive
from replays import FES, MS, SETTINGS, bursts, run_fes, write_cut

from drivers.simulated.record import RecordEntry, read_record
from drivers.simulated.spawn import NodeHandle, free_bus, spawn_node, why_silent
from fes.cli.common import FAILED, INTERRUPTED, OK, UNUSABLE
from fes.cli.replay.command import repeat
from fes.session_log import read_session

LEASE_MS = 60
MARGIN_MS = 15  # until the node has read what was on its way
BEGUN_NS = 250 * MS  # a burst lasts 1.2 s of the recording, and must not end by itself before a blow has struck
RAISE_S = 0.16

NO_BUS = why_silent(free_bus())
pytestmark = pytest.mark.skipif(bool(NO_BUS), reason=f"no CAN between processes on this machine: {NO_BUS}")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Standing at first, for as long as a session takes to warm up and a person to arm it."""
    return write_cut(tmp_path_factory.mktemp("recording"), end_s=24.0)


@pytest.fixture
def node(tmp_path: Path) -> Iterator[NodeHandle]:
    with spawn_node(record=tmp_path / "node.jsonl") as handle:
        yield handle


def settings_for(node: NodeHandle, folder: Path) -> Path:
    path = folder / "bus.toml"
    bus = f'\n[bus]\ninterface = "{node.bus.interface}"\nchannel = "{node.bus.channel}"\n'
    at_once = SETTINGS.read_text().replace("strides_before_start = 1", "strides_before_start = 0")
    path.write_text(at_once + bus + f"[bus.options]\nport = {node.bus.options['port']}\n")
    return path


def on_the_bus(node: NodeHandle, folder: Path) -> tuple[str | Path, ...]:
    return ("--stimulator", "bus", "--i-have-a-dummy-load", "--session", settings_for(node, folder))


@contextmanager
def operated(folder: Path) -> Iterator[Callable[[], None]]:
    """A person at the control socket, who arms and raises, and arms again where it latches."""
    over = threading.Event()

    def operate() -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
            while not over.wait(RAISE_S):
                for path in folder.glob("cut-*/control.sock"):
                    for ask in ("arm", "up"):
                        with suppress(OSError):
                            link.sendto(json.dumps({"ask": ask, "confirm": True}).encode(), str(path))

    thread = threading.Thread(target=operate)
    thread.start()
    try:
        yield over.set
    finally:
        over.set()
        thread.join()


@contextmanager
def replaying(path: Path, out: Path, *options: str | Path) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [*FES, "replay", str(path), "--out", str(out), "--no-report", *map(str, options)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate(timeout=10)


def wait_for(what: Callable[[], bool], process: subprocess.Popen[str], timeout_s: float = 60.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not what():
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
        assert time.monotonic() < end_s, "it did not come"
        time.sleep(0.005)


def entries_of(path: Path, channel: int = 0) -> list[RecordEntry]:
    return [entry for entry in read_record(path) if entry.channel == channel] if path.is_file() else []


def at_full_current(path: Path) -> bool:
    """In mid-burst, the rise behind it, in a burst that began so lately that it will last."""
    on_ns = None
    entries = entries_of(path)
    for entry in entries:
        on_ns = None if entry.current_ma <= 0.0 else on_ns or entry.t_ns
    return on_ns is not None and entries[-1].current_ma >= 29.0 and time.monotonic_ns() - on_ns <= BEGUN_NS


@pytest.mark.requirement("SR-01")
@pytest.mark.parametrize(
    ("options", "why"),
    [
        ((), "--i-have-a-dummy-load"),
        (("--i-have-a-dummy-load", "--arm-after", "1"), "a person arms"),
        (("--i-have-a-dummy-load", "--rearm-after", "1"), "a person arms"),
        (("--i-have-a-dummy-load", "--speed", "2"), "at recorded speed"),
    ],
)
def test_a_real_device_is_driven_as_a_live_session_or_not_at_all(
    recording: Path, tmp_path: Path, options: tuple[str, ...], why: str
) -> None:
    done = run_fes("replay", recording, "--stimulator", "bus", "--session", SETTINGS, "--out", tmp_path, *options)
    assert done.returncode == UNUSABLE
    assert why in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.requirement("SR-01")
def test_nobody_arms_so_nothing_is_delivered(recording: Path, node: NodeHandle, tmp_path: Path) -> None:
    done = run_fes("replay", recording, *on_the_bus(node, tmp_path), "--no-report", "--out", tmp_path)
    assert done.returncode in (OK, FAILED), done.stderr  # FAILED: this machine held an answer up, and that was said
    assert node.record is not None
    assert not [entry for entry in entries_of(node.record) if entry.current_ma > 0.0]
    (log,) = tmp_path.glob("cut-*/session.feslog")
    assert read_session(log).strides


@pytest.mark.requirement("SR-12")
def test_stopped_and_continued_in_mid_burst_no_current_comes_back(
    recording: Path, node: NodeHandle, tmp_path: Path
) -> None:
    """A process that was held up between deciding and sending must not send what was right before."""
    assert node.record is not None
    options = on_the_bus(node, tmp_path)
    with replaying(recording, tmp_path, *options) as process, operated(tmp_path) as operator_leaves:
        wait_for(lambda: at_full_current(node.record or Path()), process)
        operator_leaves()
        process.send_signal(signal.SIGSTOP)
        stopped_ns = time.monotonic_ns()
        time.sleep(0.3)
        process.send_signal(signal.SIGCONT)
        process.communicate(timeout=60)
    late = [entry for entry in entries_of(node.record) if entry.t_ns > stopped_ns + (LEASE_MS + MARGIN_MS) * MS]
    assert not [entry for entry in late if entry.current_ma > 0.0]
    (log,) = tmp_path.glob("cut-*/session.feslog")
    assert "controller stalled" in " ".join(note.text for note in read_session(log).notes)


@pytest.mark.requirement("SR-12")
def test_killed_in_mid_burst_the_node_is_silent_within_its_lease(
    recording: Path, node: NodeHandle, tmp_path: Path
) -> None:
    """The product's promise: no pulse later than 60 ms after the last command, whatever becomes of the controller."""
    assert node.record is not None
    options = on_the_bus(node, tmp_path)
    with replaying(recording, tmp_path, *options) as process, operated(tmp_path):
        wait_for(lambda: at_full_current(node.record or Path()), process)
        process.kill()
        blow_ns = time.monotonic_ns()
        process.wait(10)
        dead_ns = time.monotonic_ns()
        end_s = time.monotonic() + 5.0
        while entries_of(node.record)[-1].current_ma > 0.0 and time.monotonic() < end_s:
            time.sleep(0.005)
    ended = entries_of(node.record)[-1]
    assert ended.current_ma == 0.0
    # by its lease, or because the replay, held up, said so in its last moment
    assert ended.event == "lease_expired" or ended.t_ns <= dead_ns
    # that no pulse comes after the lease holds to the nanosecond; the node's own wake-up can be held up by the machine
    assert ended.last_pulse_ns < ended.accepted_ns + LEASE_MS * MS
    off_ms = (ended.t_ns - ended.accepted_ns) / MS
    print(f"off {off_ms:.2f} ms after the last accepted command, {(ended.t_ns - blow_ns) / MS:.1f} ms after the blow")
    assert ended.accepted_ns <= blow_ns + MARGIN_MS * MS

    (log,) = tmp_path.glob("cut-*/session.feslog")
    torn = read_session(log)
    assert not torn.complete
    assert any(command.on for command in torn.commands)
    assert repeat(log).difference == ""


@pytest.mark.parametrize("blow", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_in_mid_burst_it_switches_off_before_it_ends(
    recording: Path, node: NodeHandle, tmp_path: Path, blow: signal.Signals
) -> None:
    assert node.record is not None
    options = on_the_bus(node, tmp_path)
    with replaying(recording, tmp_path, *options) as process, operated(tmp_path):
        wait_for(lambda: at_full_current(node.record or Path()), process)
        process.send_signal(blow)
        blow_ns = time.monotonic_ns()
        _, said = process.communicate(timeout=20)
    assert process.returncode == INTERRUPTED, said
    assert "Nothing is stimulated until you arm" in said
    assert "Interrupted; stimulation is off." in said
    assert "Traceback" not in said
    before, ended = entries_of(node.record)[-2:]
    assert before.current_ma > 0.0
    assert ended.current_ma == 0.0
    assert ended.t_ns - blow_ns < 500 * MS
    # told to; by the end of its lease only where the replay was held up before it could, and it told it all the same
    assert ended.event in ("off", "lease_expired")

    (log,) = tmp_path.glob("cut-*/session.feslog")
    record = read_session(log)
    assert record.complete
    assert record.summary["ended"] == "interrupted"
    assert any(command.on for command in record.commands)
    assert not record.commands[-1].on
    assert record.frames[-1].t_ns == record.commands[-1].t_ns
    assert record.notes[-1].text == "interrupted"
    again = repeat(log)
    assert (again.difference, again.commands) == ("", len(record.commands))


def test_the_simulated_node_ends_with_a_killed_replay(recording: Path, tmp_path: Path) -> None:
    options = ("--stimulator", "simulated", "--session", SETTINGS, "--speed", "1")
    with replaying(recording, tmp_path, *options) as process:
        record = tmp_path / "cut-001" / "stimulator.jsonl"
        wait_for(lambda: record.is_file() and bool(read_record(record)), process)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        assert children
        process.kill()
        process.wait(10)
        end_s = time.monotonic() + 10.0
        while any(alive(int(pid)) for pid in children) and time.monotonic() < end_s:
            time.sleep(0.01)
        assert not [pid for pid in children if alive(int(pid))]


def test_a_replay_by_recorded_time_is_delivered_as_sent_and_the_same_twice(recording: Path, tmp_path: Path) -> None:
    runs = []
    for _ in range(2):
        done = run_fes("replay", recording, "--session", SETTINGS, "--no-report", "--json", "--out", tmp_path)
        assert done.returncode == OK, done.stderr
        runs.append(json.loads(done.stdout))
    wires = [run["run_summary"]["wire"] for run in runs]
    assert wires[0] == wires[1]
    assert wires[0]["matched"] == wires[0]["commands"] > 500
    assert (wires[0]["missing"], wires[0]["different"], wires[0]["unasked"]) == (0, 0, 0)
    one, other = (read_session(Path(run["files"]["session_log"])) for run in runs)
    assert one.statuses == other.statuses
    assert [frame for frame in one.frames if frame.identifier != one.frames[0].identifier] == [
        frame for frame in other.frames if frame.identifier != other.frames[0].identifier
    ]
    # 40 Hz as long as it is on, less what is below half a milliampere
    on_s = sum(burst.t_off_ns - burst.t_on_ns for burst in bursts(one.commands)) * 1e-9
    assert wires[0]["pulses"]["0"] == pytest.approx(40.0 * on_s, abs=1.5 * len(bursts(one.commands)))
    assert repeat(Path(runs[0]["files"]["session_log"])).difference == ""


def test_a_replay_slower_than_recorded_is_delivered_as_sent(tmp_path: Path) -> None:
    """Its commands are decided by the recording's time; by the computer's each would be later than the last."""
    settings = tmp_path / "session.toml"
    settings.write_text(SETTINGS.read_text().replace("strides_before_start = 1", "strides_before_start = 0"))
    options = ("--session", settings, "--speed", "0.8", "--no-report", "--json", "--out", tmp_path)
    done = run_fes("replay", write_cut(tmp_path, end_s=14.0), *options)
    assert done.returncode == OK, done.stderr
    run = json.loads(done.stdout)
    assert run["run_summary"]["wire"]["pulses"]["0"] > 20
    assert not [status.fault for status in read_session(Path(run["files"]["session_log"])).statuses if status.fault]


def test_a_stimulator_that_delivers_less_fails_the_replay(recording: Path, tmp_path: Path) -> None:
    with spawn_node(faults="weak=0") as node:
        options = on_the_bus(node, tmp_path)
        with replaying(recording, tmp_path, *options) as process, operated(tmp_path):
            _, said = process.communicate(timeout=60)
    assert process.returncode == FAILED, said
    assert "did not deliver what was sent" in said


def test_a_stimulator_that_goes_silent_is_noticed_within_the_replay(recording: Path, tmp_path: Path) -> None:
    """It stops answering; commands stay without an answer, and the replay does not say that all is well."""
    with spawn_node(record=tmp_path / "node.jsonl") as node:
        options = on_the_bus(node, tmp_path)
        with replaying(recording, tmp_path, *options) as process, operated(tmp_path):
            wait_for(lambda: bool(entries_of(tmp_path / "node.jsonl")), process)
            node.inject("mute", 1)
            _, said = process.communicate(timeout=60)
    assert process.returncode == FAILED, said
    assert "did not deliver what was sent" in said
    assert "Traceback" not in said


def test_nobody_on_the_bus_is_said(recording: Path, node: NodeHandle, tmp_path: Path) -> None:
    settings = settings_for(node, tmp_path)
    node.stop()
    load = "--i-have-a-dummy-load"
    done = run_fes("replay", recording, "--stimulator", "bus", load, "--session", settings, "--out", tmp_path)
    assert done.returncode == UNUSABLE
    assert "no stimulator was heard on" in done.stderr
