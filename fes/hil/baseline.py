"""How late this machine wakes an idle process, measured beside a campaign: ``python -m fes.hil.baseline``.

A loop of 200 Hz by absolute deadlines that does nothing, under SCHED_FIFO where that is granted, like the simulated
devices. ``pause`` and ``go`` on stdin leave out what is no baseline (a fault that takes the processor away); when stdin
closes it says what it found, as JSON.
"""

from __future__ import annotations

import gc
import json
import os
import select
import subprocess
import sys
import time
from array import array
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

PERIOD_NS: Final = 5_000_000
PRIORITY: Final = 10
_STDIN: Final = 0


@dataclass(frozen=True, slots=True)
class Lateness:
    """Of ``count`` wake-ups, in ms; ``real_time``: SCHED_FIFO was granted."""

    count: int = 0
    p50_ms: float = 0.0
    p99_ms: float = 0.0
    p999_ms: float = 0.0
    most_ms: float = 0.0
    real_time: bool = False

    def __str__(self) -> str:
        how = "SCHED_FIFO" if self.real_time else "ordinary priority"
        return (
            f"idle loop beside it ({how}, {self.count} wake-ups): late by p50 {self.p50_ms:.2f}, "
            f"p99 {self.p99_ms:.2f}, p99.9 {self.p999_ms:.2f}, at most {self.most_ms:.2f} ms"
        )


class Baseline:
    """The process while it is entered."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "fes.hil.baseline"]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )

    def leave_out(self, pausing: bool) -> None:
        """From now on, or no longer."""
        if self._process.stdin is not None:
            self._process.stdin.write("pause\n" if pausing else "go\n")
            self._process.stdin.flush()

    def end(self) -> Lateness:
        """Stop it; what it found."""
        try:
            said, _ = self._process.communicate(timeout=10)
            found: dict[str, Any] = json.loads(said)
            return Lateness(**found)
        except (subprocess.TimeoutExpired, ValueError, TypeError):
            self._process.kill()
            self._process.wait()
            return Lateness()


def main() -> int:
    """Measure until stdin closes."""
    gc.disable()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        real_time = True
    except (AttributeError, OSError):
        real_time = False
    late_ms = array("d")
    paused = False
    due_ns = time.monotonic_ns() + PERIOD_NS
    while True:
        left_s = max(0.0, (due_ns - time.monotonic_ns()) * 1e-9)
        ready, _, _ = select.select([_STDIN], [], [], left_s)
        if ready:
            typed = os.read(_STDIN, 4096)
            if not typed:
                break
            paused = typed.split()[-1] == b"pause"
        now_ns = time.monotonic_ns()
        if now_ns >= due_ns:
            if not paused:
                late_ms.append((now_ns - due_ns) * 1e-6)
            due_ns = now_ns + PERIOD_NS
    found = {"count": len(late_ms), "real_time": real_time}
    if late_ms:
        names = ("p50_ms", "p99_ms", "p999_ms", "most_ms")
        found |= dict(zip(names, np.percentile(late_ms, [50, 99, 99.9, 100]).round(3).tolist(), strict=True))
    print(json.dumps(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
