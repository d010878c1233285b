"""Start a simulated inertial sensor's process, inject faults while it runs, and be sure to end it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from drivers.imu.port import ImuLost
from drivers.simulated.imu.device import LASTING
from drivers.simulated.line_faults import LINE_FAULTS
from drivers.simulated.process_handle import ProcessHandle
from fes.config import Bus

ImuKind = Literal["xbus", "ximu3", "xsens_can", "dbc_can", "lsl"]


class ImuHandle(ProcessHandle):
    """A running sensor: ``port`` is what the host opens, ``t0_ns`` when its clock stood at its offset."""

    def __init__(self, arguments: Sequence[str], timeout_s: float) -> None:
        self.t0_ns = 0
        module = "drivers.simulated.imu.process"
        super().__init__("the simulated sensor", module, arguments, lost=ImuLost, timeout_s=timeout_s)

    def _on_ready(self, ready: Mapping[str, Any]) -> None:
        super()._on_ready(ready)
        self.t0_ns = int(ready["t0_ns"])

    def clear(self) -> None:
        """End the faults that last."""
        for name in (*LASTING, *sorted(LINE_FAULTS)):
            self.inject(name, 0.0)


def spawn_imu(
    device: ImuKind,
    *,
    sensor: str = "right_foot",
    recording: Path | None = None,
    rate_hz: float = 100.0,
    offset_s: float = 0.0,
    drift_ppm: float = 0.0,
    line: Literal["pty", "tcp", "udp"] = "pty",
    bus: Bus | None = None,
    id_offset: int = 0,
    options: Mapping[str, str | int | float | bool] | None = None,
    name: str = "imu",
    timeout_s: float = 30.0,
) -> ImuHandle:
    """Start ``python -m drivers.simulated.imu.process`` and wait until it is ready.

    Args:
        device: what it is, as in the session's settings.
        sensor: whose movement.
        recording: played instead of a simulated walk.
        rate_hz: samples a second, by its own clock.
        offset_s: of its clock at the start.
        drift_ppm: of its clock.
        line: of ``xbus`` and ``ximu3``.
        bus: of ``xsens_can`` and ``dbc_can``.
        id_offset: of ``xsens_can``.
        options: of ``dbc_can``, as in the session's settings.
        name: of the LSL stream.
        timeout_s: to be ready in.

    Raises:
        ImuLost: it ended, or was not ready within ``timeout_s``.
    """
    arguments = ["--device", device, "--sensor", sensor, "--rate", str(rate_hz), "--offset", str(offset_s)]
    arguments += ["--drift", str(drift_ppm), "--line", line, "--id-offset", str(id_offset), "--name", name]
    arguments += ["--recording", str(recording)] if recording is not None else []
    arguments += ["--bus", bus.model_dump_json()] if bus is not None else []
    arguments += ["--options", json.dumps(dict(options))] if options is not None else []
    return ImuHandle(arguments, timeout_s)
