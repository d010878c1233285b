"""Orders become events only where the state allows them, and arming only when nothing speaks against it."""

from __future__ import annotations

import json
import math
import os
import socket
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from live_parts import MS
from replays import SETTINGS
from rich.console import Console
from test_tuning_controller import tuned_session

from fes.config import ImuDevice, Session, load_session
from fes.control.controller import Controller
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.gate import gate_of
from fes.live.commands import (
    NEEDS_CONFIRMATION,
    CommandRefused,
    OperatorCommand,
    State,
    command_of_message,
    commands_of_keys,
)
from fes.live.commands import CommandKind as Kind
from fes.live.dashboard.access import Access
from fes.live.dashboard.process import about_session
from fes.live.dashboard.server import MessageHandler
from fes.live.dashboard.stream import DashboardCommands, DashboardStream
from fes.live.inputs import Control, FootSwitchInput, Keyboard, StopSwitch
from fes.live.log_pipe import PipedLog
from fes.live.monitor import Electrodes, Monitor, Notices, ShownLog, SwitchComparison, tuning_status
from fes.live.operator import Operator, unchecked_side
from fes.live.sensor_monitor import SensorMonitor
from fes.live.status import FootStatus, Status, percent_of, remedy
from fes.live.terminal_view import picture
from fes.session_log import Note, read_session
from fes.signals import (
    Event,
    FootSwitchEvent,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StrideResult,
    SystemFault,
    Vector3,
)
from statemachine.phases import Phase, PhaseChange, Transition

FOOT = "right_foot"
RATE_HZ = 100.0
CALIBRATION = FootCalibration(
    sensor=FOOT,
    rate_hz=RATE_HZ,
    up=(0.0, 0.0, 1.0),
    toe_down=(0.0, 1.0, 0.0),
    acc_bias_mps2=(0.0, 0.0, 0.0),
    gyr_bias_radps=(0.0, 0.0, 0.0),
    push_off_radps=2.5,
    fall_radps=5.0,
    stride_s=1.6,
    contact_jerk_mps3=2000.0,
    axis_confidence=1.0,
    strides=6,
    standing=True,
)


def settings() -> Session:
    device = ImuDevice(sensor=FOOT, device="xbus", port="x", rate_hz=RATE_HZ, acc_range_g=16, gyr_range_dps=2000)
    return load_session(SETTINGS).model_copy(update={"sensors": (device,)})


class Bench:
    """Operator, gate and controller; :meth:`stand` lets samples come."""

    def __init__(
        self, session: Session | None = None, side: str = "right", phase_sensor_of: dict[str, str] | None = None
    ) -> None:
        session = settings() if session is None else session
        self.t_ns = 0
        self.answered_ns: int | None = None
        self.notes: list[Note] = []
        self.further: list[str] = []
        self.controller = Controller(session, {FOOT: CALIBRATION})
        self.gate = gate_of(session, {FOOT: CALIBRATION.up})
        self.monitor = SensorMonitor(session.sensors[0], CALIBRATION)
        self.operator = Operator(
            session,
            self.controller,
            self.gate,
            {FOOT: self.monitor},
            phase_sensor_of or {FOOT: FOOT},
            self.notes.append,
            lambda: self.answered_ns,
            lambda: self.further,
            side=side,
        )

    def handle(self, event: Event) -> None:
        if isinstance(event, ImuSample):
            self.monitor.add(event)
        self.gate.observe(event)
        for request in self.controller.step(event).requests:
            self.gate.judge(event.t_ns, request)
        self.operator.follow(event)

    def stand(self, seconds: float, acc: Vector3 = (0.0, 0.0, 9.81), gyr_radps: float = 0.0, every: int = 1) -> None:
        for number in range(int(seconds * RATE_HZ)):
            self.t_ns += 10 * MS
            if number % every == 0:
                noise = 0.001 * (number % 7)
                living = (acc[0] + noise, acc[1], acc[2])
                self.handle(ImuSample(self.t_ns, FOOT, self.t_ns, living, (noise, gyr_radps * (-1) ** number, 0.0)))
            if number % 10 == 0:
                self.answered_ns = self.t_ns
                self.handle(StimAlive(self.t_ns, 7, 0))

    def command(self, ask: Kind, value: float = 0.0) -> list[Event]:
        events = self.operator.execute(OperatorCommand(ask, value), self.t_ns)
        for event in events:
            self.handle(event)
        return events

    def armed(self) -> Bench:
        self.stand(3.0)
        self.command(Kind.ARM)
        assert self.operator.state is State.ARMED, self.operator.message
        return self


def test_it_gets_ready_is_armed_by_hand_and_starts_from_nothing() -> None:
    bench = Bench()
    bench.stand(1.0)
    assert bench.operator.state is State.OFF
    assert bench.command(Kind.ARM) == []
    bench.stand(2.0)
    assert bench.operator.state is State.SHADOW
    bench.command(Kind.UP)
    assert bench.controller.intensity == pytest.approx(0.05)  # in the shadow it stimulates nobody
    assert not bench.gate.armed
    bench.command(Kind.ARM)
    assert bench.operator.state is State.ARMED
    assert bench.gate.armed
    assert bench.controller.intensity == 0.0


