"""docs/notebooks run as they stand, cell after cell; their links hold; the page of notebooks names them all."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fes
from fes.notebook.results import Result

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.py"))
DATA = Path(os.environ.get("FES_DATA") or ROOT.parent / "shared" / "data")
LONG = {"compare_detectors", "paper_tables"}  # more than about ten seconds
CELL = re.compile(r"^# %%(?: (.*))?$", re.MULTILINE)


def needs(notebook: Path) -> list[str]:
    """Folders of recordings that are no part of the project, by the notebook's first line."""
    found = re.match(r"# needs: (.+)\n", notebook.read_text(encoding="utf-8"))
    return found[1].split(", ") if found else []


def cases() -> list[object]:
    marks = {
        path: [pytest.mark.data] * bool(needs(path)) + [pytest.mark.slow] * (path.stem in LONG) for path in NOTEBOOKS
    }
    return [pytest.param(path, marks=marks[path], id=path.stem) for path in NOTEBOOKS]


@pytest.mark.parametrize("notebook", cases())
def test_it_runs(notebook):
    pytest.importorskip("matplotlib", reason="figures take matplotlib")
    if missing := [name for name in needs(notebook) if not (DATA / name).is_dir()]:
        pytest.skip(f"no {', '.join(missing)} in {DATA}; set FES_DATA to the folder that holds it")
    done = subprocess.run(
        [sys.executable, "-W", "error::RuntimeWarning", notebook.name], cwd=notebook.parent, timeout=600, text=True,
        capture_output=True, env={**os.environ, "MPLBACKEND": "Agg", "FES_DATA": str(DATA), "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.strip()


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_its_cells_are_code_or_text_with_links_that_lead_somewhere(notebook):
    text = notebook.read_text(encoding="utf-8")
    head, *cells = CELL.split(text)
    assert all(line.startswith("# needs: ") for line in head.splitlines())
    assert set(cells[::2]) <= {None, "[markdown]"}
    for kind, body in zip(cells[::2], cells[1::2], strict=True):
        assert body.strip()
        assert kind is None or all(not line or line.startswith("#") for line in body.splitlines())
    assert cells[1].startswith("\n# # ")  # a title
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        assert "://" in target or (notebook.parent / target.split("#")[0]).is_file(), target


def test_the_page_of_notebooks_names_each_with_what_it_needs():
    page = (ROOT / "docs" / "notebooks.md").read_text(encoding="utf-8")
    for notebook in NOTEBOOKS:
        row = next((line for line in page.splitlines() if f"(notebooks/{notebook.name})" in line), "")
        assert row, notebook.name
        assert all(f"`{name}`" in row for name in needs(notebook))


# --- What a notebook prints of an object by itself: what it is and how much it holds, in a line ---


@pytest.fixture(scope="module")
def objects() -> dict[str, object]:
    recording = fes.read(fes.bundled_file("example_csv.csv"))
    result = fes.analyse(recording)
    return {
        "Track": next(iter(recording.tracks.values())),
        "Recording": recording,
        "SensorCalibrations": fes.calibrate(recording),
        "Result": result,
        "GaitParameters": result.parameters,
        "Simulated": (simulated := fes.simulate(seconds=8.0)),
        "Truth": simulated.truth,
        "Analysis": (analysis := result.analysis()),
        "WalkRecord": analysis.walk_record(),
        "GaitEvents": next(iter(analysis.events.values())),
        "GroundPath": next(iter(analysis.paths.values())),
        "SessionRecord": fes.replay(recording).record,
    }


KINDS = (
    "Track", "Recording", "SensorCalibrations", "Result", "GaitParameters", "Simulated", "Truth", "Analysis",
    "WalkRecord", "GaitEvents", "GroundPath", "SessionRecord",
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_an_object_tells_what_it_is_in_a_line(objects: dict[str, object], kind: str) -> None:
    text = repr(objects[kind])
    assert text.startswith(kind)
    assert "\n" not in text
    assert len(text) < 250


def test_a_recording_tells_its_sensors(objects: dict[str, object]) -> None:
    assert "_foot" in repr(objects["Recording"])
    assert " Hz" in repr(objects["Track"])
    assert "strides" in repr(objects["GaitParameters"])


# --- Figures of an analysis: what they show is what the tables hold ---


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
