"""Every planted deviation of a simulated device is found, by its name and no other; sound devices show none."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest

from drivers.simulated.imu.device import SimulatedImu
from drivers.simulated.imu.serial_wires import serial_wire
from drivers.simulated.imu.wire import Reading, Wire, XbusWire
from drivers.simulated.stimulator.firmware import NodeFaults, OutputChannel
from drivers.simulated.stimulator.in_process import DeviceLine, NodeBus
from drivers.simulated.stimulator.sciencemode2 import ScienceMode2Device
from drivers.simulated.stimulator.sciencemode4 import ScienceMode4Device
from drivers.simulated.stimulator.serial_device import SimulatedDevice
from fes.qualify.evidence import findings, finite
from fes.qualify.sensor import SensorBench
from fes.qualify.simulated import (
    SENSORS,
    SERIALS,
    START_NS,
    STIMULATORS,
    HeldByHand,
    simulated_sensor,
    simulated_stimulator,
)
from fes.qualify.stimulator import StimulatorBench
from fes.signals import NS_PER_S, Vector3

MS = 1_000_000


def names(bench: SensorBench | StimulatorBench) -> set[str]:
    sensor = isinstance(bench, SensorBench)
    settings = (bench.device if isinstance(bench, SensorBench) else bench.session.stimulator).model_dump()
    evidence = {"what": "sensor" if sensor else "stimulator", "settings": settings, "figures": finite(bench.figures())}
    return {finding.name for finding in findings(evidence)}


# --- sensors ---------------------------------------------------------------------------------------------

Distort = Callable[[Vector3, Vector3], tuple[Vector3, Vector3]]


@dataclass(eq=False)
class Distorted(HeldByHand):
    """What its element shows of what it feels."""

    distort: Distort = field(default=lambda acc, gyr: (acc, gyr), kw_only=True)

    def sample(self, number: int) -> tuple[Vector3, Vector3]:
        return self.distort(*super().sample(number))


def scaled(vector: Vector3, *factors: float) -> Vector3:
    x, y, z = (value * factor for value, factor in zip(vector, factors, strict=True))
    return x, y, z


def held(vector: Vector3, most: float) -> Vector3:
    x, y, z = (min(max(value, -most), most) for value in vector)
    return x, y, z


def dead(gyr: Vector3) -> Vector3:
    return gyr if max(map(abs, gyr)) > 0.02 else (0.0, 0.0, 0.0)


@dataclass(eq=False)
class InBursts(DeviceLine):
    """A radio: what it sends gets through four times a second."""

    def read(self) -> bytes:
        return super().read() if self.t_ns // (10 * MS) % 25 == 0 else b""


class LosesSome(Wire):
    """Every fiftieth sample is taken and not sent."""

    def __init__(self, inner: Wire) -> None:
        self.inner = inner

    def encode(self, reading: Reading) -> list[bytes]:
        return [] if reading.counter % 50 == 7 else self.inner.encode(reading)

    def answer(self, data: bytes, t_device_ns: int) -> list[bytes]:
        return self.inner.answer(data, t_device_ns)


class StampsTwice(LosesSome):
    """Every fiftieth sample is sent twice."""

    def encode(self, reading: Reading) -> list[bytes]:
        return self.inner.encode(reading) * (1 + (reading.counter % 50 == 7))


class Garbles(LosesSome):
    """One bit of every fiftieth message is another."""

    def encode(self, reading: Reading) -> list[bytes]:
        messages = self.inner.encode(reading)
        if reading.counter % 50 == 7 and messages:
            flipped = bytearray(messages[0])
            flipped[20] ^= 0x10
            return [bytes(flipped)]
        return messages


class ForgetsItsNumber(XbusWire):
    """Says another serial number each time it is asked."""

    asked = 0

    def _answers(self, message: Any) -> list[bytes]:
        self._serial = struct.pack(">I", self.asked)
        self.asked += 1
        return super()._answers(message)


def sensor(kind: str, distort: Distort | None = None, wire: Wire | None = None, **made: Any) -> SensorBench:
    feels = (
        Distorted(made.pop("rate_hz", 100.0), distort=distort) if distort else HeldByHand(made.pop("rate_hz", 100.0))
    )
    line_type, faults = made.pop("line", DeviceLine), made.pop("faults", {})
    delay_s = made.pop("delay_s", 0.0)
    wire = wire or serial_wire(kind, 100.0, SERIALS.get(kind, "00000000"))
    device = SimulatedImu(wire, feels, START_NS, **made)
    for name, value in faults.items():
        device.set_fault(START_NS, name, value)
    line = line_type(device, START_NS)
    line.faults.set("delay", delay_s)
    return simulated_sensor(kind, device, feels, line)


def xbus() -> Wire:
    return serial_wire("xbus", 100.0)


SENSOR_PLANTS: dict[str, tuple[Callable[[], SensorBench], set[str]]] = {
    "90 Hz instead of 100": (lambda: sensor("xbus", rate_hz=90.0), {"rate"}),
    "clock 1 % fast": (lambda: sensor("xbus", drift_ppm=10_000.0), {"clock"}),
    "clock 0.1 % slow": (lambda: sensor("capture2go", drift_ppm=-1_000.0), {"clock"}),
    "2 % of the samples lost": (lambda: sensor("xbus", wire=LosesSome(xbus())), {"missing"}),
    "2 % of the samples sent twice": (lambda: sensor("xbus", wire=StampsTwice(xbus())), {"bad_stamps"}),
    "2 % of the messages garbled": (lambda: sensor("xbus", wire=Garbles(xbus())), {"bad_frames", "missing"}),
    "late by 100 ms": (lambda: sensor("xbus", delay_s=0.1), {"late"}),
    "comes in bursts of 250 ms": (lambda: sensor("ximu3", line=InBursts), {"late"}),
    "force clipped at 4 g": (lambda: sensor("xbus", lambda a, g: (held(a, 4 * 9.80665), g)), {"force_range"}),
    "rate clipped at 500 °/s": (lambda: sensor("ximu3", lambda a, g: (a, held(g, 8.7266))), {"rate_range"}),
    "dead band": (lambda: sensor("ximu3", lambda a, g: (a, dead(g))), {"dead_band"}),
    "frozen": (
        lambda: sensor("ximu3", faults={"stuck": 1.0}),
        {
            "frozen",
            "late",
            "force_axes",
            "force_gain",
            "force_bias",
            "rate_axes",
            "rate_gain",
            "force_range",
            "rate_range",
        },
    ),
    "force axes x and y exchanged": (lambda: sensor("xbus", lambda a, g: ((a[1], a[0], a[2]), g)), {"force_axes"}),
    "rate axes y and z exchanged": (lambda: sensor("xbus", lambda a, g: (a, (g[0], g[2], g[1]))), {"rate_axes"}),
    "force's sign wrong in z": (lambda: sensor("ximu3", lambda a, g: (scaled(a, 1, 1, -1), g)), {"force_axes"}),
    "rate's sign wrong in x": (lambda: sensor("capture2go", lambda a, g: (a, scaled(g, -1, 1, 1))), {"rate_axes"}),
    "turned in its case": (lambda: sensor("xbus", faults={"axes": 1.0}), {"force_axes", "rate_axes"}),
    "force × 1.05": (lambda: sensor("xbus", lambda a, g: (scaled(a, 1.05, 1.05, 1.05), g)), {"force_gain"}),
    "rate × 0.9": (lambda: sensor("xbus", lambda a, g: (a, scaled(g, 0.9, 0.9, 0.9))), {"rate_gain"}),
    "force off by 1 m/s² in y": (lambda: sensor("ximu3", lambda a, g: ((a[0], a[1] + 1, a[2]), g)), {"force_bias"}),
    "in °/s": (lambda: sensor("ximu3", lambda a, g: (a, scaled(g, 57.3, 57.3, 57.3))), {"rate_gain"}),
    "forgets its serial number": (lambda: sensor("xbus", wire=ForgetsItsNumber(100.0)), {"identity"}),
}


@pytest.mark.parametrize("plant", SENSOR_PLANTS)
def test_a_sensor_that_deviates_is_found_and_nothing_else(plant: str) -> None:
    make, expected = SENSOR_PLANTS[plant]
    assert names(make()) == expected


@pytest.mark.parametrize("kind", SENSORS)
def test_nothing_is_found_of_a_sound_sensor(kind: str) -> None:
    feels = HeldByHand(100.0, seed=2)
    device = SimulatedImu(serial_wire(kind, 100.0, SERIALS.get(kind, "00000000")), feels, START_NS, drift_ppm=80.0)
    # a WitMotion sensor has a dead band as it comes
    assert names(simulated_sensor(kind, device, feels)) == ({"dead_band"} if kind == "witmotion" else set())


# --- stimulators -----------------------------------------------------------------------------------------


class P24(ScienceMode4Device):
    """A P24 whose output stage does otherwise."""

    step_ma, gain, width, channel_shift, after_ns, again_ns = 0.0, 1.0, 1.0, 0, 0, 0

    def __init__(self, **how: Any) -> None:
        self._newest: tuple[int, int, float, float] | None = None
        for name, value in how.items():
            setattr(self, name, value)
        super().__init__(START_NS)

    def pulse(self, t_ns: int, channel: int, current_ma: float, width_us: float, detail: str = "") -> None:
        self._newest, self._next_ns = (t_ns, channel, current_ma, width_us), t_ns + (self.again_ns or 40 * MS)
        self._put(t_ns, current_ma, width_us)

    def _put(self, t_ns: int, current_ma: float, width_us: float) -> None:
        current_ma *= self.gain
        if self.step_ma:
            current_ma = round(current_ma / self.step_ma) * self.step_ma
        super().pulse(t_ns, 0, current_ma, width_us * self.width)

    def advance(self, t_ns: int) -> list[bytes]:
        """Pulses that nobody asked for: on and on after the last one, or again after a pause."""
        out = super().advance(t_ns)
        if self._newest and (self.after_ns or self.again_ns):
            last_ns, _, current_ma, width_us = self._newest
            until_ns = last_ns + (self.after_ns or self.again_ns + 200 * MS)
            while last_ns + 45 * MS < t_ns and self._next_ns <= min(t_ns, until_ns):
                self._put(self._next_ns, current_ma, width_us)
                self._next_ns += 40 * MS
        return out

    def next_deadline_ns(self) -> int:
        return min(super().next_deadline_ns(), self._next_ns + 10 * MS) if self._newest else super().next_deadline_ns()


class MidWithoutWatchdog(ScienceMode4Device):
    """Mid level that goes on when nobody asks any more."""

    def _mid_update(self, t_ns: int, packet: Any) -> list[bytes]:
        answer = super()._mid_update(t_ns, packet)
        self._watchdog_ns = 2**63 - 1
        return answer


class DeafToStop(ScienceMode4Device):
    """Mid level that does not take an update without channels for *off*."""

    def _mid_update(self, t_ns: int, packet: Any) -> list[bytes]:
        return super()._mid_update(t_ns, packet) if packet.data[0] else self._answer(packet)


class SwitchWithoutEffect(ScienceMode2Device):
    """Its emergency switch does nothing, and nobody hears of it."""

    def _emergency(self, t_ns: int, pressed: bool) -> list[bytes]:
        return []


class ComesBack(ScienceMode2Device):
    """When its emergency switch is let go, it delivers a pulse."""

    def _emergency(self, t_ns: int, pressed: bool) -> list[bytes]:
        if not pressed:
            self.pulse(t_ns, 0, 10.0, 200.0)
        return super()._emergency(t_ns, pressed)


class Restarts(ScienceMode2Device):
    """Restarts by itself, once, after half a minute."""

    def advance(self, t_ns: int) -> list[bytes]:
        if self._boots == 1 and t_ns > START_NS + 30 * NS_PER_S:
            self.set_fault(t_ns, "reboot", 1.0)
        return super().advance(t_ns)


def slow(device: SimulatedDevice, seconds: float) -> SimulatedDevice:
    device.set_fault(START_NS, "slow", seconds)
    return device


def p24(**how: Any) -> StimulatorBench:
    return simulated_stimulator("p24_low_level", P24(**how))


def on_can(faults: NodeFaults) -> StimulatorBench:
    return simulated_stimulator("can", bus=NodeBus(1, START_NS, faults))


class Unending(OutputChannel):
    """An output stage on CAN whose lease does not run out."""

    def drive(self, t_ns: int, levels: tuple[float, float, float], validity_ms: int) -> None:
        super().drive(t_ns, levels, 100_000)


def on_can_unending() -> StimulatorBench:
    bus = NodeBus(1, START_NS)
    bus.node.channels = tuple(Unending() for _ in bus.node.channels)
    return simulated_stimulator("can", bus=bus)


STIMULATOR_PLANTS: dict[str, tuple[Callable[[], StimulatorBench], set[str]]] = {
    "current rounded to 2 mA": (lambda: p24(step_ma=2.0), {"current"}),
    "current × 0.9": (lambda: p24(gain=0.9), {"current", "again"}),
    "no current": (
        lambda: p24(gain=0.0),
        {"current", "again"},
    ),
    "width × 1.2": (lambda: p24(width=1.2), {"width"}),
    "pulses for 300 ms after off": (lambda: p24(after_ns=300 * MS), {"off", "stop", "silence"}),
    "comes again a second after off": (
        lambda: p24(again_ns=NS_PER_S),
        {"off_later", "stop_later", "silence_later"},
    ),
    "goes on after off": (
        lambda: simulated_stimulator("p24_mid_level", DeafToStop(START_NS)),
        {"off", "stop", "faults"},
    ),
    "goes on without commands": (
        lambda: simulated_stimulator("p24_mid_level", MidWithoutWatchdog(START_NS)),
        {"silence"},
    ),
    "lease does not run out": (on_can_unending, {"silence"}),
    "half the current, and says so": (lambda: on_can(NodeFaults(weak=0)), {"current", "again", "faults", "interval"}),
    "answers after 0.2 s": (
        lambda: simulated_stimulator("p24_low_level", slow(ScienceMode4Device(START_NS), 0.2)),
        {"answers", "faults", "interval"},
    ),
    "emergency switch without effect": (
        lambda: simulated_stimulator("rehastim2", SwitchWithoutEffect(START_NS)),
        {"switch", "switch_said"},
    ),
    "a pulse when the switch is let go": (
        lambda: simulated_stimulator("rehastim2", ComesBack(START_NS)),
        {"switch_released"},
    ),
    "restarts by itself": (lambda: simulated_stimulator("rehastim2", Restarts(START_NS)), {"faults"}),
}


@pytest.mark.parametrize("plant", STIMULATOR_PLANTS)
def test_a_stimulator_that_deviates_is_found_and_nothing_else(plant: str) -> None:
    make, expected = STIMULATOR_PLANTS[plant]
    assert names(make()) == expected


@pytest.mark.parametrize("kind", STIMULATORS)
def test_nothing_is_found_of_a_sound_stimulator(kind: str) -> None:
    assert names(simulated_stimulator(kind)) == set()
