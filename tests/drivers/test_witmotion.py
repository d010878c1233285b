"""WitMotion's standard protocol: the codec on public bytes, the port on a simulated sensor with its dead band."""

from __future__ import annotations

import itertools
import math
import struct

import pytest

from drivers.imu import witmotion as wit
from drivers.imu.port import ImuLost
from drivers.imu.witmotion import WitmotionImu
from drivers.simulated.imu.device import SimulatedImu
from drivers.simulated.imu.serial_wires import WitmotionWire
from drivers.simulated.stimulator.in_process import DeviceLine
from fes.config import ImuDevice
from fes.gate.freshness import Freshness
from fes.live.sensor_monitor import SensorMonitor
from fes.qualify.simulated import START_NS, HeldByHand, sensor_settings
from fes.signals import NS_PER_S, ImuSample, RawSample

# of an HWT905-TTL that nobody moved: aarushmaddula/bsli-payload-project, README.md
CAPTURED = bytes.fromhex(
    "5550000000000528950168 55510c0093026d08b7077a 5552000000000000b70765 5553040ce1ff6ff2cc460b 5554acf93b0b86e7000001"
    "5555ed0fa30a5708fb06b3 555600000000000000 00ab 555923 8384ed5f03f1142c 555a0000000000000000af"
)
REST = wit.Sample(946_685_140_405, (12 / 2048, 659 / 2048, 2157 / 2048), (0.0, 0.0, 0.0))  # 5 min 40.405 s of 2000


def frame(kind: int, data: str) -> bytes:
    head = bytes((0x55, kind)) + bytes.fromhex(data)
    return head + bytes((sum(head) % 256,))


def test_a_capture_is_one_sample_at_rest_however_it_is_cut_and_whatever_is_around() -> None:
    stream = b"\x55\x51\x00" + CAPTURED + b"\x55" + CAPTURED[:30] + CAPTURED
    decoder = wit.WitmotionDecoder()
    assert [each for k in range(len(stream)) for each in decoder.feed(stream[k : k + 1])] == [REST, REST]
    assert decoder.counts.bytes_skipped == 3 + 1 + 8  # noise, a stray start, and a frame that was cut off
    assert wit.WitmotionDecoder().feed(stream) == [REST, REST]


@pytest.mark.parametrize(
    ("frames", "found", "bad"),
    [
        # 500 and -1000 °/s, on the day that the protocol's own example sets the clock to
        (
            [(0x50, "16030c091e3af401"), (0x51, "0000000000f8c409"), (0x52, "002000c000000000")],
            [wit.Sample(1_647_077_458_500, (0.0, 0.0, -1.0), (500.0, -1000.0, 0.0))],
            0,
        ),
        ([(0x5F, "0700090006001400")], [wit.Registers((7, 9, 6, 20))], 0),
        ([(0x51, "0000000000f8c409"), (0x52, "00" * 8)], [], 1),  # without its time
        ([(0x50, "16030c091e3af401"), (0x52, "00" * 8)], [], 1),  # without its force
        ([(0x50, "160d0c091e3af401"), (0x51, "00" * 8), (0x52, "00" * 8)], [], 1),  # in a 13th month
        ([(0x50, "00" * 8), (0x51, "00" * 8), (0x50, "00" * 8), (0x52, "00" * 8)], [], 1),  # of two samples
        ([(0x53, "00" * 8), (0x59, "ff" * 8)], [], 0),
    ],
)
def test_what_frames_say(frames: list[tuple[int, str]], found: list[object], bad: int) -> None:
    decoder = wit.WitmotionDecoder()
    assert decoder.feed(b"".join(frame(*each) for each in frames)) == found
    assert (decoder.counts.bad_frames, decoder.counts.bytes_skipped) == (bad, 0)


