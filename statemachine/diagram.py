"""The state diagram and the thresholds as Markdown, derived from the code: ``python -m statemachine.diagram``.

The arrows come from the transition table, their words from the first line of each guard's docstring, the thresholds
from the fields of :class:`~statemachine.guards.Thresholds` with the comments beside them. So the documentation cannot
say something else than what runs; a test holds ``docs/phases.md`` to it.
"""

import argparse
import inspect
import re
from collections.abc import Sequence
from pathlib import Path

from statemachine.guards import Thresholds
from statemachine.phases import Phase
from statemachine.table import TABLE, Row
from statemachine.terms import unit

BEGIN = "<!-- begin: written by `python -m statemachine.diagram --write docs/phases.md` -->"
END = "<!-- end -->"
_FIELD = re.compile(r"^    (\w+): (?:float|bool) = .*?  # (?:(T\d[T\d, –]*): )?(.+)$", re.MULTILINE)


def condition(row: Row) -> str:
    """What lets the transition happen, in words: its guard's docstring's first line behind the colon."""
    first = inspect.cleandoc(row.guard.__doc__ or "").splitlines()[0]
    return first.partition(": ")[2].rstrip(".")


def mermaid() -> str:
    """The table as a Mermaid state diagram."""
    lines = ["stateDiagram-v2", f"    [*] --> {Phase.STANCE.name}"]
    for row in TABLE:
        lines.append(f"    {row.source.name} --> {row.destination.name} : {row.transition.name} {condition(row)}")
    return "\n".join(lines)


def transitions_table() -> str:
    """The table as Markdown."""
    lines = ["| | from | to | when |", "|---|---|---|---|"]
    for row in TABLE:
        lines.append(
            f"| {row.transition.name} | {_words(row.source)} | {_words(row.destination)} | {_cell(condition(row))} |"
        )
    return "\n".join(lines)


def thresholds_table() -> str:
    """All thresholds with value, unit, which transitions look at them, and meaning, as Markdown."""
    lines = ["| threshold | default | unit | for | meaning |", "|---|---|---|---|---|"]
    used = ""
    for name, transitions, meaning in _FIELD.findall(inspect.getsource(Thresholds)):
        used = transitions or used  # a comment that goes on from the line above names no transition
        value = Thresholds._field_defaults[name]
        shown = ("no", "yes")[value] if isinstance(value, bool) else f"{value:g}"
        lines.append(f"| `{name}` | {shown} | {unit(name)} | {used} | {_cell(meaning)} |")
    return "\n".join(lines)


def generated() -> str:
    """All that stands between the markers."""
    return f"```mermaid\n{mermaid()}\n```\n\n{transitions_table()}\n\n{thresholds_table()}"


def updated(text: str) -> str:
    """A document with what stands between the markers made anew.

    Raises:
        ValueError: the markers are not there once each, in order.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end or BEGIN in after or END in after:
        raise ValueError(f"expected one line {BEGIN!r} and after it one line {END!r}")
    return f"{before}{BEGIN}\n\n{generated()}\n\n{END}{after}"


def _cell(text: str) -> str:
    return text.replace("|", r"\|")


def _words(phase: Phase) -> str:
    return phase.name.lower().replace("_", " ").replace("pre swing", "pre-swing")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the generated part, write it into a document, or check that a document has it as it is now."""
    parser = argparse.ArgumentParser(prog="python -m statemachine.diagram", description=main.__doc__)
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--write", type=Path, metavar="FILE", help="put it between the markers of FILE")
    what.add_argument("--check", type=Path, metavar="FILE", help="exit 1 if FILE is out of date")
    options = parser.parse_args(arguments)
    path: Path | None = options.write or options.check
    if path is None:
        print(generated())
        return 0
    try:
        text = path.read_text(encoding="utf-8")
        new = updated(text)
    except (OSError, ValueError) as error:
        parser.error(f"{path}: {error}")
    if options.check:
        if new != text:
            print(f"{path} is out of date: run python -m statemachine.diagram --write {path}")
        return int(new != text)
    path.write_text(new, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
