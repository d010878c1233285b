"""Clearance on an incline against the simulated truth, and stairs and level ground told apart by the sensor alone.

Inclines: two walkers of the recordings' generator (a healthy pair of feet, Negård et al.'s first patient) on a belt
that is inclined by −15 to 15 %, three sensors (seeds of their own) each. Errors of ``fes analyse`` and of the live
tracker with the incline set, of ``fes analyse --slope``, and, for what it costs not to set it, as on level ground. The
sensor is calibrated where it walks; "elsewhere": the calibration of the level walk.

Rise: what the live tracker, set to level, makes of each stride's height by the sensor alone, on gaitmap's stairs and on
every level walk of the data folder, and how many of the strides a tuner leaves out for that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain, product
from pathlib import Path

import numpy as np

from benchmarks.lib.command_line import parser_of, publish, table_of
from benchmarks.lib.real_sets import data_folder, stairs
from benchmarks.lib.walkers import FOOT_SETS, calibrated, feet_of, outcomes_of
from fes.analysis.pipeline import analyse, calibrations_of
from fes.config import FootGeometry, Ground
from fes.estimation.foot.calibration import FootCalibration
from fes.recording import Recording, Track
from fes.signals import FloatArray, StrideResult
from fes.simulation.truth import Truth, TruthStride
from fes.stimulation.ground import GroundWatch
from sim_inputs.generator.observe import observe
from sim_inputs.generator.session import new_session
from sim_inputs.generator.trials import BOTH, IMU, INSTEP, KMH, PAIR, PATIENT_1

INCLINES_PERCENT = (-15.0, -10.0, -5.0, 0.0, 5.0, 10.0, 15.0)
WALKERS = {
    "healthy": (BOTH, PAIR, 30, 1.2, 4.0, 200.0),
    "patient": (INSTEP, {"right_foot": PATIENT_1}, 25, 1.1 * KMH, 0.8, 200.0),
}
SEEDS = (9100, 9101, 9102)
WAYS = ("analyse", "live", "live, elsewhere", "--slope", "as level")


def walked(walker: str, incline_percent: float, seed: int) -> tuple[Recording, Truth]:
    placements, styles, count, speed_mps, ramp_s, rate_hz = WALKERS[walker]
    session = new_session(walker, seed, placements)
    session.incline_percent = incline_percent
    session.stand(4.0)
    session.walk(styles, count, speed_mps, ramp_s=ramp_s, early=False)
    session.stand(2.5)
    session.finish()
    return session.recording(rate_hz, IMU, ""), observe(session)


def live_strides(
    track: Track, calibration: FootCalibration, geometry: FootGeometry | None, ground: Ground
) -> list[StrideResult]:
    """As a live session has them."""
    outcomes = outcomes_of(track, calibration, geometry, ground)
    return [outcome for outcome in outcomes if isinstance(outcome, StrideResult)]


def clearance_errors(walker: str) -> Iterator[tuple[float, str, FloatArray]]:
    """Of each walk the incline (%), a way, and its errors (K, 3) in cm of toe and heel clearance and of length."""
    for seed, incline in product(SEEDS, INCLINES_PERCENT):
        if incline == INCLINES_PERCENT[0]:
            level = calibrations_of(walked(walker, 0.0, seed)[0])[1].calibrations
        recording, truth = walked(walker, incline, seed)
        ground, level_share = Ground(incline_percent=incline), float(np.cos(np.arctan(0.01 * incline)))
        own = calibrations_of(recording, incline=ground.incline)[1].calibrations
        for way in WAYS:
            if way.startswith("live"):
                by = level if "elsewhere" in way else own
                found = [
                    stride
                    for foot, track in recording.tracks.items()
                    for stride in live_strides(track, by[foot], recording.geometry[foot], ground)
                ]
            else:
                given = {"analyse": ground, "--slope": Ground(free=True), "as level": Ground()}[way]
                found = analyse(recording, ground=given).strides
            errors = [
                (mine.toe_clearance_m - true.toe_clearance_m, mine.heel_clearance_m - true.heel_clearance_m,
                 mine.stride_length_m - level_share * true.stride_length_m) for mine, true in paired(found, truth)
            ]  # fmt: skip
            yield incline, way, 100.0 * np.array(errors).reshape(-1, 3)


def paired(found: list[StrideResult], truth: Truth) -> Iterator[tuple[StrideResult, TruthStride]]:
    """Valid strides with the true ones of the same swing, while the belt runs steadily."""
    for true in truth.strides:
        for mine in found:
            told = true.steady and mine.valid and mine.foot == true.foot and mine.t_swing_ns is not None
            if told and abs(1e-9 * mine.t_swing_ns - true.t_swing_s) < 0.15:
                yield mine, true


def rises(data: Path) -> dict[str, list[list[StrideResult]]]:
    """By data set each foot's valid strides, live, told that the ground is level."""
    found: dict[str, list[list[StrideResult]]] = {}
    walks = []
    if (climb := stairs(data)) is not None:
        own = calibrations_of(climb, incline=math.nan)[1].calibrations
        walks = [("gaitmap, stairs", track, own[sensor]) for sensor, track in climb.tracks.items()]
    level = ((foot.data_set, foot.track, calibrated(foot.track)) for foot in feet_of(data, FOOT_SETS))
    for name, track, calibration in chain(walks, level):
        if isinstance(calibration, FootCalibration):
            strides = live_strides(track, calibration, None, Ground())
            found.setdefault(name, []).append([stride for stride in strides if stride.valid])
    return found


def left_out(strides: list[StrideResult]) -> int:
    """How many of one foot's strides teach a tuner nothing."""
    watch = GroundWatch()
    return sum(bool(watch.unusual(stride)) for stride in strides)


def main(arguments: list[str] | None = None) -> int:
    options = parser_of(__doc__, data_folder()).parse_args(arguments)
    errors: dict[tuple[str, float, str], list[FloatArray]] = {}
    for walker in WALKERS:
        for incline, way, own in clearance_errors(walker):
            errors.setdefault((walker, incline, way), []).append(own)
    rows = []
    for (walker, incline, way), walks in errors.items():
        every = np.vstack(walks)
        cells = [f"{np.nanmean(v):+.2f} ± {np.nanstd(v):.2f}" if np.isfinite(v).any() else "none" for v in every.T]
        rows.append([walker, f"{incline:+.0f}", way, str(len(every)), *cells])
    clearance = table_of("", ("walker", "incline %", "way", "strides", "toe cm", "heel cm", "length cm"), rows)
    rows = []
    for name, feet in rises(options.data).items():
        values = np.array([stride.free_rise_m for strides in feet for stride in strides])
        middle, sd = np.median(values), 1.4826 * np.median(np.abs(values - np.median(values)))
        told = f"{100 * middle:+.1f}", f"{100 * sd:.1f}", str(sum(map(left_out, feet)))
        rows.append([name, str(len(values)), *told])
    table = table_of("", ("data", "strides", "rise, median cm", "SD cm", "left out"), rows)
    publish([clearance, table], options)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
