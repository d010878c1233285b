"""A simulated inertial sensor as a process of its own: ``python -m drivers.virtual.imu_process --device xbus``.

It owns its end of a pseudo-terminal, a TCP or UDP port, a CAN bus or an LSL outlet, says in one JSON line how it is
reached, and takes faults on stdin (:mod:`drivers.virtual.process_end`). It keeps its beat by absolute deadlines.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from drivers.virtual.device_lines import DeviceEnd, PtyEnd, TcpEnd, UdpEnd
from drivers.virtual.device_loop import DeviceLoop
from drivers.virtual.imu_device import SimulatedImu
from drivers.virtual.imu_lines import CanEnd, LslEnd
from drivers.virtual.imu_signal import recorded, walking
from drivers.virtual.imu_wire import LslWire, Wire, XbusWire, Ximu3Wire, XsensCanWire
from drivers.virtual.process_end import become_real_time, say_ready, stop_signals
from fes.config import Bus


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the sensor until told to stop; exit status 2 when the settings are wrong."""
    parser = argparse.ArgumentParser(prog="imu_process", description="A simulated inertial sensor.")
    parser.add_argument("--device", choices=("xbus", "ximu3", "xsens_can", "dbc_can", "lsl"), required=True)
    parser.add_argument("--line", choices=("pty", "tcp", "udp"), default="pty", help="for xbus and ximu3")
    parser.add_argument("--sensor", default="right_foot", help="whose movement (default %(default)s)")
    parser.add_argument("--recording", type=Path, help="play this instead of a simulated walk")
    parser.add_argument("--rate", type=float, default=100.0, help="Hz")
    parser.add_argument("--offset", type=float, default=0.0, help="of its clock at the start, s")
    parser.add_argument("--drift", type=float, default=0.0, help="of its clock, ppm")
    parser.add_argument("--bus", help="CAN bus, as JSON")
    parser.add_argument("--id-offset", type=int, default=0, help="for xsens_can")
    parser.add_argument("--options", default="{}", help="for dbc_can: the options of the session's settings, as JSON")
    parser.add_argument("--name", default="imu", help="of the LSL stream")
    options = parser.parse_args(arguments)
    stop = stop_signals()
    try:
        wire, end = _line(options)
        if options.recording is not None:
            feels = recorded(options.recording, options.sensor, options.rate)
        else:
            feels = walking(options.sensor, options.rate)
    except (ValueError, RuntimeError, ImportError, OSError) as error:
        print(f"imu_process: {error}", file=sys.stderr)
        return 2
    real_time = become_real_time()
    now_ns = time.monotonic_ns()
    device = SimulatedImu(wire, feels, now_ns, offset_s=options.offset, drift_ppm=options.drift)
    say_ready(port=end.port, real_time=real_time, t0_ns=now_ns)
    try:
        DeviceLoop(device, end, stop.fileno()).run()
    finally:
        end.unplug()
    return 0


def _line(options: argparse.Namespace) -> tuple[Wire, DeviceEnd]:
    if options.device in ("xsens_can", "dbc_can"):
        return _can_wire(options), CanEnd(Bus.model_validate_json(options.bus or "{}"))
    if options.device == "lsl":
        return LslWire(), LslEnd(options.name, options.rate)
    wire: Wire = XbusWire(options.rate) if options.device == "xbus" else Ximu3Wire()
    ends: dict[str, type[PtyEnd | TcpEnd | UdpEnd]] = {"pty": PtyEnd, "tcp": TcpEnd, "udp": UdpEnd}
    return wire, ends[options.line]()


def _can_wire(options: argparse.Namespace) -> Wire:
    if options.device == "xsens_can":
        return XsensCanWire(options.id_offset)
    from drivers.virtual.imu_dbc import DbcWire

    return DbcWire(json.loads(options.options))


if __name__ == "__main__":
    sys.exit(main())
