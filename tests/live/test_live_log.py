"""The log written by a process of its own: nothing waits for it, nothing that was sent is lost."""

from __future__ import annotations

import errno
import os
import pty
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from processes import gone_after_s

from fes.cli.run.command import is_whole
from fes.live.log_pipe import LATE_NS, PipedLog
from fes.live.monitor import Monitor
from fes.session_log import Note, SessionLogError, iter_events, read_session
from fes.signals import FootSwitchEvent, ImuSample, StimOpened, SystemFault, Tick

MS = 1_000_000


def sample(number: int) -> ImuSample:
    return ImuSample(number * 2 * MS, "left_foot", number * 2 * MS, (0.1 * number, 0.0, 9.81), (0.0, 0.01, 0.0))


@pytest.fixture
def log(tmp_path: Path) -> Iterator[PipedLog]:
    opened = PipedLog(tmp_path / "session.feslog", {"kind": "live"})
    yield opened
    if opened.process.poll() is None:
        opened.process.kill()
        opened.process.wait(5)


def write(log: PipedLog, count: int = 500) -> None:
    """So many samples are sent, and its writer has answered for them; the file may hold half a chunk before."""
    for number in range(count):
        log.event(sample(number))
    log.flush()
    while log._written < log._sent:
        log.flush_due(time.monotonic_ns())
        time.sleep(0.005)


def wait_for_failure(log: PipedLog, timeout_s: float = 5.0) -> tuple[str, float]:
    """What is said, and how long after the start."""
    begin_s = time.monotonic()
    while time.monotonic() - begin_s < timeout_s:
        try:
            log.event(Tick(time.monotonic_ns()))
            log.flush_due(time.monotonic_ns())
        except SessionLogError as error:
            return str(error), time.monotonic() - begin_s
        time.sleep(0.005)
    raise AssertionError("it did not fail")


def test_what_is_logged_is_read_back(log: PipedLog) -> None:
    events = [
        *(sample(number) for number in range(500)),
        StimOpened(2000 * MS, 4711),
        FootSwitchEvent(2001 * MS, "right_foot", True),
        FootSwitchEvent(2001 * MS, "right_foot", None),
        SystemFault(2002 * MS, "left_foot: sensor lost: größer"),
    ]
    for event in events:
        log.event(event)
        log.flush_due(time.monotonic_ns())
    log.close({"ended": "complete"})
    assert list(iter_events(log.path)) == events
    record = read_session(log.path)
    assert record.complete
    assert record.summary == {"ended": "complete"}
    assert (record.reopened, record.switches, record.faults) == (events[-4:-3], events[-3:-1], events[-1:])
    log.close({})  # again: nothing
    with pytest.raises(SessionLogError, match="closed"):
        log.event(sample(1))


def test_a_controller_that_is_gone_with_answers_unread_costs_nothing(log: PipedLog) -> None:
    """As after a kill: the socket is reset, and all that was sent is in the file all the same."""
    for number in range(2000):
        log.event(sample(number))
        if number % 20 == 0:
            log.flush()
    log.flush()
    log._link.close()
    assert log.process.wait(10) == 0
    assert len(list(iter_events(log.path))) == 2000
    log._fault = "closed by the test"


def test_a_note_with_what_is_no_unicode_is_logged_all_the_same(log: PipedLog) -> None:
    Monitor(log, {}, {}, None).note(Note(5, "warning", "session", f"no {os.fsdecode(bytes([0xF6]))} größer"))
    log.close({"ended": "complete"})
    (note,) = read_session(log.path).notes
    assert note.text == "no \\udcf6 größer"


@pytest.mark.requirement("SR-18")
def test_an_existing_log_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "session.feslog"
    path.write_bytes(b"precious")
    with pytest.raises(SessionLogError, match="not overwritten"):
        PipedLog(path, {})
    assert path.read_bytes() == b"precious"


