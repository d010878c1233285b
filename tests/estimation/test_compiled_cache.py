"""What is compiled is kept under a digest of all that it rests on; damage and haste lose time, never a right number."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import os
import subprocess
import sys
from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from fes.estimation import warm_up
from fes.estimation.numerics import jit as compiled

OURS = ("fes.", "statemachine")


def _defined_in(module: str, name: str, seen: set[tuple[str, str]]) -> None:
    """Add to ``seen`` where a global name of a module gets its value, and whatever that is made of."""
    if (module, name) in seen or not module.startswith(OURS):
        return
    seen.add((module, name))
    tree = ast.parse(inspect.getsource(importlib.import_module(module)))
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    _defined_in(node.module, alias.name, seen)
        elif isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if name in {part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)}:
                for part in ast.walk(node.value):
                    if isinstance(part, ast.Name):
                        _defined_in(module, part.id, seen)


def test_the_digest_covers_every_constant_of_compiled_code() -> None:
    """A constant is compiled in: changed in a file that the digest leaves out, it would go on with its old value."""
    seen: set[tuple[str, str]] = set()
    sources = {str(path) for path in compiled._sources()}
    root = Path(compiled.__file__).parents[3]
    for path in (*root.glob("fes/**/*.py"), *root.glob("statemachine/*.py")):
        module = ".".join(path.relative_to(root).with_suffix("").parts)
        for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(function, ast.FunctionDef) and {
                each.id for each in function.decorator_list if isinstance(each, ast.Name)
            } & {"jit", "inlined", "jit_ieee", "jit_fused"}:
                for part in ast.walk(function):
                    if isinstance(part, ast.Name):
                        _defined_in(module, part.id, seen)
    assert ("fes.estimation.orientation.filter", "TRUSTED") in seen
    left_out = {(module, name) for module, name in seen if _file_of(module) not in sources}
    assert not left_out


def _file_of(module: str) -> str:
    return str(importlib.import_module(module).__file__)


SOLVED = """
import sys
import numpy as np
from fes.estimation.numerics.jit import KEPT, compiled_here
from fes.estimation.numerics.filters import solve

def solved(kind):
    system = np.array([[2.0, 0.0, 4.0], [0.0, 4.0, 4.0]], kind)
    assert solve(system, 2) and system[:, 2].tolist() == [2.0, 1.0]

def stop():
    print("ready", flush=True)
    sys.stdin.readline()

