"""The gate's judges on every walk there is: sound sensors and bursts that it accuses, and how soon faults are told.

Every recording of the data folder and its ``unseen_walkers``, the bundled trials, and virtual patients (a quarter of
them at 0.2–0.36 m/s; foot and shank). Sound: ``fes.gate.plausibility`` must say nothing of the samples as they are, and
``fes.gate.movement`` must refuse none of the bursts that tracker and walking judge permit, asked every 20 ms (the bar
is one in 2,000 real ones). Then faults that last are put in at random moments of stance and of swing, after 20 s of the
walk: wrong units, the sensor turned so that up comes from at least 80° elsewhere, axes that hold their value with a
sensor's noise (stuck) or without (frozen), wrong gains, a sensor that dangles from its cable. Last, how long a
controller that always asks for current would get it while the person stands. Left out: a sensor that lies by itself,
and in the footswitch set whatever lies within 3 s of samples that its authors made up.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from random import Random

import numpy as np

from benchmarks.lib.channels import channel
from benchmarks.lib.command_line import no_recordings, parser_of, publish, table_of, verdict
from benchmarks.lib.real_sets import TRIALS, data_folder, stairs, xio
from benchmarks.lib.walkers import LYING, SETS, calibrated, feet_of, outcomes_of
from benchmarks.loop.tuning_cohort import drawn
from fes.analysis.swings import find_swings
from fes.config import Channel, Stimulation
from fes.datasets.common import even_track
from fes.estimation.sensor_choice import Calibration
from fes.gate.movement import BurstWatch, Movement
from fes.gate.plausibility import Plausibility
from fes.recording import Track, read_recording
from fes.signals import FOOT_SENSORS, G_MPS2, NS_PER_S, FloatArray, ImuSample, IntArray, StrideResult, Vector3
from fes.simulation.forward import VirtualPatient
from fes.stimulation.walking import WalkingJudge
from statemachine.phases import Phase, Transition

SOON_S, STRIDE_S, BEFORE_S, LONGEST_S = 0.1, 1.5, 20.0, 3.0  # what is usual of a person is learnt in the 20 s before
STALL_NS, AROUND_NS = 60_000_000, 3 * NS_PER_S
ACC_NOISE, GYR_NOISE = 0.05, 0.02  # of a sensor, m/s² and rad/s
COMMAND_NS, OFF_NS, STANDS_NS, EDGE_NS = 20_000_000, 100_000_000, 3 * NS_PER_S, NS_PER_S
BAR = 1 / 2000
CHANNEL = Channel.model_validate(channel(FOOT_SENSORS[0]))
LASTS_NS = round(1e9 * (CHANNEL.extension_s + CHANNEL.fall_s))
KINDS, PHASES = ("real feet", "real shanks", "virtual"), ("swing", "stance")
Span = tuple[int, int]  # ns of the sensor's clock
Fault = Callable[[FloatArray, FloatArray, np.random.Generator, float, Vector3], None]
"""Changes force and rate (N, 3) in place, from the fault's first sample on; last the sampling rate and upright."""


# --- faults -----------------------------------------------------------------------------------------------------------


def held(which: int, axes: str, noise: float = 0.0) -> Fault:
    def fault(acc: FloatArray, gyr: FloatArray, rng: np.random.Generator, rate_hz: float, up: Vector3) -> None:
        main = int(np.argmax(gyr.std(axis=0)))
        chosen = {"all": [0, 1, 2], "main": [main], "other": [(main + 1 + int(rng.integers(2))) % 3]}[axes]
        values = (acc, gyr)[which]
        for axis in chosen:
            values[:, axis] = values[0, axis] + noise * rng.normal(size=len(values))

    return fault


def scaled(of_acc: float, of_gyr: float) -> Fault:
    def fault(acc: FloatArray, gyr: FloatArray, rng: np.random.Generator, rate_hz: float, up: Vector3) -> None:
        acc *= of_acc
        gyr *= of_gyr

    return fault


