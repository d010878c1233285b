"""The generated safety documents: requirements with their tests, hazards with their controls, third-party software.

``python tests/safety/documents.py --write`` writes them into docs/; ``test_documents.py`` fails while one is out of
date.
"""

from __future__ import annotations

import argparse
import ast
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
TESTS = ROOT / "tests"
DOCS = ROOT / "docs"
REQUIREMENTS: dict[str, dict[str, str]] = tomllib.loads(
    Path(__file__).with_name("requirements.toml").read_text(encoding="utf-8")
)
HAZARDS: list[dict[str, Any]] = tomllib.loads(Path(__file__).with_name("hazards.toml").read_text(encoding="utf-8"))[
    "hazard"
]
REGENERATE = "Written by `make docs`; do not edit by hand."


# --- requirements and their tests ---------------------------------------------------------------------------


def marked(node: ast.AST) -> Iterator[str]:
    """The requirements that a test's decorators name."""
    for decorator in getattr(node, "decorator_list", []):
        if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "pytest.mark.requirement":
            yield from (str(ast.literal_eval(argument)) for argument in decorator.args)


@cache
def shown_by() -> dict[str, list[str]]:
    """Requirement → tests that show it, as file::name, in order."""
    found: dict[str, list[str]] = {}
    for path in sorted(TESTS.rglob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                for requirement in marked(node):
                    found.setdefault(requirement, []).append(f"{path.relative_to(ROOT).as_posix()}::{node.name}")
    return {requirement: sorted(tests) for requirement, tests in sorted(found.items())}


def requirements_page() -> str:
    """docs/requirements.md."""
    found = shown_by()
    parts = [f"# Safety requirements and the tests that show them\n\n{REGENERATE}\n"]
    parts.append(
        "A test names the requirements that it shows with `@pytest.mark.requirement`. "
        "`pytest -m requirement` runs them all.\n"
    )
    for name, requirement in REQUIREMENTS.items():
        tests = "\n".join(f"- `{test}`" for test in found.get(name, [])) or "- none"
        parts.append(f"## {name}\n\n{requirement['text']}\n\n{tests}\n")
    return "\n".join(parts)


# --- hazards ------------------------------------------------------------------------------------------------


SEVERITIES = {
    1: "negligible: inconvenience, or nothing but a lost record",
    2: "minor: pain, a spasm or irritated skin that passes by itself",
    3: "serious: an injury that needs treatment; a fall, a burn, a cramp under load",
    4: "critical: lasting injury or death",
}
PROBABILITIES = {
    1: "improbable: not expected in the life of an installation",
    2: "remote: once in 10,000 sessions",
    3: "occasional: once in 100 sessions",
    4: "probable: once in 10 sessions",
    5: "frequent: in every session",
}
CLAIMS = {
    "the software": "shown by tests of this code, whatever the device",
    "recordings and virtual patients": "shown on recorded walks and virtual patients, not in use",
    "virtual devices only": "shown on simulated devices; of a real one it must be shown anew before use",
}


def acceptability(severity: int, probability: int) -> str:
    """In words, whether a risk may remain: by the sum of both grades."""
    total = severity + probability
    return "acceptable" if total <= 4 else "as low as practicable" if total == 5 else "not acceptable"


def risk(hazard: dict[str, Any], when: str) -> str:
    """Severity, probability and acceptability ``before`` or ``after`` the control, as a cell of the table."""
    severity, probability = hazard["severity"], hazard[f"probability_{when}"]
    return f"S{severity} P{probability}: {acceptability(severity, probability)}"


def scale(letter: str, grades: dict[int, str]) -> str:
    """A scale's rows."""
    return "\n".join(f"| {letter}{grade} | {text} |" for grade, text in grades.items())


def hazards_page() -> str:
    """docs/hazards.md."""
    rows = "\n".join(
        f"| {h['hazard']} | {h['cause']} | {risk(h, 'before')} | {h['control']} | {risk(h, 'after')} | {h['residual']} "
        f"| {h['claimed_for']} | {h['requirement']} | `{h['test']}` |"
        for h in HAZARDS
    )
    open_risks = "\n".join(
        f"- {h['cause']}: {h['residual']}" for h in HAZARDS if risk(h, "after").endswith("not acceptable")
    )
    claims = "\n".join(f"| {name} | {text} |" for name, text in CLAIMS.items())
    return f"""# Hazards

{REGENERATE} The source is `tests/safety/hazards.toml`.

After the manner of ISO 14971: what can hurt, what causes it, what controls it. For every row `make hazards` takes the
control out of a scratch copy of the code and runs the test named: it must pass before and fail after. What no software
controls (skin, electrodes' places, the choice of patient, falls for other reasons) is in
[intended use](intended_use.md).

## Scales

Severity is of the harm that the hazard may lead to, with the harness or the person at the side that the intended use
asks for. Probability is of that harm, before: without the control, and after: with it. All grades are judgements of
those who wrote the software, from tests, simulations and recordings. None was measured in use: there has been no use
with people. Whoever does use it has to judge anew.

| severity | |
|---|---|
{scale("S", SEVERITIES)}

| probability | |
|---|---|
{scale("P", PROBABILITIES)}

Both grades are added up. Up to 4: acceptable. 5: acceptable when as low as practicable, and watched. More: not
acceptable.

| claimed for | |
|---|---|
{claims}

## Not acceptable with the control

{open_risks or "None."}

## Hazards

| hazard | cause | risk before | control | risk after | what remains | claimed for | requirement | test that needs it |
|---|---|---|---|---|---|---|---|---|
{rows}
"""


# --- third-party software -----------------------------------------------------------------------------------


def locked(name: str) -> dict[str, str]:
    """Package → version of a lock file."""
    text = (ROOT / name).read_text(encoding="utf-8")
    return dict(re.findall(r"^([A-Za-z0-9._-]+)(?:\[[^]]*\])?==([^\s;\\]+)", text, re.MULTILINE))


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
    only = {name: version for name, version in develops.items() if name not in runs}
    tables = [
        "\n".join(f"| {name} | {version} | {licence(name)} |" for name, version in sorted(packages.items()))
        for packages in (runs, only)
    ]
    head = "| package | version | licence |\n|---|---|---|\n"
    return f"""# Third-party software

{REGENERATE} Versions are those of the lock files, by which `make` installs with hashes; licences are what the installed
packages say of themselves. The report's charts use uPlot (MIT), which lies in `fes/report/static/` with its licence.

## In the product (`locks/run.lock`)

{head}{tables[0]}

## For its development and tests (`locks/dev.lock`), and devices' own libraries that not everybody needs

{head}{tables[1]}
"""


PAGES = {
    "requirements.md": requirements_page,
    "hazards.md": hazards_page,
    "third_party.md": third_party_page,
}


def main() -> None:
    """Write the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", required=True, help="write them into docs/")
    parser.parse_args()
    for name, page in PAGES.items():
        (DOCS / name).write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
