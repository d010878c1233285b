"""One row per stride: lengths, phases passed and the stimulation that went with it."""

import math
import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from fes.estimation.strides.boundaries import UNSEEN_NS, stride_time_ns
from fes.report.stimulation import Burst, ChannelInfo, PhaseTimeline
from fes.report.text import count_of, without_numbers
from fes.signals import NS_PER_S, OperatorAction, StimCommand, StrideResult
from fes.stimulation.plan import BY_HAND_NS
from fes.walk_record import MARK, WalkRecord
from statemachine.phases import Transition

STANDING_S = 3.0  # a stance longer than this is standing, not walking, and stays out of the averages
NAN = float("nan")
DURATIONS = ("pre_swing_s", "swing_s", "loading_response_s", "stance_s")
ENDS_A_STRIDE = (int(Transition.T4), int(Transition.T6))


@dataclass(frozen=True)
class StrideStimulation:
    """What one channel did in one stride; onset is counted from the entry into pre-swing (negative: before it)."""

    channel: int
    name: str
    bursts: int
    onset_after_pre_swing_ms: float
    duration_s: float
    peak_current_ma: float
    charge_uc: float
    charge_counted_by_device: bool


@dataclass(frozen=True)
class StrideRow:
    """One stride as people read it; NaN where a number is not known.

    ``live`` of an analysis: how long the phases are by the live machine (``swing_live_s`` …). ``mark``: the last one
    that a person set before the stride began.
    """

    foot: str
    number: int
    start_s: float
    duration_s: float
    stride_length_m: float
    speed_mps: float
    clearance_cm: float
    toe_clearance_cm: float
    heel_clearance_cm: float
    height_gained_cm: float
    turn_deg: float
    pre_swing_s: float
    swing_s: float
    loading_response_s: float
    stance_s: float
    four_phases: bool
    path: str
    heel_lifts_put_back: int
    valid: bool
    reason: str
    stimulation: tuple[StrideStimulation, ...] = ()
    refused: tuple[str, ...] = ()
    live: Mapping[str, float] = field(default_factory=dict)
    mark: str = ""

    @property
    def stance_is_standing(self) -> bool:
        """Whether the stance after this stride is too long to be walking."""
        return self.stance_s > STANDING_S


def stride_rows(
    strides: Sequence[StrideResult],
    timelines: Mapping[str, PhaseTimeline],
    channels: Sequence[ChannelInfo],
    bursts: Mapping[int, Sequence[Burst]],
    refused: Sequence[StimCommand],
    origin_ns: int,
) -> tuple[StrideRow, ...]:
    """Build the rows, in order of time; ``refused`` are the commands that the gate turned off."""
    foot_of = {info.number: info.phase_sensor for info in channels}
    in_time = sorted(refused, key=lambda command: command.t_ns)
    rows = []
    for foot in dict.fromkeys(stride.foot for stride in strides):
        own = sorted((stride for stride in strides if stride.foot == foot), key=lambda stride: stride.t_start_ns)
        near = [(info, bursts.get(info.number, ())) for info in channels if info.phase_sensor == foot]
        starts = [np.array([burst.t_start_ns for burst in every], dtype=np.int64) for _, every in near]
        own_refused = [command for command in in_time if foot_of.get(command.channel) == foot]
        refused_ns = np.array([command.t_ns for command in own_refused], dtype=np.int64)
        before_ns = UNSEEN_NS
        for stride in own:
            low, high = np.searchsorted(refused_ns, [stride.t_start_ns, stride.t_end_ns])
            reasons = {without_numbers(command.refused): command.refused for command in own_refused[low:high][::-1]}
            spans = [np.searchsorted(start_ns, [stride.t_start_ns, stride.t_end_ns]) for start_ns in starts]
            inside = [(info, every[span[0] : span[1]]) for (info, every), span in zip(near, spans, strict=True)]
            stimulation = tuple(_stimulation_in(stride, info, own_bursts) for info, own_bursts in inside if own_bursts)
            time_ns = stride_time_ns(stride.t_start_ns, stride.t_end_ns, before_ns)
            before_ns = stride.t_end_ns
            row = _row(stride, timelines.get(foot), time_ns, origin_ns)
            rows.append(replace(row, stimulation=stimulation, refused=tuple(reasons.values())))
    return tuple(sorted(rows, key=lambda row: (row.start_s, row.foot)))


