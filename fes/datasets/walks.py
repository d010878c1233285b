"""Public data sets: MATLAB and HDF5 files, NumPy archives and CSV tables into recordings and references.

pyshoe: right instep at 200 Hz, z axis down, the marker's position by Vicon at every sample; a file by trial, or
``processed_data.mat`` in a folder of that name. Where the marker would be faster than 8 m/s it is left empty.

ruler: one foot (which is not documented) at 200 Hz, ``SensorConnectData_N_LLIO.mat``; beside it the table of
footprints, with the sample at which the foot stood on each.

footswitch_treadmill, ``Hnn_k.npz`` and ``Pnn_k.npz``: one instep (side not told), labels by footswitches at every
sample: 0 heel strike until flat, 1 flat foot, 2 heel off, 3 swing. The stamps are those of arrival, with stalls that
are followed by bursts, and some real gaps. Rows that no sensor can have measured (spikes) are left out. ``bad`` marks
spikes and gaps; whatever phase has such a row is not ``judged``.

stroke_walks, ``Snn.npz``: both feet, each by its own clock, which may go back near the end; ranges as its authors say.

gaitmap's example data: ``imu_sample.csv`` (deg/s; clipped at 16 g) with markers (mm, 100 Hz, from the first IMU sample
on) and events (IMU samples) beside it, and walks on stairs without truth.

xio: an NGIMU on a foot, nominally 400 Hz, g and deg/s, with irregular and partly doubled stamps; doubled rows are left
out. The walk ends where it starts; there is no other truth.

broad: a board moved by hand, 285.7 Hz, with optical orientation (w, x, y, z, sensor → east-north-up; empty where it was
not seen) and position. Not gait: it is written as the sensor ``right_foot``, for a recording has no other names.
"""

import csv
import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.datasets.common import (
    Imported,
    ImportProblem,
    checked,
    even_track,
    mat_file,
    need,
    npz_file,
    plain_csv,
    stamped_track,
    two_header_csv,
)
from fes.recording import Recording, Track
from fes.signals import G_MPS2, FloatArray

RATE_HZ: Final = 200.0
FASTEST_MPS: Final = 8.0
GYR_RANGE_RADPS: Final = 9.7


def read_pyshoe(path: Path, foot: str | None = None) -> Imported:
    """Read one walk. Raises ImportProblem: it is no such file."""
    data = mat_file(path, "imu", "gt")
    imu, place = np.asarray(data["imu"], np.float64), np.asarray(data["gt"], np.float64)
    if imu.ndim != 2 or imu.shape[1] != 6 or place.shape != (len(imu), 3):
        raise ImportProblem(f"{path}: imu is {imu.shape} and gt {place.shape}, must be (N, 6) and (N, 3)")
    checked(path, imu[:, :3], imu[:, 3:])
    sensor = f"{foot or 'right'}_foot"
    speed = np.linalg.norm(np.diff(place, axis=0), axis=1) * RATE_HZ
    jumps = np.flatnonzero(speed > FASTEST_MPS)
    place = place.copy()
    place[np.union1d(jumps, jumps + 1)] = np.nan
    names = ["t_s", *(f"{foot or 'right'}_sensor_{axis}_m" for axis in "xyz")]
    rows = np.column_stack([np.arange(len(place)) / RATE_HZ, place]).tolist()
    notes = (
        "z of the sensor points down",
        "taken as even at 200 Hz; the stamps in the file are those of arrival",
        f"{len(jumps)} jumps of the Vicon reference above 8 m/s were left empty",
        "the gyroscope clips near 9.7 rad/s; the marker is near the sensor, not at it",
    )
    trial = path.parent.name if path.stem == "processed_data" else path.stem
    track = replace(even_track(sensor, RATE_HZ, imu[:, :3], imu[:, 3:]), gyr_range_radps=GYR_RANGE_RADPS)
    return Imported(Recording(f"pyshoe_{trial}", None, {sensor: track}), {".path.csv": (names, rows)}, notes)


