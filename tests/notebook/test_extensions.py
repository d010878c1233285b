"""A package of its own extends the program by entry points; what is wrong with one is said by its name."""

from __future__ import annotations

import json
import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import fes
from drivers.imu.open import open_imus
from drivers.imu.port import ImuLost
from drivers.stimulator.open import open_session
from drivers.stimulator.port import StimulatorLost
from fes.cli.main import main
from fes.config import ConfigError, validate_session
from fes.extensions import GROUPS, ExtensionError, extension_names, load_extension
from fes.signals import G_MPS2, StimAlive, StimCommand

PAGE = Path(__file__).resolve().parents[2] / "docs" / "extensions.md"
PACKAGE = Path(__file__).resolve().parents[1] / "extension_package"


def install(folder: Path, name: str, points: dict[str, dict[str, str]]) -> Path:
    """What an installer leaves beside a package: its name and its entry points."""
    info = folder / f"{name.replace('-', '_')}-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
    lines = [line for group, own in points.items() for line in (f"[{group}]", *(f"{k} = {v}" for k, v in own.items()))]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture
def installed(tmp_path, monkeypatch):
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    monkeypatch.syspath_prepend(str(install(tmp_path / "site", project["name"], project["entry-points"])))
    monkeypatch.syspath_prepend(str(PACKAGE))
    yield project["entry-points"]
    for name in [name for name in sys.modules if name.partition(".")[0] == "gaitlab"]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def walk():
    return fes.read(fes.bundled_file("both_feet_100hz.parquet"))


def session(**settings: object) -> dict[str, object]:
    sensor = {"sensor": "left_foot", "rate_hz": 100.0, "acc_range_g": 16.0, "gyr_range_dps": 2000.0}
    return {"name": "extended", "sensors": [{**sensor, "device": "gaitlab_lines", **settings}]}


def test_the_example_brings_one_of_every_kind(installed):
    assert set(installed) == set(GROUPS.values())
    for kind, group in GROUPS.items():
        assert set(installed[group]) <= set(extension_names(kind))
        for name in installed[group]:
            assert load_extension(kind, name) is not None


def test_nothing_of_it_is_imported_before_it_is_named(installed, walk):
    fes.analyse(walk)
    assert not {name for name in sys.modules if name.partition(".")[0] == "gaitlab"}


def test_a_sensor_is_opened_by_its_name_in_the_settings(installed, tmp_path):
    lines = tmp_path / "sensor.txt"
    lines.write_text("10000,0,0,1,0,0,90\nnoise\n20000,0,0,1,0,0,-90\n40000,0,0,1")
    settings = validate_session(session(port=f"lines://{lines}"), Path("session.toml"))
    (port,) = open_imus(settings.sensors)
    samples = port.read(5)
    assert [sample.t_device_ns for sample in samples] == [10_000_000, 20_000_000]
    assert samples[0].acc_mps2 == (0.0, 0.0, G_MPS2)
    assert samples[1].gyr_radps[2] == pytest.approx(-np.pi / 2)
    assert port.counts["left_foot"].bad_frames == 1
    port.close()
    port.close()
    with pytest.raises(ImuLost, match="switched on"):
        open_imus(validate_session(session(port="lines:///nowhere/at/all"), Path("s.toml")).sensors)
    with pytest.raises(ValueError, match="must begin with lines://"):
        open_imus(validate_session(session(port="/dev/ttyUSB0"), Path("s.toml")).sensors)


def test_an_unknown_device_is_refused_with_those_that_are_there(installed):
    with pytest.raises(
        ConfigError, match=r"sensors\[0\].device = 'gaitlab_line': .*'xbus'.*'movella_dot' or 'gaitlab_lines'"
    ):
        validate_session(session(device="gaitlab_line"), Path("session.toml"))
    with pytest.raises(ConfigError, match=r"stimulator.device = 'bench': .*'can'.* or 'gaitlab_bench'"):
        validate_session({"name": "x", "stimulator": {"device": "bench", "port": "p"}}, Path("session.toml"))


def test_without_the_package_its_devices_are_unknown():
    with pytest.raises(ConfigError, match=r"'capture2go_ble' or 'movella_dot'$"):
        validate_session(session(), Path("session.toml"))