"""
TWICE = SOLVED + "solved(float); print(*compiled_here())"
DOUBLE, SINGLE = "solved(np.float64)\n", "solved(np.float32)\n"


def run(code: str, cache: Path, **more: str) -> str:
    where = {**os.environ, "XDG_CACHE_HOME": str(cache), **more}
    done = subprocess.run([sys.executable, "-c", code], env=where, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def kept(cache: Path, suffix: str = "") -> list[Path]:
    return [path for path in sorted(cache.rglob(f"kept/*/*{suffix}")) if path.is_file()]


SOLVE = "fes.estimation.numerics.filters.solve"


def test_compiled_once_and_nothing_is_left_beside_it(tmp_path: Path) -> None:
    assert run(TWICE, tmp_path) == SOLVE
    assert run(TWICE, tmp_path) == ""
    assert not list(tmp_path.rglob("process-*"))
    (listed,) = tmp_path.rglob("kept.json")
    root = listed.parent / "kept"
    sizes = [files.items() for files in json.loads(listed.read_text()).values()]
    assert sorted(chain(*sizes)) == [(str(path.relative_to(root)), path.stat().st_size) for path in kept(tmp_path)]


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("left", [0.0, 0.5, None])
def test_what_a_power_cut_leaves_is_compiled_anew(tmp_path: Path, suffix: str, left: float | None) -> None:
    """Files cut short, or gone."""
    run(TWICE, tmp_path)
    damaged = kept(tmp_path, suffix)
    assert damaged
    for path in damaged:
        if left is None:
            path.unlink()
        else:
            os.truncate(path, int(left * path.stat().st_size))
    assert run(TWICE, tmp_path) == SOLVE
    assert run(TWICE, tmp_path) == ""


def test_what_no_list_names_is_not_run(tmp_path: Path) -> None:
    """A power cut before the list was written: the files may have holes, at their full length."""
    run(TWICE, tmp_path)
    (listed,) = tmp_path.rglob("kept.json")
    listed.unlink()
    for path in kept(tmp_path):
        path.write_bytes(bytes(path.stat().st_size))
    assert run(TWICE, tmp_path) == SOLVE
    assert run(TWICE, tmp_path) == ""
    listed.write_text("{")  # cut short
    assert run(TWICE, tmp_path) == SOLVE


def test_two_processes_that_compile_at_once_do_not_mix_up_their_code(tmp_path: Path) -> None:
    """One function for different types of arguments: each begins before the other has kept anything."""
    where = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    both = [
        subprocess.Popen(
            [sys.executable, "-c", SOLVED + "stop()\n" + kind + "stop()"],
            env=where,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for kind in (DOUBLE, SINGLE)
    ]
    for _ in range(2):
        for process in both:
            assert process.stdout is not None
            assert process.stdin is not None
            assert process.stdout.readline() == "ready\n"
        for process in both:
            assert process.stdin is not None
            process.stdin.write("\n")
            process.stdin.flush()
    assert [process.wait() for process in both] == [0, 0]
    asked = SOLVED + DOUBLE + SINGLE + "print(sum(solve.stats.cache_hits.values()))"
    assert run(asked, tmp_path) == "1"  # the first one's is there, the other's is compiled again
    assert run(asked, tmp_path) == "2"


def test_what_another_process_has_kept_meanwhile_is_taken_over(tmp_path: Path) -> None:
    code = "import subprocess, sys\nsubprocess.run([sys.executable, '-c', sys.argv[1]], check=True)\n"
    where = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    command = [sys.executable, "-c", SOLVED + code + "KEPT.fetch()\n" + DOUBLE + "assert not compiled_here()", TWICE]
    subprocess.run(command, env=where, check=True, capture_output=True)


def test_a_process_that_was_killed_leaves_nothing_for_long(tmp_path: Path) -> None:
    run(SOLVED + DOUBLE + "import os\nos._exit(0)", tmp_path)
    assert list(tmp_path.rglob("process-*"))
    assert run(TWICE, tmp_path) == SOLVE
    assert not list(tmp_path.rglob("process-*"))


BLOCKED = """
import sys
from pathlib import Path
from fes.estimation.numerics.jit import jit
source = Path(sys.argv[1]) / "somewhere.py"
source.write_text("def doubled(x):\\n    return 2.0 * x\\n")
sys.path.insert(0, sys.argv[1])
import somewhere
assert jit(somewhere.doubled)(1.5) == 3.0
"""


def blocked(folder: Path) -> subprocess.CompletedProcess[str]:
    where = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache"), "TMPDIR": str(folder)}
    command = [sys.executable, "-B", "-c", BLOCKED, str(folder)]
    return subprocess.run(command, env=where, capture_output=True, text=True, check=False)


def test_nothing_is_kept_beside_the_sources(tmp_path: Path) -> None:
    """There a change in a function that they call would go unseen."""
    (tmp_path / "cache").write_text("in the way")
    (tmp_path / f"fes-gait-{os.getuid()}").write_text("in the way")
    done = blocked(tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("Compiled code cannot be kept") == 1
    assert not [*tmp_path.rglob("*.nbi"), *tmp_path.rglob("*.nbc")]


@pytest.mark.skipif(os.getuid() != 0, reason="gives a folder to somebody else")
def test_what_somebody_else_put_there_is_not_run(tmp_path: Path) -> None:
    """In the folder for temporary files anybody can make one with our name."""
    (tmp_path / "cache").write_text("in the way")
    own = tmp_path / f"fes-gait-{os.getuid()}"
    own.mkdir()
    os.chown(own, 12345, 12345)
    done = blocked(tmp_path)
    assert done.returncode == 0, done.stderr
    assert "belongs to somebody else" in done.stderr
    assert not list(own.iterdir())


def test_a_user_without_a_home_compiles(tmp_path: Path) -> None:
    """As in a container that runs under a number that nobody has."""
    code = "import pathlib\n@classmethod\ndef home(cls): raise RuntimeError\npathlib.Path.home = home\n"
    where = {**os.environ, "TMPDIR": str(tmp_path)}
    where.pop("XDG_CACHE_HOME", None)
    done = subprocess.run([sys.executable, "-c", code + TWICE], env=where, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert kept(tmp_path, ".nbi")


PLAIN = Path(__file__).with_name("plain_python.py")


def test_the_tracker_without_the_compiler_finds_the_same() -> None:
    """Plain Python is the readable reference of all that the live core compiles."""

    def found(**more: str) -> tuple[np.ndarray, np.ndarray]:
        where = {**os.environ, **more}
        done = subprocess.run([sys.executable, str(PLAIN)], env=where, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        changes, strides = json.loads(done.stdout)
        return np.array(changes), np.array(strides, float)

    (changes, strides), (plain_changes, plain_strides) = found(), found(NUMBA_DISABLE_JIT="1")
    assert len(changes) > 20
    assert np.isfinite(strides).all(axis=1).sum() >= 4
    assert np.array_equal(changes, plain_changes)
    assert plain_strides == pytest.approx(strides, rel=1e-12, abs=1e-12, nan_ok=True)


# --- After ``warm_up`` nothing is left to compile in the loop, whatever the session and the gait ---


FOLDER = Path(__file__).resolve().parents[2] / "sim_inputs"
SCRIPT = """
import sys
from pathlib import Path
from fes.calibration.recording import calibrate_phase_sensors
from fes.config import load_session
from fes.control.controller import Controller
from fes.estimation.warm_up import GEOMETRY, warm_up
from fes.recording import read_recording
from fes.signals import StrideResult

def compiled():
    found = {}
    for name, module in list(sys.modules.items()):
        for part, value in list(vars(module).items()) if name.startswith("fes.") else ():
            if hasattr(value, "py_func") and hasattr(value, "signatures"):
                found[name, part] = len(value.signatures)
    return found

folder = Path(sys.argv[1])
plain = load_session(folder / "session.toml")
known = plain.model_copy(update={"geometry": {"left_foot": GEOMETRY, "right_foot": GEOMETRY}})
for trial in sys.argv[2:]:
    recording = read_recording(folder / trial)
    found = calibrate_phase_sensors(recording)
    warm_up()
    before = compiled()
    for session in (plain, known):
        controller = Controller(session, found.calibrations)
        outcomes = [outcome for sample in recording.samples() for outcome in controller.step(sample).outcomes]
        assert sum(isinstance(outcome, StrideResult) for outcome in outcomes) > 20, trial
    more = {key for key, count in compiled().items() if count > before.get(key, 0)}
    assert not more, (trial, more)
"""


def test_no_session_begins_where_code_does_not_stay_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = iter((200, 201))
    monkeypatch.setattr(warm_up, "signatures", lambda: next(counts))
    with pytest.raises(RuntimeError, match="no session may begin"):
        warm_up.warm_up()


def test_nothing_is_compiled_in_the_loop() -> None:
    trials = ("both_feet_200hz.parquet", "negard_patient2.parquet")
    done = subprocess.run([sys.executable, "-c", SCRIPT, str(FOLDER), *trials], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-1500:]
