"""One table: every data set, each of our methods, each peer that installs from a registry.

    make bench-accuracy        (both environments, then this)
    python benchmarks/accuracy/accuracy_table.py [--peers PYTHON] [--json FILE] [--markdown FILE]

The recordings lie in $FES_DATA, else in ../shared/data; without them this says so and exits with 3. Peers run in an
environment of their own (`make peers`); without it the table has our rows alone and says so. The exit code is 0
however the numbers come out: the table says which bars are met.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console

from benchmarks.accuracy.accuracy_bars import with_bar
from benchmarks.accuracy.accuracy_ours import our_rows
from benchmarks.accuracy.accuracy_row import Row
from benchmarks.accuracy.accuracy_text import in_order, markdown, rich_table, verdicts
from benchmarks.accuracy.stroke_treadmill import data_folder
from benchmarks.peers.cases import all_asked
from benchmarks.peers.judge import judge

ROOT = Path(__file__).resolve().parents[2]
RUNNERS = ("run_orientation.py", "run_gaitmap.py")


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder of the recordings")
    parser.add_argument("--peers", type=Path, default=ROOT / ".venv-peers" / "bin" / "python", help="their Python")
    parser.add_argument("--json", type=Path, default=ROOT / "benchmarks" / "results" / "accuracy.json")
    parser.add_argument("--markdown", type=Path, default=ROOT / "docs" / "accuracy_table.md")
    options = parser.parse_args(arguments)
    asked = all_asked(options.data)
    if not asked:
        print(f"No recordings in {options.data}; set FES_DATA or give --data.", file=sys.stderr)
        return 3
    began = time.monotonic()
    with TemporaryDirectory(prefix="fes-peers-") as name:
        exchange = Path(name)
        for one in asked:
            one.case.write(exchange)
        runs = peers_at_work(options.peers, exchange)
        try:
            rows = our_rows(options.data, asked)
            failures = [f"{runner} ended with {run.wait()}" for runner, run in runs.items() if run.wait() != 0]
        finally:
            for run in runs.values():
                run.kill()
                run.wait()
        rows += judge(exchange, asked)
    rows = in_order([with_bar(row) for row in rows])
    notes = [] if runs else [f"Peers are not in this table: {options.peers} is not there; `make peers` makes it."]
    notes += [f"Peers are not complete: {failure}." for failure in failures]
    console = Console() if sys.stdout.isatty() else Console(width=200)
    console.print(rich_table(rows))
    for line in verdicts(rows):
        console.print(line)
    for note in notes:
        console.print(note)
    console.print(f"{time.monotonic() - began:.0f} s")
    for path, text in ((options.json, to_json(rows, notes)), (options.markdown, markdown(rows, notes))):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return 0


def peers_at_work(python: Path, exchange: Path) -> dict[str, subprocess.Popen[bytes]]:
    """The peers' processes, which leave their results in ``exchange``; none where their environment is not there."""
    if not python.is_file():
        return {}
    scripts = Path(__file__).parents[1] / "peers"
    return {runner: subprocess.Popen([python, scripts / runner, exchange]) for runner in RUNNERS}


def to_json(rows: list[Row], notes: list[str]) -> str:
    """The table for programs."""
    return json.dumps({"notes": notes, "rows": [row.to_json() for row in rows]}, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
