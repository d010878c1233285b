"""`fes run` with each kind of line; each walks, stimulates, stops at once, and leaves a log that replays the same.

The judge is the stimulator's own record. Then: devices lost and back, a full disk, switches on the bus.
"""

from __future__ import annotations

import importlib.util
import os
import resource
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import live_runs
import pytest
from live_runs import (
    EVERY,
    FOOT,
    Bench,
    LiveRun,
    capture2go_and_p24,
    faults_named,
    live_run,
    lsl_and_can,
    prepare,
    prepare_shank,
    shank_and_can,
    xbus_and_can,
    ximu3_and_p24,
    ximu3_and_rehastim2,
    xsens_can_and_can,
)
from processes import gone_after_s
from replays import MS

from drivers.simulated.bus_guests import StopButton
from drivers.simulated.spawn import DeviceHandle, DeviceKind, NodeHandle, free_bus, spawn_device, spawn_node, why_silent
from fes.cli.common import BROKEN, OK, STOPPED
from fes.cli.replay.command import repeat
from fes.session_log import read_session

STOP_MS = 50
GONE_S = 20.0  # the log's writer waits for the disk before it ends
LEASE_MS = 60
MARGIN_MS = 15  # two processes' wake-ups on a shared machine, beside the deadline that is claimed
REHASTIM2_MS = 30  # it delivers what it has accepted, up to 24 ms later
BURSTS = 5

NO_BUS = why_silent(free_bus())
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(NO_BUS), reason=f"no CAN between processes on this machine: {NO_BUS}"),
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo-terminals on this machine"),
]
Recordings = dict[str, tuple[Path, Path]]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Recordings:
    folder = tmp_path_factory.mktemp("recordings")
    return {"foot": prepare(folder), "slow foot": prepare(folder, EVERY), "shank": prepare_shank(folder)}


def faults_of(run: LiveRun) -> list[str]:
    return faults_named(read_session(run.log))


@pytest.mark.parametrize(
    ("bench", "moves"),
    [
        (ximu3_and_p24, "foot"),
        (ximu3_and_rehastim2, "foot"),
        (capture2go_and_p24, "slow foot"),
        (xsens_can_and_can, "slow foot"),
        (shank_and_can, "shank"),
        pytest.param(
            lsl_and_can,
            "slow foot",
            marks=pytest.mark.skipif(not importlib.util.find_spec("pylsl"), reason="pylsl is not installed"),
        ),
    ],
    ids=[
        "ximu3 and p24",
        "ximu3 and rehastim2",
        "capture2go and p24",
        "xsens and stimulator on one bus",
        "shank",
        "lsl",
    ],
)
def test_it_walks_stimulates_stops_and_replays(
    bench: Callable[[Path, Path, ExitStack], Bench], moves: str, recordings: Recordings, tmp_path: Path
) -> None:
    recording, calibration = recordings[moves]
    with live_run(tmp_path, recording, "--calibration", calibration, bench=bench) as run:
        run.armed_at()
        run.in_mid_burst()
        run.order("stop")
        blow_ns = time.monotonic_ns()
        off_ms = run.off_after_ms(blow_ns)
        print(f"off {off_ms:.1f} ms after the order")
        assert off_ms <= STOP_MS + MARGIN_MS + (REHASTIM2_MS if bench is ximu3_and_rehastim2 else 0)
        run.until(lambda status: status.state == "stopped" and bool(status.fault) and status.stops > 0)
        assert run.stays_off(run.off_ns, 0.5)
        said = run.quit()
        assert run.process.returncode == OK, said
        record = read_session(run.log)
        assert record.complete
        assert "emergency stop (control)" in faults_named(record)
        assert len(record.samples[run.sensor].t_ns) == record.summary["received"][run.sensor]
        asked = {command.current_ma for command in record.commands if command.on}
        step_ma = record.header["current_step_ma"]
        assert step_ma == (1.0 if bench is ximu3_and_rehastim2 else 0.5)
        assert asked
        assert all(current_ma % step_ma == 0.0 for current_ma in asked)
        assert not {"pyarrow", "jinja2", "rich", "scipy.signal"} & run.loaded()
        again = repeat(run.log)
        assert (again.difference, again.commands) == ("", len(record.commands))
        commands_of_the_log = {(frame.t_ns, frame.identifier, frame.data) for frame in record.frames}
        assert {(frame.t_ns, frame.identifier, frame.data) for frame in again.now.frames} <= commands_of_the_log
        assert any(frame.data for frame in again.now.frames)


