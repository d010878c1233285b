"""A session log replayed: what came out this time, and where it first differs from what is recorded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Final

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

    Args:
        record: the log.
        frames: the commands' frames in it; None where bytes cannot be compared.
        now: what came out this time.
        end_ns: time of the replay's last event.
    """
    whole = record.complete and record.summary.get("ended") in ENDED_WHOLE
    return (
        (_frame_difference(record, frames, now.frames, end_ns, whole) if frames is not None else "")
        or _command_difference(record.commands, now.commands, whole)
        or _phase_difference(record.phases, now.phases, whole)
        or _stride_difference(record.strides, now.strides, whole)
    )


def _frame_difference(
    record: SessionRecord, recorded: Sequence[WireFrame], now: list[WireFrame], end_ns: int, whole: bool
) -> str:
    for number, (was, is_now) in enumerate(zip(recorded, now, strict=False)):
        if was == is_now:
            continue
        rest = record.commands[number:]
        if not whole and all(not command.on and command.t_ns == end_ns for command in rest):
            return ""  # the session stopped here and switched off
        return (
            f"command {number + 1}: recorded {was.data.hex()} at {was.t_ns} ns, now {is_now.data.hex()} at "
            f"{is_now.t_ns} ns"
        )
    if whole and len(recorded) != len(now):
        return f"{len(recorded)} commands are recorded, now there are {len(now)}"
    return ""


def _command_difference(recorded: list[StimCommand], now: list[StimCommand], whole: bool) -> str:
    for number, (was, is_now) in enumerate(zip(recorded, now, strict=False), start=1):
        if was == is_now:
            continue
        if not whole and all(not command.on and command.t_ns >= now[-1].t_ns for command in recorded[number - 1 :]):
            return ""  # the session stopped here and switched off
        return f"command {number}: recorded {was}, now {is_now}"
    if whole and len(recorded) != len(now):
        return f"{len(recorded)} commands are recorded, now there are {len(now)}"
    return ""


def _phase_difference(recorded: list[PhaseChange], now: list[PhaseChange], whole: bool) -> str:
    for number, (was, is_now) in enumerate(zip(recorded, now, strict=False), start=1):
        if was != is_now:
            return f"phase change {number}: recorded {_describe(was)}, now {_describe(is_now)}"
    if whole and len(recorded) != len(now):
        return f"{len(recorded)} phase changes are recorded, now there are {len(now)}"
    return ""


def _describe(change: PhaseChange) -> str:
    return f"{change.foot} into {change.destination.name} at {change.t_ns} ns"


def _stride_difference(recorded: list[StrideResult], now: list[StrideResult], whole: bool) -> str:
    names = [field.name for field in fields(StrideResult) if field.compare]
    for was, is_now in zip(recorded, now, strict=False):
        for name in names:
            one, other = getattr(was, name), getattr(is_now, name)
            if not _same(one, other):
                return f"stride {was.number} of the {was.foot}: {name} is recorded as {one}, now {other}"
    if whole and len(recorded) != len(now):
        return f"{len(recorded)} strides are recorded, now there are {len(now)}"
    return ""


def _same(one: object, other: object) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=SAME, abs_tol=SAME) or (math.isnan(one) and math.isnan(other))
    return one == other
