"""What the arithmetic alone costs: the filters of an analysis in bare compiled loops over the whole recording.

The live core sample by sample, and the ZUPT-aided filter forwards and smoothed: once for the path, and once more in the
stretches, with their margins, of the stride lengths. Reading, events, strides and all bookkeeping are left out.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from fes.driving import Calibration
from fes.estimation import kernel
from fes.estimation.calibration import FootCalibration
from fes.estimation.compiled import jit
from fes.estimation.orientation import OrientationSettings
from fes.estimation.rest import at_rest, calibrate_rest
from fes.estimation.stride_fusion import MARGIN_S, STRETCH_S
from fes.estimation.zupt_kernel import ZuptSettings, forward, new_tape
from fes.estimation.zupt_smooth import smooth
from fes.recording import Recording
from fes.replay import increasing

AFTER = np.array([0, 1, 2, 3, 0, 0, 0])  # the phase that each transition leads to


@jit
def _follow(s: Any, p: Any, thresholds: Any, settings: Any, t_ns: Any, acc: Any, gyr: Any, out: Any, after: Any) -> int:
    """The live core over all samples, its phases changed at once."""
    at = changes = 0
    while at < t_ns.shape[0]:
        at, number = kernel.advance(s, p, thresholds, settings, t_ns, acc, gyr, at, t_ns.shape[0], out)
        if number > 0:
            changes += 1
            kernel.enter(s, after[number], acc[at - 1, 0], acc[at - 1, 1], acc[at - 1, 2])
    return changes


def bare_seconds(recording: Recording, calibrations: Mapping[str, Calibration], repeats: int = 3) -> float:
    """Least processor time in s, all feet together."""
    total = 0.0
    for sensor, calibration in calibrations.items():
        assert isinstance(calibration, FootCalibration)
        track = recording.tracks[sensor]
        newer = increasing(track)
        data = track.t_sensor_ns[newer], track.acc_mps2[newer], track.gyr_radps[newer]
        rest = at_rest(calibrate_rest(*data[1:], track.rate_hz), *data[1:], track.rate_hz)
        total += min(_once(calibration, *data, rest) for _ in range(repeats + 1))
    return total


def _once(calibration: FootCalibration, t_ns: Any, acc: Any, gyr: Any, rest: Any) -> float:
    state, settings, noise = np.zeros(1, kernel.STATE)[0], OrientationSettings(), ZuptSettings()
    trace, extra, lever = np.zeros((len(t_ns), 4)), np.zeros(len(t_ns)), np.zeros(3)
    whole = round((STRETCH_S + 2.0 * MARGIN_S) * calibration.rate_hz)
    tape = new_tape(min(whole, len(t_ns)), covariance=False)
    samples = (1.0 + (STRETCH_S + 2.0 * MARGIN_S) / STRETCH_S) * len(t_ns)  # of both solutions
    kernel.start(state, int(t_ns[0]), *acc[0].tolist(), settings)
    begin = time.process_time()
    _follow(state, calibration.parameters(), calibration.thresholds(), settings, t_ns, acc, gyr, trace, AFTER)
    spent, done = time.process_time() - begin, 0
    begin = time.process_time()
    for first in range(0, len(t_ns) - len(tape.position) + 1, len(tape.position)):
        part = slice(first, first + len(tape.position))
        quiet = rest[part]
        forward(t_ns[part], acc[part], gyr[part], extra[part], extra[part], quiet, acc[first], lever, True, noise, tape)
        smooth(t_ns[part], bool(quiet[0]), noise, tape)
        done += len(tape.position)
    return spent + (time.process_time() - begin) * samples / done
