"""Faults between the drivers of real sensors and the loop: what they do, and that only a fault campaign has them."""

from __future__ import annotations

import ast
import math
import re
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import cast

import click
import numpy as np
import pytest
from click.testing import CliRunner

from drivers.imu.port import ImuLost, ImuPort
from drivers.simulated.imu.device import ImuSignal, SimulatedImu
from drivers.simulated.imu.faults import LASTING, FaultedImu
from drivers.simulated.imu.wire import LSL_RECORD, LslWire
from drivers.simulated.lines import LineFaults, MessageFaults
from drivers.stimulator.open import SERIAL
from drivers.stimulator.port import StimulatorLost
from fes import limits
from fes.cli import main
from fes.cli.common import UNUSABLE, Problem
from fes.cli.run.devices import open_sensors
from fes.config import ConfigError, ImuDevice, Session, StimulatorDevice, load_session
from fes.extensions import GROUPS
from fes.hil.campaign_bench import CampaignBench
from fes.hil.devices import hardware_session, on_hardware
from fes.hil.injections import INJECTIONS
from fes.hil.results import MS, Outputs, off_after_ms
from fes.hil.scenarios import BY_NAME, SCENARIOS, Moment, by_radio
from fes.hil.sensor_faults import DUMMY_LOAD, PULSE_BY_PULSE, InjectedFaults, RealSensor
from fes.hil.settings import FOOT, session_text
from fes.live.source import Imu
from fes.signals import RawSample, StimStatus, Tick

ROOT = Path(__file__).resolve().parents[2]
WRAPPER = "drivers.simulated.imu.faults"
PERIOD_NS = 10 * MS
DEVICE = ImuDevice(sensor=FOOT, device="xbus", port="x", rate_hz=100.0, acc_range_g=16.0, gyr_range_dps=2000.0)
OTHER = DEVICE.model_copy(update={"sensor": "left_foot"})


class OpenPort(ImuPort):
    """A driver's port, open: every call of :meth:`read` brings the next sample of each sensor, 100 a second."""

    def __init__(self, *sensors: str) -> None:
        self.sensors = sensors or (FOOT,)
        self.serials = {FOOT: "037003F8"}
        self.counts = {}
        self.count = self.opened = 0

    def fileno(self) -> int:
        return 99

    def sample(self, sensor: str, number: int) -> RawSample:
        x = float(number)
        return RawSample(sensor, number * PERIOD_NS, 7 + number * PERIOD_NS, (x, x + 0.25, 9.0), (0.1 * x, 0.2, 0.3))

    def read(self, t_ns: int) -> list[RawSample]:
        self.count = t_ns // PERIOD_NS
        return [self.sample(sensor, self.count) for sensor in self.sensors]

    def close(self) -> None:
        self.opened -= 1

    def _open(self) -> None:
        self.opened += 1


def numbers(samples: list[RawSample]) -> list[int]:
    return [round((sample.t_device_ns - 7) / PERIOD_NS) for sample in samples]


# --- what stands between ---------------------------------------------------------------------------------


def test_without_a_fault_every_sample_is_as_the_driver_gave_it(monkeypatch: pytest.MonkeyPatch) -> None:
    port = OpenPort(FOOT, "left_foot")
    faulted: Imu = FaultedImu(port, [DEVICE, OTHER])
    assert (faulted.sensors, faulted.serials, faulted.fileno()) == (port.sensors, port.serials, 99)
    beyond = 1.04 * 16 * 9.81  # a driver lets its own calibration stretch full scale a little
    for number in range(200):
        assert faulted.read(number * PERIOD_NS) == [port.sample(sensor, number) for sensor in port.sensors]
    far = RawSample(FOOT, 0, 7, (beyond, math.nan, 0.0), (0.0, 0.0, 0.0))
    monkeypatch.setattr(port, "sample", lambda sensor, number: replace(far, sensor=sensor))
    (sample, _) = faulted.read(0)
    assert sample.acc_mps2[0] == beyond
    assert math.isnan(sample.acc_mps2[1])