def test_a_stimulator_takes_commands_and_answers(installed, tmp_path):
    path = tmp_path / "delivered.txt"
    stimulator = {"device": "gaitlab_bench", "port": f"bench://{path}"}
    settings = validate_session({"name": "x", "stimulator": stimulator}, Path("session.toml"))
    port, identifier, handshake = open_session(settings.stimulator, settings, 7)
    assert port.session_id == identifier
    assert handshake.alive == (StimAlive(7, 1, 0),)
    on = StimCommand(10, 1, True, 20.0, 250.0, 40.0, 100)
    off = StimCommand(20, 1, False, 0.0, 0.0, 0.0, 100)
    assert port.send(on).data == b"1 on 20 250 40 100\n"
    port.send(off)
    assert port.outstanding == 2
    assert [(each.on, each.current_ma) for each in port.poll(30)] == [(True, 20.0), (False, 0.0)]
    assert port.outstanding == 0
    port.close()
    port.close()
    assert path.read_text() == "1 on 20 250 40 100\n1 off\n"
    with pytest.raises(StimulatorLost):
        port.send(on)
    wrong = settings.stimulator.model_copy(update={"options": {"speed": 3}})
    with pytest.raises(ConfigError, match="this device has none"):
        open_session(wrong, settings, 7)


def test_what_is_no_device_is_refused_before_anything_is_sent(tmp_path, monkeypatch):
    points = {"fes.stimulators": {"odd": "fractions:Fraction.from_float"}, "fes.sensors": {"odd": "builtins:repr"}}
    monkeypatch.syspath_prepend(str(install(tmp_path, "odd", points)))
    settings = validate_session({"name": "x", "stimulator": {"device": "odd", "port": "p"}}, Path("s.toml"))
    monkeypatch.setattr("fractions.Fraction.from_float", lambda *_: 1.0)
    with pytest.raises(ConfigError, match=r"'odd' is no stimulator: it lacks open, send, poll, close"):
        open_session(settings.stimulator, settings, 7)
    with pytest.raises(ExtensionError, match="'odd' is no ImuPort but str"):
        open_imus(validate_session(session(device="odd", port="p"), Path("s.toml")).sensors)


def test_a_detector_tells_the_events_of_an_analysis(installed, walk):
    own, other = fes.analyse(walk), fes.analyse(walk, detector="gaitlab_threshold")
    find = load_extension("detector", "gaitlab_threshold")
    for foot in ("left_foot", "right_foot"):
        track = walk.tracks[foot]
        expected = find(track, None)
        mine = other.events["foot"] == foot
        begin_s = 1e-9 * track.t_sensor_ns[0]
        np.testing.assert_allclose(other.events["t_foot_off_s"][mine] - begin_s, expected["FO"], atol=1e-6)
        np.testing.assert_allclose(other.events["t_initial_contact_s"][mine] - begin_s, expected["IC"], atol=1e-6)
    np.testing.assert_array_equal(own.strides["stride_length_m"], other.strides["stride_length_m"])
    swings = [each.parameters.table["swing_s"].mean() for each in (own, other)]
    assert swings[1] - swings[0] > 0.05  # it takes foot off earlier


def test_the_page_s_functions_need_no_package():
    (block,) = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(block, str(PAGE), "exec"), names)
    own = names["own"]
    assert set(own.events_causal["rule"]) == {"when_it_turns"}
    for event, column in (("FO", "t_foot_off_s"), ("IC", "t_initial_contact_s")):
        said_s = own.events_causal["t_known_s"][own.events_causal["event"] == event]
        # the detector's event is the last sample before the change, the rule's the first one after it
        near_s = np.abs(said_s[:, None] - np.asarray(own.events[column])[None, :]).min(axis=0)
        assert near_s.max() <= 0.011
    assert fes.analyse(names["walk"]).events_causal is None


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        ("mine", "event rule must be a function, is str"),
        (lambda calibration: "FO", "must give a function, gave str"),
        (lambda calibration: lambda t_s, acc, gyr: "TO", "must say 'FO', 'IC' or None, said 'TO'"),
        (lambda calibration: lambda t_s, acc, gyr: 1 / 0, "failed: ZeroDivisionError"),
    ],
)
def test_what_an_event_rule_gives_is_checked(walk, rule, said):
    with pytest.raises(ExtensionError, match=said):
        fes.analyse(walk, event_rule=rule)


