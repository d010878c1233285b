"""Stimulation timed by sensors on a radio, against the same walks on a cable.

Real feet walk at 100 Hz through a simulated Capture2Go (its clock 20 ppm fast), a radio with moments of a connection,
the driver, the stream, controller and gate, on a clock of the simulation; the cable's samples are there when they are
measured. Whoever is switched off by a fault arms again at once. Onsets are *detected* or *predicted*, each against its
own kind by cable; docs/imus.md says what the columns are. Counted from the radio's first burst on, for by radio none
begins before three strides tell when it will have to fall. *In stance* is current while the foot is in stance (by
cable, less its last 150 ms, in which a burst may begin early). Last the radio goes silent for good in mid-burst.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.lib.channels import channel
from benchmarks.lib.command_line import parser_of, publish, spread, table_of, verdict
from benchmarks.lib.real_sets import data_folder
from benchmarks.lib.walkers import calibrated
from benchmarks.loop.predicted_onset import Walked, walks
from drivers.imu.capture2go_port import Capture2GoRadio
from drivers.imu.port import ImuLost
from drivers.simulated.imu.device import ImuSignal, Radio, SimulatedImu, even_signal
from drivers.simulated.imu.serial_wires import Capture2GoWire
from fes import limits
from fes.config import ImuDevice, Session
from fes.control.clock_sync import SensorClock
from fes.control.controller import Controller
from fes.control.runner import TICK_NS, Runner
from fes.estimation.sensor_choice import Calibration
from fes.gate import gate_of
from fes.live.source import SensorStream
from fes.session_log import Note
from fes.signals import (
    NS_PER_S,
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimStatus,
    StrideResult,
    Tick,
    WireFrame,
)
from statemachine.phases import Phase, PhaseChange

MS = 1_000_000
RATE_HZ = 100.0
DRIFT_PPM = 20.0
NEAR_NS = 400 * MS
WITHIN_NS = 40 * MS
EARLY_NS = 150 * MS
SOONEST = 95.0  # % of onsets, the bar at 30 ms and 2 %
AFTER_NS = 50 * MS  # and beyond the budget, of current once it is silent
BEGIN_NS = 1_000 * NS_PER_S  # some time of the host's clock


# --- a radio on a clock of the simulation -----------------------------------------------------------------------------


@dataclass
class Clock:
    """What time it is."""

    t_ns: int = BEGIN_NS


class SimulatedConnection:
    """A :class:`Radio` as the driver's connection, with the simulation's clock; waiting moves it."""

    def __init__(self, radio: Radio, clock: Clock) -> None:
        self.name, self._radio, self._clock = "radio", radio, clock

    def write(self, _: str, package: bytes) -> None:
        # a command waits for the next moment, too
        self._radio.receive(max(self._radio.next_moment_ns(), self._clock.t_ns), package)

    write_soon = write

    def notifications(self) -> list[bytes]:
        return self._radio.advance(self._clock.t_ns)

    def wait(self, seconds: float) -> None:
        self._clock.t_ns = min(self._radio.next_moment_ns(), self._clock.t_ns + round(seconds * NS_PER_S))

    def fileno(self) -> None:
        """Nothing to wait on."""

    def close(self) -> None:
        """Nothing to release."""


class SimulatedRadio(Capture2GoRadio):
    """The driver over a simulated connection."""

    def __init__(self, device: ImuDevice, radio: Radio, clock: Clock) -> None:
        self._simulated = SimulatedConnection(radio, clock)
        super().__init__(device, lambda: clock.t_ns)

    def _connected(self) -> SimulatedConnection:
        return self._simulated


def by_radio(
    session: Session, signal: ImuSignal, adjust: Callable[[Radio], object], at: Callable[[Radio, int], object]
) -> Iterator[Event]:
    """What the live source would make of it, to the signal's end; ``at`` may do to the radio what it likes."""
    clock, (device,) = Clock(), session.sensors
    imu = SimulatedImu(Capture2GoWire(RATE_HZ, None, "1234ab"), signal, clock.t_ns, drift_ppm=DRIFT_PPM)
    radio = Radio(imu, clock.t_ns)
    adjust(radio)
    port = SimulatedRadio(device, radio, clock)
    stream = SensorStream(port, SensorClock, ImuLost, frozenset({str(device.sensor)}), session.by_radio)
    heard_ns, end_ns = clock.t_ns, BEGIN_NS + round(signal.size / signal.rate_hz * NS_PER_S)
    while clock.t_ns < end_ns:
        clock.t_ns = min(radio.next_moment_ns(), heard_ns + TICK_NS)
        at(radio, clock.t_ns)
        for event in stream.read(clock.t_ns):
            heard_ns = clock.t_ns
            yield event
        if clock.t_ns - heard_ns >= TICK_NS:
            heard_ns = clock.t_ns
            yield Tick(heard_ns)


