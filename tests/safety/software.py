"""Software items with their safety class, and the software of others: the lists, and the bill of materials."""

from __future__ import annotations

import ast
import hashlib
import json
import re
import tomllib
import uuid
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from risks import HAZARDS, REGENERATE, ROOT, filled

SOFTWARE: dict[str, Any] = tomllib.loads(Path(__file__).with_name("software.toml").read_text(encoding="utf-8"))
ITEMS: dict[str, dict[str, str]] = SOFTWARE["item"]
CLASSES = {
    "A": "no injury can come of a failure",
    "B": "an injury that is not serious",
    "C": "death or a serious injury",
}
DISTRIBUTIONS = {"can": "python-can", "serial": "pyserial"}  # of those that are imported under another name
LOADED_BY_OTHERS = {"llvmlite": "numba", "websockets": "uvicorn"}  # as much part of what runs as what loads them
BILL = ROOT / "locks" / "run.cdx.json"


# --- items --------------------------------------------------------------------------------------------------


def item_of(module: str) -> str:
    """The software item that a module is part of, by the longest name.

    Raises:
        ValueError: none.
    """
    return max((item for item in ITEMS if module == item or module.startswith(f"{item}.")), key=len)


@cache
def modules() -> dict[str, Path]:
    """Every module of the product, but the packages' own faces ``fes`` and ``fes.__main__``."""
    found = {}
    for top in ("fes", "drivers", "statemachine"):
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return {name: path for name, path in found.items() if name != "fes"}


@cache
def imported(module: str) -> frozenset[str]:
    """All names that a module imports, wherever in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(modules()[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= (inner & set(modules())) or {node.module}
    return frozenset(found)


@cache
def used_items() -> dict[str, set[str]]:
    """Item → the other items that it imports."""
    found: dict[str, set[str]] = {item: set() for item in ITEMS}
    for module in modules():
        found[item_of(module)] |= {item_of(name) for name in imported(module) if name in modules()}
    return {item: used - {item} for item, used in found.items()}


@cache
def users_of() -> dict[str, set[str]]:
    """Package of the lock file → the items that import it, or what loads it."""
    found: dict[str, set[str]] = {}
    for module in modules():
        for name in imported(module):
            top = name.split(".")[0]
            package = DISTRIBUTIONS.get(top, top)
            if package in locked("locks/run.lock"):
                found.setdefault(package, set()).add(item_of(module))
    for package, loader in LOADED_BY_OTHERS.items():
        found[package] = set(found[loader])
    return found


def class_of(package: str) -> str:
    """The highest class of an item that uses it."""
    return max(ITEMS[item]["class"] for item in users_of()[package])


def software_page() -> str:
    """docs/software.md."""
    controls: dict[str, list[str]] = {}
    for hazard in HAZARDS:
        module = hazard["file"].removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        controls.setdefault(item_of(module), []).append(hazard["id"])
    items = "\n".join(
        f"| `{name}` | {item['class']} | {item['why']} | {', '.join(controls.get(name, ())) or '–'} |"
        for name, item in ITEMS.items()
    )
    apart = "\n".join(f"| `{each['user']}` | `{each['used']}` | {each['why']} |" for each in SOFTWARE["apart"])
    versions, users = locked("locks/run.lock"), users_of()
    others = "\n".join(
        f"| {package} | {' or '.join(versions[package])} | {class_of(package)} | `{'`, `'.join(sorted(items))}` |"
        for package, items in sorted(users.items())
    )
    anomalies = "\n".join(
        f"| {each['package']} | {each['name']} | {filled(each['here'])} | `{each['test']}` |".replace("`–`", "–")
        for each in sorted(
            ({"test": "–"} | each for each in SOFTWARE["anomaly"]), key=lambda each: str(each["package"])
        )
    )
    classes = "\n".join(f"| {name} | {text} |" for name, text in CLASSES.items())
    return f"""# Software items and software of others

{REGENERATE} The source is `tests/safety/software.toml`. After IEC 62304: classes of items, and what is known of the
software that others wrote.

## Items

| class | what may come of a failure |
|---|---|
{classes}

The software as a whole is of class C. What an item of class C uses is of class C as well; a test reads every import
and holds that, but for the pairs below. The supervisor's process and the stimulator's own lease are apart from the
controller, yet no class is lowered for them. Controls in `drivers.simulated` are those of a stimulator's firmware: a
real one must have them.

| item | class | why | controls of hazards in it |
|---|---|---|---|
{items}

| item | uses, of a lower class | what keeps them apart |
|---|---|---|
{apart}

## Software of others that is imported

All packages with their licences, those included that only these bring along: [third-party software](third_party.md).
The same as a CycloneDX bill of materials: `locks/run.cdx.json`, written by `make docs`. None was developed for
medical use.

| package | version | class | items that use it |
|---|---|---|---|
{others}

