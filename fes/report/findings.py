"""What a session amounts to: short plain sentences with a weight, and the first page that is made of them."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from fes.live.status import remedy
from fes.report.quality import SensorQuality
from fes.report.stimulation import SKIPPED, STILL, STOPPED, TuningRow
from fes.report.strides import StrideRow, summed_up
from fes.report.summary import FORMAT, ChannelSummary, ExerciseSummary, SessionSummary
from fes.report.text import capitalised, count_of, in_one, plain, readable, together, without_numbers
from fes.stimulation.onset import ONSET
from fes.stimulation.order import NOTED
from fes.walk_record import Finding, Level

SPEED_TOLERANCE = 0.05  # of the belt's speed, which treadmills show to 0.1 m/s
SILENCE_MS = 100.0
FEW_UNEXPLAINED = 0.05  # of the swings: pivots and small steps
REFUSED_BY_CHOICE: Final = ("not armed", "emergency stop")  # a person had not armed, or had stopped
_WALKING: Final = "walking_s", "unexplained_s"  # of a foot
MOST_NAMED: Final = 6
LEAST_STEP_MA: Final = 0.5
LOOK_AT_IT: Final = "; look at it"  # what the tuning did in the same stride follows
TOE_SD_CM: Final = 0.6  # of the toe's clearance against optical markers, where the toe is known: docs/accuracy.md
FIRST = 6  # sentences on the first page; the rest stand further down
_VERDICTS: Final[dict[Level, str]] = {  # what matters most first
    "alert": "Look before using the numbers",
    "warning": "Usable, with points to look at",
    "good": "No fault found in data and stimulation",
    "info": "No fault found in data and stimulation",
}
_LINK_REMEDIES: Final = {  # what of the stream was lost, and what all sensors waited for
    "stream": "check the sensor's link",
    "silence": "check the radio or the cable, and what else the computer does",
}
_VERDICT_OF_DATA: Final = "No fault found in the data"


DOUBTFUL_SHARE, FEWEST_STRIDES = 0.7, 5


def findings(summary: SessionSummary) -> tuple[Finding, ...]:
    """All sentences, in the order in which they matter; what several sensors say alike stands once."""
    return merged(_findings(summary))


def session_json(summary: SessionSummary) -> dict[str, Any]:
    """Summary, verdict and findings as plain values, NaN as null; ``format`` changes when a key changes its meaning."""
    every = findings(summary)
    level, words = verdict(every, only_data=is_only_data(summary))
    numbers = {key: value for key, value in plain(summary).items() if key != "sensor_findings"}
    judged = {"level": level, "verdict": words, "findings": plain(every)}
    return {"format": FORMAT, **numbers, **judged}


def merged(found: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings of one kind and cause as one, with their count and the sensors; numbers as least … greatest.

    Those with numbers in their effect are one only where all of their numbers are equal.
    """
    groups: dict[object, list[Finding]] = {}
    for each in found:
        said = each.text.partition(": ")[2]
        like = said if without_numbers(each.effect) != each.effect else without_numbers(said)
        alike = each.level, each.code, each.corrected, each.remedy, like
        groups.setdefault(alike if each.code and each.sensor else id(each), []).append(each)
    return tuple(own[0] if len(own) == 1 else _as_one(own) for own in groups.values())


def _as_one(own: Sequence[Finding]) -> Finding:
    sensors = list(dict.fromkeys(each.sensor for each in own))
    where = ", ".join(map(readable, sensors))
    several = len(sensors) > 1
    who = f"{count_of(len(sensors), 'sensor')} ({where})" if several else f"Sensor {where}, {len(own)} times"
    text = f"{who}: {in_one([each.text.partition(': ')[2] for each in own])}"
    causes = [each.cause for each in own]
    cause = in_one(causes) if len({without_numbers(one) for one in causes}) == 1 else causes[0]
    return replace(own[0], text=text, sensor=", ".join(sensors), cause=cause, count=len(own))


