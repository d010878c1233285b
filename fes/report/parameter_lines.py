"""Gait parameters in the terminal: a table of both sides, and a few sentences."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich import box
from rich.table import Table

from fes.analysis.hemiparetic.walk import Terrain
from fes.analysis.parameters.definitions import DEFINITIONS, STRIDE_KEYS
from fes.analysis.parameters.gait import GaitParameters
from fes.analysis.parameters.summary import Statistic
from fes.report.text import number

if TYPE_CHECKING:
    from fes.analysis.hemiparetic.walk import HemipareticWalk

DIGITS = {"m": 2, "s": 2, "m/s": 2, "cm": 1, "°": 1, "%": 1, "": 2}


def parameter_table(parameters: GaitParameters) -> Table:
    """One row per parameter: mean ± SD and CV of each foot, and the symmetry index; at most 100 columns wide."""
    table = Table(title="Gait parameters", title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    table.add_column("parameter", no_wrap=True)
    for foot in parameters.feet:
        table.add_column(f"{foot.removesuffix('_foot')}, mean ± SD", justify="right", no_wrap=True)
        table.add_column("CV %", justify="right", no_wrap=True)
    if parameters.sides:
        table.add_column("SI %", justify="right", no_wrap=True)
    for key in STRIDE_KEYS:
        values = [found[key] for found in parameters.feet.values()]
        if not any(value.n for value in values):
            continue
        known = DEFINITIONS[key]
        cells = [f"{known.name}{f' ({known.symbol})' if known.symbol else ''}, {known.shown}"]
        for value in values:
            cells += [_mean_sd(value, known.factor, DIGITS[known.shown]), number(100.0 * value.cv, 1)]
        if parameters.sides:
            both = parameters.sides.get(key)
            cells.append(number(both.index_percent if both is not None else math.nan, 1))
        table.add_row(*cells)
    return table


def parameter_lines(parameters: GaitParameters, hemiparetic: HemipareticWalk | None) -> list[str]:
    """Sentences for people."""
    walk = parameters.walk
    if not any(value.n for foot in parameters.feet.values() for value in foot.values()):
        return [f"No gait parameters: {parameters.no_step_lengths or 'no steady stride'}"]
    lines = [
        f"Walk: {number(walk.walking_speed_mps, 2)} m/s, {number(walk.cadence_per_min, 1)} steps/min, "
        f"walk ratio {number(1000.0 * walk.walk_ratio_m_min, 1)} mm/(steps/min)"
        + (f", speed over belt {walk.belt_ratio:.3f}" if math.isfinite(walk.belt_ratio) else "")
    ]
    if parameters.no_step_lengths:
        lines.append(f"No step lengths: {parameters.no_step_lengths}")
    if hemiparetic is None:
        return lines
    lines.append(hemiparetic.side.words()[:1].upper() + hemiparetic.side.words()[1:])
    for foot, found in hemiparetic.terrain.items():
        counts = ", ".join(
            f"{sum(t is kind for t in found.values())} {kind}" for kind in Terrain if kind in found.values()
        )
        lines.append(f"Ground, {foot.removesuffix('_foot')}: {counts}")
    if hemiparetic.windows is None:
        lines.append(f"No windows after Wang et al.: {hemiparetic.no_windows}")
    else:
        counts = ", ".join(
            f"{len(t.windows) - 1} {f.removesuffix('_foot')}" for f, t in hemiparetic.windows.tracks.items()
        )
        lines.append(f"Strides between windows after Wang et al.: {counts}")
    return lines


def _mean_sd(value: Statistic, factor: float, digits: int) -> str:
    if not value.n:
        return "–"
    return f"{number(factor * value.mean, digits)} ± {number(factor * value.sd, digits)}"