def by_cable(sensor: str, signal: ImuSignal) -> Iterator[Event]:
    """Every sample when it is measured."""
    for number in range(signal.size):
        t_ns = BEGIN_NS + round(number / signal.rate_hz * NS_PER_S / (1.0 + 1e-6 * DRIFT_PPM))
        yield ImuSample(t_ns, sensor, t_ns, *signal.sample(number))


# --- through controller and gate --------------------------------------------------------------------------------------


def session_of(sensor: str, device: str, onset: str = "detected", packed: bool = False) -> Session:
    """One channel on tibialis anterior."""
    most = limits.RADIO
    limited = {"max_charge_per_minute_mc": most.max_charge_per_minute_mc, "max_on_s": most.max_on_s}
    worn = {"sensor": sensor, "device": device, "port": "IMU_1234ab", "rate_hz": RATE_HZ, "acc_range_g": 16.0}
    worn |= {"gyr_range_dps": 2000.0, "options": {"packed": True} if packed else {}}
    stimulation: dict[str, object] = {"validity_ms": most.max_validity_ms}
    stimulation |= {"max_data_age_ms": most.max_data_age_ms} if device == "capture2go_ble" else {}
    own = [channel(sensor, limited, onset=onset)]
    return Session.model_validate({"name": "radio", "stimulation": stimulation, "channels": own, "sensors": [worn]})


@dataclass
class Walk:
    """What a session made of a walk; a stimulator and a log for :class:`Runner`. Of a fault its time and words."""

    commands: list[StimCommand] = field(default_factory=list)
    phases: list[PhaseChange] = field(default_factory=list)
    strides: list[StrideResult] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    latches: list[tuple[int, str]] = field(default_factory=list)

    def send(self, command: StimCommand) -> WireFrame:
        self.commands.append(command)
        return WireFrame(command.t_ns, 0, b"")

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        return []

    def phase(self, change: PhaseChange) -> None:
        self.phases.append(change)

    def stride(self, result: StrideResult) -> None:
        self.strides.append(result)

    def note(self, note: Note) -> None:
        self.notes.append(note)

    def unread(self, *_: Any, **__: Any) -> None:
        """A command is kept when it is sent."""

    event = command = latency = unread

    def spans(self) -> list[tuple[int, int]]:
        """From the first command of each burst to its off, or to where its last command ran out."""
        found: list[tuple[int, int]] = []
        begun: int | None = None
        last_ns = 0
        for command in self.commands:
            if begun is not None and (not command.on or command.t_ns > last_ns):
                found.append((begun, min(command.t_ns, last_ns)))
                begun = None
            if command.on:
                begun = command.t_ns if begun is None else begun
                last_ns = command.t_ns + command.validity_ms * MS
        return found + ([(begun, last_ns)] if begun is not None else [])


def walked(session: Session, calibration: Calibration, events: Iterable[Event], *, again: bool = True) -> Walk:
    """A whole walk; armed as soon as the gate lets a person, ``again`` after every fault, or over with the first."""
    (channel,) = session.channels
    walk, foot = Walk(), str(channel.foot)
    gate = gate_of(session, {foot: calibration.up})
    runner = Runner(Controller(session, {foot: calibration}), gate, walk, walk, lambda: 0)
    for event in events:
        runner.handle(event)
        if gate.armed:
            continue
        if gate.latched and (not walk.latches or walk.latches[-1][1] is not gate.latched):
            walk.latches.append((event.t_ns, gate.latched))
            if not again:
                break
        runner.handle(OperatorAct(event.t_ns, OperatorAction.ARM))
        runner.handle(OperatorAct(event.t_ns, OperatorAction.SET_INTENSITY, 1.0))
    return walk


def stances(walk: Walk) -> list[tuple[int, int]]:
    """From foot flat to heel rise, or to the end."""
    found, since = [], None
    for change in walk.phases:
        if since is not None:
            found.append((since, change.t_ns))
        since = change.t_ns if change.destination is Phase.STANCE else None
    return found


def overlap_ns(span: tuple[int, int], spans: list[tuple[int, int]], less_ns: int = 0) -> int:
    """How long a span lies in others, each less so much at its end."""
    return sum(max(min(span[1], end - less_ns) - max(span[0], begin), 0) for begin, end in spans)


# --- figures ----------------------------------------------------------------------------------------------------------


