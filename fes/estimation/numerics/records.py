"""All that a compiled core knows and remembers of one sensor, as one array: handed over in a fraction of a microsecond.

Every number of a named tuple that is passed into compiled code is unpacked each time, which for the forty settings of a
core takes longer than a sample's arithmetic.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias, get_type_hints

import numpy as np

# What compiled code is given; the docstrings say the shapes.
Vec: TypeAlias = np.ndarray[Any, np.dtype[Any]]  # (N,) numbers, time stamps or records
Mat: TypeAlias = np.ndarray[Any, np.dtype[Any]]  # (N, K) and more axes
Record: TypeAlias = np.record  # one element of a structured array, its fields as attributes

KINDS = {float: np.float64, int: np.int64, bool: np.bool_}


def core_type(state: np.dtype[Any], **parts: type[NamedTuple]) -> np.dtype[Any]:
    """A record of the ``state`` and of named tuples of numbers, each a record of its own with the same names."""
    return np.dtype([("state", state), *((name, record_of(part)) for name, part in parts.items())], align=True)


def record_of(part: type[NamedTuple]) -> np.dtype[Any]:
    """A record of the same numbers as a named tuple."""
    return np.dtype([(field, KINDS[kind]) for field, kind in get_type_hints(part).items()], align=True)


def new_core(kind: np.dtype[Any], **parts: tuple[float, ...]) -> np.ndarray[Any, np.dtype[Any]]:
    """An array (1,) of such a record with its parts filled in; the state is zero."""
    core = np.zeros(1, kind)
    fill(core, **parts)
    return core


def fill(core: np.ndarray[Any, np.dtype[Any]], **parts: tuple[float, ...]) -> None:
    """Fill in the parts of such an array."""
    for name, values in parts.items():
        core[name] = values
