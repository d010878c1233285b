"""Mutation testing of what stands between the controller and the wire; ``make mutants``.

mutmut changes the code in hundreds of small ways, one at a time, and runs the tests against each; a mutant that no
test notices is either a missing test or changes nothing that anybody could observe. The second kind is listed, with
the reason, in ``explained.toml``. This runs in a scratch copy, writes ``docs/mutants.md``, and ends with exit code 1
when a mutant survives without an explanation, or an explanation has lost its mutant.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("fes", "drivers", "statemachine", "tests", "pyproject.toml", "README.md", "LICENSE")
EXPLAINED = Path(__file__).with_name("explained.toml")
PAGE = ROOT / "docs" / "mutants.md"
# what is changed, and the tests that must notice it: those of its own, for all of them take half a minute a mutant
PARTS = {
    "coherence": (["fes/gate/coherence.py"], ["tests/gate/test_gate_coherence.py"]),
    "movement": (["fes/gate/movement.py"], ["tests/gate/test_gate_movement.py"]),
    "plausibility": (
        ["fes/gate/plausibility.py", "fes/gate/bounds.py"],
        ["tests/gate/test_gate_axes.py", "tests/gate/test_gate_data.py", "tests/gate/test_gate_parts.py"],
    ),
    "gate": (
        [f"fes/gate/{name}.py" for name in ("gate", "channel", "electrical", "freshness")],
        [
            *(f"tests/gate/test_gate{name}.py" for name in ("", "_data", "_movement", "_parts", "_requests")),
            "tests/stimulation/test_plan.py",
        ],
    ),
    "port": (
        ["drivers/stimulator/can_port.py", "drivers/stimulator/e2e.py"],
        [f"tests/drivers/test_can_{name}.py" for name in ("port", "port_frames", "codec")],
    ),
    "plan": (
        ["fes/stimulation/plan.py", "fes/stimulation/envelope.py"],
        [f"tests/stimulation/test_plan{name}.py" for name in ("", "_due", "_early_end", "_parts")],
    ),
}
SURVIVED = 0  # the tests' exit code
CHANGED_LINE = re.compile(r"^([-+])(?![-+]{2} )\s*(.*?)\s*$", re.MULTILINE)


@dataclass(frozen=True)
class Mutant:
    """A survivor, named by its file and the lines it takes and gives, so that a renumbering does not matter."""

    file: str
    old: str
    new: str


def copied(scratch: Path) -> Path:
    """The parts of the checkout that the tests need, elsewhere."""
    work = scratch / "work"
    work.mkdir(parents=True)
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, work / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(source, work / name)
    (work / "sim_inputs").symlink_to(ROOT / "sim_inputs")
    return work


def set_up(work: Path, part: str) -> None:
    """Tell mutmut there what to change, and which tests must notice it."""
    changed, tests = PARTS[part]
    with (work / "pyproject.toml").open("a", encoding="utf-8") as settings:
        settings.write(f"only_mutate = {changed}\npytest_add_cli_args_test_selection = {tests}\n")


def taken_up(scratch: Path) -> Path:
    """The copy of an earlier run with the tests of now: only its survivors are run once more."""
    work = scratch / "work"
    shutil.copy2(ROOT / "pyproject.toml", work / "pyproject.toml")
    for tests in (work / "tests", work / "mutants" / "tests"):
        shutil.copytree(ROOT / "tests", tests, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    for path in (work / "mutants").rglob("*.meta"):
        meta = json.loads(path.read_text(encoding="utf-8"))
        codes = meta["exit_code_by_key"]
        meta["exit_code_by_key"] = {name: None if code == SURVIVED else code for name, code in codes.items()}
        path.write_text(json.dumps(meta), encoding="utf-8")
    return work


def mutmut(work: Path, *arguments: str, echo: bool = False) -> str:
    """Run mutmut there; what it printed."""
    command = [sys.executable, "-m", "mutmut", *arguments]
    environment = os.environ | {"PYTHONPATH": "", "PYTHONWARNINGS": "ignore", "OMP_NUM_THREADS": "1"}
    environment["NUMBA_DISABLE_JIT"] = "1"  # a mutant of compiled code is read as it stands
    done = subprocess.run(command, cwd=work, env=environment, stdout=subprocess.PIPE, text=True, check=False)
    if echo or done.returncode:
        print(done.stdout[-3000:])
    if done.returncode:
        raise SystemExit(f"mutmut {arguments[0]} ended with {done.returncode}")
    return done.stdout


def results(work: Path) -> dict[str, str]:
    """Every mutant's fate by its name."""
    text = mutmut(work, "results", "--all", "true")
    return dict(re.findall(r"^\s*(\S+__mutmut_\d+): (.+?)\s*$", text, re.MULTILINE))


