"""What is wrong with a sidecar, in lines of ``file:line: key = value: what is allowed``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

_HEADER = re.compile(r"\s*\[([^\[\]]+)\]")
_KEY = re.compile(r"\s*([\w.\"'-]+)\s*=")


def explain_sidecar(error: ValidationError, model: type[BaseModel], path: Path, text: str) -> str:
    """Return one line per fault; ``model`` is what the text should have been and gives the names allowed."""
    lines_of = _lines_of(text)
    said = []
    for fault in error.errors(include_url=False):
        place = tuple(str(part) for part in fault["loc"] if part != "[key]")
        message = fault["msg"].removeprefix("Value error, ")
        if fault["type"] == "missing":
            message = "is required and missing"
        elif place[:1] == ("sensors",) and len(place) == 2 and fault["type"] == "literal_error":
            message = (
                "which sensor is it? Write one of 'left_foot', 'right_foot', 'left_shank', 'right_shank' instead "
                "(or foot_a and foot_b for two feet of which nobody knows the side)"
            )
        elif place[-1:] == ("rate_hz",) and fault.get("input") == 0:
            message = "must be greater than 0: how many samples a second was the sensor set to?"
        elif fault["type"] == "tuple_type":
            message = 'must be a list of three column names, x, y, z: ["…", "…", "…"]'
        elif fault["type"] == "extra_forbidden":
            message = f"is not a setting; allowed are {', '.join(_names_in(model, place[:-1]))}"
        value = fault.get("input")
        shown = f" = {value!r:.80}" if isinstance(value, (str, int, float, list)) and place[-1:] != (value,) else ""
        line = next((lines_of[place[:size]] for size in range(len(place), 0, -1) if place[:size] in lines_of), 0)
        said.append(f"{path}{f':{line}' if line else ''}: {'.'.join(place) or 'sidecar'}{shown}: {message}")
    return "\n".join(dict.fromkeys(said))


def _names_in(model: Any, place: tuple[str, ...]) -> list[str]:
    """The settings of the table at a place: follow the models' fields, through mappings and options."""
    if isinstance(model, type) and issubclass(model, BaseModel):
        if not place:
            return list(model.model_fields)
        field = model.model_fields.get(place[0])
        return _names_in(field.annotation, place[1:]) if field else []
    inner = [part for part in get_args(model) if isinstance(part, type) and issubclass(part, BaseModel)]
    is_mapping = getattr(model, "__origin__", None) is dict
    return _names_in(inner[0], place[1:] if is_mapping else place) if inner else []


def _lines_of(text: str) -> dict[tuple[str, ...], int]:
    """Line number of every table header and of every key that begins a line, by its path."""
    lines_of: dict[tuple[str, ...], int] = {}
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.split("\n"), start=1):
        if header := _HEADER.match(line):
            table = _parts(header[1])
            lines_of.setdefault(table, number)
        elif key := _KEY.match(line):
            lines_of.setdefault(table + _parts(key[1]), number)
    return lines_of


def _parts(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in dotted.split("."))
