"""Requirements, hazards, and what ties them to tests and to what was measured.

No number in them is written by hand: they are constants of the program and figures of ``benchmarks/results/``.
"""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from scipy.stats import beta

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks.lib.figures import RESULTS, Result, constant, figure  # noqa: E402

TESTS = ROOT / "tests"
DOCS = ROOT / "docs"
REQUIREMENTS: dict[str, dict[str, str]] = tomllib.loads(
    Path(__file__).with_name("requirements.toml").read_text(encoding="utf-8")
)
RISKS: dict[str, Any] = tomllib.loads(Path(__file__).with_name("hazards.toml").read_text(encoding="utf-8"))
HAZARDS: list[dict[str, Any]] = RISKS["hazard"]
DECISIONS: dict[str, dict[str, str]] = RISKS["decision"]
REGENERATE = "Written by `make docs`; do not edit by hand."


# --- numbers ------------------------------------------------------------------------------------------------

NAMED = re.compile(r"\{(constant|figure): ([^}]+)\}")
CONSTANT = re.compile(r"([\w.]+):([\w.]+), ([\w.,+]+)(?:, × (\S+))?")


@cache
def filled(text: str) -> str:
    """The text with its constants of the program and figures of results.

    Raises:
        ValueError, FileNotFoundError, ImportError, AttributeError: one that there is not.
    """

    def number(found: re.Match[str]) -> str:
        if found[1] == "figure":
            return figure(found[2])
        asked = CONSTANT.fullmatch(found[2])
        if asked is None:
            raise ValueError(f"no constant: {found[2]}")
        return constant(*asked.groups())

    return NAMED.sub(number, text)


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
    3: "serious: an injury that needs treatment, such as a burn",
    4: "critical: lasting injury or death. A fall of a stroke survivor is always one, whatever comes of it",
}
# The highest share of sessions in which the harm comes, of each grade.
SHARES = {1: 1e-6, 2: 1e-4, 3: 1e-2, 4: 1e-1, 5: 1.0}
PROBABILITIES = {
    1: "improbable: not expected in the life of an installation",
    2: "remote",
    3: "occasional",
    4: "probable",
    5: "frequent",
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


def needs_a_decision(hazard: dict[str, Any]) -> bool:
    """Whether its risk is not acceptable with its control either."""
    return acceptability(hazard["severity"], hazard["probability_after"]) == "not acceptable"


@dataclass(frozen=True)
class Measured:
    """What a result says of a control: in words, and in how many of so many cases it held, where that was counted."""

    text: str
    held: int = 0
    of: int = 0

    @property
    def most_missed(self) -> float:
        """The upper end of the one-sided 95 % interval of the share that gets past it (Clopper and Pearson, 1934)."""
        return 1.0 if self.held == 0 else float(beta.ppf(0.95, self.of - self.held + 1, self.held))


CELL = re.compile(r"\W*(?:([\d.]+) ms, )?.*?(\d+) of (\d+)\W*")


def campaign(rows: str) -> Measured:
    """The rows of the fault campaign whose names match: how many attempts were as required, and the longest time.

    Raises:
        ValueError: no row does.
    """
    (table,) = Result.read(RESULTS / "hil.json").tables
    held = of = 0
    nearest = (0.0, "")  # share of its deadline, in words
    for fault, deadline, *cells in table.rows:
        if not re.fullmatch(rows, fault):
            continue
        for cell in cells:
            found = CELL.fullmatch(cell)
            if found is None:
                continue
            held, of = held + int(found[2]), of + int(found[3])
            if found[1] and deadline.endswith(" ms"):
                words = f"{found[1]} of {deadline} ({fault})"
                nearest = max(nearest, (float(found[1]) / float(deadline.removesuffix(" ms")), words))
    if not of:
        raise ValueError(f"no row of the campaign: {rows}")
    time = f", nearest to its deadline {nearest[1]}" * bool(nearest[1])
    return Measured(f"`hil`: {held} of {of} attempts as required{time}", held, of)


def measured(hazard: dict[str, Any]) -> Measured | None:
    """What was measured of its control."""
    rows = campaign(hazard["campaign"]) if "campaign" in hazard else None
    if "measured" not in hazard:
        return rows
    sources = dict.fromkeys(re.findall(r"\{figure: ([\w-]+)", hazard["measured"]))
    text = f"{', '.join(f'`{name}`' for name in sources)}: {filled(hazard['measured'])}" + (
        f"; {rows.text}" if rows else ""
    )
    if "of" not in hazard:
        return Measured(text)
    of = int(filled(hazard["of"]).replace(",", ""))
    if "missed" in hazard:
        held = of - int(filled(hazard["missed"]))
    elif "held" in hazard:
        held = int(filled(hazard["held"]))
    else:
        held = round(of * float(filled(hazard["held_percent"])) / 100.0)
    return Measured(text, held, of)


def grade_of(share: float) -> int:
    """The least probability that is not exceeded."""
    return min(grade for grade, most in SHARES.items() if most >= share * (1.0 - 1e-9))


def evidence(hazard: dict[str, Any]) -> str:
    """As a cell: what was measured, what the count alone bears; or that there is none."""
    found = measured(hazard)
    if found is None:
        return "no rate: its test only"
    if not found.of:
        return found.text
    alone = grade_of(SHARES[hazard["probability_before"]] * found.most_missed)
    return f"{found.text}; at most {100.0 * found.most_missed:.1f} % get past it: P{alone} by the count alone"


def counted(when: str) -> str:
    """How many hazards are how acceptable, as cells."""
    words = [acceptability(h["severity"], h[f"probability_{when}"]) for h in HAZARDS]
    return " | ".join(str(words.count(word)) for word in ("acceptable", "as low as practicable", "not acceptable"))


def scale(letter: str, grades: dict[int, str]) -> str:
    """A scale's rows."""
    return "\n".join(f"| {letter}{grade} | {text} |" for grade, text in grades.items())


COLUMNS = ("id", "hazard", "cause", "risk before", "control", "risk after", "measured", "what remains")
COLUMNS += ("claimed for", "requirement", "test that needs it")


def header(columns: tuple[str, ...]) -> str:
    """A table's first two lines."""
    return f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}"


