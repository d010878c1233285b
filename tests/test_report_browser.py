"""The report in a real browser: the script runs without complaint and the plots are drawn."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import report_records as make

from fes.journal import SessionRecord
from fes.view.report import write_report

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")


def opened(path: Path, profile: Path) -> tuple[str, str]:
    """The page after its script has run, and what the browser logged."""
    command = [
        str(CHROMIUM),
        *("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-dev-shm-usage"),
        *(f"--user-data-dir={profile}", "--window-size=1280,2000", "--virtual-time-budget=2000"),
        *("--enable-logging=stderr", "--dump-dom", path.as_uri()),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return done.stdout, "\n".join(line for line in done.stderr.splitlines() if "CONSOLE" in line)


def test_plots_are_drawn_and_the_console_is_silent(tmp_path):
    record = make.walk(6, rate_hz=500.0)
    record.samples["left_foot"].acc_mps2[200:260] = np.nan
    write_report(record, tmp_path / "report.html")
    page, console = opened(tmp_path / "report.html", tmp_path / "profile")
    assert console == ""
    assert 'data-drawn="6"' in page  # two feet with two signals each, the current, and the whole session
    assert page.count("<canvas") == 6
    selected = re.search(r'class="chart overview".*?u-select" style="[^"]*width: ([\d.]+)px', page, re.S)
    assert selected
    assert float(selected.group(1)) > 100


def test_a_session_without_anything_is_no_error_in_the_browser(tmp_path):
    write_report(SessionRecord({}), tmp_path / "report.html")
    page, console = opened(tmp_path / "report.html", tmp_path / "profile")
    assert console == ""
    assert 'data-drawn="0"' in page