## What is known to go wrong in it

Looked through on {SOFTWARE["anomalies"]["looked"]:%Y-%m-%d}: issues of each project that a search for what is used of
it brought up. That is no complete review. Issues are those of the package's own project, by number.

| package | known | here | test |
|---|---|---|---|
{anomalies}
"""


# --- packages -----------------------------------------------------------------------------------------------


@cache
def locked(name: str) -> dict[str, list[str]]:
    """Package → its versions in a lock file: one, or one for each of several versions of Python."""
    found: dict[str, list[str]] = {}
    text = (ROOT / name).read_text(encoding="utf-8")
    for package, version in re.findall(r"^([A-Za-z0-9._-]+)(?:\[[^]]*\])?==([^\s;\\]+)", text, re.MULTILINE):
        found.setdefault(package, []).append(version)
    return found


def licence(package: str) -> str:
    """What the installed package says of its licence, in a few words."""
    try:
        about: Any = metadata.metadata(package)
    except metadata.PackageNotFoundError:
        return "not installed on this system"
    if about.get("License-Expression"):
        return str(about["License-Expression"])
    classes = [text.rsplit(" :: ", 1)[-1] for text in about.get_all("Classifier") or [] if text.startswith("License")]
    words = ", ".join(dict.fromkeys(classes)) or str(about.get("License") or "").strip().split("\n")[0]
    return words if 0 < len(words) < 80 else "see its own files"


def third_party_page() -> str:
    """docs/third_party.md."""
    runs, develops = locked("locks/run.lock"), locked("locks/dev.lock")
    only = {name: found for name, found in develops.items() if name not in runs}
    tables = [
        "\n".join(f"| {name} | {' or '.join(found)} | {licence(name)} |" for name, found in sorted(packages.items()))
        for packages in (runs, only)
    ]
    head = "| package | version | licence |\n|---|---|---|\n"
    return f"""# Third-party software

{REGENERATE} Versions are those of the lock files, by which `make` installs with hashes; licences are what the
installed packages say of themselves. Of two versions the first is for older versions of Python. The report's charts use
uPlot (MIT), which lies in `fes/report/static/` with its licence.

## In the product (`locks/run.lock`)

{head}{tables[0]}

## For its development and tests (`locks/dev.lock`), and devices' own libraries that not everybody needs

{head}{tables[1]}
"""


def told_licences() -> dict[str, str]:
    """Package → licence, as docs/third_party.md has it."""
    page = (ROOT / "docs" / "third_party.md").read_text(encoding="utf-8")
    return dict(re.findall(r"^\| ([\w.-]+) \| [^|]+ \| ([^|]+) \|$", page, re.MULTILINE))


INSTALLED = ("fast", "analysis", "live", "cohort")


def asked_for(project: dict[str, Any]) -> list[str]:
    """What pyproject.toml asks for of locks/run.lock: the core and the extras that `make` installs with it."""
    extras = project["optional-dependencies"]
    all_of_them = [*project["dependencies"], *(each for name in INSTALLED for each in extras[name])]
    return [each for each in all_of_them if not each.startswith(project["name"])]  # an extra made of another one


def bill_of_materials(licences: dict[str, str]) -> str:
    """locks/run.cdx.json: CycloneDX 1.6 of the lock file, the same for the same lock file and licences.

    Licences are names as the packages have them, no identifiers: not all of them say one. Which files of a package are
    meant stands in the lock file, whose digest is told; a component has one file for each system.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    digest = hashlib.sha256((ROOT / "locks" / "run.lock").read_bytes()).hexdigest()
    runs = dict(sorted(locked("locks/run.lock").items()))

    def reference(name: str, version: str) -> str:
        return f"pkg:pypi/{name.lower()}@{version}"

    own = reference(project["name"], project["version"])
    direct = sorted({re.split(r"[\[<>=~! ;]", each)[0] for each in asked_for(project)} & set(runs))
    bill = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_OID, own + digest)}",
        "version": 1,
        "metadata": {
            "component": {
                "type": "application",
                "bom-ref": own,
                "name": project["name"],
                "version": project["version"],
                "description": project["description"],
                "licenses": [{"license": {"id": project["license"]}}],
                "purl": own,
            },
            "properties": [{"name": "fes:lock:sha256", "value": digest}],
        },
        "components": [
            {
                "type": "library",
                "bom-ref": reference(name, version),
                "name": name,
                "version": version,
                "scope": "required",
                "licenses": [{"license": {"name": licences[name]}}],
                "purl": reference(name, version),
            }
            for name, versions in runs.items()
            for version in versions
        ],
        "dependencies": [
            {"ref": own, "dependsOn": [reference(name, version) for name in direct for version in runs[name]]},
        ],
    }
    return json.dumps(bill, indent=1, ensure_ascii=False) + "\n"
