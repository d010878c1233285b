"""Phases, strides and events of every walker there is, by one default setting, against a judge of its own.

Swings are found by ``fes/analysis/swings.py``, from the raw signals; on footswitch_treadmill by the labels, and a swing
that these lack and the raw signals show may be there too: a dragged foot keeps a switch closed. What is judged is what
users get: calibration from the recording itself, phases and strides as they come live, ``fes analyse`` ("off-line").
"fast": the cycle lasts less than 0.9 s. "elsewhere": phases the same when calibrated on 20 s elsewhere (three places).
A refused foot has no stride in order. ``--raw`` keeps everything, so that two versions can be compared.
"""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.table import Table

from benchmarks.lib.command_line import no_recordings, parser_of, publish
from benchmarks.lib.real_sets import LAST_S, Walk, data_folder
from benchmarks.lib.swing_judge import (
    IN_ORDER,
    Labelled,
    answered,
    fired_by_stride,
    in_order,
    later_ms,
    pairs,
    score,
    swing_phases,
)
from benchmarks.lib.walkers import (
    DRIFTING,
    LYING,
    SETS,
    SHORT_FLAT,
    Foot,
    calibrate,
    causal,
    feet_of,
    of_all,
    swings_of,
)
from fes.analysis.pipeline import analyse
from fes.analysis.swings import Swings
from fes.estimation.events.offline import foot_strike_angles
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from fes.recording import Recording
from fes.recording.tracks import newer_samples
from fes.signals import StrideResult
from statemachine.phases import PhaseChange, Transition

FAST_S = 0.9
CONTACTS = 50  # of a side, that Vicon's mean is over
ELSEWHERE_S, ELSEWHERE = 20.0, (0.25, 0.5, 0.75)
NEXT_S = 0.5  # a stride that begins this soon after the last one's end goes on where that ended
TIMES = (Transition.T1, Transition.T2, Transition.T3, Transition.T4)
HEALTH = ("healthy", "hemiparetic")  # of the footswitches' people
COSTS = ("flat_ms", "loading_left_ms")  # of a stride, by a channel from T1 to T4


@dataclass
class Found:
    """What was made of it; lists are per stride, ``later_ms`` by transition."""

    data_set: str
    part: str
    person: str
    run: str
    sensor: str
    refused: str = ""
    strides: int = 0
    in_order: int = 0
    swings: int = 0
    false_swings: int = 0
    answered: int = 0
    explained: int = 0
    speed_causal: float = float("nan")
    speed_offline: float = float("nan")
    fast: int = 0  # swings of cycles that last less than FAST_S, …
    fast_answered: int = 0  # … and those of them with a length
    length_cm: dict[str, list[float]] = field(default_factory=dict)  # off-line and causal, usual and fast
    events: int = 0
    strike_deg: list[float] = field(default_factory=list)
    vicon_deg: float = float("nan")
    elsewhere: int = 0
    elsewhere_same: int = 0
    later_ms: dict[str, list[float]] = field(default_factory=dict)
    flat_ms: list[float] = field(default_factory=list)
    loading_left_ms: list[float] = field(default_factory=list)
    by_labels_alone: int = 0

    @property
    def share(self) -> float:
        """Strides in order, %."""
        return 100.0 * self.in_order / self.strides if self.strides else float("nan")


def speed_mps(strides: list[StrideResult], since_ns: float) -> float:
    """Length over time of whole cycles: from the end of the stride before to the stride's own."""
    length = time = 0.0
    for before, stride in pairwise(strides):
        gap_ns = stride.t_start_ns - before.t_end_ns
        if stride.valid and before.t_end_ns >= since_ns and gap_ns <= 1e9 * NEXT_S:
            length, time = length + stride.stride_length_m, time + 1e-9 * (stride.t_end_ns - before.t_end_ns)
    return length / time if time else float("nan")


def cycle_s(swings: Swings, stride: StrideResult) -> float:
    """The time from this stride's mid-swing to the one before or after, the shorter of both."""
    inside = np.flatnonzero((swings.sure >= stride.t_start_ns) & (swings.sure <= stride.t_end_ns))
    if not len(inside):
        return 1e-9 * (stride.t_end_ns - stride.t_start_ns)
    near = np.diff(swings.sure[max(inside[0] - 1, 0) : inside[0] + 2])
    return 1e-9 * float(near.min()) if len(near) else float("inf")


def length_errors(walk: Walk, swings: Swings, strides: Iterable[StrideResult], how: str) -> dict[str, list[float]]:
    """Errors of length (cm) of the strides that the reference can judge, those of fast cycles apart."""
    errors: dict[str, list[float]] = {how: [], f"{how}, fast": []}
    for stride in strides:
        true_m = walk.true_length_m(stride) if stride.valid and walk.comparable(stride) else float("nan")
        if np.isfinite(true_m):
            fast = ", fast" if cycle_s(swings, stride) < FAST_S else ""
            errors[how + fast].append(100.0 * (stride.stride_length_m - true_m))
    return errors


