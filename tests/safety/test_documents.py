"""The safety documents say what is so."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from documents import DOCS, HAZARDS, REQUIREMENTS, ROOT, hazards_page, locked, requirements_page, shown_by

AGAIN = "is out of date: make docs"


def test_every_requirement_has_a_test_and_every_marker_a_requirement() -> None:
    found = shown_by()
    assert set(found) == set(REQUIREMENTS)


def test_requirements_are_up_to_date() -> None:
    assert (DOCS / "requirements.md").read_text(encoding="utf-8") == requirements_page(), f"requirements.md {AGAIN}"


def test_hazards_are_up_to_date() -> None:
    assert (DOCS / "hazards.md").read_text(encoding="utf-8") == hazards_page(), f"hazards.md {AGAIN}"


def test_third_party_versions_are_those_of_the_lock_files() -> None:
    """Licences depend on what is installed where the page was written; versions must not."""
    page = (DOCS / "third_party.md").read_text(encoding="utf-8")
    told = dict(re.findall(r"^\| ([\w.-]+) \| ([^ |]+) \|", page, re.MULTILINE))
    told.pop("package", None)
    assert told == locked("requirements.lock") | locked("requirements-dev.lock"), f"third_party.md {AGAIN}"


@pytest.mark.parametrize("hazard", HAZARDS, ids=lambda hazard: hazard["cause"])
def test_every_hazard_has_a_requirement_a_test_of_it_and_a_control_to_take_out(hazard: dict[str, str]) -> None:
    assert hazard["test"] in shown_by()[hazard["requirement"]]
    text = (ROOT / hazard["file"]).read_text(encoding="utf-8")
    assert text.count(hazard["old"]) == 1, f"{hazard['file']} no longer holds the control once: {hazard['old']}"
    assert hazard["new"] not in ("", hazard["old"]) or hazard["old"].strip()


def test_documents_that_are_not_generated_are_there() -> None:
    for name in ("intended_use.md", "safety.md", "mutants.md"):
        assert Path(DOCS / name).read_text(encoding="utf-8").startswith("# ")
