"""What is compiled is kept under a digest of all that it rests on; damage and haste lose time, never a right number."""

from __future__ import annotations

import ast
import importlib
import inspect
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fes.estimation.compiler_cache import Cache

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
import numpy as np
from fes.estimation.numerics.linear import solve
system = np.array([[2.0, 0.0, 4.0], [0.0, 4.0, 4.0]])
assert solve(system, 2) and system[:, 2].tolist() == [2.0, 1.0]
print(sum(solve.stats.cache_hits.values()), "found")
"""


def solved(cache: Path) -> subprocess.CompletedProcess[str]:
    where = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    return subprocess.run([sys.executable, "-c", SOLVED], env=where, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("kind", ["nbi", "nbc"])
@pytest.mark.parametrize("left", [0.0, 0.5])
def test_what_a_power_cut_leaves_is_compiled_anew(tmp_path: Path, kind: str, left: float) -> None:
    assert solved(tmp_path).returncode == 0
    assert solved(tmp_path).stdout == "1 found\n"
    damaged = list(tmp_path.rglob(f"*.{kind}"))
    assert damaged
    for path in damaged:
        os.truncate(path, int(left * path.stat().st_size))
    done = solved(tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "0 found\n"
    assert solved(tmp_path).stdout == "1 found\n"


def test_machine_code_with_a_hole_is_not_run(tmp_path: Path) -> None:
    """A block of the file that never reached the disk reads as zeros."""
    assert solved(tmp_path).returncode == 0
    (path,) = tmp_path.rglob("*.nbc")
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle - 1024 : middle + 1024] = bytes(2048)
    path.write_bytes(data)
    done = solved(tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "0 found\n"


def test_two_processes_that_compile_at_once_do_not_mix_up_their_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One function for different types of arguments, or for the processors of two machines, in one folder."""
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))

    def function(x: Any) -> Any:
        return x

    made: Any = Cache
    one, other, later = (made(function)._cache_file for _ in range(3))
    one._cache_path = other._cache_path = later._cache_path = str(tmp_path)
    write = one._save_data

    def write_last(name: str, data: Any) -> None:
        other.save("types of the other", "code of the other")
        write(name, data)

    monkeypatch.setattr(other, "_load_index", dict)  # it looked before the one had written anything
    monkeypatch.setattr(one, "_save_data", write_last)
    one.save("types of the one", "code of the one")
    assert later.load("types of the other") == "code of the other"
    assert later.load("types of the one") in (None, "code of the one")


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
    command = [sys.executable, "-c", code + SOLVED]
    done = subprocess.run(command, env=where, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.rglob("*.nbi"))


TURNED = """
import sys
import numba
numba.__version__ = sys.argv[1] or numba.__version__
import numpy as np
from fes.estimation.numerics.rotation import foot_axes
rng, axes = np.random.default_rng(3), np.empty((50, 3, 3))
q = rng.normal(size=(50, 4))
foot_axes(q, rng.normal(size=3), rng.normal(size=3), axes)
print("fes.estimation.compiler" in sys.modules, axes.tobytes().hex())
"""


def test_a_numba_that_nobody_has_tried_compiles_by_itself_to_the_same_numbers(tmp_path: Path) -> None:
    """What is replaced within numba may be another thing there, and nothing would tell."""

    def turned(version: str) -> tuple[str, str]:
        where = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
        command = [sys.executable, "-c", TURNED, version]
        done = subprocess.run(command, env=where, capture_output=True, text=True, check=True)
        ours, numbers = done.stdout.split()
        return ours, numbers

    (ours, numbers), (by_itself, same) = turned(""), turned("0.68.99")
    assert (ours, by_itself) == ("True", "False")
    assert same == numbers
