"""The stimulator that a session names, opened: the one place that knows all of them."""

import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Final, NamedTuple, Protocol

from drivers.stimulator.bus import open_bus
from drivers.stimulator.can_port import CanStimulator, Handshake
from drivers.stimulator.canopen_port import CanOpenSettings, CanOpenStimulator
from drivers.stimulator.p24_port import LowLevelStimulator, MidLevelStimulator, not_accepted
from drivers.stimulator.port import SessionUsed
from drivers.stimulator.rehastim2_port import RehaStim2
from drivers.stimulator.serial_line import SCIENCEMODE2, SCIENCEMODE4, Line, LineSettings, open_line
from fes.config import ConfigError, Session, StimulatorDevice
from fes.extensions import ExtensionError, load_extension
from fes.signals import StimAlive, StimCommand, StimStatus, WireFrame

_P24_OPTIONS: Final = frozenset(("model", "baudrate"))
_OPTIONS: Final[dict[str, frozenset[str]]] = {
    "can": frozenset(),
    "p24_low_level": _P24_OPTIONS,
    "p24_mid_level": _P24_OPTIONS | {"accept_watchdog_s"},
    "rehastim2": frozenset(),
}
CHANNELS_OF: Final = {"p24": 8, "rehamove3": 4}


class OtherStimulator(Protocol):
    """What another package's stimulator must have: a port (:mod:`drivers.stimulator.port`) with a handshake.

    ``send`` and ``poll`` never wait, "off" is a message of its own, and the device falls silent by itself when no
    command comes within ``validity_ms`` of the last one.
    """

    session_id: int
    current_step_ma: float  # between two currents that the device can deliver
    heard: bytes  # what the last poll read, b"" where the bytes that go out do not depend on it

    @property
    def outstanding(self) -> int:
        """Commands not yet answered."""

    def open(self, t_ns: int, timeout_s: float = 2.0) -> Handshake:
        """Begin the session; what it put on the wire and heard. StimulatorLost: nobody answers."""

    def send(self, command: StimCommand) -> WireFrame:
        """Write at once; what went out. StimulatorLost: the line did not take it."""

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """What has arrived since the last call, stamped ``t_ns``. StimulatorLost: the line broke."""

    def close(self) -> None:
        """Release the line; may be called twice, and sends nothing."""


Port = CanStimulator | CanOpenStimulator | LowLevelStimulator | MidLevelStimulator | RehaStim2 | OtherStimulator
_NEEDED: Final = ("open", "send", "poll", "close", "outstanding", "heard", "session_id", "current_step_ma")
Opener = Callable[[str, LineSettings], Line]
SERIAL: Final = ("p24_low_level", "p24_mid_level", "rehastim2")
IDENTIFIERS_TRIED: Final = 8  # a device that has been on for a day has had commands under a third of them


class OpenedSession(NamedTuple):
    """A stimulator with its session open, the session's identifier, and what opening it took."""

    port: Port
    session_id: int
    handshake: Handshake


def open_session(settings: StimulatorDevice, session: Session, t_ns: int) -> OpenedSession:
    """A stimulator ready for commands, under an identifier drawn by chance; under another where it has had that one.

    ``t_ns``: the time with which the handshake is stamped.

    Raises:
        ConfigError: as for :func:`open_stimulator`.
        StimulatorLost: the line cannot be opened, or the device does not answer.
    """
    for _ in range(IDENTIFIERS_TRIED - 1):
        with suppress(SessionUsed):
            return _open_once(settings, session, t_ns)
    return _open_once(settings, session, t_ns)


def _open_once(settings: StimulatorDevice, session: Session, t_ns: int) -> OpenedSession:
    session_id = secrets.randbelow(65535) + 1  # most likely not seen by the stimulator since it was switched on
    port = open_stimulator(settings, session, session_id)
    try:
        return OpenedSession(port, session_id, port.open(t_ns))
    except BaseException:
        port.close()
        raise


