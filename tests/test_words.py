"""The field's words: no public name says in a private word what gait and FES engineers have a term for."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TREES = ("fes", "drivers", "statemachine")
PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z0-9]+")
# part of a name → what to say
IN_A_NAME = {
    "way": "trajectory, path or distance",
    "ways": "trajectories, paths or distances",
    "likely": "maximum_likelihood, noise_model",
    "walked": "TrackedBlock, tracked",
    "creep": "drift_speed",
    "carry": "propagate, move",
    "afflicted": "paretic",
    "doubt": "not_ready, reason",
    "doubts": "reasons_not_ready",
    "told": "say what is returned",
    "tells": "say what is returned",
    "deed": "intervention",
    "deeds": "interventions",
    "withstood": "expected_no_effect",
    "remark": "notice",
    "remarks": "notices",
    "journal": "session_log",
    "desk": "message_handler",
    "rig": "test_bench, bench",
    "driving": "phase_sensors",
    "driven": "phase_sensor_of",
    "piece": "chunk",
    "pieces": "chunks",
    "beside": "companion_files",
    "importing": "datasets",
}
WHOLE_NAMES = {
    *("of", "at", "told", "take", "found", "known", "look", "said", "words", "tell", "begun", "passed", "carry"),
    *("Way", "Walked", "Ask", "Order", "Course", "COURSE", "Rig", "Board", "Desk", "Watch", "Remarks", "Piece"),
    *("most_likely", "common_way", "RestCalibration", "StepTape"),
    *("jump_mps3", "vertical_jump_mps3", "contact_jump_mps3"),
}


def public_definitions(path: Path) -> Iterator[tuple[str, bool]]:
    """Public names that a module defines, and whether each is a function: arguments and fields of records, too."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name, True
            given = node.args
            several = [each for each in (given.vararg, given.kwarg) if each is not None]
            yield from ((each.arg, False) for each in (*given.posonlyargs, *given.args, *given.kwonlyargs, *several))
        elif isinstance(node, ast.ClassDef):
            yield node.name, False
            yield from (
                (each.target.id, False)
                for each in node.body
                if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
            )
    for node in tree.body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        names = [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
        value = node.value if targets else None
        if isinstance(value, ast.Call) and ast.unparse(value.func) == "record_type" and not names[0].startswith("_"):
            texts = (part.value for part in ast.walk(value) if isinstance(part, ast.Constant))
            names += [text for text in texts if isinstance(text, str)]
        yield from ((name, False) for name in names)


def private_words(name: str, function: bool) -> list[str]:
    """What of a name is a private word."""
    if name.startswith("_"):
        return []
    found = [part.lower() for part in PARTS.findall(name) if part.lower() in IN_A_NAME]
    if not found and name in WHOLE_NAMES and (function or "_" in name or not name.islower()):
        found.append(name)
    return found


@pytest.mark.parametrize("tree", TREES)
def test_public_names_are_the_fields_words(tree: str) -> None:
    bad = {
        f"{path.relative_to(ROOT).as_posix()}: {name}: {', '.join(words)}"
        for path in sorted((ROOT / tree).rglob("*.py"))
        for name, function in public_definitions(path)
        if (words := private_words(name, function))
    }
    bad |= {
        f"{path.relative_to(ROOT).as_posix()}: a module's name"
        for path in (ROOT / tree).rglob("*.py")
        if private_words(path.stem, False)
    }
    assert not bad, "\n".join(sorted(bad))


def test_pages_name_things_by_the_fields_words() -> None:
    """Names in code marks, of settings, columns, modules and functions."""
    quoting_code = {"mutants.md", "CHANGELOG.md"}
    bad = {
        f"{page.name}: {code}"
        for page in (*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"))
        if page.name not in quoting_code
        for code in re.findall(r"`([^`\n]+)`", page.read_text(encoding="utf-8"))
        if not code.startswith(("tests/", ",", " "))
        for name in re.findall(r"[A-Za-z_]\w+", code)
        if ("_" in name or name in WHOLE_NAMES) and private_words(name, True)
    }
    assert not bad, "\n".join(sorted(bad))


def test_the_words_are_seen(tmp_path: Path) -> None:
    assert private_words("way_m", False) == ["way"]
    assert private_words("told", True) == ["told"]
    assert not private_words("found", False)  # a field may say what was found
    module = tmp_path / "m.py"
    module.write_text("KIND = record_type([('jump_mps3', float)])\ndef f(a, *, told=0): ...\n", encoding="utf-8")
    found = {name for name, function in public_definitions(module) if private_words(name, function)}
    assert found == {"jump_mps3", "told"}
