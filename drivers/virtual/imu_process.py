"""A simulated inertial sensor as a process of its own: ``python -m drivers.virtual.imu_process --device xbus``.

It owns its end of a pseudo-terminal, a TCP port, a CAN bus or an LSL outlet, says in one JSON line how it is reached,
and takes faults as JSON lines ``{"fault": NAME, "value": NUMBER}`` on stdin, each confirmed. It keeps its beat by
absolute deadlines.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import can

from drivers.stimulator.bus import open_bus
from drivers.virtual.can_node import become_real_time
from drivers.virtual.device_lines import DeviceEnd, PtyEnd, TcpEnd
from drivers.virtual.imu_device import SimulatedImu
from drivers.virtual.imu_signal import recorded, walking
from drivers.virtual.imu_wire import CAN_RECORD, LSL_RECORD, LslWire, Wire, XbusWire, Ximu3Wire, XsensCanWire
from drivers.virtual.line_faults import LINE_FAULTS, LineFaults
from fes.config import Bus
from fes.signals import NS_PER_S

_STDIN: Final = 0
LABELS: Final = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")


class CanEnd:
    """Records of ``CAN_RECORD`` as frames on a bus."""

    def __init__(self, settings: Bus) -> None:
        self.port = "bus"
        self._bus: can.BusABC | None = open_bus(settings, frozenset())

    def descriptors(self) -> list[int]:
        """Nothing is listened to."""
        return []

    def read(self) -> bytes:
        """Nothing."""
        return b""

    def write(self, data: bytes) -> None:
        """Frames that the bus does not take are lost."""
        for number, length, payload in CAN_RECORD.iter_unpack(data):
            message = can.Message(arbitration_id=number & 0x7FF, is_extended_id=False, data=payload[: min(length, 8)])
            with contextlib.suppress(can.CanError, OSError):
                if self._bus is not None:
                    self._bus.send(message, timeout=0)

    def unplug(self) -> None:
        """Leave the bus."""
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None


class LslEnd:
    """Records of ``LSL_RECORD`` as samples of an outlet."""

    def __init__(self, name: str, rate_hz: float) -> None:
        lsl = importlib.import_module("pylsl")
        info = lsl.StreamInfo(name, "IMU", len(LABELS), rate_hz, "double64", f"{name}-{os.getpid()}")
        channels = info.desc().append_child("channels")
        for label in LABELS:
            channel = channels.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("unit", "m/s2" if label.startswith("acc") else "rad/s")
        self.port = name
        self._outlet: Any = lsl.StreamOutlet(info, 1)

    def descriptors(self) -> list[int]:
        """Nothing is listened to."""
        return []

    def read(self) -> bytes:
        """Nothing."""
        return b""

    def write(self, data: bytes) -> None:
        """Push them with the device's stamps."""
        for stamp_s, *values in LSL_RECORD.iter_unpack(data):
            if self._outlet is not None:
                self._outlet.push_sample(values, stamp_s)

    def unplug(self) -> None:
        """The stream ends."""
        self._outlet = None