def test_a_flipped_bit_costs_its_sample() -> None:
    for bit in range(8 * 33):
        spoiled = bytearray(CAPTURED)
        spoiled[bit // 8] ^= 1 << bit % 8
        assert wit.WitmotionDecoder().feed(bytes(spoiled)) == []


def test_commands_are_those_of_the_protocol() -> None:
    assert wit.UNLOCK.hex() == "ffaa6988b5"
    assert wit.write(wit.SAVE, 0).hex() == "ffaa000000"
    assert wit.write(wit.OUTPUTS, 0x3E).hex() == "ffaa023e00"
    assert wit.write(wit.OUTPUT_RATE, 3).hex() == "ffaa030300"
    assert wit.write(wit.BANDWIDTH, 1).hex() == "ffaa1f0100"
    assert wit.read(0x34).hex() == "ffaa273400"


# --- the port -----------------------------------------------------------------------------------------------


class Bench:
    """A simulated sensor in somebody's hands, on a line."""

    def __init__(self, rate_hz: float = 100.0, wire: WitmotionWire | None = None) -> None:
        self.feels = HeldByHand(rate_hz)
        self.wire = wire or WitmotionWire(rate_hz)
        self.imu = SimulatedImu(self.wire, self.feels, START_NS, offset_s=3.0, drift_ppm=50.0)
        self.line = DeviceLine(self.imu, START_NS)
        self.written: list[bytes] = []

    def settings(self, rate_hz: float = 100.0, **options: object) -> ImuDevice:
        return sensor_settings("witmotion", rate_hz).model_copy(update={"options": options})

    def port(self, settings: ImuDevice | None = None) -> WitmotionImu:
        send = self.line.device.receive

        def receive(t_ns: int, data: bytes) -> list[bytes]:
            self.written.append(data)
            return send(t_ns, data)

        self.imu.receive = receive
        return WitmotionImu(settings or self.settings(), self.line.clock_ns, lambda *_: self.line)

    def listen(self, port: WitmotionImu, seconds: float) -> list[RawSample]:
        found, end_ns = [], self.line.t_ns + round(seconds * NS_PER_S)
        while self.line.t_ns < end_ns:
            self.line.wait(1.0)
            found += port.read(self.line.t_ns)
        return found


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 200.0])
def test_it_is_set_up_once_and_keeps_that_without_power(rate_hz: float) -> None:
    bench = Bench(rate_hz)
    port = bench.port(bench.settings(rate_hz))
    assert wit.write(wit.SAVE, 0) in bench.written
    found = bench.listen(port, 2.0)
    steps_ms = {(b.t_device_ns - a.t_device_ns) / 1e6 for a, b in itertools.pairwise(found)}
    assert steps_ms == {1000 / rate_hz}
    counts = port.counts["right_foot"]
    assert (counts.missing, counts.doubled, counts.bad_frames, counts.bad_values) == (0, 0, 0, 0)
    bench.line.faults.send(bench.line.t_ns, bench.imu.set_fault(bench.line.t_ns, "reboot", 1.0))
    bench.written.clear()
    port.reopen()
    assert set(bench.written) == {wit.read(wit.OUTPUTS), wit.read(wit.BANDWIDTH)}  # its memory is not worn
    assert len(bench.listen(port, 1.0)) >= 0.6 * rate_hz
    port.close()


def test_values_are_si_and_its_dead_band_counts_as_rest_and_not_as_frozen() -> None:
    bench = Bench()
    port = bench.port()
    rest = bench.listen(port, 2.0)[100:]
    assert {sample.gyr_radps for sample in rest} == {(0.0, 0.0, 0.0)}
    assert sum(sample.acc_mps2[2] for sample in rest) / len(rest) == pytest.approx(9.80665, abs=0.01)
    monitor, freshness = SensorMonitor(port._device, None), Freshness(40_000_000)
    for raw in rest:
        sample = ImuSample(raw.t_host_ns, raw.sensor, raw.t_host_ns, raw.acc_mps2, raw.gyr_radps)
        monitor.add(sample)
        assert freshness.note(sample) == ""
    assert "a dead band" in monitor.dead_band
    bench.feels.begin("turn")
    assert max(sample.gyr_radps[2] for sample in bench.listen(port, 6.0)) == pytest.approx(2 * math.tau / 5, rel=0.02)
    bench.line.write(wit.UNLOCK + wit.write(0x6F, 0))  # the protocol's own way to have none
    assert all(any(sample.gyr_radps) for sample in bench.listen(port, 2.0)[10:])


class Silent(WitmotionWire):
    def answer(self, data: bytes, t_device_ns: int) -> list[bytes]:
        return []


class Locked(WitmotionWire):
    """Another kind, which another key opens."""

    def answer(self, data: bytes, t_device_ns: int) -> list[bytes]:
        return super().answer(data.replace(b"\x88\xb5", b"\0\0"), t_device_ns)


class Slower(WitmotionWire):
    def boot(self) -> list[bytes]:
        self._saved[0x20] = 2
        return super().boot()


@pytest.mark.parametrize(
    ("wire", "says"),
    [(Silent, "no WitMotion sensor answers"), (Locked, "asked for registers"), (Slower, "not set to 2000 °/s")],
)
def test_what_is_none_or_will_not_be_set_up_is_refused(wire: type[WitmotionWire], says: str) -> None:
    with pytest.raises(ImuLost, match=says):
        Bench(wire=wire(100.0)).port()


@pytest.mark.parametrize(
    ("rate_hz", "options", "says"),
    [(60.0, {}, "a WitMotion sensor has 50, 100, 200"), (100.0, {"baudrate": 9600}, "need 33000 baud")],
)
def test_settings_that_cannot_work_are_refused(rate_hz: float, options: dict[str, object], says: str) -> None:
    bench = Bench()
    with pytest.raises(ValueError, match=says):
        bench.port(bench.settings(rate_hz, **options))
    assert not bench.written


def test_one_that_is_only_listened_to_and_sends_no_time_has_no_samples() -> None:
    bench = Bench()
    bench.line.write(wit.UNLOCK + wit.write(wit.OUTPUT_RATE, 9))
    port = bench.port(bench.settings(configure=False))
    assert not bench.written
    assert bench.listen(port, 1.0) == []
    assert port.counts["right_foot"].bad_frames >= 99
    bench.line.write(struct.pack("<BBBH", 0xFF, 0xAA, 2, 7))
    assert len(bench.listen(port, 1.0)) >= 99
