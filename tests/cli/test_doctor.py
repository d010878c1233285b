"""`fes devices` and `fes doctor`: each thing that can be wrong is found, named, and comes with its remedy."""

from __future__ import annotations

import json
import os
import pty
import shutil
import tempfile
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import serial
from click.testing import CliRunner
from replays import SETTINGS, cut, edit, trial

from drivers.discover import CanChannel, SerialPort, can_channels, device_maker
from drivers.imu import ximu3
from drivers.stimulator.serial_line import latency_hint
from fes.cli import doctor
from fes.cli.common import FAILED, OK, latched
from fes.cli.devices import Connected, wanted_by
from fes.cli.doctor import Finding, Verdict, settings, stop_file_finding
from fes.cli.main import main
from fes.config import ImuDevice, Session, load_session
from fes.live import processes
from fes.recording import Track, write_recording
from fes.report.quality import Notice

RATE_HZ = 100


def session(folder: Path, text: str) -> Session:
    path = folder / "session.toml"
    path.write_text(f"{SETTINGS.read_text()}\n{text}")
    return load_session(path)


def sensor(port: str | Path, rate_hz: float = RATE_HZ, device: str = "ximu3") -> str:
    return (
        f'[[sensors]]\nsensor = "right_foot"\ndevice = "{device}"\nport = "{port}"\nrate_hz = {rate_hz}\n'
        "acc_range_g = 16\ngyr_range_dps = 2000\n"
    )


def only(findings: Iterator[Finding] | list[Finding], name: str) -> Finding:
    (found,) = [finding for finding in findings if finding.name == name]
    return found


class Sensor:
    """An x-IMU3 on a pseudo-terminal, in a thread; its clock and its beat are set."""

    def __init__(self, rate_hz: float = RATE_HZ, clock: float = 1.0) -> None:
        self._own, self._other = pty.openpty()
        tty.setraw(self._other)
        self.port = os.ttyname(self._other)
        self._rate_hz, self._clock = rate_hz, clock
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        began_s, number = time.monotonic(), 0
        while not self._end.is_set():
            number += 1
            own_us = round(1e6 * self._clock * number / self._rate_hz)
            os.write(self._own, ximu3.encode(ximu3.Inertial(own_us, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))))
            time.sleep(max(0.0, began_s + number / self._rate_hz - time.monotonic()))

    def close(self) -> None:
        self._end.set()
        self._thread.join()
        os.close(self._own)
        os.close(self._other)


# --- devices ---------------------------------------------------------------------------------------------


def test_devices_are_told_by_what_they_say_of_themselves() -> None:
    assert device_maker("FTDI x-IMU3", 0x0403) == "x-io"
    assert device_maker("HASOMED GmbH P24", 0x0403) == "HASOMED"
    assert device_maker("USB Serial", 0x0403) == "FTDI"
    assert device_maker("MTi-630", 0x2639) == "Xsens"
    assert device_maker("Arduino", 0x2341) == ""
    assert device_maker("", None) == ""


