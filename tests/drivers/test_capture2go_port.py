"""Capture2Go's port against its simulated sensor, both without a line, on a clock that the test turns."""

from __future__ import annotations

import itertools
import math
import os
import random
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.imu import capture2go_codec as c2g
from drivers.imu.capture2go_codec import LAYOUTS, Capture2GoDecoder, Header, NotificationDecoder, Package
from drivers.imu.capture2go_port import Capture2GoPort
from drivers.imu.port import ImuLost
from drivers.simulated.imu.device import ImuSignal, SimulatedImu
from drivers.simulated.imu.serial_wires import Air, Capture2GoWire, package
from drivers.simulated.lines import LineFaults
from fes.config.session import ImuDevice
from fes.control.clock_sync import SensorClock
from fes.live.source import SensorStream
from fes.signals import NS_PER_S, RawSample, SystemFault

MS = 1_000_000
START_NS = 5_000 * NS_PER_S
STILL = ImuSignal(100.0, np.tile([0.0, 0.0, 9.81], (1000, 1)), np.tile([1.0, 0.0, -35.0], (1000, 1)))


class Clock:
    """Turned by the test, and by whoever waits."""

    def __init__(self) -> None:
        self.now_ns = START_NS

    def __call__(self) -> int:
        return self.now_ns


class Sensor:
    """A simulated sensor and what its line does to its packages; ``told`` are the commands that reached it."""

    def __init__(self, clock: Clock, air: Air | None = None, offset_s: float = 7.0, drift_ppm: float = 0.0) -> None:
        wire = Capture2GoWire(100.0, air, "1234ab")
        self.imu = SimulatedImu(wire, STILL, clock.now_ns, offset_s=offset_s, drift_ppm=drift_ppm)
        self.line, self.clock, self.told = LineFaults(), clock, list[Header]()
        self.answers: Callable[[bytes], list[bytes]] | None = None

    def hear(self, data: bytes) -> None:
        self.told += [Header(each.header) for each in c2g.Capture2GoDecoder().feed(data)]
        now_ns = self.clock.now_ns
        self.line.send(now_ns, self.imu.receive(now_ns, data) if self.answers is None else self.answers(data))

    def say(self) -> bytes:
        self.line.send(self.clock.now_ns, self.imu.advance(self.clock.now_ns))
        return self.line.due(self.clock.now_ns)


class MemoryPort(Capture2GoPort):
    """A port whose line is a call."""

    def __init__(self, sensor: Sensor, name: str = "right_foot", **options: object) -> None:
        self._sensor = sensor
        values = {"device": "capture2go", "port": "x", "rate_hz": 100.0, "acc_range_g": 16.0, "gyr_range_dps": 2000.0}
        super().__init__(ImuDevice.model_validate(values | {"sensor": name, "options": options}), sensor.clock)

    def _open(self) -> None:
        self._decoder = c2g.Capture2GoDecoder(self._counts)
        self._begin()

    def _send(self, package: bytes) -> None:
        self._sensor.hear(package)

    def _receive(self) -> list[Package]:
        return self._decoder.feed(self._sensor.say())

    def _wait(self, seconds: float) -> None:
        self._sensor.clock.now_ns += min(round(seconds * NS_PER_S), 2 * MS)

    @property
    def _name(self) -> str:
        return "the sensor"

    def fileno(self) -> None:
        return None

    def close(self) -> None:
        self._end()


def listen(port: MemoryPort, seconds: float) -> list[RawSample]:
    found = []
    for _ in range(round(seconds * 1000)):
        port._sensor.clock.now_ns += MS
        found += port.read(port._sensor.clock.now_ns)
    return found


def test_it_is_asked_who_it_is_set_and_started_and_its_stamps_are_on_the_hosts_clock() -> None:
    sensor = Sensor(Clock())
    assert sensor.say() == b""  # nobody has asked
    port = MemoryPort(sensor)
    assert port.serials == {"right_foot": "1234ab"}
    assert sensor.told == [
        Header.CMD_GET_DEVICE_INFO, Header.CMD_GET_STATUS, Header.CMD_SET_ABSOLUTE_TIME,
        Header.CMD_SET_MEASUREMENT_MODE, Header.CMD_START_STREAMING,
    ]  # fmt: skip
    found = listen(port, 2.5)
    assert len(found) == pytest.approx(250, abs=1)
    assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)} == {10 * MS}
    assert all(0 <= sample.t_host_ns - sample.t_device_ns <= 2 * MS for sample in found)
    assert found[0].acc_mps2 == pytest.approx((0.0, 0.0, 9.81), abs=0.003)
    assert found[0].gyr_radps == pytest.approx((1.0, 0.0, -math.radians(2000.0)), abs=0.002)  # its range ends there
    assert port.notices == []
    port.close()
    assert listen(port, 0.5) == []


