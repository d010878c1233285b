"""How late this machine wakes an idle process, measured beside a campaign: ``python -m fes.hil.baseline``.

On every processor a loop of 200 Hz by absolute deadlines that does nothing, under SCHED_FIFO where that is granted,
like the simulated devices. ``pause`` and ``go`` on stdin leave out what is no baseline (a fault that takes the
processor away); ``gaps N`` is answered with the wake-ups since N (CLOCK_MONOTONIC in ns) that were late by more than
8 ms; when stdin closes it says what it found, as JSON.
"""

import gc
import json
import os
import select
import subprocess
import sys
import threading
import time
from array import array
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import numpy as np

PERIOD_NS: Final = 5_000_000
PRIORITY: Final = 10
GAP_MS: Final = 8.0
GAPS_KEPT: Final = 1000
ANSWER_WAIT_S: Final = 5.0

Gap = tuple[int, float]
"""When a wake-up was due, CLOCK_MONOTONIC in ns, and how late it was, ms."""


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
    """The process while it runs; always :meth:`end` it."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "fes.hil.baseline"]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )

    def leave_out(self, pausing: bool) -> None:
        """From now on, or no longer."""
        self._say("pause" if pausing else "go")

    def gaps(self, since_ns: int) -> list[Gap]:
        """When this machine was away for more than 8 ms since then; none where nobody answers."""
        self._say(f"gaps {since_ns}")
        stdout = self._process.stdout
        try:
            if stdout is None or not select.select([stdout], [], [], ANSWER_WAIT_S)[0]:
                return []
            return [(int(t_ns), float(late_ms)) for t_ns, late_ms in json.loads(stdout.readline())]
        except (OSError, ValueError, TypeError):
            return []

    def end(self) -> Lateness:
        """Stop it; what it found."""
        try:
            return Lateness(**json.loads(self._process.communicate(timeout=10)[0]))
        except (subprocess.TimeoutExpired, ValueError, TypeError):
            self._process.kill()
            self._process.wait()
            return Lateness()

    def _say(self, line: str) -> None:
        stdin = self._process.stdin
        if stdin is not None and self._process.poll() is None:
            stdin.write(line + "\n")
            stdin.flush()


class IdleLoop(threading.Thread):
    """Wakes on one processor, 200 times a second, and notes how late."""

    def __init__(self, processor: int | None) -> None:
        super().__init__(daemon=True)
        self.late_ms = array("d")
        self.gaps: deque[Gap] = deque(maxlen=GAPS_KEPT)
        self.paused = False
        self.real_time = False
        self.over = threading.Event()
        self._processor = processor

    def run(self) -> None:
        """Until stopped. On Linux priority and processor are the calling thread's own."""
        with suppress(AttributeError, OSError):
            if self._processor is not None:
                os.sched_setaffinity(0, {self._processor})
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
            self.real_time = True
        due_ns = time.monotonic_ns() + PERIOD_NS
        while not self.over.is_set():
            time.sleep(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
            now_ns = time.monotonic_ns()
            late_ms = (now_ns - due_ns) * 1e-6
            if not self.paused:
                self.late_ms.append(late_ms)
                if late_ms > GAP_MS:
                    self.gaps.append((due_ns, round(late_ms, 3)))
            due_ns = now_ns + PERIOD_NS


def main() -> int:
    """Measure until stdin closes."""
    gc.disable()
    processors = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [None]
    loops = [IdleLoop(processor) for processor in processors]
    for loop in loops:
        loop.start()
    for line in sys.stdin:
        word, _, value = line.strip().partition(" ")
        if word == "gaps":
            since_ns = int(value)
            gaps = [gap for loop in loops for gap in list(loop.gaps) if gap[0] >= since_ns]
            print(json.dumps(sorted(gaps)), flush=True)
        else:
            for loop in loops:
                loop.paused = word == "pause"
    for loop in loops:
        loop.over.set()
        loop.join()
    late_ms = np.concatenate([np.array(loop.late_ms) for loop in loops])
    found = {"count": len(late_ms), "real_time": all(loop.real_time for loop in loops)}
    if len(late_ms):
        names = ("p50_ms", "p99_ms", "p999_ms", "most_ms")
        found |= dict(zip(names, np.percentile(late_ms, [50, 99, 99.9, 100]).round(3).tolist(), strict=True))
    print(json.dumps(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