def judge(foot: Foot) -> Found:
    found = Found(foot.data_set, foot.part, foot.person, foot.run, foot.track.sensor)
    track, swings = foot.track, swings_of(foot)
    found.swings, found.strides = len(swings.whole()), len(pairs(swings))
    if foot.labels is not None:
        judged = [foot.labels.judged(*pair) for pair in pairs(swings)]
        found.strides = sum(judged)
    try:
        calibration = calibrate(track)
    except CalibrationError as error:
        found.refused = str(error)
        found.elsewhere = len(ELSEWHERE) * len(pairs(swings)) if track.duration_s > 2.0 * ELSEWHERE_S else 0
        return found
    changes, strides = causal(track, calibration)
    counts = score(swings, changes, strides)
    found.false_swings, found.answered, found.explained = counts.false_swings, counts.answered, counts.explained
    found.in_order = counts.in_order
    gaps_s, at = np.append(1e-9 * np.diff(swings.sure), np.inf), np.searchsorted(swings.sure, swings.whole())
    fast = swings.whole()[np.minimum(gaps_s[at], gaps_s[at - 1]) < FAST_S].tolist()
    found.fast, found.fast_answered = len(fast), sum(answered(strides, at_ns) for at_ns in fast)
    if foot.labels is not None:
        against_labels(found, foot.labels, swings, changes)
    recording = Recording(foot.run, None, {track.sensor: track}, belt_speed_mps=None)
    result = analyse(recording, {track.sensor: calibration})
    offline = [stride for stride in result.strides if stride.foot == track.sensor]
    if np.isfinite(foot.belt_mps):
        since_ns = track.t_ns[-1] - LAST_S * 1e9
        found.speed_causal = speed_mps(strides, since_ns) / foot.belt_mps
        found.speed_offline = speed_mps(offline, since_ns) / foot.belt_mps
    if foot.walk is not None:
        found.length_cm = length_errors(foot.walk, swings, offline, "off-line")
        found.length_cm |= length_errors(foot.walk, swings, strides, "causal")
    if isinstance(calibration, FootCalibration):
        events = result.events[track.sensor]
        found.events = len(events.ic_ns)
        if np.isfinite(foot.strike_deg):
            t_ns, _, gyr = newer_samples(track)
            angle = foot_strike_angles(t_ns, gyr, events, calibration)
            found.vicon_deg = foot.strike_deg
            found.strike_deg = np.degrees(angle[np.isfinite(angle)][:CONTACTS]).tolist()
    if foot.ic_s is not None:
        against_markers(found, foot, changes)
    if track.duration_s > 2.0 * ELSEWHERE_S:
        calibrated_elsewhere(found, foot, swings, changes)
    return found


def against_labels(found: Found, labels: Labelled, swings: Swings, changes: list[PhaseChange]) -> None:
    """Order, delays and stimulated flat foot, of the strides that the labels can judge."""
    found.in_order = 0
    later: dict[str, list[float]] = defaultdict(list)
    for (begin, end), fired, ordered in zip(
        pairs(swings), fired_by_stride(swings, changes), in_order(swings, changes), strict=True
    ):
        if not labels.judged(begin, end):
            continue
        found.in_order += ordered
        found.by_labels_alone += fired == IN_ORDER
        flat_s, loading_s = labels.flat_and_loading_s(changes, begin, end)
        found.flat_ms.append(1e3 * flat_s)
        found.loading_left_ms.append(1e3 * loading_s)
        if fired == IN_ORDER:
            true = labels.times(begin, end)
            for change in changes:
                if begin <= change.t_ns < end and change.transition in true:
                    later[change.transition.name].append(1e-6 * (change.t_ns - true[change.transition]))
    found.later_ms = dict(later)
    found.false_swings = sum(
        not ((swings.possible >= a) & (swings.possible <= b)).any() and labels.judged(a, b)
        for a, b in swing_phases(changes)
    )


def against_markers(found: Found, foot: Foot, changes: list[PhaseChange]) -> None:
    """How much later than the markers' T1 to T4 each is; heel rise by the simulated truth's 5 mm, flat by its 2°."""
    strides = foot.marked_strides()
    rise_s, flat_s = ([s[key] for s in strides if key in s] for key in ("t_pre_swing_s", "t_stance_s"))
    for name, known_s in (("T1", rise_s), ("T2", foot.fo_s), ("T3", foot.ic_s), ("T4", flat_s)):
        times_s = [1e-9 * (c.t_ns - foot.track.t_ns[0]) for c in changes if c.transition.name == name]
        found.later_ms[name] = later_ms(times_s, known_s, 250.0)


