"""The wrong phase that a line late from its opening gives: current in stance, unless the arming test refuses it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from fes.calibration.recording import calibrate_phase_sensors
from fes.config import ImuDevice, load_session
from fes.control.clock_sync import SensorClock
from fes.control.controller import Controller
from fes.gate import gate_of
from fes.live.commands import CommandKind, OperatorCommand
from fes.live.operator import Operator
from fes.live.sensor_monitor import SensorMonitor
from fes.session_log import Note
from fes.signals import NS_PER_S, Event, ImuSample, StimAlive, SystemFault, Tick
from fes.simulation.forward import settings_for
from fes.simulation.forward.closed_loop import recorded_walk, walk_with_truth
from statemachine.phases import Phase

SESSION = Path(__file__).resolve().parents[2] / "sim_inputs" / "session.toml"
FOOT, RATE_HZ = "right_foot", 200.0
STANDS_S, WALKS_S = 10.0, 15.0
LOST_S, OPENED_S, TAPPED_S, ARMED_S, RAISED_S = 2.5, 3.0, 4.5, 7.0, 7.2  # of the patient's time
KNOCK_S, KNOCK_RADPS = 0.06, 2.0
TICK_NS = 20_000_000


@dataclass(frozen=True)
class Outcome:
    """Whether it was armed again, current with the foot truly in stance (ms in all, longest), and what was said."""

    armed: bool
    wrong_ms: float
    longest_ms: float
    said: str


def armed_again(late_s: float, *, proves: bool) -> Outcome:
    """One session."""
    patient = settings_for("healthy", seed=7, speed_mps=1.0, sensors=(FOOT,), rate_hz=RATE_HZ)
    patient = replace(patient, stand_s=STANDS_S)
    walked, truth = walk_with_truth(patient, WALKS_S, 1.0, "late", "simulated")
    calibration = calibrate_phase_sensors(recorded_walk(patient, WALKS_S, 1.0, "calibration", "simulated")).calibrations
    device = ImuDevice(sensor=FOOT, device="xbus", port="x", rate_hz=RATE_HZ, acc_range_g=16, gyr_range_dps=2000)
    session = load_session(SESSION)
    channels = tuple(channel for channel in session.channels if channel.foot == FOOT)
    session = session.model_copy(update={"sensors": (device,), "channels": channels})
    controller = Controller(session, calibration)
    gate = gate_of(session, {FOOT: calibration[FOOT].up})
    monitor = SensorMonitor(device, calibration[FOOT])
    notes: list[Note] = []
    answered_ns = 0
    operator = Operator(
        session, controller, gate, {FOOT: monitor}, {FOOT: FOOT}, notes.append, lambda: answered_ns, side="right"
    )
    track = walked.tracks[FOOT]
    origin_ns = int(track.t_sensor_ns[0])
    timeline: list[tuple[int, int, Event | CommandKind]] = []  # when, order, what
    clock = SensorClock()
    for stamp, acc, gyr in zip(track.t_sensor_ns.tolist(), track.acc_mps2, track.gyr_radps, strict=True):
        t_s = (stamp - origin_ns) / NS_PER_S
        if LOST_S <= t_s < OPENED_S:
            clock = SensorClock()
            continue
        arrival_ns = stamp + round(late_s * NS_PER_S) * (t_s >= OPENED_S)
        knock = KNOCK_RADPS * np.sin(np.pi * (t_s - TAPPED_S) / KNOCK_S) if 0 <= t_s - TAPPED_S < KNOCK_S else 0.0
        sample = ImuSample(
            arrival_ns, FOOT, clock.map(arrival_ns, stamp), tuple(acc.tolist()), tuple((gyr + knock).tolist())
        )
        timeline.append((arrival_ns, 0, sample))
    end_ns = int(track.t_sensor_ns[-1])
    timeline.append((origin_ns + round(LOST_S * NS_PER_S), 0, SystemFault(0, f"{FOOT}: sensor lost: unplugged")))
    timeline += [(t_ns, 1, Tick(t_ns)) for t_ns in range(origin_ns, end_ns, TICK_NS)]
    timeline += [(t_ns, 1, StimAlive(t_ns, 7, 0)) for t_ns in range(origin_ns, end_ns, 5 * TICK_NS)]
    keys = [(TAPPED_S, CommandKind.ARM)] * proves + [(ARMED_S, CommandKind.ARM)]
    keys += [(RAISED_S + 0.12 * number, CommandKind.UP) for number in range(20)]
    timeline += [(origin_ns + round(t_s * NS_PER_S), 2, kind) for t_s, kind in keys]
    stances = truth.feet[FOOT]
    on: list[tuple[int, bool]] = []

    def handle(event: Event) -> None:
        if isinstance(event, ImuSample):
            monitor.add(event)
        gate.observe(event)
        for request in controller.step(event).requests:
            command = gate.judge(event.t_ns, request)
            if command.channel == channels[0].number:
                on.append((event.t_ns, command.on))
        operator.follow(event)

    armed = False
    for t_ns, _, what in sorted(timeline, key=lambda entry: entry[:2]):
        if isinstance(what, CommandKind):
            for event in operator.execute(OperatorCommand(what), t_ns):
                handle(event)
            armed |= gate.armed
            continue
        if isinstance(what, SystemFault):
            what = replace(what, t_ns=t_ns)
        if isinstance(what, StimAlive):
            answered_ns = t_ns
        handle(what)
        if not proves:
            gate.doubted.clear()  # as before there was a test
    spans = [(begin, end) for (begin, is_on), (end, _) in pairwise(on) if is_on]
    at_ns = np.concatenate([np.arange(begin, end, 1_000_000) for begin, end in spans]) if spans else np.zeros(0)
    row = np.clip(np.searchsorted(stances.t_ns, at_ns), 0, len(stances.t_ns) - 1)
    wrong = at_ns[stances.phase[row] == Phase.STANCE]
    runs = np.split(wrong, np.flatnonzero(np.diff(wrong) > 2_000_000) + 1)
    said = [note.text for note in notes if "tap" in note.text]
    return Outcome(armed, float(len(wrong)), float(max(map(len, runs))), said[0] if said else "")


@pytest.mark.requirement("SR-27")
def test_a_line_that_comes_back_late_by_06_s_gives_no_current_in_stance() -> None:
    """As the audit had it: without the test, current flows through stances."""
    without, honest = armed_again(0.6, proves=False), armed_again(0.0, proves=True)
    assert without.armed
    assert without.longest_ms > 400
    assert honest.armed
    assert honest.longest_ms < 40
    late = armed_again(0.6, proves=True)
    assert not late.armed
    assert late.wrong_ms == 0
    assert "a tap seen 605 ms after the key" in late.said
