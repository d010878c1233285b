"""A foot switch times bursts when the sensor tells no steps, and only then; the gate judges as ever."""

from __future__ import annotations

import pytest
from replays import MS, SETTINGS
from test_live_operator import CALIBRATION, FOOT, settings

from fes.config.session import FootSwitch
from fes.control.controller import Controller
from fes.gate import gate_of
from fes.signals import FootSwitchEvent, ImuSample, OperatorAct, OperatorAction, StimCommand
from fes.stimulation.walking import SwitchFallback
from statemachine.phases import Phase, PhaseChange, Transition

STRIDE_MS, SWING_MS = 1200, 450


def walked(
    use: str, *, switch_until_ms: int = 8000, silent_at_ms: int | None = None, samples_until_ms: int = 8000
) -> list[StimCommand]:
    """A sensor that tells no step, for it turns about the vertical alone, on a foot whose switch walks."""
    assert SETTINGS.is_file()
    switch = FootSwitch.model_validate({"foot": FOOT, "source": "can_bit", "use": use})
    session = settings().model_copy(update={"foot_switches": (switch,)})
    controller, gate = Controller(session, {FOOT: CALIBRATION}), gate_of(session, {FOOT: CALIBRATION.up})
    commands: list[StimCommand] = []
    for ms in range(0, 8000, 10):
        events = []
        if ms <= samples_until_ms:
            living, turns_radps = 1e-4 * (ms // 10 % 9), 0.9 if ms % STRIDE_MS < SWING_MS else 0.0
            events.append(ImuSample(ms * MS, FOOT, ms * MS, (living, 0.0, 9.81), (living, 0.0, turns_radps)))
        if ms == 500:
            events += [
                OperatorAct(ms * MS, OperatorAction.ARM),
                OperatorAct(ms * MS, OperatorAction.SET_INTENSITY, 1.0),
            ]
        if ms > 500 and ms <= switch_until_ms and ms % STRIDE_MS in (0, SWING_MS // 10 * 10):
            events.append(FootSwitchEvent(ms * MS, FOOT, ms % STRIDE_MS != 0))
        if ms == silent_at_ms:
            events.append(FootSwitchEvent(ms * MS, FOOT, None))
        for event in events:
            gate.observe(event)
            commands += [gate.judge(event.t_ns, request) for request in controller.step(event).requests]
    return commands


def test_it_takes_over_after_two_cycles_and_bursts_with_the_switch() -> None:
    on = [command for command in walked("fallback") if command.on]
    began = [
        two.t_ns // MS for one, two in zip([None, *on], on, strict=False) if not one or two.t_ns - one.t_ns > 100 * MS
    ]
    assert [pytest.approx(ms, abs=40) for ms in (3600, 4800, 6000, 7200)] == began
    assert max(command.current_ma for command in on) == pytest.approx(30.0, abs=0.5)


def test_a_switch_that_only_compares_times_nothing() -> None:
    assert not [command for command in walked("compare") if command.on]


def test_a_switch_that_falls_silent_in_mid_burst_ends_it_as_soon_as_that_is_known() -> None:
    on = [command for command in walked("fallback", switch_until_ms=3600, silent_at_ms=4100) if command.on]
    assert on[0].t_ns // MS >= 3600
    assert 4080 <= on[-1].t_ns // MS <= 4100  # the sample of that moment comes before it


def test_after_a_silence_it_is_believed_after_two_cycles_again() -> None:
    fallback = SwitchFallback(FOOT)

    def released(at_ms: int) -> list[PhaseChange]:
        fallback.changes_at(FootSwitchEvent((at_ms - STRIDE_MS // 2) * MS, FOOT, True))
        return fallback.changes_at(FootSwitchEvent(at_ms * MS, FOOT, False))

    assert [bool(released(cycle * STRIDE_MS)) for cycle in range(1, 5)] == [False, False, True, True]
    (lost,) = fallback.changes_at(FootSwitchEvent(5000 * MS, FOOT, None))
    assert lost.transition is Transition.NONE
    assert fallback.changes_at(FootSwitchEvent(5100 * MS, FOOT, None)) == []  # the sensor's bursts are not its to end
    assert [bool(released(6000 + cycle * STRIDE_MS)) for cycle in range(1, 5)] == [False, False, True, True]


def test_an_open_contact_that_stays_open_is_left_to_the_longest_on_time() -> None:
    """A broken wire looks just like it."""
    on = [command.t_ns // MS for command in walked("fallback", switch_until_ms=3600) if command.on]
    assert on[0] >= 3600
    assert on[-1] <= 3600 + 3000 + 60


def test_without_data_from_the_sensor_there_is_no_current_whatever_the_switch_says() -> None:
    on = [command.t_ns // MS for command in walked("fallback", samples_until_ms=4900) if command.on]
    assert on
    assert on[-1] <= 4900 + 40


def test_the_sensors_first_swing_takes_over_again() -> None:
    fallback = SwitchFallback(FOOT)
    for cycle in range(4):
        at_ns = cycle * STRIDE_MS * MS
        fallback.changes_at(FootSwitchEvent(at_ns, FOOT, False))
        fallback.changes_at(FootSwitchEvent(at_ns + SWING_MS * MS, FOOT, True))
    assert fallback.active
    lifted = PhaseChange(5000 * MS, FOOT, Transition.T1, Phase.STANCE, Phase.PRE_SWING)
    swing = PhaseChange(5100 * MS, FOOT, Transition.T2, Phase.PRE_SWING, Phase.SWING)
    assert not fallback.follows_sensor(lifted)
    assert fallback.follows_sensor(swing)
    assert not fallback.active
    assert fallback.changes_at(FootSwitchEvent(5200 * MS, FOOT, True)) == []


def test_a_switch_that_chatters_or_stands_is_not_believed() -> None:
    fallback = SwitchFallback(FOOT)
    for number in range(50):
        fallback.changes_at(FootSwitchEvent(number * 40 * MS, FOOT, bool(number % 2)))
    assert not fallback.active
    slow = SwitchFallback(FOOT)
    for number in range(6):
        slow.changes_at(FootSwitchEvent(number * 3500 * MS, FOOT, False))
    assert not slow.active
