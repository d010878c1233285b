"""First, last and turning steps: are their contacts and foot offs found, by the phases as they come live?

Every step that a walk really has is a first one of a bout, a last one, a turning one (its foot turns by over 20° about
the vertical), or mid-walk. Found is a step whose T3 (T2) comes within 200 ms of the true contact (foot off); "with T6"
counts an entry into stance by T6 as a contact. False are all T2 and T3 that belong to no step that way. Truth: markers
(gaitmap_walk); the simulators' own (bundled trials, and 20 virtual walks with stops and turns, of seeds used nowhere
else); on the floor the raw signals off-line, no more than a second opinion.
"""

from __future__ import annotations

import enum
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from math import radians
from pathlib import Path
from random import Random

import numpy as np
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from benchmarks.lib.command_line import parser_of, publish, spread, table_of
from benchmarks.lib.real_sets import MARKERS_HZ, data_folder, gaitmap_markers, gaitmap_walk, trials
from benchmarks.lib.walkers import calibrate, causal, feet_of
from fes.estimation.foot.calibration import CalibrationError
from fes.recording import Track
from fes.signals import G_MPS2, FloatArray
from fes.simulation.forward import PatientSettings, VirtualPatient, draw_patient, settings_for
from fes.simulation.forward.closed_loop import recording_of, truth_of
from fes.simulation.forward.draw import draw_movement
from fes.simulation.truth import Truth

# --- the true steps ---------------------------------------------------------------------------------------------------
#
# Nothing of the phase machine, of calibration or of the stride solver is used, and no constant of theirs. A step is a
# foot's travel between two rests. Its foot off is where the speed of the part that leaves last rises through ``LEAVES``
# of that step's greatest, its contact where the part that lands first falls through ``LANDS`` of it: shares of its own
# speed, so that a short step is judged as a long one. Markers (gaitmap_walk) give that speed directly. On the floor
# it is the sensor's own, dead-reckoned between the rests around the step, for the foot stands at both ends; foot off is
# its first fast tilt before full speed, contact the first great jolt once it is slow.

MOVES_MPS, NEARBY_S = 0.25, 0.06  # markers: a foot whose heel and toe are slower has come to rest, but for short lulls
TRAVEL_M, TURNED_DEG = 0.06, 20.0  # a step goes so far, or turns so far; a turning step turns so far
LEAVES, LANDS = 0.30, 0.30
PAUSE = 2.2  # median stances: longer before a step is a first one, longer after it a last one …
LEAST_PAUSE_S = 0.9  # … and so long at least


class Kind(enum.Flag):
    """What a step is; one that is nothing else is mid-walk."""

    MID = 0
    FIRST = enum.auto()
    LAST = enum.auto()
    TURN = enum.auto()


@dataclass(frozen=True, slots=True)
class Step:
    """One true step: foot off and contact (s from the track's start), its turn, and what it is."""

    off_s: float
    contact_s: float
    turn_deg: float
    kind: Kind


def classified(steps: list[tuple[float, float, float]], begin_s: float, end_s: float) -> list[Step]:
    """Steps (foot off, contact, turn) in order → what each is; the recording is from ``begin_s`` to ``end_s``.

    A step at either end of the recording is a first or a last one if the foot stood long enough there.
    """
    if not steps:
        return []
    off, contact = (np.array([step[k] for step in steps]) for k in (0, 1))
    stance = off[1:] - contact[:-1]
    pause_s = max(PAUSE * float(np.median(stance)), LEAST_PAUSE_S) if len(stance) else LEAST_PAUSE_S
    before = np.concatenate(([off[0] - begin_s > LEAST_PAUSE_S], stance > pause_s))
    after = np.concatenate((stance > pause_s, [end_s - contact[-1] > LEAST_PAUSE_S]))
    found = []
    for step, first, last in zip(steps, before, after, strict=True):
        kind = (Kind.FIRST if first else Kind.MID) | (Kind.LAST if last else Kind.MID)
        found.append(Step(*step, kind | (Kind.TURN if abs(step[2]) > TURNED_DEG else Kind.MID)))
    return found


