"""Walking speed from shank sensors on the stroke-treadmill recordings; exit code 1 if the bar fails, 3 without data.

    python benchmarks/accuracy/ankle.py [--data FOLDER] [--json FILE]

One default setting for all runs and both sides. Per run and side: speed (sum of stride lengths over sum of stride
times, last 120 s) over the belt's, for a velocity reset to zero (ZUPT), for one fixed arm of 0.35 m and for the arm
learnt from the first minute, with that arm's parts, what the data alone say of its length, and the condition number of
Eq. (8) of Wu et al. The bar: mean 0.98–1.02 and no side off by more than 8 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from benchmarks.accuracy.stroke_treadmill import LAST_S, data_folder, runs_of
from benchmarks.lib.command_line import console_of, parser_of, publish, verdict
from fes.estimation.foot.calibration import stretch_for_calibration
from fes.estimation.shank.calibration import ShankCalibration, calibrate_shank
from fes.estimation.shank.motion import stride_spans, swing_peaks
from fes.estimation.shank.strides import ShankIntegrationSettings, solve_shank_stride
from fes.signals import FloatArray, IntArray, StrideResult

FIXED_ARM_M = 0.35
MEAN_BAR = (0.98, 1.02)
WORST_BAR = 0.08


@dataclass(frozen=True)
class ShankResult:
    """One side of one run; ratios are speed over belt, NaN where self-paced; the arm is (forward, left, up) in m."""

    run: str
    sensor: str
    belt_mps: float
    zupt: float
    fixed: float
    learnt: float
    arm_m: tuple[float, float, float]
    length_data_m: float
    length_data_sd_m: float
    condition: float
    reason: str
    strides: int
    invalid: int


def load_shanks(path: Path) -> tuple[dict[str, tuple[FloatArray, FloatArray]], float, float]:
    """Specific force and rates (N, 3) of both shanks, the rate in Hz, and the belt's speed (m/s, NaN if self-paced)."""
    data = np.load(path)
    shanks = {}
    for side in ("left", "right"):
        acc, gyr = (np.ascontiguousarray(data[f"{kind}_{side}shank"], dtype=float) for kind in ("acc", "gyr"))
        shanks[f"{side}_shank"] = acc, gyr
    return shanks, float(data["fs"]), float(data["belt_speed"])


def stamps(samples: int, rate_hz: float) -> IntArray:
    """Time stamps (N,) in ns of an even rate."""
    return np.asarray(np.round(np.arange(samples) * 1e9 / rate_hz), dtype=np.int64)


def calibrate(sensor: str, rate_hz: float, acc: FloatArray, gyr: FloatArray) -> ShankCalibration:
    """From the first minute."""
    t_ns = stamps(len(acc), rate_hz)
    rows = stretch_for_calibration(t_ns, gyr)
    return calibrate_shank(sensor, rate_hz, t_ns[rows], acc[rows], gyr[rows])


def shank_strides(
    t_ns: IntArray,
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    calibration: ShankCalibration,
    settings: ShankIntegrationSettings | None = None,
) -> list[StrideResult]:
    """All strides of a recording, off-line; unusable ones are there too, with the reason.

    Args:
        t_ns: (N,) strictly increasing.
        acc_mps2: (N, 3) specific force as measured.
        gyr_radps: (N, 3) angular rate as measured.
        calibration: of this sensor.
        settings: how to integrate, by default what the calibration says.
    """
    settings = settings or ShankIntegrationSettings.for_calibration(calibration)
    acc = acc_mps2 - np.array(calibration.acc_bias_mps2)
    gyr = gyr_radps - np.array(calibration.gyr_bias_radps)
    spans = stride_spans(gyr, swing_peaks(gyr @ settings.left, calibration.rate_hz), calibration.rate_hz)
    return [
        solve_shank_stride(calibration.sensor, number, span, t_ns, acc, gyr, settings)
        for number, span in enumerate(spans, start=1)
    ]


