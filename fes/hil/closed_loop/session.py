"""The session that a virtual patient is walked with: the text of its TOML file, and the sensors' calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from fes.calibration.recording import SensorCalibrations, calibrate_phase_sensors
from fes.config import Bus, FootGeometry, StimulatorDevice
from fes.hil.settings import table
from fes.signals import G_MPS2
from fes.simulation.forward import PatientSettings, VirtualPatient
from fes.simulation.forward.closed_loop import calibration_walk

CURRENT_MA: Final = 16.0  # too little for most: the tuning has to find what is needed
_SESSION: Final = """# Written by fes: a virtual patient and a simulated stimulator. Valid while they run.
name = "Virtual patient"
subject = "simulated"

[stimulation]
intensity = 1.0

[[channels]]
name = "Tibialis anterior, {side}"
number = {channel}
foot = "{foot}"
muscle = "tibialis anterior"
electrode_area_cm2 = 25.0
current_ma = {current_ma}
pulse_width_us = 300.0
frequency_hz = 40.0
start_phase = "pre_swing"
stop_phase = "loading_response"
rise_s = 0.15
extension_s = 0.06
fall_s = 0.10

[channels.limits]
max_current_ma = 40.0
max_pulse_width_us = 400.0
max_frequency_hz = 50.0
max_charge_per_phase_uc = 12.0
max_charge_per_minute_mc = 40.0
max_current_density_ma_per_cm2 = 0.5
max_rise_ma_per_s = 400.0
max_on_s = 3.0
min_off_s = 0.1

[channels.tuning]
mode = "{tuning}"
method = "run_to_run"
toe_clearance_m = {{ low = 0.020, high = 0.050 }}
pitch_at_contact_deg = {{ low = 4.0, high = 25.0 }}

[channels.tuning.bounds]
current_ma = {{ low = 10.0, high = 40.0 }}
pulse_width_us = {{ low = 300.0, high = 300.0 }}
start_delay_s = {{ low = 0.0, high = 0.0 }}
extension_s = {{ low = 0.06, high = 0.06 }}

[treadmill]
belt_speed_mps = {speed_mps}
"""


def session_text(
    settings: PatientSettings,
    *,
    current_ma: float = CURRENT_MA,
    tuning: str = "act",
    ports: Mapping[str, str] | None = None,
    stimulator: StimulatorDevice | None = None,
    bus: Bus | None = None,
) -> str:
    """One channel on the affected foot's dorsiflexors, tuned run to run.

    Args:
        settings: the patient.
        current_ma: to begin with.
        tuning: off, suggest or act.
        ports: of the sensors, by name; None: a session without devices, for a run in one process.
        stimulator: which, and where.
        bus: for a CAN stimulator.
    """
    text = _SESSION.format(
        side=settings.side,
        channel=settings.channel,
        foot=settings.affected_foot,
        current_ma=float(current_ma),
        tuning=tuning,
        speed_mps=settings.speed_mps,
    )
    for foot, geometry in VirtualPatient(settings).geometry.items():
        if foot in settings.sensors:
            text += _geometry(foot, geometry)
    for sensor, port in (ports or {}).items():
        text += f'\n[[sensors]]\nsensor = "{sensor}"\ndevice = "xbus"\nport = "{port}"\nrate_hz = {settings.rate_hz}\n'
        acc_g = (settings.imu.acc_range_mps2 or 16.0 * G_MPS2) / G_MPS2
        text += f"acc_range_g = {acc_g:.1f}\ngyr_range_dps = 2000.0\n"
    if stimulator is not None:
        text += f'\n[stimulator]\ndevice = "{stimulator.device}"\n'
        text += f'port = "{stimulator.port}"\n' if stimulator.port else ""
    if bus is not None:
        text += f'\n[bus]\ninterface = "{bus.interface}"\nchannel = "{bus.channel}"\n' + table(
            "bus.options", bus.options
        )
    return text


def patient_calibration(settings: PatientSettings) -> SensorCalibrations:
    """What ``fes calibrate`` finds in a walk of this patient without stimulation.

    Raises:
        CalibrationError: no foot can be calibrated.
    """
    return calibrate_phase_sensors(calibration_walk(settings))


def _geometry(foot: str, geometry: FootGeometry) -> str:
    lines = [f"{name} = {value}" for name, value in geometry.model_dump().items()]
    return f"\n[geometry.{foot}]\n" + "\n".join(lines) + "\n"
