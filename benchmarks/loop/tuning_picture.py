"""Draw ``docs/tuning.svg``: a virtual patient's walk being tuned, and an electrode that slips in it."""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt

from benchmarks.loop.closed_loop_walk import walk
from benchmarks.loop.tuning import FAULT_STRIDE, SECONDS, STRIDES, TRIALS, person, session_of
from benchmarks.loop.tuning_cohort import BAND_MM, WIDTH_US
from fes.control.controller import Controller
from fes.simulation.forward import VirtualPatient


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=140003)
    parser.add_argument("--out", type=Path, default=Path("docs/tuning.svg"))
    asked = parser.parse_args()
    trial = TRIALS["slip"]
    one = person(asked.seed, trial.who, second=False)
    widths: list[tuple[float, float]] = []
    marks: list[tuple[int, str, str]] = []
    controller: list[Controller] = []

    def during(patient: VirtualPatient, _: int) -> None:
        walked = sum(stride.foot == "right_foot" for stride in patient.strides)
        if walked > len(widths):
            now = controller[0].tuning.tuners[0].parameters.widths_us
            widths.append((now[0], now[-1]))
        if walked >= FAULT_STRIDE and not marks:
            marks.append((len(widths), "tab:red", "slips"))
            trial.acts[FAULT_STRIDE](patient, one.settings)

    session = session_of(one.made(one.settings).geometry["right_foot"], "tuner")
    done = walk(one.settings, session, one.calibration, SECONDS, STRIDES, during, prepare=controller.append)
    clear_mm = [1e3 * stride.toe_clearance_m for stride in done.measured if stride.valid][:STRIDES]
    named = [report.t_ns for report in done.reports if report.kind == "fault"]
    marks += [(sum(stride.t_flat_ns <= t_ns for stride in done.strides), "0.4", "named") for t_ns in named]
    mpl.rcParams.update({"svg.hashsalt": "tuning", "svg.fonttype": "none"})  # the same file again, and small
    figure, (top, low) = plt.subplots(2, sharex=True, figsize=(9, 5.4), layout="constrained")
    top.axhspan(*BAND_MM, color="#d9e6d3")
    top.plot(range(1, len(clear_mm) + 1), clear_mm, "o", markersize=4)
    top.set(title="toe clearance (mm), target in green", ylim=(0, 60))
    low.plot(range(1, len(widths) + 1), widths, label=("front", "tail"))
    low.set(title="pulse width (µs), 50 mA", ylim=(0, WIDTH_US), xlabel="stride")
    low.legend(loc="lower right")
    for axes in (top, low):
        for number, color, word in marks:
            axes.axvline(number, color=color, linestyle="--", linewidth=1)
            axes.annotate(word, (number, axes.get_ylim()[1]), (4, -12), textcoords="offset points", color=color)
    figure.savefig(asked.out, metadata={"Date": None})


if __name__ == "__main__":
    main()