TURNS = [
    turn
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
    if np.linalg.det(turn := np.eye(3)[list(order)] * np.array(signs)[:, None]) > 0
]


def turned(acc: FloatArray, gyr: FloatArray, rng: np.random.Generator, rate_hz: float, up: Vector3) -> None:
    """One of the 24 ways to put a box on, of those that move up by 80° and more."""
    far = [turn for turn in TURNS if np.dot(turn @ np.array(up), up) < np.cos(np.radians(80))]
    turn = far[rng.integers(len(far))]
    acc[:], gyr[:] = acc @ turn.T, gyr @ turn.T


def dangles(acc: FloatArray, gyr: FloatArray, rng: np.random.Generator, rate_hz: float, up: Vector3) -> None:
    """A pendulum on 0.15–0.4 m of cable, 25–60° to either side, hanging as it happened to be at that moment."""
    length_m, angle = rng.uniform(0.15, 0.4), np.radians(rng.uniform(25, 60))
    omega = np.sqrt(G_MPS2 / length_m)
    t_s = np.arange(len(acc)) / rate_hz
    tilt, turn = angle * np.sin(omega * t_s), angle * omega * np.cos(omega * t_s)
    along = acc[0] / np.linalg.norm(acc[0])
    across = np.cross(along, rng.normal(size=3))
    across /= np.linalg.norm(across)
    acc[:] = (G_MPS2 * np.cos(tilt) + turn**2 * length_m)[:, None] * along + rng.normal(0, ACC_NOISE, acc.shape)
    gyr[:] = turn[:, None] * across + rng.normal(0, GYR_NOISE, gyr.shape)


FAULTS: dict[str, Fault] = {
    "force in g": scaled(1.0 / G_MPS2, 1.0),
    "force × 9.81": scaled(G_MPS2, 1.0),
    "force in mg": scaled(1000.0 / G_MPS2, 1.0),
    "rates in °/s": scaled(1.0, 180.0 / np.pi),
    "turned": turned,
    "accelerometer frozen": held(0, "all"),
    "accelerometer stuck": held(0, "all", ACC_NOISE),
    "accelerometer, an axis frozen": held(0, "other"),
    "accelerometer, an axis stuck": held(0, "other", ACC_NOISE),
    "accelerometer × 0.8": scaled(0.8, 1.0),
    "accelerometer × 1.25": scaled(1.25, 1.0),
    "gyroscope frozen": held(1, "all"),
    "gyroscope stuck": held(1, "all", GYR_NOISE),
    "gyroscope, main axis frozen": held(1, "main"),
    "gyroscope, another axis frozen": held(1, "other"),
    "gyroscope, main axis stuck": held(1, "main", GYR_NOISE),
    "gyroscope, another axis stuck": held(1, "other", GYR_NOISE),
    "gyroscope × 0.5": scaled(1.0, 0.5),
    "gyroscope × 2": scaled(1.0, 2.0),
    "dangling": dangles,
}


# --- sensors ----------------------------------------------------------------------------------------------------------


def real(only: list[str]) -> Iterator[tuple[str, Track]]:
    """Set and track of every sensor, those of the bundled simulated trials first."""
    for path in sorted(TRIALS.glob("*.parquet")):
        if "truth" not in path.name:
            yield from (("bundled trials (simulated)", track) for track in read_recording(path).tracks.values())
    if climb := stairs(data_folder()):
        yield from (("gaitmap stairs", track) for track in climb.tracks.values())
    if loop := xio(data_folder()):
        yield "xio walk", loop
    for foot in feet_of(data_folder(), only):
        if foot.person not in LYING:
            yield f"{foot.data_set}, {foot.part.split(',')[0]}", foot.track


