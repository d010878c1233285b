"""Toe and heel clearance against optical markers, and against the truth of the bundled trials; 3 without the former.

gaitmap_walk: the markers on toe and heel, each above its own height at the start of the stride; minimum toe clearance
and greatest heel height are taken from them by the same definitions (fes.estimation.clearance.clearance). The geometry
is given: where the markers sit on the standing foot, and where the sensor sits among them, read off once per foot from
accelerations (marker − sensor, low-passed at 6 Hz, in swing); or given without the sideways part; or estimated from the
IMU alone, its points lifted from the sole by the height at which the markers stand. Each without and with the contact
levels of the recording. Bar: mean within 0.3 cm, SD within 0.6 cm.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from scipy.signal import butter, filtfilt

from benchmarks.lib.command_line import no_recordings, parser_of, publish, table_of
from benchmarks.lib.foot_paths import FootPath, each_path, join_paths
from benchmarks.lib.real_sets import MARKERS_HZ, STRAIGHT_RAD, data_folder, gaitmap_markers, gaitmap_walk, trials
from fes.calibration.recording import calibrate_track
from fes.estimation.clearance.clearance import (
    HEEL,
    TOE,
    FootArms,
    arms_of,
    clearances,
    contact_heights,
    contact_levels,
    mid_swing,
)
from fes.estimation.clearance.geometry import estimate_geometry
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.recording import Track
from fes.signals import NS_PER_S, FloatArray, StrideResult

GRID_HZ = 200.0
LOW_PASS_HZ = 6.0
BAR_M = (0.003, 0.006)
# all paths of a foot, its points by how they are known, and the paths that are judged with their true clearances (m)
JudgedFoot = tuple[list[FootPath], dict[str, FootArms], list[tuple[FootPath, tuple[float, float]]]]


@dataclass(frozen=True)
class Row:
    """Errors of one geometry (m), estimate − truth: mean and SD of toe and heel clearance."""

    data: str
    geometry: str
    anchored: bool
    strides: int
    toe_m: tuple[float, float]
    heel_m: tuple[float, float]

    @property
    def holds(self) -> bool:
        return all(abs(mean) <= BAR_M[0] and sd <= BAR_M[1] for mean, sd in (self.toe_m, self.heel_m))


@dataclass(frozen=True)
class MarkedStride:
    """A stride and where the markers were meanwhile, (N, 3) in m, turned to the stride's heading, z above the floor."""

    path: FootPath
    straight: bool
    toe_m: FloatArray
    heel_m: FloatArray

    def truth(self) -> tuple[float, float]:
        """Minimum toe clearance and greatest heel height of the markers (m)."""
        begin, end = np.searchsorted(self.path.t_ns[:-1], (self.path.foot_off_ns or 0, self.path.contact_ns or 0))
        toe, heel = self.toe_m[:, 2] - self.toe_m[0, 2], self.heel_m[:, 2] - self.heel_m[0, 2]
        swing = slice(begin, end + 1)
        lowest, _ = mid_swing(self.path.t_ns[swing], toe[swing], self.toe_m[swing, :2])
        return float(toe[swing][lowest]), float(heel.max())


