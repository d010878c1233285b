"""The whole closed loop on injected time: the same bytes every time, and the story that the demo tells."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from io import StringIO
from pathlib import Path
from statistics import median

import pytest
from click.testing import CliRunner
from rich.console import Console

from fes.cli import demo as demo_loop
from fes.cli.demo import LoopView
from fes.cli.demo import command as demo
from fes.config import Bus, StimulatorDevice, load_session, validate_session
from fes.hil.closed_loop.one_process import NotifyingLog, patient, result_of, run_in_one_process
from fes.hil.closed_loop.processes import WALK_S, Happening, armed_protocol
from fes.hil.settings import patient_calibration, patient_session_text
from fes.session_log import SessionLogError, read_session
from fes.simulation.forward import VirtualPatient, VirtualStride


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
