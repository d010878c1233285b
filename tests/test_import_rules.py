"""Who may import whom, read from the source of every module; and what a command does not drag in."""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
OURS = ("fes", "drivers", "statemachine")
STDLIB = sys.stdlib_module_names
# Who may import whom: a room imports what stands lower, and itself; never its own floor, never a higher one.
FLOORS: tuple[tuple[str, ...], ...] = (
    ("fes", "fes.signals", "fes.limits", "fes.extensions"),
    ("statemachine",),
    ("fes.config",),
    ("fes.walk_record", "fes.estimation.numerics"),
    ("fes.estimation", "fes.stimulation", "fes.session_log", "fes.gate"),
    ("fes.recording",),
    ("fes.control", "fes.simulation", "fes.datasets", "fes.witness"),
    ("fes.calibration", "drivers"),
    ("fes.analysis", "fes.live", "drivers.simulated"),
    ("fes.evaluation", "fes.hil", "fes.qualify"),
    ("fes.report",),
    ("fes.cohort",),
    ("fes.notebook",),
    ("fes.cli",),
)
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
HARDWARE = {"serial", "can", "drivers"}
NO_CLOCK = {"time", "threading", "asyncio", "multiprocessing", "concurrent", "sched"}
# rooms of which less is allowed than their floor would let them: what of this project, and which libraries
NARROWER: dict[str, set[str]] = {
    "fes.signals": {"numpy"},
    "fes.limits": set(),
    "fes.extensions": set(),
    "fes.config": {"pydantic", "fes.extensions", "fes.limits", "statemachine.guards"},
    "statemachine": {"transitions", "fes.signals", "fes.limits"},
    "fes.walk_record": {"numpy", "fes.signals", "statemachine.phases"},
    "fes.gate": {"numpy", "fes.config", "fes.signals", "fes.limits", "fes.estimation.numerics"},
    "fes.estimation.numerics": {"numpy", "numba", "fes.signals"},
    "fes.stimulation": {"numpy", "statemachine.phases", "fes.config", "fes.extensions", "fes.signals", "fes.limits"},
    "fes.estimation": {"numpy", "numba", "statemachine", "fes.config", "fes.signals", "fes.limits"},
}
ANALYSIS_KNOWS_NOT = {"fes.stimulation", "fes.gate", "fes.live", "fes.control", "fes.session_log", "fes.config.session"}
PURE: tuple[str, ...] = (
    "fes.control",
    "fes.gate",
    "fes.stimulation",
    "fes.estimation",
    "fes.evaluation.delivered",
    "statemachine",
    *(f"fes.live.{name}" for name in ("operator", "commands", "status", "sensor_monitor")),
)


@cache
def modules() -> dict[str, Path]:
    found = {}
    for top in OURS:
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def resolve(module: str, name: str = "") -> str:
    """The module that ``from module import name`` reaches."""
    return f"{module}.{name}" if f"{module}.{name}" in modules() else module


