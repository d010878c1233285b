"""Gait parameters against the truth of virtual and bundled walks: least to greatest of the feet's mean errors; bars.

Walks: Wang et al.'s five hemiparetic patterns (100 Hz, afflicted right, the ones looked at while the rules of
fes/analysis/parameters/contacts.py and equalise_sides.py were made), again with other seeds, 200 Hz and the left side
afflicted, and the bundled walks of both feet; with ``--seed`` walks that nobody has looked at. Only strides whose own
span lies where the belt is known to run at full speed count: no sensor on a foot can tell the way of a foot that stands
on a belt which speeds up. What counts from a stride's start (heights, rotations, sideways ways) is compared between its
own ends: where in mid-stance a stride begins is free. Lengths, times, PV and OV are those of the truth's own strides.
The truth of toe clearance is on the true path of the point of the sole that [geometry] names; the virtual foot bends at
its ball, so its own number ("model") is another.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.lib.command_line import parser_of, publish, table_of, verdict
from benchmarks.lib.foot_paths import FootPath, join_paths
from benchmarks.lib.real_sets import data_folder, gaitmap_cases, trials
from benchmarks.lib.swing_judge import later_ms
from fes.analysis.parameters.contacts import no_swings
from fes.analysis.parameters.gait import gait_parameters
from fes.analysis.parameters.motion import motions, pitches, variations
from fes.analysis.pipeline import analyse, calibrations_of
from fes.analysis.results import Analysis
from fes.estimation.clearance.clearance import TOE, FootArms, arms_of, clearances
from fes.recording import Recording
from fes.signals import FOOT_SENSORS, NS_PER_S, FloatArray
from fes.simulation.forward import VirtualPatient, settings_for
from fes.simulation.forward.closed_loop import recording_of, truth_of
from fes.simulation.truth import FootTruth, Truth, TruthStride

BUNDLED = ("both_feet_100hz", "both_feet_200hz", "misaligned")
NEAR_MS = 250.0
BARS = {
    "stride_length_percent": 2.0, "swing_ms": 20.0, "stance_ms": 20.0, "clearance_cm": 0.5, "mlr_deg": 3.0,
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    name: str
    recording: Recording
    truth: Truth


@dataclass
class Errors:
    """One foot of one walk: mean and SD of estimate − truth by quantity; ``n`` strides compared of ``true``."""

    case: str
    foot: str
    afflicted: bool
    true: int
    n: int = 0
    of: dict[str, tuple[float, float]] = field(default_factory=dict)

    def missed(self) -> list[str]:
        """The bars that the means do not hold."""
        return [key for key, bar in BARS.items() if not abs(self.of[key][0]) <= bar]


def virtual_walk(pattern: int, seed: int, rate_hz: float, side: str, seconds: float) -> Case:
    """One of Wang's five patterns, from standing to standing."""
    settings = settings_for(
        "moderate", pattern=f"hemiparetic_{pattern}", seed=seed, rate_hz=rate_hz, side=side, sensors=FOOT_SENSORS
    )
    patient = VirtualPatient(settings)
    samples = patient.advance(round(seconds * NS_PER_S))
    patient.stop()
    samples += patient.advance(round((seconds + 10.0) * NS_PER_S))
    name = f"hemiparetic {pattern}, {rate_hz:.0f} Hz, {side}"
    return Case(name, recording_of(patient, samples, name, ""), truth_of(patient, name))


def cases(*, fast: bool = False, seed: int = 0) -> Iterator[Case]:
    for pattern in range(1, 6):
        yield virtual_walk(pattern, seed + pattern, 100.0, "right", 35.0 if fast else 80.0)
    if fast:
        return
    for pattern in range(1, 6):
        yield virtual_walk(pattern, seed + 100 + pattern, 200.0, "left", 80.0)
    yield from (Case(*trial) for trial in trials(BUNDLED))


def true_path(foot: FootTruth, stride: TruthStride, begin_s: float, end_s: float) -> FootPath:
    """What was true between these times: sensor's way, and the foot's axes, level and straight ahead at the start."""
    first, last = np.searchsorted(foot.t_ns, [1e9 * begin_s, 1e9 * end_s]).tolist()
    rows = slice(first, min(last, len(foot.t_ns) - 1) + 1)
    ahead = (foot.toe_m - foot.heel_m)[first] * np.array([1.0, 1.0, 0.0])
    ahead /= np.linalg.norm(ahead)
    start = np.column_stack([ahead, np.cross([0.0, 0.0, 1.0], ahead), [0.0, 0.0, 1.0]])
    turned = Rotation.from_quat(foot.q_world_from_sensor[rows], scalar_first=True)
    axes = (turned * turned[0].inv()).as_matrix() @ start
    swing_ns = (round(1e9 * stride.t_swing_s), round(1e9 * stride.t_loading_response_s))
    return FootPath(stride.number, foot.t_ns[rows], foot.sensor_m[rows] - foot.sensor_m[first], axes, *swing_ns)


