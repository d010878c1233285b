"""Draw ``docs/tuning.svg``: a virtual patient's walk being tuned, and an electrode that slips in it.

python benchmarks/loop/tuning_picture.py [--seed 140003] [--out docs/tuning.svg]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.loop.closed_loop_walk import walk
from benchmarks.loop.tuning import FAULT_STRIDE, SECONDS, STRIDES, TRIALS, person, session_of
from benchmarks.loop.tuning_cohort import BAND_MM, WIDTH_US
from fes.control.controller import Controller
from fes.simulation.forward import VirtualPatient

WIDE, HIGH, LEFT, GAP = 900, 200, 60, 40
FRONT, TAIL, GREY, RED = "#1f5fa8", "#d08a1c", "#d9e6d3", "#b03030"


def points(values: Sequence[float], most: float, top: int, last: int) -> list[tuple[float, float]]:
    """Where values of strides 1 … ``last`` lie in a panel that begins at ``top``."""
    step = (WIDE - LEFT - 20) / max(last - 1, 1)
    return [(LEFT + n * step, top + HIGH * (1.0 - min(max(value, 0.0), most) / most)) for n, value in enumerate(values)]


def panel(top: int, most: float, label: str, ticks: Sequence[float]) -> list[str]:
    """Frame, ticks and label."""
    lines = [f'<rect x="{LEFT}" y="{top}" width="{WIDE - LEFT - 20}" height="{HIGH}" fill="none" stroke="#888"/>']
    for tick in ticks:
        y = top + HIGH * (1.0 - tick / most)
        lines.append(f'<text x="{LEFT - 6}" y="{y + 4:.0f}" text-anchor="end">{tick:g}</text>')
    lines.append(f'<text x="{LEFT}" y="{top - 8}">{label}</text>')
    return lines


def main() -> None:
    """Walk and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=140003)
    parser.add_argument("--out", type=Path, default=Path("docs/tuning.svg"))
    asked = parser.parse_args()
    trial = TRIALS["slip"]
    one = person(asked.seed, trial.who, second=False)
    widths: list[tuple[float, float]] = []
    happened: list[int] = []

    def during(patient: VirtualPatient, _: int) -> None:
        walked = sum(stride.foot == "right_foot" for stride in patient.strides)
        if walked > len(widths):
            now = controller[0].tuning.tuners[0].parameters.widths_us
            widths.append((now[0], now[-1]))
        if walked >= FAULT_STRIDE and not happened:
            happened.append(len(widths))
            trial.acts[FAULT_STRIDE](patient, one.settings)

    controller: list[Controller] = []
    session = session_of(one.made(one.settings).geometry["right_foot"], "tuner")
    done = walk(one.settings, session, one.calibration, SECONDS, STRIDES, during, prepare=controller.append)
    clear_mm = [1e3 * stride.toe_clearance_m for stride in done.measured if stride.valid][:STRIDES]
    last, top, low = STRIDES, 30, 30 + HIGH + GAP
    most_mm = 60.0
    svg = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDE} {low + HIGH + 40}" font-family="sans-serif" '
        'font-size="13"><rect width="100%" height="100%" fill="white"/>',
    ]
    ys = [top + HIGH * (1.0 - edge / most_mm) for edge in BAND_MM]
    svg.append(
        f'<rect x="{LEFT}" y="{ys[1]:.0f}" width="{WIDE - LEFT - 20}" height="{ys[0] - ys[1]:.0f}" fill="{GREY}"/>'
    )
    svg += panel(top, most_mm, "toe clearance (mm), target in green", (0, 10, 40, 60))
    svg += [
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{FRONT}"/>' for x, y in points(clear_mm, most_mm, top, last)
    ]
    svg += panel(low, WIDTH_US, "pulse width (µs): front blue, tail orange; 50 mA", (0, 100, 200, 300))
    for which, color in ((0, FRONT), (1, TAIL)):
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points([pair[which] for pair in widths], WIDTH_US, low, last))
        svg.append(f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="2"/>')
    marks = [(happened[0], RED, "slips")] if happened else []
    for report in done.reports:
        if report.kind == "fault":
            number = sum(stride.t_flat_ns <= report.t_ns for stride in done.strides)
            marks.append((number, "#555", "named"))
    for number, color, word in marks:
        x = points([0.0] * max(number, 1), 1.0, top, last)[-1][0]
        svg.append(
            f'<line x1="{x:.1f}" y1="{top}" x2="{x:.1f}" y2="{low + HIGH}" stroke="{color}" stroke-dasharray="4 3"/>'
        )
        svg.append(f'<text x="{x + 4:.1f}" y="{top + 14}" fill="{color}">{word}</text>')
    svg.append(f'<text x="{WIDE - 20}" y="{low + HIGH + 24}" text-anchor="end">stride, 1 to {last}</text></svg>')
    asked.out.write_text("\n".join(svg) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
