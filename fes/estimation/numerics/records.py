"""All that a compiled core knows and remembers of one sensor, as one array: handed over in a fraction of a microsecond.

Every number of a named tuple that is passed into compiled code is unpacked each time, which for the forty settings of a
core takes longer than a sample's arithmetic.
"""

import math
from struct import Struct
from typing import Any, NamedTuple, Protocol, TypeAlias, get_type_hints

import numpy as np

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
