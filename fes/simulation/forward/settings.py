"""A virtual patient in plain numbers with their allowed ranges: body, gait, muscle, sensors; ready ones by name."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

from fes.config import read_toml
from fes.signals import FOOT_SENSORS, SENSORS, SHANK_SENSORS
from fes.simulation.forward.gait_patterns import PATTERNS
from fes.simulation.sensor import ImuModel, Placement

STEP_NS = 500_000  # the internal step: the shoe sole's contact modes (about 70 Hz) are well below its 2 kHz

REFERENCE_US: Final = 300.0  # the pulse width at which thresholds are given
MUSCLE_GROUPS: Final = ("muscle", "evertors", "calf")  # the settings that are a stimulated muscle's


@dataclass(frozen=True, slots=True)
class MuscleSettings:
    """A stimulated muscle group: the dorsiflexors, the evertors, or the calf."""

    threshold_uc: float = 3.5  # charge per phase at which the first fibres answer, µC, in a pulse of REFERENCE_US
    saturation_uc: float = 11.0  # charge at which all that the electrodes reach are recruited, in such a pulse, µC
    chronaxie_us: float = 459.0  # strength–duration time constant of motor axons (Mogyoros et al., Brain 119, 1996)
    max_torque_nm: float = 14.0  # greatest torque of the fresh, fully recruited muscle at 40 Hz, N·m
    delay_s: float = 0.03  # electromechanical delay, from pulse to first force
    tau_calcium_s: float = 0.025  # time constant of the rise and decay of one pulse's calcium
    tau_rise_s: float = 0.06  # time constant of activation rising
    tau_fall_s: float = 0.06  # time constant of activation falling
    fatigue_s: float = 250.0  # time constant of tiring under full activation; ``inf`` never tires
    recovery_s: float = 300.0  # time constant of recovery at rest
    fatigue_floor: float = 0.3  # share of the torque that is left however long it goes on

    def equivalent_uc(self, charge_uc: float, pulse_width_us: float) -> float:
        """Charge of a pulse of REFERENCE_US that reaches the same fibres (Weiss: threshold charge ~ width + chronaxie).

        Durfee & MacLean's recruitment is over charge at one width; short pulses need less charge and more current.
        """
        return charge_uc * (REFERENCE_US + self.chronaxie_us) / (pulse_width_us + self.chronaxie_us)


@dataclass(frozen=True, slots=True)
class DeliveredPulse:
    """One pulse that left the stimulator: when, on which channel, how strong."""

    t_ns: int
    channel: int
    current_ma: float
    pulse_width_us: float

    @property
    def charge_uc(self) -> float:
        """Charge of one phase."""
        return self.current_ma * self.pulse_width_us * 1e-3


PLACEMENTS: Final = {
    "left_foot": Placement((0.068, 0.006, 0.067), (-4.0, 19.0, 5.0)),
    "right_foot": Placement((0.070, -0.005, 0.068), (3.0, 21.0, -4.0)),
    "left_shank": Placement((0.030, 0.030, 0.200), (3.0, -4.0, 6.0)),
    "right_shank": Placement((0.030, -0.030, 0.200), (-3.0, -5.0, -5.0)),
}


@dataclass(frozen=True, slots=True)
class PatientSettings:
    """One virtual patient."""

    seed: int = 1  # fixes every random number
    side: str = "right"  # the affected leg
    speed_mps: float = 0.8  # belt speed
    height_m: float = 1.75  # body height; segments are Winter's shares of it
    mass_kg: float = 75.0  # body mass
    voluntary_dorsiflexion: float = 0.0  # share of a healthy person's own dorsiflexion in swing that is left, 0–1
    spasticity: float = 0.2  # 0 (none) to 1 (the calf answers every stretch, and is short and stiff)
    pattern: str = "none"  # "none", or one of Wang et al.'s five, "hemiparetic_1" … "hemiparetic_5"
    muscle: MuscleSettings = field(default_factory=MuscleSettings)  # the stimulated dorsiflexors of the affected side
    channel: int = 0  # the stimulator's channel on them; pulses of channels that are on no muscle do nothing
    evertors: MuscleSettings = field(default_factory=lambda: MuscleSettings(max_torque_nm=6.0))  # the peronei
    evertor_channel: int | None = None  # the stimulator's channel on the evertors; None: no electrode is there
    # gastrocnemius, stimulated from heel rise on for more push-off (Kesar et al., *Stroke* 40, 2009); its torque is
    # chosen: a fifth of the some 120 N·m that healthy plantarflexors hold at will, as much as a bearable current gives
    calf: MuscleSettings = field(default_factory=lambda: MuscleSettings(max_torque_nm=25.0))
    calf_channel: int | None = None  # the stimulator's channel on the calf; None: no electrode is there
    # inversion torque for each N·m of stimulated dorsiflexion: the lever of tibialis anterior about the subtalar axis,
    # 0.6 ± 0.3 cm (Piazza et al., Conf IEEE EMBS 2003), over its 4 cm about the ankle, less what of the evertors the
    # same electrodes reach; below 0 they evert
    inversion_share: float = 0.10
    roll_stiffness_nm_per_rad: float = 12.0  # of the relaxed foot about its long axis
    spasm_radps: float = 2.0  # stretch of the calf that sets off a spasm; its torque grows with ``spasticity``
    electrode_quality: float = 1.0  # share of the charge that reaches the nerve, 0–1
    # habitual extra lift by hip and knee against the dropped foot, 0 (none) to 1 (just clears)
    compensation: float = 0.6
    variability: float = 1.0  # stride-to-stride variation, 1 being usual
    knee_flexion: float = 1.0  # of both knees, as a share of what is normal or the pattern's
    early_lift_m: float = 0.015  # the toe's clearance in early swing is this much above the least, in mid-swing
    leg_twist_deg: float = 19.0  # outward turn of the leg about its long axis from stance to early swing
    toe_break_deg: float = 20.0  # from square across the foot to the line through the toes' joints
    shoe_stiffness: float = 1.0  # of sole and heel pad, 1 being a heel that gives way by 8 mm under half the weight
    strap_hz: float = 30.0  # natural frequency of a sensor on strap, shoe and skin
    strap_damping: float = 0.7  # … and its damping ratio
    asymmetry: float = 0.02  # how much shorter the affected leg's stance is, as a share of the cycle
    rate_hz: float = 100.0  # samples a second of every sensor; 2000 must be a multiple of it
    sensors: tuple[str, ...] = FOOT_SENSORS + SHANK_SENSORS  # which sensors are worn
    imu: ImuModel = field(default_factory=ImuModel)  # what is wrong with the sensors
    # where they sit; a shank's position is from the ankle, its z up the shank
    placements: dict[str, Placement] = field(default_factory=PLACEMENTS.copy)
    stand_s: float = 4.0  # quiet standing before the belt starts

    def __post_init__(self) -> None:
        if self.side not in ("left", "right"):
            raise ValueError(f"side = {self.side!r}: the affected side is 'left' or 'right'")
        if self.pattern not in PATTERNS:
            raise ValueError(f"pattern = {self.pattern!r}: choose one of {', '.join(PATTERNS)}")
        for settings, prefix, ranges in (
            (self, "", _RANGES),
            (self.muscle, "muscle.", _MUSCLE_RANGES),
            (self.evertors, "evertors.", _MUSCLE_RANGES),
            (self.calf, "calf.", _MUSCLE_RANGES),
        ):
            for name, (low, high) in ranges.items():
                value = getattr(settings, name)
                if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
                    raise ValueError(f"{prefix}{name} = {value!r}: must be a number from {low:g} to {high:g}")
        for name in ("seed", "channel"):
            if not isinstance(getattr(self, name), int):
                raise ValueError(f"{name} = {getattr(self, name)!r}: must be a whole number")
        taken = {self.channel: "dorsiflexors"}
        for muscles in ("evertor", "calf"):
            number = getattr(self, f"{muscles}_channel")
            if number is None:
                continue
            if number not in range(8):
                raise ValueError(f"{muscles}_channel = {number!r}: must be a whole number from 0 to 7")
            if number in taken:
                raise ValueError(f"{muscles}_channel = {number} is the {taken[number]}' channel already")
            taken[number] = f"{muscles}s"
        for name in MUSCLE_GROUPS:
            muscle = getattr(self, name)
            if muscle.saturation_uc <= muscle.threshold_uc:
                low, high = muscle.threshold_uc, muscle.saturation_uc
                raise ValueError(f"{name}.saturation_uc = {high:g} must be above threshold_uc = {low:g}")
        steps = 1e9 / STEP_NS / self.rate_hz
        if steps < 2.0 or abs(steps - round(steps)) > 1e-9:
            raise ValueError(f"rate_hz = {self.rate_hz:g}: 2000 must be a multiple of it, e.g. 100, 200, 400, 500")
        unknown = [name for name in self.sensors if name not in SENSORS or name not in self.placements]
        if unknown or not self.sensors:
            raise ValueError(f"sensors = {self.sensors}: give some of {', '.join(SENSORS)}, each with its placement")

    @property
    def affected_foot(self) -> str:
        """Name of the affected side's foot sensor."""
        return f"{self.side}_foot"


