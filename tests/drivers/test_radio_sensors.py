"""Sensors by radio: the ports in process and on a stand-in for bleak, whose notifications a simulated radio sends."""

from __future__ import annotations

import asyncio
import itertools
import math
import struct
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from drivers.imu import capture2go_codec as c2g
from drivers.imu import capture2go_port as ble
from drivers.imu import movella_dot as dot
from drivers.imu.movella_dot import MovellaDotImu
from drivers.imu.open import open_imus
from drivers.imu.port import ImuLost, ImuPort
from drivers.simulated.imu.device import ImuSignal, Radio, SimulatedImu
from drivers.simulated.imu.serial_wires import INFO, Capture2GoWire, MovellaDotWire
from drivers.simulated.stimulator.in_process import DeviceLine
from fes.config import ImuDevice
from fes.control.clock_sync import SensorClock
from fes.live.source import SensorStream
from fes.signals import NS_PER_S, ImuSample, RawSample

MS = 1_000_000
FOOT = "right_foot"
START_NS = 1000 * NS_PER_S
COUNTED = ImuSignal(60.0, np.tile([0.0, 0.0, 9.81], (6000, 1)), np.linspace([0.0] * 3, [30.0, 0.0, 0.0], 6000))


def device(port: str = "/in process", rate_hz: float = 60.0, **options: object) -> ImuDevice:
    values = {"sensor": FOOT, "device": "movella_dot", "port": port, "rate_hz": rate_hz, "options": options}
    return ImuDevice.model_validate(values | {"acc_range_g": 16.0, "gyr_range_dps": 2000.0})


def test_values_are_those_of_the_specification() -> None:
    assert dot.uuid(dot.MEDIUM_PAYLOAD) == "15172003-4947-11e9-8646-d663bd873d93"
    assert (dot.START.hex(), dot.STOP.hex()) == ("010115", "010015")
    assert (dot.is_measuring(b"\1\1\5"), dot.is_measuring(b"\1\0\x15")) == (True, False)
    assert dot.output_rate(60).hex() == "10" + "00" * 23 + "3c00" + "00" * 6
    assert dot.set_rate_hz(bytes(24) + b"\x1e\0" + bytes(6)) == 30
    assert dot.identity(INFO) == ("A0B0C0D", "2.6.1")
    payload = "40420f00 00000000 000080bf c3f51c41 00003443 000000c2 00000000" + "00" * 12  # laid out by hand
    force = (0.0, -1.0, struct.unpack("<f", b"\xc3\xf5\x1c\x41")[0])
    expected = 1_000_000, force, (math.pi, -math.radians(32), 0.0)
    for length in (28, 40):
        assert dot.sample(bytes.fromhex(payload)[:length]) == expected
    for value in (bytes(27), b""):
        with pytest.raises(struct.error):
            dot.sample(value)


# --- in process ---------------------------------------------------------------------------------------------


class Bench:
    """A simulated sensor behind a radio; ``offset_s``: its clock at the start."""

    def __init__(self, offset_s: float = 77.0, wire: MovellaDotWire | None = None, **radio: float) -> None:
        self.offset_ns = round(offset_s * NS_PER_S)
        imu = SimulatedImu(wire or MovellaDotWire(60.0), COUNTED, START_NS, offset_s=offset_s)
        self.radio = Radio(imu, START_NS, whole=True, **radio)
        self.line = DeviceLine(self.radio, START_NS)

    def port(self) -> MovellaDotImu:
        return MovellaDotImu(device(), self.line.clock_ns, lambda *_: self.line)

    def walked(self, port: MovellaDotImu, seconds: float) -> list[ImuSample]:
        """What the live source makes of it, each with its own time of measurement in the first rate."""
        stream = SensorStream(port, SensorClock, ImuLost, frozenset({FOOT}), frozenset({FOOT}))
        found, end_ns = [], self.line.t_ns + round(seconds * NS_PER_S)
        while self.line.t_ns < end_ns:
            self.line.advance(self.line.t_ns + 5 * MS)
            found += [each for each in stream.read(self.line.t_ns) if isinstance(each, ImuSample)]
        return found

    def measured_ns(self, sample: ImuSample) -> int:
        """In truth: its rate counts the samples."""
        return START_NS + round(sample.gyr_radps[0] / COUNTED.gyr_radps[1, 0] * NS_PER_S / 60)


