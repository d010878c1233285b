"""How many steps of real walks get no burst because nobody is known to walk yet: starts, turns, pauses.

    python benchmarks/loop/first_strides.py [--data FOLDER] [--json FILE]

Every heel rise (T1) that a swing follows is a step; it is refused where ``WalkingJudge`` does not permit a burst with
it. Beside the program's own settings stand two strides asked for before the first burst, as it was once. Walks as in
``every_walker.py``, phases and strides as they come live. Last the bundled trial of not walking: bursts while nobody
walks, which must be none.
"""

from __future__ import annotations

import sys
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path

from rich.table import Table

from benchmarks.accuracy.every_walker import Foot, calibrate, feet_of
from benchmarks.accuracy.stroke_treadmill import data_folder
from benchmarks.lib.command_line import console_of, parser_of, save
from fes.calibration.recording import calibrate_phase_sensors
from fes.config import Stimulation
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import stride_settings
from fes.estimation.strides.results import StrideMaker
from fes.estimation.tracking.tracker import Outcome
from fes.recording import Track, read_recording
from fes.signals import StrideResult
from fes.simulation.truth import load_truth
from fes.stimulation.walking import WalkingJudge
from statemachine.phases import Transition

SETS = ("ruler_walks", "gaitmap_walk", "stroke_walks", "footswitch_treadmill", "pyshoe_vicon")
BUNDLED = Path(__file__).resolve().parents[2] / "sim_inputs"


def outcomes_of(track: Track, calibration: FootCalibration) -> list[Outcome]:
    """Phase changes and strides in the order in which they come live."""
    tracker = FootTracker(calibration, StrideMaker(track.sensor, stride_settings(calibration)))
    return list(tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps))


def heel_rises(outcomes: Iterable[Outcome], settings: Stimulation) -> list[tuple[int, bool, bool]]:
    """Of each T1: when (ns), whether a burst was permitted, whether a swing followed."""
    judge, found = WalkingJudge(settings), list[tuple[int, bool, bool]]()
    for outcome in outcomes:
        if isinstance(outcome, StrideResult):
            judge.on_stride(outcome)
            continue
        permitted = judge.on_phase(outcome)
        if outcome.transition is Transition.T1:
            found.append((outcome.t_ns, permitted, False))
        elif outcome.transition is Transition.T2 and found:
            found[-1] = (*found[-1][:2], True)
    return found


def refused_by_set(feet: Iterable[Foot], settings: tuple[Stimulation, ...]) -> dict[str, tuple[int, list[int]]]:
    """By data set: steps, and how many of them each of the settings refused."""
    steps: Counter[str] = Counter()
    refused: defaultdict[str, list[int]] = defaultdict(lambda: [0] * len(settings))
    for foot in feet:
        try:
            calibration = calibrate(foot.track)
        except CalibrationError:
            continue
        if isinstance(calibration, FootCalibration):
            outcomes = outcomes_of(foot.track, calibration)
            for number, each in enumerate(settings):
                swung = [permitted for _, permitted, swings in heel_rises(outcomes, each) if swings]
                refused[foot.data_set][number] += swung.count(False)
            steps[foot.data_set] += len(swung)
    return {name: (count, refused[name]) for name, count in steps.items()}


def bursts_of_nobody(settings: Stimulation) -> int:
    """In the bundled trial of not walking, permitted heel rises outside its walk."""
    recording = read_recording(BUNDLED / "not_walking.parquet")
    walks = [each for each in load_truth(BUNDLED / "not_walking.parquet").activities if each.walking]
    count = 0
    for sensor, calibration in calibrate_phase_sensors(recording).calibrations.items():
        if isinstance(calibration, FootCalibration):
            rises = heel_rises(outcomes_of(recording.tracks[sensor], calibration), settings)
            permitted_s = [1e-9 * t_ns for t_ns, permitted, _ in rises if permitted]
            count += sum(not any(walk.start_s <= t_s <= walk.end_s for walk in walks) for t_s in permitted_s)
    return count


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    options = parser_of(__doc__, data_folder()).parse_args(arguments)
    own, two = Stimulation(), Stimulation(strides_before_start=2)
    found = refused_by_set(feet_of(options.data, SETS), (own, two))
    table = Table("set", "steps", f"refused ({own.strides_before_start} stride before)", "(2 before)")
    for name, (steps, refused) in found.items():
        table.add_row(name, str(steps), *(f"{each} ({100 * each / steps:.1f} %)" for each in refused))
    table.add_row("not walking: bursts", "", str(bursts_of_nobody(own)), str(bursts_of_nobody(two)))
    console_of(100).print(table)
    save(found, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
