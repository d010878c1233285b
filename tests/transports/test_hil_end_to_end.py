"""A short fault campaign with all its processes; the whole one is `make hil`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from campaigns import HELD_UP_MS, faults_but_lost_time
from replays import FES

from drivers.simulated.spawn import free_bus, spawn_imu, spawn_node, why_silent
from fes.cli.common.exits import FAILED, INTERRUPTED, OK, UNUSABLE
from fes.config import StimulatorDevice
from fes.hil.results import MS, PERIOD_NS
from fes.hil.settings import FOOT, RATE_HZ, session_text, walker

SHORT = ("imu_silent", "controller_killed")

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo-terminals on this machine"),
    pytest.mark.skipif(sys.platform != "linux", reason="the campaign's processes are looked for in /proc"),
]


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


@pytest.mark.slow
def test_with_real_devices_it_wants_a_dummy_load_and_judges_by_what_the_bus_says(tmp_path: Path) -> None:
    """Devices started by somebody else stand for real ones; the witness is a second receiver on their bus."""
    bus = free_bus("loopback")
    if why := why_silent(bus):
        pytest.skip(f"no loopback multicast on this machine: {why}")
    walked = walker(tmp_path)
    with (
        spawn_node(bus=bus),
        spawn_imu("xbus", sensor=FOOT, recording=walked.recording, rate_hz=RATE_HZ) as imu,
    ):
        settings = tmp_path / "real.toml"
        settings.write_text(session_text("", imu.port, bus, StimulatorDevice()))
        command = [*FES, "hil", "--hardware", str(settings), "--calibration", str(walked.calibration)]
        command += ["--out", str(tmp_path / "out"), "--only", "stop_control", "--only", "controller_stopped"]
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
