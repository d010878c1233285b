"""How soon two sensors on each other's feet are told by the session's check of sides, and how often it is wrong.

Each walk's sensors are exchanged with the calibration stored, and once more left as they are. A channel's third burst
begins in its foot's fourth stride. *Strides asked* is how many of each foot the check waits for; the product's own is
marked. Named: at the score that the product asks for, before the third burst and at all, and the stride of that in the
middle. False: a walk on its own sides that is called exchanged at any time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.lib.command_line import parser_of, publish, table_of
from benchmarks.lib.real_sets import data_folder, load_run, runs_of
from fes.calibration.recording import calibrate_track
from fes.calibration.side_detection import tell_sides
from fes.datasets import read_file
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import stride_settings
from fes.estimation.strides.results import StrideMaker
from fes.live.sensor_monitor import LEAST_SCORE, LEAST_STRIDES, MOST_STRIDES, SideCheck
from fes.recording import Track, read_recording
from fes.recording.tracks import newer_samples
from fes.signals import FOOT_SENSORS, FloatArray, ImuSample, StrideResult
from fes.simulation.forward import settings_for
from fes.simulation.forward.closed_loop import recorded_walk

BUNDLED = Path(__file__).resolve().parents[2] / "sim_inputs" / "both_feet_100hz.parquet"
SEVERITIES, WALKS_S, RATE_HZ, FIRST_SEED = ("healthy", "moderate", "severe"), 40.0, 100.0, 8000
ASKED, BURSTS_STRIDE = (1, 2, 3, 5), 4
COLUMNS = ("feet", "strides asked", "pairs", "not calibrated", "before the third burst", "in all", "in stride", "false")
Seen = list[tuple[int, str, int, FloatArray]]  # of a stride that can tell: its end, its foot, its number, its signs
Feet = Mapping[str, Track]


class Signs(SideCheck):
    """The product's own signs of each stride, kept instead of judged."""

    def _judge(self) -> None:
        """Nothing is done before all is seen."""


def seen_in(tracks: Feet, calibrations: Mapping[str, FootCalibration]) -> Seen:
    """A walk's strides as a session sees them, in the order of time."""
    seen: Seen = []
    check = Signs(calibrations)
    for foot, track in tracks.items():
        calibration = calibrations[foot]
        tracker = FootTracker(calibration, StrideMaker(foot, stride_settings(calibration)))
        t_ns, acc, gyr = newer_samples(track)
        number = 0
        for t, a, g in zip(t_ns.tolist(), acc.tolist(), gyr.tolist(), strict=True):
            check.add_event(ImuSample(t, foot, t, tuple(a), tuple(g)))
            for outcome in tracker.step(t, tuple(a), tuple(g)):
                if isinstance(outcome, StrideResult):
                    number += 1
                    check.add_stride(outcome)
                    while len(check._signs[foot]) > sum(each[1] == foot for each in seen):
                        seen.append((outcome.t_end_ns, foot, number, check._signs[foot][-1]))
    return sorted(seen, key=lambda each: each[0])


def named(seen: Seen, asked: int) -> int | None:
    """The number of the stride, of the foot further on, at whose end it is called exchanged; None where it is not."""
    signs: dict[str, list[FloatArray]] = {foot: [] for foot in FOOT_SENSORS}
    furthest = 0
    for _, foot, number, one in seen:
        signs[foot].append(one)
        furthest = max(furthest, number)
        fewest = min(map(len, signs.values()))
        if fewest < asked:
            continue
        verdict = tell_sides(*(np.median(signs[each], axis=0) for each in FOOT_SENSORS))
        if verdict.sure and verdict.left == 1 and verdict.score >= LEAST_SCORE:
            return furthest
        if (verdict.sure and verdict.left == 0) or fewest >= MOST_STRIDES:
            return None
    return None


def virtual(patients: int) -> Iterator[Feet]:
    """Pairs of virtual ones, of each severity in turn."""
    for number in range(patients):
        severity, seed = SEVERITIES[number % len(SEVERITIES)], FIRST_SEED + number
        settings = settings_for(severity, seed=seed, speed_mps=0.8, sensors=FOOT_SENSORS, rate_hz=RATE_HZ)
        yield recorded_walk(settings, WALKS_S, 1.0, "sides", "simulated").tracks


def rows_of(group: str, walks: Iterable[Feet]) -> Iterator[list[str]]:
    """One row for each number of strides asked."""
    exchanged, own, refused = list[Seen](), list[Seen](), 0
    for tracks in walks:
        feet = {foot: tracks[foot] for foot in FOOT_SENSORS if foot in tracks}
        if len(feet) < 2:
            continue
        try:
            calibrations = {foot: calibrate_track(track) for foot, track in feet.items()}
        except CalibrationError:
            refused += 1
            continue
        left, right = (feet[foot] for foot in FOOT_SENSORS)
        other = {"left_foot": replace(right, sensor="left_foot"), "right_foot": replace(left, sensor="right_foot")}
        own.append(seen_in(feet, calibrations))
        exchanged.append(seen_in(other, calibrations))
    for asked in ASKED:
        told = [named(seen, asked) for seen in exchanged]
        soon = sum(at is not None and at < BURSTS_STRIDE for at in told)
        at_all = [at for at in told if at is not None]
        false = sum(named(seen, asked) is not None for seen in own)
        middle = f"{np.median(at_all):.0f}" if at_all else "–"
        mark = ", the product's" if asked == LEAST_STRIDES else ""
        yield [group, f"{asked}{mark}", *map(str, (len(own), refused, soon, len(at_all))), middle, str(false)]


def main() -> None:
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--patients", type=int, default=12)
    options = parser.parse_args()
    rows = [*rows_of("bundled", [read_recording(BUNDLED).tracks]), *rows_of("virtual", virtual(options.patients))]
    if options.data.is_dir():
        floor = sorted((options.data / "unseen_walkers" / "stroke_walks").glob("*.npz"))
        belt = {"stroke survivors": options.data, "others": options.data / "unseen_walkers"}
        for name, folder in belt.items():
            rows += rows_of(f"{name}, treadmill", (load_run(path)[0] for path in runs_of(folder)))
        walks = (read_file("stroke_walks", path).recording.tracks for path in floor)  # each foot by its own clock
        rows += rows_of("stroke survivors and others, floor", walks)
    publish([table_of("", COLUMNS, rows)], options)


if __name__ == "__main__":
    main()
