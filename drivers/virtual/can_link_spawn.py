"""Start the process that joins two CAN buses, and be sure to end it."""

from __future__ import annotations

from pathlib import Path

from drivers.virtual.can_node_spawn import NodeHandle
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
    arguments = ["--back", back.model_dump_json()]
    arguments += ["--front", front.model_dump_json()] if front is not None else ["--slcan", str(slcan)]
    module = "drivers.virtual.can_link"
    return NodeHandle("the simulated CAN line", module, arguments, front or back, timeout_s=timeout_s)
