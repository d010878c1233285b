"""Hemiparetic walks measured beside the project's own strides, for ``hemiparetic.py``: feet, sides, clocks, ground."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.accuracy.parameters import BUNDLED, TRIALS, virtual_walk
from benchmarks.lib.real_sets import LAST_S, gaitmap_cases, gaitmap_feet, load_run
from benchmarks.lib.swing_judge import mid_swings
from fes.analysis.hemiparetic.foot import FootTrack
from fes.analysis.hemiparetic.sync import Offset, Samples, offset
from fes.analysis.hemiparetic.walk import HemipareticWalk, Terrain, feet_of, hemiparetic_walk, windows_of
from fes.analysis.hemiparetic.windows import THRESHOLD_M2PS4
from fes.analysis.pipeline import analyse, calibrations_of
from fes.analysis.results import Analysis
from fes.estimation.events.offline import find_events
from fes.estimation.foot.calibration import FootCalibration
from fes.recording import Recording, read_recording
from fes.recording.tracks import increasing
from fes.signals import FOOT_SENSORS, NS_PER_S, FloatArray

METHODS = ("printed", "fitted", "own", "parameters")
EDGE_S = 1.0  # of a recording that begins and ends within a stride
CUT_S = ((2.2, 3.7), (1.0, 4.4))  # at the beginnings and ends of left and right
AHEAD_S = 7.813  # of the right foot's clock


@dataclass
class FootResult:
    """One foot of one run: swings and speed over belt (NaN where not known) by method."""

    run: str
    foot: str
    mid_swings: int
    swings: dict[str, int] = field(default_factory=dict)
    wrong: dict[str, int] = field(default_factory=dict)
    belt_ratio: dict[str, float] = field(default_factory=dict)

    def off(self, method: str) -> float:
        """Missed and false strides over mid-swings."""
        return self.wrong[method] / self.mid_swings


@dataclass(frozen=True)
class SideResult:
    """What was told of one walk's sides; ``truth`` "" where nobody knows, "none" where there is no afflicted side."""

    walk: str
    told: str
    leaning: str
    score: float
    agreeing: int
    power_ratio: float
    power_steady: float
    votes: dict[str, float]
    truth: str


@dataclass(frozen=True)
class GroundResult:
    """What the strides of one walk went over, both feet together."""

    walk: str
    level: int
    up: int
    down: int
    truth: str


@dataclass(frozen=True)
class ClockResult:
    """How far off (s) the clock was found; ``sure`` whether the stride was said to be told clearly."""

    walk: str
    error_s: float
    method: str
    runner_up: float
    sure: bool


def analysed(recording: Recording) -> tuple[Analysis, HemipareticWalk]:
    """A recording with default settings."""
    recording, found = calibrations_of(recording)
    result = analyse(recording, found.calibrations)
    return result, hemiparetic_walk(result)


def of_windows(track: FootTrack | None, belt_mps: float) -> tuple[int, float]:
    """Swings between windows, and speed over belt in the last 120 s."""
    if track is None or len(track.windows) < 3:
        return 0, math.nan
    times = track.t_ns[track.centres]
    late = times[:-1] >= track.t_ns[-1] - LAST_S * NS_PER_S
    lengths = track.stride_lengths_m()[late]
    time_s = float((np.diff(times)[late]).sum()) / NS_PER_S
    return len(track.windows) - 1, float(lengths.sum()) / time_s / belt_mps if time_s else math.nan


def wrong(peaks_s: FloatArray, spans_s: FloatArray, ends_s: tuple[float, float]) -> int:
    """Missed, joined and false strides: mid-swings (K,) against strides from begin to end (M, 2), within ``ends_s``."""
    low, high = ends_s
    inside = [int(((peaks_s > begin) & (peaks_s <= end)).sum()) for begin, end in spans_s]
    held = [bool(((spans_s[:, 0] < at) & (at <= spans_s[:, 1])).any()) for at in peaks_s]
    missed = sum(not one for one, at in zip(held, peaks_s, strict=True) if low < at < high)
    joined = sum(max(count - 1, 0) for count in inside)
    false = sum(count == 0 for count, (begin, end) in zip(inside, spans_s, strict=True) if begin > low and end < high)
    return missed + joined + false


