"""Recordings with ground truth that are not part of the project, as tracks in SI units and what is true of them.

They lie in $FES_DATA, else in ../shared/data beside the project; see docs/accuracy.md for where each comes from. A set
that is absent yields none.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.io import loadmat

from fes.datasets import read_file
from fes.datasets.common import even_track, two_header_csv
from fes.recording import Recording, Track, read_recording
from fes.signals import FloatArray, IntArray, StrideResult
from fes.simulation.truth import HEEL_UP_M, TILT_RAD, Truth, load_truth

BoolArray = npt.NDArray[np.bool_]
TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"
NAMES = ("negard_patient1", "negard_patient2", "both_feet_100hz", "both_feet_200hz", "misaligned", "soft_contact")
STRAIGHT_RAD = 0.35
LONGEST_S = 1.2  # of a stance or swing of the gaitmap walk
LAST_S = 120.0  # of a run on a belt, over which its speed is known
GAITMAP_HZ, MARKERS_HZ = 204.8, 100.0


def data_folder() -> Path:
    """Where the recordings are: $FES_DATA, else ../shared/data beside the project."""
    return Path(os.environ.get("FES_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")


def trials(names: Iterable[str] = (*NAMES, "not_walking")) -> Iterator[tuple[str, Recording, Truth]]:
    """The bundled ones with their truth."""
    for name in names:
        yield name, read_recording(TRIALS / f"{name}.parquet"), load_truth(TRIALS / f"{name}.parquet")


# --- stroke_treadmill -------------------------------------------------------------------------------------------------


def runs_of(folder: Path) -> list[Path]:
    """All runs below a folder, in order."""
    return sorted((folder / "stroke_treadmill").glob("*.npz"))


def load_run(path: Path, part: str = "foot") -> tuple[dict[str, Track], float]:
    """The feet (or shanks) of one run and the belt's speed (m/s, NaN when self-paced)."""
    recording = read_file("stroke_treadmill", path).recording
    tracks = {f"{side}_{part}": recording.tracks[f"{side}_{part}"] for side in ("left", "right")}
    return tracks, float(recording.belt_speed_mps or "nan")


def strike_deg(path: Path) -> float:
    """Vicon's mean foot-strike angle of a run, toe-up positive."""
    return float(np.load(path)["fsa_mean_deg"])


def stroke_feet(folder: Path) -> Iterator[tuple[str, Track, float]]:
    """Runs on a belt of known speed: name, track, belt speed (m/s)."""
    for path in runs_of(folder):
        tracks, belt_mps = load_run(path)
        if np.isfinite(belt_mps):
            for track in tracks.values():
                yield path.stem, track, belt_mps


# --- walks with a reference for single strides ------------------------------------------------------------------------


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
        """The greatest height of the tracked point above its start; NaN where that is not at the sensor."""
        return float("nan")

    def true_lift_m(self, stride: StrideResult) -> float:
        """The sensor's clearance by the reference; NaN where there is none."""
        return self.true_clearance_m(stride)

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

    def span(self, stride: StrideResult) -> tuple[int, int]:
        """The rows of a stride's ends."""
        return round(1e-9 * stride.t_start_ns * self.rate_hz), round(1e-9 * stride.t_end_ns * self.rate_hz)

    def _rows(self, stride: StrideResult) -> FloatArray:
        first, last = self.span(stride)
        return self.position_m[first : last + 1] if 0 <= first < last < len(self.position_m) else np.empty((0, 3))

    def true_length_m(self, stride: StrideResult) -> float:
        """Horizontal distance between the stride's own ends; NaN for steps on the spot and the reference's glitches.

        Where the foot stood is the median over 25 ms on either side: single samples of the reference jump.
        """
        rows = self._rows(stride)
        if not len(rows):
            return float("nan")
        near = round(0.025 * self.rate_hz)
        places = [np.median(self.position_m[max(k - near, 0) : k + near + 1], axis=0) for k in self.span(stride)]
        length = float(np.hypot(*(places[1] - places[0])[:2]))
        jump = float(np.linalg.norm(np.diff(rows, axis=0), axis=1).max()) * self.rate_hz
        return length if length > 0.3 and jump < 8.0 else float("nan")

    def true_clearance_m(self, stride: StrideResult) -> float:
        rows = self._rows(stride)
        return float(rows[:, 2].max() - rows[0, 2]) if self.at_sensor and len(rows) else float("nan")

    def true_lift_m(self, stride: StrideResult) -> float:
        """Through the lever arm, where that is known."""
        if self.lever_m is None:
            return self.true_clearance_m(stride)
        first, last = self.span(stride)
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


def pyshoe_vicon(folder: Path) -> Iterator[PathWalk]:
    """Right instep, 200 Hz, Vicon position of the sensor's marker at every sample."""
    for path in sorted((folder / "pyshoe_vicon").glob("*.mat")):
        data = loadmat(path)
        track = even_track("right_foot", 200.0, data["imu"][:, :3], data["imu"][:, 3:])
        yield PathWalk("pyshoe_vicon", path.stem, track, data["gt"], 200.0, at_sensor=True)