@pytest.mark.parametrize(
    ("name", "value"),
    [*((name, 1.0) for name in LASTING), ("held", 7.0), ("held_alive", 33.0), ("unit", 57.3), ("force_scaled", 0.8),
     ("rate_scaled", 2.0), ("clip", 0.01), ("jumping", 0.2), ("doubled", 3.0), ("tap", 1.0)],
)  # fmt: skip
def test_a_real_sensor_shows_what_a_simulated_one_with_this_fault_does(name: str, value: float) -> None:
    port = OpenPort()
    values = [port.sample(FOOT, number) for number in range(50)]
    signal = ImuSignal(100.0, np.array([s.acc_mps2 for s in values]), np.array([s.gyr_radps for s in values]))
    simulated = SimulatedImu(LslWire(), signal, 0)
    real = FaultedImu(port, [DEVICE])
    for number in range(50):
        t_ns = number * PERIOD_NS
        if number == 10:
            simulated.set_fault(t_ns, name, value)
            real.inject(t_ns, FOOT, name, value)
        if number == 40:
            simulated.set_fault(t_ns, name, 0.0) if name != "tap" else None
            real.clear(t_ns, FOOT)
        expected = [LSL_RECORD.unpack(message) for message in simulated.advance(t_ns)]
        shown = [((s.t_device_ns - 7) * 1e-9, *s.acc_mps2, *s.gyr_radps) for s in real.read(t_ns)]
        np.testing.assert_allclose(shown, expected, atol=1e-12, err_msg=f"{name} at {number}")


def test_what_happens_on_a_line_happens_to_samples_of_one_sensor_alone() -> None:
    port = OpenPort(FOOT, "left_foot")
    faulted = FaultedImu(port, [DEVICE, OTHER])

    def read(number: int) -> list[int]:
        samples = faulted.read(number * PERIOD_NS)
        assert [s for s in samples if s.sensor == "left_foot"] == [port.sample("left_foot", number)]
        assert all(s.t_host_ns == number * PERIOD_NS for s in samples)
        return numbers([s for s in samples if s.sensor == FOOT])

    def inject(name: str, value: float = 1.0) -> None:
        faulted.inject(0, FOOT, name, value)

    inject("mute")
    assert read(1) == []
    inject("mute", 0.0)
    inject("drop", 2)
    assert [read(2), read(3), read(4)] == [[], [], [4]]
    inject("reorder")
    assert [read(5), read(6)] == [[], [6, 5]]
    inject("backlog")
    assert [read(7), read(8)] == [[], []]
    inject("backlog", 0.0)
    assert faulted.fileno() is None  # to be read at once: nothing says that they have come
    assert sorted(read(9)) == [7, 8, 9]
    inject("delay", 0.02)
    assert [read(10), faulted.fileno(), read(11), read(12)] == [[], None, [], [10]]
    inject("delay", 0.0)
    assert [sorted(read(13)), faulted.fileno()] == [[11, 13], None]
    assert [read(14), faulted.fileno(), read(15)] == [[12, 14], 99, [15]]
    inject("jump", 0.5)
    assert read(16) == [66]
    inject("reboot")
    assert read(17) == []  # its time was at 0: silent until 0.3 s
    assert faulted.read(30 * PERIOD_NS)[0].t_device_ns == 0
    inject("drift", 1e5)  # of stamps that began at 0 again
    assert faulted.read(130 * PERIOD_NS)[0].t_device_ns == pytest.approx(1.1e9, rel=1e-6)
    for name in LineFaults.faults - MessageFaults.faults | {"coffee", "stand"}:
        with pytest.raises(ValueError, match=name):
            inject(name)


def test_an_unplugged_line_is_lost_until_it_is_plugged_in_again() -> None:
    port = OpenPort()
    faulted = FaultedImu(port, [DEVICE])
    faulted.inject(0, FOOT, "unplug", 1.0)
    assert faulted.fileno() is None  # nothing would wake the loop to notice it
    for attempt in (lambda: faulted.read(0), faulted.reopen):
        with pytest.raises(ImuLost, match="unplugged"):
            attempt()
    faulted.inject(0, FOOT, "unplug", 0.0)
    faulted.reopen()
    assert len(faulted.read(0)) == 1


# --- the link --------------------------------------------------------------------------------------------


def session_of(tmp_path: Path, stimulator: StimulatorDevice | None = None, **changed: float) -> Path:
    path = tmp_path / "session.toml"
    text = session_text("", "/dev/sensor", None, stimulator or StimulatorDevice())
    for name, value in changed.items():
        text = re.sub(rf"\n{name} = .*", f"\n{name} = {value}", text)
    path.write_text(text)
    return path


