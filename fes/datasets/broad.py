"""BROAD: a board moved by hand, 285.7 Hz, with optical orientation and position; HDF5 or MATLAB files. Not gait.

The board is written as the sensor ``right_foot``, for a recording has no other names: good for orientation only. The
optical quaternion (w, x, y, z, sensor → east-north-up) goes into ``.orientation.csv``, empty where it was not seen.

The HDF5 files are read without a library. Format: "HDF5 File Format Specification Version 3.0", the parts that
version-0 superblocks use: symbol tables, version-1 object headers and B-trees, contiguous or chunked layout with
deflate. Anything else is refused by name.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fes.datasets.common import Imported, ImportProblem, checked, even_track, mat_file
from fes.recording import Recording

Array = npt.NDArray[np.generic]
DATASPACE, DATATYPE, LAYOUT, FILTERS, ATTRIBUTE, CONTINUATION, SYMBOLS = 0x1, 0x3, 0x8, 0xB, 0xC, 0x10, 0x11
DEFLATE = 1


class OldHdf5:
    """One file: ``arrays()`` by name and ``attributes()`` of the root, numeric ones only."""

    def __init__(self, path: Path) -> None:
        self._path, self._data = path, path.read_bytes()
        if self._data[:8] != b"\x89HDF\r\n\x1a\n" or self._data[8] != 0 or self._data[13:15] != b"\x08\x08":
            raise self._refused("a superblock of version 0 with 8-byte offsets at the start")
        self._root = self._messages(self._number(64, "Q"))

    def arrays(self) -> dict[str, Array]:
        """Every data set of the root group."""
        body = self._one(self._root, SYMBOLS)
        tree, heap = struct.unpack("<QQ", body[:16])
        if self._data[heap : heap + 4] != b"HEAP":
            raise self._refused("a local heap")
        names = self._number(heap + 24, "Q")
        out = {}
        for table in self._leaves(tree, key_size=8, kind=0):
            for k in range(self._number(table + 6, "H")):
                entry = table + 8 + 40 * k
                begin = names + self._number(entry, "Q")
                name = self._data[begin : self._data.index(b"\0", begin)].decode()
                out[name] = self._array(self._messages(self._number(entry + 8, "Q")))
        return out

    def attributes(self) -> dict[str, float]:
        """Scalar floats of the root group."""
        out = {}
        for kind, body in self._root:
            if kind == ATTRIBUTE and body[0] == 1:
                sizes = struct.unpack("<HHH", body[2:8])
                parts, at = [], 8
                for size in sizes:
                    parts.append(body[at : at + size])
                    at += -(-size // 8) * 8
                if parts[1][0] & 0xF == 1:
                    out[parts[0].rstrip(b"\0").decode()] = float(np.frombuffer(body, self._dtype(parts[1]), 1, at)[0])
        return out

    def _refused(self, wanted: str) -> ValueError:
        kind = "only HDF5 files of the oldest kind, as BROAD has them, are read here"
        return ValueError(f"{self._path}: expected {wanted}; {kind}")

    def _number(self, at: int, code: str) -> int:
        return int(struct.unpack_from("<" + code, self._data, at)[0])

    def _messages(self, header: int) -> list[tuple[int, bytes]]:
        if self._data[header] != 1:
            raise self._refused("object headers of version 1")
        blocks, out = [(header + 16, self._number(header + 8, "I"))], []
        for begin, size in blocks:  # grows while continuations turn up
            at = begin
            while at + 8 <= begin + size:
                kind, length = struct.unpack_from("<HH", self._data, at)
                body = self._data[at + 8 : at + 8 + length]
                if kind == CONTINUATION:
                    blocks.append(struct.unpack("<QQ", body[:16]))
                out.append((kind, body))
                at += 8 + length
        return out

    def _one(self, messages: list[tuple[int, bytes]], kind: int) -> bytes:
        for found, body in messages:
            if found == kind:
                return body
        raise self._refused(f"a header message of type {kind:#x}")

    def _leaves(self, node: int, key_size: int, kind: int) -> list[int]:
        """Where the children of a B-tree's lowest nodes lie."""
        if self._data[node : node + 4] != b"TREE" or self._data[node + 4] != kind:
            raise self._refused("a version-1 B-tree")
        level, count = self._data[node + 5], self._number(node + 6, "H")
        children = [self._number(node + 24 + key_size + k * (key_size + 8), "Q") for k in range(count)]
        if level == 0:
            return children
        return [leaf for child in children for leaf in self._leaves(child, key_size, kind)]

    def _dtype(self, body: bytes) -> np.dtype[np.generic]:
        kind, size = body[0] & 0xF, struct.unpack("<I", body[4:8])[0]
        if kind == 1 and size in (4, 8) and not body[1] & 1:
            return np.dtype(f"<f{size}")
        if kind in (0, 8) and size == 1:  # whole numbers; enumerations such as booleans
            return np.dtype("i1")
        raise self._refused("little-endian floats or booleans")

    def _array(self, messages: list[tuple[int, bytes]]) -> Array:
        space, layout = self._one(messages, DATASPACE), self._one(messages, LAYOUT)
        rank, dtype = space[1], self._dtype(self._one(messages, DATATYPE))
        start = 8 if space[0] == 1 else 4
        shape = struct.unpack_from(f"<{rank}Q", space, start)
        length = math.prod(shape) * dtype.itemsize
        if layout[0] != 3:
            raise self._refused("a data layout of version 3")
        if layout[1] == 1:
            begin = struct.unpack_from("<Q", layout, 2)[0]
            return np.frombuffer(self._data[begin : begin + length], dtype).reshape(shape)
        tree = struct.unpack_from("<Q", layout, 3)[0]
        chunk = struct.unpack_from(f"<{layout[2] - 1}I", layout, 11)
        filters = [body for kind, body in messages if kind == FILTERS]
        if layout[1] != 2 or (filters and (filters[0][1], filters[0][8]) != (1, DEFLATE)):
            raise self._refused("contiguous data, or chunks with deflate and no other filter")
        out = np.zeros(shape, dtype)
        for at, data in self._chunks(tree, 16 + 8 * rank, rank):
            block = np.frombuffer(zlib.decompress(data) if filters else data, dtype).reshape(chunk)
            inside = tuple(slice(a, min(a + c, s)) for a, c, s in zip(at, chunk, shape, strict=True))
            out[inside] = block[tuple(slice(0, s.stop - s.start) for s in inside)]
        return out

    def _chunks(self, node: int, key: int, rank: int) -> Iterator[tuple[tuple[int, ...], bytes]]:
        """Each chunk's place and bytes."""
        if self._data[node : node + 4] != b"TREE" or self._data[node + 4] != 1:
            raise self._refused("a B-tree of chunks")
        for k in range(self._number(node + 6, "H")):
            at = node + 24 + k * (key + 8)
            child = self._number(at + key, "Q")
            if self._data[node + 5]:
                yield from self._chunks(child, key, rank)
            else:
                place = struct.unpack_from(f"<{rank}Q", self._data, at + 8)
                yield place, self._data[child : child + self._number(at, "I")]