def spans(moving: FloatArray, lull: int) -> list[tuple[int, int]]:
    """First and last index of every stretch that is true, but for lulls of up to ``lull`` samples."""
    at = np.flatnonzero(moving)
    if not len(at):
        return []
    cuts = np.flatnonzero(np.diff(at) > lull + 1)
    firsts, lasts = np.concatenate(([0], cuts + 1)), np.concatenate((cuts, [len(at) - 1]))
    return list(zip(at[firsts].tolist(), at[lasts].tolist(), strict=True))


def crossings(leaving: FloatArray, landing: list[FloatArray], first: int) -> tuple[float, float]:
    """Where the speed ``leaving`` rises, and the first of ``landing`` falls, through its share of its peak."""

    def share(speed: FloatArray, level: float, peak: int, way: int) -> float:
        at, limit = peak, level * speed[peak]
        while 0 <= at + way < len(speed) and speed[at] > limit:
            at += way
        near = speed[at - way] - speed[at]
        return at - way * (float((limit - speed[at]) / near) if near > 0.0 else 0.0)

    off = share(leaving, LEAVES, int(np.argmax(leaving)), -1)
    return first + off, first + min(share(each, LANDS, int(np.argmax(each)), 1) for each in landing)


# --- markers ----------------------------------------------------------------------------------------------------------


def marker_steps(folder: Path, side: str) -> list[Step]:
    """All steps of one foot of gaitmap_walk."""
    heel, toe = gaitmap_markers(folder, side, "FCC", "TOE")
    for axis in (*heel.T, *toe.T):  # a gap of a marker is bridged
        gap = np.isnan(axis)
        axis[gap] = np.interp(np.flatnonzero(gap), np.flatnonzero(~gap), axis[~gap])
    speeds = [np.linalg.norm(np.gradient(marker, axis=0), axis=1) * MARKERS_HZ for marker in (heel, toe)]
    heading = np.unwrap(np.arctan2(*(toe - heel)[:, 1::-1].T))
    found = []
    for a, b in spans(np.minimum(*speeds) > MOVES_MPS, round(NEARBY_S * MARKERS_HZ)):
        travel = float(np.linalg.norm((toe[b] - toe[a])[:2]))
        turn = float(np.degrees(heading[min(b + 5, len(heading) - 1)] - heading[max(a - 5, 0)]))
        if travel < TRAVEL_M and abs(turn) < TURNED_DEG:
            continue
        a, b = max(a - 10, 0), min(b + 10, len(heel) - 1)
        off, contact = crossings(speeds[1][a : b + 1], [speed[a : b + 1] for speed in speeds], a)
        found.append((off / MARKERS_HZ, contact / MARKERS_HZ, turn))
    return classified(found, 0.0, len(heel) / MARKERS_HZ)


# --- a sensor by itself, off-line -------------------------------------------------------------------------------------

PUSHES = 0.8  # foot off: the first peak of the tilting rate that has this share of its greatest
# at rest: slower and calmer than that for so long, where the foot turns by BRISK_RADPS (95 % of samples are below) …
QUIET_RADPS, QUIET_MPS2, QUIET_S, BRISK_RADPS = 1.1, 2.2, 0.04, 7.0
LEAST_QUIET = 0.55  # … and in proportion where it is slower, down to this share
SMOOTH_HZ = 8.0
SLOWED, JOLT_S, STRUCK = 0.25, 0.01, 0.4  # contact: the first of the great jolts once the foot is so slow
LONGEST_S = 4.0  # of a movement that dead reckoning can judge