def side_notes(bench: Bench) -> list[str]:
    return [note.text for note in bench.notes if "confirmed" in note.text]


@pytest.mark.requirement("SR-21")
def test_one_legs_side_is_asked_of_the_operator_once_and_the_answer_noted() -> None:
    bench = Bench(side="")
    bench.stand(3.0)
    assert bench.command(Kind.ARM) == []
    assert bench.operator.message == (
        "Movement does not tell which leg each sensor is on: is right_foot on the right leg? a again"
    )
    assert bench.operator.state is State.SHADOW
    bench.stand(5.1)  # too late: asked anew
    assert bench.command(Kind.ARM) == []
    assert side_notes(bench) == []
    bench.command(Kind.ARM)
    assert bench.operator.state is State.ARMED
    assert side_notes(bench) == ["right_foot on the right leg, confirmed (key)"]
    bench.command(Kind.DISARM)
    bench.stand(1.0)
    bench.command(Kind.ARM)
    assert bench.operator.state is State.ARMED
    assert len(side_notes(bench)) == 1


@pytest.mark.requirement("SR-21")
@pytest.mark.parametrize(("side", "origin", "by"), [("right", "key", "--side"), ("", "control", "control")])
def test_one_legs_side_that_was_said_otherwise_is_noted_as_such(side: str, origin: str, by: str) -> None:
    bench = Bench(side=side)
    bench.stand(3.0)
    for event in bench.operator.execute(OperatorCommand(Kind.ARM, origin=origin), bench.t_ns):
        bench.handle(event)
    assert bench.operator.state is State.ARMED
    assert side_notes(bench) == [f"right_foot on the right leg, confirmed ({by})"]


def test_the_other_side_said_confirms_nothing() -> None:
    bench = Bench(side="left")
    bench.stand(3.0)
    assert bench.command(Kind.ARM) == []
    assert bench.operator.state is State.SHADOW


SHANKS = {"left_foot": "left_shank", "right_foot": "right_shank"}
MIXED = {"left_foot": "left_foot", "right_foot": "right_shank"}


@pytest.mark.parametrize("worn", [SHANKS, MIXED])
def test_both_legs_are_asked_for_where_not_both_feet_have_sensors_of_their_own(worn: dict[str, str]) -> None:
    left, right = worn.values()
    said = f"{left} on the left leg and {right} on the right leg"
    bench = Bench(phase_sensor_of=worn)
    bench.stand(3.0)
    assert bench.command(Kind.ARM) == []
    assert bench.operator.message == f"Movement does not tell which leg each sensor is on: is {said}? a again"
    bench.command(Kind.ARM)
    assert bench.operator.state is State.ARMED
    assert side_notes(bench) == [f"{said}, confirmed (key)"]
    bench = Bench(side="both", phase_sensor_of=worn).armed()
    assert side_notes(bench) == [f"{said}, confirmed (--side)"]


def test_two_feet_with_sensors_of_their_own_are_not_asked_for() -> None:
    bench = Bench(side="", phase_sensor_of={foot: foot for foot in SHANKS}).armed()
    assert side_notes(bench) == []
    assert unchecked_side({}) == ""
    assert unchecked_side({"left_foot": "left_foot"}) == unchecked_side({"left_foot": "left_shank"}) == "left"


def test_the_page_asks_what_the_session_asks() -> None:
    def asked(mode: str, *calibrated: str) -> str:
        return str(about_session(settings(), mode, calibrated)["ask_side"])

    both = asked("live", "left_shank", "right_shank")
    assert both.endswith("is left_shank on the left leg and right_shank on the right leg?")
    assert asked("live", "left_foot").endswith("is left_foot on the left leg?")
    assert asked("live", "left_foot", "right_foot") == asked("replay") == asked("exercise", "left_foot") == ""


class Steps:
    """Stands in for a foot's tracker: phase changes and strides at known times."""

    def __init__(self, outcomes: dict[int, list[PhaseChange | StrideResult]]) -> None:
        self.phase = Phase.STANCE
        self._outcomes = outcomes

    def step(self, t_ns: int, acc_mps2: Vector3, gyr_radps: Vector3) -> list[PhaseChange | StrideResult]:
        outcomes = self._outcomes.get(t_ns, [])
        self.phase = next((each.destination for each in outcomes if isinstance(each, PhaseChange)), self.phase)
        return outcomes


def steps_from(begin_ns: int, strides: int) -> Steps:
    """Strides of a metre and a second each."""
    outcomes: dict[int, list[PhaseChange | StrideResult]] = {}
    for number in range(strides):
        t_ns, closed = begin_ns + number * 1000 * MS, []
        if number:
            sizes = 1.0, 0.1, 0.0, 0.0, 1.0
            closed = [StrideResult(FOOT, number, t_ns - 1000 * MS, t_ns, *sizes, None, None, None, None, True, "")]
        path = zip((0, 100, 400, 500), ("T1", "T2", "T3", "T4"), strict=True)
        for after_ms, name in path:
            source = Phase(int(name[1]) - 1)
            change = PhaseChange(t_ns + after_ms * MS, FOOT, Transition[name], source, Phase(int(name[1]) % 4))
            outcomes[change.t_ns] = [*(closed if name == "T1" else []), change]
    return Steps(outcomes)


