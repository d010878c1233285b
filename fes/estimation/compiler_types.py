"""numba's knowledge of types, with a memory.

For each ``a + b`` and ``x[i]`` numba tries its ways to type it one after the other, although a kernel asks the same of
a thousand statements, and asks again when it turns them into LLVM's code. That took an eighth of the time of compiling.
Here the answer for given types of arguments is kept. What numba compiles for an operation depends on the compiler's
options, and is asked anew.
"""

from __future__ import annotations

import functools
from typing import Any

from numba.core import types
from numba.core.datamodel import models
from numba.core.datamodel.registry import register_default
from numba.core.registry import cpu_target
from numba.core.typing.context import Context


class Operation(types.Function):
    """A function or an operator of numba's."""

    def __init__(self, kind: Any) -> None:
        super().__init__(kind.templates)
        self._known: dict[Any, Any] = {}

    def known(self, args: Any, kws: Any) -> Any:
        """The types of arguments and result when it is called with such arguments, if that has been asked before."""
        signature = None if kws else self._known.get(args)
        if signature is not None:
            vars(self)["_impl_keys"][signature.args] = self.typing_key
        return signature

    def get_call_type(self, context: Any, args: Any, kws: Any) -> Any:
        """The types of arguments and result when it is called with such arguments.

        Raises:
            TypingError: it cannot be.
        """
        signature = self.known(args, kws)
        if signature is None:
            signature = super().get_call_type(cpu_target.typing_context, args, kws)
            compiled = signature is None or self.get_impl_key(signature) is not self.typing_key
            if not kws and not compiled:
                self._known[args] = signature
        return signature


register_default(Operation)(models.OpaqueModel)
_operation = functools.cache(Operation)


class Types(Context):
    """What numba knows, not a copy of it, with :class:`Operation` in the place of functions and operators."""

    def __init__(self) -> None:
        self.__dict__ = vars(cpu_target.typing_context)

    def refresh(self) -> None:
        """Take in what has been declared since."""
        cpu_target.typing_context.refresh()

    def _lookup_global(self, value: Any) -> Any:
        kind = super()._lookup_global(value)
        return _operation(kind) if type(kind) is types.Function else kind

    def resolve_function_type(self, func: Any, args: Any, kws: Any) -> Any:
        """The types of arguments and result when something is called with such arguments; None if it cannot be."""
        kind = func if isinstance(func, types.Type) else self._lookup_global(func)
        known = kind.known(args, kws) if isinstance(kind, Operation) else None
        return known or super().resolve_function_type(func, args, kws)
