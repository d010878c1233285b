"""A controller that is killed leaves no view behind, whatever its terminal does. (Its log: test_live_log.)"""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from processes import gone_after_s

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc on this machine")

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
