"""The recordings that ``zero_velocity.py`` measures on, with stride borders given by the sets themselves."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.io import loadmat

from benchmarks.lib.real_sets import (
    FootprintWalk,
    PathWalk,
    gaitmap_walk,
    pyshoe_vicon,
    ruler_walks,
    stroke_feet,
    track_of,
)
from fes.recording import Track
from fes.signals import FloatArray, IntArray

BoolArray = npt.NDArray[np.bool_]

GLITCH_MPS = 8.0  # faster than this the optical system has lost its marker
SPEED_OVER_S = 0.025
DISPUTED_M = 0.08  # where the set's own trajectory departs further from the ruler, one of them is wrong
STRAIGHT_M = 0.6  # shorter ones are turns


@dataclass(frozen=True)
class BorderedWalk:
    """A track with strides between given instants: borders (M,) in ns, true lengths (M,) in m.

    ``disputed`` (M,) marks strides whose reference the set itself contradicts. ``speed_mps`` (N,) is the optical speed,
    NaN where it is not to be believed, empty where there is none.
    """

    data_set: str
    name: str
    track: Track
    begin_ns: IntArray
    end_ns: IntArray
    length_m: FloatArray
    disputed: BoolArray
    speed_mps: FloatArray = field(default_factory=lambda: np.zeros(0))


def _instants(samples: npt.ArrayLike, rate_hz: float) -> IntArray:
    return np.rint(np.asarray(samples, dtype=float) * (1e9 / rate_hz)).astype(np.int64)


def optical_speed(position_m: FloatArray, rate_hz: float) -> FloatArray:
    """Speed (N,) in m/s of positions (N, 3) in m, over 25 ms; NaN around glitches."""
    width = max(round(SPEED_OVER_S * rate_hz), 1)
    velocity = np.gradient(position_m, axis=0) * rate_hz
    smooth = [np.convolve(velocity[:, j], np.full(width, 1.0 / width), "same") for j in range(3)]
    speed = np.linalg.norm(smooth, axis=0)
    jump = np.linalg.norm(np.diff(position_m, axis=0, prepend=position_m[:1]), axis=1) * rate_hz > GLITCH_MPS
    speed[np.convolve(jump, np.ones(width + 2), "same") > 0.0] = np.nan
    return np.asarray(speed)


def pyshoe(folder: Path) -> list[BorderedWalk]:
    """Nine healthy walks before a Vicon, right instep, 200 Hz."""
    walks = []
    for walk in pyshoe_vicon(folder):
        assert isinstance(walk, PathWalk)
        strides = folder / "pyshoe_vicon" / "strides" / f"{walk.name}_strideIndex_timestamp_gcpX_gcpY.csv"
        at = np.loadtxt(strides, delimiter=",", skiprows=1)[:, 0].astype(int)
        lengths = np.hypot(*np.diff(walk.position_m[at, :2], axis=0).T)
        stamps = _instants(at, walk.rate_hz)
        speed = optical_speed(walk.position_m, walk.rate_hz)
        sure = np.zeros(len(lengths), bool)
        walks.append(BorderedWalk(walk.data_set, walk.name, walk.track, stamps[:-1], stamps[1:], lengths, sure, speed))
    return walks


def ruler(folder: Path) -> list[BorderedWalk]:
    """Four walks with every footprint measured by ruler, 200 Hz."""
    walks = []
    for walk in ruler_walks(folder):
        assert isinstance(walk, FootprintWalk)
        own = loadmat(folder / "ruler_walks" / f"{walk.name}.mat")["pyshoeTrajectory"][walk.index]
        lengths = np.hypot(*np.diff(walk.place_m, axis=0).T)
        disputed = np.abs(np.hypot(*np.diff(own, axis=0).T) - lengths) > DISPUTED_M
        stamps = _instants(walk.index, walk.track.rate_hz)
        walks.append(BorderedWalk(walk.data_set, walk.name, walk.track, stamps[:-1], stamps[1:], lengths, disputed))
    return walks


def gaitmap(folder: Path) -> list[BorderedWalk]:
    """One healthy adult, both shoes, 204.8 Hz, reference borders, length by the heel marker; straight strides."""
    walks = []
    for walk in gaitmap_walk(folder):
        assert isinstance(walk, PathWalk)
        with (folder / "gaitmap_walk" / "stride_events_sample.csv").open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["foot"] == walk.name]
        borders = np.array([(float(row["start"]), float(row["end"])) for row in rows]) / walk.track.rate_hz
        seconds = np.arange(len(walk.position_m)) / walk.rate_hz
        begin, end = (
            np.array([np.interp(side, seconds, walk.position_m[:, j]) for j in range(2)]) for side in borders.T
        )
        lengths = np.hypot(*(end - begin))
        straight = lengths > STRAIGHT_M
        stamps = _instants(borders[straight], 1.0)
        sure = np.zeros(int(straight.sum()), bool)
        walks.append(
            BorderedWalk(walk.data_set, walk.name, walk.track, stamps[:, 0], stamps[:, 1], lengths[straight], sure)
        )
    return walks


def stroke(folder: Path) -> list[tuple[str, Track, float]]:
    """Feet of stroke survivors on a belt of known speed (m/s), 100 Hz."""
    return [(f"{run} {track.sensor}", track, belt_mps) for run, track, belt_mps in stroke_feet(folder)]


def xio(folder: Path) -> Track | None:
    """A walk of about 25 m that ends where it began, 400 Hz nominal; doubled stamps dropped, put on a regular grid."""
    path = folder / "xio_walk" / "short_walk.csv"
    if not path.is_file():
        return None
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    _, first = np.unique(table[:, 0], return_index=True)
    table = table[first]
    grid = np.arange(table[0, 0], table[-1, 0], 1.0 / 400.0)
    columns = np.column_stack([np.interp(grid, table[:, 0], table[:, k]) for k in range(1, 7)])
    return track_of("right_foot", 400.0, columns[:, 3:] * 9.81, np.radians(columns[:, :3]))
