"""Pages are what the kept figures and the program's constants say, and a figure that moves is noticed."""

from __future__ import annotations

import importlib
import sys
from dataclasses import replace
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def figures():
    return importlib.import_module("benchmarks.lib.figures")


@pytest.fixture
def kept(figures):
    table = figures.Figures(
        "Lengths", ["walk", "SL, m", "n"], [["H", "1.37 ± 0.06", "1,024"], ["A", "−0.83 ± 0.08", "9"]]
    )
    return figures.Result("python benchmarks/one.py", [table], {"a set": "0badcafe"})


def test_every_page_is_as_rendered_from_what_is_kept(figures):
    assert [page.name for page, _ in figures.stale()] == [], "make figures"


def test_every_result_is_on_a_page_and_can_be_made_again(figures):
    shown = figures.named()
    assert shown
    for name in shown:
        assert (figures.RESULTS / f"{name}.json").is_file()
    for name in shown - set(figures.ELSEWHERE):
        assert (ROOT / "benchmarks" / figures.arguments_of(name)[0]).is_file()
    assert {*figures.QUICK, *figures.ELSEWHERE} <= shown
    kept = {path.stem for path in figures.RESULTS.glob("*.json")}
    assert kept == shown, "results that no page shows"


def test_a_page_gets_its_tables_with_their_source_and_its_constants(figures, kept, tmp_path):
    kept.keep(tmp_path / "one.json")
    page = (
        "Before.\n\n<!-- figures: one -->\nold\n<!-- end of figures -->\n\nOver "
        "<!-- constant: fes.estimation.strides.boundaries:AROUND_S, .0f, × 1000 -->7<!-- / --> ms.\n"
    )
    text = figures.rendered(page, tmp_path)
    assert "| H | 1.37 ± 0.06 | 1,024 |" in text
    assert "`python benchmarks/one.py`, " in text
    assert "a set (0badcafe)" in text
    assert "-->30<!-- / --> ms." in text
    assert "old" not in text
    assert figures.rendered(text, tmp_path) == text, "once more changes nothing"


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("one; H, ; SL, m; one ([\\d.]+)", "1.37"),
        ("one; .*; SL, m; least ([\\d.−]+)", "−0.83"),
        ("one; .*; SL, m; most ± ([\\d.]+)", "0.08"),
        ("one; .*; n; sum ([\\d,]+)", "1,033"),
        ("one; note; ; one of (\\d+) feet", "12"),
    ],
)
def test_a_page_gets_single_figures_of_a_table(figures, kept, tmp_path, asked, said):
    replace(kept, notes=["3 of 12 feet"]).keep(tmp_path / "one.json")
    assert figures.rendered(f"It is <!-- figure: {asked} -->old<!-- / --> cm.", tmp_path).endswith(
        f"-->{said}<!-- / --> cm."
    )


@pytest.mark.parametrize("asked", ["one; X; n; one (\\d+)", "one; .*; n; one (\\d+)", "one; H; m; one (\\d+)"])
def test_what_a_table_does_not_say_is_no_figure(figures, kept, tmp_path, asked):
    kept.keep(tmp_path / "one.json")
    with pytest.raises(ValueError, match="figures"):
        figures.figure(asked, tmp_path)


@pytest.mark.parametrize(
    ("row", "far"),
    [
        (["H", "1.37 ± 0.06", "1,024"], False),
        (["H", "1.38 ± 0.05", "1,024"], False),
        (["H", "1.39 ± 0.06", "1,024"], True),
        (["H", "1.37 ± 0.08", "1,024"], True),
        (["H", "1.37 ± 0.06", "1,026"], True),
        (["H", "–", "1,024"], True),
        (["G", "1.37 ± 0.06", "1,024"], True),
    ],
)
def test_a_figure_may_move_by_one_in_its_last_digit(figures, kept, row, far):
    table = kept.tables[0]
    again = replace(kept, tables=[replace(table, rows=[row, table.rows[1]])])
    assert bool(figures.moved(kept, again)) is far


def test_a_sign_is_a_figure_too_and_so_is_a_row(figures, kept):
    table = kept.tables[0]
    other = [table.rows[0], ["A", "0.83 ± 0.08", "9"]]
    assert figures.moved(kept, replace(kept, tables=[replace(table, rows=other)]))
    assert figures.moved(kept, replace(kept, tables=[replace(table, rows=table.rows[:1])]))
    assert figures.moved(kept, replace(kept, tables=[]))


BENCHMARK = """
import sys
sys.path.insert(0, {root!r})
from benchmarks.lib.figures import Figures, Result
if {ends}:
    sys.exit({ends})
Result("one", [Figures("Lengths", ["walk", "SL, m"], [["H", {value!r}]])]).keep(__import__("pathlib").Path(sys.argv[2]))
"""


@pytest.mark.parametrize(
    ("value", "ends", "code", "said"),
    [
        ("1.37", 0, 0, "No figure has moved"),
        ("1.41", 0, 1, "one: Lengths: H, SL, m: 1.37 was kept, 1.41 is found"),
        ("1.37", 1, 1, "one: ended with 1"),
        ("1.37", 3, 0, "passed over"),
    ],
)
def test_the_check_fails_on_a_changed_figure(figures, tmp_path, capsys, value, ends, code, said):
    figures.Result("one", [figures.Figures("Lengths", ["walk", "SL, m"], [["H", "1.37"]])]).keep(tmp_path / "one.json")
    script = tmp_path / "one.py"
    script.write_text(BENCHMARK.format(root=str(ROOT), value=value, ends=ends), encoding="utf-8")
    assert figures.check({"one": (str(script),)}, tmp_path) == code
    assert said in capsys.readouterr().out


def test_what_a_benchmark_prints_is_what_it_keeps(figures, tmp_path, capsys, monkeypatch):
    from rich.table import Table

    from benchmarks.lib import command_line

    table = Table("walk", "T4 ms", title="late")
    table.add_row("H", "+9 [+3, +17]")
    path = tmp_path / "one.json"
    monkeypatch.setattr(sys, "argv", ["benchmarks/lib/one.py", "--feet", "3", "--json", str(path), "--jobs=2"])
    options = command_line.parser_of("One.").parse_args(["--json", str(path)])
    command_line.publish([table], options, ["[x] stays as it is."])
    assert "[x] stays as it is." in capsys.readouterr().out
    kept = figures.Result.read(path)
    assert (kept.command, kept.notes) == ("python benchmarks/lib/one.py --feet 3", ["[x] stays as it is."])
    (one,) = kept.tables
    assert (one.title, one.columns, one.rows) == ("late", ["walk", "T4 ms"], [["H", "+9 [+3, +17]"]])
