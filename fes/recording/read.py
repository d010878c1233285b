"""A recording's files → tracks in SI units, every check passed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fes.recording.plausible import check_units
from fes.recording.raw import RawTrack, read_table
from fes.recording.sidecar import Sensor, Sidecar, load_sidecar
from fes.recording.template import sidecar_template
from fes.recording.timebase import MIN_DURATION_S, judge_stamps
from fes.recording.tracks import (
    UNLABELLED_FEET,
    Recording,
    RecordingError,
    SidecarMissingError,
    Track,
    TrackQuality,
)
from fes.signals import SENSORS

TABLE_SUFFIXES = (".csv", ".parquet")
CAN_SUFFIXES = (".asc", ".blf", ".log")
CLIPPED_FROM = 0.999  # share of full scale: the last count may be one short of it


def read_recording(path: Path) -> Recording:
    """Read a CSV or Parquet file or a CAN log with the sidecar (``.toml``) of the same name.

    Raises:
        RecordingError: a file is missing or damaged, the sidecar does not fit it, or the numbers cannot be what the
            sidecar says; the message names the file, the place and the fix.
        SidecarMissingError: there is no sidecar; the error holds a proposal.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in TABLE_SUFFIXES + CAN_SUFFIXES:
        raise RecordingError(
            f"{path}: is none of the formats read here ({', '.join(TABLE_SUFFIXES + CAN_SUFFIXES)}). "
            f"Name the data file, not its sidecar."
        )
    if not path.is_file():
        raise RecordingError(f"{path}: {'is a folder' if path.is_dir() else 'is not there'}. Name a recording's file.")
    sidecar_path = path.with_suffix(".toml")
    empty = sidecar_path.is_file() and sidecar_path.stat().st_size == 0
    if empty or not sidecar_path.exists():
        raise SidecarMissingError(
            f"{sidecar_path}: is {'empty' if empty else 'missing'}. This sidecar says what {path.name} holds. "
            f"Save the following under that name and answer what is marked with “?”:",
            sidecar_path,
            sidecar_template(path),
        )
    sidecar = load_sidecar(sidecar_path)
    if suffix in CAN_SUFFIXES:
        from fes.recording.can_log import read_can_log

        raw = read_can_log(path, sidecar_path, sidecar)
    else:
        raw = read_table(path, sidecar_path, sidecar)
    tracks = {
        sensor: _track(path, sidecar, sensor, raw[sensor]) for sensor in SENSORS + UNLABELLED_FEET if sensor in raw
    }
    _check_overlap(path, tracks)
    extra = dict(sidecar.extra)
    mounting = {sensor: columns.mounting for sensor, columns in sidecar.sensors.items() if columns.mounting}
    if mounting:
        extra["mounting"] = {sensor: value.model_dump(exclude_defaults=True) for sensor, value in mounting.items()}
    return Recording(
        sidecar.name or path.stem,
        path,
        tracks,
        sidecar.belt_speed_mps,
        sidecar.subject,
        sidecar.description,
        dict(sidecar.geometry.items()),
        extra,
    )


def _track(path: Path, sidecar: Sidecar, sensor: str, raw: RawTrack) -> Track:
    name: Sensor = next(key for key in sidecar.sensors if key == sensor)
    columns = sidecar.sensors[name]
    where = f"{path.with_name(columns.file) if columns.file else path}: {sensor}"
    timing = judge_stamps(raw.stamps_ns, sidecar.rate_of(name), where, raw.place, sidecar.time_unit_of(name))
    span_s = float(raw.t_sensor_ns.max() - raw.t_sensor_ns.min()) * 1e-9
    if span_s + 1.0 / timing.rate_hz < MIN_DURATION_S:
        raise RecordingError(f"{where}: lasts {span_s:.3f} s; a recording needs at least {MIN_DURATION_S:g} s")
    factors = sidecar.factors_of(name)
    check_units(where, raw.acc, raw.gyr, timing.rate_hz, sidecar.acc_unit_of(name), sidecar.gyr_unit_of(name), factors)
    acc, gyr = (values if by == 1.0 else values * by for values, by in zip((raw.acc, raw.gyr), factors, strict=True))
    clipped = np.zeros(len(acc), bool)
    for values, full_scale in ((acc, columns.acc_range), (gyr, columns.gyr_range)):
        if full_scale is not None:
            clipped |= (np.abs(values) >= CLIPPED_FROM * full_scale).any(axis=1)
    quality = TrackQuality(
        samples=len(acc),
        missing=timing.missing + raw.stamps_ns.size - raw.t_sensor_ns.size,
        doubled=timing.doubled,
        backward=timing.backward,
        irregular=timing.irregular,
        clipped=int(clipped.sum()),
    )
    arrival = np.maximum.accumulate(raw.t_sensor_ns if raw.t_arrival_ns is None else raw.t_arrival_ns)
    return Track(
        sensor, timing.rate_hz, arrival, raw.t_sensor_ns, acc, gyr, columns.acc_range, columns.gyr_range, quality
    )


def _check_overlap(path: Path, tracks: dict[str, Track]) -> None:
    """Sensors with own clocks must share an origin, or one foot would walk after the other."""
    last_start = max(tracks.values(), key=lambda track: int(track.t_ns[0]))
    first_end = min(tracks.values(), key=lambda track: int(track.t_ns[-1]))
    gap_s = float(last_start.t_ns[0] - first_end.t_ns[-1]) * 1e-9
    if gap_s > 0:
        raise RecordingError(
            f"{path}: {first_end.sensor} ends {gap_s:.3f} s before {last_start.sensor} starts: their clocks have "
            f"different origins. Subtract each sensor's start, or synchronise the sensors; or say rate_hz instead of "
            f"time_column, which lets all begin at once, and set one foot's clock by the walk (fes analyse --apart)."
        )
