"""What a person can do to the tuning in a live session, and what the session tells of it."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from replays import trial
from rich.console import Console
from test_tuning_controller import MS, STRIDE_MS, Walk, full, tuned_session

from fes.analysis.pipeline import analyse
from fes.calibration.recording import calibrate_phase_sensors
from fes.config import Session
from fes.control.controller import Controller
from fes.estimation.foot.calibration import FootCalibration
from fes.gate import gate_of
from fes.live.commands import NEEDS_CONFIRMATION, OperatorCommand, commands_of_keys
from fes.live.commands import CommandKind as Kind
from fes.live.inputs import WitnessInput
from fes.live.monitor import tuning_status
from fes.live.operator import AGAIN_NS, Operator, Refusal, TuningCommands
from fes.live.processes import HelperProcess
from fes.live.status import Status, TuningStatus
from fes.live.terminal_view import picture
from fes.live.witness_process import Growing
from fes.recording import Recording, Track, read_recording
from fes.session_log import Note, SessionWriter
from fes.signals import Event, ImuSample, OperatorAct, OperatorAction
from fes.witness.verdict import Hearing

AT_NS = (5 * STRIDE_MS + 700) * MS


@cache
def calibrations() -> dict[str, FootCalibration]:
    return calibrate_phase_sensors(trial("example_csv")).calibrations


def dragging(mode: str, strides: int = 6) -> Walk:
    """A foot whose toe is always 2 mm above the ground, the target being 12–35."""
    return Walk(tuned_session(mode), calibrations(), [0.002] * 20).until(strides, [full()])


def pressed(ask: Kind) -> OperatorCommand:
    return OperatorCommand(ask)


def over_control(ask: Kind) -> OperatorCommand:
    return OperatorCommand(ask, origin="control")


def test_the_keys_of_the_tuning() -> None:
    asked = [Kind.FREEZE_TUNING, Kind.RESUME_TUNING, Kind.ACCEPT_SUGGESTION, Kind.ROLL_BACK]
    assert [command.kind for command in commands_of_keys(b"fgyr")] == asked
    assert set(asked[1:]) <= NEEDS_CONFIRMATION  # freezing alone can never lead to more current
    assert Kind.FREEZE_TUNING not in NEEDS_CONFIRMATION


def test_a_suggestion_is_accepted_by_the_second_press_and_acts_from_the_next_burst_on() -> None:
    walk = dragging("suggest")
    commands = TuningCommands(walk.controller)
    assert commands.execute(pressed(Kind.ACCEPT_SUGGESTION), 0, AT_NS) == []
    assert commands.message == "channel 0, accept: current 30.0 → 32.0 mA? y again"
    acts = commands.execute(pressed(Kind.ACCEPT_SUGGESTION), 0, AT_NS + AGAIN_NS)
    assert acts == [OperatorAct(AT_NS + AGAIN_NS, OperatorAction.ACCEPT_SUGGESTION, 0.0)]
    assert "from the next burst on" in commands.message
    walk.take(acts[0])
    assert walk.controller.tuning.parameters()[0].current_ma == 32.0
    with pytest.raises(Refusal, match="nothing is suggested for channel 0"):
        commands.execute(pressed(Kind.ACCEPT_SUGGESTION), 0, AT_NS + AGAIN_NS)


def test_a_second_press_too_late_or_for_something_else_only_asks_again() -> None:
    walk = dragging("suggest")
    commands = TuningCommands(walk.controller)
    assert commands.execute(pressed(Kind.ACCEPT_SUGGESTION), 0, AT_NS) == []
    assert commands.execute(pressed(Kind.ACCEPT_SUGGESTION), 0, AT_NS + AGAIN_NS + 1) == []
    tuner = walk.controller.tuning.tuners[0]
    assert tuner.pending is not None
    tuner.pending = replace(tuner.pending, current_ma=31.0)  # the foot took another step meanwhile
    assert commands.execute(pressed(Kind.ACCEPT_SUGGESTION), 0, AT_NS + AGAIN_NS + 2) == []
    assert "30.0 → 31.0 mA" in commands.message
    assert commands.execute(pressed(Kind.ROLL_BACK), 0, AT_NS + AGAIN_NS + 3) == []
    assert (
        commands.execute(pressed(Kind.ACCEPT_SUGGESTION), 0, AT_NS + AGAIN_NS + 4) == []
    )  # the roll-back came between
    assert len(commands.execute(pressed(Kind.ACCEPT_SUGGESTION), 0, AT_NS + AGAIN_NS + 5)) == 1


def test_over_the_control_socket_the_messages_confirmation_is_enough() -> None:
    walk = dragging("suggest")
    acts = TuningCommands(walk.controller).execute(over_control(Kind.ACCEPT_SUGGESTION), 0, AT_NS)
    assert [act.action for act in acts] == [OperatorAction.ACCEPT_SUGGESTION]


def test_freezing_going_on_and_rolling_back() -> None:
    walk = dragging("act")
    commands = TuningCommands(walk.controller)
    assert walk.controller.tuning.parameters()[0].current_ma > 30.0
    with pytest.raises(Refusal, match="not frozen"):
        commands.execute(pressed(Kind.RESUME_TUNING), 0, AT_NS)
    (freeze,) = commands.execute(pressed(Kind.FREEZE_TUNING), 0, AT_NS)
    walk.take(freeze)
    with pytest.raises(Refusal, match="frozen already"):
        commands.execute(pressed(Kind.FREEZE_TUNING), 0, AT_NS)
    assert tuning_status(walk.controller.tuning)["0"].frozen == "on demand"
    (go_on,) = commands.execute(pressed(Kind.RESUME_TUNING), 0, AT_NS)
    walk.take(go_on)
    assert not walk.controller.tuning.tuners[0].frozen
    assert commands.execute(pressed(Kind.ROLL_BACK), 0, AT_NS) == []
    assert "roll back and freeze: current 36.0 → 30.0 mA? r again" in commands.message
    (back,) = commands.execute(pressed(Kind.ROLL_BACK), 0, AT_NS)
    walk.take(back)
    status = tuning_status(walk.controller.tuning)["0"]
    assert status.now == "30.0 mA, 300 µs"
    assert status.last_change.startswith("back to the session's settings")
    with pytest.raises(Refusal, match="is frozen"):
        commands.execute(pressed(Kind.ACCEPT_SUGGESTION), 0, AT_NS)


def test_what_does_not_tune_itself_is_refused_in_words() -> None:
    commands = TuningCommands(dragging("act").controller)
    with pytest.raises(Refusal, match="channel 5 does not tune itself"):
        commands.execute(pressed(Kind.ROLL_BACK), 5, AT_NS)
    untuned = TuningCommands(Controller(tuned_session("off"), calibrations()))
    for ask in (
        Kind.FREEZE_TUNING,
        Kind.RESUME_TUNING,
        Kind.ACCEPT_SUGGESTION,
        Kind.ROLL_BACK,
    ):
        with pytest.raises(Refusal, match="no channel of this session tunes itself"):
            untuned.execute(pressed(ask), 0, AT_NS)


def operator_of(session: Session, controller: Controller, notes: list[Note]) -> Operator:
    return Operator(session, controller, gate_of(session, {}), {}, {}, notes.append, lambda: None)


def test_the_operator_carries_orders_and_notes_refusals() -> None:
    walk = dragging("suggest")
    notes: list[Note] = []
    operator = operator_of(tuned_session("suggest"), walk.controller, notes)
    assert operator.execute(OperatorCommand(Kind.ACCEPT_SUGGESTION), AT_NS) == []
    assert operator.message.endswith("y again")
    assert notes == []
    acts = operator.execute(OperatorCommand(Kind.ACCEPT_SUGGESTION), AT_NS + MS)
    assert acts == [OperatorAct(AT_NS + MS, OperatorAction.ACCEPT_SUGGESTION, 0.0)]
    assert operator.execute(OperatorCommand(Kind.RESUME_TUNING), AT_NS) == []
    assert (notes[-1].severity, notes[-1].text) == ("warning", "tuning is not frozen")


def test_the_status_tells_of_suggestion_change_reason_and_charge() -> None:
    suggesting = tuning_status(dragging("suggest").controller.tuning)["0"]
    assert suggesting.mode == "suggest"
    assert suggesting.suggestion == "current 30.0 → 32.0 mA"
    assert "toe clearance 2 mm (target 12–35)" in suggesting.why
    assert suggesting.last_change == ""
    walk = dragging("act")
    acting = tuning_status(walk.controller.tuning)["0"]
    assert (acting.suggestion, acting.why) == ("", "")
    assert "more is needed: current 34.0 → 36.0 mA" in acting.last_change
    assert 0 < acting.last_change_ns < 6 * STRIDE_MS * MS
    ledger = walk.controller.tuning.ledger.electrodes[0]
    assert acting.step_uc == round(ledger.steps_uc[-1], 1) > 0.0
    assert acting.session_uc == round(ledger.session_uc, 1) >= acting.minute_uc > acting.step_uc
    status = Status(5, "running", tuning={"0": acting})
    assert Status.decode(status.encode()) == status
    assert json.loads(status.encode())["tuning"]["0"]["mode"] == "act"


def drawn(status: Status) -> str:
    console = Console(width=200, record=True, file=StringIO())
    console.print(picture(status))
    return console.export_text()


def test_the_terminal_view_shows_it() -> None:
    told = TuningStatus(
        mode="suggest", now="30.0 mA, 300 µs", suggestion="current", why="suggested: toe low: current 30.0 → 32.0 mA",
        last_change="suggestion accepted by the operator", hint="the muscle may be tiring", step_uc=240.0,
        minute_uc=9400.0, session_uc=12300.0,
    )  # fmt: skip
    shown = drawn(Status(1, "running", tuning={"0": told}))
    for words in (
        "channel 0: tuning suggest, set to 30.0 mA, 300 µs at full intensity",
        "240 µC a step, 9.40 mC this minute, 12.30 mC",
        "toe low: current 30.0 → 32.0 mA (y accepts)",
        "last change: suggestion accepted",
        "may be tiring",
        "f freeze · g go on · y accept · r roll back",
    ):
        assert words in shown
    assert "FROZEN (on demand)" in drawn(Status(1, "running", tuning={"0": replace(told, frozen="on demand")}))
    assert "channel 0:" not in drawn(Status(1, "running", tuning={"0": TuningStatus()}))


# --- The witness of a live session's foot sensors: heard after each stride, over a log that grows ---


TRIAL = Path(__file__).resolve().parents[2] / "sim_inputs" / "both_feet_100hz.parquet"
FOOT = "right_foot"


def walked(late_ms: float = 0.0) -> Track:
    """A foot's sensor whose accelerometer is late."""
    track = read_recording(TRIAL).tracks[FOOT]
    at = track.t_sensor_ns - 1e6 * late_ms
    acc = np.column_stack([np.interp(at, track.t_sensor_ns, axis) for axis in track.acc_mps2.T])
    return replace(track, acc_mps2=acc)


