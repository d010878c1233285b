"""A recording → Parquet or CSV with its sidecar; what is written here, :func:`fes.recording.read_recording` reads."""

import json
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fes.recording.tracks import UNLABELLED_FEET, Recording, RecordingError
from fes.signals import SENSORS

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def write_recording(recording: Recording, path: Path, *, overwrite: bool = False) -> None:
    """Write ``path`` (``.parquet`` or ``.csv``) and ``path`` with suffix ``.toml``.

    Parquet holds float32 (the sensors' own resolution is coarser), CSV every digit. Both files are complete
    before they appear under their names, so a stop half-way leaves what was there before.

    Args:
        recording: at least one track; tracks that differ in time get their own time columns.
        path: the data file to make; its folder must exist.
        overwrite: replace files that are there already.

    Raises:
        RecordingError: no track, an unknown suffix, a file in the way, or the disk refuses.
    """
    path = Path(path)
    sidecar, suffix = path.with_suffix(".toml"), path.suffix.lower()
    if suffix not in (".parquet", ".csv"):
        raise RecordingError(f"{path}: recordings are written as .parquet or .csv, not {path.suffix!r}")
    if not any(track.t_ns.size for track in recording.tracks.values()):
        raise RecordingError(f"{path}: the recording has no samples, so there is nothing to write")
    for target in (path, sidecar):
        if target.exists() and not overwrite:
            raise RecordingError(f"{target}: is there already; choose another name or pass overwrite=True")
    columns, settings = _lay_out(recording, single=suffix == ".parquet")
    try:
        text = toml_text(settings)
    except TypeError as error:
        raise RecordingError(f"{sidecar}: cannot be written: {error}") from error
    temporary = [target.with_name(f".{target.name}.{os.getpid()}.part") for target in (path, sidecar)]
    try:
        _write_table(columns, temporary[0], suffix)
        temporary[1].write_text(text, encoding="utf-8")
        temporary[0].replace(path)
        temporary[1].replace(sidecar)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        for leftover in temporary:
            leftover.unlink(missing_ok=True)


def _lay_out(recording: Recording, *, single: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return (column name → values, which may be fewer than there are rows; sidecar settings)."""
    tracks = [recording.tracks[sensor] for sensor in SENSORS + UNLABELLED_FEET if sensor in recording.tracks]
    shared = all(np.array_equal(track.t_sensor_ns, tracks[0].t_sensor_ns) for track in tracks)
    number = np.float32 if single else np.float64
    columns: dict[str, Any] = {}
    settings: dict[str, Any] = {
        "name": recording.name,
        "subject": recording.subject,
        "description": recording.description,
        "belt_speed_mps": recording.belt_speed_mps,
        "acc_unit": "m/s^2",
        "gyr_unit": "rad/s",
        "time_unit": "ns",
        "sensors": {},
    }
    mounting = recording.extra.get("mounting", {})
    if shared:
        columns["t_ns"] = tracks[0].t_sensor_ns
        settings["time_column"] = "t_ns"
    for track in tracks:
        sensor = track.sensor
        entry: dict[str, Any] = {
            "rate_hz": float(track.rate_hz),
            "acc_range_mps2": track.acc_range_mps2,
            "gyr_range_radps": track.gyr_range_radps,
        }
        if not shared:
            entry["time_column"] = f"{sensor}_t_ns"
            columns[entry["time_column"]] = track.t_sensor_ns
        if not np.array_equal(track.t_ns, np.maximum.accumulate(track.t_sensor_ns)):  # what a reader assumes
            entry["arrival_column"] = f"{sensor}_arrival_ns"
            columns[entry["arrival_column"]] = track.t_ns
        for kind, values in (("acc", track.acc_mps2), ("gyr", track.gyr_radps)):
            entry[kind] = [f"{sensor}_{kind}_{axis}" for axis in "xyz"]
            for axis, name in enumerate(entry[kind]):
                columns[name] = np.ascontiguousarray(values[:, axis], dtype=number)
        if sensor in mounting:
            entry["mounting"] = dict(mounting[sensor])
        settings["sensors"][sensor] = entry
    settings["geometry"] = {foot: value.model_dump() for foot, value in recording.geometry.items()} or None
    settings["ground"] = recording.ground.model_dump(exclude_defaults=True) or None
    settings["extra"] = {key: value for key, value in recording.extra.items() if key != "mounting"} or None
    return columns, settings


def _write_table(columns: dict[str, Any], path: Path, suffix: str) -> None:
    """Write the columns, the short ones filled up with empty cells."""
    import pyarrow as pa

    rows = max(values.size for values in columns.values())
    arrays = {name: pa.array(values) for name, values in columns.items()}
    for name, array in arrays.items():
        if empty := rows - len(array):
            arrays[name] = pa.concat_arrays([array, pa.nulls(empty, array.type)])
    table = pa.table(arrays)
    if suffix == ".csv":
        from pyarrow import csv

        csv.write_csv(table, path, csv.WriteOptions(quoting_style="none"))
    else:
        from pyarrow import parquet

        # bytes of like weight side by side, times as steps: smaller, and read faster, than a dictionary of numbers that
        # hardly recur; where no cell is empty, none can be, and no reader has to check
        table = table.cast(pa.schema([field.with_nullable(table[field.name].null_count > 0) for field in table.schema]))
        encodings = {
            field.name: "DELTA_BINARY_PACKED" if pa.types.is_integer(field.type) else "BYTE_STREAM_SPLIT"
            for field in table.schema
        }
        parquet.write_table(
            table, path, compression="lz4", use_dictionary=False, column_encoding=encodings, write_page_checksum=True
        )


def toml_text(values: Mapping[str, Any], path: tuple[str, ...] = ()) -> str:
    """TOML of nested mappings of str, bool, int, float and lists of these; None is left out. ``path``: the table's own.

    Raises:
        TypeError: a value has no TOML form; the message names its key.
    """
    plain = {key: value for key, value in values.items() if not isinstance(value, Mapping) and value is not None}
    tables = {key: value for key, value in values.items() if isinstance(value, Mapping)}
    text = "".join(f"{_key(key)} = {toml_value(value, (*path, key))}\n" for key, value in plain.items())
    if path and (plain or not tables):
        text = f"\n[{'.'.join(map(_key, path))}]\n{text}"
    text += "".join(toml_text(table, (*path, key)) for key, table in tables.items())
    return text if path else text.lstrip("\n") or "\n"


def toml_value(value: object, path: tuple[str, ...] = ()) -> str:
    """One value's TOML text; JSON's escapes are TOML's, but for DEL, which TOML wants escaped.

    Raises:
        TypeError: the value has no TOML form.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, int):
        return str(int(value))
    if isinstance(value, float):
        return repr(float(value)) if math.isfinite(value) else str(value)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(toml_value(item, path) for item in value) + "]"
    if isinstance(value, Mapping):
        pairs = (f"{_key(key)} = {toml_value(item, (*path, key))}" for key, item in value.items() if item is not None)
        return "{ " + ", ".join(pairs) + " }"
    raise TypeError(f"{'.'.join(path)}: {type(value).__name__} has no TOML form; use text, numbers, lists or tables")


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else toml_value(key)
