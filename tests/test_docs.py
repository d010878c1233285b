"""The documentation holds what it says: links, commands, make targets, modules, examples of settings."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import architecture_page
import click
import pytest

from fes.cli.main import main
from fes.config import validate_session
from fes.recording.sidecar import Sidecar

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "sim_inputs" / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
TREES = ("fes", "drivers", "statemachine")
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`([^`\n]+)`")
FOLDERS = (*TREES, "benchmarks", "tests", "docs", "sim_inputs")
PATH = re.compile(rf"^(?:{'|'.join(FOLDERS)})/[\w./*-]*$")
MODULE = re.compile(rf"^(?:{'|'.join(TREES)})(?:\.\w+)+$")

pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


@cache
def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path, language: str) -> list[str]:
    return [body for name, body in FENCE.findall(text_of(page)) if name == language]


def inline(page: Path) -> list[str]:
    return INLINE.findall(FENCE.sub("", text_of(page)))


def command_lines(page: Path) -> list[str]:
    """Every line that a reader would type: shell blocks, indented lines, and inline code."""
    lines = [line for body in blocks(page, "sh") for line in body.splitlines()]
    lines += [line for line in FENCE.sub("", text_of(page)).splitlines() if line.startswith("    ")]
    return [line.split("#")[0].strip() for line in lines] + inline(page)


@cache
def options_of(name: str) -> frozenset[str] | None:
    command = main.get_command(click.Context(main), name)
    if command is None:
        return None
    inner = command.commands.values() if isinstance(command, click.Group) else ()
    parameters = [each for one in (command, *inner) for each in one.params]
    return frozenset(option for each in parameters for option in (*each.opts, *each.secondary_opts)) | {"--help"}


@cache
def headings(page: Path) -> frozenset[str]:
    """Anchors of a page's headings, as forges make them."""
    found = re.findall(r"^#+ (.*)$", FENCE.sub("", text_of(page)), re.MULTILINE)
    return frozenset(re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in found)


@pages
def test_every_relative_link_leads_somewhere(page):
    for target in LINK.findall(INLINE.sub("", FENCE.sub("", text_of(page)))):
        if "://" in target or target.startswith("mailto:"):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), f"{page.name}: {target}"
        assert file.is_relative_to(ROOT), f"{page.name}: {target} leaves the project"
        assert not anchor or file.suffix != ".md" or anchor in headings(file), f"{page.name}: no heading for {target}"


def test_every_page_can_be_reached_from_the_readme():
    seen: set[Path] = set()
    todo = [ROOT / "README.md"]
    while todo:
        page = todo.pop()
        seen.add(page)
        found = {(page.parent / target.split("#")[0]).resolve() for target in LINK.findall(text_of(page))}
        todo += [file for file in found - seen if file.suffix == ".md" and file.exists()]
    assert {page for page in PAGES if page.parent.name == "docs"} <= seen


@pages
def test_every_command_and_option_exists(page):
    for line in command_lines(page):
        for call in re.findall(r"(?:^|[`\s])fes ([a-z]+)([^`|]*)", line):
            name, rest = call
            known = options_of(name)
            assert known is not None, f"{page.name}: fes {name}"
            for option in re.findall(r"(?<!\S)--[a-z][a-z-]*", rest):
                assert option in known, f"{page.name}: fes {name} {option}"


@pages
def test_every_make_target_exists(page):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for line in command_lines(page):
        for target in re.findall(r"^make ([a-z-]+)", line):
            assert target in targets, f"{page.name}: make {target}"


@pages
def test_every_path_and_module_exists(page):
    for code in inline(page):
        name = code.split()[0].split("::")[0] if code.strip() else ""
        if PATH.match(name):
            assert list(ROOT.glob(name.rstrip("/"))) or (ROOT / name).exists(), f"{page.name}: {name}"
        elif MODULE.match(name):
            assert importable(name), f"{page.name}: {name}"
    for line in command_lines(page):
        for name in re.findall(r"python -m ([\w.]+)", line):
            assert name.split(".")[0] not in TREES or importable(name), f"{page.name}: {name}"
        for name in re.findall(r"python ((?:benchmarks|tests)/[\w/.]+)", line):
            assert (ROOT / name).is_file(), f"{page.name}: {name}"


def importable(name: str) -> bool:
    """Whether a dotted name is a module, or something that a module defines."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        base = ROOT.joinpath(*parts[:length])
        file = base.with_suffix(".py") if base.with_suffix(".py").is_file() else base / "__init__.py"
        if file.is_file():
            rest = parts[length : length + 1]
            return not rest or re.search(rf"\b{rest[0]}\b", file.read_text(encoding="utf-8")) is not None
    return False


def test_the_rooms_the_loop_and_the_frames_are_as_the_code_has_them():
    assert architecture_page.main(["--check"]) == 0


def toml_blocks(name: str) -> list[dict[str, Any]]:
    return [tomllib.loads(body) for body in blocks(ROOT / "docs" / name, "toml")]


@pytest.mark.parametrize("name", ["sessions.md", "imus.md", "stimulators.md"])
def test_examples_of_settings_are_valid(name):
    examples = toml_blocks(name)
    assert examples
    for data in examples:
        session = validate_session({"name": "example", **data}, Path(name))
        assert set(data) <= set(type(session).model_fields)


def test_the_complete_example_names_every_setting():
    example = toml_blocks("sessions.md")[0]
    session = validate_session(example, Path("sessions.md"))
    assert set(type(session).model_fields) - {"phases", "thresholds"} <= set(example)
    for table, value in (
        (example["channels"][0], session.channels[0]),
        (example["channels"][0]["limits"], session.channels[0].limits),
        (example["stimulation"], session.stimulation),
        (example["sensors"][0], session.sensors[0]),
        (example["stimulator"], session.stimulator),
        (example["foot_switches"][0], session.foot_switches[0]),
        (example["geometry"]["right_foot"], session.geometry["right_foot"]),
    ):
        assert set(type(value).model_fields) - {"tuning"} <= set(table)


def test_the_example_of_a_sidecar_is_valid():
    for data in toml_blocks("recordings.md"):
        Sidecar.model_validate(data)


RENDERED = re.compile(
    r"<!-- (?:figures|begin|tuning results).*?<!-- end(?: of figures| of tuning results)? -->|<!--.*?-->", re.DOTALL
)


def test_what_a_user_has_to_read_grows_no_longer():
    """Words of README.md and of the index's pages before Assurance, without code and what commands write."""
    index = ROOT / "docs" / "index.md"
    links = LINK.findall(text_of(index).partition("\n## Assurance")[0])
    read = {ROOT / "README.md", index, *(ROOT / "docs" / name for name in links if name.endswith(".md"))}
    prose = " ".join(FENCE.sub("", RENDERED.sub("", text_of(page))) for page in read)
    words = [word for word in prose.split() if any(letter.isalnum() for letter in word)]
    assert len(words) <= 22_500, f"{len(words)} words: say it shorter, or in a table of what measured it"
