"""The closed-loop demonstration: who walks, what happens, and what came of it."""

import csv
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from statistics import median
from typing import Any, Final

from fes.hil.closed_loop.processes import WALK_S, Happening, Protocol, armed_protocol
from fes.signals import FOOT_SENSORS, NS_PER_S
from fes.simulation.forward import PatientSettings, VirtualStride, harm_of, settings_for

SECONDS: Final = 80.0
SLIPS_S: Final = 48.0
SLIPS_TO: Final = 0.7
CURRENT_MA: Final = 12.0  # far too little for this patient
LOW_MM: Final = 10.0  # of true toe clearance: what the demonstration's tuning aims at


def patient() -> PatientSettings:
    """Who walks: a severe drop foot, feet sensors, and little habit of lifting the leg instead."""
    return settings_for("severe", seed=1, compensation=0.3, stand_s=WALK_S, sensors=FOOT_SENSORS)


def demo_protocol(seconds: float = SECONDS) -> Protocol:
    """Walk, and let an electrode slip half-way."""
    slip = (Happening(SLIPS_S, "electrode", SLIPS_TO),) if seconds > SLIPS_S else ()
    return armed_protocol(seconds, slip)


def outcome(stride: VirtualStride) -> str:
    """What became of a stride, in a word."""
    if stride.stumbled:
        return "stumbled"
    return "dragged" if stride.dragged else "low" if 1e3 * stride.toe_clearance_m < LOW_MM else "clears"


def result_of(strides: Sequence[VirtualStride]) -> dict[str, Any]:
    """What came of it: the same between processes and in one."""
    walked = [stride for stride in strides if stride.walking]
    slip_ns = round(SLIPS_S * NS_PER_S)
    parts = {
        "first_8_strides": walked[:8],
        "before_the_slip": [stride for stride in walked if stride.t_flat_ns < slip_ns][-10:],
        "last_10_strides": walked[-10:],
    }
    return {
        "strides": len(walked),
        "charge_mc": round(1e-3 * sum(stride.charge_uc for stride in walked), 2),
        "strides_until_clear": _until_clear([stride for stride in walked if stride.t_flat_ns < slip_ns]),
        "strides_until_clear_again": _until_clear([stride for stride in walked if stride.t_flat_ns >= slip_ns]),
        "harm": {key: round(value, 3) for key, value in asdict(harm_of(walked)).items()},
        **{
            name: {
                "dragged": sum(stride.dragged for stride in part),
                "stumbled": sum(stride.stumbled for stride in part),
                "median_toe_clearance_mm": round(1e3 * median(s.toe_clearance_m for s in part), 1) if part else None,
                "charge_uc_a_step": round(median(s.charge_uc for s in part), 1) if part else None,
            }
            for name, part in parts.items()
        },
    }


def _until_clear(strides: Sequence[VirtualStride]) -> int | None:
    """Which stride, counted from 1, is the first of three in a row that clear the ground; None for none."""
    clear = [outcome(stride) == "clears" for stride in strides]
    return next((n + 1 for n in range(len(clear) - 2) if all(clear[n : n + 3])), None)


def write_strides(path: Path, strides: Sequence[VirtualStride]) -> None:
    """The patient's own account of its strides, as CSV.

    Raises:
        OSError: it cannot be written.
    """
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [item.name for item in fields(VirtualStride)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(stride) for stride in strides)