def test_standing_after_a_walk_is_armed_and_a_test_burst_is_possible() -> None:
    bench = Bench().armed()
    bench.controller.trackers[FOOT] = cast("FootTracker", steps_from(bench.t_ns + 500 * MS, 6))
    bench.stand(6.0)
    assert bench.operator.state is State.RUNNING
    bench.stand(3.0)
    assert bench.operator.state is State.ARMED
    assert not bench.controller.walking(FOOT)
    bench.command(Kind.DISARM)
    bench.command(Kind.ARM)
    bench.stand(1.0)
    assert bench.operator.state is State.ARMED
    assert [act.action for act in bench.command(Kind.TEST) if isinstance(act, OperatorAct)] == [
        OperatorAction.TEST_BURST
    ]


def test_a_stop_during_a_fault_is_what_the_session_is_off_for() -> None:
    bench = Bench().armed()
    bench.handle(SystemFault(bench.t_ns, "right_foot: sensor lost: unplugged"))
    assert bench.operator.state is State.FAULT
    assert bench.operator.why_off == bench.gate.latched == "right_foot: sensor lost: unplugged"
    bench.command(Kind.STOP)
    bench.stand(1.0)
    assert bench.operator.state is State.STOPPED
    assert bench.operator.why_off == "emergency stop"
    assert bench.operator.message == "emergency stop (key)"
    bench.gate.doubted.clear()  # as after a tap with the key
    bench.command(Kind.ARM)
    assert bench.operator.why_off == ""


def test_what_was_latched_before_a_stall_did_not_come_of_it() -> None:
    bench = Bench().armed()
    bench.handle(SystemFault(bench.t_ns, "lease expired"))
    bench.operator.explain_fault(bench.t_ns + 500 * MS, "controller stalled for 223 ms", 223 * MS)
    assert bench.operator.why_off == "lease expired"
    bench.operator.explain_fault(bench.t_ns + 200 * MS, "controller stalled for 223 ms", 223 * MS)
    assert bench.operator.why_off == "controller stalled for 223 ms, then: lease expired"
    bench.stand(1.0)
    bench.command(Kind.ARM)
    bench.handle(SystemFault(bench.t_ns, "another"))
    assert bench.operator.why_off == "another"


def test_a_refusal_is_shown_for_ten_seconds_and_then_what_stood_there_before() -> None:
    bench = Bench().armed()
    bench.command(Kind.CHANNEL, 5.0)
    bench.command(Kind.CHANNEL, 6.0)
    assert bench.operator.message == "there is no channel 6"
    bench.stand(9.9)
    assert bench.operator.message == "there is no channel 6"
    bench.stand(0.2)
    assert bench.operator.message == "armed; + raises the intensity"
    bench.command(Kind.CHANNEL, 5.0)
    bench.command(Kind.UP)
    bench.stand(11.0)
    assert bench.operator.message == "intensity 5%"


@pytest.mark.parametrize("shown", [True, False])
def test_what_was_wrong_with_a_sensor_that_drives_nothing_is_shown_while_it_is(shown: bool) -> None:
    bench = Bench()
    notices = Notices(bench.gate, Electrodes((), None), list)
    bench.gate.observe(ImuSample(MS, "left_shank", MS, (0.0, 0.0, float("nan")), (0.0, 0.0, 0.0)))
    assert bool(notices.now(MS + (4999 if shown else 5000) * MS)) is shown


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("controller stalled for 50 ms", "Close other programs"),
        ("a command was 61 ms late, not sent", "Close other programs"),
        ("right_foot: sensor lost: unplugged", "plug, battery and range"),
        ("right_foot data 41 ms old, limit 40 ms", "link"),
        ("right_foot is frozen: the same values for 60 ms, limit 60 ms", "off and on"),
        ("non-finite sample from right_foot", "off and on"),
        ("right_foot's clock went back by 900 ms", "off and on"),
        ("right_foot shows 1.1 m/s² and less than gravity for 80 ms: is its unit g?", "unit and ranges"),
        ("right_foot turns at 41 rad/s, which no foot does: is its unit °/s?", "unit and ranges"),
        ("right_foot is saturated: at the end of its range for 80 ms", "unit and ranges"),
        ("right_foot rests turned by more than 65° from its calibration: remounted?", "as it was at calibration"),
        ("stimulator lost: bus off", "plug and supply"),
        ("stimulator fault on channel 0: output stage fault: electrode or lead, the channel is off", "electrodes"),
        ("stimulator restarted", "off and on"),
        ("Tibialis anterior: stimulator delivers pulses that nobody asked for", "own switch"),
        ("Tibialis anterior: on for 3 s, limit 3 s", "channel's settings"),
        ("Tibialis anterior: 20 mC within a minute, limit 20 mC", "channel's settings"),
        ("time ran backward by 3 ms", "clock"),
        ("emergency stop", ""),
    ],
)
def test_a_fault_has_its_remedy(fault: str, words: str) -> None:
    assert words in remedy(fault)
    assert bool(remedy(fault)) is bool(words)


