"""Recordings with ground truth that are not part of the project, as tracks in SI units and what is true of them.

They lie in $FES_DATA, else in ../shared/data beside the project; see docs/accuracy.md for where each comes from. Every
loader yields walks; a set that is absent yields none.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from benchmarks.accuracy.stroke_treadmill import data_folder, load_run, track_of
from fes.recording import Track
from fes.signals import FloatArray, IntArray, StrideResult
from fes.simulation.truth import HEEL_UP_M, TILT_RAD

STRAIGHT_RAD = 0.35
LONGEST_S = 1.2  # of a stance or swing of the gaitmap walk


@dataclass(frozen=True)
class Walk:
    """One foot of one walk. ``truth`` says what a stride should measure, or NaN where nobody knows."""

    data_set: str
    name: str
    track: Track

    def true_length_m(self, stride: StrideResult) -> float:
        """Length of the stride by the reference; NaN where there is none."""
        raise TypeError(f"{type(self).__name__} has no reference for single strides")

    def true_clearance_m(self, stride: StrideResult) -> float:
        """The sensor's clearance by the reference; NaN where there is none."""
        return float("nan")

    def comparable(self, stride: StrideResult) -> bool:
        """Whether sensor and reference travel the same way: not in a stride that swivels the foot on the ground."""
        return abs(stride.turn_rad) <= STRAIGHT_RAD


@dataclass(frozen=True)
class PathWalk(Walk):
    """Truth is the position (N, 3) in m, z up, of a point of the foot at ``rate_hz`` from the first sample on.

    ``lever_m`` (N, 3) is the sensor's path, as the markers' orientation and a lever arm give it, where the point is
    another; ``frame`` (N, 3, 3) that orientation; ``borders_s`` (K, 2) the stride borders of the reference.
    """

    position_m: FloatArray
    rate_hz: float
    at_sensor: bool
    lever_m: FloatArray | None = None
    borders_s: FloatArray | None = None
    frame: FloatArray | None = None

    def _rows(self, stride: StrideResult) -> FloatArray:
        first, last = (round(1e-9 * t_ns * self.rate_hz) for t_ns in (stride.t_start_ns, stride.t_end_ns))
        return self.position_m[first : last + 1] if 0 <= first < last < len(self.position_m) else np.empty((0, 3))

    def true_length_m(self, stride: StrideResult) -> float:
        """Horizontal distance between the stride's own ends; NaN for steps on the spot and the reference's glitches.

        Where the foot stood is the median over 25 ms on either side: single samples of the reference jump.
        """
        rows = self._rows(stride)
        if not len(rows):
            return float("nan")
        near = round(0.025 * self.rate_hz)
        start, end = (round(1e-9 * t_ns * self.rate_hz) for t_ns in (stride.t_start_ns, stride.t_end_ns))
        places = [np.median(self.position_m[max(k - near, 0) : k + near + 1], axis=0) for k in (start, end)]
        length = float(np.hypot(*(places[1] - places[0])[:2]))
        jump = float(np.linalg.norm(np.diff(rows, axis=0), axis=1).max()) * self.rate_hz
        return length if length > 0.3 and jump < 8.0 else float("nan")

    def true_clearance_m(self, stride: StrideResult) -> float:
        """Greatest height of the tracked point above its start."""
        rows = self._rows(stride)
        return float(rows[:, 2].max() - rows[0, 2]) if self.at_sensor and len(rows) else float("nan")

    def true_lift_m(self, stride: StrideResult) -> float:
        """The sensor's clearance, through the lever arm; NaN where that is not known."""
        if self.lever_m is None:
            return float("nan")
        first, last = (round(1e-9 * t_ns * self.rate_hz) for t_ns in (stride.t_start_ns, stride.t_end_ns))
        height = self.lever_m[first : last + 1, 2]
        return float(height.max() - height[0]) if len(height) else float("nan")

    def comparable(self, stride: StrideResult) -> bool:
        """Any stride, where the reference tracks the sensor itself."""
        return self.at_sensor or super().comparable(stride)


