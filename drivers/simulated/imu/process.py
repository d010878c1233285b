"""A simulated inertial sensor as a process of its own: ``python -m drivers.simulated.imu.process --device xbus``.

It owns its end of a pseudo-terminal, a TCP or UDP port, a CAN bus or an LSL outlet, prints in one JSON line how it is
reached, and takes faults on stdin (:mod:`drivers.simulated.lines`). It keeps its beat by absolute deadlines.
"""

import argparse
import contextlib
import importlib
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from drivers.simulated.imu import wire as wires
from drivers.simulated.imu.device import SimulatedImu, recorded_signal, walking_signal
from drivers.simulated.imu.serial_wires import SERIAL_WIRES, on_its_line, serial_wire
from drivers.simulated.lines import (
    CanEnd,
    DeviceEnd,
    DeviceLoop,
    PtyEnd,
    TcpEnd,
    UdpEnd,
    become_real_time,
    publish_ready,
    stop_signals,
)
from fes.config import Bus


class LslEnd(DeviceEnd):
    """Records of ``LSL_RECORD`` as samples of an outlet."""

    def __init__(self, name: str, rate_hz: float) -> None:
        lsl = importlib.import_module("pylsl")
        info = lsl.StreamInfo(name, "IMU", len(wires.AXES), rate_hz, "double64", f"{name}-{os.getpid()}")
        channels = info.desc().append_child("channels")
        for label in wires.AXES:
            channel = channels.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("unit", "m/s2" if label.startswith("acc") else "rad/s")
        self.port = name
        self._outlet: Any = lsl.StreamOutlet(info, 1)

    def write(self, data: bytes) -> None:
        """Push them with the device's stamps."""
        for stamp_s, *values in wires.LSL_RECORD.iter_unpack(data):
            if self._outlet is not None:
                self._outlet.push_sample(values, stamp_s)

    def unplug(self) -> None:
        """The stream ends."""
        self._outlet = None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the sensor until a signal ends it; exit status 2 when the settings are wrong."""
    parser = argparse.ArgumentParser(prog="imu_process", description="A simulated inertial sensor.")
    parser.add_argument("--device", choices=(*SERIAL_WIRES, "xsens_can", "dbc_can", "lsl"), required=True)
    parser.add_argument("--line", choices=("pty", "tcp", "udp"), default="pty", help="for serial sensors")
    parser.add_argument("--sensor", default="right_foot", help="whose movement (default %(default)s)")
    parser.add_argument("--recording", type=Path, help="play this instead of a simulated walk")
    parser.add_argument("--rate", type=float, default=100.0, help="Hz")
    parser.add_argument("--offset", type=float, default=0.0, help="of its clock at the start, s")
    parser.add_argument("--drift", type=float, default=0.0, help="of its clock, ppm")
    parser.add_argument("--bus", help="CAN bus, as JSON")
    parser.add_argument("--id-offset", type=int, default=0, help="for xsens_can")
    parser.add_argument("--options", default="{}", help="for dbc_can: the options of the session's settings, as JSON")
    parser.add_argument("--name", default="imu", help="of the LSL stream")
    parser.add_argument("--serial", help="of an xbus sensor, 8 hex digits, or of a capture2go, 6 characters")
    parser.add_argument("--record", type=Path, help="where to put down, as JSON lines, when which sample was played")
    options = parser.parse_args(arguments)
    stop = stop_signals()
    try:
        wire, end = _line(options)
        played, sensor, rate_hz = options.recording, options.sensor, options.rate
        feels = recorded_signal(played, sensor, rate_hz) if played else walking_signal(sensor, rate_hz)
    except (ValueError, RuntimeError, ImportError, OSError) as error:
        print(f"imu_process: {error}", file=sys.stderr)
        return 2
    real_time = become_real_time()
    now_ns = time.monotonic_ns()
    with contextlib.ExitStack() as stack:
        stack.callback(end.unplug)
        record = stack.enter_context((options.record or Path(os.devnull)).open("w", encoding="utf-8", buffering=1))

        def jumped(t_ns: int, played: int) -> None:
            print(json.dumps({"t_ns": t_ns, "played": played}), file=record)

        imu = SimulatedImu(wire, feels, now_ns, offset_s=options.offset, drift_ppm=options.drift, jumped=jumped)
        device = on_its_line(options.device, imu, now_ns)
        publish_ready(port=end.port, real_time=real_time, t0_ns=now_ns)
        DeviceLoop(device, end, stop.fileno()).run()
    return 0


def _line(options: argparse.Namespace) -> tuple[wires.Wire, DeviceEnd]:
    if options.device == "lsl":
        return wires.LslWire(), LslEnd(options.name, options.rate)
    if options.device in SERIAL_WIRES:
        ends: dict[str, type[PtyEnd | TcpEnd | UdpEnd]] = {"pty": PtyEnd, "tcp": TcpEnd, "udp": UdpEnd}
        return serial_wire(options.device, options.rate, options.serial), ends[options.line]()
    xsens = options.device == "xsens_can"
    wire = wires.XsensCanWire(options.id_offset) if xsens else wires.DbcWire(json.loads(options.options))
    return wire, CanEnd(Bus.model_validate_json(options.bus or "{}"))


if __name__ == "__main__":
    sys.exit(main())
