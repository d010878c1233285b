"""A recording's files → tracks in SI units, every check passed."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from fes.recording.can_log import CAN_SUFFIXES, read_can_log
from fes.recording.containers import container_of
from fes.recording.csv_layout import has_rows
from fes.recording.raw import MIN_DURATION_S, RATE_TOLERANCE, RawTrack, judge_stamps, late_block, read_parts, read_table
from fes.recording.several_files import is_zip
from fes.recording.sidecar import SensorColumns, Sidecar, load_sidecar
from fes.recording.table import TABLE_SUFFIXES, is_parquet, parquet_rows
from fes.recording.template import sidecar_template
from fes.recording.tracks import UNLABELLED_FEET, Recording, RecordingError, SidecarMissingError, Track, TrackQuality
from fes.recording.units import check_units
from fes.signals import NS_PER_S, SENSORS

FIRST_ROWS = 32_768  # these tell the rate
Judged = dict[tuple[int, float | None], tuple[float, TrackQuality]]  # by which stamps and stated rate
CLIPPED_FROM = 0.999  # share of full scale: the last count may be one short of it


def read_recording(path: Path) -> Recording:
    """Read a CSV or Parquet file or a CAN log with the sidecar (``.toml``) of the same name.

    Raises:
        RecordingError: a file is missing or damaged, the sidecar does not fit it, or the numbers cannot be what the
            sidecar says; the message names the file, the place and the fix.
        SidecarMissingError: there is no sidecar; the error holds a proposal.
    """
    path, sidecar_path, sidecar = _described(path)
    if path.suffix.lower() in CAN_SUFFIXES:
        raw = read_can_log(path, sidecar_path, sidecar)
    else:
        raw = read_table(path, sidecar_path, sidecar)
    return _recording(path, sidecar, tracks_of(path, sidecar, raw))


def follow_recording(path: Path, part_s: float, whole_s: float = 0.0) -> Iterator[Recording]:
    """As :func:`read_recording`, in parts of equal length that follow each other, of ``part_s`` at most.

    A recording of no more than ``whole_s`` is one part; so is all but Parquet whose sensors share one time column, or
    have none. ``quality`` is each part's own.

    Raises:
        RecordingError: as there.
    """
    path, sidecar_path, sidecar = _described(path)
    rows = _part_rows(path, sidecar_path, sidecar, part_s, whole_s)
    if not rows:
        yield read_recording(path)
        return
    before: dict[str, Track] = {}
    for raw in read_parts(path, sidecar_path, sidecar, rows):
        recording = _recording(path, sidecar, tracks_of(path, sidecar, raw, before))
        for name, track in recording.tracks.items():
            newest = int(np.argmax(track.t_sensor_ns))
            before[name] = replace(track.part(slice(newest, newest + 1)), t_ns=track.t_ns[-1:].copy())
        raw.clear()  # the file's columns need not stay while the part is worked on
        if recording.tracks:
            yield recording
        del recording


def _part_rows(path: Path, sidecar_path: Path, sidecar: Sidecar, part_s: float, whole_s: float) -> int:
    """How many rows make a part; 0 where all is one, or has to be read at once."""
    columns = [sidecar.columns_of(sensor) for sensor in sidecar.sensors]
    if not is_parquet(path) or sidecar.can is not None or any(each.file or each.gyr_file for each in columns):
        return 0
    if len({(each.time_column, each.time_unit) for each in columns}) > 1:
        return 0
    if any(each.time_wraps_at for each in columns):  # how often it has wrapped, only the whole tells
        return 0
    rows = parquet_rows(path)
    if rows <= FIRST_ROWS:
        return 0
    first_rows = next(read_parts(path, sidecar_path, sidecar, FIRST_ROWS), {})
    steps = {name: np.diff(raw.t_sensor_ns) for name, raw in first_rows.items()}
    rates = [NS_PER_S / float(np.median(each[each > 0])) for each in steps.values() if (each > 0).any()]
    if not rates or max(rates) > (1.0 + RATE_TOLERANCE) * min(rates):
        return 0
    parts = math.ceil(rows / (part_s * max(rates))) if rows > whole_s * max(rates) else 1
    return math.ceil(rows / parts) if parts > 1 else 0


def _described(path: Path) -> tuple[Path, Path, Sidecar]:
    """A recording's file, its sidecar's path and what that says."""
    path = Path(path)
    formats = (
        f"{', '.join(TABLE_SUFFIXES + CAN_SUFFIXES)}, .xdf, .h5, a phone's .zip or folder, or text with rows of "
        "numbers under any other name"
    )
    if not path.exists() or not (path.is_file() or path.is_dir()):
        raise RecordingError(f"{path}: is {'no file' if path.exists() else 'not there'}. Name a recording: {formats}.")
    suffix = path.suffix.lower()
    several = path.is_dir() or is_zip(path)
    if suffix == ".toml" or not (
        several or suffix in TABLE_SUFFIXES + CAN_SUFFIXES or is_parquet(path) or container_of(path) or has_rows(path)
    ):
        raise RecordingError(
            f"{path}: is none of the formats read here ({formats}). Name the data file, not its sidecar."
        )
    sidecar_path = path.with_suffix(".toml")
    if path.is_dir():  # a point in its name begins no suffix
        path = path if path.name.strip(".") else path.resolve()
        sidecar_path = path.with_name(f"{path.name}.toml")
    empty = sidecar_path.is_file() and sidecar_path.stat().st_size == 0
    if empty or not sidecar_path.exists():
        raise SidecarMissingError(
            f"{sidecar_path}: is {'empty' if empty else 'missing'}. This sidecar says what {path.name} holds. "
            f"Save the following under that name and answer what is marked with “?”:",
            sidecar_path,
            sidecar_template(path),
        )
    return path, sidecar_path, load_sidecar(sidecar_path)


def tracks_of(
    path: Path, sidecar: Sidecar, raw: Mapping[str, RawTrack], before: Mapping[str, Track] | None = None
) -> dict[str, Track]:
    """Tracks of what was read, judged; ``before``: where each ended in the part before.

    Raises:
        RecordingError: as of :func:`read_recording`.
    """
    before = before or {}
    described = {str(sensor): sidecar.columns_of(sensor) for sensor in sidecar.sensors}
    judged: Judged = {}
    tracks = {
        sensor: _track(path, sensor, described[sensor], raw[sensor], judged, before.get(sensor))
        for sensor in SENSORS + UNLABELLED_FEET
        if sensor in raw
    }
    if tracks:  # sensors with own clocks must share an origin, or one foot would walk after the other
        last_start = max(tracks.values(), key=lambda track: int(track.t_ns[0]))
        first_end = min(tracks.values(), key=lambda track: int(track.t_ns[-1]))
        gap_s = float(last_start.t_ns[0] - first_end.t_ns[-1]) * 1e-9
        if gap_s > 0:
            raise RecordingError(
                f"{path}: {first_end.sensor} ends {gap_s:.3f} s before {last_start.sensor} starts: their clocks have "
                f"different origins. Subtract each sensor's start, or synchronise the sensors; or say rate_hz instead "
                f"of time_column, which lets all begin at once, and set one foot's clock by the walk "
                f"(fes analyse --sync-clocks)."
            )
    return tracks


def _recording(path: Path, sidecar: Sidecar, tracks: dict[str, Track]) -> Recording:
    extra = dict(sidecar.extra)
    mounting = {sensor: columns.mounting for sensor, columns in sidecar.sensors.items() if columns.mounting}
    if mounting:
        extra["mounting"] = {sensor: value.model_dump(exclude_defaults=True) for sensor, value in mounting.items()}
    about = sidecar.belt_speed_mps, sidecar.subject, sidecar.description
    return Recording(
        sidecar.name or path.stem, path, tracks, *about, dict(sidecar.geometry.items()), extra, sidecar.ground
    )


def _track(
    path: Path, sensor: str, columns: SensorColumns, raw: RawTrack, judged: Judged, before: Track | None
) -> Track:
    """``judged``: what was found of the sensors before; feet often share stamps and rate."""
    where = f"{path.with_name(columns.file) if columns.file else path}: {sensor}"
    raw, late = _without_late_block(raw)
    stamps_ns, place = raw.stamps_ns, raw.place
    if before is not None:
        stamps_ns = np.append(before.t_sensor_ns, stamps_ns)
        place = lambda index: raw.place(max(index - 1, 0))  # noqa: E731
    same = id(stamps_ns), columns.rate_hz
    if before is not None or late or same not in judged:
        rate_hz, found = judge_stamps(stamps_ns, columns.rate_hz, where, place, columns.time_unit or "s")
        if before is None and not late:  # else the stamps are of its own, and live no longer than this
            judged[same] = rate_hz, found
    else:
        rate_hz, found = judged[same]
    newest_ns = np.maximum.accumulate(raw.t_sensor_ns) if found.backward else raw.t_sensor_ns
    oldest_ns = raw.t_sensor_ns.min() if found.backward else raw.t_sensor_ns[0]
    span_s = float(newest_ns[-1] - oldest_ns) * 1e-9
    if span_s + 1.0 / rate_hz < MIN_DURATION_S:
        raise RecordingError(f"{where}: lasts {span_s:.3f} s; a recording needs at least {MIN_DURATION_S:g} s")
    if before is None:  # a quarter of an hour on a bicycle has no instant at which a foot feels gravity alone
        check_units(where, raw.acc, raw.gyr, rate_hz, columns.acc_unit or "m/s^2", columns.gyr_unit or "rad/s")
    factors = columns.factors
    acc, gyr = (values if by == 1.0 else values * by for values, by in zip((raw.acc, raw.gyr), factors, strict=True))
    clipped = np.zeros(len(acc), bool)
    ranges = columns.acc_range, columns.gyr_range
    for values, size, factor, full_scale in zip((acc, gyr), raw.greatest, factors, ranges, strict=True):
        bound = math.inf if full_scale is None else CLIPPED_FROM * full_scale
        if size * abs(factor) >= bound:
            clipped |= (np.abs(values) >= bound).any(axis=1)
    missing = found.missing + raw.stamps_ns.size - raw.t_sensor_ns.size
    quality = replace(
        found,
        samples=len(acc),
        missing=missing,
        clipped=int(np.count_nonzero(clipped)),
        late=late,
        repaired=raw.repaired,
    )
    arrival = newest_ns if raw.t_arrival_ns is None else np.maximum.accumulate(raw.t_arrival_ns)
    if before is not None:
        arrival, rate_hz = np.maximum(arrival, before.t_ns), before.rate_hz
    return Track(sensor, rate_hz, arrival, raw.t_sensor_ns, acc, gyr, columns.acc_range, columns.gyr_range, quality)


def _without_late_block(raw: RawTrack) -> tuple[RawTrack, int]:
    """The samples before the clock has gone back near the end, and how many are left out."""
    end = late_block(raw.stamps_ns)
    if end == raw.stamps_ns.size:
        return raw, 0
    kept = late_block(raw.t_sensor_ns)
    arrival_ns = None if raw.t_arrival_ns is None else raw.t_arrival_ns[:kept]
    return replace(
        raw,
        t_sensor_ns=raw.t_sensor_ns[:kept],
        t_arrival_ns=arrival_ns,
        acc=raw.acc[:kept],
        gyr=raw.gyr[:kept],
        stamps_ns=raw.stamps_ns[:end],
    ), raw.t_sensor_ns.size - kept