def read_ruler(path: Path, foot: str | None = None) -> Imported:
    """Read one walk. Raises ImportProblem: it is no such file."""
    imu = np.asarray(mat_file(path, "imu_data")["imu_data"], np.float64)
    if imu.ndim != 2 or imu.shape[1] != 6:
        raise ImportProblem(f"{path}: imu_data is {imu.shape}, must be (N, 6)")
    checked(path, imu[:, :3], imu[:, 3:])
    sensor = f"{foot or 'right'}_foot"
    name = path.stem.removesuffix("_LLIO")
    table = path.with_name(f"{name}_strideIndex_timestamp_gcpX_gcpY.csv")
    references: dict[str, Any] = {}
    if table.is_file():
        references[".strides.csv"] = _strides(table, sensor, len(imu))
    notes = (
        "z of the sensor points down; the sign of the mediolateral rate differs between walks",
        f"which foot is not documented: taken for the {sensor.replace('_', ' ')}",
        "in turns the foot swivels, and what the sensor travels is not the way between footprints",
    )
    number = name.removeprefix("SensorConnectData_")
    track = even_track(sensor, RATE_HZ, imu[:, :3], imu[:, 3:])
    return Imported(Recording(f"ruler_{number}", None, {sensor: track}), references, notes)


def _strides(path: Path, sensor: str, samples: int) -> tuple[list[str], list[tuple[Any, ...]]]:
    names, values = plain_csv(path)
    try:
        index, x, y = (values[:, names.index(name)] for name in ("strideIndex", "gcpX", "gcpY"))
    except ValueError as error:
        raise ImportProblem(f"{path}: lacks strideIndex, gcpX or gcpY; it has {', '.join(names)}") from error
    if not np.isfinite(values).all() or (np.diff(index) <= 0).any() or index[0] < 0 or index[-1] >= samples + 1:
        raise ImportProblem(f"{path}: its strideIndex must increase and lie within the recording's {samples} samples")
    place = np.column_stack([x, y])
    rows = [
        (sensor, index[a] / RATE_HZ, index[b] / RATE_HZ, float(np.hypot(*(place[b] - place[a]))))
        for a, b in pairwise(range(len(index)))
    ]
    return ["foot", "t_start_s", "t_end_s", "stride_length_m"], rows


PHASES: Final = ("loading_response", "stance", "pre_swing", "swing")  # by the switches' label
MOST_MPS2, MOST_RADPS = 400.0, 40.0  # more than a foot can do: a spike


def read_footswitch_treadmill(path: Path, foot: str | None = None) -> Imported:
    """Read one trial. Raises ImportProblem: it is no such file."""
    data, meta = _archive(path, "foot_t_s", "foot_acc", "foot_gyr", "label", "bad")
    sensor = f"{foot or 'right'}_foot"
    track, spikes = _track(path, sensor, data, "foot")
    t_s, label, bad = data["foot_t_s"] - data["foot_t_s"][0], data["label"].astype(int), data["bad"].astype(bool)
    if label.shape != t_s.shape or bad.shape != t_s.shape or not np.isin(label, range(len(PHASES))).all():
        raise ImportProblem(f"{path}: its labels must be {len(t_s)} of 0 to {len(PHASES) - 1}")
    cuts = np.flatnonzero(np.diff(label)) + 1
    begins, ends = np.append(0, cuts), np.append(cuts, len(label) - 1)
    phases = [
        (sensor, t_s[a], t_s[b], PHASES[label[a]], int(not bad[a : b + 1].any()))
        for a, b in zip(begins.tolist(), ends.tolist(), strict=True)
    ]
    swings = [k for k, (*_, phase, judged) in enumerate(phases) if phase == PHASES[3] and judged]
    events = [(sensor, "FO", phases[k][1]) for k in swings if k > 0]
    events += [(sensor, "IC", phases[k + 1][1]) for k in swings if k + 1 < len(phases)]
    notes = [
        f"which foot is not told: taken for the {sensor.replace('_', ' ')}",
        "stamps are those of arrival, with stalls of seconds and bursts after them: judge nothing there",
        "phases by footswitches, which have delays of their own: .phases.csv (judged 0: a spike or a gap is in it)",
        *([f"{spikes} rows that no sensor can have measured were left out"] if spikes else []),
        *([str(meta["note"])] if meta.get("note") else []),
    ]
    references: dict[str, Any] = {
        ".events.csv": (["foot", "event", "t_s"], sorted(events, key=lambda event: event[2])),
        ".phases.csv": (["foot", "t_start_s", "t_end_s", "phase", "judged"], phases),
    }
    recording = Recording(
        f"footswitch_treadmill_{path.stem}", None, {sensor: track}, subject=str(meta.get("person", path.stem)),
        extra={"group": str(meta.get("group", "")), "surface": "treadmill"},
    )  # fmt: skip
    return Imported(recording, references, tuple(notes))