@dataclass(frozen=True)
class FootprintWalk(Walk):
    """Truth is the place (K, 2) in m of every footprint, and the sample at which the foot stood there."""

    index: IntArray
    place_m: FloatArray

    def true_length_m(self, stride: StrideResult) -> float:
        """Distance between the footprints around the stride's middle."""
        middle = 0.5e-9 * (stride.t_start_ns + stride.t_end_ns) * self.track.rate_hz
        k = int(np.searchsorted(self.index, middle))
        if not 0 < k < len(self.index):
            return float("nan")
        return float(np.hypot(*(self.place_m[k] - self.place_m[k - 1])))


def pyshoe_vicon(folder: Path) -> Iterator[Walk]:
    """Right instep, 200 Hz, Vicon position of the sensor's marker at every sample."""
    for path in sorted((folder / "pyshoe_vicon").glob("*.mat")):
        data = loadmat(path)
        track = track_of("right_foot", 200.0, data["imu"][:, :3], data["imu"][:, 3:])
        yield PathWalk("pyshoe_vicon", path.stem, track, data["gt"], 200.0, at_sensor=True)


def ruler_walks(folder: Path) -> Iterator[Walk]:
    """One foot, 200 Hz, every footprint measured by ruler."""
    for path in sorted((folder / "ruler_walks").glob("*_LLIO.mat")):
        imu = loadmat(path)["imu_data"]
        table = path.with_name(path.name.replace("LLIO.mat", "strideIndex_timestamp_gcpX_gcpY.csv"))
        rows = list(csv.DictReader(table.open()))
        index = np.array([int(float(row["strideIndex"])) for row in rows])
        place = np.array([[float(row["gcpX"]), float(row["gcpY"])] for row in rows])
        track = track_of("right_foot", 200.0, imu[:, :3], imu[:, 3:])
        yield FootprintWalk("ruler_walks", path.stem, track, index, place)


def gaitmap_walk(folder: Path) -> Iterator[Walk]:
    """Lateral shoes, 204.8 Hz; truth is the heel marker at 100 Hz (mm in the file)."""
    imu_path, mocap_path = (folder / "gaitmap_walk" / name for name in ("imu_sample.csv", "mocap_sample.csv"))
    if not imu_path.is_file():
        return
    imu, mocap = _two_header_lines(imu_path), _two_header_lines(mocap_path)
    for side in ("left", "right"):
        acc, gyr = (
            np.column_stack([imu[f"{side}_sensor", f"{kind}_{axis}"] for axis in "xyz"]) for kind in ("acc", "gyr")
        )
        heel = np.column_stack([mocap[f"{side[0].upper()}_FCC", axis] for axis in "xyz"]) / 1000.0
        toe, fifth = (
            np.column_stack([mocap[f"{side[0].upper()}_{name}", axis] for axis in "xyz"]) / 1000.0
            for name in ("TOE", "FM5")
        )
        events = list(csv.DictReader((folder / "gaitmap_walk" / "stride_events_sample.csv").open()))
        borders = np.array([[float(row["start"]), float(row["end"])] for row in events if row["foot"] == side]) / 204.8
        track = track_of(f"{side}_foot", 204.8, acc, np.radians(gyr))
        frame = marker_frame(heel, toe, fifth)
        yield PathWalk(
            "gaitmap_walk",
            side,
            track,
            heel,
            100.0,
            at_sensor=False,
            lever_m=sensor_of(heel, toe, fifth, frame),
            borders_s=borders,
            frame=frame,
        )


