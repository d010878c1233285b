"""What a file tells beside its columns: the rate and the side in its own header or name, the units in its numbers."""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fes.recording import naming
from fes.recording.plausible import MOVING_MPS2, quiet_level
from fes.recording.units import ACC_UNITS, GYR_UNITS
from fes.signals import G_MPS2, FloatArray

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

    Attributes:
        gravity: the accelerometer's median in the quietest windows.
        moved: 99th percentile of how far the accelerometer is from that.
        peak: the gyroscope's 99th percentile.
    """

    gravity: float
    moved: float
    peak: float


def look(data: FloatArray) -> Numbers:
    """Sum up (N, 6) raw values, accelerometer first."""
    acc, gyr = np.ascontiguousarray(data[:, :3]), np.ascontiguousarray(data[:, 3:])
    gravity = quiet_level(acc, gyr, 100.0).acc
    moved = float(np.percentile(np.abs(np.linalg.norm(acc, axis=1) - gravity), 99.0))
    return Numbers(gravity, moved, float(np.percentile(np.linalg.norm(gyr, axis=1), 99.0)))


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
    """Return (side, part, what told it) from a file's name or, if that is silent, from the lines over its header."""
    name = naming.plain(path.stem)
    said = [(naming.plain(text), f"line {number}: “{text[:60]}”") for number, text in above]
    parts = {part for words, _ in said if (part := naming.part_of(words))}
    part = naming.part_of(name) or (parts.pop() if len(parts) == 1 else "")
    for words, told in [(name, "the file's name"), *said]:
        if side := naming.side_of(words):
            return side, part, told
    return "", part, ""


def other_side(path: Path) -> Path | None:
    """Return the file beside this one whose name differs in the side and, at most, in a number of the device."""
    words = re.split(r"([^A-Za-z]+|(?<=[a-z])(?=[A-Z]))", path.stem)
    for index, word in enumerate(words):
        opposite = _SIDES.get((word or "").lower())
        if opposite is None:
            continue
        wanted = "".join(
            [*(part or "" for part in words[:index]), opposite, *(part or "" for part in words[index + 1 :])]
        )
        beside = {
            other.stem.lower(): other
            for other in sorted(path.parent.glob(f"*{path.suffix}"))
            if other != path
            and naming.side_of(naming.plain(other.stem)) not in ("", naming.side_of(naming.plain(path.stem)))
        }
        near = difflib.get_close_matches(wanted.lower(), list(beside), n=1, cutoff=0.8)
        return beside[near[0]] if near else None
    return None
