"""How soon a foot whose cycle the machine does not see is named, and how often one is that it does see.

*Sound*: every real foot as it is, feet and shanks, and virtual patients, unstimulated (on a belt whose speed changes,
too) and stimulated in closed loop. *Planted*: the axis has the wrong sign; the sensor turns by 180° about the vertical
in mid-walk; the other foot's sensor is worn; the foot comes to shuffle. Counted are the strides (swings by
``fes/analysis/swings.py``; of a shuffle each scrape) that begin after the plant and before the naming, and the bursts
that may begin after the fifth, with this judge and without it.

A shuffle is made after what a severe foot of a stroke survivor showed: the foot stands 0.6–1.5 s, then is scraped along
the floor for 2–4 s (*short*: 1–3 s), in slips of 2–12 cm and 0.15–0.35 s with rests of 0.05–0.5 s between them, turning
about all three axes at 50–130 °/s at most. By the measures that such a foot's calibration has, and *after a walk* by
the calibration of this foot's own walk, which comes first for 20 s.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from rich.table import Table

from benchmarks.lib.command_line import parser_of, publish, table_of, verdict
from benchmarks.lib.real_sets import data_folder
from benchmarks.lib.swing_judge import in_order
from benchmarks.lib.walkers import SETS, Foot, calibrated, feet_of, swings_of
from benchmarks.loop.closed_loop_walk import walk
from benchmarks.loop.tuning_cohort import channel_of
from fes.analysis.swings import Swings, find_swings
from fes.config import ImuDevice, Session, Stimulation
from fes.control.controller import Controller
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.sensor_choice import Calibration, tracker_of
from fes.recording import Track
from fes.signals import FOOT_SENSORS, NS_PER_S, FloatArray, IntArray, StrideResult
from fes.simulation.forward import PatientSettings, VirtualPatient, draw_patient
from fes.simulation.forward.closed_loop import calibration_walk, recorded_walk, recording_of
from fes.stimulation.order import OrderJudge
from fes.stimulation.walking import WalkingJudge
from statemachine.phases import PhaseChange, Transition

WITHIN = 5  # strides
SHARE = 0.95
LEAST_STRIDES = 12  # of a walk, to be planted in; twice as many where that is in its middle
SEED = 36
WALK_S, SHUFFLE_S = 60.0, 60.0
SLOWER, FASTER, FASTEST_MPS = 0.5, 1.8, 2.0  # of the speed before
SCRAPE_S, SHORT_SCRAPE_S = (2.0, 4.0), (1.0, 3.0)
BEFORE_S = 20.0
CURRENT_MA, INTENDED = 25.0, "stimulated"
CHANGED = "belt changed"
SOUND = "sound", INTENDED, CHANGED  # what is not
PLANTED = "wrong sign", "shuffle", "short shuffle"  # what is to be named


@dataclass
class Result:
    """One foot under one condition; ``later``: strides until the first naming after the plant, -1 for never."""

    group: str
    case: str
    who: str
    strides: int
    namings: int
    later: int = -1
    ordered: float = float("nan")
    bursts: int = 0  # that may begin in the strides after the fifth from the plant on; of a sound walk, all
    unwatched: int = 0  # likewise, were the order not watched
    words: list[str] = field(default_factory=list)


@dataclass
class Watched:
    """What one foot's walk led to: when it came into disorder and why, its phase changes, when a burst may begin."""

    named: list[tuple[int, str]] = field(default_factory=list)
    changes: list[PhaseChange] = field(default_factory=list)
    bursts_ns: list[int] = field(default_factory=list)
    unwatched_ns: list[int] = field(default_factory=list)

    def sound(self, group: str, who: str, swings: Swings) -> Result:
        ordered, words = in_order(swings, self.changes), [text for _, text in self.named]
        share = float(np.mean(ordered)) if ordered else float("nan")
        bursts = len(self.bursts_ns), len(self.unwatched_ns)
        return Result(group, "sound", who, len(swings.sure), len(self.named), -1, share, *bursts, words)

    def planted(self, group: str, case: str, who: str, strides_ns: IntArray, begin_ns: int = 0) -> Result:
        after = [told for told in self.named if told[0] >= begin_ns]
        strides_ns = strides_ns[strides_ns >= begin_ns]
        later = int(np.count_nonzero(strides_ns <= after[0][0])) if after else -1
        late_ns = strides_ns[WITHIN] if len(strides_ns) > WITHIN else np.iinfo(np.int64).max
        bursts = [sum(t_ns > int(late_ns) for t_ns in each) for each in (self.bursts_ns, self.unwatched_ns)]
        words = [text for _, text in after[:1]]
        count = len(strides_ns), len(after), later
        return Result(group, case, who, *count, bursts=bursts[0], unwatched=bursts[1], words=words)


