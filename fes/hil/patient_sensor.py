"""A virtual patient's foot sensor in the place of a campaign's: the same faults; the patient feels the pulses."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Protocol

from drivers.virtual.imu_device import LASTING
from drivers.virtual.line_faults import LINE_FAULTS
from fes.calibrations import save
from fes.hil.patient_session import calibration_of
from fes.hil.patient_spawn import PatientHandle, spawn_patient
from fes.hil.walk import FOOT, RATE_HZ
from fes.patient.virtual import PatientSettings, settings_for

CYCLE_S: Final = (5.0, 3.5)  # walks and stands in turns; a stand is longer than a burst may last


class Sensor(Protocol):
    """A campaign's sensor: see :class:`~drivers.virtual.imu_spawn.ImuHandle`."""

    @property
    def port(self) -> str:
        """What the host opens."""
        ...

    def fault(self, name: str, value: float = 1.0) -> int:
        """Bring a fault about now; when that was, CLOCK_MONOTONIC ns."""
        ...

    def clear(self) -> None:
        """End the faults that last."""
        ...

    def stop(self) -> int:
        """It is not needed any more."""
        ...


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

    def fault(self, name: str, value: float = 1.0) -> int:
        """As a simulated sensor's; ``stand`` keeps the patient standing, 0 lets it walk on."""
        return self._patient.hold(bool(value)) if name == "stand" else self._patient.fault(name, value, FOOT)

    def clear(self) -> None:
        """End the faults that last."""
        for name in (*LASTING, *sorted(LINE_FAULTS)):
            self._patient.fault(name, 0.0, FOOT)

    def stop(self) -> int:
        """Nothing: whoever started the patient ends it."""
        return 0


def campaign_patient(folder: Path, pulses: Path) -> tuple[PatientHandle, Path]:
    """A patient who walks and stands in turns, and the calibration of its sensor.

    Args:
        folder: for the calibration.
        pulses: the socket that the stimulator tells its pulses to.

    Raises:
        ImuLost: it does not start.
    """
    settings: PatientSettings = settings_for("moderate", seed=11, sensors=(FOOT,), rate_hz=RATE_HZ, speed_mps=1.0)
    calibration = folder / "patient.calibration.json"
    save(calibration_of(settings), calibration)
    return spawn_patient(pulses, settings, cycle_s=CYCLE_S), calibration
