"""Start a simulated serial stimulator's process, tell it its faults while it runs, and be sure to end it."""

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

from drivers.virtual.node_record import RecordEntry, read_record
from drivers.virtual.spawn import NodeFailed

DeviceKind = Literal["sciencemode4", "sciencemode2"]
_STOP_WAIT_S: Final = 3.0
_ANSWER_WAIT_S: Final = 10.0


@dataclass(slots=True)
class DeviceHandle:
    """A running device: ``port`` is what the host opens, ``record`` the file it writes (None: none).

    Use as a context manager, or call :meth:`stop`. Should this process die first, the device ends by itself.
    """

    process: subprocess.Popen[str]
    port: str
    real_time: bool
    record: Path | None
    _errors: IO[str]

    def tell(self, fault: str, value: float = 1.0) -> int:
        """Bring a fault about now; returns when it was, in CLOCK_MONOTONIC ns.

        Raises:
            NodeFailed: the device does not know it, or is gone.
        """
        if self.process.stdin is None:
            raise NodeFailed("the simulated device has no stdin")
        try:
            self.process.stdin.write(json.dumps({"fault": fault, "value": value}) + "\n")
            self.process.stdin.flush()
            answer = json.loads(_line(self.process, _ANSWER_WAIT_S))
            return int(answer["t_ns"])
        except (OSError, ValueError) as error:
            raise NodeFailed(f"the simulated device is gone: {error}") from error
        except KeyError:
            raise NodeFailed(f"the simulated device refused: {answer.get('error')}") from None

    def entries(self, event: str = "") -> list[RecordEntry]:
        """The record so far; only entries of this kind, when one is named."""
        if self.record is None or not self.record.is_file():
            return []
        return [entry for entry in read_record(self.record) if event in ("", entry.event)]

    def stop(self) -> int:
        """End the device and wait for it; returns its exit status. May be called twice."""
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


def spawn_device(
    kind: DeviceKind,
    *,
    record: Path | None = None,
    faults: str = "",
    line: Literal["pty", "tcp"] = "pty",
    timeout_s: float = 20.0,
) -> DeviceHandle:
    """Start ``python -m drivers.virtual.KIND`` and wait until it is ready.

    Raises:
        NodeFailed: it ended, or was not ready within ``timeout_s``.
    """
    command = [sys.executable, "-m", f"drivers.virtual.{kind}", "--until-stdin-closes", "--line", line]
    command += ["--faults", faults] + ([] if record is None else ["--record", str(record)])
    errors = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115 - lives as long as the handle
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True, start_new_session=True
    )
    handle = DeviceHandle(process, "", False, record, errors)
    said = _line(process, timeout_s)
    try:
        ready = json.loads(said)
        handle.port, handle.real_time = str(ready["port"]), bool(ready["real_time"])
    except (ValueError, KeyError, TypeError) as error:
        process.kill()
        process.wait(_STOP_WAIT_S)
        errors.seek(0)
        why = errors.read().strip() or said.strip() or f"nothing within {timeout_s:g} s"
        handle.stop()
        raise NodeFailed(f"the simulated stimulator did not start ({' '.join(command)}); it said: {why}") from error
    return handle


def _line(process: subprocess.Popen[str], timeout_s: float) -> str:
    if process.stdout is None:
        return ""
    ready, _, _ = select.select([process.stdout], [], [], timeout_s)
    return process.stdout.readline() if ready else ""
