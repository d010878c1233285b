"""One virtual patient in closed loop, many times faster than life: patient → controller → gate → pulses → patient."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any

import numpy as np

from fes.calibration.recording import calibrate_track
from fes.config import Session
from fes.control.controller import Controller
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.sensor_choice import Calibration
from fes.gate.gate import gate_of
from fes.recording import Track
from fes.signals import (
    NS_PER_S,
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimCommand,
    StimStatus,
    StrideResult,
    Tick,
)
from fes.simulation.forward import DeliveredPulse, Harm, PatientSettings, VirtualPatient, VirtualStride, harm_of
from fes.stimulation.tuning.report import TuningReport
from statemachine.phases import Transition

STEP_NS = 10_000_000
CALIBRATION_S = 30.0


@dataclass
class Output:
    """The stimulator's output of one channel: pulses at the commanded rate while a command is valid."""

    command: StimCommand | None = None
    next_ns: int = 0
    counter: int = 0
    pulses: list[DeliveredPulse] = field(default_factory=list)

    def send(self, command: StimCommand) -> None:
        """Take a command; a burst begins with a pulse."""
        if self.command is None or not self.command.on:
            self.next_ns = command.t_ns
        self.command = command

    def until(self, t_ns: int) -> StimStatus | None:
        """Deliver what is due before ``t_ns``; the answer, None when nothing was delivered."""
        now = self.command
        if now is None or not now.on:
            return None
        count, end_ns = 0, min(t_ns, now.t_ns + now.validity_ms * 1_000_000)
        while self.next_ns < end_ns:
            self.pulses.append(DeliveredPulse(self.next_ns, now.channel, now.current_ma, now.pulse_width_us))
            self.next_ns += round(NS_PER_S / now.frequency_hz)
            count += 1
        if not count:
            return None
        self.counter = (self.counter + 1) % 16
        charge_uc = count * now.current_ma * now.pulse_width_us * 1e-3
        levels = (now.current_ma, now.pulse_width_us, now.frequency_hz)
        return StimStatus(t_ns, now.channel, self.counter, True, *levels, count, charge_uc)


@dataclass
class Walk:
    """What a walk left: the patient's true strides of the affected foot, measured ones, reports, all pulses."""

    strides: list[VirtualStride]
    measured: list[StrideResult]
    reports: list[TuningReport]
    refused: set[str]
    latched: str
    charge_uc: float
    controller: Controller
    pulses: list[DeliveredPulse] = field(default_factory=list)
    put_back: int = 0  # heels lifted and put back (T5)

    @property
    def harm(self) -> Harm:
        """What the stimulation did to the patient, over all strides."""
        return harm_of(self.strides)


def calibration_of(settings: PatientSettings, made: Callable[[Any], Any] = VirtualPatient) -> FootCalibration:
    """From a walk of the same patient without stimulation."""
    foot = settings.affected_foot
    samples = [s for s in made(settings).advance(round(CALIBRATION_S * NS_PER_S)) if s.sensor == foot]
    t_ns = np.array([sample.t_ns for sample in samples])
    acc = np.array([sample.acc_mps2 for sample in samples])
    gyr = np.array([sample.gyr_radps for sample in samples])
    return calibrate_track(Track(foot, settings.rate_hz, t_ns, t_ns, acc, gyr, 16.0 * 9.80665, 34.9))


def walk(
    settings: PatientSettings,
    session: Session,
    calibration: FootCalibration,
    seconds: float,
    strides: int,
    during: Callable[[VirtualPatient, int], None] | None = None,
    lost: Callable[[int], bool] | None = None,
    seen: Callable[[ImuSample], ImuSample] | None = None,
    prepare: Callable[[Controller], None] | None = None,
    made: Callable[[Any], Any] = VirtualPatient,
) -> Walk:
    """Walk until ``strides`` of the affected foot or ``seconds`` are over.

    Args:
        settings: of the patient.
        session: of the controller.
        calibration: of the affected foot.
        seconds: at most.
        strides: at most.
        during: called every step with the patient and the time in ns, to do something to it.
        lost: whether what the sensor says at a time in ns is lost.
        seen: what becomes of a sample that is not.
        prepare: called with the controller before the first event, as to take a part of the tuning away.
        made: makes the patient of the settings.
    """
    patient, foot = made(settings), settings.affected_foot
    calibrations: dict[str, Calibration] = {foot: calibration}
    controller = Controller(session, calibrations)
    gate = gate_of(session, {foot: calibration.up}, {})
    outputs = {channel.number: Output() for channel in session.channels}
    if prepare:
        prepare(controller)
    done = Walk([], [], [], set(), "", 0.0, controller)

    def handle(event: Event) -> None:
        gate.observe(event)
        decision = controller.step(event)
        for request in decision.requests:
            command = gate.judge(event.t_ns, request)
            outputs[command.channel].send(command)
            if command.refused and "not armed" not in command.refused:
                done.refused.add(command.refused)
        done.reports.extend(decision.reports)
        for outcome in decision.outcomes:
            if isinstance(outcome, StrideResult):
                done.measured.append(outcome)
            elif outcome.transition is Transition.T5:
                done.put_back += 1

    armed, t_ns, seen_strides = False, 0, 0
    while t_ns < seconds * NS_PER_S and len(done.strides) < strides:
        t_ns += STEP_NS
        pulses = sorted((p for output in outputs.values() for p in output.pulses), key=attrgetter("t_ns"))
        for output in outputs.values():
            output.pulses = []
        done.charge_uc += sum(pulse.charge_uc for pulse in pulses)
        done.pulses += pulses
        for sample in patient.advance(t_ns, pulses):
            if sample.sensor == foot and not (lost and lost(sample.t_ns)):
                handle(seen(sample) if seen else sample)
        handle(Tick(t_ns))
        if during:
            during(patient, t_ns)
        if not armed and t_ns >= 2 * NS_PER_S:
            armed = True
            handle(OperatorAct(t_ns, OperatorAction.ARM))
            handle(OperatorAct(t_ns, OperatorAction.SET_INTENSITY, 1.0))
        for output in outputs.values():
            if (status := output.until(t_ns + STEP_NS)) is not None:
                handle(replace(status, t_ns=t_ns))
        new, seen_strides = patient.strides[seen_strides:], len(patient.strides)
        done.strides += [one for one in new if one.foot == foot and one.walking]
    done.latched = gate.latched
    return done
