"""The safety documents say what is so."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from documents import PAGES
from risks import (
    CLAIMS,
    DECISIONS,
    DOCS,
    HAZARDS,
    NAMED,
    PROBABILITIES,
    REQUIREMENTS,
    RESULTS,
    RISKS,
    ROOT,
    SEVERITIES,
    SHARES,
    Measured,
    Result,
    acceptability,
    campaign,
    filled,
    grade_of,
    measured,
    needs_a_decision,
    shown_by,
)
from software import locked

AGAIN = "is out of date: make docs"


def test_every_requirement_has_a_test_and_every_marker_a_requirement() -> None:
    found = shown_by()
    assert set(found) == set(REQUIREMENTS)


@pytest.mark.parametrize("name", [name for name in PAGES if name != "third_party.md"])
def test_a_page_is_up_to_date(name: str) -> None:
    """With every number in it, which this computes anew."""
    assert (DOCS / name).read_text(encoding="utf-8") == PAGES[name](), f"{name} {AGAIN}"


def test_third_party_versions_are_those_of_the_lock_files() -> None:
    """Licences depend on what is installed where the page was written; versions must not."""
    page = (DOCS / "third_party.md").read_text(encoding="utf-8")
    told = dict(re.findall(r"^\| ([\w.-]+) \| ([^|]+) \|", page, re.MULTILINE))
    told.pop("package", None)
    both = locked("locks/run.lock") | locked("locks/dev.lock")
    assert told == {name: " or ".join(versions) for name, versions in both.items()}, f"third_party.md {AGAIN}"


@pytest.mark.parametrize("hazard", HAZARDS, ids=lambda hazard: hazard["id"])
def test_every_hazard_has_a_requirement_a_test_of_it_and_a_control_to_take_out(hazard: dict[str, Any]) -> None:
    assert hazard["test"] in shown_by()[hazard["requirement"]]
    text = (ROOT / hazard["file"]).read_text(encoding="utf-8")
    assert text.count(hazard["old"]) == 1, f"{hazard['file']} no longer holds the control once: {hazard['old']}"
    assert hazard["new"] not in ("", hazard["old"]) or hazard["old"].strip()


@pytest.mark.parametrize("hazard", HAZARDS, ids=lambda hazard: hazard["id"])
def test_every_hazard_is_graded_and_says_what_remains_and_for_what_it_is_claimed(hazard: dict[str, Any]) -> None:
    assert hazard["severity"] in SEVERITIES
    assert hazard["probability_before"] in PROBABILITIES
    assert hazard["probability_after"] in PROBABILITIES
    found = measured(hazard)
    least = grade_of(SHARES[hazard["probability_before"]] * (1.0 - found.held / found.of)) if found and found.of else 1
    assert hazard["probability_after"] >= least, "better than what was observed"
    changes = hazard["probability_after"] < hazard["probability_before"]
    assert changes or hazard["probability_after"] == least, "a control that changes nothing is none"
    assert hazard["residual"].strip()
    assert hazard["claimed_for"] in CLAIMS


@pytest.mark.parametrize("hazard", HAZARDS, ids=lambda hazard: hazard["id"])
def test_what_a_simulated_device_does_is_claimed_of_virtual_devices_only(hazard: dict[str, Any]) -> None:
    assert not hazard["file"].startswith("drivers/simulated/") or hazard["claimed_for"] == "virtual devices only"


def test_a_hazard_keeps_its_id() -> None:
    """None is used twice, none is passed over but those that went."""
    ids = [hazard["id"] for hazard in HAZARDS] + list(RISKS["retired"])
    assert sorted(ids) == [f"HZ-{number:02d}" for number in range(1, len(ids) + 1)]


def test_a_fall_is_of_the_gravest_severity() -> None:
    gravest = max(SEVERITIES)
    assert "fall" in SEVERITIES[gravest]
    throws = ("a fall", "wrong phase", "wrong foot", "while the person stands", "outside the swing", "cannot stop it")
    for hazard in HAZARDS:
        if any(words in hazard["hazard"] for words in throws):
            assert hazard["severity"] == gravest, hazard["id"]


def test_what_is_not_acceptable_has_a_decision_and_nothing_else_has_one() -> None:
    for hazard in HAZARDS:
        assert needs_a_decision(hazard) == ("decision" in hazard), hazard["id"]
    assert {hazard["decision"] for hazard in HAZARDS if "decision" in hazard} == set(DECISIONS)
    for decision in DECISIONS.values():
        assert all(decision[key].endswith(".") for key in ("grounds", "operator"))


def test_every_row_of_the_campaign_is_evidence_for_a_hazard() -> None:
    (table,) = Result.read(RESULTS / "hil.json").tables
    asked = [hazard["campaign"] for hazard in HAZARDS if "campaign" in hazard]
    assert not [row[0] for row in table.rows if not any(re.fullmatch(rows, row[0]) for rows in asked)]


def test_no_number_of_a_hazard_is_written_by_hand() -> None:
    names = re.compile(r"\b(?:SR-\d+|T[1-6])\b")
    for hazard in (*HAZARDS, *DECISIONS.values()):
        for key in hazard.keys() & {"hazard", "cause", "control", "residual", "measured", "grounds", "operator"}:
            assert not re.search(r"\d", names.sub("", NAMED.sub("", hazard[key]))), hazard[key]


def test_a_number_that_there_is_not_is_an_error() -> None:
    assert filled("{constant: fes.limits:MAX_DATA_AGE_MS, .0f} ms") == "40 ms"
    for wrong in ("{constant: fes.limits}", "{constant: fes.limits:NONE, .0f}", "{figure: hil; none; .*; one (1)}"):
        with pytest.raises((ValueError, AttributeError)):
            filled(wrong)
    with pytest.raises(ValueError, match="no row"):
        campaign("a fault that nobody injects")


def test_what_a_count_bears() -> None:
    """Against the closed form of no miss in n, 1 - 0.05^(1/n), and the ends of the scale."""
    assert Measured("", 400, 400).most_missed == pytest.approx(1.0 - 0.05 ** (1.0 / 400.0))
    assert Measured("", 0, 4).most_missed == 1.0
    assert Measured("", 90, 100).most_missed > 0.1
    assert [grade_of(share) for share in (0.0, 1e-6, 2e-6, 1e-4, 1e-2, 0.02, 0.1, 0.2, 1.0)] == [
        1,
        1,
        2,
        2,
        3,
        4,
        4,
        5,
        5,
    ]


def test_what_is_probable_and_serious_is_not_acceptable() -> None:
    assert acceptability(3, 1) == acceptability(1, 3) == "acceptable"
    assert acceptability(3, 2) == acceptability(4, 1) == "as low as practicable"
    assert acceptability(3, 3) == acceptability(4, 2) == "not acceptable"


def test_documents_that_are_not_generated_are_there() -> None:
    for name in ("intended_use.md", "safety.md", "mutants.md"):
        assert Path(DOCS / name).read_text(encoding="utf-8").startswith("# ")


# --- the pages that are written by hand -----------------------------------------------------------------------

BY_HAND = ("dossier.md", "closed_loop.md", "security.md", "usability.md")
MOST_WORDS = 2500
COMMENT = re.compile(r"<!--.*?-->")
RENDERED = re.compile(r"<!-- (?:figure|constant): [^>]+ -->[^<]+<!-- / -->")
NAMES = re.compile(
    r"`[^`]+`|\]\([^)]+\)|\b(?:ISO|IEC) \d+(?:-\d+)*|\b(?:FDA|of) 2023\b|\b(?:HZ|SR)-\d+\b|\bT[1-6]\b|^\d\. ",
    re.MULTILINE,
)


@pytest.mark.parametrize("name", BY_HAND)
def test_a_page_by_hand_holds_no_number_that_is_not_computed(name: str) -> None:
    """Beyond constants and figures, which `tests/test_figures.py` renders anew, and names."""
    text = NAMES.sub("", RENDERED.sub("", (DOCS / name).read_text(encoding="utf-8")))
    assert not [line for line in text.splitlines() if re.search(r"\d", line)]


@pytest.mark.parametrize("name", BY_HAND)
def test_a_page_by_hand_names_hazards_requirements_and_tests_that_there_are(name: str) -> None:
    text = (DOCS / name).read_text(encoding="utf-8")
    ids = {hazard["id"] for hazard in HAZARDS} | set(REQUIREMENTS)
    assert set(re.findall(r"\b(?:HZ|SR)-\d+\b", text)) <= ids
    for file, test in re.findall(r"`(tests/[\w/.]+)::(\w+)`", text):
        assert re.search(rf"^def {test}\b", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), test


def test_the_pages_by_hand_are_short() -> None:
    """Words, without the rows that figures fill."""
    lines = [line for name in BY_HAND for line in (DOCS / name).read_text(encoding="utf-8").splitlines()]
    text = COMMENT.sub(" ", "\n".join(line for line in lines if not (line.startswith("|") and "<!-- figure" in line)))
    assert sum(bool(re.search("[a-z]", word, re.IGNORECASE)) for word in text.split()) <= MOST_WORDS