_RANGES = {
    "seed": (0, 2**63), "speed_mps": (0.1, 2.0), "height_m": (1.2, 2.2), "mass_kg": (35.0, 180.0),
    "voluntary_dorsiflexion": (0.0, 1.0), "spasticity": (0.0, 1.0), "channel": (0, 7), "electrode_quality": (0.0, 1.0),
    "compensation": (0.0, 1.5), "variability": (0.0, 3.0), "asymmetry": (-0.15, 0.15), "rate_hz": (20.0, 1000.0),
    "stand_s": (1.0, 600.0), "inversion_share": (-0.5, 0.5), "roll_stiffness_nm_per_rad": (2.0, 100.0),
    "spasm_radps": (0.5, math.inf), "shoe_stiffness": (0.4, 2.0), "strap_hz": (15.0, 200.0),
    "strap_damping": (0.1, 2.0), "toe_break_deg": (-10.0, 40.0), "leg_twist_deg": (-20.0, 40.0),
    "knee_flexion": (0.4, 1.2), "early_lift_m": (0.0, 0.04),
}  # fmt: skip
_MUSCLE_RANGES = {
    "threshold_uc": (0.0, 60.0), "saturation_uc": (0.0, 65.0), "chronaxie_us": (50.0, 2000.0),
    "max_torque_nm": (0.0, 60.0), "delay_s": (0.0, 0.2),
    "tau_calcium_s": (0.002, 0.2), "tau_rise_s": (0.005, 1.0), "tau_fall_s": (0.005, 1.0), "fatigue_s": (1.0, math.inf),
    "recovery_s": (1.0, math.inf), "fatigue_floor": (0.0, 1.0),
}  # fmt: skip