def open_stimulator(settings: StimulatorDevice, session: Session, session_id: int, opener: Opener = open_line) -> Port:
    """The port, its line open and its handshake still to come (``port.open(t_ns)``).

    Options: ``model`` ("p24" or "rehamove3") and ``baudrate`` for the p24 devices, ``accept_watchdog_s`` for
    ``p24_mid_level``; those of ``canopen`` are the fields of
    :class:`~drivers.stimulator.canopen_port.CanOpenSettings`. ``opener`` opens the line of the :data:`SERIAL` ones.

    Raises:
        ConfigError: an option that this device does not have, or a session that it cannot serve.
        StimulatorLost: the line or bus cannot be opened.
    """
    device = settings.device
    if device == "canopen":
        return _open_canopen(settings, session, session_id)
    if device not in _OPTIONS:
        return _open_other(settings, session, session_id)
    if unknown := sorted(settings.options.keys() - _OPTIONS[device]):
        allowed = ", ".join(sorted(_OPTIONS[device])) or "none"
        raise ConfigError(f"stimulator.options of device {device!r}: {', '.join(unknown)}; it has {allowed}")
    if device == "can":
        validity_ms = session.stimulation.validity_ms
        bus, clock_ns = open_bus(session.bus), time.monotonic_ns
        return CanStimulator(bus, session_id, in_real_time=True, clock_ns=clock_ns, validity_ms=validity_ms)
    if device == "rehastim2":
        _rate_suffices(settings, session)
        numbers = _channel_numbers(settings, session)
        return RehaStim2(opener(settings.port, SCIENCEMODE2), session_id, numbers)
    model = settings.options.get("model", "p24")
    if not isinstance(model, str) or model not in CHANNELS_OF:
        raise ConfigError(f"stimulator.options.model = {model!r}; one of: {', '.join(CHANNELS_OF)}")
    most = CHANNELS_OF[model]
    for channel in session.channels:
        if channel.number >= most:
            raise ConfigError(f"channel {channel.name!r}: number {channel.number}; a {model} has 0 to {most - 1}")
    baudrate = settings.options.get("baudrate", SCIENCEMODE4.baudrate)
    if isinstance(baudrate, bool) or not isinstance(baudrate, int) or baudrate <= 0:
        raise ConfigError(f"stimulator.options.baudrate = {baudrate!r} must be a whole number above 0")
    line_settings = replace(SCIENCEMODE4, baudrate=baudrate)
    if device == "p24_low_level":
        _rate_suffices(settings, session)
        return LowLevelStimulator(opener(settings.port, line_settings), session_id, most)
    accepted_s = settings.options.get("accept_watchdog_s", 0.0)
    if isinstance(accepted_s, (str, bool)):
        raise ConfigError(f"stimulator.options.accept_watchdog_s = {accepted_s!r} must be a number of seconds")
    if why := not_accepted(float(accepted_s)):
        raise ConfigError(why)
    line = opener(settings.port, line_settings)
    return MidLevelStimulator(line, session_id, most, accept_watchdog_s=accepted_s)


def open_lead_detected_from_ma(settings: StimulatorDevice) -> float | None:
    """From which current on such a device notices an open lead, 0: any pulse; None when its heartbeat says so.

    Another package's device notices it at any pulse; where it does not, electrodes stay unknown until one is answered.
    """
    if settings.device in ("p24_low_level", "p24_mid_level"):
        return 15.0
    return None if settings.device in ("can", "canopen") else 0.0


def _open_canopen(settings: StimulatorDevice, session: Session, session_id: int) -> Port:
    try:
        node = CanOpenSettings.from_options(settings.options)
    except ValueError as error:
        raise ConfigError(f"stimulator.options of device {settings.device!r}: {error}") from None
    _rate_suffices(settings, session)
    numbers = _channel_numbers(settings, session)
    for channel in session.channels:  # nothing that the gate lets through may be refused in the middle of a burst
        try:
            node.steps(channel.limits.max_current_ma, channel.limits.max_pulse_width_us)
        except ValueError as error:
            raise ConfigError(
                f"channel {channel.name!r}: its limits allow more than device 'canopen' delivers: {error}. Lower "
                "max_current_ma or max_pulse_width_us of channels.limits"
            ) from None
    bus = open_bus(session.bus, frozenset((node.heartbeat_id, node.answer_id)))
    return CanOpenStimulator(bus, session_id, numbers, node)


def _open_other(settings: StimulatorDevice, session: Session, session_id: int) -> OtherStimulator:
    """A stimulator of another package: its entry point makes the port from settings, session and identifier."""
    try:
        make = load_extension("stimulator", settings.device)
    except ExtensionError as error:
        raise ConfigError(f"stimulator.device: {error}") from error
    port: OtherStimulator = make(settings, session, session_id)
    if missing := [name for name in _NEEDED if not hasattr(port, name)]:
        raise ConfigError(f"stimulator.device = {settings.device!r} is no stimulator: it lacks {', '.join(missing)}")
    return port


def _channel_numbers(settings: StimulatorDevice, session: Session) -> list[int]:
    if not session.channels:
        raise ConfigError(f"device {settings.device!r} needs the session's channels; there are none")
    return [channel.number for channel in session.channels]


def _rate_suffices(settings: StimulatorDevice, session: Session) -> None:
    """One pulse for each command: no more pulses than commands."""
    rate_hz = session.stimulation.command_rate_hz
    for channel in session.channels:
        if channel.frequency_hz > rate_hz:
            raise ConfigError(
                f"channel {channel.name!r}: frequency_hz = {channel.frequency_hz:g} needs as many commands a second; "
                f"device {settings.device!r} gives one pulse for each, and command_rate_hz = {rate_hz:g}"
            )
