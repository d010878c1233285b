"""Figures of an analysis: what they show is what the tables hold."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import fes
from fes.notebook.results import Result


@pytest.fixture(scope="module")
def result() -> Result:
    pytest.importorskip("matplotlib", reason="figures take matplotlib").use("Agg")
    return fes.analyse(fes.bundled_file("both_feet_100hz.parquet"))


def test_strides_are_drawn_by_foot(result: Result) -> None:
    axes = result.plot.strides("stride_length_m")
    own = result.strides["valid"] & (result.strides["foot"] == "left_foot")
    assert [line.get_label() for line in axes.lines] == ["left", "right"]
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), result.strides["stride_length_m"][own])
    assert axes.get_ylabel() == "stride length, m"
    with pytest.raises(KeyError, match="no column"):
        result.plot.strides("length")


def test_phases_are_bars_of_both_feet_within_the_time_asked_for(result: Result) -> None:
    axes = result.plot.phases(begin_s=20.0, seconds=5.0)
    assert axes.get_xlim() == (20.0, 25.0)
    changes = int(np.sum((result.phases["t_s"] > 20.0) & (result.phases["t_s"] < 25.0)))
    assert len(axes.collections) == changes + 2  # of each foot one had begun before


def test_paths_and_wings(result: Result) -> None:
    assert len(result.plot.path().lines) == 2
    wings = result.plot.butterfly()
    assert len(wings.lines) == int(result.strides["valid"].sum()) + 1  # and the line in the middle


def test_given_axes_are_drawn_on(result: Result) -> None:
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    assert result.plot.path(axes=axes) is axes
    assert axes.lines


def test_without_matplotlib_the_remedy_is_named(result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=r"pip install fes-gait\[plot\]"):
        result.plot.path()
