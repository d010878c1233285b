"""Evidence says when it was changed; the page is made of evidence alone; the command refuses what it must."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from fes.cli.main import main
from fes.cli.qualify import SIMULATED, _is_virtual
from fes.qualify.evidence import NONE_REAL, EvidenceRefused, hardware_page, load_evidence, sealed
from fes.qualify.simulated import SENSORS, STIMULATORS

ROOT = Path(__file__).resolve().parents[2]
EVIDENCE = ROOT / "docs" / "evidence"
KEY = b"of this laboratory alone"


def fes(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["qualify", *arguments])


def kept(name: str = "p24_low_level") -> dict[str, Any]:
    path = next(EVIDENCE.glob(f"{name}-*.json"))
    return dict(json.loads(path.read_text(encoding="utf-8")))


def body(data: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in data.items() if name not in ("digest", "signature", "format")}


def write(folder: Path, data: dict[str, Any]) -> Path:
    path = folder / "device.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


def test_the_page_is_that_of_the_evidence() -> None:
    assert (ROOT / "docs" / "hardware.md").read_text(encoding="utf-8") == hardware_page(EVIDENCE)


def test_every_simulated_kind_has_evidence_and_no_real_device_has() -> None:
    records = [load_evidence(path) for path in EVIDENCE.glob("*.json")]
    assert {each["settings"]["device"] for each in records} == {*SENSORS, *STIMULATORS} == set(SIMULATED)
    assert all(each["simulated"] for each in records) == (NONE_REAL in hardware_page(EVIDENCE))


def leaves(value: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = [leaf for key, each in inner for leaf in leaves(each, (*place, key))]
    return found or [place]


def test_a_change_of_anything_is_found(tmp_path: Path) -> None:
    data = kept()
    assert load_evidence(write(tmp_path, data)) == data
    places = leaves(data)
    assert len(places) > 40
    for place in places:
        changed = json.loads(json.dumps(data))
        inner = changed
        for key in place[:-1]:
            inner = inner[key]
        value = inner[place[-1]]
        inner[place[-1]] = (
            not value if isinstance(value, bool) else value + 1 if isinstance(value, int | float) else "x"
        )
        with pytest.raises(EvidenceRefused, match=r"device\.json"):
            load_evidence(write(tmp_path, changed))


def test_a_new_digest_does_not_deceive_who_has_the_key(tmp_path: Path) -> None:
    data = sealed(body(kept()), KEY)
    assert load_evidence(write(tmp_path, data), KEY) == data
    forged = sealed({**body(data), "by": "somebody else"})
    forged["signature"] = data["signature"]
    assert load_evidence(write(tmp_path, forged))["by"] == "somebody else"
    with pytest.raises(EvidenceRefused, match="signature does not hold"):
        load_evidence(write(tmp_path, forged), KEY)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"format": 1, "digest": "0"}', '{"format": 9, "digest": "0"}', "\0"])
def test_what_is_no_evidence_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text, encoding="utf-8")
    done = fes("--page", str(tmp_path))
    assert done.exit_code == 2
    assert "a.json" in done.output


def test_the_page_tells_real_from_simulated(tmp_path: Path) -> None:
    write(tmp_path, sealed({**body(kept()), "simulated": False, "by": "A | <b>"}))
    page = hardware_page(tmp_path)
    real, _, simulated = page.partition("## Simulated devices")
    assert NONE_REAL not in page
    assert "A \\| &lt;b>" in real
    assert "None." in simulated


def test_a_deviation_stands_in_the_page_and_in_the_exit_code(tmp_path: Path) -> None:
    data = body(kept())
    data["figures"] = {**data["figures"], "off_after_ms": 300.0}
    write(tmp_path, sealed(data))
    assert "pulses for 300 ms after it" in hardware_page(tmp_path)


def test_a_whole_run_on_a_simulated_stimulator(tmp_path: Path) -> None:
    done = fes("--simulated", "p24_low_level", "--out", str(tmp_path))
    assert done.exit_code == 0, done.output
    assert "Nothing deviates." in done.output
    (path,) = tmp_path.glob("*.json")
    record = load_evidence(path)
    assert record["simulated"]
    assert record["figures"] == kept()["figures"]  # the same each time: its clock is the device's
    assert fes("--simulated", "p24_low_level", "--out", str(tmp_path)).exit_code == 0
    assert len(list(tmp_path.glob("*.json"))) == 2  # none is written over


@pytest.mark.requirement("SR-01")
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "name one of"),
        (["--simulated", "xbus", "--page", "."], "name one of"),
        (["--simulated", "toaster"], "toaster"),
        (["--page", "nowhere"], "no such folder"),
        (["nowhere.toml", "--device", "stimulator", "--by", "me"], "nowhere.toml"),
        (["SESSION", "--device", "stimulator"], "--by"),
        (["SESSION", "--device", "left_ear", "--by", "me"], "right_foot"),
        (["SESSION", "--device", "stimulator", "--by", "me"], "--i-have-a-dummy-load"),
        (
            ["SESSION", "--device", "stimulator", "--by", "me", "--i-have-a-dummy-load", "--channel", "7"],
            "no channel 7",
        ),
        (["--simulated", "can", "--key", "nowhere"], "nowhere"),
        (["WEAK", "--device", "stimulator", "--by", "me", "--i-have-a-dummy-load"], "max_current_ma = 20"),
    ],
)
def test_what_cannot_be_done_is_said_and_nothing_is_opened(
    tmp_path: Path, arguments: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def opened(*_: Any) -> None:
        raise AssertionError("something was opened")

    monkeypatch.setattr("drivers.stimulator.open.open_session", opened)
    monkeypatch.setattr("drivers.imu.open.open_imus", opened)
    session = tmp_path / "session.toml"
    session.write_text(SESSION, encoding="utf-8")
    weak = tmp_path / "weak.toml"
    weak.write_text(SESSION.replace("max_current_ma = 30.0", "max_current_ma = 15.0"), encoding="utf-8")
    files = {"SESSION": str(session), "WEAK": str(weak)}
    done = fes(*[files.get(each, each) for each in arguments], "--out", str(tmp_path))
    assert done.exit_code == 2, done.output
    assert said in done.output


SESSION = """
name = "s"

