"""Capture2Go's codec: bytes as the makers' package makes them, byte by byte, with noise before and bytes after."""

from __future__ import annotations

import math
import struct

import pytest

from drivers.imu import capture2go_codec as c2g
from drivers.imu.capture2go_codec import Capture2GoDecoder, Flags, Header, NotificationDecoder, Package

T_NS = 1_700_000_000_123_456_789
# packed by the makers' package (capture2go 1.0.1) from the values that the tests below name
INFO = "024c2d0cef2f71000100313233346162322e3100000000003700000000000000312e302e3300000000000000323032362d30342d303200"
SAMPLE = "025d31b4e31f520215cd853dfe9c97170040ffff0200000000f82908f0debc9a78563412fdff11"
STATUS = "02b7b522d613010200f2052a0100000002030100feff030001dd4d"
REFUSAL = "0293c76ea603fffffb5001"
SYNC_ID = 0x0123456789ABCDEF
MODE = {"fullFixedMode": 2, "statusMode": 1, "syncMode": 1, "syncId": SYNC_ID, "disableMagData": True}


@pytest.mark.parametrize(
    ("header", "fields", "wanted"),
    [
        (Header.CMD_GET_DEVICE_INFO, {}, "02096be66e007000"),
        (Header.CMD_SET_ABSOLUTE_TIME, {"newTimestamp": T_NS}, "02ef7886a308700115cd853dfe9c9717"),
        (
            Header.CMD_SET_MEASUREMENT_MODE,
            MODE,
            "020e0701b71e200100000000000000000002000000000100000001efcdab8967452301000001",
        ),
        (Header.CMD_START_STREAMING, {}, "023d7f658c005001"),
        (Header.CMD_STOP_STREAMING, {}, "02bf1d53be005201"),
        (Header.CMD_STOP_STREAMING_AND_CLEAR_BUFFER, {}, "0235f5bc44005801"),
    ],
)
def test_golden_commands(header: Header, fields: dict[str, c2g.Value], wanted: str) -> None:
    assert c2g.pack(header, fields).hex() == wanted


def test_golden_answers() -> None:
    info, status, refusal = Capture2GoDecoder().feed(bytes.fromhex(INFO + STATUS + REFUSAL))
    told = c2g.unpack(info)
    assert (told["protocolVersion"], told["serial"], told["firmwareDate"]) == (1, b"1234ab", b"2026-04-02")
    assert (told["hardwareRevision"], told["firmwareRevision"], told["firmwareVersion"]) == (b"2.1", b"7", b"1.0.3")
    told = c2g.unpack(status)
    assert (told["timestamp"], told["sensorState"], told["gyrBias"]) == (5_000_000_000, 2, (1, -2, 3))
    assert (told["synchronized"], told["battery"]) == (True, c2g.CHARGING | 93)
    assert c2g.unpack(refusal) == {"errorCode": 0xFB, "command": Header.CMD_START_STREAMING}


def test_a_sample_in_si_with_its_flags() -> None:
    (package,) = Capture2GoDecoder().feed(bytes.fromhex(SAMPLE))
    assert (package.header, c2g.nominal_rate_hz(package.header)) == (Header.DATA_FULL_6D_FIXED_100HZ, 100)
    (sample,) = c2g.samples(package)
    assert sample.t_ns == T_NS
    assert sample.gyr_radps == pytest.approx((math.radians(1000.0), -1.0652644e-3, 2.1305289e-3), rel=1e-7)
    assert sample.acc_mps2 == pytest.approx((0.0, -9.81, 9.81 * 2089 / 2048))
    assert sample.flags == Flags.TIME_GAP | Flags.PROCESSING_ISSUE


