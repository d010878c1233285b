"""Figures of the pages in docs/: kept as benchmarks/results/NAME.json by what measured them, and rendered.

    python benchmarks/lib/figures.py            render every page from the kept figures and the program's constants
    python benchmarks/lib/figures.py --check    measure the quick ones again; 1 if one has moved or a page is late
    python benchmarks/lib/figures.py --all      measure all again that there are recordings for, keep and render

A page names figures and holds none: between ``<!-- figures: NAME -->`` and ``<!-- end of figures -->`` stand a result's
tables and when, of what and by which command they were made; ``<!-- constant: module:NAME, FORMAT, × FACTOR -->`` and
``<!-- / -->`` hold a constant of the program, times a factor where the page has another unit; ``<!-- figure: NAME; ROW;
COLUMN; HOW -->`` and ``<!-- / -->`` what cells of a result say (:func:`figure`). A number may move by one in its last
digit shown before the check fails: by less nobody sees it, and processors differ in their last bits.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RESULTS, PAGES = ROOT / "benchmarks" / "results", ROOT / "docs"
BLOCK = re.compile(r"<!-- figures: ([\w-]+) -->\n.*?<!-- end of figures -->", re.DOTALL)
CONSTANT = re.compile(r"<!-- constant: ([\w.]+):([\w.]+), ([\w.,+]+)(?:, × (\S+))? -->[^<]*<!-- / -->")
FIGURE = re.compile(r"<!-- figure: ([^>]+?) -->[^<]*<!-- / -->")
NUMBER = re.compile(r"[-+−]?\d[\d,]*(?:\.\d+)?")
NO_RECORDINGS = 3  # a benchmark's exit code without the recordings of others that it needs


@dataclass(frozen=True)
class Figures:
    """One table: its title, its columns with their units, and rows of text as wide as these."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """For a page; a title makes a section."""
        lines = [f"### {self.title}\n"] if self.title else []
        for cells in (self.columns, ["---"] * len(self.columns), *self.rows):
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Result:
    """What a command measured; ``data`` are the digests of what it read, ``machine`` is told where times count, and
    ``notes`` are lines below the tables."""

    command: str
    tables: Sequence[Figures]
    data: dict[str, str] = field(default_factory=dict)
    machine: str = ""
    notes: Sequence[str] = ()
    commit: str = ""
    made: str = ""

    def keep(self, path: Path) -> None:
        """Write it, with today's date and the commit that is checked out."""
        asked = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--exclude", "*"]
        commit = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
        told = asdict(self) | {"commit": commit, "made": datetime.now(UTC).date().isoformat()}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(told, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")

    @staticmethod
    def read(path: Path) -> Result:
        """Back from the file."""
        told = json.loads(path.read_text(encoding="utf-8"))
        return Result(**told | {"tables": [Figures(**each) for each in told["tables"]]})

    def markdown(self) -> str:
        """Its tables, and where they are from."""
        of = ", ".join(f"{name} ({digest})" for name, digest in self.data.items())
        where = f" on {self.machine}" if self.machine else ""
        source = f"`{self.command}`, {self.made}, at {self.commit}{where}{'; ' if of else ''}{of}."
        notes = ["".join(f"- {note}\n" for note in self.notes)] if self.notes else []
        return "\n".join([*(table.markdown() for table in self.tables), *notes, source])


def machine() -> str:
    """This one, in words."""
    return f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}"


