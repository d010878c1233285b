"""``import fes``: docs/api.md runs as it stands; what is wrong with an input is said; nothing is loaded too early."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fes

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "api.md"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page: Path) -> list[str]:
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def test_every_block_of_the_page_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in blocks(PAGE):
        exec(compile(block, "docs/api.md", "exec"), names)
    assert (tmp_path / "walk.html").stat().st_size > 100_000
    assert {"session.feslog", "session.html", "agreement.html", "walk.calibration.json"} <= {
        path.name for path in tmp_path.iterdir()
    }


def test_every_name_has_its_part_of_the_page():
    headings = " ".join(re.findall(r"^## (.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
    assert {name for name in fes.__all__ if f"`{name}`" not in headings} == set()
    assert len(fes.__all__) == 10


def test_names_are_listed_and_others_are_not_there():
    assert set(fes.__all__) <= set(dir(fes))
    assert callable(fes.recording)
    assert list(inspect.signature(fes.recording).parameters)[:3] == ["acc", "gyr", "rate_hz"]
    with pytest.raises(AttributeError, match="analyze"):
        fes.analyze  # noqa: B018


def test_the_import_alone_loads_nothing():
    code = "import fes, sys; print(*sorted({'numpy', 'numba', 'pydantic', 'fes.notebook'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert not done.stdout.strip()


def test_the_types_name_what_is_offered():
    stub = (ROOT / "fes" / "__init__.pyi").read_text(encoding="utf-8")
    assert {name for name in fes.__all__ if f"as {name}\n" not in stub} == set()


@pytest.fixture(scope="module")
def walk():
    return fes.read(fes.bundled_file("both_feet_100hz.parquet"))


def arrays(walk, foot="left_foot"):
    track = walk.tracks[foot]
    return track.acc_mps2, track.gyr_radps


def test_arrays_give_what_the_file_gives(walk):
    again = fes.recording(
        acc={name: track.acc_mps2 for name, track in walk.tracks.items()},
        gyr={name: track.gyr_radps for name, track in walk.tracks.items()},
        rate_hz=100.0,
    )
    both = [fes.analyse(each, geometry=walk.geometry).strides for each in (walk, again)]
    assert len(both[0]) == len(both[1]) > 80
    assert np.allclose(both[0]["stride_length_m"], both[1]["stride_length_m"], atol=1e-3, equal_nan=True)


def test_units_are_converted(walk):
    acc, gyr = arrays(walk)
    same = fes.recording(acc / 9.80665, np.degrees(gyr), 100.0, acc_unit="g", gyr_unit="deg/s")
    assert np.allclose(same.tracks["left_foot"].acc_mps2, acc)
    assert np.allclose(same.tracks["left_foot"].gyr_radps, gyr)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda acc, gyr: {"acc": acc.T, "gyr": gyr}, r"shape \(3, \d+\), must be \(N, 3\)"),
        (lambda acc, gyr: {"acc": acc, "gyr": gyr[:-1]}, r"acc has \d+ samples, gyr"),
        (
            lambda acc, gyr: {"acc": np.where(np.arange(len(acc))[:, None] == 7, np.nan, acc), "gyr": gyr},
            r"row 8: column 'left_foot acc x'",
        ),
        (lambda acc, gyr: {"acc": acc / 9.81, "gyr": gyr}, 'acc_unit = "g"'),
        (lambda acc, gyr: {"acc": acc, "gyr": np.degrees(gyr)}, 'gyr_unit = "deg/s"'),
        (lambda acc, gyr: {"acc": acc - np.median(acc, axis=0), "gyr": gyr}, "gravity"),
        (lambda acc, gyr: {"acc": acc, "gyr": gyr, "sensor": "hip"}, "no sensor is called 'hip'"),
        (lambda acc, gyr: {"acc": acc, "gyr": gyr, "rate_hz": 0.1}, "rate_hz"),
        (lambda acc, gyr: {"acc": acc[:50], "gyr": gyr[:50]}, "lasts 0.490 s"),
        (lambda acc, gyr: {"acc": acc, "gyr": gyr, "acc_unit": "feet"}, "acc_unit = 'feet'"),
        (lambda acc, gyr: {"acc": {"left_foot": acc}, "gyr": {"right_foot": gyr}}, "give both of each"),
        (lambda acc, gyr: {"acc": [["x"] * 3], "gyr": gyr}, "no array of numbers"),
    ],
)
def test_arrays_that_cannot_be_are_refused(walk, change, said):
    with pytest.raises(ValueError, match=said):
        fes.recording(**{"rate_hz": 100.0, **change(*arrays(walk))})


def test_missing_files_are_said():
    with pytest.raises(ValueError, match="is not there"):
        fes.read("nowhere.csv")
    with pytest.raises(ValueError, match=r"nowhere\.toml"):
        fes.load_session("nowhere.toml")
    with pytest.raises(ValueError, match=r"nowhere\.feslog"):
        fes.read_log("nowhere.feslog")
    with pytest.raises(FileNotFoundError, match="negard_patient2"):
        fes.bundled_file("nowhere.csv")


def test_a_channel_needs_the_sensor_that_it_follows(walk):
    standing = fes.recording(*(part[:200] for part in arrays(walk, "right_foot")), 100.0, "right_foot")
    with pytest.raises(ValueError, match="right_foot"):
        fes.replay(standing, fes.bundled_file("session.toml"))


def test_a_long_recording_is_one_result(walk, monkeypatch, tmp_path):
    """In parts, as a file of hours would be: the strides are the same."""
    from fes import notebook
    from fes.recording import chunks

    def short(path):
        return chunks.cut_into_chunks(chunks.follow_recording(path, 30.0), around_s=5.0)

    path = fes.bundled_file("both_feet_100hz.parquet")
    whole = fes.analyse(path)
    monkeypatch.setattr("fes.recording.read.FIRST_ROWS", 1000)
    monkeypatch.setattr(notebook, "recording_chunks", short)
    result = fes.analyse(path)
    assert len(list(result)) > 1
    assert len(result.strides) == len(whole.strides)
    assert len(result.parameters.table) > 0
    with pytest.raises(ValueError, match="for part in result"):
        result.analysis()
    assert [each.name for each in result.report(tmp_path / "walk.html")][:2] == ["walk-01.html", "walk-02.html"]


def test_a_session_log_replays_the_same(walk, tmp_path):
    logs = [fes.replay(walk, fes.bundled_file("session.toml"), log=tmp_path / f"{n}.feslog") for n in "ab"]
    assert [frame.data for frame in logs[0].record.frames] == [frame.data for frame in logs[1].record.frames]
    assert fes.evaluate(logs[0], fes.bundled_file("both_feet_100hz.strides.csv")).table["n"].min() > 10


def test_the_readme_runs(tmp_path, monkeypatch):
    """Its five lines of Python, on a bundled recording in place of the reader's own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        fes, "read", lambda path, read=fes.read: read(fes.bundled_file("both_feet_100hz.parquet")), raising=False
    )
    [block] = blocks(ROOT / "README.md")
    exec(compile(block, "README.md", "exec"), {})
    assert (tmp_path / "walk.html").is_file()
