"""docs/notebooks run as they stand, cell after cell; their links hold; the page of notebooks names them all."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

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
