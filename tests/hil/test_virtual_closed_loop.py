"""The loop closed on simulated time: patient, controller, gate, the stimulator's end of the line, and back."""

from __future__ import annotations

import json
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from click.testing import CliRunner
from virtual_walks import affected

from drivers.simulated.stimulator.in_process import InProcessStimulator
from fes.calibration.recording import calibrate_phase_sensors
from fes.cli.simulate import command
from fes.config import load_session
from fes.control.controller import Controller
from fes.control.runner import Runner, armed_after, with_ticks
from fes.estimation.sensor_choice import shank_phase_sensors
from fes.gate import gate_of
from fes.recording import read_recording
from fes.session_log import Note, SessionLogError, SessionWriter, read_session
from fes.signals import NS_PER_S, Event, StimCommand, StrideResult, WireFrame
from fes.simulation.forward import VirtualPatient, load_patient, settings_for
from fes.simulation.forward.closed_loop import calibration_walk, patient_events
from fes.simulation.truth import load_truth
from statemachine.phases import PhaseChange

SESSION = Path(__file__).resolve().parents[2] / "sim_inputs" / "session.toml"


class Wire:
    """A log that keeps what went over the wire."""

    def __init__(self) -> None:
        self.frames: list[tuple[int, bytes]] = []

    def command(self, command: StimCommand, frame: WireFrame) -> None:
        self.frames.append((frame.t_ns, frame.data))

    def event(self, event: Event) -> None: ...
    def phase(self, change: PhaseChange) -> None: ...
    def stride(self, result: StrideResult) -> None: ...
    def note(self, note: Note) -> None: ...
    def latency(self, t_ns: int, latency_ns: int) -> None: ...


def closed_loop(seconds: float) -> tuple[VirtualPatient, Wire]:
    settings = settings_for("severe", seed=12, sensors=("left_foot", "right_foot"))
    session = load_session(SESSION)
    found = calibrate_phase_sensors(calibration_walk(settings)).calibrations
    patient, wire = VirtualPatient(settings), Wire()
    stimulator = InProcessStimulator(session_id=7)
    stimulator.start(0)
    gate = gate_of(session, {name: each.up for name, each in found.items()}, shank_phase_sensors(found))
    runner = Runner(Controller(session, found), gate, stimulator, wire, lambda: 0)
    events = armed_after(with_ticks(patient_events(patient, stimulator, seconds)), 0.5, 0.75)
    runner.run(events, lambda event: None)
    stimulator.close()
    return patient, wire


def test_phase_triggered_stimulation_lifts_the_foot_and_every_run_is_the_same() -> None:
    patient, wire = closed_loop(30.0)
    strides = affected(patient, 0)
    assert strides[0].charge_uc == 0.0  # nothing before a stride has shown that this is walking
    later = strides[8:]
    assert all(stride.charge_uc > 100.0 for stride in later)
    assert 0.01 <= median(stride.toe_clearance_m for stride in later) <= 0.03
    assert not any(stride.dragged or stride.stumbled for stride in later)
    again, same = closed_loop(30.0)
    assert same.frames == wire.frames
    assert again.strides == patient.strides


def test_the_stimulator_in_process_makes_the_pulses_that_were_commanded() -> None:
    stimulator = InProcessStimulator(session_id=9)
    stimulator.start(0)
    for t_ns in range(0, NS_PER_S, 20_000_000):
        stimulator.send(StimCommand(t_ns, 2, True, 20.0, 250.0, 40.0, 60))
        statuses = stimulator.poll(t_ns)
        assert not any(status.fault for status in statuses)
    stimulator.poll(2 * NS_PER_S)
    pulses = stimulator.take_pulses()
    assert {(p.channel, p.current_ma, p.pulse_width_us) for p in pulses} == {(2, 20.0, 250.0)}
    assert np.diff([p.t_ns for p in pulses]).tolist() == [25_000_000] * (len(pulses) - 1)
    assert pulses[-1].t_ns < 980_000_000 + 60_000_000  # the lease ends what nobody renews
    assert len(pulses) == pytest.approx(41, abs=1)
    assert stimulator.take_pulses() == []
    stimulator.close()


