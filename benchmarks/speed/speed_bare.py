"""What the arithmetic alone costs: the filters of an analysis in bare compiled loops over the whole recording.

The live core sample by sample; and of the ZUPT-aided filter the samples gathered into intervals, and twice, for path
and stride lengths, forwards and smoothed. Reading, events, strides and all bookkeeping are left out.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from fes.estimation.foot import features as kernel
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.orientation import OrientationSettings
from fes.estimation.numerics.jit import jit
from fes.estimation.numerics.records import Mat, Record, Vec, new_core
from fes.estimation.sensor_choice import Calibration
from fes.estimation.tracking.phase_features import enter_phase
from fes.estimation.zupt.decimation import MOVING_NS, RESTING_NS, ZuptSettings, gather, gather_intervals, interval_ends
from fes.estimation.zupt.filter import filter_intervals, new_tape, smooth_intervals
from fes.estimation.zupt.thresholds import find_zero_velocity
from fes.recording import Recording
from fes.recording.tracks import increasing

AFTER = np.array([0, 1, 2, 3, 0, 0, 0])  # the phase that each transition leads to


@jit
def _follow(core: Record, t_ns: Vec, acc: Mat, gyr: Mat, out: Mat, after: Vec) -> int:
    """The live core over all samples, its phases changed at once."""
    at = changes = 0
    while at < t_ns.shape[0]:
        at, number = kernel.advance(core, t_ns, acc, gyr, at, t_ns.shape[0], out)
        if number > 0:
            changes += 1
            enter_phase(core, after[number])
    return changes


def bare_seconds(recording: Recording, calibrations: Mapping[str, Calibration], repeats: int = 3) -> float:
    """Least processor time in s, all feet together."""
    total = 0.0
    for sensor, calibration in calibrations.items():
        assert isinstance(calibration, FootCalibration)
        track = recording.tracks[sensor]
        newer = increasing(track)
        data = track.t_sensor_ns[newer], track.acc_mps2[newer], track.gyr_radps[newer]
        _, rest, _ = find_zero_velocity(*data[1:], track.rate_hz)
        total += min(_once(calibration, *data, rest) for _ in range(repeats + 1))
    return total


def _once(calibration: FootCalibration, t_ns: Any, acc: Any, gyr: Any, rest: Any) -> float:
    parts = {"parameters": calibration.parameters(), "thresholds": calibration.thresholds()}
    core, noise = new_core(kernel.CORE, **parts, settings=OrientationSettings())[0], ZuptSettings()
    trace, none, lever, bias = np.zeros((len(t_ns), 4)), np.zeros(len(t_ns)), np.zeros(3), np.zeros(3)
    intervals = gather_intervals(t_ns, acc, gyr, none, none, rest, (0.0, 0.0, 0.0))
    tape = new_tape(len(intervals.ends), int(np.count_nonzero(rest[intervals.ends])))
    ends = np.empty(len(t_ns), np.int64)
    kernel.start(core, int(t_ns[0]), *acc[0].tolist())
    begin = time.process_time()
    _follow(core, t_ns, acc, gyr, trace, AFTER)
    interval_ends(t_ns, rest, MOVING_NS, RESTING_NS, ends)
    gather(t_ns, acc, gyr, none, none, 0.0, 0.0, 0.0, noise, intervals)
    for level in (False, True):
        filter_intervals(t_ns, gyr, rest, intervals, acc[0], lever, bias, level, noise, tape)
        smooth_intervals(t_ns, intervals.ends, bool(rest[0]), noise, tape)
    return time.process_time() - begin