@contextmanager
def linked(session: Session, *, pulses: bool = False) -> Iterator[tuple[RealSensor, InjectedFaults, list[Imu]]]:
    """Both ends of a link; the session's is read in the time of the orders, as its loop does."""
    sensor = RealSensor(pulses=pulses)
    faults = InjectedFaults(sensor.connect().detach())
    assert faults.dummy_load
    try:
        yield sensor, faults, list(faults.between([OpenPort(FOOT), OpenPort("left_foot")], session))
    finally:
        sensor.close()


def test_orders_are_carried_out_and_answered_with_their_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = load_session(session_of(tmp_path))
    session = other.model_copy(update={"sensors": (*other.sensors, OTHER)})
    with linked(session) as (sensor, faults, (right, left)):
        send = socket.socket.send

        def at_once(link: socket.socket, data: bytes) -> int:
            """The session's loop comes by as soon as there is an order."""
            sent = send(link, data)
            if link is sensor._link:
                faults.read_events(5 * MS)
            return sent

        monkeypatch.setattr(socket.socket, "send", at_once)
        assert sensor.inject("stuck") == 5 * MS
        right.read(0), left.read(0)
        assert right.read(PERIOD_NS)[0].acc_mps2 == (0.0, 0.25, 9.0), "the sensor that the channel follows"
        assert left.read(PERIOD_NS)[0].acc_mps2 == (1.0, 1.25, 9.0)
        sensor.clear()
        assert right.read(2 * PERIOD_NS)[0].acc_mps2 == (2.0, 2.25, 9.0)
        sensor.inject("tap")
        for port in (right, left):  # arming asks each sensor that was in doubt
            port.read(3 * PERIOD_NS)
            assert port.read(4 * PERIOD_NS)[0].gyr_radps[1] > 0.2
        with pytest.raises(ImuLost, match="coffee"):
            sensor.inject("coffee")


def test_a_session_that_does_not_answer_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fes.hil.sensor_faults.ANSWER_S", 0.05)
    sensor = RealSensor(pulses=False)
    with pytest.raises(ImuLost, match="does not answer"):
        sensor.inject("stuck")
    theirs = sensor.connect()
    with pytest.raises(ImuLost, match="does not answer"):
        sensor.inject("stuck")
    theirs.close()
    with pytest.raises(ImuLost, match="does not answer"):
        sensor.inject("stuck")
    sensor.close()


def entries_of(sensor: RealSensor, count: int) -> Outputs:
    outputs, end_s, heard = Outputs(), time.monotonic() + 5.0, 0
    while heard < count and time.monotonic() < end_s:
        new = sensor.new_entries()
        heard += len(new)
        outputs.add(new)
        time.sleep(0.002)
    assert heard == count
    return outputs


def status(t_ms: int, *, on: bool = True, fault: str = "") -> StimStatus:
    return StimStatus(t_ms * MS, 0, 0, on, 18.0 if on else 0.0, 300.0, 40.0, fault=fault)


@pytest.mark.parametrize(("pulses", "off_ms"), [(True, 50), (False, 60)])
def test_the_stimulators_answers_say_when_it_was_off(tmp_path: Path, pulses: bool, off_ms: int) -> None:
    """Pulse by pulse the last is the end; else the answer to "off". A fault's answer is no proof of either."""
    with linked(load_session(session_of(tmp_path)), pulses=pulses) as (sensor, faults, _):
        told = [status(0), status(25), status(50), status(55, on=False, fault="no answer"), status(60, on=False)]
        for event in (*told, status(80, on=False), Tick(90 * MS)):
            faults.observe(event)
        outputs = entries_of(sensor, 4 if pulses else 5)  # the first says that a session has begun
        (stretch,) = outputs.stretches(500 * MS)
        assert off_after_ms([stretch], 10 * MS) == off_ms - 10


def test_current_of_which_no_end_was_heard_is_still_on_until_another_session_begins(tmp_path: Path) -> None:
    with linked(load_session(session_of(tmp_path))) as (sensor, faults, _):
        faults.observe(status(0))
        faults.observe(status(20, on=False, fault="no answer within 100 ms"))
        outputs = entries_of(sensor, 2)
        assert math.isinf(off_after_ms(outputs.stretches(500 * MS), 10 * MS))
        sensor.connect().close()
        outputs.add(sensor.new_entries())
        assert not math.isinf(off_after_ms(outputs.stretches(time.monotonic_ns()), 10 * MS))


def test_an_answer_that_was_lost_on_the_way_is_no_silence(tmp_path: Path) -> None:
    with linked(load_session(session_of(tmp_path))) as (sensor, faults, _):
        faults._told += 1  # one that found the link full
        faults.observe(status(0))
        with pytest.raises(StimulatorLost, match="nobody took in"):
            entries_of(sensor, 10)


