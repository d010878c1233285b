"""What a guard asked and what it saw: its comparisons, one by one, read from the guard's own source.

No rule stands here a second time: the function is parsed once, every comparison is evaluated with the features and
thresholds that it was given, and *and*, *or* and early returns are kept, so that a guard that said no can say why.

What was parsed is plain lists and numbers (:data:`Expression`), so that a page can evaluate a guard as well.
"""

import ast
import inspect
import operator
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
Expression = float | bool | list[Any]  # a number, ["x" or "p", field], or [operation, operands …]
_OPERATORS: Final = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_DO: Final[dict[str, Callable[..., Any]]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "neg": operator.neg,
    "abs": abs,
    "max": max,
    "min": min,
}


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
        return f"{self.what} {_short(self.seen)} {self.sign} {_short(self.limit)} {self.unit}".rstrip(" –")

    def failed(self) -> str:
        """The same of one that does not hold, with the opposite sign."""
        if self.unit == FLAG:
            return str(self)
        return f"{self.what} {_short(self.seen)} {_OPPOSITE[self.sign]} {_short(self.limit)} {self.unit}".rstrip(" –")


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


@dataclass(frozen=True)
class Comparison:
    """A :class:`Term` before anything was seen: both sides as expressions."""

    what: str
    seen: Expression
    sign: str
    limit: Expression
    limit_is: str
    unit: str

    def evaluated(self, x: Features, p: Thresholds) -> Term:
        """What it makes of these features and thresholds."""
        seen, limit = value_of(self.seen, x, p), value_of(self.limit, x, p)
        return Term(self.what, seen, self.sign, limit, self.limit_is, self.unit, _HOLDS[self.sign](seen, limit))


@dataclass(frozen=True)
class Comparisons:
    """:class:`Terms` before anything was seen."""

    every: bool
    parts: tuple["Comparison | Comparisons", ...]

    def evaluated(self, x: Features, p: Thresholds) -> Terms:
        """What they make of these features and thresholds."""
        return Terms(self.every, tuple(part.evaluated(x, p) for part in self.parts))


def terms_of(guard: Guard, x: Features, p: Thresholds) -> Terms:
    """What ``guard`` made of these features and thresholds.

    Raises:
        ValueError: the guard is written in a way that is not understood here.
    """
    return comparisons_of(guard).evaluated(x, p)


@cache
def comparisons_of(guard: Guard) -> Comparisons:
    """The guard's comparisons, as its source has them.

    Raises:
        ValueError: the guard is written in a way that is not understood here.
    """
    function = ast.parse(textwrap.dedent(inspect.getsource(guard))).body[0]
    assert isinstance(function, ast.FunctionDef)
    known: dict[str, Expression] = {}
    parts: list[Comparison | Comparisons] = []
    for line in function.body:
        if isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant):
            continue  # its docstring
        try:
            if isinstance(line, ast.Assign) and isinstance(line.targets[0], ast.Name):
                known[line.targets[0].id] = _expression(line.value, known)
                continue
            if isinstance(line, ast.If) and _returns_false(line.body) and not line.orelse:
                parts.append(_comparisons(line.test, known, negated=True))
                continue
            if isinstance(line, ast.Return) and line.value is not None:
                parts.append(_comparisons(line.value, known, negated=False))
                continue
        except KeyError:
            pass
        raise ValueError(f"{guard.__name__}: {ast.unparse(line)!r} is not understood")
    return Comparisons(True, tuple(parts))


def _short(value: float) -> str:
    """Three digits, never a power of ten; as ``short`` of fes/report/static/moments.js."""
    size = abs(value)
    return f"{value:.0f}" if size >= 1000.0 else f"{value:.4f}" if 0.0 < size < 1e-3 else f"{value:.3g}"


def value_of(expression: Expression, x: Features, p: Thresholds) -> Any:
    """The expression's value with these features and thresholds."""
    if not isinstance(expression, list):
        return expression
    head, *rest = expression
    if head in ("x", "p"):
        return getattr(x if head == "x" else p, rest[0])
    return _DO[head](*(value_of(each, x, p) for each in rest))


def _returns_false(lines: list[ast.stmt]) -> bool:
    line = lines[0]
    return isinstance(line, ast.Return) and isinstance(line.value, ast.Constant) and line.value.value is False


def _expression(node: ast.expr, known: dict[str, Expression]) -> Expression:
    """A side of a comparison as plain values; KeyError where it is written in another way."""
    if isinstance(node, ast.Constant) and isinstance(node.value, (bool, int, float)):
        return node.value
    if isinstance(node, ast.Name):
        return known[node.id]
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ("x", "p"):
        return [node.value.id, node.attr]
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return ["neg", _expression(node.operand, known)]
    if isinstance(node, ast.BinOp):
        return [_OPERATORS[type(node.op)], _expression(node.left, known), _expression(node.right, known)]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _DO:
        return [node.func.id, *(_expression(each, known) for each in node.args)]
    raise KeyError(ast.unparse(node))


def _comparisons(node: ast.expr, known: dict[str, Expression], negated: bool) -> Comparison | Comparisons:
    if isinstance(node, ast.BoolOp):
        parts = tuple(_comparisons(value, known, negated) for value in node.values)
        return Comparisons(isinstance(node.op, ast.And) is not negated, parts)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return _comparisons(node.operand, known, not negated)
    if isinstance(node, ast.Compare):
        left, sides = node.left, []
        for sign_of, right in zip(node.ops, node.comparators, strict=True):
            sign = _OPPOSITE[_SIGNS[type(sign_of)]] if negated else _SIGNS[type(sign_of)]
            values = _expression(left, known), sign, _expression(right, known)
            sides.append(Comparison(_words(left), *values, _plain(right), _unit(left)))
            left = right
        return sides[0] if len(sides) == 1 else Comparisons(not negated, tuple(sides))
    return Comparison(_words(node), _expression(node, known), "=", not negated, "", FLAG)


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
