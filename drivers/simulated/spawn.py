"""Start a simulated device's process (stimulator, sensor, or the line to one), and be sure to end it."""

import json
import socket
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, Literal

import can

from drivers.imu.port import ImuLost
from drivers.simulated.imu.faults import LASTING
from drivers.simulated.imu.wire import SERIAL
from drivers.simulated.lines import LINE_FAULTS
from drivers.simulated.process_handle import ProcessHandle
from drivers.stimulator.bus import LOOPBACK, MULTICAST, BusError, open_bus
from drivers.stimulator.port import StimulatorLost
from fes.config import Bus

DeviceKind = Literal["sciencemode4", "sciencemode2"]
_PROBES: Final = frozenset((1,))
ImuKind = Literal[
    "xbus", "ximu3", "capture2go", "capture2go_ble", "witmotion", "movella_dot", "xsens_can", "dbc_can", "lsl"
]


class NodeFailed(StimulatorLost):
    """The simulated stimulator did not start; the message holds what it printed."""


class NodeHandle(ProcessHandle):
    """A running node, or a line to one: ``bus`` reaches it. ``boot_id`` is -1 for a line."""

    def __init__(self, what: str, module: str, arguments: Sequence[str], bus: Bus, record: Path | None = None) -> None:
        super().__init__(what, module, arguments, lost=NodeFailed, timeout_s=20.0, record=record)
        self.bus = bus
        self.boot_id = int(self.ready.get("boot_id", -1))


def _options(**values: object) -> list[str]:
    """As a command line has them; None: left out."""
    given = ((name.replace("_", "-"), value) for name, value in values.items() if value is not None)
    return [part for name, value in given for part in (f"--{name}", str(value))]


def spawn_node(
    *,
    record: Path | None = None,
    boot_id: int | None = None,
    faults: str = "",
    bus: Bus | None = None,
    clock: str = "real",
    pulses: Path | None = None,
) -> NodeHandle:
    """Start ``python -m drivers.simulated.stimulator.can_node`` and wait until it is ready.

    ``clock`` is "real", or "bus" for :mod:`drivers.simulated.stimulator.lockstep`. Without ``bus`` it gets one of its
    own that stays on this machine (:func:`free_bus`). ``faults`` as in
    :func:`drivers.simulated.stimulator.firmware.parse_faults`.

    Raises:
        NodeFailed: it ended, or was not ready in time.
    """
    bus = bus or free_bus()
    arguments = ["--until-stdin-closes", *_options(clock=clock, faults=faults, boot_id=boot_id, pulses=pulses)]
    arguments += _options(interface=bus.interface, channel=bus.channel, port=bus.options.get("port"))
    module = "drivers.simulated.stimulator.can_node"
    return NodeHandle("the simulated stimulator", module, arguments, bus, record)


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


def spawn_link(back: Bus, *, front: Bus | None = None, slcan: Path | None = None) -> NodeHandle:
    """Start ``python -m drivers.simulated.can_link`` and wait until it is ready; it can ``cut`` or ``unplug``.

    ``back`` is the node's bus, ``front`` the controller's; or ``slcan`` is where the simulated adapter's line will be.

    Raises:
        NodeFailed: it ended, or was not ready in time.
    """
    arguments = _options(back=back.model_dump_json(), front=front and front.model_dump_json(), slcan=slcan)
    return NodeHandle("the simulated CAN line", "drivers.simulated.can_link", arguments, front or back)


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
    what, module = "the simulated stimulator", f"drivers.simulated.stimulator.{kind}"
    arguments = ["--until-stdin-closes", *_options(line=line, faults=faults, pulses=pulses)]
    return DeviceHandle(what, module, arguments, lost=NodeFailed, timeout_s=timeout_s, record=record)


class ImuHandle(ProcessHandle):
    """A running sensor: ``port`` is what the host opens, ``t0_ns`` when its clock stood at its offset."""

    def __init__(self, arguments: Sequence[str], record: Path | None = None) -> None:
        module = "drivers.simulated.imu.process"
        super().__init__("the simulated sensor", module, arguments, lost=ImuLost, timeout_s=30.0, record=record)
        self.t0_ns = int(self.ready["t0_ns"])

    def clear(self) -> None:
        """End the faults that last."""
        for name in (*LASTING, *sorted(LINE_FAULTS)):
            self.inject(name, 0.0)

    def played(self) -> list[tuple[int, int]]:
        """Its record: time (ns) and number in the signal of each sample that did not follow on the one before."""
        written = self.record.read_text(encoding="utf-8") if self.record is not None else ""
        entries = map(json.loads, written.split("\n")[:-1])  # what stands behind the last end of a line is on its way
        return [(entry["t_ns"], entry["played"]) for entry in entries]


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
    serial: str = SERIAL,
    record: Path | None = None,
) -> ImuHandle:
    """Start ``python -m drivers.simulated.imu.process`` and wait until it is ready.

    It feels what ``sensor`` feels in ``recording``, or in a simulated walk, ``rate_hz`` times a second by a clock
    that begins at ``offset_s`` and drifts by ``drift_ppm``. ``line`` is for serial ones, ``bus`` for
    ``xsens_can`` (with ``id_offset``) and ``dbc_can`` (with ``options`` as in a session's settings), ``name`` for LSL.
    ``serial``: the number that ``xbus`` tells, and ``capture2go`` (6 characters). ``record``: the file for
    :meth:`ImuHandle.played`.

    Raises:
        ImuLost: it ended, or was not ready in time.
    """
    arguments = _options(device=device, sensor=sensor, rate=rate_hz, offset=offset_s, drift=drift_ppm, line=line)
    arguments += _options(
        id_offset=id_offset, name=name, serial=serial, recording=recording, bus=bus and bus.model_dump_json()
    )
    return ImuHandle(arguments + _options(options=None if options is None else json.dumps(dict(options))), record)