def tuned(mode: str = "act") -> Session:
    session = tuned_session(mode)
    walks_first = session.stimulation.model_copy(update={"strides_before_start": 2})
    return session.model_copy(update={"sensors": settings().sensors, "stimulation": walks_first})


@pytest.mark.parametrize(("gravity_mps2", "mm"), [(9.90, "10"), (9.71, "11"), (9.97, "18")])
def test_where_gravity_is_not_what_it_was_at_calibration_the_foot_is_measured_but_not_tuned_by(
    gravity_mps2: float, mm: str
) -> None:
    bench = Bench(tuned())
    bench.stand(3.0, acc=(0.0, 0.0, gravity_mps2))
    bench.command(Kind.ARM)
    assert bench.gate.armed  # stimulation as set is not what depends on heights
    (status,) = tuning_status(bench.controller.tuning).values()
    assert status.frozen.endswith(f"wrong by some {mm} mm; calibrate again")  # not "on demand"
    assert f"wrong by some {mm} mm; calibrate again; tuning is frozen" in bench.operator.message
    assert [note.severity for note in bench.notes if "calibrate again" in note.text] == ["warning"]
    bench.command(Kind.RESUME_TUNING)  # whoever knows better
    assert not any(tuner.frozen for tuner in bench.controller.tuning.tuners.values())
    bench.command(Kind.DISARM)
    bench.command(Kind.ARM)  # forgotten by then, and told again
    assert "calibrate again; tuning is frozen" in bench.operator.message
    assert all(tuner.frozen for tuner in bench.controller.tuning.tuners.values())


def test_going_on_after_a_pause_does_not_call_frozen_what_a_person_has_resumed() -> None:
    bench = Bench(tuned())
    bench.stand(3.0, acc=(0.0, 0.0, 9.97))
    bench.command(Kind.ARM)
    bench.command(Kind.RESUME_TUNING)
    bench.command(Kind.PAUSE)
    bench.command(Kind.PAUSE)
    assert bench.operator.state is State.ARMED
    assert not any(tuner.frozen for tuner in bench.controller.tuning.tuners.values())
    assert "tuning is frozen" not in bench.operator.message
    assert len([note for note in bench.notes if "calibrate again" in note.text]) == 1


@pytest.mark.parametrize(("tunes", "gravity_mps2"), [(True, 9.76), (True, 9.86), (False, 9.97)])
def test_where_gravity_is_what_it_was_or_nothing_is_tuned_nobody_hears_of_moved_zeros(
    tunes: bool, gravity_mps2: float
) -> None:
    bench = Bench(tuned() if tunes else None)
    bench.stand(3.0, acc=(0.0, 0.0, gravity_mps2))
    events = bench.command(Kind.ARM)
    assert bench.gate.armed
    assert [event.action for event in events if isinstance(event, OperatorAct)][-1] is OperatorAction.ARM
    assert not any(tuner.frozen for tuner in bench.controller.tuning.tuners.values())
    assert "calibrate again" not in bench.operator.message


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda bench: bench.stand(1.2, gyr_radps=0.4), "stand still"),
        (lambda bench: bench.stand(1.2, acc=(0.0, 0.0, 8.0)), "8.00 m/s² at rest instead of 9.81"),
        (lambda bench: bench.stand(1.2, acc=(9.81, 0.0, 0.0)), "tilted by 90°"),
        (lambda bench: bench.stand(1.2, every=2), "50 samples in the last second, 100 are expected"),
        (lambda bench: setattr(bench, "t_ns", bench.t_ns + 100 * MS), "silent for 1"),
        (lambda bench: setattr(bench, "answered_ns", bench.t_ns - 600 * MS), "the stimulator does not answer"),
        (lambda bench: setattr(bench, "answered_ns", None), "the stimulator does not answer"),
        (lambda bench: bench.further.append("the stop file is there"), "the stop file is there"),
    ],
)
def test_whatever_speaks_against_arming_is_named(spoil: object, says: str) -> None:
    bench = Bench()
    bench.stand(3.0)
    assert callable(spoil)
    spoil(bench)
    assert bench.command(Kind.ARM) == []
    assert not bench.gate.armed
    assert bench.operator.state is not State.ARMED
    assert "cannot arm" in bench.operator.message
    assert says in bench.operator.message
    assert bench.notes[-1].text == bench.operator.message


def test_intensity_goes_in_steps_up_to_the_sessions_and_not_faster_than_a_person_means() -> None:
    bench = Bench().armed()
    assert bench.command(Kind.UP)
    assert bench.command(Kind.UP) == [], "a key held down repeats faster than this"
    for _ in range(40):
        bench.t_ns += 200 * MS
        bench.operator.execute(OperatorCommand(Kind.UP), bench.t_ns)
    (act,) = bench.operator.execute(OperatorCommand(Kind.DOWN), bench.t_ns)
    assert isinstance(act, OperatorAct)
    assert act.value == pytest.approx(settings().stimulation.intensity - 0.05)
    for _ in range(40):
        (act,) = bench.operator.execute(OperatorCommand(Kind.DOWN), bench.t_ns)
    assert isinstance(act, OperatorAct)
    assert act.value == 0.0