# --- only there ------------------------------------------------------------------------------------------


@pytest.mark.requirement("SR-31")
@pytest.mark.parametrize("word", [b"", b"yes", DUMMY_LOAD[:-1], None])
def test_without_the_campaigns_word_no_sensor_is_opened(tmp_path: Path, word: bytes | None) -> None:
    session = load_session(session_of(tmp_path))
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours:
        ours.send(word) if word is not None else ours.close()
        faults = InjectedFaults(theirs.detach())
        with ExitStack() as stack, pytest.raises(Problem, match="--i-have-a-dummy-load"):
            open_sensors(session, stack, faults)


@pytest.mark.requirement("SR-31")
def test_a_campaign_on_real_devices_begins_with_that_word_alone(tmp_path: Path) -> None:
    path = session_of(tmp_path)
    arguments = ["hil", "--hardware", str(path), "--calibration", str(path), "--only", "imu_frozen"]
    refused = CliRunner().invoke(main, [*arguments, "--out", str(tmp_path / "out")])
    assert refused.exit_code == UNUSABLE
    assert "--i-have-a-dummy-load" in refused.output
    assert not (tmp_path / "out").exists()


def test_nobody_is_said_to_walk_with_simulated_sensors(tmp_path: Path) -> None:
    refused = CliRunner().invoke(main, ["hil", "--walking", "--out", str(tmp_path / "out")])
    assert refused.exit_code == UNUSABLE
    assert "--walking is for --hardware" in refused.output


