"""Calibration at a session's beginning: found from the newest minute, whatever came before it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
from replays import SETTINGS, trial

from fes.config import ImuDevice, load_session
from fes.live.calibrating import Calibrating
from fes.signals import ImuSample, Vector3

NS_PER_S = 1_000_000_000


def standing_then_walking(stand_s: float) -> tuple[Calibrating, Iterator[ImuSample]]:
    """A calibration of one foot, and its samples: the first half second again and again, then the walk."""
    recording = trial("negard_patient2")
    ((foot, track),) = recording.tracks.items()
    device = ImuDevice(sensor=foot, device="xbus", port="x", rate_hz=track.rate_hz, acc_range_g=16, gyr_range_dps=2000)
    settings = load_session(SETTINGS).model_copy(update={"sensors": (device,)})
    step_ns, half = round(NS_PER_S / track.rate_hz), int(track.rate_hz / 2)

    def samples() -> Iterator[ImuSample]:
        standing = [number % half for number in range(int(stand_s * track.rate_hz))]
        for number, row in enumerate([*standing, *range(len(track.t_ns))]):
            acc, gyr = track.acc_mps2[row].tolist(), track.gyr_radps[row].tolist()
            yield ImuSample(number * step_ns, foot, number * step_ns, tuple(acc), tuple(gyr))

    return Calibrating(settings, 6), samples()


def give(finding: Calibrating, sample: ImuSample) -> None:
    finding.add_event(sample)
    if finding._thread is not None:  # what it tries is done before the next sample: the test knows no race
        finding._thread.join()


def test_who_stands_for_over_a_minute_first_is_calibrated_all_the_same() -> None:
    finding, samples = standing_then_walking(70.0)
    for sample in samples:
        give(finding, sample)
        if finding.done:
            return
    raise AssertionError(finding.message)


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_sample_that_is_no_number_is_left_out(wrong: float) -> None:
    finding, samples = standing_then_walking(2.0)
    for number, sample in enumerate(samples):
        spoilt: Vector3 = (0.0, wrong, 0.0)
        if number == 100:
            sample = ImuSample(sample.t_ns, sample.sensor, sample.t_sensor_ns, spoilt, sample.gyr_radps)
        if number == 110:
            sample = ImuSample(sample.t_ns, sample.sensor, sample.t_sensor_ns, sample.acc_mps2, spoilt)
        give(finding, sample)
        if finding.done:
            return
    raise AssertionError(finding.message)