def digest(paths: Iterable[Path]) -> str:
    """Of the files, by name and content: eight hexadecimal digits."""
    found = hashlib.sha256()
    for path in sorted(paths):
        found.update(path.name.encode())
        found.update(hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()[:8]


# --- pages ---------------------------------------------------------------------------------------------------


def rendered(page: str, results: Path = RESULTS) -> str:
    """The page with what it names filled in.

    Raises:
        FileNotFoundError, AttributeError: it names figures, or a constant, that there are not.
    """

    def block(found: re.Match[str]) -> str:
        text = Result.read(results / f"{found[1]}.json").markdown()
        return f"<!-- figures: {found[1]} -->\n\n{text}\n\n<!-- end of figures -->"

    def inline(found: re.Match[str], text: str) -> str:
        return f"{found[0].partition('-->')[0]}-->{text}<!-- / -->"

    page = FIGURE.sub(lambda found: inline(found, figure(found[1], results)), BLOCK.sub(block, page))
    return CONSTANT.sub(lambda found: inline(found, constant(*found.groups())), page)


def constant(module: str, path: str, form: str, factor: str | None = None) -> str:
    """A constant of the program as a page has it.

    Raises:
        ImportError, AttributeError: there is none of this name.
    """
    value: Any = importlib.import_module(module)
    for name in path.split("."):
        value = getattr(value() if isinstance(value, type) else value, name)  # of settings as they come
    return f"{value * float(factor or 1.0):{form}}"


def figure(asked: str, results: Path = RESULTS) -> str:
    """What cells of a kept result say, asked for as ``NAME; ROW; COLUMN; HOW``.

    ROW is an expression that the row's cells, joined by ", ", begin with, COLUMN one for the column's whole name. HOW
    is ``one``, ``least``, ``most`` or ``sum`` and an expression with one group: what is taken of each cell in which it
    is found, a number but for ``one``. ROW ``note`` asks the notes instead, which have no columns. In a page's table a
    ``|`` would end the cell, so ``¦`` stands for it.

    Raises:
        FileNotFoundError: no such result.
        ValueError: nothing is found, or several where ``one`` is asked for.
    """
    name, row, column, how = (part.strip() for part in asked.replace("¦", "|").split(";"))
    kept = Result.read(results / f"{name}.json")
    cells = [
        cell
        for table in kept.tables
        for line in table.rows
        if row != "note" and re.match(row, ", ".join(line))
        for title, cell in zip(table.columns, line, strict=True)
        if re.fullmatch(column, title)
    ]
    kind, _, expression = how.partition(" ")
    found = [got[1] for cell in (kept.notes if row == "note" else cells) if (got := re.search(expression, cell))]
    if not found or (kind == "one" and len(set(found)) > 1):
        raise ValueError(f"{asked}: {len(found)} figures")
    if kind == "one":
        return found[0]
    if kind == "sum":
        return f"{sum(map(_value, found)):,.0f}"
    return {"least": min, "most": max}[kind](found, key=_value)


def named(pages: Path = PAGES) -> set[str]:
    """The results that some page shows."""
    return {name for page in pages.glob("*.md") for name in BLOCK.findall(page.read_text(encoding="utf-8"))}


def stale(pages: Path = PAGES, results: Path = RESULTS) -> Iterator[tuple[Path, str]]:
    """Pages that are not as rendered, and how they should be."""
    for page in sorted(pages.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        if (right := rendered(text, results)) != text:
            yield page, right


# --- measured again ------------------------------------------------------------------------------------------


def moved(kept: Result, again: Result) -> list[str]:
    """What differs by more than one in the last digit shown, in words."""
    found = []
    if [table.title for table in kept.tables] != [table.title for table in again.tables]:
        return ["other tables than are kept"]
    for one, other in zip(kept.tables, again.tables, strict=True):
        if len(one.rows) != len(other.rows) or list(one.columns) != list(other.columns):
            found.append(f"{one.title}: another shape than is kept")
            continue
        for was, now in zip(one.rows, other.rows, strict=True):
            pairs = zip(one.columns, was, now, strict=True)
            found += [
                f"{one.title}: {was[0]}, {name}: {a} was kept, {b} is found" for name, a, b in pairs if _far(a, b)
            ]
    return found


def _far(was: str, now: str) -> bool:
    if NUMBER.sub("#", was) != NUMBER.sub("#", now):
        return True
    pairs = zip(NUMBER.findall(was), NUMBER.findall(now), strict=True)
    return any(abs(_value(a) - _value(b)) > 1.01 * 10.0 ** -len(a.partition(".")[2]) for a, b in pairs)


def _value(text: str) -> float:
    return float(text.replace(",", "").replace("−", "-"))


def measured(name: str, arguments: Sequence[str], path: Path) -> int:
    """Run a benchmark into a file of results; its exit code."""
    print(f"{name} …", file=sys.stderr, flush=True)
    command = [sys.executable, str(ROOT / "benchmarks" / arguments[0]), *arguments[1:], "--json", str(path)]
    return subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode


def check(quick: dict[str, Sequence[str]], results: Path = RESULTS) -> int:
    """Measure the quick ones again; 1 if something has moved, or could not be measured."""
    wrong = []
    with TemporaryDirectory() as folder:
        for name, arguments in quick.items():
            path = Path(folder, f"{name}.json")
            code = measured(name, arguments, path)
            if code == NO_RECORDINGS:
                print(f"{name}: its recordings are not on this machine, passed over")
            elif not path.is_file():
                wrong.append(f"{name}: ended with {code}")
            else:
                wrong += [f"{name}: {what}" for what in moved(Result.read(results / path.name), Result.read(path))]
    print("\n".join(wrong) or "No figure has moved.")
    return int(bool(wrong))


QUICK = ("papers-simulated", "dead-sensor")
ELSEWHERE = {"hil": "make hil", "speed-live-minimal": "make minimal"}  # hours, or an environment, of its own


def arguments_of(name: str) -> list[str]:
    """The script below ``benchmarks/`` that made a kept result, and its options."""
    words = shlex.split(Result.read(RESULTS / f"{name}.json").command)
    return [words[1].removeprefix("benchmarks/"), *words[2:]]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="measure the quick ones again and compare")
    parser.add_argument("--all", action="store_true", help="measure all again and keep them")
    given = parser.parse_args()
    if given.check:
        late = [page.name for page, _ in stale()]
        print("".join(f"docs/{name} is out of date: make figures\n" for name in late), end="")
        return max(check({name: arguments_of(name) for name in QUICK}), int(bool(late)))
    worst = 0
    for name in sorted(named() - set(ELSEWHERE)) if given.all else ():
        worst = max(worst, measured(name, arguments_of(name), RESULTS / f"{name}.json"))
    for page, text in stale():
        page.write_text(text, encoding="utf-8")
        print(f"docs/{page.name}")
    return worst


if __name__ == "__main__":
    sys.exit(main())
