"""Start a virtual patient's process, hear of its strides, tell it what happens, and be sure to end it."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, Self

from drivers.imu.port import ImuLost
from fes.patient.virtual import PatientSettings, VirtualStride
from fes.patient.virtual.settings import to_plain

_STOP_WAIT_S: Final = 5.0
_ANSWER_WAIT_S: Final = 10.0


@dataclass(slots=True)
class PatientHandle:
    """A running patient: ``ports`` by sensor, ``start_ns`` the host's time at which its own began.

    Use as a context manager, or call :meth:`stop`. Should this process die first, the patient ends by itself.
    """

    process: subprocess.Popen[bytes]
    ports: dict[str, str]
    start_ns: int
    real_time: bool
    summary: dict[str, Any] = field(default_factory=dict)  # known once it has stopped
    _errors: IO[str] | None = None
    _heard: bytes = b""
    _answers: list[dict[str, Any]] = field(default_factory=list)
    _strides: list[VirtualStride] = field(default_factory=list)

    @property
    def now_s(self) -> float:
        """The patient's own time now."""
        return (time.monotonic_ns() - self.start_ns) * 1e-9

    def new_strides(self) -> list[VirtualStride]:
        """Strides of the affected foot that were completed since the last call."""
        self._listen(0.0)
        strides, self._strides = self._strides, []
        return strides

    def do(self, deed: str, value: float = 0.0) -> int:
        """Let something happen to it: walk, stand, speed, electrode, fitness; returns when, CLOCK_MONOTONIC ns.

        Raises:
            ImuLost: it does not know that, or is gone.
        """
        return int(self._ask({"do": deed, "value": value})["t_ns"])

    def fault(self, name: str, value: float = 1.0, sensor: str = "") -> int:
        """Bring a fault of a worn sensor about, without ``sensor`` of all; returns when.

        Raises:
            ImuLost: it does not know it, or is gone.
        """
        return int(self._ask({"fault": name, "value": value, "sensor": sensor})["t_ns"])

    def hold(self, held: bool) -> int:
        """A patient who walks in turns stands for as long as this holds; returns when it was told.

        Raises:
            ImuLost: it is gone.
        """
        return int(self._ask({"hold": held})["t_ns"])

    def begin(self) -> None:
        """Let the time of a patient begin that was started ``held``.

        Raises:
            ImuLost: it has begun already, or is gone.
        """
        self.start_ns = int(self._ask({"begin": True})["start_ns"])

    def replug(self, sensor: str) -> str:
        """Another line in the place of a sensor's; its port.

        Raises:
            ImuLost: it is gone.
        """
        self.ports[sensor] = str(self._ask({"replug": sensor})["port"])
        return self.ports[sensor]

    def punctuality(self) -> dict[str, Any]:
        """How late it was so far, and what reached it.

        Raises:
            ImuLost: it is gone.
        """
        found: dict[str, Any] = self._ask({"ask": "summary"})["summary"]
        return found

    def stop(self) -> int:
        """End it and wait for it; its exit status. May be called twice."""
        if self.process.stdin is not None and not self.process.stdin.closed:
            self.process.stdin.close()
        end_s = time.monotonic() + _STOP_WAIT_S
        while time.monotonic() < end_s and self._listen(0.2):
            pass
        for last_resort in (self.process.terminate, self.process.kill):
            try:
                self.process.wait(_STOP_WAIT_S)
                break
            except subprocess.TimeoutExpired:
                last_resort()
        status = self.process.wait(_STOP_WAIT_S)
        if self.process.stdout is not None:
            self.process.stdout.close()
        if self._errors is not None:
            self._errors.close()
        return status

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    # --- inside -----------------------------------------------------------------------------------------

    def _ask(self, what: Mapping[str, Any]) -> dict[str, Any]:
        if self.process.stdin is None or self.process.stdin.closed:
            raise ImuLost("the virtual patient has been stopped")
        try:
            self.process.stdin.write(json.dumps(what).encode() + b"\n")
            self.process.stdin.flush()
        except OSError as error:
            raise ImuLost(f"the virtual patient is gone: {error}") from error
        end_s = time.monotonic() + _ANSWER_WAIT_S
        while not self._answers:
            if time.monotonic() > end_s or not self._listen(0.1):
                raise ImuLost(f"the virtual patient does not answer{self.said()}")
        answer = self._answers.pop(0)
        if "error" in answer:
            raise ImuLost(f"the virtual patient refused: {answer['error']}")
        return answer

    def said(self) -> str:
        """The end of what it said on stderr, after a colon; "" for nothing."""
        if self._errors is None or self._errors.closed:
            return ""
        self._errors.seek(0)
        text = self._errors.read().strip()
        return f": {text[-500:]}" if text else ""

    def _listen(self, timeout_s: float) -> bool:
        """Take in what it has said; False when its stdout has ended."""
        if self.process.stdout is None or self.process.stdout.closed:
            return False
        descriptor = self.process.stdout.fileno()
        while select.select([descriptor], [], [], timeout_s)[0]:
            data = os.read(descriptor, 1 << 16)
            if not data:
                return False
            *lines, self._heard = (self._heard + data).split(b"\n")
            for line in lines:
                said = json.loads(line)
                if "stride" in said:
                    self._strides.append(VirtualStride(**said["stride"]))
                elif "summary" in said and "done" not in said:
                    self.summary = said["summary"]
                else:
                    self._answers.append(said)
            timeout_s = 0.0
        return True


def spawn_patient(
    pulses: Path,
    settings: PatientSettings,
    *,
    cycle_s: tuple[float, float] | None = None,
    waits: bool = False,
    held: bool = False,
    timeout_s: float = 180.0,
) -> PatientHandle:
    """Start ``python -m fes.hil.patient_process`` and wait until its time has begun (at first it may compile).

    Args:
        pulses: the socket that the stimulator tells its pulses to; made by the patient.
        settings: who it is.
        cycle_s: walk and stand in turns, so many seconds each.
        waits: stand until told to walk.
        held: its time begins with :meth:`PatientHandle.begin`; until then its sensors are silent.
        timeout_s: until it must be there.

    Raises:
        ImuLost: it ended, or was not ready in time.
    """
    command = [sys.executable, "-m", "fes.hil.patient_process", "--pulses", str(pulses)]
    command += ["--settings", json.dumps(to_plain(settings))]
    command += [] if cycle_s is None else ["--cycle", *map(str, cycle_s)]
    command += (["--waits"] if waits else []) + (["--held"] if held else [])
    errors = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115 - lives as long as the handle
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, start_new_session=True
    )
    handle = PatientHandle(process, {}, 0, False, _errors=errors)
    end_s = time.monotonic() + timeout_s
    while not handle._answers and time.monotonic() < end_s and handle._listen(0.2):
        pass
    try:
        ready = handle._answers.pop(0)
        handle.ports, handle.start_ns = dict(ready["ports"]), int(ready["start_ns"])
        handle.real_time = bool(ready["real_time"])
    except (IndexError, KeyError, TypeError, ValueError) as error:
        process.kill()
        process.wait()
        said = handle.said() or f": nothing within {timeout_s:g} s"
        handle.stop()
        raise ImuLost(f"the virtual patient did not start{said}") from error
    return handle
