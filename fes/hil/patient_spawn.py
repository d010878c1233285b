"""Start a virtual patient's process, hear of its strides, tell it what happens, and be sure to end it."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from drivers.imu.port import ImuLost
from drivers.virtual.process_handle import ProcessHandle
from fes.patient.virtual import PatientSettings, VirtualStride
from fes.patient.virtual.settings import to_plain


class PatientHandle(ProcessHandle):
    """A running patient: ``ports`` by sensor, ``start_ns`` the host's time at which its own began.

    ``summary`` is known once it has stopped.
    """

    def __init__(self, arguments: Sequence[str], timeout_s: float) -> None:
        self.ports: dict[str, str] = {}
        self.start_ns = 0
        self.summary: dict[str, Any] = {}
        self._strides: list[VirtualStride] = []
        module = "fes.hil.patient_process"
        super().__init__("the virtual patient", module, arguments, lost=ImuLost, timeout_s=timeout_s)

    def _take(self, ready: Mapping[str, Any]) -> None:
        super()._take(ready)
        self.ports, self.start_ns = dict(ready["ports"]), int(ready["start_ns"])

    def _hear(self, said: Mapping[str, Any]) -> bool:
        if "stride" in said:
            self._strides.append(VirtualStride(**said["stride"]))
        elif "summary" in said and "done" not in said:
            self.summary = said["summary"]
        else:
            return False
        return True

    @property
    def now_s(self) -> float:
        """The patient's own time now."""
        return (time.monotonic_ns() - self.start_ns) * 1e-9

    def new_strides(self) -> list[VirtualStride]:
        """Strides of the affected foot that were completed since the last call."""
        self.listen()
        strides, self._strides = self._strides, []
        return strides

    def do(self, deed: str, value: float = 0.0) -> int:
        """Let something happen to it: walk, stand, speed, electrode, fitness; returns when, CLOCK_MONOTONIC ns.

        Raises:
            ImuLost: it does not know that, or is gone.
        """
        return int(self.ask({"do": deed, "value": value})["t_ns"])

    def fault(self, name: str, value: float = 1.0, sensor: str = "") -> int:
        """Bring a fault of a worn sensor about, without ``sensor`` of all; returns when.

        Raises:
            ImuLost: it does not know it, or is gone.
        """
        return int(self.ask({"fault": name, "value": value, "sensor": sensor})["t_ns"])

    def hold(self, held: bool) -> int:
        """A patient who walks in turns stands for as long as this holds; returns when it was told.

        Raises:
            ImuLost: it is gone.
        """
        return int(self.ask({"hold": held})["t_ns"])

    def begin(self) -> None:
        """Let the time of a patient begin that was started ``held``.

        Raises:
            ImuLost: it has begun already, or is gone.
        """
        self.start_ns = int(self.ask({"begin": True})["start_ns"])

    def replug(self, sensor: str) -> str:
        """Another line in the place of a sensor's; its port.

        Raises:
            ImuLost: it is gone.
        """
        self.ports[sensor] = str(self.ask({"replug": sensor})["port"])
        return self.ports[sensor]

    def punctuality(self) -> dict[str, Any]:
        """How late it was so far, and what reached it.

        Raises:
            ImuLost: it is gone.
        """
        found: dict[str, Any] = self.ask({"ask": "summary"})["summary"]
        return found


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
    arguments = ["--pulses", str(pulses), "--settings", json.dumps(to_plain(settings))]
    arguments += [] if cycle_s is None else ["--cycle", *map(str, cycle_s)]
    arguments += (["--waits"] if waits else []) + (["--held"] if held else [])
    return PatientHandle(arguments, timeout_s)
