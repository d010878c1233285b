"""Stimulation that tunes itself against settings made that day, in trials in which every arm may do the same.

It takes hours: docs/tuning_results.md has the commands. With ``--keep FILE`` whoever has walked is written there at
once, and does not walk again with the same tuning (the files of its room; of the rule and its watch only where these
are tried); ``--kept`` makes the tables of those alone.

Arms, all within the same bounds (50 mA, 60 to 300 µs):

- *fixed*: pulses of 300 µs, set that day: raised until the toe clears and the heel comes first, and a fifth on top;
- *short*: set that day in the same way, with the pulses that the tuned arms have: 50 mA, the width raised instead;
- *plain*: the plain rule of the independent comparison (``plain_rule.py``);
- *tuner*: the tuning's own rule; *two*: with a second channel on the evertors.

Plain and tuner begin with a pulse that recruits as START_MA does at 300 µs. Everybody drawn who has a drop foot counts,
in every arm: of whom calibration refuses, or the gate latches, every stride from then on is outside the band. What
counts is the patient's true toe clearance. Differences are means over patients, with the 95 % interval of a bootstrap
over them.

The second patient (:mod:`second_patient`) shares nothing with the first.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import count
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.lib.command_line import parser_of, publish, table_of
from benchmarks.lib.figures import digest
from benchmarks.loop.closed_loop_walk import Walk, calibration_of, walk
from benchmarks.loop.plain_rule import PlainRule
from benchmarks.loop.second_patient import SecondPatient, draw_second
from benchmarks.loop.tuning_cohort import (
    BAND_MM,
    MOST_MA,
    PITCH_DEG,
    WIDTH_US,
    channel_of,
    drawn,
    has_a_drop_foot,
    session_with,
    short_channel,
    titrated_ma,
)  # fmt: skip
from fes.config import Channel, FootGeometry, Session
from fes.control.controller import Controller
from fes.estimation.foot.calibration import CalibrationError
from fes.simulation.forward import VirtualPatient, harm_of
from fes.simulation.forward.gait_patterns import PATTERNS

STRIDES, SECONDS = 45, 300.0
START_MA = 15.0  # at 300 µs: what hardly any foot answers to
RATE_US = 30.0  # the most that one stride may change
SETTLED, WITHIN, REACHED = 10, 6, 4  # strides; in the band: 4 of 5 in a row
FAULT_STRIDE, SPARED = 18, 5
ROLL_DEG, ROLL_FROM, EVERTORS = 5.0, 3, 1
LEAST_WIDTH_US = 20.0  # of common stimulators
ARMS = ("fixed", "short", "plain", "tuner", "two")
OWN_RULE = ("rule.py", "settings.py", "watch.py")
PAIRS = (("tuner", "short"), ("tuner", "plain"), ("plain", "short"), ("short", "fixed"))


# --- what happens to whom -------------------------------------------------------------------------------------


@dataclass
class Trial:
    """``who`` walks instead of who was drawn; ``at`` strides of the affected foot something happens to them."""

    text: str
    who: Callable[[Any], Any] = lambda settings: settings
    acts: dict[int, Callable[[Any, Any], None]] = field(default_factory=dict)
    fault: str = ""  # what is to be named


def _quality(share: float) -> Callable[[Any, Any], None]:
    return lambda one, settings: one.set_electrode_quality(share * getattr(settings, "electrode_quality", 1.0))


def _slow(settings: Any) -> Any:
    name = f"hemiparetic_{1 + settings.seed % 5}"
    return replace(settings, pattern=name, speed_mps=PATTERNS[name].speed_mps)


TRIALS = {
    "day": Trial("an ordinary day"),
    "slip": Trial("electrode slips to 70 %", acts={FAULT_STRIDE: _quality(0.7)}, fault="electrodes"),
    "drift": Trial(
        "electrode drifts to 60 % in 20 strides",
        acts={FAULT_STRIDE + n: _quality(1.0 - 0.02 * n) for n in range(1, 21)}, fault="electrodes",
    ),
    "spastic": Trial(
        "calf wholly spastic for four strides",
        acts={
            18: lambda one, settings: one.set_spasticity(1.0),
            22: lambda one, settings: one.set_spasticity(settings.spasticity),
        },
        fault="calf",
    ),
    "slow": Trial("Wang's five walks, 0.21–0.35 m/s", _slow),
}  # fmt: skip


# --- sessions -------------------------------------------------------------------------------------------------


def tuning_of(method: str = "learning") -> dict[str, Any]:
    """The tuned channel's settings. The target is the band itself: no measuring error is known beforehand."""
    low, high = (1e-3 * edge for edge in BAND_MM)
    return {
        "mode": "act", "method": method, "timing": True, "toe_clearance_m": {"low": low, "high": high},
        "pitch_at_contact_deg": {"low": PITCH_DEG[0], "high": PITCH_DEG[1]},
        "max_change_ma": RATE_US * MOST_MA / WIDTH_US, "max_change_us": RATE_US,
        "bounds": {
            "current_ma": {"low": 10.0, "high": MOST_MA}, "pulse_width_us": {"low": 0.2 * WIDTH_US, "high": WIDTH_US},
            "start_delay_s": {"low": 0.0, "high": 0.4}, "extension_s": {"low": -0.1, "high": 0.1},
        },
    }  # fmt: skip