def _names(kind: type) -> set[str]:
    return {item.name for item in fields(kind)}


def from_plain(values: Mapping[str, Any]) -> PatientSettings:
    """Back from the plain values of ``dataclasses.asdict``, which may have been through JSON.

    Raises:
        ValueError, TypeError: they are no settings of a patient.
    """
    kinds: dict[str, Callable[[Any], Any]] = {
        **dict.fromkeys(MUSCLE_GROUPS, lambda plain: MuscleSettings(**plain)),
        "imu": lambda plain: ImuModel(**plain),
        "placements": lambda plain: {
            name: Placement(tuple(one["body_m"]), tuple(one["angles_deg"])) for name, one in plain.items()
        },
        "sensors": tuple,
    }
    return PatientSettings(**{name: kinds[name](value) if name in kinds else value for name, value in values.items()})


SEVERITIES: Final[dict[str, dict[str, float]]] = {
    "healthy": {"voluntary_dorsiflexion": 1.0, "spasticity": 0.0, "asymmetry": 0.0},
    "mild": {"voluntary_dorsiflexion": 0.5, "spasticity": 0.1, "compensation": 0.6},
    "moderate": {"voluntary_dorsiflexion": 0.15, "spasticity": 0.3, "compensation": 0.6},
    "severe": {"voluntary_dorsiflexion": 0.0, "spasticity": 0.7, "compensation": 0.5, "asymmetry": 0.04},
}


def settings_for(severity: str, **others: object) -> PatientSettings:
    """A patient of one of :data:`SEVERITIES`; ``others`` are settings by name and win.

    A pattern walks at its own speed unless ``others`` names one.

    Raises:
        ValueError: an unknown severity or setting, or a value out of range.
    """
    if severity not in SEVERITIES:
        raise ValueError(f"severity {severity!r}: choose one of {', '.join(SEVERITIES)}")
    unknown = set(others) - _names(PatientSettings)
    if unknown:
        raise ValueError(f"no such setting of a patient: {', '.join(sorted(unknown))}")
    values: dict[str, Any] = {**SEVERITIES[severity], **others}
    pattern = values.get("pattern", "none")
    if pattern in PATTERNS and pattern != "none":
        values.setdefault("speed_mps", PATTERNS[pattern].speed_mps)
    return PatientSettings(**values)


def load_patient(path: Path, **others: object) -> PatientSettings:
    """A patient from a TOML file: a table ``[patient]`` with ``severity`` and any settings, ``[patient.muscle]``.

    Raises:
        ValueError: the file cannot be read, or holds what is no setting; the message names file and key.
    """
    data, _ = read_toml(path, "settings", ValueError)
    table = data.get("patient")
    if not isinstance(table, dict) or set(data) != {"patient"}:
        raise ValueError(f"{path}: must hold one table, [patient]; it has {', '.join(data) or 'nothing'}")
    values = dict(table)
    groups = {name: values.pop(name) for name in MUSCLE_GROUPS if name in values}
    allowed = (_names(PatientSettings) - {*MUSCLE_GROUPS, "imu", "placements"}) | {"severity"}
    _refuse(path, "patient", values, allowed)
    try:
        for name, group in groups.items():
            if not isinstance(group, dict):
                raise ValueError(f"{name} must be a table, [patient.{name}]")
            _refuse(path, f"patient.{name}", group, _names(MuscleSettings))
            values[name] = replace(getattr(PatientSettings(), name), **group)
        if "sensors" in values:
            if not isinstance(values["sensors"], list):
                raise ValueError(f'sensors = {values["sensors"]!r}: must be a list of names, e.g. ["left_foot"]')
            values["sensors"] = tuple(values["sensors"])
        values = {**values, **others}
        return settings_for(values.pop("severity", "moderate"), **values)
    except (ValueError, TypeError) as error:
        raise error if str(error).startswith(f"{path}: ") else ValueError(f"{path}: {error}") from error


def _refuse(path: Path, table: str, values: dict[str, Any], allowed: set[str]) -> None:
    unknown = sorted(set(values) - allowed)
    if unknown:
        raise ValueError(f"{path}: [{table}] has no {unknown[0]!r}; it knows {', '.join(sorted(allowed))}")