def with_live(
    rows: Sequence[StrideRow], live: Sequence[StrideRow], without: Collection[tuple[str, int]]
) -> tuple[StrideRow, ...]:
    """The rows of off-line instants, those of the live machine beside them, by foot and number.

    Strides ``without`` off-line instants have no durations by these.
    """
    unknown: dict[str, Any] = dict.fromkeys(DURATIONS, NAN)
    lasted = {
        (row.foot, row.number): {f"{name.removesuffix('_s')}_live_s": getattr(row, name) for name in DURATIONS}
        for row in live
    }
    keyed = [(row, (row.foot, row.number)) for row in rows]
    return tuple(
        replace(row, live=lasted[key], **(unknown if key in without else {})) if key in lasted else row
        for row, key in keyed
    )


def _stimulation_in(stride: StrideResult, info: ChannelInfo, own: Sequence[Burst]) -> StrideStimulation:
    entered = stride.t_pre_swing_ns
    return StrideStimulation(
        channel=info.number,
        name=info.name,
        bursts=len(own),
        onset_after_pre_swing_ms=NAN if entered is None else (own[0].t_start_ns - entered) / 1e6,
        duration_s=sum(burst.duration_s for burst in own),
        peak_current_ma=max(burst.peak_current_ma for burst in own),
        charge_uc=sum(burst.charge_uc for burst in own),
        charge_counted_by_device=own[0].counted,
    )


def _row(stride: StrideResult, timeline: PhaseTimeline | None, time_ns: int, origin_ns: int) -> StrideRow:
    pre_swing, swing = stride.t_pre_swing_ns, stride.t_swing_ns
    loading, stance = stride.t_loading_response_ns, stride.t_stance_ns
    passed = _transitions(stride, timeline)
    entries = [t for t in (pre_swing, swing, loading, stance) if t is not None]
    heights = ("clearance", "toe_clearance", "heel_clearance", "height_gained")
    return StrideRow(
        **{n: getattr(stride, n) for n in ("foot", "number", "stride_length_m", "speed_mps", "valid", "reason")},
        **{f"{name}_cm": getattr(stride, f"{name}_m") * 100 for name in heights},
        start_s=(stride.t_start_ns - origin_ns) / NS_PER_S,
        duration_s=time_ns / NS_PER_S,
        turn_deg=math.degrees(stride.turn_rad),
        pre_swing_s=_seconds(pre_swing, swing),
        swing_s=_seconds(swing, stance if loading is None else loading),
        loading_response_s=_seconds(loading, stance),
        stance_s=_seconds(stance, _next_change_ns(stance, timeline)),
        four_phases=len(entries) == 4 and all(a < b for a, b in pairwise(entries)),
        path=" ".join(passed),
        heel_lifts_put_back=passed.count("T5"),
    )


def _seconds(start_ns: int | None, end_ns: int | None) -> float:
    return NAN if start_ns is None or end_ns is None else (end_ns - start_ns) / NS_PER_S


def _next_change_ns(t_ns: int | None, timeline: PhaseTimeline | None) -> int | None:
    if t_ns is None or timeline is None:
        return None
    later = timeline.change_ns[np.searchsorted(timeline.change_ns, t_ns, side="right") :]
    return int(later[0]) if later.size else None


def _transitions(stride: StrideResult, timeline: PhaseTimeline | None) -> list[str]:
    """Names of the transitions since the stance before this stride, up to the one that ended it."""
    if timeline is None or timeline.change_ns.size == 0:
        times = (stride.t_pre_swing_ns, stride.t_swing_ns, stride.t_loading_response_ns, stride.t_stance_ns)
        last = "T6" if stride.t_loading_response_ns is None else "T4"
        return [name for name, t in zip(("T1", "T2", "T3", last), times, strict=True) if t is not None]
    until = stride.t_end_ns if stride.t_stance_ns is None else stride.t_stance_ns
    low = int(np.searchsorted(timeline.change_ns, stride.t_start_ns, side="right"))
    high = int(np.searchsorted(timeline.change_ns, until, side="right"))
    numbers = timeline.transition[low:high].tolist()
    begin = max((at + 1 for at, number in enumerate(numbers[:-1]) if number in ENDS_A_STRIDE), default=0)
    return [Transition(number).name for number in numbers[begin:]]


STOP: Final = "emergency stop"
WORDS: Final = {
    OperatorAction.ARM: "armed",
    OperatorAction.DISARM: "disarmed",
    OperatorAction.EMERGENCY_STOP: STOP,
    OperatorAction.TEST_BURST: "test burst",
    OperatorAction.TRIGGER: "manual burst",
    OperatorAction.SET_INTENSITY: "intensity",
    OperatorAction.FREEZE_TUNING: "tuning frozen",
    OperatorAction.RESUME_TUNING: "tuning told to go on",
    OperatorAction.ACCEPT_SUGGESTION: "suggestion accepted",
    OperatorAction.ROLL_BACK: "settings rolled back",
}
LOWERED: Final = ", less than the session's"
HARDLY: Final = 1e-6
STEPS_NS: Final = 2 * NS_PER_S  # key presses that follow each other sooner are one act
NOBODYS: Final = ("(button lost)", "(the keyboard is gone")  # stops that the session makes by itself
CAUSE: Final = re.compile(r"state .* \((.*)\)")


