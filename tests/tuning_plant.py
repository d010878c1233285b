"""A foot that answers to charge, as plain as can be: recruitment ramp, noise, drift; and a tuning that follows it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from random import Random
from typing import Any

import numpy as np

from fes.config import Channel, ChannelLimits, ImuDevice, Session, Tuning
from fes.signals import NS_PER_S, StimStatus, StrideResult
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.report import TuningReport
from fes.stimulation.tuning.session import Tuners

BAND = {"low": 0.012, "high": 0.035}
BOUNDS = {
    "current_ma": {"low": 10.0, "high": 40.0},
    "pulse_width_us": {"low": 100.0, "high": 400.0},
    "start_delay_s": {"low": 0.0, "high": 0.3},
    "extension_s": {"low": 0.0, "high": 0.2},
}


def tuning(**changes: Any) -> Tuning:
    return Tuning.model_validate({"mode": "act", "toe_clearance_m": BAND, "bounds": BOUNDS} | changes)


def channel(tuned: Tuning | None = None, **changes: Any) -> Channel:
    values: dict[str, Any] = {
        "name": "Tibialis anterior",
        "number": 0,
        "foot": "right_foot",
        "electrode_area_cm2": 25.0,
        "current_ma": 30.0,
        "pulse_width_us": 300.0,
        "frequency_hz": 40.0,
        "limits": ChannelLimits(
            max_current_ma=45.0,
            max_pulse_width_us=450.0,
            max_frequency_hz=50.0,
            max_charge_per_phase_uc=20.0,
            max_charge_per_minute_mc=30.0,
            max_current_density_ma_per_cm2=1.0,
            max_rise_ma_per_s=400.0,
            max_on_s=3.0,
            min_off_s=0.1,
        ),
        "tuning": tuned or tuning(),
    }
    return Channel(**values | changes)


def stride(
    number: int,
    toe_clearance_m: float,
    pitch_deg: float = 5.0,
    duration_s: float = 1.4,
    pre_swing_s: float = 0.4,
    swing_s: float = 0.5,
    **changes: Any,
) -> StrideResult:
    """Stride ``number`` of an even walk, its swing as long as said, its pitch constant until contact."""
    start_ns = round(number * duration_s * NS_PER_S)
    at = [0.2, 0.2 + pre_swing_s, 0.2 + pre_swing_s + swing_s, 0.3 + pre_swing_s + swing_s]
    pre, swing, loading, stance = (start_ns + round(s * NS_PER_S) for s in at)
    values: dict[str, Any] = {
        "foot": "right_foot",
        "number": number,
        "t_start_ns": start_ns,
        "t_end_ns": start_ns + round(duration_s * NS_PER_S),
        "stride_length_m": 0.8,
        "clearance_m": 0.15 + toe_clearance_m,
        "height_gained_m": 0.0,
        "turn_rad": 0.0,
        "speed_mps": 0.8 / duration_s,
        "t_pre_swing_ns": pre,
        "t_swing_ns": swing,
        "t_loading_response_ns": loading,
        "t_stance_ns": stance,
        "toe_clearance_m": toe_clearance_m,
        "trajectory_m": np.zeros((101, 3)),
        "pitch_rad": np.full(101, math.radians(pitch_deg)),
    }
    return StrideResult(**values | changes)


@dataclass
class Plant:
    """Toe clearance from the charge of a pulse: threshold, saturation, noise, and what fatigue leaves of it."""

    threshold_uc: float = 3.5
    saturation_uc: float = 11.0
    range_m: float = 0.06
    baseline_m: float = -0.01
    noise_m: float = 0.003
    seed: int = 1
    fitness: float = 1.0
    fatigue_per_stride: float = 0.0
    _random: Random = field(init=False)

    def __post_init__(self) -> None:
        self._random = Random(self.seed)

    def clearance_m(self, parameters: BurstParameters, intensity: float = 1.0) -> float:
        charge_uc = parameters.current_ma * intensity * parameters.mean_width_us * 1e-3
        recruited = min(max((charge_uc - self.threshold_uc) / (self.saturation_uc - self.threshold_uc), 0.0), 1.0)
        self.fitness *= 1.0 - self.fatigue_per_stride * recruited
        risen = self.range_m * self.fitness * recruited
        return max(self.baseline_m + risen + self._random.gauss(0.0, self.noise_m), 0.0)


def charge_of(parameters: BurstParameters, intensity: float = 1.0) -> float:
    """Of one burst, µC: 30 pulses."""
    return 30.0 * parameters.current_ma * intensity * parameters.mean_width_us * 1e-3


class Tuned:
    """One channel's tuning as the controller has it, fed stride by stride; ``said`` is all that it has reported."""

    def __init__(self, one: Channel) -> None:
        sensor = ImuDevice(
            sensor="right_foot", device="xsens_can", rate_hz=100.0, acc_range_g=16.0, gyr_range_dps=2000.0
        )
        self.tuners = Tuners(Session(name="test", channels=(one,), sensors=(sensor,)))
        self.tuner = self.tuners.tuners[one.number]
        self.said: list[TuningReport] = []

    @property
    def parameters(self) -> BurstParameters:
        return self.tuner.parameters

    def walk(self, walked: StrideResult, charge_uc: float | None = None, intensity: float = 1.0) -> list[TuningReport]:
        """A stride with the charge of the burst in force, or this; what came of it."""
        given_uc = charge_of(self.parameters, intensity) if charge_uc is None else charge_uc
        self.tuners.on_status(StimStatus(walked.t_end_ns - 1, 0, 0, True, 1.0, 1.0, 40.0, 1, given_uc))
        reports = list(self.tuners.on_stride(walked.t_end_ns, "right_foot", walked, intensity))
        self.said += reports
        return reports
