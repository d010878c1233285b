"""The whole closed loop on injected time: the same bytes every time, and the story that the demo tells."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from io import StringIO
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from click.testing import CliRunner
from rich.console import Console
from virtual_walks import affected

from drivers.simulated.stimulator.in_process import InProcessStimulator
from fes.cli import demo as demo_loop
from fes.cli.demo import LoopView
from fes.cli.demo import command as demo
from fes.cli.simulate import command
from fes.config import Bus, StimulatorDevice, load_session, validate_session
from fes.hil.closed_loop.one_process import (
    NotifyingLog,
    patient,
    result_of,
    run_in_one_process,
    walk_stimulated,
)
from fes.hil.closed_loop.processes import WALK_S, Happening, armed_protocol
from fes.hil.settings import patient_calibration, patient_session_text
from fes.recording import read_recording
from fes.session_log import SessionLogError, SessionWriter, read_session
from fes.signals import NS_PER_S, StimCommand
from fes.simulation.forward import VirtualPatient, VirtualStride, load_patient, settings_for
from fes.simulation.truth import load_truth


def run(
    folder: Path, name: str, seconds: float, *further: Happening, tuning: str = "act"
) -> tuple[VirtualPatient, Path]:
    settings = patient()
    text = patient_session_text(settings, current_ma=12.0, tuning=tuning)
    session = validate_session(tomllib.loads(text), folder / "session.toml", text)
    log = folder / name
    return run_in_one_process(
        settings,
        session,
        patient_calibration(settings).calibrations,
        armed_protocol(seconds, further),
        log,
        "2026-01-01T00:00:00",
    ), log


def test_two_runs_are_the_same_to_the_last_bit(tmp_path: Path) -> None:
    one, first = run(tmp_path, "one.feslog", 19.0)
    other, second = run(tmp_path, "other.feslog", 19.0)
    assert first.read_bytes() == second.read_bytes()
    assert one.strides == other.strides
    log = read_session(first)
    assert log.complete
    assert not [note for note in log.notes if note.severity == "fault"]
    assert sum(status.charge_uc for status in log.statuses) > 300.0
    dose = log.summary["dose"]["0"]
    assert dose["session_uc"] == pytest.approx(sum(status.charge_uc for status in log.statuses))


def test_what_a_person_does_to_the_tuning_acts_in_the_run(tmp_path: Path) -> None:
    _, log = run(tmp_path, "x.feslog", 24.0, Happening(17.0, "freeze_tuning"), Happening(20.0, "roll_back"))
    texts = [note.text for note in read_session(log).notes if note.source == "tuning"]
    assert any("12.0 → 14.0 mA" in text for text in texts)
    assert any("frozen (on demand)" in text for text in texts)
    assert any("back to the session's settings" in text and "18.0 → 12.0 mA" in text for text in texts)
    assert not any("18.0 → 20.0" in text for text in texts)


def test_the_demo_tells_its_story(tmp_path: Path) -> None:
    done = CliRunner().invoke(demo, ["--closed-loop", "--fast", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    folder = tmp_path / "closed_loop-001"
    result = json.loads((folder / "result.json").read_text())
    first, before, last = (result[part] for part in ("first_8_strides", "before_the_slip", "last_10_strides"))
    assert first["dragged"] >= 1
    assert first["stumbled"] >= 1  # before the first burst
    assert first["median_toe_clearance_mm"] < 10.0
    assert result["strides_until_clear"] <= 12
    assert result["strides_until_clear_again"] <= 12
    assert "After the electrode slipped it took" in done.output
    for part in (before, last):
        assert (part["dragged"], part["stumbled"]) == (0, 0)
        assert part["median_toe_clearance_mm"] > 10.0
    assert result["harm"]["strides"] == result["strides"]
    assert result["harm"]["drags"] >= first["dragged"]
    assert last["charge_uc_a_step"] > before["charge_uc_a_step"]  # what the slipped electrode does not pass on
    for words in ("stumbled", "clears", "12.0 → 14.0 mA", "an electrode has slipped", "the last 10 strides: 0 dragged"):
        assert words in done.output
    assert "\x1b" not in done.output  # no terminal: plain lines
    assert "12.0 → 14.0 mA" in (folder / "report.html").read_text()
    assert len((folder / "patient.strides.csv").read_text().splitlines()) == result["strides"] + 1


def test_an_interrupted_demo_leaves_its_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(view: LoopView, stride: VirtualStride) -> None:
        if stride.number == 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(LoopView, "stride", interrupted)
    done = CliRunner().invoke(demo, ["--closed-loop", "--fast", "--out", str(tmp_path)])
    assert done.exit_code == 130, done.output
    folder = tmp_path / "closed_loop-001"
    assert "12.0 → 14.0 mA" in (folder / "report.html").read_text()
    assert len((folder / "patient.strides.csv").read_text().splitlines()) == 1 + 5


def test_a_demo_interrupted_before_its_log_has_a_header_is_interrupted_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*given: object) -> None:
        (tmp_path / "closed_loop-001" / "session.feslog").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(demo_loop, "_in_one_process", interrupted)
    done = CliRunner().invoke(demo, ["--closed-loop", "--fast", "--out", str(tmp_path)])
    assert done.exit_code == 130, done.output


def test_a_demo_on_a_full_disk_ends_with_a_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(log: object, change: object) -> None:
        raise SessionLogError("session.feslog: cannot be written any more: the disk is full")

    monkeypatch.setattr(NotifyingLog, "phase", full)
    done = CliRunner().invoke(demo, ["--closed-loop", "--fast", "--out", str(tmp_path)])
    assert done.exit_code == 3, done.output
    assert "the disk is full" in done.output


def drawn(view: LoopView, width: int = 150, height: int = 50) -> str:
    console = Console(width=width, height=height, record=True, file=StringIO())
    console.print(view.picture(console))
    return console.export_text()


def test_the_picture_shows_the_last_strides_and_reasons(capsys: pytest.CaptureFixture[str]) -> None:
    lived = VirtualPatient(patient())
    lived.advance(40_000_000_000)
    strides = [stride for stride in lived.strides if stride.foot == "right_foot"]
    with LoopView("A walk", live=True) as view:
        view.state("running, intensity 100%")
        for stride in strides:
            view.stride(replace(stride, dragged=False, stumbled=False, toe_clearance_m=0.02))
        view.stride(replace(strides[-1], number=99, stumbled=True, toe_clearance_m=-0.004))
        for number in range(9):
            view.text(float(number), f"reason {number}")
        shown = drawn(view)
        low = drawn(view, 80, 24)
        for number in range(4):
            view.text(float(number), f"{number}: " + "a reason that needs several lines of a narrow terminal " * 4)
        crowded = drawn(view, 80, 24)
    assert "running, intensity 100%" in shown
    assert "━" * 20 in shown
    assert any(line.startswith("99 ") and "stumbled" in line for line in shown.splitlines())
    assert "reason 8" in shown
    assert "reason 4" not in shown
    assert not any(line.startswith("1 ") for line in shown.splitlines())  # the oldest make room
    assert len(shown.splitlines()) < 26
    for picture, newest in ((low, "reason 8"), (crowded, "3: a reason")):
        assert len(picture.splitlines()) < 24  # nothing is cut off at the bottom
        assert newest in picture
        assert sum(line[:1].isdigit() for line in picture.splitlines()) >= 5
        assert any(line.startswith("99 ") for line in picture.splitlines())
    capsys.readouterr()
    with LoopView("A walk", live=False) as plain:
        plain.state("armed")
        plain.state("armed")
        plain.stride(strides[0])
    assert capsys.readouterr().out.count("armed") == 1
    with LoopView("A walk", quiet=True) as silent:
        silent.stride(strides[0])
        silent.text(1.0, "x")
        silent.state("y")
    assert capsys.readouterr().out == ""


def test_options_that_do_not_go_together_are_refused(tmp_path: Path) -> None:
    for options in (["--closed-loop", "--speed", "2"], ["--fast"], ["--json"]):
        done = CliRunner().invoke(demo, [*options, "--out", str(tmp_path)])
        assert done.exit_code == 2
        assert "closed-loop" in done.output


def test_a_run_without_strides_has_a_result() -> None:
    assert result_of([])["last_10_strides"]["median_toe_clearance_mm"] is None


def test_a_course_holds_only_what_can_happen() -> None:
    planned = armed_protocol(60.0, (Happening(50.0, "electrode", 0.7), Happening(2.0, "speed", 0.9)))
    assert [one.what for one in planned.happenings] == ["speed", "arm", "full", "electrode"]
    assert planned.happenings[2].t_s + 4.0 < WALK_S
    with pytest.raises(ValueError, match="must be one of"):
        Happening(1.0, "fly")


@pytest.mark.parametrize("tuning", ["off", "suggest", "act"])
def test_the_session_it_writes_is_one(tmp_path: Path, tuning: str) -> None:
    stimulator = StimulatorDevice.model_validate({"device": "p24_low_level", "port": "/dev/pts/7"})
    bus = Bus(interface="udp_multicast", options={"port": 4711})
    settings = patient()
    ports = {"left_foot": "/dev/pts/1", "right_foot": "/dev/pts/2"}
    path = tmp_path / "session.toml"
    path.write_text(patient_session_text(settings, tuning=tuning, ports=ports, stimulator=stimulator, bus=bus), "utf-8")
    session = load_session(path)
    assert {device.sensor: device.port for device in session.sensors} == ports
    assert session.stimulator == stimulator
    assert session.bus == bus
    assert session.geometry == VirtualPatient(settings).geometry
    (channel,) = session.channels
    assert (channel.foot, channel.number) == (settings.affected_foot, settings.channel)
    assert channel.tuning is not None
    assert channel.tuning.mode == tuning
    assert median([channel.tuning.bounds.current_ma.low, 40.0]) == 25.0 if channel.tuning.bounds else False


# --- The loop closed on simulated time: patient, controller, gate, the stimulator's end of the line ---


SESSION = Path(__file__).resolve().parents[2] / "sim_inputs" / "session.toml"


def test_phase_triggered_stimulation_lifts_the_foot(tmp_path: Path) -> None:
    patient = VirtualPatient(settings_for("severe", seed=12, sensors=("left_foot", "right_foot")))
    session = load_session(SESSION)
    session = session.model_copy(update={"stimulation": session.stimulation.model_copy(update={"intensity": 0.75})})
    walk_stimulated(patient, session, 30.0, tmp_path / "x.feslog", name="x", on_sample=lambda sample: None)
    strides = affected(patient, 0)
    assert strides[0].charge_uc == 0.0  # nothing before a stride has shown that this is walking
    later = strides[8:]
    assert all(stride.charge_uc > 100.0 for stride in later)
    assert 0.01 <= median(stride.toe_clearance_m for stride in later) <= 0.03
    assert not any(stride.dragged or stride.stumbled for stride in later)


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