def sensor_of(heel: FloatArray, toe: FloatArray, fifth: FloatArray, frame: FloatArray) -> FloatArray:
    """Path (N, 3) of the lateral sensor: 0.076 m forward of the heel marker and 0.05 m outward, turning with the foot.

    The arm is level when the foot is flat; flat is what the markers show while they hardly move (below 0.1 m/s).
    """
    still = sum(np.linalg.norm(np.diff(p, axis=0, prepend=p[:1]), axis=1) * 100.0 for p in (heel, toe)) < 0.1
    up = np.nanmedian(frame[still][:, 2, :], axis=0)
    up /= np.linalg.norm(up)
    forward = np.array([1.0, 0.0, 0.0]) - up * up[0]
    forward /= np.linalg.norm(forward)
    outward = np.cross(up, forward) * np.sign(np.nanmedian(np.einsum("ij,ij->i", fifth - heel, frame[:, :, 1])))
    return np.asarray(heel + frame @ (0.076 * forward + 0.05 * outward))


def marker_frame(heel: FloatArray, toe: FloatArray, fifth: FloatArray) -> FloatArray:
    """Orientation (N, 3, 3) of the foot from three markers: x towards the toe, z out of their plane and upward."""
    x = toe - heel
    x /= np.linalg.norm(x, axis=1)[:, None]
    z = np.cross(x, fifth - heel)
    z /= np.linalg.norm(z, axis=1)[:, None]
    z *= np.sign(np.nanmedian(z[:, 2]))
    return np.stack([x, np.cross(z, x), z], axis=2)


def marker_strides(walk: PathWalk, ic_s: FloatArray, fo_s: FloatArray) -> Iterator[dict[str, float]]:
    """Of each foot off of the markers' its instants (s) by the names of a stride's columns, as far as they are seen."""
    assert walk.frame is not None
    height_m, forward = walk.position_m[:, 2], walk.frame[:, :, 0]
    pitch = np.arctan2(forward[:, 2], np.hypot(forward[:, 0], forward[:, 1]))

    def stance(begin_s: float, end_s: float) -> tuple[float, float]:
        """Foot flat, and the last heel rise, within."""
        first, last = round(begin_s * walk.rate_hz), round(end_s * walk.rate_hz)
        middle = (first + last) // 2
        low = np.abs(height_m - np.median(height_m[middle - 3 : middle + 4])) < HEEL_UP_M
        flat = low & (np.abs(pitch - np.median(pitch[middle - 3 : middle + 4])) < TILT_RAD)
        rolling, down = np.flatnonzero(~flat[first:middle]), np.flatnonzero(low[middle:last])
        begun = first + (rolling[-1] + 1 if len(rolling) else 0)
        return begun / walk.rate_hz, (middle + down[-1] + 1) / walk.rate_hz

    for off_s in fo_s.tolist():
        stride = {"t_swing_s": off_s}
        before, after = ic_s[ic_s < off_s], ic_s[ic_s > off_s]
        if len(before) and off_s - before[-1] < LONGEST_S:
            stride["t_pre_swing_s"] = stance(before[-1], off_s)[1]
        if len(after) and after[0] - off_s < LONGEST_S:
            stride["t_loading_response_s"] = after[0]
            following = fo_s[fo_s > after[0]]
            if len(following) and following[0] - after[0] < LONGEST_S:
                stride["t_stance_s"] = stance(after[0], following[0])[0]
        yield stride


def _two_header_lines(path: Path) -> dict[tuple[str, str], FloatArray]:
    """Columns of a CSV whose names stand in two lines; an empty cell is NaN."""
    with path.open() as file:
        first, second = (file.readline().rstrip("\n").split(",") for _ in range(2))
        values = np.genfromtxt(file, delimiter=",")
    return {(a, b): values[:, k] for k, (a, b) in enumerate(zip(first, second, strict=True))}


def stroke_feet(folder: Path) -> Iterator[tuple[str, Track, float]]:
    """Runs of the stroke treadmill set on a belt of known speed: name, track, belt speed (m/s)."""
    for path in sorted((folder / "stroke_treadmill").glob("*.npz")):
        tracks, belt_mps = load_run(path)
        if np.isfinite(belt_mps):
            for track in tracks.values():
                yield path.stem, track, belt_mps


def all_walks() -> list[Walk]:
    """Every walk with a reference for single strides."""
    folder = data_folder()
    return [*pyshoe_vicon(folder), *ruler_walks(folder), *gaitmap_walk(folder)]
