"""What the compiler remembers of types changes no result and spares asking; what takes long to compile is not used."""

from __future__ import annotations

import ast
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core import types

from fes.estimation import compiled
from fes.estimation.compiled import jit, jit_ieee
from fes.estimation.compiler_types import Operation


def mixed(x: float, n: int, values: Any) -> float:
    """Operations of the same operators on several kinds of numbers, some of them literal."""
    total = x + 2 + n * 3.0 + values[0] + values[n]
    values[n] = total
    for i in range(n):
        total += float(values[i]) * i - n % 3 + i // 2 + x**2 - max(x, 1.0) + min(n, 2)
    return float(total)


@jit_ieee
def share_ieee(x: float, n: int) -> float:
    return x / n + max(x, 0.0)


@jit
def share_checked(x: float, n: int) -> float:
    return x / n + max(x, 0.0)


@jit
def _doubled(x: Any, i: int) -> float:
    return float(x[i] * 2.0)


@jit
def _between(x: Any, i: int) -> float:
    return _doubled(x, i) + _doubled(x, i + 1)


@jit
def called_through(x: Any) -> float:
    total = 0.0
    for i in range(x.shape[0] - 1):
        total += _between(x, i) - _doubled(x, i)
    return total


def test_what_is_remembered_changes_no_result() -> None:
    compiled_one = jit(mixed)
    for kind in (np.float64, np.float32, np.int64):
        ours, theirs = np.arange(7).astype(kind), np.arange(7).astype(kind)
        assert compiled_one(1.5, 4, ours) == pytest.approx(mixed(1.5, 4, theirs), rel=1e-6)
        assert ours.tolist() == theirs.tolist()


def test_each_model_of_errors_keeps_its_own_division() -> None:
    """Operators are remembered for all functions alike; what they are compiled to is not."""
    assert share_ieee(1.0, 0) == math.inf
    with pytest.raises(ZeroDivisionError):
        share_checked(1.0, 0)
    assert share_ieee(3.0, 2) == share_checked(3.0, 2) == 4.5


def test_what_is_called_through_others_is_linked_once_and_for_all() -> None:
    x = np.arange(6, dtype=float)
    assert called_through(x) == 2.0 * x[1:].sum()
    assert _between(x, 1) == 6.0


def test_the_same_question_is_asked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[object, Any]] = []
    by_numba = types.Function.get_call_type

    def asking(self: Any, context: Any, args: Any, kws: Any) -> Any:
        if type(self) is Operation:
            asked.append((self.typing_key, args))
        return by_numba(self, context, args, kws)

    monkeypatch.setattr(types.Function, "get_call_type", asking)

    def chain(a: Any, b: Any, c: Any) -> Any:
        return a + b + c + a - b - c + b * c * a + (a + b) * (b - c)

    assert jit(chain)(np.float32(1.0), np.float32(2.0), np.float32(3.0)) == chain(1.0, 2.0, 3.0)
    assert len(asked) == len(set(asked)) <= 3


def test_no_slice_is_copied_in_compiled_code() -> None:
    """``a[i:j] = b``, b an array, brings in numba's code for strings, for a message: three seconds of compiling."""
    copied = []
    for source in compiled._sources():
        for function in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            if not isinstance(function, ast.FunctionDef) or not {
                name.id for name in function.decorator_list if isinstance(name, ast.Name)
            } & {"jit", "inlined", "jit_ieee", "jit_fused"}:
                continue
            for node in ast.walk(function):
                if not isinstance(node, ast.Assign):
                    continue
                sides = ast.walk(node.value), (part for target in node.targets for part in ast.walk(target))
                if all(any(isinstance(part, ast.Slice) for part in side) for side in sides):
                    copied.append(f"{Path(source).name}:{node.lineno}")
    assert not copied
