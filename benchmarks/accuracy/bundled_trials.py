"""Phases, stride length and clearance on the bundled trials against their truth; exit code 1 if the bar fails.

The bar is Table 2 of Negård et al. (2005), the better of its two patients: stride length error mean 1.7 cm, SD 1.7 cm;
clearance error mean 0.3 cm, SD 0.4 cm. Strides during which the belt changes its speed are left out (``steady`` = no in
the truth): what an inertial sensor measures then is not the way on the belt.
"""

from __future__ import annotations

import numpy as np

from benchmarks.lib.command_line import mean_sd, parser_of, publish, table_of, verdict
from benchmarks.lib.real_sets import trials
from benchmarks.lib.walkers import outcomes_of
from fes.calibration.recording import calibrate_track
from fes.recording import Recording
from fes.signals import FloatArray, StrideResult
from fes.simulation.truth import TruthStride

BARS_CM = {"length cm": (1.7, 1.7), "clearance cm": (0.3, 0.4)}
COLUMNS = ("length cm", "clearance cm", "toe cm", "heel cm", "IC ms", "FO ms")


def pairs_of(recording: Recording, foot: str, truth: list[TruthStride]) -> list[tuple[StrideResult, TruthStride]]:
    """Each true stride with the estimated one that holds its foot off, where that is valid."""
    track = recording.tracks[foot]
    outcomes = outcomes_of(track, calibrate_track(track), recording.geometry.get(foot))
    found = [each for each in outcomes if isinstance(each, StrideResult)]
    held = ((next((s for s in found if s.t_start_ns < 1e9 * t.t_swing_s < s.t_end_ns), None), t) for t in truth)
    return [(own, true) for own, true in held if own is not None and own.valid]


def errors_of(pairs: list[tuple[StrideResult, TruthStride]]) -> FloatArray:
    """Estimate − truth (K, 6), in the order and units of COLUMNS; NaN where there is none."""

    def ms(t_ns: int | None, t_s: float) -> float:
        return float("nan") if t_ns is None else 1e3 * (1e-9 * t_ns - t_s)

    return np.array([
        (*(100.0 * (getattr(s, name) - getattr(t, name)) for name in (
            "stride_length_m", "clearance_m", "toe_clearance_m", "heel_clearance_m"
        )), ms(s.t_loading_response_ns, t.t_loading_response_s), ms(s.t_swing_ns, t.t_swing_s)) for s, t in pairs
    ]).reshape(-1, len(COLUMNS))  # fmt: skip


def in_order(stride: StrideResult) -> bool:
    times = (stride.t_pre_swing_ns, stride.t_swing_ns, stride.t_loading_response_ns, stride.t_stance_ns)
    return None not in times


def main(arguments: list[str] | None = None) -> int:
    options = parser_of(__doc__).parse_args(arguments)
    rows, held = [], True
    for _, recording, truth in trials():
        for foot in recording.tracks:
            true = [s for s in truth.strides_of(foot) if s.steady and s.walking]
            pairs = pairs_of(recording, foot, true)
            errors = errors_of(pairs)
            for column, (bias, sd) in BARS_CM.items():
                own = errors[:, COLUMNS.index(column)]
                held &= bool(abs(own.mean()) <= bias and own.std(ddof=1) <= sd)
            held &= len(pairs) == len(true)
            cells = [mean_sd(e, 0 if c.endswith("ms") else 2) for c, e in zip(COLUMNS, errors.T, strict=True)]
            counts = len(true), len(pairs), sum(in_order(s) for s, _ in pairs)
            rows.append([recording.name, foot, *map(str, counts), *cells])
    table = table_of("", ("trial", "foot", "strides", "found", "4 phases", *COLUMNS), rows)
    publish([table], options, ["Errors are estimate − truth, mean ± SD."])
    return verdict(held)


if __name__ == "__main__":
    raise SystemExit(main())
