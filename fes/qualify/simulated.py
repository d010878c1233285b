"""Simulated devices in this process, and the person who handles them: every step is done, every reading is the truth.

Time is the devices' own, so a qualification takes a second and is the same each time. What the person does with a
sensor is what is felt by it; what they read from the oscilloscope is what the device's output stage put out.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.imu.capture2go_port import Capture2GoImu
from drivers.imu.port import ImuPort
from drivers.imu.witmotion import WitmotionImu
from drivers.imu.xbus import XbusImu
from drivers.imu.ximu3 import Ximu3Imu
from drivers.simulated.imu.device import SimulatedImu
from drivers.simulated.imu.serial_wires import serial_wire
from drivers.simulated.record import Pulse, pulses_of
from drivers.simulated.stimulator.firmware import NEVER
from drivers.simulated.stimulator.in_process import DeviceLine, NodeBus
from drivers.simulated.stimulator.sciencemode2 import ScienceMode2Device
from drivers.simulated.stimulator.sciencemode4 import ScienceMode4Device
from drivers.simulated.stimulator.serial_device import SimulatedDevice
from drivers.stimulator.can_port import CanStimulator
from drivers.stimulator.open import Port, open_stimulator
from fes.config import ImuDevice, Session, validate_session
from fes.qualify.sensor import AXES, SensorBench
from fes.qualify.stimulator import StimulatorBench, exercise_of
from fes.signals import G_MPS2, NS_PER_S, Vector3

SENSORS: Final = ("xbus", "ximu3", "capture2go", "witmotion")
STIMULATORS: Final = ("can", "p24_low_level", "p24_mid_level", "rehastim2")
SERIALS: Final = {"xbus": "037003F8", "capture2go": "ABC123"}
START_NS: Final = 1000 * NS_PER_S
SESSION_ID: Final = 0x51A7
APART: Final = 1009  # more identifiers than the commands of a session use up
READY_S, TURN_S, STRIKES_AFTER_S, PRESSES_AFTER_S = 1.0, 5.0, 0.7, 0.5
ACC_NOISE_MPS2, GYR_NOISE_RADPS = 0.02, 0.003
SHAKEN_MPS2, SHAKEN_RADPS, SHAKEN_HZ = 60.0, 18.0, 2.7
SLOW_RADPS: Final = 0.15
BLOW_MPS2, BLOW_SAMPLES = 40.0, 3
UNREAD_NS: Final = 1_000_000
PAUSE_NS: Final = NS_PER_S // 5
AT_THE_END: Final = 5  # pulses
LIMITS: Final = {
    "max_current_ma": 30.0, "max_pulse_width_us": 400.0, "max_frequency_hz": 50.0, "max_charge_per_phase_uc": 10.0,
    "max_charge_per_minute_mc": 20.0, "max_current_density_ma_per_cm2": 1.0, "max_rise_ma_per_s": 400.0,
    "max_on_s": 3.0, "min_off_s": 0.1,
}  # fmt: skip


@dataclass(eq=False)
class HeldByHand:
    """What a sensor feels in this person's hands: gravity along ``up``, noise, and what they do with it."""

    rate_hz: float
    seed: int = 1
    up: tuple[int, float] = (2, 1.0)  # axis, and which way
    does: str = ""
    number: int = 0
    size: int = 1 << 60
    _since: int = 0

    def __post_init__(self) -> None:
        self._noise = np.random.default_rng(self.seed).normal(size=(4093, 6))  # goes round, never twice in a row

    def begin(self, does: str) -> None:
        """From the next sample on they do this."""
        self.does, self._since = does, self.number + 1

    def sample(self, number: int) -> tuple[Vector3, Vector3]:
        """The ``number``-th."""
        self.number = number
        values = self._noise[number % len(self._noise)] * ([ACC_NOISE_MPS2] * 3 + [GYR_NOISE_RADPS] * 3)
        axis, way = self.up
        values[axis] += way * G_MPS2
        t_s = (number - self._since) / self.rate_hz
        if self.does == "turn" and READY_S <= t_s < READY_S + TURN_S:
            part = (t_s - READY_S) / TURN_S
            values[3 + axis] += way * math.tau / TURN_S * (1.0 - math.cos(math.tau * part))
        elif self.does == "slow":
            values[3:] += SLOW_RADPS * math.sin(t_s)
        elif self.does == "shake":
            for each in range(6):  # stronger and weaker, so that no two peaks are equal
                grows = math.sin(0.5 * t_s + each) ** 2 + 0.1
                size = (SHAKEN_MPS2, SHAKEN_RADPS)[each > 2] * grows
                values[each] += size * math.sin(math.tau * SHAKEN_HZ * (1 + 0.1 * each) * t_s)
        elif self.does == "strike" and number - self._since < BLOW_SAMPLES:
            values[2] += BLOW_MPS2
        ax, ay, az, p, q, r = values.tolist()
        return (ax, ay, az), (p, q, r)


