"""What a guard asked and what it saw: its comparisons, one by one, read from the guard's own source.

No rule stands here a second time: the function is parsed, every comparison is evaluated with the features and
thresholds that it was given, and *and*, *or* and early returns are kept, so that a guard that said no can say why.
"""

import ast
import inspect
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

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
_SIGNS: Final = {ast.Lt: "<", ast.LtE: "≤", ast.Gt: ">", ast.GtE: "≥", ast.Eq: "=", ast.NotEq: "≠"}
_OPPOSITE: Final = {"<": "≥", "≥": "<", ">": "≤", "≤": ">", "=": "≠", "≠": "="}
_HOLDS: Final[dict[str, Callable[[Any, Any], bool]]] = {
    "<": lambda a, b: a < b,
    "≤": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    "≥": lambda a, b: a >= b,
    "=": lambda a, b: a == b,
    "≠": lambda a, b: a != b,
}
FLAG: Final = "yes or no"  # instead of a unit
_YES_NO: Final = {True: "yes", False: "no"}
_CALLS: Final = {"abs": abs, "max": max, "min": min}


@dataclass(frozen=True)
class Term:
    """One comparison: ``what`` was ``seen`` and had to be ``sign`` ``limit``; ``limit_is`` says of what it is made."""

    what: str
    seen: float
    sign: str
    limit: float
    limit_is: str
    unit: str
    holds: bool

    def __str__(self) -> str:
        if self.unit == FLAG:
            return f"{self.what}: {_YES_NO[bool(self.seen)]}, must be {_YES_NO[bool(self.limit)]}"
        return f"{self.what} {self.seen:.3g} {self.sign} {self.limit:.3g} {self.unit}".rstrip(" –")

    def failed(self) -> str:
        """The same of one that does not hold, with the opposite sign."""
        if self.unit == FLAG:
            return str(self)
        return f"{self.what} {self.seen:.3g} {_OPPOSITE[self.sign]} {self.limit:.3g} {self.unit}".rstrip(" –")


@dataclass(frozen=True)
class Terms:
    """Terms of which all, or one at least, must hold."""

    every: bool
    parts: tuple["Term | Terms", ...]

    @property
    def holds(self) -> bool:
        """What the guard said."""
        return (all if self.every else any)(part.holds for part in self.parts)

    def each(self) -> Iterator[Term]:
        """Every comparison, in the order of the source."""
        for part in self.parts:
            yield from part.each() if isinstance(part, Terms) else (part,)

    def why_not(self) -> str:
        """What was lacking, "" where nothing was."""
        lacking = [part for part in self.parts if not part.holds]
        if self.holds:
            return ""
        said = [part.why_not() if isinstance(part, Terms) else part.failed() for part in lacking]
        return ", and ".join(said) if self.every else "none of these: " + "; ".join(said)


def terms_of(guard: Guard, x: Features, p: Thresholds) -> Terms:
    """What ``guard`` made of these features and thresholds.

    Raises:
        ValueError: the guard is written in a way that is not understood here.
    """
    known: dict[str, Any] = {"x": x, "p": p, **_CALLS}
    parts: list[Term | Terms] = []
    for line in _body(guard):
        if isinstance(line, ast.Assign) and isinstance(line.targets[0], ast.Name):
            known[line.targets[0].id] = _value(line.value, known)
        elif isinstance(line, ast.If) and _returns_false(line.body) and not line.orelse:
            parts.append(_terms(line.test, known, negated=True))
        elif isinstance(line, ast.Return) and line.value is not None:
            parts.append(_terms(line.value, known, negated=False))
        else:
            raise ValueError(f"{guard.__name__}: {ast.unparse(line)!r} is not understood")
    return Terms(True, tuple(parts))


@cache
def _body(guard: Guard) -> list[ast.stmt]:
    function = ast.parse(textwrap.dedent(inspect.getsource(guard))).body[0]
    assert isinstance(function, ast.FunctionDef)
    return [line for line in function.body if not (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant))]


def _returns_false(lines: list[ast.stmt]) -> bool:
    line = lines[0]
    return isinstance(line, ast.Return) and isinstance(line.value, ast.Constant) and line.value.value is False


def _value(expression: ast.expr, known: dict[str, Any]) -> Any:
    return eval(compile(ast.Expression(expression), "<guard>", "eval"), {"__builtins__": {}}, known)


def _terms(expression: ast.expr, known: dict[str, Any], negated: bool) -> Term | Terms:
    if isinstance(expression, ast.BoolOp):
        parts = tuple(_terms(value, known, negated) for value in expression.values)
        return Terms(isinstance(expression.op, ast.And) is not negated, parts)
    if isinstance(expression, ast.UnaryOp) and isinstance(expression.op, ast.Not):
        return _terms(expression.operand, known, not negated)
    if isinstance(expression, ast.Compare):
        left, sides = expression.left, []
        for operator, right in zip(expression.ops, expression.comparators, strict=True):
            sides.append(_comparison(left, _SIGNS[type(operator)], right, known, negated))
            left = right
        return sides[0] if len(sides) == 1 else Terms(not negated, tuple(sides))
    seen = bool(_value(expression, known))
    return Term(_words(expression), seen, "=", not negated, "", FLAG, seen is not negated)


def _comparison(left: ast.expr, sign: str, right: ast.expr, known: dict[str, Any], negated: bool) -> Term:
    seen, limit = _value(left, known), _value(right, known)
    sign = _OPPOSITE[sign] if negated else sign
    return Term(_words(left), seen, sign, limit, _plain(right), _unit(left), _HOLDS[sign](seen, limit))


def _plain(expression: ast.expr) -> str:
    return ast.unparse(expression).replace("x.", "").replace("p.", "").replace(" * ", " · ")


def _names(expression: ast.expr) -> list[str]:
    return [node.attr for node in ast.walk(expression) if isinstance(node, ast.Attribute)]


def _unit(expression: ast.expr) -> str:
    return next((UNITS[end] for name in _names(expression) if (end := name.rpartition("_")[2]) in UNITS), "–")


def _words(expression: ast.expr) -> str:
    """``-x.toe_down_radps`` → ``−toe down``."""
    text = _plain(expression)
    for name in _names(expression):
        stem, _, end = name.rpartition("_")
        text = text.replace(name, (stem if end in UNITS else name).replace("_", " "))
    return text.replace("-", "−")
