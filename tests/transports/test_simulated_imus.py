"""What a simulated sensor plays, and its own faults, as the driver's samples show them; in real time, over Xbus."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np
import pytest
from imu_reading import collect, settings

from drivers.imu.open import open_imus
from drivers.imu.port import ImuPort, RawSample
from drivers.virtual.imu_spawn import ImuHandle, spawn_imu
from fes.recording import Recording, Track, write_recording
from fes.signals import G_MPS2, NS_PER_S

RATE_HZ = 200.0
PERIOD_NS = 5_000_000
OFFSET_NS = 40 * NS_PER_S
SAMPLES = 240
STEP_RADPS = 1e-4  # each sample of the recording says by its rate which one it is


def numbered() -> Recording:
    """1.2 s at rest; the turning rate counts the samples."""
    t_ns = np.arange(SAMPLES, dtype=np.int64) * PERIOD_NS
    acc = np.tile([0.0, 0.6 * G_MPS2, 0.8 * G_MPS2], (SAMPLES, 1))
    gyr = np.zeros((SAMPLES, 3))
    gyr[:, 0] = np.arange(SAMPLES) * STEP_RADPS
    gyr[:, 2] = -0.01
    return Recording("numbered", None, {"left_foot": Track("left_foot", RATE_HZ, t_ns, t_ns, acc, gyr)})


@pytest.fixture(scope="module")
def handle(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ImuHandle]:
    path = tmp_path_factory.mktemp("recording") / "numbered.parquet"
    write_recording(numbered(), path)
    with spawn_imu(
        "xbus", sensor="left_foot", recording=path, rate_hz=RATE_HZ, offset_s=OFFSET_NS / NS_PER_S
    ) as running:
        yield running


@pytest.fixture
def port(handle: ImuHandle) -> Iterator[ImuPort]:
    options = {"baudrate": 921600, "configure": False}
    (opened,) = open_imus([settings("xbus", handle.port, "left_foot", RATE_HZ, **options)])
    collect([opened], 0.1)
    yield opened
    opened.close()
    handle.clear()


def numbers(samples: list[RawSample]) -> list[int]:
    return [round(sample.gyr_radps[0] / STEP_RADPS) for sample in samples]


def least_late_ns(samples: list[RawSample]) -> int:
    """The host's time of reading less the device's stamp, of the sample that waited least."""
    return min(sample.t_host_ns - sample.t_device_ns for sample in samples)


def test_a_recording_is_played_sample_by_sample_round_and_round(port: ImuPort) -> None:
    found = collect([port], 1.4)
    played = numbers(found)
    assert len(played) > SAMPLES  # all of it, and its beginning again
    assert all(b == (a + 1) % SAMPLES for a, b in itertools.pairwise(played))
    stamps_ns = [sample.t_device_ns for sample in found]
    assert {b - a for a, b in itertools.pairwise(stamps_ns)} == {PERIOD_NS}
    first = (stamps_ns[0] - OFFSET_NS) // PERIOD_NS
    assert played[0] == first % SAMPLES  # by its own clock, from when it started
    for sample in found:
        assert sample.acc_mps2 == pytest.approx((0.0, 0.6 * G_MPS2, 0.8 * G_MPS2), rel=1e-6)
        assert sample.gyr_radps[1:] == pytest.approx((0.0, -0.01), rel=1e-6)


def test_stuck_it_says_the_same_again_and_again_with_new_stamps(handle: ImuHandle, port: ImuPort) -> None:
    told_ns = handle.fault("stuck")
    found = [sample for sample in collect([port], 0.4) if sample.t_host_ns > told_ns + 2 * PERIOD_NS]
    assert len(found) > 40
    assert len({sample.gyr_radps for sample in found}) == 1
    assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)} == {PERIOD_NS}
    handle.fault("stuck", 0.0)
    after = numbers(collect([port], 0.3)[-20:])
    assert all(b == (a + 1) % SAMPLES for a, b in itertools.pairwise(after))
    assert after[0] != numbers(found)[0]


@pytest.mark.slow
def test_clipped_its_values_end_early_and_its_flag_says_so(handle: ImuHandle, port: ImuPort) -> None:
    counts = port.counts["left_foot"]
    assert counts.clipped == 0
    told_ns = handle.fault("clip", 0.03)  # of 16 g: below gravity's share on one axis
    found = [sample for sample in collect([port], 0.4) if sample.t_host_ns > told_ns + 2 * PERIOD_NS]
    limit_mps2 = 0.03 * 16.0 * G_MPS2
    assert found
    for sample in found:
        assert sample.acc_mps2 == pytest.approx((0.0, limit_mps2, limit_mps2), rel=1e-6)
    assert len(found) <= counts.clipped <= len(found) + 4
    assert counts.bad_values == 0
    handle.fault("clip", 0.0)
    assert collect([port], 0.3)[-1].acc_mps2[2] == pytest.approx(0.8 * G_MPS2, rel=1e-6)


@pytest.mark.slow
def test_delayed_it_comes_late_with_the_stamps_of_when_it_was_taken(handle: ImuHandle, port: ImuPort) -> None:
    before_ns = least_late_ns(collect([port], 0.2))
    handle.fault("delay", 0.15)
    collect([port], 0.2)
    found = collect([port], 0.3)
    assert least_late_ns(found) - before_ns == pytest.approx(150_000_000, abs=5_000_000)
    assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)} == {PERIOD_NS}


@pytest.mark.slow
def test_its_clock_drifts_when_told_and_its_beat_with_it(handle: ImuHandle, port: ImuPort) -> None:
    assert gained(port) == pytest.approx(0.0, abs=0.2)
    handle.fault("drift", 500_000.0)  # far more than a busy machine adds
    try:
        assert gained(port) == pytest.approx(0.5, abs=0.2)
    finally:
        handle.fault("drift", 0.0)


def gained(port: ImuPort) -> float:
    """By how much of the host's time the device's stamps run ahead, over 0.5 s; waits on the host even out."""
    collect([port], 0.05)
    found = collect([port], 0.5)
    assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)} == {PERIOD_NS}  # of its own clock
    host_s = np.array([sample.t_host_ns - found[0].t_host_ns for sample in found]) * 1e-9
    device_s = np.array([sample.t_device_ns - found[0].t_device_ns for sample in found]) * 1e-9
    slope = float(np.polyfit(device_s, host_s, 1)[0])
    assert math.isfinite(slope)
    return 1.0 / slope - 1.0
