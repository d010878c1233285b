"""What an hour's session of two feet at 500 Hz leaves behind: the log's size and rate, the report's time and memory.

A virtual patient's walk is repeated to the length and goes through the loop of a session (controller, gate, codec,
simulated stimulator, log) on the recording's time. Times are processor times of the process that is measured.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import compute, parquet

from benchmarks.speed.speed import one_walk, repeated
from benchmarks.speed.speed_row import Row
from drivers.simulated.stimulator.in_process import InProcessStimulator
from fes.calibration.recording import calibrate_phase_sensors
from fes.config import load_session
from fes.control.controller import Controller
from fes.control.replay import identity, log_header, session_for
from fes.control.runner import Runner, armed_after, with_ticks
from fes.estimation.sensor_choice import shank_phase_sensors
from fes.estimation.warm_up import warm_up
from fes.gate import gate_of
from fes.recording import Recording, write_recording
from fes.recording.tracks import samples_of
from fes.session_log import SessionWriter
from fes.signals import FOOT_SENSORS, NS_PER_S, Event
from fes.simulation.forward import VirtualPatient, settings_for
from fes.simulation.forward.closed_loop import recording_of

ROOT = Path(__file__).resolve().parents[2]
RATE_HZ = 500.0
WALK_S = 120.0
LOG_MB_PER_H, REPORT_S = 200.0, 10.0
WRITTEN_SAMPLES = 200_000
STARTER = """
import json, os, sys
child = os.posix_spawn(
    sys.argv[1], sys.argv[1:], os.environ, file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
)
_, status, usage = os.wait4(child, 0)
print(json.dumps([status, usage.ru_utime, usage.ru_stime, usage.ru_maxrss]))
"""


@dataclass(frozen=True)
class Spent:
    """What a process took: processor time in s, greatest resident memory in MB."""

    seconds: float
    memory_mb: float


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


def spent_by(command: Sequence[str | Path]) -> Spent:
    """Run a command and see what it took.

    A small process starts it: Linux counts the memory that its parent has needed as the command's own.

    Raises:
        RuntimeError: it failed.
    """
    starter = [sys.executable, "-I", "-S", "-c", STARTER, *(str(part) for part in command)]
    status, user_s, system_s, most_kb = json.loads(subprocess.run(starter, capture_output=True, check=True).stdout)
    if status:
        raise RuntimeError(f"{' '.join(map(str, command))}: ended with {os.waitstatus_to_exitcode(status)}")
    return Spent(user_s + system_s, most_kb / 1024)


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

GROUP = "growth with the recording"
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
        rows.append(Row(GROUP, f"fes analyse, {hours:.2g} h", spent[hours].seconds, "s", note=note))
        rows.append(Row(GROUP, f"memory, {hours:.2g} h", spent[hours].memory_mb, "MB"))
    if len(spent) > 1:
        short, long = min(spent), max(spent)
        times = (spent[long].seconds / long) / (spent[short].seconds / short)
        what = f"time an hour, {long:.2g} h over {short:.2g} h"
        rows.append(Row(GROUP, what, times, "", LINEAR, note="linear: 1, less by what starting takes"))
        memory = spent[long].memory_mb / spent[short].memory_mb
        rows.append(Row(GROUP, f"memory, {long:.2g} h over {short:.2g} h", memory, "", BOUNDED))
    return rows
