"""The tables and verdicts of ``benchmarks/tuning.py``, from its results."""

from __future__ import annotations

import json
from pathlib import Path
from statistics import median
from typing import Any

from scipy.stats import fisher_exact

BEGIN, END = "<!-- tuning results: benchmarks/tuning.py -->", "<!-- end of tuning results -->"
NAMES = {
    "none": "none", "foot switch": "fixed, foot switch", "phase": "fixed, phase-triggered",
    "run-to-run": "run-to-run", "learning": "learning",
}  # fmt: skip
TUNED = ("run-to-run", "learning")
KEEPS = 0.9
LAST = 20  # strides that tell how a patient ends
STRIDE = 1.02 / LAST
SURE = 0.05  # what chance explains less often than this, it does not explain


def write_tables(files: list[Path], page: Path | None) -> None:
    """Print the tables of each file; put them between the markers of ``page``."""
    parts = []
    for path in files:
        rows = sorted((json.loads(line) for line in path.open(encoding="utf-8")), key=lambda row: row["seed"])
        parts.append(table(rows) + "\n\n" + verdicts(rows))
    text = "\n\n".join(parts)
    print(text)
    if page is not None:
        whole = page.read_text(encoding="utf-8")
        before, rest = whole.split(BEGIN)
        page.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}", encoding="utf-8")


def table(rows: list[dict[str, Any]]) -> str:
    """One row a method."""
    able = [row for row in rows if row["reach"]]
    seeds = [row["seed"] for row in rows]
    slow, fast = min(row["speed_mps"] for row in rows), max(row["speed_mps"] for row in rows)
    lines = [
        f"**Seeds {min(seeds)}–{max(seeds)}**: {len(rows)} patients with a drop foot ({slow:.1f}–{fast:.1f} m/s; "
        f"{sum(row['passed_over'] for row in rows)} drawn people without one passed over), {len(able)} of whom can "
        f"reach the band. Set in the clinic: {median(row['clinic_ma'] for row in rows):g} mA "
        f"({min(row['clinic_ma'] for row in rows):g}–{max(row['clinic_ma'] for row in rows):g}).",
        "",
        "| method | strides in the band | heel first | stumbles | drags | µC a step, median | in the band within 10 "
        "strides | later strides in the band | keep ≥ 95 % of them |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for method, name in NAMES.items():
        every = [row["results"][method] for row in rows]
        mine = [row["results"][method] for row in able]
        lines.append(
            f"| {name} | {_mean(every, 'in_band'):.1%} | {_mean(every, 'heel_first'):.1%} | "
            f"{sum(r['stumbles'] for r in every)} | {sum(r['drags'] for r in every)} | "
            f"{median(r['charge_uc'] for r in every):.0f} | {_soon(mine)} of {len(mine)} | "
            f"{_mean(mine, 'later'):.1%} | {sum(r['later'] >= 0.95 for r in mine)} of {len(mine)} |"
        )
    return "\n".join(lines)


def verdicts(rows: list[dict[str, Any]]) -> str:
    """The bars, each with what both tuned methods reached."""
    able = [row for row in rows if row["reach"]]
    lines = ["| bar | " + " | ".join(NAMES[method] for method in TUNED) + " |", "|---|---|---|"]
    bars: dict[str, list[str]] = {}
    for method in TUNED:
        every = [row["results"][method] for row in rows]
        mine = [row["results"][method] for row in able]
        phase = [row["results"]["phase"] for row in rows]
        stumbles, fixed = sum(r["stumbles"] for r in every), sum(r["stumbles"] for r in phase)
        given = [(a["stumbles"], b["stumbles"]) for a, b in zip(every, phase, strict=True) if a["charge_uc"] > 0.0]
        alone = (
            f"; without the {len(rows) - len(given)} never stimulated {_sums(given)}" if len(given) < len(rows) else ""
        )
        charge, usual = (median(r["charge_uc"] for r in part) for part in (every, phase))
        both = [(a, b) for a, b in zip(every, phase, strict=True) if b["charge_uc"] > 0.0]
        less = median(a["charge_uc"] / b["charge_uc"] for a, b in both)
        kept = [a["charge_uc"] / b["charge_uc"] for a, b in both if b["in_band"] >= KEEPS]
        worse = [row["seed"] for row in rows if _worse(row, method)]
        certain = [row["seed"] for row in rows if _worse(row, method) and _chance(row, method) < SURE]
        stopped = [row["seed"] for row in rows if row["results"][method]["stopped"]]
        soon, later = _soon(mine) / len(mine), _mean(mine, "later")
        for bar, value, met in (
            ("in the band within 10 strides on ≥ 95 % of those who can reach it", f"{soon:.1%}", soon >= 0.95),
            ("keeps ≥ 95 % of later strides in it", f"{later:.1%}", later >= 0.95),
            (
                "stumbles less than half as often as fixed phase-triggered",
                f"{stumbles} against {fixed}{alone}", 2 * stumbles < fixed,
            ),
            (
                "less charge on the median than fixed phase-triggered",
                f"{charge:.0f} against {usual:.0f} µC; by patient {less:.0%}, {_part(kept)}", charge < usual,
            ),
            (
                "no patient ends worse than with fixed timing",
                f"{len(certain)} by more than chance; {_seeds(worse)} by two strides or more", not certain,
            ),
            ("none over a limit or stopped", _seeds(stopped), not stopped),
        ):  # fmt: skip
            bars.setdefault(bar, []).append(f"{value}: {'met' if met else '**missed**'}")
    other_day = sum(row["another_day"] < row["results"]["foot switch"]["at_the_end"] - STRIDE for row in rows)
    again = f"The fixed setting, walked by the same {len(rows)} once more"
    note = f"\n{again}, ends two strides or more below itself in {other_day}."
    return "\n".join(lines + [f"| {bar} | " + " | ".join(values) + " |" for bar, values in bars.items()] + [note])


def _sums(pairs: list[tuple[int, int]]) -> str:
    return f"{sum(a for a, _ in pairs)} against {sum(b for _, b in pairs)}"


def _part(ratios: list[float]) -> str:
    """Of those whose fixed setting does keep the toe clear."""
    shown = f"{median(ratios):.0%}" if ratios else "—"
    return f"of the {len(ratios)} whom the fixed setting keeps in the band {shown}"


def _worse(row: dict[str, Any], method: str) -> bool:
    """Whether more than one of the last 20 strides fewer lie in the band than with the foot switch's timing."""
    results = row["results"]
    return bool(results[method]["at_the_end"] < results["foot switch"]["at_the_end"] - STRIDE)


def _chance(row: dict[str, Any], method: str) -> float:
    """How likely the last strides differ by so much where both methods keep the same share (Fisher, one-sided)."""
    counts = [(round(row["results"][name]["at_the_end"] * LAST), LAST) for name in (method, "foot switch")]
    table = [[inside, of - inside] for inside, of in counts]
    return float(fisher_exact(table, alternative="less").pvalue)


def _soon(results: list[dict[str, Any]]) -> int:
    return sum(r["converged"] is not None and r["converged"] <= 10 for r in results)


def _mean(results: list[dict[str, Any]], key: str) -> float:
    return float(sum(r[key] for r in results)) / max(len(results), 1)


def _seeds(seeds: list[int]) -> str:
    return f"{len(seeds)}" + (f" (seed {', '.join(map(str, seeds))})" if seeds else "")
