"""A virtual patient as a process of its own: ``python -m fes.hil.closed_loop.patient_process --pulses SOCKET``.

It stands between the stimulator and the sensors: pulses that a simulated stimulator has delivered come in over the
socket, and each worn sensor speaks on a pseudo-terminal of its own. It keeps real time by absolute deadlines and
counts how late it was. It says in one JSON line how its sensors are reached, then a line ``{"stride": …}`` for each
stride of the affected foot, and at the end ``{"summary": …}``. On stdin it takes JSON lines, each confirmed:

- ``{"do": "walk"}``, and whatever else :mod:`fes.simulation.forward.closed_loop` knows, with ``value``;
- ``{"fault": NAME, "value": NUMBER, "sensor": NAME}`` as simulated sensors do, without ``sensor`` for all of them;
- ``{"hold": true}``: one who walks in turns stands until ``false``;
- ``{"replug": SENSOR}``, answered with the new port; ``{"ask": "summary"}``; ``{"begin": true}`` to one who is held.

The patient as a device has no I/O and no clock: the host's time and delivered pulses in, the messages of its worn
sensors out. It is advanced by one sampling interval at a time, so that the same pulses give the same samples however
late the process was woken.
"""

import argparse
import json
import math
import select
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.simulated.imu.device import ImuSignal, Radio, SimulatedImu
from drivers.simulated.imu.serial_wires import Air, on_its_line, serial_wire
from drivers.simulated.lines import (
    LINE_FAULTS,
    STDIN,
    CommandReader,
    LineFaults,
    PtyEnd,
    become_real_time,
    publish_ready,
    stop_signals,
)
from drivers.simulated.record import Pulse, PulseInlet
from fes.signals import G_MPS2, NS_PER_S, SENSORS
from fes.simulation.forward import DeliveredPulse, PatientSettings, VirtualPatient, VirtualStride
from fes.simulation.forward.closed_loop import intervene
from fes.simulation.forward.settings import from_plain

REMEMBERED_S: Final = 60.0
HELD: Final = 1 << 62
LATE_NS: Final = 5_000_000  # a sample that goes out later than this is counted
LONGEST_WAIT_S: Final = 1.0


@dataclass(slots=True)
class Punctuality:
    """How well a patient kept real time, and what reached it.

    ``late_5ms``: intervals whose samples went out more than 5 ms after their moment. ``pulses_late``: pulses that came
    after the muscle should have answered, which acted at once instead.
    """

    intervals: int = 0
    latest_ms: float = 0.0
    late_5ms: int = 0
    pulses: int = 0
    pulses_late: int = 0
    charge_uc: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """For summaries."""
        return {**asdict(self), "latest_ms": round(self.latest_ms, 3), "charge_uc": round(self.charge_uc, 3)}


@dataclass(frozen=True, slots=True)
class Life:
    """How a patient lives.

    ``cycle_s``: walk and stand in turns, so many seconds each; None: walk on after ``settings.stand_s``. ``waits``:
    stand until it is to walk. ``held``: its time begins with a command; until then its sensors, of the kind
    ``sensors``, are silent.
    """

    cycle_s: tuple[float, float] | None = None
    waits: bool = False
    held: bool = False
    sensors: str = "xbus"


