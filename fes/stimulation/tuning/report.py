"""What a rule is given and what it proposes, and what the tuning says of it, in the units that people read."""

from dataclasses import dataclass
from typing import Literal, Protocol

from fes.signals import StrideResult
from fes.stimulation.envelope import BIN_S, BurstParameters
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


def difference(before: BurstParameters, after: BurstParameters) -> str:
    """What changes, in words; "" for nothing."""
    changes = []
    if after.current_ma != before.current_ma:
        changes.append(f"current {before.current_ma:.1f} → {after.current_ma:.1f} mA")
    moved = [a - b for b, a in zip(before.widths_us, after.widths_us, strict=True)]
    if any(moved):
        k = max(range(len(moved)), key=lambda k: abs(moved[k]))
        width = f"pulse width {before.widths_us[k]:.0f} → {after.widths_us[k]:.0f} µs"
        even = len(set(before.widths_us)) == len(set(after.widths_us)) == 1
        mean = f"mean {before.mean_width_us:.0f} → {after.mean_width_us:.0f} µs"
        changes.append(width if even else f"{width} {k * BIN_S:.2f} s into the burst, where it changes most ({mean})")
    for name, key in (("start delay", "start_delay_s"), ("extension", "extension_s")):
        was, becomes = getattr(before, key), getattr(after, key)
        if was != becomes:
            changes.append(f"{name} {1e3 * was:.0f} → {1e3 * becomes:.0f} ms")
    return ", ".join(changes)
