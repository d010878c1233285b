"""Every command of docs/first_hour.md that needs one terminal runs as it stands there, in its order."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner
from first_hour import ROOT, commands

from fes.cli.main import main


def test_the_commands_of_one_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sim_inputs").symlink_to(ROOT / "sim_inputs")
    found = commands("sh")
    assert len(found) >= 6
    for command in found:
        result = CliRunner().invoke(main, command[1:])
        assert result.exit_code == 0, f"{' '.join(command)}\n{result.output}"
    for name in ("closed_loop-001/report.html", "negard_patient2-001/report.html", "timing.toml", "timing.xml"):
        assert (tmp_path / "hour" / name).is_file()
