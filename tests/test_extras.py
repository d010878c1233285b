"""Without the extras: what goes on all the same, and what says which extra it needs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import tomllib
from contextlib import ExitStack
from pathlib import Path

import pytest
from live_runs import EVERY, Bench, capture2go_and_p24, live_run, prepare
from packaging.requirements import Requirement
from replays import FES

from drivers.simulated.spawn import free_bus, why_silent
from fes.cli.common import EXTRAS, FAILED, OK, UNUSABLE
from fes.session_log import SessionWriter, read_session
from fes.simulation import bundled_file

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NO_EXTRAS_OF_USERS = {"build", "dev", "devices"}


def names(requirements: list[str]) -> set[str]:
    return {Requirement(each).name for each in requirements}


def libraries(extra: str) -> set[str]:
    """What an extra brings, with what the extras bring that it is made of."""
    found = [Requirement(each) for each in PROJECT["optional-dependencies"][extra]]
    parts = [libraries(part) for each in found for part in each.extras if each.name == PROJECT["name"]]
    return {each.name for each in found if each.name != PROJECT["name"]}.union(*parts)


# of all of them the package is imported by the name that it is installed by
LIBRARIES = {extra: libraries(extra) for extra in PROJECT["optional-dependencies"]}
OPTIONAL = {"dask", "llvmlite"}.union(*(each for extra, each in LIBRARIES.items() if extra not in NO_EXTRAS_OF_USERS))
ALL_BUT_ANALYSIS = OPTIONAL - LIBRARIES["analysis"] - {"llvmlite"}
# Every Python of the process' family runs it when it starts. What is not found cannot be told from not installed.
SITE = """
import sys
from importlib.machinery import PathFinder

