"""The stimulator as the live loop sees it: lost and found again as events, and nothing that has grown old goes out."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from fes import limits
from fes.live.sensors import Reopening, StimulatorLine
from fes.live.supervision import UNSENT
from fes.signals import Event, StimAlive, StimCommand, StimOpened, StimStatus, SystemFault, WireFrame


class Electrodes:
    """Which channels' electrodes are not known yet: some stimulators report an open lead only with a pulse.

    Args:
        channels: those of the session.
        detected_from_ma: the least current whose answer reports an open lead, 0 for any pulse; None: the stimulator
            reports it by itself, so that nothing is ever unknown.
    """

    def __init__(self, channels: Iterable[int], detected_from_ma: float | None) -> None:
        self._channels = tuple(sorted(channels)) if detected_from_ma is not None else ()
        self._detected_from_ma = detected_from_ma or 0.0
        self._unknown = set(self._channels)

    def add_event(self, event: Event) -> None:
        """An answer without a fault at such a current makes known; one that was away may have been rewired."""
        if isinstance(event, StimStatus):
            if event.on and not event.fault and event.current_ma >= max(self._detected_from_ma, 1e-9):
                self._unknown.discard(event.channel)
        elif isinstance(event, StimOpened):
            self._unknown = set(self._channels)

    def unknown(self) -> str:
        """Which are not known yet, for people; "" when all are."""
        if not self._unknown:
            return ""
        at = f" at {self._detected_from_ma:g} mA" if self._detected_from_ma else ""
        which = ", ".join(map(str, sorted(self._unknown)))
        return f"electrode not known until the first pulse{at} (channel {which})"


class Opened(NamedTuple):
    """A line that was opened again, its new session identifier, and what its handshake put on the wire."""

    line: StimulatorLine
    session_id: int
    frames: Sequence[WireFrame] = ()


class LiveStimulator:
    """Wraps an open line; what it meets becomes events for the loop, stamped by ``clock_ns``, see :meth:`events`.

    ``reopen`` opens it again; ``lost`` is the exception that says that it is gone. ``on_heard`` and ``on_frame`` get
    what belongs in the log beside commands and events.
    """

    def __init__(
        self, line: StimulatorLine, reopen: Callable[[], Opened], lost: type[Exception], clock_ns: Callable[[], int]
    ) -> None:
        self._line: StimulatorLine | None = line
        self._reopen = reopen
        self._lost = lost
        self._clock_ns = clock_ns
        self._attempts: Reopening[Opened] | None = None
        self._events: list[Event] = []
        self.unsent = 0
        self.on_heard: Callable[[int, bytes], None] = lambda t_ns, data: None
        self.on_frame: Callable[[WireFrame], None] = lambda frame: None

    @property
    def state(self) -> str:
        """ "open", or why it is not."""
        if self._attempts is None:
            return "open"
        return f"lost, is being opened again ({self._attempts.why_not})" if self._attempts.why_not else "lost"

    @property
    def is_open(self) -> bool:
        """Whether commands go out."""
        return self._line is not None

    def send(self, command: StimCommand) -> WireFrame:
        """Write the command; a frame with identifier 0 where nothing went out.

        A process that was held up between deciding and sending must not send what was right a second ago: *on* older
        than the data it may rest on is left out and is a fault. Off always goes.
        """
        if self._line is not None:
            late_ns = self._clock_ns() - command.t_ns
            if command.on and late_ns > limits.MAX_DATA_AGE_MS * 1_000_000:
                self._events.append(SystemFault(command.t_ns, f"a command was {late_ns / 1e6:.0f} ms late, not sent"))
            else:
                try:
                    frame = self._line.send(command)
                except self._lost as error:
                    self._lose(command.t_ns, error)
                else:
                    self.unsent += frame.identifier == UNSENT
                    return frame
        self.unsent += 1
        return WireFrame(command.t_ns, UNSENT, b"")

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """What has arrived; nothing from a line that is lost."""
        if self._line is None:
            return []
        try:
            answers = self._line.poll(t_ns)
        except self._lost as error:
            self._lose(t_ns, error)
            return []
        if heard := self._line.heard:
            self.on_heard(t_ns, heard)
        return answers

    def events(self, t_ns: int) -> Iterator[Event]:
        """Losses and reopenings since the last call."""
        if self._attempts is not None and (opened := self._attempts.poll(t_ns)) is not None:
            self._attempts = None
            self._line = opened.line
            for frame in opened.frames:
                self.on_frame(frame)
            self._events.append(StimOpened(t_ns, opened.session_id))
        while self._events:
            event = self._events.pop(0)
            yield SystemFault(t_ns, event.text) if isinstance(event, SystemFault) else event

    def add_fault(self, text: str) -> None:
        """The line itself has found what forbids stimulation."""
        self._events.append(SystemFault(0, text))

    def renew(self, t_ns: int) -> None:
        """Open the device again, under a new session identifier, though it was not lost."""
        if self._line is not None:
            self._open_again(t_ns)

    def close(self) -> None:
        """Release the line."""
        if self._line is not None:
            self._line.close()
            self._line = None

    def _open_again(self, t_ns: int) -> None:
        self.close()
        self._attempts = Reopening(self._reopen, t_ns)

    def _lose(self, t_ns: int, error: Exception) -> None:
        self._open_again(t_ns)
        self._events.append(SystemFault(t_ns, f"stimulator lost: {error}"[:200]))
