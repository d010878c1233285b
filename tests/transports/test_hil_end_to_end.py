"""A short fault campaign with all its processes; the whole one is `make hil`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from replays import FES

from drivers.simulated.spawn import (
    DeviceKind,
    ImuKind,
    free_bus,
    spawn_device,
    spawn_imu,
    spawn_node,
    why_silent,
)
from fes.cli.common import FAILED, INTERRUPTED, OK, UNUSABLE
from fes.config import StimulatorDevice
from fes.hil.campaign_bench import LOST_TIME
from fes.hil.results import MS, PERIOD_NS
from fes.hil.settings import FOOT, RATE_HZ, STANDS_S, session_text, walker
from fes.session_log import read_session

SHORT = ("imu_silent", "controller_killed")
HELD_UP_MS = 100.0  # one process alone, which no idle loop beside it sees

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo-terminals on this machine"),
    pytest.mark.skipif(sys.platform != "linux", reason="the campaign's processes are looked for in /proc"),
]


def faults_but_lost_time(named: str, faults: Iterable[str]) -> list[str]:
    """What was wrong; a session that was held up just then, and says so first, names its reason rightly as well."""
    lost_time = any(word in named for word in LOST_TIME)
    return [fault for fault in faults if not (lost_time and fault.startswith("the reason given is"))]


def processes_of(folder: Path) -> list[str]:
    """Command lines of all processes that name this folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = path.read_text(errors="replace")
        except OSError:
            continue
        if str(folder) in line:
            found.append(line.replace("\0", " "))
    return found


def gone(folder: Path, timeout_s: float = 3.0) -> list[str]:
    """As :func:`processes_of`, once what was killed has had the time to go: as much as the campaign grants it."""
    end_s = time.monotonic() + timeout_s
    while (left := processes_of(folder)) and time.monotonic() < end_s:
        time.sleep(0.02)
    return left


def arguments(transport: str, out: Path, names: tuple[str, ...]) -> list[str]:
    return [*FES, "hil", "--transport", transport, "--out", str(out), *(f"--only={name}" for name in names)]