@cache
def imports(module: str, *, at_import: bool = False) -> frozenset[str]:
    """All that a module imports, wherever in it; with ``at_import`` only what happens when it is imported."""
    tree = ast.parse(modules()[module].read_text(encoding="utf-8"))
    inside = {
        inner
        for outer in ast.walk(tree)
        if isinstance(outer, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        for inner in ast.walk(outer)
    }
    found: set[str] = set()
    for node in ast.walk(tree):
        if at_import and node in inside:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative imports hide who imports whom"
            assert node.module is not None
            found |= {resolve(node.module, alias.name) for alias in node.names}
    return frozenset(found)


def within(module: str, packages: tuple[str, ...] | set[str]) -> bool:
    return any(module == package or module.startswith(package + ".") for package in packages)


def of(*packages: str) -> list[str]:
    found = [module for module in modules() if within(module, packages)]
    assert found, packages
    return found


def room_of(module: str) -> str:
    """The room that a module stands in."""
    found = [room for room in FLOOR if within(module, {room})]
    assert found, f"{module} stands in no room: name it in FLOORS"
    return max(found, key=len)


def test_nobody_imports_upward() -> None:
    """Nor what stands beside it: a room imports itself and lower floors, without an exception."""
    upward = {
        f"{module} → {name}"
        for module in modules()
        for name in imports(module)
        if name in modules()
        and name != "fes"
        and room_of(name) != room_of(module)
        and FLOOR[room_of(name)] >= FLOOR[room_of(module)]
    }
    assert not upward


def test_what_is_private_stays_in_its_file() -> None:
    private = {
        f"{module}: {node.module}.{alias.name}"
        for module, path in modules().items()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in OURS
        for alias in node.names
        if alias.name.startswith("_") and not alias.name.startswith("__")
    }
    assert not private


@pytest.mark.parametrize("room", NARROWER)
def test_a_room_imports_only_what_it_may(room: str) -> None:
    found = {
        module: strange
        for module in of(room)
        if (
            strange := {
                name
                for name in imports(module)
                if name.split(".")[0] not in STDLIB and not within(name, NARROWER[room] | {room})
            }
        )
    }
    assert not found


def test_an_analysis_knows_no_session() -> None:
    for module in of("fes.analysis"):
        assert not {name for name in imports(module) if within(name, ANALYSIS_KNOWS_NOT)}, module


def test_recordings_take_of_the_estimation_its_numbers_only() -> None:
    for module in of("fes.recording"):
        taken = {name for name in imports(module) if within(name, {"fes.estimation"})}
        assert all(within(name, {"fes.estimation.numerics"}) for name in taken), module


@pytest.mark.parametrize("module", [module for package in PURE for module in of(package)])
def test_what_decides_reads_no_clock_and_opens_nothing(module: str) -> None:
    roots = {name.split(".")[0] for name in imports(module)}
    assert not roots & (NO_CLOCK | HARDWARE | {"socket", "signal", "select", "random", "secrets"})


@pytest.mark.parametrize("module", [module for package in PURE for module in of(package)])
def test_what_decides_asks_nobody_for_the_time(module: str) -> None:
    """Nor by way of another name: no ``….now()``, ``….monotonic…()``, ``….perf_counter…()`` on anything but a Clock."""
    tree = ast.parse(modules()[module].read_text(encoding="utf-8"))
    asked = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and node.attr in ("now", "today", "monotonic", "monotonic_ns", "perf_counter")
    }
    assert not asked


def test_only_the_commands_wire_drivers_to_the_controller() -> None:
    users = {module for module in modules() if any(within(name, {"drivers"}) for name in imports(module))}
    outside = {module for module in users if not within(module, {"drivers", "fes.cli", "fes.hil", "fes.qualify"})}
    assert not outside
    hardware = {module for module in of("fes") if any(within(name, {"serial", "can"}) for name in imports(module))}
    assert hardware <= {"fes.recording.can_log", "fes.qualify.simulated"}  # a CAN log is a file; a bus without wire


def test_only_the_views_own_process_draws() -> None:
    assert {module for module in of("fes.live") if "rich" in {name.split(".")[0] for name in imports(module)}} == {
        "fes.live.terminal_view"
    }
    assert not [module for module in of("fes.live") if "fes.live.terminal_view" in imports(module)]


def test_nobody_but_the_commands_knows_the_commands() -> None:
    users = {module for module in modules() if any(within(name, {"fes.cli"}) for name in imports(module))}
    assert all(within(module, {"fes.cli"}) for module in users)


def test_no_import_cycles() -> None:
    graph = {
        module: {name for name in imports(module, at_import=True) if name in modules() and name != module}
        for module in modules()
    }
    # a package's __init__ re-exports its parts; a part does not import its package
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " → ".join((*path[path.index(module) :], module))
        if module not in done:
            for name in graph[module]:
                visit(name, (*path, module))
            done.add(module)

    for module in graph:
        visit(module, ())


