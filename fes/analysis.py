"""Off-line analysis: the same core as live, advanced in one block; no stimulation, no clock, no devices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fes import __version__
from fes.config import Session
from fes.controller import stride_settings
from fes.estimation.calibration import FootCalibration
from fes.estimation.events_offline import GaitEvents, find_events
from fes.estimation.foot import FootTracker, SampleCounts
from fes.estimation.foot_strike import foot_strike_angles
from fes.estimation.strides import StrideMaker
from fes.journal import SampleArrays, SessionRecord
from fes.recording import Recording
from fes.replay import LOG_FORMAT, increasing, session_for
from fes.signals import StrideResult
from statemachine.phases import PhaseChange


@dataclass(frozen=True)
class Analysis:
    """What a recording shows: phase changes and strides of all feet by time, and what became of the samples."""

    recording: Recording
    calibrations: dict[str, FootCalibration]
    phases: list[PhaseChange]
    strides: list[StrideResult]
    events: dict[str, GaitEvents]
    counts: dict[str, SampleCounts]

    def stride_rows(self) -> list[dict[str, Any]]:
        """One flat row per stride, units in the names; ready for CSV, Parquet and JSON."""
        return [_stride_row(stride) for stride in self.strides]

    def phase_rows(self) -> list[dict[str, Any]]:
        """One flat row per phase change; T2 is foot off (FO), T3 initial contact (IC)."""
        return [
            {
                "foot": change.foot,
                "t_s": 1e-9 * change.t_ns,
                "transition": change.transition.name,
                "from": change.source.name.lower(),
                "to": change.destination.name.lower(),
            }
            for change in self.phases
        ]

    def event_rows(self) -> list[dict[str, Any]]:
        """One flat row per swing, from foot off (FO) to initial contact (IC); found off-line, not causally."""
        rows = []
        for foot, events in self.events.items():
            track = self.recording.tracks[foot]
            newer = increasing(track)
            angles = foot_strike_angles(
                track.t_sensor_ns[newer], track.gyr_radps[newer], events, self.calibrations[foot]
            )
            for fo_ns, mid_ns, ic_ns, angle in zip(
                events.fo_ns, events.mid_swing_ns, events.ic_ns, angles, strict=True
            ):
                rows.append(
                    {
                        "foot": foot,
                        "t_foot_off_s": 1e-9 * int(fo_ns),
                        "t_mid_swing_s": 1e-9 * int(mid_ns),
                        "t_initial_contact_s": 1e-9 * int(ic_ns),
                        "foot_strike_angle_rad": float(angle),
                    }
                )
        return sorted(rows, key=lambda row: row["t_foot_off_s"])

    def record(self, created: str) -> SessionRecord:
        """The same as a session's record, for the tables and the report."""
        header = {
            "format": LOG_FORMAT,
            "fes_version": __version__,
            "kind": "analysis",
            "created": created,
            "recording": {
                "name": self.recording.name,
                "rates_hz": {sensor: track.rate_hz for sensor, track in self.recording.tracks.items()},
                "belt_speed_mps": self.recording.belt_speed_mps,
            },
            "session": session_for(self.recording, None).model_dump(mode="json"),
            "calibration": {sensor: calibration.to_dict() for sensor, calibration in self.calibrations.items()},
        }
        samples = {
            sensor: SampleArrays(track.t_ns, track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
            for sensor, track in self.recording.tracks.items()
            if sensor in self.calibrations
        }
        return SessionRecord(header, samples=samples, phases=self.phases, strides=self.strides, complete=True)


def analyse(recording: Recording, calibrations: dict[str, FootCalibration]) -> Analysis:
    """Track every calibrated foot through the whole recording."""
    session: Session = session_for(recording, None)
    phases: list[PhaseChange] = []
    strides: list[StrideResult] = []
    events: dict[str, GaitEvents] = {}
    counts: dict[str, SampleCounts] = {}
    for foot, calibration in calibrations.items():
        track = recording.tracks[foot]
        tracker = FootTracker(calibration, StrideMaker(foot, stride_settings(session, calibration)))
        for outcome in tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps):
            if isinstance(outcome, StrideResult):
                strides.append(outcome)
            else:
                phases.append(outcome)
        newer = increasing(track)
        events[foot] = find_events(track.t_sensor_ns[newer], track.acc_mps2[newer], track.gyr_radps[newer], calibration)
        counts[foot] = tracker.counts
    phases.sort(key=lambda change: change.t_ns)
    strides.sort(key=lambda stride: stride.t_start_ns)
    return Analysis(recording, calibrations, phases, strides, events, counts)


def _stride_row(stride: StrideResult) -> dict[str, Any]:
    def seconds(t_ns: int | None) -> float | None:
        return None if t_ns is None else 1e-9 * t_ns

    return {
        "foot": stride.foot,
        "number": stride.number,
        "valid": stride.valid,
        "reason": stride.reason,
        "t_start_s": 1e-9 * stride.t_start_ns,
        "t_end_s": 1e-9 * stride.t_end_ns,
        "t_pre_swing_s": seconds(stride.t_pre_swing_ns),
        "t_swing_s": seconds(stride.t_swing_ns),
        "t_loading_response_s": seconds(stride.t_loading_response_ns),
        "t_stance_s": seconds(stride.t_stance_ns),
        "stride_length_m": stride.stride_length_m,
        "speed_mps": stride.speed_mps,
        "clearance_m": stride.clearance_m,
        "toe_clearance_m": stride.toe_clearance_m,
        "heel_clearance_m": stride.heel_clearance_m,
        "height_gained_m": stride.height_gained_m,
        "turn_rad": stride.turn_rad,
    }
