"""What a guard asked and what it saw: its comparisons, one by one, in its own words.

No rule stands here a second time: the guard itself is called, with features and thresholds that are :class:`Traced`
numbers. Arithmetic with these notes of what the result is made, a comparison of two is a :class:`Term`, and ``&`` and
``|`` join terms, so that a guard that said no can say why.
"""

import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import reduce
from typing import Any, Final, NamedTuple

from statemachine.guards import Features, Thresholds

Guard = Callable[[Features, Thresholds], bool]
UNITS: Final = {
    "mps3": "m/s³",
    "mps2": "m/s²",
    "radps2": "rad/s²",
    "radps": "rad/s",
    "mps": "m/s",
    "rad": "rad",
    "s": "s",
}
FLAG: Final = "yes or no"  # instead of a unit
_OPPOSITE: Final = {"<": "≥", "≥": "<", ">": "≤", "≤": ">"}
_YES_NO: Final = {True: "yes", False: "no"}
_NEGATED: Final = {"toe down": "toe up"}  # what has a name of its own the other way round


class Undecided(ValueError):
    """Of two thresholds that are arrays, now the one is greater and now the other."""


class _Joined:
    """What ``&`` and ``|`` make of terms."""

    def __and__(self, other: Any) -> "Terms":
        return Terms(True, (*_parts(self, True), *_parts(other, True)))

    def __or__(self, other: Any) -> "Terms":
        return Terms(False, (*_parts(self, False), *_parts(other, False)))


def _parts(one: Any, every: bool) -> tuple[Any, ...]:
    return one.parts if isinstance(one, Terms) and one.every is every else (one,)


@dataclass(frozen=True)
class Term(_Joined):
    """One comparison: ``what`` was ``seen`` and had to be ``sign`` ``limit``; ``limit_is`` says of what it is made.

    Of what are arrays (N,), ``seen``, ``limit`` and ``holds`` may be arrays (N,) too.
    """

    what: str
    seen: Any
    sign: str
    limit: Any
    limit_is: str
    unit: str
    holds: Any

    def __bool__(self) -> bool:  # ``max`` and ``min`` of two thresholds compare them
        if not hasattr(self.holds, "all"):
            return bool(self.holds)
        if self.holds.all() != self.holds.any():
            raise Undecided
        return bool(self.holds.all())

    def __str__(self) -> str:
        return self._said(self.sign)

    def failed(self) -> str:
        """The same of one that does not hold, with the opposite sign."""
        return self._said(_OPPOSITE.get(self.sign, self.sign))

    def _said(self, sign: str) -> str:
        if self.unit == FLAG:
            return f"{self.what}: {_YES_NO[bool(self.seen)]}, must be {_YES_NO[bool(self.limit)]}"
        return f"{self.what} {_short(self.seen)} {sign} {_short(self.limit)} {self.unit}".rstrip(" –")


@dataclass(frozen=True)
class Terms(_Joined):
    """Terms of which all, or one at least, must hold."""

    every: bool
    parts: tuple["Term | Terms", ...]

    @property
    def holds(self) -> Any:
        """What the guard said."""
        return reduce(operator.and_ if self.every else operator.or_, (part.holds for part in self.parts))

    def each(self) -> Iterator[Term]:
        """Every comparison, in the order of the source."""
        for part in self.parts:
            yield from part.each() if isinstance(part, Terms) else (part,)

    def why_not(self) -> str:
        """What was lacking, "" where nothing was."""
        if self.holds:
            return ""
        if not self.every:
            return "none of these holds: " + "; ".join(map(_lacking, self.parts))
        lacking = (part for part in self.parts if not part.holds)
        return ", and ".join(part.why_not() if isinstance(part, Terms) else part.failed() for part in lacking)


def _lacking(part: Term | Terms) -> str:
    """What would have to hold and does not, as the guard asks it."""
    if isinstance(part, Term):
        return str(part)
    return (" and " if part.every else " or ").join(_lacking(each) for each in part.parts if not each.holds)


def terms_of(guard: Guard, x: Features, p: Thresholds) -> Terms:
    """What ``guard`` made of these features and thresholds; of N samples at once if they are arrays (N,).

    Raises:
        Undecided: which threshold holds is not the same at all N samples.
    """
    found: Any = guard(_traced(x, feature_words), _traced(p, str))
    return found if isinstance(found, Terms) else Terms(True, (found,))


def unit(name: str) -> str:
    """The unit that a feature's or threshold's name ends in; a share or a factor has none."""
    return UNITS.get(name.rpartition("_")[2], "–")


def feature_words(name: str) -> str:
    """``toe_down_radps`` → ``toe down``."""
    return (name if unit(name) == "–" else name.rpartition("_")[0]).replace("_", " ")


def _traced(values: NamedTuple, words: Callable[[str], str]) -> Any:
    kinds = type(values).__annotations__
    return values._make(
        Traced(value, words(name), FLAG if kinds[name] is bool else unit(name))
        for name, value in values._asdict().items()
    )


def _arithmetic(sign: str, do: Callable[[Any, Any], Any]) -> Any:
    def done(one: Any, other: Any) -> "Traced":
        a, b = _known(one), _known(other)
        words = (
            f"({each.words})" if sign in "·/" and (" + " in each.words or " − " in each.words) else each.words
            for each in (a, b)
        )
        return Traced(do(a.value, b.value), f" {sign} ".join(words), b.unit if a.unit == "–" else a.unit)

    return done


def _swapped(do: Any) -> Any:
    return lambda one, other: do(other, one)


def _comparison(sign: str, does: Callable[[Any, Any], Any]) -> Any:
    def compared(one: "Traced", other: Any) -> Term:
        limit = _known(other)
        return Term(one.words, one.value, sign, limit.value, limit.words, one.unit, does(one.value, limit.value))

    return compared


@dataclass(frozen=True, eq=False)
class Traced:
    """A number that knows in words of what it is made, and its unit."""

    value: Any
    words: str
    unit: str = "–"

    __add__, __sub__ = _arithmetic("+", operator.add), _arithmetic("−", operator.sub)
    __mul__, __truediv__ = _arithmetic("·", operator.mul), _arithmetic("/", operator.truediv)
    __lt__, __le__ = _comparison("<", operator.lt), _comparison("≤", operator.le)
    __gt__, __ge__ = _comparison(">", operator.gt), _comparison("≥", operator.ge)
    __eq__ = _comparison("=", operator.eq)

    __radd__, __rsub__, __rmul__, __rtruediv__ = map(_swapped, (__add__, __sub__, __mul__, __truediv__))

    def __neg__(self) -> "Traced":
        return Traced(-self.value, _NEGATED.get(self.words, f"−{self.words}"), self.unit)

    def __abs__(self) -> "Traced":
        return Traced(abs(self.value), f"|{self.words}|", self.unit)


def _known(value: Any) -> Traced:
    """A number that stands in a guard as such."""
    if isinstance(value, Traced):
        return value
    return Traced(value, "" if isinstance(value, bool) else f"{value:g}")


def _short(value: float) -> str:
    """Three digits, never a power of ten; as ``short`` of fes/report/static/moments.js."""
    size, value = abs(value), value + 0.0  # which makes −0 a 0
    return f"{value:.0f}" if size >= 1000.0 else f"{value:.4f}" if 0.0 < size < 1e-3 else f"{value:.3g}"