@dataclass
class Figures:
    """Of one radio, over all walks."""

    hours: float = 0.0
    bursts: int = 0
    asked: int = 0  # of these since the radio's first
    lost: int = 0
    extra: int = 0
    cut: int = 0
    behind: int = 0
    off: int = 0
    over: int = 0
    late_ms: list[float] = field(default_factory=list)
    stance_ms: list[float] = field(default_factory=list)

    @property
    def within(self) -> float:
        """%."""
        near = sum(abs(late) * MS <= WITHIN_NS for late in self.late_ms)
        return 100.0 * near / max(self.asked, 1)

    def add(self, cable: Walk, radio: Walk, seconds: float) -> None:
        """One walk."""
        stood, bursts, by_radio = stances(cable), cable.spans(), radio.spans()
        contacts = [change.t_ns for change in cable.phases if change.destination is Phase.LOADING_RESPONSE]
        self.hours += seconds / 3600.0
        self.bursts += len(bursts)
        first_ns = by_radio[0][0] - NEAR_NS if by_radio else 0
        self.asked += sum(begin > first_ns for begin, _ in bursts)
        matched: set[int] = set()
        for begin, end in bursts:
            near = [n for n, (on_ns, _) in enumerate(by_radio) if abs(on_ns - begin) < NEAR_NS and n not in matched]
            if not near:
                self.lost += 1
                continue
            best = min(near, key=lambda n: abs(by_radio[n][0] - begin))
            matched.add(best)
            self.late_ms.append((by_radio[best][0] - begin) / MS)
            contact = next((t_ns for t_ns in contacts if begin < t_ns <= end), None)
            self.cut += contact is not None and by_radio[best][1] < contact
        self.extra += len(by_radio) - len(matched)
        self.stance_ms += [overlap_ns(span, stood, EARLY_NS) / MS for span in by_radio]
        self.behind += sum("refused" in note.text and "data" in note.text for note in radio.notes)
        self.off += len(radio.latches)
        self.over += sum(map(over, radio.commands))


def over(command: StimCommand) -> bool:
    """Whether a command is beyond what a radio allows."""
    most = limits.RADIO
    charge_uc = limits.charge_per_phase_uc(command.current_ma, command.pulse_width_us)
    beyond = command.current_ma > most.max_current_ma or charge_uc > most.max_charge_per_phase_uc
    return command.validity_ms > most.max_validity_ms or (command.on and beyond)


@dataclass(frozen=True)
class Setting:
    """One radio; ``away_s``: every 10 s it is away for so long."""

    name: str
    interval_ms: float = 30.0
    fails: float = 0.0
    lose_every_s: float = 0.0
    away_s: float = 0.0
    packed: bool = False

    def adjust(self, radio: Radio) -> None:
        """Make the radio so."""
        radio.interval_s, radio.fails = 1e-3 * self.interval_ms, self.fails

    def at(self, radio: Radio, t_ns: int) -> None:
        """What happens to it now."""
        since_ns = t_ns - BEGIN_NS
        if self.away_s and since_ns % (10 * NS_PER_S) < TICK_NS:
            radio.away_until_ns = t_ns + round(self.away_s * NS_PER_S)
        if self.lose_every_s and since_ns % round(self.lose_every_s * NS_PER_S) < TICK_NS:
            radio.lose = 1


SETTINGS = (
    *(Setting(f"{ms:g} ms, {loss} %", ms, loss / 100) for ms, loss in ((7.5, 0), (30, 0), (30, 2), (30, 10), (50, 10))),
    Setting("30 ms, 2 %, one notification lost every 3 s", 30.0, 0.02, lose_every_s=3.0),
    Setting("30 ms, away for 0.3 s every 10 s", 30.0, away_s=0.3),
    Setting("30 ms, away for 1.5 s every 10 s (a backlog)", 30.0, away_s=1.5),
    Setting("30 ms, 2 %, eight samples a package", 30.0, 0.02, packed=True),
)
BAR = "30 ms, 2 %"
PREDICTED = (BAR, "50 ms, 10 %", SETTINGS[-1].name)  # measured with prediction, too
CHOSEN = {"bundled trials": 3, "stroke_treadmill": 40, "stroke_walks": 40}  # of each set, one foot in so many