def evertors() -> Channel:
    """The second channel."""
    tuning = tuning_of()
    del tuning["toe_clearance_m"], tuning["pitch_at_contact_deg"]
    tuning["eversion_at_contact_deg"] = {"low": -ROLL_DEG, "high": ROLL_DEG}
    tuning["bounds"]["extension_s"]["low"] = 0.0
    tuning["bounds"]["pulse_width_us"]["low"] = LEAST_WIDTH_US  # so that it may also be next to nothing
    channel = short_channel(START_MA, tuning=tuning)
    return channel.model_copy(update={"name": "Peronei, right", "muscle": "peronei", "number": EVERTORS})


def session_of(geometry: FootGeometry, arm: str, set_ma: float = START_MA) -> Session:
    """An arm's session; ``set_ma``: what was set that day, at WIDTH_US."""
    if arm == "none":
        return session_with(geometry)
    if arm == "fixed":
        return session_with(geometry, channel_of(set_ma, extension_s=0.0))
    if arm == "short":
        return session_with(geometry, short_channel(set_ma, extension_s=0.0))
    lifts = short_channel(START_MA, tuning=tuning_of())
    return session_with(geometry, lifts, *([evertors()] if arm == "two" else []))


def with_rule(arm: str, controller: Controller) -> None:
    """The plain rule in the place of our own."""
    if arm == "plain":
        for tuner in controller.tuning.tuners.values():
            tuner.rule = PlainRule(tuner.channel)


# --- what came of it ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Result:
    """Of one walk, by strides from the first that could have stimulation."""

    inside: list[bool]
    stumbles: int = 0
    drags: int = 0  # both from stride WITHIN on
    charge_uc: float = 0.0
    push_off_lost: float = 0.0
    heel_first: float = 0.0
    put_back: int = 0
    stopped: bool = False
    latched: str = ""
    refused: str = ""
    rolled: float = 0.0  # share of strides from the fourth on within ROLL_DEG of level
    named: str = ""  # after the fault
    lowered: bool = False  # within SPARED strides of it
    false_names: int = 0

    @property
    def settled(self) -> float:
        """Share of the strides from SETTLED on in the band."""
        return fmean(self.inside[SETTLED:] or [False])

    @property
    def soon(self) -> bool:
        """Whether the band was reached within WITHIN strides, and held for 4 of 5."""
        return any(sum(self.inside[n : n + 5]) >= REACHED for n in range(WITHIN + 1))