@dataclass(frozen=True)
class HandRow:
    """One thing that a person did; ``channel`` of a burst, else −1."""

    time_s: float
    action: str
    channel: int
    text: str


@dataclass(frozen=True)
class MarkRow:
    """A mark that a person set; ``strides``: how many valid ones began from then until the next mark."""

    time_s: float
    text: str
    strides: int = 0


def with_marks(
    record: WalkRecord, rows: Sequence[StrideRow], origin_ns: int
) -> tuple[tuple[MarkRow, ...], tuple[StrideRow, ...]]:
    """The marks by time, and the strides, each with the last mark before it began."""
    marks = sorted((note.t_ns, note.text) for note in record.notes if note.source == MARK)
    times_s = [(t_ns - origin_ns) / NS_PER_S for t_ns, _ in marks]
    of_row = [bisect_right(times_s, row.start_s) - 1 for row in rows]
    counted = Counter(at for at, row in zip(of_row, rows, strict=True) if row.valid)
    told = tuple(MarkRow(times_s[at], text, counted[at]) for at, (_, text) in enumerate(marks))
    marked = (replace(row, mark=marks[at][1]) if at >= 0 else row for at, row in zip(of_row, rows, strict=True))
    return told, tuple(marked)


def hand_rows(record: WalkRecord, origin_ns: int, usual_intensity: float = 1.0) -> tuple[HandRow, ...]:
    """By time; a stop pressed again before the next arming belongs to the first, and of an intensity that is set in
    steps the last one counts; below ``usual_intensity`` (0 … 1), the session's, it says so."""
    said: dict[int, list[str]] = {}
    for note in record.notes:
        if note.source == "session":
            said.setdefault(note.t_ns, []).append(note.text)
    rows: list[HandRow] = []
    stopped = False
    for act in sorted(record.acts, key=lambda act: act.t_ns):
        stops = act.action is OperatorAction.EMERGENCY_STOP
        of_itself = act.action is OperatorAction.FREEZE_TUNING and act.why
        begins = act.action is OperatorAction.SET_INTENSITY and not act.value > 0.0  # as every arming does
        if act.action not in WORDS or (stops and stopped) or of_itself or begins:
            continue
        stopped = stops or (stopped and act.action is not OperatorAction.ARM)
        channel = int(act.value) if act.action in BY_HAND_NS else -1
        text = WORDS[act.action] if channel >= 0 else _as_said(act.action, said.get(act.t_ns, []))
        if act.action is OperatorAction.SET_INTENSITY:
            text = f"{text} {min(act.value, 1.0):.0%}" + (LOWERED if act.value < usual_intensity - HARDLY else "")
            if rows and rows[-1].action == act.action and act.t_ns - origin_ns < STEPS_NS + NS_PER_S * rows[-1].time_s:
                rows.pop()
        rows.append(HandRow((act.t_ns - origin_ns) / NS_PER_S, str(act.action), channel, text))
    return tuple(rows)


def _as_said(action: OperatorAction, said: Sequence[str]) -> str:
    """As the session put it at that moment, where it did: who stopped, disarmed or paused, why it could not arm."""
    if action is OperatorAction.EMERGENCY_STOP:
        return next((text for text in said if text.startswith(STOP)), STOP)
    refused = next((text for text in said if text.startswith("cannot")), "")
    return refused or next((found[1] for text in said if (found := CAUSE.match(text))), WORDS[action])


def is_stop_note(source: str, text: str) -> bool:
    """Whether a note is of a stop that a person made, or of the gate's latch that came of any stop."""
    if source == "gate":
        return text.endswith(f": {STOP}")
    return source == "session" and text.startswith(STOP) and not any(origin in text for origin in NOBODYS)


def summed_up(rows: Sequence[HandRow]) -> str:
    """Bursts, stops, and an intensity that was left below the session's; "" for none of these."""
    left = [row for row in rows if row.action == OperatorAction.SET_INTENSITY][-1:]
    lowered = [f"{row.text} from {row.time_s:.1f} s on" for row in left if row.text.endswith(LOWERED)]
    bursts = Counter(row.text for row in rows if row.channel >= 0)
    stops = [f"{row.text} at {row.time_s:.1f} s" for row in rows if row.action == OperatorAction.EMERGENCY_STOP]
    return ", ".join([*(count_of(count, what) for what, count in bursts.items()), *stops, *lowered])
