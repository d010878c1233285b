"""The four phases against footswitches: ours, and a hidden Markov model trained with the judged person left out.

    python benchmarks/accuracy/footswitch_hmm.py [--peers PYTHON] [--data FOLDER] [--json FILE]

The set's own paper (Sánchez Manchola et al. 2019) prints timing errors and goodness indices of such a model, causal
thresholds beside it. The model sees whole trials (Viterbi); our phases are causal. Per walker: how much later than the
label T1–T4 are (median ± SD, ms), in strides that have all four in order; and the goodness index
√((1 − sensitivity)² + (1 − specificity)²) over samples, mean of the four phases (0 is perfect, 0.7 is chance). Neither
spikes nor stalls nor bursts are judged. hmmlearn lives in the peers' environment (``make peers``).
"""

from __future__ import annotations

import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.accuracy.every_walker import (
    TIMES,
    Foot,
    Found,
    against_labels,
    calibrate,
    causal,
    footswitch_treadmill,
    swings_of,
)
from benchmarks.accuracy.stroke_treadmill import data_folder
from benchmarks.lib.command_line import console_of, parser_of, publish
from benchmarks.lib.swing_judge import Labelled
from fes.analysis.swings import GRID_HZ, pitch_of
from fes.estimation.foot.calibration import CalibrationError
from fes.signals import FloatArray, IntArray
from statemachine.phases import Phase, PhaseChange, Transition

ROOT = Path(__file__).resolve().parents[2]
PHASE_OF_LABEL = np.array([3, 0, 1, 2])  # loading response, stance, pre-swing, swing, as the machine numbers them
ENTERED_BY = {0: Transition.T3, 1: Transition.T4, 2: Transition.T1, 3: Transition.T2}


def features(foot: Foot) -> tuple[IntArray, FloatArray]:
    """Times (N,) ns and the sagittal rate with its derivative (N, 2), each over its SD."""
    track = foot.track
    t_ns, pitch = pitch_of(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    rate = np.gradient(pitch) * GRID_HZ
    columns = np.column_stack((rate, np.gradient(rate) * GRID_HZ))
    return t_ns, columns / columns.std(axis=0)


def labels_at(labels: Labelled, t_ns: IntArray) -> tuple[IntArray, Any]:
    """The labels at these times, and whether they can be judged."""
    at = np.searchsorted(labels.t_ns, t_ns).clip(0, len(labels.t_ns) - 1)
    return labels.label[at], labels.sound[at]


def changes_from(sensor: str, t_ns: IntArray, label: IntArray) -> list[PhaseChange]:
    """Decoded labels as phase changes."""
    phases = [Phase(int(k)) for k in PHASE_OF_LABEL[label]]
    return [
        PhaseChange(int(t_ns[k]), sensor, ENTERED_BY[int(label[k])], phases[k - 1], phases[k])
        for k in np.flatnonzero(np.diff(label)) + 1
    ]


def goodness(labels: Labelled, changes: list[PhaseChange], t_ns: IntArray) -> float:
    """Mean of the phases' goodness indices over the samples that can be judged."""
    label, sound = labels_at(labels, t_ns)
    phases = np.array([0, *(int(change.destination) for change in changes)])
    phase = phases[np.searchsorted(np.array([c.t_ns for c in changes], np.int64), t_ns, side="right")][sound]
    true = PHASE_OF_LABEL[label][sound]
    found = []
    for k in range(4):
        hit, miss = phase[true == k] == k, phase[true != k] == k
        if len(hit):
            found.append(float(np.hypot(1.0 - hit.mean(), miss.mean())))
    return float(np.mean(found))


def decoded(python: str, feet: list[Foot], seen: list[tuple[IntArray, FloatArray]]) -> list[IntArray]:
    """What the model makes of every trial."""
    with TemporaryDirectory() as folder:
        given, made = Path(folder) / "in.npz", Path(folder) / "out.npz"
        arrays: dict[str, Any] = {"persons": np.array([foot.person for foot in feet])}
        for k, (foot, (t_ns, x)) in enumerate(zip(feet, seen, strict=True)):
            assert foot.labels is not None
            arrays |= {f"x_{k}": x, f"y_{k}": labels_at(foot.labels, t_ns)[0]}
        np.savez(given, **arrays)
        subprocess.run([python, str(ROOT / "benchmarks/peers/run_hmm.py"), str(given), str(made)], check=True)
        with np.load(made) as out:
            return [out[f"y_{k}"] for k in range(len(feet))]


def main(arguments: list[str] | None = None) -> int:
    """Print the table; 3 without data or peer."""
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--peers", default=str(ROOT / ".venv-peers/bin/python"), help="the peers' Python")
    options = parser.parse_args(arguments)
    feet = list(footswitch_treadmill(options.data / "unseen_walkers", "unseen"))
    if not feet or not Path(options.peers).exists():
        print(f"No recordings in {options.data}, or no {options.peers}; set FES_DATA, make peers.", file=sys.stderr)
        return 3
    seen = [features(foot) for foot in feet]
    rows: dict[tuple[str, str], list[tuple[Found, float]]] = defaultdict(list)
    for foot, (t_ns, _), label in zip(feet, seen, decoded(options.peers, feet, seen), strict=True):
        assert foot.labels is not None
        made = {"hidden Markov model": changes_from(foot.track.sensor, t_ns, label)}
        try:
            made["fes, causal"] = causal(foot.track, calibrate(foot.track))[0]
        except CalibrationError:
            made["fes, causal"] = []
        for method, changes in made.items():
            found = Found(foot.data_set, foot.part, foot.person, foot.run, foot.track.sensor)
            swings = swings_of(foot)
            against_labels(found, foot.labels, swings, changes)
            found.strides = len(found.flat_ms)
            rows[foot.person, method].append((found, goodness(foot.labels, changes, t_ns)))
    table = Table("walker", "method", "in order %", *(f"{each.name} ms" for each in TIMES), "goodness")
    for (person, method), trials in sorted(rows.items()):
        order = 100.0 * sum(f.in_order for f, _ in trials) / max(sum(f.strides for f, _ in trials), 1)
        later = {each.name: [ms for f, _ in trials for ms in f.later_ms.get(each.name, [])] for each in TIMES}
        cells = [f"{np.median(ms):+.0f} ± {np.std(ms):.0f}" if len(ms) > 4 else "–" for ms in later.values()]
        index = float(np.mean([g for _, g in trials]))
        table.add_row(person, method, f"{order:.1f}", *cells, f"{index:.3f}")
    publish(console_of(130), [table], options)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
