"""How fast: the user's road, `fes.analyse` to all its tables; the pipeline of two feet and its stages; start-up.

The recording is the first run of the stroke-treadmill set, or without that the bundled both_feet_200hz, repeated. A
foot's sample counts as one. The road goes by the clock, in one pass after one that warms up; other times are this
process's processor time, the least of several runs, so that other programs disturb them little.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import fes
from benchmarks.lib.foot_paths import each_path
from benchmarks.lib.real_sets import data_folder, load_run
from benchmarks.speed.speed_bare import bare_seconds
from benchmarks.speed.speed_row import Row
from fes.analysis.ground_path import fuse, ground_path
from fes.analysis.parameters.gait import gait_parameters
from fes.analysis.pipeline import analyse, analyse_chunks, calibrations_of, calibrations_of_chunks
from fes.analysis.results import Analysis
from fes.analysis.toe_and_heel import point_heights
from fes.estimation.events.offline import find_events
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import stride_settings
from fes.estimation.strides.results import StrideMaker
from fes.estimation.zupt.foot_trajectory import foot_samples
from fes.recording import Recording, Track, read_recording, write_recording
from fes.recording.chunks import Chunk, keep_freed_memory
from fes.recording.tracks import newer_samples

ROOT = Path(__file__).resolve().parents[2]
SAMPLES_PER_S, ROAD_SAMPLES_PER_S = 1_500_000.0, 900_000.0
BARE_RATIO = 2.0
HELP_S, WARM_S = 0.25, 1.5
REPEATS = 8
ONE_CORE = ["taskset", "--cpu-list", "0"] if shutil.which("taskset") else []


def one_walk() -> Recording:
    """A walk of two feet to repeat."""
    runs = sorted((data_folder() / "stroke_treadmill").glob("*.npz"))
    if not runs:
        return read_recording(ROOT / "sim_inputs" / "both_feet_200hz.parquet")
    tracks, belt_mps = load_run(runs[0])
    return Recording(runs[0].stem, None, tracks, belt_mps if np.isfinite(belt_mps) else None)


def repeated(recording: Recording, minutes: float) -> Recording:
    """The recording again and again, until ``minutes`` are full."""
    rate_hz = next(iter(recording.tracks.values())).rate_hz
    span_ns = round(1e9 * (max(track.duration_s for track in recording.tracks.values()) + 1.0 / rate_hz))
    times = max(round(60e9 * minutes / span_ns), 1)

    def longer(track: Track) -> Track:
        later = np.repeat(np.arange(times) * span_ns, len(track.t_ns))
        return replace(
            track,
            t_ns=np.tile(track.t_ns, times) + later,
            t_sensor_ns=np.tile(track.t_sensor_ns, times) + later,
            acc_mps2=np.tile(track.acc_mps2, (times, 1)),
            gyr_radps=np.tile(track.gyr_radps, (times, 1)),
        )

    return replace(recording, tracks={name: longer(track) for name, track in recording.tracks.items()})


def least(work: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Least processor time of several runs, in s."""
    taken = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        taken.append(time.process_time() - begin)
    return min(taken)


def every_table(recording: Recording | Path) -> int:
    """What a user does with arrays or a file, to the last table; how many rows there are."""
    found = fes.analyse(recording)
    tables = (found.strides, found.events, found.phases, found.path, found.parameters.table, found.parameters.summary)
    return sum(len(table) for table in tables)


def road_seconds(recording: Recording | Path) -> float:
    """By the clock, in one pass after one that warms up."""
    every_table(recording)
    begin = time.perf_counter()
    every_table(recording)
    return time.perf_counter() - begin


def road_rows(minutes: float, folder: Path) -> list[Row]:
    """From arrays and from files to all tables, the parts of the way from arrays, and `fes analyse` of a short walk."""
    keep_freed_memory()
    recording = repeated(one_walk(), minutes)
    samples = sum(len(track.t_ns) for track in recording.tracks.values())
    group, parts = f"fes.analyse of {minutes:g} minutes of two feet, all tables", "of the way from arrays"
    rows = [Row(group, "samples, both feet", float(samples))]
    speed = samples / road_seconds(recording)
    rows.append(Row(group, "from arrays", speed, "samples/s", ROAD_SAMPLES_PER_S, higher=True))
    for suffix, bar in ((".parquet", ROAD_SAMPLES_PER_S), (".csv", None)):
        path = folder / f"from_{suffix[1:]}{suffix}"
        write_recording(recording, path)
        speed = samples / road_seconds(path)
        rows.append(Row(group, f"from {suffix[1:]}", speed, "samples/s", bar, higher=True))
    times = [time.perf_counter()]
    found = calibrations_of_chunks([Chunk(recording)])
    times.append(time.perf_counter())
    (analysis,) = analyse_chunks([Chunk(recording)], found.calibrations)
    times.append(time.perf_counter())
    gait_parameters(analysis)
    times.append(time.perf_counter())
    analysis.tables()
    times.append(time.perf_counter())
    names = ("calibration", "tracking, events, path", "gait parameters", "tables")
    rows += [Row(parts, name, 1e9 * s / samples, "ns/sample") for name, s in zip(names, np.diff(times), strict=True)]
    trial = ROOT / "sim_inputs" / "both_feet_200hz.parquet"
    command = [Path(sys.executable).with_name("fes"), "analyse", trial, "--out", folder / "out"]
    for _ in range(2):  # the first one warms up
        begin = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True, cwd=ROOT)
        seconds = time.perf_counter() - begin
    rows.append(Row("first result", "fes analyse with its report, warm", seconds, "s", WARM_S))
    return rows