def hazards_page() -> str:
    """docs/hazards.md."""
    rows = "\n".join(
        f"| {h['id']} | {h['hazard']} | {filled(h['cause'])} | {risk(h, 'before')} | {filled(h['control'])} "
        f"| {risk(h, 'after')} | {evidence(h)} | {filled(h['residual'])} | {h['claimed_for']} | {h['requirement']} "
        f"| `{h['test']}` |"
        for h in HAZARDS
    )
    decisions = "\n".join(
        f"| {decision['title']} | {', '.join(h['id'] for h in HAZARDS if h.get('decision') == name)} "
        f"| {decision['grounds']} | {decision['operator']} |"
        for name, decision in DECISIONS.items()
    )
    shares = {
        grade: f"{text} (at most once in {1.0 / SHARES[grade]:,.0f} sessions)"
        if grade < 5
        else f"{text} (in every session)"
        for grade, text in PROBABILITIES.items()
    }
    claims = "\n".join(f"| {name} | {text} |" for name, text in CLAIMS.items())
    return f"""# Hazards

{REGENERATE} The source is `tests/safety/hazards.toml`.

After the manner of ISO 14971: what can hurt, what causes it, what controls it. For every row `make hazards` takes the
control out of a scratch copy of the code and runs the test named: it must pass before and fail after. What no
software controls (skin, electrodes' places, the choice of patient, falls for other reasons) is in [intended
use](intended_use.md). Which test and which measurement stand behind a row is in [traceability](traceability.md).

## Scales

Severity is of the harm itself. Stimulation that comes or stays against the phase of a person on their feet may throw
them, and so may lift that stays away: such rows are graded as a fall. Probability is of that harm with the harness or
the person at the side that the intended use asks for, before: without the control, and after: with it. All grades are
judgements of those who wrote the software, from tests, simulations and recordings. None was measured in use: there
has been no use with people. Whoever does use it has to judge anew.

| severity | |
|---|---|
{scale("S", SEVERITIES)}

| probability | |
|---|---|
{scale("P", shares)}

Both grades are added up. Up to 4: acceptable. 5: acceptable when as low as practicable, and watched. More: not
acceptable.

| claimed for | |
|---|---|
{claims}

## How far the counts carry

*Measured* names the file of [results](hil_results.md) in `benchmarks/results/` and what it says. Where cases were
counted, the share that gets past the control is given with the upper end of its one-sided 95 % interval, and the
grade that it leaves of the grade before. That takes the cases for a fair draw of what happens in use, which they are
not: they are simulated faults, recorded walks and virtual patients.

No grade after is better than what the observed share leaves; a test holds that. Where it is better than the upper end
leaves, the difference rests on the test and on how the control is made, not on a count. Where a control lowers a risk
by less than a grade, both grades are the same.

| | acceptable | as low as practicable | not acceptable |
|---|---|---|---|
| before | {counted("before")} |
| after | {counted("after")} |

## Not acceptable with the control: who decides

Most of these are S4 P2: a fall, though a remote one. This software has no further control that would lower them.
Those who wrote it do not decide that they may be taken. For a study, its medical lead proposes, the ethics committee
approves, and the physician decides for each person. Without these three, do not stimulate anybody who stands or walks.
The benefit side is empty so far: that anybody walks better or falls less often with this software has not been shown.

| what stays | hazards | grounds that may be weighed | what the operator must do |
|---|---|---|---|
{decisions}

## Hazards

{header(COLUMNS)}
{rows}
"""


# --- traceability -------------------------------------------------------------------------------------------


def traceability_page() -> str:
    """docs/traceability.md."""
    rows = []
    for name in REQUIREMENTS:
        mine = [hazard for hazard in HAZARDS if hazard["requirement"] == name]
        tests = shown_by().get(name, [])
        for hazard in mine:
            found = measured(hazard)
            rows.append(
                f"| {name} | {hazard['id']} | {filled(hazard['cause'])} | `{hazard['test']}` | {len(tests) - 1} "
                f"| {found.text if found else 'the tests'} |"
            )
        if not mine:
            rows.append(f"| {name} | – | – | `{tests[0]}` | {len(tests) - 1} | the tests |")
    table = "\n".join(rows)
    return f"""# From requirements to what was measured

{REGENERATE} A row leads from a [requirement](requirements.md) to a [hazard](hazards.md) that it is for, to the test
that fails without the hazard's control, and to what was measured: rows of the [fault campaign](hil_results.md)
(`hil`) and other files of `benchmarks/results/`. How many more tests show the requirement is told; their names stand
with it.

| requirement | hazard | cause | test that needs the control | more tests | evidence |
|---|---|---|---|---|---|
{table}
"""
