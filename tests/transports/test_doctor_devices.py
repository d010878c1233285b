"""`fes doctor` and `fes devices` beside simulated devices in processes of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from first_hour import commands
from live_runs import bus_text, sensor_text
from replays import SETTINGS

from drivers.simulated.spawn import free_bus, spawn_device, spawn_imu, spawn_node, why_silent
from fes.cli import doctor as doctor_devices
from fes.cli.common import FAILED, OK
from fes.cli.doctor import Verdict
from fes.cli.main import main
from fes.config import load_session
from fes.session_log import read_session

NO_BUS = why_silent(free_bus())
pytestmark = [
    pytest.mark.skipif(bool(NO_BUS), reason=f"no CAN between processes on this machine: {NO_BUS}"),
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo-terminals on this machine"),
]


def test_a_session_whose_devices_answer_passes_and_nothing_is_stimulated(tmp_path: Path) -> None:
    with spawn_node(record=tmp_path / "node.jsonl") as node, spawn_imu("xbus", rate_hz=100.0) as imu:
        path = tmp_path / "session.toml"
        text = bus_text(node.bus) + sensor_text("xbus", imu.port, rate_hz=100.0)
        path.write_text(f"{SETTINGS.read_text()}\n{text}")
        done = CliRunner().invoke(main, ["doctor", str(path), "--out", str(tmp_path), "--json"])
        assert done.exit_code == OK, done.output
        told = {finding["name"]: finding for finding in json.loads(done.stdout)["findings"]}
        assert "Hz" in told["right_foot"]["said"]
        assert told["stimulator"]["said"].endswith(f"heartbeat of boot {node.boot_id}")
        found = CliRunner().invoke(main, ["devices", str(path)])
        assert found.exit_code == OK, found.output
        assert "right_foot" in found.output
        assert '"session"' not in (tmp_path / "node.jsonl").read_text()  # nobody opened one there
        node.stop()
        gone = CliRunner().invoke(main, ["doctor", str(path), "--out", str(tmp_path)])
        assert gone.exit_code == FAILED
        assert "no heartbeat" in gone.output
        assert "fes simulate --live starts one" in gone.output


def test_a_stimulator_that_reports_a_fault_fails(tmp_path: Path) -> None:
    with spawn_device("sciencemode4", record=tmp_path / "device.jsonl") as device:
        path = tmp_path / "session.toml"
        path.write_text(f'{SETTINGS.read_text()}\n[stimulator]\ndevice = "p24_low_level"\nport = "{device.port}"\n')
        assert doctor_devices.stimulator(load_session(path)).verdict is Verdict.OK
        assert device.entries("pulse") == []
        device.inject("mute")
        silent = doctor_devices.stimulator(load_session(path))
        assert silent.verdict is Verdict.FAILURE
        assert silent.remedy


# --- the commands of docs/first_hour.md that need two terminals ---------------------------------------------


NO_BUS = why_silent(free_bus())
pytestmark = pytest.mark.skipif(bool(NO_BUS), reason=f"no CAN between processes on this machine: {NO_BUS}")
FES = [sys.executable, "-c", "from fes.cli.main import main; main()"]


@pytest.mark.parametrize("sensors", ["xbus", "capture2go"])
def test_a_live_session_and_one_fault(sensors: str, tmp_path: Path) -> None:
    patient, doctor, session, listed, fault = (FES + words[1:] for words in commands("sh live"))
    if sensors != "xbus":  # which the page has without a word
        patient, fault = [*patient, "--sensors", sensors], [*fault, "--sensors", sensors]
    with subprocess.Popen(
        patient, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as walking:
        try:
            by_s = time.monotonic() + 60.0
            while not (tmp_path / "hour/patient-001/session.toml").is_file():  # the last that it writes
                assert time.monotonic() < by_s
                time.sleep(0.2)
            for command in (doctor, session):
                done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=150)
                assert done.returncode == 0, done.stdout + done.stderr
        finally:
            walking.terminate()
    (log,) = (tmp_path / "hour").glob("*/session.feslog")
    assert log.with_name("report.html").is_file()
    assert any(stride.valid for stride in read_session(log).strides)  # it walked; nobody armed
    assert not any(command.on for command in read_session(log).commands)
    for command in (listed, fault):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=150)
        assert done.returncode == 0, done.stdout + done.stderr
