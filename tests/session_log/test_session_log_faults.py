"""The session log under bad treatment: cut, flipped, killed, a full disk. What was stored stays readable."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fes.session_log import Note, SessionLogError, SessionRecord, SessionWriter, iter_events, read_session
from fes.session_log.framing import MAGIC, RecordType, framed
from fes.session_log.repair import recover, survey
from fes.signals import ImuSample, OperatorAct, OperatorAction, StimCommand, StimStatus, StrideResult, Tick, WireFrame
from statemachine.phases import Phase, PhaseChange, Transition


def small_log(path: Path) -> bytes:
    """One record of each kind and a few runs, 1 kB or so."""
    writer = SessionWriter(path, {"format": 1})
    for number in range(3):
        for sensor in ("left_foot", "right_foot"):
            writer.event(ImuSample(number * 100, sensor, number * 99, (1.0, 2.0, 9.81), (0.1, 0.2, 0.3)))
            writer.latency(number * 100, 50 + number)
        writer.event(Tick(number * 100 + 1))
        writer.command(
            StimCommand(number, 0, True, 10.0, 200.0, 40.0, 60, "because"), WireFrame(number, 1, b"12345678")
        )
        writer.event(StimStatus(number * 100 + 2, 0, number, True, 10.0, 200.0, 40.0))
        writer.phase(PhaseChange(number, "left_foot", Transition.T1, Phase.STANCE, Phase.PRE_SWING))
    path_m = np.ones((2, 3))
    writer.stride(StrideResult("left_foot", 1, 0, 1, 1.0, 0.1, 0.0, 0.0, 1.0, 1, 2, 3, 4, trajectory_m=path_m))
    writer.note(Note(1, "warning", "gate", "text"))
    writer.event(OperatorAct(400, OperatorAction.DISARM))
    writer.close({"done": True})
    return path.read_bytes()


def outline(log: SessionRecord) -> list[list[object]]:
    """All that was read, as lists that can be compared for being a beginning of others."""
    return [
        *([*arrays.t_ns.tolist()] for arrays in log.samples.values()),
        log.ticks_ns.tolist(),
        *map(list, (log.acts, log.statuses, log.phases, log.strides, log.commands, log.frames, log.notes)),
        log.latency_ns.tolist(),
    ]


def count(log: SessionRecord) -> int:
    return sum(map(len, outline(log)))


def is_beginning(part: list[object], whole: list[object]) -> bool:
    return whole[: len(part)] == part


@pytest.mark.requirement("SR-18")
def test_every_cut_is_readable_and_loses_only_its_end(tmp_path: Path) -> None:
    data = small_log(tmp_path / "whole")
    events = list(iter_events(tmp_path / "whole"))
    whole = read_session(tmp_path / "whole")
    assert whole.complete
    path = tmp_path / "cut"
    header_end = data.index(b'{"format":1}') + len(b'{"format":1}')
    before, clean = -1, 0
    for size in range(len(data)):
        path.write_bytes(data[:size])
        if size < header_end:
            with pytest.raises(SessionLogError, match="nothing"):
                read_session(path)
            with pytest.raises(SessionLogError, match="nothing"):
                list(iter_events(path))
            continue
        log = read_session(path)
        assert not log.complete
        assert log.header == {"format": 1}
        assert is_beginning(list(iter_events(path)), events)
        assert count(log) >= before, "a longer file never holds less"
        before = count(log)
        clean += log.lost == ""
        if log.lost:
            assert f"of {size} bytes" in log.lost
    assert before == count(whole)
    assert clean > 20, "a cut between records loses nothing"


@pytest.mark.requirement("SR-18")
def test_every_flipped_bit_is_noticed(tmp_path: Path) -> None:
    data = small_log(tmp_path / "whole")
    events = list(iter_events(tmp_path / "whole"))
    path = tmp_path / "flipped"
    for position in range(len(data)):
        for bit in (0, 7) if position % 3 else range(8):
            damaged = bytearray(data)
            damaged[position] ^= 1 << bit
            path.write_bytes(damaged)
            try:
                log = read_session(path)
            except SessionLogError:
                assert position < 40, "only a damaged beginning makes a log unreadable"
                continue
            assert log.lost
            assert not log.complete
            assert is_beginning(list(iter_events(path)), events)


def test_bytes_behind_the_end_are_told(tmp_path: Path) -> None:
    data = small_log(tmp_path / "log")
    (tmp_path / "log").write_bytes(data + bytes(100))
    log = read_session(tmp_path / "log")
    assert log.lost == f"the last 100 of {len(data) + 100} bytes, from byte {len(data)} on: no record starts there"
    assert not log.complete
    assert log.summary == {"done": True}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "holds only 0 bytes"),
        (MAGIC[:4], "holds only 4 bytes"),
        (b"time,acc\n0,1\n", "is not a session log"),
        (MAGIC[:-1] + b"\x02" + bytes(20), "format 2, this fes reads format 1"),
        (MAGIC, "has no whole header"),
    ],
)
def test_other_files_are_refused_with_the_reason(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "log"
    path.write_bytes(content)
    with pytest.raises(SessionLogError, match=message) as caught:
        read_session(path)
    assert str(path) in str(caught.value)
    with pytest.raises(SessionLogError, match=message):
        list(iter_events(path))


@pytest.mark.parametrize(
    ("kind", "payload"),
    [
        (RecordType.TICK, b"abc"),
        (RecordType.SAMPLES, b"\x09" + bytes(20)),
        (RecordType.SAMPLES, bytes(9) + b"\x07" + bytes(32)),
        (RecordType.SAMPLES, bytes(9) + bytes(32)),
        (RecordType.STATUS, b"\xff" + bytes(60)),
        (RecordType.LATENCY, bytes(12)),
        (RecordType.NOTE, b"[]"),
        (RecordType.STRIDE, bytes(3)),
        (RecordType.ACT, bytes(16) + b"dance"),
    ],
)
def test_a_malformed_record_is_never_taken_for_data(tmp_path: Path, kind: RecordType, payload: bytes) -> None:
    path = tmp_path / "log"
    SessionWriter(path, {"format": 1}).flush()
    path.write_bytes(path.read_bytes() + framed(kind, payload))
    with pytest.raises(SessionLogError, match=r"near byte .* a record is malformed .* `fes recover \S+log`"):
        read_session(path)
    if kind == RecordType.TICK:
        with pytest.raises(SessionLogError, match="malformed"):
            list(iter_events(path))
    recover(survey(path), tmp_path / "recovered")
    assert read_session(tmp_path / "recovered").header == {"format": 1}


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SessionLogError, match=r"gone: cannot be read.*Name an existing session log"):
        read_session(tmp_path / "gone")


KILLED = """
import sys, time
from pathlib import Path
from fes.session_log import SessionWriter
from fes.signals import ImuSample
writer = SessionWriter(Path(sys.argv[1]), {"format": 1})
start = time.monotonic_ns()
number = 0
while True:
    now = time.monotonic_ns()
    while start + number * 1_000_000 <= now:
        t = start + number * 1_000_000
        writer.event(ImuSample(t, "left_foot", t, (0.0, 0.0, 9.75), (0.0, float(number % 1000), 0.0)))
        number += 1
    writer.flush_due(now)
    if number % 64 < 8:
        print(now, flush=True)
    time.sleep(0.001)