def test_pause_is_off_and_one_key_from_armed_with_its_intensity() -> None:
    bench = Bench().armed()
    bench.command(Kind.UP)
    bench.command(Kind.PAUSE)
    assert (bench.operator.state, bench.gate.armed) == (State.PAUSED, False)
    assert bench.command(Kind.UP) == []
    bench.stand(0.5, gyr_radps=0.4)  # moving: no reason against going on
    bench.command(Kind.PAUSE)
    assert (bench.operator.state, bench.gate.armed) == (State.ARMED, True)
    assert bench.controller.intensity == pytest.approx(0.05)


def test_a_pause_through_the_control_socket_never_goes_on_an_arm_does() -> None:
    bench = Bench().armed()
    for _ in range(2):
        for event in bench.operator.execute(command_of_message(b'{"ask": "pause"}'), bench.t_ns):
            bench.handle(event)
        assert bench.operator.state is State.PAUSED
    assert "paused already" in bench.operator.message
    bench.command(Kind.ARM)
    assert bench.operator.state is State.ARMED


@pytest.mark.parametrize("before", ["shadow", "armed", "paused"])
def test_an_emergency_stop_latches_from_everywhere_and_arming_starts_from_nothing(before: str) -> None:
    bench = Bench()
    bench.stand(3.0)
    if before != "shadow":
        bench.armed()
        bench.command(Kind.UP)
    if before == "paused":
        bench.command(Kind.PAUSE)
    bench.command(Kind.STOP)
    assert bench.operator.state is State.STOPPED
    assert bench.gate.latched == "emergency stop"
    assert not bench.gate.armed
    bench.stand(0.4)
    assert (
        bench.command(Kind.PAUSE) == bench.command(Kind.UP) == bench.command(Kind.TEST) == bench.command(Kind.ARM) == []
    )
    assert bench.operator.state is State.STOPPED
    assert bench.operator.message == "cannot arm: stopped just now"
    bench.stand(0.1)
    bench.command(Kind.ARM)
    assert bench.operator.state is State.ARMED
    assert bench.controller.intensity == 0.0


@pytest.mark.requirement("SR-16")
@pytest.mark.parametrize("before", ["shadow", "armed", "paused"])
@pytest.mark.parametrize("typed", [b"a ", b" a", b"p ", b" p"])
def test_an_arming_on_its_way_does_not_undo_a_stop(before: str, typed: bytes) -> None:
    bench = Bench()
    bench.stand(3.0)
    if before != "shadow":
        bench.armed()
    if before == "paused":
        bench.command(Kind.PAUSE)
    read_end, write_end = os.pipe()
    os.write(write_end, typed)
    for event in Keyboard(read_end, bench.operator.execute).read_events(bench.t_ns):
        bench.handle(event)
    os.close(write_end)
    assert (bench.operator.state, bench.gate.armed) == (State.STOPPED, False)
    assert bench.gate.latched == "emergency stop"


@pytest.mark.requirement("SR-16")
def test_the_pages_confirmation_that_was_asked_for_before_a_stop_does_not_undo_it() -> None:
    bench = Bench()
    bench.stand(3.0)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    page = DashboardCommands(DashboardStream(ours), bench.operator.execute, lambda: bench.operator.state)
    bench.command(Kind.STOP)
    bench.stand(0.3)
    theirs.send(b'{"ask":"arm","confirm":true}')
    for event in page.read_events(bench.t_ns):
        bench.handle(event)
    assert (bench.operator.state, bench.gate.armed) == (State.STOPPED, False)
    ours.close()
    theirs.close()


def test_a_fault_latches_and_only_a_person_ends_it() -> None:
    bench = Bench().armed()
    bench.handle(SystemFault(bench.t_ns, "controller stalled for 200 ms"))
    assert bench.operator.state is State.FAULT
    assert not bench.gate.armed
    bench.stand(2.0)
    assert bench.operator.state is State.FAULT
    bench.command(Kind.ARM)
    assert bench.operator.state is State.ARMED


def test_bursts_by_hand_only_when_armed_and_a_test_only_at_rest() -> None:
    bench = Bench()
    bench.stand(3.0)
    assert bench.command(Kind.TEST) == bench.command(Kind.TRIGGER) == []
    bench.armed()
    bench.stand(0.6, gyr_radps=0.25)
    assert bench.command(Kind.TEST) == []
    bench.stand(0.6)
    assert bench.command(Kind.CHANNEL, 5) == []
    assert "no channel 5" in bench.operator.message
    assert bench.command(Kind.TEST) == [OperatorAct(bench.t_ns, OperatorAction.TEST_BURST, 0.0)]
    assert bench.command(Kind.TRIGGER) == [OperatorAct(bench.t_ns, OperatorAction.TRIGGER, 0.0)]


