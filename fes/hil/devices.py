"""What a campaign runs against: simulated devices on one transport, or the real devices of a session file.

With real devices faults of the host's side are brought about, and the sensors' between their drivers and the loop. A
second receiver on its bus hears what a stimulator on CAN says it delivers. Of another kind nobody but the session hears
that: what it makes of the answers is the judge, of faults of which neither it nor its supervisor dies or stands still.
"""

from __future__ import annotations

import os
import threading
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.imu.port import ImuLost
from drivers.simulated.bus_guests import Rogue, StopButton
from drivers.simulated.record import RecordEntry, RecordReader
from drivers.simulated.spawn import (
    DeviceHandle,
    DeviceKind,
    ImuHandle,
    ImuKind,
    NodeHandle,
    free_bus,
    spawn_device,
    spawn_imu,
    spawn_link,
    spawn_node,
    why_silent,
)
from drivers.stimulator.can_codec import STATUS_ID, FrameRejected, Result, Status, decode
from drivers.stimulator.port import StimulatorLost
from fes.analysis.pipeline import analyse
from fes.calibration.recording import SensorCalibrations, save
from fes.config import WIRELESS, Bus, ConfigError, Session, StimulatorDevice, load_session
from fes.estimation.events.offline import GaitEvents
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.hil.closed_loop.bench import PatientHandle, PatientSensor, campaign_patient
from fes.hil.results import PERIOD_NS
from fes.hil.scenarios import Needs, Scenario
from fes.hil.sensor_faults import PULSE_BY_PULSE, HeardAnswers, RealSensor
from fes.hil.settings import BUTTON_ID, FOOT, INTENSITY, RATE_HZ, SENSOR_HZ, STANDS_S, Walker, session_text, walker
from fes.recording import Recording, RecordingError, Track, write_recording
from fes.signals import FOOT_SENSORS, NS_PER_S, BoolArray, FloatArray

# --- A walk out of a recording, in the place of the simulated patient's: they stand, and walk on ------------


LEAVES_S: Final = 0.5  # from the end of the rest to the first foot off: the push-off is none of it
WALKS_S: Final = 10.0  # a patient who is to stand walks to the end first
SWINGS: Final = 3


def recorded_walker(
    recording: Recording, found: SensorCalibrations, folder: Path, rate_hz: float | None = None
) -> Walker:
    """Write the files of a foot that stands for :data:`STANDS_S` and then walks for about :data:`WALKS_S`.

    Nobody knows the true phases of a recording. In their place is what its off-line analysis finds with all samples at
    hand: stance lasts from foot flat to heel rise (:func:`fes.estimation.events.offline.find_events`).

    ``rate_hz``: of the sensor that plays it; None: the recording's.

    RecordingError: no foot does so, or no foot is calibrated.
    """
    analysis = analyse(recording, found.calibrations)
    for foot in sorted(FOOT_SENSORS, key=lambda name: name != FOOT):
        if foot in analysis.events and (walk_ns := _walk(recording.tracks[foot], analysis.events[foot])):
            break
    else:
        raise RecordingError(
            f"{recording.path or recording.name}: no calibrated foot stands for {STANDS_S + LEAVES_S:g} s and walks "
            f"{SWINGS} strides within {WALKS_S:g} s after it; the campaign arms at rest and injects while they walk"
        )
    track = recording.tracks[foot]
    first, last = np.searchsorted(track.t_sensor_ns, walk_ns).tolist()
    part = track.part(slice(first, last))
    path, calibration = folder / "walker.parquet", folder / "walker.calibration.json"
    write_recording(Recording(recording.name, None, {foot: part}), path, overwrite=True)
    save(found, calibration)
    rate_hz = rate_hz or float(round(track.rate_hz))
    grid_ns = part.t_sensor_ns[0] + np.arange(int((walk_ns[1] - walk_ns[0]) * rate_hz / NS_PER_S)) * (
        NS_PER_S / rate_hz
    )
    in_stance = _in_stance(grid_ns, analysis.events[foot])
    in_stance[: round(STANDS_S * rate_hz)] = True  # they stand, which comes after no swing
    ranges = track.acc_range_mps2, track.gyr_range_radps
    return Walker(path, calibration, in_stance, foot, rate_hz, *ranges)


