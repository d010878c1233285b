"""What programs read and people type: JSON from every command, near names, the commands of docs/first_hour.md."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from first_hour import ROOT, commands

from fes.cli.common import error_text, write_table
from fes.cli.main import main
from fes.config.base import read_toml
from fes.recording import SidecarMissingError
from fes.report.page import render_report
from fes.walk_record import WalkRecord

WALK = ROOT / "sim_inputs" / "both_feet_100hz.parquet"


def test_lists_are_json_too() -> None:
    found = json.loads(CliRunner().invoke(main, ["import", "list", "--json"]).stdout)["data_sets"]
    assert found["xio"]["licence"]
    faults = json.loads(CliRunner().invoke(main, ["hil", "--list", "--json"]).stdout)["faults"]
    assert len(faults) > 5
    assert all(fault["required"] for fault in faults.values())


@pytest.mark.parametrize("command", ["cohort", "sweep", "hil", "report", "import", "analyse", "doctor", "evaluate"])
def test_every_command_with_results_has_json(command: str) -> None:
    assert "--json" in CliRunner().invoke(main, [command, "--help"]).output


def test_a_cohort_says_what_it_made_as_json(tmp_path: Path) -> None:
    args = ["cohort", str(WALK), "--out", str(tmp_path / "c"), "--workers", "1", "--no-report", "--json"]
    found = json.loads(CliRunner().invoke(main, args).stdout)
    assert (found["recordings"], found["analysed"], found["report"], found["not_used"]) == (1, 1, None, [])
    assert found["valid_strides"] > 80


def test_near_names_are_suggested() -> None:
    told = CliRunner().invoke(main, ["analyze", "x.csv"])
    assert told.exit_code == 2
    assert "Did you mean 'analyse'?" in told.output


@pytest.mark.parametrize(("environment", "coloured"), [({"NO_COLOR": "1"}, False), ({"NO_COLOR": ""}, True)])
def test_doctor_keeps_to_no_color(environment: dict[str, str], coloured: bool) -> None:
    told = CliRunner().invoke(main, ["doctor"], env=environment, color=True)
    assert ("\x1b[" in told.output) is coloured


def test_analyse_writes_truths_as_convert_does(tmp_path: Path) -> None:
    write_table([{"valid": True, "x": float("inf"), "n": 3}, {"valid": False, "x": 0.5, "n": 4}], tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text() == "valid,x,n\ntrue,,3\nfalse,0.5,4\n"


def test_a_report_of_an_analysis_has_no_sections_of_stimulation() -> None:
    html = render_report(WalkRecord(header={"kind": "analysis"}))
    assert 'id="table"' in html
    assert 'id="stimulation"' not in html
    assert 'id="latency"' not in html
    assert "#latency" not in html


def test_comments_are_no_questions(tmp_path: Path) -> None:
    proposal = "#   a ?\n# ? put the names\nrate_hz = 0  # ? samples per second\n"
    told = error_text(SidecarMissingError("missing", tmp_path / "w.toml", proposal))
    assert "One answer is missing: the “?” in line 3 of" in told


def test_a_decimal_comma_in_a_sidecar_is_named(tmp_path: Path) -> None:
    (tmp_path / "w.toml").write_text('name = "a"\nbelt_speed_mps = 0,8  # m/s\n')
    with pytest.raises(ValueError, match=r"not valid TOML: .*Decimals have a point: write 0\.8"):
        read_toml(tmp_path / "w.toml", "sidecar", ValueError)


def test_the_commands_of_one_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command of docs/first_hour.md that needs one terminal runs as it stands there, in its order."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sim_inputs").symlink_to(ROOT / "sim_inputs")
    found = commands("sh")
    assert len(found) >= 6
    for command in found:
        result = CliRunner().invoke(main, command[1:])
        assert result.exit_code == 0, f"{' '.join(command)}\n{result.output}"
    for name in ("closed_loop-001/report.html", "negard_patient2-001/report.html", "timing.toml", "timing.xml"):
        assert (tmp_path / "hour" / name).is_file()
