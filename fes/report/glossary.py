"""What words and numbers mean: shown on hover, focus and touch, and listed at the report's end.

What is usual stands beside the key numbers where somebody has published it, each with its source. Ranges are of
comfortable walking over ground. They depend on age, sex and height, which a session does not know, and on a treadmill
the belt sets the speed: they are there to see how far away a number is, and judge nothing.
"""

from dataclasses import dataclass
from functools import cache
from typing import Final

from fes.analysis.parameters.definitions import DEFINITIONS
from fes.report.quality import MEANING, SHORT
from fes.report.text import capitalised, slug


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


GLOSSARY: dict[str, str] = {
    "stride": "From mid-stance to the next mid-stance of the same foot (m, s). Some papers call it a step.",
    "stride length": "Horizontal distance of the foot sensor between the two mid-stances (m).",
    "clearance": "Greatest height of the sensor during the stride above its height at the start (cm).",
    "toe clearance": "Least height of the toe in mid-swing (cm); the settings, or fes analyse, say where the toe is.",
    "heel clearance": "Greatest height of the heel (cm); the settings, or fes analyse, say where the heel is.",
    "pre-swing": "From heel rise until the toe leaves the ground.",
    "swing": "The foot is off the ground, until first contact.",
    "loading response": "From first contact until the foot lies still.",
    "stance": "The foot lies still, until the heel rises again.",
    "four phases": "Pre-swing, swing, loading response and stance were all entered, in this order.",
    "T5": "The heel was lifted and put back without a swing.",
    "T6": "The swing ended in stance without a loading response being seen.",
    "valid": "The stride's numbers can be used; if not, the reason is given and it is left out of all averages.",
    "walking speed": "Distance over time of the valid strides within 30 % of the median speed (m/s); mean of feet.",
    "cadence": "Two steps per stride: 120 s divided by the mean stride time in s (steps/min).",
    "onset": "First command to stimulate, counted from the entry into pre-swing of the same foot (ms).",
    "burst": "A stretch in which a channel was commanded on without a break.",
    "charge": "Charge of one phase of all pulses (µC): counted by the stimulator, else current · width · number.",
    "outside": "Time a channel was commanded on while its foot was in a phase in which it must be off (s).",
    "latency": "From a sample's arrival to the controller's decision (ms).",
    "p50, p99": "Half, and 99 of 100, of the values are no greater than this.",
    "SD": "Standard deviation; for phase durations in percent of the mean.",
    "gate": "The safety gate: the last check before the wire. It turns a command off when in doubt and says why.",
    "pitch": "Rotation of the foot about the axis across it (°): toe up positive, 0 in the stance at the start.",
}


_MORE = {
    "CV": "Coefficient of variation: standard deviation over the size of the mean (%).",
    "interval": "The mean of endless walking just like this lies there 95 times in 100; strides are taken to be like "
    "their neighbours. It knows nothing of errors that all strides share.",
    "n": "How many steady strides the mean is of: within 30 % of the median stride's length, turning by 20° at most.",
    "usual": "What a published source found; of healthy people over ground, not of this person. "
    + "; ".join(norm.hover() for norm in NORMS.values()),
}


@dataclass(frozen=True, slots=True)
class Term:
    """``name`` is what is explained, ``text`` the explanation with unit, formula in words and source."""

    name: str
    text: str


@cache
def terms() -> dict[str, Term]:
    """By anchor: words of the report, then gait parameters."""
    found = {slug(name): Term(name, text) for name, text in (*GLOSSARY.items(), *_MORE.items())}
    for kind, name in SHORT.items():
        found[slug(f"flag {name}")] = Term(name, f"{capitalised(MEANING[kind])}.")
    for key, known in DEFINITIONS.items():
        symbol = f" ({known.symbol})" if known.symbol else ""
        unit = f" Unit: {known.shown}." if known.shown else ""
        source = f" [{known.source}]" if known.source else ""
        found[slug(key)] = Term(f"{known.name}{symbol}", f"{capitalised(known.text)}.{unit}{source}")
    found[slug("temporal_symmetry")] = Term(
        "temporal symmetry",
        "Swing over stance time of the paretic side over that of the other; left over right where no side was named. "
        f"1 is symmetric. Usual: {NORMS['temporal_symmetry'].hover()}.",
    )
    found[slug("speed_class")] = Term("speed class after stroke", f"{SPEED_CLASSES_SOURCE}.")
    return found


def parameter_slugs() -> list[str]:
    """Anchors of the gait parameters, in the table's order."""
    return [slug(key) for key in DEFINITIONS] + [slug("temporal_symmetry"), slug("speed_class")]
