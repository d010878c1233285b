"""A simulated serial stimulator as a process of its own; it owns its end of the line and its own clock.

It prints one JSON line when it is ready, with the port that the host opens, and takes faults while it runs: JSON lines
``{"fault": NAME, "value": NUMBER}`` on stdin, each confirmed by a line on stdout. It ends on SIGTERM, SIGINT, or when
stdin closes (``--until-stdin-closes``). What it delivered is in its record, pulse by pulse, by CLOCK_MONOTONIC.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import signal
import socket
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from drivers.virtual.can_node import become_real_time
from drivers.virtual.device_lines import DeviceEnd, PtyEnd, TcpEnd
from drivers.virtual.line_faults import LINE_FAULTS, LineFaults, parse_line_faults
from drivers.virtual.node_record import RecordWriter
from drivers.virtual.simulated_device import SimulatedDevice
from fes.signals import NS_PER_S

_STDIN: Final = 0
LONGEST_WAIT_S: Final = 1.0


class DeviceLoop:
    """Device, line, faults and record: one wait per turn, until the next deadline or byte."""

    def __init__(self, device: SimulatedDevice, end: DeviceEnd, record: RecordWriter, wake: int, stdin: bool) -> None:
        self._device = device
        self._end = end
        self._record = record
        self._wake = wake
        self._stdin = stdin
        self._typed = b""
        self._faults = LineFaults()

    def run(self) -> None:
        """Until a signal, or the end of stdin. Everything is off afterwards."""
        try:
            while self._turn():
                pass
        finally:
            self._device.power_off(time.monotonic_ns())
            self._record.write(self._device.take_record())

    def fault(self, name: str, value: float) -> None:
        """Bring a fault about.

        Raises:
            ValueError: no such fault.
        """
        now_ns = time.monotonic_ns()
        if name == "unplug":
            self._end.unplug()
        elif name in LINE_FAULTS:
            self._faults.set(name, value)
        else:
            self._faults.send(now_ns, self._device.set_fault(now_ns, name, value))

    def _turn(self) -> bool:
        now_ns = time.monotonic_ns()
        self._put_out(now_ns, self._device.advance(now_ns))
        deadline_ns = min(self._device.next_deadline_ns(), self._faults.next_deadline_ns())
        wait_s = min(max(0.0, (deadline_ns - time.monotonic_ns()) / NS_PER_S), LONGEST_WAIT_S)
        line = self._end.descriptors()
        ready, _, _ = select.select([self._wake, *([_STDIN] if self._stdin else []), *line], [], [], wait_s)
        if self._wake in ready or (_STDIN in ready and self._stdin and not self._listen()):
            return False
        if any(descriptor in ready for descriptor in line) and (data := self._end.read()):
            now_ns = time.monotonic_ns()
            self._put_out(now_ns, self._device.receive(now_ns, data))
        return True

    def _put_out(self, now_ns: int, messages: list[bytes]) -> None:
        self._faults.send(now_ns, messages)
        self._end.write(self._faults.due(now_ns))
        self._record.write(self._device.take_record())

    def _listen(self) -> bool:
        """What was typed; False at its end."""
        data = os.read(_STDIN, 4096)
        *lines, self._typed = (self._typed + data).split(b"\n")
        for line in lines:
            try:
                asked = json.loads(line)
                self.fault(str(asked["fault"]), float(asked.get("value", 1)))
                answer = {"done": asked["fault"], "t_ns": time.monotonic_ns()}
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                answer = {"error": f"{line.decode(errors='replace')!r}: {error}"}
            print(json.dumps(answer), flush=True)
        return bool(data)


def run_device(name: str, make: Callable[[int], SimulatedDevice], arguments: Sequence[str] | None = None) -> int:
    """Run a device until told to stop; exit status 2 when the settings are wrong."""
    parser = argparse.ArgumentParser(prog=name, description=f"A simulated stimulator ({name}) in its own process.")
    parser.add_argument("--line", choices=("pty", "tcp"), default="pty", help="what the host opens")
    parser.add_argument("--record", type=Path, help="write what was delivered to this file, JSON lines")
    parser.add_argument("--faults", default="", help="electrode=CH,slow=S,garble=N,drop=N,reorder=N,delay=S,mute=1 …")
    parser.add_argument("--until-stdin-closes", action="store_true", help="listen to stdin, and end with it")
    options = parser.parse_args(arguments)
    signalled, wake = socket.socketpair()
    wake.setblocking(False)
    signal.set_wakeup_fd(wake.fileno())
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    end: DeviceEnd = PtyEnd() if options.line == "pty" else TcpEnd()
    record = RecordWriter(options.record)
    real_time = become_real_time()
    device = make(time.monotonic_ns())
    loop = DeviceLoop(device, end, record, signalled.fileno(), options.until_stdin_closes)
    try:
        for fault, value in parse_line_faults(options.faults):
            loop.fault(fault, value)
    except ValueError as error:
        parser.error(f"--faults: {error}")
    print(json.dumps({"ready": True, "pid": os.getpid(), "port": end.port, "real_time": real_time}), flush=True)
    try:
        loop.run()
    finally:
        record.close()
        end.unplug()
    return 0