def _findings(summary: SessionSummary) -> Iterator[Finding]:
    if not summary.complete:
        lost = f" Lost: {summary.lost}." if summary.lost else ""
        yield Finding("alert", f"The session log has no proper end; the numbers cover only what was kept.{lost}")
    if summary.faults:
        first, count = summary.faults[0], count_of(len(summary.faults), "fault")
        where = f"the first at {first.time_s:.1f} s ({first.source}): {first.text}"
        yield Finding("alert", f"{count} noted, {where}. {remedy(first.text)}".rstrip())
    yield from summary.sensor_findings
    if done := summed_up(summary.by_hand):
        yield Finding("info", f"By hand: {done}.")
    if not summary.channels and summary.kind != "analysis":
        yield Finding("info", "No stimulation channel was set up.")
    if summary.thresholds:
        yield Finding("info", f"{capitalised(summary.thresholds)}.")
    if summary.exercise is not None:
        yield from _exercise(summary, summary.exercise)
        yield from _wire(summary)
    else:
        for channel in summary.channels:
            yield from _channel(channel, summary.command_period_s)
            yield from _tuning(channel, summary)
        yield from _wire(summary)
        yield from _noted(summary)
        yield from _toe_on_the_ground(summary)
        yield from _strides(summary)
        yield from _speed(summary)
    if summary.refusals:
        most, total = summary.refusals[0], sum(refusal.count for refusal in summary.refusals)
        often = f"most often: {most.reason} ({most.count})"
        by_choice = all(refusal.reason in REFUSED_BY_CHOICE for refusal in summary.refusals)
        text = f"The safety gate turned {count_of(total, 'command')} off; {often}."
        yield Finding("info" if by_choice else "warning", text)
    latency = summary.latency
    if latency.count:
        p50, p99, most_ms = (f"{ms:.2f} ms" for ms in (latency.p50_ms, latency.p99_ms, latency.max_ms))
        yield Finding("info", f"From sample to decision: {p50} in the median, 99 % within {p99}, at most {most_ms}.")
    for sensor in summary.sensors:
        yield from _sensor(sensor)


def _exercise(summary: SessionSummary, exercise: ExerciseSummary) -> Iterator[Finding]:
    sets = f"{exercise.done}" if exercise.done > exercise.count else f"{exercise.done} of {exercise.count}"
    yield Finding("good" if exercise.done >= exercise.count else "info", f"Exercise: {sets} bursts asked for.")
    for channel in summary.channels:
        given = channel.bursts - channel.bursts_by_hand
        text = f"{channel.name}: {count_of(given, 'burst')} of exercise, {channel.on_time_s:.1f} s on in all."
        yield Finding("good" if given == exercise.done else "warning", text)


def _wire(summary: SessionSummary) -> Iterator[Finding]:
    """What the run itself counted when it held the commands against the stimulator's answers."""
    keys = ("commands", "missing", "different")
    told = [[each.get(key) for key in keys] for each in summary.run_summary.values() if isinstance(each, dict)]
    for commands, missing, different in [each for each in told if all(isinstance(count, int) for count in each)][:1]:
        if missing or different:
            lacks = f"left {missing} unanswered and did {different} differently"
            yield Finding("alert", f"Of {commands} commands the stimulator {lacks}.")
        else:
            yield Finding("good", f"The stimulator answered all {commands} commands and did what each one said.")


def _channel(channel: ChannelSummary, period_s: float) -> Iterator[Finding]:
    name = channel.name
    if channel.on_without_command:
        often = count_of(channel.on_without_command, "time")
        text = f"{name}: the stimulator answered {often} that it was on although no command asked for it."
        yield Finding("alert", text)
    if not channel.bursts:
        yield Finding("info", f"{name}: never stimulated.")
        return
    if not channel.foot:
        yield Finding("warning", f"{name}: stimulated, but the log's settings do not say on which foot.")
        return
    times = count_of(channel.bursts, "time")
    times += f" ({channel.bursts_by_hand} of them by hand)" if channel.bursts_by_hand else ""
    if channel.foreseen:
        times += f", {channel.bursts_early} times before its heel rise was detected, for it was foreseen"
    window = f"{readable(channel.start_phase)} … {readable(channel.stop_phase)}"
    if channel.longest_outside_s == 0:
        yield Finding("good", f"{name}: stimulated {times}, never outside {window} of its foot.")
    elif channel.longest_outside_s <= period_s:
        most = f"for at most {channel.longest_outside_s * 1e3:.0f} ms, no longer than one command lasts"
        yield Finding("info", f"{name}: stimulated {times}; {channel.bursts_outside} reached outside {window} {most}.")
    else:
        some = f"{channel.bursts_outside} of {count_of(channel.bursts, 'burst')} outside {window}"
        how = f"{channel.outside_s:.2f} s in all, the longest {channel.longest_outside_s * 1e3:.0f} ms"
        yield Finding("alert", f"{name}: {some}, {how}.")


