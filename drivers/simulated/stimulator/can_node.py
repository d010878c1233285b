"""The simulated CAN stimulator as a process of its own: ``python -m drivers.simulated.stimulator.can_node``.

A real stimulator's lease does not depend on the controller's computer; so this node has its own process, its own
clock and loop, and asks for real-time scheduling where it may. Faults while it runs are the node's own, and those of
its line (:mod:`drivers.simulated.lines`) for what it sends.
"""

import secrets
import sys
from collections.abc import Iterable, Sequence

from drivers.simulated.lines import CAN_RECORD, CanEnd, add_bus_options, bus_of
from drivers.simulated.record import Pulse, RecordEntry
from drivers.simulated.stimulator.firmware import StimulatorNode, parse_faults
from drivers.simulated.stimulator.serial_device import StimulatingDevice, run_stimulator, stimulator_parser
from drivers.stimulator.can_codec import CONTROLLER_IDS, Frame


class NodeDevice(StimulatingDevice):
    """A node whose frames are records of ``CAN_RECORD``."""

    def __init__(self, node: StimulatorNode) -> None:
        self.node = node

    def receive(self, t_ns: int, data: bytes) -> list[bytes]:
        """Frames from the bus."""
        out: list[bytes] = []
        for identifier, length, payload in CAN_RECORD.iter_unpack(data):
            out += _records(self.node.receive(t_ns, identifier, payload[:length]))
        return out

    def advance(self, t_ns: int) -> list[bytes]:
        """As the node's."""
        return _records(self.node.advance(t_ns))

    def next_deadline_ns(self) -> int:
        """As the node's."""
        return self.node.next_deadline_ns()

    def set_fault(self, t_ns: int, name: str, value: float) -> list[bytes]:
        """As the node's."""
        self.node.set_fault(t_ns, name, value)
        return []

    def power_off(self, t_ns: int) -> None:
        """As the node's."""
        self.node.power_off(t_ns)

    def take_record_and_pulses(self) -> tuple[list[RecordEntry], list[Pulse]]:
        """What happened since the last call, and the pulses."""
        return self.node.take_record(), self.node.take_pulses()


def _records(frames: Iterable[Frame]) -> list[bytes]:
    return [CAN_RECORD.pack(identifier, len(data), data) for identifier, data in frames]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until a signal ends it; exit status 2 when the settings are wrong, 1 when the bus broke."""
    parser = stimulator_parser("can_node", "electrode=CH,weak=CH,drop=N,reboot=SECONDS,mute=SECONDS")
    add_bus_options(parser)
    parser.add_argument("--boot-id", type=int, help="0 to 65535; default: random")
    options = parser.parse_args(arguments)
    boot_id = secrets.randbelow(2**16) if options.boot_id is None else options.boot_id
    if not 0 <= boot_id < 2**16:
        parser.error(f"--boot-id {boot_id} is not within 0 to 65535")
    try:
        faults = parse_faults(options.faults)
    except ValueError as error:
        parser.error(f"--faults: {error}")
    return run_stimulator(
        parser,
        options,
        lambda: CanEnd(bus_of(options), CONTROLLER_IDS),
        lambda t_ns: NodeDevice(StimulatorNode(boot_id, t_ns, faults)),
        boot_id=boot_id,
    )


if __name__ == "__main__":
    sys.exit(main())