def compare(case: Case) -> tuple[list[Errors], Analysis]:
    recording, found = calibrations_of(case.recording)
    result = analyse(recording, found.calibrations)
    parameters = gait_parameters(result)
    out = []
    full = [true for foot in parameters.strides for true in case.truth.strides_of(foot) if true.steady]
    begin_s, end_s = min(true.t_start_s for true in full), max(true.t_end_s for true in full)
    for foot, strides in parameters.strides.items():
        truth = case.truth.strides_of(foot)
        afflicted = foot.removesuffix("_foot") in case.name
        errors = Errors(case.name, foot, afflicted, sum(t.steady and t.walking for t in truth))
        arms = arms_of(case.recording.geometry[foot])
        rows: list[dict[str, float]] = []
        for k, true in enumerate(truth):
            if not (true.steady and true.walking):
                continue
            own = [s for s in strides if s["t_start_s"] < true.t_swing_s < s["t_end_s"]]
            if own and own[0]["t_start_s"] >= begin_s and own[0]["t_end_s"] <= end_s:
                before = truth[k - 1] if k and truth[k - 1].walking else None
                rows.append(_differences(own[0], true, before, case, foot, arms))
        errors.n = len(rows)
        errors.of = {key: _spread([row[key] for row in rows]) for key in (rows[0] if rows else {})}
        errors.of |= {key: (math.nan, math.nan) for key in BARS if key not in errors.of}
        out.append(errors)
    return out, result


def markers(folder: Path) -> list[tuple[str, str, float, float, int]]:
    """Contacts on the one real walk with true ones, optical markers: what, by whom, mean and SD (ms), how many."""
    tracks = {case.track.sensor: case for case in gaitmap_cases(folder)}
    recording = Recording("gaitmap_walk", None, {foot: case.track for foot, case in tracks.items()})
    recording, found = calibrations_of(recording)
    result = analyse(recording, found.calibrations)
    parameters = gait_parameters(result)
    times: dict[tuple[str, str], list[float]] = {}
    for foot, case in tracks.items():
        events, rows = result.events[foot], parameters.strides[foot]
        for what, true, plain, ours in (
            ("IC", case.ic_s, events.ic_ns / NS_PER_S, rows["t_contact_s"]),
            ("FO", case.fo_s, events.fo_ns / NS_PER_S, rows["t_foot_off_s"]),
        ):
            for by, told in (("off-line events", plain), ("parameters", ours)):
                times.setdefault((what, by), []).extend(later_ms(told[np.isfinite(told)], true, NEAR_MS))
    return [(what, by, *_spread(values), len(values)) for (what, by), values in times.items()]


def _differences(
    v: dict[str, float], true: TruthStride, before: TruthStride | None, case: Case, foot: str, arms: FootArms
) -> dict[str, float]:
    feet = case.truth.feet[foot]
    path = true_path(feet, true, v["t_start_s"], v["t_end_s"])
    paths, unseen = join_paths([path]), no_swings(1)
    pitch, t = pitches(paths), 1e-9 * path.t_ns
    side = foot.removesuffix("_foot")
    mdd, circumduction, mlr = motions(paths, pitch, unseen.foot_off_ns, unseen.contact_ns, side)[0, :3].tolist()
    pv = ov = math.nan
    if before is not None:
        both = join_paths([true_path(feet, each, each.t_start_s, each.t_end_s) for each in (before, true)])
        pv, ov = variations(both, np.array([[0, 1]]))[0].tolist()
    stance = true.t_swing_s - before.t_loading_response_s if before is not None else math.nan
    return {
        "stride_length_percent": 100.0 * (v["stride_length_common_m"] / true.stride_length_m - 1.0),
        "swing_ms": 1e3 * (v["swing_s"] - (true.t_loading_response_s - true.t_swing_s)),
        "stance_ms": 1e3 * (v["stance_s"] - stance),
        "clearance_cm": 100.0 * (v["lift_m"] - float((path.position_m[:, 2] - path.position_m[0, 2]).max())),
        "mlr_deg": math.degrees(v["heel_rotation_rad"] - mlr),
        "toe_cm": 100.0 * (v["toe_clearance_m"] - float(clearances(paths, arms, None)[0, TOE])),
        "toe_model_cm": 100.0 * (v["toe_clearance_m"] - true.toe_clearance_m),
        "mdd_cm": 100.0 * (v["deviation_m"] - mdd),
        "circumduction_cm": 100.0 * (v["circumduction_m"] - circumduction),
        "angle_ic_deg": math.degrees(v["angle_contact_rad"] - np.interp(true.t_loading_response_s, t, pitch)),
        "angle_fo_deg": math.degrees(v["angle_off_rad"] - np.interp(true.t_swing_s, t, pitch)),
        "pv_cm": 100.0 * (v["position_variation_m"] - pv),
        "ov_deg": math.degrees(v["orientation_variation_rad"] - ov),
        "step_length_cm": 100.0 * (v["step_length_m"] - _step_length(case.truth, true)),
        "double_support_ms": 1e3 * (v["double_support_s"] - _double_support(case.truth, true, before)),
    }