def virtual(first: int, patients: int) -> Iterator[tuple[str, Track]]:
    for seed in range(first, first + patients):
        settings = replace(drawn(seed, 0), sensors=("right_foot", "right_shank"))
        if seed % 4 == 0:
            settings = replace(settings, speed_mps=round(Random(seed).uniform(0.2, 0.36), 2))
        samples = VirtualPatient(settings).advance(40 * NS_PER_S)
        for sensor in settings.sensors:
            own = [sample for sample in samples if sample.sensor == sensor]
            acc, gyr = (np.array([getattr(sample, name) for sample in own]) for name in ("acc_mps2", "gyr_radps"))
            yield f"virtual {sensor.split('_')[1]}", even_track(sensor, settings.rate_hz, acc, gyr)


def sound_parts(name: str, track: Track) -> list[Track]:
    """The parts between stalls, for the set whose rows around them nobody measured."""
    if not name.startswith("footswitch"):
        return [track]
    step_ns = np.diff(track.t_ns)
    quick = np.convolve(step_ns, np.ones(20) / 20, "same") < 0.7e9 / track.rate_hz
    bend = np.abs(np.diff(track.gyr_radps, 2, axis=0, append=track.gyr_radps[-2:])).max(axis=1)
    made_up = np.convolve(bend, np.ones(20) / 20, "same") < 0.1 * np.median(bend)  # without noise though it turns
    made_up &= np.linalg.norm(track.gyr_radps, axis=1) > 0.5
    spoilt = np.zeros(len(track.t_ns), dtype=bool)
    for at in np.flatnonzero((step_ns > STALL_NS) | quick | made_up[:-1]):
        begin, end = np.searchsorted(track.t_ns, (track.t_ns[at] - AROUND_NS, track.t_ns[at + 1] + AROUND_NS))
        spoilt[begin:end] = True
    edges = np.flatnonzero(np.diff(np.concatenate(([True], spoilt, [True])).astype(int)))
    return [track.part(slice(int(a), int(b))) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def samples_of(track: Track, t_ns: IntArray) -> Iterator[ImuSample]:
    columns = (t_ns, track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    for t, own, acc, gyr in zip(*(column.tolist() for column in columns), strict=True):
        yield ImuSample(t, track.sensor, own, tuple(acc), tuple(gyr))


# --- the judges -------------------------------------------------------------------------------------------------------


@dataclass
class Walked:
    """What a session makes of a track: bursts, samples of pre-swing and swing, and where a pre-swing begins."""

    bursts: list[Span]
    swing: IntArray
    begins: IntArray


def walked(track: Track, calibration: Calibration) -> Walked:
    judge, bursts = WalkingJudge(Stimulation()), list[Span]()
    phase, begins = np.zeros(len(track.t_ns), dtype=int), list[int]()
    began_ns = contact_ns = None
    for outcome in outcomes_of(track, calibration):
        if isinstance(outcome, StrideResult):
            judge.on_stride(outcome)
            continue
        t_ns, lost = outcome.t_ns, outcome.transition is Transition.NONE
        judge.on_time(t_ns)
        permitted = judge.on_phase(outcome)
        if began_ns is not None and (lost or outcome.destination in (Phase.STANCE, Phase.PRE_SWING)):
            bursts.append((began_ns, t_ns if contact_ns is None else min(t_ns, contact_ns + LASTS_NS)))
            began_ns = contact_ns = None
        at = int(np.searchsorted(track.t_sensor_ns, t_ns))
        phase[at:] = outcome.destination
        if outcome.destination is Phase.PRE_SWING:
            begins.append(at)
            began_ns = t_ns if permitted and not lost else None
        elif outcome.destination is Phase.LOADING_RESPONSE and began_ns is not None:
            contact_ns = t_ns
    swing = np.flatnonzero((phase == Phase.PRE_SWING) | (phase == Phase.SWING))
    return Walked(bursts, swing, np.array(begins, dtype=int))


def refused(track: Track, bursts: list[Span]) -> int:
    """How many of them the coarse check refuses at any moment."""
    movement, found, waiting = Movement(), 0, iter(bursts)
    watch = BurstWatch(CHANNEL, movement, 0)
    burst, next_ns, begins, bad = next(waiting, None), 0, True, False
    for sample in samples_of(track, track.t_sensor_ns):
        movement.observe(sample)
        while burst is not None and sample.t_ns > burst[1]:
            found += bad
            burst, begins, bad = next(waiting, None), True, False
        if burst is not None and sample.t_ns >= burst[0] and (begins or sample.t_ns >= next_ns):
            bad, next_ns = bool(watch.forbids(sample.t_ns, begins=begins)) or bad, sample.t_ns + COMMAND_NS
            begins = False
    return found + bad


def asked_always_s(track: Track) -> tuple[float, float]:
    """Seconds of standing, and with current by a controller that always asks, anew 0.1 s after a refusal."""
    swings = find_swings(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    edges = [swings.begin_ns, *swings.possible.tolist(), swings.end_ns]
    spans = [(a + EDGE_NS, b - EDGE_NS) for a, b in pairwise(edges) if b - a > STANDS_NS]
    movement, on, again_ns, next_ns, stands, current = Movement(), False, 0, 0, 0, 0
    watch = BurstWatch(CHANNEL, movement, 0)
    for sample in samples_of(track, track.t_sensor_ns):
        movement.observe(sample)
        if sample.t_ns < next_ns:
            continue
        next_ns = sample.t_ns + COMMAND_NS
        if sample.t_ns >= again_ns:
            on = not watch.forbids(sample.t_ns, begins=not on)
            again_ns = sample.t_ns if on else sample.t_ns + OFF_NS
        inside = any(a <= sample.t_ns <= b for a, b in spans)
        stands, current = stands + inside, current + (inside and on)
    return 1e-9 * COMMAND_NS * stands, 1e-9 * COMMAND_NS * current


def told_after_s(track: Track, at: int, rng: np.random.Generator, up: Vector3) -> dict[str, float]:
    """Of every fault, from sample ``at``, where it begins, until the judge objects; infinite if not in three seconds.

    What the judge has learnt of the walk before is the same for all of them.
    """
    before = track.part(slice(at - round(BEFORE_S * track.rate_hz), at))
    part = track.part(slice(at, at + round(LONGEST_S * track.rate_hz)))
    judges = [Plausibility(track.sensor, None, each) for each in (None, up)]
    for judge, sample in itertools.product(judges, samples_of(before, before.t_ns)):
        judge.fault(sample)
    learnt = [judge._core.copy() for judge in judges]
    found = dict.fromkeys(FAULTS, float("inf"))
    for name, fault in FAULTS.items():
        mounted = name == "turned"  # and nothing else is judged by where up was
        judge, acc, gyr = judges[mounted], part.acc_mps2.copy(), part.gyr_radps.copy()
        judge._core[:] = learnt[mounted]
        fault(acc, gyr, rng, track.rate_hz, up)
        for sample in samples_of(replace(part, acc_mps2=acc, gyr_radps=gyr), part.t_ns):
            if judge.fault(sample) or (mounted and judge.not_ready):
                found[name] = 1e-9 * float(sample.t_ns - part.t_ns[0])
                break
    return found


@dataclass
class Counts:
    sensors: int = 0
    hours: float = 0.0
    accused: int = 0
    bursts: int = 0
    refused: int = 0
    stands_s: float = 0.0
    always_s: float = 0.0


def summary(found: list[tuple[float, float]]) -> str:
    if not found:
        return "–"
    told, following = np.array(found).T
    middle = np.percentile(told, 50, method="higher")
    shares = "; ".join(f"{np.mean(told <= limit):.0%}" for limit in (SOON_S, STRIDE_S, following))
    return f"{shares}; {f'{middle:.2f} s' if np.isfinite(middle) else f'not in {LONGEST_S:g} s'}"


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--only", nargs="+", choices=SETS, default=list(SETS), help="these sets alone")
    parser.add_argument("--moments", type=int, default=1, help="per sensor, of stance and swing each")
    parser.add_argument("--patients", type=int, default=12, help="virtual ones")
    parser.add_argument("--first", type=int, default=3000, help="seed of the first")
    options = parser.parse_args(arguments)
    rng, groups, said = np.random.default_rng(1), dict[str, Counts](), list[str]()
    times: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for name, track in itertools.chain(real(options.only), virtual(options.first, options.patients)):
        counts = groups.setdefault(name, Counts())
        words = set[str]()
        for part in sound_parts(name, track):
            judge = Plausibility(track.sensor, None, None)
            words |= {judge.fault(sample) for sample in samples_of(part, part.t_ns)} - {""}
            counts.hours += part.duration_s / 3600.0
        said += [f"{name}: {each}" for each in sorted(words)]
        counts.sensors, counts.accused = counts.sensors + 1, counts.accused + bool(words)
        if (calibration := calibrated(track)) is None:
            continue
        found = walked(track, calibration)
        counts.bursts, counts.refused = counts.bursts + len(found.bursts), counts.refused + refused(track, found.bursts)
        stands_s, always_s = asked_always_s(track)
        counts.stands_s, counts.always_s = counts.stands_s + stands_s, counts.always_s + always_s
        if "bundled" in name or name.startswith("footswitch") or not len(found.swing):
            continue
        kind = "virtual" if "virtual" in name else f"real {'feet' if track.sensor.endswith('foot') else 'shanks'}"
        before, after = (round(s * track.rate_hz) + 1 for s in (BEFORE_S, LONGEST_S))
        span = np.arange(max(before, found.swing[0]), min(len(track.t_ns) - after, found.swing[-1]))
        inside = np.isin(span, found.swing)
        for phase, where in (("swing", span[inside]), ("stance", span[~inside])):
            for at in rng.choice(where, min(options.moments, len(where)), replace=False).tolist():
                later = found.begins[found.begins > at]
                next_s = 1e-9 * float(track.t_ns[later[0]] - track.t_ns[at]) if len(later) else float("inf")
                for fault, told_s in told_after_s(track, at, rng, calibration.up).items():
                    times.setdefault((fault, kind, phase), []).append((told_s, next_s))
    of_people = [counts for name, counts in groups.items() if "virtual" not in name and "simulated" not in name]
    if not of_people:
        return no_recordings(data_folder())
    rows = [
        [name, str(c.sensors), f"{c.hours:.2f}", str(c.accused), f"{c.bursts:,}", str(c.refused)]
        for name, c in groups.items()
    ]
    sound = ("recordings", "sensors", "hours", "accused", "bursts", "refused by the coarse check")
    told = [
        [fault, *(summary(times.get((fault, kind, phase), [])) for kind in KINDS for phase in PHASES)]
        for fault in FAULTS
    ]
    columns = ("fault", *(f"{kind}, in {phase}" for kind in KINDS for phase in PHASES))
    stands_s, always_s = (sum(getattr(c, key) for c in of_people) for key in ("stands_s", "always_s"))
    bursts, wrong = sum(c.bursts for c in of_people), sum(c.refused for c in of_people)
    notes = [
        f"All real sensors: {sum(c.accused for c in of_people)} of {sum(c.sensors for c in of_people)} accused, "
        f"{wrong} of {bursts:,} bursts refused.",
        f"While people stand ({stands_s / 60:.0f} minutes), a controller that always asks for current gets it for "
        f"{100 * always_s / stands_s:.0f} % of the time.",
        *said,
    ]
    tables = [
        table_of("Sound sensors", sound, rows),
        table_of("Told within 0.1 s; within a stride (1.5 s); before the next pre-swing; median", columns, told),
    ]
    publish(tables, options, notes, data_folder())
    return verdict(wrong <= BAR * bursts and not any(c.accused for c in of_people))


if __name__ == "__main__":
    raise SystemExit(main())
