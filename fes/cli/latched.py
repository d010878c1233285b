"""Saying at a replay's end that the gate had latched: the exit code does not, for a gate that stops did its work."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

import click

if TYPE_CHECKING:
    from fes.view.quality import Remark

GATE: Final = "gate"
LATCHED: Final = "off until armed again: "  # as fes.runner notes it
ARMED_AGAIN: Final = "armed again"


def latched(remarks: Iterable[Remark]) -> str:
    """How often and when the gate latched, and whether it stayed so; "" when it never did. Times are the session's."""
    told = [each for each in remarks if each.source == GATE]
    latches = [each for each in told if each.severity == "fault" and each.text.startswith(LATCHED)]
    if not latches:
        return ""
    first, last = latches[0], latches[-1]
    rearmed = next((each.time_s for each in told if each.text == ARMED_AGAIN and each.time_s >= last.time_s), None)
    times = "once" if len(latches) == 1 else f"{len(latches)} times, first"
    what = f"The gate latched {times} at {first.time_s:.3f} s: {first.text.removeprefix(LATCHED)}."
    if rearmed is None:
        return f"{what} Nothing was stimulated from {last.time_s:.3f} s to the end."
    return f"{what} It was last armed again at {rearmed:.3f} s."


def tell_latched(remarks: Iterable[Remark]) -> None:
    """On stderr, in red, where there is something to tell."""
    if said := latched(remarks):
        click.secho(said, fg="red", bold=True, err=True)