def test_can_interfaces_are_read_from_the_system(tmp_path: Path) -> None:
    for name, kind, flags in (("can0", "280", "0x40c1"), ("vcan0", "280", "0x40080"), ("eth0", "1", "0x1003")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n")
        (tmp_path / name / "flags").write_text(f"{flags}\n")
    here = [channel for channel in can_channels(tmp_path) if channel.interface == "socketcan"]
    assert here == [CanChannel("socketcan", "can0", "up"), CanChannel("socketcan", "vcan0", "down")]


def test_a_sessions_devices_are_found_or_not(tmp_path: Path) -> None:
    there = tmp_path / "ttyUSB0"
    there.touch()
    text = (
        '[bus]\ninterface = "socketcan"\nchannel = "can1"\n' + sensor(there) + "[live.stop_button]\n"
        f'source = "serial_cts"\nport = "{tmp_path}/ttyUSB9"\n'
    )
    connected = Connected(
        [SerialPort(str(there), "x-IMU3", "0403:6015", "x-io")], [CanChannel("socketcan", "can0")], None
    )
    wanted = {each.name: each for each in wanted_by(session(tmp_path, text), connected)}
    assert wanted["right_foot"].found is True
    assert "x-IMU3" in wanted["right_foot"].said
    assert wanted["stimulator"].found is False
    assert wanted["stop button"].found is False


def test_the_commands_speak_json_and_exit_by_what_they_found(tmp_path: Path) -> None:
    path = tmp_path / "session.toml"
    path.write_text(SETTINGS.read_text() + sensor("/dev/nothing-here"))
    done = CliRunner().invoke(main, ["devices", str(path), "--json"])
    assert done.exit_code == FAILED
    found = json.loads(done.stdout)
    assert [each["found"] for each in found["session"] if each["name"] == "right_foot"] == [False]
    alone = CliRunner().invoke(main, ["devices"])
    assert alone.exit_code == OK
    assert "Serial ports" in alone.stdout


# --- doctor: the computer ---------------------------------------------------------------------------------


def test_a_sound_computer_passes(tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["doctor", "--out", str(tmp_path), "--json"])
    assert done.exit_code == OK, done.output
    told = json.loads(done.stdout)
    assert told["ok"] is True
    names = {finding["name"] for finding in told["findings"]}
    assert {"clock", "disk", "disk speed", "compiled code", "serial ports' group"} <= names
    assert not list(tmp_path.iterdir())


def test_what_was_asked_for_is_given_back() -> None:
    before = os.sched_getscheduler(0)
    list(doctor.permissions())
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == before & ~os.SCHED_RESET_ON_FORK


def test_no_fixed_priority_is_a_warning_with_cost_and_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(processes.os, "sched_setscheduler", refuse)
    found = only(doctor.permissions(), "fixed priority (SCHED_FIFO)")
    assert found.verdict is Verdict.WARNING
    assert "Operation not permitted" in found.said
    assert "rtprio" in found.remedy


def test_a_disk_that_is_too_small_is_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = session(tmp_path, sensor("/dev/x", rate_hz=500))
    per_s = doctor.log_bytes_per_s(settings, tmp_path)
    assert 10_000 < per_s < 200_000  # some 40 bytes a sample, 500 of them
    monkeypatch.setattr(shutil, "disk_usage", lambda place: SimpleNamespace(free=int(3600 * per_s * 0.9)))
    found = only(doctor.disk(settings, tmp_path, hours=1.0), "disk")
    assert found.verdict is Verdict.FAILURE
    assert "make room" in found.remedy
    assert only(doctor.disk(settings, tmp_path, hours=0.5), "disk").verdict is Verdict.OK


def test_a_folder_that_cannot_be_written_is_a_failure(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (found,) = doctor.disk(None, tmp_path / "file", hours=1.0)
    assert (found.name, found.verdict) == ("disk", Verdict.FAILURE)


def test_a_user_outside_the_group_is_warned() -> None:
    found = doctor.group(ids={64_999})
    assert found.verdict is Verdict.WARNING
    assert "usermod -aG" in found.remedy


# --- doctor: the session ----------------------------------------------------------------------------------


def test_a_session_without_its_limits_is_a_failure(tmp_path: Path) -> None:
    path = tmp_path / "session.toml"
    path.write_text(SETTINGS.read_text().replace("max_on_s = 3.0\n", ""))
    done = CliRunner().invoke(main, ["doctor", str(path), "--out", str(tmp_path), "--json"])
    assert done.exit_code == FAILED
    found = next(each for each in json.loads(done.stdout)["findings"] if each["name"] == "session")
    assert found["verdict"] == "failure"
    assert "max_on_s" in found["said"]


def test_a_stop_file_whose_folder_is_not_there_is_a_failure(tmp_path: Path) -> None:
    """Arming would be refused, for nobody could stop the session by it."""
    missing, file = tmp_path / "gone" / "halt", tmp_path / "file"
    file.touch()
    found = only(settings(tmp_path, session(tmp_path, f'[live]\nstop_file = "{missing}"\n')), "stop file")
    assert found.verdict is Verdict.FAILURE
    assert str(missing.parent) in found.said
    assert found.remedy == "make the folder"
    assert stop_file_finding(file / "halt").verdict is Verdict.FAILURE
    assert stop_file_finding(tmp_path / "halt").verdict is Verdict.OK


def test_the_stop_file_may_be_named_as_for_run(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")  # is there, though it leads nowhere
    for given in ([str(SETTINGS)], []):
        command = ["doctor", *given, "--stop-file", str(tmp_path / "link"), "--out", str(tmp_path), "--json"]
        done = CliRunner().invoke(main, command)
        assert done.exit_code == FAILED
        (found,) = [each for each in json.loads(done.stdout)["findings"] if each["name"] == "stop file"]
        assert ("arming would be refused" in found["said"], found["remedy"]) == (True, "remove it")


def test_a_stop_file_in_a_folder_that_is_not_ones_own_costs_that_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)  # root may write anywhere
    found = stop_file_finding(tmp_path / "halt")
    assert found.verdict is Verdict.WARNING
    assert str(tmp_path) in found.said


# --- doctor: devices --------------------------------------------------------------------------------------


def measured(settings: Session) -> Finding:
    (found,) = doctor.sensors(settings, measure_s=1.0)
    return found


def test_a_port_that_is_not_there(tmp_path: Path) -> None:
    found = measured(session(tmp_path, sensor("/dev/nothing-here")))
    assert found.verdict is Verdict.FAILURE
    assert "no such port" in found.said
    assert "fes devices" in found.remedy


def test_a_port_that_this_user_may_not_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch()
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)
    found = measured(session(tmp_path, sensor(port)))
    assert found.verdict is Verdict.FAILURE
    assert "dialout" in found.remedy


def test_a_sensor_at_its_rate_passes_and_one_at_another_rate_does_not(tmp_path: Path) -> None:
    with closing(Sensor()) as here:
        right = measured(session(tmp_path, sensor(here.port)))
        wrong = measured(session(tmp_path, sensor(here.port, rate_hz=200)))
    assert right.verdict is not Verdict.FAILURE, right
    assert wrong.verdict is Verdict.FAILURE
    assert "the settings say 200 Hz" in wrong.said
    assert any(f"rate_hz = {rate}" in wrong.remedy for rate in range(92, 109)), wrong.remedy


def test_a_sensor_whose_port_another_program_has(tmp_path: Path) -> None:
    with closing(Sensor()) as here, serial.Serial(here.port, exclusive=True):
        found = measured(session(tmp_path, sensor(here.port)))
    assert found.verdict is Verdict.FAILURE
    assert "in use by another program" in found.said
    assert "fuser" in found.remedy


def test_a_sensor_whose_clock_runs_wrong(tmp_path: Path) -> None:
    with closing(Sensor(clock=1.1)) as here:
        found = measured(session(tmp_path, sensor(here.port)))
    assert found.verdict is Verdict.FAILURE
    assert "its clock runs" in found.said


def test_a_silent_sensor(tmp_path: Path) -> None:
    own, other = pty.openpty()
    try:
        found = measured(session(tmp_path, sensor(os.ttyname(other))))
        assert found.verdict is Verdict.FAILURE
        assert "nothing is heard" in found.said
    finally:
        os.close(own)
        os.close(other)


def heard(host_ms: list[float], missing: int = 0) -> doctor.Heard:
    imu = ImuDevice(sensor="right_foot", device="ximu3", port="x", rate_hz=100, acc_range_g=16, gyr_range_dps=2000)
    times = [int(t * 1e6) for t in host_ms]
    return doctor.Heard(imu, times, list(times), missing)


def test_gaps_are_told_as_what_they_cost() -> None:
    even = [10.0 * k for k in range(100)]
    assert doctor.judged("right_foot", heard(even), 1.0).verdict is Verdict.OK
    gap = even[:50] + [t + 45.0 for t in even[50:]]
    found = doctor.judged("right_foot", heard(gap), 1.0)
    assert found.verdict is Verdict.WARNING
    assert "longest silence 55 ms" in found.said
    assert doctor.judged("right_foot", heard(even, missing=3), 1.0).verdict is Verdict.WARNING


@pytest.mark.parametrize(("begin", "end"), [(0, 20), (180, 200)])
def test_a_program_that_was_held_up_does_not_blame_the_sensors_clock(begin: int, end: int) -> None:
    """0.2 s in which nobody read: what waited is read at once."""
    times = [10.0 * k for k in range(200)]
    waited = times[:begin] + [times[end - 1]] * (end - begin) + times[end:]
    found = heard(times)
    found.host_ns = [int(t * 1e6) for t in waited]
    assert doctor.judged("right_foot", found, 2.0).verdict is not Verdict.FAILURE
    found.device_ns = [round(1.1 * t) for t in found.device_ns]
    assert "its clock runs 1.100 times" in doctor.judged("right_foot", found, 2.0).said


def test_an_adapter_that_holds_answers_back_is_named_with_its_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ttyUSB0").mkdir()
    (tmp_path / "ttyUSB0" / "latency_timer").write_text("16\n")
    monkeypatch.setattr(doctor, "latency_hint", lambda port: latency_hint(port, tmp_path))
    settings = session(tmp_path, '[stimulator]\ndevice = "rehastim2"\nport = "/dev/ttyUSB0"\n')
    monkeypatch.setattr(doctor, "stimulator", lambda session: Finding("stimulator", Verdict.OK, ""))
    found = only(doctor.devices(settings), "latency timer")
    assert found.verdict is Verdict.WARNING
    assert "16 ms" in found.said
    assert "echo 1 >" in found.remedy


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[stimulator]\ndevice = "rehastim2"\nport = "/dev/nothing"\n', "no such port"),
        ('[bus]\ninterface = "socketcan"\nchannel = "can17"\n', "can17"),
    ],
)
def test_a_stimulator_that_cannot_be_opened(tmp_path: Path, text: str, said: str) -> None:
    found = doctor.stimulator(session(tmp_path, text))
    assert found.verdict is Verdict.FAILURE
    assert said in found.said


