"""What tests ask of other processes."""

from __future__ import annotations

import time
from pathlib import Path


def alive(pid: int) -> bool:
    """Whether it still runs; one that nobody has waited for yet does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def gone_after_s(pids: list[int], since_ns: int, timeout_s: float = 5.0) -> float:
    """How long after an instant none of them runs any more."""
    while any(map(alive, pids)):
        assert time.monotonic_ns() - since_ns < timeout_s * 1e9, f"{pids}: still there"
        time.sleep(0.005)
    return (time.monotonic_ns() - since_ns) * 1e-9