def invoke(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(command, list(arguments))
    return result.exit_code, result.output


def test_fes_simulate_writes_what_fes_reads(tmp_path: Path) -> None:
    code, out = invoke(
        "--severity", "severe", "--speed", "0.9", "--seed", "3", "--seconds", "15", "--out", str(tmp_path), "--json"
    )
    assert code == 0, out
    result = json.loads(out)
    assert result["charge_uc"] == 0
    recording = read_recording(Path(result["recording"]))
    assert set(recording.tracks) == {"left_foot", "right_foot", "left_shank", "right_shank"}
    assert recording.tracks["right_foot"].duration_s == pytest.approx(15.0, abs=0.02)
    assert len(load_truth(tmp_path / "simulated.parquet").strides_of("right_foot")) == result["strides"]
    first = (tmp_path / "simulated.parquet").read_bytes()
    code, out = invoke("--out", str(tmp_path))
    assert code == 2
    assert "--overwrite" in out
    again = ("--severity", "severe", "--speed", "0.9", "--seed", "3", "--seconds", "15", "--overwrite")
    assert invoke(*again, "--out", str(tmp_path))[0] == 0
    assert (tmp_path / "simulated.parquet").read_bytes() == first


def test_fes_simulate_in_closed_loop_writes_a_session_log(tmp_path: Path) -> None:
    code, out = invoke(
        "--severity", "severe", "--seconds", "20", "--stimulate", "phase", "--out", str(tmp_path), "--json"
    )
    assert code == 0, out
    assert json.loads(out)["charge_uc"] > 500.0
    log = read_session(tmp_path / "simulated.feslog")
    assert log.complete
    delivered = sum(status.charge_uc for status in log.statuses)
    assert delivered == pytest.approx(json.loads(out)["charge_uc"], rel=0.2)
    assert log.header["recording"]["name"] == "simulated"  # not the walk that it was calibrated with
    assert log.header["session"]["name"] == "Virtual patient, simulated"
    assert log.header["kind"] == "simulated"
    assert [note.text for note in log.notes if note.severity == "fault"] == []  # the end is no sensor that was lost


def test_fes_simulate_says_why_nothing_was_stimulated_any_more(tmp_path: Path) -> None:
    """At 2 m/s this foot comes down harder than the gate believes."""
    walk = ("--severity", "severe", "--speed", "2", "--seconds", "12", "--seed", "3")
    code, out = invoke(*walk, "--stimulate", "phase", "--out", str(tmp_path))
    assert code == 0, out
    assert "The gate latched once at 5.5" in out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--seconds", "nan"), "nan is not a finite number"),
        (("--speed", "nan"), "nan is not a finite number"),
        (("--session", "session.toml"), "--stimulate phase"),
        (("--stimulator", "rehastim2"), "--live"),
        (("--live", "--json"), "--json has no meaning with --live"),
        (("--live", "--session", "mine.toml"), "--session has no meaning with --live"),
    ],
)
def test_fes_simulate_refuses_what_it_cannot_use(tmp_path: Path, arguments: tuple[str, ...], said: str) -> None:
    code, out = invoke(*arguments, "--out", str(tmp_path))
    assert code == 2, out
    assert said in out


def test_fes_simulate_takes_a_name_literally(tmp_path: Path) -> None:
    named = ("--name", "[abc]", "--seconds", "5", "--out", str(tmp_path))
    code, out = invoke(*named)
    assert code == 0, out
    assert "None" not in out  # too short for a stride
    code, out = invoke(*named)
    assert code == 2
    assert "--overwrite" in out


def test_fes_simulate_on_a_full_disk_ends_with_a_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: object, change: object) -> None:
        raise SessionLogError("simulated.feslog: cannot be written any more: the disk is full")

    monkeypatch.setattr(SessionWriter, "phase", full)
    code, out = invoke("--seconds", "8", "--stimulate", "phase", "--out", str(tmp_path))
    assert code == 3, out
    assert "the disk is full" in out


def test_a_patient_from_a_file_and_its_faults(tmp_path: Path) -> None:
    file = tmp_path / "patient.toml"
    file.write_text('[patient]\nseverity = "mild"\nheight_m = 1.6\n[patient.muscle]\nmax_torque_nm = 9.0\n', "utf-8")
    settings = load_patient(file, seed=5)
    assert (settings.voluntary_dorsiflexion, settings.height_m, settings.muscle.max_torque_nm) == (0.5, 1.6, 9.0)
    assert load_patient(file, severity="severe").voluntary_dorsiflexion == 0.0
    for text, said in (
        ("[patient]\nweight = 3\n", "has no 'weight'"),
        ("[walker]\n", r"one table, \[patient\]"),
        ("[patient\n", "not valid TOML"),
        ("[patient]\nheight_m = 9.0\n", "height_m = 9.0"),
        ("[patient]\nmuscle = 3\n", "must be a table"),
        ("[patient]\nheight_m = 'tall'\n", "height_m"),
        ("[patient]\nseed = 1.5\n", "seed = 1.5: must be a whole number"),
        ("[patient]\nchannel = 0.5\n", "channel = 0.5: must be a whole number"),
        ("[patient]\nsensors = 5\n", "sensors = 5: must be a list of names"),
    ):
        file.write_text(text, "utf-8")
        with pytest.raises(ValueError, match=said):
            load_patient(file)
    with pytest.raises(ValueError, match="cannot be read"):
        load_patient(tmp_path / "none.toml")
    code, out = invoke(str(file), "--out", str(tmp_path))
    assert code == 2
    assert "sensors" in out
    with pytest.raises(ValueError, match="no such setting"):
        settings_for("mild", wheels=4)
