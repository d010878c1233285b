"""Session records made by hand for the tests of what people look at: a walk whose numbers are known beforehand."""

from __future__ import annotations

from typing import Any

import numpy as np

from fes.session_log import Note, SampleArrays, SessionRecord
from fes.signals import StimAlive, StimCommand, StimStatus, StrideResult
from statemachine.phases import Phase, PhaseChange, Transition

S = 1_000_000_000
MS = 1_000_000
PERIOD_S = 1.4
PRE_SWING_S, SWING_S, LOADING_S = 0.20, 0.45, 0.12
TO_PRE_SWING_S = 0.35  # from a stride's start (mid-stance) to its pre-swing
LENGTH_M, CLEARANCE_M = 0.63, 0.12
BELT_MPS = 0.45
T0 = 5 * S

LIMITS = {
    "max_current_ma": 40.0,
    "max_pulse_width_us": 300.0,
    "max_frequency_hz": 50.0,
    "max_charge_per_phase_uc": 12.0,
    "max_charge_per_minute_mc": 50.0,
    "max_current_density_ma_per_cm2": 1.0,
    "max_rise_ma_per_s": 500.0,
    "max_on_s": 2.0,
    "min_off_s": 0.1,
}


def channel(number: int, foot: str, name: str, **more: Any) -> dict[str, Any]:
    settings = {
        "name": name,
        "number": number,
        "foot": foot,
        "electrode_area_cm2": 25.0,
        "current_ma": 20.0,
        "pulse_width_us": 250.0,
        "frequency_hz": 40.0,
        "limits": LIMITS,
    }
    return settings | more


def header(channels: list[dict[str, Any]] | None = None, **session: Any) -> dict[str, Any]:
    if channels is None:
        channels = [channel(0, "left_foot", "TA left"), channel(1, "right_foot", "TA right")]
    return {
        "format": 1,
        "fes_version": "0.1.0",
        "kind": "replay",
        "created": "2026-11-20T10:00:00+00:00",
        "recording": {"name": "walk", "sha256": "ab" * 32, "rates_hz": {}, "belt_speed_mps": BELT_MPS},
        "session": {"name": "Trial 3", "subject": "P07", "channels": channels} | session,
        "calibration": {"left_foot": {"gyr_bias_radps": [0.001, -0.002, 0.0005]}},
        "stim_session_id": 7,
    }


def at(seconds: float) -> int:
    return T0 + round(seconds * S)


def foot_path(length_m: float, clearance_m: float, points: int = 101) -> tuple[np.ndarray, np.ndarray]:
    """A foot's path and pitch over a stride: heel up, toe down, swing through, heel first, flat."""
    phase = np.linspace(0.0, 1.0, points)
    rise = np.clip((phase - 0.25) / 0.52, 0.0, 1.0)
    forward = length_m * (rise**2.2 * (3.0 - 2.0 * rise) / 1.0) ** 0.9
    height = clearance_m * (np.exp(-(((phase - 0.46) / 0.075) ** 2)) + 0.33 * np.exp(-(((phase - 0.68) / 0.06) ** 2)))
    pitch = np.radians(-58 * np.exp(-(((phase - 0.44) / 0.07) ** 2)) + 24 * np.exp(-(((phase - 0.72) / 0.07) ** 2)))
    sway = 0.02 * np.sin(np.pi * rise) ** 2
    return np.stack([forward, sway, height], axis=1), pitch


def stride(
    number: int,
    start_s: float,
    foot: str = "left_foot",
    *,
    length_m: float = LENGTH_M,
    clearance_m: float = CLEARANCE_M,
    **more: Any,
) -> StrideResult:
    pre = start_s + TO_PRE_SWING_S
    path, pitch = foot_path(length_m, clearance_m)
    values: dict[str, Any] = {
        "foot": foot,
        "number": number,
        "t_start_ns": at(start_s),
        "t_end_ns": at(start_s + PERIOD_S),
        "stride_length_m": length_m,
        "clearance_m": clearance_m,
        "height_gained_m": 0.001,
        "turn_rad": 0.02,
        "speed_mps": length_m / PERIOD_S,
        "t_pre_swing_ns": at(pre),
        "t_swing_ns": at(pre + PRE_SWING_S),
        "t_loading_response_ns": at(pre + PRE_SWING_S + SWING_S),
        "t_stance_ns": at(pre + PRE_SWING_S + SWING_S + LOADING_S),
        "trajectory_m": path,
        "pitch_rad": pitch,
    }
    return StrideResult(**(values | more))


def phases_of(result: StrideResult) -> list[PhaseChange]:
    """The phase changes that belong to a stride's entries."""
    names = (
        (result.t_pre_swing_ns, Transition.T1, Phase.STANCE, Phase.PRE_SWING),
        (result.t_swing_ns, Transition.T2, Phase.PRE_SWING, Phase.SWING),
        (result.t_loading_response_ns, Transition.T3, Phase.SWING, Phase.LOADING_RESPONSE),
    )
    changes = [PhaseChange(t, result.foot, how, a, b) for t, how, a, b in names if t is not None]
    if result.t_stance_ns is not None:
        seen = result.t_loading_response_ns is not None
        how, source = (Transition.T4, Phase.LOADING_RESPONSE) if seen else (Transition.T6, Phase.SWING)
        changes.append(PhaseChange(result.t_stance_ns, result.foot, how, source, Phase.STANCE))
    return changes


