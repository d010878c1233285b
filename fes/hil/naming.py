"""Does the session say why it is off, and is it the reason that was given to it?"""

from __future__ import annotations

from fes.hil.rig import LATCHED, Rig
from fes.hil.scenarios import Scenario

__all__ = ["LATCHED", "badly_named", "is_latched", "named_now"]


def named_now(rig: Rig) -> str:
    """The session's reason; "" when it gives none."""
    status = rig.status() if rig.session().alive else None
    return status.fault if status else ""


def is_latched(rig: Rig) -> bool:
    """Whether only a person leads on."""
    status = rig.status()
    return status is not None and status.state in LATCHED


def badly_named(named: str, scenario: Scenario) -> list[str]:
    """What is wrong with the reason, if anything."""
    if scenario.restart or not scenario.words or any(word in named for word in scenario.words):
        return []
    return [f"the reason given is {named!r}, it should speak of {' or '.join(scenario.words)}"]
