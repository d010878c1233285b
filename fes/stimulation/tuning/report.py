"""What a rule is given and what it proposes, and what the tuning says of it, in the units that people read."""

from dataclasses import dataclass
from typing import Literal, Protocol

from fes.signals import StrideResult
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.targets import Reading

Kind = Literal["change", "suggestion", "skip", "hint", "roll_back", "fault", "frozen"]


@dataclass(frozen=True, slots=True)
class Seen:
    """A stride for a rule: walked with ``given`` at ``intensity`` (0–1); ``skipped``: why it teaches nothing, or ""."""

    stride: StrideResult
    reading: Reading | None  # None where it teaches nothing
    given: BurstParameters
    charge_uc: float
    intensity: float
    skipped: str = ""
    noticed: str = ""  # what the watch named in this stride


@dataclass(frozen=True, slots=True)
class Proposal:
    """What a rule wants: other settings with its reason, or only to say something; ``stop``: nothing any more."""

    text: str
    wanted: BurstParameters | None = None
    stop: bool = False


class Rule(Protocol):
    """Of one channel; what an entry point of the group ``fes.tuners`` makes from the channel's settings."""

    def stride(self, seen: Seen) -> Proposal | None:
        """The newest stride; what is to come of it, None for nothing."""

    def acted(self, what: str, incline: float | None = None) -> None:
        """A person acted: "resumed", "rolled back", or "ground" with its rise over run (None: unknown)."""


@dataclass(frozen=True, slots=True)
class TuningReport:
    """One thing the tuning did, would do, or did not do, and why.

    ``before`` and ``after`` are the parameters of the next burst, the same unless ``kind`` is "change" or "roll_back"
    (then they are in force) or "suggestion" (then ``after`` waits for a person).
    """

    t_ns: int
    channel: int
    kind: Kind
    text: str
    before: BurstParameters
    after: BurstParameters

    @property
    def skipped(self) -> bool:
        """Whether its stride taught nothing, though the settings may have changed for it."""
        return " skipped: " in self.text

    @property
    def severity(self) -> str:
        """For the session log."""
        return "warning" if self.kind in ("hint", "roll_back", "fault") else "info"
