"""What a recording holds once it is read: one track per sensor, in SI units, with what was wrong with it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fes.config import FootGeometry, Ground
from fes.signals import SENSORS, Event, FloatArray, ImuSample, IntArray

UNLABELLED_FEET = ("foot_a", "foot_b")  # fes calibrate finds which is left
PER_SAMPLE = ("t_ns", "t_sensor_ns", "acc_mps2", "gyr_radps")  # of a track


class RecordingError(ValueError):
    """A recording cannot be used; the message names the file, the place and what would be right."""


class SidecarMissingError(RecordingError):
    """A recording has no ``sidecar`` yet; the ``proposal`` is text to begin it with, and follows the message."""

    def __init__(self, message: str, sidecar: Path, proposal: str) -> None:
        super().__init__(f"{message}\n\n{proposal}")
        self.sidecar, self.proposal = sidecar, proposal


@dataclass(frozen=True, slots=True)
class TrackQuality:
    """How a sensor's samples came: counts, all 0 for a perfect track except ``samples``.

    Attributes:
        samples: samples in the track.
        missing: samples that should have come, from empty rows and from gaps of 1.5 or more usual intervals.
        doubled: samples stamped like the one before.
        backward: samples stamped earlier than the one before.
        irregular: intervals more than 50 % away from the usual (median) interval.
        clipped: samples with at least one axis at its range; 0 where the ranges are unknown.
        repaired: single wrong stamps that were put between their neighbours.
        late: samples left out at the end of the file, where the clock had gone back; they are not in the track.
    """

    samples: int = 0
    missing: int = 0
    doubled: int = 0
    backward: int = 0
    irregular: int = 0
    clipped: int = 0
    late: int = 0
    repaired: int = 0


@dataclass(frozen=True, eq=False)
class Track:
    """One sensor's samples in the order of the file, C-contiguous.

    Attributes:
        sensor: one of :data:`fes.signals.SENSORS`.
        rate_hz: the rate stated, or one over the usual (median) interval.
        t_ns: (N,) arrival, never decreasing.
        t_sensor_ns: (N,) as stamped; may stand still or go back.
        acc_mps2: (N, 3) specific force in the sensor's own frame.
        gyr_radps: (N, 3) angular rate in the sensor's own frame.
        acc_range_mps2: full scale (±) of the accelerometer, None if unknown.
        gyr_range_radps: full scale (±) of the gyroscope, None if unknown.
        quality: counts of what was wrong.
    """

    sensor: str
    rate_hz: float
    t_ns: IntArray
    t_sensor_ns: IntArray
    acc_mps2: FloatArray
    gyr_radps: FloatArray
    acc_range_mps2: float | None = None
    gyr_range_radps: float | None = None
    quality: TrackQuality = field(default_factory=TrackQuality)

    def __post_init__(self) -> None:
        times, vectors = (np.int64, (self.t_ns.size,)), (np.float64, (self.t_ns.size, 3))
        if self.sensor not in SENSORS + UNLABELLED_FEET:
            raise RecordingError(f"track {self.sensor!r}: a sensor is one of {', '.join(SENSORS)}")
        for name, (dtype, shape) in zip(PER_SAMPLE, (times, times, vectors, vectors), strict=True):
            array = getattr(self, name)
            if array.dtype != dtype or array.shape != shape:
                raise RecordingError(
                    f"track {self.sensor}: {name} is {array.dtype} {array.shape}, must be {np.dtype(dtype)} {shape}"
                )
            if not array.flags.c_contiguous:
                object.__setattr__(self, name, np.ascontiguousarray(array))

    def part(self, rows: slice) -> Track:
        """The same with these samples alone, as copies: the whole need not be kept for them."""
        return replace(self, **{name: getattr(self, name)[rows].copy() for name in PER_SAMPLE})

    def __repr__(self) -> str:
        return f"Track {self.sensor}: {len(self.t_ns)} samples, {self.duration_s:.1f} s at {self.rate_hz:g} Hz"

    @property
    def duration_s(self) -> float:
        """From the first to the last arrival."""
        return float(self.t_ns[-1] - self.t_ns[0]) * 1e-9 if self.t_ns.size else 0.0


@dataclass(frozen=True, eq=False)
class Recording:
    """One session's tracks and what its sidecar says.

    Attributes:
        name: for people; the file's stem unless the sidecar names it.
        path: the data file, None if the recording was made in memory.
        tracks: sensor name → track, in the order of :data:`fes.signals.SENSORS`.
        belt_speed_mps: the treadmill's belt, None over ground or unknown.
        geometry: foot sensor name → where toe and heel are.
        ground: level, an incline, or free.
        extra: whatever else the sidecar's ``[extra]`` holds; ``extra["mounting"]`` is sensor → mounting.
    """

    name: str
    path: Path | None
    tracks: dict[str, Track]
    belt_speed_mps: float | None = None
    subject: str = ""
    description: str = ""
    geometry: dict[str, FootGeometry] = field(default_factory=dict)
    extra: dict[str, Any] = field(default_factory=dict)
    ground: Ground = field(default_factory=Ground)

    def __repr__(self) -> str:
        tracks = "; ".join(
            f"{name} {each.duration_s:.1f} s at {each.rate_hz:g} Hz" for name, each in self.tracks.items()
        )
        return f"Recording {self.name}: {tracks or 'no sensor'}"

    def samples(self) -> Iterator[ImuSample]:
        """Yield all tracks' samples merged by arrival; on equal times sensors come in the order of SENSORS."""
        ordered = [self.tracks[sensor] for sensor in SENSORS + UNLABELLED_FEET if sensor in self.tracks]
        if not ordered:
            return
        t_ns = np.concatenate([track.t_ns for track in ordered])
        order = np.argsort(t_ns, kind="stable")
        which = np.repeat(np.arange(len(ordered)), [track.t_ns.size for track in ordered])[order]
        row = np.concatenate([np.arange(track.t_ns.size) for track in ordered])[order]
        # by blocks: lists are fast to walk, and a long recording as lists at once would fill the memory
        for start in range(0, order.size, 65536):
            yield from _block(ordered, which[start : start + 65536], row[start : start + 65536])