@pytest.mark.requirement("SR-29")
@pytest.mark.parametrize("offset_s", [77.0, 2**32 / 1e6 - 5.0])  # its stamps run over after 5 s
def test_samples_never_count_as_younger_than_they_are_and_grow_old(offset_s: float) -> None:
    bench = Bench(offset_s, fails=0.05, seed=3)
    port = bench.port()
    assert (port.serials, port.firmwares) == ({FOOT: "A0B0C0D"}, {FOOT: "2.6.1"})
    found = bench.walked(port, 60.0)
    assert len(found) > 3500
    early_ms = [(bench.measured_ns(sample) - sample.t_sensor_ns) / MS for sample in found]
    assert min(early_ms) >= 0
    assert max(early_ms[:60]) < 60  # the way of the start, a period, and the first sample's own way
    assert early_ms[-1] - early_ms[60] == pytest.approx(12.0, abs=2.0)  # a minute of 200 ppm
    assert {round((b.t_sensor_ns - a.t_sensor_ns) / MS) for a, b in itertools.pairwise(found[200:])} == {17}
    assert port.counts[FOOT].missing == 0
    assert "cannot be asked for its time" in port.notices[0]


@dataclass(eq=False)
class Overtaken(DeviceLine):
    """Notifications come 0.3 s late, and answers overtake them."""

    held: list[tuple[int, bytes]] = field(default_factory=list)

    def advance(self, t_ns: int) -> None:
        self.t_ns = max(self.t_ns, t_ns)
        sent = self.device.advance(self.t_ns)
        self.held += [(self.t_ns + 300 * MS * (each[:2] == b"\x03\x20"), each) for each in sent]
        self.faults.send(self.t_ns, [each for due_ns, each in self.held if due_ns <= self.t_ns])
        self.held = [(due_ns, each) for due_ns, each in self.held if due_ns > self.t_ns]


@pytest.mark.requirement("SR-29")
def test_what_an_earlier_measurement_left_on_its_way_dates_nothing() -> None:
    bench = Bench()
    bench.line = Overtaken(bench.radio, START_NS)
    bench.port()
    bench.line.advance(bench.line.t_ns + NS_PER_S)
    found = bench.walked(bench.port(), 2.0)
    assert min(bench.measured_ns(sample) - sample.t_sensor_ns for sample in found) >= 0


def test_what_the_radio_loses_is_counted_and_what_is_too_short_is_passed_over() -> None:
    bench = Bench()
    port = bench.port()
    bench.walked(port, 1.0)
    bench.radio.lose = 3
    bench.walked(port, 1.0)
    assert port.counts[FOOT].missing == 3
    bench.line.faults.send(bench.line.t_ns, [struct.pack("<HH", dot.MEDIUM_PAYLOAD, 5) + b"short"])
    bench.walked(port, 0.1)
    assert port.counts[FOOT].bad_frames == 1


class Stubborn(MovellaDotWire):
    """It begins so, and takes nothing that is written to ``deaf_to``."""

    deaf_to = b""
    begins = (False, 4, 60)

    def boot(self) -> list[bytes]:
        super().boot()
        self._measures, self._payload, self._set_hz = self.begins
        return []

    def answer(self, data: bytes, t_device_ns: int) -> list[bytes]:
        return [] if data[:2] == self.deaf_to and len(data) > 4 else super().answer(data, t_device_ns)


class Synchronised(Stubborn):
    deaf_to, begins = b"\x02\x10", (False, 4, 30)


class Endless(Stubborn):
    deaf_to, begins = b"\x01\x20", (True, 21, 60)


class Deaf(MovellaDotWire):
    def answer(self, data: bytes, t_device_ns: int) -> list[bytes]:
        return []


class Other(MovellaDotWire):
    def _read(self, number: int) -> bytes:
        return b"something else"


