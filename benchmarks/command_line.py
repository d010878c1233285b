"""What the benchmarks' command lines have in common: options, the console, results as JSON, the last word."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console


def parser_of(text: str | None, data: Path | None = None) -> argparse.ArgumentParser:
    """The benchmark's own text as it stands, and ``--json``; ``--data`` where ``data`` says where recordings are."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    if data is not None:
        parser.add_argument("--data", type=Path, default=data, help="folder of the recordings")
    parser.add_argument("--json", type=Path, help="write the results here as well")
    return parser


def console_of(columns: int) -> Console:
    """As wide as the terminal; where there is none, wide enough for the tables."""
    return Console() if sys.stdout.isatty() else Console(width=columns)


def save(results: Any, path: Path | None) -> None:
    """As JSON, where a path was given."""
    if path is not None:
        path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


def verdict(console: Console, held: bool, *, several: bool = False) -> int:
    """Say whether the bar holds, or the bars; the exit code."""
    if held:
        console.print("The bars hold." if several else "The bar holds.")
    else:
        console.print("[red]The bars do not hold.[/]" if several else "[red]The bar does not hold.[/]")
    return 0 if held else 1
