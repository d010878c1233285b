"""Means and spreads over the strides of a foot and the bursts of a channel."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from fes.view.bursts import Burst
from fes.view.channels import ChannelInfo
from fes.view.strides import StrideRow

NAN = float("nan")
STEADY_SHARE = 0.3


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation (n − 1) of ``n`` values; NaN where too few."""

    mean: float
    sd: float
    n: int

    @property
    def sd_percent(self) -> float:
        """Standard deviation in percent of the mean."""
        return 100 * self.sd / abs(self.mean) if self.mean else NAN


@dataclass(frozen=True)
class FootSummary:
    """One foot's session. Averages are over valid strides; stances over 3 s are standing and left out."""

    foot: str
    strides: int
    valid: int
    four_phases: int
    without_loading_response: int
    heel_lifts_put_back: int
    stride_length_m: Spread
    clearance_cm: Spread
    toe_clearance_cm: Spread
    stride_time_s: Spread
    walking_speed_mps: float
    cadence_steps_per_min: float
    pre_swing_s: Spread
    swing_s: Spread
    loading_response_s: Spread
    stance_s: Spread


@dataclass(frozen=True)
class ChannelSummary:
    """One channel's session; ``outside_s`` is the time on in phases in which it must be off."""

    channel: int
    name: str
    foot: str
    muscle: str
    start_phase: str
    stop_phase: str
    bursts: int
    on_time_s: float
    peak_current_ma: float
    pulses: float
    charge_uc: float
    charge_counted_by_device: bool
    outside_s: float
    longest_outside_s: float
    bursts_outside: int
    on_without_command: int
    onset_after_pre_swing_ms: Spread
    burst_duration_s: Spread


def spread(values: Iterable[float]) -> Spread:
    """Mean and standard deviation of the finite values."""
    kept = np.array([value for value in values if np.isfinite(value)])
    return Spread(
        mean=float(kept.mean()) if kept.size else NAN,
        sd=float(kept.std(ddof=1)) if kept.size > 1 else NAN,
        n=int(kept.size),
    )


def steady_speed_mps(rows: Sequence[StrideRow]) -> float:
    """Way over time of the steady strides, m/s; NaN where there is none.

    A stride is steady when its own speed is within ``STEADY_SHARE`` of the median stride's: the first and the last
    step of a walk and steps on the spot say nothing about the belt.
    """
    pairs = [(row.stride_length_m, row.duration_s) for row in rows if row.duration_s > 0]
    length_m, time_s = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
    speed_mps = length_m / time_s
    usual = float(np.median(speed_mps[np.isfinite(speed_mps)])) if np.isfinite(speed_mps).any() else NAN
    steady = np.abs(speed_mps - usual) <= STEADY_SHARE * abs(usual)
    return float(length_m[steady].sum() / time_s[steady].sum()) if steady.any() else NAN


def foot_summary(foot: str, rows: Sequence[StrideRow]) -> FootSummary:
    """Sum up the strides of one foot."""
    valid = [row for row in rows if row.valid]
    stride_time = spread(row.duration_s for row in valid)
    return FootSummary(
        foot=foot,
        strides=len(rows),
        valid=len(valid),
        four_phases=sum(row.four_phases for row in rows),
        without_loading_response=sum(row.path.endswith("T6") for row in rows),
        heel_lifts_put_back=sum(row.heel_lifts_put_back for row in rows),
        stride_length_m=spread(row.stride_length_m for row in valid),
        clearance_cm=spread(row.clearance_cm for row in valid),
        toe_clearance_cm=spread(row.toe_clearance_cm for row in valid),
        stride_time_s=stride_time,
        walking_speed_mps=steady_speed_mps(valid),
        cadence_steps_per_min=120.0 / stride_time.mean if stride_time.n else NAN,
        pre_swing_s=spread(row.pre_swing_s for row in valid),
        swing_s=spread(row.swing_s for row in valid),
        loading_response_s=spread(row.loading_response_s for row in valid),
        stance_s=spread(row.stance_s for row in valid if not row.stance_is_standing),
    )


def channel_summary(
    info: ChannelInfo, bursts: Sequence[Burst], rows: Sequence[StrideRow], stray: int
) -> ChannelSummary:
    """Sum up one channel; ``stray`` counts answers that say on without a command."""
    own = [item for row in rows for item in row.stimulation if item.channel == info.number]
    outside = [burst.outside_s for burst in bursts]
    known = info.foot != ""
    return ChannelSummary(
        channel=info.number,
        name=info.name,
        foot=info.foot,
        muscle=info.muscle,
        start_phase=info.start_phase,
        stop_phase=info.stop_phase,
        bursts=len(bursts),
        on_time_s=sum(burst.duration_s for burst in bursts),
        peak_current_ma=max((burst.peak_current_ma for burst in bursts), default=0.0),
        pulses=sum(burst.pulses for burst in bursts),
        charge_uc=sum(burst.charge_uc for burst in bursts),
        charge_counted_by_device=any(burst.counted for burst in bursts),
        outside_s=sum(outside) if known else NAN,
        longest_outside_s=max(outside, default=0.0) if known else NAN,
        bursts_outside=sum(value > 0 for value in outside),
        on_without_command=stray,
        onset_after_pre_swing_ms=spread(item.onset_after_pre_swing_ms for item in own),
        burst_duration_s=spread(burst.duration_s for burst in bursts),
    )
