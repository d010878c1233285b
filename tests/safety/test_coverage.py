"""Every line and branch of the gate is tested by the gate's own tests."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.requirement("SR-04")
def test_the_gates_own_tests_reach_every_line_and_branch_of_it(tmp_path: Path) -> None:
    tests = sorted(str(path) for path in (ROOT / "tests" / "gate").glob("test_*.py"))
    cover = ["--cov=fes.gate", "--cov-branch", "--cov-fail-under=100", "--cov-report=term-missing"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *cover, *tests],
        cwd=ROOT,
        env=os.environ | {"COVERAGE_FILE": str(tmp_path / "coverage"), "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