def test_a_stride_method_tells_the_lengths(installed, walk):
    own, other = fes.analyse(walk), fes.analyse(walk, stride_method="gaitlab_pendulum")
    valid = other.strides["valid"]
    measure = load_extension("stride method", "gaitlab_pendulum")
    for foot in ("left_foot", "right_foot"):
        mine = valid & (other.strides["foot"] == foot)
        times_s = other.strides["t_start_s"][mine], other.strides["t_end_s"][mine]
        begin_s = 1e-9 * walk.tracks[foot].t_sensor_ns[0]
        expected = measure(walk.tracks[foot], None, *(t_s - begin_s for t_s in times_s))
        np.testing.assert_allclose(other.strides["stride_length_m"][mine], expected, rtol=1e-6)
        np.testing.assert_allclose(other.strides["speed_mps"][mine], expected / (times_s[1] - times_s[0]), rtol=1e-6)
    assert len(own.strides) == len(other.strides)
    assert not np.allclose(own.strides["stride_length_m"][valid], other.strides["stride_length_m"][valid], atol=0.01)


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda track, calibration: {"IC": [1.0]}, "a mapping with FO and IC"),
        (lambda track, calibration: {"IC": [1.0], "FO": [1e6]}, "FO must lie within the recording"),
        (lambda track, calibration: {"IC": ["late"], "FO": [1.0]}, "IC must be times in s"),
        (lambda track, calibration: 1 / 0, "'gaitlab_threshold' failed: ZeroDivisionError"),
    ],
)
def test_what_a_detector_gives_is_checked(installed, walk, monkeypatch, function, said):
    monkeypatch.setattr(
        sys.modules.get("gaitlab.detector") or __import__("gaitlab.detector").detector, "threshold_swings", function
    )
    with pytest.raises(ExtensionError, match=said):
        fes.analyse(walk, detector="gaitlab_threshold")


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda track, calibration, start_s, end_s: np.ones(3), r"lengths in m .* their shape is \(3,\)"),
        (lambda track, calibration, start_s, end_s: -np.ones(len(start_s)), "none below 0"),
    ],
)
def test_what_a_stride_method_gives_is_checked(installed, walk, monkeypatch, function, said):
    monkeypatch.setattr("gaitlab.stride_method.arc_length", function)
    with pytest.raises(ExtensionError, match=said):
        fes.analyse(walk, stride_method="gaitlab_pendulum")


def test_a_stride_without_a_length_is_not_valid(installed, walk, monkeypatch):
    def first_unknown(track, calibration, start_s, end_s):
        return np.where(np.arange(len(start_s)) == 0, np.nan, 1.0)

    monkeypatch.setattr("gaitlab.stride_method.arc_length", first_unknown)
    own, found = fes.analyse(walk), fes.analyse(walk, stride_method="gaitlab_pendulum")
    assert own.strides["valid"].sum() - found.strides["valid"].sum() == 2
    assert sum(row["reason"] == "the stride method gave no length" for row in found.strides) == 2


def test_an_importer_is_listed_and_used(installed, walk, tmp_path):
    track = walk.tracks["left_foot"]
    rows = np.column_stack((track.acc_mps2 / G_MPS2, np.degrees(track.gyr_radps)))
    lab = tmp_path / "walk.lab"
    lab.write_text("gaitlab;100\n" + "\n".join(";".join(f"{v:.6f}" for v in row) for row in rows) + "\n")
    listed = CliRunner().invoke(main, ["import", "list", "--json"])
    assert json.loads(listed.stdout)["data_sets"]["gaitlab"]["licence"] == "ours"
    done = CliRunner().invoke(
        main, ["import", "gaitlab", str(tmp_path), "--foot", "left", "--out", str(tmp_path / "out")]
    )
    assert done.exit_code == 0, done.output
    again = fes.read(tmp_path / "out" / "walk.parquet")
    np.testing.assert_allclose(again.tracks["left_foot"].acc_mps2, track.acc_mps2, atol=1e-4)
    lab.write_text("other;100\n")
    refused = CliRunner().invoke(main, ["import", "gaitlab", str(lab), "--out", str(tmp_path / "out")])
    assert refused.exit_code == 2
    assert "does not begin with gaitlab" in refused.output


def test_a_part_that_is_not_there_or_broken_is_named(installed, walk, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"brings a detector 'mine'; there are: gaitlab_threshold"):
        fes.analyse(walk, detector="mine")
    points = {"fes.detectors": {"broken": "no_such_module:find", "gaitlab_threshold": "fractions:Fraction"}}
    monkeypatch.syspath_prepend(str(install(tmp_path / "second", "second-lab", points)))
    with pytest.raises(ExtensionError, match=r"'broken' of second-lab cannot be imported: ModuleNotFoundError"):
        load_extension("detector", "broken")
    with pytest.raises(ExtensionError, match=r"several packages .*: gaitlab-fes, second-lab"):
        load_extension("detector", "gaitlab_threshold")