def test_a_test_burst_goes_through_plan_and_gate_and_ends_by_itself() -> None:
    bench = Bench().armed()
    for _ in range(10):
        bench.stand(0.2)
        bench.command(Kind.UP)
    on: list[tuple[int, float]] = []
    bench.command(Kind.TEST)
    begin_ns = bench.t_ns
    while bench.t_ns < begin_ns + 1500 * MS:
        bench.t_ns += 10 * MS
        noise = 1e-4 * (bench.t_ns // MS % 9)
        event = ImuSample(bench.t_ns, FOOT, bench.t_ns, (noise, 0.0, 9.81), (noise, 0.0, 0.0))
        bench.gate.observe(event)
        for request in bench.controller.step(event).requests:
            command = bench.gate.judge(bench.t_ns, request)
            assert not command.refused
            if command.on:
                on.append((bench.t_ns - begin_ns, command.current_ma))
    assert max(current for _, current in on) == pytest.approx(15.0, abs=0.5)  # half of 30 mA
    assert 500 * MS <= on[-1][0] <= 700 * MS
    assert not bench.gate.latched


def test_the_belt_is_a_setting_within_bounds() -> None:
    bench = Bench()
    bench.stand(0.1)
    assert bench.command(Kind.BELT, 0.8) == [OperatorAct(bench.t_ns, OperatorAction.SET_BELT_SPEED, 0.8)]
    bench.command(Kind.BELT_UP)
    assert bench.operator.belt_speed_mps == pytest.approx(0.9)
    bench.command(Kind.BELT, 99)
    assert bench.operator.belt_speed_mps == 5.0
    bench.command(Kind.BELT, -1)
    assert bench.operator.belt_speed_mps == 0.0


def test_the_ground_is_said_in_percent_and_what_no_treadmill_does_is_refused() -> None:
    bench = Bench()
    bench.stand(0.1)
    assert bench.command(Kind.GROUND, 10.0) == [OperatorAct(bench.t_ns, OperatorAction.SET_INCLINE, 0.1)]
    assert bench.controller.incline == pytest.approx(0.1)
    assert bench.operator.message == "the ground is an incline of +10 % from the next stride on (key)"
    for slip in (100.0, -25.1, math.nan):
        assert bench.command(Kind.GROUND, slip) == []
        assert "between -25 % and 25 %" in bench.operator.message
    assert bench.controller.incline == pytest.approx(0.1)
    assert bench.command(Kind.GROUND_FREE) == [OperatorAct(bench.t_ns, OperatorAction.FREE_GROUND)]
    assert math.isnan(bench.controller.incline)
    assert bench.command(Kind.GROUND, -25.0) == [OperatorAct(bench.t_ns, OperatorAction.SET_INCLINE, -0.25)]
    assert [note.text for note in bench.notes if "ground is" in note.text][1].startswith(
        "the ground is stairs or ramps"
    )


def test_the_ground_needs_no_confirmation_over_the_control_socket() -> None:
    assert command_of_message(b'{"ask":"ground","value":-7.5}') == OperatorCommand(Kind.GROUND, -7.5, "control")
    assert command_of_message(b'{"ask":"ground_free"}').kind is Kind.GROUND_FREE
    for message in (
        b'{"ask":"ground","value":"10"}',
        b'{"ask":"ground","value":NaN}',
        b'{"ask":"ground","value":true}',
    ):
        with pytest.raises(CommandRefused):
            command_of_message(message)


@pytest.mark.parametrize(
    ("incline", "percent", "shown"),
    [
        (0.0, 0.0, "level"),
        (0.07, 7.0, "an incline of +7 %"),
        (-0.025, -2.5, "an incline of -2.5 %"),
        (math.nan, None, "stairs or ramps"),
    ],
)
def test_the_status_and_the_view_have_the_ground_in_force(incline: float, percent: float | None, shown: str) -> None:
    status = Status(5, "armed", incline_percent=percent_of(incline))
    assert status.incline_percent == percent
    assert Status.decode(status.encode()) == status
    console = Console(width=140, file=StringIO(), record=True)
    console.print(picture(status))
    assert f"ground: {shown}" in console.export_text()


def test_the_log_tells_of_stairs_anew_once_the_ground_is_said(tmp_path: Path) -> None:
    notes: list[Note] = []
    log = Mock(note=notes.append)
    shown = ShownLog(log, {FOOT: FOOT})
    level = StrideResult(FOOT, 1, 0, 1000 * MS, 1.0, 0.1, 0.0, 0.0, 1.0, free_rise_m=0.12)

    def told(t_start_ms: int, **changes: Any) -> list[str]:
        notes.clear()
        shown.stride(replace(level, t_start_ns=t_start_ms * MS, t_end_ns=(t_start_ms + 1000) * MS, **changes))
        return [note.text for note in notes]

    assert "a stair or a slope" in told(0)[0]
    shown.event(OperatorAct(1500 * MS, OperatorAction.SET_INCLINE, 0.12))
    assert told(1000) == [], "it began on the ground before"
    assert told(2000, height_gained_m=0.12) == []
    shown.event(OperatorAct(3000 * MS, OperatorAction.FREE_GROUND))
    assert told(3100, free_rise_m=0.4) == []
    shown.event(OperatorAct(4500 * MS, OperatorAction.SET_INCLINE, 0.0))
    assert "a stair or a slope" in told(4600)[0]


def test_a_stop_among_keys_comes_first_and_unknown_keys_are_nothing() -> None:
    asks = [command.kind for command in commands_of_keys(b"+9zt  ")]
    assert asks == [Kind.STOP, Kind.STOP, Kind.UP, Kind.TRIGGER]
    asks = [command.kind for command in commands_of_keys(b"+\x1b[A9zt ")]
    assert asks == [Kind.STOP, Kind.UP], "behind an escape only a stop counts"
    assert commands_of_keys(b"3") == [OperatorCommand(Kind.CHANNEL, 3.0)]


ANYTHING = st.recursive(
    st.none()
    | st.booleans()
    | st.floats()
    | st.integers()
    | st.just(10**400)
    | st.text()
    | st.sampled_from(list(Kind)),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
SAID = st.dictionaries(st.sampled_from(["ask", "value", "confirm", "token", "secret", "press"]), ANYTHING) | ANYTHING


@given(st.binary(max_size=2000))
def test_no_message_is_more_than_an_order_or_a_refusal(message: bytes) -> None:
    with suppress(CommandRefused):
        assert command_of_message(message).kind in Kind


@given(SAID)
@example({"ask": []})
@example({"ask": {"a": 1}})
@example({"ask": "belt", "value": 10**400})
@example({"ask": "down", "value": -(10**400)})
@example({"ask": "channel", "value": 1e300})
def test_no_json_ends_the_session_by_whichever_way_it_comes(said: object) -> None:
    message = json.dumps(said).encode()
    with suppress(CommandRefused):
        command = command_of_message(message)
        assert command.kind in Kind
        assert abs(command.value) <= 1e9
        bench = Bench()
        bench.operator.execute(command, 0)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        theirs.send(message)
        DashboardCommands(DashboardStream(ours), lambda command, t_ns: [], lambda: State.ARMED).read_events(0)
    handler = MessageHandler(
        Access("link", lambda: "secret"), {"mode": "live"}, lambda t_ns: (None, 0), lambda: "question"
    )
    for text in ('{"token":"link"}', message.decode()):
        outcome = handler.handle(text, 0)
        assert outcome.reply or outcome.stop or outcome.command
        json.dumps(outcome.reply)


@pytest.mark.parametrize("ask", list(Kind))
def test_what_can_lead_to_more_current_needs_a_confirmation(ask: Kind) -> None:
    plain = json.dumps({"ask": ask}).encode()
    if ask in NEEDS_CONFIRMATION:
        with pytest.raises(CommandRefused, match="confirm"):
            command_of_message(plain)
    else:
        assert command_of_message(plain).kind is ask
    assert command_of_message(json.dumps({"ask": ask, "confirm": True}).encode()).kind is ask


def test_the_control_socket_carries_orders_answers_and_status(tmp_path: Path) -> None:
    carried: list[OperatorCommand] = []

    def execute(command: OperatorCommand, t_ns: int) -> list[Event]:
        carried.append(command)
        return [OperatorAct(t_ns, OperatorAction.EMERGENCY_STOP)]

    control = Control(tmp_path / "c.sock", execute)
    assert (tmp_path / "c.sock").stat().st_mode & 0o077 == 0
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        other.bind(str(tmp_path / "o.sock"))
        other.settimeout(2)
        other.sendto(b'{"ask":"stop"}', str(tmp_path / "c.sock"))
        assert [type(event) for event in control.read_events(5)] == [OperatorAct]
        assert json.loads(other.recv(4096)) == {"ok": True}
        for message in (b'{"ask":"up"}', b'{"ask":[]}', b'{"ask":"belt","value":1' + b"0" * 400 + b"}", b"watch"):
            other.sendto(message, str(tmp_path / "c.sock"))
        assert control.read_events(6) == []
        assert [json.loads(other.recv(4096))["ok"] for _ in range(3)] == [False, False, False]
        assert json.loads(other.recv(4096)) == {"ok": True}
        for _ in range(5000):  # nobody reads: frames are dropped, the session does not wait
            control.publish(b"x" * 1000)
        assert other.recv(4096) == b"x" * 1000
    control.publish(b"gone")
    control.close()
    assert not (tmp_path / "c.sock").exists()
    assert [command.kind for command in carried] == [Kind.STOP]


class Switch:
    def __init__(self) -> None:
        self.pressed: bool | None = None

    def fileno(self) -> int | None:
        return None

    def read(self) -> bool | None:
        return self.pressed


def test_a_stop_button_stops_when_pressed_and_when_it_goes_missing() -> None:
    line = Switch()
    button = StopSwitch(line, lambda command, t_ns: [OperatorAct(t_ns, OperatorAction.EMERGENCY_STOP)])
    assert button.read_events(1) == []
    assert "nothing is heard" in button.not_ready()
    line.pressed = False
    assert (button.read_events(2), button.not_ready()) == ([], "")
    line.pressed = True
    assert len(button.read_events(3)) == 1
    assert button.read_events(4) == []
    assert "pressed" in button.not_ready()
    line.pressed = False
    assert button.read_events(5) == []
    line.pressed = None
    assert len(button.read_events(6)) == 1


def test_a_foot_switch_tells_its_changes() -> None:
    line = Switch()
    switch = FootSwitchInput(FOOT, line)
    told = []
    for t_ns, pressed in enumerate([None, True, True, False, None, False, True]):
        line.pressed = pressed
        told += switch.read_events(t_ns)
    assert [(event.t_ns, event.pressed) for event in told] == [(1, True), (3, False), (4, None), (6, True)]


def test_a_foot_switch_is_held_against_the_sensors_phases() -> None:
    comparison = SwitchComparison()
    for stride in range(5):
        at_ns = stride * 1200 * MS
        comparison.add_switch(FootSwitchEvent(at_ns, FOOT, True))
        comparison.add_switch(FootSwitchEvent(at_ns + 700 * MS, FOOT, False))
        if stride != 2:
            late_ns = at_ns + (20 + stride) * MS
            comparison.add_phase(PhaseChange(late_ns, FOOT, Transition.T3, Phase.SWING, Phase.LOADING_RESPONSE))
        comparison.add_phase(PhaseChange(at_ns + 690 * MS, FOOT, Transition.T2, Phase.PRE_SWING, Phase.SWING))
    found = comparison.to_dict()[FOOT]
    assert found["contact"] == {"pairs": 4, "switch_only": 1, "sensor_only": 0, "delay_ms": [22.0, 20.0, 24.0]}
    assert found["release"] == {"pairs": 5, "switch_only": 0, "sensor_only": 0, "delay_ms": [-10.0, -10.0, -10.0]}


def test_a_status_is_the_same_behind_the_line_and_nothing_else_is_one() -> None:
    status = Status(5, "armed", feet={FOOT: FootStatus("stance", True, 3, 1.2, 0.9, 500.0, 1.0)}, belt_speed_mps=0.8)
    assert Status.decode(status.encode()) == status
    for other in (b"", b"{}", b'{"version":99}', b"[]", b'{"version":1,"feet":{},"more":1}'):
        with pytest.raises(ValueError, match=r"."):
            Status.decode(other)


def test_what_is_no_number_is_null_to_every_listener() -> None:
    nan, inf = float("nan"), float("inf")
    feet = {FOOT: FootStatus("stance", True, 3, nan, -inf, 500.0, 1.0)}
    datagram = Status(5, "armed", feet=feet, belt_speed_mps=inf, latency_p99_ms=nan, notices=["as is"]).encode()

    def refuse(text: str) -> None:
        raise AssertionError(text)

    told = json.loads(datagram, parse_constant=refuse)
    assert told["feet"][FOOT]["stride_length_m"] is told["feet"][FOOT]["speed_mps"] is None
    assert told["belt_speed_mps"] is told["latency_p99_ms"] is None
    assert Status.decode(datagram).feet[FOOT].rate_hz == 500.0


def test_frames_that_a_page_missed_are_counted_to_the_end(tmp_path: Path) -> None:
    bench = Bench()
    log = PipedLog(tmp_path / "session.feslog", {})
    monitor = Monitor(log, {FOOT: bench.monitor}, {FOOT: FOOT}, None)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours:
        monitor.dashboard = DashboardStream(ours)
        for _ in range(2000):  # nobody reads
            bench.t_ns += 100 * MS
            monitor.publish(bench.t_ns, bench.operator, "open")
        missed = monitor.dropped_dashboard_frames
        assert missed > 1000
        theirs.close()
        bench.t_ns += 100 * MS
        monitor.publish(bench.t_ns, bench.operator, "open")
        assert monitor.dashboard is None
        assert monitor.dropped_dashboard_frames == missed
    log.close({})


def test_what_the_system_refuses_is_named_with_its_cost() -> None:
    """In a process of its own: it would change this one's scheduling."""
    code = (
        "import resource, json; resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, 0))\n"
        "import os, numpy\n"  # while the interpreter's own files may still be read
        "from fes.live.processes import become_real_time\n"
        "if os.geteuid() == 0: os.setgid(65534); os.setuid(65534)\n"
        "print(json.dumps([[g.name, g.refused, g.cost, g.remedy] for g in become_real_time()]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    grants = json.loads(done.stdout)
    refused = {name: (why, cost, remedy) for name, why, cost, remedy in grants if why}
    assert "fixed priority (SCHED_FIFO)" in refused
    assert "locked memory (mlockall)" in refused
    assert all(all(texts) for texts in refused.values())


def test_a_dead_band_is_said_once_and_arms_as_rest(tmp_path: Path) -> None:
    bench = Bench()
    log = PipedLog(tmp_path / "session.feslog", {})
    monitor = Monitor(log, {FOOT: bench.monitor}, {FOOT: FOOT}, None)
    for k in range(1000):
        moves = 0.5 if k in (400, 700) else 0.0  # it leaves its dead band and comes back
        event = ImuSample(10 * MS * k, FOOT, 10 * MS * k, (0.001 * (k % 7), 0.0, 9.81), (moves, 0.0, 0.0))
        monitor.event(event)
        bench.gate.observe(event)
    assert bench.gate.latched == ""
    assert bench.monitor.not_at_rest(10_000 * MS) == ""
    log.close({})
    assert [note.text for note in read_session(log.path).notes] == [
        "right_foot: its gyroscope reads exactly 0 at rest (a dead band); counted as rest"
    ]
