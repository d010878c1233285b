"""What an hour's session of two feet at 500 Hz leaves behind: the log's size and rate, the report's time and memory.

A virtual patient's walk is repeated to the length and goes through the loop of a session (controller, gate, codec,
simulated stimulator, log) on the recording's time. Times are processor times of the process that is measured.
"""

from __future__ import annotations

import gc
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import compute, parquet

from benchmarks.speed.speed import one_walk, repeated, spent_by
from benchmarks.speed.speed_row import Row
from drivers.simulated.stimulator.in_process import InProcessStimulator
from fes.analysis.pipeline import calibrations_of
from fes.calibration.recording import calibrate_phase_sensors
from fes.config import load_session
from fes.control.controller import Controller
from fes.control.replay import identity, log_header, session_for
from fes.control.runner import Runner, armed_after, with_ticks
from fes.estimation.sensor_choice import shank_phase_sensors
from fes.estimation.warm_up import warm_up
from fes.gate import SafetyGate, gate_of
from fes.recording import Recording, write_recording
from fes.recording.tracks import samples_of
from fes.session_log import SessionWriter
from fes.signals import FOOT_SENSORS, NS_PER_S, Event, FloatArray, ImuSample, StrideResult
from fes.simulation.forward import VirtualPatient, settings_for
from fes.simulation.forward.closed_loop import recording_of

ROOT = Path(__file__).resolve().parents[2]
RATE_HZ = 500.0
WALK_S = 120.0
LOG_MB_PER_H, REPORT_S = 200.0, 10.0
WRITTEN_SAMPLES = 200_000


def walk(hours: float) -> Recording:
    """Two minutes of a virtual patient at 500 Hz, again and again; numbers as a sensor's line carries them."""
    settings = settings_for("moderate", rate_hz=RATE_HZ, sensors=FOOT_SENSORS)
    patient = VirtualPatient(settings)
    recording = recording_of(patient, patient.advance(round(WALK_S * NS_PER_S)), "two feet at 500 Hz", "")
    for track in recording.tracks.values():
        track.acc_mps2[:] = track.acc_mps2.astype(np.float32)
        track.gyr_radps[:] = track.gyr_radps.astype(np.float32)
    return repeated(recording, 60.0 * hours)


def record(recording: Recording, log_path: Path) -> float:
    """Run the session and leave its log; the loop's processor time in s."""
    calibrations = calibrate_phase_sensors(recording).calibrations
    session = session_for(recording, load_session(ROOT / "sim_inputs" / "session.toml"))
    numbers = identity(recording.name, session)
    header = log_header(recording, "", session, calibrations, numbers.session_id, "2000-01-01T00:00:00+00:00")
    begin_ns = min(int(track.t_ns[0]) for track in recording.tracks.values())
    stimulator = InProcessStimulator(numbers.session_id, numbers.boot_id, begin_ns)
    gate = gate_of(
        session, {sensor: each.up for sensor, each in calibrations.items()}, shank_phase_sensors(calibrations)
    )
    warm_up()
    log = SessionWriter(log_path, header)
    handshake = stimulator.start(begin_ns)
    runner = Runner(Controller(session, calibrations), gate, stimulator, log, time.perf_counter_ns)
    for frame in handshake.frames:
        log.frame(frame)
    for alive in handshake.alive:
        runner.handle(alive)

    def after(event: Event) -> None:
        stimulator.take_pulses()
        log.flush_due(event.t_ns)

    events = with_ticks(samples_of(recording, set(calibrations)))
    begin_s = time.process_time()
    runner.run(armed_after(events, 0.5, 1.0, rearm_after_s=1.0, latched=lambda: bool(gate.latched)), after)
    spent = time.process_time() - begin_s
    log.close({"ended": "complete"})
    stimulator.close()
    return spent


def writing(recording: Recording, folder: Path) -> tuple[float, float]:
    """What logging costs by itself: µs a sample with its latency, and MB/s."""
    samples = [s for s, _ in zip(samples_of(recording, set(recording.tracks)), range(WRITTEN_SAMPLES), strict=False)]
    taken = []
    for number in range(3):
        path = folder / f"only_samples_{number}.feslog"
        log = SessionWriter(path, {})
        begin_s = time.process_time()
        for sample in samples:
            log.event(sample)
            log.latency(sample.t_ns, 20_000)
            log.flush_due(sample.t_ns)
        log.flush()
        taken.append(time.process_time() - begin_s)
        log.close({})
    return 1e6 * min(taken) / len(samples), 1e-6 * path.stat().st_size / min(taken)


def session_rows(hours: float, folder: Path) -> list[Row]:
    """The figures; per hour, so that a shorter run tells as well."""
    recording = walk(hours)
    samples = sum(len(track.t_ns) for track in recording.tracks.values())
    log_path = folder / "session.feslog"
    loop_s = record(recording, log_path)
    sample_us, rate_mbps = writing(recording, folder)
    log_mb = 1e-6 * log_path.stat().st_size
    for path in folder.glob("only_samples_*"):
        path.unlink()
    del recording
    report = spent_by([Path(sys.executable).with_name("fes"), "report", log_path, "--out", folder / "report.html"])
    hours = samples / (len(FOOT_SENSORS) * RATE_HZ * 3600.0)
    length = f"{hours:.3g} h at 2 × 500 Hz"
    return [
        Row("session", f"log, {length}", log_mb, "MB", LOG_MB_PER_H * hours),
        Row("session", "log, a sample with its latency", sample_us, "µs"),
        Row("session", "log, writing", rate_mbps, "MB/s", higher=True),
        Row("session", "whole loop with simulated stimulator and log", 1e6 * loop_s / samples, "µs/sample"),
        Row("session", f"fes report, {length}", report.seconds, "s", REPORT_S),
        Row("session", "fes report, memory", report.memory_mb, "MB"),
        Row("session", "fes report, its file", 1e-6 * (folder / "report.html").stat().st_size, "MB"),
    ]


