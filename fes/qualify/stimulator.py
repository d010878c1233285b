"""A stimulator is qualified on a dummy load: every command goes through the session's own gate. Figures only.

Bursts are those of an exercise, which a person asks for. What came out is read from an oscilloscope across the load:
the host's own account says only what it sent. How long pulses go on is read as the length of a burst, from its first
pulse of half its height to its last, against the time from that command to *off*: both are late by the same delay.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.stimulator.can_port import COUNTERS
from drivers.stimulator.open import Port
from drivers.stimulator.port import StimulatorLost
from fes.config import Channel, ConfigError, Session, validate_session
from fes.gate import SafetyGate, gate_of
from fes.qualify.sensor import Clock, Figures, NotQualified, Reader
from fes.signals import NS_PER_S, OperatorAct, OperatorAction, StimRequest, StimStatus, SystemFault, Tick

CURRENT_MA, WIDTH_US = 10.0, 200.0  # low for a load of 1 kΩ, and well above what an oscilloscope shows as noise
CURRENTS: Final = 5
WIDTHS_US: Final = (100.0, 200.0, 300.0)
BURST_S, SWITCH_S, AFTER_S, RELEASE_S = 0.8, 2.0, 2.5, 5.0
SETTLE_S: Final = 0.2  # a CAN node takes no current until commands have come for 128 ms
NEEDED: Final = {
    "max_current_ma": 20.0,  # five of the coarsest steps, 2 mA, above the least
    "max_pulse_width_us": 200.0,
    "max_charge_per_phase_uc": 4.0,
    "max_rise_ma_per_s": 80.0,  # up there before the burst's second half
    "max_on_s": SWITCH_S + 0.2,
}
RISES: Final = 0.8  # of the channel's own limit
OWN_SWITCH: Final = ("rehastim2",)  # have an emergency switch of their own (docs/stimulators.md)
LENGTH: Final = "from the first pulse of half the height to the last one before a pause of over 200 ms"
LATER: Final = "pulses after such a pause, how many (0: none)"


class Ends(StrEnum):
    """How a burst comes to its end."""

    OFF = "off"
    STOP = "stop"
    SILENCE = "silence"
    SWITCH = "switch"


def exercise_of(session: Session, number: int, path: Path) -> Session:
    """The session's channel of this number as an exercise by itself, with its own limits and no sensor.

    ConfigError: no such channel, or its limits leave no room for what is tried.
    """
    channel = next((each for each in session.channels if each.number == number), None)
    if channel is None:
        known = ", ".join(str(each.number) for each in session.channels) or "none"
        raise ConfigError(f"there is no channel {number}; the session has {known}")
    if low := [f"{name} = {least:g}" for name, least in NEEDED.items() if getattr(channel.limits, name) < least]:
        raise ConfigError(
            f"{path}: channel {channel.name!r}: to be qualified it needs at least {', '.join(low)}. A file for "
            "the dummy load alone may allow them"
        )
    exercise = {"on_s": SWITCH_S, "off_s": 10.0, "count": 1, "rise_s": 0.1, "fall_s": 0.1, "channels": (number,)}
    alone = {**channel.model_dump(), "never_with": (), "tuning": None}
    changed = {"channels": [alone], "sensors": (), "foot_switches": (), "exercise": exercise}
    return validate_session({**session.model_dump(), **changed}, path)


@dataclass(eq=False)
class StimulatorBench:
    """A session of one channel, how its stimulator is opened, time and a person; :meth:`figures` goes through all.

    StimulatorLost: it cannot be reached (any more).
    """

    session: Session
    opener: Callable[[int], Port]
    clock: Clock
    person: Reader
    _port: Port | None = None
    _on: bool = False
    _latches: list[str] = field(default_factory=list)
    _answers_ms: list[float] = field(default_factory=list)
    _sent: dict[int, int] = field(default_factory=dict)
    _commands: int = 0
    _count: int = 0  # of this opening's
    _step_ma: float = 0.0  # between two currents; no burst may begin with more

    def __post_init__(self) -> None:
        self.channel: Channel = self.session.channels[0]

    def figures(self) -> Figures:
        """All of them, and the device off and its line released whatever happens."""
        try:
            return self._figures()
        finally:
            self._release()

    def _figures(self) -> Figures:
        port = self._open()
        step_ma, gate = port.current_step_ma, gate_of(self.session, {}, None, port.current_step_ma)
        base_ma = CURRENT_MA - CURRENT_MA % step_ma
        currents = [base_ma + number * step_ma for number in range(CURRENTS)]
        widths = [width for width in WIDTHS_US if width <= self.channel.limits.max_pulse_width_us]
        hz = min(self.session.stimulation.command_rate_hz / 2, self.channel.limits.max_frequency_hz)
        found: Figures = {"current_step_ma": step_ma, "asked_ma": currents, "asked_us": widths, "interval_ms": 1e3 / hz}
        scope = "Oscilloscope across the dummy load, single trigger, 5 s; a burst comes at once."
        read_ma, read_us = [], []
        for current_ma in currents:
            self.person.does("burst", scope)
            self._burst(gate, current_ma, WIDTH_US, hz)
            read_ma.append(self.person.reads("ma", "height of a pulse's first phase at the burst's end", "mA"))
        found |= {"read_ma": read_ma, "read_interval_ms": self.person.reads("interval_ms", "from pulse to pulse", "ms")}
        for width_us in widths:
            self.person.does("burst", scope)
            self._burst(gate, base_ma, width_us, hz)
            read_us.append(self.person.reads("us", "width of a pulse's first phase", "µs"))
        found["read_us"] = read_us
        for ends in (Ends.OFF, Ends.STOP, Ends.SILENCE):
            self.person.does("burst", scope)
            lasted_ms, refused = self._burst(gate, base_ma, WIDTH_US, hz, ends)
            found[f"{ends}_after_ms"] = self.person.reads("length_ms", LENGTH, "ms") - lasted_ms
            found[f"{ends}_later_pulses"] = self.person.reads("later", LATER, "pulses")
            if ends is Ends.STOP:
                found["stop_refused_commands"] = refused
        if self.session.stimulator.device in OWN_SWITCH:
            self.person.does("switch", f"{scope} While pulses come, press the stimulator's own emergency switch.")
            before = len(self._latches)
            self._burst(gate, base_ma, WIDTH_US, hz, Ends.SWITCH)
            found["switch_noticed"] = len(self._latches) > before
            del self._latches[before:]
            pressed = "from the press to the last pulse (0: none came)"
            found["switch_after_ms"] = self.person.reads("after_switch_ms", pressed, "ms")
            self.person.does("release", f"Release the switch within {RELEASE_S:g} s. Nothing must come by itself.")
            self._open()
            self._let_pass(gate, RELEASE_S)
            found["switch_released_pulses"] = self.person.reads("pulses", "pulses since it was released", "pulses")
        self.person.does("burst", scope)
        self._burst(gate, base_ma, WIDTH_US, hz)
        found["again_ma"] = self.person.reads("ma", "height of a pulse's first phase at the burst's end", "mA")
        answers = np.array(self._answers_ms or [np.nan])
        found |= {"answer_p50_ms": float(np.median(answers)), "answer_p99_ms": float(np.quantile(answers, 0.99))}
        return found | {"commands": self._commands, "answers": len(self._answers_ms), "latches": self._latches}

    def _open(self) -> Port:
        self._release()
        self._port = self.opener(self.clock.now_ns())
        self._sent.clear()
        self._count, self._step_ma = 0, self._port.current_step_ma
        return self._port

    def _release(self) -> None:
        """Off first, if it may still be on; a line that is broken takes no leave."""
        port, self._port = self._port, None
        if port is not None:
            try:
                if self._on:
                    off = gate_of(self.session, {}).judge(
                        self.clock.now_ns(), StimRequest(self.channel.number, on=False)
                    )
                    port.send(off)
            finally:
                port.close()

    def _burst(
        self, gate: SafetyGate, current_ma: float, width_us: float, hz: float, ends: Ends = Ends.OFF
    ) -> tuple[float, int]:
        """One burst and what comes after it; how long it was asked for in ms, and how many commands were refused.

        NotQualified: the gate refuses what is asked for, and the stimulator is not to blame.
        """
        self._open()  # while a person got ready it heard no command, and may have ended its session
        self._let_pass(gate, self.channel.limits.min_off_s + SETTLE_S)
        begin_ns, period_ns = self.clock.now_ns(), round(NS_PER_S / self.session.stimulation.command_rate_hz)
        for action in (OperatorAction.ARM, OperatorAction.EXERCISE):
            gate.observe(OperatorAct(begin_ns, action, float(self.channel.number)))
        burst_ns = round((SWITCH_S if ends is Ends.SWITCH else BURST_S) * NS_PER_S)
        rise_ma = RISES * self.channel.limits.max_rise_ma_per_s * period_ns / NS_PER_S
        half_ns: int | None = None
        stopped_ns: int | None = None
        refused, t_ns, number = 0, begin_ns, 0
        while t_ns < begin_ns + burst_ns + AFTER_S * NS_PER_S:
            over = t_ns >= begin_ns + burst_ns
            if over and stopped_ns is None:
                stopped_ns = t_ns
                if ends is Ends.STOP:
                    gate.observe(OperatorAct(t_ns, OperatorAction.EMERGENCY_STOP))
                if ends is Ends.SILENCE:
                    self._on = False
            if not (over and ends is Ends.SILENCE):
                wants = not over or ends is Ends.STOP  # after a stop the plan goes on asking: the gate must refuse
                level_ma = min(current_ma, self._step_ma * (1 + math.floor(rise_ma * number / self._step_ma)))
                half_ns = t_ns if half_ns is None and level_ma >= current_ma / 2 else half_ns
                request = StimRequest(self.channel.number, wants, *((level_ma, width_us, hz) if wants else ()))
                refused += self._send(gate, t_ns, request, may_be_refused=over or bool(self._new_latch(gate)))
            number += 1
            self._poll_until(gate, begin_ns + number * period_ns)
            t_ns = self.clock.now_ns()
        gate.observe(OperatorAct(t_ns, OperatorAction.DISARM))
        if (
            latch := self._new_latch(gate)
        ) and ends is not Ends.SILENCE:  # that a lease or a watchdog ended it, it may say
            self._latches.append(latch)
        if self._port is None:
            self._open()
        return ((stopped_ns or t_ns) - (half_ns or begin_ns)) / 1e6, refused

    @staticmethod
    def _new_latch(gate: SafetyGate) -> str:
        """Why the gate has gone off since it was armed, where that is the stimulator's doing."""
        return gate.latched if "stimulator" in gate.latched else ""

    def _send(self, gate: SafetyGate, t_ns: int, request: StimRequest, *, may_be_refused: bool) -> int:
        gate.observe(Tick(t_ns))
        command = gate.judge(t_ns, request)
        if command.refused and not may_be_refused:
            raise NotQualified(f"the gate refuses what is to be tried: {command.refused}")
        if self._port is None:
            return 0
        self._on = self._on or command.on
        try:
            self._port.send(command)
        except StimulatorLost as error:
            self._lose(gate, error)
            return 0
        self._on = command.on
        self._sent[self._count % COUNTERS] = t_ns
        self._count += 1
        self._commands += 1
        return bool(command.refused)

    def _poll_until(self, gate: SafetyGate, until_ns: int) -> None:
        while self.clock.now_ns() < until_ns:
            fileno: Any = getattr(self._port, "fileno", None)
            self.clock.wait(until_ns, fileno() if fileno is not None and fileno() >= 0 else None)
            if self._port is None:
                continue
            now_ns = self.clock.now_ns()
            try:
                events = self._port.poll(now_ns)
            except StimulatorLost as error:
                self._lose(gate, error)
                return
            for event in events:
                gate.observe(event)
                if not isinstance(event, StimStatus) or event.fault:
                    continue
                if (sent_ns := self._sent.pop(event.counter, None)) is not None:
                    self._answers_ms.append((now_ns - sent_ns) / 1e6)

    def _lose(self, gate: SafetyGate, error: StimulatorLost) -> None:
        """It is opened again with the next burst, and what happened stands in the evidence."""
        gate.observe(SystemFault(self.clock.now_ns(), f"stimulator lost: {error}"))
        self._on = False
        self._release()

    def _let_pass(self, gate: SafetyGate, seconds: float) -> None:
        """Time passes with *off* at the usual rate, as in a session."""
        end_ns = self.clock.now_ns() + int(seconds * NS_PER_S)
        while (now_ns := self.clock.now_ns()) < end_ns:
            self._send(gate, now_ns, StimRequest(self.channel.number, on=False), may_be_refused=True)
            self._poll_until(gate, now_ns + round(NS_PER_S / self.session.stimulation.command_rate_hz))
