"""What numba is spared while one of our functions is compiled.

numba tells whoever listens about each call of LLVM, each lock and each step; asks after each step which variables live
where, which only the interpreter's objects and generators need; looks for a statement's variables by trying each of its
parts for five kinds one after the other; reads a function's signature whenever it looks one up; writes each statement
as text for a diary that nobody keeps; and imports all its modules again to see whether there is something new. That
took a fifth of the time of compiling. Here it is replaced for as long as one of our functions is compiled, and numba's
lock held. The machine code is the same, bit by bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from types import FunctionType, SimpleNamespace
from typing import Any

from numba.core import base, codegen, errors, event, ir, lowering, ssa, transforms
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import PassManager, _pass_registry
from numba.core.cpu import CPUContext
from numba.core.postproc import PostProcessor, VariableLifetime

_LLVM: Any = vars(codegen)["llvmir"]
_VARIABLE, _INSTRUCTION, _LIST, _DICTIONARY, _OTHER = range(5)
_KINDS = (ir.Var, _VARIABLE), (ir.Inst, _INSTRUCTION), ((list, tuple), _LIST), (dict, _DICTIONARY)
_kind_of: dict[type, int] = {}


def _variables(values: Iterable[Any], found: list[Any]) -> list[Any]:
    """Append the variables in parts of a statement, and in what is within these, in their order."""
    for value in values:
        kind = _kind_of.get(type(value))
        if kind is None:
            kind = next((kind for classes, kind in _KINDS if isinstance(value, classes)), _OTHER)
            _kind_of[type(value)] = kind
        if kind == _OTHER:
            continue
        if kind == _VARIABLE:
            found.append(value)
        elif kind == _INSTRUCTION:
            found += value.list_vars()
        else:
            _variables(value if kind == _LIST else value.values(), found)
    return found


def _of_statement(statement: Any) -> list[Any]:
    return _variables(vars(statement).values(), [])


def _of_expression(expression: Any) -> list[Any]:
    return _variables(expression._kws.values(), [])


_after_each_step = PostProcessor.run


def _after_step(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    code = self.func_ir
    if code.is_generator:
        _after_each_step(self, emit_dels, extend_lifetimes)
        return
    code.blocks = transforms.canonicalize_cfg(code.blocks)
    code.variable_lifetime = VariableLifetime(code.blocks)
    code.generator_info = None
    if emit_dels:
        self._insert_var_dels(extend_lifetimes=extend_lifetimes)


_has_loc, _while = vars(base)["_has_loc"], vars(errors)["new_error_context"]


def _has_place(function: Any) -> Any:
    """Whether a function has an argument ``loc``."""
    if type(function) is not FunctionType or vars(function).keys() & {"__wrapped__", "__signature__"}:
        return _has_loc(function)
    code = function.__code__
    return "loc" in code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]


def _run_step(self: Any, _: int, step: Any, state: Any) -> None:
    """Run one of the compiler's steps, without a diary of it and without checks of numba's own work."""
    step.analysis = self._analysis
    with _while("Pass {name}", name=step.name()):
        for part in (step.run_initialization, step.run_pass, step.run_finalizer):
            part(state)
    if _pass_registry.get(type(step)).mutates_CFG:
        PostProcessor(state.func_ir).run()


def _written(self: Any) -> str:
    """One instruction of LLVM's, as text."""
    parts = [] if isinstance(self.type, _LLVM.VoidType) else [self.get_reference(), " = "]
    self.descr(parts)
    return "".join(parts).rstrip()


def _declared_since(self: Any) -> None:
    """The modules are there since compiling began; they may have declared more."""
    for registry in list(self._registries):
        self.install_registry(registry)


def _nothing(*_: Any, **__: Any) -> None:
    pass


SPARED: tuple[tuple[Any, str, Any], ...] = (
    (ir.Stmt, "list_vars", _of_statement),
    (ir.Expr, "list_vars", _of_expression),
    (PostProcessor, "run", _after_step),
    (base, "_has_loc", _has_place),
    (event, "start_event", _nothing),
    (event, "end_event", _nothing),
    (PassManager, "_runPass", global_compiler_lock(_run_step)),
    (_LLVM.NamedValue, "_to_string", _written),
    (lowering, "str", _nothing),  # each statement, for debugging
    (ssa, "_logger", SimpleNamespace(debug=_nothing)),
    (CPUContext, "load_additional_registries", _declared_since),
)


@contextmanager
def spared() -> Iterator[None]:
    """Spare numba all this within. Only for who holds numba's lock."""
    before = [vars(owner).get(name) for owner, name, _ in SPARED]
    try:
        for owner, name, ours in SPARED:
            setattr(owner, name, ours)
        yield
    finally:
        for (owner, name, _), theirs in zip(SPARED, before, strict=True):
            if theirs is None:  # a builtin function
                delattr(owner, name)
            else:
                setattr(owner, name, theirs)