def test_everything_imported_is_declared() -> None:
    """No module leans on a library that only happens to be installed."""
    declared = {"cantools", "click", "jinja2", "msgpack", "numba", "numpy", "pyarrow", "pydantic", "serial", "can"}
    declared |= {"rich", "scipy", "transitions", "markupsafe", *OURS}
    declared |= {"sim_inputs"}  # `fes trials` in a checkout: what makes the bundled recordings
    declared |= {"starlette", "uvicorn"}  # the page's process
    declared |= {"dask", "distributed", "fsspec"}  # cohorts only
    declared |= {"canopen"}  # an extra: only the simulated CANopen node is made with it
    declared |= {"mcap"}  # an extra: only `fes convert` to MCAP needs it, and says so where it is missing
    declared |= {"ezc3d"}  # an extra: only C3D references need it, and say so where it is missing
    declared |= {"pyxdf", "h5py"}  # extras: only XDF and HDF5 recordings need them, and say so where they are missing
    found = {name.split(".")[0] for module in modules() for name in imports(module)} - set(STDLIB)
    assert found <= declared


def loaded_after(code: str, *watched: str) -> set[str]:
    """Which of these are loaded in a fresh process after running the code."""
    script = f"{code}\nimport sys\nprint(*sorted(set({watched!r}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=True)
    return set(done.stdout.splitlines()[-1].split()) if done.stdout.strip() else set()


def test_the_loop_loads_no_heavy_library() -> None:
    # numba looks whether there is a scipy, which alone loads next to nothing
    heavy = (
        "pyarrow",
        "jinja2",
        "rich",
        "scipy.linalg",
        "scipy.signal",
        "scipy.spatial",
        "matplotlib",
        "cantools",
        "can",
        "serial",
        "click",
    )
    assert all(importlib.util.find_spec(name) for name in heavy if name != "matplotlib")
    assert not loaded_after(
        "import fes.control.controller, fes.control.runner, fes.gate, fes.session_log, fes.control.runner", *heavy
    )


NOT_FOR_A_SESSION = ("pyarrow", "jinja2", "rich", "starlette", "uvicorn", "dask", "distributed", "matplotlib", "mcap")
NOT_FOR_A_SESSION += ("scipy.stats", "scipy.signal", "scipy.spatial", "scipy.interpolate", "scipy.optimize")
NOT_FOR_A_SESSION += (
    "scipy.ndimage",
    "fes.report",
    "fes.analysis.pipeline",
    "fes.analysis.parameters",
    "fes.analysis.hemiparetic",
    "fes.simulation",
)


def test_a_live_session_loads_nothing_that_it_does_not_need() -> None:
    """Nor when all that it compiles has been compiled (or loaded from the cache)."""
    code = "import fes.cli.run.command\nfrom fes.estimation.warm_up import warm_up\nwarm_up()"
    assert not loaded_after(code, *NOT_FOR_A_SESSION)


def test_an_analysis_loads_no_device() -> None:
    heavy = ("can", "cantools", "serial", "drivers", "scipy.linalg", "scipy.signal", "rich", "jinja2", "pyarrow")
    assert not loaded_after(
        "import fes.cli.analyse", *heavy, "fes.gate", "fes.control.runner", "fes.analysis.hemiparetic"
    )


def test_help_loads_nothing_slow() -> None:
    code = "from fes.cli import main\ntry:\n    main(['--help'])\nexcept SystemExit as end:\n    assert not end.code"
    assert not loaded_after(code, "numba", "numpy", "pydantic", "can", "rich", "pyarrow", "scipy", "transitions")


def test_the_gate_loads_neither_controller_nor_drivers() -> None:
    loaded = loaded_after("import fes.gate", *(name for name in modules() if not within(name, {"fes.gate"})))
    names_of_thresholds = {"statemachine", "statemachine.guards"}
    numerics = {
        "fes.estimation",
        *(f"fes.estimation.numerics{name}" for name in ("", ".jit", ".records")),
    }
    signals = {"fes", "fes.signals", "fes.limits", "fes.extensions", *of("fes.config")}
    assert loaded == signals | names_of_thresholds | numerics