def test_a_stimulator_on_the_bus_that_is_lost_comes_back_and_is_armed_by_hand(
    recordings: Recordings, tmp_path: Path
) -> None:
    recording, calibration = recordings["foot"]
    with ExitStack() as stack, live_run(tmp_path, recording, "--calibration", calibration) as run:
        run.armed_at()
        run.in_mid_burst()
        assert isinstance(run.stimulator, NodeHandle)
        blow_ns = time.monotonic_ns()
        run.stimulator.process.kill()
        run.stimulator.process.wait(5)
        fault = run.until(lambda status: status.state == "fault")
        print(f"{fault.fault!r} after {(fault.t_ns - blow_ns) / MS:.0f} ms")
        node = stack.enter_context(spawn_node(bus=run.stimulator.bus, record=tmp_path / "again.jsonl", boot_id=77))
        run.stimulator = node
        run.until(lambda status: status.stimulator == "open")
        assert run.stays_off(blow_ns, 1.0)
        run.armed_at()
        run.in_mid_burst()
        said = run.quit()
        assert run.process.returncode == OK, said
        assert any("stimulator lost" in text for text in faults_of(run))
        assert repeat(run.log).difference == ""


@pytest.mark.parametrize(
    ("bench", "kind", "greeting", "late_ms"),
    [
        (ximu3_and_p24, "sciencemode4", 0x4000_0000, 0),
        (ximu3_and_rehastim2, "sciencemode2", 0x2000_0000 + 30, REHASTIM2_MS),
    ],
    ids=["p24", "rehastim2"],
)
def test_a_serial_stimulator_that_is_unplugged_is_named_reopened_and_armed_by_hand(
    bench: Callable[[Path, Path, ExitStack], Bench],
    kind: DeviceKind,
    greeting: int,
    late_ms: int,
    recordings: Recordings,
    tmp_path: Path,
) -> None:
    recording, calibration = recordings["foot"]
    with ExitStack() as stack, live_run(tmp_path, recording, "--calibration", calibration, bench=bench) as run:
        run.armed_at()
        run.in_mid_burst()
        assert isinstance(run.stimulator, DeviceHandle)
        blow_ns = run.stimulator.inject("unplug")
        # one pulse a command, and none can come any more
        assert run.off_after_ms(blow_ns) <= MARGIN_MS + late_ms
        run.until(lambda status: status.state == "fault" and "lost" in status.stimulator)
        time.sleep(0.6)  # so that an attempt or two fail
        port = tmp_path / "stimulator"
        device = stack.enter_context(spawn_device(kind, record=tmp_path / "again.jsonl"))
        port.unlink()
        port.symlink_to(device.port)
        run.stimulator = device
        run.until(lambda status: status.stimulator == "open")
        assert run.stays_off(blow_ns, 1.0)
        run.armed_at()
        run.in_mid_burst()
        said = run.quit()
        assert run.process.returncode == OK, said
        record = read_session(run.log)
        assert any("stimulator lost" in text for text in faults_named(record))
        assert any(opened.t_ns > blow_ns for opened in record.reopened)
        # the handshake of the session's beginning and that of the reopening, perhaps repeated
        greetings = [frame for frame in record.frames if frame.identifier == greeting]
        assert len(greetings) >= 2
        assert greetings[0].t_ns < blow_ns < greetings[-1].t_ns
        again = repeat(run.log)
        assert again.difference == ""
        assert {frame.data for frame in again.now.frames} <= {frame.data for frame in record.frames}


@pytest.mark.parametrize("bench", [ximu3_and_p24, ximu3_and_rehastim2], ids=["p24", "rehastim2"])
def test_pulses_withheld_from_a_serial_stimulators_queue_are_withheld_in_the_replay(
    bench: Callable[[Path, Path, ExitStack], Bench], recordings: Recordings, tmp_path: Path
) -> None:
    """It is mute for a while in mid-burst: what was not sent, and what was asked meanwhile, follows from what came."""
    recording, calibration = recordings["foot"]
    withheld = "none was added to the stimulator's queue"
    with live_run(tmp_path, recording, "--calibration", calibration, bench=bench) as run:
        run.armed_at()
        assert isinstance(run.stimulator, DeviceHandle)
        latched = ""
        for _ in range(BURSTS):  # held up, it may latch for another reason before it has two pulses unanswered
            run.in_mid_burst()
            run.stimulator.inject("mute", 1)
            latched = run.until(lambda status: status.state == "fault").fault
            time.sleep(0.3)
            run.stimulator.inject("mute", 0)
            if withheld in latched:
                break
            print(f"latched by another reason: {latched}")
        assert withheld in latched
        run.armed_at()
        run.in_mid_burst()
        said = run.quit()
        assert run.process.returncode == OK, said
        record = read_session(run.log)
        assert any(withheld in status.fault for status in record.statuses)
        again = repeat(run.log)
        assert (again.difference, again.commands) == ("", len(record.commands))