def silences(calibration: Calibration, sensor: str, signal: ImuSignal, cable: Walk) -> list[tuple[int, int]]:
    """For some bursts: how long current goes on (ns) once the radio is silent in it, and how long of that in stance."""
    session, found = session_of(sensor, "capture2go_ble"), []
    setting = Setting(BAR, 30.0, 0.02)
    stood = stances(cable)
    for share, (begin, end) in zip((0.2, 0.5, 0.8, 0.95) * 2, cable.spans()[12:44:4], strict=False):
        silent_ns = begin + round(share * (end - begin))
        kept = min(round((silent_ns - BEGIN_NS) / NS_PER_S * RATE_HZ) + round(2 * RATE_HZ), signal.size)
        cut = ImuSignal(RATE_HZ, signal.acc_mps2[:kept], signal.gyr_radps[:kept])

        def at(radio: Radio, t_ns: int, from_ns: int = silent_ns) -> None:
            if t_ns >= from_ns:
                radio.away_until_ns = sys.maxsize

        last = walked(session, calibration, by_radio(session, cut, setting.adjust, at)).spans()
        if last and last[-1][0] <= silent_ns < last[-1][1]:
            found.append((last[-1][1] - silent_ns, overlap_ns((silent_ns, last[-1][1]), stood)))
    return found


def chosen(data: Path) -> Iterator[Walked]:
    """The bundled trials, and some of the stroke survivors."""
    seen = dict.fromkeys(CHOSEN, 0)
    for walk in walks(data, list(CHOSEN)[1:]):
        if seen[walk.group] % CHOSEN[walk.group] == 0:
            yield walk
        seen[walk.group] += 1


def main(arguments: list[str] | None = None) -> int:
    options = parser_of(__doc__, data_folder()).parse_args(arguments)
    arms = [(setting, "detected") for setting in SETTINGS]
    arms += [(setting, "predicted") for setting in SETTINGS if setting.name in PREDICTED]
    figures = {(setting.name, onset): Figures() for setting, onset in arms}
    silent: list[tuple[int, int]] = []
    for walk in chosen(options.data):
        if (calibration := calibrated(walk.track)) is None:
            continue
        sensor, signal = walk.track.sensor, even_signal(walk.track, RATE_HZ)
        cables = {
            onset: walked(session_of(sensor, "capture2go", onset), calibration, by_cable(sensor, signal))
            for onset in ("predicted", "detected")
        }
        for setting, onset in arms:
            session = session_of(sensor, "capture2go_ble", onset, setting.packed)
            radio = walked(session, calibration, by_radio(session, signal, setting.adjust, setting.at))
            figures[setting.name, onset].add(cables[onset], radio, signal.size / RATE_HZ)
        silent += silences(calibration, sensor, signal, cables["detected"])
        bar = figures[BAR, "detected"]
        print(walk.group, walk.person, sensor, bar.bursts, f"{bar.within:.1f}", file=sys.stderr, flush=True)
    rows = []
    for (name, onset), f in figures.items():
        per, stance = 100.0 / max(f.bursts, 1), "–"
        if f.stance_ms:
            middle, most = np.percentile(f.stance_ms, (50, 95))
            stance = f"{middle:.0f}, {most:.0f}, {max(f.stance_ms):.0f}"
        rows.append([
            name, onset, str(f.bursts), spread(f.late_ms), f"{f.within:.1f} %", f"{per * f.lost:.1f}",
            f"{per * f.extra:.1f}", stance, f"{per * f.cut:.1f}", f"{f.behind / f.hours:.0f}", f"{f.off / f.hours:.1f}",
            str(f.over),
        ])  # fmt: skip
    columns = (
        "radio", "onset by", "bursts", "onset", "within 40", "lost", "extra", "in stance", "cut", "behind", "off",
        "over",
    )  # fmt: skip
    table = table_of("Against the cable, ms", columns, rows)
    on_ms, wrong_ms = (np.array(silent).reshape(-1, 2) / MS).T
    gone = Table("silences", "current goes on", "most", "in stance, most", title="The radio goes silent in a burst, ms")
    gone.add_row(str(len(on_ms)), spread(on_ms.tolist()), f"{on_ms.max():.0f}", f"{wrong_ms.max():.0f}")
    bar = figures[BAR, "detected"]
    most_ms = limits.RADIO.max_data_age_ms + AFTER_NS / MS
    said = f"Bars: at {BAR} {SOONEST:g} % of detected onsets within 40 ms: {bar.within:.1f} %; current for "
    said += f"{most_ms:.0f} ms after the radio goes silent at most: {on_ms.max():.0f} ms; "
    said += f"nothing over a limit: {sum(f.over for f in figures.values())}."
    publish([table, gone], options, [said])
    held = bar.within >= SOONEST and on_ms.max() <= most_ms and not any(f.over for f in figures.values())
    return verdict(held)


if __name__ == "__main__":
    sys.exit(main())
