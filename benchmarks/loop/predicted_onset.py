"""Bursts that begin when the heel is expected to rise, against those that begin when it is seen to.

Every foot goes twice through controller and gate, as in a session that is armed again at once after a fault: with
``onset = "detected"`` and ``"predicted"``. docs/phases.md says what the columns are. A false start is a burst begun
early after which T1 does not come for 150 ms; *extra* are bursts of the predicted session without a counterpart in the
detected one. ``LEAD_NS`` is chosen by data: the longest with which one start in a thousand is false at most; at last
that choice is made for each person by all others.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise, takewhile
from pathlib import Path

import numpy as np

from benchmarks.lib.channels import channel
from benchmarks.lib.command_line import parser_of, publish, spread, table_of, verdict
from benchmarks.lib.real_sets import data_folder, trials
from benchmarks.lib.swing_judge import later_ms
from benchmarks.lib.walkers import DRIFTING, LYING, calibrated, feet_of
from fes.analysis.swings import find_swings
from fes.config import Session
from fes.control.controller import Controller, towards_heel_rise
from fes.estimation.sensor_choice import Calibration, tracker_of
from fes.gate.gate import gate_of
from fes.recording import Track
from fes.recording.tracks import newer_samples
from fes.signals import NS_PER_S, ImuSample, OperatorAct, OperatorAction, StrideResult
from fes.stimulation import onset
from fes.stimulation.walking import WalkingJudge
from statemachine.phases import PhaseChange, Transition

SETS = ("gaitmap_walk", "footswitch_treadmill", "stroke_treadmill", "stroke_walks", "ruler_walks")
LEADS_MS = (20, 30, 40, 50, 60, 80)
MOST_FALSE = 0.01
NEAR_MS = 400.0
MS = 1e-6


@dataclass
class Walked:
    """One foot's track with its person and, where there is one, the truth of its heel rises (ns)."""

    group: str
    person: str
    track: Track
    rises_ns: list[int] = field(default_factory=list)


@dataclass
class Early:
    """One burst begun early; ``came_ns`` is None for a false start."""

    began_ns: int
    expected_ns: float
    came_ns: int | None


@dataclass
class Figures:
    """Of one set, in ms; lists are per burst."""

    feet: int = 0
    feet_used: int = 0
    bursts: int = 0
    lost: int = 0
    extra: int = 0
    false: int = 0
    cut: int = 0
    before: list[float] = field(default_factory=list)
    off: list[float] = field(default_factory=list)
    detected_late: list[float] = field(default_factory=list)
    predicted_late: list[float] = field(default_factory=list)
    longer: list[float] = field(default_factory=list)
    charge: list[tuple[float, float]] = field(default_factory=list)  # detected and predicted, mA s


def walks(data: Path, wanted: Iterable[str]) -> Iterator[Walked]:
    """The bundled trials, then the sets."""
    for name, recording, truth in trials():
        for foot, track in recording.tracks.items():
            rises = [round(1e9 * s.t_pre_swing_s) for s in truth.strides_of(foot) if s.walking]
            yield Walked("bundled trials", name, track, rises)
    for each in feet_of(data, wanted):
        rises = [round(1e9 * s["t_pre_swing_s"]) for s in each.marked_strides() if "t_pre_swing_s" in s]
        if each.labels is not None and each.person not in LYING and each.run not in DRIFTING:
            swings = find_swings(each.track.t_ns, each.track.acc_mps2, each.track.gyr_radps)
            labels = (each.labels.times(*stride).get(Transition.T1) for stride in pairwise(swings.sure.tolist()))
            rises += [label for label in labels if label is not None]
        yield Walked(each.data_set, each.person, each.track, rises)


# --- through controller and gate --------------------------------------------------------------------------------------


@dataclass
class Bursts:
    """What a session made of a walk: bursts let out (from, to), phases, and what was begun early."""

    spans: list[tuple[int, int]] = field(default_factory=list)
    charges: list[float] = field(default_factory=list)  # of each, mA s
    rises_ns: list[int] = field(default_factory=list)
    contacts: list[tuple[int, float]] = field(default_factory=list)  # and the current then (mA)
    early: list[Early] = field(default_factory=list)


def session(foot: str, how: str) -> Session:
    """One channel on tibialis anterior."""
    own = channel(foot, {"max_charge_per_minute_mc": 100.0}, onset=how)
    return Session.model_validate({"name": "onset", "channels": [own]})