[[sensors]]
sensor = "right_foot"
device = "xbus"
port = "/dev/ttyUSB9"
rate_hz = 100
acc_range_g = 16
gyr_range_dps = 2000

[[channels]]
name = "load"
number = 0
foot = "right_foot"
electrode_area_cm2 = 25.0
current_ma = 10.0
pulse_width_us = 200.0
frequency_hz = 25.0

[channels.limits]
max_current_ma = 30.0
max_pulse_width_us = 400.0
max_frequency_hz = 50.0
max_charge_per_phase_uc = 10.0
max_charge_per_minute_mc = 20.0
max_current_density_ma_per_cm2 = 1.0
max_rise_ma_per_s = 400.0
max_on_s = 3.0
min_off_s = 0.1
"""


@pytest.mark.parametrize(
    ("settings", "virtual"),
    [
        ({"port": "/dev/pts/3"}, True),
        ({"port": "socket://127.0.0.1:5000"}, True),
        ({"port": "/dev/ttyUSB0"}, False),
        ({"port": "socket://192.168.1.4:5000"}, False),
        ({"port": "bus", "bus": {"interface": "udp_multicast", "channel": "239.74.163.2"}}, True),
        ({"port": "", "bus": {"interface": "socketcan", "channel": "vcan0"}}, True),
        ({"port": "", "bus": {"interface": "socketcan", "channel": "can0"}}, False),
    ],
)
def test_a_line_that_no_device_can_be_on_is_known(settings: dict[str, Any], virtual: bool) -> None:
    assert _is_virtual(settings) is virtual
