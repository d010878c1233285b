"""A virtual patient and a simulated stimulator as processes, joined by delivered pulses, and their session file.

sensors' lines ← patient ← pulses ← stimulator ← its line. What is between the two lines, ``fes run``, is not started
here: whoever has the session file starts it.
"""

import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from drivers.imu.port import ImuLost
from drivers.simulated.imu.faults import LASTING
from drivers.simulated.lines import LINE_FAULTS
from drivers.simulated.spawn import DeviceHandle, DeviceKind, NodeHandle, ProcessHandle, spawn_device, spawn_node
from fes.calibration.recording import save
from fes.config import StimulatorDevice
from fes.hil.closed_loop.patient_process import Life
from fes.hil.settings import FOOT, PATIENT_CURRENT_MA, RATE_HZ, patient_calibration, patient_session_text
from fes.simulation.forward import PatientSettings, VirtualStride, settings_for

STIMULATORS: Final[dict[str, DeviceKind | None]] = {
    "can": None,
    "p24_low_level": "sciencemode4",
    "rehastim2": "sciencemode2",
}
SESSION_NAME: Final = "session.toml"
CYCLE_S: Final = (5.0, 3.5)  # walks and stands in turns; a stand is longer than a burst may last


class PatientHandle(ProcessHandle):
    """A running patient: ``ports`` by sensor, ``start_ns`` the host's time at which its own began.

    ``summary`` is known once it has stopped. What is asked of it raises ImuLost when it is gone or does not know that.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        self.summary: dict[str, Any] = {}
        self._strides: list[VirtualStride] = []
        module = "fes.hil.closed_loop.patient_process"  # at first it may compile
        super().__init__("the virtual patient", module, arguments, lost=ImuLost, timeout_s=180.0)
        self.ports: dict[str, str] = dict(self.ready["ports"])
        self.start_ns = int(self.ready["start_ns"])

    def _on_message(self, message: Mapping[str, Any]) -> bool:
        if "stride" in message:
            self._strides.append(VirtualStride(**message["stride"]))
        elif "summary" in message and "done" not in message:
            self.summary = message["summary"]
        else:
            return False
        return True

    @property
    def now_s(self) -> float:
        """The patient's own time now."""
        return (time.monotonic_ns() - self.start_ns) * 1e-9

    def new_strides(self) -> list[VirtualStride]:
        """Strides of the affected foot that were completed since the last call."""
        self.receive_messages()
        strides, self._strides = self._strides, []
        return strides

    def intervene(self, name: str, value: float = 0.0) -> int:
        """Let something happen to it: walk, stand, speed, electrode, fitness; returns when, CLOCK_MONOTONIC ns."""
        return int(self.request({"do": name, "value": value})["t_ns"])

    def inject(self, name: str, value: float = 1.0, sensor: str = "") -> int:
        """Bring a fault of a worn sensor about, without ``sensor`` of all; returns when."""
        return int(self.request({"fault": name, "value": value, "sensor": sensor})["t_ns"])

    def hold(self, held: bool) -> int:
        """A patient who walks in turns stands for as long as this holds; returns when that was."""
        return int(self.request({"hold": held})["t_ns"])

    def begin(self) -> None:
        """Let the time of a patient begin that was started ``held``, once."""
        self.start_ns = int(self.request({"begin": True})["start_ns"])

    def replug(self, sensor: str) -> str:
        """Another line in the place of a sensor's; its port."""
        self.ports[sensor] = str(self.request({"replug": sensor})["port"])
        return self.ports[sensor]

    def punctuality(self) -> dict[str, Any]:
        """How late it was so far, and what reached it."""
        return dict(self.request({"ask": "summary"})["summary"])