def burst(number: int, start_s: float, duration_s: float, current_ma: float = 20.0) -> list[StimCommand]:
    """Commands every 20 ms with a ramp of 100 ms at either end, then off."""
    steps = round(duration_s / 0.02)
    commands = [
        StimCommand(
            t_ns=at(start_s + 0.02 * i),
            channel=number,
            on=True,
            current_ma=round(current_ma * min(1.0, (i + 1) / 5, (steps - i) / 5) * 2) / 2,
            pulse_width_us=250.0,
            frequency_hz=40.0,
            validity_ms=60,
        )
        for i in range(steps)
    ]
    return [*commands, StimCommand(at(start_s + duration_s), number, False, 0.0, 0.0, 0.0, 60)]


def answers(commands: list[StimCommand]) -> list[StimStatus]:
    """A device that delivers 0.8 pulses per command and counts them (as whole pulses)."""
    found, owed = [], 0.0
    for i, command in enumerate(commands):
        owed += 0.8 if command.on else 0.0
        pulses, owed = int(owed), owed - int(owed)
        charge = pulses * command.current_ma * command.pulse_width_us * 1e-3
        found.append(
            StimStatus(
                command.t_ns + MS,
                command.channel,
                i % 16,
                command.on,
                command.current_ma,
                command.pulse_width_us,
                command.frequency_hz,
                pulses,
                charge,
            )
        )
    return found


def signals(result: list[StrideResult], seconds: float, rate_hz: float, seed: int) -> SampleArrays:
    """Samples of a tilted sensor that fit the strides' pitch and height well enough to look at."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * rate_hz)) / rate_hz
    pitch, height = np.zeros(t.size), np.zeros(t.size)
    shock = np.zeros(t.size)
    for one in result:
        begin, end = (one.t_start_ns - T0) / S, (one.t_end_ns - T0) / S
        inside = (t >= begin) & (t < end)
        share = (t[inside] - begin) / (end - begin)
        grid = np.linspace(0, 1, one.pitch_rad.size)
        pitch[inside] = np.interp(share, grid, one.pitch_rad)
        height[inside] = np.interp(share, grid, one.trajectory_m[:, 2])
        if one.t_loading_response_ns is not None:
            shock += 18 * np.exp(-(((t - (one.t_loading_response_ns - T0) / S - 0.02) / 0.015) ** 2))
    width = max(3, int(rate_hz / 20))
    smooth = np.ones(width) / width
    pitch, height = np.convolve(pitch, smooth, "same"), np.convolve(height, smooth, "same")
    rate = -np.gradient(pitch, t)
    up = 9.81 + np.gradient(np.gradient(height, t), t) + shock
    gyr = np.stack([0.1 * rate, 0.97 * rate, 0.2 * rate], axis=1) + rng.normal(0, 0.03, (t.size, 3))
    acc = np.stack([up * np.sin(pitch) + 0.4 * shock, 0 * t, up * np.cos(pitch)], axis=1)
    stamps = T0 + np.round(t * S).astype(np.int64)
    return SampleArrays(stamps, stamps, acc + rng.normal(0, 0.1, acc.shape), gyr)


def walk(
    count: int = 20, feet: tuple[str, ...] = ("left_foot", "right_foot"), *, rate_hz: float = 100.0, seed: int = 1
) -> SessionRecord:
    """A steady walk of ``count`` strides per foot with stimulation in every stride from the third on."""
    rng = np.random.default_rng(seed)
    record = SessionRecord(header(), complete=True)
    seconds = count * PERIOD_S + 2.0
    for index, foot in enumerate(("left_foot", "right_foot")):
        if foot not in feet:
            continue
        own = []
        for number in range(count):
            start_s = 0.5 + number * PERIOD_S + (PERIOD_S / 2 if index else 0.0)
            late = rng.normal(0, 0.01)
            one = stride(
                number,
                start_s,
                foot,
                length_m=LENGTH_M + rng.normal(0, 0.025),
                clearance_m=CLEARANCE_M - 0.02 * index + rng.normal(0, 0.008),
                t_swing_ns=at(start_s + TO_PRE_SWING_S + PRE_SWING_S + late),
            )
            own.append(one)
            record.phases += phases_of(one)
            if number >= 2:
                record.commands += burst(index, start_s + TO_PRE_SWING_S + 0.004, 0.70 + 0.02 * int(rng.integers(0, 3)))
        record.strides += own
        record.samples[foot] = signals(own, seconds, rate_hz, seed + index)
    record.phases.sort(key=lambda change: change.t_ns)
    record.commands.sort(key=lambda command: command.t_ns)
    record.strides.sort(key=lambda one: one.t_end_ns)
    record.statuses = answers(record.commands)
    sent = len(record.commands)
    record.summary = {"wire": {"commands": sent, "matched": sent, "missing": 0, "different": 0}}
    ends = int(seconds * 10)
    record.alive = [StimAlive(T0 + i * 100 * MS, 3, 0) for i in range(ends)]
    record.latency_ns = (rng.gamma(4.0, 60_000, 4000) + 90_000).astype(np.int64)
    record.latency_t_ns = np.linspace(T0, at(seconds), 4000).astype(np.int64)
    record.notes = [Note(at(0.1), "info", "runner", "armed by the operator")]
    return record
