"""numba's compiler, made to do less: each function once, and machine code only for what Python calls.

By itself numba gives every function machine code, two wrappers (for Python and for C) and a file in the cache, and then
compiles all of it into each of its callers once more. Of our functions Python calls one in four. So here a function's
body is compiled for its callers (:class:`Body`), and linking, optimising, a wrapper, machine code and a place in the
cache are for what Python calls, at its first call. Nor has what numba compiles of its own for us machine code, which
took a twelfth of the time. Arithmetic and its order are untouched. A cache that cannot be written to, for lack of space
or of rights, costs time at the next start and nothing else.

This reaches deeper into numba than its documented interface: it is for releases that the tests have seen
(:mod:`fes.estimation.compiled`).
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import compiler, types
from numba.core.caching import NullCache
from numba.core.registry import CPUDispatcher
from numba.core.registry import cpu_target as NUMBA
from numba.core.target_extension import CPU, dispatcher_registry
from numba.core.typed_passes import NativeLowering, NopythonRewrites
from numba.core.untyped_passes import InlineInlinables

import fes.estimation.compiler_elements  # noqa: F401 - what it declares
from fes.estimation.compiled import unkept
from fes.estimation.compiler_cache import Cache
from fes.estimation.compiler_ir import Inlining, Target
from fes.estimation.compiler_llvm import BorrowingLowering, Lowering
from fes.estimation.compiler_spared import spared
from fes.estimation.compiler_types import Types

STACK_SLOTS = 1 << 16
MANY_OBJECTS = 50_000  # more than loading finished code makes, less than compiling the least function
OPTIONS = {"nopython": True, "boundscheck": None, "fastmath": False, "nogil": True, "no_cfunc_wrapper": True}
NEEDLESS = (NopythonRewrites,)  # arithmetic of whole arrays in one loop: ours is of numbers


class _Pipeline(compiler.Compiler):
    """numba's steps, some of them replaced."""

    for_python = False
    lowering: Any = Lowering

    def __init__(self, *rest: Any) -> None:
        super().__init__(*rest)
        self.state.targetctx = Target(self.state.targetctx)
        self.state.typingctx = self.state.targetctx.typing_context = Types()

    def define_pipelines(self) -> Any:
        ours, managers = {NativeLowering: self.lowering, InlineInlinables: Inlining}, super().define_pipelines()
        for manager in managers:
            manager.passes = [(ours.get(step, step), why) for step, why in manager.passes if step not in NEEDLESS]
        return managers


class _KernelPipeline(_Pipeline):
    lowering = BorrowingLowering


class _PythonPipeline(_KernelPipeline):
    for_python = True

    def compile_extra(self, func: Any) -> Any:
        """Compile, while what numba compiles of its own gets no machine code."""
        dispatcher_registry.update({CPU: Body})
        try:
            with spared():
                return super().compile_extra(func)
        finally:
            dispatcher_registry.update({CPU: CPUDispatcher})


class Body(CPUDispatcher):
    """A function that only other compiled functions call: numba's own ones, as they are needed, and ours."""

    def __init__(
        self, py_func: Any, locals: Any = None, targetoptions: Any = None, pipeline_class: Any = _Pipeline
    ) -> None:
        super().__init__(py_func, locals, targetoptions, pipeline_class)

    def compile(self, sig: Any) -> Any:
        """Compile for these types, once."""
        return None if sig in self.overloads else super().compile(sig)

    def add_overload(self, cres: Any) -> None:
        """Take what compiling for some types of arguments gave, for callers."""
        key = object()
        self.targetctx.insert_user_function(key, cres.fndesc, cres.library.with_callees())
        self.overloads[tuple(cres.signature.args)] = cres._replace(entry_point=key)


class Function(CPUDispatcher):
    """A compiled function, for Python and for other compiled functions."""

    def __init__(self, py_func: Callable[..., Any], locals: Any = None, targetoptions: Any = None) -> None:
        super().__init__(py_func, locals, targetoptions, _PythonPipeline)
        self._cache: Any = NullCache()  # until the first call from Python
        self._body = Body(py_func, locals, targetoptions, _KernelPipeline)

    def compile(self, sig: Any) -> Any:
        """Compile for a call from Python, or fetch it from the cache."""
        if isinstance(self._cache, NullCache):
            try:
                self._cache = Cache(self.py_func)
            except (OSError, RuntimeError) as error:  # the latter is how numba says that it found no folder
                unkept(error)
        with undisturbed():
            return _in_one_piece(super().compile, sig)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What numba asks for at a call from other compiled code."""
        pysig, args = self._body.fold_argument_types(args, kws)
        template, *_ = self._body.get_call_template(tuple(types.unliteral(kind) for kind in args), {})
        return template, pysig, args, {}

    def get_overload(self, sig: Any) -> Any:
        """The key under which numba finds the body."""
        return self._body.get_overload(sig)


def load() -> None:
    """Load what only compiling needs; by itself that comes with the first function."""
    NUMBA.typing_context.refresh()
    NUMBA.target_context.refresh()


@contextmanager
def undisturbed() -> Iterator[None]:
    """Without Python's collector of garbage, which walks through all that numba builds again and again.

    Nor does it afterwards: what compiling leaves stays as long as the process.
    """
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            if gc.get_count()[0] > MANY_OBJECTS:
                gc.freeze()
            gc.enable()


def _in_one_piece(function: Callable[[Any], Any], argument: Any) -> Any:
    return function(argument)


# Python's own stack comes in pieces of 16 KB; when calls go back and forth over the end of one, a piece is fetched from
# the system and given back each time, which took a seventh of the time of compiling. A frame with room for this many
# values has a piece of its own, with as much room again for those above it.
_in_one_piece.__code__ = _in_one_piece.__code__.replace(co_stacksize=STACK_SLOTS)