def read_stroke_walks(path: Path, foot: str | None = None) -> Imported:
    """Read one walk. Raises ImportProblem: it is no such file."""
    sides = ("left", "right")
    data, meta = _archive(path, *(f"{side}_{kind}" for side in sides for kind in ("t_s", "acc", "gyr")))
    rate_hz = _number(path, meta, "rate_hz")
    ranges = _number(path, meta, "acc_range_g") * G_MPS2, float(np.radians(_number(path, meta, "gyr_range_degps")))
    tracks = {f"{side}_foot": _track(path, f"{side}_foot", data, side, rate_hz, *ranges)[0] for side in sides}
    extra = {"group": str(meta.get("group", "")), "aid": bool(meta.get("aid")), "surface": "floor, with turns"}
    notes = ["each foot has its own clock: set them by the walk with --sync-clocks", "there is no reference"]
    for sensor, track in tracks.items():
        if back := int(np.count_nonzero(np.diff(track.t_sensor_ns) < 0)):
            notes.append(f"{sensor}: the clock goes back {back} times, as recorded")
    recording = Recording(f"stroke_walks_{path.stem}", None, tracks, subject=path.stem, extra=extra)
    return Imported(recording, {}, tuple(notes))


def _archive(path: Path, *needed: str) -> tuple[dict[str, FloatArray], dict[str, Any]]:
    """The arrays and what ``meta`` says."""
    data = npz_file(path, "meta", *needed)
    try:
        meta = json.loads(str(data.pop("meta")))
    except ValueError as error:
        raise ImportProblem(f"{path}: its meta is no JSON: {error}") from error
    if not isinstance(meta, dict):
        raise ImportProblem(f"{path}: its meta is {type(meta).__name__}, must be a table of names")
    return data, meta


def _number(path: Path, meta: dict[str, Any], name: str) -> float:
    value = meta.get(name)
    if not isinstance(value, (int, float)) or not 0.0 < value < 10_000.0:
        raise ImportProblem(f"{path}: its meta says {name} = {value!r}, must be a number above 0")
    return float(value)


def _track(
    path: Path, sensor: str, data: dict[str, FloatArray], prefix: str, rate_hz: float | None = None,
    acc_range_mps2: float | None = None, gyr_range_radps: float | None = None,
) -> tuple[Track, int]:  # fmt: skip
    """One sensor's samples by their own stamps, without spikes, and how many of these there were.

    ``rate_hz`` None: the mean of the stamps.
    """
    t_s, acc, gyr = (np.asarray(data[f"{prefix}_{kind}"], np.float64) for kind in ("t_s", "acc", "gyr"))
    checked(path, acc, gyr)
    if t_s.shape != (len(acc),) or not np.isfinite(t_s).all():
        raise ImportProblem(f"{path}: {prefix}_t_s must be {len(acc)} times in s")
    sound = (np.abs(acc).max(axis=1) < MOST_MPS2) & (np.abs(gyr).max(axis=1) < MOST_RADPS)
    sound[0] = True  # the references count from the first stamp
    t_ns = np.round(1e9 * (t_s[sound] - t_s[0])).astype(np.int64)
    rate_hz = rate_hz or (len(t_ns) - 1) * 1e9 / float(np.ptp(t_ns))
    track = stamped_track(sensor, rate_hz, t_ns, acc[sound], gyr[sound], acc_range_mps2, gyr_range_radps)
    return track, int(np.count_nonzero(~sound))