def test_eight_samples_of_a_packed_one_follow_from_its_first_stamp() -> None:
    gyr, acc = tuple(range(24)), tuple(range(100, 124))
    fields: dict[str, c2g.Value] = {"timestamp": 7, "gyr": gyr, "acc": acc, "errorFlags": 4}
    (package,) = Capture2GoDecoder().feed(c2g.pack(Header.DATA_FULL_PACKED_200HZ, fields))
    found = c2g.samples(package)
    assert [sample.t_ns for sample in found] == [7 + 5_000_000 * k for k in range(8)]
    assert [round(sample.gyr_radps[1] / c2g.GYR_RADPS) for sample in found] == list(range(1, 24, 3))
    assert [round(sample.acc_mps2[2] / c2g.ACC_MPS2) for sample in found] == list(range(102, 125, 3))
    assert {sample.flags for sample in found} == {Flags.ACC_CLIPPING}


def test_floats_are_in_si_already_and_a_status_is_no_sample() -> None:
    fields: dict[str, c2g.Value] = {"timestamp": -1, "gyr": (0.5, 0.0, -2.0), "acc": (0.0, 0.25, 9.75)}
    (package,) = Capture2GoDecoder().feed(c2g.pack(Header.DATA_FULL_FLOAT_200HZ, fields))
    (sample,) = c2g.samples(package)
    assert (sample.t_ns, sample.gyr_radps, sample.acc_mps2) == (-1, (0.5, 0.0, -2.0), (0.0, 0.25, 9.75))
    (package,) = Capture2GoDecoder().feed(c2g.pack(Header.DATA_STATUS))
    assert c2g.samples(package) == []


def test_byte_by_byte_with_noise_around() -> None:
    good = bytes.fromhex(SAMPLE)
    stream = b"\x01\x02\x55" + good + b"\x02" * 9 + good + b"\x00" + good
    decoder = Capture2GoDecoder()
    found = [package for k in range(len(stream)) for package in decoder.feed(stream[k : k + 1])]
    assert found == Capture2GoDecoder().feed(good) * 3
    assert decoder.counts.bytes_skipped == 3 + 9 + 1


def test_a_wrong_checksum_costs_one_package() -> None:
    good, broken = bytes.fromhex(SAMPLE), bytearray.fromhex(SAMPLE)
    broken[20] ^= 0x10
    decoder = Capture2GoDecoder()
    assert len(decoder.feed(good + bytes(broken) + good)) == 2
    assert decoder.counts.bad_frames >= 1


@pytest.mark.parametrize(
    "package",
    [Package(0x00A0), Package(0x1000, b"ab"), Package(Header.CMD_GET_STATUS, b"a"), Package(Header.DATA_STATUS)],
)
def test_what_is_not_in_the_protocol_is_rejected(package: Package) -> None:
    for reader in (c2g.unpack, c2g.samples):
        with pytest.raises(c2g.Capture2GoRejected, match=r"protocol|instead of"):
            reader(package)


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="no field rate"):
        c2g.pack(Header.CMD_START_STREAMING, {"rate": 1})
    with pytest.raises(struct.error):
        c2g.pack(Header.ERROR, {"errorCode": 256})
    with pytest.raises(ValueError, match="237 bytes"):
        c2g.encode(1, bytes(237))


def test_a_notification_has_real_time_packages_first_and_the_send_buffer_goes_on() -> None:
    live, stored = bytes.fromhex(SAMPLE), bytes.fromhex(INFO)
    decoder = NotificationDecoder()
    assert decoder.feed(b"\xff" + stored[:20]) == []
    assert [p.header for p in decoder.feed(b"\xfd" + live + live + stored[20:30])] == [0x0252, 0x0252]
    assert [p.header for p in decoder.feed(b"\xfe" + live + stored[30:] + stored)] == [0x0252, 0x0071, 0x0071]
    assert (decoder.counts.bad_frames, decoder.feed(b"")) == (0, [])


@pytest.mark.parametrize("count", [0xFE, 0xFD, 0xFB, 0x00])
def test_a_notification_that_is_not_what_it_says_is_passed_over(count: int) -> None:
    live = bytes.fromhex(SAMPLE)
    decoder = NotificationDecoder()
    whole = live if count == 0xFD else b"" if count == 0xFE else live * 4
    assert decoder.feed(bytes((count,)) + whole + live[:-1]) == []
    assert decoder.counts.bad_frames == 1
    assert len(decoder.feed(b"\xfe" + live)) == 1