def judge(done: Walk, trial: Trial, fault_ns: int | None) -> Result:
    """Hold a walk's true strides against the band."""
    first = next((n for n, one in enumerate(done.strides) if one.charge_uc > 0.0), 3)
    strides = done.strides[first:]
    inside = [BAND_MM[0] <= 1e3 * one.toe_clearance_m <= BAND_MM[1] for one in strides]
    if done.latched:  # no stimulation from then on, however well the foot was lifted by the person alone
        inside = [good and one.charge_uc > 0.0 for good, one in zip(inside, strides, strict=True)]
    inside += [False] * (STRIDES - first - len(inside))
    faults = [report for report in done.reports if report.kind == "fault"]
    late = [report for report in faults if fault_ns is not None and report.t_ns > fault_ns]
    after = [one.t_flat_ns for one in strides if fault_ns is not None and one.t_contact_ns > fault_ns]
    # what follows from the first stride that was walked with the fault: nobody knows of it before
    since_ns, until_ns = (after[0], after[min(SPARED, len(after) - 1)]) if after else (0, 0)
    lowered = [
        report for report in done.reports
        if since_ns < report.t_ns <= until_ns and max(report.after.widths_us)
        * report.after.current_ma < max(report.before.widths_us) * report.before.current_ma
    ]  # fmt: skip
    return Result(
        inside,
        sum(one.stumbled for one in strides[WITHIN:]),
        sum(one.dragged for one in strides[WITHIN:]),
        sum(one.charge_uc for one in strides) / max(len(strides), 1),
        harm_of(strides).push_off_lost,
        fmean([57.2958 * one.pitch_at_contact_rad >= PITCH_DEG[0] for one in strides[SETTLED:]] or [False]),
        done.put_back,
        any("tuning has stopped" in report.text for report in done.reports),
        done.latched,
        "",
        fmean([abs(57.2958 * one.inversion_at_contact_rad) <= ROLL_DEG for one in strides[ROLL_FROM:]] or [False]),
        late[0].text if trial.fault and late else "",
        bool(lowered),
        len(faults) - (len(late) if trial.fault else 0),
    )


@dataclass(frozen=True)
class Person:
    """Who takes part: ``made`` makes them walk; ``refused``: why they could not be calibrated."""

    settings: Any
    made: Callable[[Any], Any]
    calibration: Any = None
    refused: str = ""


def person(seed: int, who: Callable[[Any], Any], *, second: bool) -> Person:
    """The person of a seed: the first draw with a drop foot. Nobody is drawn for who cannot be calibrated."""
    made: Callable[[Any], Any] = SecondPatient if second else VirtualPatient
    for attempt in count():
        settings = draw_second(1000 * seed + attempt) if second else who(drawn(seed, attempt))
        if has_a_drop_foot(settings, made):
            break
    try:
        return Person(settings, made, calibration_of(settings, made))
    except CalibrationError as error:
        return Person(settings, made, refused=str(error))


def one_walk(one: Person, trial: Trial, arm: str, set_ma: float) -> Result:
    settings, made = one.settings, one.made
    geometry = made(settings).geometry["right_foot"]
    if arm == "two":
        settings = replace(settings, evertor_channel=EVERTORS)
    happened: list[int] = []
    due = sorted(trial.acts)

    def during(patient: Any, t_ns: int) -> None:
        walked = sum(stride.foot == "right_foot" for stride in patient.strides)
        while len(happened) < len(due) and walked >= due[len(happened)]:
            trial.acts[due[len(happened)]](patient, settings)
            happened.append(t_ns)

    session = session_of(geometry, arm, set_ma)
    done = walk(
        settings, session, one.calibration, SECONDS, STRIDES, during, prepare=partial(with_rule, arm), made=made
    )
    return judge(done, trial, happened[0] if happened and trial.fault else None)


def one_person(seed: int, names: Sequence[str], arms: Sequence[str], *, second: bool = False) -> dict[str, Any]:
    """All walks of one person, by trial and arm."""
    found: dict[str, dict[str, Result]] = {}
    set_ma: dict[str, float] = {}
    for name in names:
        trial = TRIALS[name]
        one = person(seed, trial.who, second=second)
        found[name] = {}
        ways = {"fixed": lambda ma: channel_of(ma, extension_s=0.0), "short": partial(short_channel, extension_s=0.0)}
        for arm in arms:
            if one.refused:
                found[name][arm] = Result([False] * (STRIDES - 3), refused=one.refused)
                continue
            ma = START_MA
            if arm in ways:
                geometry = one.made(one.settings).geometry["right_foot"]
                key = f"{arm} {one.settings}"  # events do not change what is set that day
                if key not in set_ma:
                    set_ma[key] = titrated_ma(one.settings, geometry, one.calibration, ways[arm], one.made)
                ma = set_ma[key]
            found[name][arm] = one_walk(one, trial, arm, ma)
    return found


