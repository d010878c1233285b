"""The supervisor: a gate and the stimulator's port in a process of their own, which the controller reaches by asking.

Nothing else holds the stimulator's line. It is told every event that the controller's gate observes, observes it with a
gate of its own, made from the same settings, and judges every command anew. What its gate refuses though the
controller's let it out, a datagram that is none, a flood, silence of :data:`SILENT_NS` while armed, and the stop file
make it switch off all channels by itself, and latch. It trusts the controller's samples and the acts of persons that it
is told of: of those it has no source of its own, but for the stop file.
"""

import socket
import struct
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Final, NamedTuple, Protocol

from fes import limits
from fes.gate import STOPPED, SafetyGate
from fes.live.inputs import StopFile
from fes.live.supervision import (
    MALFORMED,
    MOST_BYTES,
    OWN,
    UNSENT,
    Datagram,
    LineOpened,
    StimulatorLine,
    Value,
    What,
    datagram,
    packed,
    unpacked,
)
from fes.session_log import Received
from fes.signals import (
    NS_PER_S,
    FootSwitchEvent,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimOpened,
    StimRequest,
    SystemFault,
    Tick,
    WireFrame,
)

SILENT_NS: Final = 40_000_000  # as long as the controller's own guard lets itself be away
LOOK_NS: Final = 5_000_000  # between two looks at the time and the stop file
FOLLOWS_NS: Final = 20_000_000  # within which the controller itself switches off what is latched
MOST_VALUES_PER_S: Final = 50_000  # eight sensors at 1,000 Hz send a fifth of it
_EVENTS = (ImuSample, Tick, OperatorAct, StimOpened, FootSwitchEvent, SystemFault)


class Port(StimulatorLine, Protocol):
    """An open port; see ``drivers.stimulator.port``."""

    session_id: int

    @property
    def current_step_ma(self) -> float:
        """Between two currents that the device can deliver."""


class PortOpened(NamedTuple):
    """A port with its session open, and what its handshake sent and heard."""

    port: Port
    frames: Sequence[WireFrame]
    alive: Sequence[StimAlive]


def opened_values(opened: PortOpened) -> list[Value]:
    """What the controller is told of an opening."""
    line = LineOpened(opened.port.session_id, opened.port.current_step_ma)
    return [line, *opened.frames, *opened.alive]