def test_an_electrode_that_is_known_to_be_off_forbids_arming(recordings: Recordings, tmp_path: Path) -> None:
    recording, calibration = recordings["foot"]
    with live_run(tmp_path, recording, "--calibration", calibration) as run:
        run.armed_at()
        run.in_mid_burst()
        assert isinstance(run.stimulator, NodeHandle)
        blow_ns = run.stimulator.inject("electrode", 0)
        assert run.off_after_ms(blow_ns) <= 100
        # where it latched for another reason first, the next burst shows it
        run.until(lambda status: "check the electrodes" in status.message, run.operated)
        assert run.status is not None
        assert run.status.state == "fault"
        run.stimulator.inject("electrode", -1)
        run.until(lambda status: status.stimulator == "open")
        run.armed_at()  # under a new session, by hand
        run.in_mid_burst()
        run.quit()
        assert any("output stage fault" in text for text in faults_of(run))
        assert repeat(run.log).difference == ""


def kill(run: LiveRun, writer: int) -> None:
    os.kill(writer, signal.SIGKILL)


def fill_the_disk(run: LiveRun, writer: int) -> None:
    full = run.log.stat().st_size + 100  # from here on the file takes no more than this
    resource.prlimit(writer, resource.RLIMIT_FSIZE, (full, full))


@pytest.mark.parametrize(("blow", "says"), [(kill, "ALARM"), (fill_the_disk, "cannot be written any more")])
def test_a_log_that_can_no_longer_be_written_ends_the_session_safely_within_a_second(
    blow: Callable[[LiveRun, int], None], says: str, recordings: Recordings, tmp_path: Path
) -> None:
    recording, calibration = recordings["foot"]
    with live_run(tmp_path, recording, "--calibration", calibration) as run:
        run.armed_at()
        run.in_mid_burst()
        (writer,) = run.children("log_process")
        before_ns = time.monotonic_ns()
        blow(run, writer)
        blow_ns = time.monotonic_ns()
        off_ms = run.off_after_ms(blow_ns)
        print(f"off {off_ms:.1f} ms after {blow.__name__}")
        said = run.end()
        assert off_ms <= 1000
        assert run.process.returncode == STOPPED, said
        assert "ALARM" in said
        assert says in said
        assert "Traceback" not in said
        record = read_session(run.log)
        assert before_ns - int(record.samples[FOOT].t_ns[-1]) <= 250 * MS
        assert repeat(run.log).difference == ""


CRASHING = """
from fes.cli import main
from fes.live.operator import Operator
def broken(self, order, t_ns):
    raise ZeroDivisionError("made up")
Operator._belt = broken
main(prog_name="fes")
"""


def test_a_session_that_crashes_is_off_leaves_no_process_and_its_log_says_so(
    recordings: Recordings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, calibration = recordings["foot"]
    monkeypatch.setattr(live_runs, "LISTING", CRASHING)
    with live_run(tmp_path, recording, "--calibration", calibration, "--view") as run:
        run.armed_at()
        run.in_mid_burst()
        helpers = [*run.children("log_process"), *run.children("fes.live.terminal_view")]
        run.order("belt_up")
        blow_ns = time.monotonic_ns()
        assert run.off_after_ms(blow_ns) <= STOP_MS + MARGIN_MS
        said = run.end()
        assert run.process.returncode == BROKEN, said
        gone_after_s(helpers, blow_ns, GONE_S)
        record = read_session(run.log)
        assert record.complete
        assert record.summary["ended"] == "stopped: ZeroDivisionError: made up"
        assert repeat(run.log).difference == ""


def test_a_stop_button_and_a_foot_switch_on_the_bus(recordings: Recordings, tmp_path: Path) -> None:
    recording, calibration = recordings["foot"]
    bus = free_bus()
    text = (
        '[live]\nfolder = "elsewhere"\n[live.stop_button]\nsource = "can_bit"\nidentifier = 0x1F0\nbit = 0\n'
        f'[[foot_switches]]\nfoot = "{FOOT}"\nsource = "can_bit"\nidentifier = 0x1F1\nbit = 0\n'
    )

    def with_switches(folder: Path, path: Path, stack: ExitStack) -> Bench:
        bench = xbus_and_can(folder, path, stack)
        assert isinstance(bench.stimulator, NodeHandle)
        nonlocal bus
        bus = bench.stimulator.bus
        return bench

    with (
        ExitStack() as guests,
        live_run(tmp_path, recording, "--calibration", calibration, bench=with_switches, text=text) as run,
    ):
        run.until(lambda status: "nothing is heard of the stop button" in status.message, "arm")
        button = guests.enter_context(StopButton(bus, 0x1F0))
        switch = guests.enter_context(StopButton(bus, 0x1F1, pressed=True))
        run.armed_at()
        switch.press(False)
        run.in_mid_burst()
        button.press()
        blow_ns = time.monotonic_ns()
        off_ms = run.off_after_ms(blow_ns)
        print(f"off {off_ms:.1f} ms after the button")
        assert off_ms <= STOP_MS + MARGIN_MS
        run.until(lambda status: status.state == "stopped")
        run.until(lambda status: "the stop button is pressed" in status.message, "arm")
        run.quit()
        assert run.log.parent.parent.name == "elsewhere"
        assert [event.pressed for event in read_session(run.log).switches] == [True, False]
        assert repeat(run.log).difference == ""
