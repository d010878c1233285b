"""Decoders take any bytes; the clock keeps order."""

from __future__ import annotations

import contextlib
import math
import os
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.imu import capture2go_codec as c2g
from drivers.imu import xbus, ximu3
from drivers.imu.can_port import DbcSensor
from drivers.stimulator import p24_port as sm4
from drivers.stimulator import rehastim2_port as sm2
from drivers.stimulator.p24_port import Point, Train
from drivers.stimulator.port import PulseTrain
from drivers.stimulator.sciencemode import Packet
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


# --- ScienceMode4 against the vendor's own Python package on random parameters ---


oracle: Any = pytest.importorskip("science_mode_4", reason="the science-mode-4 package is not installed")

numbers4 = st.integers(0, 63)
currents_ma = st.floats(0.5, 130.0)
widths_us = st.floats(1.0, 4095.0)
packets4 = st.builds(Packet, numbers4, st.integers(0, 1023), st.binary(max_size=30))
packets2 = st.builds(Packet, st.integers(0, 255), st.integers(0, 255), st.binary(max_size=30))


def oracle_points(points: tuple[Point, ...]) -> list[Any]:
    return [oracle.ChannelPoint(point.width_us, point.steps * 0.5) for point in points]


def oracle_bytes(packet: Any, number: int) -> bytes:
    packet.number = number
    return bytes(oracle.Protocol.packet_to_bytes(packet))


