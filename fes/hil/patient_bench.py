"""A virtual patient and a simulated stimulator as processes, joined by delivered pulses, and their session file.

sensors' lines ← patient ← pulses ← stimulator ← its line. What is between the two lines, ``fes run``, is not started
here: whoever has the session file starts it.
"""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.virtual.can_node_spawn import NodeHandle, spawn_node
from drivers.virtual.device_spawn import DeviceHandle, DeviceKind, spawn_device
from fes.calibrations import save
from fes.config import StimulatorDevice
from fes.hil.patient_session import CURRENT_MA, calibration_of, session_text
from fes.hil.patient_spawn import PatientHandle, spawn_patient
from fes.patient.virtual import PatientSettings

STIMULATORS: Final[dict[str, DeviceKind | None]] = {
    "can": None,
    "p24_low_level": "sciencemode4",
    "rehastim2": "sciencemode2",
}
SESSION_NAME: Final = "session.toml"
CALIBRATION_NAME: Final = "patient.calibration.json"


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
    *,
    stimulator: str = "can",
    current_ma: float = CURRENT_MA,
    tuning: str = "act",
    waits: bool = False,
    held: bool = False,
    cycle_s: tuple[float, float] | None = None,
) -> PatientBench:
    """Start both, calibrate on a walk of the same patient, write the session file; ``stack`` ends the processes.

    Args:
        settings: the patient.
        folder: for the files; must exist.
        stimulator: one of :data:`STIMULATORS`.
        current_ma: the session's to begin with.
        tuning: off, suggest or act.
        waits: the patient stands until told to walk.
        held: its time begins when told to.
        cycle_s: it walks and stands in turns, so many seconds each.

    Raises:
        ImuLost, StimulatorLost: one does not start.
        CalibrationError: this patient's walk does not show enough to calibrate on.
    """
    calibration = folder / CALIBRATION_NAME
    save(calibration_of(settings), calibration)
    # a socket's name may have 107 bytes, less than many a folder's
    pulses = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fes-"))) / "pulses"
    patient = spawn_patient(pulses, settings, waits=waits, held=held, cycle_s=cycle_s)
    stack.callback(patient.stop)
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
    text = session_text(settings, current_ma=current_ma, tuning=tuning, ports=patient.ports, stimulator=where, bus=bus)
    session.write_text(text, encoding="utf-8")
    return PatientBench(settings, folder, session, calibration, patient, device)
