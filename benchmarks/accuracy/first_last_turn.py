"""First, last and turning steps: are their contacts and foot offs found, and if not, which rule of which guard it was.

    python benchmarks/accuracy/first_last_turn.py [--only GROUP …] [--why] [--each] [--data FOLDER] [--json FILE]

Every step that a walk really has (``true_steps.py``) is a first one of a bout, a last one, a turning one (its foot
turns by over 20° about the vertical), or mid-walk. Found is a step whose T3 (T2) comes within 200 ms of the true
contact (foot off); "with T6" counts an entry into stance by T6 as a contact. False are all T2 and T3 that belong to no
step that way, late ones among them. Phases as they come live, calibrated from the recording itself.

Truth: markers (gaitmap_walk); the simulators' own (bundled trials, and 20 virtual walks with stops and turns, of seeds
used nowhere else); on the floor (stroke_walks) the raw signals off-line, which is no more than a second opinion.
"""

from __future__ import annotations

import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import radians
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.accuracy.true_steps import Kind, Step, classified, floor_walks, marker_steps, sensor_steps
from benchmarks.lib.command_line import console_of, parser_of, publish
from benchmarks.lib.real_sets import data_folder, gaitmap_cases
from benchmarks.lib.walkers import calibrate, causal
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import stride_settings
from fes.estimation.strides.results import StrideMaker
from fes.estimation.tracking.phase_features import features_in
from fes.recording import Track, read_recording
from fes.signals import FloatArray
from fes.simulation.forward import PatientSettings, VirtualPatient, draw_patient, settings_for
from fes.simulation.forward.closed_loop import recording_of, truth_of
from fes.simulation.forward.draw import draw_movement
from fes.simulation.truth import Truth, load_truth
from statemachine.phases import PhaseChange

NEAR_S = 0.2
TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"
BUNDLED = ("negard_patient1", "negard_patient2", "both_feet_100hz", "both_feet_200hz", "misaligned", "soft_contact",
           "not_walking")  # fmt: skip
SEED, WALKS = 88_271, 10  # of healthy ones, and of drop feet
KINDS = {"mid-walk": Kind.MID, "first": Kind.FIRST, "last": Kind.LAST, "turning": Kind.TURN}


@dataclass(frozen=True, slots=True)
class Foot:
    """One foot with its true steps."""

    group: str
    name: str
    track: Track
    steps: list[Step]


@dataclass
class Found:
    """One kind of steps of one foot: errors in ms of the found ones, and why the others were not."""

    group: str
    name: str
    kind: str
    steps: int = 0
    contact_ms: list[float] = field(default_factory=list)
    off_ms: list[float] = field(default_factory=list)
    contacts_with_t6: int = 0
    why: dict[str, int] = field(default_factory=dict)


# --- walks ------------------------------------------------------------------------------------------------------------


def gaitmap(data: Path) -> Iterator[Foot]:
    for case in gaitmap_cases(data):
        side = case.track.sensor.split("_")[0]
        yield Foot("gaitmap, markers", side, case.track, marker_steps(data, side))


def of_truth(group: str, name: str, tracks: dict[str, Track], truth: Truth) -> Iterator[Foot]:
    for sensor, track in tracks.items():
        if sensor.endswith("foot"):
            steps = [
                (s.t_swing_s, s.t_loading_response_s, s.stride_length_m, s.turn_deg) for s in truth.strides_of(sensor)
            ]
            yield Foot(group, f"{name} {sensor.split('_')[0]}", track, classified(steps, 0.0, track.duration_s))


def bundled(_: Path) -> Iterator[Foot]:
    for name in BUNDLED:
        path = TRIALS / f"{name}.parquet"
        yield from of_truth("bundled", name, read_recording(path).tracks, load_truth(path))


