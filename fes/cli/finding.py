"""What a check before a session found, and how it is told."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Final

import click


class Verdict(StrEnum):
    """Whether a session can be begun with it."""

    OK = "ok"
    WARNING = "warning"
    FAILURE = "failure"


@dataclass(frozen=True, slots=True)
class Finding:
    """One check: what was looked at, what was found, and for what is not right the ``remedy``."""

    name: str
    verdict: Verdict
    said: str
    remedy: str = ""


COLOURS: Final = {Verdict.OK: "green", Verdict.WARNING: "yellow", Verdict.FAILURE: "red"}


def ok(name: str, said: str) -> Finding:
    """All is well."""
    return Finding(name, Verdict.OK, said)


def warning(name: str, said: str, remedy: str) -> Finding:
    """It works, at a cost that ``said`` names."""
    return Finding(name, Verdict.WARNING, said, remedy)


def failure(name: str, said: str, remedy: str) -> Finding:
    """A session would not begin, or not hold."""
    return Finding(name, Verdict.FAILURE, said, remedy)


def tell(finding: Finding) -> None:
    """One line, the remedy under it."""
    word = click.style(f"{finding.verdict:<8}", fg=COLOURS[finding.verdict])
    click.echo(f"{word} {finding.name}: {finding.said}")
    if finding.remedy:
        click.echo(f"{'':<9}→ {finding.remedy}")


def as_json(findings: Iterable[Finding]) -> str:
    """``{"ok": …, "findings": […]}``."""
    listed = list(findings)
    good = all(finding.verdict is not Verdict.FAILURE for finding in listed)
    return json.dumps({"ok": good, "findings": [asdict(finding) for finding in listed]}, indent=2)