def _tuning(channel: ChannelSummary, summary: SessionSummary) -> Iterator[Finding]:
    """What the tuning made of a channel, and what it gave up on."""
    own = [row for row in summary.tuning if row.channel == channel.channel]
    if not own:
        return
    skipped = sum(SKIPPED in row.text for row in own)
    changes = [row for row in own if row.changes and SKIPPED not in row.text]
    faults = [row for row in own if row.kind == "fault"]
    strides = [row for row in summary.strides if any(i.channel == channel.channel for i in row.stimulation)]
    if changes and strides:
        moved = [row for row in changes if (", current " in row.text or ": current " in row.text)] or changes
        first, last = (_stride_before(edge.time_s, strides) for edge in (moved[0], moved[-1]))
        when = f"between strides {first} and {last}" if last > first else f"at stride {first}"
        why = changes[0].text.split(": current")[0].split(": pulse width")[0]
        measured, of_stride, _ = why.partition(" in this stride")
        why = f"at first {measured}" if of_stride else why
        blamed = "".join(f"; noticed at {row.time_s:.1f} s: {_blame(row)}" for row in faults)
        went = _went(strides, channel.channel)
        text = f"{channel.name}: {went} {when}: {why}{blamed} ({count_of(len(changes), 'change')}"
        yield Finding("info", f"{text}, {count_of(skipped, 'stride')} taught it nothing).", leads=True)
    else:
        asked = [row for row in own if row.kind == "suggestion"]
        made = f"made {count_of(len(asked), 'suggestion')} and no change" if asked else "made no change"
        newest = f" The last, at {asked[-1].time_s:.1f} s: {asked[-1].text.partition(': ')[2]}." if asked else ""
        yield Finding(
            "info", f"{channel.name}: tuning {made}; {count_of(skipped, 'stride')} taught it nothing.{newest}"
        )
    if reach := next((row for row in summary.reached if row.channel == channel.channel), None):
        yield Finding("good" if reach.within else "alert", f"{channel.name}: {reach.text}.")
    if known := [row for row in own if row.kind == "identified"]:
        yield Finding("info", f"{channel.name}, {known[-1].text}.")
    stopped = [row for row in own if STOPPED in row.text]
    back = [row for row in own if row.kind == "roll_back" and row not in stopped and STILL not in row.text]
    hints = [row for row in own if row.kind == "hint"]
    told = ((faults, "noticed a change"), (stopped, "stopped"), (back, "went back"), (hints, "asks for a look"))
    for rows, what in told:
        if rows:
            often = f" {count_of(len(rows), 'time')}, first" if len(rows) > 1 else ""
            said = rows[0].text.split(LOOK_AT_IT)[0] + (LOOK_AT_IT if LOOK_AT_IT in rows[0].text else "")
            text = f"{channel.name}: tuning {what}{often} at {rows[0].time_s:.1f} s: {said}."
            yield Finding("warning", text)


def _went(strides: Sequence[StrideRow], channel: int) -> str:
    """What became of the stimulation from the first to the last stride that had it: current, else a step's charge."""
    given = [i for row in strides for i in row.stimulation if i.channel == channel]
    first, last = given[0], given[-1]
    if abs(last.peak_current_ma - first.peak_current_ma) >= LEAST_STEP_MA:
        return f"{first.peak_current_ma:.1f} → {last.peak_current_ma:.1f} mA"
    return f"{first.charge_uc:.0f} → {last.charge_uc:.0f} µC a step"


def _blame(fault: TuningRow) -> str:
    """What most likely happened, without what was done about it."""
    return fault.text.split("most likely ")[-1].split(";")[0].split(":")[0] + " had changed"


def _stride_before(time_s: float, rows: Sequence[StrideRow]) -> int:
    """The number of the last of these strides that had begun by then."""
    return max((row.number for row in rows if row.start_s <= time_s), default=rows[0].number)


