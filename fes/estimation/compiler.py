"""numba's compiler, made to do less: each function once, and machine code only for what Python calls.

By itself numba gives every function machine code, two wrappers (for Python and for C) and a file in the cache, and then
compiles all of it into each of its callers once more. Of our functions Python calls one in four. So here a function's
body is compiled for its callers (:meth:`Function.body`), and a wrapper, machine code and a place in the cache are for
what Python calls, at its first call. Arithmetic and its order are untouched. A cache that cannot be written to, for
lack of space or of rights, costs time at the next start and nothing else.

This reaches deeper into numba than its documented interface: ``pyproject.toml`` holds numba to a release that the tests
have seen.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import compiler, dispatcher, sigutils, types
from numba.core.caching import FunctionCache, NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.runtime.nrt import rtsys
from numba.core.typing.templates import make_concrete_template

STACK_SLOTS = 1 << 16
_FunctionCompiler: Any = vars(dispatcher)["_FunctionCompiler"]
OPTIONS = {"nopython": True, "boundscheck": None, "fastmath": False, "nogil": True, "no_cfunc_wrapper": True}


class _BodyLibrary(JITCodeLibrary):
    """LLVM's code of one function, to be compiled into others: no machine code of its own."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class _BodyPipeline(compiler.Compiler):
    def __init__(self, typing_context: Any, target_context: Any, _: None, *rest: Any) -> None:
        super().__init__(typing_context, target_context, _BodyLibrary(target_context.codegen(), "body"), *rest)


class _Body(_FunctionCompiler):
    """Compiles a function for its callers."""

    def _customize_flags(self, flags: Any) -> Any:
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        return flags


class _Cache(FunctionCache):
    """numba's, but one that says once that it cannot be written to instead of ending the session."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)  # all that finished code needs; numba would load what compiling needs, too
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            unkept(error)


class Function(CPUDispatcher):
    """A compiled function, for Python and for other compiled functions."""

    def __init__(self, py_func: Callable[..., Any], locals: Any = None, targetoptions: Any = None) -> None:
        super().__init__(py_func, locals, targetoptions)
        self._cache: Any = NullCache()  # until the first call from Python
        self._bodies: dict[Any, tuple[object, Any]] = {}
        self._body = _Body(py_func, self.targetdescr, self.targetoptions, self.locals, _BodyPipeline)

    def body(self, args: tuple[Any, ...]) -> Any:
        """What compiling for these types of arguments gave, for callers."""
        if args not in self._bodies:
            with global_compiler_lock:
                result, key = self._body.compile(args, None), object()
                self.targetctx.insert_user_function(key, result.fndesc, [result.library])
            self._bodies[args] = key, result
        return self._bodies[args][1]

    def compile(self, sig: Any) -> Any:
        """Compile for a call from Python, or fetch it from the cache."""
        if isinstance(self._cache, NullCache):
            try:
                self._cache = _Cache(self.py_func)
            except (OSError, RuntimeError) as error:  # the latter is how numba says that it found no folder
                unkept(error)
        with undisturbed():
            return _in_one_piece(super().compile, sig)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What numba asks for at a call from other compiled code."""
        pysig, args = self._body.fold_argument_types(args, kws)
        self.body(tuple(types.unliteral(kind) for kind in args))
        name, signatures = self.py_func.__name__, [result.signature for _, result in self._bodies.values()]
        return make_concrete_template(f"CallTemplate({name})", name, signatures), pysig, args, {}

    def get_overload(self, sig: Any) -> Any:
        """The key under which numba finds the body."""
        return self._bodies[tuple(sigutils.normalize_signature(sig)[0])][0]


_told: list[Exception] = []


def unkept(error: Exception) -> None:
    """Say once that compiled code cannot be kept."""
    if not _told:
        _told.append(error)
        logging.getLogger(__name__).warning(
            "Compiled code cannot be kept, so the next start takes as long as this one: %s. Make room there, or name "
            "another folder in XDG_CACHE_HOME.", error
        )  # fmt: skip


@contextmanager
def undisturbed() -> Iterator[None]:
    """Without Python's collector of garbage, which walks through all that numba builds again and again."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def _in_one_piece(function: Callable[[Any], Any], argument: Any) -> Any:
    return function(argument)


# Python's own stack comes in pieces of 16 KB; when calls go back and forth over the end of one, a piece is fetched from
# the system and given back each time, which took a seventh of the time of compiling. A frame with room for this many
# values has a piece of its own, with as much room again for those above it.
_in_one_piece.__code__ = _in_one_piece.__code__.replace(co_stacksize=STACK_SLOTS)
