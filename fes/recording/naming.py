"""What names tell: which column is which axis of which sensor, in which unit; which side a text speaks of."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Final

from fes.signals import SENSORS

_KINDS: Final = {
    "acc": re.compile(
        r"linacc|acceleration|accelerometer|beschleunigung|accel|acc(?![a-z])|acc(?=[xyz]\b)|\ba(?= ?[xyz]\b)"
    ),
    "gyr": re.compile(r"gyroscope|drehrate|gyro|gyr|angular ?(velocity|rate|vel)|angvel|omega|\b[gw](?= ?[xyz]\b)"),
}
_OTHER = re.compile(r"mag|quat|temp|press|euler|roll|pitch|yaw|lin ?acc|free ?acc|linear ?acc|\bgrav")
_UNIT = re.compile(
    r"[(\[][^)\]]*[)\]]+|\b(deg|rad|m) ?/ ?s(ec)?(\^?2|²)?|\b(m ?s2|mps2|rad ?s|rps|deg ?ps|rad ?ps|deg ?s|m?dps|m?g)$"
)
_GRADE = re.compile(r"\b(un)?cal(ibrated)?\b|\bwr\b|\bln\b|\bhg\b|\bwide range\b|\blow noise\b|\bhigh g\b")
_NARROW = re.compile(r"\bln\b|\blow noise\b")  # Shimmer's: 2 g at most, which every heel strike exceeds
_AXIS = re.compile(r"\b([xyz])\b|([xyz])$")
_LEFT = re.compile(
    r"\b(left|links|linke[rsn]?|li|gauche|izquierd[oa]|izq|sinistr[oa]|sx|l)\b|\bl(?=foot|shank|shoe|f\b|s\b)|left"
)
_RIGHT = re.compile(
    r"\b(right|rechts|rechte[rsn]?|re|droite?|derech[oa]|der|destr[oa]|dx|r)\b|\br(?=foot|shank|shoe|f\b|s\b)|right"
)
_SHANK = re.compile(r"shank|shin|tibia|calf|lower ?leg|unterschenkel|wade|\b[lr]s\b")
_FOOT = re.compile(r"foot|feet|shoe|heel|instep|toe|fu(ß|ss)|schuh|pied|pie\b|piede|\b[lr]f\b")
_TIME = re.compile(
    r"\b(time|timestamp|t|sec|seconds|ms|millis|micros|ticks|sampletime\w*|zeit|zeitstempel|elapsed)\b|timestamp"
)
_UNITS: Final = {
    "acc": ((r"mg|milli ?g", "mg"), (r"g|gs|g'?s", "g"), (r"m\W*s.*2|mps2|ms2|m\W*s\W*s|m\W*s\W*²", "m/s^2")),
    "gyr": ((r"m ?(deg|°|º).*|mdps", "mdeg/s"), (r"(deg|°|º|grad).*|dps", "deg/s"), (r"rad.*|rps", "rad/s")),
    "time": (
        (r"ns|nanosec.*", "ns"),
        (r"us|µs|μs|usec|microsec.*|micros", "us"),
        (r"ms|msec|millisec.*|millis", "ms"),
        (r"s|sec|seconds?", "s"),
    ),
}


@dataclass
class Group:
    """Columns whose names differ by kind and axis only: one sensor.

    Attributes:
        columns: kind → axis → column.
        called: what the names call the sensor.
        sensor: one of :data:`fes.signals.SENSORS`, or "" where nothing tells.
        why: what told the sensor, if not the columns' own names; "" otherwise.
    """

    columns: dict[str, dict[str, str]] = field(default_factory=lambda: {"acc": {}, "gyr": {}})
    called: str = ""
    sensor: str = ""
    why: str = ""

    def names(self, kind: str) -> list[str]:
        """Column names x, y, z; a placeholder where none was recognised."""
        return [self.columns[kind].get(axis, f"? {kind} {axis}") for axis in "xyz"]

    @property
    def whole(self) -> bool:
        """Are all six columns known?"""
        return all(len(axes) == 3 for axes in self.columns.values())


def plain(name: str) -> str:
    """Lower case, words apart: ``LeftFoot_AccX`` → ``left foot acc x``."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name)
    return re.sub(r"[_\-.:,\s]+", " ", spaced).strip().lower()


def side_of(text: str) -> str:
    """“left” or “right” if a plain text speaks of just one of them, "" otherwise."""
    left, right = bool(_LEFT.search(text)), bool(_RIGHT.search(text))
    return "" if left == right else "left" if left else "right"


def part_of(text: str) -> str:
    """“shank” or “foot” if a plain text speaks of just one of them, "" otherwise."""
    shank, foot = bool(_SHANK.search(text)), bool(_FOOT.search(text))
    return "" if shank == foot else "shank" if shank else "foot"


def time_columns(names: list[str]) -> list[str]:
    """The columns that are called a time."""
    return [name for name in names if _TIME.search(plain(name)) and not _kind(plain(name))]


def stated_unit(kind: str, name: str, units_row: str = "") -> str:
    """The unit that a column's name or the line of units under it gives, as a sidecar spells it; "" if none does.

    ``kind``: "acc", "gyr" or "time".
    """
    bracket = re.search(r"[(\[]([^()\[\]]*(\([^()]*\))?[^()\[\]]*)[)\]]\s*$", name)
    last = _UNIT.search(plain(name)) if kind != "time" else re.search(r"\b(\w+)$", plain(name))
    for text in (units_row, bracket.group(1) if bracket else "", last.group(0) if last else ""):
        bare = text.strip(" ()[]").lower()
        for pattern, unit in _UNITS[kind]:
            if bare and re.fullmatch(pattern, bare):
                return unit
    return ""


def group_columns(names: list[str]) -> list[Group]:
    """Sort columns into sensors by what of their names is neither kind, axis nor unit; at least one group.

    A sensor is named only where the columns' names tell its side; the part is the foot unless they say shank.
    """
    groups: dict[str, Group] = {}
    for name in names:
        words = re.sub(r"\s+", " ", _UNIT.sub(" ", plain(name))).strip()
        kind = _kind(words)
        axis = _AXIS.search(_KINDS[kind].sub(" ", words)) if kind else None
        if not kind or axis is None:
            continue
        rest = " ".join(_GRADE.sub(" ", _AXIS.sub(" ", _KINDS[kind].sub(" ", words), count=1)).split())
        group = groups.setdefault(rest, Group(called=rest))
        letter = axis.group(1) or axis.group(2)
        known = group.columns[kind].get(letter)
        if known is None or (_NARROW.search(plain(known)) and not _NARROW.search(plain(name))):
            group.columns[kind][letter] = name
    whole = {key: group for key, group in groups.items() if group.whole}
    chosen = list((whole or groups).values())[: len(SENSORS)] or [Group()]
    for group in chosen:
        side = side_of(group.called)
        sensor = f"{side}_{part_of(group.called) or 'foot'}"
        if side and sensor not in {other.sensor for other in chosen}:
            group.sensor = sensor
    order = (*SENSORS, "")
    return sorted(chosen, key=lambda group: order.index(group.sensor))


def _kind(words: str) -> str:
    if _OTHER.search(words):
        return ""
    return next((kind for kind, pattern in _KINDS.items() if pattern.search(words)), "")