def stages(recording: Recording) -> dict[str, float]:
    """Processor time of the parts of an analysis, in s, all feet together."""
    recording, found = calibrations_of(recording)
    seconds = dict[str, float]()
    for sensor, calibration in found.calibrations.items():
        assert isinstance(calibration, FootCalibration)
        track = recording.tracks[sensor]
        data = newer_samples(track)
        settings = stride_settings(calibration, recording.geometry.get(sensor))

        def follow(calibration: FootCalibration = calibration, settings: Any = settings, data: Any = data) -> Any:
            return FootTracker(calibration, StrideMaker(calibration.sensor, settings)).track(*data)

        walked, foot = follow(), foot_samples(*data)
        parts: dict[str, Callable[[], Any]] = {
            "phases and strides": follow,
            "rest": lambda d=data: foot_samples(*d),
            "lengths fused": lambda w=walked, f=foot: fuse(w.rows.copy(), f),
            "path": lambda t=track, c=calibration, f=foot: ground_path(t, c, foot=f),
            "toe and heel": lambda w=walked: point_heights(w.paths(), None, level=True),
            "strides as results, when asked for": lambda w=walked: (w.strides(), each_path(w.paths())),
            "events": lambda d=data, c=calibration: find_events(*d, c),
        }
        for name, work in parts.items():
            seconds[name] = seconds.get(name, 0.0) + least(work)
    return seconds


def listed(result: Analysis) -> int:
    """Make the objects that an analysis leaves as arrays until they are asked for; how many they are."""
    return len(result.strides) + len(result.phases)


def command_seconds(
    *arguments: str | Path, repeats: int = REPEATS, cache: Path | None = None, cores: Sequence[str] = ONE_CORE
) -> float:
    """Least processor time of `fes …` with all its processes, on one core if not said otherwise, in s."""
    environment = dict(os.environ) | ({"XDG_CACHE_HOME": str(cache)} if cache else {})
    command = [*cores, Path(sys.executable).with_name("fes"), *map(str, arguments)]
    taken = []
    for _ in range(repeats):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, env=environment, check=True, capture_output=True, cwd=ROOT)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        taken.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(taken)


def measure(minutes: float, folder: Path, *, cold: bool) -> list[Row]:
    """Pipeline, stages and start-up; the recording is written to ``folder``."""
    keep_freed_memory()
    recording = repeated(one_walk(), minutes)
    samples, per = sum(len(track.t_ns) for track in recording.tracks.values()), "ns/sample"
    group, start_up = f"analysis of {minutes:g} minutes of two feet", "start-up"
    rows = [Row(group, "samples, both feet", float(samples))]
    reading = {}
    for suffix in ("parquet", "csv"):
        path = folder / f"from_{suffix}.{suffix}"
        write_recording(recording, path)
        read_recording(path)
        reading[path] = least(lambda path=path: read_recording(path))
    first, *_ = reading
    recording, found = calibrations_of(read_recording(first))
    analyse(recording, found.calibrations)
    calibrating = least(lambda: calibrations_of(recording))
    analysing = least(lambda: analyse(recording, found.calibrations))
    as_objects = least(lambda: listed(analyse(recording, found.calibrations)))
    for path, seconds in reading.items():
        speed = samples / (seconds + calibrating + analysing)
        bar = SAMPLES_PER_S if path is first else None  # a text's digits alone take a third of what the bar allows
        rows.append(Row(group, f"whole pipeline from {path.suffix[1:]}", speed, "samples/s", bar, higher=True))
    objects = samples / (reading[first] + calibrating + as_objects)
    rows.append(Row(group, "the same from parquet, strides and phases as objects", objects, "samples/s"))
    bare = bare_seconds(recording, found.calibrations)
    parts = {f"read {path.suffix[1:]}": seconds for path, seconds in reading.items()}
    parts |= {"calibrate": calibrating, "analyse": analysing, **stages(recording)}
    parts["the same filters in a bare compiled loop"] = bare
    rows += [Row(group, name, 1e9 * seconds / samples, per) for name, seconds in parts.items()]
    rows.append(Row(group, "analyse over bare loop", analysing / bare, "", BARE_RATIO))
    command = ("analyse", ROOT / "sim_inputs" / "both_feet_200hz.parquet", "--out", folder / "out")
    rows.append(Row(start_up, "fes --help", command_seconds("--help"), "s", HELP_S))
    rows.append(Row(start_up, "fes analyse, warm", command_seconds(*command), "s", WARM_S))
    if cold:
        seconds = command_seconds(*command, repeats=1, cache=folder / "cache")
        rows.append(Row(start_up, "fes analyse, cold", seconds, "s"))
        begin = time.monotonic()
        command_seconds(*command, repeats=1, cache=folder / "another_cache", cores=())
        rows.append(Row(start_up, "fes analyse, cold, by the clock, all cores", time.monotonic() - begin, "s"))
    return rows
