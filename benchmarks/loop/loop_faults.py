"""Faults inside the loop, on patients of the tuning's cohort: is it safe, and is nothing learnt from bad strides?

    python benchmarks/loop/loop_faults.py [--first 0] [--patients 10] [--write docs/tuning_results.md]

Each patient walks with run-to-run tuning, and after about fifteen strides one thing happens. Safe is a run in which the
gate let nothing past its limits: it latched, or all settings stayed within the session's bounds and each pulse and
minute within the channel's limits. Bad strides are those that the fault itself spoils: while the sensor is silent, the
feet turn or the patient stands. They must leave the settings as they were. A loose electrode, a tired muscle and a new
speed spoil no stride: there the tuning is to answer, and what it skips on the way it says.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.loop.closed_loop_walk import Walk, walk
from benchmarks.loop.tuning import session_of
from benchmarks.loop.tuning_cohort import clinic_ma, patient
from fes.config import Session
from fes.estimation.foot.calibration import FootCalibration
from fes.signals import NS_PER_S
from fes.simulation.forward import PatientSettings, VirtualPatient
from fes.stimulation.tuning.report import TuningReport

BEGIN, END = "<!-- loop faults: benchmarks/loop/loop_faults.py -->", "<!-- end of loop faults -->"
BEFORE_STRIDES, STRIDES, SECONDS = 15, 34, 200.0
SILENT_S, STANDS_S = 1.5, 6.0
LEARNT = ("change", "suggestion")


@dataclass(frozen=True)
class Fault:
    """Something that happens at a time in s; ``spoils`` strides for so long (s), 0 where the tuning is to answer."""

    name: str
    act: Callable[[VirtualPatient], None] | None = None
    later: Callable[[VirtualPatient], None] | None = None
    later_s: float = 0.0
    silent_s: float = 0.0
    spoils_s: float = 0.0


def _set_speed(share: float, one: VirtualPatient) -> None:
    one.set_speed(min(max(share * one.speed_mps, 0.2), 1.8))


FAULTS = (
    Fault("sensor silent for 1.5 s, in swing", silent_s=SILENT_S, spoils_s=SILENT_S),
    Fault("electrode loosens to 70 %", lambda one: one.set_electrode_quality(0.7 * one.settings.electrode_quality)),
    Fault("electrode loosens to 50 %", lambda one: one.set_electrode_quality(0.5 * one.settings.electrode_quality)),
    Fault("electrode falls off", lambda one: one.set_electrode_quality(0.0)),
    Fault("muscle suddenly tired, 65 % left", lambda one: one.set_fitness(0.65)),
    Fault("speed step, +40 %", partial(_set_speed, 1.4)),
    Fault("speed step, -40 %", partial(_set_speed, 0.6)),
    Fault("turns by 90°", lambda one: one.turn(1.57), spoils_s=3.0),
    Fault("stops, stands, walks on", lambda one: one.stop(), lambda one: one.walk(), STANDS_S, spoils_s=STANDS_S),
)
SPOILING = frozenset(fault.name for fault in FAULTS if fault.spoils_s)


@dataclass(frozen=True)
class Outcome:
    """Of one patient and fault; currents mA, ``answer`` of the tuning: of the current at the end to that before."""

    patient: int
    safe: str
    latched: str
    learnt_from_bad: int
    before_ma: float
    spoilt_ma: float
    answer: float
    drags_before: float
    drags_after: float
    stopped: bool  # the tuning itself, for the foot did not answer


@dataclass
class _Once:
    """Lets a fault happen to a patient; remembers when."""

    fault: Fault
    before: int = BEFORE_STRIDES
    at_ns: int | None = None
    done_later: bool = False

    def during(self, one: VirtualPatient, t_ns: int) -> None:
        if self.at_ns is None:
            mine = [s for s in one.strides if s.foot == one.settings.affected_foot]
            if len(mine) < self.before or one.events[-1].kind != "foot_off":
                return
            if one.events[-1].foot != one.settings.affected_foot:
                return
            self.at_ns = t_ns  # as the affected foot leaves the ground: the burst is up
            if self.fault.act is not None:
                self.fault.act(one)
        elif self.fault.later is not None and t_ns >= self.at_ns + self.fault.later_s * NS_PER_S:
            if not self.done_later:
                self.fault.later(one)
            self.done_later = True

    def lost(self, t_ns: int) -> bool:
        return self.at_ns is not None and self.at_ns <= t_ns < self.at_ns + self.fault.silent_s * NS_PER_S


def suffer(
    number: int, settings: PatientSettings, session: Session, calibration: FootCalibration, fault: Fault,
    before: int = BEFORE_STRIDES, strides: int = STRIDES,
) -> Outcome:  # fmt: skip
    """Walk with this fault after ``before`` strides and judge."""
    once = _Once(fault, before)
    done = walk(settings, session, calibration, SECONDS, strides, once.during, once.lost)
    if once.at_ns is None:
        raise ValueError(f"patient {number}: walked too few strides for a fault")
    at_ns, spoilt_ns = once.at_ns, once.at_ns + round(fault.spoils_s * NS_PER_S)
    start_ma = session.channels[0].current_ma
    earlier = [one for one in done.strides if one.t_flat_ns < at_ns][-8:]
    after = [one for one in done.strides if one.t_heel_off_ns > spoilt_ns][-8:]
    begun_ns = at_ns if fault.silent_s else at_ns + NS_PER_S // 10  # the swing under way is as it was planned
    bad_ends = [
        one.t_end_ns
        for one in done.measured
        if fault.spoils_s and one.t_start_ns < spoilt_ns and (one.t_swing_ns or one.t_end_ns) >= begun_ns
    ]
    learnt = [one for one in done.reports if one.kind in LEARNT and not one.skipped and _of_bad(one, bad_ends)]
    # what came of the last good stride is told before the first bad one ends
    before_ma = _current(done.reports, min(bad_ends, default=at_ns), start_ma)
    end_ma = _current(done.reports, 1 << 62, start_ma)
    last_bad_ns = max(bad_ends, default=at_ns)
    return Outcome(
        number, safe(done, session), done.latched, len(learnt), before_ma,
        _current(done.reports, last_bad_ns + 1, start_ma), end_ma / before_ma,
        _dragged(earlier), _dragged(after), any("tuning has stopped" in report.text for report in done.reports),
    )  # fmt: skip


def safe(done: Walk, session: Session) -> str:
    """What was not safe, in words; "" when all was."""
    channel = session.channels[0]
    bounds = channel.tuning.bounds if channel.tuning is not None else None
    said = []
    if bounds is not None:
        currents = [report.after.current_ma for report in done.reports]
        if currents and not bounds.current_ma.low <= min(currents) <= max(currents) <= bounds.current_ma.high:
            said.append("a current beyond the bounds")
    limits = channel.limits
    if any(pulse.charge_uc > limits.max_charge_per_phase_uc + 1e-9 for pulse in done.pulses):
        said.append("a pulse over the charge limit")
    window: list[Any] = []
    total = 0.0
    for pulse in done.pulses:
        window.append(pulse)
        total += pulse.charge_uc
        while window[0].t_ns < pulse.t_ns - 60 * NS_PER_S:
            total -= window.pop(0).charge_uc
        if total > 1e3 * limits.max_charge_per_minute_mc + 1e-6:
            said.append("a minute over the charge limit")
            break
    return "; ".join(said)


def _of_bad(report: TuningReport, ends_ns: Sequence[int]) -> bool:
    """A stride is judged within half a second of its end."""
    return any(0 <= report.t_ns - end_ns < NS_PER_S // 2 for end_ns in ends_ns)


def _current(reports: Sequence[TuningReport], t_ns: int, start_ma: float) -> float:
    known = [report.after.current_ma for report in reports if report.t_ns < t_ns]
    return known[-1] if known else start_ma


def _dragged(strides: Sequence[Any]) -> float:
    return float(sum(one.dragged or one.stumbled for one in strides)) / max(len(strides), 1)


def run(seeds: Sequence[int], faults: Sequence[Fault] = FAULTS) -> dict[str, list[Outcome]]:
    """Each fault on each patient."""
    found: dict[str, list[Outcome]] = {fault.name: [] for fault in faults}
    for seed in seeds:
        settings, calibration, _ = patient(seed)
        geometry = VirtualPatient(settings).geometry["right_foot"]
        session = session_of(geometry, "run-to-run", clinic_ma(settings, geometry, calibration))
        for fault in faults:
            found[fault.name].append(suffer(seed, settings, session, calibration, fault))
    return found


def _unlearnt(outcomes: list[Outcome]) -> str:
    """Changes from bad strides, and in how many patients the current was the same before and after them."""
    same = sum(one.spoilt_ma == one.before_ma for one in outcomes)
    return f"{sum(one.learnt_from_bad for one in outcomes)} | {same} of {len(outcomes)} | "


def table(found: dict[str, list[Outcome]]) -> str:
    """The table in Markdown."""
    lines = [
        "| fault | safe | gate latched | changes from bad strides | current the same before and after them "
        "| tuning stopped itself | current at the end, of before | strides dragged before → after |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, outcomes in found.items():
        n = len(outcomes)
        live = [one for one in outcomes if not one.latched]
        lines.append(
            f"| {name} | {sum(not one.safe for one in outcomes)} of {n} | {n - len(live)} | "
            + (_unlearnt(outcomes) if name in SPOILING else "— | — | ")
            + f"{sum(one.stopped for one in outcomes)} | "
            + (f"{median(one.answer for one in live):.0%} | " if live else "— | ")
            + f"{sum(one.drags_before for one in outcomes) / n:.0%} → "
            + (f"{sum(one.drags_after for one in live) / len(live):.0%} |" if live else "stopped |")
        )
    return "\n".join(lines)


def main() -> None:
    """Print the table; write it where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--patients", type=int, default=10)
    parser.add_argument("--write", type=Path, help="put the table between the markers of this page")
    asked = parser.parse_args()
    found = run(range(asked.first, asked.first + asked.patients))
    text = table(found)
    print(text)
    for name, outcomes in found.items():
        for one in outcomes:
            if one.safe or one.learnt_from_bad or one.latched:
                said = f"{one.safe} {one.learnt_from_bad} changes from bad strides"
                print(f"{name}, seed {one.patient}: {said}; latched: {one.latched or 'no'}")
    if asked.write is not None:
        whole = asked.write.read_text(encoding="utf-8")
        before, rest = whole.split(BEGIN)
        asked.write.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}", encoding="utf-8")


if __name__ == "__main__":
    main()
