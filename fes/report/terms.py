"""Every word and parameter that the report explains: shown on hover, focus and touch, and listed at its end."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

from fes.analysis.parameters.definitions import DEFINITIONS
from fes.report.flags import CLIPPED_ACC, CLIPPED_GYR, LOST, MEANING, UNSURE
from fes.report.glossary import GLOSSARY, NORMS, SPEED_CLASSES_SOURCE
from fes.report.text import slug

FLAG_NAMES = {
    CLIPPED_ACC: "clip a",
    CLIPPED_GYR: "clip g",
    LOST: "gap",
    UNSURE: "unsure",
}
_MORE = {
    "CV": "Coefficient of variation: standard deviation over the size of the mean (%).",
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
    found = {slug(word): Term(word, text) for word, text in (*GLOSSARY.items(), *_MORE.items())}
    for kind, name in FLAG_NAMES.items():
        found[slug(f"flag {name}")] = Term(name, f"{MEANING[kind][:1].upper()}{MEANING[kind][1:]}.")
    for key, known in DEFINITIONS.items():
        symbol = f" ({known.symbol})" if known.symbol else ""
        unit = f" Unit: {known.shown}." if known.shown else ""
        source = f" [{known.source}]" if known.source else ""
        text = f"{known.text[:1].upper()}{known.text[1:]}.{unit}{source}"
        found[slug(key)] = Term(f"{known.name}{symbol}", text)
    found[slug("temporal_symmetry")] = Term(
        "temporal symmetry",
        "Swing over stance time of the afflicted side over that of the other; left over right where no side was named. "
        f"1 is symmetric. Usual: {NORMS['temporal_symmetry'].hover()}.",
    )
    found[slug("speed_class")] = Term("speed class after stroke", f"{SPEED_CLASSES_SOURCE}.")
    return found


def parameter_slugs() -> list[str]:
    """Anchors of the gait parameters, in the table's order."""
    return [slug(key) for key in DEFINITIONS] + [slug("temporal_symmetry"), slug("speed_class")]