GAITMAP_HZ: Final = 204.8
MARKER_HZ: Final = 100.0
POINTS: Final = {"heel": "FCC", "toe": "TOE"}


def read_gaitmap(path: Path, foot: str | None = None) -> Imported:
    """Read one IMU table and what lies beside it. Raises ImportProblem: it is no such table."""
    columns = two_header_csv(path)
    tracks = {}
    for side in ("left", "right"):
        try:
            acc, gyr = (
                np.column_stack([columns[f"{side}_sensor", f"{kind}_{axis}"] for axis in "xyz"])
                for kind in ("acc", "gyr")
            )
        except KeyError as error:
            raise ImportProblem(f"{path}: lacks the column {error.args[0]}; is it gaitmap's imu_sample.csv?") from error
        checked(path, acc, gyr)
        name = f"{side}_foot"
        tracks[name] = replace(even_track(name, GAITMAP_HZ, acc, np.radians(gyr)), acc_range_mps2=16.0 * G_MPS2)
    stairs = "stair" in path.stem
    references: dict[str, Any] = {}
    if not stairs:
        mocap, events = (path.with_name(name) for name in ("mocap_sample.csv", "stride_events_sample.csv"))
        if mocap.is_file():
            references[".path.csv"] = _markers(mocap)
        if events.is_file():
            references[".events.csv"] = _events(events)
    notes = ["the accelerometer clips at 16 g at heel strike", "the sensors are tilted by about 15 degrees about x"]
    turns = "the reference joins two steps in a turn to one stride"
    notes.append("stairs, without truth: use --stairs" if stairs else turns)
    recording = Recording(f"gaitmap_{path.stem}", None, tracks, description="lateral shoe sensors, over ground")
    return Imported(recording, references, tuple(notes))


def _markers(path: Path) -> tuple[list[str], list[list[float]]]:
    columns = two_header_csv(path)
    names, parts = ["t_s"], [np.arange(len(next(iter(columns.values())))) / MARKER_HZ]
    for side in ("left", "right"):
        for point, label in POINTS.items():
            for axis in "xyz":
                marker = (f"{side[0].upper()}_{label}", axis)
                if marker not in columns:
                    raise ImportProblem(f"{path}: lacks the marker {marker[0]}, axis {axis}")
                names.append(f"{side}_{point}_{axis}_m")
                parts.append(1e-3 * columns[marker])
    rows: FloatArray = np.column_stack(parts)
    return names, rows.tolist()


def _events(path: Path) -> tuple[list[str], list[tuple[str, str, float]]]:
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    found = []
    for line, row in enumerate(rows, 2):
        try:
            for key, what in (("ic", "IC"), ("tc", "FO")):
                found.append((f"{row['foot']}_foot", what, float(row[key]) / GAITMAP_HZ))
        except (KeyError, ValueError, TypeError) as error:
            raise ImportProblem(f"{path}:{line}: lacks foot, ic or tc, or they are no numbers ({error})") from error
    return ["foot", "event", "t_s"], sorted(found, key=lambda event: event[2])


NOMINAL_HZ: Final = 400.0
_UNITS: Final = (("time", "s", 1), ("gyroscope", "deg/s", 3), ("accelerometer", "g", 3))