def test_one_that_streams_already_begins_anew_and_one_that_records_is_left_alone() -> None:
    sensor = Sensor(Clock())
    first = MemoryPort(sensor)
    listen(first, 0.2)
    again = MemoryPort(sensor)  # the first has gone without a word
    assert Header.CMD_STOP_STREAMING_AND_CLEAR_BUFFER in sensor.told
    assert len(listen(again, 0.5)) == pytest.approx(50, abs=1)
    status = c2g.pack(Header.DATA_STATUS, {"sensorState": 3})
    sensor.answers = lambda data: [c2g.pack(Header.DATA_DEVICE_INFO), status]
    sensor.told.clear()
    with pytest.raises(ImuLost, match="records"):
        MemoryPort(sensor)
    assert not {0x0156, Header.CMD_SET_MEASUREMENT_MODE} & set(sensor.told)  # the first: stop recording


def test_a_refusal_and_silence_are_named() -> None:
    sensor = Sensor(Clock())
    sensor.answers = lambda data: [package(0xFFFF, b"\xfb\x70\x00")]
    with pytest.raises(ImuLost, match=r"refuses CMD_GET_DEVICE_INFO: wrong state \(0xfb\)"):
        MemoryPort(sensor)
    sensor.line.set("mute", 1)
    with pytest.raises(ImuLost, match="no Capture2Go answers to CMD_GET_DEVICE_INFO"):
        MemoryPort(sensor)


def test_another_mode_than_asked_for_is_no_mode() -> None:
    sensor = Sensor(Clock())

    def answers(data: bytes) -> list[bytes]:
        (asked,) = c2g.Capture2GoDecoder().feed(data)
        if asked.header == Header.CMD_SET_MEASUREMENT_MODE:
            return [c2g.pack(Header.DATA_MEASUREMENT_MODE, {"fullFixedMode": 3, "disableMagData": True})]
        return sensor.imu.receive(sensor.clock.now_ns, data)

    sensor.answers = answers
    with pytest.raises(ImuLost, match="does not take fullFixedMode, statusMode as asked for"):
        MemoryPort(sensor)


def test_its_flags_are_counted_told_and_acted_on() -> None:
    sensor = Sensor(Clock())
    port = MemoryPort(sensor)
    listen(port, 0.1)
    sensor.imu.set_fault(sensor.clock.now_ns, "unsound", 3)
    found = listen(port, 0.5)
    lost = [sample for sample in found if math.isnan(sample.acc_mps2[0]) and math.isnan(sample.gyr_radps[2])]
    counts = port.counts["right_foot"]
    assert len(lost) == counts.unsound == counts.bad_values == 3
    assert [notice.partition(": ")[2][:27] for notice in port.notices] == ["its flags tell that its pro"]
    sensor.imu.set_fault(sensor.clock.now_ns, "jump", 0.5)
    sensor.imu.set_fault(sensor.clock.now_ns, "clip", 0.03)
    found = listen(port, 0.5)
    assert (counts.time_gaps, counts.missing) == (1, 50)
    assert counts.clipped == pytest.approx(50, abs=1)
    assert any("gaps in its stamps" in notice for notice in port.notices)


def test_what_its_buffer_held_back_comes_whole_in_order_and_old() -> None:
    sensor = Sensor(Clock())
    port = MemoryPort(sensor)
    listen(port, 0.5)
    sensor.line.set("backlog", 1)
    assert listen(port, 0.6) == []
    sensor.line.set("backlog", 0)
    found = listen(port, 0.2)
    assert len(found) == pytest.approx(80, abs=1)
    assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)} == {10 * MS}
    assert max(sample.t_host_ns - sample.t_device_ns for sample in found) == pytest.approx(600 * MS, abs=12 * MS)
    counts = port.counts["right_foot"]
    assert (counts.missing, counts.doubled, counts.backward, counts.bad_frames) == (0, 0, 0, 0)


def test_after_a_loss_of_power_it_is_silent_until_it_is_opened_again() -> None:
    sensor = Sensor(Clock())
    port = MemoryPort(sensor)
    listen(port, 0.5)
    sensor.imu.set_fault(sensor.clock.now_ns, "reboot", 1)
    assert listen(port, 2.0) == []
    port.reopen()
    found = listen(port, 0.5)
    assert len(found) == pytest.approx(50, abs=1)
    assert all(0 <= sample.t_host_ns - sample.t_device_ns <= 2 * MS for sample in found)


