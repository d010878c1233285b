"""What names say: which column is which axis of which sensor, in which unit; which side a text speaks of.

Also what else a file shows: rate and side in its header or name, units in its numbers.
"""

import difflib
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from fes.recording.units import ACC_UNITS, GYR_UNITS, MOVING_MPS2, TIME_UNITS_NS, gravity_subtracted, quiet_level
from fes.signals import G_MPS2, SENSORS, FloatArray

_KINDS: Final = {
    "acc": re.compile(
        r"linacc|acceleration|accelerometer|beschl(?:eunigung|(?![a-z]))|accel|acc(?![a-z])|acc(?=[xyz]\b)"
        r"|\ba(?= ?[xyz]\b)"
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
_ELSEWHERE = re.compile(
    r"lumbar|sternum|trunk|torso|pelvis|waist|sacrum|wrist|\b(upper|fore)? ?arm\b|hand\b|head\b|chest|\bback\b|\bhip\b|"
    r"thigh|upper ?leg|oberschenkel|becken|handgelenk"
)
_TIME = re.compile(
    r"\b(time|timestamp|t|sec|seconds|ms|millis|micros|ticks|sampletime\w*|zeit|zeitstempel|elapsed)\b|timestamp"
)
_COUNTER = re.compile(
    r"\b((packet|sample|frame|paket|pkt)( ?(counter|number|count|num|no|nr|index|idx|id|zähler|nummer))?"
    r"|counter|count|zähler|laufnummer|seq|sequence( ?(number|no))?|index|idx)$"
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
    """Columns whose names differ by kind and axis only: one sensor; ``columns``: kind → axis → column.

    ``called`` is what the names call the sensor, ``sensor`` one of :data:`fes.signals.SENSORS`, or "" where nothing
    tells.
    """

    columns: dict[str, dict[str, str]] = field(default_factory=lambda: {"acc": {}, "gyr": {}})
    called: str = ""
    sensor: str = ""

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


def worn_elsewhere(text: str) -> bool:
    """Does a plain text speak of a place that is no foot or shank?"""
    return bool(_ELSEWHERE.search(text))


def time_columns(names: list[str]) -> list[str]:
    """The columns that are called a time."""
    return [name for name in names if _TIME.search(plain(name)) and not _kind(plain(name))]


def counter_columns(names: list[str]) -> list[str]:
    """The columns that are called a counter of samples."""
    return [name for name in names if _COUNTER.search(plain(name)) and not _kind(plain(name))]


def units_of_time(name: str) -> tuple[str | float, ...]:
    """Units that a column of this name may have.

    Xsens calls two clocks SampleTimeFine: of MT devices it counts 0.1 ms, of DOT µs (recordings.md has the sources).
    """
    return ("us", 1e-4) if "sample time fine" in plain(name) else tuple(TIME_UNITS_NS)


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
    on_legs = {key: group for key, group in groups.items() if not _ELSEWHERE.search(key)}
    groups = on_legs or groups
    whole = {key: group for key, group in groups.items() if group.whole}
    chosen = list((whole or groups).values())[: len(SENSORS)] or [Group()]
    for group in chosen:
        side = side_of(group.called)
        sensor = f"{side}_{part_of(group.called) or 'foot'}"
        if side and sensor not in {other.sensor for other in chosen}:
            group.sensor = sensor
    order = (*SENSORS, "")
    return sorted(chosen, key=lambda group: order.index(group.sensor))


def axis_columns(names: list[str]) -> dict[str, str]:
    """Axis → column of a file that holds one triad, and so need not say which: ``x``, ``X (m/s^2)``, ``x-axis (g)``."""
    found: dict[str, str] = {}
    for name in names:
        axis = _AXIS.search(_UNIT.sub(" ", plain(name)).strip())
        if axis:
            found.setdefault(axis.group(1) or axis.group(2), name)
    return found


def _kind(words: str) -> str:
    if _OTHER.search(words):
        return ""
    return next((kind for kind, pattern in _KINDS.items() if pattern.search(words)), "")


_TURNS: Final = sorted({2**bits for bits in (8, 10, 12, 14, 15, 16, 20, 24, 31, 32)}
                       | {10**digits for digits in range(2, 10)} | {60_000, 3_600_000, 86_400_000})  # fmt: skip


def wraps_at_of(readings: FloatArray) -> int | None:
    """Where a counter (N,) begins anew: a usual size that its largest reading nearly has; None if it does not."""
    if readings.size < 2 or not (np.diff(readings) < -0.5 * readings.max()).any() or (readings % 1 != 0).any():
        return None
    largest = float(readings.max())
    return next((turn for turn in _TURNS if largest < turn and largest >= 0.98 * turn - 1), None)


RATES_HZ = (20.0, 5000.0)
# 99th percentile of what a walking foot or shank turns: what is less beside an accelerometer that moves is another
# unit, and between the two a number could be slow degrees or fast radians
WALKING_RADPS = (0.5, 20.0)
UNSURE_DEGPS = (15.0, 30.0)
_RATE = re.compile(
    r"(rate|freq\w*|\bfs\b|\bodr\b|abtast\w*|sampling)[^\d\n]{0,25}(\d+([.,]\d+)?)\s*(k?hz)?|\b(\d+([.,]\d+)?)\s*hz\b",
    re.I,
)
_SIDES = {
    "left": "right", "right": "left", "links": "rechts", "rechts": "links", "gauche": "droite", "droite": "gauche",
    "izquierdo": "derecho", "derecho": "izquierdo", "sx": "dx", "dx": "sx", "l": "r", "r": "l",
}  # fmt: skip


@dataclass(frozen=True)
class Numbers:
    """What one sensor's values look like, in the units of the file.

    ``gravity`` is the accelerometer's median in the quietest windows, ``moved`` the 99th percentile of how far it is
    from that, ``peak`` the gyroscope's 99th percentile.
    """

    gravity: float
    moved: float
    peak: float
    subtracted: bool = False  # gravity is not in it


def characterise(data: FloatArray) -> Numbers:
    """Sum up (N, 6) raw values, accelerometer first."""
    acc, gyr = np.ascontiguousarray(data[:, :3]), np.ascontiguousarray(data[:, 3:])
    gravity, _ = quiet_level(acc, gyr, 100.0)
    moved = float(np.percentile(np.abs(np.linalg.norm(acc, axis=1) - gravity), 99.0))
    return Numbers(gravity, moved, float(np.percentile(np.linalg.norm(gyr, axis=1), 99.0)), gravity_subtracted(acc))


def acc_unit_of(numbers: Numbers) -> str:
    """The unit in which the quiet accelerometer reads gravity, "" if none."""
    return next((unit for unit, size in ACC_UNITS.items() if 0.75 <= numbers.gravity * size / G_MPS2 <= 1.33), "")


def gyr_unit_of(numbers: Numbers, acc_unit: str) -> str:
    """The only unit in which a walking leg would turn so; "" if it moves too little to tell, or two would do."""
    if not acc_unit or numbers.moved * ACC_UNITS[acc_unit] < MOVING_MPS2:
        return ""
    if UNSURE_DEGPS[0] <= numbers.peak <= UNSURE_DEGPS[1]:
        return ""
    low, high = WALKING_RADPS
    fitting = [unit for unit, size in GYR_UNITS.items() if low <= numbers.peak * size <= high]
    return fitting[0] if len(fitting) == 1 else ""


def stated_rate(above: list[tuple[int, str]]) -> tuple[float, str] | None:
    """Return (rate in Hz, the line it stands in) if the lines over a header give just one, None otherwise."""
    found: dict[float, str] = {}
    for number, text in above:
        for match in _RATE.finditer(text):
            value = float((match.group(2) or match.group(5)).replace(",", "."))
            value *= 1000.0 if (match.group(4) or "").lower() == "khz" else 1.0
            if RATES_HZ[0] <= value <= RATES_HZ[1]:
                found.setdefault(value, f"line {number}: “{text[:60]}”")
    return next(iter(found.items())) if len(found) == 1 else None


def place_of(path: Path, above: list[tuple[int, str]]) -> tuple[str, str, str]:
    """Return (side, part, what named it) from a file's name or, if that is silent, from the lines over its header."""
    name = plain(path.stem)
    above_lines = [(plain(text), f"line {number}: “{text[:60]}”") for number, text in above]
    parts = {part for words, _ in above_lines if (part := part_of(words))}
    part = part_of(name) or (parts.pop() if len(parts) == 1 else "")
    for words, source in [(name, "the file's name"), *above_lines]:
        if side := side_of(words):
            return side, part, source
    return "", part, ""


def other_side(path: Path) -> Path | None:
    """Return the file beside this one whose name differs in the side and, at most, in a number of the device."""
    words = re.split(r"([^A-Za-z]+|(?<=[a-z])(?=[A-Z]))", path.stem)
    for index, word in enumerate(words):
        opposite = _SIDES.get((word or "").lower())
        if opposite is None:
            continue
        wanted = "".join(filter(None, [*words[:index], opposite, *words[index + 1 :]]))
        beside = {
            other.stem.lower(): other
            for other in sorted(path.parent.glob(f"*{path.suffix}"))
            if other != path
            and other.suffix == path.suffix
            and side_of(plain(other.stem)) not in ("", side_of(plain(path.stem)))
        }
        near = difflib.get_close_matches(wanted.lower(), list(beside), n=1, cutoff=0.8)
        return beside[near[0]] if near else None
    return None
