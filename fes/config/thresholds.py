"""``[thresholds]`` of a session: the guards' limits set for one person, and where they come from.

A number stands for the threshold itself, ``"x1.2"`` for 1.2 times what holds for this person anyway. ``origin`` says in
words who chose them; ``fes sweep --apply`` writes both.
"""

import difflib
import json
import math
import re
from collections.abc import Mapping
from typing import Any, Final

from statemachine.guards import Thresholds

ORIGIN: Final = "origin"
LEAST, MOST = 0.25, 4.0  # times the default, or what holds anyway: further off no gait was seen
_TABLE: Final = re.compile(r"^[ \t]*\[thresholds\][^\n]*\n(?:(?![ \t]*\[)[^\n]*(?:\n|\Z))*", re.MULTILINE)
_FACTOR: Final = re.compile(r"x(\d+(?:\.\d*)?|\.\d+)")

Value = bool | float | str


def changed_thresholds(own: Thresholds, changes: Mapping[str, Value]) -> Thresholds:
    """A person's thresholds with these set.

    Raises:
        ValueError: there is no such threshold, or a value is not of its kind.
    """
    now: dict[str, Any] = own._asdict()
    new: dict[str, Any] = {}
    for name, value in changes.items():
        if name == ORIGIN:
            continue
        if name not in now:
            near = difflib.get_close_matches(name, now, 1)
            raise ValueError(f"{name} is no threshold{f'; perhaps {near[0]}?' if near else ''}")
        factor = _FACTOR.fullmatch(value) if isinstance(value, str) else None
        if isinstance(now[name], bool):
            if not isinstance(value, bool):
                raise ValueError(f"thresholds.{name} = {value}: must be true or false")
            new[name] = value
        elif factor is not None:
            new[name] = now[name] * float(factor[1])
        elif isinstance(value, (bool, str)) or not 0.0 <= value < math.inf:
            raise ValueError(f"thresholds.{name} = {value}: must be a number, 0 or more")
        else:
            new[name] = float(value)
    return own._replace(**new)


def check_thresholds(changes: Mapping[str, Value]) -> None:
    """Refuse what no session may set.

    Raises:
        ValueError: as :func:`changed_thresholds`, or a value is further from the default than the stated bounds.
    """
    default = Thresholds()
    new = changed_thresholds(default, changes)
    for name, value in new._asdict().items():
        usual = getattr(default, name)
        if not isinstance(usual, bool) and not LEAST * usual <= value <= MOST * usual:
            raise ValueError(
                f"thresholds.{name} = {changes[name]} is outside {LEAST:g} to {MOST:g} times the default of {usual:g}"
            )


def with_thresholds_table(text: str, changes: Mapping[str, Value]) -> str:
    """A session file's text with these as its ``[thresholds]``, at its end; an older table goes."""
    without = _TABLE.sub("", text).rstrip("\n")
    lines = (f"{name} = {json.dumps(value, ensure_ascii=False)}" for name, value in changes.items())
    return "\n".join([without, "", "[thresholds]", *lines, ""])


def describe_thresholds(changes: Mapping[str, Value]) -> str:
    """What the session sets and where that comes from, in a line; "" for nothing."""
    set_here = [
        f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in changes.items()
    ]
    named = ", ".join(text for text in set_here if not text.startswith(f"{ORIGIN} "))
    return f"thresholds of the session: {named} (from: {changes.get(ORIGIN, 'the session file')})" if named else ""