def test_a_session_hears_what_it_says_while_its_line_is_there() -> None:
    sensor = Sensor(Clock())
    port = MemoryPort(sensor)
    stream = SensorStream(port, SensorClock, ImuLost, frozenset({"right_foot"}))
    sensor.imu.set_fault(sensor.clock.now_ns, "unsound", 1)
    listen(port, 0.1)
    assert list(stream.notices) == port.notices != []
    sensor.hear(c2g.pack(Header.CMD_STOP_STREAMING) + c2g.pack(Header.CMD_GET_STATUS))
    sensor.clock.now_ns += 10 * MS
    assert any(isinstance(event, SystemFault) for event in stream.read(sensor.clock.now_ns))
    assert list(stream.notices) == []


def test_one_that_says_that_it_has_stopped_is_lost() -> None:
    sensor = Sensor(Clock())
    port = MemoryPort(sensor)
    sensor.hear(c2g.pack(Header.CMD_STOP_STREAMING) + c2g.pack(Header.CMD_GET_STATUS))  # somebody else did
    with pytest.raises(ImuLost, match="stopped streaming by itself"):
        listen(port, 0.1)


def test_two_have_one_clock_until_one_loses_it() -> None:
    clock, air = Clock(), Air()
    first = MemoryPort(Sensor(clock, air), "left_foot", sync="sender", sync_id=9)
    second = MemoryPort(Sensor(clock, air, offset_s=900.0), "right_foot", sync="receiver", sync_id=9)
    assert Header.CMD_SET_ABSOLUTE_TIME not in second._sensor.told

    def apart_ns() -> int:
        """Between the two sensors' stamps of what was taken at the same moment."""
        found: dict[str, RawSample] = {}
        for _ in range(1500):
            clock.now_ns += MS
            for port in (first, second):
                found |= {sample.sensor: sample for sample in port.read(clock.now_ns)}
        return abs(found["left_foot"].t_device_ns - found["right_foot"].t_device_ns)

    assert apart_ns() <= 10 * MS
    assert first.notices == second.notices == []
    second._sensor.imu.set_fault(clock.now_ns, "deaf", 1)
    second._sensor.imu.set_fault(clock.now_ns, "drift", 20_000.0)  # as no crystal: 20 ms a second
    apart_ns()
    assert apart_ns() > 40 * MS
    assert second.notices == ["right_foot: hears no clock of its sender; its stamps drift from the others'"]
    stranger = MemoryPort(Sensor(clock, air), "left_shank", sync="receiver", sync_id=10)
    listen(stranger, 0.2)
    assert len(stranger.notices) == 1


def test_a_battery_that_is_nearly_empty_is_told() -> None:
    sensor = Sensor(Clock())
    port = MemoryPort(sensor)
    for battery, told in ((14, 1), (15, 0), (0x80 | 3, 0)):
        status = {"sensorState": 2, "battery": battery, "synchronized": True}
        sensor.line.send(sensor.clock.now_ns, [c2g.pack(Header.DATA_STATUS, status)])
        port.read(sensor.clock.now_ns)
        assert len(port.notices) == told


@pytest.mark.parametrize(
    ("change", "options", "said"),
    [
        ({"rate_hz": 400.0}, {}, "400: a Capture2Go has 200, 100, 50, 25"),
        ({"acc_range_g": 32.0}, {}, "no more than acc_range_g = 16"),
        ({"gyr_range_dps": 4000.0}, {}, "gyr_range_dps = 2000"),
        ({}, {"sync": "maybe"}, "options.sync = 'maybe'"),
        ({}, {"sync": "sender"}, "need each other"),
        ({}, {"sync_id": 4}, "need each other"),
        ({}, {"sync": "receiver", "sync_id": -1}, "sync_id"),
    ],
)
def test_what_it_has_not_is_refused_before_it_is_opened(
    change: dict[str, float], options: dict[str, object], said: str
) -> None:
    from drivers.imu.open import open_imus

    values = {"device": "capture2go", "port": "/dev/nothing", "rate_hz": 100.0, "acc_range_g": 16.0}
    values |= {"gyr_range_dps": 2000.0, "sensor": "left_foot", "options": options}
    with pytest.raises(ValueError, match=said):
        open_imus([ImuDevice.model_validate(values | change)])


# --- Capture2Go's codec held byte for byte against the makers' own package, where that is installed ---


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