class Kept:
    """Results by model, seed, trial and arm, in a file where there is one; those of another tuning count as none."""

    def __init__(self, path: Path | None) -> None:
        self.results: dict[tuple[bool, int, str, str], Result] = {}
        self._path = path
        here = Path(__file__).resolve().parent
        files = {*(here.parents[1] / "fes" / "stimulation" / "tuning").glob("*.py"), here / "plain_rule.py"}
        files |= {here / "second_patient.py", here / "tuning_cohort.py", here / "closed_loop_walk.py"}
        others = digest(file for file in files if file.name not in OWN_RULE)
        self._tuning = {arm: digest(files) if arm in ("tuner", "two") else others for arm in ARMS}
        for line in path.read_text(encoding="utf-8").splitlines() if path is not None and path.is_file() else ():
            row = json.loads(line)
            if row["tuning"] == self._tuning[row["arm"]]:
                row["result"]["inside"] = [each == "1" for each in row["result"]["inside"]]
                self.results[row["second"], row["seed"], row["trial"], row["arm"]] = Result(**row["result"])

    def has(self, second: bool, seed: int, trial: str, arms: Sequence[str]) -> bool:
        return all((second, seed, trial, arm) in self.results for arm in arms)

    def left(self, second: bool, seed: int, trials: Sequence[str], arms: Sequence[str]) -> tuple[list[str], list[str]]:
        """The trials and the arms in which something of these is not there yet."""
        names = [name for name in trials if not self.has(second, seed, name, arms)]
        return names, [arm for arm in arms if not all(self.has(second, seed, name, [arm]) for name in trials)]

    def add(self, second: bool, seed: int, walked: dict[str, dict[str, Result]]) -> None:
        """What a person's walks brought, by trial and arm."""
        for trial, by_arm in walked.items():
            for arm, result in by_arm.items():
                self.results[second, seed, trial, arm] = result
                inside = "".join("01"[each] for each in result.inside)
                row = {"tuning": self._tuning[arm], "second": second, "seed": seed, "trial": trial, "arm": arm}
                if self._path is not None:
                    with self._path.open("a", encoding="utf-8") as file:
                        file.write(json.dumps({**row, "result": asdict(result) | {"inside": inside}}) + "\n")


# --- tables ---------------------------------------------------------------------------------------------------

HEAD = (
    "trial", "arm", "in the band after stride 10", "within 6 strides", "µC a step, median",
    "stumbles / drags from stride 6", "push-off lost", "heel first", "heels put back (T5)", "stopped itself", "latched",
    "refused", "landed within 5°",
)  # fmt: skip


def rows(name: str, every: Sequence[dict[str, Result]]) -> Iterator[list[str]]:
    """A trial's lines, one an arm."""
    for arm in every[0]:
        mine = [one[arm] for one in every]
        yield [
            TRIALS[name].text,
            arm,
            f"{fmean(one.settled for one in mine):.1%}",
            f"{sum(one.soon for one in mine)} of {len(mine)}",
            f"{median(one.charge_uc for one in mine if not one.refused):.0f}",
            f"{sum(one.stumbles for one in mine)} / {sum(one.drags for one in mine)}",
            f"{fmean(one.push_off_lost for one in mine if not one.refused):.1%}",
            f"{fmean(one.heel_first for one in mine):.0%}",
            str(sum(one.put_back for one in mine)),
            *(str(sum(bool(getattr(one, what)) for one in mine)) for what in ("stopped", "latched", "refused")),
            f"{fmean(one.rolled for one in mine):.1%}",
        ]


def differences(name: str, every: Sequence[dict[str, Result]]) -> list[str]:
    """Between arms, over the same people: strides in the band after the tenth in points, and charge in %."""
    lines = []
    for one, other in (pair for pair in PAIRS if set(pair) <= set(every[0])):
        points = [100.0 * (each[one].settled - each[other].settled) for each in every]
        charge = [
            100.0 * (each[one].charge_uc / each[other].charge_uc - 1.0) for each in every
            if not each[one].refused and each[other].charge_uc > 0.0
        ]  # fmt: skip
        lines.append(
            f"{TRIALS[name].text}, {one} − {other}: {interval(points, fmean)} points in the band after stride 10; "
            f"charge {interval(charge, median)} % (median)"
        )
    return lines


