"""The accuracy table for people: on the terminal and as Markdown."""

from __future__ import annotations

from itertools import groupby

from rich.table import Table

from benchmarks.accuracy.accuracy_row import Row

HEAD = ("method", "known", "n", "bias", "SD", "RMSE", "worst", "recall", "met", "note")
PREAMBLE = """# Accuracy, ours and others'

Made by `make bench-accuracy` from the recordings in `$FES_DATA` or `../shared/data`; do not edit.

One default setting everywhere. Errors are estimate − truth; worst is the greatest absolute error; recall is the share
of what the reference holds that was found, n what the errors were counted on. *causal*: known at the latest when the
stride or event is over; *off-line*: the method looks at the whole recording.

*Reference borders* are those of the data set. Not all methods end a stride at exactly these instants: our two stride
solvers move each border to the quietest instant within 50 ms, and are held against the truth between the moved borders;
our ZUPT filter and the peers stay at the given ones, and are held against the truth there. So that one comparison is
like for like, three peers are also run between the borders that our solver chose, against the same truth: the rows
*our ends*. The strides that count are the same for all: those that the reference disputes, shuffles under 0.3 m and its
glitches are left out. But our solvers leave out some more, which they call invalid or which lie outside the walking
that the phase machine saw; n and recall show it.

*Own detection*: the reference is asked at the ends that each method found itself, and the strides it did not find show
in the recall alone. On the treadmill, where no reference borders exist, peers get those that our tracker found; `own
detection` is a peer's own.

Peers run with the defaults of their documentation, and all get axes x forward, y left, z up and a gyroscope free of the
bias found in a standing second, which is more help than our own methods get. What they do and where that departs from
their documentation stands in `benchmarks/peers/`. The figures of our own methods are in-sample as docs/accuracy.md
says: their constants were chosen with these recordings at hand.
"""


def in_order(rows: list[Row]) -> list[Row]:
    """By data set and quantity, the least error first, what did not run last."""
    last = float("inf")

    def key(row: Row) -> tuple[str, str, float, str]:
        size = row.rmse if row.rmse == row.rmse else abs(row.bias)
        return row.data_set, row.quantity, size if size == size else last, row.method

    return sorted(rows, key=key)


def cells(row: Row) -> list[str]:
    """One row as text, under `HEAD`."""

    def number(value: float, sign: str = "") -> str:
        return "–" if value != value else f"{value:{sign}.2f}"

    recall = "–" if row.recall != row.recall else f"{100 * row.recall:.1f} %"
    met = "" if row.bar_met is None else ("yes" if row.bar_met else "no")
    errors = [number(row.bias, "+"), number(row.sd), number(row.rmse), number(row.worst)]
    return [row.method, row.known, str(row.n), *errors, recall, met, row.note]


def groups(rows: list[Row]) -> list[list[Row]]:
    """Rows of one quantity of one data set each, in the order they come."""
    return [list(group) for _, group in groupby(rows, lambda row: (row.data_set, row.quantity))]


def bar_of(group: list[Row]) -> str:
    """The bar of a quantity in words, empty where it has none."""
    return next((row.bar for row in group if row.bar), "")


def rich_table(rows: list[Row]) -> Table:
    """For the terminal; our rows are bold."""
    table = Table("what, and its bar", *HEAD)
    for group in groups(rows):
        table.add_section()
        bar = bar_of(group)
        said = [group[0].data_set, f"{group[0].quantity} ({group[0].unit})", *([f"bar: {bar}"] if bar else [])]
        beside = [*said[: len(group) - 1], "\n".join(said[len(group) - 1 :])]
        for k, row in enumerate(group):
            table.add_row(beside[k] if k < len(beside) else "", *cells(row), style="bold" if row.ours else "")
    return table


def verdicts(rows: list[Row]) -> list[str]:
    """Of every bar, which of our methods meet it."""
    lines = []
    for group in groups(rows):
        judged = [row for row in group if row.ours and row.bar_met is not None]
        if judged:
            met = ", ".join(f"{row.method} ({row.known})" for row in judged if row.bar_met)
            verdict = f"met by {met}" if met else "NOT MET by any of our methods"
            lines.append(f"{group[0].data_set}, {group[0].quantity}: {bar_of(group)}: {verdict}")
    return lines


def markdown(rows: list[Row], notes: list[str]) -> str:
    """The page for docs/."""
    parts = [PREAMBLE, *(f"\n{note}\n" for note in notes), "\n## The bars\n\n"]
    parts += [f"- {line}\n" for line in verdicts(rows)]
    for data_set, of_set in groupby(rows, lambda row: row.data_set):
        parts.append(f"\n## {data_set}\n")
        for group in groups(list(of_set)):
            bar = bar_of(group)
            parts.append(f"\n### {group[0].quantity} ({group[0].unit})\n\n" + (f"Bar: {bar}.\n\n" if bar else ""))
            parts.append("| " + " | ".join(HEAD) + " |\n|" + " --- |" * len(HEAD) + "\n")
            for row in group:
                texts = cells(row)
                texts[0] = f"**{texts[0]}**" if row.ours else texts[0]
                parts.append("| " + " | ".join(text.replace("|", "\\|") for text in texts) + " |\n")
    return "".join(parts)
