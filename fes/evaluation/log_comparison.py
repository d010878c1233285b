"""Two session logs side by side: settings, strides matched by time, stimulation, bytes. Pure; B − A throughout."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Final

import numpy as np

from fes.evaluation.timing.marks import Mark, marks_of_commands, pair_times
from fes.session_log import Note, SessionRecord
from fes.signals import Event, IntArray, StimCommand, StrideResult, WireFrame
from fes.walk_record import finite_or_none
from statemachine.phases import PhaseChange

# --- A session log replayed: what came out this time, and where it first differs from what is recorded ------


SAME: Final = 1e-6  # of a stride's numbers: another processor's last bit is no difference, another sample is
ENDED_WHOLE: Final = ("complete", "different", "interrupted")  # every event logged was dealt with to its end


class ReplayOutput:
    """A loop's log that only remembers what came out."""

    def __init__(self) -> None:
        self.commands: list[StimCommand] = []
        self.frames: list[WireFrame] = []
        self.phases: list[PhaseChange] = []
        self.strides: list[StrideResult] = []
        self.latencies_ns: list[int] = []

    def event(self, event: Event) -> None:
        """Known already."""

    def command(self, command: StimCommand, frame: WireFrame) -> None:
        """Keep both."""
        self.commands.append(command)
        self.frames.append(frame)

    def phase(self, change: PhaseChange) -> None:
        """Keep it."""
        self.phases.append(change)

    def stride(self, result: StrideResult) -> None:
        """Keep it."""
        self.strides.append(result)

    def note(self, note: Note) -> None:
        """Known already."""

    def latency(self, t_ns: int, latency_ns: int) -> None:
        """Keep it."""
        self.latencies_ns.append(latency_ns)


def first_difference(record: SessionRecord, frames: Sequence[WireFrame] | None, now: ReplayOutput, end_ns: int) -> str:
    """Where a replay first differs from the log, for people; "" where it is the same as far as the log goes.

    ``frames`` are the log's commands' frames, None where bytes cannot be compared; ``now`` is what came out this time,
    ``end_ns`` the time of the replay's last event.
    """
    whole = record.complete and record.summary.get("ended") in ENDED_WHOLE
    fields_compared = [field.name for field in fields(StrideResult) if field.compare]

    def frame(k: int, was: WireFrame, now: WireFrame) -> str | None:
        if not whole and all(not command.on and command.t_ns == end_ns for command in record.commands[k:]):
            return ""  # the session stopped here and switched off
        return f"command {k + 1}: recorded {was.data.hex()} at {was.t_ns} ns, now {now.data.hex()} at {now.t_ns} ns"

    def command(k: int, was: StimCommand, is_now: StimCommand) -> str | None:
        last_ns = now.commands[-1].t_ns
        if not whole and all(not command.on and command.t_ns >= last_ns for command in record.commands[k:]):
            return ""  # the session stopped here and switched off
        return f"command {k + 1}: recorded {was}, now {is_now}"

    def phase(k: int, *changes: PhaseChange) -> str | None:
        was, is_now = (f"{each.foot} into {each.destination.name} at {each.t_ns} ns" for each in changes)
        return f"phase change {k + 1}: recorded {was}, now {is_now}"

    def stride(k: int, was: StrideResult, is_now: StrideResult) -> str | None:
        for name in fields_compared:
            one, other = getattr(was, name), getattr(is_now, name)
            if not _same(one, other):
                return f"stride {was.number} of the {was.foot}: {name} is recorded as {one}, now {other}"
        return None

    def first(what: str, recorded: Sequence[Any], now: Sequence[Any], differ: Callable[..., str | None]) -> str:
        for k, (was, is_now) in enumerate(zip(recorded, now, strict=False)):
            if was != is_now and (text := differ(k, was, is_now)) is not None:
                return text
        if whole and len(recorded) != len(now):
            return f"{len(recorded)} {what} are recorded, now there are {len(now)}"
        return ""

    return (
        (first("commands", frames, now.frames, frame) if frames is not None else "")
        or first("commands", record.commands, now.commands, command)
        or first("phase changes", record.phases, now.phases, phase)
        or first("strides", record.strides, now.strides, stride)
    )


def _same(one: object, other: object) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=SAME, abs_tol=SAME) or (math.isnan(one) and math.isnan(other))
    return one == other


