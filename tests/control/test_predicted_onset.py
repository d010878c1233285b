"""Bursts that begin when the heel rise is foreseen: in whole replays, and where nothing may begin."""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from replays import MS, SETTINGS, TRIALS, both_feet, bursts, replay, same_outputs, trial

from fes.calibration.recording import calibrate_phase_sensors
from fes.cli.main import main
from fes.cli.replay.command import repeat
from fes.config import Session, load_session
from fes.control.controller import Controller
from fes.control.runner import armed_after
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import Calibration
from fes.estimation.tracking.tracker import Tracker
from fes.gate.gate import gate_of
from fes.report.summary import summarise
from fes.session_log import SessionRecord, read_session
from fes.signals import NS_PER_S, Event, ImuSample, OperatorAct, OperatorAction, StimCommand, StrideResult, Tick
from fes.stimulation.onset import EACH_ONSET, FALSE_NS, ONSET
from statemachine.phases import Phase, PhaseChange, Transition

FEET = {0: "right_foot", 1: "left_foot"}
PREDICTED = 'start_phase = "pre_swing"\nonset = "predicted"'
FOOT, STEP_NS = "right_foot", 5 * MS
WALK, WALKS_FROM_S = "both_feet_200hz", 12.0  # whose samples the gate sees beside a foot by script