@pytest.mark.requirement("SR-18")
def test_a_dead_writer_is_noticed_within_a_second_and_what_it_had_is_there(log: PipedLog) -> None:
    write(log)
    kept = log.path.stat().st_size
    os.kill(log.process.pid, signal.SIGKILL)
    said, after_s = wait_for_failure(log)
    assert after_s < 1.0
    assert "cannot be written any more" in said
    assert log.healthy == said
    with pytest.raises(SessionLogError):
        log.close({})
    assert log.path.stat().st_size == kept
    assert len(list(iter_events(log.path))) == 500


def test_a_writer_that_hangs_is_noticed_and_nobody_waits_for_it(log: PipedLog) -> None:
    resource = pytest.importorskip("resource")
    os.kill(log.process.pid, signal.SIGSTOP)
    begin_s, said, waits = time.monotonic(), "", []
    for number in range(1_000_000):
        waited, before_s = resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw, time.monotonic()
        try:
            log.event(sample(number))
            log.flush_due(time.monotonic_ns())
        except SessionLogError as error:
            said = str(error)
            break
        if resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw > waited:  # not where the machine merely held us up
            waits.append(time.monotonic() - before_s)
    assert "does not keep up" in said
    assert LATE_NS * 1e-9 < time.monotonic() - begin_s < 1.0
    print(f"{len(waits)} waits of {max(waits, default=0.0):.4f} s at most")
    assert not waits or sorted(waits)[len(waits) // 2] < 0.1
    os.kill(log.process.pid, signal.SIGKILL)


SITE = """
import os, time
real = os.fsync
def fsync(file):
    {}
os.fsync = fsync
"""


def log_on_a_disk_whose_sync(does: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> PipedLog:
    (folder / "sitecustomize.py").write_text(SITE.format(does))
    monkeypatch.setenv("PYTHONPATH", str(folder))
    return PipedLog(folder / "session.feslog", {"kind": "live"})


def test_a_disk_that_syncs_slowly_ends_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a card or a stick does: what the operating system has is written, however long the disk takes."""
    log = log_on_a_disk_whose_sync("time.sleep(0.7)", tmp_path, monkeypatch)
    begin_s, number, told = time.monotonic(), 0, set()
    while time.monotonic() - begin_s < 2.5:
        log.event(sample(number))
        log.flush_due(time.monotonic_ns())
        number += 1
        time.sleep(0.002)
        told.add(log.warning)
    log.close({"ended": "complete"})
    assert len(told) == 2, "said, and said until it is over"
    assert read_session(log.path).complete
    assert len(list(iter_events(log.path))) == number


@pytest.mark.requirement("SR-18")
def test_a_disk_that_refuses_to_sync_ends_the_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = log_on_a_disk_whose_sync("raise OSError(5, 'worn out')", tmp_path, monkeypatch)
    said, after_s = wait_for_failure(log)
    assert "cannot be written any more" in said
    assert "Input/output error" in said
    assert after_s < 3.0, "at the first sync, a second after the start"
    with pytest.raises(SessionLogError):
        log.close({})


HANGS = "time.sleep(100 if os.path.exists({!r}) else 0)"


@pytest.mark.requirement("SR-18")
def test_a_disk_that_hangs_is_told_of_within_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hangs = tmp_path / "hangs"
    log = log_on_a_disk_whose_sync(HANGS.format(str(hangs)), tmp_path, monkeypatch)
    begin_s = hung_s = told_s = time.monotonic()
    while time.monotonic() - begin_s < 2.5:
        log.event(Tick(time.monotonic_ns()))
        log.flush_due(time.monotonic_ns())
        if hung_s == begin_s and time.monotonic() - begin_s > 0.7:
            assert log.warning == ""
            hangs.touch()
            hung_s = time.monotonic()
        if log.warning and told_s == begin_s:
            told_s = time.monotonic()
        time.sleep(0.01)
    print(f"told {told_s - hung_s:.2f} s after it hung")
    assert 0.0 < told_s - hung_s < 1.0
    assert "the disk does not keep up" in log.warning
    monkeypatch.setattr("fes.live.log_pipe.CLOSE_WAIT_S", 0.5)
    with pytest.raises(SessionLogError, match="cannot be written"):  # its end is not called whole either
        log.close({"ended": "complete"})


WRITES = """
import os
real = os.write
def write(file, data):
    if file > 2 and os.path.exists({!r}):
        raise OSError({}, "")
    return real(file, data)
os.write = write
"""


@pytest.mark.requirement("SR-18")
def test_a_file_system_that_turns_read_only_is_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fails = tmp_path / "fails"
    (tmp_path / "sitecustomize.py").write_text(WRITES.format(str(fails), errno.EROFS))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    log = PipedLog(tmp_path / "session.feslog", {"kind": "live"})
    fails.touch()
    said, after_s = wait_for_failure(log)
    assert "Read-only file system" in said
    assert after_s < 1.0
    with pytest.raises(SessionLogError, match="Read-only"):
        log.close({})


def remove(path: Path) -> None:
    path.unlink()


def replace_it(path: Path) -> None:
    other = path.with_name("other")
    other.write_bytes(path.read_bytes())
    other.rename(path)


def move_the_folder(path: Path) -> None:
    path.parent.rename(path.parent.with_name("elsewhere"))


def remove_the_folder(path: Path) -> None:
    shutil.rmtree(path.parent)


@pytest.mark.requirement("SR-18")
@pytest.mark.parametrize("do", [remove, replace_it, move_the_folder, remove_the_folder])
def test_a_log_that_is_gone_is_told_of_within_a_second_and_nothing_is_lost(
    do: Callable[[Path], None], tmp_path: Path
) -> None:
    (tmp_path / "walk").mkdir()
    place = tmp_path / "walk" / "session.feslog"
    log = PipedLog(place, {"kind": "live"})
    for number in range(500):
        log.event(sample(number))
    log.flush()
    do(place)
    said, after_s = wait_for_failure(log)
    assert after_s < 1.0
    assert "removed" in said or "replaced" in said
    assert log.healthy == said
    with pytest.raises(SessionLogError, match="all that was logged is in") as told:
        log.close({"ended": said})
    assert log.path != place
    assert str(log.path) in str(told.value)
    record = read_session(log.path)
    assert record.complete, "up to the summary"
    assert len(list(iter_events(log.path))) >= 501


@pytest.mark.requirement("SR-18")
def test_a_log_that_is_removed_just_before_the_end_is_not_called_whole(log: PipedLog) -> None:
    place = log.path
    log.event(sample(0))
    place.unlink()
    with pytest.raises(SessionLogError, match=r"has been removed.* all that was logged is in"):
        log.close({"ended": "complete"})
    assert read_session(log.path).complete
    assert not is_whole(place)
    assert is_whole(log.path)
    with log.path.open("r+b") as file:
        file.truncate(log.path.stat().st_size - 1)
    assert not is_whole(log.path)


@pytest.mark.requirement("SR-18")
def test_a_log_that_is_cut_short_by_another_program_is_told_of(log: PipedLog) -> None:
    write(log)
    os.truncate(log.path, 1000)
    said, after_s = wait_for_failure(log)
    assert "cut short" in said
    assert after_s < 1.0
    with pytest.raises(SessionLogError, match="cut short"):
        log.close({})


@pytest.mark.requirement("SR-18")
def test_a_full_disk_is_noticed_within_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """/dev/full takes no byte: the process that writes says so, the loop hears it."""
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full here")

    monkeypatch.setattr("fes.live.log_pipe.create", lambda path: os.open(full, os.O_WRONLY))
    with pytest.raises(SessionLogError, match="the disk is full"):
        PipedLog(tmp_path / "session.feslog", {})


def test_a_disk_that_fills_up_is_noticed_within_a_second(log: PipedLog, tmp_path: Path) -> None:
    """The writer's own limit on a file's size stands for a full disk: it is refused in the middle of the session."""
    resource = pytest.importorskip("resource")
    log.event(sample(0))
    log.flush()
    full_at = log.path.stat().st_size + 2000
    resource.prlimit(log.process.pid, resource.RLIMIT_FSIZE, (full_at, full_at))
    for _ in range(1000):  # more than there is room for
        log.event(Tick(time.monotonic_ns()))
    said, after_s = wait_for_failure(log)
    assert after_s < 1.0
    assert "cannot be written any more" in said
    with pytest.raises(SessionLogError, match="cannot be written"):
        log.close({})
    record = read_session(log.path)
    assert len(record.ticks_ns) > 10
    assert not record.complete


@pytest.mark.requirement("SR-18")
def test_a_killed_controller_loses_at_most_a_quarter_of_a_second(tmp_path: Path) -> None:
    """It logs the monotonic time every 2 ms and is killed; the newest event in the file is close to its last one."""
    path, last = tmp_path / "session.feslog", tmp_path / "last"
    last.write_bytes(bytes(8))
    script = (
        "import mmap, struct, sys, time\n"
        "from pathlib import Path\n"
        "from fes.live.log_pipe import PipedLog\n"
        "from fes.signals import Tick\n"
        "log = PipedLog(Path(sys.argv[1]), {})\n"
        "file = open(sys.argv[2], 'r+b')\n"
        "last = mmap.mmap(file.fileno(), 8)\n"
        "print(log.process.pid, flush=True)\n"
        "while True:\n"
        "    t_ns = time.monotonic_ns()\n"
        "    struct.pack_into('<q', last, 0, t_ns)\n"
        "    log.event(Tick(t_ns)); log.flush_due(time.monotonic_ns()); time.sleep(0.002)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script, str(path), str(last)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    writer = int(process.stdout.readline())
    while not path.exists() or path.stat().st_size < 3000:
        time.sleep(0.005)
    killed_ns = time.monotonic_ns()
    process.kill()
    process.wait(10)
    process.stdout.close()
    gone_after_s([writer], killed_ns)
    record = read_session(path)
    assert record.lost == ""
    assert not record.complete
    (newest_ns,) = struct.unpack("<q", last.read_bytes())
    lost_ms = (newest_ns - int(record.ticks_ns[-1])) / MS
    print(f"lost {lost_ms:.0f} ms")
    assert 0 <= lost_ms < 250


# --- A controller that is killed leaves no view behind, whatever its terminal does ---


CONTROLLER = """
import sys, time
from contextlib import suppress
from fes.live.processes import HelperProcess
from fes.live.status import Status
with HelperProcess("fes.live.terminal_view") as view:
    print(view.process.pid, file=sys.stderr, flush=True)
    for number in range(10**9):
        with suppress(BlockingIOError):
            view.link.send(Status(number, "running", "x" * 400).encode())
        time.sleep(0.01)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc on this machine")
@pytest.mark.parametrize("read", [True, False], ids=["a terminal", "a terminal that is held up"])
def test_the_view_of_a_killed_controller_ends(read: bool) -> None:
    terminal, slave = pty.openpty()
    controller = subprocess.Popen(
        [sys.executable, "-c", CONTROLLER], stdout=slave, stderr=subprocess.PIPE, env=os.environ | {"TERM": "xterm"}
    )
    os.close(slave)
    try:
        assert controller.stderr is not None
        view = int(controller.stderr.readline())
        shown = os.read(terminal, 4096)  # it draws
        assert shown
        os.set_blocking(terminal, False)
        end_s = time.monotonic() + (0.5 if read else 1.5)  # unread, the terminal is full long before
        while time.monotonic() < end_s:
            with suppress(BlockingIOError):
                shown += os.read(terminal, 65536) if read else b""
            time.sleep(0.01)
        killed_ns = time.monotonic_ns()
        controller.kill()
        controller.wait(5)
        took_s = gone_after_s([view], killed_ns)
        print(f"gone after {took_s:.2f} s")
        assert took_s < 1.0
        if read:
            with suppress(OSError):
                while data := os.read(terminal, 65536):
                    shown += data
            assert shown.rpartition(b"\x1b[?25")[2][:1] == b"h", "the cursor is shown again"
    finally:
        controller.kill()
        controller.wait(5)
        os.close(terminal)