def stroke_run(path: Path) -> tuple[list[FootResult], SideResult, GroundResult]:
    """Both feet of one run."""
    tracks, belt_mps = load_run(path)
    recording = Recording(path.stem, None, tracks, belt_speed_mps=None if math.isnan(belt_mps) else belt_mps)
    result, walk = analysed(recording)
    feet = feet_of(result)
    healthy = "left_foot" if walk.side.leaning == "right" else "right_foot"
    windows = {"fitted": walk.windows}
    try:
        windows["printed"] = windows_of(feet, healthy, THRESHOLD_M2PS4)
    except ValueError:
        windows["printed"] = None
    out = []
    for foot in FOOT_SENSORS:
        track = tracks[foot]
        peaks_s = track.t_ns[mid_swings(track.gyr_radps[:, 1], track.rate_hz)] / NS_PER_S
        found = FootResult(path.stem, foot, len(peaks_s))
        ends_s = (float(track.t_ns[0]) / NS_PER_S + EDGE_S, float(track.t_ns[-1]) / NS_PER_S - EDGE_S)
        for method, one in windows.items():
            windowed = one.tracks.get(foot) if one else None
            found.swings[method], found.belt_ratio[method] = of_windows(windowed, belt_mps)
            times = windowed.t_ns[windowed.centres] / NS_PER_S if windowed else np.zeros(0)
            found.wrong[method] = wrong(peaks_s, np.column_stack((times[:-1], times[1:])), ends_s)
        valid = [s for s in result.strides if s.foot == foot]
        late = [s for s in valid if s.valid and s.t_start_ns >= track.t_ns[-1] - LAST_S * NS_PER_S]
        found.swings["own"] = len(valid)
        spans = np.array([(s.t_start_ns / NS_PER_S, s.t_end_ns / NS_PER_S) for s in valid]).reshape(-1, 2)
        found.wrong["own"] = wrong(peaks_s, spans, ends_s)
        time_s = sum(s.t_end_ns - s.t_start_ns for s in late) / NS_PER_S
        found.belt_ratio["own"] = sum(s.stride_length_m for s in late) / time_s / belt_mps
        rows = walk.parameters.strides[foot]
        found.swings["parameters"] = len(rows)
        spans = np.column_stack((rows["t_start_s"], rows["t_end_s"]))
        found.wrong["parameters"] = wrong(peaks_s, spans, ends_s)
        begin_s = track.t_ns[-1] / NS_PER_S - LAST_S
        kept = rows[(rows["t_start_s"] >= begin_s) & np.isfinite(rows["stride_time_s"])]
        way_m, time_s = kept["stride_length_common_m"].sum(), kept["stride_time_s"].sum()
        found.belt_ratio["parameters"] = float(way_m / time_s / belt_mps)
        out.append(found)
    return out, told_side(path.stem, walk, ""), ground(path.stem, walk, "level")


def told_side(name: str, walk: HemipareticWalk, truth: str) -> SideResult:
    """As a row."""
    side = walk.side
    return SideResult(
        name,
        side.side or "not sure",
        side.leaning,
        side.score,
        side.agreeing,
        side.power.ratio,
        side.power.steady,
        side.votes,
        truth,
    )


def ground(name: str, walk: HemipareticWalk, truth: str) -> GroundResult:
    """As a row."""
    every = [kind for found in walk.terrain.values() for kind in found.values()]
    level, up, down = (sum(kind is one for kind in every) for one in (Terrain.LEVEL, Terrain.UP, Terrain.DOWN))
    return GroundResult(name, level, up, down, truth)


def stairs(folder: Path) -> Recording | None:
    """The gaitmap stairs, upwards; None where they are absent."""
    path = folder / "gaitmap_walk" / "imu_sample_healthy_stair_up.csv"
    return Recording("gaitmap stairs", None, gaitmap_feet(path)) if path.is_file() else None


def clock(recording: Recording) -> ClockResult:
    """Cut both feet, set the right one's clock off, and find it again."""
    recording, found = calibrations_of(recording)
    samples = []
    for foot, (begin_s, end_s) in zip(FOOT_SENSORS, zip(*CUT_S, strict=True), strict=True):
        track, calibration = recording.tracks[foot], found.calibrations[foot]
        assert isinstance(calibration, FootCalibration)
        newer = increasing(track)
        t, acc, gyr = track.t_sensor_ns[newer], track.acc_mps2[newer], track.gyr_radps[newer]
        keep = (t > t[0] + begin_s * NS_PER_S) & (t < t[-1] - end_s * NS_PER_S)
        t, acc, gyr = t[keep], acc[keep], gyr[keep]
        if foot == "right_foot":
            t = t - round(AHEAD_S * NS_PER_S)
        samples.append(Samples(t, acc, find_events(t, acc, gyr, calibration)))
    result: Offset = offset(samples[0], samples[1])
    return ClockResult(recording.name, result.offset_s - AHEAD_S, result.method, result.runner_up, result.sure)


def known_walks(folder: Path) -> list[tuple[Recording, str]]:
    """Walks whose afflicted side is known."""
    walks = [
        (virtual_walk(pattern, 10 + pattern, 100.0, side, 50.0).recording, side)
        for pattern in range(1, 6)
        for side in ("left", "right")
    ]
    walks += [(read_recording(TRIALS / f"{name}.parquet"), "none") for name in BUNDLED]
    if (folder / "gaitmap_walk").is_dir():
        tracks = {case.track.sensor: case.track for case in gaitmap_cases(folder)}
        walks.append((Recording("gaitmap_walk", None, tracks), "none"))
    return walks