def speed(
    acc: FloatArray, gyr: FloatArray, calibration: ShankCalibration, arm: FloatArray | None
) -> tuple[float, int, int]:
    """Mean speed (m/s) in the last 120 s with one arm (None: ZUPT), all strides, and how many of them are invalid."""
    up, left = np.array(calibration.up), np.array(calibration.left)
    t_ns = stamps(len(acc), calibration.rate_hz)
    results = shank_strides(t_ns, acc, gyr, calibration, ShankIntegrationSettings(up, left, arm))
    late = [s for s in results if s.valid and s.t_start_ns >= t_ns[-1] - LAST_S * 1e9]
    time_s = 1e-9 * sum(s.t_end_ns - s.t_start_ns for s in late)
    length_m = sum(s.stride_length_m for s in late)
    return length_m / time_s, len(results), sum(not s.valid for s in results)


def evaluate(path: Path) -> list[ShankResult]:
    """Both sides of one run."""
    shanks, rate_hz, belt_mps = load_shanks(path)
    results = []
    for sensor, (acc, gyr) in shanks.items():
        calibration = calibrate(sensor, rate_hz, acc, gyr)
        arm, up = calibration.arm, np.array(calibration.up)
        axes = np.stack((calibration.forward(), np.array(calibration.left), up))
        x, y, z = (float(v) for v in axes @ np.array(arm.arm_m))
        learnt, strides, invalid = speed(acc, gyr, calibration, np.array(arm.arm_m))
        results.append(
            ShankResult(
                run=path.stem,
                sensor=sensor,
                belt_mps=belt_mps,
                zupt=speed(acc, gyr, calibration, None)[0] / belt_mps,
                fixed=speed(acc, gyr, calibration, FIXED_ARM_M * up)[0] / belt_mps,
                learnt=learnt / belt_mps,
                arm_m=(x, y, z),
                length_data_m=arm.length_data_m,
                length_data_sd_m=arm.length_data_sd_m,
                condition=arm.condition,
                reason=arm.reason,
                strides=strides,
                invalid=invalid,
            )
        )
    return results


def holds(results: list[ShankResult]) -> bool:
    """Whether the learnt arm meets the bar over all sides with a known belt speed."""
    ratios = np.array([r.learnt for r in results if not np.isnan(r.belt_mps)])
    return bool(MEAN_BAR[0] <= ratios.mean() <= MEAN_BAR[1] and np.abs(ratios - 1.0).max() <= WORST_BAR)


def main(arguments: list[str] | None = None) -> int:
    """Print the table; 0 when the bar holds, 1 when not, 3 without data."""
    options = parser_of(__doc__, data_folder()).parse_args(arguments)
    if not (paths := runs_of(options.data)):
        return 3
    results = [result for path in paths for result in evaluate(path)]
    fixed = f"fixed {FIXED_ARM_M:.2f}"
    parts = ("arm fwd/left/up cm", "data cm", "cond.", "valid", "arm is")
    table = Table("run", "side", "belt", "ZUPT", fixed, "learnt", *parts)
    for r in results:
        ratios = ["–" if np.isnan(v) else f"{v:.3f}" for v in (r.zupt, r.fixed, r.learnt)]
        table.add_row(
            r.run,
            r.sensor.removesuffix("_shank"),
            "–" if np.isnan(r.belt_mps) else f"{r.belt_mps:.1f}",
            *ratios,
            "/".join(f"{100 * v:+.1f}" for v in r.arm_m),
            f"{100 * r.length_data_m:.0f} ± {100 * r.length_data_sd_m:.0f}",
            f"{r.condition:.1f}",
            f"{r.strides - r.invalid}/{r.strides}",
            f"prior: {r.reason}" if r.reason else "learnt",
        )
    console = console_of(150)
    total = []
    for name in ("zupt", "fixed", "learnt"):
        ratios_known = np.array([getattr(r, name) for r in results if not np.isnan(r.belt_mps)])
        total.append(
            f"{name}: speed over belt, {len(ratios_known)} sides: mean {ratios_known.mean():.4f}, "
            f"SD {ratios_known.std(ddof=1):.4f}, from {ratios_known.min():.4f} to {ratios_known.max():.4f}"
        )
    console.print(table)
    publish(console, [], options, total)
    return verdict(console, holds(results))


if __name__ == "__main__":
    raise SystemExit(main())
