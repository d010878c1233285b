"""CAN logs (``.asc``, ``.blf``, ``.log``) with their DBC as recordings.

A sensor's columns are ``Message.Signal``. Its acceleration and rate may come in one message or in several; a sample
is stamped when its last message came.
"""

import difflib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fes.recording.raw import LARGEST_VALUE, RawTrack
from fes.recording.sidecar import Sidecar
from fes.recording.table import greatest_size
from fes.recording.tracks import RecordingError
from fes.signals import NS_PER_S, FloatArray, IntArray

CAN_SUFFIXES = (".asc", ".blf", ".log")
LARGEST_TIME_S = 4e9  # beyond the year 2096


class _Collector:
    """Gathers one sensor's messages and pairs them into samples."""

    def __init__(self, columns: tuple[str, ...]) -> None:
        self.parts = [tuple(name.split(".", 1)) for name in columns]
        self.messages = sorted({message for message, _ in self.parts})
        self._came: dict[str, list[tuple[int, int, dict[str, Any]]]] = {message: [] for message in self.messages}

    def add(self, message: str, signals: dict[str, Any], t_ns: int, frame: int) -> None:
        """Take one decoded message, the ``frame``-th of the log."""
        self._came[message].append((t_ns, frame, signals))

    def samples(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Return (t_ns, frame, values) of the complete samples: (N,), (N,), (N, 6).

        The message that usually comes last closes a sample; with it go the latest of the others, if they came after
        the closing message before. A sample that lacks one is lost whole, halves of two are never mixed.
        """
        if not all(self._came.values()):
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 6))
        t_ns = {message: np.array([each[0] for each in came], np.int64) for message, came in self._came.items()}
        frames = {message: np.array([each[1] for each in came], np.int64) for message, came in self._came.items()}

        def wait_ns(closing: str) -> float:
            """How long, usually, the other messages would have waited if this one closed the samples."""
            total = 0.0
            for message in self.messages:
                index = np.searchsorted(frames[message], frames[closing], side="right") - 1
                waited = t_ns[closing] - t_ns[message][np.maximum(index, 0)]
                total += float(np.median(waited[index >= 0])) if (index >= 0).any() else float("inf")
            return total

        last = min(self.messages, key=wait_ns)
        closing = frames[last]
        before = np.concatenate([[-1], closing[:-1]])
        complete = np.ones(closing.size, bool)
        index = {}
        for message in self.messages:
            index[message] = np.searchsorted(frames[message], closing, side="right") - 1
            complete &= (index[message] >= 0) & (frames[message][index[message]] > before)
        rows = np.flatnonzero(complete)
        values = np.empty((rows.size, len(self.parts)))
        for column, (message, signal) in enumerate(self.parts):
            chosen = index[message][rows].tolist()
            values[:, column] = [float(self._came[message][number][2][signal]) for number in chosen]
        return t_ns[last][rows], closing[rows], values


def read_can_log(path: Path, sidecar_path: Path, sidecar: Sidecar) -> dict[str, RawTrack]:
    """Return sensor → what the log has of it, times from the log's first frame on.

    Raises:
        RecordingError: the log or the DBC cannot be read, a name is not in the DBC, or no frame of a sensor came.
    """
    if sidecar.can is None:
        raise RecordingError(f'{sidecar_path}: {path.name} is a CAN log: say [can] and dbc = "NAME.dbc" in the sidecar')
    dbc_path = sidecar_path.parent / sidecar.can.dbc
    database = _load_dbc(dbc_path)
    known = sorted(f"{message.name}.{signal.name}" for message in database.messages for signal in message.signals)
    collectors = {}
    for sensor, columns in sidecar.sensors.items():
        if columns.time_column or columns.arrival_column or sidecar.time_column:
            what = "a CAN log has its own times; leave time_column and arrival_column out"
            raise RecordingError(f"{sidecar_path}: {what}")
        for name in (*columns.acc, *columns.gyr):
            if name not in known:
                near = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
                guess = f"Did you mean {' or '.join(map(repr, near))}?" if near else f"It has {', '.join(known[:20])}."
                what = f"{dbc_path.name} has no {name!r}; names are Message.Signal. {guess}"
                raise RecordingError(f"{sidecar_path}: {sensor}: {what}")
        collectors[sensor] = _Collector((*columns.acc, *columns.gyr))
    wanted: dict[tuple[int, bool], tuple[Any, list[_Collector]]] = {}
    for collector in collectors.values():
        for name in collector.messages:
            message = database.get_message_by_name(name)
            key = (message.frame_id, bool(message.is_extended_frame))
            wanted.setdefault(key, (message, []))[1].append(collector)
    first_ns: int | None = None
    for frame, received in enumerate(_frames(path), start=1):
        if not abs(received.timestamp) < LARGEST_TIME_S:
            raise RecordingError(f"{path}: frame {frame} has the time {received.timestamp:g} s, which cannot be")
        t_ns = round(received.timestamp * NS_PER_S)
        first_ns = t_ns if first_ns is None else first_ns
        message, receivers = wanted.get((received.arbitration_id, received.is_extended_id), (None, []))
        if message is None or received.is_error_frame or received.is_remote_frame:
            continue
        signals = _decode(path, frame, message, received)
        for collector in receivers:
            collector.add(message.name, signals, t_ns - first_ns, frame)
    if first_ns is None:
        raise RecordingError(f"{path}: holds no CAN frame")
    return {sensor: _raw(path, sensor, collector) for sensor, collector in collectors.items()}


def dbc_signals(path: Path) -> dict[str, str]:
    """The names ``Message.Signal`` of a DBC, each with its unit.

    Raises:
        RecordingError: it cannot be read.
    """
    messages = _load_dbc(path).messages
    return {f"{message.name}.{signal.name}": signal.unit or "" for message in messages for signal in message.signals}


def _load_dbc(path: Path) -> Any:
    import cantools

    try:
        return cantools.database.load_file(path)
    except OSError as error:
        why = error.strerror or error
        raise RecordingError(f"{path}: cannot be read: {why}. dbc is sought beside the sidecar.") from error
    except (cantools.Error, ValueError) as error:
        raise RecordingError(f"{path}: is no DBC that can be read: {error}") from error


def _frames(path: Path) -> Iterator[Any]:
    import can

    try:
        with can.LogReader(path) as reader:
            yield from reader
    except Exception as error:  # the readers of several formats fail in many ways on bytes that are none of theirs
        raise RecordingError(f"{path}: cannot be read as a CAN log: {error}") from error


def _decode(path: Path, frame: int, message: Any, received: Any) -> dict[str, Any]:
    """Signals by name as numbers; multiplexed and enumerated signals too."""
    try:
        signals: dict[str, Any] = message.decode(bytes(received.data), decode_choices=False)
    except Exception as error:  # cantools raises several unrelated kinds for a payload that does not fit
        raise RecordingError(
            f"{path}: frame {frame} (identifier 0x{received.arbitration_id:X}, {len(received.data)} bytes) does not "
            f"fit message {message.name} of the DBC: {error}"
        ) from error
    return signals


def _raw(path: Path, sensor: str, collector: _Collector) -> RawTrack:
    t_ns, frames, values = collector.samples()
    if not t_ns.size:
        raise RecordingError(
            f"{path}: {sensor}: no frame of {', '.join(collector.messages)} came, or not of each; "
            f"check that the log and the DBC belong together"
        )
    bad = np.flatnonzero(~(np.abs(values) < LARGEST_VALUE).all(axis=1))
    if bad.size:
        raise RecordingError(f"{path}: {sensor}: frame {frames[bad[0]]} holds a number that is no measurement")
    acc, gyr = np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:])
    greatest = greatest_size(acc), greatest_size(gyr)
    return RawTrack(t_ns, None, acc, gyr, t_ns, lambda index: f"frame {frames[index]}", greatest)