def stop_and_go(settings: PatientSettings, name: str) -> tuple[dict[str, Track], Truth]:
    """Four bouts with stands between them; in the second and the fourth the feet turn by 60° and back.

    The simulator turns feet, not the course on its belt: who turned round would walk backward.
    """
    patient = VirtualPatient(settings)
    now_s = settings.stand_s
    samples = patient.advance(round(1e9 * now_s))
    for walk_s, turn_rad in ((18.0, 0.0), (14.0, radians(60.0)), (6.0, 0.0), (14.0, radians(-60.0))):
        patient.walk()
        for share, turn in ((0.4, turn_rad), (0.7, -turn_rad)):
            samples += patient.advance(round(1e9 * (now_s + share * walk_s)))
            patient.turn(turn)
        now_s += walk_s
        samples += patient.advance(round(1e9 * now_s))
        patient.stop()
        now_s += 6.0
        samples += patient.advance(round(1e9 * now_s))
    return recording_of(patient, samples, name, "").tracks, truth_of(patient, name)


def virtual(_: Path) -> Iterator[Foot]:
    for number in range(2 * WALKS):
        r = Random(f"{SEED}/{number}/first, last, turn")
        rate_hz = (100.0, 200.0)[number % 2]
        if number < WALKS:
            speed_mps = r.uniform(0.5, 1.5)
            settings = settings_for(
                "healthy", seed=r.randrange(1 << 30), speed_mps=speed_mps, rate_hz=rate_hz, **draw_movement(r)
            )
        else:
            settings = draw_patient(SEED, number, rate_hz=rate_hz)
        health = "healthy" if number < WALKS else "drop foot"
        name = f"{number} {settings.speed_mps:.2f} m/s {rate_hz:.0f} Hz"
        for foot in of_truth(f"virtual, {health}", name, *stop_and_go(settings, name)):
            if health == "healthy" or foot.track.sensor == settings.affected_foot:
                yield foot


def floor(data: Path) -> Iterator[Foot]:
    for person, track in floor_walks(data):
        health = "healthy" if "healthy" in person else "stroke"
        yield Foot(f"floor, {health}", f"{person.split()[0]} {track.sensor.split('_')[0]}", track, sensor_steps(track))


GROUPS = {"gaitmap": gaitmap, "bundled": bundled, "virtual": virtual, "floor": floor}


# --- one foot ---------------------------------------------------------------------------------------------------------


def nearest(times: FloatArray, true_s: float) -> float:
    """Error in s of the nearest of ``times``, infinite where there is none."""
    return float(min(times - true_s, key=abs, default=np.inf))


def judge(foot: Foot, *, why: bool) -> tuple[list[Found], dict[str, float]]:
    """Per kind, what was found; and of all steps the false T2 and T3."""
    found = {name: Found(foot.group, foot.name, name) for name in KINDS}
    calibration = calibrate(foot.track)
    if not isinstance(calibration, FootCalibration):
        raise CalibrationError(f"{foot.name}: no foot's calibration")
    changes, _ = causal(foot.track, calibration)
    times = {
        name: np.array([1e-9 * (c.t_ns - foot.track.t_sensor_ns[0]) for c in changes if c.transition.name in which])
        for name, which in (("T2", ("T2",)), ("T3", ("T3",)), ("contact", ("T3", "T6")))
    }
    trace = Trace(foot.track, calibration) if why else None
    for step in foot.steps:
        off, contact = nearest(times["T2"], step.off_s), nearest(times["T3"], step.contact_s)
        reasons = trace.why(step, abs(off) > NEAR_S, abs(contact) > NEAR_S) if trace is not None else []
        for name, kind in KINDS.items():
            if step.kind & kind or step.kind is kind:
                one = found[name]
                one.steps += 1
                one.off_ms += [1e3 * off] if abs(off) <= NEAR_S else []
                one.contact_ms += [1e3 * contact] if abs(contact) <= NEAR_S else []
                one.contacts_with_t6 += abs(nearest(times["contact"], step.contact_s)) <= NEAR_S
                one.why = dict(Counter(one.why) + Counter(reasons))
    true = {"T2": np.array([s.off_s for s in foot.steps]), "T3": np.array([s.contact_s for s in foot.steps])}
    false = {name: sum(abs(nearest(at, t)) > NEAR_S for t in times[name]) for name, at in true.items()}
    return list(found.values()), {"steps": len(foot.steps), **false}


