"""The sessions that are run: the text of their TOML files, for a campaign and for a virtual patient; and who walks.

In a campaign a simulated patient stands, walks a few strides, stands again, for ever.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes import limits
from fes.calibration.recording import SensorCalibrations, calibrate_phase_sensors, load, save
from fes.config import WIRELESS, Bus, StimulatorDevice
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.sensor_choice import Calibration
from fes.recording import write_recording
from fes.recording.write import toml_text
from fes.signals import G_MPS2, NS_PER_S, BoolArray
from fes.simulation.forward import PatientSettings, VirtualPatient, recorded_walk, settings_for
from fes.simulation.forward.closed_loop import calibration_walk, walk_with_truth
from statemachine.phases import Phase

FOOT: Final = "right_foot"
RATE_HZ: Final = 100.0
SENSOR_HZ: Final = {"capture2go": 100.0, "capture2go_ble": 100.0, "witmotion": 100.0, "movella_dot": 60.0}  # only these
STANDS_S: Final = 2.0  # at rest for so long at the recording's beginning
WALKS_S: Final = 4.5
STOPS_S: Final = 2.6  # a last step, then a stand that with the next beginning's lasts longer than a burst may
CALIBRATION_S: Final = 16.0
_PATIENT: Final = settings_for("healthy", seed=11, speed_mps=1.1, sensors=(FOOT,), rate_hz=RATE_HZ, stand_s=STANDS_S)
SYNC_ID: Final = 0x51A7  # that the virtual patient's wireless sensors share
PATIENT_CURRENT_MA: Final = 16.0  # too little for most: the tuning has to find what is needed
_TUNING: Final = {
    "method": "run_to_run",
    "timing": True,
    "toe_clearance_m": {"low": 0.020, "high": 0.050},
    "pitch_at_contact_deg": {"low": 4.0, "high": 25.0},
    "bounds": {
        "current_ma": {"low": 10.0, "high": 50.0},
        "pulse_width_us": {"low": 150.0, "high": 300.0},
        "start_delay_s": {"low": 0.0, "high": 0.2},
        "extension_s": {"low": -0.1, "high": 0.1},
    },
}


@dataclass(frozen=True, slots=True)
class Walker:
    """The recording that the simulated sensor plays round and round, its calibration, and which samples are stance.

    ``in_stance`` (N,) bool, ``rate_hz`` a second: the foot lay flat on the ground, in truth.
    """

    recording: Path
    calibration: Path
    in_stance: BoolArray
    foot: str = FOOT
    rate_hz: float = RATE_HZ
    acc_range_mps2: float | None = None
    gyr_range_radps: float | None = None

    def stances_ns(self, played: Sequence[tuple[int, int]], since_ns: int, until_ns: int) -> list[tuple[int, int]]:
        """From when to when the foot was in stance, by what the sensor played (``ImuHandle.played``)."""
        spans: list[tuple[int, int]] = []
        for (t_ns, first), (next_ns, _) in pairwise([*played, (until_ns, 0)]):
            count = max(math.ceil((next_ns - t_ns) * self.rate_hz / NS_PER_S), 0)
            flat = np.concatenate([[False], self.in_stance[first : first + count], [False]])
            edges = np.flatnonzero(flat[1:] != flat[:-1])
            for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
                from_ns, to_ns = (t_ns + round(edge / self.rate_hz * NS_PER_S) for edge in (begin, end))
                if to_ns > since_ns and from_ns < until_ns:
                    spans.append((max(from_ns, since_ns), min(to_ns, until_ns)))
        return spans


def walker(folder: Path, rate_hz: float = RATE_HZ) -> Walker:
    """Write its files, for a sensor of this rate."""
    recording, calibration = folder / "walker.parquet", folder / "walker.calibration.json"
    walked, truth = walk_with_truth(_PATIENT, WALKS_S, STOPS_S, "walker", "simulated")
    write_recording(walked, recording, overwrite=True)
    save(calibrate_phase_sensors(recorded_walk(_PATIENT, CALIBRATION_S, STOPS_S, "walker", "simulated")), calibration)
    t_ns = walked.tracks[FOOT].t_sensor_ns
    grid_ns = np.arange(t_ns[0], t_ns[-1] + 1, NS_PER_S / rate_hz)
    foot = truth.feet[FOOT]
    at = np.clip(np.searchsorted(foot.t_ns, grid_ns), 0, len(foot.t_ns) - 1)
    return Walker(recording, calibration, foot.phase[at] == Phase.STANCE, rate_hz=rate_hz)


CURRENT_MA: Final = 60.0
PULSE_WIDTH_US: Final = 300.0
FREQUENCY_HZ: Final = 40.0
INTENSITY: Final = 0.3  # 18 mA: an open lead is only told at 15 mA and above
DOSE_MC: Final = 0.3  # three steps' worth
_CABLE: Final = replace(
    limits.CABLE, max_current_ma=80.0, max_charge_per_phase_uc=24.0, max_charge_per_minute_mc=50.0
)  # by radio all that its class allows
CHANNEL: Final = 0
BUTTON_ID: Final = 0x3A0
_BUTTON: Final = {"source": "can_bit", "identifier": BUTTON_ID, "bit": 0, "pressed": "high"}


def _channel_text(channel: Mapping[str, Any], limits_of_it: Mapping[str, float]) -> str:
    """One on an electrode of 25 cm², by the pulses that all channels here have."""
    pulses = {"electrode_area_cm2": 25.0, "pulse_width_us": PULSE_WIDTH_US, "frequency_hz": FREQUENCY_HZ}
    limited = {"max_pulse_width_us": 400.0, "max_frequency_hz": 50.0, **limits_of_it}
    return f"\n[[channels]]\n{toml_text({**channel, **pulses})}\n{toml_text({'channels': {'limits': limited}})}"


def session_text(
    variant: str,
    sensor_port: str,
    bus: Bus | None,
    stimulator: StimulatorDevice,
    worn_by: Walker | None = None,
    sensors: str = "xbus",
) -> str:
    """A session for one foot: the ``worn_by``'s, without whom the simulated patient's.

    Variants: "" stimulates in swing; ``stance`` in stance, without end when the foot stands; ``dose`` as "" with little
    charge a minute; ``button`` as "" with a stop button on the bus; ``seen`` as "", and ``reversed``, whose calibration
    is :func:`reversed_axis`. ``sensors``: which kind it is.
    """
    start, stop = ("stance", "pre_swing") if variant == "stance" else ("swing", "loading_response")
    most = limits.RADIO if sensors in WIRELESS else _CABLE
    if variant == "dose":
        most = replace(most, max_charge_per_minute_mc=DOSE_MC)
    foot, rate_hz = (worn_by.foot, worn_by.rate_hz) if worn_by else (FOOT, RATE_HZ)
    acc_mps2, gyr_radps = (worn_by.acc_range_mps2, worn_by.gyr_range_radps) if worn_by else (None, None)
    aged = {"validity_ms": most.max_validity_ms, "max_data_age_ms": most.max_data_age_ms}
    text = toml_text(
        {"name": "fault campaign", "stimulation": {"intensity": INTENSITY, "strides_before_start": 0, **aged}}
    )
    text += _channel_text(
        {
            **{"name": "tibialis anterior", "number": CHANNEL, "foot": foot, "current_ma": CURRENT_MA},
            **{"start_phase": start, "stop_phase": stop, "rise_s": 0.1},
        },
        {
            "max_current_ma": most.max_current_ma,
            "max_charge_per_phase_uc": most.max_charge_per_phase_uc,
            "max_charge_per_minute_mc": most.max_charge_per_minute_mc,
            "max_current_density_ma_per_cm2": 1.0,
            "max_rise_ma_per_s": 800.0,
            "max_on_s": most.max_on_s,
            "min_off_s": 0.05,
        },
    )
    text += _sensor_text(sensors, foot, sensor_port, rate_hz, acc_mps2, gyr_radps) + _stimulator_text(stimulator, bus)
    return text + ("\n" + toml_text({"live": {"stop_button": _BUTTON}}) if variant == "button" else "")


def reversed_axis(calibration: Path, folder: Path) -> Path:
    """Write the same calibration with every mediolateral axis reversed, and return where."""
    stored = load(calibration)
    found: dict[str, Calibration] = {}
    for sensor, each in stored.calibrations.items():
        x, y, z = each.toe_down if isinstance(each, FootCalibration) else each.left
        reversed_to = (-x, -y, -z)
        if isinstance(each, FootCalibration):
            found[sensor] = replace(each, toe_down=reversed_to)
        else:
            found[sensor] = replace(each, left=reversed_to)
    target = folder / "reversed.calibration.json"
    save(SensorCalibrations(found, sides=stored.sides, serials=stored.serials), target)
    return target


def _sensor_text(
    device: str, sensor: str, port: str, rate_hz: float, acc_mps2: float | None, gyr_radps: float | None = None
) -> str:
    acc_g = (acc_mps2 or 16.0 * G_MPS2) / G_MPS2
    gyr_dps = math.degrees(gyr_radps) if gyr_radps else 2000.0
    text = f'\n[[sensors]]\nsensor = "{sensor}"\ndevice = "{device}"\nport = "{port}"\nrate_hz = {rate_hz}\n'
    return text + f"acc_range_g = {acc_g:.1f}\ngyr_range_dps = {gyr_dps:.1f}\n"


def _stimulator_text(stimulator: StimulatorDevice | None, bus: Bus | None) -> str:
    tables: dict[str, Any] = {}
    if stimulator is not None:
        options = stimulator.options or None
        tables["stimulator"] = {"device": stimulator.device, "port": stimulator.port or None, "options": options}
    if bus is not None:
        tables["bus"] = {"interface": bus.interface, "channel": bus.channel, "options": bus.options or None}
    return "\n" + toml_text(tables) if tables else ""


def patient_session_text(
    settings: PatientSettings,
    current_ma: float = PATIENT_CURRENT_MA,
    tuning: str = "act",
    ports: Mapping[str, str] | None = None,
    stimulator: StimulatorDevice | None = None,
    bus: Bus | None = None,
    sensors: str = "xbus",
) -> str:
    """One channel on the affected foot's dorsiflexors, tuned (off, suggest or act) run to run; by radio never.

    ``ports``: of the ``sensors``, whose kind that is, by name; without them and a stimulator: for a run in one process.
    """
    by_radio = sensors in WIRELESS
    most = limits.RADIO if by_radio else limits.CABLE
    aged = {"validity_ms": most.max_validity_ms, "max_data_age_ms": most.max_data_age_ms} if by_radio else {}
    stimulation = {"intensity": 1.0, **aged}
    text = "# Written by fes: a virtual patient and a simulated stimulator. Valid while they run.\n"
    text += toml_text({"name": "Virtual patient", "subject": "simulated", "stimulation": stimulation})
    text += _channel_text(
        {
            **{"name": f"Tibialis anterior, {settings.side}", "number": settings.channel},
            **{"foot": settings.affected_foot, "muscle": "tibialis anterior", "current_ma": float(current_ma)},
            **{"start_phase": "pre_swing", "stop_phase": "loading_response"},
            **{"onset": "predicted" if by_radio else None, "rise_s": 0.15, "extension_s": 0.06, "fall_s": 0.10},
        },
        {
            "max_current_ma": 50.0,
            "max_charge_per_phase_uc": 15.0,
            "max_charge_per_minute_mc": min(40.0, most.max_charge_per_minute_mc),
            "max_current_density_ma_per_cm2": 0.5,
            "max_rise_ma_per_s": 400.0,
            "max_on_s": min(3.0, most.max_on_s),
            "min_off_s": 0.1,
        },
    )
    if not by_radio:
        text += "\n" + toml_text({"channels": {"tuning": {"mode": tuning, **_TUNING}}})
    geometry = VirtualPatient(settings).geometry.items()
    worn = {foot: each.model_dump() for foot, each in geometry if foot in settings.sensors}
    text += "\n" + toml_text({"treadmill": {"belt_speed_mps": settings.speed_mps}, "geometry": worn})
    for number, (sensor, port) in enumerate((ports or {}).items()):
        text += _sensor_text(sensors, sensor, port, settings.rate_hz, settings.imu.acc_range_mps2)
        if sensors.startswith("capture2go") and len(ports or {}) > 1:  # the first's clock is all others'
            text += f'options = {{ sync = "{"receiver" if number else "sender"}", sync_id = {SYNC_ID} }}\n'
    return text + _stimulator_text(stimulator, bus)


def patient_calibration(settings: PatientSettings) -> SensorCalibrations:
    """What ``fes calibrate`` finds in a walk of this patient without stimulation.

    CalibrationError: no foot can be calibrated.
    """
    return calibrate_phase_sensors(calibration_walk(settings))
