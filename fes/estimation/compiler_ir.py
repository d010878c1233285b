"""numba's steps before LLVM, without asking again what has been answered.

A function that becomes part of its callers numba takes apart from Python's bytecode once more at each place of each
caller. For a type's size it writes a module for LLVM, lets it read that, and asks for the size of what stands in there.
It takes each value apart for arrays to count, also where there can be none. And it looks through all its modules for
declarations again whenever something is not there that mostly is not. What comes out is the same.
"""

from __future__ import annotations

from typing import Any, ClassVar

from numba.core import inline_closurecall
from numba.core.compiler_machinery import register_pass
from numba.core.cpu import CPUContext
from numba.core.runtime.context import NRTContext
from numba.core.untyped_passes import InlineInlinables


class _Inliner(inline_closurecall.InlineWorker):
    """Keeps what it has taken apart: numba copies that for each place, and changes the copy."""

    _known: ClassVar[dict[Any, Any]] = {}

    def run_untyped_passes(self, func: Any, enable_ssa: bool = False) -> Any:
        if enable_ssa:
            return super().run_untyped_passes(func, enable_ssa)
        self.flags.enable_ssa = False
        if func not in self._known:
            self._known[func] = super().run_untyped_passes(func)
        return self._known[func]


@register_pass(mutates_CFG=True, analysis_only=False)
class Inlining(InlineInlinables):
    """numba's pass, with an inliner that remembers."""

    _name = "inline_inlinables_once_taken_apart"

    def _do_work(self, state: Any, work_list: Any, block: Any, i: int, expr: Any, inline_worker: Any) -> Any:
        inline_worker.__class__ = _Inliner
        return super()._do_work(state, work_list, block, i, expr, inline_worker)


class _Counting(NRTContext):
    """Finds the arrays to count in what a function uses; what can hold none is not taken apart for that."""

    _may_hold: ClassVar[dict[int, bool]] = {}

    def get_meminfos(self, builder: Any, ty: Any, val: Any) -> list[Any]:
        """What of a value is counted, with its type."""
        may_hold = self._may_hold.get(ty._code)
        if may_hold is None:
            may_hold = self._may_hold[ty._code] = self._context.data_model_manager[ty].contains_nrt_meminfo()
        return super().get_meminfos(builder, ty, val) if may_hold else []


class Target(CPUContext):
    """What numba knows of the processor: a copy, with a memory."""

    _sizes: ClassVar[dict[str, int]] = {}

    @property
    def nrt(self) -> Any:
        """What counts arrays."""
        return _Counting(self, self.enable_nrt)

    def __init__(self, like: CPUContext) -> None:
        self.__dict__ = dict(vars(like))

    def get_abi_sizeof(self, ty: Any) -> int:
        """Size of one of LLVM's types, in bytes."""
        name = str(ty)
        if name not in self._sizes:
            self._sizes[name] = super().get_abi_sizeof(ty)
        return self._sizes[name]

    def get_function(self, fn: Any, sig: Any, _firstcall: bool = True) -> Any:
        """What makes LLVM's code of an operation.

        Raises:
            NotImplementedError: there is nothing for these types.
        """
        return super().get_function(fn, sig, _firstcall and fn not in SELDOM)


SELDOM = "__array__", "static_getitem", "static_setitem"  # numba asks for these, and has another way without
