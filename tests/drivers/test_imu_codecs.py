"""Codecs of the inertial sensors: whole, byte by byte, with noise before and bytes after."""

from __future__ import annotations

import itertools
import math
import struct
from pathlib import Path

import pytest

from drivers.imu import xbus, ximu3
from drivers.imu.can_port import DbcSensor
from drivers.imu.port import LineCounts, LossCounter, StampClock, Unwrapper
from drivers.imu.xbus import Mid, Xdi
from fes.config.session import ImuDevice
from fes.signals import G_MPS2, RawSample

# counter 42581, time 5719854, then acceleration, rate and status as an MTi-300 sends them; laid out by hand
GOLDEN_DATA = bytes.fromhex(
    "102002a655 10600400 57472e 40200c bda21af8 be2a8e96 411d27a2 80200c bbb17d81 bb963200 3c01e841 e02004 00400003"
)
GOLDEN = bytes((0xFA, 0xFF, 0x36, len(GOLDEN_DATA))) + GOLDEN_DATA


def device(kind: str, **values: object) -> ImuDevice:
    base = {"sensor": "left_foot", "device": kind, "rate_hz": 100.0, "acc_range_g": 16.0, "gyr_range_dps": 2000.0}
    return ImuDevice.model_validate(base | values)


def golden() -> bytes:
    return GOLDEN + bytes((-sum(GOLDEN[1:]) % 256,))


def test_xbus_golden_measurement() -> None:
    (message,) = xbus.XbusDecoder().feed(golden())
    found = xbus.decode_measurement(message.data)
    assert (message.mid, found.counter, found.time_fine, found.status) == (Mid.MT_DATA2, 42581, 5719854, 0x00400003)
    assert found.acc_mps2 == pytest.approx((-0.07915300, -0.16655955, 9.82217598))
    assert found.gyr_radps == pytest.approx((-0.00541657, -0.00458360, 0.00792891), rel=1e-5)
    assert not found.clipped


def test_xbus_golden_commands() -> None:
    assert xbus.encode(Mid.GO_TO_CONFIG).hex() == "faff3000d1"
    assert xbus.encode(Mid.GO_TO_MEASUREMENT).hex() == "faff1000f1"
    assert xbus.encode(Mid.REQ_DID).hex() == "faff000001"
    assert xbus.output_configuration(400).hex() == "1020ffff1060ffffe020ffff4020019080200190"


def test_xbus_byte_by_byte_with_noise_around() -> None:
    decoder = xbus.XbusDecoder()
    stream = b"\x01\xfa\x02" + golden() + b"\xfa\xff" + golden() + b"\x00" + golden()
    found = [message for k in range(len(stream)) for message in decoder.feed(stream[k : k + 1])]
    assert [message.data for message in found] == [GOLDEN_DATA] * 3
    assert decoder.counts.bytes_skipped == 3 + 2 + 1


def test_xbus_wrong_checksum_costs_one_message() -> None:
    broken = bytearray(golden())
    broken[12] ^= 0x10
    decoder = xbus.XbusDecoder()
    assert len(decoder.feed(bytes(broken) + golden())) == 1
    assert decoder.counts.bad_frames >= 1


def test_xbus_extended_length() -> None:
    data = bytes(range(256)) + b"\x01"
    message = xbus.encode(Mid.MT_DATA2, data)
    assert message[3:6] == b"\xff\x01\x01"
    assert xbus.XbusDecoder().feed(message) == [xbus.XbusMessage(Mid.MT_DATA2, data)]


@pytest.mark.parametrize("number_format", [0, 1, 2, 3])
def test_xbus_number_formats(number_format: int) -> None:
    values = (-9.8125, 0.25, 1.5)
    data = xbus.block(Xdi.ACCELERATION | number_format, xbus.encode_reals(values, number_format))
    assert xbus.decode_measurement(data).acc_mps2 == values


def test_xbus_fp1632_sends_the_fraction_first() -> None:
    assert xbus.decode_reals("x", bytes.fromhex("80000000fffe"), 2, 1) == [-1.5]


def test_xbus_clipping_flag() -> None:
    for flag in (1 << 8, 1 << 13, 1 << 19):
        assert xbus.decode_measurement(xbus.block(Xdi.STATUS_WORD, struct.pack(">I", flag))).clipped


@pytest.mark.parametrize("data", [b"\x10", b"\x10\x20\x02\x00", b"\x10\x20\x01\x00", b"\x40\x20\x01\x00"])
def test_xbus_blocks_cut_off_are_rejected(data: bytes) -> None:
    with pytest.raises(xbus.XbusRejected):
        xbus.decode_measurement(data)


