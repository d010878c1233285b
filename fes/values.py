"""Frozen values that are made as fast as others: several are made at every sample."""

from __future__ import annotations

from dataclasses import MISSING, Field
from typing import Any, TypeVar

Value = TypeVar("Value")


def quick(frozen: type[Value]) -> type[Value]:
    """Give a ``dataclass(frozen=True, slots=True)`` an ``__init__`` that takes a third of the time.

    Python's own sets each field past the frozen class, with a call for each. This one lets the object be of a class
    with the same slots that is not frozen until its fields are set. Its arguments and their defaults stay as they were,
    and so does that nothing of the object can be changed afterwards. What is derived from it cannot be made.

    Raises:
        TypeError: the class has what this does not do: ``__post_init__``, or fields other than plain ones.
    """
    fields: dict[str, Field[Any]] = vars(frozen)["__dataclass_fields__"]
    plain = all(field.init and not field.kw_only for field in fields.values())
    if not plain or hasattr(frozen, "__post_init__") or tuple(fields) != vars(frozen).get("__slots__"):
        raise TypeError(f"{frozen.__name__} has more than plain fields")
    open_one = type(frozen.__name__, (), {"__slots__": tuple(fields)})
    known: dict[str, Any] = {"OpenOne": open_one, "Frozen": frozen, "become": vars(object)["__class__"].__set__}
    arguments, lines = ["self"], ["become(self, OpenOne)"]
    for name, field in fields.items():
        value = name
        if field.default is not MISSING:
            known[f"_{name}"] = field.default
            arguments.append(f"{name}=_{name}")
        elif field.default_factory is not MISSING:
            known["MISSING"], known[f"_{name}"] = MISSING, field.default_factory
            arguments.append(f"{name}=MISSING")
            value = f"_{name}() if {name} is MISSING else {name}"
        else:
            arguments.append(name)
        lines.append(f"self.{name} = {value}")
    lines.append("self.__class__ = Frozen")
    exec(f"def __init__({', '.join(arguments)}):\n  " + "\n  ".join(lines), known)
    made, own = known["__init__"], vars(frozen)["__init__"]
    made.__annotations__, made.__qualname__, made.__module__ = own.__annotations__, own.__qualname__, own.__module__
    setattr(frozen, "__init__", made)  # noqa: B010 - by name, for a type checker takes it for a method of its own
    return frozen
