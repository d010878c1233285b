"""One element of an array, in and out, is the one that numpy means, whatever the array and the index."""

from __future__ import annotations

from itertools import product
from typing import Any

import numba
import numpy as np
import pytest

from fes.estimation import compiler, compiler_elements
from fes.estimation.compiled import jit_ieee

SEEN = np.dtype([("count", np.int64), ("values", np.float64, (2, 3)), ("on", np.bool_)], align=True)


@jit_ieee
def _line(x: Any, i: int, value: float) -> Any:
    x[i] = value
    return 2.0 * x[i] + x[-1] + x[0]


@jit_ieee
def _plane(x: Any, i: int, j: int, value: float) -> Any:
    x[i, j] = value
    x[i, 0] += 1.0
    return 2.0 * x[i, j] + x[-1, j] + x[i, -1] + x[0, 0]


@jit_ieee
def _space(x: Any, i: int, j: int, k: int, value: float) -> Any:
    x[i, j, k] = value
    x[i, 1, -2] -= 1.0
    return 2.0 * x[i, j, k] + x[-1, j, k] + x[0, -1, k] + x[i, j, -1]


@jit_ieee
def _record(x: Any, i: int, j: int, k: int, value: float) -> Any:
    x[i].values[j, k] = value
    x[i].count += 1
    x[i].on = x[i].values[j, -1] > 0.0
    return 2.0 * x[i].values[j, k] + x[-1].values[0, 0]


@jit_ieee
def _rows(x: Any, i: int) -> Any:
    first, second = x[i], x[1:]
    return first[1] + second[-1, 0]


def plain(function: Any) -> Any:
    return function.py_func


def arrays(*shape: int) -> list[Any]:
    """In C order, in Fortran's, every other row of one, and of whole numbers."""
    values = np.arange(float(np.prod(shape))).reshape(shape)
    return [values, np.asfortranarray(values), np.repeat(values, 2, 0)[::2], values.astype(np.int64)]


@pytest.mark.parametrize("kind", range(4))
def test_each_element_is_numpys(kind: int) -> None:
    functions: list[tuple[Any, tuple[int, ...]]] = [(_line, (4,)), (_plane, (4, 3)), (_space, (2, 3, 4))]
    for function, shape in functions:
        for index in product(*(range(-n, n) for n in shape)):
            ours, numpys = arrays(*shape)[kind], arrays(*shape)[kind]
            assert function(ours, *index, 7.0) == plain(function)(numpys, *index, 7.0)
            np.testing.assert_array_equal(ours, numpys)


@pytest.mark.parametrize("whole", [np.int8, np.int32, np.uint8, np.uint64])
def test_whole_numbers_of_other_sizes_point_to_the_same(whole: type[Any]) -> None:
    ours, numpys = arrays(4, 3)[0], arrays(4, 3)[0]
    assert _plane(ours, whole(2), whole(1), 7.0) == plain(_plane)(numpys, 2, 1, 7.0)
    np.testing.assert_array_equal(ours, numpys)


def test_arrays_within_records_are_the_records_own() -> None:
    ours, numpys = np.zeros(3, SEEN), np.zeros(3, SEEN).view(np.recarray)
    for i, j, k in product(range(-3, 3), range(-2, 2), range(-3, 3)):
        value = float(100 * i + 10 * j + k)
        assert _record(ours, i, j, k, value) == plain(_record)(numpys, i, j, k, value)
    assert ours.tobytes() == numpys.tobytes()


def test_what_is_no_single_element_is_a_view_as_ever() -> None:
    x = np.arange(12.0).reshape(4, 3)
    assert _rows(x, 1) == plain(_rows)(x, 1)
    assert _rows(x, -1) == plain(_rows)(x, -1)


def test_this_is_how_elements_are_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not numba's own way, which takes a tenth longer."""
    places: list[int] = []
    place = compiler_elements._place

    def counted(builder: Any, array: Any, indices: list[Any]) -> Any:
        places.append(len(indices))
        return place(builder, array, indices)

    monkeypatch.setattr(compiler_elements, "_place", counted)

    def moved(x: Any, i: int) -> None:
        x[i, 1] = x[i, 2]
        x[0, 0] = x[1][0]

    for kind, expected in ((numba.float64[:, ::1], [2, 2, 1, 2]), (numba.float64[::1, :], list[int]())):
        places.clear()
        # a function's body, for that is never kept: what has been compiled before would come from the cache
        compiler.Body(moved, targetoptions=compiler.OPTIONS).compile((kind, numba.int64))
        assert places == expected
