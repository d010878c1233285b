"""The computer's monotonic clock, handed to what needs one."""

from __future__ import annotations

import time


class MonotonicClock:
    """Real time."""

    def now_ns(self) -> int:
        """Monotonic time in ns."""
        return time.monotonic_ns()

    def wait_until_ns(self, t_ns: int) -> None:
        """Sleep until ``t_ns``; returns at once when that has passed."""
        left_ns = t_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns * 1e-9)
