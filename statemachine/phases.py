"""The four gait phases of Negård et al. (2005), Figure 5, and the six transitions' names."""

from dataclasses import dataclass
from enum import IntEnum


class Phase(IntEnum):
    """Gait phase of one foot; the numbers are what compiled code and logs carry."""

    STANCE = 0
    PRE_SWING = 1
    SWING = 2
    LOADING_RESPONSE = 3


class Transition(IntEnum):
    """T1–T6 of Negård et al. (2005); 0 means that no transition fired."""

    NONE = 0
    T1 = 1
    T2 = 2
    T3 = 3
    T4 = 4
    T5 = 5
    T6 = 6


@dataclass(frozen=True, slots=True)
class PhaseChange:
    """One foot went from one phase into another.

    ``t_ns`` is the time stamp of the sample at which the guard fired, ``foot`` the sensor's name.
    """

    t_ns: int
    foot: str
    transition: Transition
    source: Phase
    destination: Phase
