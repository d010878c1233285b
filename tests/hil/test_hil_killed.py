"""A campaign that is killed leaves no session behind: it is interrupted, even one that stands still just then."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from processes import alive, gone_after_s

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc on this machine")

SESSION = """
import time
from fes.cli.common import Interrupt
with Interrupt() as interrupt:
    print("runs", flush=True)
    try:
        while True:
            time.sleep(0.01)
            interrupt.check()
    except KeyboardInterrupt:
        print("switched off", flush=True)
"""
CAMPAIGN = f"""
import pathlib, sys, threading, time
from fes.hil import controller
controller._START = {SESSION!r}
folder = pathlib.Path(sys.argv[1])
begun = []
starting = threading.Thread(
    target=lambda: begun.append(controller.ControllerProcess(folder / "x.toml", folder / "x.json", folder))
)
starting.start()
starting.join()
while begun[0].alive and "runs" not in begun[0].printed():
    time.sleep(0.01)
print(begun[0].process.pid, flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("stopped", [False, True], ids=["running", "stopped"])
def test_a_killed_campaigns_session_is_interrupted(tmp_path: Path, stopped: bool) -> None:
    """Started in a thread that has ended since, which the system tells of just as of the whole process."""
    campaign = subprocess.Popen([sys.executable, "-c", CAMPAIGN, str(tmp_path)], stdout=subprocess.PIPE)
    session = 0
    try:
        assert campaign.stdout is not None
        session = int(campaign.stdout.readline())
        time.sleep(0.1)  # had the thread's end ended it, it would be gone by now
        assert alive(session)
        if stopped:
            os.kill(session, signal.SIGSTOP)
        killed_ns = time.monotonic_ns()
        campaign.kill()
        campaign.wait(5)
        print(f"gone after {gone_after_s([session], killed_ns):.2f} s")
        assert (tmp_path / "said.txt").read_text().split("\n") == ["runs", "switched off", ""]
    finally:
        campaign.kill()
        campaign.wait(5)
        with suppress(ProcessLookupError):
            if session:
                os.kill(session, signal.SIGKILL)
