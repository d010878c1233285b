"""A session log as C3D: read back with the library, its signals, current and events are those of the log."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from fes.cli.main import main
from fes.evaluation.reference.read import read_references
from fes.session_log import SessionWriter
from fes.signals import ImuSample, StimCommand, StrideResult, WireFrame
from statemachine.phases import Phase, PhaseChange, Transition

ezc3d = pytest.importorskip("ezc3d", reason="writing C3D is an extra")
S = 10**9
FEET = ("left_foot", "right_foot")
CYCLE = (
    (0.20, Transition.T1, Phase.STANCE, Phase.PRE_SWING),
    (0.35, Transition.T2, Phase.PRE_SWING, Phase.SWING),
    (0.80, Transition.T3, Phase.SWING, Phase.LOADING_RESPONSE),
    (0.95, Transition.T4, Phase.LOADING_RESPONSE, Phase.STANCE),
)


def signal(t_s: float, axis: int) -> float:
    return (axis + 1) * math.sin(2.0 * math.pi * 1.5 * t_s)


def written(path: Path, seconds: float = 70.0, drift: float = 50e-6) -> Path:
    """Two feet at 100 Hz whose samples arrive late by up to 8 ms; the left one's clock drifts; 0.5 s missing."""
    writer = SessionWriter(path, {"format": 1, "session": {"name": "made"}})
    late = np.random.default_rng(1).uniform(0.0, 0.008, round(100 * seconds))
    for k, delay_s in enumerate(late.tolist()):
        t_s = 0.01 * k
        arrived = 5 * S + round(1e9 * (t_s + delay_s))
        for foot in FEET:
            if foot == "right_foot" and 10.0 <= t_s < 10.5:
                continue
            stamp = round(1e9 * t_s * (1.0 + (drift if foot == "left_foot" else 0.0)))
            acc = tuple(signal(t_s, axis) for axis in range(3))
            writer.event(ImuSample(arrived, foot, stamp, acc, (0.5, 0.25, math.nan if k == 50 else -t_s)))
        if 20.0 <= t_s < 21.0 and k % 2 == 0:
            writer.command(StimCommand(arrived, 0, True, 20.0, 200.0, 40.0, 60), WireFrame(arrived, 1, b""))
        writer.flush_due(arrived)
    for second in range(round(seconds) - 1):
        for share, transition, source, destination in CYCLE:
            writer.phase(
                PhaseChange(5 * S + round(1e9 * (second + share)), FEET[second % 2], transition, source, destination)
            )
    way = np.column_stack([np.linspace(0.0, 1.2, 50), np.zeros(50), 0.05 * np.sin(np.linspace(0.0, math.pi, 50))])
    ends = (6 * S, 7 * S, 1.2, 0.05, 0.0, 0.0, 1.0, None, None, None, None)
    writer.stride(StrideResult("left_foot", 1, *ends, trajectory_m=way, pitch_rad=way[:, 2]))
    writer.close({})
    return path


def converted(log: Path, *options: str) -> Any:
    result = CliRunner().invoke(main, ["convert", str(log), "--to", "c3d", *options])
    assert result.exit_code == 0, result.output
    return ezc3d.c3d(str(log.with_suffix(".c3d")))


def test_signals_current_phases_and_ways_are_the_logs(tmp_path: Path) -> None:
    file = converted(written(tmp_path / "walk.feslog"))
    group = file["parameters"]["ANALOG"]
    labels, units = group["LABELS"]["value"], group["UNITS"]["value"]
    rate_hz = group["RATE"]["value"][0]
    assert rate_hz == 100.0
    rows = dict(zip(labels, file["data"]["analogs"][0], strict=True))
    assert units[labels.index("left_foot.AccX")] == "m/s^2"
    assert units[labels.index("right_foot.GyrZ")] == "rad/s"
    t_s = np.arange(len(rows["left_foot.AccX"])) / rate_hz
    for foot in FEET:
        present = rows[f"{foot}.Present"] > 0.5
        assert np.mean(~present) == pytest.approx(0.0 if foot == "left_foot" else 0.5 / 70.0, abs=0.001)
        for axis, letter in enumerate("XYZ"):
            truth = (axis + 1) * np.sin(2.0 * np.pi * 1.5 * t_s)
            # the common times may lie a few milliseconds beside the true ones: nobody knows the mean delay
            assert np.max(np.abs(rows[f"{foot}.Acc{letter}"] - truth)[present]) < (axis + 1) * 9.5 * 0.006
    assert np.all(np.isfinite(np.asarray(list(rows.values()))))
    current = rows["stimulation.0"]
    assert set(np.unique(current)) == {0.0, 20.0}
    on_s = t_s[current > 0.0]
    assert on_s[0] == pytest.approx(20.0, abs=0.02)
    assert on_s[-1] == pytest.approx(21.05, abs=0.03)
    assert set(np.unique(rows["left_foot.Phase"])) == {0.0, 1.0, 2.0, 3.0}
    points = file["data"]["points"]
    assert file["parameters"]["POINT"]["LABELS"]["value"] == ["left_foot.sensor"]
    seen = np.isfinite(points[0, 0])
    assert np.mean(seen) == pytest.approx(1.0 / 70.0, abs=0.001)
    assert np.nanmax(points[0, 0]) == pytest.approx(1200.0, rel=0.02)
    assert np.nanmax(points[2, 0]) == pytest.approx(50.0, rel=0.01)


def test_events_come_back_as_a_reference_in_minutes_and_seconds(tmp_path: Path) -> None:
    log = written(tmp_path / "walk.feslog")
    converted(log)
    events = read_references([log.with_suffix(".c3d")]).events
    assert len(events) == 2 * 69
    assert [(one.foot, one.what) for one in events[:4]] == [
        ("left_foot", "FO"), ("left_foot", "IC"), ("right_foot", "FO"), ("right_foot", "IC"),
    ]  # fmt: skip
    spacing = np.diff([one.t_s for one in events if one.what == "IC"])
    np.testing.assert_allclose(spacing, 1.0, atol=1e-4)
    assert events[-1].t_s == pytest.approx(68.8, abs=0.02)


def test_a_long_session_stays_within_what_the_format_counts(tmp_path: Path) -> None:
    path = tmp_path / "long.feslog"
    writer = SessionWriter(path, {"format": 1, "session": {"name": "made"}})
    for k in range(70_000):
        writer.event(ImuSample(k * 10**7, "left_foot", k * 10**7, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)))
        writer.flush_due(k * 10**7)
    writer.close({})
    file = converted(path)
    assert file["parameters"]["POINT"]["RATE"]["value"][0] == 50.0
    assert file["data"]["analogs"].shape[2] == 70_000


def test_nothing_is_overwritten_and_an_empty_session_is_said(tmp_path: Path) -> None:
    log = written(tmp_path / "walk.feslog", 3.0)
    target = log.with_suffix(".c3d")
    target.write_bytes(b"mine")
    result = CliRunner().invoke(main, ["convert", str(log), "--to", "c3d"])
    assert result.exit_code == 2
    assert "not overwritten" in result.output
    assert target.read_bytes() == b"mine"
    empty = tmp_path / "empty.feslog"
    SessionWriter(empty, {"format": 1, "session": {"name": "made"}}).close({})
    result = CliRunner().invoke(main, ["convert", str(empty), "--to", "c3d"])
    assert result.exit_code == 2
    assert "no sensor's samples" in result.output
    result = CliRunner().invoke(main, ["convert", str(log), "--to", "c3d", "--out", str(tmp_path / "no" / "a.c3d")])
    assert result.exit_code == 2
    assert "cannot be written" in result.output
