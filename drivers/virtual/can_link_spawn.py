"""Start the process that joins two CAN buses, and be sure to end it."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from drivers.virtual.spawn import NodeFailed, NodeHandle, first_line
from fes.config import Bus


def spawn_link(
    back: Bus, *, front: Bus | None = None, slcan: Path | None = None, timeout_s: float = 20.0
) -> NodeHandle:
    """Start ``python -m drivers.virtual.can_link`` and wait until it is ready; ``tell`` it to ``cut`` or ``unplug``.

    Args:
        back: the node's bus.
        front: the controller's bus, or
        slcan: where the simulated adapter's serial line is to be found.

    Raises:
        NodeFailed: it ended, or was not ready within ``timeout_s``.
    """
    command = [sys.executable, "-m", "drivers.virtual.can_link", "--back", back.model_dump_json()]
    command += ["--front", front.model_dump_json()] if front is not None else ["--slcan", str(slcan)]
    errors = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115 - lives as long as the handle
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True, start_new_session=True
    )
    handle = NodeHandle(process, front or back, -1, False, None, errors)
    line = first_line(process, timeout_s)
    try:
        handle.real_time = bool(json.loads(line)["real_time"])
    except (ValueError, KeyError, TypeError) as error:
        process.kill()
        process.wait()
        errors.seek(0)
        said = errors.read().strip() or line.strip() or f"nothing within {timeout_s:g} s"
        handle.stop()
        raise NodeFailed(f"the simulated CAN line did not start ({' '.join(command)}); it said: {said}") from error
    return handle