@pytest.mark.parametrize(
    ("wire", "says"),
    [
        (Deaf, "does not answer"),
        (Synchronised, "keeps to 30 Hz instead of 60"),
        (Endless, "goes on measuring"),
        (Other, "is no Movella DOT"),
    ],
)
def test_one_that_does_not_do_as_it_is_told_is_refused(
    wire: type[MovellaDotWire], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.imu.ble.READ_S", 0.05)
    with pytest.raises(ImuLost, match=says):
        Bench(wire=wire(60.0)).port()


def test_a_rate_that_it_has_not_is_refused() -> None:
    with pytest.raises(ValueError, match="a Movella DOT has 60 and 30 by radio"):
        open_imus([device(rate_hz=100.0)])


# --- by bleak -----------------------------------------------------------------------------------------------


class BleakClient:
    """What ports ask of bleak's client; how values are written and read is the kind's own."""

    radio: ClassVar[Radio]
    notifies: ClassVar[str]
    alive: ClassVar[bool] = True
    hangs: ClassVar[bool] = False

    def __init__(self, device: Any, disconnected_callback: Any, timeout: float) -> None:
        self._gone = disconnected_callback

    async def connect(self) -> None:
        if self.hangs:
            await asyncio.sleep(3600)

    async def start_notify(self, characteristic: str, callback: Any) -> None:
        assert characteristic == self.notifies
        self._task = asyncio.create_task(self._run(callback))

    async def _run(self, callback: Any) -> None:
        while self.alive:
            for message in self.radio.advance(time.monotonic_ns()):
                self.heard(message, callback)
            await asyncio.sleep(0.003)
        self._gone(self)

    def heard(self, message: bytes, callback: Any) -> None:
        callback(None, bytearray(message))

    async def disconnect(self) -> None:
        self._task.cancel()


def install(
    monkeypatch: pytest.MonkeyPatch, client: type[BleakClient], name: str, address: str, services: list[str] | None
) -> None:
    """In bleak's place; one device is near, which is found by these services."""

    class Scanner:
        @staticmethod
        async def find_device_by_filter(is_it: Any, timeout: float, service_uuids: list[str] | None) -> Any:
            found = SimpleNamespace(name=name, address=address)
            return found if service_uuids == services and is_it(found, None) else None

    monkeypatch.setitem(sys.modules, "bleak", SimpleNamespace(BleakClient=client, BleakScanner=Scanner))


class DotClient(BleakClient):
    notifies = dot.uuid(dot.MEDIUM_PAYLOAD)

    def heard(self, message: bytes, callback: Any) -> None:
        number, value = int.from_bytes(message[:2], "little"), message[4:]
        if number == dot.MEDIUM_PAYLOAD:
            super().heard(value, callback)
        else:
            self.value = number, value

    async def write_gatt_char(self, characteristic: str, data: bytes, response: bool) -> None:
        assert response
        record = struct.pack("<HH", int(characteristic[4:8], 16), len(data)) + data
        self.radio.receive(time.monotonic_ns(), record)

    async def read_gatt_char(self, characteristic: str) -> bytearray:
        self.value = 0, b""
        await self.write_gatt_char(characteristic, b"", response=True)
        while self.value[0] != int(characteristic[4:8], 16):
            await asyncio.sleep(0.003)
        return bytearray(self.value[1])


@pytest.fixture
def radio(monkeypatch: pytest.MonkeyPatch) -> Iterator[Radio]:
    now_ns = time.monotonic_ns()
    imu = SimulatedImu(MovellaDotWire(60.0), COUNTED, now_ns)
    DotClient.radio, DotClient.alive = Radio(imu, now_ns, 0.0075, whole=True), True
    install(monkeypatch, DotClient, "Movella DOT", "D4:22:CD:00:8A:5A", None)
    yield DotClient.radio
    DotClient.alive = False


def listen(port: ImuPort, seconds: float) -> list[RawSample]:
    found, end_s = list[RawSample](), time.monotonic() + seconds
    while time.monotonic() < end_s:
        time.sleep(0.005)
        found += port.read(time.monotonic_ns())
    return found


def test_by_bleak_it_is_set_up_heard_lost_and_opened_again(radio: Radio) -> None:
    (port,) = open_imus([device("D4:22:CD:00:8A:5A")])
    assert port.serials == {FOOT: "A0B0C0D"}
    for _ in range(2):
        found = listen(port, 0.5)
        assert len(found) >= 15
        assert [(sensor, said_ns) for sensor, _, said_ns in port.clock_answers()] == [(FOOT, found[0].t_device_ns)]
        DotClient.alive = False
        with pytest.raises(ImuLost, match="the connection is gone"):
            listen(port, 2.0)
        DotClient.alive = True
        port.reopen()
    port.close()
    port.close()
    with pytest.raises(ImuLost, match="is not found"):
        open_imus([device("D4:22:CD:00:00:00", find_s=0.2)])


# --- Capture2Go by radio ------------------------------------------------------------------------------------


C2G_COUNTED = ImuSignal(100.0, np.tile([0.0, 0.0, 9.81], (1000, 1)), np.linspace([0.0] * 3, [10.0, 0.0, 0.0], 1000))


class C2gClient(BleakClient):
    notifies = ble.FROM_SENSOR

    async def write_gatt_char(self, characteristic: str, data: bytes, response: bool) -> None:
        assert characteristic == ble.TO_SENSOR
        assert response or data == c2g.pack(c2g.Header.CMD_GET_STATUS)  # of its time nobody waits for the answer
        C2gClient.radio.receive(time.monotonic_ns(), data)


@pytest.fixture
def c2g_radio(monkeypatch: pytest.MonkeyPatch) -> Iterator[Radio]:
    now_ns = time.monotonic_ns()
    imu = SimulatedImu(Capture2GoWire(100.0, None, "1234ab"), C2G_COUNTED, now_ns)
    C2gClient.radio, C2gClient.alive, C2gClient.hangs = Radio(imu, now_ns), True, False
    install(monkeypatch, C2gClient, "IMU_1234ab", "00:11:22:33:44:55", [ble.SERVICE])
    yield C2gClient.radio
    C2gClient.alive = False


def capture2go(port: str = "IMU_1234ab", **options: object) -> ImuDevice:
    values = {"sensor": "left_foot", "device": "capture2go_ble", "port": port, "rate_hz": 100.0, "options": options}
    return ImuDevice.model_validate(values | {"acc_range_g": 16.0, "gyr_range_dps": 2000.0})


def test_eight_at_a_time_none_is_lost_and_their_age_is_the_radios(c2g_radio: Radio) -> None:
    (port,) = open_imus([capture2go(packed=True)])
    assert port.serials == {"left_foot": "1234ab"}
    found = listen(port, 1.5)
    assert len(found) >= 100
    assert len(found) % 8 == 0
    assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)} == {10 * MS}
    youngest_ms, oldest_ms = (
        pick(sample.t_host_ns - sample.t_device_ns for sample in found) / MS for pick in (min, max)
    )
    assert youngest_ms >= 0
    assert oldest_ms >= 70  # seven samples older than the newest of its package
    counts = port.counts["left_foot"]
    assert (counts.missing, counts.doubled, counts.backward, counts.bad_frames) == (0, 0, 0, 0)
    port.close()
    port.close()


