"""How fast: the user's road, `fes.analyse` to all its tables; the pipeline of two feet and its stages; start-up.

The recording is the first run of the stroke-treadmill set, or without that the bundled both_feet_200hz, repeated. A
foot's sample counts as one. The road goes by the clock, in one pass after one that warms up; other times are this
process's processor time, the least of several runs, so that other programs disturb them little.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import fes
from benchmarks.lib.foot_paths import each_path
from benchmarks.lib.real_sets import data_folder, load_run, runs_of
from benchmarks.peers.cases import case_of
from benchmarks.speed.speed_row import Row
from fes.analysis.ground_path import fuse, ground_path
from fes.analysis.parameters.gait import gait_parameters
from fes.analysis.pipeline import analyse, analyse_chunks, calibrations_of, calibrations_of_chunks
from fes.analysis.results import Analysis
from fes.analysis.toe_and_heel import point_heights
from fes.estimation.events.offline import find_events
from fes.estimation.foot import features as kernel
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.orientation import OrientationSettings
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.numerics.jit import jit
from fes.estimation.numerics.records import Mat, Record, Vec, new_core
from fes.estimation.orientation.body import run, track_orientation
from fes.estimation.orientation.filter import NO_RANGE, BodySettings, new_state
from fes.estimation.sensor_choice import Calibration, stride_settings
from fes.estimation.strides.results import StrideMaker
from fes.estimation.tracking.phase_features import enter_phase
from fes.estimation.zupt.decimation import MOVING_NS, RESTING_NS, ZuptSettings, gather, gather_intervals, interval_ends
from fes.estimation.zupt.filter import filter_intervals, new_tape, smooth_intervals
from fes.estimation.zupt.foot_trajectory import foot_samples
from fes.estimation.zupt.thresholds import find_zero_velocity
from fes.recording import Recording, Track, read_recording, write_recording
from fes.recording.chunks import Chunk, keep_freed_memory
from fes.recording.tracks import increasing, newer_samples

ROOT = Path(__file__).resolve().parents[2]
SAMPLES_PER_S, ROAD_SAMPLES_PER_S = 1_500_000.0, 900_000.0
BARE_RATIO = 2.0
HELP_S, WARM_S = 0.25, 1.5
REPEATS = 8
TASKSET = shutil.which("taskset")
ONE_CORE = [TASKSET, "--cpu-list", "0"] if TASKSET else []
STARTER = """
import json, os, sys
child = os.posix_spawn(
    sys.argv[1], sys.argv[1:], os.environ, file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
)
_, status, usage = os.wait4(child, 0)
print(json.dumps([status, usage.ru_utime, usage.ru_stime, usage.ru_maxrss]))
"""


def one_walk() -> Recording:
    """A walk of two feet to repeat."""
    if not (runs := runs_of(data_folder())):
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


@dataclass(frozen=True)
class Spent:
    """What a process took: processor time in s, greatest resident memory in MB."""

    seconds: float
    memory_mb: float


def spent_by(command: Sequence[str | Path], cache: Path | None = None) -> Spent:
    """Run a command, its compiled code in ``cache`` if that is given, and see what it and its processes took.

    A small process starts it: Linux counts the memory that its parent has needed as the command's own.

    Raises:
        RuntimeError: it failed.
    """
    environment = dict(os.environ) | ({"XDG_CACHE_HOME": str(cache)} if cache else {})
    starter = [sys.executable, "-I", "-S", "-c", STARTER, *(str(part) for part in command)]
    status, user_s, system_s, most_kb = json.loads(
        subprocess.run(starter, env=environment, capture_output=True, check=True).stdout
    )
    if status:
        raise RuntimeError(f"{' '.join(map(str, command))}: ended with {os.waitstatus_to_exitcode(status)}")
    return Spent(user_s + system_s, most_kb / 1024)


def command_seconds(
    *arguments: str | Path, repeats: int = REPEATS, cache: Path | None = None, cores: Sequence[str] = ONE_CORE
) -> float:
    """Least processor time of `fes …` with all its processes, on one core if not said otherwise, in s."""
    command = [*cores, Path(sys.executable).with_name("fes"), *arguments]
    return min(spent_by(command, cache).seconds for _ in range(repeats))


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


# --- what the arithmetic alone costs ----------------------------------------------------------------------------------
#
# The filters of an analysis in bare compiled loops over the whole recording: the live core sample by sample; and of the
# ZUPT-aided filter the samples gathered into intervals, and twice, for path and stride lengths, forwards and smoothed.
# Reading, events, strides and all bookkeeping are left out.

AFTER = np.array([0, 1, 2, 3, 0, 0, 0])  # the phase that each transition leads to


@jit
def _follow(core: Record, t_ns: Vec, acc: Mat, gyr: Mat, out: Mat, after: Vec) -> int:
    """The live core over all samples, its phases changed at once."""
    at = changes = 0
    while at < t_ns.shape[0]:
        at, number = kernel.advance(core, t_ns, acc, gyr, at, t_ns.shape[0], out)
        if number > 0:
            changes += 1
            enter_phase(core, after[number])
    return changes


def bare_seconds(recording: Recording, calibrations: Mapping[str, Calibration], repeats: int = 3) -> float:
    """Least processor time in s, all feet together."""
    total = 0.0
    for sensor, calibration in calibrations.items():
        assert isinstance(calibration, FootCalibration)
        track = recording.tracks[sensor]
        newer = increasing(track)
        data = track.t_sensor_ns[newer], track.acc_mps2[newer], track.gyr_radps[newer]
        _, rest, _ = find_zero_velocity(*data[1:], track.rate_hz)
        total += min(_once(calibration, *data, rest) for _ in range(repeats + 1))
    return total


def _once(calibration: FootCalibration, t_ns: Any, acc: Any, gyr: Any, rest: Any) -> float:
    parts = {"parameters": calibration.parameters(), "thresholds": calibration.thresholds()}
    core, noise = new_core(kernel.CORE, **parts, settings=OrientationSettings())[0], ZuptSettings()
    trace, none, lever, bias = np.zeros((len(t_ns), 4)), np.zeros(len(t_ns)), np.zeros(3), np.zeros(3)
    intervals = gather_intervals(t_ns, acc, gyr, none, none, rest, (0.0, 0.0, 0.0))
    tape = new_tape(len(intervals.ends), int(np.count_nonzero(rest[intervals.ends])))
    ends = np.empty(len(t_ns), np.int64)
    kernel.start(core, int(t_ns[0]), *acc[0].tolist())
    begin = time.process_time()
    _follow(core, t_ns, acc, gyr, trace, AFTER)
    interval_ends(t_ns, rest, MOVING_NS, RESTING_NS, ends)
    gather(t_ns, acc, gyr, none, none, 0.0, 0.0, 0.0, noise, intervals)
    for level in (False, True):
        filter_intervals(t_ns, gyr, rest, intervals, acc[0], lever, bias, level, noise, tape)
        smooth_intervals(t_ns, intervals.ends, bool(rest[0]), noise, tape)
    return time.process_time() - begin


# --- other libraries beside ours --------------------------------------------------------------------------------------

BESIDE = "beside others, on the same recording"
STEPPED_SAMPLES = 5_000
EKF = "ahrs EKF, a call a sample"
STEP_OVER_EKF = 1.0  # a live step, with all that it does, costs no more than an EKF's orientation in Python


def peer_rows(recording: Recording, python: Path, live_step_us: float) -> list[Row]:
    """What they take in µs a sample, and how many times ours that is; none where their environment is not there.

    ``live_step_us``: what our whole live step takes on this recording.
    """
    if not python.is_file():
        return [Row(BESIDE, "peers: not measured", float("nan"), note="`make peers` makes their environment")]
    recording, found = calibrations_of(recording)
    with TemporaryDirectory(prefix="fes-speed-") as name:
        folder = Path(name)
        for sensor, calibration in found.calibrations.items():
            assert isinstance(calibration, FootCalibration)
            case_of(sensor, recording.tracks[sensor], calibration, np.zeros((0, 2), np.int64), ()).write(folder)
        script = Path(__file__).parents[1] / "peers" / "run_speed.py"
        done = subprocess.run([python, script, folder], capture_output=True, text=True, check=False)
        if done.returncode:
            return [Row(BESIDE, "peers: not measured", float("nan"), note=done.stderr.strip().splitlines()[-1][:120])]
        theirs = json.loads((folder / "speed.json").read_text(encoding="utf-8"))
    ours = our_costs(recording)
    stepped = {"live step": live_step_us, "orientation alone, a call a sample": ours["orientation, stepped"]}
    beside = {
        "VQF (C++), a call a sample": stepped,
        "VQF (C++), a call for all": {"orientation, all at once": ours["orientation"]},
        "PyVQF, a call a sample": stepped,
        "imufusion (C), a call a sample": stepped,
        EKF: stepped,
        "gaitmap pipeline (Herzer), RtsKalman": {"fes.analyse": ours["analysis"]},
        "gaitmap pipeline (Rampp), integration": {"fes.analyse": ours["analysis"]},
        "gaitmap RtsKalman": {"path, smoothed": ours["path"]},
    }
    rows = [
        Row(BESIDE, "ours: orientation alone, a call a sample", ours["orientation, stepped"], "µs/sample"),
        Row(BESIDE, "ours: orientation alone, all at once", ours["orientation"], "µs/sample"),
        Row(BESIDE, "ours: path, smoothed", ours["path"], "µs/sample"),
        Row(BESIDE, "ours: fes.analyse, calibration and every table", ours["analysis"], "µs/sample"),
        Row(BESIDE, "ours: live step, all of it", live_step_us, "µs/sample"),
    ]
    for name, value in theirs["us"].items():
        times = (f"{value / own:.3g} times our {what}" for what, own in beside[name].items())
        rows.append(Row(BESIDE, name, value, "µs/sample", note=", ".join(times)))
        if name == EKF:
            rows.append(Row(BESIDE, "our live step over that EKF", live_step_us / value, "", STEP_OVER_EKF))
    rows += [Row(BESIDE, f"{part}: failed", float("nan"), note=why[:120]) for part, why in theirs["failed"].items()]
    return rows


def our_costs(recording: Recording) -> dict[str, float]:
    """What corresponds to theirs, in µs a sample of one foot."""
    recording, found = calibrations_of(recording)
    samples = sum(len(track.t_ns) for track in recording.tracks.values())
    tracks = [recording.tracks[sensor] for sensor in found.calibrations]
    every_table(recording)

    def orientations() -> None:
        for track in tracks:
            track_orientation(track.acc_mps2, track.gyr_radps, track.rate_hz)

    def paths() -> None:
        for sensor, calibration in found.calibrations.items():
            assert isinstance(calibration, FootCalibration)
            ground_path(recording.tracks[sensor], calibration)

    def stepped() -> None:
        state, still, ranges = new_state(BodySettings()), np.zeros(1, bool), np.full(2, NO_RANGE)
        for acc, gyr in pairs:
            run(state, acc, gyr, still, 1.0 / tracks[0].rate_hz, ranges, BodySettings())

    pairs = list(
        zip(tracks[0].acc_mps2[:STEPPED_SAMPLES, None], tracks[0].gyr_radps[:STEPPED_SAMPLES, None], strict=True)
    )
    orientations()

    return {
        "orientation": 1e6 * least(orientations) / samples,
        "orientation, stepped": 1e6 * least(stepped) / len(pairs),
        "path": 1e6 * least(paths) / samples,
        "analysis": 1e6 * least(lambda: every_table(recording)) / samples,
    }
