"""One table of several fault campaigns (``out/hil-*/hil.json``), for docs/hil_results.md.

Rows are faults, columns transports. A cell holds the worst time from the fault to the end of the stimulator's output,
for how long of it current flowed in a true stance, at most, where it did, and how many attempts were as required and in
time; campaigns on the same transport are taken together. With ``--json FILE`` it is kept for `make figures`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.lib.command_line import parser_of
from benchmarks.lib.figures import Figures, Result, machine
from fes.hil.scenarios import SCENARIOS

ORDER: Final = {scenario.name: number for number, scenario in enumerate(SCENARIOS)}
KEYS: Final = ("transport", "started", "seconds", "baseline", "rows")


@dataclass(slots=True)
class Cell:
    """One fault on one transport, over all campaigns."""

    made: int = 0
    right: int = 0
    worst_ms: float | None = None
    never: bool = False
    away: int = 0
    wrong_ms: float = 0.0

    def add(self, row: dict[str, Any]) -> None:
        deadline_ms = row["deadline_ms"]
        self.away += len(row.get("away", ()))
        for attempt in row["attempts"]:
            off_ms = attempt["off_ms"]
            self.made += 1
            self.never |= off_ms == "never"
            late = off_ms == "never" or (off_ms is not None and deadline_ms is not None and off_ms > deadline_ms)
            self.wrong_ms = max(self.wrong_ms, attempt.get("wrong_ms") or 0.0)
            self.right += not late and not attempt["faults"]
            if isinstance(off_ms, (int, float)):
                self.worst_ms = max(off_ms, self.worst_ms or 0.0)

    def __str__(self) -> str:
        if not self.made:
            return "–"
        time = "still on, " if self.never else "" if self.worst_ms is None else f"{self.worst_ms:.1f} ms, "
        stance = f"{self.wrong_ms:.0f} ms in stance, " if self.wrong_ms else ""
        text = f"{time}{stance}{self.right} of {self.made}"
        return text if self.right == self.made else f"**{text}**"


def merged(campaigns: Sequence[dict[str, Any]]) -> Result:
    """The table, and what each campaign was."""
    transports = list(dict.fromkeys(campaign["transport"] for campaign in campaigns))
    lines: dict[str, tuple[list[str], dict[str, Cell]]] = {}  # the fault with its deadline, and its cells
    for campaign in campaigns:
        for row in campaign["rows"]:
            deadline = "–" if row["deadline_ms"] is None else f"{row['deadline_ms']:g} ms"
            _, cells = lines.setdefault(row["name"], ([row["fault"].replace("|", "/"), deadline], {}))
            cells.setdefault(campaign["transport"], Cell()).add(row)
    rows = [
        [*fault, *(str(cells.get(each, "")) for each in transports)]
        for _, (fault, cells) in sorted(lines.items(), key=lambda named: ORDER.get(named[0], len(ORDER)))
    ]
    table = Figures("", ["fault", "off within", *transports], rows)
    return Result("make hil", [table], machine=machine(), notes=[_campaign(campaign) for campaign in campaigns])


def _campaign(campaign: dict[str, Any]) -> str:
    baseline = campaign["baseline"]
    away = len(campaign.get("away", ())) + sum(len(row.get("away", ())) for row in campaign["rows"])
    unasked = len(campaign.get("unasked", ()))
    attempts = sum(len(row["attempts"]) for row in campaign["rows"])
    return (
        f"{campaign['transport']}, {campaign['started'][:16].replace('T', ' ')}: {attempts} attempts in "
        f"{campaign['seconds'] / 60:.0f} minutes; idle loop late by p99 {baseline['p99_ms']:g}, p99.9 "
        f"{baseline['p999_ms']:g}, at most {baseline['most_ms']:g} ms; machine away {away} times; off without a fault "
        f"{unasked} times."
    )


def read(path: Path) -> dict[str, Any]:
    """A campaign's ``hil.json``.

    Raises:
        ValueError: it cannot be read, or is none; the message names it.
    """
    try:
        data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        missing = [key for key in KEYS if key not in data]
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{path}: cannot be read: {error}. Give hil.json files that `fes hil` wrote.") from error
    if missing:
        raise ValueError(f"{path}: is no campaign's result: {', '.join(missing)} missing. Give hil.json files.")
    return data


def main(arguments: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("results", nargs="+", type=Path, help="hil.json files, one per campaign")
    options = parser.parse_args(arguments)
    try:
        result = merged([read(path) for path in options.results])
    except ValueError as error:
        parser.error(str(error))
    print(result.markdown())
    if options.json is not None:
        result.keep(options.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