NEEDED: Final = ("imu_acc", "imu_gyr", "opt_quat", "opt_pos", "movement")


def read(path: Path, foot: str | None = None) -> Imported:
    """Read one trial. Raises ImportProblem: it is no such file."""
    if path.suffix.lower() == ".mat":
        arrays = mat_file(path, *NEEDED, "sampling_rate")
        rate_hz = float(np.asarray(arrays["sampling_rate"]).ravel()[0])
    else:
        arrays, rate_hz = _hdf5(path)
    if not 1.0 <= rate_hz <= 10_000.0:
        raise ImportProblem(f"{path}: its sampling_rate is {rate_hz:g} Hz, which no such sensor has")
    acc, gyr, quaternion, place = (np.asarray(arrays[name], np.float64) for name in NEEDED[:4])
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


def _hdf5(path: Path) -> tuple[dict[str, Any], float]:
    try:
        file = OldHdf5(path)
        arrays: dict[str, Any] = dict(file.arrays())
        rate_hz = file.attributes()["sampling_rate"]
    except (OSError, ValueError, KeyError, IndexError, RecursionError, MemoryError, struct.error, zlib.error) as error:
        raise ImportProblem(f"{path}: is no HDF5 file as BROAD has them: {error}") from error
    missing = [name for name in NEEDED if name not in arrays]
    if missing:
        raise ImportProblem(f"{path}: lacks {', '.join(missing)}; it holds {', '.join(sorted(arrays))}")
    return arrays, rate_hz
