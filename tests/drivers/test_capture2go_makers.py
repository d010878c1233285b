"""Capture2Go's codec held byte for byte against the makers' own package, where that is installed."""

from __future__ import annotations

import math
import os
import random
import struct
from typing import Any

import pytest

from drivers.imu import capture2go_codec as c2g
from drivers.imu.capture2go_codec import LAYOUTS, Capture2GoDecoder, Header, NotificationDecoder, Package

pkg: Any = pytest.importorskip("capture2go.pkg", reason="the makers' package is not installed: pip install capture2go")
parsing: Any = pytest.importorskip("capture2go.parsing")
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


def test_both_know_the_same_packages_with_the_same_fields() -> None:
    names = {int(header): header.name for header in pkg.packages}
    for header in Header:
        assert [name for name, _ in LAYOUTS[header].fields] == [name for name, *_ in kinds(pkg.packages[header])]
        assert header.name == names[header]
    assert set(c2g.ERRORS) == {int(code) for code in pkg.ErrorCode}
    assert math.isclose(c2g.GYR_RADPS, pkg.GYR_SCALE_FACTOR, rel_tol=1e-15)
    assert math.isclose(c2g.ACC_MPS2, pkg.ACC_SCALE_FACTOR, rel_tol=1e-15)


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
