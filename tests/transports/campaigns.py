"""What a fault campaign's attempt may owe to a busy machine and to nothing else."""

from __future__ import annotations

from collections.abc import Iterable

from fes.hil.campaign_bench import LOST_TIME

HELD_UP_MS = 100.0  # one process alone, which no idle loop beside it sees


def faults_but_lost_time(named: str, faults: Iterable[str]) -> list[str]:
    """What was wrong; a session that was held up just then, and says so first, names its reason rightly as well."""
    lost_time = any(word in named for word in LOST_TIME)
    return [fault for fault in faults if not (lost_time and fault.startswith("the reason given is"))]
