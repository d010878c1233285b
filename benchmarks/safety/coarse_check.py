"""The gate's coarse check on every walk there is: bursts refused wrongly, and what it leaves to a spoilt controller.

    python benchmarks/safety/coarse_check.py [--only SET …] [--patients N] [--first SEED] [--data FOLDER] [--json FILE]

Every recording of the data folder and its ``unseen_walkers``, and so many walks of virtual patients at 0.2–0.36 m/s, go
through calibration, tracker and walking judge as in a session. Each burst that these permit is held against the gate's
own watch (``fes.gate.movement``) every 20 ms, from heel rise to contact with the default extension and fall. A burst
refused at any moment counts as refused. The bar is one in 2,000 of the real ones, by the constants as they are: they
were chosen with all of these walks known.

Then the controller is spoilt: "always" asks for current without end, and anew 0.1 s after a refusal; "random" for
bursts of 0.2 to 2 s at any time. Counted is the current that goes out while the person stands: over 3 s between two
swings that ``fes/analysis/swings.py`` finds in the raw signals, but for 1 s at either end.
Exit code 1 if the bar is missed, 3 without data.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict, astuple, dataclass, replace
from itertools import chain, pairwise
from random import Random
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.accuracy.every_walker import percent
from benchmarks.lib.command_line import console_of, no_recordings, parser_of, save
from benchmarks.lib.real_sets import data_folder
from benchmarks.lib.walkers import SETS, calibrate, feet_of
from benchmarks.loop.tuning_cohort import drawn
from fes.analysis.swings import find_swings
from fes.config import Channel, Stimulation
from fes.datasets.common import even_track
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import Calibration, stride_settings
from fes.estimation.shank.tracker import ShankTracker
from fes.estimation.strides.results import StrideMaker
from fes.gate.movement import BurstWatch, Movement
from fes.recording import Track
from fes.signals import FOOT_SENSORS, NS_PER_S, ImuSample, StrideResult
from fes.simulation.forward import VirtualPatient
from fes.stimulation.walking import WalkingJudge
from statemachine.phases import Phase, Transition

COMMAND_NS, OFF_NS = 20_000_000, 100_000_000
STANDS_NS, AROUND_NS = 3_000_000_000, 1_000_000_000
BAR = 1 / 2000
LIMITS = {
    "max_current_ma": 30.0, "max_pulse_width_us": 400.0, "max_frequency_hz": 50.0, "max_charge_per_phase_uc": 10.0,
    "max_charge_per_minute_mc": 50.0, "max_current_density_ma_per_cm2": 1.0, "max_rise_ma_per_s": 1000.0,
    "max_on_s": 3.0, "min_off_s": 0.1,
}  # fmt: skip
Span = tuple[int, int]  # of a burst, ns of the sensor's clock


CHANNEL = Channel.model_validate(
    {"name": "x", "number": 0, "foot": FOOT_SENSORS[0], "electrode_area_cm2": 25.0, "current_ma": 20.0,
     "pulse_width_us": 300.0, "frequency_hz": 40.0, "limits": LIMITS}
)  # fmt: skip
LASTS_NS = round(1e9 * (CHANNEL.extension_s + CHANNEL.fall_s))


@dataclass
class Counts:
    """Of one set: sensors, bursts, those refused; standing, and what spoilt controllers ask for and get in it (s)."""

    sensors: int = 0
    bursts: int = 0
    refused: int = 0
    stands_s: float = 0.0
    always_s: float = 0.0
    random_asked_s: float = 0.0
    random_s: float = 0.0


def slow_virtual(first: int, patients: int) -> Iterator[tuple[str, Track]]:
    """One foot each, at 0.2 to 0.36 m/s."""
    for seed in range(first, first + patients):
        settings = replace(drawn(seed, 0), sensors=("right_foot",), speed_mps=round(Random(seed).uniform(0.2, 0.36), 2))
        samples = VirtualPatient(settings).advance(40 * NS_PER_S)
        acc, gyr = (np.array([getattr(sample, name) for sample in samples]) for name in ("acc_mps2", "gyr_radps"))
        yield "virtual, slow", even_track("right_foot", settings.rate_hz, acc, gyr)


def bursts_of(track: Track, calibration: Calibration) -> list[Span]:
    """The bursts that tracker and walking judge permit."""
    if isinstance(calibration, FootCalibration):
        tracker: Any = FootTracker(calibration, StrideMaker(track.sensor, stride_settings(calibration)))
    else:
        tracker = ShankTracker(calibration)
    judge, bursts = WalkingJudge(Stimulation()), list[Span]()
    began_ns = contact_ns = None
    for outcome in tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps):
        if isinstance(outcome, StrideResult):
            judge.on_stride(outcome)
            continue
        t_ns, lost = outcome.t_ns, outcome.transition is Transition.NONE
        judge.on_time(t_ns)
        permitted = judge.on_phase(outcome)
        if began_ns is not None and (lost or outcome.destination in (Phase.STANCE, Phase.PRE_SWING)):
            bursts.append((began_ns, t_ns if contact_ns is None else min(t_ns, contact_ns + LASTS_NS)))
            began_ns = contact_ns = None
        if outcome.destination is Phase.PRE_SWING and permitted and not lost:
            began_ns = t_ns
        elif outcome.destination is Phase.LOADING_RESPONSE and began_ns is not None:
            contact_ns = t_ns
    return bursts


def refused(track: Track, bursts: list[Span]) -> int:
    """How many of them the watch refuses at any moment."""
    movement, found = Movement(), 0
    watch = BurstWatch(CHANNEL, movement, 0)
    waiting = iter(bursts)
    burst, next_ns, begins, bad = next(waiting, None), 0, True, False
    for sample in samples_of(track):
        movement.observe(sample)
        t_ns = sample.t_ns
        while burst is not None and t_ns > burst[1]:
            found += bad
            burst, begins, bad = next(waiting, None), True, False
        if burst is not None and t_ns >= burst[0] and (begins or t_ns >= next_ns):
            bad, begins, next_ns = bool(watch.forbids(t_ns, begins=begins)) or bad, False, t_ns + COMMAND_NS
    return found + bad


def samples_of(track: Track) -> Iterator[ImuSample]:
    """By the sensor's own clock, which the bursts' times are of."""
    for t_ns, gyr in zip(track.t_sensor_ns.tolist(), track.gyr_radps.tolist(), strict=True):
        yield ImuSample(t_ns, track.sensor, t_ns, (0.0, 0.0, 0.0), tuple(gyr))


def standing(track: Track) -> list[Span]:
    """Where no swing is near, nor what might be one."""
    swings = find_swings(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    edges = [swings.begin_ns, *swings.possible.tolist(), swings.end_ns]
    return [(a + AROUND_NS, b - AROUND_NS) for a, b in pairwise(edges) if b - a > STANDS_NS]


def spoilt(track: Track, spans: list[Span], counts: Counts, rng: Random) -> None:
    """What both controllers get through, of what they ask for, in these spans."""
    movement = Movement()
    watches = [BurstWatch(CHANNEL, movement, 0) for _ in range(2)]
    on, again_ns, until_ns, idle_ns = [False, False], [0, 0], 0, 0
    waiting = iter(spans)
    span, next_ns = next(waiting, None), 0
    for sample in samples_of(track):
        movement.observe(sample)
        t_ns = sample.t_ns
        if t_ns < next_ns:
            continue
        step_s, next_ns = 1e-9 * COMMAND_NS, t_ns + COMMAND_NS
        if t_ns >= idle_ns:  # the next burst at random
            until_ns = t_ns + round(1e9 * rng.uniform(0.2, 2.0))
            idle_ns = until_ns + round(1e9 * rng.uniform(0.1, 2.0))
        asked = [True, t_ns < until_ns]
        for k, watch in enumerate(watches):
            lets = asked[k] and t_ns >= again_ns[k] and not watch.forbids(t_ns, begins=not on[k])
            if asked[k] and t_ns >= again_ns[k] and not lets:
                again_ns[k] = t_ns + OFF_NS
            on[k] = lets
        while span is not None and t_ns > span[1]:
            span = next(waiting, None)
        if span is not None and t_ns >= span[0]:
            counts.stands_s += step_s
            counts.always_s += step_s * on[0]
            counts.random_asked_s += step_s * asked[1]
            counts.random_s += step_s * on[1]


def main() -> int:
    """Print the table."""
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--only", nargs="*", default=list(SETS), choices=SETS)
    parser.add_argument("--patients", type=int, default=20, help="virtual ones")
    parser.add_argument("--first", type=int, default=2000, help="seed of the first")
    asked = parser.parse_args()
    groups: dict[str, Counts] = {}
    rng = Random(1)
    walkers = ((f"{foot.data_set}, {foot.part}", foot.track) for foot in feet_of(asked.data, asked.only))
    for name, track in chain(walkers, slow_virtual(asked.first, asked.patients)):
        try:
            bursts = bursts_of(track, calibrate(track))
        except CalibrationError:
            continue
        counts = groups.setdefault(name, Counts())
        counts.sensors += 1
        counts.bursts += len(bursts)
        if wrong := refused(track, bursts):
            counts.refused += wrong
            print(f"{name}, {track.sensor}: {wrong} of {len(bursts)} refused", file=sys.stderr)
        spoilt(track, standing(track), counts, rng)
    real = [counts for name, counts in groups.items() if not name.startswith("virtual")]
    if not real:
        return no_recordings(asked.data)
    total = Counts(*(sum(column) for column in zip(*map(astuple, real), strict=True)))
    table = Table("set", "sensors", "bursts", "refused", "standing, min", "always: s", "%", "random: s", "of s", "%")
    for name, c in (*groups.items(), ("all real", total)):
        table.add_row(
            name, str(c.sensors), str(c.bursts), str(c.refused), f"{c.stands_s / 60:.1f}",
            f"{c.always_s:.1f}", percent(c.always_s, c.stands_s),
            f"{c.random_s:.1f}", f"{c.random_asked_s:.1f}", percent(c.random_s, c.random_asked_s),
        )  # fmt: skip
    console_of(150).print(table)
    save({name: asdict(c) for name, c in groups.items()}, asked.json)
    return 1 if total.refused > BAR * total.bursts else 0


if __name__ == "__main__":
    sys.exit(main())