def read_xio(path: Path, foot: str | None = None) -> Imported:
    """Read one walk. Raises ImportProblem: it is no such table."""
    names, values = plain_csv(path)
    wanted = [(kind, unit) for kind, unit, axes in _UNITS for _ in range(axes)]
    for name, (kind, unit) in zip(names + [""] * 7, wanted, strict=False):
        if not re.match(rf"{kind}\b.*\({re.escape(unit)}\)$", name.lower()):
            raise ImportProblem(f"{path}: has a column {name!r} where {kind} in {unit} should be; is it x-io's table?")
    t_s = values[:, 0]
    if not np.isfinite(t_s).all():
        raise ImportProblem(f"{path}: row {int(np.flatnonzero(~np.isfinite(t_s))[0]) + 2} has no time")
    kept = np.concatenate([[True], np.diff(t_s) > 0.0])
    acc, gyr = values[kept, 4:7] * G_MPS2, np.radians(values[kept, 1:4])
    checked(path, acc, gyr)
    sensor = f"{foot or 'right'}_foot"
    t_ns = np.round((t_s[kept] - t_s[0]) * 1e9).astype(np.int64)
    notes = (
        f"{int((~kept).sum())} of {len(t_s)} rows carried the stamp of the row before and were left out",
        f"which foot is not documented: taken for the {sensor.replace('_', ' ')}",
        "the walk ends where it starts: the only reference (.end.csv)",
    )
    rate_hz = 1e9 / float(np.median(np.diff(t_ns)))
    track = stamped_track(sensor, rate_hz, t_ns, acc, gyr)
    references = {".end.csv": (["foot", "end_distance_m", "end_height_m"], [(sensor, 0.0, 0.0)])}
    extra = {"closed_loop": True, "nominal_rate_hz": NOMINAL_HZ}
    return Imported(Recording(f"xio_{path.stem}", None, {sensor: track}, extra=extra), references, notes)


BOARD: Final = ("imu_acc", "imu_gyr", "opt_quat", "opt_pos", "movement")


def read_broad(path: Path, foot: str | None = None) -> Imported:
    """Read one trial. Raises ImportProblem: it is no such file."""
    arrays, rate_hz = broad_trial(path)
    if not 1.0 <= rate_hz <= 10_000.0:
        raise ImportProblem(f"{path}: its sampling_rate is {rate_hz:g} Hz, which no such sensor has")
    acc, gyr, quaternion, place = (np.asarray(arrays[name], np.float64) for name in BOARD[:4])
    moving = np.asarray(arrays["movement"]).ravel().astype(int)
    checked(path, acc, gyr)
    if quaternion.shape != (len(acc), 4) or place.shape != (len(acc), 3) or len(moving) != len(acc):
        raise ImportProblem(f"{path}: optical data and samples differ in length")
    sensor = f"{foot or 'right'}_foot"
    names = ["t_s", "q_w", "q_x", "q_y", "q_z", "x_m", "y_m", "z_m", "moving"]
    stamps = np.arange(len(acc)) / rate_hz
    rows = np.column_stack([stamps, quaternion, place, moving]).tolist()
    notes = (
        f"a board moved by hand, not a foot: written as {sensor}; phases and strides of it mean nothing",
        "the magnetometer is left out; orientation counts only while the board moves (column moving)",
    )
    track = even_track(sensor, rate_hz, acc, gyr)
    recording = Recording(f"broad_{path.stem}", None, {sensor: track}, extra={"not_gait": True})
    return Imported(recording, {".orientation.csv": (names, rows)}, notes)


def broad_trial(path: Path) -> tuple[dict[str, Any], float]:
    """The arrays of a trial, in HDF5 or MATLAB's form, and its rate (Hz).

    ImportProblem: it cannot be read, lacks something, or h5py is not installed.
    """
    if path.suffix.lower() == ".mat":
        arrays = mat_file(path, *BOARD, "sampling_rate")
        return arrays, float(np.asarray(arrays["sampling_rate"]).ravel()[0])
    try:
        import h5py
    except ImportError as error:
        raise ImportProblem(f"{path}: reading HDF5 needs h5py: pip install 'fes-gait[apdm]'") from error
    try:
        with h5py.File(path, "r") as file:
            arrays = {name: np.asarray(each) for name, each in file.items() if isinstance(each, h5py.Dataset)}
            rate_hz = float(np.ravel(file.attrs["sampling_rate"])[0])
    except (OSError, ValueError, TypeError, KeyError, IndexError, RuntimeError, MemoryError) as error:
        raise ImportProblem(f"{path}: is no HDF5 file as BROAD has them: {error}") from error
    need(path, arrays, BOARD)
    return arrays, rate_hz
