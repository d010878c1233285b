"""Capture2Go's codec: bytes as the makers' package makes them, byte by byte, with noise before and bytes after."""

from __future__ import annotations

import contextlib
import math
import os
import random
import struct
from importlib import import_module
from typing import Any

import pytest

from drivers.imu import capture2go_codec as c2g
from drivers.imu.capture2go_codec import LAYOUTS, Capture2GoDecoder, Flags, Header, NotificationDecoder, Package

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


# --- held byte for byte against the makers' own package, where that is installed ---


pkg: Any = None
parsing: Any = None
with contextlib.suppress(ImportError):
    pkg, parsing = import_module("capture2go.pkg"), import_module("capture2go.parsing")
needs_makers = pytest.mark.skipif(pkg is None, reason="the makers' package is not installed: pip install capture2go")
COUNT = 1_000_000 if os.environ.get("FES_EXAMPLES") == "nightly" else 20_000
TEXT = "s"


def random_value(chance: random.Random, kind: str, count: int) -> c2g.Value:
    """For a field of this C type: a whole number or real anywhere in its range, or text that ends with a zero."""
    if kind == TEXT:
        return bytes(chance.randrange(1, 256) for _ in range(chance.randrange(count + 1)))
    if kind == "f":
        return struct.unpack("<f", struct.pack("<f", chance.uniform(-1e4, 1e4)))[0]
    bits = 8 * struct.calcsize(f"<{kind}")
    number = chance.choice((0, -1, chance.getrandbits(bits), 1 << bits - 1)) % (1 << bits)
    if kind == "?":
        return bool(number & 1)
    return number - (1 << bits) if kind.islower() and number >> bits - 1 else number


def kinds(theirs: Any) -> list[tuple[str, str, int]]:
    """Name, type and number of values of each field of a package, as the makers' class has them."""
    found = []
    for name, declared in theirs._fields_:
        of_one = getattr(declared, "_type_", "")
        if isinstance(of_one, str):
            found.append((name, of_one.replace("l", "q").replace("L", "Q"), 0))
        else:
            text = of_one._type_ == "c"
            kind = TEXT if text else of_one._type_.replace("l", "q").replace("L", "Q")
            found.append((name, kind, declared._length_))
    return found


def made(chance: random.Random, header: Header, known: list[tuple[str, str, int]]) -> tuple[dict[str, c2g.Value], Any]:
    """Random fields, and the makers' package with them."""
    theirs, fields = pkg.packages[header](), {}
    for name, kind, count in known:
        if count and kind != TEXT:
            values = tuple(random_value(chance, kind, 0) for _ in range(count))
            getattr(theirs, name)[:] = values
            fields[name] = values
        else:
            fields[name] = random_value(chance, kind, count)
            setattr(theirs, name, fields[name])
    return fields, theirs


def plain(value: Any) -> Any:
    return tuple(value) if hasattr(value, "_length_") else value


@needs_makers
def test_both_know_the_same_packages_with_the_same_fields() -> None:
    names = {int(header): header.name for header in pkg.packages}
    for header in Header:
        assert [name for name, _ in LAYOUTS[header].fields] == [name for name, *_ in kinds(pkg.packages[header])]
        assert header.name == names[header]
    assert set(c2g.ERRORS) == {int(code) for code in pkg.ErrorCode}
    assert math.isclose(c2g.GYR_RADPS, pkg.GYR_SCALE_FACTOR, rel_tol=1e-15)
    assert math.isclose(c2g.ACC_MPS2, pkg.ACC_SCALE_FACTOR, rel_tol=1e-15)


