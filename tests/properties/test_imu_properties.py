"""Decoders take any bytes; the clock keeps order."""

from __future__ import annotations

import contextlib
import math
import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.imu import capture2go_codec as c2g
from drivers.imu import xbus, ximu3
from drivers.imu.can_port import DbcSensor
from fes.config.session import ImuDevice
from fes.control.clock_sync import SensorClock

BOUNDED = settings(max_examples=5000 if os.environ.get("FES_EXAMPLES") == "nightly" else 150, deadline=None)
CHUNKS = st.lists(st.binary(max_size=60), max_size=12)
REALS = st.floats(width=32, allow_nan=False)
XSENS = ImuDevice(sensor="left_foot", device="xsens_can", rate_hz=100.0, acc_range_g=16.0, gyr_range_dps=2000.0)


@pytest.mark.requirement("SR-15")
@BOUNDED
@given(CHUNKS)
def test_xbus_takes_any_bytes_and_finds_the_same_however_cut(chunks: list[bytes]) -> None:
    cut, whole = xbus.XbusDecoder(), xbus.XbusDecoder()
    found = [message for chunk in chunks for message in cut.feed(chunk)]
    assert found == whole.feed(b"".join(chunks))
    assert cut.counts == whole.counts


@BOUNDED
@given(st.binary(max_size=300))
def test_xbus_measurements_of_any_bytes(data: bytes) -> None:
    with contextlib.suppress(xbus.XbusRejected):
        found = xbus.decode_measurement(data)
        assert found.counter is None or 0 <= found.counter < 2**16


@BOUNDED
@given(st.integers(0, 255), st.binary(max_size=600))
def test_xbus_round_trip(mid: int, data: bytes) -> None:
    assert xbus.XbusDecoder().feed(xbus.encode(mid, data)) == [xbus.XbusMessage(mid, data)]


@BOUNDED
@given(st.integers(0, 2**64 - 1), st.tuples(REALS, REALS, REALS), st.tuples(REALS, REALS, REALS), CHUNKS)
def test_ximu3_round_trip_after_any_bytes(
    t_us: int, gyr: tuple[float, float, float], acc: tuple[float, float, float], noise: list[bytes]
) -> None:
    decoder = ximu3.Ximu3Decoder()
    for chunk in noise:
        decoder.feed(chunk)
    decoder.feed(b"\n")
    message = ximu3.Inertial(t_us, gyr, acc)
    assert decoder.feed(ximu3.encode(message)) == [message]


@pytest.mark.requirement("SR-15")
@BOUNDED
@given(CHUNKS, st.sampled_from(sorted(c2g.Header)), st.integers(0, 10**6))
def test_capture2go_takes_any_bytes_and_finds_the_same_however_cut(
    chunks: list[bytes], header: c2g.Header, cut_at: int
) -> None:
    good = c2g.pack(header)
    chunks = [*chunks, good[: cut_at % len(good)], good[cut_at % len(good) :], *chunks, good, bytes(260)]
    cut, whole = c2g.Capture2GoDecoder(), c2g.Capture2GoDecoder()
    found = [package for chunk in chunks for package in cut.feed(chunk)]
    assert found == whole.feed(b"".join(chunks))
    assert cut.counts == whole.counts
    assert found.count(c2g.Package(header, good[c2g.HEAD_BYTES :])) >= 2  # noise costs no package after it
    for package in found:
        assert c2g.encode(package.header, package.payload) in b"".join(chunks)
        c2g.samples(package)


@BOUNDED
@given(st.integers(-(2**63), 2**63 - 1), *[st.tuples(*[st.integers(-(2**15), 2**15 - 1)] * 3)] * 2, st.integers(0, 31))
def test_capture2go_samples_are_within_their_range(
    t_ns: int, gyr: tuple[int, int, int], acc: tuple[int, int, int], flags: int
) -> None:
    fields: dict[str, c2g.Value] = {"timestamp": t_ns, "gyr": gyr, "acc": acc, "errorFlags": flags}
    (package,) = c2g.Capture2GoDecoder().feed(c2g.pack(c2g.Header.DATA_FULL_6D_FIXED_200HZ, fields))
    (sample,) = c2g.samples(package)
    assert (sample.t_ns, sample.flags) == (t_ns, flags)
    assert c2g.unpack(package) == {**fields, "quat": 0, "delta": 0}
    assert max(map(abs, sample.gyr_radps)) <= math.radians(2000.0) * (1 + 1e-12)
    assert max(map(abs, sample.acc_mps2)) <= 16 * 9.81


@BOUNDED
@given(st.lists(st.binary(max_size=80), max_size=8))
def test_capture2go_takes_any_notifications(notifications: list[bytes]) -> None:
    decoder = c2g.NotificationDecoder()
    for notification in notifications:
        for package in decoder.feed(notification):
            c2g.unpack(package)
    live = c2g.pack(c2g.Header.DATA_FULL_FIXED_RT)
    assert decoder.feed(b"\xfe" + live)[0] == c2g.Package(c2g.Header.DATA_FULL_FIXED_RT, live[c2g.HEAD_BYTES :])


@BOUNDED
@given(st.lists(st.tuples(st.sampled_from((0x05, 0x32, 0x34)), st.binary(max_size=8)), max_size=40))
def test_can_frames_of_any_bytes_give_sound_samples_or_nan(frames: list[tuple[int, bytes]]) -> None:
    part = DbcSensor(XSENS)
    for identifier, data in frames:
        sample = part.receive(0, identifier, data)
        if sample is not None:
            assert math.isnan(sample.acc_mps2[0]) or max(map(abs, sample.acc_mps2)) < 16 * 9.81 * 1.06


@BOUNDED
@given(st.lists(st.tuples(st.integers(0, 3 * 10**9), st.integers(0, 3 * 10**9)), min_size=2, max_size=80))
def test_stamps_that_do_not_go_back_are_mapped_to_ones_that_do_not(steps: list[tuple[int, int]]) -> None:
    clock = SensorClock()
    host_ns = device_ns = 0
    last_ns = None
    for host_step, device_step in steps:
        host_ns += host_step
        device_ns += device_step
        mapped_ns = clock.map(host_ns, device_ns)
        assert last_ns is None or mapped_ns >= last_ns
        last_ns = mapped_ns
