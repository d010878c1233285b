"""Does `fes timing check` find what it must, and stay silent on unchanged code? Four plants, 20 seeds, 13 stroke runs.

    python benchmarks/loop/timing_plants.py [--seeds 20] [--walks 10] [--workers 2] [--keep FOLDER] [--data DIR]

Each seed makes ten simulated walks of two feet and 100 strides (1,000 strides in all), of a walker of its own. Their
baseline goes through the file's text. Then the walks are replayed by another process: unchanged, and one of the ten
with each plant in the running program, as if it showed in no other:

- a guard 20 ms later: one of T1 to T4, by the seed; what follows it waits as well
- an envelope that starts 10 ms later, on every channel
- one stride of the 1,000 missed: its four transitions, on one foot
- a latency that grew by 1 ms at p99: every 50th decision takes a millisecond longer, and nothing else changes

A plant is caught if a failure names the kind of mark that was changed (or the latency). The second table asks for less:
the walks are new to the baseline, which has those of the other seeds' walkers only; what is judged is the bias against
the truth. The stroke runs are imported, and checked by the command itself, twice; they are not part of the project.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.table import Table

from benchmarks.accuracy.stroke_treadmill import data_folder
from benchmarks.lib.command_line import console_of, parser_of, save, verdict
from fes.calibration.recording import calibrate_phase_sensors
from fes.config import Session, load_session
from fes.control.controller import Controller, Decision
from fes.control.replay import session_for
from fes.estimation.sensor_choice import Calibration
from fes.estimation.tracking.tracker import Outcome, Tracker
from fes.estimation.warm_up import warm_up
from fes.evaluation.timing.judgement import (
    LATENCY,
    Baseline,
    Failure,
    Limits,
    Measured,
    RecordingTiming,
    as_baseline,
    baseline_text,
    judge,
    measure,
    read_baseline,
)
from fes.evaluation.timing.truth import read_truth, without_cut_ends
from fes.recording import read_recording
from fes.signals import Event, ImuSample, Vector3
from sim_inputs.generator import trials
from statemachine.phases import PhaseChange, Transition

ROOT: Final = Path(__file__).resolve().parents[2]
STRIDES, UNKNOWN = 50, 2  # of each foot in a walk; walks judged as unknown ones
GUARD_NS, ENVELOPE_S, SLOWER_NS, EVERY = 20_000_000, 0.010, 1_000_000, 50
PLANTS: Final = ("guard", "envelope", "stride", "latency")
WORDS: Final = {
    "none": "unchanged",
    "guard": "a guard 20 ms later",
    "envelope": "an envelope 10 ms later",
    "stride": "one stride missed",
    "latency": "latency +1 ms at p99",
}
REPEATS: Final = 2


class ChangedTracker:
    """A tracker of which one thing is changed; all else is its own."""

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker

    def __getattr__(self, name: str) -> Any:
        return getattr(self._tracker, name)


class LateGuard(ChangedTracker):
    """One guard fires 20 ms later, at the first sample from then on; what follows waits for it."""

    def __init__(self, tracker: Tracker, late: Transition) -> None:
        super().__init__(tracker)
        self._late, self._held, self._until_ns = late, list[Outcome](), 0

    def step(self, t_ns: int, acc_mps2: Vector3, gyr_radps: Vector3) -> list[Outcome]:
        """As :meth:`Tracker.step`."""
        for outcome in self._tracker.step(t_ns, acc_mps2, gyr_radps):
            fired = isinstance(outcome, PhaseChange) and outcome.transition == self._late
            if fired and t_ns >= self._until_ns:
                self._until_ns = t_ns + GUARD_NS
            self._held.append(outcome)
        if t_ns < self._until_ns:
            return []
        out = [replace(each, t_ns=t_ns) if isinstance(each, PhaseChange) else each for each in self._held]
        self._held = []
        return out


class MissedStride(ChangedTracker):
    """One stride, by its number, is not seen: none of its transitions, and no result."""

    def __init__(self, tracker: Tracker, number: int) -> None:
        super().__init__(tracker)
        self._number, self._begun = number, 0

    def step(self, t_ns: int, acc_mps2: Vector3, gyr_radps: Vector3) -> list[Outcome]:
        """As :meth:`Tracker.step`."""
        out = []
        for outcome in self._tracker.step(t_ns, acc_mps2, gyr_radps):
            if isinstance(outcome, PhaseChange) and outcome.transition == Transition.T1:
                self._begun += 1
            if self._begun != self._number:
                out.append(outcome)
        return out


class SlowController(Controller):
    """Every 50th sample's decision takes a millisecond longer."""

    samples = 0

    def step(self, event: Event) -> Decision:
        """As :meth:`Controller.step`."""
        decision = super().step(event)
        if isinstance(event, ImuSample):
            self.samples += 1
            if self.samples % EVERY == 0:
                until_ns = time.perf_counter_ns() + SLOWER_NS
                while time.perf_counter_ns() < until_ns:
                    pass
        return decision


