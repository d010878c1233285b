"""Capture2Go's port against its simulated sensor, both without a line, on a clock that the test turns."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from drivers.imu import capture2go_codec as c2g
from drivers.imu.capture2go_codec import Header
from drivers.imu.capture2go_port import Capture2GoImu
from drivers.imu.open import open_imus
from drivers.imu.port import ImuLost
from drivers.simulated.imu.device import ImuSignal, SimulatedImu
from drivers.simulated.imu.serial_wires import Air, Capture2GoWire, package
from drivers.simulated.stimulator.in_process import DeviceLine
from fes.config.session import ImuDevice
from fes.control.clock_sync import SensorClock
from fes.live.source import SensorStream
from fes.signals import NS_PER_S, RawSample, SystemFault

MS = 1_000_000
START_NS = 5_000 * NS_PER_S
STILL = ImuSignal(100.0, np.tile([0.0, 0.0, 9.81], (1000, 1)), np.tile([1.0, 0.0, -35.0], (1000, 1)))


class Sensor(DeviceLine):
    """A simulated sensor on its line; ``told`` are the commands that reached it."""

    def __init__(self, air: Air | None = None, offset_s: float = 7.0) -> None:
        self.imu = SimulatedImu(Capture2GoWire(100.0, air, "1234ab"), STILL, START_NS, offset_s=offset_s)
        super().__init__(self.imu, START_NS)
        self.told: list[Header] = []
        self.answers: Callable[[bytes], list[bytes]] | None = None

    def write(self, data: bytes) -> None:
        self.told += [Header(each.header) for each in c2g.Capture2GoDecoder().feed(data)]
        self.faults.send(self.t_ns, (self.answers or partial(self.imu.receive, self.t_ns))(data))

    def port(self, name: str = "right_foot", **options: object) -> Capture2GoImu:
        values = {"device": "capture2go", "port": "x", "rate_hz": 100.0, "acc_range_g": 16.0, "gyr_range_dps": 2000.0}
        settings = ImuDevice.model_validate(values | {"sensor": name, "options": options})
        return Capture2GoImu(settings, self.clock_ns, lambda *_: self)

    def listen(self, port: Capture2GoImu, seconds: float) -> list[RawSample]:
        found = []
        for _ in range(round(seconds * 1000)):
            self.advance(self.t_ns + MS)
            found += port.read(self.t_ns)
        return found


def test_it_is_asked_who_it_is_set_and_started_and_its_stamps_are_on_the_hosts_clock() -> None:
    sensor = Sensor()
    assert sensor.read() == b""  # nobody has asked
    port = sensor.port()
    assert port.serials == {"right_foot": "1234ab"}
    assert sensor.told == [
        Header.CMD_GET_DEVICE_INFO, Header.CMD_GET_STATUS, Header.CMD_SET_ABSOLUTE_TIME,
        Header.CMD_SET_MEASUREMENT_MODE, Header.CMD_START_STREAMING,
    ]  # fmt: skip
    found = sensor.listen(port, 2.5)
    assert len(found) == pytest.approx(250, abs=1)
    assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)} == {10 * MS}
    assert all(0 <= sample.t_host_ns - sample.t_device_ns <= 2 * MS for sample in found)
    assert found[0].acc_mps2 == pytest.approx((0.0, 0.0, 9.81), abs=0.003)
    assert found[0].gyr_radps == pytest.approx((1.0, 0.0, -math.radians(2000.0)), abs=0.002)  # its range ends there
    assert port.notices == []
    port.close()
    assert sensor.listen(port, 0.5) == []


def test_one_that_streams_already_begins_anew_and_one_that_records_is_left_alone() -> None:
    sensor = Sensor()
    first = sensor.port()
    sensor.listen(first, 0.2)
    again = sensor.port()  # the first has gone without a word
    assert Header.CMD_STOP_STREAMING_AND_CLEAR_BUFFER in sensor.told
    assert len(sensor.listen(again, 0.5)) == pytest.approx(50, abs=1)
    status = c2g.pack(Header.DATA_STATUS, {"sensorState": 3})
    sensor.answers = lambda data: [c2g.pack(Header.DATA_DEVICE_INFO), status]
    sensor.told.clear()
    with pytest.raises(ImuLost, match="records"):
        sensor.port()
    assert not {0x0156, Header.CMD_SET_MEASUREMENT_MODE} & set(sensor.told)  # the first: stop recording


def test_a_refusal_and_silence_are_named() -> None:
    sensor = Sensor()
    sensor.answers = lambda data: [package(0xFFFF, b"\xfb\x70\x00")]
    with pytest.raises(ImuLost, match=r"refuses CMD_GET_DEVICE_INFO: wrong state \(0xfb\)"):
        sensor.port()
    sensor.faults.set("mute", 1)
    with pytest.raises(ImuLost, match="no Capture2Go answers to CMD_GET_DEVICE_INFO"):
        sensor.port()


def test_another_mode_than_asked_for_is_no_mode() -> None:
    sensor = Sensor()

    def answers(data: bytes) -> list[bytes]:
        (asked,) = c2g.Capture2GoDecoder().feed(data)
        if asked.header == Header.CMD_SET_MEASUREMENT_MODE:
            return [c2g.pack(Header.DATA_MEASUREMENT_MODE, {"fullFixedMode": 3, "disableMagData": True})]
        return sensor.imu.receive(sensor.t_ns, data)

    sensor.answers = answers
    with pytest.raises(ImuLost, match="does not take fullFixedMode, statusMode as asked for"):
        sensor.port()


def test_its_flags_are_counted_told_and_acted_on() -> None:
    sensor = Sensor()
    port = sensor.port()
    sensor.listen(port, 0.1)
    sensor.imu.set_fault(sensor.t_ns, "unsound", 3)
    found = sensor.listen(port, 0.5)
    lost = [sample for sample in found if math.isnan(sample.acc_mps2[0]) and math.isnan(sample.gyr_radps[2])]
    counts = port.counts["right_foot"]
    assert len(lost) == counts.unsound == counts.bad_values == 3
    assert [notice.partition(": ")[2][:27] for notice in port.notices] == ["its flags tell that its pro"]
    sensor.imu.set_fault(sensor.t_ns, "jump", 0.5)
    sensor.imu.set_fault(sensor.t_ns, "clip", 0.03)
    found = sensor.listen(port, 0.5)
    assert (counts.time_gaps, counts.missing) == (1, 50)
    assert counts.clipped == pytest.approx(50, abs=1)
    assert any("gaps in its stamps" in notice for notice in port.notices)


def test_what_its_buffer_held_back_comes_whole_in_order_and_old() -> None:
    sensor = Sensor()
    port = sensor.port()
    sensor.listen(port, 0.5)
    sensor.faults.set("backlog", 1)
    assert sensor.listen(port, 0.6) == []
    sensor.faults.set("backlog", 0)
    found = sensor.listen(port, 0.2)
    assert len(found) == pytest.approx(80, abs=1)
    assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)} == {10 * MS}
    assert max(sample.t_host_ns - sample.t_device_ns for sample in found) == pytest.approx(600 * MS, abs=12 * MS)
    counts = port.counts["right_foot"]
    assert (counts.missing, counts.doubled, counts.backward, counts.bad_frames) == (0, 0, 0, 0)


def test_after_a_loss_of_power_it_is_silent_until_it_is_opened_again() -> None:
    sensor = Sensor()
    port = sensor.port()
    sensor.listen(port, 0.5)
    sensor.imu.set_fault(sensor.t_ns, "reboot", 1)
    assert sensor.listen(port, 2.0) == []
    port.reopen()
    found = sensor.listen(port, 0.5)
    assert len(found) == pytest.approx(50, abs=1)
    assert all(0 <= sample.t_host_ns - sample.t_device_ns <= 2 * MS for sample in found)


def test_a_session_hears_what_it_says_while_its_line_is_there() -> None:
    sensor = Sensor()
    port = sensor.port()
    stream = SensorStream(port, SensorClock, ImuLost, frozenset({"right_foot"}))
    sensor.imu.set_fault(sensor.t_ns, "unsound", 1)
    sensor.listen(port, 0.1)
    assert list(stream.notices) == port.notices != []
    sensor.write(c2g.pack(Header.CMD_STOP_STREAMING) + c2g.pack(Header.CMD_GET_STATUS))
    sensor.advance(sensor.t_ns + 10 * MS)
    assert any(isinstance(event, SystemFault) for event in stream.read(sensor.t_ns))
    assert list(stream.notices) == []


def test_one_that_says_that_it_has_stopped_is_lost() -> None:
    sensor = Sensor()
    port = sensor.port()
    sensor.write(c2g.pack(Header.CMD_STOP_STREAMING) + c2g.pack(Header.CMD_GET_STATUS))  # somebody else did
    with pytest.raises(ImuLost, match="stopped streaming by itself"):
        sensor.listen(port, 0.1)


def test_two_have_one_clock_until_one_loses_it() -> None:
    air = Air()
    sensors = [Sensor(air), Sensor(air, offset_s=900.0)]
    first = sensors[0].port("left_foot", sync="sender", sync_id=9)
    second = sensors[1].port("right_foot", sync="receiver", sync_id=9)
    assert Header.CMD_SET_ABSOLUTE_TIME not in sensors[1].told

    def apart_ns() -> int:
        """Between the two sensors' stamps of what was taken at the same moment."""
        found: dict[str, RawSample] = {}
        begin_ns = max(sensor.t_ns for sensor in sensors)
        for ms in range(1, 1501):
            for sensor, port in zip(sensors, (first, second), strict=True):
                sensor.advance(begin_ns + ms * MS)
                found |= {sample.sensor: sample for sample in port.read(sensor.t_ns)}
        return abs(found["left_foot"].t_device_ns - found["right_foot"].t_device_ns)

    assert apart_ns() <= 10 * MS
    assert first.notices == second.notices == []
    sensors[1].imu.set_fault(sensors[1].t_ns, "deaf", 1)
    sensors[1].imu.set_fault(sensors[1].t_ns, "drift", 20_000.0)  # as no crystal: 20 ms a second
    apart_ns()
    assert apart_ns() > 40 * MS
    assert second.notices == ["right_foot: hears no clock of its sender; its stamps drift from the others'"]
    other = Sensor(air)
    stranger = other.port("left_shank", sync="receiver", sync_id=10)
    other.listen(stranger, 0.2)
    assert len(stranger.notices) == 1


def test_a_battery_that_is_nearly_empty_is_told() -> None:
    sensor = Sensor()
    port = sensor.port()
    for battery, told in ((14, 1), (15, 0), (0x80 | 3, 0)):
        status = {"sensorState": 2, "battery": battery, "synchronized": True}
        sensor.faults.send(sensor.t_ns, [c2g.pack(Header.DATA_STATUS, status)])
        port.read(sensor.t_ns)
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
    values = {"device": "capture2go", "port": "/dev/nothing", "rate_hz": 100.0, "acc_range_g": 16.0}
    values |= {"gyr_range_dps": 2000.0, "sensor": "left_foot", "options": options}
    with pytest.raises(ValueError, match=said):
        open_imus([ImuDevice.model_validate(values | change)])