def calibrated_elsewhere(found: Found, foot: Foot, swings: Swings, changes: list[PhaseChange]) -> None:
    """How many strides have the same phases when 20 s somewhere else in the recording are what is known."""
    usual, track = fired_by_stride(swings, changes), foot.track
    for place in ELSEWHERE:
        begin_ns = track.t_ns[0] + round(place * 1e9 * (track.duration_s - ELSEWHERE_S))
        first, last = np.searchsorted(track.t_ns, (begin_ns, begin_ns + round(1e9 * ELSEWHERE_S)))
        found.elsewhere += len(usual)
        try:
            other, _ = causal(track, calibrate(track.part(slice(first, last))))
        except (CalibrationError, ValueError):
            continue
        fired = fired_by_stride(swings, other)
        found.elsewhere_same += sum(a == b for a, b in zip(usual, fired, strict=True))


# --- tables -----------------------------------------------------------------------------------------------------------


def percent(part: float, whole: float) -> str:
    return f"{100.0 * part / whole:.2f}" if whole else "–"


def rms(values: Iterable[float]) -> str:
    squares = np.array(list(values)) ** 2
    return f"{np.sqrt(squares.mean()):.2f} ({len(squares)})" if len(squares) else "–"


def groups_of(found: list[Found]) -> dict[str, list[Found]]:
    """By set and part; footswitches by health, without what the set itself disputes, which is shown apart."""
    groups: dict[str, list[Found]] = defaultdict(list)
    for one in found:
        name = f"{one.data_set}, {one.part}"
        if one.data_set == "footswitch_treadmill":
            name = f"footswitch, {'healthy' if one.person.startswith('H') else 'hemiparetic'}"
            if one.person in LYING or one.run in DRIFTING:
                name = "footswitch, sensor lies or labels drift"
        groups[name].append(one)
    return groups


def phases_table(groups: dict[str, list[Found]]) -> Table:
    table = Table(
        "set", "feet", "refused", "strides", "in order %", "worst foot", "false /100", "answered %", "or why %",
        "elsewhere same %", "events / swing, worst",
        title="phases and strides, causal; events off-line",
    )  # fmt: skip
    for name, feet in groups.items():
        strides, swings = sum(f.strides for f in feet), sum(f.swings for f in feet)
        worst = min((f for f in feet if f.strides), key=lambda f: f.share)
        with_events = [f for f in feet if f.events and f.swings]
        ratios = [f.events / f.swings for f in with_events]
        most = f", {max(ratios):.2f} {with_events[int(np.argmax(ratios))].run}" if ratios else ""
        mean = f"{sum(f.events for f in with_events) / sum(f.swings for f in with_events):.3f}" if ratios else "–"
        table.add_row(
            name, str(len(feet)), str(sum(bool(f.refused) for f in feet)), str(strides),
            percent(sum(f.in_order for f in feet), strides), f"{worst.share:.1f} {worst.run} {worst.sensor}",
            percent(sum(f.false_swings for f in feet), swings), percent(sum(f.answered for f in feet), swings),
            percent(sum(f.explained for f in feet), swings),
            percent(sum(f.elsewhere_same for f in feet), sum(f.elsewhere for f in feet)), mean + most,
        )  # fmt: skip
    return table


def lengths_table(groups: dict[str, list[Found]]) -> Table:
    table = Table(
        "set", "speed / belt off-line", "worst", "causal", "worst", "length RMSE cm, walk off-line", "fast",
        "walk causal", "fast", "answered fast %",
        title="lengths: number of strides in brackets",
    )  # fmt: skip
    for name, feet in groups.items():
        cells = []
        for kind in ("speed_offline", "speed_causal"):
            ratios = np.array([getattr(f, kind) for f in feet if np.isfinite(getattr(f, kind))])
            far = ratios[np.argmax(np.abs(ratios - 1.0))] if len(ratios) else 0.0
            cells += [f"{ratios.mean():.4f} ± {ratios.std(ddof=1):.4f}", f"{far:.3f}"] if len(ratios) > 1 else ["–"] * 2
        for kind in ("off-line", "off-line, fast", "causal", "causal, fast"):
            cells.append(rms(error for f in feet for error in f.length_cm.get(kind, ())))
        told = percent(sum(f.fast_answered for f in feet), sum(f.fast for f in feet))
        cells.append(told if feet[0].data_set in ("pyshoe_vicon", "ruler_walks") else "–")
        if any(cell != "–" for cell in cells):
            table.add_row(name, *cells)
    return table