class WithoutExtras(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in {!r} else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = WithoutExtras
"""


def without(missing: set[str], folder: Path) -> str:
    """The PYTHONPATH with which these cannot be imported."""
    (folder / "site").mkdir()
    (folder / "site" / "sitecustomize.py").write_text(SITE.format(missing), encoding="utf-8")
    return os.pathsep.join((str(folder / "site"), str(ROOT)))


def run_without(missing: set[str], command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": without(missing, folder)}
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
    "arrays": ([sys.executable, "-c", FROM_ARRAYS], "walk.html"),
    "analyse": ([*FES, "analyse", WALK], "*.html"),
    "simulate": ([*FES, "simulate", "--seconds", "40"], "simulated.parquet"),
}


@pytest.mark.parametrize("road", ROADS)
def test_goes_with_analysis_alone(road: str, tmp_path: Path) -> None:
    command, result = ROADS[road]
    done = run_without(ALL_BUT_ANALYSIS, command, tmp_path)
    assert done.returncode == OK, done.stdout + done.stderr
    assert [*tmp_path.rglob(result)]


@pytest.mark.parametrize("words", ["--help", "cohort --help", "analyse --help", "hil --list", "devices", "run --help"])
def test_goes_without_extras(words: str, tmp_path: Path) -> None:
    done = run_without(OPTIONAL, [*FES, *words.split()], tmp_path)
    assert done.returncode == OK, done.stdout + done.stderr


def test_the_doctor_says_that_nothing_is_compiled(tmp_path: Path) -> None:
    done = run_without(OPTIONAL, [*FES, "doctor", "--json"], tmp_path)
    (found,) = (each for each in json.loads(done.stdout)["findings"] if each["name"] == "compiled code")
    assert (found["verdict"], found["remedy"]) == ("warning", "pip install 'fes-gait[fast]'")
    assert "numba is not installed" in found["said"]


@pytest.mark.live
def test_a_whole_session_goes_without_extras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The devices are in processes of their own, which have all extras; the session and its processes have none."""
    recording, calibration = prepare(tmp_path, EVERY)

    def devices_first(folder: Path, recording: Path, stack: ExitStack) -> Bench:
        connected = capture2go_and_p24(folder, recording, stack)
        monkeypatch.setenv("PYTHONPATH", without(OPTIONAL, tmp_path))
        return connected

    with live_run(tmp_path, recording, "--calibration", calibration, "--report", bench=devices_first) as run:
        run.until(lambda status: run.current_ma() > 0.0, run.operated)
        time.sleep(3.0)
        said = run.quit()
        assert run.process.returncode == OK, said
        assert not {each.partition(".")[0] for each in run.loaded()} & OPTIONAL
        record, report = read_session(run.log), run.log.with_name("report.html")
    assert record.summary["ended"] == "complete"
    assert any(command.on for command in record.commands)
    assert any(stride.valid for stride in record.strides)
    assert any("numba is not installed" in note.text for note in record.notes)
    assert "numba is not installed" in said
    assert report.is_file()


@pytest.mark.live
def test_a_session_without_dashboard_goes_with_analysis_alone(tmp_path: Path) -> None:
    """Sensor, stimulator, supervisor and controller as processes, judged at the stimulator's end."""
    if why := why_silent(free_bus("loopback")):
        pytest.skip(f"no loopback multicast on this machine: {why}")
    done = run_without(ALL_BUT_ANALYSIS, [*FES, "hil", "--transport", "loopback", "--only", "imu_frozen"], tmp_path)
    assert done.returncode in (OK, FAILED), done.stdout + done.stderr  # in time or not: it has run
    assert [*tmp_path.rglob("*.feslog")]


NEEDS = [
    ("analysis", "demo", ["demo"]),
    ("analysis", "analyse", ["analyse", WALK]),
    ("analysis", "simulate", ["simulate", "--live"]),
    ("analysis", "trials", ["trials", "here"]),
    ("analysis", "timing", ["timing", "check", WALK]),
    ("analysis", "replay", ["replay", WALK]),
    ("analysis", "hil", ["hil", "--only", "imu_frozen"]),
    ("fast", "compile", ["compile"]),
    ("cohort", "cohort", ["cohort", WALK]),
    ("cohort", "sweep", ["sweep", SESSION, WALK, "--set", "phases.swing_begins=1,2"]),
    ("cohort", "sweep", ["sweep", "--names"]),
    ("live", "run --dashboard", ["run", SESSION, "--dashboard"]),
    ("live", "replay --dashboard", ["replay", WALK, "--dashboard"]),
    ("live", "hil", ["hil", "--only", "page_killed"]),
]


@pytest.mark.parametrize(("extra", "what", "arguments"), NEEDS, ids=[" ".join(each[2][:2]) for each in NEEDS])
def test_says_which_extra_it_needs(extra: str, what: str, arguments: list[str], tmp_path: Path) -> None:
    missing = ALL_BUT_ANALYSIS if extra == "live" else OPTIONAL
    done = run_without(missing, [*FES, *arguments], tmp_path)
    told = f"Error: fes {what} needs the extra {extra}, which is not installed: pip install 'fes-gait[{extra}]'\n"
    assert (done.returncode, done.stdout, done.stderr) == (UNUSABLE, "", told)
    assert [each.name for each in tmp_path.iterdir()] == ["site"]


def test_a_part_of_a_command_says_which_extra_it_needs(tmp_path: Path) -> None:
    SessionWriter(tmp_path / "session.feslog", {}).close({})
    done = run_without(OPTIONAL, [*FES, "convert", "session.feslog", "--to", "parquet"], tmp_path)
    told = "Error: this needs the extra analysis, which is not installed: pip install 'fes-gait[analysis]'\n"
    assert (done.returncode, done.stderr) == (UNUSABLE, told)


def test_each_extra_brings_what_its_commands_import() -> None:
    for extra, imported in EXTRAS.items():
        assert set(imported) == LIBRARIES[extra]
    assert not names(PROJECT["dependencies"]) & OPTIONAL
