"""One table: every data set, each of our methods, each peer that installs from a registry.

    make bench-accuracy        (both environments, then this, and the page)

Peers run in an environment of their own (`make peers`); without it the table has our rows alone and says so. The exit
code is 0 however the numbers come out, and 3 without recordings: the table says which bars are met.
"""

from __future__ import annotations

import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.accuracy.accuracy_ours import our_rows
from benchmarks.accuracy.accuracy_rows import in_order, tables, verdicts, with_bar
from benchmarks.lib.command_line import no_recordings, parser_of, publish
from benchmarks.lib.real_sets import data_folder
from benchmarks.peers.cases import all_asked
from benchmarks.peers.judge import judge

ROOT = Path(__file__).resolve().parents[2]
RUNNERS = ("run_orientation.py", "run_gaitmap.py")


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--peers", type=Path, default=ROOT / ".venv-peers" / "bin" / "python", help="their Python")
    options = parser.parse_args(arguments)
    asked = all_asked(options.data)
    if not asked:
        return no_recordings(options.data)
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
    publish(tables(rows), options, [*verdicts(rows), *notes])
    return 0


def peers_at_work(python: Path, exchange: Path) -> dict[str, subprocess.Popen[bytes]]:
    """The peers' processes, which leave their results in ``exchange``; none where their environment is not there."""
    if not python.is_file():
        return {}
    scripts = Path(__file__).parents[1] / "peers"
    return {runner: subprocess.Popen([python, scripts / runner, exchange]) for runner in RUNNERS}


if __name__ == "__main__":
    raise SystemExit(main())