ALWAYS_DIFFERENT: Final = ("created", "created_t_ns")  # of two runs; no difference between what they did
SAME_STRIDE_NS: Final = 400_000_000  # two strides of a foot cannot end as close as this
TIMES: Final = {"T1": "t_pre_swing_ns", "T2": "t_swing_ns", "T3": "t_loading_response_ns", "stance": "t_stance_ns"}
_LENGTHS: Final = {"length_cm": "stride_length_m", "clearance_cm": "clearance_m"}
QUANTITIES: Final = ("length_cm", "clearance_cm", "T1_ms", "T2_ms", "T3_ms", "stance_ms", "on_ms", "off_ms")
ENOUGH: Final = 0.6  # of the shorter walk's strides must end together; chance brings a few together
_LONGEST_FOR_SHIFT: Final = 1000
_NAN: Final = float("nan")
Switching = dict[tuple[str, str], int]  # when which channel was switched on or off, ns


@dataclass(frozen=True, slots=True)
class StridePair:
    """One stride in both logs; ``differences`` B − A by QUANTITIES, NaN where one of them does not know it.

    ``same`` is False if anything differs, also what has no column; ``start_s`` counts from A's first moment.
    """

    foot: str
    number_a: int
    number_b: int
    start_s: float
    length_m: tuple[float, float]
    differences: dict[str, float]
    same: bool


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean, SD and greatest size of a difference over ``n`` strides; NaN where there are none."""

    n: int
    mean: float
    sd: float
    greatest: float


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two logs' differences.

    ``settings``: what the headers say differently, as (name, A's, B's). ``shift_s``: B's clock − A's. ``only_a`` and
    ``only_b``: strides without a partner. ``commands``, ``frames``, ``phases``: the first difference in words, "" none.
    """

    settings: list[tuple[str, Any, Any]]
    shift_s: float
    matched_by: str
    pairs: list[StridePair]
    only_a: list[StrideResult]
    only_b: list[StrideResult]
    commands: str
    frames: str
    phases: str
    counts: dict[str, tuple[int, int]] = field(default_factory=dict)

    @property
    def identical(self) -> bool:
        """Both sessions had the same settings and did the same at the same times, bytes included."""
        alike = not (self.settings or self.only_a or self.only_b or self.commands or self.frames or self.phases)
        return alike and not self.shift_s and all(each.same for each in self.pairs)

    def spread(self, quantity: str) -> Spread:
        """Of one of QUANTITIES over the pairs that know it."""
        values = np.array([each.differences[quantity] for each in self.pairs], np.float64)
        values = values[np.isfinite(values)]
        if not values.size:
            return Spread(0, _NAN, _NAN, _NAN)
        sd = float(values.std(ddof=1)) if values.size > 1 else _NAN
        return Spread(int(values.size), float(values.mean()), sd, float(np.abs(values).max()))

    def to_json(self) -> dict[str, Any]:
        """Plain values, None for what is not known."""
        plain: dict[str, Any] = finite_or_none(
            {
                "identical": self.identical,
                "settings": [{"name": name, "a": a, "b": b} for name, a, b in self.settings],
                "shift_s": self.shift_s,
                "matched_by": self.matched_by,
                "counts": {name: {"a": a, "b": b} for name, (a, b) in self.counts.items()},
                "first_difference": {"commands": self.commands, "frames": self.frames, "phases": self.phases},
                "only_in_a": [_label(stride) for stride in self.only_a],
                "only_in_b": [_label(stride) for stride in self.only_b],
                "differences": {name: asdict(self.spread(name)) for name in QUANTITIES},
                "strides": [
                    {name: getattr(each, name) for name in ("foot", "number_a", "number_b", "start_s", "same")}
                    | each.differences
                    for each in self.pairs
                ],
            }
        )
        return plain


def _label(stride: StrideResult) -> str:
    return f"{stride.foot} {stride.number}"


