"""A simulated device's process, seen from inside: publishes that it is ready, takes faults on stdin, ends on a signal.

Ready is one JSON line on stdout. Faults are JSON lines ``{"fault": NAME, "value": NUMBER}`` on stdin, each confirmed by
a line with the time at which it had taken effect, or answered with what is wrong. SIGTERM, SIGINT and the end of stdin
end the process. The other end of the conversation is :mod:`drivers.simulated.process_handle`.
"""

import gc
import json
import os
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

STDIN: Final = 0


def stop_signals() -> socket.socket:
    """Readable as soon as SIGTERM or SIGINT has come, so that a wait ends with it. Call once, in the main thread."""
    signalled, wake = socket.socketpair()
    wake.setblocking(False)
    signal.set_wakeup_fd(wake.detach())
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    return signalled


def become_real_time() -> bool:
    """Ask for SCHED_FIFO, as a device's timers owe nothing to this computer's load; False where it is not allowed."""
    gc.freeze()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except (AttributeError, OSError):
        return False
    return True


def publish_ready(**facts: str | int | bool | dict[str, str]) -> None:
    """Publish to whoever started this process that the device runs, and how it is reached."""
    print(json.dumps({"ready": True, "pid": os.getpid(), **facts}), flush=True)


def fault_commands(inject: Callable[[str, float], None]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Commands that are faults only: ``inject`` brings one about, or raises ValueError for an unknown one."""

    def execute(command: dict[str, Any]) -> dict[str, Any]:
        inject(str(command["fault"]), float(command.get("value", 1)))
        return {"done": command["fault"]}

    return execute


@dataclass(eq=False)
class CommandReader:
    """Commands as they come on stdin; ``execute`` carries one out and returns the answer, without the time."""

    execute: Callable[[dict[str, Any]], dict[str, Any]]
    now_ns: Callable[[], int] = time.monotonic_ns
    _incomplete: bytes = b""

    def read(self) -> bool:
        """Execute what has come, when stdin is readable; False at its end."""
        data = os.read(STDIN, 4096)
        *lines, self._incomplete = (self._incomplete + data).split(b"\n")
        for line in lines:
            try:
                answer = {**self.execute(json.loads(line)), "t_ns": self.now_ns()}
            except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
                answer = {"error": f"{line.decode(errors='replace')!r}: {error}"}
            print(json.dumps(answer), flush=True)
        return bool(data)