class PatientDevice:
    """Call :meth:`advance` at every deadline, and :meth:`receive` for bytes from the host to a sensor.

    Its time begins at the host's ``start_ns``, :data:`HELD`: with :meth:`begin`.
    """

    def __init__(self, settings: PatientSettings, start_ns: int, life: Life = Life()) -> None:
        self._kind, self._air = life.sensors, Air()
        self.patient = VirtualPatient(settings, remember_s=REMEMBERED_S)
        self.counts = Punctuality()
        self.held = False  # one who walks in turns: stand, once the steps are finished, for as long as this holds
        self._start_ns = start_ns
        self._step_ns = round(NS_PER_S / settings.rate_hz)
        self._delay_ns = round(settings.muscle.delay_s * NS_PER_S)
        self._interval = 0
        self._cycle_s = life.cycle_s
        self._walked, self._changed_ns = False, 0
        self._read_strides = 0
        if life.waits or life.cycle_s:
            self.patient.stay()
        self._felt = {
            name: ImuSignal(settings.rate_hz, np.zeros((1, 3)), np.zeros((1, 3))) for name in settings.sensors
        }
        self._imus = {name: self._imu(settings, felt) for name, felt in self._felt.items()}

    def _imu(self, settings: PatientSettings, felt: ImuSignal) -> SimulatedImu | Radio:
        imu = settings.imu
        sensor = SimulatedImu(
            serial_wire(self._kind, settings.rate_hz, air=self._air),
            felt,
            self._start_ns + self._step_ns,
            acc_range_g=(imu.acc_range_mps2 or 16.0 * G_MPS2) / G_MPS2,
            gyr_range_dps=math.degrees(imu.gyr_range_radps or math.radians(2000.0)),
        )
        return on_its_line(self._kind, sensor, self._start_ns)

    def begin(self, t_ns: int) -> None:
        """Let the patient's time begin now. ValueError: it has begun."""
        if self._start_ns != HELD:
            raise ValueError("the patient's time has begun already")
        self._start_ns = t_ns
        self._imus = {name: self._imu(self.patient.settings, felt) for name, felt in self._felt.items()}

    def next_deadline_ns(self) -> int:
        """When the next samples are due."""
        return self._start_ns + (self._interval + 1) * self._step_ns

    def advance(self, t_ns: int, pulses: Sequence[Pulse]) -> dict[str, list[bytes]]:
        """All samples due by ``t_ns``, by sensor; ``pulses`` are those sent since the last call."""
        out: dict[str, list[bytes]] = {name: [] for name in self._imus}
        felt = self._feel(pulses)
        while (due_ns := self.next_deadline_ns()) <= t_ns:
            self._interval += 1
            self._cycle()
            for sample in self.patient.advance(self._interval * self._step_ns, felt):
                self._felt[sample.sensor].acc_mps2[0] = sample.acc_mps2
                self._felt[sample.sensor].gyr_radps[0] = sample.gyr_radps
            felt = []
            for name, imu in self._imus.items():
                out[name] += imu.advance(due_ns)
            late_ns = t_ns - due_ns
            self.counts.intervals += 1
            self.counts.late_5ms += late_ns > LATE_NS
            self.counts.latest_ms = max(self.counts.latest_ms, late_ns * 1e-6)
        if felt:  # came between two deadlines
            self.patient.advance(self.patient.now_ns, felt)
        return out

    def receive(self, sensor: str, t_ns: int, data: bytes) -> list[bytes]:
        """Bytes from the host to a sensor; its answers."""
        return self._imus[sensor].receive(t_ns, data)

    def set_fault(self, sensor: str, t_ns: int, name: str, value: float) -> list[bytes]:
        """Bring a sensor's fault about; what it says. ValueError: no such fault or sensor."""
        if sensor not in self._imus:
            raise ValueError(f"no sensor {sensor!r} is worn; there are {', '.join(self._imus)}")
        return self._imus[sensor].set_fault(t_ns, name, value)

    def new_strides(self) -> list[VirtualStride]:
        """The affected foot's strides, complete since the last call."""
        strides = self.patient.strides[self._read_strides :]
        self._read_strides = len(self.patient.strides)
        return [stride for stride in strides if stride.foot == self.patient.settings.affected_foot]

    # --- inside -----------------------------------------------------------------------------------------

    def _feel(self, pulses: Sequence[Pulse]) -> list[DeliveredPulse]:
        felt = []
        for pulse in pulses:
            t_ns = pulse.t_ns - self._start_ns
            if not (math.isfinite(pulse.current_ma) and math.isfinite(pulse.pulse_width_us)) or t_ns < 0:
                continue
            one = DeliveredPulse(t_ns, pulse.channel, pulse.current_ma, pulse.pulse_width_us)
            felt.append(one)
            self.counts.pulses += 1
            self.counts.charge_uc += one.charge_uc
            self.counts.pulses_late += t_ns + self._delay_ns < self.patient.now_ns
        return felt

    def _cycle(self) -> None:
        if self._cycle_s is None:
            return
        walk_s, stand_s = self._cycle_s
        if self.patient.walking != self._walked:
            self._walked, self._changed_ns = self.patient.walking, self.patient.now_ns
        since_s = (self.patient.now_ns - self._changed_ns) / NS_PER_S
        if self.held or (self._walked and since_s >= walk_s):
            self.patient.stop()
        elif not self._walked and since_s >= stand_s:
            self.patient.walk()


