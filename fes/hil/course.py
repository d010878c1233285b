"""What happens in a closed-loop run, by the patient's own time: the same list for separate processes and for one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from fes.patient.virtual.deeds import DEEDS

ORDERS: Final = ("arm", "full", "freeze_tuning", "resume_tuning", "accept_suggestion", "roll_back")
ARM_S: Final = 4.0
FULL_S: Final = 4.5  # intensity to the session's; by hand that takes four seconds
WALK_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class Happening:
    """At ``t_s`` of the patient's time: an order of the operator (:data:`ORDERS`) or a deed to the patient."""

    t_s: float
    what: str
    value: float = 0.0

    def __post_init__(self) -> None:
        if self.what not in (*ORDERS, *DEEDS):
            raise ValueError(f"{self.what!r}: must be one of {', '.join((*ORDERS, *DEEDS))}")


@dataclass(frozen=True, slots=True)
class Course:
    """A whole run: it lasts ``seconds``; the patient begins to walk at :data:`WALK_S`."""

    seconds: float
    happenings: tuple[Happening, ...]


def course(seconds: float, further: Sequence[Happening] = ()) -> Course:
    """Armed and raised to full while the patient stands, then whatever else, by time."""
    first = (Happening(ARM_S, "arm"), Happening(FULL_S, "full"))
    return Course(seconds, tuple(sorted((*first, *further), key=lambda one: one.t_s)))