def _block(ordered: list[Track], which: IntArray, row: IntArray) -> Iterator[ImuSample]:
    """The samples of these tracks (by number) and rows."""
    size = which.size
    t_ns, t_sensor_ns = np.empty(size, np.int64), np.empty(size, np.int64)
    values = np.empty((size, 6))
    for number, track in enumerate(ordered):
        mine = which == number
        rows = row[mine]
        t_ns[mine], t_sensor_ns[mine] = track.t_ns[rows], track.t_sensor_ns[rows]
        values[mine, :3], values[mine, 3:] = track.acc_mps2[rows], track.gyr_radps[rows]
    names = [ordered[number].sensor for number in which.tolist()]
    for t, sensor, stamp, (ax, ay, az, gx, gy, gz) in zip(
        t_ns.tolist(), names, t_sensor_ns.tolist(), values.tolist(), strict=True
    ):
        yield ImuSample(t, sensor, stamp, (ax, ay, az), (gx, gy, gz))


def increasing(track: Track) -> npt.NDArray[np.bool_]:
    """Which samples (N,) are newer than all before them: what is left without doubled and backward stamps."""
    before = np.maximum.accumulate(track.t_sensor_ns)[:-1]
    return np.concatenate(([True], track.t_sensor_ns[1:] > before))


def newer_samples(track: Track) -> tuple[IntArray, FloatArray, FloatArray]:
    """Stamps (N,), specific force and rate (N, 3) of the samples that are newer than all before them."""
    if (track.t_sensor_ns[1:] > track.t_sensor_ns[:-1]).all():  # the usual case; nothing to copy
        return track.t_sensor_ns, track.acc_mps2, track.gyr_radps
    newer = increasing(track)
    return track.t_sensor_ns[newer], track.acc_mps2[newer], track.gyr_radps[newer]


def samples_of(recording: Recording, sensors: set[str]) -> Iterator[Event]:
    """The recording's samples of these sensors, in order of arrival."""
    return (sample for sample in recording.samples() if sample.sensor in sensors)
