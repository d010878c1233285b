"""A simulated serial stimulator as a process of its own; it owns its end of the line and its own clock.

It prints one JSON line when it is ready, with the port that the host opens, and takes faults on stdin while it runs
(:mod:`drivers.simulated.process_end`). It ends on SIGTERM, SIGINT, or when stdin closes (``--until-stdin-closes``).
What it delivered is in its record, pulse by pulse, by CLOCK_MONOTONIC.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from drivers.simulated.line_faults import DeviceLoop, parse_line_faults
from drivers.simulated.lines import DeviceEnd, PtyEnd, TcpEnd
from drivers.simulated.process_end import become_real_time, say_ready, stop_signals
from drivers.simulated.pulses import PulseOutlet
from drivers.simulated.stimulator.firmware import RecordWriter
from drivers.simulated.stimulator.serial_device import SimulatedDevice


def run_device(name: str, make: Callable[[int], SimulatedDevice], arguments: Sequence[str] | None = None) -> int:
    """Run a device until told to stop; everything is off afterwards. Exit status 2 when the settings are wrong."""
    parser = argparse.ArgumentParser(prog=name, description=f"A simulated stimulator ({name}) in its own process.")
    parser.add_argument("--line", choices=("pty", "tcp"), default="pty", help="what the host opens")
    parser.add_argument("--record", type=Path, help="write what was delivered to this file, JSON lines")
    parser.add_argument("--pulses", type=Path, help="tell each pulse to the socket of this name")
    parser.add_argument("--faults", default="", help="electrode=CH,slow=S,garble=N,drop=N,reorder=N,delay=S,mute=1 …")
    parser.add_argument("--until-stdin-closes", action="store_true", help="listen to stdin, and end with it")
    options = parser.parse_args(arguments)
    stop = stop_signals()
    try:
        record = RecordWriter(options.record)
        end: DeviceEnd = PtyEnd() if options.line == "pty" else TcpEnd()
    except OSError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    real_time = become_real_time()
    pulses = PulseOutlet(options.pulses)
    device = make(time.monotonic_ns())

    def keep() -> None:
        entries = device.take_record()
        pulses.of_record(entries)
        record.write(entries)

    loop = DeviceLoop(device, end, stop.fileno(), stdin=options.until_stdin_closes, afterwards=keep)
    try:
        for fault, value in parse_line_faults(options.faults):
            loop.fault(fault, value)
    except ValueError as error:
        parser.error(f"--faults: {error}")
    say_ready(port=end.port, real_time=real_time)
    try:
        loop.run()
    finally:
        device.power_off(time.monotonic_ns())
        keep()
        record.close()
        pulses.close()
        end.unplug()
    return 0
