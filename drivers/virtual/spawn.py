"""Start the simulated stimulator's process, on a bus of its own, and be sure to end it."""

from __future__ import annotations

import json
import select
import socket
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Self

import can

from drivers.stimulator.bus import LOOPBACK, MULTICAST, BusError, open_bus
from drivers.stimulator.port import StimulatorLost
from fes.config import Bus

_STOP_WAIT_S: Final = 3.0
_PROBES: Final = frozenset((1,))
_ANSWER_WAIT_S: Final = 10.0


class NodeFailed(StimulatorLost):
    """The simulated stimulator did not start; the message holds what it said."""


@dataclass(slots=True)
class NodeHandle:
    """A running node: ``bus`` reaches it, ``record`` is the file it writes (None: none).

    Use as a context manager, or call :meth:`stop`. Should this process die first, the node sees its stdin close and
    ends by itself.
    """

    process: subprocess.Popen[str]
    bus: Bus
    boot_id: int
    real_time: bool
    record: Path | None
    _errors: IO[str]

    def tell(self, fault: str, value: float = 1.0) -> int:
        """Bring a fault about now; returns when it was, in CLOCK_MONOTONIC ns.

        Raises:
            NodeFailed: the node does not know it, or is gone.
        """
        if self.process.stdin is None:
            raise NodeFailed("the simulated stimulator has no stdin")
        try:
            self.process.stdin.write(json.dumps({"fault": fault, "value": value}) + "\n")
            self.process.stdin.flush()
            answer = json.loads(first_line(self.process, _ANSWER_WAIT_S))
            return int(answer["t_ns"])
        except (OSError, ValueError) as error:
            raise NodeFailed(f"the simulated stimulator is gone: {error}") from error
        except KeyError:
            raise NodeFailed(f"the simulated stimulator refused: {answer.get('error')}") from None

    def stop(self) -> int:
        """End the node and wait for it; returns its exit status. May be called twice."""
        if self.process.stdin is not None:
            self.process.stdin.close()
        for last_resort in (self.process.terminate, self.process.kill):
            try:
                self.process.wait(_STOP_WAIT_S)
                break
            except subprocess.TimeoutExpired:
                last_resort()
        status = self.process.wait(_STOP_WAIT_S)
        if self.process.stdout is not None:
            self.process.stdout.close()
        self._errors.close()
        return status

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


def spawn_node(
    *,
    record: Path | None = None,
    boot_id: int | None = None,
    faults: str = "",
    bus: Bus | None = None,
    clock: str = "real",
    timeout_s: float = 20.0,
) -> NodeHandle:
    """Start ``python -m drivers.virtual.can_node`` and wait until it is ready.

    ``clock`` is "real", or "bus" for :mod:`drivers.virtual.lockstep`. Without ``bus`` it gets one of its own that
    stays on this machine (:func:`free_bus`). ``faults`` as in :func:`drivers.virtual.node_faults.parse_faults`.

    Raises:
        NodeFailed: it ended, or was not ready within ``timeout_s``.
    """
    settings = bus or free_bus()
    command = [sys.executable, "-m", "drivers.virtual.can_node", "--until-stdin-closes"]
    command += ["--clock", clock, "--interface", settings.interface, "--channel", settings.channel, "--faults", faults]
    if "port" in settings.options:
        command += ["--port", str(settings.options["port"])]
    if boot_id is not None:
        command += ["--boot-id", str(boot_id)]
    if record is not None:
        command += ["--record", str(record)]
    errors = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115 - lives as long as the handle
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True, start_new_session=True
    )
    handle = NodeHandle(process, settings, -1, False, record, errors)
    line = first_line(process, timeout_s)
    try:
        ready = json.loads(line)
        handle.boot_id, handle.real_time = int(ready["boot_id"]), bool(ready["real_time"])
    except (ValueError, KeyError, TypeError) as error:
        process.kill()
        process.wait(_STOP_WAIT_S)
        errors.seek(0)
        said = errors.read().strip() or line.strip() or f"nothing within {timeout_s:g} s"
        handle.stop()
        raise NodeFailed(f"the simulated stimulator did not start ({' '.join(command)}); it said: {said}") from error
    return handle


def free_bus(interface: str = "") -> Bus:
    """A bus on this machine, on a UDP port that nobody uses now.

    Multicast as python-can has it, or the loopback bus where the machine has no route for that.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port: int = probe.getsockname()[1]
    settings = Bus(interface=interface or MULTICAST, options={"port": port})
    if not interface and why_silent(settings):
        return settings.model_copy(update={"interface": LOOPBACK})
    return settings


def why_silent(settings: Bus) -> str:
    """ "" when two openings of this bus on this machine hear each other, else the reason why not."""
    try:
        with open_bus(settings, _PROBES) as one, open_bus(settings, _PROBES) as other:
            one.send(can.Message(arbitration_id=min(_PROBES), is_extended_id=False), timeout=0)
            heard = other.recv(timeout=0.5)
    except (BusError, can.CanError) as error:
        return str(error)
    return "" if heard is not None else "frames are sent but do not come back on this machine"


def first_line(process: subprocess.Popen[str], timeout_s: float) -> str:
    """What the process says first; "" when nothing in time."""
    if process.stdout is None:
        return ""
    ready, _, _ = select.select([process.stdout], [], [], timeout_s)
    return process.stdout.readline() if ready else ""