NOBODY = 65534


def said_to_an_ordinary_user() -> list[str]:
    """What is found of the session in the current folder; called as that user."""
    session = load_session(Path("session.toml"))
    findings = [
        *settings(Path("session.toml"), session),
        doctor.port_fault("sensor", "hidden/port"),
        doctor.port_fault("sensor", "port"),
        *doctor.disk(session, Path("hidden/out"), 1.0),
    ]
    said = [f"{each.verdict} {each.said} -> {each.remedy}" for each in findings if each]
    return said + [f"{each.found} {each.said}" for each in wanted_by(session, Connected([], [], []))]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can become another user")
def test_an_ordinary_user_gets_a_verdict_where_nothing_may_be_looked_at() -> None:
    with tempfile.TemporaryDirectory() as name:  # pytest's own folders are closed to others
        folder = Path(name)
        folder.chmod(0o755)
        (folder / "hidden").mkdir(mode=0o700)
        (folder / "hidden" / "port").touch()
        (folder / "port").touch(mode=0o600)
        sensor = 'sensor = "right_foot"\ndevice = "xbus"\nport = "hidden/port"\nrate_hz = 100.0\n'
        (folder / "session.toml").write_text(
            f'{SETTINGS.read_text()}\n[live]\nstop_file = "hidden/stop"\n[[sensors]]\n{sensor}'
            "acc_range_g = 16\ngyr_range_dps = 2000\n"
        )
        reading, writing = os.pipe()
        pid = os.fork()  # not a new interpreter: nobody may look into the folder where this one is
        if pid == 0:
            try:
                os.chdir(folder)
                os.setgroups([])
                os.setgid(NOBODY)
                os.setuid(NOBODY)
                os.write(writing, "\n".join(said_to_an_ordinary_user()).encode())
            except BaseException as error:
                os.write(writing, repr(error).encode())
            finally:
                os._exit(0)
        os.close(writing)
        os.waitpid(pid, 0)
        with os.fdopen(reading, "rb") as file:
            said = file.read().decode()
    assert "failure hidden/stop: cannot be looked for: Permission denied -> name a file" in said
    assert "failure hidden/port: cannot be looked for: Permission denied -> run as" in said
    assert "failure port: this user may not open it -> sudo usermod" in said
    assert "cannot be written: Permission denied -> make room" in said
    assert "False cannot be looked for: Permission denied" in said