ControllerMaker = Callable[[Session, Mapping[str, Calibration]], Controller]


def controller_with(change: Callable[[str, Tracker], ChangedTracker]) -> ControllerMaker:
    """Controllers whose trackers are changed."""

    def made(session: Session, calibrations: Mapping[str, Calibration]) -> Controller:
        controller = Controller(session, calibrations)
        changed: dict[str, Any] = {foot: change(foot, tracker) for foot, tracker in controller.trackers.items()}
        controller.trackers = changed
        return controller

    return made


def late_envelope(session: Session, calibrations: Mapping[str, Calibration]) -> Controller:
    """A controller whose envelopes start 10 ms after what the session asks for."""
    channels = [each.model_copy(update={"start_delay_s": each.start_delay_s + ENVELOPE_S}) for each in session.channels]
    return Controller(session.model_copy(update={"channels": tuple(channels)}), calibrations)


def walk_hit(seed: int, walks: int) -> int:
    """The one walk that has the plants."""
    return int(np.random.default_rng(90_000 + seed).integers(walks))


def planted(plant: str, seed: int) -> ControllerMaker:
    """What makes the controllers of a walk with a plant in them."""
    if plant == "guard":
        late = Transition[f"T{seed % 4 + 1}"]
        return controller_with(lambda foot, tracker: LateGuard(tracker, late))
    if plant == "envelope":
        return late_envelope
    if plant == "stride":
        rng = np.random.default_rng(seed)
        hit, number = ("left_foot", "right_foot")[int(rng.integers(2))], int(rng.integers(2, STRIDES))
        return controller_with(lambda foot, tracker: MissedStride(tracker, number if foot == hit else 0))
    return SlowController if plant == "latency" else Controller


def kinds_hit(plant: str, seed: int) -> set[str]:
    """The kinds of marks of which a failure must speak."""
    if plant == "guard":
        return {f"T{seed % 4 + 1}"}
    return {"envelope": {"on"}, "stride": {"T1", "T2", "T3", "T4"}, "latency": {LATENCY}}[plant]


def both_feet_session() -> Session:
    """The bundled settings, with the same channel on the left foot too."""
    head, channel = (ROOT / "sim_inputs" / "session.toml").read_text(encoding="utf-8").split("[[channels]]")
    left = channel.replace("right", "left").replace("number = 0", "number = 1")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.toml"
        path.write_text(f"{head}[[channels]]{channel}\n[[channels]]{left}", encoding="utf-8")
        return load_session(path)


def make_walks(seed: int, folder: Path, walks: int) -> list[Path]:
    """A seed's walks, made unless they are there: of one walker, at one speed."""
    rng = np.random.default_rng(70_000 + seed)
    base = (trials.HEALTHY, trials.SLOW_HEALTHY)[seed % 2]
    stretch, push = rng.uniform(0.9, 1.25), rng.uniform(0.85, 1.1)
    style = replace(
        base,
        pre_swing_s=base.pre_swing_s * stretch,
        stance_s=base.stance_s * stretch,
        loading_s=base.loading_s * rng.uniform(0.9, 1.3),
        push_deg=base.push_deg * push,
    )
    other = replace(style, push_deg=0.94 * style.push_deg, swing_s=0.98 * style.swing_s)
    speed_mps = float(rng.uniform(0.75, 1.0) * (1.2, 0.9)[seed % 2])
    paths = []
    for walk in range(walks):
        name = f"seed{seed:02d}_walk{walk}"
        paths.append(folder / f"{name}.parquet")
        if not paths[-1].with_name(f"{name}.activities.csv").is_file():
            fill = trials._treadmill({"right_foot": style, "left_foot": other}, STRIDES, speed_mps, 4.0, early=True)
            trials.write_trial(trials.Trial(name, 100 * seed + walk, 100.0, trials.BOTH, fill, "made anew"), folder)
    return paths


