"""The numbers of a session, without any drawing: what the tables, the report and ``--json`` show."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fes.config import Session
from fes.journal import SessionLogError, SessionRecord
from fes.signals import FOOT_SENSORS, NS_PER_S
from fes.view.aggregate import ChannelSummary, FootSummary, channel_summary, foot_summary
from fes.view.bursts import Burst, answers_without_command, find_bursts
from fes.view.channels import (
    ChannelInfo,
    CommandColumns,
    channel_infos,
    command_columns,
    session_settings,
    status_columns,
)
from fes.view.jsonable import plain
from fes.view.quality import Latency, Refusal, Remark, SensorQuality, all_sensors, group_refusals, latency_of, remarks
from fes.view.strides import StrideRow, stride_rows
from fes.view.timeline import PhaseTimeline, build_timeline
from fes.view.tuning import DoseRow, TuningRow, dose_rows, tuning_rows

FORMAT = 1
NAN = float("nan")
LONGEST_NS = 31 * 24 * 3600 * NS_PER_S
FURTHEST_NS = 2**62  # 146 years: differences stay within 64 bits


@dataclass(frozen=True)
class SessionSummary:
    """All numbers of a session; ``to_json`` gives them with their units in the names."""

    name: str
    subject: str
    recording: str
    kind: str
    created: str
    fes_version: str
    complete: bool
    lost: str
    duration_s: float
    belt_speed_mps: float
    walking_speed_mps: float
    speed_over_belt: float
    command_period_s: float
    feet: dict[str, FootSummary]
    channels: tuple[ChannelSummary, ...]
    refusals: tuple[Refusal, ...]
    latency: Latency
    remarks: tuple[Remark, ...]
    sensors: tuple[SensorQuality, ...]
    run_summary: dict[str, Any]
    strides: tuple[StrideRow, ...]
    dose: tuple[DoseRow, ...] = ()
    tuning: tuple[TuningRow, ...] = ()

    @property
    def faults(self) -> tuple[Remark, ...]:
        """The remarks that tell of a fault."""
        return tuple(remark for remark in self.remarks if remark.severity == "fault")

    def to_json(self) -> dict[str, Any]:
        """Plain values, NaN as null; ``format`` changes when a key changes its meaning."""
        return {"format": FORMAT, **plain(self)}


@dataclass(frozen=True)
class SessionView:
    """A summary together with what the figures need besides it."""

    record: SessionRecord
    settings: Session | None
    summary: SessionSummary
    origin_ns: int
    end_ns: int
    timelines: dict[str, PhaseTimeline]
    channels: tuple[ChannelInfo, ...]
    commands: dict[int, CommandColumns] = field(repr=False)
    bursts: dict[int, tuple[Burst, ...]] = field(repr=False)


def summarise(record: SessionRecord) -> SessionSummary:
    """Work out a session's numbers."""
    return view_session(record).summary


def view_session(record: SessionRecord) -> SessionView:
    """Work out a session's numbers and keep the columns they came from.

    Raises:
        SessionLogError: its times run over more than a month, or are too large to be subtracted.
    """
    settings = session_settings(record.header)
    origin_ns, end_ns = _span(record)
    if not 0 <= end_ns - origin_ns <= LONGEST_NS or max(abs(origin_ns), abs(end_ns)) > FURTHEST_NS:
        raise SessionLogError(
            f"its times run from {origin_ns / NS_PER_S:g} s to {end_ns / NS_PER_S:g} s; no session is so long, or so "
            "far from its clock's beginning. Nothing can be drawn of it; `fes convert` gives what it holds."
        )
    timelines = {foot: build_timeline(record.phases, foot, origin_ns, end_ns) for foot in _feet(record, settings)}
    infos = channel_infos(settings, record.commands)
    commands = {info.number: command_columns(record.commands, info.number) for info in infos}
    statuses = {info.number: status_columns(record.statuses, info.number) for info in infos}
    bursts = {
        info.number: find_bursts(info, commands[info.number], statuses[info.number], timelines.get(info.foot))
        for info in infos
    }
    refused = [command for command in record.commands if command.refused]
    rows = stride_rows(record.strides, timelines, infos, bursts, refused, origin_ns)
    feet = {foot: foot_summary(foot, [row for row in rows if row.foot == foot]) for foot in timelines}
    speeds = [foot.walking_speed_mps for foot in feet.values() if np.isfinite(foot.walking_speed_mps)]
    speed = float(np.mean(speeds)) if speeds else NAN
    belt = _belt_speed(record.header, settings)
    header, recording = record.header, _section(record.header, "recording")
    session = _section(header, "session")
    summary = SessionSummary(
        name=str(session.get("name", "") or "session"),
        subject=str(session.get("subject", "")),
        recording=str(recording.get("name", "")),
        kind=str(header.get("kind", "")),
        created=str(header.get("created", "")),
        fes_version=str(header.get("fes_version", "")),
        complete=record.complete,
        lost=record.lost,
        duration_s=(end_ns - origin_ns) / NS_PER_S,
        belt_speed_mps=belt,
        walking_speed_mps=speed,
        speed_over_belt=speed / belt,
        command_period_s=1.0 / (settings.stimulation.command_rate_hz if settings else 50.0),
        feet=feet,
        channels=tuple(
            channel_summary(
                info,
                bursts[info.number],
                rows,
                answers_without_command(commands[info.number], statuses[info.number]),
            )
            for info in infos
        ),
        refusals=group_refusals(refused, origin_ns),
        latency=latency_of(record.latency_ns),
        remarks=remarks(record, origin_ns),
        sensors=all_sensors(record.samples),
        run_summary=plain(record.summary),
        strides=rows,
        dose=dose_rows(record, settings, origin_ns),
        tuning=tuning_rows(record.notes, origin_ns),
    )
    return SessionView(record, settings, summary, origin_ns, end_ns, timelines, infos, commands, bursts)


def _span(record: SessionRecord) -> tuple[int, int]:
    """First and last instant that anything happened."""
    times = [arrays.t_ns for arrays in record.samples.values()] + [record.ticks_ns, record.latency_t_ns]
    edges = [int(edge) for array in times if array.size for edge in (array.min(), array.max())]
    for things in (record.phases, record.commands, record.statuses, record.notes):
        edges += [thing.t_ns for thing in (*things[:1], *things[-1:])]
    for stride in (*record.strides[:1], *record.strides[-1:]):
        edges += [stride.t_start_ns, stride.t_end_ns]
    return (min(edges), max(edges)) if edges else (0, 0)


def _feet(record: SessionRecord, settings: Session | None) -> list[str]:
    """The feet that anything is known about, left first, then whatever else a log names."""
    seen = {stride.foot for stride in record.strides} | {change.foot for change in record.phases}
    seen |= {name for name, arrays in record.samples.items() if name in FOOT_SENSORS and arrays.t_ns.size}
    seen |= {channel.foot for channel in settings.channels} if settings else set()
    return [foot for foot in FOOT_SENSORS if foot in seen] + sorted(seen - set(FOOT_SENSORS))


def _section(header: dict[str, Any], key: str) -> dict[str, Any]:
    value = header.get(key)
    return value if isinstance(value, dict) else {}


def _belt_speed(header: dict[str, Any], settings: Session | None) -> float:
    belt = _section(header, "recording").get("belt_speed_mps")
    if isinstance(belt, (int, float)) and belt > 0:
        return float(belt)
    return settings.treadmill.belt_speed_mps if settings and settings.treadmill else NAN