@pytest.mark.parametrize("transport", ["loopback", pytest.param("serial", marks=pytest.mark.slow)])
def test_a_short_campaign_is_met_and_leaves_nothing_running(transport: str, tmp_path: Path) -> None:
    if transport == "loopback" and (why := why_silent(free_bus("loopback"))):
        pytest.skip(f"no loopback multicast on this machine: {why}")
    done = subprocess.run(
        arguments(transport, tmp_path, SHORT), capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode in (OK, FAILED), done.stdout + done.stderr
    (folder,) = tmp_path.iterdir()
    found = json.loads((folder / "hil.json").read_text())
    assert [row["name"] for row in found["rows"]] == list(SHORT)
    for row in found["rows"]:
        (attempt,) = row["attempts"]
        print(transport, row["name"], attempt, found["baseline"])
        assert faults_but_lost_time(attempt["named"], attempt["faults"]) == [], done.stderr
        # a machine that held up an idle loop may have held up these processes as well
        machine_ms = found["baseline"]["most_ms"]
        assert attempt["last_pulse_ms"] <= row["deadline_ms"] + machine_ms
        # a simulated stimulator that is held up itself puts its end down late, though no pulse comes after its lease
        assert attempt["off_ms"] <= row["deadline_ms"] + machine_ms + HELD_UP_MS
        in_time = attempt["off_ms"] <= row["deadline_ms"]
        assert (row["verdict"] == "met") == (in_time and not attempt["faults"])
        # the record is the stimulator's own: current did flow when the fault struck
        assert attempt["last_pulse_ms"] >= -PERIOD_NS / MS
    assert "sensor silent" in (folder / "hil.md").read_text()
    assert gone(tmp_path) == []


def test_interrupted_it_ends_all_its_processes(tmp_path: Path) -> None:
    process = subprocess.Popen(
        arguments("serial", tmp_path, SHORT), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    end_s = time.monotonic() + 60
    while not any("run" in line for line in processes_of(tmp_path) if "--control" in line):
        assert time.monotonic() < end_s
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=60)
    assert process.returncode == INTERRUPTED, said
    assert "Traceback" not in said
    assert gone(tmp_path) == []


@contextmanager
def devices(stimulator: str, sensor: ImuKind, folder: Path, *, walks: bool = False) -> Iterator[tuple[Path, Path]]:
    """Devices started by somebody else stand for real ones, for their drivers open them; session file, calibration."""
    bus = free_bus("loopback") if stimulator in ("can", "canopen") else None
    if bus is not None and (why := why_silent(bus)):
        pytest.skip(f"no loopback multicast on this machine: {why}")
    walked = walker(folder)
    options: dict[str, Any] = {"accept_watchdog_s": 2.0} if stimulator == "p24_mid_level" else {}
    with ExitStack() as stack:
        port = ""
        if stimulator == "can":
            stack.enter_context(spawn_node(bus=bus))
        elif stimulator == "canopen":
            pytest.importorskip("canopen", reason="the extra canopen is not installed")
            from drivers.simulated.stimulator import canopen

            assert bus is not None
            command = [sys.executable, "-m", canopen.__name__, "--port", str(bus.options["port"]), "--node-id", "5"]
            node = stack.enter_context(
                subprocess.Popen([*command, "--channel", bus.channel], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            )
            stack.callback(node.kill)
            assert node.stdout is not None
            assert json.loads(node.stdout.readline())["ready"]
            options = {
                "node_id": 5, "current_index": canopen.CURRENT_INDEX, "width_index": canopen.WIDTH_INDEX,
                "current_step_ma": canopen.CURRENT_STEP_MA, "width_step_us": canopen.WIDTH_STEP_US,
                "max_current_ma": 100.0, "max_width_us": 500.0, "heartbeat_ms": canopen.HEARTBEAT_MS,
            }  # fmt: skip
        else:
            kind: DeviceKind = "sciencemode2" if stimulator == "rehastim2" else "sciencemode4"
            port = stack.enter_context(spawn_device(kind)).port
        imu = stack.enter_context(spawn_imu(sensor, sensor=FOOT, recording=walked.recording, rate_hz=RATE_HZ))
        imu.inject("stand", 0.0 if walks else STANDS_S)
        device = StimulatorDevice.model_validate({"device": stimulator, "port": port, "options": options})
        settings = folder / "real.toml"
        settings.write_text(session_text("", imu.port, bus, device, sensors=sensor))
        yield settings, walked.calibration


def on_hardware(settings: Path, calibration: Path, out: Path, *names: str) -> list[str]:
    command = [*FES, "hil", "--hardware", str(settings), "--calibration", str(calibration), "--out", str(out)]
    return [*command, *(f"--only={name}" for name in names)]


@pytest.mark.slow
def test_with_real_devices_it_wants_a_dummy_load_and_judges_by_what_the_bus_says(tmp_path: Path) -> None:
    """The witness is a second receiver on their bus."""
    with devices("can", "xbus", tmp_path) as (settings, calibration):
        command = on_hardware(settings, calibration, tmp_path / "out", "stop_control", "controller_stopped")
        refused = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert refused.returncode == UNUSABLE
        assert "dummy load" in refused.stderr
        assert not (tmp_path / "out").exists()
        command.append("--i-have-a-dummy-load")
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode in (OK, FAILED), done.stdout + done.stderr
    (folder,) = (tmp_path / "out").iterdir()
    rows = json.loads((folder / "hil.json").read_text())["rows"]
    assert [row["name"] for row in rows] == ["controller_stopped", "stop_control"]
    for row in rows:
        assert len(row["attempts"]) == (3 if row["name"] == "controller_stopped" else 1)
        for attempt in row["attempts"]:
            assert faults_but_lost_time(attempt["named"], attempt["faults"]) == [], done.stderr
            assert 0.0 < attempt["off_ms"] < 200.0


@pytest.mark.slow
@pytest.mark.requirement("SR-31")
@pytest.mark.parametrize(
    ("stimulator", "sensor"),
    [
        ("can", "xbus"),
        ("canopen", "ximu3"),
        ("p24_low_level", "capture2go"),
        ("p24_mid_level", "xbus"),
        ("rehastim2", "ximu3"),
    ],
)
def test_faults_come_between_a_real_driver_and_the_loop(stimulator: str, sensor: ImuKind, tmp_path: Path) -> None:
    """With every stimulator's protocol it is measured when current ends: by its answers; on CAN others hear them."""
    names = ("imu_unplugged", "imu_frozen", "imu_rate_stuck", "imu_nan", "controller_killed")
    with devices(stimulator, sensor, tmp_path) as (settings, calibration):
        command = [*on_hardware(settings, calibration, tmp_path / "out", *names), "--i-have-a-dummy-load"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode in (OK, FAILED), done.stdout + done.stderr
    (folder,) = (tmp_path / "out").iterdir()
    rows = {row["name"]: row for row in json.loads((folder / "hil.json").read_text())["rows"]}
    assert "--walking" in rows.pop("imu_rate_stuck")["failure_reason"]
    killed = rows.pop("controller_killed")
    assert killed["attempts"] if stimulator == "can" else "(CAN)" in killed["failure_reason"]
    for name, row in rows.items():
        (attempt,) = row["attempts"]
        print(stimulator, sensor, name, attempt)
        assert faults_but_lost_time(attempt["named"], attempt["faults"]) == [], done.stderr
        assert 0.0 <= attempt["off_ms"] < 300.0
    session = read_session(next((folder / "run1").glob("**/session.feslog")))
    assert session.header["faults_injected"] is True
    assert any("FAULTS OF THE SENSORS ARE INJECTED" in note.text for note in session.notes)
    assert "FAULTS OF THE SENSORS ARE INJECTED" in (folder / "run1" / "said.txt").read_text()


@pytest.mark.slow
def test_a_fault_that_only_movement_shows_is_told_of_a_sensor_that_walks(tmp_path: Path) -> None:
    with devices("p24_low_level", "xbus", tmp_path, walks=True) as (settings, calibration):
        command = on_hardware(settings, calibration, tmp_path / "out", "imu_rate_stuck")
        command += ["--i-have-a-dummy-load", "--walking"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode in (OK, FAILED), done.stdout + done.stderr
    (folder,) = (tmp_path / "out").iterdir()
    (row,) = json.loads((folder / "hil.json").read_text())["rows"]
    assert row["attempts"]
    for attempt in row["attempts"]:
        assert faults_but_lost_time(attempt["named"], attempt["faults"]) == [], done.stderr
        assert 0.0 <= attempt["off_ms"] < row["deadline_ms"] + HELD_UP_MS