def measured_walk(path: Path, plant: str, seed: int, repeats: int) -> tuple[Measured, Session]:
    """One walk replayed, with or without a plant."""
    recording = read_recording(path)
    calibrations = calibrate_phase_sensors(recording).calibrations
    session = session_for(recording, both_feet_session())
    maker = planted(plant, seed)
    return measure(
        recording, session, calibrations, time.perf_counter_ns, repeats=repeats, controller_of=maker
    ), session


def outcome_of(
    path: Path, plant: str, seed: int, baseline: Baseline | None, *, latency: bool = True
) -> RecordingTiming:
    """One walk judged; a latency that seems to have grown is measured again, as the command does."""
    limits = Limits(baseline.tolerance_ms, baseline.allowed) if baseline else Limits()
    known = baseline is not None and path.stem in baseline.recordings
    if not latency:
        limits = replace(limits, tolerance_ms={k: v for k, v in limits.tolerance_ms.items() if k != LATENCY})
    measured, session = measured_walk(path, plant, seed, REPEATS if latency else 1)
    truth = None
    if plant == "none" or not known:  # a plant is to be found by the events themselves
        truth = without_cut_ends(read_truth(path, session, ["left_foot", "right_foot"]), *measured.span_ns)
    for _ in range(3):
        outcome = judge(measured, truth, baseline, path.stem, limits)
        if not any(failure.what == LATENCY for failure in outcome.failures):
            break
        more, _ = measured_walk(path, plant, seed, REPEATS)
        measured = replace(measured, latency_ns=np.minimum(measured.latency_ns, more.latency_ns))
    return judge(measured, truth, baseline, path.stem, limits)


def write_baseline(seed: int, folder: Path, walks: int) -> Path:
    """A seed's baseline, as a file; made unless it is there."""
    file = folder / f"seed{seed:02d}.timing.toml"
    if file.is_file():
        return file
    warm_up()
    known = {}
    for path in make_walks(seed, folder, walks):
        outcome = outcome_of(path, "none", seed, None)
        known[outcome.name] = as_baseline(outcome, path.stem, "", f"walker {seed}")
    file.write_text(baseline_text(Baseline(known)), encoding="utf-8")
    return file


@dataclass(frozen=True)
class SeedResult:
    """A seed: by plant (and "none") what was caught in words, and how many failures there were; ``strides`` checked."""

    seed: int
    strides: int
    texts: dict[str, list[str]]
    caught: dict[str, bool]


def check_seed(seed: int, folder: Path, walks: int) -> SeedResult:
    """Every plant of a seed, held against its baseline."""
    warm_up()
    baseline = read_baseline(folder / f"seed{seed:02d}.timing.toml")
    paths = make_walks(seed, folder, walks)
    texts: dict[str, list[str]] = {}
    caught: dict[str, bool] = {}
    strides = 0
    for plant in ("none", *PLANTS):
        texts[plant] = []
        failures = list[Failure]()
        for path in paths if plant == "none" else [paths[walk_hit(seed, walks)]]:
            latency = plant in ("none", "latency")
            outcome = outcome_of(path, plant, seed, baseline, latency=latency)
            failures += outcome.failures
            texts[plant] += [f"{outcome.name} {f.who} {f.what}: {f.text}" for f in outcome.failures]
            if plant == "none":
                strides += sum(len(row.pairs_ns) for row in outcome.own if row.what == "T2")
        named = {failure.what for failure in failures}
        caught[plant] = bool(failures) if plant == "none" else kinds_hit(plant, seed) <= named
    return SeedResult(seed, strides, texts, caught)


def check_unknown(seed: int, folder: Path, seeds: int, walks: int) -> dict[str, int]:
    """How many of at most two walks fail that the baseline does not know: it has those of all other seeds."""
    warm_up()
    known: dict[str, Any] = {}
    for other in range(1, seeds + 1):
        if other != seed:
            known |= read_baseline(folder / f"seed{other:02d}.timing.toml").recordings
    baseline = Baseline(known)
    found = {}
    for plant in ("none", "guard", "envelope"):
        paths = make_walks(seed, folder, min(walks, UNKNOWN))
        outcomes = [outcome_of(path, plant, seed, baseline, latency=False) for path in paths]
        found[plant] = sum(bool(outcome.failures) for outcome in outcomes)
    return found