def heard(track: Track) -> Iterator[Hearing]:
    """Stride by stride."""
    strides = analyse(Recording("walk", None, {FOOT: track})).strides
    hearing, done = Hearing(FOOT, track.rate_hz), 0
    values = np.hstack((track.acc_mps2, track.gyr_radps))
    for stride in strides:
        until = int(np.searchsorted(track.t_sensor_ns, stride.t_end_ns + 500_000_000))
        borders = [(stride.t_start_ns, stride.t_end_ns)]
        hearing.add(track.t_sensor_ns[done:until], values[done:until], borders)
        done = until
        hearing.hear()
        yield hearing


def test_a_late_accelerometer_is_told_by_how_much_and_a_sound_one_never() -> None:
    said = [hearing.lies for hearing in heard(walked(40.0))]
    assert said[10] == ""
    assert "the accelerometer is" in said[-1]
    assert 35.0 <= float(said[-1].split()[3]) <= 45.0, said[-1]
    assert {hearing.lies for hearing in heard(walked())} == {""}


def test_it_says_at_once_that_it_does_not_know_yet() -> None:
    unknown = [hearing.unknown for hearing in heard(walked())]
    assert unknown[0] == "1 of 20 strides"
    assert unknown[18] == "19 of 20 strides"


# --- over a log ------------------------------------------------------------------------------------------------------


