"""What is usual, where somebody has published it: shown beside the key numbers, each with its source.

Ranges are of comfortable walking over ground. They depend on age, sex and height, which a session does not know, and
on a treadmill the belt sets the speed: they are there to see how far away a number is, and judge nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Norm:
    """One published range: ``text`` for a table's cell, ``detail`` says of whom, ``source`` where it is from."""

    text: str
    detail: str
    source: str

    def hover(self) -> str:
        """All of it."""
        return f"{self.text}: {self.detail} [{self.source}]"


NORMS: Final[dict[str, Norm]] = {
    "walking_speed_mps": Norm(
        "0.94 … 1.43 m/s",
        "means of healthy adults at their normal pace over ground, from women of 80 and more to men of 40 to 49; a "
        "meta-analysis of 23,111 people",
        "Bohannon & Andrews 2011, Physiotherapy 97:182",
    ),
    "temporal_symmetry": Norm(
        "0.9 … 1.1",
        "95 % interval of 24 healthy people over ground",
        "Patterson et al. 2008, Arch Phys Med Rehabil 89:304",
    ),
}
# Speeds of stroke survivors and how far they usually get with them: upper bound (m/s) and name.
SPEED_CLASSES: Final = ((0.4, "household walking"), (0.8, "limited community walking"), (99.0, "community walking"))
SPEED_CLASSES_SOURCE: Final = (
    "Up to 0.4 m/s, to 0.8 m/s and above 0.8 m/s after a stroke: household, limited community and community walking "
    "[Perry et al. 1995, as in Schmid et al. 2007]. Made for walking over ground at one's own pace"
)


def speed_class(speed_mps: float) -> str:
    """Perry et al.'s class of a walking speed (m/s); "" where it is not known."""
    return next((name for bound, name in SPEED_CLASSES if speed_mps <= bound), "")