class Unwatched(OrderJudge):
    """Finds everything in order."""

    def on_phase(self, change: PhaseChange) -> None:
        """As the other's."""


def watched(track: Track, calibration: Calibration) -> Watched:
    tracker, found = tracker_of(Session(name="disorder"), calibration), Watched()
    judge, other = WalkingJudge(Stimulation()), WalkingJudge(Stimulation())
    other.order = Unwatched()
    for outcome in tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps):
        if isinstance(outcome, StrideResult):
            judge.on_stride(outcome)
            other.on_stride(outcome)
            continue
        found.changes.append(outcome)
        before, permitted, otherwise = judge.order.in_order, judge.on_phase(outcome), other.on_phase(outcome)
        if before and not judge.order.in_order:
            found.named.append((outcome.t_ns, judge.order.reason))
        if outcome.transition is Transition.T1:
            found.bursts_ns += [outcome.t_ns] * permitted
            found.unwatched_ns += [outcome.t_ns] * otherwise
    return found


def wrong_sign(calibration: FootCalibration) -> FootCalibration:
    x, y, z = calibration.toe_down
    return replace(calibration, toe_down=(-x, -y, -z))


def turned(track: Track, calibration: FootCalibration) -> tuple[Track, int]:
    """From its middle on turned by 180° about the vertical; and when."""
    up, half = np.array(calibration.up), len(track.t_ns) // 2
    turn = 2.0 * np.outer(up, up) - np.eye(3)
    acc, gyr = track.acc_mps2.copy(), track.gyr_radps.copy()
    acc[half:], gyr[half:] = acc[half:] @ turn, gyr[half:] @ turn
    return replace(track, acc_mps2=acc, gyr_radps=gyr), int(track.t_ns[half])


def minimum_jerk(n: int) -> tuple[FloatArray, FloatArray]:
    """Acceleration of a way of 1 in a time of 1, and the rate of a turn to 1 and back, its peak 1; (n,) each."""
    u = np.linspace(0.0, 1.0, n)
    return 60.0 * u - 180.0 * u**2 + 120.0 * u**3, np.sin(2.0 * np.pi * u)


def of_a_shuffle(calibration: FootCalibration) -> FootCalibration:
    """With the measures of a foot that shuffles: calibrated on shuffles of this kind they are about these."""
    return replace(calibration, push_off_radps=1.2, fall_radps=2.4, stride_s=2.5, contact_jerk_mps3=500.0)


