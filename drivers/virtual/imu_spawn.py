"""Start a simulated inertial sensor's process, tell it its faults while it runs, and be sure to end it."""

from __future__ import annotations

import json
import select
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Literal, Self

from drivers.imu.port import ImuLost
from fes.config import Bus

ImuKind = Literal["xbus", "ximu3", "xsens_can", "lsl"]
_STOP_WAIT_S: Final = 3.0


@dataclass(slots=True)
class ImuHandle:
    """A running sensor: ``port`` is what the host opens, ``t0_ns`` when its clock stood at its offset."""

    process: subprocess.Popen[str]
    port: str
    t0_ns: int
    _errors: IO[str]

    def fault(self, name: str, value: float = 1.0) -> int:
        """Bring a fault about now; returns when it was, in CLOCK_MONOTONIC ns.

        Raises:
            ImuLost: the device does not know it, or is gone.
        """
        if self.process.stdin is None:
            raise ImuLost("the simulated sensor has no stdin")
        try:
            self.process.stdin.write(json.dumps({"fault": name, "value": value}) + "\n")
            self.process.stdin.flush()
            answer = json.loads(_line(self.process, 10.0))
        except (OSError, ValueError) as error:
            raise ImuLost(f"the simulated sensor is gone: {error}") from error
        if "error" in answer:
            raise ImuLost(f"the simulated sensor refused: {answer['error']}")
        return int(answer["t_ns"])

    def clear(self) -> None:
        """End the faults that last."""
        for name in ("garble", "drop", "reorder", "delay", "mute", "unit", "stuck", "clip", "full", "nan", "doubled"):
            self.fault(name, 0.0)

    def stop(self) -> int:
        """End the sensor and wait for it; returns its exit status. May be called twice."""
        if self.process.stdin is not None:
            self.process.stdin.close()
        for last_resort in (self.process.terminate, self.process.kill):
            try:
                self.process.wait(_STOP_WAIT_S)
                break
            except subprocess.TimeoutExpired:
                last_resort()
        status = self.process.wait(_STOP_WAIT_S)
        if self.process.stdout is not None:
            self.process.stdout.close()
        self._errors.close()
        return status

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


def spawn_imu(
    device: ImuKind,
    *,
    sensor: str = "right_foot",
    recording: Path | None = None,
    rate_hz: float = 100.0,
    offset_s: float = 0.0,
    drift_ppm: float = 0.0,
    line: Literal["pty", "tcp"] = "pty",
    bus: Bus | None = None,
    id_offset: int = 0,
    name: str = "imu",
    timeout_s: float = 30.0,
) -> ImuHandle:
    """Start ``python -m drivers.virtual.imu_process`` and wait until it is ready.

    Raises:
        ImuLost: it ended, or was not ready within ``timeout_s``.
    """
    command = [sys.executable, "-m", "drivers.virtual.imu_process", "--device", device, "--sensor", sensor]
    command += ["--rate", str(rate_hz), "--offset", str(offset_s), "--drift", str(drift_ppm), "--line", line]
    command += ["--id-offset", str(id_offset), "--name", name]
    command += ["--recording", str(recording)] if recording is not None else []
    command += ["--bus", bus.model_dump_json()] if bus is not None else []
    errors = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115 - lives as long as the handle
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True, start_new_session=True
    )
    handle = ImuHandle(process, "", 0, errors)
    said = _line(process, timeout_s)
    try:
        ready = json.loads(said)
        handle.port, handle.t0_ns = str(ready["port"]), int(ready["t0_ns"])
    except (ValueError, KeyError, TypeError) as error:
        process.kill()
        process.wait(_STOP_WAIT_S)
        errors.seek(0)
        why = errors.read().strip() or said.strip() or f"nothing within {timeout_s:g} s"
        handle.stop()
        raise ImuLost(f"the simulated sensor did not start ({' '.join(command)}); it said: {why}") from error
    return handle


def _line(process: subprocess.Popen[str], timeout_s: float) -> str:
    if process.stdout is None:
        return ""
    ready, _, _ = select.select([process.stdout], [], [], timeout_s)
    return process.stdout.readline() if ready else ""