def _step_length(truth: Truth, true: TruthStride) -> float:
    """Between the mid-stances; sensors do not sit alike on the feet, so standing side by side counts as zero."""
    other = next((name for name in truth.feet if name != true.foot), None)
    if other is None:
        return math.nan
    landed = [s.t_end_s for s in truth.strides_of(other) if s.t_loading_response_s < true.t_loading_response_s]
    places = []
    for foot, t_s in ((true.foot, true.t_end_s), (other, landed[-1] if landed else 0.0)):
        poses = truth.feet[foot]
        at = min(int(np.searchsorted(poses.t_ns, 1e9 * t_s)), len(poses.t_ns) - 1)
        places.append(float(poses.sensor_m[at, 0] - poses.sensor_m[0, 0]))
    return places[0] - places[1]


def _double_support(truth: Truth, true: TruthStride, before: TruthStride | None) -> float:
    if before is None:
        return math.nan
    begin, end = before.t_loading_response_s, true.t_swing_s
    inside = [s for s in truth.strides if s.foot != true.foot and begin < s.t_swing_s < s.t_loading_response_s < end]
    if len(inside) != 1:
        return math.nan
    return (inside[0].t_swing_s - begin) + (end - inside[0].t_loading_response_s)


def _spread(values: list[float]) -> tuple[float, float]:
    kept: FloatArray = np.array([value for value in values if math.isfinite(value)])
    if len(kept) < 2:
        return math.nan, math.nan
    return float(kept.mean()), float(kept.std(ddof=1))


NAMED = {
    "stride_length_percent": ("stride length, %", 1), "swing_ms": ("swing time, ms", 0),
    "stance_ms": ("stance time, ms", 0), "clearance_cm": ("sensor's clearance (MLH), cm", 2), "mlr_deg": ("MLR, °", 1),
    "toe_cm": ("MTC of the named point, cm", 1), "toe_model_cm": ("MTC, model, cm", 1), "mdd_cm": ("MDD, cm", 1),
    "circumduction_cm": ("circumduction, cm", 1), "angle_ic_deg": ("foot angle at IC, °", 1),
    "angle_fo_deg": ("foot angle at FO, °", 1), "pv_cm": ("PV, cm", 1), "ov_deg": ("OV, °", 1),
    "double_support_ms": ("double support, ms", 0), "step_length_cm": ("step length, cm", 0),
}  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--seed", type=int, default=0, help="added to the seeds of all virtual walks")
    options = parser.parse_args(arguments)
    groups: dict[str, list[Errors]] = {}
    for case in cases(seed=options.seed):
        name = next((f"patterns, {hz} Hz" for hz in (100, 200) if f"{hz} Hz" in case.name), "bundled")
        groups.setdefault(name, []).extend(compare(case)[0])
    rows = []
    for key, (name, digits) in NAMED.items():
        means = [np.array([errors.of[key][0] for errors in feet if key in errors.of]) for feet in groups.values()]
        known = [values[np.isfinite(values)] for values in means]
        spans = [f"{v.min():+.{digits}f} … {v.max():+.{digits}f}" if len(v) else "–" for v in known]
        rows.append([name, f"{BARS[key]:g}" if key in BARS else "", *spans])
    heads = [f"{name} ({len(feet)} feet)" for name, feet in groups.items()]
    missed = [(e.case, e.foot, key) for feet in groups.values() for e in feet for key in e.missed()]
    notes = [f"misses its bar: {case}, {foot}: {key}" for case, foot, key in missed]
    if (data_folder() / "gaitmap_walk").is_dir():
        notes += [
            f"gaitmap_walk against markers, {what} by {by}: {mean:+.1f} ± {sd:.1f} ms, {n} contacts"
            for what, by, mean, sd, n in markers(data_folder())
        ]
    publish([table_of("", ("quantity", "bar", *heads), rows)], options, notes)
    return verdict(not missed)


if __name__ == "__main__":
    raise SystemExit(main())