class Trials:
    """Replays of bundled trials, both feet, with the onset predicted or not."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._logs: dict[tuple[str, str], Path] = {}

    def log(self, name: str, onset: str = "predicted") -> Path:
        if (name, onset) not in self._logs:
            out = self.folder / onset
            out.mkdir(exist_ok=True)
            text = both_feet(SETTINGS.read_text())
            settings = out / "both.toml"
            settings.write_text(text.replace('start_phase = "pre_swing"', PREDICTED) if onset == "predicted" else text)
            replay(TRIALS / f"{name}.parquet", out, settings)
            self._logs[name, onset] = out / f"{name}-001" / "session.feslog"
        return self._logs[name, onset]

    def of(self, name: str, onset: str = "predicted") -> SessionRecord:
        return read_session(self.log(name, onset))


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> Trials:
    return Trials(tmp_path_factory.mktemp("predicted"))


def rises(record: SessionRecord, foot: str) -> np.ndarray:
    return np.array([c.t_ns for c in record.phases if c.foot == foot and c.transition is Transition.T1])


@pytest.mark.requirement("SR-26")
@pytest.mark.parametrize("channel", [0, 1])
def test_bursts_begin_before_the_heel_rise_is_seen_and_none_ends_later(trials: Trials, channel: int) -> None:
    predicted, detected = trials.of("both_feet_200hz"), trials.of("both_feet_200hz", "detected")
    rises_ns = rises(predicted, FEET[channel])
    pairs = list(zip(bursts(predicted.commands, channel), bursts(detected.commands, channel), strict=True))
    leads_ns = [seen.t_on_ns - early.t_on_ns for early, seen in pairs]
    assert sum(lead > 0 for lead in leads_ns) >= 20
    assert 30 * MS <= np.median([lead for lead in leads_ns if lead > 0]) <= 45 * MS
    assert all(0 <= lead < FALSE_NS for lead in leads_ns)
    assert all(early.t_off_ns <= seen.t_off_ns for early, seen in pairs)
    assert all(early.peak_ma == seen.peak_ma for early, seen in pairs)
    assert all(np.min(np.abs(rises_ns - seen.t_on_ns)) == 0 for _, seen in pairs)


def test_each_stride_has_what_was_expected_and_what_came(trials: Trials) -> None:
    record = trials.of("both_feet_200hz")
    each = [note for note in record.notes if note.source == EACH_ONSET]
    for channel, foot in FEET.items():
        rises_ns = rises(record, foot)
        early = [b for b in bursts(record.commands, channel) if not np.any(rises_ns == b.t_on_ns)]
        own = [note for note in each if note.text.startswith(foot.replace("_", " "))]
        assert [note.t_ns for note in own] == [int(rises_ns[rises_ns > b.t_on_ns][0]) for b in early]
        assert f"{(own[0].t_ns - early[0].t_on_ns) / MS:.0f} ms after the burst was asked for" in own[0].text
    assert [note.text.split(": ")[1] for note in record.notes if note.source == ONSET] == ["onset is predicted"] * 2


@pytest.mark.parametrize("name", ["negard_patient1", "soft_contact", "not_walking"])
def test_where_it_is_not_foreseen_it_is_detected(trials: Trials, name: str) -> None:
    predicted, detected = trials.of(name), trials.of(name, "detected")
    assert predicted.commands == detected.commands
    assert not [note for note in predicted.notes if note.source in (ONSET, EACH_ONSET)]


@pytest.mark.requirement("SR-20")
def test_a_log_gives_the_same_bytes_and_the_walk_again_too(trials: Trials, tmp_path: Path) -> None:
    log = trials.log("both_feet_200hz")
    assert repeat(log).difference == ""
    again = replay(TRIALS / "both_feet_200hz.parquet", tmp_path, log.parents[1] / "both.toml")
    assert same_outputs(again, read_session(log))
    assert again.notes == read_session(log).notes


def test_the_report_tells_early_bursts_from_wrong_ones(trials: Trials) -> None:
    summary = summarise(trials.of("both_feet_200hz"))
    for channel in summary.channels:
        assert channel.foreseen
        assert 20 <= channel.bursts_early < channel.bursts
        assert channel.bursts_outside == 0
    assert summarise(trials.of("both_feet_200hz", "detected")).channels[0].bursts_early == 0


@pytest.mark.parametrize("after_s", [-0.02, 0.02, 0.3])
def test_explain_says_what_was_expected_and_what_came(
    trials: Trials, capsys: pytest.CaptureFixture[str], after_s: float
) -> None:
    each = [note for note in trials.of("both_feet_200hz").notes if note.source == EACH_ONSET]
    early = [
        note for note in each if note.text.startswith("right") and " 50 ms after the burst was asked for" in note.text
    ]
    rise_s = early[-1].t_ns / NS_PER_S
    log = trials.log("both_feet_200hz")
    with pytest.raises(SystemExit) as ended:
        main(["explain", str(log), "--at", f"{rise_s + after_s:.3f}", "--json", "--no-page"], prog_name="fes")
    assert ended.value.code == 0
    text = json.loads(capsys.readouterr().out)["channels"][0]["why"]
    assert "Its onset is predicted: 20 of the last 20 heel rises came within 60 ms of when they were expected." in text
    assert "The heel was expected to rise at" in text
    assert "; the burst was asked for early, at" in text
    assert (f"; it rose at {rise_s:.3f} s." in text) is (after_s > 0.0)


# --- a foot by script -------------------------------------------------------------------------------------------------


class Script:
    """Stands in for the tracker: strides of 1.2 s, whose last 100 ms of stance turn the foot towards a heel rise."""

    def __init__(self, tracker: Tracker, last: int, *, turns_after: bool) -> None:
        self.foot, self.phase, self._tracker = FOOT, Phase.STANCE, tracker
        self._last, self._turns_after, self._now_ns = last, turns_after, 0

    def step(self, t_ns: int, acc: Any, gyr: Any) -> list[PhaseChange | StrideResult]:
        self._now_ns = t_ns
        number, at_ms = divmod(t_ns // MS, 1200)
        rows = {
            0: (Transition.T3, Phase.SWING, Phase.LOADING_RESPONSE),
            100: (Transition.T4, Phase.LOADING_RESPONSE, Phase.STANCE),
            700: (Transition.T1, Phase.STANCE, Phase.PRE_SWING),
            900: (Transition.T2, Phase.PRE_SWING, Phase.SWING),
        }
        if t_ns % MS or at_ms not in rows or number > self._last or (number == self._last and at_ms > 100):
            return []
        transition, source, self.phase = rows[at_ms]
        change = PhaseChange(t_ns, FOOT, transition, source, self.phase)
        stride = StrideResult(FOOT, number, t_ns - 1200 * MS, t_ns, stride_length_m=1.0, turn_rad=0.0)
        return [stride, change] if transition is Transition.T4 else [change]

    def seen(self) -> Any:
        features, limits = self._tracker.seen()
        number, at_ms = divmod(self._now_ns // MS, 1200)
        share = max(0.0, min(1.0, (at_ms - 600) / 100)) if number < self._last or self._turns_after else 0.0
        rate = limits.heel_rise_share * max(limits.push_off_radps, 0.5 * limits.fall_radps)
        return features._replace(turned_rad=share * limits.turn_rad, toe_down_radps=share * rate), limits


@cache
def calibrations() -> dict[str, Calibration]:
    return calibrate_phase_sensors(trial(WALK)).calibrations


def predicted_session() -> Session:
    session = load_session(SETTINGS)
    channel = type(session.channels[0]).model_validate({**session.channels[0].model_dump(), "onset": "predicted"})
    stimulation = session.stimulation.model_copy(update={"strides_before_start": 0})
    return session.model_copy(update={"channels": (channel,), "stimulation": stimulation})


LAST = 17  # the stride in which the foot stops; five strides show when the heel rises and ten more how well
STOPS_NS = LAST * 1200 * MS  # its contact


def run(
    until_ns: int, acts: Iterable[OperatorAct] = (), *,
    turns_after: bool = True, silent_ns: int | None = None, armed: bool = True,
) -> tuple[list[StimCommand], Controller]:  # fmt: skip
    """Through controller and gate; with ``silent_ns`` samples end there and ticks go on."""
    session = predicted_session()
    controller = Controller(session, calibrations())
    tracker = controller.trackers[FOOT]
    controller.trackers[FOOT] = cast("FootTracker", Script(tracker, LAST, turns_after=turns_after))
    gate = gate_of(session, {FOOT: calibrations()[FOOT].up})
    walk, events = trial(WALK).tracks[FOOT], list[Event]()
    first = round(WALKS_FROM_S * walk.rate_hz)
    for t_ns in range(STEP_NS, until_ns, STEP_NS):
        if silent_ns is None or t_ns < silent_ns:
            at = first + t_ns // STEP_NS
            acc, gyr = tuple(walk.acc_mps2[at].tolist()), tuple(walk.gyr_radps[at].tolist())
            events.append(ImuSample(t_ns, FOOT, t_ns, acc, gyr))
        else:
            events.append(Tick(t_ns))
    started = armed_after(events, 0.3, 1.0) if armed else iter(events)
    acts, commands = sorted(acts, key=lambda each: each.t_ns), []
    for event in started:
        for now in [*[act for act in acts if act.t_ns <= event.t_ns], event]:
            if isinstance(now, OperatorAct) and now in acts:
                acts = [act for act in acts if act is not now]
            gate.observe(now)
            commands += [gate.judge(event.t_ns, request) for request in controller.step(now).requests]
    return commands, controller


def on_ns(commands: list[StimCommand], since_ns: int) -> list[int]:
    return [command.t_ns for command in commands if command.on and command.t_ns >= since_ns]


RISE_NS = STOPS_NS + 700 * MS  # where the heel would rise


@pytest.mark.requirement("SR-26")
def test_a_person_who_stops_as_the_heel_is_about_to_rise_is_stimulated_for_150_ms_at_most() -> None:
    commands, controller = run(STOPS_NS + 8 * NS_PER_S)
    began = [b for a, b in pairwise(on_ns(commands, 0)) if b - a > 200 * MS]
    assert began[-2] % (1200 * MS) == 660 * MS  # of the stride before: 40 ms before its heel rose
    false = on_ns(commands, STOPS_NS + 200 * MS)
    assert false[0] == RISE_NS - 40 * MS
    assert false[-1] < false[0] + FALSE_NS
    assert not controller.onsets[FOOT].in_use
    off = next(c for c in commands if c.t_ns > false[-1])
    assert not off.on
    assert off.t_ns == false[0] + FALSE_NS


@pytest.mark.requirement("SR-26")
def test_who_stands_still_after_walking_is_not_stimulated() -> None:
    commands, _ = run(STOPS_NS + 8 * NS_PER_S, turns_after=False)
    assert not on_ns(commands, STOPS_NS + 200 * MS)


@pytest.mark.parametrize("action", [OperatorAction.EMERGENCY_STOP, OperatorAction.DISARM])
def test_a_stop_in_the_early_part_ends_it_at_once(action: OperatorAction) -> None:
    at_ns = RISE_NS - 1200 * MS - 20 * MS
    commands, _ = run(STOPS_NS, [OperatorAct(at_ns, action)])
    assert on_ns(commands, at_ns - 30 * MS)[0] < at_ns
    assert not on_ns(commands, at_ns)


def test_a_sensor_that_falls_silent_in_the_early_part_ends_it() -> None:
    began_ns = RISE_NS - 40 * MS
    commands, _ = run(STOPS_NS + 2 * NS_PER_S, silent_ns=began_ns + 20 * MS)
    early = on_ns(commands, STOPS_NS + 200 * MS)
    assert early[0] == began_ns
    assert early[-1] <= began_ns + 20 * MS + 40 * MS
    assert any("old" in command.refused or "silent" in command.refused for command in commands)


def test_the_gate_refuses_it_as_any_other() -> None:
    commands, controller = run(STOPS_NS, [OperatorAct(STEP_NS, OperatorAction.SET_INTENSITY, 1.0)], armed=False)
    assert controller.onsets[FOOT].in_use
    assert not on_ns(commands, 0)
    refused = [command.t_ns for command in commands if command.refused == "not armed"]
    assert any(t_ns % (1200 * MS) == 660 * MS for t_ns in refused)


@pytest.mark.requirement("SR-25", "SR-26")
@pytest.mark.parametrize("why", ["disorder", "not enough strides"])
def test_nothing_begins_early_of_whom_is_not_known_to_walk(monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    if why == "disorder":
        monkeypatch.setattr("fes.stimulation.order.OrderJudge.in_order", False, raising=False)
        monkeypatch.setattr(
            "fes.stimulation.order.OrderJudge.on_phase", lambda self, change: setattr(self, "in_order", False)
        )
    else:
        monkeypatch.setattr("fes.stimulation.walking.WalkingJudge.walking", False)
    commands, controller = run(STOPS_NS)
    assert all(t_ns % (1200 * MS) >= 700 * MS or t_ns % (1200 * MS) < 100 * MS for t_ns in on_ns(commands, 0))
    assert not controller.onsets[FOOT].used


def test_what_a_person_should_know() -> None:
    _, controller = run(1200 * MS)
    assert controller.notices() == [
        "right foot: onset is detected, not predicted: 0 of 10 heel rises have shown how well they are foreseen"
    ]
    _, controller = run(STOPS_NS)
    assert controller.notices() == []