class Trace:
    """What the guards saw at every sample, to say which of their rules held a transition up."""

    def __init__(self, track: Track, calibration: FootCalibration) -> None:
        tracker = FootTracker(calibration, StrideMaker(track.sensor, stride_settings(calibration)))
        self.t_s = 1e-9 * (track.t_sensor_ns - track.t_sensor_ns[0])
        self.phase: list[int] = []  # before the sample
        self.seen: list[Any] = []
        self.limits: list[Any] = []
        self.changes: list[tuple[float, str]] = []
        core = tracker._core
        samples = track.t_sensor_ns.tolist(), track.acc_mps2.tolist(), track.gyr_radps.tolist()
        for t_s, t_ns, acc, gyr in zip(self.t_s.tolist(), *samples, strict=True):
            self.phase.append(int(core["state"]["phase"][0]))
            outcomes = tracker.step(t_ns, tuple(acc), tuple(gyr))
            self.seen.append(features_in(core))
            self.limits.append(core["thresholds"][0].copy())
            self.changes += [(t_s, one.transition.name) for one in outcomes if isinstance(one, PhaseChange)]

    def between(self, begin_s: float, end_s: float) -> range:
        return range(*np.searchsorted(self.t_s, (begin_s, end_s)).tolist())

    def why(self, step: Step, off: bool, contact: bool) -> list[str]:
        """Why this step's foot off and contact were not found, each in one line."""
        return ([f"T2: {self._off(step)}"] if off else []) + ([f"T3: {self._contact(step)}"] if contact else [])

    def _off(self, step: Step) -> str:
        during = self.between(step.off_s - NEAR_S, step.off_s + NEAR_S)
        phases = [self.phase[i] for i in during]
        in_it = [name for t, name in self.changes if step.off_s - NEAR_S <= t <= step.off_s + NEAR_S]
        if not phases:
            return "recording cut"
        if "T5" in in_it:
            return "T5 put the foot back"
        if set(phases) == {0}:
            x, p = [self.seen[i] for i in during], self.limits[during[-1]]
            rate = max(float(p["push_off_radps"]), 0.5 * float(p["fall_radps"]))
            fast = [one for one in x if one.toe_down_radps > p["heel_rise_share"] * rate]
            if not fast:
                return "no T1: rate below heel_rise_share"
            if not any(one.turned_rad > p["turn_rad"] for one in fast):
                return "no T1: turned less than turn_rad"
            return "no T1: before lifts_after"
        if 2 in phases and phases[0] == 2:
            return "in swing already"
        if phases[-1] == 1:
            p, x = self.limits[during[-1]], self.seen[during[-1]]
            low = x.toe_down_peak_radps < p["push_off_share"] * p["push_off_radps"]
            return f"no T2: {'peak below push_off_share' if low else 'peak not left'}"
        if set(phases) == {3}:
            return "loading response goes on"
        if phases[-1] == 0:
            return "T1 late, still stance" if 3 not in phases else "loading response ends late"
        return f"other {sorted(set(phases))}"

    def _contact(self, step: Step) -> str:
        during = self.between(step.contact_s - NEAR_S, step.contact_s + NEAR_S)
        names = [(t, name) for t, name in self.changes if step.off_s - NEAR_S <= t <= step.contact_s + NEAR_S]
        if not during:
            return "recording cut"
        entered = [t for t, name in names if name == "T2"] or self.phase[during[0]] == 2
        if not entered:
            return "never in swing"
        ended = [(t, name) for t, name in names if name in ("T3", "T6") and t > step.off_s]
        if ended:
            return "T6 instead" if ended[-1][1] == "T6" else "T3 early"
        at = self.between(step.contact_s - 0.03, step.contact_s + 0.12)
        if any(self.phase[i] != 2 for i in at):
            return "not in swing at contact"
        clauses: Counter[str] = Counter()
        for i in at:
            x, p = self.seen[i], self.limits[i]
            clauses.update(held_by(x, p))
        struck = [i for i in at if not held_by(self.seen[i], self.limits[i])]
        return "no sign of contact" if struck else f"held by {clauses.most_common(1)[0][0]}"


