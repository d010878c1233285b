"""Every walker there is, known and unseen, foot by foot; and what users get of one: calibration, phases and strides."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.lib.real_sets import (
    PathWalk,
    Walk,
    gaitmap_events,
    gaitmap_walk,
    load_run,
    marker_strides,
    pyshoe_vicon,
    ruler_walks,
    runs_of,
    strike_deg,
)
from benchmarks.lib.swing_judge import Labelled, labelled
from fes.analysis.swings import Swings, find_swings
from fes.calibration.recording import calibrate_shank_track, calibrate_track
from fes.config import FootGeometry, Ground
from fes.datasets import read_file
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import Calibration, stride_settings
from fes.estimation.shank.tracker import ShankTracker
from fes.estimation.strides.results import StrideMaker
from fes.estimation.tracking.tracker import Outcome
from fes.recording import Track
from fes.recording.tracks import increasing
from fes.signals import StrideResult
from statemachine.phases import PhaseChange

SETS = (
    "stroke_treadmill", "shanks", "pyshoe_vicon", "ruler_walks", "gaitmap_walk", "footswitch_treadmill", "stroke_walks"
)  # fmt: skip
FOOT_SETS = tuple(name for name in SETS if name != "shanks")
LYING = ("P06",)  # its accelerometer is off gravity by more than 3 m/s² in 29 % of its quiet samples
DRIFTING = ("P07_1", "H04_2")  # labels
SHORT_FLAT = ("H03",)  # T4 cannot be judged


@dataclass(frozen=True, eq=False)
class Foot:
    """One sensor of one walk. ``judge`` is the track that swings are counted by, its own unless it is a shank's."""

    data_set: str
    part: str
    person: str
    run: str
    track: Track
    judge: Track | None = None
    walk: Walk | None = None
    belt_mps: float = float("nan")
    strike_deg: float = float("nan")
    labels: Labelled | None = None
    ic_s: Any = None
    fo_s: Any = None

    @property
    def side(self) -> str:
        return self.track.sensor.split("_")[0]

    def marked_strides(self) -> list[dict[str, float]]:
        """Instants (s) of its strides by optical markers, see :func:`real_sets.marker_strides`; none without any."""
        if self.ic_s is None or not isinstance(self.walk, PathWalk):
            return []
        return list(marker_strides(self.walk, np.sort(self.ic_s), np.sort(self.fo_s)))


def stroke_treadmill(folder: Path, part: str) -> Iterator[Foot]:
    for path in runs_of(folder):
        tracks, belt_mps = load_run(path)
        common = {"belt_mps": belt_mps, "strike_deg": strike_deg(path)}
        for track in tracks.values():
            yield Foot("stroke_treadmill", part, path.stem[:4], path.stem, track, **common)


def shanks(folder: Path, part: str) -> Iterator[Foot]:
    for path in runs_of(folder):
        (feet, belt_mps), (found, _) = load_run(path), load_run(path, "shank")
        for foot, shank in zip(feet.values(), found.values(), strict=True):
            yield Foot("shanks", part, path.stem[:4], path.stem, shank, foot, belt_mps=belt_mps)


def measured_walks(walks: Iterable[Walk], part: str, person: Callable[[str], str]) -> Iterator[Foot]:
    for walk in walks:
        yield Foot(walk.data_set, part, person(walk.name), walk.name, walk.track, walk=walk)


def gaitmap(folder: Path, part: str) -> Iterator[Foot]:
    for walk in gaitmap_walk(folder):
        ic_s, fo_s = gaitmap_events(folder, walk.name, "ic", "tc").T
        yield Foot("gaitmap_walk", part, "adult", walk.name, walk.track, walk=walk, ic_s=ic_s, fo_s=fo_s)


def footswitch_treadmill(folder: Path, part: str) -> Iterator[Foot]:
    for path in sorted((folder / "footswitch_treadmill").glob("*.npz")):
        data = np.load(path)
        meta, t_s = json.loads(str(data["meta"])), data["foot_t_s"]
        (track,) = read_file("footswitch_treadmill", path).recording.tracks.values()
        labels = labelled(np.round(1e9 * (t_s - t_s[0])).astype(np.int64), data["label"], data["bad"])
        track = replace(track, rate_hz=meta["rate_hz_mean"])
        yield Foot("footswitch_treadmill", part, meta["person"], path.stem, track, labels=labels)


def stroke_walks(folder: Path, part: str) -> Iterator[Foot]:
    for path in sorted((folder / "stroke_walks").glob("*.npz")):
        recording = read_file("stroke_walks", path).recording
        for track in recording.tracks.values():
            group = f"{part}, {recording.extra['group']}"
            yield Foot("stroke_walks", group, path.stem, path.stem, before_the_jump(track))


def before_the_jump(track: Track) -> Track:
    """Without a late block whose clock has gone back."""
    back = np.flatnonzero(~increasing(track))
    return track.part(slice(0, int(back[0]))) if len(back) and back[0] > 0.9 * len(track.t_ns) else track


READERS: dict[str, Callable[[Path, str], Iterator[Foot]]] = {
    "stroke_treadmill": stroke_treadmill,
    "shanks": shanks,
    "pyshoe_vicon": lambda folder, part: measured_walks(pyshoe_vicon(folder), part, lambda name: name[:10]),
    "ruler_walks": lambda folder, part: measured_walks(ruler_walks(folder), part, lambda name: name.split("_")[1]),
    "gaitmap_walk": gaitmap,
    "footswitch_treadmill": footswitch_treadmill,
    "stroke_walks": stroke_walks,
}


def feet_of(data: Path, wanted: Iterable[str]) -> Iterator[Foot]:
    """All feet of these sets, known and unseen."""
    for name in wanted:
        for folder, part in ((data, "known"), (data / "unseen_walkers", "unseen")):
            yield from READERS[name](folder, part)


def of_all(work: Callable[[Foot], Any], feet: Iterable[Foot], jobs: int) -> list[Any]:
    """Some work on every foot, in the order of the feet, in so many processes."""
    if jobs == 1:
        return [work(foot) for foot in feet]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(work, feet, chunksize=1))


def calibrate(track: Track) -> Calibration:
    """As ``fes calibrate`` does."""
    return calibrate_shank_track(track) if track.sensor.endswith("shank") else calibrate_track(track)


def calibrated(track: Track) -> Calibration | None:
    """The same; None where the track is refused."""
    try:
        return calibrate(track)
    except CalibrationError:
        return None


def outcomes_of(
    track: Track, calibration: Calibration, geometry: FootGeometry | None = None, ground: Ground | None = None
) -> list[Outcome]:
    """Phase changes and strides in the order in which they come live."""
    if isinstance(calibration, FootCalibration):
        settings = stride_settings(calibration, geometry, ground)
        tracker: Any = FootTracker(calibration, StrideMaker(track.sensor, settings))
    else:
        tracker = ShankTracker(calibration)
    outcomes: list[Outcome] = tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    return outcomes


def causal(track: Track, calibration: Calibration) -> tuple[list[PhaseChange], list[StrideResult]]:
    """Phase changes, and strides, as they come live."""
    outcomes = outcomes_of(track, calibration)
    changes = [outcome for outcome in outcomes if isinstance(outcome, PhaseChange)]
    return changes, [outcome for outcome in outcomes if isinstance(outcome, StrideResult)]


def swings_of(foot: Foot) -> Swings:
    """What this foot's phases are held against."""
    by = foot.judge or foot.track
    seen = find_swings(by.t_ns, by.acc_mps2, by.gyr_radps)
    return seen if foot.labels is None else foot.labels.swings(seen)
