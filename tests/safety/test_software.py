"""Software items, the software of others, and the bill of materials."""

from __future__ import annotations

import ast
import json
import math
import re
import tomllib
from typing import Any

import pytest
from gate_bench import make_limits
from pydantic import ValidationError
from risks import HAZARDS, ROOT
from software import (
    BILL,
    CLASSES,
    ITEMS,
    SOFTWARE,
    asked_for,
    bill_of_materials,
    class_of,
    item_of,
    locked,
    modules,
    told_licences,
    used_items,
    users_of,
)

from fes.config import ChannelLimits, Session
from fes.config.base import Settings
from fes.control.controller import Controller
from fes.signals import OperatorAct, OperatorAction


def test_every_module_is_part_of_an_item_and_every_item_has_one() -> None:
    assert {item_of(module) for module in modules()} == set(ITEMS)
    assert {item["class"] for item in ITEMS.values()} == set(CLASSES)


def test_what_an_item_uses_is_of_no_lower_class_but_where_it_is_kept_apart() -> None:
    lower = {
        (user, used)
        for user, all_used in used_items().items()
        for used in all_used
        if ITEMS[used]["class"] < ITEMS[user]["class"]
    }
    assert lower == {(each["user"], each["used"]) for each in SOFTWARE["apart"]}


def test_what_controls_a_serious_harm_is_of_the_highest_class() -> None:
    """But for a stimulator's firmware, which is simulated here."""
    lower = {
        item
        for hazard in HAZARDS
        if hazard["severity"] >= 3
        and ITEMS[item := item_of(hazard["file"].removesuffix(".py").replace("/", "."))]["class"] != "C"
    }
    assert lower == {"drivers.simulated"}


def test_gate_plan_phases_and_supervisor_are_of_the_highest_class() -> None:
    for module in ("fes.gate.gate", "fes.stimulation.plan", "statemachine.machine", "fes.live.supervisor"):
        assert ITEMS[item_of(module)]["class"] == "C"


def test_of_every_package_that_may_hurt_it_is_said_what_is_known() -> None:
    assert {package for package in users_of() if class_of(package) in "BC"} == {
        each["package"] for each in SOFTWARE["anomaly"]
    }
    for each in SOFTWARE["anomaly"]:
        assert "://" not in each["name"] + each["here"]


def test_a_test_that_an_anomaly_names_is_there() -> None:
    for named in (each["test"] for each in SOFTWARE["anomaly"] if "test" in each):
        file, _, name = named.partition("::")
        assert re.search(rf"^def {name}\b", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), named


def test_no_compiled_code_assumes_that_numbers_are_finite() -> None:
    """Of fastmath only contraction is allowed; everything else may pass NaN by."""
    found = [
        (path.name, ast.unparse(keyword.value))
        for path in modules().values()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call)
        for keyword in node.keywords
        if keyword.arg == "fastmath"
    ]
    assert found == [("jit.py", "{'contract'}")]


def test_no_setting_takes_a_number_that_is_none() -> None:
    assert Settings.model_config["allow_inf_nan"] is False


# --- the bill of materials -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bill() -> dict[str, Any]:
    told: dict[str, Any] = json.loads(BILL.read_text(encoding="utf-8"))
    return told


def test_the_bill_of_materials_is_that_of_the_lock_file() -> None:
    assert BILL.read_text(encoding="utf-8") == bill_of_materials(told_licences()), (
        "run.cdx.json is out of date: make docs"
    )


def test_the_bill_of_materials_names_every_package_once(bill: dict[str, Any]) -> None:
    runs = locked("locks/run.lock")
    pairs = [(name, version) for name, versions in runs.items() for version in versions]
    assert sorted((each["name"], each["version"]) for each in bill["components"]) == sorted(pairs)


def test_the_bill_of_materials_is_built_as_cyclonedx_asks(bill: dict[str, Any]) -> None:
    """What the schema of CycloneDX 1.6 asks of the parts that are used."""
    assert (bill["bomFormat"], bill["specVersion"], bill["version"]) == ("CycloneDX", "1.6", 1)
    assert re.fullmatch(r"urn:uuid:[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}", bill["serialNumber"])
    assert set(bill) == {
        "bomFormat",
        "specVersion",
        "serialNumber",
        "version",
        "metadata",
        "components",
        "dependencies",
    }
    everything = [bill["metadata"]["component"], *bill["components"]]
    references = [each["bom-ref"] for each in everything]
    assert len(set(references)) == len(references)
    for each in everything:
        assert each["type"] in ("application", "library")
        assert re.fullmatch(r"pkg:pypi/[a-z0-9._-]+@[0-9][\w.+-]*", each["purl"])
        (choice,) = each["licenses"]
        assert set(choice["license"]) in ({"id"}, {"name"})
        assert each.get("scope", "required") == "required"
    for each in bill["dependencies"]:
        assert {each["ref"], *each["dependsOn"]} <= set(references)
        assert len(set(each["dependsOn"])) == len(each["dependsOn"])


def test_the_bill_of_materials_names_no_registry() -> None:
    assert "://" not in BILL.read_text(encoding="utf-8")


def test_what_the_project_asks_for_is_what_the_bill_says_it_depends_on(bill: dict[str, Any]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (own,) = bill["dependencies"]
    said = {reference.removeprefix("pkg:pypi/").partition("@")[0] for reference in own["dependsOn"]}
    assert said == {re.split(r"\W*[<>=]", each)[0] for each in asked_for(project)}


# --- How a session begins ---


@pytest.mark.requirement("SR-17")
def test_intensity_starts_at_nothing() -> None:
    assert Controller(Session(name="x"), {}).intensity == 0.0


@pytest.mark.requirement("SR-17")
@pytest.mark.parametrize(("asked", "set_to"), [(0.5, 0.5), (7.0, 1.0), (-1.0, 0.0), (math.nan, 0.0), (math.inf, 1.0)])
def test_intensity_stays_between_nothing_and_all(asked: float, set_to: float) -> None:
    controller = Controller(Session(name="x"), {})
    controller.step(OperatorAct(0, OperatorAction.SET_INTENSITY, asked))
    assert controller.intensity == set_to


@pytest.mark.requirement("SR-17")
@pytest.mark.parametrize("missing", sorted(ChannelLimits.model_fields))
def test_each_single_limit_must_be_stated(missing: str) -> None:
    assert ChannelLimits.model_validate(make_limits())
    with pytest.raises(ValidationError, match=missing):
        ChannelLimits.model_validate({name: value for name, value in make_limits().items() if name != missing})