class ImuLoop:
    """Sensor, line and faults: one wait per turn, until the next sample or byte."""

    def __init__(self, device: SimulatedImu, end: DeviceEnd, wake: int) -> None:
        self._device = device
        self._end = end
        self._wake = wake
        self._faults = LineFaults()
        self._typed = b""

    def run(self) -> None:
        """Until a signal or the end of stdin."""
        while self._turn():
            pass

    def _turn(self) -> bool:
        now_ns = time.monotonic_ns()
        self._put_out(now_ns, self._device.advance(now_ns))
        deadline_ns = min(self._device.next_deadline_ns(), self._faults.next_deadline_ns())
        wait_s = max(0.0, (deadline_ns - time.monotonic_ns()) / NS_PER_S)
        line = self._end.descriptors()
        ready, _, _ = select.select([self._wake, _STDIN, *line], [], [], wait_s)
        if self._wake in ready or (_STDIN in ready and not self._listen()):
            return False
        if any(descriptor in ready for descriptor in line) and (data := self._end.read()):
            now_ns = time.monotonic_ns()
            self._put_out(now_ns, self._device.receive(now_ns, data))
        return True

    def _put_out(self, now_ns: int, messages: list[bytes]) -> None:
        self._faults.send(now_ns, messages)
        if data := self._faults.due(now_ns):
            self._end.write(data)

    def _listen(self) -> bool:
        data = os.read(_STDIN, 4096)
        *lines, self._typed = (self._typed + data).split(b"\n")
        for line in lines:
            try:
                asked = json.loads(line)
                self._fault(str(asked["fault"]), float(asked.get("value", 1)))
                answer = {"done": asked["fault"], "t_ns": time.monotonic_ns()}
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                answer = {"error": f"{line.decode(errors='replace')!r}: {error}"}
            print(json.dumps(answer), flush=True)
        return bool(data)

    def _fault(self, name: str, value: float) -> None:
        now_ns = time.monotonic_ns()
        if name == "unplug":
            self._end.unplug()
        elif name in LINE_FAULTS:
            self._faults.set(name, value)
        else:
            self._put_out(now_ns, self._device.set_fault(now_ns, name, value))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the sensor until told to stop; exit status 2 when the settings are wrong."""
    parser = argparse.ArgumentParser(prog="imu_process", description="A simulated inertial sensor.")
    parser.add_argument("--device", choices=("xbus", "ximu3", "xsens_can", "lsl"), required=True)
    parser.add_argument("--line", choices=("pty", "tcp"), default="pty", help="for xbus and ximu3")
    parser.add_argument("--sensor", default="right_foot", help="whose movement (default %(default)s)")
    parser.add_argument("--recording", type=Path, help="play this instead of a simulated walk")
    parser.add_argument("--rate", type=float, default=100.0, help="Hz")
    parser.add_argument("--offset", type=float, default=0.0, help="of its clock at the start, s")
    parser.add_argument("--drift", type=float, default=0.0, help="of its clock, ppm")
    parser.add_argument("--bus", help="CAN bus, as JSON")
    parser.add_argument("--id-offset", type=int, default=0)
    parser.add_argument("--name", default="imu", help="of the LSL stream")
    options = parser.parse_args(arguments)
    signalled, wake = socket.socketpair()
    wake.setblocking(False)
    signal.set_wakeup_fd(wake.fileno())
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    try:
        if options.recording is not None:
            feels = recorded(options.recording, options.sensor, options.rate)
        else:
            feels = walking(options.sensor, options.rate)
        wire, end = _line(options)
    except (ValueError, RuntimeError, ImportError) as error:
        print(f"imu_process: {error}", file=sys.stderr)
        return 2
    real_time = become_real_time()
    now_ns = time.monotonic_ns()
    device = SimulatedImu(wire, feels, now_ns, offset_s=options.offset, drift_ppm=options.drift)
    ready = {"ready": True, "port": end.port, "pid": os.getpid(), "real_time": real_time, "t0_ns": now_ns}
    print(json.dumps(ready), flush=True)
    try:
        ImuLoop(device, end, signalled.fileno()).run()
    finally:
        end.unplug()
    return 0


def _line(options: argparse.Namespace) -> tuple[Wire, DeviceEnd]:
    if options.device == "xsens_can":
        return XsensCanWire(options.id_offset), CanEnd(Bus.model_validate_json(options.bus or "{}"))
    if options.device == "lsl":
        return LslWire(), LslEnd(options.name, options.rate)
    wire: Wire = XbusWire(options.rate) if options.device == "xbus" else Ximu3Wire()
    return wire, PtyEnd() if options.line == "pty" else TcpEnd()


if __name__ == "__main__":
    sys.exit(main())
