"""What all settings have in common; pydantic's errors as lines of file, line, key, value and what is allowed."""

import re
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

Phase = Literal["stance", "pre_swing", "swing", "loading_response"]
PHASE_ORDER: tuple[Phase, ...] = ("stance", "pre_swing", "swing", "loading_response")
Foot = Literal["left_foot", "right_foot"]
SensorName = Literal["left_foot", "right_foot", "left_shank", "right_shank"]

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class ConfigError(ValueError):
    """The session file cannot be used; the message says where and what would be right."""


class Settings(BaseModel):
    """Base of all settings: frozen; an unknown key is an error, not a silent typo, and so is ``"3"`` for a number."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


def read_toml(path: Path, what: str, fault: type[ValueError]) -> tuple[dict[str, Any], str]:
    """What a TOML file holds, and its text; ``what`` it should be and the kind of ``fault`` are for the messages.

    Raises:
        ValueError: of the kind of ``fault``: the file cannot be read or is not TOML.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # some editors put a mark in front
        return tomllib.loads(text), text
    except OSError as error:
        raise fault(f"{path}: cannot be read: {error.strerror or error}. Name an existing {what} file.") from error
    except UnicodeDecodeError as error:
        raise fault(f"{path}: is not text (byte {error.start}). A {what} is a TOML file in UTF-8.") from error
    except tomllib.TOMLDecodeError as error:
        at = re.search(r"line (\d+)", str(error))
        line = text.splitlines()[int(at[1]) - 1] if at and int(at[1]) <= len(text.splitlines()) else ""
        comma = re.search(r"(?<![\w.])(-?\d+),(\d+)\s*(#|$)", line)
        hint = f". Decimals have a point: write {comma[1]}.{comma[2]}" if comma else ""
        raise fault(f"{path}: is not valid TOML: {error}{hint}") from error


def explain(
    error: ValidationError,
    path: Path,
    text: str,
    root: type[Settings],
    reword: Callable[[Mapping[str, Any], tuple[int | str, ...]], str] = lambda fault, location: "",
) -> str:
    """Put a pydantic error about ``root`` settings into lines of ``file:line: key = value: what is allowed``.

    ``reword`` may say of a fault at a location what is allowed, in better words; "" leaves it as it is.
    """
    lines_of = _lines_of(text)
    faults = []
    for fault in error.errors(include_url=False):
        location = tuple(part for part in fault["loc"] if part != "[key]")
        message = fault["msg"].removeprefix("Value error, ")
        if "options" in location[:-1]:  # one fault per type that it might have been
            location = location[: location.index("options") + 2]
            message = "Input should be text, a number, true or false"
        elif fault["type"] == "missing":
            message = "is required and missing"
        elif fault["type"] == "extra_forbidden":
            message = f"is not a setting; allowed are {', '.join(_settings_beside(root, location))}"
        message = reword(fault, location) or message
        key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
        value = fault.get("input")
        shown = f" = {value!r:.80}" if isinstance(value, (str, int, float, list)) else ""
        line = next((lines_of[location[:n]] for n in range(len(location), 0, -1) if location[:n] in lines_of), 0)
        place = f"{path}:{line}" if line else f"{path}"
        faults.append(f"{place}: {key or 'the file'}{shown}: {message}")
    return "\n".join(dict.fromkeys(faults))


def _settings_beside(root: type[Settings], location: tuple[int | str, ...]) -> list[str]:
    """The names allowed in the table that this key was found in."""
    table = root
    for name in (part for part in location[:-1] if isinstance(part, str)):
        field = table.model_fields.get(name)
        if field is not None:  # else it is a key of a mapping of tables, as in [geometry.left_foot]
            table = _table_in(field.annotation) or table
    return list(table.model_fields)


def _table_in(annotation: object) -> type[Settings] | None:
    """The kind of table that a setting holds, alone, in a list, in a mapping or as one of two."""
    if isinstance(annotation, type) and issubclass(annotation, Settings):
        return annotation
    return next((table for part in get_args(annotation) if (table := _table_in(part))), None)


_HEADER = re.compile(r"\s*(\[\[?)([^\[\]]+)\]")
_KEY = re.compile(r"\s*([\w.\"'-]+)\s*=")


def _lines_of(text: str) -> dict[tuple[int | str, ...], int]:
    """1-based line of every table header and of every key that begins a line, by its place in the parsed data."""
    lines_of: dict[tuple[int | str, ...], int] = {}
    entries: dict[tuple[int | str, ...], int] = {}  # so far, of each array of tables
    table: tuple[int | str, ...] = ()
    in_string = False
    for number, line in enumerate(text.split("\n"), start=1):
        inside, in_string = in_string, in_string ^ bool((line.count('"""') + line.count("'''")) % 2)
        if inside:
            continue
        if header := _HEADER.match(line):
            table = ()
            *parents, last = _parts(header[2])
            for name in parents:
                table += (name,)
                table += (entries[table] - 1,) if table in entries else ()
            table += (last,)
            if header[1] == "[[":
                entries[table] = entries.get(table, 0) + 1
                table += (entries[table] - 1,)
            lines_of.setdefault(table, number)
        elif key := _KEY.match(line):
            lines_of.setdefault(table + _parts(key[1]), number)
    return lines_of


def _parts(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in dotted.split("."))