@dataclass(eq=False)
class SimulatedTime:
    """Passes where somebody waits, from deadline to deadline of what is on the line."""

    line: DeviceLine | NodeBus
    _stood_ns: int = -1

    def now_ns(self) -> int:
        """The line's."""
        return self.line.t_ns

    def wait(self, until_ns: int, descriptor: int | None) -> None:
        """Until then or the next thing that happens."""
        now_ns = self.line.t_ns
        if now_ns == self._stood_ns:  # something has come, and nobody reads it
            self.line.advance(min(until_ns, now_ns + UNREAD_NS))
        else:
            self.line.wait(max(until_ns - now_ns, 1) / NS_PER_S)
        self._stood_ns = self.line.t_ns if self.line.t_ns == now_ns else -1


@dataclass(eq=False)
class SensorPerson:
    """Handles a simulated sensor as they are asked to."""

    line: DeviceLine
    feels: HeldByHand
    _strikes_ns: int | None = None

    def does(self, key: str, instruction: str) -> None:
        """Begin at once."""
        side, _, what = key.partition("_")
        if what in ("up", "down"):
            self.feels.up = AXES.index(side), 1.0 if what == "up" else -1.0
        self.feels.begin({"strike": ""}.get(key, "turn" if what == "turn" else key))
        self._strikes_ns = self.line.t_ns + int(STRIKES_AFTER_S * NS_PER_S) if key == "strike" else None

    def struck_ns(self) -> int | None:
        """Once it is time for it."""
        if self._strikes_ns is None or self.line.t_ns < self._strikes_ns:
            return None
        self._strikes_ns = None
        self.feels.begin("strike")
        return self.line.t_ns


def sensor_settings(kind: str, rate_hz: float = 100.0) -> ImuDevice:
    """Of a simulated sensor, which is worn nowhere."""
    options = {"sensor": "right_foot", "device": kind, "port": "in process", "rate_hz": rate_hz}
    return ImuDevice.model_validate({**options, "acc_range_g": 16.0, "gyr_range_dps": 2000.0})


def simulated_sensor(
    kind: str, device: SimulatedImu | None = None, feels: HeldByHand | None = None, line: DeviceLine | None = None
) -> SensorBench:
    """A bench with a simulated sensor of this kind; ``device``, what it ``feels`` and its ``line`` may be others."""
    settings = sensor_settings(kind)
    feels = feels or HeldByHand(settings.rate_hz)
    device = device or SimulatedImu(serial_wire(kind, settings.rate_hz, SERIALS.get(kind, "00000000")), feels, START_NS)
    line = line or DeviceLine(device, START_NS)
    port: ImuPort
    if kind == "ximu3":
        port = Ximu3Imu(settings, lambda *_: line)
    elif kind == "xbus":
        port = XbusImu(settings, line.clock_ns, lambda *_: line)
    elif kind == "witmotion":
        port = WitmotionImu(settings, line.clock_ns, lambda *_: line)
    else:
        port = Capture2GoImu(settings, line.clock_ns, lambda *_: line)
    return SensorBench(settings, port, SimulatedTime(line), SensorPerson(line, feels))