def _walk(track: Track, events: GaitEvents) -> tuple[int, int] | None:
    """Begin and end, of the quietest such rest with its walk; it ends in mid-stance, where a foot moves least."""
    stands_ns, leaves_ns, walks_ns = (round(s * NS_PER_S) for s in (STANDS_S, LEAVES_S, WALKS_S))
    ends_ns = np.concatenate([track.t_sensor_ns[:1], events.ic_ns])[: len(events.fo_ns)]  # of the swing before each
    found: list[tuple[float, int, int]] = []
    for off_ns in events.fo_ns[events.fo_ns - ends_ns >= stands_ns + leaves_ns].tolist():
        begin_ns = off_ns - stands_ns - leaves_ns
        middles_ns = (events.ic_ns[:-1] + events.fo_ns[1 : len(events.ic_ns)]) // 2
        middles_ns = middles_ns[(middles_ns > off_ns) & (middles_ns < off_ns + walks_ns)]
        if len(middles_ns) >= SWINGS:
            rows = slice(*np.searchsorted(track.t_sensor_ns, [begin_ns, begin_ns + stands_ns]).tolist())
            found.append((float(np.square(track.gyr_radps[rows]).sum()), begin_ns, int(middles_ns[-1])))
    return min(found)[1:] if found else None


def _in_stance(t_ns: FloatArray, events: GaitEvents) -> BoolArray:
    """Which of these moments lie between a foot flat and the next heel rise, as far as both were seen."""
    flat_ns, rise_ns = events.foot_flat_ns, events.heel_rise_ns
    assert flat_ns is not None
    assert rise_ns is not None
    ends_ns = rise_ns[1:]
    begins_ns = flat_ns[: len(ends_ns)]
    seen = (begins_ns != UNSEEN_NS) & (ends_ns != UNSEEN_NS)
    borders = np.stack([begins_ns[seen], ends_ns[seen]], axis=1).ravel()
    return np.asarray(np.searchsorted(borders, t_ns, side="right") % 2 == 1)


TRANSPORTS: Final = ("udp_multicast", "loopback", "slcan", "socketcan", "serial", "serial_rehastim2")
SERIAL: Final[dict[str, tuple[DeviceKind, str]]] = {
    "serial": ("sciencemode4", "p24_low_level"),
    "serial_rehastim2": ("sciencemode2", "rehastim2"),
}


REALS: Final = ("xbus", "ximu3", "movella_dot")  # sensors that send floating point
Sensor = ImuHandle | PatientSensor
PlayedRecording = tuple[Recording, SensorCalibrations]
WATCHED: Final = ("view", "page")  # of the host's side as well, but nobody watches real devices
_ENDED_BY: Final = {Result.LEASE_EXPIRED: "lease_expired", Result.ON_TIME: "on_time"}


class Unavailable(RuntimeError):
    """This transport cannot be had on this machine; the message says why and what else there is."""


@dataclass(slots=True)
class Devices:
    """Running devices. ``sensor_port`` and the stimulator's are names that stay when what is behind them is replaced.

    ``front`` is the bus that the session is given, ``back`` the one that the simulated stimulator is on.
    """

    folder: Path
    transport: str
    calibration: Path
    walker: Walker
    stimulator: StimulatorDevice
    front: Bus | None
    back: Bus | None
    link: NodeHandle | None
    node: NodeHandle | DeviceHandle
    imu: Sensor
    spare: Sensor
    stack: ExitStack
    capabilities: frozenset[Needs]
    button_bus: Bus | None = None
    button: StopButton | None = None
    patient: PatientHandle | None = None
    sensors: ImuKind = "xbus"
    pulses: Path | None = None
    _tail: RecordReader = field(init=False)
    _left: list[RecordEntry] = field(default_factory=list)
    _replaced: int = 0
    _sensors: int = 1
    _stands: bool = False

    def __post_init__(self) -> None:
        self._tail = RecordReader(self.node.record or Path(os.devnull))

    @property
    def sensor_port(self) -> Path:
        """Where the session finds the sensor."""
        return self.folder / "sensor"

    @property
    def intensity(self) -> float:
        """That the operator raises to."""
        return INTENSITY

    def session_file(self, number: int, variant: str) -> Path:
        """Settings for the campaign's next session."""
        path = self.folder / f"session{number}.toml"
        bus = self.button_bus if variant == "button" else self.front
        text = session_text(variant, str(self.sensor_port), bus, self.stimulator, self.walker, self.sensors)
        path.write_text(text, encoding="utf-8")
        return path

    def processes(self) -> list[int]:
        """Ids of those that must keep their time whatever happens to the controller."""
        return [self.node.process.pid, *([self.link.process.pid] if self.link is not None else [])]

    def new_entries(self) -> list[RecordEntry]:
        """What the stimulators of this campaign have recorded since the last call; a replaced one's first."""
        left, self._left = self._left, []
        return left + self._tail.new_entries()

    def stand(self, stands: bool) -> None:
        """The patient stays standing, once they stand; or walks on."""
        self._stands = stands
        self.imu.inject("stand", STANDS_S if stands else 0.0)

    def stances_ns(self, since_ns: int, until_ns: int) -> list[tuple[int, int]] | None:
        """From when to when the foot was in stance, in truth; None with a virtual patient, whose feet nobody asks."""
        if isinstance(self.imu, PatientSensor):
            return None
        return self.walker.stances_ns(self.imu.played(), since_ns, until_ns)

    def sensor_replugged(self) -> None:
        """Another sensor is plugged in where the unplugged one was; it plays the same walk from its beginning."""
        set_link(self.sensor_port, self.spare.port)
        self.imu.stop()
        self.imu = self.spare
        if self.patient is not None:
            self.spare = PatientSensor(self.patient)
        else:
            self._sensors += 1
            self.spare = _sensor(self.folder, self.walker, self._sensors, self.sensors)
            self.stack.callback(self.spare.stop)
        self.stand(self._stands)

    def stimulator_replugged(self) -> None:
        """Another serial stimulator is plugged in where the unplugged one was."""
        self.node.stop()
        self._left += self._tail.new_entries()
        self._replaced += 1
        kind, _ = SERIAL[self.transport]
        record = self.folder / f"stimulator{self._replaced}.jsonl"
        self.node = spawn_device(kind, record=record, pulses=self.pulses)
        self.stack.callback(self.node.stop)
        self._tail = RecordReader(record)
        set_link(self.folder / "stimulator", self.node.port)

    def stop_button(self) -> StopButton:
        """The button on its bus, made when it is first asked for; let go."""
        if self.button is None:
            if self.button_bus is None:
                raise Unavailable(f"{self.transport} has no bus for a stop button")
            self.button = self.stack.enter_context(StopButton(self.button_bus, BUTTON_ID))
        return self.button


