"""What a sweep tries: settings by name with their values, the grid or a sample of it, a session changed by one point.

Names are those of the session file, with dots: ``phases.swing_begins``, ``stimulation.strides_before_start``,
``channels.tuning.gain`` (of every channel), ``channels.0.current_ma`` (of the channel with that number). The guards'
thresholds are ``thresholds.heel_rise_share`` and so on; ``x1.2`` is 1.2 times what it would be for this person.
"""

import difflib
import hashlib
import itertools
import json
import math
import random
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, get_args

from fes.cohort.store import CohortError
from fes.config import Session, validate_session
from fes.config.base import Settings
from fes.config.thresholds import changed_thresholds
from statemachine.guards import Thresholds

SWEPT: Final = ("phases", "stimulation", "channels")  # of a session; the rest is of devices and persons
FIXED: Final = ("name", "number", "foot", "muscle", "electrode_area_cm2", "never_with", "limits")  # of a channel
THRESHOLDS: Final = "thresholds"
MOST: Final = 100_000  # combinations; more is a slip, or needs --sample
MOST_VALUES: Final = 10_000
_FACTOR: Final = re.compile(r"x(\d+(?:\.\d+)?(?:e[+-]\d+)?)")
_RANGE: Final = re.compile(r"([^:]+):([^:]+):(\d+)")

Value = bool | int | float | str


@dataclass(frozen=True, slots=True)
class Axis:
    """One setting and the values to try."""

    name: str
    values: tuple[Value, ...]


@dataclass(frozen=True, slots=True)
class Point:
    """One combination: settings by name, as the session file has them; empty for the session as it is."""

    values: tuple[tuple[str, Value], ...] = ()

    def text(self) -> str:
        """The same for the same combination, whatever the order it was asked in."""
        return json.dumps(dict(self.values), sort_keys=True)

    @property
    def identity(self) -> str:
        """A short name."""
        return hashlib.sha256(self.text().encode()).hexdigest()[:12]


def parse_axis(asked: str) -> Axis:
    """``name=a,b,c`` or ``name=low:high:count``. CohortError: it is neither, or there is no such setting."""
    name, equals, values = asked.partition("=")
    name = name.strip()
    if not equals or not values.strip():
        raise CohortError(f"--set {asked}: write NAME=VALUE,VALUE,… or NAME=LOW:HIGH:COUNT.")
    _check_name(name)
    found = tuple(dict.fromkeys(each for part in values.split(",") for each in _values(asked, part.strip())))
    factor = next((each for each in found if times_of(each) is not None), None)
    if factor is not None and not name.startswith(f"{THRESHOLDS}."):
        raise CohortError(f"--set {asked}: {factor} is for {THRESHOLDS}; write the value itself.")
    return Axis(name, found)


def combinations_of(axes: Sequence[Axis], sample: int | None = None, seed: int = 1) -> list[Point]:
    """The session as it is, then all combinations, or ``sample`` different ones drawn by ``seed``.

    CohortError: a setting is named twice, or there are too many combinations.
    """
    names = [each.name for each in axes]
    if twice := [name for name in names if names.count(name) > 1]:
        raise CohortError(f"--set {twice[0]}: is there twice; give all its values in one.")
    total = math.prod(len(each.values) for each in axes)
    if (total if sample is None else min(sample, total)) > MOST:
        raise CohortError(f"{sample or total} combinations are more than {MOST}; give fewer values, or --sample N.")
    if sample is not None and total > sys.maxsize:
        raise CohortError(f"{total} combinations are too many to draw from; give fewer values.")
    chosen: Iterable[tuple[Value, ...]] = itertools.product(*(each.values for each in axes))
    if sample is not None and sample < total:  # without laying the grid out
        chosen = (_nth(axes, number) for number in sorted(random.Random(seed).sample(range(total), sample)))
    return [Point(), *(Point(tuple(zip(names, values, strict=True))) for values in chosen)]


def session_with(base: Session, point: Point, path: Path) -> Session:
    """The session with a combination's settings.

    Raises:
        CohortError: it has no such channel, or no tuning to change.
        ConfigError: the combination is not allowed; says why.
    """
    data = base.model_dump()
    if "ground" not in base.model_fields_set:  # then a recording's sidecar says it
        del data["ground"]
    swept = thresholds_of(point)  # the trackers are given these; the session's own of the same name give way
    data[THRESHOLDS] = {name: value for name, value in base.thresholds.items() if name not in swept}
    for name, value in point.values:
        root, *parts = name.split(".")
        if root == THRESHOLDS:
            continue
        if root != "channels":
            data[root][parts[0]] = value
            continue
        number = int(parts.pop(0)) if parts[0].isdigit() else None
        chosen = [channel for channel in data["channels"] if number in (None, channel["number"])]
        if not chosen:
            raise CohortError(f"{name}: the session has no such channel.")
        for channel in chosen:
            _put(channel, parts, value, name)
    return validate_session(data, path)


