"""Start a simulated device's process (stimulator, sensor, or the line to one), and be sure to end it.

A simulated device's process, seen from whoever started it: started, given faults, asked for its record, ended.

The other end of the conversation is :mod:`drivers.simulated.lines`.
"""

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, Self

import can

from drivers.imu.port import ImuLost
from drivers.simulated.imu.faults import LASTING
from drivers.simulated.imu.wire import SERIAL
from drivers.simulated.lines import LINE_FAULTS
from drivers.simulated.record import RecordEntry, read_record
from drivers.stimulator.bus import LOOPBACK, MULTICAST, BusError, open_bus
from drivers.stimulator.port import StimulatorLost
from fes.config import Bus

STOP_WAIT_S: Final = 3.0
ANSWER_WAIT_S: Final = 10.0
_READ_AT_MOST: Final = 65536  # bytes at once


class ProcessHandle:
    """A running device: ``port`` is what the host opens, ``record`` the file that it writes (None: none).

    Use as a context manager, or call :meth:`stop`. Should this process die first, the device sees its stdin close and
    ends by itself. ``what`` is the device, as messages name it; ``python -m module`` runs it. ``ready`` holds the facts
    of its ready line, to which each kind of device adds its own.

    lost: it ended, or was not ready within ``timeout_s``; the message holds the command and what it printed.
    """

    def __init__(
        self,
        what: str,
        module: str,
        arguments: Sequence[str],
        *,
        lost: type[RuntimeError],
        timeout_s: float,
        record: Path | None = None,
    ) -> None:
        self._what = what
        self._lost = lost
        self.record = record
        command = [sys.executable, "-m", module, *arguments, *([] if record is None else ["--record", str(record)])]
        self._unread = b""
        self._overdue = 0
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the handle
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, start_new_session=True
        )
        line = self._read_line(timeout_s)
        try:
            self.ready: dict[str, Any] = json.loads(line or "")
            self.port, self.real_time = str(self.ready.get("port", "")), bool(self.ready["real_time"])
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            if line is None:
                self.process.kill()
            why = self._error_output(f"nothing within {timeout_s:g} s" if line is None else line.strip())
            self.stop()
            raise lost(f"{what} did not start ({' '.join(command)}); it said: {why}") from error

    def _on_message(self, message: Mapping[str, Any]) -> bool:
        """Take in a line that the device may send unasked; whether it was one. A device that does so overrides this."""
        return False

    def inject(self, fault: str, value: float = 1.0) -> int:
        """Bring a fault about now; returns when it had taken effect, by the device's clock (CLOCK_MONOTONIC), ns.

        lost: the device does not know it, or is gone; the message says which, and what it printed last.
        """
        return int(self.request({"fault": fault, "value": value})["t_ns"])

    def request(self, command: Mapping[str, Any]) -> dict[str, Any]:
        """Send any command that this device takes; its answer. lost: as :meth:`inject` does."""
        try:
            if self.process.stdin is not None:
                self.process.stdin.write(json.dumps(dict(command)).encode() + b"\n")
                self.process.stdin.flush()
            end_s = time.monotonic() + ANSWER_WAIT_S
            answer: dict[str, Any] = {}
            while not answer:
                if (line := self._read_line(max(0.0, end_s - time.monotonic()))) is None:
                    self._overdue += 1  # its answer, should it still come, is none to the next command
                    raise self._lost(f"{self._what} has not answered within {ANSWER_WAIT_S:g} s")
                answer = self._answer_in(line)
        except (OSError, ValueError) as error:
            raise self._lost(f"{self._what} is gone; it said: {self._error_output()}") from error
        if "error" in answer:
            raise self._lost(f"{self._what} refused: {answer['error']}")
        return answer

    def entries(self, event: str = "") -> list[RecordEntry]:
        """The record so far; only entries of this kind, when one is named."""
        if self.record is None or not self.record.is_file():
            return []
        return [entry for entry in read_record(self.record) if event in ("", entry.event)]

    def stop(self) -> int:
        """End the device and wait for it; returns its exit status. May be called twice."""
        if self.process.stdin is not None:
            with contextlib.suppress(OSError):  # it may be gone with something unread
                self.process.stdin.close()
        end_s = time.monotonic() + STOP_WAIT_S
        self.receive_messages(STOP_WAIT_S)  # its last ones; and a pipe that is full would keep it from ending
        for last_resort in (self.process.terminate, self.process.kill):
            try:
                self.process.wait(max(0.0, end_s - time.monotonic()))
                break
            except subprocess.TimeoutExpired:
                last_resort()
                end_s = time.monotonic() + STOP_WAIT_S
        status = self.process.wait(STOP_WAIT_S)
        if self.process.stdout is not None:
            self.process.stdout.close()
        self._errors.close()
        return status

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def receive_messages(self, timeout_s: float = 0.0) -> None:
        """Take in what it sends unasked, until it sends no more or the time is over."""
        end_s = time.monotonic() + timeout_s
        while line := self._read_line(max(0.0, end_s - time.monotonic())):
            with contextlib.suppress(ValueError, TypeError):  # nobody waits for a line that says nothing
                self._answer_in(line)

    def _answer_in(self, line: str) -> dict[str, Any]:
        """The answer to the newest command; empty for what was sent unasked and for an answer that is overdue."""
        message: dict[str, Any] = json.loads(line)
        unasked = self._on_message(message)
        overdue = not unasked and self._overdue > 0
        self._overdue -= overdue
        return {} if unasked or overdue else message

    def _read_line(self, timeout_s: float) -> str | None:
        """The next line it prints; without its end when it prints no more, None when there is none in time."""
        if self.process.stdout is None or self.process.stdout.closed:
            return ""
        descriptor = self.process.stdout.fileno()
        end_s = time.monotonic() + timeout_s
        while b"\n" not in self._unread:
            if not select.select([descriptor], [], [], max(0.0, end_s - time.monotonic()))[0]:
                return None
            data = os.read(descriptor, _READ_AT_MOST)
            if not data:
                break
            self._unread += data
        line, _, self._unread = self._unread.partition(b"\n")
        return line.decode(errors="replace")

    def _error_output(self, default: str = "") -> str:
        """Its errors once it has ended, else ``default``, else how it ended."""
        if self._errors.closed:
            return "nothing; it has been stopped"
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(STOP_WAIT_S)
        # not by seek: the device writes at the same place in the file
        printed = os.pread(self._errors.fileno(), _READ_AT_MOST, 0).decode(errors="replace").strip()
        return printed or default or f"nothing; it ended with status {self.process.returncode}"


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
    pulses: Path | None = None,
) -> NodeHandle:
    """Start ``python -m drivers.simulated.stimulator.can_node`` and wait until it is ready.

    Without ``bus`` it gets one of its own that stays on this machine (:func:`free_bus`). ``faults`` as in
    :func:`drivers.simulated.stimulator.firmware.parse_faults`.

    NodeFailed: it ended, or was not ready in time.
    """
    bus = bus or free_bus()
    arguments = ["--until-stdin-closes", *_options(faults=faults, boot_id=boot_id, pulses=pulses)]
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

    ImuLost: it ended, or was not ready in time.
    """
    arguments = _options(device=device, sensor=sensor, rate=rate_hz, offset=offset_s, drift=drift_ppm, line=line)
    arguments += _options(
        id_offset=id_offset, name=name, serial=serial, recording=recording, bus=bus and bus.model_dump_json()
    )
    return ImuHandle(arguments + _options(options=None if options is None else json.dumps(dict(options))), record)
