"""Files that hold several sensors' own streams: LSL's XDF (pyxdf), APDM's HDF5 (h5py), Xsens MVN's XML.

Each becomes a table whose columns are called ``stream.channel``, with a time ``stream.time``; shorter streams end in
empty cells. XDF: "Specifications" in the wiki of github.com/sccn/xdf; pyxdf sets the streams' clocks to one. APDM: the
layout of file format 5 as its users read it (``Sensors/NUMBER/Accelerometer``, m/s²; ``Gyroscope``, rad/s; ``Time``, µs
since 1970; what the sensor was called is in ``Configuration``, ``Label 0``); of formats 2 to 4
(``NUMBER/Calibrated/Accelerometers``, ``Gyroscopes``, ``NUMBER/Time``; names in the root's ``MonitorLabelList``, in the
order of ``CaseIdList``).

MVNX ("MVN User Manual", MVNX file format): of each tracker ``sensorFreeAcceleration`` (m/s², in the global frame, z up,
without gravity) and ``sensorOrientation`` (wxyz, of the tracker in the global frame). What its accelerometer and its
gyroscope measured is made from them: gravity is added, the sum is turned into the tracker's own frame, and the rotation
rate is the turn from one frame to the next.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from fes.recording.tracks import RecordingError
from fes.signals import G_MPS2

if TYPE_CHECKING:
    import pyarrow as pa

Array = npt.NDArray[Any]
_MAGIC = {b"XDF:": "xdf", b"\x89HDF": "apdm"}
_MVNX: Final = b"<mvnx"
_HEAD: Final = 2000  # bytes: what may stand above the first element
_CHANNELS: Final = [
    (f"{kind} {axis}", unit) for kind, unit in (("Accelerometer", "m/s^2"), ("Gyroscope", "rad/s")) for axis in "XYZ"
]
_NEEDS = {"xdf": "pyxdf", "apdm": "h5py"}


def container_of(path: Path) -> str:
    """“xdf”, “apdm”, “mvnx” by the file's first bytes, "" for any other."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
            return _MAGIC.get(head[:4], "mvnx" if _MVNX in head else "")
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
        for stream, names, values, t, time_unit in _READERS[kind](path):
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
        if "Sensors" in file:
            each = file["Sensors"].items()
            sensors = [(_text(one["Configuration"].attrs.get("Label 0", "")), n, one, one) for n, one in each]
            names = ("Accelerometer", "Gyroscope")
        else:
            numbers = [_text(number) for number in file.attrs["CaseIdList"]]
            labels = [_text(label) for label in file.attrs.get("MonitorLabelList", [""] * len(numbers))]
            sensors = [(label, n, file[n], file[n]["Calibrated"]) for label, n in zip(labels, numbers, strict=True)]
            names = ("Accelerometers", "Gyroscopes")
        for label, number, sensor, calibrated in sensors:
            values = np.hstack([np.asarray(calibrated[name], np.float64) for name in names])
            yield label or number, _CHANNELS, values, np.asarray(sensor["Time"]).astype(np.int64), "us"


def _text(value: bytes | str) -> str:
    return (value.decode() if isinstance(value, bytes) else str(value)).strip(" \0")


def _mvnx(path: Path) -> Iterator[_Stream]:
    labels: list[str] = []
    rate_hz = 0.0
    index: list[int] = []
    measured: dict[str, list[Array]] = {"sensorFreeAcceleration": [], "sensorOrientation": []}
    for event, element in ElementTree.iterparse(path, events=("start", "end")):
        tag = element.tag.rpartition("}")[2]
        if event == "start":
            if tag == "subject":
                rate_hz = float(element.get("frameRate", "nan"))
            continue
        if tag == "sensor":
            labels.append(element.get("label", f"sensor {len(labels) + 1}"))
        elif tag == "frame":
            if element.get("type", "normal") == "normal":  # the others are poses of the body model, not of this moment
                texts = {child.tag.rpartition("}")[2]: child.text for child in element}
                if missing := [name for name in measured if not texts.get(name)]:
                    raise ValueError(f"a frame has no {missing[0]}: export it with all data of the sensors")
                index.append(int(element.get("index") or len(index)))
                for name, values in measured.items():
                    values.append(np.array((texts[name] or "").split(), np.float64))
            element.clear()
    if not rate_hz > 0.0:
        raise ValueError("it does not say its frameRate")
    free_mps2 = np.array(measured["sensorFreeAcceleration"]).reshape(len(index), len(labels), 3)
    q_world = np.array(measured["sensorOrientation"]).reshape(len(index), len(labels), 4)
    t_s = np.array(index) / rate_hz
    for number, label in enumerate(labels if len(index) > 1 else ()):
        sensed = np.hstack(_as_sensed(free_mps2[:, number], q_world[:, number], t_s))
        yield re.sub("(?<=[a-z])(?=[A-Z])", " ", label), _CHANNELS, sensed, t_s, "s"


def _as_sensed(free_world_mps2: Array, q_world_from_sensor: Array, t_s: Array) -> tuple[Array, Array]:
    """What a tracker's accelerometer (N, 3) and gyroscope (N, 3) measured, m/s² and rad/s, from what MVN made of it."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_quat(q_world_from_sensor, scalar_first=True)
    acc_mps2 = turned.inv().apply(free_world_mps2 + np.array([0.0, 0.0, G_MPS2]))
    between_radps = (turned[:-1].inv() * turned[1:]).as_rotvec() / np.diff(t_s)[:, None]
    # a rate between two frames belongs to both: their mean at each, and at the ends the only one there is
    gyr_radps = (np.vstack([between_radps[:1], between_radps]) + np.vstack([between_radps, between_radps[-1:]])) / 2.0
    return acc_mps2, gyr_radps


_READERS: Final = {"xdf": _xdf, "apdm": _apdm, "mvnx": _mvnx}
