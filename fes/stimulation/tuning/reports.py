"""What the tuning reports: each change with its reason in words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fes.stimulation.parameters import BurstParameters

Kind = Literal["change", "suggestion", "skip", "hint", "roll_back", "frozen"]


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
    def severity(self) -> str:
        """For the session log."""
        return "warning" if self.kind in ("hint", "roll_back") else "info"


def difference(before: BurstParameters, after: BurstParameters) -> str:
    """What changes, in words; "" for nothing."""
    changes = []
    if after.current_ma != before.current_ma:
        changes.append(f"current {before.current_ma:.1f} → {after.current_ma:.1f} mA")
    moved = [(b, a) for b, a in zip(before.widths_us, after.widths_us, strict=True) if a != b]
    if moved:
        most = max(moved, key=lambda pair: abs(pair[1] - pair[0]))
        changes.append(
            f"pulse width {most[0]:.0f} → {most[1]:.0f} µs where it changes most "
            f"(mean {before.mean_width_us:.0f} → {after.mean_width_us:.0f} µs)"
        )
    if after.start_delay_s != before.start_delay_s:
        changes.append(f"start delay {1e3 * before.start_delay_s:.0f} → {1e3 * after.start_delay_s:.0f} ms")
    if after.extension_s != before.extension_s:
        changes.append(f"extension {1e3 * before.extension_s:.0f} → {1e3 * after.extension_s:.0f} ms")
    return ", ".join(changes)