def compare_logs(a: SessionRecord, b: SessionRecord) -> Comparison:
    """Compare two sessions."""
    shift_ns = best_shift(_ends(a.strides), _ends(b.strides))
    matches, matched_by = _matches(a.strides, b.strides, shift_ns)
    by_number, shift_ns = shift_ns is None, shift_ns or 0
    begin_ns = min((int(each.t_ns[0]) for each in a.samples.values()), default=0)
    stimulation_a, stimulation_b = _Stimulation(a), _Stimulation(b)
    pairs = []
    for x, y in matches:
        own_shift_ns = y.t_start_ns - x.t_start_ns if by_number else shift_ns
        switched = stimulation_a.switched_in(x), stimulation_b.switched_in(y)
        pairs.append(_pair(x, y, own_shift_ns, begin_ns, switched))
    in_a, in_b = {id(x) for x, _ in matches}, {id(y) for _, y in matches}
    counted = ("strides", "phases", "commands", "frames", "statuses", "notes")
    sequences: dict[str, tuple[Sequence[Any], Sequence[Any]]] = {
        "command": (a.commands, b.commands),
        "frame": (a.frames, b.frames),
        "phase change": (a.phases, b.phases),
    }
    first = {kind: _first_difference(kind, logs, shift_ns, begin_ns) for kind, logs in sequences.items()}
    # every frame carries the session's identifier, so all of them differ where it does
    other_identifier = bool(a.frames) and a.header.get("stim_session_id") != b.header.get("stim_session_id")
    one, other = _flat(a.header), _flat(b.header)
    names = [name for name in {**one, **other} if name not in ALWAYS_DIFFERENT]
    settings = [(name, one.get(name), other.get(name)) for name in names if not _equal(one.get(name), other.get(name))]
    return Comparison(
        settings=settings,
        shift_s=1e-9 * shift_ns,
        matched_by=matched_by,
        pairs=sorted(pairs, key=lambda each: each.start_s),
        only_a=[stride for stride in a.strides if id(stride) not in in_a],
        only_b=[stride for stride in b.strides if id(stride) not in in_b],
        commands=first["command"],
        frames=first["frame"] + (" (the sessions' identifiers differ)" if other_identifier else ""),
        phases=first["phase change"],
        counts={name: (len(getattr(a, name)), len(getattr(b, name))) for name in counted},
    )


def best_shift(a: dict[str, IntArray], b: dict[str, IntArray]) -> int | None:
    """B's clock − A's (ns) at which most strides end together, 0 if that is as good; None if fewer than ENOUGH do."""
    limited = {foot: (a[foot][:_LONGEST_FOR_SHIFT], b[foot][:_LONGEST_FOR_SHIFT]) for foot in a.keys() & b.keys()}
    fewest = sum(min(len(x), len(y)) for x, y in limited.values())
    if not fewest:
        return None
    differences = np.sort(np.concatenate([(y[None, :] - x[:, None]).ravel() for x, y in limited.values()]))
    width = SAME_STRIDE_NS // 4
    within = np.searchsorted(differences, differences + width, side="right") - np.arange(len(differences))
    at_zero = int((np.abs(differences) <= width).sum())
    best = int(within.argmax())
    if at_zero >= 0.9 * within[best]:
        return 0
    if within[best] < max(ENOUGH * fewest, 2):
        return None
    return int(np.median(differences[best : best + int(within[best])]))


def _ends(strides: Sequence[StrideResult]) -> dict[str, IntArray]:
    feet = {stride.foot for stride in strides}
    return {foot: np.array(sorted(s.t_end_ns for s in strides if s.foot == foot), np.int64) for foot in feet}


def _matches(
    a: Sequence[StrideResult], b: Sequence[StrideResult], shift_ns: int | None
) -> tuple[list[tuple[StrideResult, StrideResult]], str]:
    """Strides that belong together, and by what: time, or number where no shift brings them together."""
    if shift_ns is None:
        by_number = {(stride.foot, stride.number): stride for stride in b}
        return [(x, by_number[x.foot, x.number]) for x in a if (x.foot, x.number) in by_number], "number"
    found = []
    for foot in sorted({stride.foot for stride in a}):
        own_a, own_b = (sorted((s for s in c if s.foot == foot), key=lambda s: s.t_end_ns) for c in (a, b))
        ends_a, ends_b = (np.array([s.t_end_ns for s in own], np.int64) for own in (own_a, own_b))
        found += [(own_a[i], own_b[j]) for i, j in pair_times(ends_a + shift_ns, ends_b, SAME_STRIDE_NS)]
    return found, "time"


class _Stimulation:
    """Where a session's channels went on and off, by foot."""

    def __init__(self, record: SessionRecord) -> None:
        session = record.header.get("session")
        channels = session.get("channels", []) if isinstance(session, dict) else []
        self.foot_of = {f"channel {each.get('number')}": each.get("foot") for each in channels}
        self.marks: list[Mark] = marks_of_commands(record.commands)
        self.t_ns = np.array([mark.t_ns for mark in self.marks], np.int64)

    def switched_in(self, stride: StrideResult) -> Switching:
        """The first switching on of each channel of this foot during the stride, and the switching off after it."""
        first: Switching = {}
        for at in range(int(np.searchsorted(self.t_ns, stride.t_start_ns)), len(self.marks)):
            mark = self.marks[at]
            waits = any(what == "on" and (who, "off") not in first for who, what in first)
            if mark.t_ns > stride.t_end_ns and not waits:
                break
            if self.foot_of.get(mark.who) != stride.foot:
                continue
            begun = (mark.who, "on") in first
            if (mark.what == "on" and not begun and mark.t_ns <= stride.t_end_ns) or (mark.what == "off" and begun):
                first.setdefault((mark.who, mark.what), mark.t_ns)
        return first