def all_nodes() -> dict[str, list[ast.AST]]:
    """Of every module all that stands in it."""
    found = {}
    for path in (path for package in ("fes", "drivers", "statemachine") for path in (ROOT / package).rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        found[name] = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    return found


def reached(module: str, imported: dict[str, set[str]]) -> set[str]:
    """All modules of this project that it imports, wherever in it, and that those import."""
    found, todo = set[str](), {module}
    while todo:
        name = todo.pop()
        found.add(name)
        todo |= (imported[name] | {name.rpartition(".")[0]}) & imported.keys() - found
    return found


@pytest.mark.requirement("SR-31")
def test_a_session_of_fes_run_reaches_no_fault_by_whatever_it_imports_or_names() -> None:
    imported: dict[str, set[str]] = {}
    naming, handing = set[str](), set[str]()
    for name, nodes in all_nodes().items():
        imported[name] = set()
        for node in nodes:
            if isinstance(node, ast.Import):
                imported[name] |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                imported[name] |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
            elif isinstance(node, ast.Constant) and "import InjectedFaults" in str(node.value):
                naming.add(name)
            elif isinstance(node, ast.Call) and any(keyword.arg == "obj" for keyword in node.keywords):
                handing.add(name)
    for start in ("fes.cli.run.command", "fes.cli.run.supervisor", "drivers.imu.open"):
        assert not reached(start, imported) & {WRAPPER, "fes.hil.sensor_faults"}, start
    assert WRAPPER in reached("fes.hil.sensor_faults", imported)
    assert naming == {"fes.hil.controller"}, "the one program that is started with faults"
    assert not handing, "nobody hands a command of this process an object"


@pytest.mark.requirement("SR-31")
def test_no_option_setting_or_variable_of_a_session_names_a_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = main.get_command(click.Context(main), "run")
    assert run is not None
    assert not [option for each in run.params for option in each.opts if "fault" in option or "dummy" in option]
    assert not any(isinstance(each, click.Option) and each.envvar for each in run.params)
    assert main.context_settings.get("auto_envvar_prefix") is None
    given: list[object] = []
    monkeypatch.setattr("fes.cli.run.command.run_session", lambda path, options, faults: given.append(faults))
    for name in ("FES_FAULTS", "FES_RUN_FAULTS", "FES_HIL", "FAULTS"):
        monkeypatch.setenv(name, "1")
    path = session_of(tmp_path)
    assert CliRunner().invoke(main, ["run", str(path)]).exit_code == 0
    assert given == [None]
    for option in ("--i-have-a-dummy-load", "--faults"):
        assert CliRunner().invoke(main, ["run", str(path), option]).exit_code == UNUSABLE
    assert given == [None]
    text = path.read_text()
    for added in ("[faults]\nsensor = true\n", "[live]\nfaults = true\n", "[hil]\n"):
        path.write_text(f"{text}\n{added}")
        with pytest.raises(ConfigError):
            load_session(path)
    path.write_text(text.replace('device = "xbus"', 'device = "faulted"'))
    with pytest.raises(ConfigError):
        load_session(path)


@pytest.mark.requirement("SR-31")
def test_no_extension_point_leads_to_a_fault() -> None:
    """A part of another package is given settings, never another sensor's port; and none of ours is such a part."""
    ours = {each.value for group in GROUPS.values() for each in entry_points(group=group)}
    assert not [value for value in ours if value.startswith(("drivers.simulated", "fes.hil", WRAPPER))]
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert "simulated" not in project.partition("[project.entry-points")[2].partition("\n[tool")[0]


# --- rows ------------------------------------------------------------------------------------------------


def test_every_sensors_fault_can_be_brought_about_on_real_devices() -> None:
    of_sensors = [s for s in SCENARIOS if s.name.startswith(("imu_", "stamp", "clock", "stale"))]
    assert len(of_sensors) > 40
    for scenario in of_sensors:
        assert on_hardware(scenario) == (scenario.moment is Moment.SWING), scenario.name
    for name in ("commands_flipped", "link_lost", "node_reboot", "axis_reversed", "dose", "view_killed"):
        assert not on_hardware(BY_NAME[name])
    listed = CliRunner().invoke(main, ["hil", "--list"]).output.splitlines()
    assert {line.split()[0] for line in listed if line.endswith("[--hardware]")} == {
        scenario.name for scenario in filter(on_hardware, SCENARIOS)
    }


@pytest.mark.parametrize("name", sorted(s.name for s in SCENARIOS if on_hardware(s) and s.name.startswith("imu_")))
def test_the_orders_of_a_row_are_known_to_the_port(name: str) -> None:
    """With the order's own name and value: nothing of the simulated sensor's is left that the port would refuse."""
    port = FaultedImu(OpenPort(), [DEVICE])

    class Ordered:
        def inject(self, fault: str, value: float = 1.0) -> int:
            port.inject(0, FOOT, fault, value)
            return 0

        def clear(self) -> None:
            port.clear(0, FOOT)

    class Bench:
        value = BY_NAME[name].value(0) or 0.3
        equipment = type("Real", (), {"imu": Ordered(), "sensor_replugged": lambda self: None})()

        def observe(self, seconds: float) -> None:
            pass

    inject, heal = INJECTIONS[name]
    bench = cast(CampaignBench, Bench())
    inject(bench, 0)
    heal(bench)


@pytest.mark.parametrize("device", [*SERIAL, "can"])
def test_a_stimulator_of_every_kind_can_be_judged(tmp_path: Path, device: str) -> None:
    options = {"accept_watchdog_s": 2.0} if device == "p24_mid_level" else {}
    stimulator = StimulatorDevice.model_validate({"device": device, "port": "/dev/x", "options": options})
    assert hardware_session(session_of(tmp_path, stimulator)).stimulator.device == device
    slow = session_of(tmp_path, stimulator, frequency_hz=15.0)
    if device in PULSE_BY_PULSE:
        with pytest.raises(ConfigError, match="counts as an end"):
            hardware_session(slow)
    else:
        hardware_session(slow)


# --- What the fault campaign requires where the sensor's samples come by radio ---


SILENT_MS = limits.RADIO.max_data_age_ms + 50.0


@pytest.mark.parametrize("name", ["imu_silent", "imu_unplugged", "imu_frozen"])
def test_a_sensors_fault_may_last_as_long_as_its_data_may_be_old(name: str) -> None:
    assert BY_NAME[name].deadline_ms < by_radio(BY_NAME[name]).deadline_ms == SILENT_MS


def test_the_lease_is_the_radios() -> None:
    assert by_radio(BY_NAME["controller_killed"]).deadline_ms < BY_NAME["controller_killed"].deadline_ms


def test_a_sample_late_by_less_than_latches_is_no_row_by_radio() -> None:
    assert min(by_radio(BY_NAME["imu_backlog"]).values) > 0.25 > min(BY_NAME["imu_backlog"].values)


def test_what_is_required_stays_but_for_the_time_it_may_take() -> None:
    for row in SCENARIOS:
        changed = by_radio(row)
        assert (changed.name, changed.effect, changed.response) == (row.name, row.effect, row.response)
        assert set(changed.values) <= set(row.values)
        assert changed.values or not row.values
