"""First, last and turning steps: are their contacts and foot offs found, by the phases as they come live?

Every step that a walk really has (``true_steps.py``) is a first one of a bout, a last one, a turning one (its foot
turns by over 20° about the vertical), or mid-walk. Found is a step whose T3 (T2) comes within 200 ms of the true
contact (foot off); "with T6" counts an entry into stance by T6 as a contact. False are all T2 and T3 that belong to no
step that way. Truth: markers (gaitmap_walk); the simulators' own (bundled trials, and 20 virtual walks with stops and
turns, of seeds used nowhere else); on the floor the raw signals off-line, no more than a second opinion.
"""

from __future__ import annotations

import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import radians
from pathlib import Path
from random import Random

import numpy as np

from benchmarks.accuracy.true_steps import Kind, Step, classified, marker_steps, sensor_steps
from benchmarks.lib.command_line import parser_of, publish, spread, table_of
from benchmarks.lib.real_sets import data_folder, gaitmap_walk, trials
from benchmarks.lib.walkers import calibrate, causal, feet_of
from fes.estimation.foot.calibration import CalibrationError
from fes.recording import Track
from fes.signals import FloatArray
from fes.simulation.forward import PatientSettings, VirtualPatient, draw_patient, settings_for
from fes.simulation.forward.closed_loop import recording_of, truth_of
from fes.simulation.forward.draw import draw_movement
from fes.simulation.truth import Truth

NEAR_S = 0.2
SEED, WALKS = 88_271, 10  # of healthy ones, and of drop feet
KINDS = {"mid-walk": Kind.MID, "first": Kind.FIRST, "last": Kind.LAST, "turning": Kind.TURN}


@dataclass(frozen=True, slots=True)
class Foot:
    group: str
    name: str
    track: Track
    steps: list[Step]


@dataclass
class Found:
    """One kind of steps of one foot: errors in ms of the found ones."""

    group: str
    kind: str
    steps: int = 0
    contact_ms: list[float] = field(default_factory=list)
    off_ms: list[float] = field(default_factory=list)
    contacts_with_t6: int = 0


# --- walks ------------------------------------------------------------------------------------------------------------


def gaitmap(data: Path) -> Iterator[Foot]:
    for walk in gaitmap_walk(data):
        yield Foot("gaitmap, markers", walk.name, walk.track, marker_steps(data, walk.name))


def of_truth(group: str, name: str, tracks: dict[str, Track], truth: Truth) -> Iterator[Foot]:
    for sensor, track in tracks.items():
        if sensor.endswith("foot"):
            steps = [
                (s.t_swing_s, s.t_loading_response_s, s.stride_length_m, s.turn_deg) for s in truth.strides_of(sensor)
            ]
            yield Foot(group, f"{name} {sensor.split('_')[0]}", track, classified(steps, 0.0, track.duration_s))


def bundled(_: Path) -> Iterator[Foot]:
    for name, recording, truth in trials():
        yield from of_truth("bundled", name, recording.tracks, truth)


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
    for foot in feet_of(data, ["stroke_walks"]):
        health = "healthy" if "healthy" in foot.part else "stroke"
        yield Foot(f"floor, {health}", f"{foot.run} {foot.side}", foot.track, sensor_steps(foot.track))


GROUPS = {"gaitmap": gaitmap, "bundled": bundled, "virtual": virtual, "floor": floor}


# --- one foot ---------------------------------------------------------------------------------------------------------


def nearest(times: FloatArray, true_s: float) -> float:
    """Error in s of the nearest of ``times``, infinite where there is none."""
    return float(min(times - true_s, key=abs, default=np.inf))


def judge(foot: Foot) -> tuple[list[Found], dict[str, float]]:
    """Per kind, what was found; and of all steps the false T2 and T3. A refused foot has nothing found."""
    found = {name: Found(foot.group, name) for name in KINDS}
    try:
        changes, _ = causal(foot.track, calibrate(foot.track))
    except CalibrationError as error:
        print(f"{foot.group}, {foot.name}: refused, {error}", file=sys.stderr)
        changes = []
    times = {
        name: np.array([1e-9 * (c.t_ns - foot.track.t_sensor_ns[0]) for c in changes if c.transition.name in which])
        for name, which in (("T2", ("T2",)), ("T3", ("T3",)), ("contact", ("T3", "T6")))
    }
    for step in foot.steps:
        off, contact = nearest(times["T2"], step.off_s), nearest(times["T3"], step.contact_s)
        for name, kind in KINDS.items():
            if step.kind & kind or step.kind is kind:
                one = found[name]
                one.steps += 1
                one.off_ms += [1e3 * off] if abs(off) <= NEAR_S else []
                one.contact_ms += [1e3 * contact] if abs(contact) <= NEAR_S else []
                one.contacts_with_t6 += abs(nearest(times["contact"], step.contact_s)) <= NEAR_S
    true = {"T2": np.array([s.off_s for s in foot.steps]), "T3": np.array([s.contact_s for s in foot.steps])}
    false = {name: sum(abs(nearest(at, t)) > NEAR_S for t in times[name]) for name, at in true.items()}
    return list(found.values()), {"steps": len(foot.steps), **false}


# --- tables -----------------------------------------------------------------------------------------------------------


def rows_of(found: list[Found], false: dict[str, Counter[str]]) -> Iterator[list[str]]:
    groups: defaultdict[tuple[str, str], list[Found]] = defaultdict(list)
    for one in found:
        groups[one.group, one.kind].append(one)
    for (group, kind), ones in groups.items():
        steps = sum(one.steps for one in ones)
        if not steps:
            continue
        edges = ("+.0f", ".0f")
        contacts, offs = ([ms for one in ones for ms in getattr(one, name)] for name in ("contact_ms", "off_ms"))
        wrong = [f"{100.0 * false[group][name] / false[group]['steps']:.1f}" for name in ("T2", "T3")]
        yield [
            group, kind, str(steps), f"{100.0 * len(contacts) / steps:.1f}",
            f"{100.0 * sum(one.contacts_with_t6 for one in ones) / steps:.1f}", spread(contacts, *edges),
            f"{100.0 * len(offs) / steps:.1f}", spread(offs, *edges), ", ".join(wrong) if kind == "mid-walk" else "",
        ]  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--only", nargs="+", choices=tuple(GROUPS), default=tuple(GROUPS), help="these groups alone")
    options = parser.parse_args(arguments)
    found: list[Found] = []
    false: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for foot in (foot for group in options.only for foot in GROUPS[group](options.data)):
        ones, wrong = judge(foot)
        found += ones
        false[foot.group].update(wrong)
    columns = (
        "group", "kind", "steps", "contacts %", "with T6 %", "error ms, median [5, 95]", "foot offs %",
        "error ms, median [5, 95]", "false T2, T3 /100",
    )  # fmt: skip
    table = table_of("found within 200 ms, causal", columns, rows_of(found, false))
    publish([table], options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
