"""What a worker process of this machine does first. Dask calls it by name, when one is started anew too."""

from __future__ import annotations

import signal
from typing import Any


def dask_setup(worker: Any) -> None:
    """Leave Ctrl-C to the process that was asked: it ends its workers, which would each print a trace."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