def log_of(track: Track, path: Path) -> None:
    """What a session would have written."""
    strides = analyse(Recording("walk", None, {FOOT: track})).strides
    log, due = SessionWriter(path, {"kind": "live", "recording": {"rates_hz": {FOOT: track.rate_hz}}}), list(strides)
    for t, acc, gyr in zip(track.t_sensor_ns.tolist(), track.acc_mps2.tolist(), track.gyr_radps.tolist(), strict=True):
        log.event(ImuSample(t, FOOT, t, tuple(acc), tuple(gyr)))
        while due and due[0].t_end_ns + 300_000_000 <= t:
            log.stride(due.pop(0))
    log.close({})


def test_a_log_is_read_as_it_grows_and_every_sample_once(tmp_path: Path) -> None:
    track = walked().part(slice(0, 3000))
    log_of(track, tmp_path / "whole.feslog")
    whole = (tmp_path / "whole.feslog").read_bytes()
    path = tmp_path / "grows.feslog"
    growing, strides = Growing(path), 0
    times: list[int] = []
    for end in (0, 3, 700, len(whole) // 2, len(whole) // 2 + 11, len(whole)):
        path.write_bytes(whole[:end])
        samples, borders = growing.read_new()
        times += samples[FOOT][0].tolist() if FOOT in samples else []
        strides += len(borders.get(FOOT, []))
    assert times == track.t_sensor_ns.tolist()
    assert strides > 5
    assert growing.rates_hz == {FOOT: track.rate_hz}


def test_the_process_says_what_lies_and_ends_with_the_session(tmp_path: Path) -> None:
    log_of(walked(40.0), tmp_path / "session.feslog")
    # all of the log is there at its first look: it hears once where a session hears after each stride
    arguments = "fes.live.witness_process", str(tmp_path / "session.feslog")
    with HelperProcess(*arguments) as helper:
        helper.link.settimeout(120.0)
        said = json.loads(helper.link.recv(4096))
        assert said["sensor"] == FOOT
    assert helper.process.returncode is not None  # by itself, or killed where the processors are busy


# --- what a session makes of it --------------------------------------------------------------------------------------


def test_what_lies_is_told_once_and_shown_and_a_session_goes_on_without_a_witness() -> None:
    link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    link.setblocking(False)
    told: list[str] = []

    def freeze(t_ns: int, why: str) -> list[Event]:
        told.append(why)
        return [OperatorAct(t_ns, OperatorAction.FREEZE_TUNING, why=why)]

    witness = WitnessInput(link, freeze)
    assert witness.read_events(1) == []
    for lies, unknown in (("", "3 of 20 strides"), ("it is late", ""), ("it is later", "")):
        theirs.send(json.dumps({"sensor": FOOT, "lies": lies, "unknown": unknown}).encode())
    assert witness.read_events(2) == []
    assert witness.now() == [f"{FOOT}: whether this sensor can be trusted is not known yet (3 of 20 strides)"]
    assert len(witness.read_events(3)) == 1
    assert witness.read_events(4) == []
    assert told == [f"{FOOT}: it is late"]
    assert witness.now() == [f"{FOOT}: it is later; lengths and clearance are wrong"]
    theirs.close()
    assert witness.read_events(5) == []
    assert witness.fileno() is None
    assert "the witness has ended" in witness.now()[0]


@pytest.mark.parametrize("message", [b"[]", b"{}", b"\xff"])
def test_what_is_no_message_ends_it(message: bytes) -> None:
    link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.send(message)
    witness = WitnessInput(link, lambda t_ns, why: [])
    assert witness.read_events(1) == []
    assert witness.fileno() is None
