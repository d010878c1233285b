"""Other libraries' speed beside ours: the same recording, the same run, as ratios; they run in an own environment."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.peers.cases import case_of
from benchmarks.speed.speed import every_table, least
from benchmarks.speed.speed_row import Row
from fes.analysis.ground_path import ground_path
from fes.analysis.pipeline import calibrations_of
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.orientation.body import run, track_orientation
from fes.estimation.orientation.filter import NO_RANGE, BodySettings, new_state
from fes.recording import Recording

GROUP = "beside others, on the same recording"
STEPPED_SAMPLES = 5_000
EKF = "ahrs EKF, a call a sample"
STEP_OVER_EKF = 1.0  # a live step, with all that it does, costs no more than an EKF's orientation in Python


def peer_rows(recording: Recording, python: Path, live_step_us: float) -> list[Row]:
    """What they take in µs a sample, and how many times ours that is; none where their environment is not there.

    ``live_step_us``: what our whole live step takes on this recording.
    """
    if not python.is_file():
        return [Row(GROUP, "peers: not measured", float("nan"), note="`make peers` makes their environment")]
    recording, found = calibrations_of(recording)
    with TemporaryDirectory(prefix="fes-speed-") as name:
        folder = Path(name)
        for sensor, calibration in found.calibrations.items():
            assert isinstance(calibration, FootCalibration)
            case_of(sensor, recording.tracks[sensor], calibration, np.zeros((0, 2), np.int64), ()).write(folder)
        script = Path(__file__).parents[1] / "peers" / "run_speed.py"
        done = subprocess.run([python, script, folder], capture_output=True, text=True, check=False)
        if done.returncode:
            return [Row(GROUP, "peers: not measured", float("nan"), note=done.stderr.strip().splitlines()[-1][:120])]
        theirs = json.loads((folder / "speed.json").read_text(encoding="utf-8"))
    ours = our_costs(recording)
    stepped = {"live step": live_step_us, "orientation alone, a call a sample": ours["orientation, stepped"]}
    beside = {
        "VQF (C++), a call a sample": stepped,
        "VQF (C++), a call for all": {"orientation, all at once": ours["orientation"]},
        "PyVQF, a call a sample": stepped,
        "imufusion (C), a call a sample": stepped,
        EKF: stepped,
        "gaitmap pipeline (Herzer), RtsKalman": {"fes.analyse": ours["analysis"]},
        "gaitmap pipeline (Rampp), integration": {"fes.analyse": ours["analysis"]},
        "gaitmap RtsKalman": {"path, smoothed": ours["path"]},
    }
    rows = [
        Row(GROUP, "ours: orientation alone, a call a sample", ours["orientation, stepped"], "µs/sample"),
        Row(GROUP, "ours: orientation alone, all at once", ours["orientation"], "µs/sample"),
        Row(GROUP, "ours: path, smoothed", ours["path"], "µs/sample"),
        Row(GROUP, "ours: fes.analyse, calibration and every table", ours["analysis"], "µs/sample"),
        Row(GROUP, "ours: live step, all of it", live_step_us, "µs/sample"),
    ]
    for name, value in theirs["us"].items():
        times = (f"{value / own:.3g} times our {what}" for what, own in beside[name].items())
        rows.append(Row(GROUP, name, value, "µs/sample", note=", ".join(times)))
        if name == EKF:
            rows.append(Row(GROUP, "our live step over that EKF", live_step_us / value, "", STEP_OVER_EKF))
    rows += [Row(GROUP, f"{part}: failed", float("nan"), note=why[:120]) for part, why in theirs["failed"].items()]
    return rows


def our_costs(recording: Recording) -> dict[str, float]:
    """What corresponds to theirs, in µs a sample of one foot."""
    recording, found = calibrations_of(recording)
    samples = sum(len(track.t_ns) for track in recording.tracks.values())
    tracks = [recording.tracks[sensor] for sensor in found.calibrations]
    every_table(recording)

    def orientations() -> None:
        for track in tracks:
            track_orientation(track.acc_mps2, track.gyr_radps, track.rate_hz)

    def paths() -> None:
        for sensor, calibration in found.calibrations.items():
            assert isinstance(calibration, FootCalibration)
            ground_path(recording.tracks[sensor], calibration)

    def stepped() -> None:
        state, still, ranges = new_state(BodySettings()), np.zeros(1, bool), np.full(2, NO_RANGE)
        for acc, gyr in pairs:
            run(state, acc, gyr, still, 1.0 / tracks[0].rate_hz, ranges, BodySettings())

    pairs = list(
        zip(tracks[0].acc_mps2[:STEPPED_SAMPLES, None], tracks[0].gyr_radps[:STEPPED_SAMPLES, None], strict=True)
    )
    orientations()

    return {
        "orientation": 1e6 * least(orientations) / samples,
        "orientation, stepped": 1e6 * least(stepped) / len(pairs),
        "path": 1e6 * least(paths) / samples,
        "analysis": 1e6 * least(lambda: every_table(recording)) / samples,
    }
