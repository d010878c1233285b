"""What numba is spared changes no machine code, and is there again afterwards, for others too."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from numba import njit
from numba.core import compiler as numba_compiler
from numba.core.caching import NullCache
from numba.core.codegen import JitEngine
from numba.core.errors import NumbaError
from numba.core.ir import Inst
from numba.core.registry import CPUDispatcher
from numba.core.target_extension import CPU, dispatcher_registry

from fes.estimation import compiler
from fes.estimation.compiled import inlined, jit
from fes.estimation.compiler_spared import SPARED, spared


@inlined
def _turned(x: float, y: float, left: bool) -> tuple[float, float]:
    if left:
        return -y, x
    return y, -x


@jit
def _longest(values: Any, begin: int) -> float:
    longest = 0.0
    for row in values[begin:]:
        longest = max(longest, row[0] ** 2 + row[1] ** 2)
    return longest


def walk(values: Any, begin: int) -> float:
    """Loops, conditions, slices, calls, arrays of its own, numba's own functions."""
    turns = np.zeros((values.shape[0], 2))
    for i in range(begin, values.shape[0]):
        turns[i, 0], turns[i, 1] = _turned(values[i, 0], values[i, 1], i % 2 == 0)
    if begin > 2 and not values[0, 0] > 1.0:
        return min(_longest(turns, begin), 3.0)
    return float(_longest(turns, 0) + abs(values[:, 1].sum()))


def theirs() -> list[Any]:
    """What numba has now where it is spared something."""
    return [vars(owner).get(name) for owner, name, _ in SPARED]


@pytest.fixture(autouse=True)
def not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each test compiles."""
    monkeypatch.setattr(compiler, "Cache", lambda _: NullCache())


def machine_code(function: Any) -> list[str]:
    """Instructions and constants, without names, in which numba numbers the functions."""
    (compiled,) = function.overloads.values()
    lines = re.findall(r"^\t(?:[a-z]|\.quad).*", compiled.library.get_asm_str(), re.MULTILINE)
    return [re.sub(r"[\w.$]*_ZN[\w.$]*", "name", line) for line in lines]


def test_the_machine_code_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    values, ours = np.random.default_rng(0).normal(size=(9, 2)), jit(walk)
    assert ours(values, 1) == pytest.approx(walk(values, 1), rel=1e-12)

    @contextmanager
    def nothing_spared() -> Iterator[None]:
        yield

    monkeypatch.setattr(compiler, "spared", nothing_spared)
    monkeypatch.setattr(compiler, "NEEDLESS", ())
    whole = jit(walk)
    assert whole(values, 1) == ours(values, 1)
    assert len(machine_code(ours)) > 200
    assert machine_code(whole) == machine_code(ours)


def test_numba_is_left_as_it_was() -> None:
    before = theirs()
    jit(walk)(np.ones((3, 2)), 0)
    assert theirs() == before
    assert dispatcher_registry[CPU] is CPUDispatcher


def test_so_it_is_after_an_error() -> None:
    def wrong(x: Any) -> Any:
        return x + "text"

    before = theirs()
    with pytest.raises(NumbaError, match=r"unicode_type"):
        jit(wrong)(1.0)
    assert theirs() == before
    assert dispatcher_registry[CPU] is CPUDispatcher


def test_numba_compiles_for_others_what_it_compiled_for_us() -> None:
    """Its own functions have no machine code then, but what others need."""
    values = np.arange(8.0).reshape(4, 2)
    ours, others = jit(walk)(values, 1), njit(walk)(values, 1)
    assert ours == others == walk(values, 1)
    assert njit(lambda x: np.zeros(3) + max(x, 1.0))(2.0).tolist() == [2.0] * 3


def test_what_numba_compiles_for_us_gets_no_machine_code(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    make = JitEngine.add_module
    monkeypatch.setattr(JitEngine, "add_module", lambda self, module: (made.append(module.name), make(self, module))[1])

    def emptied(n: int) -> float:
        return float(np.full((n, 3, 1), 2.5)[0, 0, 0] + max(1, 2, n))

    assert jit(emptied)(3) == 5.5
    assert len(made) == 1


SOURCE = """
    def with_much(a, b, n, *rest):
        out = [b[0, n], a[1:] != b[n, 0]]
        while n > 0:
            n, a[n:] = n - 1, b[n:, 0] if rest else 1.0
            out.append(max(n, a[0], key=None))
        return {"a": (a, n), "out": [out, rest]}
"""


def test_the_variables_of_each_statement_are_numbas() -> None:
    names: dict[str, Any] = {}
    exec(textwrap.dedent(SOURCE), names)
    code = numba_compiler.run_frontend(names["with_much"])
    statements = [statement for block in code.blocks.values() for statement in block.body]
    parts = [part for statement in statements for part in vars(statement).values() if isinstance(part, Inst)]
    expected = [[str(variable) for variable in each.list_vars()] for each in (*statements, *parts)]
    with spared():
        assert [[str(variable) for variable in each.list_vars()] for each in (*statements, *parts)] == expected
    assert len(statements) > 50
