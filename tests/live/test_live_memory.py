"""A live session's memory does not grow: ``live_memory.py``, which can do an hour, for two minutes of a session."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).with_name("live_memory.py")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc on this system")
def test_memory_is_flat() -> None:
    done = subprocess.run(
        [sys.executable, str(BENCHMARK), "--minutes", "2"], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["samples"] > 2 * 500 * 115
    assert found["commands_on"] > 300  # it walked and was stimulated
    assert found["growth_mb"] < 2.0  # of the last minute; 60,000 samples kept would be over 10 MB