def interval(values: Sequence[float], middle: Callable[[Sequence[float]], float]) -> str:
    """A statistic with the 95 % interval of 4,000 draws of as many people."""
    chance = np.random.default_rng(37)
    picks = chance.integers(0, len(values), (4000, len(values)))
    found = [float(middle(list(np.asarray(values)[pick]))) for pick in picks]
    low, high = np.quantile(found, [0.025, 0.975])
    return f"{middle(values):+.1f} [{low:+.1f}, {high:+.1f}]"


def fault_lines(name: str, every: Sequence[dict[str, Result]]) -> list[str]:
    """What was named, and whether anything was lowered meanwhile."""
    trial, lines = TRIALS[name], []
    for arm in (arm for arm in every[0] if arm in ("tuner", "two")):
        mine = [one[arm] for one in every if not one[arm].refused]
        strides = sum(len(one.inside) for one in mine)
        said = f"false names {1e3 * sum(one.false_names for one in mine) / max(strides, 1):.2f} per 1,000 strides"
        if trial.fault:
            right = sum(trial.fault in one.named for one in mine)
            wrong = sum(bool(one.named) and trial.fault not in one.named for one in mine)
            lowered = sum(one.lowered for one in mine)
            said = f"named in {right} of {len(mine)}, as something else in {wrong}; lowered within {SPARED} strides in "
            said += f"{lowered}; before it {sum(one.false_names for one in mine)} false names"
        lines.append(f"{trial.text}, {arm}: {said}")
    return lines


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--patients", type=int, default=20)
    parser.add_argument("--first", type=int, default=130000, help="seed of the first")
    parser.add_argument("--second", type=int, default=0, help="how many of the second patient model")
    parser.add_argument("--second-first", type=int, default=1)
    parser.add_argument("--trials", nargs="+", default=["day"], choices=[*TRIALS, "all"])
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=ARMS)
    parser.add_argument("--processes", type=int, default=1, help="at once")
    parser.add_argument("--keep", type=Path, help="file of results, a line a person and trial")
    parser.add_argument("--kept", action="store_true", help="nobody walks: the tables of who stands in the file")
    asked = parser.parse_args()
    names = list(TRIALS) if "all" in asked.trials else asked.trials
    groups = [
        ("The first patient model", range(asked.first, asked.first + asked.patients), names, asked.arms, False),
        (
            "The second patient model", range(asked.second_first, asked.second_first + asked.second),
            [name for name in names if name in ("day", "slip", "drift")], [a for a in asked.arms if a != "two"], True,
        ),
    ]  # fmt: skip
    kept, tables, notes = Kept(asked.keep), list[Table](), list[str]()
    with ProcessPoolExecutor(asked.processes) as pool:
        for title, seeds, trials, arms, second in groups:
            walks = {
                seed: pool.submit(one_person, seed, *left, second=second)
                for seed in seeds if all(left := kept.left(second, seed, trials, arms)) and not asked.kept
            }  # fmt: skip
            try:
                for seed, one in walks.items():
                    kept.add(second, seed, one.result())
            except (KeyboardInterrupt, BrokenProcessPool):
                print("interrupted: the tables have who has walked", flush=True)
            walked = {name: [seed for seed in seeds if kept.has(second, seed, name, arms)] for name in trials}
            if not any(walked.values()):
                continue
            lines = list[list[str]]()
            for name, who in walked.items():
                every = [{arm: kept.results[second, seed, name, arm] for arm in arms} for seed in who]
                if every:
                    lines += rows(name, every)
                    said = [f"{TRIALS[name].text}: {len(who)} people, seeds {who[0]} to {who[-1]}"]
                    said += differences(name, every) + fault_lines(name, every)
                    notes += [f"second model, {each}" if second else each for each in said]
            tables.append(table_of(title, HEAD, lines))
    publish(tables, asked, notes)


if __name__ == "__main__":
    main()