def shuffled(
    track: Track, calibration: FootCalibration, seed: int, scrape_s: tuple[float, float]
) -> tuple[Track, IntArray, int]:
    """The foot's own walk and then a shuffle; the middle of each scrape, and when the shuffle begins."""
    rng = np.random.default_rng((SEED, seed))
    up, left = np.array(calibration.up), np.array(calibration.toe_down)
    axes = np.array((np.cross(left, up), left, up))  # forward, left, up in the sensor's frame
    rate_hz, n = calibration.rate_hz, round(SHUFFLE_S * calibration.rate_hz)
    force = 0.1 * rng.standard_normal((n, 3))
    rates = 0.01 * rng.standard_normal((n, 3))
    scrapes, at = [], 0
    while at < n:
        at += round(rate_hz * rng.uniform(0.6, 1.5))
        begin, end = at, at + round(rate_hz * rng.uniform(*scrape_s))
        while at < min(end, n):
            rows = slice(at, at + round(rate_hz * rng.uniform(0.15, 0.35)))
            went, turn = minimum_jerk(rows.stop - rows.start)
            kept = len(force[rows])
            force[rows, 0] += (rng.uniform(0.02, 0.12) * (rate_hz / len(went)) ** 2 * went)[:kept]
            force[rows] += 0.5 * rng.standard_normal((kept, 3))  # the floor's own roughness
            rates[rows] += np.radians(rng.uniform(50.0, 130.0) * rng.uniform(-1.0, 1.0, 3)) * turn[:kept, None]
            at = rows.stop + round(rate_hz * rng.uniform(0.05, 0.5))
        scrapes.append((begin + min(at, n)) // 2)
    angle = np.cumsum(rates, axis=0) / rate_hz
    gravity = 9.81 * np.column_stack((-angle[:, 1], angle[:, 0], np.ones(n)))  # small angles
    before = track.part(slice(0, round(BEFORE_S * rate_hz)))
    t_ns = before.t_ns[-1] + np.arange(1, n + 1) * round(NS_PER_S / rate_hz)
    both = replace(
        before,
        t_ns=np.concatenate((before.t_ns, t_ns)),
        t_sensor_ns=np.concatenate((before.t_sensor_ns, before.t_sensor_ns[-1] - before.t_ns[-1] + t_ns)),
        acc_mps2=np.vstack((before.acc_mps2, (force + gravity) @ axes + np.array(calibration.acc_bias_mps2))),
        gyr_radps=np.vstack((before.gyr_radps, rates @ axes + np.array(calibration.gyr_bias_radps))),
    )
    return both, t_ns[np.minimum(scrapes, n - 1)], int(t_ns[0])


# --- real feet --------------------------------------------------------------------------------------------------------


def real(feet: Iterable[Foot]) -> Iterator[Result]:
    every = list(feet)
    known = {(foot.part, foot.run, foot.track.sensor): calibrated(foot.track) for foot in every}
    for number, foot in enumerate(every):
        sensor = foot.track.sensor
        if (calibration := known[foot.part, foot.run, sensor]) is None:
            continue
        swings, who, group = swings_of(foot), f"{foot.run} {sensor}", f"{foot.data_set}, {foot.part}"
        yield watched(foot.track, calibration).sound(group, who, swings)
        if not isinstance(calibration, FootCalibration):
            continue
        if len(swings.sure) >= LEAST_STRIDES:
            yield watched(foot.track, wrong_sign(calibration)).planted(group, "wrong sign", who, swings.sure)
        if len(swings.sure) >= 2 * LEAST_STRIDES:
            track, begin_ns = turned(foot.track, calibration)
            yield watched(track, calibration).planted(group, "turned in mid-walk", who, swings.sure, begin_ns)
        other = known.get((foot.part, foot.run, FOOT_SENSORS[sensor == FOOT_SENSORS[0]]))
        if isinstance(other, FootCalibration) and other.sensor != sensor:
            exchanged = replace(other, sensor=sensor)
            yield watched(foot.track, exchanged).planted(group, "other foot", who, swings.sure)
        if foot.data_set == "stroke_treadmill":
            yield from shuffles(foot.track, calibration, number, group, who)


def shuffles(track: Track, calibration: FootCalibration, seed: int, group: str, who: str) -> Iterator[Result]:
    for case, scrape_s in (("shuffle", SCRAPE_S), ("short shuffle", SHORT_SCRAPE_S)):
        both, scrapes_ns, begin_ns = shuffled(track, calibration, seed, scrape_s)
        alone = both.part(slice(int(np.searchsorted(both.t_ns, begin_ns)), None))
        yield watched(alone, of_a_shuffle(calibration)).planted(group, case, who, scrapes_ns)
        if case == "shuffle":
            yield watched(both, calibration).planted(group, "shuffle after a walk", who, scrapes_ns, begin_ns)


# --- virtual patients -------------------------------------------------------------------------------------------------


def virtual(patients: int) -> Iterator[Result]:
    for number in range(patients):
        settings = draw_patient(SEED, number, sensors=FOOT_SENSORS)
        calibration_tracks = calibration_walk(settings).tracks
        tracks = recorded_walk(settings, WALK_S, 2.0, "walk", "").tracks
        for sensor, track in tracks.items():
            who, group = f"{number} {sensor} {settings.pattern}", "virtual"
            if (calibration := calibrated(calibration_tracks[sensor])) is None:
                continue
            swings = find_swings(track.t_ns, track.acc_mps2, track.gyr_radps)
            yield watched(track, calibration).sound(group, who, swings)
            if not isinstance(calibration, FootCalibration):
                continue
            yield watched(track, wrong_sign(calibration)).planted(group, "wrong sign", who, swings.sure)
            yield from shuffles(track, calibration, 1000 + number, group, who)
            if sensor == settings.affected_foot:
                yield stimulated(settings, calibration, who)
        yield from at_another_speed(settings, number)


def at_another_speed(settings: PatientSettings, number: int) -> Iterator[Result]:
    """The belt goes faster or slower in mid-walk, all at once."""
    patient = VirtualPatient(settings)
    samples = patient.advance(2 * NS_PER_S)
    patient.walk()
    samples += patient.advance(round((2.0 + WALK_S) * NS_PER_S))
    patient.set_speed(min(settings.speed_mps * (FASTER if number % 2 else SLOWER), FASTEST_MPS))
    samples += patient.advance(round((2.0 + 2.0 * WALK_S) * NS_PER_S))
    for sensor, track in recording_of(patient, samples, "", "").tracks.items():
        if (calibration := calibrated(track)) is None:
            continue
        swings = find_swings(track.t_ns, track.acc_mps2, track.gyr_radps)
        yield replace(watched(track, calibration).sound("virtual", f"{number} {sensor}", swings), case=CHANGED)


def stimulated(settings: PatientSettings, calibration: FootCalibration, who: str) -> Result:
    """In closed loop, with a usual current in every swing."""
    worn = {"sensor": calibration.sensor, "device": "xbus", "rate_hz": settings.rate_hz}
    device = ImuDevice.model_validate({**worn, "acc_range_g": 16.0, "gyr_range_dps": 2000.0})
    channel = channel_of(CURRENT_MA).model_copy(update={"foot": calibration.sensor})
    session = Session(name=INTENDED, sensors=(device,), channels=(channel,))
    held: list[Controller] = []
    states: list[str] = [""]

    def during(_: VirtualPatient, __: int) -> None:
        states.append("".join(held[0].in_disorder()))

    done = walk(settings, session, calibration, WALK_S, 10**6, during, prepare=held.append)
    told = [now for before, now in pairwise(states) if now and not before]
    return Result("virtual", INTENDED, who, len(done.strides), len(told), words=told)


# --- the table --------------------------------------------------------------------------------------------------------


def tables_of(results: Sequence[Result]) -> list[Table]:
    """Of what was planted, by kind of walker; and of the walks as they are, by set."""
    planted, sound = defaultdict[tuple[str, str], list[Result]](list), defaultdict[str, list[Result]](list)
    for one in results:
        name = one.group.split(",")[0]
        if one.case in SOUND:
            health = one.group.rpartition(", ")[2] if name == "stroke_walks" else one.case * (name == "virtual")
            sound[f"{name}, {health}" if health else name].append(one)
        else:
            kind = name if name in ("stroke_treadmill", "virtual") else "other real feet"
            planted[one.case, kind].append(one)
    rows = []
    for (case, kind), own in sorted(planted.items()):
        soon = 100.0 * np.mean([0 <= one.later <= WITHIN for one in own])
        later = [one.later for one in own if one.later >= 0]
        bursts = (f"{sum(getattr(one, name) for one in own):,}" for name in ("bursts", "unwatched"))
        never = str(len(own) - len(later))
        rows.append([case, kind, str(len(own)), f"{soon:.1f}", str(max(later, default=0)), never, *bursts])
    told = [0 <= one.later <= WITHIN for one in results if one.case in PLANTED]
    rows.append([", ".join(PLANTED), "all together", str(len(told)), f"{100.0 * np.mean(told):.1f}", "", "", "", ""])
    as_they_are = []
    for name, own in sorted(sound.items()):
        strides, namings = sum(one.strides for one in own), sum(one.namings for one in own)
        kept_back = sum(one.unwatched - one.bursts for one in own)
        rate = f"{1e3 * namings / max(strides, 1):.2f}"
        as_they_are.append([name, str(len(own)), f"{strides:,}", str(namings), rate, str(kept_back)])
    columns = ("planted", "walkers", "feet", f"within {WITHIN} strides, %", "latest", "never", "bursts", "without")
    usual = ("set", "feet", "strides", "namings", "per 1,000", "bursts kept back")
    return [table_of("Planted", columns, rows), table_of("As they are", usual, as_they_are)]


def named_by_mistake(results: Iterable[Result]) -> list[str]:
    """The walks as they are in which a foot was named, and why."""
    return [
        f"{one.group}, {one.who}: {one.namings} in {one.strides} strides, of which {100 * one.ordered:.0f} % are in "
        f"order; {one.words[0]}"
        for one in results
        if one.namings and one.case in SOUND
    ]


def main() -> int:
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--patients", type=int, default=60, help="how many virtual ones")
    parser.add_argument("--only", nargs="*", choices=SETS, default=SETS, help="these sets")
    options = parser.parse_args()
    results = [*real(feet_of(options.data, options.only)), *virtual(options.patients)]
    publish(tables_of(results), options, named_by_mistake(results))
    told = [0 <= one.later <= WITHIN for one in results if one.case in PLANTED]
    belt = [one for one in results if one.case == "sound" and one.group.startswith("stroke_treadmill")]
    return verdict(float(np.mean(told)) >= SHARE and not any(one.namings for one in belt))


if __name__ == "__main__":
    raise SystemExit(main())
