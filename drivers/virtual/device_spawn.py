"""Start a simulated serial stimulator's process, tell it its faults while it runs, and be sure to end it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from drivers.virtual.can_node_spawn import NodeFailed
from drivers.virtual.process_handle import ProcessHandle

DeviceKind = Literal["sciencemode4", "sciencemode2"]


class DeviceHandle(ProcessHandle):
    """A running serial stimulator; its ``port`` is a pseudo-terminal's name, or ``socket://127.0.0.1:PORT``."""


def spawn_device(
    kind: DeviceKind,
    *,
    record: Path | None = None,
    faults: str = "",
    pulses: Path | None = None,
    line: Literal["pty", "tcp"] = "pty",
    timeout_s: float = 20.0,
) -> DeviceHandle:
    """Start ``python -m drivers.virtual.KIND`` and wait until it is ready.

    Raises:
        NodeFailed: it ended, or was not ready within ``timeout_s``.
    """
    arguments = ["--until-stdin-closes", "--line", line, "--faults", faults]
    arguments += ["--pulses", str(pulses)] if pulses is not None else []
    module = f"drivers.virtual.{kind}"
    return DeviceHandle(
        "the simulated stimulator", module, arguments, lost=NodeFailed, timeout_s=timeout_s, record=record
    )
