"""Wang et al.'s way with hemiparetic walks beside the project's own strides, on the stroke-treadmill recordings.

    python benchmarks/hemiparetic.py [--data FOLDER] [--json FILE]

Swings of both feet against the mid-swing peaks of the low-passed toe-up rate (the data set's own axis): wrong are
peaks in no stride, peaks beyond the first in a stride, and strides without one. The recordings begin and end in the
middle of a walk; what lies within a second of their ends does not count. Speed over belt in the last 120 s on belts
of known speed; which side is afflicted and how sure that is; the clocks of two feet found again after one had been
set off and both cut. Methods:

- printed: windows at the threshold that the paper prints (0.025 m²/s⁴), the healthier foot's mapped to the other;
- fitted: the same, the threshold fitted to each foot;
- own: strides of `fes analyse`; parameters: the same as fes.parameters gives them (both feet brought to a common way).

Clocks and sides are checked on virtual walks and the bundled ones, too, of which the truth is known. Without the
recordings this says so and exits with 3.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from event_cases import GAITMAP_HZ, gaitmap_cases, make_track
from parameters import BUNDLED, TRIALS, virtual_walk
from rich.console import Console
from rich.table import Table
from stroke_treadmill import LAST_S, data_folder, load_run, mid_swings

from fes.analysis import Analysis, analyse, calibrations_of
from fes.estimation.calibration import FootCalibration
from fes.estimation.events_offline import find_events
from fes.hemiparetic.side import SIGNS
from fes.hemiparetic.sync import Offset, Samples, offset
from fes.hemiparetic.terrain import Terrain
from fes.hemiparetic.track import FootTrack
from fes.hemiparetic.walk import HemipareticWalk, feet_of, hemiparetic_walk, windows_of
from fes.hemiparetic.windows import THRESHOLD_M2PS4
from fes.recording import Recording, read_recording
from fes.replay import increasing
from fes.signals import FOOT_SENSORS, NS_PER_S, FloatArray

METHODS = ("printed", "fitted", "own", "parameters")
COUNT_BAR = 0.01
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
        spans = np.array([(r.t_start_s, r.t_end_s) for r in rows]).reshape(-1, 2)
        found.wrong["parameters"] = wrong(peaks_s, spans, ends_s)
        begin_s = track.t_ns[-1] / NS_PER_S - LAST_S
        kept = [r for r in rows if r.t_start_s >= begin_s and math.isfinite(r.values["stride_time_s"])]
        time_s = sum(r.values["stride_time_s"] for r in kept)
        found.belt_ratio["parameters"] = sum(r.values["stride_length_m"] for r in kept) / time_s / belt_mps
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
    if not path.is_file():
        return None
    with path.open(encoding="utf-8") as file:
        names = list(zip(*(file.readline().rstrip("\n").split(",") for _ in range(2)), strict=True))
        rows = np.genfromtxt(file, delimiter=",")
    rows = rows[np.isfinite(rows).sum(axis=1) > 1]
    column = {name: rows[:, k] for k, name in enumerate(names)}
    tracks = {}
    for side in ("left", "right"):
        acc, gyr = (np.column_stack([column[f"{side}_sensor", f"{k}_{a}"] for a in "xyz"]) for k in ("acc", "gyr"))
        tracks[f"{side}_foot"] = make_track(f"{side}_foot", GAITMAP_HZ, acc, np.radians(gyr))
    return Recording("gaitmap stairs", None, tracks)


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


def main(arguments: list[str] | None = None) -> int:
    """Print the tables; 0 when the bars hold, 1 when not, 3 without data."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder with stroke_treadmill/ below")
    parser.add_argument("--json", type=Path, help="write the results here as well")
    options = parser.parse_args(arguments)
    paths = sorted((options.data / "stroke_treadmill").glob("*.npz"))
    if not paths:
        print(f"No recordings in {options.data / 'stroke_treadmill'}; set FES_DATA or give --data.", file=sys.stderr)
        return 3
    feet: list[FootResult] = []
    sides: list[SideResult] = []
    clocks: list[ClockResult] = []
    grounds: list[GroundResult] = []
    for path in paths:
        found, side, over = stroke_run(path)
        feet += found
        sides.append(side)
        grounds.append(over)
        clocks.append(clock(Recording(path.stem, None, load_run(path)[0])))
    for recording, truth in known_walks(options.data):
        walk = analysed(recording)[1]
        sides.append(told_side(recording.name, walk, truth))
        grounds.append(ground(recording.name, walk, "level"))
        if truth != "left":
            clocks.append(clock(recording))
    console = Console() if sys.stdout.isatty() else Console(width=140)
    climb = stairs(options.data)
    if climb is not None:
        grounds.append(ground(climb.name, analysed(climb)[1], "up, with landings"))
    _show(console, feet, sides, clocks, grounds)
    if options.json:
        options.json.write_text(
            json.dumps({"feet": [asdict(f) for f in feet], "sides": [asdict(s) for s in sides],
                        "grounds": [asdict(g) for g in grounds], "clocks": [asdict(c) for c in clocks]}, indent=1)
        )  # fmt: skip
    counted = all(foot.off("own") <= COUNT_BAR for foot in feet)
    own, ours = (_spread(feet, method) for method in ("own", "parameters"))
    speed = abs(ours[0] - 1.0) <= max(abs(own[0] - 1.0), 0.002) and ours[1] <= own[1]
    right = all(s.told in (s.truth, "not sure") for s in sides if s.truth)
    console.print(f"Strides within 1 % of the mid-swings on every foot (own strides): {'yes' if counted else 'no'}")
    console.print(f"Speed over belt of the parameters no worse than the strides' own: {'yes' if speed else 'no'}")
    console.print(f"No wrong side told where it is known: {'yes' if right else 'no'}")
    return 0 if counted and speed and right else 1