def survivor(work: Path, name: str) -> Mutant:
    """What this mutant changes."""
    module = name.split(".x", 1)[0]
    lines = CHANGED_LINE.findall(mutmut(work, "show", name))
    old, new = (" ".join(text for sign, text in lines if sign == wanted) for wanted in "-+")
    return Mutant(module.replace(".", "/") + ".py", old, new)


def explanations() -> Iterator[tuple[Mutant, str]]:
    """The survivors that are known, and why each changes nothing; several changes of a line may share a reason."""
    for row in tomllib.loads(EXPLAINED.read_text(encoding="utf-8"))["mutant"]:
        for new in [row["new"]] if isinstance(row["new"], str) else row["new"]:
            yield Mutant(row["file"], row["old"], new), row["why"]


def page(fates: Counter[str], files: Counter[str], known: dict[Mutant, str]) -> str:
    """docs/mutants.md."""
    counted = "\n".join(f"| `{file}` | {number} |" for file, number in sorted(files.items()))
    rows = "\n".join(
        f"| `{m.file}` | `{_cell(m.old)}` | `{_cell(m.new)}` | {why} |"
        for m, why in sorted(known.items(), key=lambda item: (item[0].file, item[0].old, item[0].new))
    )
    return f"""# Mutation testing

Written by `make mutants` (mutmut, in a scratch copy of the checkout). Each mutant is one small change of the code; the
tests must notice it. {sum(fates.values())} mutants: {fates["killed"]} killed, {fates["timeout"]} ended by a time limit
(an endless loop is noticed too), {fates["survived"]} survive and change nothing that can be observed, for the reasons
below. Any other survivor ends the target with exit code 1.

| file | mutants |
|---|---|
{counted}

## Survivors, explained

| file | line | becomes | why no test can tell |
|---|---|---|---|
{rows}
"""


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def main() -> None:
    """Run, compare, write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scratch", type=Path, help="keep the scratch copy here instead of in a temporary folder")
    parser.add_argument(
        "--again", action="store_true", help="of the copies in --scratch only what survived, by the tests of now"
    )
    parser.add_argument("--children", type=int, default=1, help="mutants at once")
    parser.add_argument("--write", action="store_true", help="write docs/mutants.md")
    parser.add_argument("--only", nargs="*", default=list(PARTS), choices=PARTS, help="these parts")
    options = parser.parse_args()
    if options.again and not options.scratch:
        parser.error("--again takes up what an earlier run left in --scratch")
    gate = {f"fes/gate/{path.name}" for path in (ROOT / "fes/gate").glob("*.py")} - {"fes/gate/__init__.py"}
    if left := gate - {file for changed, _ in PARTS.values() for file in changed}:
        parser.error(f"in no part: {left}")
    if options.write and len(options.only) < len(PARTS):
        parser.error("--write needs every part: leave out --only")
    fates, alive = dict[str, str](), dict[Mutant, str]()
    with tempfile.TemporaryDirectory() as temporary:
        for part in options.only:
            scratch = (options.scratch or Path(temporary)) / part
            work = taken_up(scratch) if options.again else copied(scratch)
            set_up(work, part)
            mutmut(work, "run", "--max-children", str(options.children))
            found = results(work)
            alive |= {survivor(work, name): name for name, fate in found.items() if fate == "survived"}
            fates |= found
    changed = {file for part in options.only for file in PARTS[part][0]}
    known = {mutant: why for mutant, why in explanations() if mutant.file in changed}
    files = Counter(name.split(".x", 1)[0].replace(".", "/") + ".py" for name in fates)
    print(dict(Counter(fates.values())))
    for mutant in sorted(alive.keys() - known.keys(), key=lambda m: (m.file, m.old)):
        print(f"SURVIVED, unexplained: {alive[mutant]}\n  - {mutant.old}\n  + {mutant.new}")
    for mutant in known.keys() - alive.keys():
        print(f"explained, but no survivor any more: {mutant}")
    lost = {name: fate for name, fate in fates.items() if fate not in ("killed", "timeout", "survived")}
    for name, fate in lost.items():
        print(f"{fate}: {name}")
    if lost or alive.keys() != known.keys() or not fates:
        raise SystemExit(1)
    if options.write:
        PAGE.write_text(page(Counter(fates.values()), files, known), encoding="utf-8")


if __name__ == "__main__":
    main()
