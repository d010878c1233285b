"""A live step: one sample's way from the gate that sees it, through estimator, phases, strides and plan, to commands.

The session is armed and stimulates at full intensity, the garbage collector is off as in a live session. Mean and 99th
percentile are by the clock, over the samples of one pass; beside the mean stands this process's processor time in
another pass. Not part of a step: the driver's codec, the log, the stimulator's line.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.speed.speed import one_walk
from benchmarks.speed.speed_row import Row
from benchmarks.speed.speed_session import RATE_HZ, WALK_S, walk
from fes.analysis.pipeline import calibrations_of
from fes.config import load_session
from fes.control.controller import Controller
from fes.control.replay import session_for
from fes.control.runner import armed_after, with_ticks
from fes.estimation.sensor_choice import shank_phase_sensors
from fes.estimation.warm_up import warm_up
from fes.gate import SafetyGate, gate_of
from fes.recording import Recording
from fes.recording.tracks import samples_of
from fes.signals import Event, FloatArray, ImuSample, StrideResult

ROOT = Path(__file__).resolve().parents[2]
GROUP = "a live step"
MEAN_US, P99_US = 12.0, 45.0


@dataclass(frozen=True)
class LiveStep:
    """What one sample takes (µs) by the clock: mean and 99th percentile; and in processor time, the mean.

    ``stride_share`` of the samples end a stride, ``bursts_share`` of the commands have current.
    """

    mean_us: float
    p99_us: float
    processor_us: float
    stride_share: float
    bursts_share: float


def live_step(recording: Recording) -> LiveStep:
    recording, found = calibrations_of(recording)
    session = session_for(recording, load_session(ROOT / "sim_inputs" / "session.toml"))
    up = {sensor: calibration.up for sensor, calibration in found.calibrations.items()}
    source = armed_after(with_ticks(samples_of(recording, set(found.calibrations))), 0.5, 1.0)
    events = list(source)
    is_sample = np.array([isinstance(event, ImuSample) for event in events])
    warm_up()

    def parts() -> tuple[SafetyGate, Controller]:
        return gate_of(session, up, shank_phase_sensors(found.calibrations)), Controller(session, found.calibrations)

    with _as_in_a_session():
        taken_us, strides, commands, on = _clocked_us(events, *parts())
        spent_s = _spent_s(events, *parts())
    taken_us = taken_us[is_sample]
    mean_us, p99_us = float(taken_us.mean()), float(np.percentile(taken_us, 99))
    samples = len(taken_us)
    return LiveStep(mean_us, p99_us, 1e6 * spent_s / samples, strides / samples, on / max(commands, 1))


def live_rows(named: dict[str, Callable[[], Recording]]) -> list[Row]:
    rows = []
    for name, recording in named.items():
        found = live_step(recording())
        current = f"current in {100 * found.bursts_share:.0f} % of the commands"
        strides = f"{100 * found.stride_share:.2g} % of the samples end a stride"
        mean, most = f"live step, mean, {name}", f"live step, 99 %, {name}"
        rows.append(Row(GROUP, mean, found.mean_us, "µs", MEAN_US, note=f"one pass by the clock; {current}"))
        rows.append(Row(GROUP, most, found.p99_us, "µs", P99_US, note=f"of the same pass; {strides}"))
        rows.append(Row(GROUP, f"live step, processor time, {name}", found.processor_us, "µs"))
    return rows


@contextmanager
def _as_in_a_session() -> Iterator[None]:
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


def _clocked_us(events: list[Event], gate: SafetyGate, controller: Controller) -> tuple[FloatArray, int, int, int]:
    """What each event took; how many strides, commands, and commands with current there were."""
    taken = np.zeros(len(events))
    clock, strides, commands, on = time.perf_counter_ns, 0, 0, 0
    for at, event in enumerate(events):
        begin_ns = clock()
        gate.observe(event)
        decision = controller.step(event)
        judged = [gate.judge(event.t_ns, request) for request in decision.requests]
        taken[at] = clock() - begin_ns
        strides += sum(isinstance(outcome, StrideResult) for outcome in decision.outcomes)
        commands, on = commands + len(judged), on + sum(command.on for command in judged)
    return 1e-3 * taken, strides, commands, on


def _spent_s(events: list[Event], gate: SafetyGate, controller: Controller) -> float:
    begin_s = time.process_time()
    for event in events:
        gate.observe(event)
        for request in controller.step(event).requests:
            gate.judge(event.t_ns, request)
    return time.process_time() - begin_s


def recordings() -> dict[str, Callable[[], Recording]]:
    """The walk of ``speed.py``, and two minutes of a virtual patient at 500 Hz."""
    first = one_walk()
    rate_hz = next(iter(first.tracks.values())).rate_hz
    return {f"2 × {rate_hz:.0f} Hz": lambda: first, f"2 × {RATE_HZ:.0f} Hz": lambda: walk(WALK_S / 3600.0)}