def stimulated(track: Track, calibration: Calibration, how: str) -> Bursts:
    """One walk through controller and gate."""
    settings = session(track.sensor, how)
    controller = Controller(settings, {track.sensor: calibration})
    gate = gate_of(settings, {track.sensor: calibration.up})
    found, began_ns, current_ma, since_ns, charge = Bursts(), None, 0.0, 0, 0.0
    foreseen = controller.onsets.get(track.sensor)
    t_ns, acc, gyr = newer_samples(track)
    for at_ns, force, rate in zip(t_ns.tolist(), acc.tolist(), gyr.tolist(), strict=True):
        events: list[ImuSample | OperatorAct] = [ImuSample(at_ns, track.sensor, at_ns, tuple(force), tuple(rate))]
        if not gate.armed:
            events.append(OperatorAct(at_ns, OperatorAction.ARM))
            events.append(OperatorAct(at_ns, OperatorAction.SET_INTENSITY, 1.0))
        for event in events:
            gate.observe(event)
            used = foreseen is not None and foreseen.used
            decision = controller.step(event)
            for outcome in decision.outcomes:
                if isinstance(outcome, PhaseChange) and outcome.transition is Transition.T3:
                    found.contacts.append((at_ns, current_ma))
                elif isinstance(outcome, PhaseChange) and outcome.transition is Transition.T1:
                    found.rises_ns.append(at_ns)
            if foreseen is not None and foreseen.used and not used:
                found.early.append(Early(at_ns, foreseen.expected_ns or 0.0, None))
            for request in decision.requests:
                command = gate.judge(at_ns, request)
                charge += current_ma * (at_ns - since_ns) / NS_PER_S
                current_ma, since_ns = command.current_ma, at_ns
                if command.on and began_ns is None:
                    began_ns, charge = at_ns, 0.0
                elif not command.on and began_ns is not None:
                    found.spans.append((began_ns, at_ns))
                    found.charges.append(charge)
                    began_ns = None
    found.early = [early for early in found.early if early.began_ns + onset.FALSE_NS <= t_ns[-1]]
    for early in found.early:
        after = (rise for rise in found.rises_ns if early.began_ns < rise <= early.began_ns + onset.FALSE_NS)
        early.came_ns = next(after, None)
    return found


def judge(walk: Walked, calibration: Calibration, figures: Figures) -> None:
    """Add one foot's figures to its set's."""
    detected, predicted = (stimulated(walk.track, calibration, how) for how in ("detected", "predicted"))
    true = [early for early in predicted.early if early.came_ns is not None]
    figures.feet += 1
    figures.feet_used += bool(predicted.early)
    figures.bursts += len(detected.spans)
    figures.false += len(predicted.early) - len(true)
    figures.extra += sum(
        not any(begin < span[1] and span[0] < end for begin, end in detected.spans) for span in predicted.spans
    )
    figures.before += [MS * (early.came_ns - early.began_ns) for early in true if early.came_ns is not None]
    figures.off += [MS * (early.expected_ns - early.came_ns) for early in true if early.came_ns is not None]
    at_contact = dict(detected.contacts)
    early_at = {early.began_ns for early in true}
    with_charges = list(zip(predicted.spans, predicted.charges, strict=True))
    for (begin, end), charge in zip(detected.spans, detected.charges, strict=True):
        same = [(span, own) for span, own in with_charges if span[0] < end and begin < span[1]]
        figures.lost += not same
        if len(same) == 1 and same[0][0][0] in early_at:
            (began, ended), own = same[0]
            figures.longer.append(MS * ((ended - began) - (end - begin)))
            figures.charge.append((charge, own))
            there = next(((t, ma) for t, ma in predicted.contacts if t > begin), None)
            figures.cut += there is not None and there[1] < at_contact.get(there[0], 0.0) - 0.5
    for late, spans in ((figures.detected_late, detected.spans), (figures.predicted_late, predicted.spans)):
        late += later_ms((1e-9 * begin for begin, _ in spans), (1e-9 * rise for rise in walk.rises_ns), NEAR_MS)


# --- the lead, with the person left out -------------------------------------------------------------------------------