class PatientLoop:
    """Patient, lines and socket: one wait per turn, until the next sample or byte."""

    def __init__(self, device: PatientDevice, sensors: Sequence[str], inlet: PulseInlet, wake: int) -> None:
        self._device = device
        self._inlet = inlet
        self._wake = wake
        self.ends = {sensor: PtyEnd() for sensor in sensors}
        self._faults = {sensor: LineFaults() for sensor in sensors}
        self._commands = CommandReader(self._execute)

    def close(self) -> None:
        """Pull every plug."""
        for end in self.ends.values():
            end.unplug()
        self._inlet.close()

    def turn(self) -> bool:
        """One turn; False after a signal or the end of stdin."""
        now_ns = time.monotonic_ns()
        for sensor, messages in self._device.advance(now_ns, self._inlet.receive()).items():
            self._put_out(sensor, now_ns, messages)
        for stride in self._device.new_strides():
            print(json.dumps({"stride": asdict(stride)}), flush=True)
        deadline_ns = min(self._device.next_deadline_ns(), *(f.next_deadline_ns() for f in self._faults.values()))
        wait_s = min(max(0.0, (deadline_ns - time.monotonic_ns()) / NS_PER_S), LONGEST_WAIT_S)
        lines = {line: sensor for sensor, end in self.ends.items() for line in end.descriptors()}
        ready, _, _ = select.select([self._wake, STDIN, *lines], [], [], wait_s)
        if self._wake in ready or (STDIN in ready and not self._commands.read()):
            return False
        for line in ready:
            if line in lines and (data := self.ends[lines[line]].read()):
                now_ns = time.monotonic_ns()
                self._put_out(lines[line], now_ns, self._device.receive(lines[line], now_ns, data))
        return True

    def _put_out(self, sensor: str, now_ns: int, messages: list[bytes]) -> None:
        self._faults[sensor].send(now_ns, messages)
        if data := self._faults[sensor].due(now_ns):
            self.ends[sensor].write(data)

    def _execute(self, command: dict[str, Any]) -> dict[str, Any]:
        answer: dict[str, Any] = {"done": True}
        match command:
            case {"do": what}:
                intervene(self._device.patient, str(what), float(command.get("value", 0.0)))
            case {"hold": held}:
                self._device.held = bool(held)
            case {"begin": _}:
                answer["start_ns"] = time.monotonic_ns()
                self._device.begin(answer["start_ns"])
            case {"replug": str(sensor)}:
                self.ends[sensor].unplug()
                self.ends[sensor] = PtyEnd()
                answer["port"] = self.ends[sensor].port
            case {"ask": _}:
                now_s = self._device.patient.now_ns / NS_PER_S
                answer |= {"summary": self._device.counts.to_dict(), "now_s": now_s}
            case _:
                name, value = str(command["fault"]), float(command.get("value", 1))
                for sensor in [str(command["sensor"])] if command.get("sensor") else list(self.ends):
                    now_ns = time.monotonic_ns()
                    if name == "unplug":
                        self.ends[sensor].unplug()
                    elif name in LINE_FAULTS:
                        self._faults[sensor].set(name, value)
                    else:
                        self._put_out(sensor, now_ns, self._device.set_fault(sensor, now_ns, name, value))
        return answer


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the patient until a signal ends it; exit status 2 when the settings are wrong."""
    parser = argparse.ArgumentParser(prog="patient_process", description="A virtual patient with worn sensors.")
    parser.add_argument("--pulses", type=Path, required=True, help="socket that delivered pulses come to")
    parser.add_argument("--settings", default="{}", help="who it is: fes.simulation.forward.PatientSettings as JSON")
    parser.add_argument("--life", default="{}", help="how it lives: Life as JSON")
    options = parser.parse_args(arguments)
    stop = stop_signals()
    try:
        settings = from_plain(json.loads(options.settings))
        life = Life(**json.loads(options.life))
        PatientDevice(settings, 0, Life(sensors=life.sensors)).advance(NS_PER_S, [])  # compiled before time begins
        inlet = PulseInlet(options.pulses)
    except (ValueError, TypeError, OSError) as error:
        print(f"patient_process: {error}", file=sys.stderr)
        return 2
    worn = [sensor for sensor in SENSORS if sensor in settings.sensors]
    real_time = become_real_time()
    start_ns = HELD if life.held else time.monotonic_ns()
    device = PatientDevice(settings, start_ns, life)
    loop = PatientLoop(device, worn, inlet, stop.fileno())
    publish_ready(ports={sensor: end.port for sensor, end in loop.ends.items()}, start_ns=start_ns, real_time=real_time)
    try:
        while loop.turn():
            pass
    finally:
        loop.close()
        print(json.dumps({"summary": device.counts.to_dict()}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