class Supervisor:
    """Answers the controller's datagrams, and looks after itself between them; waits for nothing, owns no process.

    ``opener`` opens the port again, at the time with which its handshake is stamped, in a thread; ``lost`` is the
    exception that says that the line is gone. ``clock_ns``: the monotonic clock that the controller's times are of.
    """

    def __init__(
        self,
        gate: SafetyGate,
        opened: PortOpened,
        opener: Callable[[int], PortOpened],
        lost: type[Exception],
        stop_file: StopFile | None,
        clock_ns: Callable[[], int],
    ) -> None:
        self.gate = gate
        self._port: Port | None = opened.port
        self._opener, self._lost, self._stop_file, self._clock_ns = opener, lost, stop_file, clock_ns
        self._why_lost = ""
        self._on: dict[int, bool] = {}  # every channel ever commanded, in that order
        self._untold: list[Value] = []  # what it did by itself, and its faults
        self._distrusts = ""  # why this controller is never believed again
        self._off_ns = -1  # when it last switched off by itself
        self._heard_ns = self._looked_ns = self._second_ns = clock_ns()
        self._counted = 0
        self._opening: threading.Thread | None = None
        self._open_number = 0
        self._result: PortOpened | Exception | None = None
        for alive in opened.alive:
            gate.observe(alive)

    # --- the controller's datagrams ------------------------------------------------------------------------

    def answer(self, data: bytes) -> bytes:
        """Take in a datagram; its answer, b"" for none."""
        now_ns = self._heard_ns = self._clock_ns()
        try:
            asked = unpacked(data)
            command = asked.values.pop() if asked.what is What.COMMAND else None
            events = [event for event in asked.values if isinstance(event, _EVENTS)]
            if len(events) != len(asked.values) or asked.what >= What.DONE:
                raise ValueError("what only the supervisor says")
            if command is not None and not isinstance(command, StimCommand):
                raise ValueError("no command")
        except MALFORMED as error:
            self._distrust(now_ns, f"the controller sent what is no record: {error}")
            return b""
        self._count(now_ns, 1 + len(events))
        for event in events:
            if event.t_ns > now_ns:
                self._distrust(now_ns, "the controller dated an event ahead")
            self.gate.observe(event)
            if isinstance(event, OperatorAct) and event.action is OperatorAction.ARM:
                self._hold_back(event)
        if command is not None:
            return self._tried(asked, lambda: [self._send(now_ns, command)])
        if asked.what is What.POLL:
            return self._tried(asked, lambda: self._poll(asked.t_ns))
        if asked.what is What.OPEN:
            self._open_again(asked)
        elif asked.what is What.CLOSE:
            self._release()
        return b""

    def _hold_back(self, arm: OperatorAct) -> None:
        """An arming from before the supervisor switched off, or of a controller that is not believed, arms nothing."""
        why = self._distrusts or (self._stop_file.not_ready() if self._stop_file else "")
        if not why and arm.t_ns <= self._off_ns:
            why = "armed before it was switched off"
        if why:
            self.gate.latch(arm.t_ns, why)

    def _send(self, now_ns: int, command: StimCommand) -> WireFrame:
        """Judge a command and write it; a frame of identifier 0 where it is refused, and everything off then."""
        port = self._open_port()
        request = StimRequest(command.channel, on=False)
        if command.on:
            late_ns = now_ns - command.t_ns
            if not 0 <= late_ns <= limits.MAX_DATA_AGE_MS * 1_000_000:
                self._refuse(now_ns, f"a command was {late_ns / 1e6:.0f} ms late")
                return WireFrame(command.t_ns, UNSENT, b"")
            levels = command.current_ma, command.pulse_width_us, command.frequency_hz
            request = StimRequest(command.channel, True, *levels)
        judged = self.gate.judge(command.t_ns, request)
        if judged.refused:
            self._refuse(now_ns, judged.refused)
            return WireFrame(command.t_ns, UNSENT, b"")
        self._on[judged.channel] = judged.on  # first: a command that fails half-way may have gone out all the same
        return port.send(judged)

    def _poll(self, t_ns: int) -> list[Value]:
        port = self._open_port()
        answers = port.poll(t_ns)
        for answer in answers:
            self.gate.observe(answer)
        return [*([Received(t_ns, port.heard)] if port.heard else []), *answers]

    def _tried(self, asked: Datagram, do: Callable[[], Sequence[Value]]) -> bytes:
        try:
            return self._told(asked.number, What.DONE, do())
        except self._lost as error:
            return self._told(asked.number, What.LOST, [SystemFault(asked.t_ns, str(error))])
        except ValueError as error:
            return self._told(asked.number, What.IMPOSSIBLE, [SystemFault(asked.t_ns, str(error))])

    def _told(self, number: int, what: What, values: Sequence[Value]) -> bytes:
        untold, self._untold = self._untold, []
        return datagram(number, what, self._clock_ns(), b"".join(map(packed, (*untold, *values))))

    # --- what it does by itself ------------------------------------------------------------------------------

    def supervise(self) -> bytes:
        """See to the time, the stop file and an opening under way; the answer to that, once it is over.

        Call it at least every :data:`LOOK_NS`, and only after what had come was taken in: what the supervisor missed
        while it was away itself is no silence of the controller's.
        """
        now_ns = self._clock_ns()
        if now_ns - self._looked_ns < LOOK_NS:
            return b""
        self._looked_ns = now_ns
        if self._stop_file is not None and self._stop_file.read_events(now_ns):
            self._switch_off(now_ns, STOPPED)  # the controller, if it is well, sees and says it too
        silent_ns = now_ns - self._heard_ns
        if self.gate.armed and silent_ns > SILENT_NS:
            self._refuse(now_ns, f"controller stalled for {silent_ns / 1e6:.0f} ms")
        latched_ns = self.gate.latched_ns
        if latched_ns is not None and now_ns - latched_ns > FOLLOWS_NS and any(self._on.values()):
            self._refuse(now_ns, f"the controller did not switch off: {self.gate.latched}")
        if self._opening is None or self._opening.is_alive() or self._result is None:
            return b""
        self._opening, result, self._result = None, self._result, None
        if isinstance(result, Exception):
            return self._told(self._open_number, What.LOST, [SystemFault(now_ns, str(result))])
        self._port, self._why_lost = result.port, ""
        self._on.clear()
        return self._told(self._open_number, What.DONE, opened_values(result))

    def end(self, why: str) -> None:
        """Off, and the line released: the controller is gone."""
        self._switch_off(self._clock_ns(), why)
        self._release()

    def _count(self, now_ns: int, values: int) -> None:
        if now_ns - self._second_ns > NS_PER_S:
            self._second_ns, self._counted = now_ns, 0
        self._counted += values
        if self._counted > MOST_VALUES_PER_S:
            self._distrust(now_ns, "the controller sends more than any session does")

    def _distrust(self, now_ns: int, why: str) -> None:
        if not self._distrusts:
            self._distrusts = why
            self._refuse(now_ns, f"{why}; start a new session")

    def _refuse(self, now_ns: int, why: str) -> None:
        self._switch_off(now_ns, why)
        self._untold.append(SystemFault(now_ns, f"supervisor: {why}"[:200]))

    def _switch_off(self, now_ns: int, why: str) -> None:
        """Latch, and send *off* for all channels, in the order in which they were commanded, where one is on."""
        self.gate.latch(now_ns, why)
        self._off_ns = now_ns
        if not any(self._on.values()):
            return
        for channel in self._on:
            command = replace(self.gate.judge(now_ns, StimRequest(channel, on=False)), refused=OWN + why)
            self._on[channel] = False
            if self._port is None:
                continue
            try:
                self._untold += [command, self._port.send(command)]
            except (self._lost, ValueError) as error:  # each is tried
                self._why_lost = str(error)

    # --- the line ----------------------------------------------------------------------------------------------

    def _open_port(self) -> Port:
        if self._port is None or self._why_lost:
            raise self._lost(self._why_lost or "it is not open")
        return self._port

    def _release(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None
        self._on = dict.fromkeys(self._on, False)  # what was on ends by its lease

    def _open_again(self, asked: Datagram) -> None:
        self._release()
        self._open_number = asked.number
        if self._opening is None:
            self._opening = threading.Thread(target=self._attempt, args=(asked.t_ns,), daemon=True)
            self._opening.start()

    def _attempt(self, t_ns: int) -> None:
        try:
            self._result = self._opener(t_ns)
        except Exception as error:  # whatever a driver raises, the controller asks again
            self._result = error


def serve(link: socket.socket, supervisor: Supervisor) -> None:
    """Answer until the controller's end of the link closes; then everything is off."""
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", 0, LOOK_NS // 1000))
    why = "the supervisor has failed"
    try:
        while True:
            with suppress(BlockingIOError):
                if not (data := link.recv(MOST_BYTES + 1)):
                    break
                _say(link, supervisor.answer(data))
            _say(link, supervisor.supervise())
        why = "the controller has ended"
    except ConnectionResetError:
        why = "the controller has ended"
    finally:
        supervisor.end(why)


def _say(link: socket.socket, answer: bytes) -> None:
    if answer:
        with suppress(OSError):  # a controller that is gone, or does not read, is noticed by its silence
            link.send(answer, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