# --- how the analysis grows with the recording ------------------------------------------------------------------------

GROWTH = "growth with the recording"
LINEAR, BOUNDED = 1.25, 1.5


def write_long(walk: Recording, hours: float, path: Path) -> tuple[int, float]:
    """A recording of about that length as a file, written in pieces; samples of all feet together, hours in truth."""
    piece = repeated(walk, 10.0)
    write_recording(piece, path, overwrite=True)
    table = parquet.read_table(path)
    stamps = [name for name in table.column_names if pa.types.is_integer(table.schema.field(name).type)]
    span_ns = max(int(track.t_ns[-1] - track.t_ns[0]) for track in piece.tracks.values())
    span_ns += round(1e9 / next(iter(piece.tracks.values())).rate_hz)
    times = max(round(3.6e12 * hours / span_ns), 1)
    with parquet.ParquetWriter(path, table.schema) as writer:
        for number in range(times):
            later = table
            for name in stamps:
                column = compute.add(table.column(name), number * span_ns)
                later = later.set_column(later.column_names.index(name), table.schema.field(name), column)
            writer.write_table(later)
    return times * sum(len(track.t_ns) for track in piece.tracks.values()), times * span_ns / 3.6e12


def growth_rows(lengths: list[float], folder: Path) -> list[Row]:
    """Time and memory of each length, and how they grow from the shortest to the longest."""
    fes, walk = Path(sys.executable).with_name("fes"), one_walk()
    rows, spent = [], {}
    write_long(walk, 0.2, folder / "warm.parquet")
    spent_by([fes, "analyse", folder / "warm.parquet", "--out", folder / "out", "--no-report"])  # compiles, if need be
    for asked in sorted(lengths):
        path = folder / f"walk_{asked:g}h.parquet"
        samples, hours = write_long(walk, asked, path)
        command = [fes, "analyse", path, "--out", folder / "out", "--format", "parquet", "--no-report"]
        spent[hours] = spent_by(command)
        path.unlink()
        note = f"{samples / 1e6:.2f} M samples"
        rows.append(Row(GROWTH, f"fes analyse, {hours:.2g} h", spent[hours].seconds, "s", note=note))
        rows.append(Row(GROWTH, f"memory, {hours:.2g} h", spent[hours].memory_mb, "MB"))
    if len(spent) > 1:
        short, long = min(spent), max(spent)
        times = (spent[long].seconds / long) / (spent[short].seconds / short)
        what = f"time an hour, {long:.2g} h over {short:.2g} h"
        rows.append(Row(GROWTH, what, times, "", LINEAR, note="linear: 1, less by what starting takes"))
        memory = spent[long].memory_mb / spent[short].memory_mb
        rows.append(Row(GROWTH, f"memory, {long:.2g} h over {short:.2g} h", memory, "", BOUNDED))
    return rows


# --- a live step ------------------------------------------------------------------------------------------------------
#
# One sample's way from the gate that sees it, through estimator, phases, strides and plan, to commands. The session is
# armed and stimulates at full intensity, the garbage collector is off as in a live session. Not part of a step: the
# driver's codec, the log, the stimulator's line.

STEP = "a live step"
MEAN_US, P99_US = 12.0, 45.0


def live_rows() -> list[Row]:
    """Of the walk of ``speed.py``, and of two minutes of a virtual patient at 500 Hz."""
    first = one_walk()
    rate_hz = next(iter(first.tracks.values())).rate_hz
    return step_rows(first, f"2 × {rate_hz:.0f} Hz") + step_rows(walk(WALK_S / 3600.0), f"2 × {RATE_HZ:.0f} Hz")


def step_rows(recording: Recording, name: str = "") -> list[Row]:
    """What one sample takes: mean and 99th percentile by the clock, and the mean in processor time."""
    recording, found = calibrations_of(recording)
    session = session_for(recording, load_session(ROOT / "sim_inputs" / "session.toml"))
    up = {sensor: calibration.up for sensor, calibration in found.calibrations.items()}
    events = list(armed_after(with_ticks(samples_of(recording, set(found.calibrations))), 0.5, 1.0))
    warm_up()

    def parts() -> tuple[SafetyGate, Controller]:
        return gate_of(session, up, shank_phase_sensors(found.calibrations)), Controller(session, found.calibrations)

    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        taken_us, strides, commands, on = _clocked_us(events, *parts())
        spent_s = _spent_s(events, *parts())
    finally:
        gc.enable()
        gc.unfreeze()
    taken_us = taken_us[[isinstance(event, ImuSample) for event in events]]
    samples, p99_us = len(taken_us), float(np.percentile(taken_us, 99))
    current = f"one pass by the clock; current in {100 * on / max(commands, 1):.0f} % of the commands"
    ends = f"of the same pass; {100 * strides / samples:.2g} % of the samples end a stride"
    return [
        Row(STEP, f"live step, mean, {name}", float(taken_us.mean()), "µs", MEAN_US, note=current),
        Row(STEP, f"live step, 99 %, {name}", p99_us, "µs", P99_US, note=ends),
        Row(STEP, f"live step, processor time, {name}", 1e6 * spent_s / samples, "µs"),
    ]


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