# --- A replay whose gate latched says so at its end; its exit code says whether it went through ---


def gate(t_s: float, text: str) -> Notice:
    return Notice(t_s, "info" if text == "armed again" else "fault", "gate", text)


def test_what_is_said_of_latches() -> None:
    assert latched([]) == ""
    assert latched([Notice(1.0, "warning", "gate", "channel 0 refused: not armed"), gate(0.5, "armed again")]) == ""
    first = gate(1.25, "off until armed again: emergency stop")
    assert latched([first]) == (
        "The gate latched once at 1.250 s: emergency stop. Nothing was stimulated from 1.250 s to the end."
    )
    assert latched([first, gate(2.0, "armed again")]) == (
        "The gate latched once at 1.250 s: emergency stop. It was last armed again at 2.000 s."
    )
    again = [first, gate(2.0, "armed again"), gate(3.0, "off until armed again: x")]
    assert latched(again) == (
        "The gate latched 2 times, first at 1.250 s: emergency stop. Nothing was stimulated from 3.000 s to the end."
    )


def test_a_replay_and_its_logs_replay_say_it_last(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def spoilt(track: Track) -> Track:
        acc_mps2, gyr_radps = track.acc_mps2.copy(), track.gyr_radps.copy()
        acc_mps2[3000:3060], gyr_radps[3000:3060] = acc_mps2[3000], gyr_radps[3000]
        return replace(track, acc_mps2=acc_mps2, gyr_radps=gyr_radps)

    recording = tmp_path / "spoilt.parquet"
    write_recording(edit(cut(trial("negard_patient2"), 0.0, 12.0), spoilt), recording)
    common = ["--json"]
    for target in (recording, None):
        path = target or next(tmp_path.glob("out/*/session.feslog"))
        more = ["--out", str(tmp_path / "out"), "--session", str(SETTINGS), "--stimulator", "none", "--no-report"]
        with pytest.raises(SystemExit) as ended:
            main(["replay", str(path), *common, *(more if target else [])], prog_name="fes")
        assert ended.value.code == OK
        said = capsys.readouterr().err
        assert "The gate latched once at 6.0" in said
        assert "right_foot is frozen: the same values for 60 ms, limit 60 ms. Nothing was stimulated from 6.0" in said