def thresholds_of(point: Point) -> dict[str, Value]:
    """The guards' thresholds that a combination changes, by name."""
    named = (name.partition(".") for name, _ in point.values)
    return {name: value for (root, _, name), (_, value) in zip(named, point.values, strict=True) if root == THRESHOLDS}


def change_thresholds(thresholds: Thresholds, changes: dict[str, Value]) -> Thresholds:
    """Thresholds with a combination's. CohortError: a value is not of the threshold's kind."""
    try:
        return changed_thresholds(thresholds, changes)
    except ValueError as error:
        raise CohortError(str(error)) from error


def times_of(value: Value) -> float | None:
    """1.2 of ``x1.2``, that is 1.2 times what it would be; None of any other value."""
    found = _FACTOR.fullmatch(value) if isinstance(value, str) else None
    return float(found[1]) if found else None


def swept_names() -> list[str]:
    """All settings that can be swept."""
    of_session = (name for root in SWEPT for name in _leaves(Session.model_fields[root].annotation, root))
    fixed = re.compile(rf"channels\.({'|'.join(FIXED)})(\.|$)")
    return [f"{THRESHOLDS}.{name}" for name in Thresholds._fields] + [n for n in of_session if not fixed.match(n)]


def _check_name(name: str) -> None:
    """Refuse what is no setting, with the nearest that is."""
    known = swept_names()
    if re.sub(r"^channels\.\d+\.", "channels.", name) in known:
        return
    last = name.rpartition(".")[2]
    near = difflib.get_close_matches(name, known, 3, 0.5)
    near += [other for other in known if other.rpartition(".")[2] == last or last.lower() in other]
    words = {word for word in re.split(r"[._]", last.lower()) if len(word) > 3}
    near += sorted(known, key=lambda other: -len(words & set(re.split(r"[._]", other))))[:3] if words else []
    best = ", ".join(dict.fromkeys(near[:4]))
    raise CohortError(f"--set {name}: is no setting that can be swept. Nearest: {best}. `fes sweep --names` lists all.")


def _values(asked: str, part: str) -> list[Value]:
    if found := _RANGE.fullmatch(part):
        low, high, count = (_number(asked, text) for text in found.groups())
        if not 2 <= count <= MOST_VALUES:
            raise CohortError(f"--set {asked}: COUNT of {part} must be 2 to {MOST_VALUES}.")
        return [float(f"{low + (high - low) * k / (count - 1):.12g}") for k in range(int(count))]
    if re.fullmatch(r"x[\d.]+(e-?\d+)?", part):
        return [f"x{_number(asked, part[1:]):g}"]
    if not part:
        raise CohortError(f"--set {asked}: a value between two commas is missing.")
    try:
        value = tomllib.loads(f"value = {part}")["value"]
    except (ValueError, RecursionError):  # no TOML, or brackets without end
        return [part]
    if isinstance(value, float) and not math.isfinite(value):
        raise CohortError(f"--set {asked}: {part} is no number.")
    return [value if isinstance(value, (bool, int, float, str)) else part]


def _number(asked: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise CohortError(f"--set {asked}: {text} is no number.")
    return value


def _nth(axes: Sequence[Axis], number: int) -> tuple[Value, ...]:
    chosen = []
    for each in reversed(axes):
        number, at = divmod(number, len(each.values))
        chosen.append(each.values[at])
    return tuple(reversed(chosen))


def _put(table: dict[str, Any], parts: Sequence[str], value: object, name: str) -> None:
    for part in parts[:-1]:
        if not isinstance(table.get(part), dict):
            raise CohortError(f"{name}: the session's channel {table.get('name', '')!r} has no {part}; add it there.")
        table = table[part]
    table[parts[-1]] = value


def _leaves(annotation: object, name: str) -> Iterator[str]:
    """Dotted names of a setting, or of all in a table of them."""
    kinds = (annotation, *get_args(annotation))
    tables = [each for each in kinds if isinstance(each, type) and issubclass(each, Settings)]
    if not tables:
        yield name
    for key, field in tables[0].model_fields.items() if tables else ():
        yield from _leaves(field.annotation, f"{name}.{key}")