def test_ximu3_message_of_the_manual() -> None:
    """xioTechnologies/x-IMU3-User-Manual, Sections/communicationProtocol.tex: "Inertial message"."""
    golden = bytes.fromhex("c9 40420f0000000000" + "00" * 20 + "0000803f 0a")
    message = ximu3.Inertial(1_000_000, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert ximu3.Ximu3Decoder().feed(golden) == [message]
    assert ximu3.encode(message) == golden
    stuffed = ("4558414d504c45", "45dbdc414d504c45", "4558dbdd4d504c45", "4558414d50dbdddbdc")  # its "Byte stuffing"
    plain = ("4558414d504c45", "450a414d504c45", "4558db4d504c45", "4558414d50db0a")
    assert [ximu3.unescaped(bytes.fromhex(each)) for each in stuffed] == [bytes.fromhex(each) for each in plain]


def test_ximu3_escapes_and_noise() -> None:
    message = ximu3.Inertial(0x0ADB0A, (1.0, -2.0, 3.0), (0.0, 0.5, 1.0))
    raw = ximu3.encode(message)
    assert raw[:9].hex() == "c9dbdcdbdddbdc0000"
    decoder = ximu3.Ximu3Decoder()
    stream = b"noise\n" + raw + b'{"ping":null}\r\n' + raw[:-4] + b"\n" + raw
    assert [m for k in range(len(stream)) for m in decoder.feed(stream[k : k + 1])] == [message, message]
    assert (decoder.counts.bad_frames, decoder.counts.bytes_skipped) == (1, 6)


def test_stamps_run_over_but_restarts_stay_steps_back() -> None:
    clock = StampClock(32, 100_000)
    top = clock.time_ns(2**32 - 5)
    assert clock.time_ns(5) - top == 10 * 100_000
    assert clock.time_ns(2**32 - 2) - top == 3 * 100_000  # late, from before the turn
    other = StampClock(32, 100_000)
    assert other.time_ns(1_000_000) > other.time_ns(3)
    counter = Unwrapper(8)
    assert [counter.unwrap(raw) for raw in (254, 255, 1, 0)] == [254, 255, 257, 256]


def test_losses_by_counter_and_by_stamp() -> None:
    counts = LineCounts()
    losses = LossCounter(counts, 100.0, 16)
    for stamp_ms, counter in ((0, 65534), (10, 65535), (40, 2), (40, 2), (30, 1)):
        losses.note(stamp_ms * 1_000_000, counter)
    assert (counts.missing, counts.doubled, counts.backward) == (2, 1, 1)
    bare = LineCounts()
    losses = LossCounter(bare, 100.0)
    for stamp_ms in (0, 10, 41, 50):
        losses.note(stamp_ms * 1_000_000)
    assert bare.missing == 2


def xsens(part: DbcSensor, k: int, *, without: int = -1) -> list[RawSample]:
    frames = [
        (0x05, struct.pack(">I", 100 * k)),
        (0x32, struct.pack(">3h", 512, -1024, k)),
        (0x34, struct.pack(">3h", 256 * k, 0, 2560)),
    ]
    found = [part.receive(7, number, data) for number, data in frames if number != without]
    return [sample for sample in found if sample is not None]


def test_xsens_can_pairs_frames_of_one_sample_and_never_mixes() -> None:
    part = DbcSensor(device("xsens_can"))
    (sample,) = xsens(part, 1)
    assert sample.acc_mps2 == (1.0, 0.0, 10.0)
    assert sample.gyr_radps == (1.0, -2.0, 1 / 512)
    assert (sample.t_host_ns, sample.t_device_ns) == (7, 10_000_000)
    for lost in (0x05, 0x32, 0x34):
        assert xsens(part, 2, without=lost) == []
        (after,) = xsens(part, 3)
        assert after.acc_mps2[0] == 3.0
        assert after.gyr_radps[2] == 3 / 512
    assert part.counts.bad_frames >= 3
    assert part.receive(7, 0x34, b"\x00") is None


DBC = """VERSION ""
BU_: A
BO_ 256 M: 8 A
 SG_ Ax : 0|8@1- (0.1,0) [0|0] "" A
 SG_ Ay : 8|8@1- (0.1,0) [0|0] "" A
 SG_ Az : 16|8@1- (0.1,0) [0|0] "" A
 SG_ Gx : 24|8@1- (10,0) [0|0] "" A
 SG_ Gy : 32|8@1- (10,0) [0|0] "" A
 SG_ Gz : 40|8@1- (10,0) [0|0] "" A
 SG_ N : 48|8@1+ (1,0) [0|0] "" A
"""
NAMES = {"acc_x": "M.Ax", "acc_y": "M.Ay", "acc_z": "M.Az", "gyr_x": "M.Gx", "gyr_y": "M.Gy", "gyr_z": "M.Gz"}


def test_a_dbc_without_time_counts(tmp_path: Path) -> None:
    path = tmp_path / "imu.dbc"
    path.write_text(DBC, encoding="ascii")
    options = NAMES | {"dbc": str(path), "counter": "M.N", "acc_unit": "g", "gyr_unit": "deg/s", "id_offset": 1}
    part = DbcSensor(device("dbc_can", options=options))
    stamps = []
    for number in (254, 255, 2):
        sample = part.receive(0, 257, struct.pack("<6bBx", 10, 0, -10, 9, 0, 0, number))
        assert sample is not None
        stamps.append(sample.t_device_ns)
    assert sample.acc_mps2 == pytest.approx((G_MPS2, 0.0, -G_MPS2))
    assert sample.gyr_radps[0] == pytest.approx(math.radians(90.0))
    assert [b - a for a, b in itertools.pairwise(stamps)] == [10_000_000, 30_000_000]
    assert part.counts.missing == 2
