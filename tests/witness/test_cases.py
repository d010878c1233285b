"""Inputs after public bug reports: what a user gives in, and that terminal, JSON, report and Python say the same of it.

The inputs of ``../shared/cases`` are made where that folder is; the same kinds are made from a bundled walk elsewhere
(``test_witness.py``).
"""

from __future__ import annotations

import html
import json
import re
import runpy
from pathlib import Path

import pytest
from click.testing import CliRunner

import fes
from fes.cli import main

SCRIPT = Path(__file__).resolve().parents[2].parent / "shared" / "cases" / "make_cases.py"
pytestmark = [
    pytest.mark.data,
    pytest.mark.slow,
    pytest.mark.skipif(not SCRIPT.is_file(), reason="the script that makes the inputs is not beside the project"),
]
# of each input that can be analysed: the code that must be found, if any
CODES = {
    "clean": "",
    "lag_20ms": "lag",
    "gyro_gain_0.9": "gyr_gain",
    "left_handed": "axes",
    "rollover_1024": "",
    "arrival_bursts": "",
    "frozen_0.6s": "frozen",
    "dead_band_1dps": "dead_band",
    "gyro_bias_step": "gyr_bias",
    "gyro_sign_flip": "axes",
}
REFUSED = {"gravity_removed": "gravity was subtracted", "acceleration_only": "no gyroscope"}
PROPOSED = {"rollover_1024": "time_wraps_at = 1024", "arrival_bursts": "packets of 15"}
TRUE_M = 1.31  # the mean stride length of the walk as it was


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cases")
    runpy.run_path(str(SCRIPT))["main"](folder)
    return folder


def run(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(main, ["analyse", *arguments])
    return done.exit_code, done.output


def plain(text: str) -> str:
    return re.sub(r"\s+", " ", text)


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_used_says_why_and_asks_nothing(cases: Path, name: str) -> None:
    code, said = run(str(cases / f"{name}.csv"))
    assert code != 0
    assert REFUSED[name] in said
    assert "?" not in said
    assert not (cases / f"{name}.toml").exists()


@pytest.mark.parametrize("name", CODES)
def test_all_four_say_the_same(cases: Path, tmp_path: Path, name: str) -> None:
    path, out = cases / f"{name}.csv", str(tmp_path)
    _, proposal = run(str(path), "--out", out)
    assert PROPOSED.get(name, "") in proposal
    sidecar = path.with_suffix(".toml")
    sidecar.write_text(sidecar.read_text(encoding="utf-8").replace('"?"', "left_foot"), encoding="utf-8")
    strict, terminal = run(str(path), "--out", out, "--strict")
    _, printed = run(str(path), "--out", out, "--json")
    told = json.loads(printed[printed.index("{") :])
    page = html.unescape(re.sub(r"<[^>]+>", "", Path(told["files"]["folder"], "report.html").read_text("utf-8")))
    texts = [finding["text"] for finding in told["findings"]]
    assert [finding.text for finding in fes.analyse(path).findings] == texts
    for text in [*texts, told["verdict"]]:
        assert plain(text) in plain(page)
        assert plain(text).replace(" ", "") in plain(terminal).replace(" ", "")
    bad = any(finding["level"] in ("warning", "alert") for finding in told["findings"])
    assert strict == (1 if bad else 0)
    codes = {finding["code"] for finding in told["findings"]}
    assert CODES[name] in codes or not CODES[name]
    lies = {"lag", "gyr_gain", "axes", "gyr_bias", "acc_scale", "frozen"}
    assert codes & lies == ({CODES[name]} & lies)
    if CODES[name] in lies:
        assert "No fault found" not in told["verdict"]
        _, printed = run(str(path), "--out", out, "--json", "--correct")
        mended = json.loads(printed[printed.index("{") :])
        length = mended["feet"]["left_foot"]["stride_length_m"]["mean"]
        assert length == pytest.approx(TRUE_M, rel=0.02)
