"""From numba's code to LLVM's and to machine code: borrowed arrays, and no passes over what is only declared.

Arrays that one of our functions is given it does not count in and out, which numba does by a locked instruction at
every call within a loop: they are the caller's until the function returns. Machine code is for what Python calls
alone; of other functions, numba's own ones among them, LLVM's code is kept for those that call them.
"""

from __future__ import annotations

from typing import Any

from numba.core import errors, ir, lowering, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering

_TUPLE: Any = types.BaseTuple
_while = vars(errors)["new_error_context"]


class _Lower(lowering.Lower):
    """Arrays that a function is given stay with who calls it, until it returns: in here nobody counts them."""

    def lower_block(self, block: Any) -> None:
        # numba makes what an error would say for each statement
        self.pre_block(block)
        with _while("lowering at {place.loc}", place=self):
            for statement in block.body:
                self.loc = statement.loc
                self.lower_inst(statement)
        self.post_block(block)

    def lower_assign(self, ty: Any, inst: Any) -> Any:
        if isinstance(inst.value, ir.Arg) and not _arrays_in(self.fndesc.restype):
            given, at = list(self.fnargs), inst.value.index
            given[at] = _borrowed(self.context, self.builder, ty, given[at])
            self.fnargs = given
        return super().lower_assign(ty, inst)


def _arrays_in(kind: Any) -> bool:
    """A result may be one of the arguments, or a part of it, and must be owned."""
    return isinstance(kind, types.Array) or (isinstance(kind, _TUPLE) and any(_arrays_in(k) for k in kind))


def _borrowed(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """An argument whose arrays have no owner."""
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        for owner in ("meminfo", "parent"):
            setattr(array, owner, getattr(array, owner).type(None))
        return array._getvalue()
    if isinstance(kind, _TUPLE):
        for k, part in enumerate(kind):
            value = builder.insert_value(value, _borrowed(context, builder, part, builder.extract_value(value, k)), k)
    return value


class _Library(JITCodeLibrary):
    """LLVM's code of functions, and their machine code."""

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout
        for function in ll_module.functions:
            if not function.is_declaration:  # numba makes passes for those too, nine of ten
                # the whole of it is optimised in earnest when it is linked; until then the cheap passes will do
                passes, options = self._codegen._function_pass_manager(opt=1, loop_vectorize=False, slp_vectorize=False)
                passes.run(function, options)


class _BodyLibrary(_Library):
    """LLVM's code of one function, for what Python calls to link and optimise: no machine code of its own."""

    def finalize(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def with_callees(self) -> list[Any]:
        """This and all that it calls, directly or not."""
        return list(dict.fromkeys([self, *self._linking_libraries]))


@register_pass(mutates_CFG=True, analysis_only=False)
class Lowering(NativeLowering):
    """numba's last step, into one of these libraries."""

    _name = "native_lowering_for_callers"

    def run_pass(self, state: Any) -> Any:
        """Make LLVM's code, and machine code of it where Python calls it."""
        if state.library is None:
            for_python, flags = state.pipeline.for_python, state.flags
            # numba compiles its own functions anew for other flags, so these are set where it does not look any more
            flags.no_compile = flags.no_cpython_wrapper = not for_python
            flags.no_cfunc_wrapper = True
            kind = _Library if for_python else _BodyLibrary
            state.library = kind(state.targetctx.codegen(), state.func_id.func_qualname)
            if for_python:
                state.library.enable_object_caching()
        return super().run_pass(state)


@register_pass(mutates_CFG=True, analysis_only=False)
class BorrowingLowering(Lowering):
    """The same for functions that do not give back what they are given but as an array, alone or in a tuple."""

    _name = "native_lowering_of_borrowed_arrays"

    @property
    def lowering_class(self) -> Any:
        """What writes LLVM's code."""
        return _Lower