def test_bad_reception_makes_samples_late_and_not_missing(c2g_radio: Radio) -> None:
    c2g_radio.fails, c2g_radio.interval_s = 0.1, 0.0075
    (port,) = open_imus([capture2go()])
    listen(port, 0.3)
    c2g_radio.away_until_ns = time.monotonic_ns() + NS_PER_S // 2
    found = listen(port, 1.2)
    assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)} == {10 * MS}
    assert max(sample.t_host_ns - sample.t_device_ns for sample in found) > 400 * MS
    assert port.counts["left_foot"].missing == 0
    port.close()


def test_notifications_that_the_system_loses_cost_their_packages_and_are_counted(c2g_radio: Radio) -> None:
    (port,) = open_imus([capture2go(packed=True)])
    listen(port, 0.3)
    c2g_radio.lose = 2
    found = listen(port, 1.5)
    counts = port.counts["left_foot"]
    assert counts.missing >= 8
    assert counts.missing % 8 == 0
    assert len(found) >= 50
    port.close()


def test_a_connection_that_goes_is_lost_and_can_be_opened_again(c2g_radio: Radio) -> None:
    (port,) = open_imus([capture2go("00:11:22:33:44:55")])
    listen(port, 0.2)
    c2g_radio.imu.set_fault(time.monotonic_ns(), "reboot", 1)  # out of power
    C2gClient.alive = False
    with pytest.raises(ImuLost, match=r"the connection is gone\. Is it switched on"):
        listen(port, 2.0)
    C2gClient.alive = True
    port.reopen()
    assert len(listen(port, 1.0)) >= 40
    port.close()


@pytest.mark.usefixtures("c2g_radio")
def test_who_is_not_there_or_never_answers_is_named_in_time() -> None:
    with pytest.raises(ImuLost, match="left_foot on IMU_other: is not found"):
        open_imus([capture2go("IMU_other", find_s=0.2)])
    C2gClient.hangs = True
    began_s = time.monotonic()
    with pytest.raises(ImuLost, match="TimeoutError"):
        open_imus([capture2go(find_s=0.2)])
    assert time.monotonic() - began_s < 5.0


def test_without_bleak_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bleak", None)
    with pytest.raises(ImuLost, match=r"pip install 'fes-gait\[ble\]'"):
        open_imus([capture2go()])


def test_one_at_a_time_and_asked_for_its_time_it_answers_within_what_the_radio_takes(c2g_radio: Radio) -> None:
    (port,) = open_imus([capture2go()])
    found = listen(port, 1.5)
    assert len(found) >= 120
    told = port.clock_answers()
    assert len(told) >= 8
    assert port.clock_answers() == []
    # the clock was set when it was opened, some time before the command reached it: it shows less than the host's
    for sensor, asked_ns, said_ns in told:
        assert sensor == "left_foot"
        assert -100 * MS < asked_ns - said_ns < 100 * MS
    port.close()


def test_an_answer_that_is_lost_makes_no_later_one_count_for_more(c2g_radio: Radio) -> None:
    (port,) = open_imus([capture2go()])
    listen(port, 0.3)
    port.clock_answers()
    c2g_radio.away_until_ns = time.monotonic_ns() + NS_PER_S
    listen(port, 1.5)
    oldest_ns = min(asked_ns for _, asked_ns, _ in port.clock_answers())
    assert oldest_ns < c2g_radio.away_until_ns - NS_PER_S // 2  # by when it was asked, not by when it was asked again
    port.close()