def starts(track: Track, calibration: Calibration) -> dict[int, tuple[int, int]]:
    """By lead (ms), how many bursts would begin early and how many of them would be false."""
    tracker = tracker_of(Session(name="onset"), calibration)
    walking = WalkingJudge(session(track.sensor, "detected").stimulation)
    foreseen = {lead: onset.OnsetPredictor(lead * onset.MS) for lead in LEADS_MS}
    count: dict[int, list[int]] = {lead: [0, 0] for lead in LEADS_MS}
    t_ns, acc, gyr = newer_samples(track)
    for at_ns, force, rate in zip(t_ns.tolist(), acc.tolist(), gyr.tolist(), strict=True):
        for outcome in tracker.step(at_ns, tuple(force), tuple(rate)):
            if isinstance(outcome, StrideResult):
                walking.on_stride(outcome)
                continue
            permitted = walking.on_phase(outcome)
            for each in foreseen.values():
                each.on_phase(outcome, permitted)
        walking.on_time(at_ns)
        seen = towards_heel_rise(tracker) if any(each.watching for each in foreseen.values()) else None
        for lead, each in foreseen.items():
            if seen is not None and each.starts(at_ns, *seen):
                each.used = each.in_use and walking.walking
                count[lead][0] += each.used
            count[lead][1] += sum(severity == "warning" for severity, _, _ in each.said)
            each.said.clear()
    return {lead: (counted[0], counted[1]) for lead, counted in count.items()}


def chosen(counts: dict[tuple[str, str], dict[int, tuple[int, int]]], without: str) -> int:
    """The longest lead up to which one in a thousand of the others' starts is false at most."""
    others = [by_lead for (_, person), by_lead in counts.items() if person != without]
    sound = takewhile(lambda lead: sum(o[lead][1] for o in others) <= 1e-3 * sum(o[lead][0] for o in others), LEADS_MS)
    return max(sound, default=LEADS_MS[0])


def rows(groups: dict[str, Figures]) -> list[list[str]]:
    found = []
    for name, f in groups.items():
        early = len(f.before) + f.false
        share = f"{100.0 * early / f.bursts:.0f} % ({f.feet_used} of {f.feet} feet)" if f.bursts else "–"
        false = f"{100.0 * f.false / early:.2f} ({f.false})" if early else "–"
        cells = [name, str(f.bursts), share, spread(f.before), spread(f.off), false, str(f.extra), str(f.lost)]
        cells += [spread(f.detected_late), spread(f.predicted_late), spread(f.longer)]
        detected, predicted = np.sum(f.charge, axis=0) if f.charge else (np.nan, np.nan)
        cells.append(f"{100.0 * (predicted / detected - 1.0):+.1f}" if f.charge else "–")
        found.append([*cells, f"{100.0 * f.cut / len(f.longer):.1f}" if f.longer else "–"])
    return found


TITLES = (
    "set", "bursts", "used", "before T1", "off", "false per 100", "extra", "lost", "late, detected", "late, predicted",
    "longer", "charge", "cut per 100",
)  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--only", nargs="*", default=list(SETS), choices=SETS)
    options = parser.parse_args(arguments)
    groups: dict[str, Figures] = {}
    counts: dict[tuple[str, str], dict[int, tuple[int, int]]] = {}
    for walk in walks(options.data, options.only):
        if (calibration := calibrated(walk.track)) is None:
            continue
        judge(walk, calibration, groups.setdefault(walk.group, Figures()))
        own = counts.setdefault((walk.group, walk.person), dict.fromkeys(LEADS_MS, (0, 0)))
        for lead, (early, false) in starts(walk.track, calibration).items():
            own[lead] = own[lead][0] + early, own[lead][1] + false
        print(walk.group, walk.person, walk.track.sensor, own, file=sys.stderr, flush=True)
    table = table_of("ms, median [5–95 %]", TITLES, rows(groups))
    leads = {key: chosen(counts, key[1]) for key in counts}
    total = [sum(by_lead[leads[key]][which] for key, by_lead in counts.items()) for which in (0, 1)]
    every = [
        f"{lead} ms: {sum(c[lead][1] for c in counts.values())} of {sum(c[lead][0] for c in counts.values())}"
        for lead in LEADS_MS
    ]
    picks = ", ".join(f"{lead} ms for {list(leads.values()).count(lead)}" for lead in sorted(set(leads.values())))
    by_lead = (
        f"False starts of all sets by lead: {'; '.join(every)}. Chosen for each person by all others: {picks}; with "
        f"that {total[1]} of {total[0]} starts were false."
    )
    publish([table], options, [by_lead])
    held = all(f.false <= MOST_FALSE * max(len(f.before), 100) for f in groups.values())
    return verdict(held)


if __name__ == "__main__":
    raise SystemExit(main())
