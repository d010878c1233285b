"""All that a compiled core knows and remembers of one sensor, as one array: handed over in a fraction of a microsecond.

Every number of a named tuple that is passed into compiled code is unpacked each time, which for the forty settings of a
core takes longer than a sample's arithmetic.
"""

import math
from functools import cache
from struct import Struct
from typing import Any, ClassVar, NamedTuple, Protocol, TypeAlias, get_type_hints

import numpy as np

from fes.estimation.numerics.jit import PLAIN

# What compiled code is given; the docstrings say the shapes.
Vec: TypeAlias = np.ndarray[Any, np.dtype[Any]]  # (N,) numbers, time stamps or records
Mat: TypeAlias = np.ndarray[Any, np.dtype[Any]]  # (N, K) and more axes


class Record(Protocol):
    """One element of a structured array, its fields as attributes."""

    def __getattr__(self, field: str) -> Any: ...
    def __setattr__(self, field: str, value: Any) -> None: ...


KINDS = {float: np.float64, int: np.int64, bool: np.bool_}
CODES = {"f": "d", "i": "q", "b": "?"}  # numpy's kinds as ``struct`` names them


def record_type(fields: list[Any]) -> np.dtype[Any]:
    """A record with these fields, aligned; they are its elements' attributes without the compiler too."""
    return np.dtype((np.record, np.dtype(fields, align=True)))


def core_type(state: np.dtype[Any], **parts: type[NamedTuple]) -> np.dtype[Any]:
    """A record of the ``state`` and of named tuples of numbers, each a record of its own with the same names."""
    return record_type(
        [("state", np.dtype((np.record, state))), *((name, record_of(part)) for name, part in parts.items())]
    )


def record_of(part: type[NamedTuple]) -> np.dtype[Any]:
    """A record of the same numbers as a named tuple."""
    return record_type([(field, KINDS[kind]) for field, kind in get_type_hints(part).items()])


def new_core(kind: np.dtype[Any], **parts: tuple[float, ...]) -> Vec:
    """An array (1,) of such a record with its parts filled in; the state is zero."""
    core = np.zeros(1, kind)
    fill(core, **parts)
    return core


def fill(core: Vec, **parts: tuple[float, ...]) -> None:
    """Fill in the parts of such an array."""
    for name, values in parts.items():
        core[name] = values


def struct_of(kind: np.dtype[Any], *names: str) -> Struct:
    """How ``struct`` reads and writes the named fields of a record, from its first byte on: in a third of numpy's time.

    Without names all of them. What lies between them is passed over in reading, and zeroed in writing.
    """
    code, end = "=", 0

    def add(kind: np.dtype[Any], offset: int) -> None:
        nonlocal code, end
        if kind.names is not None and kind.fields is not None:
            for name in kind.names:
                add(kind.fields[name][0], offset + kind.fields[name][1])
            return
        code += f"{offset - end}x{math.prod(kind.shape)}{CODES[kind.base.kind]}"
        end = offset + kind.itemsize

    for name in names or kind.names or ():
        assert kind.fields is not None
        add(kind.fields[name][0], kind.fields[name][1])
    return Struct(code)


def handed(array: Vec) -> Any:
    """An array as a live step's functions are handed it: where nothing is compiled, in a form quick for Python.

    That is a list of :class:`PlainRecord`, or of numbers the memory; both are the array's own memory.
    """
    if not PLAIN:
        return array
    if array.dtype.names is None:
        return array.data
    kind = _plain_type(array.dtype)
    return [kind(each) for each in array.view(np.uint8).reshape(len(array), -1)]


class PlainRecord:
    """One element of a structured array, its fields as attributes, in a twentieth of the time that numpy's takes.

    ``memory`` (B,) are its bytes. Numbers are Python's; more than one axis is numpy's array.
    """

    __slots__ = ("_array", "_flags", "_floats", "_ints", "_parts")
    KIND: ClassVar[np.dtype[Any]]

    def __init__(self, memory: Vec) -> None:
        self._array = memory.view(self.KIND)
        data = memory.data
        self._floats, self._ints, self._flags = data.cast("d"), data.cast("q"), data.cast("?")
        self._parts = {
            name: _part(memory[offset : offset + kind.itemsize], kind)
            for name, (kind, offset, *_) in (self.KIND.fields or {}).items()
            if kind.names is not None or kind.shape
        }


def _part(memory: Vec, kind: np.dtype[Any]) -> Any:
    if kind.names is not None:
        return _plain_type(kind)(memory)
    values = memory.view(kind.base).reshape(kind.shape)
    return values.data if values.ndim == 1 else values


@cache
def _plain_type(kind: np.dtype[Any]) -> type[PlainRecord]:
    """The class of a record's elements."""
    fields = {
        name: _record_in(name) if part.names is not None or part.shape else _number_at(part.kind, offset)
        for name, (part, offset, *_) in (kind.fields or {}).items()
    }
    return type("PlainRecord", (PlainRecord,), {"__slots__": (), "KIND": kind, **fields})


def _number_at(kind: str, offset: int) -> property:
    at = offset if kind == "b" else offset // 8
    read: Any
    write: Any
    if kind == "f":
        read, write = lambda self: self._floats[at], lambda self, value: self._floats.__setitem__(at, value)
    elif kind == "i":
        read, write = lambda self: self._ints[at], lambda self, value: self._ints.__setitem__(at, value)
    else:
        read, write = lambda self: self._flags[at], lambda self, value: self._flags.__setitem__(at, value)
    return property(read, write)


def _record_in(name: str) -> property:
    def read(self: PlainRecord) -> Any:
        return self._parts[name]

    def write(self: PlainRecord, value: Any) -> None:
        self._array[name] = value._array if isinstance(value, PlainRecord) else value

    return property(read, write)
