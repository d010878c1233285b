"""Start a simulated device's process (stimulator, sensor, or the line to one), and be sure to end it."""

from __future__ import annotations

import json
import socket
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import can

from drivers.imu.port import ImuLost
from drivers.simulated.imu.device import LASTING
from drivers.simulated.lines import LINE_FAULTS
from drivers.simulated.process_handle import ProcessHandle
from drivers.stimulator.bus import LOOPBACK, MULTICAST, BusError, open_bus
from drivers.stimulator.port import StimulatorLost
from fes.config import Bus

DeviceKind = Literal["sciencemode4", "sciencemode2"]
_PROBES: Final = frozenset((1,))
ImuKind = Literal["xbus", "ximu3", "xsens_can", "dbc_can", "lsl"]


class NodeFailed(StimulatorLost):
    """The simulated stimulator did not start; the message holds what it printed."""


class NodeHandle(ProcessHandle):
    """A running node, or a line to one: ``bus`` reaches it. ``boot_id`` is -1 for a line."""

    def __init__(
        self,
        what: str,
        module: str,
        arguments: Sequence[str],
        bus: Bus,
        *,
        timeout_s: float,
        record: Path | None = None,
    ) -> None:
        self.bus = bus
        self.boot_id = -1
        super().__init__(what, module, arguments, lost=NodeFailed, timeout_s=timeout_s, record=record)

    def _on_ready(self, ready: Mapping[str, Any]) -> None:
        super()._on_ready(ready)
        self.boot_id = int(ready.get("boot_id", -1))


def spawn_node(
    *,
    record: Path | None = None,
    boot_id: int | None = None,
    faults: str = "",
    bus: Bus | None = None,
    clock: str = "real",
    pulses: Path | None = None,
    timeout_s: float = 20.0,
) -> NodeHandle:
    """Start ``python -m drivers.simulated.stimulator.can_node`` and wait until it is ready.

    ``clock`` is "real", or "bus" for :mod:`drivers.simulated.stimulator.lockstep`. Without ``bus`` it gets one of its
    own that stays on this machine (:func:`free_bus`). ``faults`` as in
    :func:`drivers.simulated.stimulator.firmware.parse_faults`.

    Raises:
        NodeFailed: it ended, or was not ready within ``timeout_s``.
    """
    settings = bus or free_bus()
    arguments = ["--until-stdin-closes", "--clock", clock, "--faults", faults]
    arguments += ["--interface", settings.interface, "--channel", settings.channel]
    arguments += ["--port", str(settings.options["port"])] if "port" in settings.options else []
    arguments += ["--boot-id", str(boot_id)] if boot_id is not None else []
    arguments += ["--pulses", str(pulses)] if pulses is not None else []
    module = "drivers.simulated.stimulator.can_node"
    return NodeHandle("the simulated stimulator", module, arguments, settings, timeout_s=timeout_s, record=record)


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


def spawn_link(
    back: Bus, *, front: Bus | None = None, slcan: Path | None = None, timeout_s: float = 20.0
) -> NodeHandle:
    """Start ``python -m drivers.simulated.can_link`` and wait until it is ready; it can ``cut`` or ``unplug``.

    Args:
        back: the node's bus.
        front: the controller's bus, or
        slcan: where the simulated adapter's serial line is to be found.

    Raises:
        NodeFailed: it ended, or was not ready within ``timeout_s``.
    """
    arguments = ["--back", back.model_dump_json()]
    arguments += ["--front", front.model_dump_json()] if front is not None else ["--slcan", str(slcan)]
    module = "drivers.simulated.can_link"
    return NodeHandle("the simulated CAN line", module, arguments, front or back, timeout_s=timeout_s)


class DeviceHandle(ProcessHandle):
    """A running serial stimulator; its ``port`` is a pseudo-terminal's name, or ``socket://127.0.0.1:PORT``."""


def spawn_device(
    kind: DeviceKind,
    *,
    record: Path | None = None,
    faults: str = "",
    pulses: Path | None = None,
    line: Literal["pty", "tcp"] = "pty",
    timeout_s: float = 20.0,
) -> DeviceHandle:
    """Start ``python -m drivers.simulated.stimulator.KIND`` and wait until it is ready.

    Raises:
        NodeFailed: it ended, or was not ready within ``timeout_s``.
    """
    arguments = ["--until-stdin-closes", "--line", line, "--faults", faults]
    arguments += ["--pulses", str(pulses)] if pulses is not None else []
    module = f"drivers.simulated.stimulator.{kind}"
    return DeviceHandle(
        "the simulated stimulator", module, arguments, lost=NodeFailed, timeout_s=timeout_s, record=record
    )


class ImuHandle(ProcessHandle):
    """A running sensor: ``port`` is what the host opens, ``t0_ns`` when its clock stood at its offset."""

    def __init__(self, arguments: Sequence[str], timeout_s: float) -> None:
        self.t0_ns = 0
        module = "drivers.simulated.imu.process"
        super().__init__("the simulated sensor", module, arguments, lost=ImuLost, timeout_s=timeout_s)

    def _on_ready(self, ready: Mapping[str, Any]) -> None:
        super()._on_ready(ready)
        self.t0_ns = int(ready["t0_ns"])

    def clear(self) -> None:
        """End the faults that last."""
        for name in (*LASTING, *sorted(LINE_FAULTS)):
            self.inject(name, 0.0)


def spawn_imu(
    device: ImuKind,
    *,
    sensor: str = "right_foot",
    recording: Path | None = None,
    rate_hz: float = 100.0,
    offset_s: float = 0.0,
    drift_ppm: float = 0.0,
    line: Literal["pty", "tcp", "udp"] = "pty",
    bus: Bus | None = None,
    id_offset: int = 0,
    options: Mapping[str, str | int | float | bool] | None = None,
    name: str = "imu",
    timeout_s: float = 30.0,
) -> ImuHandle:
    """Start ``python -m drivers.simulated.imu.process`` and wait until it is ready.

    Args:
        device: what it is, as in the session's settings.
        sensor: whose movement.
        recording: played instead of a simulated walk.
        rate_hz: samples a second, by its own clock.
        offset_s: of its clock at the start.
        drift_ppm: of its clock.
        line: of ``xbus`` and ``ximu3``.
        bus: of ``xsens_can`` and ``dbc_can``.
        id_offset: of ``xsens_can``.
        options: of ``dbc_can``, as in the session's settings.
        name: of the LSL stream.
        timeout_s: to be ready in.

    Raises:
        ImuLost: it ended, or was not ready within ``timeout_s``.
    """
    arguments = ["--device", device, "--sensor", sensor, "--rate", str(rate_hz), "--offset", str(offset_s)]
    arguments += ["--drift", str(drift_ppm), "--line", line, "--id-offset", str(id_offset), "--name", name]
    arguments += ["--recording", str(recording)] if recording is not None else []
    arguments += ["--bus", bus.model_dump_json()] if bus is not None else []
    arguments += ["--options", json.dumps(dict(options))] if options is not None else []
    return ImuHandle(arguments, timeout_s)
