"""Faults between the drivers of real sensors and the loop: both ends of the link from a campaign to its session.

The session's end is given to ``fes run`` by the program that the campaign starts (:mod:`fes.hil.controller`), and by
nobody else. It takes orders in the loop's own turn, and tells what the stimulator's driver has decoded of its answers:
where nobody else can hear the stimulator, the campaign judges by these.
"""

import json
import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from queue import Empty, Queue
from typing import Any, Final

from drivers.imu.port import ImuLost, ImuPort
from drivers.simulated.imu.faults import FaultedImu
from drivers.simulated.record import RecordEntry
from drivers.stimulator.port import StimulatorLost
from fes.config import Session
from fes.estimation.sensor_choice import phase_sensors
from fes.signals import Event, StimStatus

DUMMY_LOAD: Final = b"--i-have-a-dummy-load"  # the first datagram; without it no session begins
WORD_S: Final = 1.0
ANSWER_S: Final = 5.0
MOST_BYTES: Final = 4096
PULSE_BY_PULSE: Final = ("p24_low_level", "rehastim2")  # that answer every pulse, and have nothing to say to "off"


class InjectedFaults:
    """The session's end; a :class:`fes.cli.run.devices.SensorFaults`.

    Faults are of the sensor that the first channel follows; all of them feel a ``tap``, which arming may ask of each.
    ``dummy_load``: whoever is at the other end has confirmed one.
    """

    def __init__(self, descriptor: int) -> None:
        self._link = socket.socket(fileno=descriptor)
        self._link.settimeout(WORD_S)
        self.dummy_load = False
        with suppress(OSError):
            self.dummy_load = self._link.recv(MOST_BYTES) == DUMMY_LOAD
        self._link.setblocking(False)
        self._ports: Sequence[FaultedImu] = ()
        self._sensor = ""
        self._told = 0

    def between(self, ports: Sequence[ImuPort], session: Session) -> Sequence[FaultedImu]:
        """These ports, each with faults to come."""
        self._sensor = phase_sensors(str(each.sensor) for each in session.sensors)[session.channels[0].foot]
        self._ports = [FaultedImu(port, session.sensors) for port in ports]
        return self._ports

    def fileno(self) -> int:
        """Readable with an order."""
        return self._link.fileno()

    def read_events(self, t_ns: int) -> list[Event]:
        """Execute what is ordered, from the next sample read on; no event comes of it."""
        with suppress(OSError):  # the end of the loop; should the campaign end, it ends this session
            while data := self._link.recv(MOST_BYTES):
                order = json.loads(data)
                self._send({"number": order["number"], **self._execute(t_ns, order["fault"], order["value"])})
        return []

    def observe(self, event: Event) -> None:
        """Tell of the stimulator's answers."""
        if isinstance(event, StimStatus):
            self._told += 1
            levels = event.current_ma, event.pulse_width_us, event.frequency_hz
            self._send({"told": self._told, "status": (event.t_ns, event.channel, event.on, bool(event.fault), levels)})

    def _execute(self, t_ns: int, fault: str, value: float) -> dict[str, Any]:
        try:
            for port in self._ports:
                for sensor in port.sensors:
                    if fault == "clear":
                        port.clear(t_ns, sensor)
                    elif sensor == self._sensor or fault == "tap":
                        port.inject(t_ns, sensor, fault, value)
        except ValueError as error:
            return {"error": str(error)}
        return {"t_ns": t_ns}

    def _send(self, message: dict[str, Any]) -> None:
        with suppress(OSError):  # nobody reads: the loop waits for no campaign, which sees that one is missing
            self._link.send(json.dumps(message).encode())


class HeardAnswers:
    """A stimulator's answers as entries of a record; which channels are on is known by those before.

    ``pulses``: it answers every pulse and has no answer to "off" (:data:`PULSE_BY_PULSE`).
    """

    def __init__(self, *, pulses: bool = False) -> None:
        self._pulses = pulses
        self._on: set[int] = set()

    def entry(
        self, t_ns: int, channel: int, on: bool, levels: Sequence[float], ended_by: str = "off"
    ) -> RecordEntry | None:
        """It delivers these levels (mA, µs, Hz), or is off; None where it was off before."""
        was_on = channel in self._on
        if not (on or was_on):
            return None
        event = ended_by if not on else "pulse" if self._pulses else "level" if was_on else "on"
        if not on:
            self._on.discard(channel)
        elif not self._pulses:
            self._on.add(channel)
        current_ma, width_us, frequency_hz = levels
        return RecordEntry(t_ns, event, channel, current_ma, width_us, frequency_hz, t_ns, last_pulse_ns=t_ns)


class RealSensor:
    """The campaign's end: to be used as a simulated sensor's handle is. :meth:`connect` it for each session.

    ``pulses``: as of :class:`HeardAnswers`; None: others hear the stimulator, and its answers are not kept.
    """

    def __init__(self, *, pulses: bool | None) -> None:
        self._pulses = pulses
        self._link: socket.socket | None = None
        self._answers: Queue[dict[str, Any]] = Queue()
        self._entries: Queue[RecordEntry] = Queue()
        self._heard = HeardAnswers()
        self._number = 0
        self._missed = False

    def connect(self) -> socket.socket:
        """A new link; the session's end of it, with the word that it asks for."""
        self.close()
        self._link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._link.send(DUMMY_LOAD)
        self._heard = HeardAnswers(pulses=bool(self._pulses))
        self._entries.put(RecordEntry(time.monotonic_ns(), "boot"))  # what the last session saw no end of is over
        threading.Thread(target=self._listen, args=(self._link,), daemon=True).start()
        return theirs

    def inject(self, name: str, value: float = 1.0) -> int:
        """Bring a fault about, or with 0 end it; when the session did so (CLOCK_MONOTONIC, ns).

        ImuLost: the session does not know it, or does not answer.
        """
        self._number += 1
        try:
            if self._link is None:
                raise OSError
            self._link.send(json.dumps({"number": self._number, "fault": name, "value": value}).encode())
            answer = self._answers.get(timeout=ANSWER_S)
            while answer["number"] != self._number:
                answer = self._answers.get(timeout=ANSWER_S)
        except (OSError, Empty):
            raise ImuLost(f"the session does not answer to the fault {name!r} of its sensor") from None
        if "error" in answer:
            raise ImuLost(f"the session refused: {answer['error']}")
        return int(answer["t_ns"])

    def clear(self) -> None:
        """End the faults that last."""
        self.inject("clear")

    def new_entries(self) -> list[RecordEntry]:
        """What the stimulator answered since the last call, as entries of a record.

        StimulatorLost: an answer was lost on the way to here.
        """
        if self._missed:
            self._missed = False
            raise StimulatorLost("the session had answers of the stimulator to tell that nobody took in")
        return [self._entries.get() for _ in range(self._entries.qsize())]

    def close(self) -> None:
        """Let go of the link."""
        if self._link is not None:
            with suppress(OSError):
                self._link.shutdown(socket.SHUT_RDWR)  # so that the thread ends
            self._link.close()
            self._link = None

    def _listen(self, link: socket.socket) -> None:
        told = 0
        with suppress(OSError):
            while data := link.recv(MOST_BYTES):
                message = json.loads(data)
                if "status" not in message:
                    self._answers.put(message)
                    continue
                if self._pulses is None:
                    continue
                told += 1
                if message["told"] != told:
                    told, self._missed = message["told"], True
                t_ns, channel, on, faulty, levels = message["status"]
                if not on and faulty:
                    continue  # at a fault nobody knows
                if entry := self._heard.entry(t_ns, channel, on, levels):
                    self._entries.put(entry)
