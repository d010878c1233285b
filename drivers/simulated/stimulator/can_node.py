"""The simulated CAN stimulator as a process of its own: ``python -m drivers.simulated.stimulator.can_node``.

A real stimulator's lease does not depend on the controller's computer; so this node has its own process, its own
clock and loop, and asks for real-time scheduling where it may. It prints one JSON line when it is ready and ends
on SIGTERM, SIGINT, or (``--until-stdin-closes``) when the process that started it is gone. Faults while it runs are
JSON lines ``{"fault": NAME, "value": NUMBER}`` on stdin, each confirmed: the node's own, and those of its line
(:mod:`drivers.simulated.lines`) for what it sends.
"""

import argparse
import contextlib
import secrets
import select
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import can

from drivers.simulated import lines
from drivers.simulated.imu.wire import CAN_RECORD
from drivers.simulated.lines import LINE_FAULTS, STDIN, CommandReader, LineFaults
from drivers.simulated.record import PulseOutlet, RecordWriter
from drivers.simulated.stimulator.firmware import StimulatorNode, parse_faults
from drivers.stimulator.bus import MULTICAST, BusError, open_bus
from drivers.stimulator.can_codec import CONTROLLER_IDS, Frame
from fes.config import Bus
from fes.signals import NS_PER_S

FRAMES_AT_ONCE: Final = 64
READ_ERRORS_IN_A_ROW: Final = 100


class BusBroken(RuntimeError):
    """The node's bus cannot be read any more."""


@dataclass(eq=False)
class NodeLoop:
    """Node, bus, record and the descriptors that end it: one wait per turn, until the next deadline or frame."""

    node: StimulatorNode
    bus: can.BusABC
    record: RecordWriter
    stop: Sequence[int]
    pulses: PulseOutlet = field(default_factory=lambda: PulseOutlet(None))

    def __post_init__(self) -> None:
        self._read_errors = 0
        self._faults = LineFaults()
        self._commands = CommandReader(lines.fault_commands(self._inject))

    def run(self) -> None:
        """Until a stop descriptor speaks. The outputs are off afterwards.

        BusBroken: reading failed a hundred times in a row.
        """
        try:
            while self._turn():
                pass
        finally:
            self.node.power_off(time.monotonic_ns())
            self.record.write(self.node.take_record())

    def _turn(self) -> bool:
        self._put_out(self.node.advance(time.monotonic_ns()))
        deadline_ns = min(self.node.next_deadline_ns(), self._faults.next_deadline_ns())
        wait_s = max(0.0, (deadline_ns - time.monotonic_ns()) / NS_PER_S)
        ready, _, _ = select.select([self.bus.fileno(), *self.stop], [], [], wait_s)
        for descriptor in self.stop:  # a signal ends the node, so does the end of stdin, but not what is sent there
            if descriptor in ready and (descriptor != STDIN or not self._commands.read()):
                return False
        if self.bus.fileno() in ready:
            for _ in range(FRAMES_AT_ONCE):
                message = self._read()
                if message is None:
                    break
                if message.is_extended_id or message.is_remote_frame or message.is_error_frame:
                    continue
                self._put_out(self.node.receive(time.monotonic_ns(), message.arbitration_id, bytes(message.data)))
        return True

    def _put_out(self, frames: list[Frame]) -> None:
        self.pulses.send_made(channel.made for channel in self.node.channels)
        now_ns = time.monotonic_ns()
        self._faults.send(now_ns, [CAN_RECORD.pack(identifier, len(data), data) for identifier, data in frames])
        for identifier, length, data in CAN_RECORD.iter_unpack(self._faults.due(now_ns)):
            # a node whose answers do not get out still keeps its leases; the controller sees the silence
            with contextlib.suppress(can.CanError, OSError):
                message = can.Message(arbitration_id=identifier, data=data[:length], is_extended_id=False)
                self.bus.send(message, timeout=0)
        self.record.write(self.node.take_record())

    def _read(self) -> can.Message | None:
        try:
            message = self.bus.recv(timeout=0.0)
        except (can.CanError, OSError) as error:  # a datagram that is no CAN frame, or a bus that is gone
            self._read_errors += 1
            if self._read_errors >= READ_ERRORS_IN_A_ROW:
                raise BusBroken(f"{self.bus.channel_info}: cannot be read: {error}") from error
            return None
        self._read_errors = 0
        return message

    def _inject(self, name: str, value: float) -> None:
        if name in LINE_FAULTS:
            self._faults.set(name, value)
        else:
            self.node.set_fault(time.monotonic_ns(), name, value)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until a signal ends it; exit status 2 when the settings are wrong, 1 when the bus broke."""
    parser = argparse.ArgumentParser(prog="can_node", description="A simulated CAN stimulator in its own process.")
    parser.add_argument(
        "--interface", default=MULTICAST, help="python-can interface, or loopback (default %(default)s)"
    )
    parser.add_argument("--channel", default=Bus().channel, help="channel of the interface (default %(default)s)")
    parser.add_argument("--port", type=int, help="UDP port, for udp_multicast and loopback")
    parser.add_argument("--boot-id", type=int, help="0 to 65535; default: random")
    parser.add_argument("--record", type=Path, help="write what was delivered to this file, JSON lines")
    parser.add_argument("--pulses", type=Path, help="send each pulse to the socket of this name")
    parser.add_argument("--faults", default="", help="electrode=CH,weak=CH,drop=N,reboot=SECONDS,mute=SECONDS")
    parser.add_argument("--until-stdin-closes", action="store_true", help="end when the starting process is gone")
    options = parser.parse_args(arguments)
    boot_id = secrets.randbelow(2**16) if options.boot_id is None else options.boot_id
    if not 0 <= boot_id < 2**16:
        parser.error(f"--boot-id {boot_id} is not within 0 to 65535")
    try:
        faults = parse_faults(options.faults)
    except ValueError as error:
        parser.error(f"--faults: {error}")
    port: dict[str, str | int | float | bool] = {} if options.port is None else {"port": options.port}
    settings = Bus(interface=options.interface, channel=options.channel, options=port)
    signalled = lines.stop_signals()
    stop = [signalled.fileno()] + ([STDIN] if options.until_stdin_closes else [])
    try:
        record = RecordWriter(options.record)
        bus = open_bus(settings, CONTROLLER_IDS)
    except (BusError, OSError) as error:
        print(f"can_node: {error}", file=sys.stderr)
        return 2
    real_time = lines.become_real_time()
    node = StimulatorNode(boot_id, time.monotonic_ns(), faults)
    lines.publish_ready(boot_id=boot_id, real_time=real_time)
    try:
        NodeLoop(node, bus, record, stop, PulseOutlet(options.pulses)).run()
    except BusBroken as error:
        print(f"can_node: {error}", file=sys.stderr)
        return 1
    finally:
        record.close()
        bus.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
