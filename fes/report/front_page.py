"""The first page: one verdict, the sentences that matter most, the key figures and the stimulation's dose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fes.report.findings import Finding, Level, findings
from fes.report.flags import CLIPPED_ACC, CLIPPED_GYR, Flag, SensorFlags
from fes.report.summary import ChannelSummary, SessionSummary
from fes.report.text import count_of, number, readable
from fes.report.tuning import DoseRow

FIRST = 6  # sentences on the first page; the rest stand further down
_ORDER: Final[tuple[Level, ...]] = ("alert", "warning", "good", "info")
_VERDICTS: Final[dict[Level, str]] = {
    "alert": "Look before using the numbers",
    "warning": "Usable, with points to look at",
    "good": "No fault found in data and stimulation",
    "info": "No fault found in data and stimulation",
}


@dataclass(frozen=True, slots=True)
class FrontPage:
    """What stands there: the worst level with its words, the first sentences and the others, cards, and the doses."""

    level: Level
    verdict: str
    first: tuple[Finding, ...]
    others: tuple[Finding, ...]
    cards: tuple[dict[str, str], ...]
    doses: tuple[tuple[ChannelSummary, DoseRow | None], ...]


def front_page(
    summary: SessionSummary,
    flags: Mapping[tuple[str, int], Sequence[Flag]],
    sensors: Mapping[str, SensorFlags],
    more: Sequence[Finding] = (),
) -> FrontPage:
    """Put it together; sentences of alerts and warnings come first, in the order in which they were found."""
    every = (*findings(summary), *more, *flag_findings(flags, sensors))
    ordered = sorted(every, key=lambda finding: _ORDER.index(finding.level))
    level: Level = ordered[0].level if ordered else "info"
    dose = {row.channel: row for row in summary.dose}
    return FrontPage(
        level=level,
        verdict=_VERDICTS[level],
        first=tuple(ordered[:FIRST]),
        others=tuple(ordered[FIRST:]),
        cards=tuple(_cards(summary)),
        doses=tuple((channel, dose.get(channel.channel)) for channel in summary.channels),
    )


def flag_findings(flags: Mapping[tuple[str, int], Sequence[Flag]], sensors: Mapping[str, SensorFlags]) -> list[Finding]:
    """A sentence for every sensor that reached its limit."""
    found = []
    for name, sensor in sensors.items():
        for kind, axis, unit in ((CLIPPED_ACC, "acc", "m/s²"), (CLIPPED_GYR, "gyr", "rad/s")):
            samples = int(sensor.at_limit[axis].sum())
            strides = sum(any(flag.kind == kind for flag in own) for (foot, _), own in flags.items() if foot == name)
            if samples:
                how = "" if sensor.known else ", told from the samples, for the range is not known"
                found.append(
                    Finding(
                        "warning",
                        f"Sensor {readable(name)}: {kind} at its limit of {sensor.limits[axis]:.0f} {unit} in "
                        f"{count_of(samples, 'sample')}, in {count_of(strides, 'stride')}{how}.",
                    )
                )
    return found


def _cards(s: SessionSummary) -> list[dict[str, str]]:
    """The key figures of the session: a word from the glossary, a name, a value with its unit, a small line below."""
    total = len(s.strides)
    four, valid = sum(row.four_phases for row in s.strides), sum(row.valid for row in s.strides)
    belt = "no belt known"
    if s.belt_speed_mps > 0:
        belt = f"belt {s.belt_speed_mps:.2f}, ratio {number(s.speed_over_belt, 3)}"
    cards = [
        _card("stride", "Strides", f"{total}", f"{valid} valid"),
        _card("four phases", "All four phases", f"{100 * four / total:.0f} %" if total else "–", f"{four} of {total}"),
        _card("walking speed", "Walking speed", f"{number(s.walking_speed_mps, 2)} m/s", belt),
    ]
    feet = [foot for foot in s.feet.values() if foot.valid]
    if feet:
        cadence = sum(foot.cadence_steps_per_min for foot in feet) / len(feet)
        cards.append(_card("cadence", "Cadence", f"{number(cadence, 0)} /min", "steps"))
    if s.channels:
        bursts, on_s = sum(channel.bursts for channel in s.channels), sum(channel.on_time_s for channel in s.channels)
        charge_mc = sum(channel.charge_uc for channel in s.channels) / 1e3
        cards.append(_card("burst", "Stimulation", count_of(bursts, "burst"), f"{on_s:.1f} s on, {charge_mc:.2f} mC"))
    if s.latency.count:
        cards.append(_card("latency", "Latency p99", f"{s.latency.p99_ms:.2f} ms", f"median {s.latency.p50_ms:.2f} ms"))
    return cards


def _card(term: str, name: str, value: str, below: str) -> dict[str, str]:
    return {"term": term, "name": name, "value": value, "below": below}