def walked(track: Track) -> tuple[list[StrideResult], list[FootPath]]:
    """The valid strides of one foot and their paths."""
    calibration = calibrate_track(track)
    settings = StrideSettings(forward=calibration.forward(), up=np.array(calibration.up))
    tracker = FootTracker(calibration, StrideMaker(track.sensor, settings))
    block = tracker.track(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    return [each for each in block.strides() if each.valid], each_path(block.paths())


@cache
def marked_strides(folder: Path) -> dict[str, list[MarkedStride]]:
    """Side → strides of the walk with markers; empty where it is absent."""
    found: dict[str, list[MarkedStride]] = {}
    for walk in gaitmap_walk(folder):
        markers = gaitmap_markers(folder, walk.name, "TOE", "FCC")
        seconds = np.arange(len(markers[0])) / MARKERS_HZ
        found[walk.name] = []
        for stride, path in zip(*walked(walk.track), strict=True):
            at_s = path.t_ns / NS_PER_S
            toe, heel = (np.column_stack([np.interp(at_s, seconds, axis) for axis in place.T]) for place in markers)
            # nothing tells the sensor where the laboratory's x points: the heel's way is turned to the sensor's
            (x, y), (u, v) = (heel[-1] - heel[0])[:2], path.position_m[-1, :2]
            angle = np.arctan2(v, u) - np.arctan2(y, x)
            turn = np.array(
                [[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]]
            )
            straight = abs(stride.turn_rad) <= STRAIGHT_RAD
            found[walk.name].append(MarkedStride(path, straight, toe @ turn.T, heel @ turn.T))
    return found


def given_arms(strides: list[MarkedStride]) -> FootArms:
    """Sensor to markers: the heel's by accelerations, the toe's from there by the standing markers."""
    turned, moved, between = [], [], []
    for stride in (each for each in strides if each.straight):
        path = stride.path
        between.append(path.axes[0].T @ (stride.toe_m[0] - stride.heel_m[0]))
        t_s = path.t_ns / NS_PER_S
        grid = np.arange(t_s[0], t_s[-1], 1.0 / GRID_HZ)
        columns = np.column_stack((stride.heel_m - path.position_m, path.axes.reshape(-1, 9)))
        even = np.column_stack([np.interp(grid, t_s, column) for column in columns.T])
        smooth = filtfilt(*butter(2, 2.0 * LOW_PASS_HZ / GRID_HZ), even, axis=0, padlen=50)
        second = np.gradient(np.gradient(smooth, axis=0), axis=0)
        swing = (grid * NS_PER_S > path.foot_off_ns) & (grid * NS_PER_S < path.contact_ns)
        moved.append(second[swing, :3].ravel())
        turned.append(second[swing, 3:].reshape(-1, 3))
    heel = np.linalg.lstsq(np.vstack(turned), np.concatenate(moved), rcond=None)[0]
    toe = heel + np.median(between, axis=0)
    return FootArms((toe[0], toe[1], toe[2]), (heel[0], heel[1], heel[2]))


def arms_by_geometry(strides: list[MarkedStride]) -> dict[str, FootArms]:
    given = given_arms(strides)
    sole = arms_of(estimate_geometry(join_paths([stride.path for stride in strides])).geometry)
    toe_up, heel_up = (float(np.median([getattr(s, name)[0, 2] for s in strides])) for name in ("toe_m", "heel_m"))
    return {
        "given": given,
        "given, not sideways": FootArms((given.toe_m[0], 0.0, given.toe_m[2]), (given.heel_m[0], 0.0, given.heel_m[2])),
        "estimated": FootArms(
            (sole.toe_m[0], 0.0, sole.toe_m[2] + toe_up), (sole.heel_m[0], 0.0, sole.heel_m[2] + heel_up)
        ),
    }


def marker_rows(folder: Path) -> Iterator[Row]:
    """The walk with markers, both feet together, straight strides."""
    feet = []
    for strides in marked_strides(folder).values():
        judged = [(stride.path, stride.truth()) for stride in strides if stride.straight]
        feet.append(([stride.path for stride in strides], arms_by_geometry(strides), judged))
    return _rows("gaitmap_walk, markers", feet)


@cache
def trial_rows() -> list[Row]:
    """The bundled trials, all feet together, steady strides."""
    feet = []
    for _, recording, truth in trials():
        for foot, geometry in recording.geometry.items():
            _, paths = walked(recording.tracks[foot])
            arms = {"given": arms_of(geometry), "estimated": arms_of(estimate_geometry(join_paths(paths)).geometry)}
            judged = []
            for true in (each for each in truth.strides_of(foot) if each.steady and each.walking):
                path = next((p for p in paths if p.t_ns[0] < NS_PER_S * true.t_swing_s < p.t_ns[-1]), None)
                if path is not None:
                    judged.append((path, (true.toe_clearance_m, true.heel_clearance_m)))
            feet.append((paths, arms, judged))
    return list(_rows("bundled trials", feet))


def _rows(data: str, feet: Sequence[JudgedFoot]) -> Iterator[Row]:
    for geometry, anchored in product(feet[0][1] if feet else (), (False, True)):
        errors = []
        for paths, arms_of_foot, judged in feet:
            arms = arms_of_foot[geometry]
            levels = contact_levels(contact_heights(join_paths(paths), arms)) if anchored else None
            errors += [clearances(join_paths([path]), arms, levels)[0, [TOE, HEEL]] - true for path, true in judged]
        mean, sd = np.mean(errors, axis=0), np.std(errors, axis=0, ddof=1)
        toe, heel = ((float(mean[k]), float(sd[k])) for k in range(2))
        yield Row(data, geometry, anchored, len(errors), toe, heel)


def main(arguments: list[str] | None = None) -> int:
    options = parser_of(__doc__).parse_args(arguments)
    rows = [
        [row.data, row.geometry, "yes" if row.anchored else "no", str(row.strides),
         *(f"{100.0 * mean:+.2f} ± {100.0 * sd:.2f}" for mean, sd in (row.toe_m, row.heel_m)),
         "yes" if row.holds else "no"] for row in (*trial_rows(), *marker_rows(data_folder()))
    ]  # fmt: skip
    table = table_of("", ("data", "geometry", "contact levels", "strides", "toe cm", "heel cm", "bar"), rows)
    arms_told = []
    for side, strides in marked_strides(data_folder()).items():
        for name, arms in arms_by_geometry(strides).items():
            toe, heel = (" ".join(f"{100.0 * part:+.1f}" for part in arm) for arm in (arms.toe_m, arms.heel_m))
            arms_told.append(f"{side}, {name}: toe {toe}, heel {heel} cm (forward, left, up)")
    publish([table], options, arms_told, folder=data_folder())
    return 0 if marked_strides(data_folder()) else no_recordings(data_folder())


if __name__ == "__main__":
    raise SystemExit(main())