@given(numbers4, st.integers(0, 7), currents_ma, widths_us)
def test_low_level_pulses_are_the_vendors(number: int, channel: int, current_ma: float, width_us: float) -> None:
    points = sm4.biphasic(current_ma, width_us)
    theirs = oracle.PacketLowLevelChannelConfig()
    theirs.execute_stimulation = True
    theirs.channel = oracle.Channel(channel % 4)
    theirs.connector = oracle.Connector(channel // 4)
    theirs.points = oracle_points(points)
    assert sm4.encode(sm4.low_pulse(number, channel, points)) == oracle_bytes(theirs, number)


@given(
    numbers4,
    st.dictionaries(
        st.integers(0, 7),
        st.tuples(currents_ma, widths_us, st.integers(1, 16383), st.integers(0, 15)),
        max_size=8,
    ),
)
def test_mid_level_updates_are_the_vendors(number: int, wanted: dict[int, tuple[float, float, int, int]]) -> None:
    trains, configurations = {}, [None] * 8
    for channel, (current_ma, width_us, period_ms, ramp) in wanted.items():
        points = sm4.biphasic(current_ma, width_us)
        trains[channel] = Train(points, 2 * period_ms, ramp)
        configurations[channel] = oracle.MidLevelChannelConfiguration(True, ramp, period_ms, oracle_points(points))
    theirs = oracle.PacketMidLevelUpdate()
    theirs.channel_configuration = configurations
    assert sm4.encode(sm4.mid_update(number, trains)) == oracle_bytes(theirs, number)


@given(packets4)
def test_the_vendors_package_reads_our_packets(packet: Packet) -> None:
    frame = sm4.encode(packet)
    command, number, data = oracle.Protocol.extract_packet_data(frame)
    assert (number, command, bytes(data)) == (packet.number, packet.command, packet.data)


def test_small_messages_are_the_vendors() -> None:
    for theirs, ours in (
        (oracle.PacketLowLevelInit(), Packet(3, sm4.Code.LOW_INIT, b"\0")),
        (oracle.PacketMidLevelStop(), Packet(3, sm4.Code.MID_STOP)),
        (oracle.PacketMidLevelGetCurrentData(), sm4.mid_current_data(3)),
        (oracle.PacketGeneralGetStimStatus(), Packet(3, sm4.Code.STIM_STATUS)),
    ):
        assert sm4.encode(ours) == oracle_bytes(theirs, 3)


noise = st.binary(max_size=40)


@given(st.lists(st.tuples(noise, packets4), max_size=6), noise, st.integers(1, 50))
def test_sciencemode4_finds_its_packets_in_noise(parts: list[tuple[bytes, Packet]], tail: bytes, cut: int) -> None:
    """Noise without F0 costs nothing; whatever the noise, no packet comes out that was not put in."""
    stream = b"".join(before + sm4.encode(packet) for before, packet in parts) + tail
    clean = b"".join(before.replace(b"\xf0", b"") + sm4.encode(packet) for before, packet in parts)
    wanted = [packet for _, packet in parts]
    assert sm4.Decoder().feed(clean) == wanted
    decoder = sm4.Decoder()
    got = [p for at in range(0, len(stream), cut) for p in decoder.feed(stream[at : at + cut])]
    assert got == sm4.Decoder().feed(stream)
    assert all(packet in wanted for packet in got)


@given(st.lists(st.tuples(noise, packets2), max_size=6), st.integers(1, 50))
def test_sciencemode2_finds_its_packets_in_noise(parts: list[tuple[bytes, Packet]], cut: int) -> None:
    clean = b"".join(before.replace(b"\xf0", b"") + sm2.encode(packet) for before, packet in parts)
    decoder = sm2.Decoder()
    got = [p for at in range(0, len(clean), cut) for p in decoder.feed(clean[at : at + cut])]
    assert got == [packet for _, packet in parts]


@pytest.mark.requirement("SR-15")
@given(st.binary(max_size=3000))
@settings(max_examples=300)
def test_no_bytes_break_the_decoders(data: bytes) -> None:
    for decoder in (sm4.Decoder(), sm2.Decoder()):
        decoder.feed(data)
        assert len(decoder._buffer) <= decoder.max_length


@given(currents_ma, widths_us)
def test_every_pulse_is_balanced_and_no_more_than_asked_for(current_ma: float, width_us: float) -> None:
    points = sm4.biphasic(current_ma, width_us)
    assert sm4.net_charge(points) == 0
    assert all(abs(point.steps) * 0.5 <= current_ma for point in points)
    assert points[0].width_us == points[2].width_us <= width_us


@given(st.floats(1.0, 100.0), st.lists(st.integers(0, 60_000_000), min_size=1, max_size=300))
def test_a_train_is_never_faster_than_its_frequency(frequency_hz: float, steps_ns: list[int]) -> None:
    """However irregular the commands: in any window no more pulses than the frequency allows, and no doublets."""
    train, t_ns, pulses = PulseTrain(), 0, []
    for step_ns in steps_ns:
        t_ns += step_ns
        if train.due(t_ns, frequency_hz):
            pulses.append(t_ns)
    period_ns = int(1e9 / frequency_hz)
    assert all(b - a >= period_ns // 2 for a, b in pairwise(pulses))
    for first in range(len(pulses)):
        for last in range(first, len(pulses)):
            assert last - first <= (pulses[last] - pulses[first]) / period_ns + 1.0


@given(st.floats(5.0, 100.0), st.floats(20.0, 100.0), st.integers(0, 4_000_000))
@example(54.5, 72.0, 637_109)  # 0.89
@example(79.466, 98.789, 3_869_000)  # 0.83, the least of 40,000 drawn
def test_a_train_keeps_its_frequency_under_jitter(frequency_hz: float, rate_hz: float, jitter_ns: int) -> None:
    """Never too fast; and what commands half a period late cost, which are not made up for, is a fifth at most."""
    train, count, t_ns = PulseTrain(), 0, 0
    for step in range(400):
        t_ns = int(step * 1e9 / rate_hz) + (jitter_ns if step % 3 == 1 else 0)
        count += train.due(t_ns, frequency_hz)
    reached_hz = count / (t_ns * 1e-9)
    assert reached_hz <= frequency_hz * 1.02 + 0.3
    if frequency_hz <= 0.8 * rate_hz:
        assert reached_hz >= 0.8 * frequency_hz