def _pair(
    a: StrideResult, b: StrideResult, shift_ns: int, begin_ns: int, switched: tuple[Switching, Switching]
) -> StridePair:
    in_a, in_b = switched
    differences = {name: 100 * (getattr(b, key) - getattr(a, key)) for name, key in _LENGTHS.items()}
    for name, key in TIMES.items():
        differences[f"{name}_ms"] = _ms(getattr(a, key), getattr(b, key), shift_ns)
    for what in ("on", "off"):
        marks = [mark for mark in in_a.keys() | in_b.keys() if mark[1] == what]
        own = [_ms(in_a.get(mark), in_b.get(mark), shift_ns) for mark in marks]
        differences[f"{what}_ms"] = max((value for value in own if math.isfinite(value)), key=abs, default=_NAN)
    same = {mark: t_ns + shift_ns for mark, t_ns in in_a.items()} == in_b and _same_stride(a, b, shift_ns)
    start_s, lengths_m = 1e-9 * (a.t_start_ns - begin_ns), (a.stride_length_m, b.stride_length_m)
    return StridePair(a.foot, a.number, b.number, start_s, lengths_m, differences, same)


def _ms(a_ns: int | None, b_ns: int | None, shift_ns: int) -> float:
    return _NAN if a_ns is None or b_ns is None else 1e-6 * (b_ns - a_ns - shift_ns)


def _same_stride(a: StrideResult, b: StrideResult, shift_ns: int) -> bool:
    for item in fields(StrideResult):
        if not item.compare or (shift_ns and item.name == "number"):
            continue
        one, other = getattr(a, item.name), getattr(b, item.name)
        if item.name.endswith("_ns") and one is not None:
            one += shift_ns
        if not _equal(one, other):
            return False
    return True


def _equal(one: object, other: object) -> bool:
    """Whether they are the same; not known (NaN) and not known are."""
    nan = isinstance(one, float) and isinstance(other, float) and math.isnan(one) and math.isnan(other)
    return bool(nan or one == other)


def _flat(value: object, name: str = "") -> dict[str, Any]:
    """A nested mapping with the path as name."""
    if isinstance(value, dict):
        items: Iterable[tuple[object, object]] = value.items()
    elif isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        items = enumerate(value)
    else:
        return {name: value}
    return {k: v for key, item in items for k, v in _flat(item, f"{name}.{key}" if name else str(key)).items()}


# what is compared of each, and how it reads
_FACTS: Final[dict[str, tuple[Callable[[Any], tuple[Any, ...]], Callable[[Any], str]]]] = {
    "command": (
        lambda each: (each.channel, each.on, each.current_ma, each.pulse_width_us, each.frequency_hz),
        lambda each: f"channel {each.channel} {f'{each.current_ma:.1f} mA' if each.on else 'off'}",
    ),
    "frame": (lambda each: (each.identifier, each.data), lambda each: f"{each.identifier:x}#{each.data.hex()}"),
    "phase change": (lambda each: (each.foot, each.transition), lambda each: f"{each.foot} {each.transition.name}"),
}


def _first_difference(kind: str, logs: tuple[Sequence[Any], Sequence[Any]], shift_ns: int, begin_ns: int) -> str:
    """Where two sequences of something with a time, first differ; "" where they do not."""
    facts, describe = _FACTS[kind]
    for number, (one, other) in enumerate(zip(*logs, strict=False), start=1):
        if facts(one) != facts(other) or one.t_ns + shift_ns != other.t_ns:
            return (
                f"{kind} {number}: A {describe(one)} at {1e-9 * (one.t_ns - begin_ns):.3f} s, "
                f"B {describe(other)} at {1e-9 * (other.t_ns - shift_ns - begin_ns):.3f} s"
            )
    a, b = map(len, logs)
    return "" if a == b else f"A has {a} {kind}s, B {b}; as far as both go they are the same"
