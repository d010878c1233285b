"""A usual channel on tibialis anterior, limits that nothing here comes near, and tables of a session file."""

from __future__ import annotations

import json
from typing import Any

LIMITS = {
    "max_current_ma": 30.0, "max_pulse_width_us": 400.0, "max_frequency_hz": 50.0, "max_charge_per_phase_uc": 10.0,
    "max_charge_per_minute_mc": 50.0, "max_current_density_ma_per_cm2": 1.0, "max_rise_ma_per_s": 1000.0,
    "max_on_s": 3.0, "min_off_s": 0.1,
}  # fmt: skip


def channel(foot: str, limits: dict[str, float] | None = None, **settings: Any) -> dict[str, Any]:
    """As a session file has it."""
    return {
        "name": "x", "number": 0, "foot": foot, "electrode_area_cm2": 25.0, "current_ma": 20.0, "pulse_width_us": 300.0,
        "frequency_hz": 40.0, "limits": LIMITS | (limits or {}), **settings,
    }  # fmt: skip


def toml(head: str, values: dict[str, Any]) -> str:
    """One table of a session file as text, tables in it inline; ``head`` is its line in brackets, or empty."""

    def of(value: Any) -> str:
        if isinstance(value, dict):
            return "{" + ", ".join(f"{name} = {of(inner)}" for name, inner in value.items()) + "}"
        return json.dumps(value, ensure_ascii=False)

    return "\n".join((head, *(f"{name} = {of(value)}" for name, value in values.items()), ""))