@needs_makers
def test_random_packages_are_the_same_bytes_both_ways(capsys: pytest.CaptureFixture[str]) -> None:
    """Ours packs what theirs packs, and each reads what the other wrote."""
    chance = random.Random(40)
    headers = sorted(Header)
    known = {header: kinds(pkg.packages[header]) for header in headers}
    ours, unpacker = Capture2GoDecoder(), parsing.Unpacker()
    measured = held = 0
    for number in range(COUNT):
        header = headers[number % len(headers)]
        fields, theirs = made(chance, header, known[header])
        sent = theirs.pack()
        assert c2g.pack(header, fields) == sent
        unpacker.feed(sent)
        (package,) = ours.feed(sent)
        heard = next(unpacker)
        mine = c2g.unpack(package)
        assert (package.header, set(mine)) == (heard.header, set(fields))
        for name, value in mine.items():
            assert value == plain(getattr(heard, name)) == fields[name], (header, name)
        held += len(sent)
        found = c2g.samples(package)
        if found and (number // len(headers)) % 8 == 0:  # their reading into arrays is slow
            measured += same_samples(found, heard.parse())
    with capsys.disabled():
        print(
            f"\nCapture2Go: {COUNT} random packages of {len(headers)} kinds, {held} bytes the same; {measured} samples"
        )
    assert (ours.counts.bad_frames, ours.counts.bytes_skipped) == (0, 0)
    assert measured > COUNT // 100


def same_samples(found: list[c2g.Sample], parsed: dict[str, Any]) -> int:
    count = len(found)
    stamps = parsed["timestamp"].ravel().tolist() if count > 1 else [parsed["timestamp"]]
    for k, (sample, t_ns) in enumerate(zip(found, stamps, strict=True)):
        assert abs(sample.t_ns) >= 2**62 or sample.t_ns == t_ns  # at the end of its range theirs turns over
        for mine, name in ((sample.gyr_radps, "gyr"), (sample.acc_mps2, "acc")):
            theirs = parsed[name].reshape(count, 3)[k].tolist()
            assert all(math.isclose(a, b, rel_tol=1e-15, abs_tol=0.0) for a, b in zip(mine, theirs, strict=True))
    return count


@needs_makers
def test_a_stream_with_noise_before_it_is_read_alike_however_it_is_cut() -> None:
    chance = random.Random(41)
    headers = sorted(Header)
    stream = chance.randbytes(40).replace(b"\x02", b"\x03")
    for header in chance.choices(headers, k=2000):
        stream += made(chance, header, kinds(pkg.packages[header]))[1].pack()
    ours, unpacker = Capture2GoDecoder(), parsing.Unpacker(ignoreInitialGarbage=True)
    found: list[Package] = []
    heard: list[tuple[int, bytes]] = []
    while stream:
        cut = chance.randrange(1, 300)
        found += ours.feed(stream[:cut])
        unpacker.feed(stream[:cut])
        heard += [(package.header, bytes(package)) for package in unpacker]
        stream = stream[cut:]
    assert [(package.header, package.payload) for package in found] == heard
    assert len(found) > 1900
    assert ours.counts.bytes_skipped == 40


@needs_makers
def test_notifications_are_read_alike() -> None:
    chance = random.Random(42)
    headers = sorted(Header)
    live = [header for header in headers if header.name.endswith("_RT")]
    ours, unpacker, buffer = NotificationDecoder(), parsing.Unpacker(), b""
    for _ in range(3000):
        count = chance.randrange(4)
        head = b"".join(
            made(chance, header, kinds(pkg.packages[header]))[1].pack() for header in chance.choices(live, k=count)
        )
        while len(buffer) < 244:
            header = chance.choice(headers)
            buffer += made(chance, header, kinds(pkg.packages[header]))[1].pack()
        room = chance.randrange(1, 244 - len(head))
        sent, buffer = bytes((0xFF - count,)) + head + buffer[:room], buffer[room:]
        found = [(package.header, package.payload) for package in ours.feed(sent)]
        unpacker.feed(unpacker.extractRtPackages(sent))
        assert found == [(package.header, bytes(package)) for package in unpacker]
    assert (ours.counts.bad_frames, ours.counts.bytes_skipped) == (0, 0)
