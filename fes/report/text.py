"""Values as people and as JSON read them: numbers, names, counts and times."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from datetime import datetime
from typing import Any, Final

import numpy as np

DIGITS: Final = {"m": 2, "s": 2, "m/s": 2, "cm": 1, "°": 1, "%": 1, "": 2}  # decimals of a unit
_NUMBER: Final = re.compile(r"\d+(?:[.,]\d+)?")


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation (n − 1) of ``n`` values; NaN where too few."""

    mean: float
    sd: float
    n: int

    @property
    def sd_percent(self) -> float:
        """Standard deviation in percent of the mean."""
        return 100 * self.sd / abs(self.mean) if self.mean else math.nan


def spread(values: Iterable[float]) -> Spread:
    """Mean and standard deviation of the finite values."""
    kept = np.array([value for value in values if np.isfinite(value)])
    sd = float(kept.std(ddof=1)) if kept.size > 1 else math.nan
    return Spread(float(kept.mean()) if kept.size else math.nan, sd, kept.size)


def number(value: float | None, digits: int, sign: str = "") -> str:
    """A number, with ``sign="+"`` always signed, or a dash for what is not known."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{round(value, digits) + 0.0:{sign}.{digits}f}"


def mean_sd(values: Spread, digits: int, unit: str = "") -> str:
    """``0.63 ± 0.02 m``, or a dash when there is nothing."""
    if not values.n:
        return "–"
    sd = f" ± {values.sd:.{digits}f}" if values.n > 1 else ""
    return f"{values.mean:.{digits}f}{sd} {unit}".rstrip()


def readable(name: str) -> str:
    """``left_foot`` → ``left foot``."""
    return name.replace("pre_swing", "pre-swing").replace("_", " ")


def without_numbers(text: str) -> str:
    """The words of a reason, by which like reasons are told from unlike ones."""
    return _NUMBER.sub("#", text)


def in_one(texts: Sequence[str]) -> str:
    """Texts of the same words as one, each number that differs as ``least … greatest``."""
    numbers = zip(*([each[0] for each in _NUMBER.finditer(text)] for text in texts), strict=True)
    ranges = (sorted(set(own), key=lambda one: float(one.replace(",", "."))) for own in numbers)
    return _NUMBER.sub(lambda _: " … ".join(dict.fromkeys([(own := next(ranges))[0], own[-1]])), texts[0])


def together(names: Sequence[str]) -> str:
    """Of whom a sum is, where it is of more than one foot or shank: ``both feet together``."""
    parts = "feet" if all(name.endswith("_foot") for name in names) else "sensors"
    return f"{'both' if len(names) == 2 else f'all {len(names)}'} {parts} together" if len(names) > 1 else ""


def capitalised(sentence: str) -> str:
    """The same with a capital first letter."""
    return sentence[:1].upper() + sentence[1:]


def count_of(count: int, noun: str) -> str:
    """``1 stride``, ``3 strides``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def slug(name: str) -> str:
    """A name as an anchor."""
    return "d-" + re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def local_time(created: str) -> str:
    """An ISO time as people write it; anything else as it is."""
    try:
        moment = datetime.fromisoformat(created)
    except ValueError:
        return created
    return f"{moment:%Y-%m-%d %H:%M} {moment.tzname() or ''}".strip()


def plain(value: Any) -> Any:
    """Turn dataclasses, mappings, sequences and numpy values into what ``json.dumps(allow_nan=False)`` takes.

    NaN and infinity become null; anything else that JSON does not know becomes its text.
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        return {entry.name: plain(getattr(value, entry.name)) for entry in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (Sequence, set, frozenset)) and not isinstance(value, (bytes, bytearray)):
        return [plain(item) for item in value]
    return str(value)
