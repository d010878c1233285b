"""A session log replayed: what came out this time, and where it first differs from what is recorded."""

import math
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any, Final

from fes.session_log import Note, SessionRecord
from fes.signals import Event, StimCommand, StrideResult, WireFrame
from statemachine.phases import PhaseChange

SAME: Final = 1e-6  # of a stride's numbers: another processor's last bit is no difference, another sample is
ENDED_WHOLE: Final = ("complete", "different", "interrupted")  # every event logged was dealt with to its end


class ReplayOutput:
    """A loop's log that only remembers what came out."""

    def __init__(self) -> None:
        self.commands: list[StimCommand] = []
        self.frames: list[WireFrame] = []
        self.phases: list[PhaseChange] = []
        self.strides: list[StrideResult] = []

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
        """Another machine's business."""


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
