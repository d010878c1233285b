"""One element of an array, told to LLVM in a quarter of the words.

For ``x[i, j]`` numba writes some fifty of LLVM's instructions: it puts the array into memory, takes it apart there,
makes a tuple of the indices and takes that apart again. LLVM finds that ten are left, but by then they have been made,
written as text, read and optimised, and kernels hold little else. Here the ten are written: a tenth of the time of
compiling, and the same machine code. They are declared by numba's own means, ``lower_builtin``; all else than one
element of an array in C order goes numba's way.
"""

from __future__ import annotations

import operator
from typing import Any

from numba import extending
from numba.core import codegen, types
from numba.np import arrayobj

DATA, SHAPE = 4, 5  # of what numba makes of an array
_LLVM: Any = vars(codegen)["llvmir"]
_arrays: Any = arrayobj
_declared: Any = extending.lower_builtin


@_declared(operator.getitem, types.Array, types.Integer)
def _get_at(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind, index = sig.args
    if not _is_one(context, kind, (index,)):
        return _arrays.getitem_arraynd_intp(context, builder, sig, args)
    return _arrays.load_item(context, builder, kind, _place(builder, args[0], [args[1]]))


@_declared(operator.getitem, types.Array, types.BaseTuple)
def _get(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind, indices = sig.args
    if not _is_one(context, kind, tuple(indices)):
        return _arrays.getitem_array_tuple(context, builder, sig, args)
    return _arrays.load_item(context, builder, kind, _place(builder, args[0], _parts(builder, indices, args[1])))


@_declared(operator.setitem, types.Array, types.Integer, types.Any)
def _set_at(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind, index, given = sig.args
    if not _is_one(context, kind, (index,)):
        return _arrays.setitem_array(context, builder, sig, args)
    place, value = _place(builder, args[0], [args[1]]), context.cast(builder, args[2], given, kind.dtype)
    return _arrays.store_item(context, builder, kind, value, place)


@_declared(operator.setitem, types.Array, types.BaseTuple, types.Any)
def _set(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind, indices, given = sig.args
    if not _is_one(context, kind, tuple(indices)):
        return _arrays.setitem_array(context, builder, sig, args)
    place = _place(builder, args[0], _parts(builder, indices, args[1]))
    return _arrays.store_item(context, builder, kind, context.cast(builder, args[2], given, kind.dtype), place)


def _is_one(context: Any, kind: Any, indices: tuple[Any, ...]) -> bool:
    """Whether these are a whole number of the usual size for each axis of an array in C order, bounds not checked."""
    usual = kind.layout == "C" and not context.enable_boundscheck
    return usual and 0 < len(indices) == kind.ndim and all(index == types.intp for index in indices)


def _parts(builder: Any, kinds: Any, whole: Any) -> list[Any]:
    """The values in a tuple."""
    return [_part(builder, whole, k) for k in range(len(kinds))]


def _part(builder: Any, whole: Any, k: int) -> Any:
    """The ``k``-th value in a tuple: what was put there, where that can be seen."""
    made = whole
    while isinstance(made, _LLVM.instructions.InsertValue):
        if made.indices == [k]:
            value = made.operands[1]
            if isinstance(value, _LLVM.instructions.ExtractValue) and len(value.indices) == 1:  # of a tuple made before
                return _part(builder, value.operands[0], value.indices[0])
            return value
        made = made.operands[0]
    return builder.extract_value(whole, k)


def _place(builder: Any, array: Any, indices: list[Any]) -> Any:
    """Where the element lies; a negative index counts from the end."""
    shape, place = builder.extract_value(array, SHAPE), None
    for axis, index in enumerate(indices):
        count = builder.extract_value(shape, axis)
        if not isinstance(index, _LLVM.Constant) or index.constant < 0:
            below = builder.icmp_signed("<", index, index.type(0))
            index = builder.select(below, builder.add(index, count), index)
        place = index if place is None else builder.add(builder.mul(place, count), index)
    return builder.gep(builder.extract_value(array, DATA), [place])