def held_by(x: Any, p: Any) -> list[str]:
    """Which of T3's conditions on the swing before do not hold."""
    rate = max(float(p["push_off_radps"]), 0.5 * float(p["fall_radps"]))
    found = []
    if x.in_swing_s < p["shortest_swing_share"] * p["swing_s"]:
        found.append("shortest_swing_share")
    fell = x.toe_down_peak_radps + x.toe_up_peak_radps
    seen = fell >= p["mid_swing_share"] * p["fall_radps"] or x.toe_up_peak_radps >= p["toe_up_share"] * rate
    if not (seen or x.swung_rad > p["swing_turn_rad"]):
        found.append("mid_swing_share")
    rising = -x.toe_down_radps / max(x.toe_up_peak_radps, 1e-9)
    slowed = x.speed_share < p["slowed_share"] and rising < p["slowed_share"]
    if not (slowed or x.fallen_rad > p["turn_rad"]):
        found.append("slowed_share")
    return found


# --- tables -----------------------------------------------------------------------------------------------------------


def spread(ms: list[float]) -> str:
    return f"{np.median(ms):+.0f} [{np.percentile(ms, 5):.0f}, {np.percentile(ms, 95):.0f}]" if ms else "–"


def table_of(found: list[Found], false: dict[str, Counter[str]]) -> Table:
    table = Table(
        "group", "kind", "steps", "contacts %", "with T6 %", "error ms, median [5, 95]", "foot offs %",
        "error ms, median [5, 95]", "false T2, T3 /100",
        title="found within 200 ms, causal",
    )  # fmt: skip
    groups: defaultdict[tuple[str, str], list[Found]] = defaultdict(list)
    for one in found:
        groups[one.group, one.kind].append(one)
    for (group, kind), ones in groups.items():
        steps = sum(one.steps for one in ones)
        if not steps:
            continue
        contacts, offs = ([ms for one in ones for ms in getattr(one, name)] for name in ("contact_ms", "off_ms"))
        wrong = [f"{100.0 * false[group][name] / false[group]['steps']:.1f}" for name in ("T2", "T3")]
        table.add_row(
            group, kind, str(steps), f"{100.0 * len(contacts) / steps:.1f}",
            f"{100.0 * sum(one.contacts_with_t6 for one in ones) / steps:.1f}", spread(contacts),
            f"{100.0 * len(offs) / steps:.1f}", spread(offs), ", ".join(wrong) if kind == "mid-walk" else "",
        )  # fmt: skip
    return table


def main(arguments: list[str] | None = None) -> int:
    """Print the tables."""
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--only", nargs="+", choices=tuple(GROUPS), default=tuple(GROUPS), help="these groups alone")
    parser.add_argument("--why", action="store_true", help="which rule held each missed one up (slow)")
    parser.add_argument("--each", action="store_true", help="a line for every foot")
    options = parser.parse_args(arguments)
    console = console_of(170)
    found: list[Found] = []
    false: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for group in options.only:
        for foot in GROUPS[group](options.data):
            try:
                ones, wrong = judge(foot, why=options.why)
            except CalibrationError as error:
                console.print(f"{foot.group}, {foot.name}: refused, {error}", markup=False)
                ones = [
                    Found(foot.group, foot.name, name, sum(bool(s.kind & k or s.kind is k) for s in foot.steps))
                    for name, k in KINDS.items()
                ]
                wrong = {"steps": len(foot.steps), "T2": 0, "T3": 0}
            found += ones
            false[foot.group].update(wrong)
            if options.each:
                each = ", ".join(f"{o.kind} {len(o.contact_ms)}+{len(o.off_ms)}/{o.steps}" for o in ones if o.steps)
                console.print(f"{foot.group}, {foot.name}: {each}; false {wrong['T2']}, {wrong['T3']}", markup=False)
    lines = []
    if options.why:
        reasons: defaultdict[tuple[str, str], Counter[str]] = defaultdict(Counter)
        for one in found:
            reasons[one.group, one.kind].update(one.why)
        for (group, kind), count in reasons.items():
            if count:
                lines.append(f"{group}, {kind}: " + "; ".join(f"{n} {why}" for why, n in count.most_common()))
    publish(console, [table_of(found, false)], options, lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
