"""A virtual patient as a process of its own: ``python -m fes.hil.closed_loop.patient_process --pulses SOCKET``.

It stands between the stimulator and the sensors: pulses that a simulated stimulator has delivered come in over the
socket, and each worn sensor speaks Xbus on a pseudo-terminal of its own. It keeps real time by absolute deadlines and
counts how late it was. It says in one JSON line how its sensors are reached, then a line ``{"stride": …}`` for each
stride of the affected foot, and at the end ``{"summary": …}``. On stdin it takes JSON lines, each confirmed:

- ``{"do": "walk"}``, and whatever else :mod:`fes.simulation.forward.closed_loop` knows, with ``value``;
- ``{"fault": NAME, "value": NUMBER, "sensor": NAME}`` as simulated sensors do, without ``sensor`` for all of them;
- ``{"hold": true}``: one who walks in turns (``--cycle``) stands until ``false``;
- ``{"replug": SENSOR}``, answered with the new port; ``{"ask": "summary"}``; ``{"begin": true}`` after ``--held``.
"""

from __future__ import annotations

import argparse
import json
import select
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from drivers.simulated.line_faults import LINE_FAULTS, LineFaults
from drivers.simulated.lines import PtyEnd
from drivers.simulated.process_end import STDIN, CommandReader, become_real_time, publish_ready, stop_signals
from drivers.simulated.pulses import PulseInlet
from fes.hil.closed_loop.patient_device import HELD, PatientDevice
from fes.signals import NS_PER_S, SENSORS
from fes.simulation.forward.closed_loop import intervene
from fes.simulation.forward.settings import from_plain

LONGEST_WAIT_S: Final = 1.0


class PatientLoop:
    """Patient, lines and socket: one wait per turn, until the next sample or byte."""

    def __init__(self, device: PatientDevice, sensors: Sequence[str], inlet: PulseInlet, wake: int) -> None:
        self._device = device
        self._inlet = inlet
        self._wake = wake
        self.ends = {sensor: PtyEnd() for sensor in sensors}
        self._faults = {sensor: LineFaults() for sensor in sensors}
        self._commands = CommandReader(self._execute)

    def run(self) -> None:
        """Until a signal or the end of stdin."""
        while self._turn():
            pass

    def close(self) -> None:
        """Pull every plug."""
        for end in self.ends.values():
            end.unplug()
        self._inlet.close()

    def _turn(self) -> bool:
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
        if "do" in command:
            intervene(self._device.patient, str(command["do"]), float(command.get("value", 0.0)))
        elif "hold" in command:
            self._device.hold(bool(command["hold"]))
        elif "begin" in command:
            start_ns = time.monotonic_ns()
            self._device.begin(start_ns)
            return {"done": True, "start_ns": start_ns}
        elif "replug" in command:
            sensor = str(command["replug"])
            self.ends[sensor].unplug()
            self.ends[sensor] = PtyEnd()
            return {"done": True, "port": self.ends[sensor].port}
        elif "ask" in command:
            return {"done": True, "summary": self._device.counts.to_dict(), "now_s": self._device.now_s}
        else:
            for sensor in [str(command["sensor"])] if command.get("sensor") else list(self.ends):
                self._inject(sensor, str(command["fault"]), float(command.get("value", 1)))
        return {"done": True}

    def _inject(self, sensor: str, name: str, value: float) -> None:
        now_ns = time.monotonic_ns()
        if name == "unplug":
            self.ends[sensor].unplug()
        elif name in LINE_FAULTS:
            self._faults[sensor].set(name, value)
        else:
            self._put_out(sensor, now_ns, self._device.set_fault(sensor, now_ns, name, value))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the patient until a signal ends it; exit status 2 when the settings are wrong."""
    parser = argparse.ArgumentParser(prog="patient_process", description="A virtual patient with worn sensors.")
    parser.add_argument("--pulses", type=Path, required=True, help="socket that delivered pulses come to")
    parser.add_argument("--settings", default="{}", help="who it is: fes.simulation.forward.PatientSettings as JSON")
    parser.add_argument("--cycle", type=float, nargs=2, metavar=("WALK_S", "STAND_S"), help="walk and stand in turns")
    parser.add_argument("--waits", action="store_true", help="stand until it is to walk")
    parser.add_argument("--held", action="store_true", help="its time begins with a command, not at once")
    options = parser.parse_args(arguments)
    stop = stop_signals()
    try:
        settings = from_plain(json.loads(options.settings))
        PatientDevice(settings, 0).advance(NS_PER_S, [])  # everything compiled before time begins
        inlet = PulseInlet(options.pulses)
    except (ValueError, TypeError, OSError) as error:
        print(f"patient_process: {error}", file=sys.stderr)
        return 2
    cycle_s = None if options.cycle is None else (options.cycle[0], options.cycle[1])
    worn = [sensor for sensor in SENSORS if sensor in settings.sensors]
    real_time = become_real_time()
    start_ns = HELD if options.held else time.monotonic_ns()
    device = PatientDevice(settings, start_ns, cycle_s=cycle_s, waits=options.waits)
    loop = PatientLoop(device, worn, inlet, stop.fileno())
    publish_ready(ports={sensor: end.port for sensor, end in loop.ends.items()}, start_ns=start_ns, real_time=real_time)
    try:
        loop.run()
    finally:
        loop.close()
        print(json.dumps({"summary": device.counts.to_dict()}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