def _spread(feet: list[FootResult], method: str) -> tuple[float, float, int]:
    values = np.array([f.belt_ratio[method] for f in feet if math.isfinite(f.belt_ratio[method])])
    return (
        (float(values.mean()), float(values.std(ddof=1)), len(values)) if len(values) > 1 else (math.nan, math.nan, 0)
    )


def _show(
    console: Console,
    feet: list[FootResult],
    sides: list[SideResult],
    clocks: list[ClockResult],
    grounds: list[GroundResult],
) -> None:
    table = Table("run", "foot", "mid-swings", *(f"{m} (wrong)" for m in METHODS), *(f"{m} / belt" for m in METHODS))
    for f in feet:
        ratios = (f"{f.belt_ratio[m]:.4f}" if math.isfinite(f.belt_ratio[m]) else "–" for m in METHODS)
        table.add_row(
            f.run, f.foot[:-5], str(f.mid_swings), *(f"{f.swings[m]} ({f.wrong[m]})" for m in METHODS), *ratios
        )
    console.print(table)
    for method in METHODS:
        mean, sd, n = _spread(feet, method)
        within = sum(f.off(method) <= COUNT_BAR for f in feet)
        worst = max(f.off(method) for f in feet)
        console.print(
            f"{method}: strides within 1 % of mid-swings on {within} of {len(feet)} feet, worst {100 * worst:.1f} %; "
            f"speed over belt {mean:.4f} ± {sd:.4f} ({n} feet)"
        )
    table = Table("walk", "afflicted", "leaning", "score", "signs", "power l/r", "steady", *SIGNS, "truth")
    for s in sides:
        numbers = f"{s.score:.2f}", f"{s.agreeing} of 4", f"{s.power_ratio:.2f}", f"{100 * s.power_steady:.0f} %"
        votes = (f"{s.votes[sign]:+.2f}" for sign in SIGNS)
        table.add_row(s.walk, s.told, s.leaning, *numbers, *votes, s.truth or "not known")
    console.print(table)
    table = Table("walk, feet cut apart", "error ms", "by", "runner-up", "sure")
    for c in clocks:
        table.add_row(c.walk, f"{1e3 * c.error_s:+.0f}", c.method, f"{c.runner_up:.2f}", "yes" if c.sure else "no")
    console.print(table)
    table = Table("walk, both feet", "level", "up", "down", "truth")
    for g in grounds:
        table.add_row(g.walk, str(g.level), str(g.up), str(g.down), g.truth)
    console.print(table)
    flat = [g for g in grounds if g.truth == "level"]
    wrongly = sum(g.up + g.down for g in flat)
    console.print(f"Strides on level ground taken for stairs: {wrongly} of {wrongly + sum(g.level for g in flat)}")


if __name__ == "__main__":
    raise SystemExit(main())