def _toe_on_the_ground(summary: SessionSummary) -> Iterator[Finding]:
    """Strides whose toe came down in mid-swing, by their own measure; apart, those of which that cannot be told."""
    for foot, own in summary.feet.items():
        measured = [row for row in summary.strides if row.foot == foot and row.valid and row.toe_clearance_cm <= 0.0]
        of = count_of(own.toe_clearance_cm.n, "stride")
        low = [row for row in measured if row.toe_clearance_cm <= -TOE_SD_CM]
        near = [row for row in measured if row.toe_clearance_cm > -TOE_SD_CM]
        if low:
            what = f"in {len(low)} of {of} the toe came to the ground in mid-swing ({_numbers(low)})"
            text = f"{readable(foot).capitalize()}: {what}: it may have dragged or stumbled there"
            if own.toe_given:
                yield Finding("warning", f"{text}.")
            else:
                yield Finding("info", f"{text}; where the toe is was only estimated.")
        if near:
            what = f"in {len(near)} of {of} the toe passed within {TOE_SD_CM:g} cm of the ground ({_numbers(near)})"
            yield Finding(
                "info", f"{readable(foot).capitalize()}: {what}; whether it touched cannot be told so exactly."
            )


def _noted(summary: SessionSummary) -> Iterator[Finding]:
    """Feet whose cycle the machine did not see, and early bursts without a heel rise: when first, and why."""
    for source, what in ((NOTED, "time"), (ONSET, "false start")):
        told = [each for each in summary.notices if each.source == source and each.severity == "warning"]
        if told:
            often = f"{count_of(len(told), what)}, first"
            if source == NOTED:
                often = "A foot came into disorder" + (f" {often}" if len(told) > 1 else "")
            yield Finding("warning", f"{often} at {told[0].time_s:.1f} s: {told[0].text}.")


def _numbers(rows: list[StrideRow]) -> str:
    return ", ".join(str(row.number) for row in rows[:MOST_NAMED]) + (" …" if len(rows) > MOST_NAMED else "")


def _strides(summary: SessionSummary) -> Iterator[Finding]:
    missed_swings = sum(foot.unexplained for foot in summary.feet.values())
    total = len(summary.strides) + missed_swings
    for foot in summary.feet.values():
        if foot.unexplained:
            where = f"between {foot.unexplained_from_s:.1f} and {foot.unexplained_to_s:.1f} s"
            counts = f"{count_of(foot.swings, 'swing')}, {count_of(foot.strides, 'stride')}"
            few = foot.unexplained <= FEW_UNEXPLAINED * foot.swings
            text = f"{readable(foot.foot).capitalize()}: {counts}; {foot.unexplained} unexplained {where}."
            yield Finding("info" if few else "warning", text)
    if not summary.strides:
        yield Finding("warning", "No stride was found: the foot did not walk, or the sensor did not see it.")
        return
    for name, foot in summary.feet.items():
        explained = any(told.sensor == name and told.level in ("warning", "alert") for told in summary.sensor_findings)
        if foot.strides >= FEWEST_STRIDES and foot.valid < DOUBTFUL_SHARE * foot.strides:
            text = f"{readable(name).capitalize()}: only {foot.valid} of {foot.strides} strides could be measured."
            asked = f" Does this sensor sit on the {readable(name)}, and are units and rate in the sidecar right?"
            yield Finding("warning", text if explained else text + asked, code="few_valid", sensor=name)
    seen = any(foot.swings for foot in summary.feet.values())  # by the samples, whatever the phase machine found
    four, of = sum(row.four_phases for row in summary.strides), "swing" if seen else "stride"
    of_all = together([name for name, foot in summary.feet.items() if foot.strides or foot.swings])
    of_all = f"{capitalised(of_all)}: " if of_all else ""
    text = f"{of_all}{four} of {count_of(total, of)} passed all four phases"
    text += f" in order ({100 * four / total:.1f} %)" if four < total else ""
    missed = sum(foot.without_loading_response for foot in summary.feet.values())
    put_back = sum(foot.heel_lifts_put_back for foot in summary.feet.values())
    text += f"; {missed} without a loading response (T6)" if missed else ""
    text += f"; the heel was lifted and put back {count_of(put_back, 'time')} (T5)" if put_back else ""
    if seen:
        walking_s, lacking_s = (sum(getattr(foot, n) for foot in summary.feet.values()) for n in _WALKING)
        walking_s, lacking_s = round(walking_s, 1), round(lacking_s, 1)
        walking = "their walking" if len(summary.feet) == 2 else "walking"
        unexplained = f"no stride explains {lacking_s:.1f} s of {walking_s:.1f} s of walking"
        text += f"; {unexplained if missed_swings else f'all {walking_s:.1f} s of {walking} explained'}"
    yield Finding("good" if four >= 0.95 * total else "warning", f"{text}.")
    unused = Counter(row.reason or "no reason given" for row in summary.strides if not row.valid)
    if unused:
        reasons = ", ".join(f"{reason} ({count})" for reason, count in unused.most_common(4))
        left_out = count_of(sum(unused.values()), "stride")
        yield Finding("info", f"{of_all}{left_out} left out of the averages: {reasons}.")