@dataclass(eq=False)
class StimulatorPerson:
    """Reads what the output stage put out since the oscilloscope was last made ready; presses its own switch."""

    line: DeviceLine | NodeBus
    _seen: list[Pulse] = field(default_factory=list)
    _presses: bool = False
    _pressed_ns: int = NEVER

    def does(self, key: str, instruction: str) -> None:
        """Begin with an empty screen; the switch is pressed in the middle of the burst, or let go."""
        self.collect()
        self._seen.clear()
        self._presses = key == "switch"
        if key == "release" and isinstance(self.line, DeviceLine):
            self.line.faults.send(self.line.t_ns, self.line.device.set_fault(self.line.t_ns, "emergency", 0.0))

    def reads(self, key: str, question: str, unit: str) -> float:
        """What the question asks for, of what was put out."""
        self.collect()
        pulses = sorted(self._seen)
        if key == "pulses":
            return float(len(pulses))
        half_ma = max((pulse.current_ma for pulse in pulses), default=0.0) / 2
        pulses = [pulse for pulse in pulses if pulse.current_ma >= half_ma]
        if not pulses:
            return 0.0
        times_ns = np.array([pulse.t_ns for pulse in pulses])
        gaps = np.flatnonzero(np.diff(times_ns) > PAUSE_NS)
        burst = slice(0, int(gaps[0]) + 1 if len(gaps) else len(pulses))
        end = pulses[burst][-AT_THE_END:]
        burst_ns = times_ns[burst]
        if key == "ma":
            return float(np.median([pulse.current_ma for pulse in end]))
        if key == "us":
            return float(np.median([pulse.pulse_width_us for pulse in end]))
        if key == "interval_ms":
            return float(np.median(np.diff(burst_ns))) / 1e6 if len(burst_ns) > 1 else 0.0
        if key == "length_ms":
            return float(burst_ns[-1] - burst_ns[0]) / 1e6
        if key == "later":
            return float(len(pulses) - len(burst_ns))
        return max(0, int(times_ns[-1]) - self._pressed_ns) / 1e6  # after_switch_ms

    def watch(self) -> None:
        """Called as time passes: the switch is pressed in the middle of the pulses."""
        if not self._presses or not isinstance(self.line, DeviceLine):
            return
        self.collect()
        if self._seen and self.line.t_ns >= self._seen[0].t_ns + PRESSES_AFTER_S * NS_PER_S:
            self._pressed_ns, self._presses = self.line.t_ns, False
            self.line.faults.send(self.line.t_ns, self.line.device.set_fault(self.line.t_ns, "emergency", 1.0))

    def collect(self) -> None:
        """Take what was put out since."""
        if isinstance(self.line, NodeBus):
            self._seen += self.line.pulses
            self.line.pulses.clear()
        elif isinstance(self.line.device, SimulatedDevice):
            self._seen += pulses_of(self.line.device.take_record())


@dataclass(eq=False)
class WatchedTime(SimulatedTime):
    """As it passes, the person watches."""

    person: StimulatorPerson = field(kw_only=True)

    def wait(self, until_ns: int, descriptor: int | None) -> None:
        """As :meth:`SimulatedTime.wait`."""
        super().wait(until_ns, descriptor)
        self.person.watch()


def stimulator_session(kind: str) -> Session:
    """Settings of a session with one channel on a simulated stimulator."""
    channel = {
        "name": "dummy load", "number": 0, "foot": "right_foot", "electrode_area_cm2": 25.0, "current_ma": 10.0,
        "pulse_width_us": 200.0, "frequency_hz": 25.0, "limits": LIMITS,
    }  # fmt: skip
    options = {"accept_watchdog_s": 2.0} if kind == "p24_mid_level" else {}
    stimulator = {"device": kind, "port": "in process", "options": options}
    data: dict[str, Any] = {"name": "qualification", "channels": [channel], "stimulator": stimulator}
    return exercise_of(validate_session(data, Path("simulated")), 0, Path("simulated"))


def simulated_stimulator(
    kind: str, device: SimulatedDevice | None = None, bus: NodeBus | None = None
) -> StimulatorBench:
    """A bench with a simulated stimulator of this kind; the ``device`` on its line, or the ``bus``, may be another."""
    session = stimulator_session(kind)
    opener: Callable[[int], Port]
    line: DeviceLine | NodeBus
    if kind == "can":
        line = node = bus or NodeBus(1, START_NS)
        sessions = iter(range(SESSION_ID % APART, 1 << 16, APART))

        def open_on_bus(t_ns: int) -> Port:
            port = CanStimulator(node, next(sessions), in_real_time=True, clock_ns=node.clock_ns)
            port.open(t_ns, clock_ns=node.clock_ns)
            return port

        opener = open_on_bus
    else:
        make = ScienceMode2Device if kind == "rehastim2" else ScienceMode4Device
        line = wire = DeviceLine(device or make(START_NS), START_NS)

        def open_on_line(t_ns: int) -> Port:
            port = open_stimulator(session.stimulator, session, SESSION_ID, lambda *_: wire)
            port.open(t_ns, clock_ns=wire.clock_ns)  # type: ignore[call-arg]  # an extension's need not have one
            return port

        opener = open_on_line
    person = StimulatorPerson(line)
    return StimulatorBench(session, opener, WatchedTime(line, person=person), person)
