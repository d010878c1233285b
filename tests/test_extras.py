"""Without the extras: what goes on all the same, and what says which extra it needs."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from replays import FES

from drivers.simulated.spawn import free_bus, why_silent
from fes.cli.common import EXTRAS, FAILED, OK, UNUSABLE
from fes.simulation import bundled_file

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NO_EXTRAS_OF_USERS = {"build", "dev", "devices"}


def names(requirements: list[str]) -> set[str]:
    return {Requirement(each).name for each in requirements}


# of all of them the package is imported by the name that it is installed by
LIBRARIES = {extra: names(each) for extra, each in PROJECT["optional-dependencies"].items()}
OPTIONAL = {"dask"}.union(*(each for extra, each in LIBRARIES.items() if extra not in NO_EXTRAS_OF_USERS))
# Every Python of the process' family runs it when it starts. What is not found cannot be told from not installed.
SITE = f"""
import sys
from importlib.machinery import PathFinder

class WithoutExtras(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in {OPTIONAL!r} else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = WithoutExtras
"""


def run_without_extras(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    (folder / "site").mkdir()
    (folder / "site" / "sitecustomize.py").write_text(SITE, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(folder / "site"), str(ROOT)))}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=600
    )


WALK = str(bundled_file("both_feet_100hz.parquet"))
SESSION = str(bundled_file("session.toml"))
FROM_ARRAYS = f"""
import fes
track = fes.read({WALK!r}).tracks["left_foot"]
result = fes.analyse(fes.recording(acc=track.acc_mps2, gyr=track.gyr_radps, rate_hz=100.0, sensor="left_foot"))
assert result.strides["valid"].sum() > 10
result.report("walk.html")
"""
ROADS = {
    "help": ([*FES, "--help"], ""),
    "cohort's help": ([*FES, "cohort", "--help"], ""),
    "arrays": ([sys.executable, "-c", FROM_ARRAYS], "walk.html"),
    "analyse": ([*FES, "analyse", WALK], "*.html"),
    "simulate": ([*FES, "simulate", "--seconds", "40"], "simulated.parquet"),
    "a campaign's list": ([*FES, "hil", "--list"], ""),
}


@pytest.mark.parametrize("road", ROADS)
def test_goes_without_extras(road: str, tmp_path: Path) -> None:
    command, result = ROADS[road]
    done = run_without_extras(command, tmp_path)
    assert done.returncode == OK, done.stdout + done.stderr
    assert not result or [*tmp_path.rglob(result)]


@pytest.mark.live
def test_a_session_without_dashboard_goes_without_extras(tmp_path: Path) -> None:
    """Sensor, stimulator, supervisor and controller as processes, judged at the stimulator's end."""
    if why := why_silent(free_bus("loopback")):
        pytest.skip(f"no loopback multicast on this machine: {why}")
    done = run_without_extras([*FES, "hil", "--transport", "loopback", "--only", "imu_frozen"], tmp_path)
    assert done.returncode in (OK, FAILED), done.stdout + done.stderr  # in time or not: it has run
    assert [*tmp_path.rglob("*.feslog")]


NEEDS = [
    ("cohort", "cohort", ["cohort", WALK]),
    ("cohort", "sweep", ["sweep", SESSION, WALK, "--set", "phases.swing_begins=1,2"]),
    ("cohort", "sweep", ["sweep", "--names"]),
    ("live", "run --dashboard", ["run", SESSION, "--dashboard"]),
    ("live", "replay --dashboard", ["replay", WALK, "--dashboard"]),
    ("live", "hil", ["hil", "--only", "page_killed"]),
]


@pytest.mark.parametrize(("extra", "what", "arguments"), NEEDS, ids=[" ".join(each[2][:2]) for each in NEEDS])
def test_says_which_extra_it_needs(extra: str, what: str, arguments: list[str], tmp_path: Path) -> None:
    done = run_without_extras([*FES, *arguments], tmp_path)
    told = f"Error: fes {what} needs the extra {extra}, which is not installed: pip install 'fes-gait[{extra}]'\n"
    assert (done.returncode, done.stdout, done.stderr) == (UNUSABLE, "", told)
    assert [each.name for each in tmp_path.iterdir()] == ["site"]


def test_each_extra_brings_what_its_commands_import() -> None:
    for extra, libraries in EXTRAS.items():
        assert set(libraries) == LIBRARIES[extra]
    assert not names(PROJECT["dependencies"]) & OPTIONAL