def _sensor(folder: Path, worn_by: Walker, number: int, kind: ImuKind) -> ImuHandle:
    record = folder / f"sensor{number}.jsonl"
    return spawn_imu(kind, sensor=worn_by.foot, recording=worn_by.recording, rate_hz=worn_by.rate_hz, record=record)


def set_link(link: Path, target: str) -> None:
    """Make a symbolic link, or turn it to another target in one step."""
    new = link.with_name(link.name + ".new")
    new.unlink(missing_ok=True)
    new.symlink_to(target)
    new.replace(link)


def start_devices(
    transport: str,
    folder: Path,
    stack: ExitStack,
    channel: str = "vcan0",
    *,
    closed_loop: bool = False,
    played: PlayedRecording | None = None,
    sensors: ImuKind = "xbus",
) -> Devices:
    """Start all of a transport's devices; ``stack`` ends them.

    ``closed_loop``: the sensor is worn by a virtual patient, who feels what the stimulator delivers. ``played``: the
    sensor plays a walk out of this recording. ``sensors``: which kind, one on a line of bytes or by radio.

    Raises:
        Unavailable: the transport is not to be had here, or a device does not start.
        RecordingError, CalibrationError: the recording cannot be used.
    """
    rate_hz = SENSOR_HZ.get(sensors)
    if closed_loop and rate_hz not in (None, RATE_HZ):
        raise Unavailable(
            f"{sensors} has {rate_hz:g} Hz, a virtual patient's sensors {RATE_HZ:g}. Leave out --closed-loop"
        )
    try:
        walked = recorded_walker(*played, folder, rate_hz) if played else walker(folder, rate_hz or RATE_HZ)
        calibration = walked.calibration
        patient, pulses = None, None
        if closed_loop:
            patient, calibration, pulses = campaign_patient(folder, stack, sensors)
        front, back, link, node, stimulator = _stimulator(transport, folder, stack, channel, pulses)
        imus: list[Sensor] = (
            [_sensor(folder, walked, number, sensors) for number in range(2)]
            if patient is None
            else [PatientSensor(patient, patient.ports[FOOT]), PatientSensor(patient)]
        )
    except (StimulatorLost, ImuLost) as error:
        raise Unavailable(f"{transport}: {error}") from error
    for each in imus:
        stack.callback(each.stop)
    set_link(folder / "sensor", imus[0].port)
    # nobody else can be on a serial adapter's line; a serial stimulator leaves the bus to the button
    button_bus = None if transport == "slcan" else free_bus() if front is None else front
    serial = transport in SERIAL
    capabilities = {
        **dict.fromkeys((Needs.SIMULATED, Needs.SENSOR, Needs.MOVES, Needs.HEARD), True),
        Needs.SERIAL: serial,
        Needs.CAN: not serial,
        Needs.LINK: serial or link is not None,
        Needs.SLCAN: transport == "slcan",
        Needs.BUTTON: button_bus is not None,
        Needs.LONG_STAND: played is None,
        Needs.REALS: sensors in REALS,
        Needs.UNSOUND: sensors.startswith("capture2go"),
        Needs.CABLE: sensors not in WIRELESS,
    }
    return Devices(
        folder, transport, calibration, walked, stimulator, front, back, link, node, imus[0], imus[1], stack,
        frozenset(need for need, met in capabilities.items() if met), button_bus, patient=patient, pulses=pulses,
        sensors=sensors,
    )  # fmt: skip