def sensor_steps(track: Track) -> list[Step]:
    """All steps that the sensor by itself shows, off-line: rests first, then the travel between them."""
    t_s = 1e-9 * (track.t_sensor_ns - track.t_sensor_ns[0])
    rate_hz = track.rate_hz
    grid_s = np.arange(0.0, t_s[-1], 1.0 / rate_hz)
    acc, gyr = (
        np.column_stack([np.interp(grid_s, t_s, axis) for axis in values.T])
        for values in (track.acc_mps2, track.gyr_radps)
    )
    smooth = butter(2, SMOOTH_HZ, fs=rate_hz, output="sos")
    turning = sosfiltfilt(smooth, np.linalg.norm(gyr, axis=1))
    weight = float(np.median(np.linalg.norm(acc, axis=1)[turning < np.percentile(turning, 20.0)]))
    lively = np.sqrt(np.maximum(sosfiltfilt(smooth, (np.linalg.norm(acc, axis=1) - weight) ** 2), 0.0))
    brisk = float(np.clip(np.percentile(turning, 95.0) / BRISK_RADPS, LEAST_QUIET, 1.0))
    quiet = (turning < brisk * QUIET_RADPS) & (lively < brisk * QUIET_MPS2)
    rests = [(a, b) for a, b in spans(quiet, 0) if (b - a) / rate_hz >= QUIET_S]
    bias = np.median(gyr[turning < np.percentile(turning, 10.0)], axis=0)
    gyr = gyr - bias
    found = []
    for (a0, a1), (b0, b1) in pairwise(rests):
        begin, end = max(a0, a1 - 3), min(b1, b0 + 3)
        if (end - begin) / rate_hz > LONGEST_S:
            continue
        force, rates = acc[begin : end + 1] * (G_MPS2 / weight), gyr[begin : end + 1]
        velocity, free, tilting, turn = dead_reckoned(force, rates, 1.0 / rate_hz)
        travel = float(np.linalg.norm(velocity[:, :2].sum(axis=0)) / rate_hz)
        if travel < TRAVEL_M:  # a foot that only pivots has not stepped
            continue
        off, contact = (begin + at for at in turned_and_struck(velocity, free, tilting, rate_hz))
        found.append((off / rate_hz, contact / rate_hz, turn))
    return classified(found, 0.0, float(grid_s[-1]))


def turned_and_struck(
    velocity: FloatArray, force: FloatArray, tilting: FloatArray, rate_hz: float
) -> tuple[float, float]:
    """Foot off: the first great tilting rate before full speed; contact: the first great jolt when slow (samples)."""
    speed = np.linalg.norm(velocity, axis=1)
    peak = int(np.argmax(speed))
    early = tilting[: peak + 1]
    off = int(np.flatnonzero(early >= PUSHES * early.max())[0])
    while off < peak and tilting[off + 1] > tilting[off]:
        off += 1
    lag = max(round(JOLT_S * rate_hz), 1)
    jolt = np.zeros(len(force))
    jolt[lag:] = np.linalg.norm(force[lag:] - force[:-lag], axis=1)
    late = peak + int(np.argmax(speed[peak:] < SLOWED * speed[peak]))
    great = np.flatnonzero(jolt[late:] >= STRUCK * jolt[late:].max())
    return off, late + float(great[0]) - 0.5 * lag


def dead_reckoned(acc: FloatArray, gyr: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Velocity and free acceleration (N, 3) in the world between two rests, the rate (N,) about level axes (rad/s), and
    the turn about the vertical (deg, left positive).

    Upright as gravity says at the start, velocity zero at both ends.
    """
    up = np.mean(acc[:4], axis=0)
    up /= np.linalg.norm(up)
    start, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])
    turns = Rotation.from_rotvec(0.5 * (gyr[1:] + gyr[:-1]) * dt_s)
    now, attitudes = start, [start.as_quat()]
    for step in turns:
        now = now * step
        attitudes.append(now.as_quat())
    attitude = Rotation.from_quat(np.array(attitudes))
    rate = attitude.apply(gyr)
    free = attitude.apply(acc) - (0.0, 0.0, G_MPS2)
    velocity = np.concatenate((np.zeros((1, 3)), np.cumsum(0.5 * (free[1:] + free[:-1]), axis=0) * dt_s))
    velocity -= np.linspace(0.0, 1.0, len(velocity))[:, None] * velocity[-1]
    return velocity, free, np.hypot(rate[:, 0], rate[:, 1]), float(np.degrees(rate[:, 2].sum() * dt_s))


# --- what is found of them --------------------------------------------------------------------------------------------

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
            steps = [(s.t_swing_s, s.t_loading_response_s, s.turn_deg) for s in truth.strides_of(sensor)]
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