"""


@pytest.mark.requirement("SR-18")
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs POSIX signals")
def test_a_killed_writer_loses_at_most_250_ms(tmp_path: Path) -> None:
    path = tmp_path / "log"
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    first = int(process.stdout.readline())
    last = first
    while last - first < 600_000_000:
        last = int(process.stdout.readline())
    process.kill()  # it has lived through `last`, by its own clock
    rest = [int(line) for line in process.stdout.read().split("\n")[:-1] if line.strip().isdigit()]
    process.wait()
    process.stdout.close()
    last = max([last, *rest])
    log = read_session(path)
    t_ns = log.samples["left_foot"].t_ns
    assert log.lost == ""
    assert not log.complete
    assert last - t_ns[-1] <= 250_000_000
    assert t_ns.size > 300
    assert np.all(np.diff(t_ns) == 1_000_000), "nothing is missing in between"


FULL = """
import resource, signal, sys
from pathlib import Path
from fes.session_log import SessionLogError, SessionWriter
from fes.signals import Tick
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
writer = SessionWriter(Path(sys.argv[1]), {"format": 1})
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
written = 0
try:
    for number in range(100_000):
        writer.event(Tick(number))
        writer.flush_due(number * 1_000_000)
        written += 1
except SessionLogError as error:
    print(written)
    print(error)
for call in (lambda: writer.event(Tick(1)), lambda: writer.flush_due(0), lambda: writer.latency(1, 1),
             lambda: writer.close({})):
    try:
        call()
    except SessionLogError as error:
        print("again:", error)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="needs a limit on file sizes")
def test_a_file_that_may_not_grow_is_told_at_once_and_stays_readable(tmp_path: Path) -> None:
    path = tmp_path / "log"
    done = subprocess.run([sys.executable, "-c", FULL, str(path)], capture_output=True, text=True, check=True)
    written, message, *again = done.stdout.splitlines()
    assert "cannot be written any more" in message
    assert "make room and start a new session" in message
    assert len(again) == 4, "every further call says so, closing too"
    log = read_session(path)
    assert not log.complete
    assert log.ticks_ns.tolist() == list(range(log.ticks_ns.size))
    assert int(written) - log.ticks_ns.size <= 51, "at most the last 50 ms are lost"


def test_no_room_even_for_the_header(tmp_path: Path) -> None:
    code = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from fes.session_log import SessionLogError, SessionWriter\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4, 4))\n"
        "try: SessionWriter(Path(sys.argv[1]), {'format': 1})\n"
        "except SessionLogError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "log")], capture_output=True, text=True, check=True
    )
    assert "cannot be written any more" in done.stdout


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_called_so(tmp_path: Path) -> None:
    path = tmp_path / "log"
    writer = SessionWriter(path, {"format": 1})
    writer.event(Tick(1))
    writer.flush()
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full, writer._fd)
    os.close(full)
    writer.event(Tick(2))
    with pytest.raises(SessionLogError, match="the disk is full"):
        writer.flush_due(0)
    with pytest.raises(SessionLogError, match="the disk is full"):
        writer.event(Tick(3))
    with pytest.raises(SessionLogError, match="the disk is full"):
        writer.close({})
    assert list(iter_events(path)) == [Tick(1)]
