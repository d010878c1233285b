"""The commands of docs/first_hour.md that need two terminals: patient and devices in one, the session in the other."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest
from first_hour import commands

from drivers.simulated.spawn import free_bus, why_silent
from fes.session_log import read_session

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
