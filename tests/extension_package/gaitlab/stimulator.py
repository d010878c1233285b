"""A stimulator for the bench that takes lines of text: what would be delivered goes into a file, answered at once."""

from pathlib import Path

from drivers.stimulator.can_port import Handshake
from drivers.stimulator.port import StimulatorLost
from fes.config import ConfigError, Session, StimulatorDevice
from fes.signals import StimAlive, StimCommand, StimStatus, WireFrame

SCHEME = "bench://"
BOOT_ID = 1


class BenchStimulator:
    """Writes into the file that ``port = "bench:///path"`` names. "Off" is a line of its own."""

    current_step_ma = 0.5
    heard = b""  # what goes out depends on no answer

    def __init__(self, settings: StimulatorDevice, session: Session, session_id: int) -> None:
        if not settings.port.startswith(SCHEME):
            raise ConfigError(f"stimulator.port = {settings.port!r} must begin with {SCHEME}")
        if settings.options:
            raise ConfigError(f"stimulator.options: {', '.join(settings.options)}; this device has none")
        self.session_id = session_id
        self._path = Path(settings.port.removeprefix(SCHEME))
        self._answers: list[StimCommand] = []
        self._sent = 0
        self._line = None

    @property
    def outstanding(self) -> int:
        return len(self._answers)

    def open(self, t_ns: int, timeout_s: float = 2.0) -> Handshake:
        try:
            self._line = self._path.open("a", encoding="ascii", buffering=1)
        except OSError as error:
            raise StimulatorLost(f"{self._path}: {error.strerror}") from error
        return Handshake(BOOT_ID, (), (StimAlive(t_ns, BOOT_ID, 0),))

    def send(self, command: StimCommand) -> WireFrame:
        if self._line is None:
            raise StimulatorLost(f"{self._path}: is not open")
        levels = f"{command.current_ma:g} {command.pulse_width_us:g} {command.frequency_hz:g} {command.validity_ms}"
        text = f"{command.channel} {'on ' + levels if command.on else 'off'}\n"
        try:
            self._line.write(text)
        except OSError as error:
            raise StimulatorLost(f"{self._path}: {error.strerror}") from error
        self._answers.append(command)
        return WireFrame(command.t_ns, 0, text.encode("ascii"))

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        answers: list[StimStatus | StimAlive] = []
        for command in self._answers:
            levels = (command.current_ma, command.pulse_width_us, command.frequency_hz) if command.on else (0.0,) * 3
            answers.append(StimStatus(t_ns, command.channel, self._sent % 16, command.on, *levels))
            self._sent += 1
        self._answers.clear()
        return answers

    def close(self) -> None:
        if self._line is not None:
            self._line.close()
            self._line = None
