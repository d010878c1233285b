"""What a simulated sensor plays, and its own faults, as the driver's samples show them; in real time, over Xbus."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

import numpy as np
import pytest
from imu_reading import Taken, collect_samples, settings

from drivers.imu.open import open_imus
from drivers.imu.port import ImuPort
from drivers.simulated.spawn import ImuHandle, spawn_imu
from fes.recording import Recording, Track, write_recording
from fes.signals import G_MPS2, NS_PER_S, RawSample

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
    made = opened(handle)
    yield made
    made.close()
    handle.clear()


@pytest.fixture
def taken(handle: ImuHandle) -> Taken:
    return Taken(handle, OFFSET_NS / NS_PER_S)


def opened(handle: ImuHandle) -> ImuPort:
    """The sensor's line, empty of what nobody has read."""
    options = {"baudrate": 921600, "configure": False}
    (made,) = open_imus([settings("xbus", handle.port, "left_foot", RATE_HZ, **options)])
    Taken(handle, OFFSET_NS / NS_PER_S).since(made, time.monotonic_ns(), 1)
    return made


def numbers(samples: list[RawSample]) -> list[int]:
    return [round(sample.gyr_radps[0] / STEP_RADPS) for sample in samples]


def stamps_are_a_period_apart(samples: list[RawSample]) -> bool:
    return {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(samples)} == {PERIOD_NS}


def test_a_recording_is_played_sample_by_sample_round_and_round(port: ImuPort) -> None:
    found = collect_samples([port], SAMPLES + 20)  # all of it, and its beginning again
    played = numbers(found)
    assert all(b == (a + 1) % SAMPLES for a, b in itertools.pairwise(played))
    assert stamps_are_a_period_apart(found)
    first = (found[0].t_device_ns - OFFSET_NS) // PERIOD_NS
    assert played[0] == first % SAMPLES  # by its own clock, from when it started
    for sample in found:
        assert sample.acc_mps2 == pytest.approx((0.0, 0.6 * G_MPS2, 0.8 * G_MPS2), rel=1e-6)
        assert sample.gyr_radps[1:] == pytest.approx((0.0, -0.01), rel=1e-6)


def test_stuck_it_says_the_same_again_and_again_with_new_stamps(handle: ImuHandle, port: ImuPort, taken: Taken) -> None:
    found = taken.since(port, handle.inject("stuck"), 60)
    assert len({sample.gyr_radps for sample in found}) == 1
    assert stamps_are_a_period_apart(found)
    after = numbers(taken.since(port, handle.inject("stuck", 0.0), 20))
    assert all(b == (a + 1) % SAMPLES for a, b in itertools.pairwise(after))


@pytest.mark.slow
def test_clipped_its_values_end_early_and_its_flag_says_so(handle: ImuHandle, port: ImuPort, taken: Taken) -> None:
    counts = port.counts["left_foot"]
    assert counts.clipped == 0
    limit_mps2 = 0.03 * 16.0 * G_MPS2  # below gravity's share on one axis
    found = taken.since(port, handle.inject("clip", 0.03), 60)
    for sample in found:
        assert sample.acc_mps2 == pytest.approx((0.0, limit_mps2, limit_mps2), rel=1e-6)
    assert counts.clipped >= len(found)  # and those taken before it was told, but sent after
    assert counts.bad_values == 0
    told_ns = handle.inject("clip", 0.0)
    assert taken.since(port, told_ns, 1)[0].acc_mps2[2] == pytest.approx(0.8 * G_MPS2, rel=1e-6)
    clipped = counts.clipped
    collect_samples([port], 20)
    assert counts.clipped == clipped


@pytest.mark.slow
def test_delayed_it_comes_late_with_the_stamps_of_when_it_was_taken(
    handle: ImuHandle, port: ImuPort, taken: Taken
) -> None:
    found = taken.since(port, handle.inject("delay", 0.15), 60)
    end_s = time.monotonic() + 10.0
    while min(map(taken.late_ns, found)) >= 155_000_000:  # of many samples one meets a machine with time for it
        assert time.monotonic() < end_s, "later than it was told"
        found += collect_samples([port], 20)
    assert min(map(taken.late_ns, found)) >= 150_000_000
    assert stamps_are_a_period_apart(found)


@pytest.mark.slow
def test_its_clock_drifts_when_told_and_its_beat_with_it() -> None:
    with spawn_imu("xbus", sensor="left_foot", rate_hz=RATE_HZ, offset_s=OFFSET_NS / NS_PER_S) as handle:
        port = opened(handle)
        assert gained(port) == pytest.approx(0.0, abs=0.2)
        handle.inject("drift", 500_000.0)  # far more than a busy machine adds
        collect_samples([port], 20)
        assert gained(port) == pytest.approx(0.5, abs=0.2)
        port.close()


def gained(port: ImuPort) -> float:
    """By how much of the host's time the device's stamps run ahead, over 2 s of them; waits on the host even out."""
    found = collect_samples([port], 400)
    assert stamps_are_a_period_apart(found)  # of its own clock
    host_s = np.array([sample.t_host_ns - found[0].t_host_ns for sample in found]) * 1e-9
    device_s = np.array([sample.t_device_ns - found[0].t_device_ns for sample in found]) * 1e-9
    return 1.0 / float(np.polyfit(device_s, host_s, 1)[0]) - 1.0