def _speed(summary: SessionSummary) -> Iterator[Finding]:
    if not np.isfinite(summary.walking_speed_mps):
        return
    speed = f"Walking speed from the foot: {summary.walking_speed_mps:.2f} m/s"
    if not np.isfinite(summary.speed_over_belt):
        yield Finding("info", f"{speed} (the belt's speed is not known).")
        return
    off = 100 * (summary.speed_over_belt - 1)
    agrees = abs(off) <= 100 * SPEED_TOLERANCE
    yield Finding("good" if agrees else "warning", f"{speed}, belt {summary.belt_speed_mps:.2f} m/s ({off:+.1f} %).")


def _sensor(sensor: SensorQuality) -> Iterator[Finding]:
    flaws = [
        count_of(sensor.missing, "missing sample") if sensor.missing else "",
        count_of(sensor.doubled, "doubled time stamp") if sensor.doubled else "",
        count_of(sensor.backward, "backward time stamp") if sensor.backward else "",
        f"{count_of(sensor.not_a_number, 'sample')} without a value" if sensor.not_a_number else "",
    ]
    silence = f"longest silence {sensor.longest_silence_ms:.0f} ms" if sensor.longest_silence_ms > SILENCE_MS else ""
    told = ", ".join(flaw for flaw in flaws if flaw)
    # apart: a silence is of the computer or the radio, and so usually of all sensors at once
    for code, cause in (("stream", told), ("silence", silence)):
        if cause:
            text = f"Sensor {readable(sensor.sensor)}: {cause} ({sensor.samples} samples)."
            yield Finding("warning", text, code=code, sensor=sensor.sensor, cause=cause, remedy=_LINK_REMEDIES[code])


def verdict(every: Sequence[Finding], *, only_data: bool) -> tuple[Level, str]:
    """The worst level of these and its words, the same on every page and screen."""
    levels = list(_VERDICTS)
    level: Level = min((finding.level for finding in every), key=levels.index, default="info")
    return level, _VERDICT_OF_DATA if only_data and level in ("good", "info") else _VERDICTS[level]


def is_only_data(summary: SessionSummary) -> bool:
    """Nothing was, or could have been, stimulated."""
    return summary.kind == "analysis" and not summary.channels


def front_page(summary: SessionSummary, more: Sequence[Finding] = ()) -> dict[str, Any]:
    """The worst level with its words, what to do, the first sentences and the others.

    Sentences of alerts and warnings come first, then what tuning made of each channel, each in the order in which they
    were found.
    """
    every = (*findings(summary), *more)
    levels = list(_VERDICTS)
    calm = levels.index("good")
    ordered = sorted(every, key=lambda one: calm - 0.5 if one.leads else levels.index(one.level))
    level, words = verdict(every, only_data=is_only_data(summary))
    found = {"level": level, "verdict": words, "first": ordered[:FIRST], "others": ordered[FIRST:]}
    return {**found, "todo": _what_to_do(ordered)}


def _what_to_do(every: Sequence[Finding]) -> str:
    """What the alerts and warnings ask for, each remedy once with its sensors."""
    asked: dict[str, list[str]] = {}
    look = [each for each in every if each.level in ("alert", "warning")]
    for each in look:
        asked.setdefault(each.remedy, []).extend(filter(None, each.sensor.split(", ")))
    told = [
        remedy + (f" ({', '.join(map(readable, dict.fromkeys(sensors)))})" if sensors else "")
        for remedy, sensors in asked.items()
        if remedy
    ]
    if "" in asked:
        told.append("look at each point marked ✗ or ! before you use the numbers")
    return f"{capitalised('; '.join(told))}." if look else "Nothing; the numbers can be used."