def _stimulator(
    transport: str, folder: Path, stack: ExitStack, channel: str, pulses: Path | None
) -> tuple[Bus | None, Bus | None, NodeHandle | None, NodeHandle | DeviceHandle, StimulatorDevice]:
    record = folder / "stimulator.jsonl"
    if transport in SERIAL:
        kind, name = SERIAL[transport]
        device = spawn_device(kind, record=record, pulses=pulses)
        stack.callback(device.stop)
        set_link(folder / "stimulator", device.port)
        settings = StimulatorDevice.model_validate({"device": name, "port": str(folder / "stimulator")})
        return None, None, None, device, settings
    link, adapter = None, folder / "adapter"
    if transport == "socketcan":
        front = back = Bus(interface="socketcan", channel=channel)
    elif transport == "slcan":
        options: dict[str, Any] = {"bitrate": 500000, "timeout": 0, "sleep_after_open": 0.2}
        back, front = free_bus(), Bus(interface="slcan", channel=str(adapter), options=options)
    else:
        back, front = free_bus(transport), free_bus(transport)
    if why := why_silent(back):
        raise Unavailable(
            f"{back.interface} {back.channel}: {why.rstrip('.')}. Other transports need no such thing: --transport "
            f"loopback, slcan or serial"
        )
    if front is not back:
        link = spawn_link(back, slcan=adapter) if transport == "slcan" else spawn_link(back, front=front)
        stack.callback(link.stop)
    node = spawn_node(record=record, bus=back, pulses=pulses)
    stack.callback(node.stop)
    return front, back, link, node, StimulatorDevice()


def on_hardware(scenario: Scenario) -> bool:
    """Whether this row can be brought about on real devices."""
    return Needs.SIMULATED not in scenario.needs and not scenario.name.startswith(WATCHED)


def hardware_session(path: Path) -> Session:
    """The settings, if a campaign can judge them.

    ConfigError: they cannot be used, or do not allow to tell a burst's end.
    """
    session = load_session(path)
    if not session.channels:
        raise ConfigError(f"{path}: channels are missing; there is nothing to stimulate")
    if session.stimulator.device in PULSE_BY_PULSE:
        least_hz = NS_PER_S / PERIOD_NS
        for channel in session.channels:
            if channel.frequency_hz < least_hz:
                raise ConfigError(
                    f"{path}: channel {channel.name!r}: frequency_hz = {channel.frequency_hz:g}: with device "
                    f"{session.stimulator.device!r} a pause between two pulses under {least_hz:.0f} Hz counts as an end"
                )
    return session


@dataclass(frozen=True, slots=True)
class Hardware:
    """Real devices as a campaign's bench; ``witness``: a second receiver on the stimulator's bus."""

    folder: Path
    path: Path
    calibration: Path
    intensity: float
    imu: RealSensor
    witness: BusWitness | None = None

    def session_file(self, number: int, variant: str) -> Path:
        """The one that there is."""
        return self.path

    def new_entries(self) -> list[RecordEntry]:
        """What the stimulator said since the last call: on the bus, or to the session."""
        return self.imu.new_entries() if self.witness is None else self.witness.new_entries()

    def sensor_replugged(self) -> None:
        """Its line can be opened again."""
        self.imu.inject("unplug", 0.0)

    @staticmethod
    def processes() -> list[int]:
        """None: devices keep their own time."""
        return []


@dataclass(slots=True)
class BusWitness:
    """Collects the stimulator's status frames in a thread, stamped when they came, as entries of a record."""

    rogue: Rogue
    _entries: list[RecordEntry] = field(default_factory=list)
    _read: int = 0
    _heard: HeardAnswers = field(default_factory=HeardAnswers)
    _over: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    def start(self, stack: ExitStack) -> None:
        """Listen until the stack closes."""
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        stack.callback(self.stop)

    def stop(self) -> None:
        """Listen no more."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(2.0)

    def new_entries(self) -> list[RecordEntry]:
        """What was heard since the last call."""
        before, self._read = self._read, len(self._entries)
        return self._entries[before : self._read]

    def note(self, t_ns: int, identifier: int, data: bytes) -> None:
        """A frame was heard."""
        message = None
        with suppress(FrameRejected):
            message = decode(identifier, data) if identifier == STATUS_ID else None
        if not isinstance(message, Status):
            return
        levels = (message.current_ma, message.pulse_width_us, message.frequency_hz)
        ended_by = _ENDED_BY.get(message.result, "off")
        if entry := self._heard.entry(t_ns, message.channel, message.on, levels, ended_by):
            self._entries.append(entry)

    def _listen(self) -> None:
        while not self._over.is_set():
            for frame in self.rogue.receive(0.02, first_only=True):
                self.note(time.monotonic_ns(), *frame)
