"""Files that hold several sensors' own streams, by their own libraries: LSL's XDF (pyxdf), APDM's HDF5 (h5py).

Each becomes a table whose columns are called ``stream.channel``, with a time ``stream.time``; shorter streams end in
empty cells. XDF: "Specifications" in the wiki of github.com/sccn/xdf; pyxdf sets the streams' clocks to one. APDM: the
layout of file format 5 as its users read it (``Sensors/NUMBER/Accelerometer``, m/s²; ``Gyroscope``, rad/s; ``Time``, µs
since 1970; what the sensor was called is in ``Configuration``, ``Label 0``).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fes.recording.tracks import RecordingError

if TYPE_CHECKING:
    import pyarrow as pa

Array = npt.NDArray[Any]
_MAGIC = {b"XDF:": "xdf", b"\x89HDF": "apdm"}
_NEEDS = {"xdf": "pyxdf", "apdm": "h5py"}


def container_of(path: Path) -> str:
    """“xdf”, “apdm” by the file's first bytes, "" for any other."""
    try:
        with path.open("rb") as file:
            return _MAGIC.get(file.read(4), "")
    except OSError:
        return ""  # told when it is read


def container_table(path: Path) -> tuple[pa.Table, dict[str, str]]:
    """The columns of all numeric streams, and the unit of each that has one.

    Raises:
        RecordingError: it is damaged, holds no stream of numbers, or its library is not installed.
    """
    import pyarrow as pa

    kind = container_of(path)
    columns: dict[str, Array] = {}
    units: dict[str, str] = {}
    try:
        for stream, names, values, t, time_unit in (_xdf if kind == "xdf" else _apdm)(path):
            unique = stream if f"{stream}.time" not in columns else f"{stream}{len(columns)}"
            columns[f"{unique}.time"], units[f"{unique}.time"] = t, time_unit
            for (name, unit), column in zip(names, values.T, strict=True):
                columns[f"{unique}.{name}"], units[f"{unique}.{name}"] = column, unit
    except ImportError as error:
        library = _NEEDS[kind]
        raise RecordingError(f"{path}: reading it needs {library}: pip install 'fes-gait[{kind}]'") from error
    except Exception as error:  # the libraries fail in many ways on bytes that are none of theirs
        raise RecordingError(f"{path}: cannot be read as {kind.upper()}: {error}. Copy or record it again.") from error
    rows = max((column.size for column in columns.values()), default=0)
    if not rows:
        raise RecordingError(f"{path}: holds no stream of numbers")
    arrays = {name: pa.array(column) for name, column in columns.items()}
    filled = {name: pa.concat_arrays([one, pa.nulls(rows - len(one), one.type)]) for name, one in arrays.items()}
    return pa.table(filled), units


_Stream = tuple[str, list[tuple[str, str]], Array, Array, str]  # its name, channels and units, values, times, unit


def _xdf(path: Path) -> Iterator[_Stream]:
    import pyxdf

    for stream in pyxdf.load_xdf(str(path), verbose=False)[0]:
        info, values, t_s = stream["info"], stream["time_series"], stream["time_stamps"]
        if not isinstance(values, np.ndarray) or not np.issubdtype(values.dtype, np.number) or not len(t_s):
            continue
        described = ((info.get("desc") or [None])[0] or {}).get("channels") or [None]
        channels = (described[0] or {}).get("channel") or []
        names = [
            ((one.get("label") or [None])[0] or f"channel {number}", (one.get("unit") or [None])[0] or "")
            for number, one in enumerate(channels, start=1)
        ]
        if len(names) != values.shape[1]:
            names = [(f"channel {number}", "") for number in range(1, values.shape[1] + 1)]
        yield info["name"][0], names, values.astype(np.float64), np.asarray(t_s, np.float64), "s"


def _apdm(path: Path) -> Iterator[_Stream]:
    import h5py

    with h5py.File(path, "r") as file:
        for number, sensor in file["Sensors"].items():
            label = sensor["Configuration"].attrs.get("Label 0", number)
            label = (label.decode() if isinstance(label, bytes) else str(label)).strip(" \0")
            values = np.hstack([np.asarray(sensor[kind], np.float64) for kind in ("Accelerometer", "Gyroscope")])
            kinds = (("Accelerometer", "m/s^2"), ("Gyroscope", "rad/s"))
            names = [(f"{kind} {axis}", unit) for kind, unit in kinds for axis in "XYZ"]
            yield label or number, names, values, np.asarray(sensor["Time"]).astype(np.int64), "us"