def spawn_patient(pulses: Path, settings: PatientSettings, life: Life) -> PatientHandle:
    """Start ``python -m fes.hil.closed_loop.patient_process`` and wait until its time has begun.

    ``pulses``: the socket that the stimulator sends its pulses to; made by the patient. The time of one who is held
    begins with :meth:`PatientHandle.begin`.

    ImuLost: it ended, or was not ready in time.
    """
    who, how = (json.dumps(asdict(each)) for each in (settings, life))
    return PatientHandle(["--pulses", str(pulses), "--settings", who, "--life", how])


@dataclass(slots=True)
class PatientBench:
    """What runs; ``session`` and ``calibration`` are the files that ``fes run`` needs."""

    settings: PatientSettings
    folder: Path
    session: Path
    calibration: Path
    patient: PatientHandle
    stimulator: NodeHandle | DeviceHandle


def start_patient_bench(
    settings: PatientSettings,
    folder: Path,
    stack: ExitStack,
    life: Life,
    *,
    stimulator: str = "can",
    current_ma: float = PATIENT_CURRENT_MA,
) -> PatientBench:
    """Start both, calibrate on a walk of the same patient, write the session file; ``stack`` ends the processes.

    The folder must exist. ``stimulator``: one of :data:`STIMULATORS`; ``current_ma``: to begin with.

    Raises:
        ImuLost, StimulatorLost: one does not start.
        CalibrationError: this patient's walk does not show enough to calibrate on.
    """
    patient, calibration, pulses = _worn(settings, folder, stack, life)
    record = folder / "stimulator.jsonl"
    kind = STIMULATORS[stimulator]
    device: NodeHandle | DeviceHandle
    if kind is None:
        device = spawn_node(record=record, pulses=pulses)
        where, bus = StimulatorDevice(), device.bus
    else:
        device = spawn_device(kind, record=record, pulses=pulses)
        where, bus = StimulatorDevice.model_validate({"device": stimulator, "port": device.port}), None
    stack.callback(device.stop)
    session = folder / SESSION_NAME
    text = patient_session_text(settings, current_ma, "act", patient.ports, where, bus, life.sensors)
    session.write_text(text, encoding="utf-8")
    return PatientBench(settings, folder, session, calibration, patient, device)


class PatientSensor:
    """One end of the foot sensor's line; the patient's process goes on when it is stopped."""

    def __init__(self, patient: PatientHandle, port: str = "") -> None:
        self._patient = patient
        self._port = port

    @property
    def port(self) -> str:
        """What the host opens; a spare one is plugged in when it is first asked for."""
        if not self._port:
            self._port = self._patient.replug(FOOT)
        return self._port

    def inject(self, name: str, value: float = 1.0) -> int:
        """As a simulated sensor's; ``stand`` keeps the patient standing, 0 lets it walk on."""
        return self._patient.hold(bool(value)) if name == "stand" else self._patient.inject(name, value, FOOT)

    def clear(self) -> None:
        """End the faults that last."""
        for name in (*LASTING, *sorted(LINE_FAULTS)):
            self._patient.inject(name, 0.0, FOOT)

    def stop(self) -> int:
        """Nothing: whoever started the patient ends it."""
        return 0


def campaign_patient(folder: Path, stack: ExitStack, sensors: str = "xbus") -> tuple[PatientHandle, Path, Path]:
    """A patient who walks and stands in turns, the calibration of its sensor, and the socket for its pulses.

    ImuLost: it does not start.
    """
    settings = settings_for("moderate", seed=11, sensors=(FOOT,), rate_hz=RATE_HZ, speed_mps=1.0)
    return _worn(settings, folder, stack, Life(CYCLE_S, sensors=sensors))


def _worn(settings: PatientSettings, folder: Path, stack: ExitStack, life: Life) -> tuple[PatientHandle, Path, Path]:
    calibration = folder / "patient.calibration.json"
    save(patient_calibration(settings), calibration)
    # a socket's name may have 107 bytes, less than many a folder's
    pulses = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fes-"))) / "pulses"
    patient = spawn_patient(pulses, settings, life)
    stack.callback(patient.stop)
    return patient, calibration, pulses
