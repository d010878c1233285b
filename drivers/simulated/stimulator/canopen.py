"""A simulated CANopen stimulator, made with the ``canopen`` package (optional): every SYNC is a pulse.

``CanOpenDevice`` answers SDOs in the package's own thread, sends a heartbeat, and writes each pulse into its record.
Needs the extra ``canopen``. As a process of its own: ``python -m drivers.simulated.stimulator.canopen``.
"""

import argparse
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import can
import canopen
from canopen.objectdictionary import UNSIGNED8, ObjectDictionary, ODArray, ODVariable

from drivers.simulated.lines import add_bus_options, bus_of, publish_ready
from drivers.simulated.record import RecordEntry, RecordWriter
from drivers.stimulator.bus import LOOPBACK, BusError, open_bus
from drivers.stimulator.canopen_port import SYNC_ID

CURRENT_INDEX: Final = 0x3200
WIDTH_INDEX: Final = 0x3201
CURRENT_STEP_MA: Final = 0.5
WIDTH_STEP_US: Final = 2.0
CHANNELS: Final = 8
HEARTBEAT_MS: Final = 100


def object_dictionary() -> ObjectDictionary:
    """Currents and widths of all channels, and the heartbeat's period."""
    make: Any = ObjectDictionary  # the package's annotations leave its constructor out
    dictionary: ObjectDictionary = make()
    for name, index in (("current", CURRENT_INDEX), ("width", WIDTH_INDEX)):
        array = ODArray(name, index)
        for subindex in range(CHANNELS + 1):
            variable = ODVariable(f"{name} {subindex}", index, subindex)
            variable.data_type = UNSIGNED8
            variable.default, variable.access_type = (0, "rw") if subindex else (CHANNELS, "ro")
            array.add_member(variable)
        dictionary.add_object(array)
    heartbeat = ODVariable("producer heartbeat time", 0x1017, 0)
    heartbeat.data_type = canopen.objectdictionary.UNSIGNED16
    heartbeat.default = HEARTBEAT_MS
    dictionary.add_object(heartbeat)
    return dictionary


class CanOpenDevice:
    """On an open bus, which it then owns; stops with :meth:`close`."""

    def __init__(self, bus: can.BusABC, node_id: int, record: Path | None = None) -> None:
        self._record = RecordWriter(record)
        self._lock = threading.Lock()
        self._pulses: list[RecordEntry] = []
        self._network = canopen.Network(bus)
        self._network.connect()
        self._node: Any = canopen.LocalNode(node_id, object_dictionary())
        self._network.add_node(self._node)
        self._network.subscribe(SYNC_ID, self._sync)
        self._node.nmt.state = "PRE-OPERATIONAL"
        self._node.nmt.start_heartbeat(HEARTBEAT_MS)

    @property
    def pulses(self) -> list[RecordEntry]:
        """All delivered so far."""
        with self._lock:
            return list(self._pulses)

    def value(self, index: int, channel: int) -> int:
        """What an entry holds."""
        return int(self._node.sdo[index][channel + 1].raw)

    def restart(self) -> None:
        """As after a loss of power: all values 0, pre-operational, boot-up message."""
        for channel in range(CHANNELS):
            self._node.sdo[CURRENT_INDEX][channel + 1].raw = 0
            self._node.sdo[WIDTH_INDEX][channel + 1].raw = 0
        self._node.nmt.state = "INITIALISING"
        self._node.nmt.state = "PRE-OPERATIONAL"

    def mute(self) -> None:
        """Its heartbeat stops."""
        self._node.nmt.stop_heartbeat()

    def close(self) -> None:
        """Off the bus."""
        self._node.nmt.stop_heartbeat()
        self._network.disconnect()
        self._record.close()

    def _sync(self, identifier: int, data: bytearray, timestamp: float) -> None:
        if self._node.nmt.state != "OPERATIONAL":
            return
        now_ns = time.monotonic_ns()
        with self._lock:
            for channel in range(CHANNELS):
                current_ma = self.value(CURRENT_INDEX, channel) * CURRENT_STEP_MA
                width_us = self.value(WIDTH_INDEX, channel) * WIDTH_STEP_US
                if current_ma and width_us:
                    entry = RecordEntry(now_ns, "pulse", channel, current_ma, width_us, last_pulse_ns=now_ns)
                    self._pulses.append(entry)
                    self._record.write([entry])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the device until its stdin closes; exit status 2 when the bus cannot be opened."""
    parser = argparse.ArgumentParser(prog="canopen_device", description="A simulated CANopen stimulator.")
    add_bus_options(parser, LOOPBACK)
    parser.add_argument("--node-id", type=int, default=1, help="1 to 127 (default %(default)s)")
    parser.add_argument("--record", type=Path, help="write what was delivered to this file, JSON lines")
    options = parser.parse_args(arguments)
    wanted = frozenset((0x000, SYNC_ID, 0x600 + options.node_id))
    try:
        bus = open_bus(bus_of(options), wanted)
    except BusError as error:
        print(f"canopen_device: {error}", file=sys.stderr)
        return 2
    device = CanOpenDevice(bus, options.node_id, options.record)
    publish_ready()
    sys.stdin.read()
    device.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
