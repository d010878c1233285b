"""`fes run` between a simulated sensor (serial) and a simulated stimulator (CAN), whose own record is the judge."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from live_runs import FOOT, LiveRun, faults_named, live_run, prepare
from processes import gone_after_s
from replays import MS

from drivers.simulated.spawn import free_bus, why_silent
from fes.cli.common import INTERRUPTED, OK
from fes.cli.replay.command import repeat
from fes.session_log import read_session

LEASE_MS = 60
MARGIN_MS = 15  # two processes' wake-ups on a shared machine, beside the deadline that is claimed
STOP_MS = 50
GONE_S = 20.0  # the log's writer waits for the disk before it ends

NO_BUS = why_silent(free_bus())
pytestmark = [
    pytest.mark.skipif(bool(NO_BUS), reason=f"no CAN between processes on this machine: {NO_BUS}"),
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo-terminals on this machine"),
]


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return prepare(tmp_path_factory.mktemp("loop"))


def notes_of(run: LiveRun, severity: str = "fault") -> list[str]:
    return [note.text for note in read_session(run.log).notes if note.severity == severity]


def test_it_walks_and_stimulates_stops_by_file_and_replays_to_the_same_bytes(
    loop: tuple[Path, Path], tmp_path: Path
) -> None:
    recording, calibration = loop
    options = ("--report", "--calibration", calibration, "--stop-file", tmp_path / "halt")
    with live_run(tmp_path, recording, *options) as run:
        run.until(lambda status: status.state != "off")

        def unconfirmed() -> str:
            run.order("up")
            return ""

        run.until(lambda status: any("confirm" in str(answer) for answer in run.answers), unconfirmed)
        assert run.status is not None
        assert run.status.intensity == 0.0
        run.armed_at()
        run.order("belt", value=0.6)
        run.until(lambda status: status.belt_speed_mps == 0.6)
        run.until(lambda status: status.on and status.feet[FOOT].rate_hz > 450, run.operated)
        run.in_mid_burst()
        (tmp_path / "halt").touch()
        blow_ns = time.monotonic_ns()
        off_ms = run.off_after_ms(blow_ns)
        print(f"off {off_ms:.1f} ms after the stop file appeared")
        assert off_ms <= STOP_MS + MARGIN_MS
        run.until(lambda status: status.state == "stopped" and bool(status.fault) and status.stops > 0)
        run.until(lambda status: "remove it" in status.message, "arm")  # refused: the file is still there
        assert run.stays_off(run.off_ns, 0.3)
        said = run.quit()
        assert run.process.returncode == OK, said
        assert "by hand: emergency stop (file halt) at" in said
        assert "on, peak" in said
        assert run.log.with_name("report.html").is_file()
        record = read_session(run.log)
        assert record.complete
        assert "emergency stop (file halt)" in notes_of(run)
        assert record.header["kind"] == "live"
        assert any(command.on for command in record.commands)
        assert len(record.latency_ns) > 1000
        received = record.summary["received"][FOOT]
        assert received == len(record.samples[FOOT].t_ns)
        again = repeat(run.log)
        assert (again.difference, again.commands) == ("", len(record.commands))
        late = record.summary["arrival"][FOOT]
        assert late["count"] == received
        heavy = {"pyarrow", "jinja2", "matplotlib", "rich", "scipy.signal", "pandas", "mcap", "drivers.simulated"}
        assert not heavy & run.loaded()
        assert "fes.live.session" in run.loaded()


def test_the_space_bar_stops_a_killed_view_does_not_and_arming_is_by_hand(
    loop: tuple[Path, Path], tmp_path: Path
) -> None:
    recording, calibration = loop
    with live_run(tmp_path, recording, "--calibration", calibration, "--view") as run:
        run.armed_at()
        (view,) = run.children("fes.live.terminal_view")
        os.kill(view, signal.SIGKILL)
        run.in_mid_burst()
        os.write(run.keys, b" ")
        blow_ns = time.monotonic_ns()
        off_ms = run.off_after_ms(blow_ns)
        print(f"off {off_ms:.1f} ms after the key")
        assert off_ms <= STOP_MS + MARGIN_MS
        run.until(lambda status: status.state == "stopped")
        assert run.stays_off(run.off_ns, 1.0)
        # by hand, when the patient stands again: from intensity 0
        run.until(lambda status: status.state in ("armed", "running"), "arm")
        assert run.status is not None
        assert run.status.intensity == 0.0
        run.process.send_signal(signal.SIGINT)
        said = run.end()
        assert run.process.returncode == INTERRUPTED, said
        assert "Traceback" not in said
        assert any("view has ended" in text for text in notes_of(run, "warning"))
        assert repeat(run.log).difference == ""


def test_killed_in_mid_burst_the_lease_ends_it_and_the_log_is_there(loop: tuple[Path, Path], tmp_path: Path) -> None:
    recording, calibration = loop
    with live_run(tmp_path, recording, "--calibration", calibration, "--view") as run:
        run.armed_at()
        run.in_mid_burst()
        modules = ("log_process", "run.supervisor", "fes.live.terminal_view")
        helpers = [pid for module in modules for pid in run.children(module)]
        assert len(helpers) == len(modules)
        before_ns = time.monotonic_ns()
        blow_ns = run.struck(signal.SIGKILL)
        run.process.wait(10)
        off_ms = run.off_after_ms(blow_ns)
        ended = run.ended()
        print(f"off {off_ms:.1f} ms after the kill")
        assert off_ms <= LEASE_MS + MARGIN_MS
        # told to, at the latest by the supervisor that sees it gone, or by its lease, after which there is no pulse
        assert ended.event in ("off", "lease_expired")
        assert ended.last_pulse_ns < ended.accepted_ns + LEASE_MS * MS
        gone_after_s(helpers, blow_ns, GONE_S)  # they end by themselves
        record = read_session(run.log)
        assert not record.complete
        assert record.lost == ""
        lost_ms = (before_ns - int(record.samples[FOOT].t_ns[-1])) / MS
        print(f"{lost_ms:.0f} ms of the log lost")
        assert lost_ms <= 250
        assert repeat(run.log).difference == ""


@pytest.mark.slow
def test_stopped_and_continued_it_notices_the_gap_and_stays_off(loop: tuple[Path, Path], tmp_path: Path) -> None:
    recording, calibration = loop
    with live_run(tmp_path, recording, "--calibration", calibration) as run:
        run.armed_at()
        run.in_mid_burst()
        blow_ns = run.struck(signal.SIGSTOP)
        assert run.off_after_ms(blow_ns) <= LEASE_MS + MARGIN_MS
        time.sleep(0.5)
        goes_on_ns = time.monotonic_ns()
        run.struck(signal.SIGCONT)
        time.sleep(1.5)
        # stopped between its last look at the clock and the wire, it cannot know how late it is: one command, no more
        again = run.on_since(run.off_ns)
        assert len(again) <= 1
        assert all(run.off_after_ms(entry.t_ns) <= MARGIN_MS for entry in again)
        run.until(lambda status: status.state == "fault")
        said = run.quit()
        assert run.process.returncode == OK, said
        record = read_session(run.log)
        # what latched depends on where it was stopped (tests/live/test_live_stalls.py); that it was away does not
        assert faults_named(record)
        assert record.summary["stalls"] >= 1
        assert record.summary["longest_stall_ms"] >= (goes_on_ns - blow_ns) / MS - MARGIN_MS
        assert repeat(run.log).difference == ""


@pytest.mark.slow
def test_an_unplugged_sensor_is_off_in_time_and_comes_back_without_arming(
    loop: tuple[Path, Path], tmp_path: Path
) -> None:
    recording, calibration = loop
    with live_run(tmp_path, recording, "--calibration", calibration) as run:
        run.armed_at()
        run.in_mid_burst()
        blow_ns = run.imu.inject("mute")
        off_ms = run.off_after_ms(blow_ns)
        print(f"off {off_ms:.1f} ms after the sensor fell silent")
        # held up, the session leaves it to the lease, which counts from when the stimulator read the last command
        assert off_ms <= 100 + (MARGIN_MS if run.ended().event == "lease_expired" else 0)
        run.until(lambda status: status.state == "fault")
        time.sleep(1.2)
        run.imu.inject("mute", 0.0)
        back = run.until(lambda status: status.feet[FOOT].rate_hz > 450)
        assert back.state == "fault"
        assert run.stays_off(run.off_ns, 0.5)
        run.quit()
        assert repeat(run.log).difference == ""


@pytest.mark.slow
def test_it_calibrates_in_the_session_where_no_calibration_is_given(loop: tuple[Path, Path], tmp_path: Path) -> None:
    recording, _ = loop
    with live_run(tmp_path, recording, "--strides", "3", "--duration", "6") as run:
        said = run.end(timeout_s=120)
        assert run.process.returncode == OK, said
        assert "toe-down about" in said
        assert any("state off → shadow" in text for text in notes_of(run, "info"))
        folder = run.log.parent
        assert (folder / "calibration.json").is_file()
        standing = read_session(folder / "calibration.feslog")
        assert standing.complete
        assert len(standing.samples[FOOT].t_ns) > 1000
        assert repeat(run.log).difference == ""


def test_exercise_reads_no_sensor_counts_its_bursts_and_replays_to_the_same_bytes(
    loop: tuple[Path, Path], tmp_path: Path
) -> None:
    recording, _ = loop
    cycle = "[exercise]\non_s = 0.6\noff_s = 0.5\nrise_s = 0.2\nfall_s = 0.2\ncount = 3\n"
    with live_run(tmp_path, recording, "--report", text=cycle, command="exercise") as run:
        run.armed_at()
        # a busy machine may hold it up, which latches: whoever waits goes on operating
        run.until(lambda status: status.state == "shadow" and "exercise done" in status.message, run.operated)
        said = run.quit()
        assert run.process.returncode == OK, said
        assert "exercise: " in said
        record = read_session(run.log)
        assert (record.header["kind"], record.samples) == ("exercise", {})
        assert sum(act.action == "exercise" for act in record.acts) >= 3
        assert repeat(run.log).difference == ""
        assert '<section id="exercise">' in run.log.with_name("report.html").read_text(encoding="utf-8")
        assert max(entry.current_ma for entry in run.entries()) > 1.0