def delays_table(found: list[Found], groups: dict[str, list[Found]]) -> Table:
    table = Table(
        "walker", "in order %", "T1 ms", "T2 ms", "T3 ms", "T4 ms", "flat foot stimulated, median ms", "95 % ms",
        "loading left without stimulation, median ms", "95 % ms",
        title="footswitches (gaitmap: markers): later than the label, median ± SD",
    )  # fmt: skip
    people: dict[str, list[Found]] = defaultdict(list)
    for one in found:
        if one.data_set in ("footswitch_treadmill", "gaitmap_walk"):
            people[one.person].append(one)
    for person, trials in people.items():
        table.add_row(*delay_cells(person, [t for t in trials if t.run not in DRIFTING]))
    for name in HEALTH:
        if own := groups.get(f"footswitch, {name}"):
            table.add_row(*delay_cells(f"{name}, every stride", own))
    return table


def delay_cells(name: str, trials: list[Found]) -> list[str]:
    """A row of the delays: some trials together, without what the set itself disputes."""
    cells = [name, percent(sum(t.in_order for t in trials), sum(t.strides for t in trials))]
    for each in TIMES:
        judged = [t for t in trials if t.person not in SHORT_FLAT or each is not Transition.T4]
        values = [ms for t in judged for ms in t.later_ms.get(each.name, [])]
        cells.append(f"{np.median(values):+.0f} ± {np.std(values):.0f}" if len(values) > 4 else "–")
    return [*cells, *(value for kind in COSTS for value in middle_and_most(trials, kind))]


def middle_and_most(trials: Iterable[Found], kind: str) -> tuple[str, str]:
    """Median and 95 % of a stride's milliseconds; what is left of loading hangs on the label of T4."""
    judged = [t for t in trials if kind == "flat_ms" or t.person not in SHORT_FLAT]
    values = [ms for t in judged for ms in getattr(t, kind)]
    return (f"{np.median(values):.0f}", f"{np.percentile(values, 95):.0f}") if values else ("–", "–")


def strike_lines(found: list[Found]) -> list[str]:
    """SD of the foot-strike angle against Vicon, known, unseen and all together; the furthest run."""
    runs: dict[tuple[str, str], list[Found]] = defaultdict(list)
    for one in found:
        if one.strike_deg:
            runs[one.part, one.run].append(one)
    off = {key: np.mean([a for f in feet for a in f.strike_deg]) - feet[0].vicon_deg for key, feet in runs.items()}
    lines = []
    for part in ("known", "unseen", ""):
        own = {run: float(d) for (where, run), d in off.items() if part in where}
        if len(own) > 2:
            middle = float(np.mean(list(own.values())))
            far = max(own, key=lambda run: abs(own[run] - middle))
            lines.append(
                f"foot-strike angle, {part or 'all'} ({len(own)} runs): SD {np.std(list(own.values()), ddof=1):.2f}°, "
                f"offset {middle:+.1f}°, furthest {far} {own[far] - middle:+.1f}°"
            )
    return lines


def low_lines(found: list[Found], groups: dict[str, list[Found]]) -> list[str]:
    """Feet below 90 % of the floor walks, what labels alone say, and who was refused."""
    low = [f for f in found if f.data_set == "stroke_walks" and f.strides and f.share < 90.0]
    lines = []
    if any(f.data_set == "stroke_walks" for f in found):
        each = ", ".join(f"{f.run} {f.sensor.split('_')[0]} {f.share:.0f}" for f in sorted(low, key=lambda f: f.share))
        lines.append(f"stroke_walks, feet below 90 %: {len(low)}: {each}")
    for part in HEALTH:
        feet = groups.get(f"footswitch, {part}", [])
        if strides := sum(f.strides for f in feet):
            alone = 100.0 * sum(f.by_labels_alone for f in feet) / strides
            lines.append(f"footswitch, {part}, by the labels alone: {alone:.2f} % of {strides} strides in order")
    return lines + [f"refused: {f.run} {f.sensor}: {f.refused}" for f in found if f.refused]


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--only", nargs="+", choices=SETS, default=SETS, help="these sets alone")
    parser.add_argument("--persons", nargs="+", help="these walkers alone, as the tables name them")
    parser.add_argument("--part", choices=("known", "unseen"), help="these walkers alone")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="processes")
    parser.add_argument("--raw", type=Path, help="everything about every foot, as JSON")
    options = parser.parse_args(arguments)
    feet = (f for f in feet_of(options.data, options.only) if not options.persons or f.person in options.persons)
    feet = (f for f in feet if not options.part or f.part.startswith(options.part))
    found = of_all(judge, feet, options.jobs)
    if not found:
        return no_recordings(options.data)
    groups = groups_of(found)
    tables = [phases_table(groups), lengths_table(groups), delays_table(found, groups)]
    publish(tables, options, [*strike_lines(found), *low_lines(found, groups)])
    if options.raw:
        options.raw.write_text(json.dumps([asdict(f) | {"share": f.share} for f in found]), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