def stroke_runs(data: Path, folder: Path) -> tuple[int, int, str]:
    """The stroke runs by the command: how many, the check's exit code, and its last words."""
    runs = sorted((data / "stroke_treadmill").glob("MR*.npz"))
    if not runs:
        return 0, 0, f"no runs in {data}: not checked"
    made, baseline = folder / "stroke", folder / "stroke.timing.toml"
    session = folder / "both.toml"
    head, channel = (ROOT / "sim_inputs" / "session.toml").read_text(encoding="utf-8").split("[[channels]]")
    left = channel.replace("right", "left").replace("number = 0", "number = 1")
    session.write_text(f"{head}[[channels]]{channel}\n[[channels]]{left}", encoding="utf-8")
    fes = [sys.executable, "-c", "from fes.cli import main; main(prog_name='fes')"]
    if not made.is_dir():
        done = subprocess.run(
            [*fes, "import", "stroke_treadmill", *map(str, runs), "--out", str(made)], capture_output=True, text=True
        )
        if done.returncode:
            return len(runs), done.returncode, done.stderr
    common = [str(made), "--session", str(session), "--baseline", str(baseline)]
    baseline.unlink(missing_ok=True)
    for arguments in (["baseline", *common], ["check", *common, "--no-report"]):
        done = subprocess.run([*fes, "timing", *arguments], capture_output=True, text=True)
        if done.returncode:
            break
    return len(runs), done.returncode, done.stderr.strip().splitlines()[-1]


def main() -> int:
    """Print both tables; 0 if every plant is caught and nothing else is."""
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--walks", type=int, default=10, help="of a seed, 100 strides each")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="where the walks are made, and stay")
    options = parser.parse_args()
    console = console_of(100)
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as made:
        folder = options.keep or Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        seeds = range(1, options.seeds + 1)
        many: dict[str, Any] = {"max_workers": options.workers, "max_tasks_per_child": 1}
        results = list[SeedResult]()
        with ProcessPoolExecutor(**many) as pool:
            for first in range(0, len(seeds), options.workers):
                part = seeds[first : first + options.workers]
                list(pool.map(partial(write_baseline, folder=folder, walks=options.walks), part))
                for result in pool.map(partial(check_seed, folder=folder, walks=options.walks), part):
                    results.append(result)
                    print(result.seed, result.caught, file=sys.stderr, flush=True)
            judge_unknown = partial(check_unknown, folder=folder, seeds=len(seeds), walks=options.walks)
            unknown = list(pool.map(judge_unknown, seeds))
        runs, code, said = stroke_runs(options.data, folder)
    table = Table(title="Against the baseline's own events, and the latency")
    for title in ("", "seeds that failed", "of", "an example"):
        table.add_column(title)
    for plant in ("none", *PLANTS):
        example = next((texts[0] for each in results if (texts := each.texts[plant])), "–")
        table.add_row(WORDS[plant], str(sum(each.caught[plant] for each in results)), str(len(results)), example)
    console.print(table)
    strides = [each.strides for each in results]
    console.print(f"{min(strides)} to {max(strides)} strides a seed.")
    other = Table(title="Walks that the baseline does not know, by their bias against the truth")
    for title in ("", "walks that failed", "of"):
        other.add_column(title)
    for plant in ("none", "guard", "envelope"):
        failed = sum(each[plant] for each in unknown)
        other.add_row(WORDS[plant], str(failed), str(min(options.walks, UNKNOWN) * len(unknown)))
    console.print(other)
    console.print(f"Stroke runs: {runs}, baseline and check by the command: exit code {code}. {said}")
    save(
        {
            "seeds": [{"seed": each.seed, "caught": each.caught, "texts": each.texts} for each in results],
            "unknown": unknown,
            "stroke_runs": {"runs": runs, "exit_code": code, "said": said},
        },
        options.json,
    )
    held = code == 0 and not any(each.caught["none"] for each in results)
    held &= all(each.caught[plant] for each in results for plant in PLANTS)
    return verdict(console, held, several=True)


if __name__ == "__main__":
    sys.exit(main())
