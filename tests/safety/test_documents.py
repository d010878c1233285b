"""The safety documents say what is so."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from documents import (
    CLAIMS,
    DOCS,
    HAZARDS,
    PROBABILITIES,
    REQUIREMENTS,
    ROOT,
    SEVERITIES,
    acceptability,
    hazards_page,
    locked,
    requirements_page,
    shown_by,
)

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
    assert told == locked("locks/run.lock") | locked("locks/dev.lock"), f"third_party.md {AGAIN}"


@pytest.mark.parametrize("hazard", HAZARDS, ids=lambda hazard: hazard["cause"])
def test_every_hazard_has_a_requirement_a_test_of_it_and_a_control_to_take_out(hazard: dict[str, Any]) -> None:
    assert hazard["test"] in shown_by()[hazard["requirement"]]
    text = (ROOT / hazard["file"]).read_text(encoding="utf-8")
    assert text.count(hazard["old"]) == 1, f"{hazard['file']} no longer holds the control once: {hazard['old']}"
    assert hazard["new"] not in ("", hazard["old"]) or hazard["old"].strip()


@pytest.mark.parametrize("hazard", HAZARDS, ids=lambda hazard: hazard["cause"])
def test_every_hazard_is_graded_and_says_what_remains_and_for_what_it_is_claimed(hazard: dict[str, Any]) -> None:
    assert hazard["severity"] in SEVERITIES
    assert hazard["probability_before"] in PROBABILITIES
    assert hazard["probability_after"] in PROBABILITIES
    assert hazard["probability_after"] < hazard["probability_before"], "a control that changes nothing is none"
    assert hazard["residual"].strip()
    assert hazard["claimed_for"] in CLAIMS


@pytest.mark.parametrize("hazard", HAZARDS, ids=lambda hazard: hazard["cause"])
def test_what_a_simulated_device_does_is_claimed_of_virtual_devices_only(hazard: dict[str, Any]) -> None:
    assert not hazard["file"].startswith("drivers/simulated/") or hazard["claimed_for"] == "virtual devices only"


def test_what_is_probable_and_serious_is_not_acceptable() -> None:
    assert acceptability(3, 1) == acceptability(1, 3) == "acceptable"
    assert acceptability(3, 2) == acceptability(4, 1) == "as low as practicable"
    assert acceptability(3, 3) == acceptability(4, 2) == "not acceptable"


def test_documents_that_are_not_generated_are_there() -> None:
    for name in ("intended_use.md", "safety.md", "mutants.md"):
        assert Path(DOCS / name).read_text(encoding="utf-8").startswith("# ")
