"""The supervisor's process: ``python -m fes.cli.run.supervisor LINK_FD PARENT``; see :mod:`fes.live.supervisor`.

Its first datagram are the settings, its second one asks for the stimulator to be opened.
"""

import json
import socket
import sys
import time
from pathlib import Path

from drivers.stimulator.open import open_session
from drivers.stimulator.port import StimulatorLost
from fes.config import ConfigError, validate_session
from fes.gate import gate_of
from fes.live.inputs import StopFile
from fes.live.processes import end_with, fixed_priority, frozen_garbage, joined, locked_memory
from fes.live.supervision import MOST_BYTES, What, datagram, packed, unpacked
from fes.live.supervisor import PortOpened, Supervisor, opened_values, serve
from fes.signals import SystemFault


def run(link: socket.socket) -> int:
    """Open the stimulator, then serve until the controller ends; 2 where it cannot be opened."""
    settings = json.loads(link.recv(1 << 20) or b"{}")
    if not settings or not (first := link.recv(MOST_BYTES)):
        return 2
    asked = unpacked(first)
    session = validate_session(settings["session"], Path("the session"))

    def open_port(t_ns: int) -> PortOpened:
        port, _, handshake = open_session(session.stimulator, session, t_ns)
        return PortOpened(port, handshake.frames, handshake.alive)

    try:
        opened = open_port(asked.t_ns)
    except (StimulatorLost, ConfigError) as error:
        what = What.LOST if isinstance(error, StimulatorLost) else What.IMPOSSIBLE
        link.send(datagram(asked.number, what, 0, packed(SystemFault(0, str(error)))))
        return 2
    up = {sensor: tuple(vector) for sensor, vector in settings["up"].items()}
    gate = gate_of(session, up, settings["shank_phase_sensors"], opened.port.current_step_ma)
    stop_file = StopFile(Path(settings["stop_file"]), lambda command, t_ns: [SystemFault(t_ns, command.origin)])
    for ask in (frozen_garbage, locked_memory, fixed_priority):  # the session says what was refused
        ask()
    supervisor = Supervisor(gate, opened, open_port, StimulatorLost, stop_file, time.monotonic_ns)
    link.send(datagram(asked.number, What.DONE, 0, b"".join(map(packed, opened_values(opened)))))
    serve(link, supervisor)
    return 0


def main() -> int:
    """Ctrl-C is the controller's business; where that is killed, this process ends too, off."""
    link, parent, _ = joined()
    end_with(parent)
    with link:
        return run(link)


if __name__ == "__main__":
    sys.exit(main())