def ruler_walks(folder: Path) -> Iterator[FootprintWalk]:
    """One foot, 200 Hz, every footprint measured by ruler."""
    for path in sorted((folder / "ruler_walks").glob("*_LLIO.mat")):
        imu = loadmat(path)["imu_data"]
        table = path.with_name(path.name.replace("LLIO.mat", "strideIndex_timestamp_gcpX_gcpY.csv"))
        index, _, x, y = np.loadtxt(table, delimiter=",", skiprows=1).T
        track = even_track("right_foot", 200.0, imu[:, :3], imu[:, 3:])
        yield FootprintWalk("ruler_walks", path.stem, track, index.astype(int), np.column_stack((x, y)))


def gaitmap_feet(path: Path) -> dict[str, Track]:
    """Both feet of a gaitmap recording, lateral shoes, 204.8 Hz."""
    tracks = read_file("gaitmap", path).recording.tracks
    return {sensor: replace(track, acc_range_mps2=None) for sensor, track in tracks.items()}


def stairs(folder: Path) -> Recording | None:
    """The gaitmap stairs, upwards; None where they are absent."""
    path = folder / "gaitmap_walk" / "imu_sample_healthy_stair_up.csv"
    return Recording("gaitmap stairs", None, gaitmap_feet(path)) if path.is_file() else None


def gaitmap_markers(folder: Path, side: str, *names: str) -> list[FloatArray]:
    """Paths (N, 3) in m at 100 Hz of markers of one foot: FCC (heel), TOE, FM5 …"""
    columns = two_header_csv(folder / "gaitmap_walk" / "mocap_sample.csv")
    return [np.column_stack([columns[f"{side[0].upper()}_{name}", axis] for axis in "xyz"]) / 1000.0 for name in names]


def gaitmap_events(folder: Path, side: str, *names: str) -> FloatArray:
    """Instants (K, len(names)) in s of the strides of one foot: start, end, ic, tc."""
    with (folder / "gaitmap_walk" / "stride_events_sample.csv").open(encoding="utf-8", newline="") as file:
        rows = [[float(row[name]) for name in names] for row in csv.DictReader(file) if row["foot"] == side]
    return np.array(rows) / GAITMAP_HZ


def gaitmap_walk(folder: Path) -> Iterator[PathWalk]:
    """A healthy adult, both feet; truth is the heel marker at 100 Hz."""
    path = folder / "gaitmap_walk" / "imu_sample.csv"
    if not path.is_file():
        return
    for sensor, track in gaitmap_feet(path).items():
        side = sensor.removesuffix("_foot")
        heel, toe, fifth = gaitmap_markers(folder, side, "FCC", "TOE", "FM5")
        frame = marker_frame(heel, toe, fifth)
        lever, borders = sensor_of(heel, toe, fifth, frame), gaitmap_events(folder, side, "start", "end")
        yield PathWalk("gaitmap_walk", side, track, heel, MARKERS_HZ, False, lever, borders, frame)


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


def all_walks() -> list[Walk]:
    """Every walk with a reference for single strides."""
    folder = data_folder()
    return [*pyshoe_vicon(folder), *ruler_walks(folder), *gaitmap_walk(folder)]


def xio(folder: Path) -> Track | None:
    """A walk of about 25 m that ends where it began, 400 Hz nominal; doubled stamps dropped, put on a regular grid."""
    path = folder / "xio_walk" / "short_walk.csv"
    if not path.is_file():
        return None
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    grid = np.arange(table[0, 0], table[-1, 0], 1.0 / 400.0)
    columns = np.column_stack([np.interp(grid, table[:, 0], table[:, k]) for k in range(1, 7)])
    return even_track("right_foot", 400.0, columns[:, 3:] * 9.81, np.radians(columns[:, :3]))


# --- strides between borders that the sets give -----------------------------------------------------------------------

GLITCH_MPS = 8.0  # faster than this the optical system has lost its marker
SPEED_OVER_S = 0.025
DISPUTED_M = 0.08  # where the set's own trajectory departs further from the ruler, one of them is wrong
STRAIGHT_M = 0.6  # shorter ones are turns


@dataclass(frozen=True)
class BorderedWalk:
    """Strides between given instants: borders (M,) in ns, true lengths (M,) in m.

    ``disputed`` (M,) marks strides whose reference the set itself contradicts. ``speed_mps`` (N,) is the optical speed,
    NaN where it is not to be believed, empty where there is none.
    """

    walk: Walk
    begin_ns: IntArray
    end_ns: IntArray
    length_m: FloatArray
    disputed: BoolArray
    speed_mps: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def track(self) -> Track:
        return self.walk.track


