"""The shank's constants chosen again with each patient left out, and judged on that patient; 3 without data.

    python benchmarks/shank_choice.py [--data FOLDER]

Eleven settings around the default of ``fes.estimation.shank.motion``. The others choose by the number of their strides
in order, as ``shank_phases.py`` counts them; about four minutes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table
from shank_phases import evaluate
from stroke_treadmill import data_folder

from fes.estimation.shank import motion as shank_levels

SETTINGS: tuple[dict[str, float], ...] = (
    {},
    {"FLAT_TO_PEAK": 0.2},
    {"FLAT_TO_PEAK": 0.3},
    {"STILL_PER_FLOOR": 1.4},
    {"STILL_PER_FLOOR": 2.2},
    {"LEAVE_ACC": 1.5},
    {"LEAVE_ACC": 1.0},
    {"RISING_SHARE": 0.25},
    {"CONTACT_SHARE": 0.2},
    {"PUSH_OFF_SHARE": 0.55},
    {"PUSH_OFF_SHARE": 0.25},
)
Tally = tuple[int, int]


def tally(folder: Path, setting: dict[str, float]) -> dict[str, Tally]:
    """Patient → strides in order, and all strides, with a setting."""
    before = {name: getattr(shank_levels, name) for name in setting}
    try:
        for name, value in setting.items():
            setattr(shank_levels, name, value)
        found: dict[str, Tally] = {}
        for path in sorted((folder / "stroke_treadmill").glob("*.npz")):
            patient = path.stem.split("_")[0]
            for side in evaluate(path):
                in_order, strides = found.get(patient, (0, 0))
                found[patient] = in_order + side.in_order, strides + side.strides
        return found
    finally:
        for name, value in before.items():
            setattr(shank_levels, name, value)


def named(setting: dict[str, float]) -> str:
    """The setting in words."""
    return ", ".join(f"{name} {value:g}" for name, value in setting.items()) or "default"


def main() -> int:
    """Print every setting's shares, and what the others would choose for each patient."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder with stroke_treadmill/ below")
    folder = parser.parse_args().data
    results = [tally(folder, setting) for setting in SETTINGS]
    patients = list(results[0])
    if not patients:
        print(f"No recordings in {folder / 'stroke_treadmill'}; set FES_DATA or give --data.", file=sys.stderr)
        return 3
    console = Console() if sys.stdout.isatty() else Console(width=120)
    table = Table("setting", *patients)
    for setting, found in zip(SETTINGS, results, strict=True):
        table.add_row(named(setting), *(f"{100 * found[p][0] / found[p][1]:.2f} %" for p in patients))
    console.print(table)
    total = [0, 0]
    for patient in patients:
        best = max(range(len(SETTINGS)), key=lambda k: sum(results[k][p][0] for p in patients if p != patient))
        in_order, strides = results[best][patient]
        total = [total[0] + in_order, total[1] + strides]
        console.print(
            f"{patient} left out: the others choose {named(SETTINGS[best])}; {in_order} of {strides} in order"
        )
    console.print(f"Left out, in all: {total[0]} of {total[1]} ({100 * total[0] / total[1]:.2f} %)")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