def _instants(samples: npt.ArrayLike, rate_hz: float) -> IntArray:
    return np.rint(np.asarray(samples, dtype=float) * (1e9 / rate_hz)).astype(np.int64)


def optical_speed(position_m: FloatArray, rate_hz: float) -> FloatArray:
    """Speed (N,) in m/s of positions (N, 3) in m, over 25 ms; NaN around glitches."""
    width = max(round(SPEED_OVER_S * rate_hz), 1)
    velocity = np.gradient(position_m, axis=0) * rate_hz
    speed = np.linalg.norm([np.convolve(v, np.full(width, 1.0 / width), "same") for v in velocity.T], axis=0)
    jump = np.linalg.norm(np.diff(position_m, axis=0, prepend=position_m[:1]), axis=1) * rate_hz > GLITCH_MPS
    speed[np.convolve(jump, np.ones(width + 2), "same") > 0.0] = np.nan
    return np.asarray(speed)


def pyshoe(folder: Path) -> list[BorderedWalk]:
    """Nine healthy walks before a Vicon, right instep, 200 Hz."""
    walks = []
    for walk in pyshoe_vicon(folder):
        strides = folder / "pyshoe_vicon" / "strides" / f"{walk.name}_strideIndex_timestamp_gcpX_gcpY.csv"
        at = np.loadtxt(strides, delimiter=",", skiprows=1)[:, 0].astype(int)
        lengths, stamps = np.hypot(*np.diff(walk.position_m[at, :2], axis=0).T), _instants(at, walk.rate_hz)
        speed = optical_speed(walk.position_m, walk.rate_hz)
        walks.append(BorderedWalk(walk, stamps[:-1], stamps[1:], lengths, np.zeros(len(lengths), bool), speed))
    return walks


def ruler(folder: Path) -> list[BorderedWalk]:
    """Four walks with every footprint measured by ruler, 200 Hz."""
    walks = []
    for walk in ruler_walks(folder):
        own = loadmat(folder / "ruler_walks" / f"{walk.name}.mat")["pyshoeTrajectory"][walk.index]
        lengths = np.hypot(*np.diff(walk.place_m, axis=0).T)
        disputed = np.abs(np.hypot(*np.diff(own, axis=0).T) - lengths) > DISPUTED_M
        stamps = _instants(walk.index, walk.track.rate_hz)
        walks.append(BorderedWalk(walk, stamps[:-1], stamps[1:], lengths, disputed))
    return walks


def gaitmap(folder: Path) -> list[BorderedWalk]:
    """One healthy adult, both shoes, reference borders, length by the heel marker; straight strides."""
    walks = []
    for walk in gaitmap_walk(folder):
        assert walk.borders_s is not None
        seconds = np.arange(len(walk.position_m)) / walk.rate_hz
        places = [[np.interp(s, seconds, walk.position_m[:, j]) for j in range(2)] for s in walk.borders_s.T]
        lengths = np.hypot(*np.subtract(places[1], places[0]))
        straight = lengths > STRAIGHT_M
        begin_ns, end_ns = _instants(walk.borders_s[straight], 1.0).T
        walks.append(BorderedWalk(walk, begin_ns, end_ns, lengths[straight], np.zeros(int(straight.sum()), bool)))
    return walks


# --- true contacts and foot offs --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """One foot of one recording, its true events in s from the start, and whether markers confirm an extra event."""

    name: str
    track: Track
    ic_s: FloatArray
    fo_s: FloatArray
    confirmed: Callable[[str, float], bool] = lambda _event, _t_s: False


def gaitmap_cases(folder: Path) -> list[Case]:
    """Both feet of the walk with markers; only the 57 strides of the reference count."""
    cases = []
    for walk in gaitmap_walk(folder):
        ic_s, fo_s = gaitmap_events(folder, walk.name, "ic", "tc").T
        speed = np.hypot(*(np.gradient(x) for x in walk.position_m.T[:2])) * MARKERS_HZ
        cases.append(Case("gaitmap_walk", walk.track, ic_s, fo_s, partial(_steps, speed)))
    return cases


def _steps(speed_mps: FloatArray, event: str, t_s: float) -> bool:
    """Does the heel marker come to rest after this IC, or leave rest about this FO?"""
    at = round(t_s * MARKERS_HZ)
    before, after = speed_mps[max(at - 40, 0) : at + 1], speed_mps[at : at + 40]
    rest, motion = (after, before) if event == "IC" else (before, after)
    return bool(np.nanmin(rest) < 0.1 and np.nanmax(motion) > 0.5)


def bundled_cases() -> list[Case]:
    """Every foot of the bundled walks."""
    cases = []
    for name, recording, truth in trials(NAMES):
        for foot, track in recording.tracks.items():
            strides = truth.strides_of(foot)
            contacts = np.array([s.t_loading_response_s for s in strides])
            cases.append(Case(f"bundled {name}", track, contacts, np.array([s.t_swing_s for s in strides])))
    return cases
