"""A click in the report says what ``fes explain`` says of that instant, from the page alone, in a real browser."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from page_browser import CHROMIUM, Page, chromium
from replays import SETTINGS, bursts, cut, replay, trial

from fes.cli import main
from fes.recording import write_recording
from fes.report.explanation import cell
from fes.report.page import FINEST_NS, MOST_ROWS, guard_traces, write_report
from fes.session_log import SessionRecord
from fes.signals import NS_PER_S
from statemachine.phases import Transition
from statemachine.table import TABLE

LENGTH_S = 26.0
ROWS = (
    "[...document.querySelectorAll('#moment tbody tr')]"
    ".map(row => [row.className, ...[...row.cells].map(one => one.textContent)])"
)
SENTENCES = "[...document.querySelectorAll('#moment li')].map(line => line.textContent)"


@dataclass
class Walked:
    log: Path
    record: SessionRecord
    page: Page

    @property
    def origin_ns(self) -> int:
        return min(int(samples.t_ns[0]) for samples in self.record.samples.values())

    def click(self, at_s: float) -> tuple[float, list[str], list[list[str]]]:
        """Bring the window about an instant and click into its middle: when that was, sentences, rows."""
        self.page.go("about:blank")
        self.page.go(f"{self.log.with_name('page.html').as_uri()}#at={at_s:.4f}")
        self.page.until("document.documentElement.dataset.drawn == document.querySelectorAll('.chart').length")
        for _ in range(6):  # to 0.2 s, so that a pixel is no sample
            self.page.run("document.querySelector('[data-act=in]').click()")
        over = "#charts .chart:not(.overview) .u-over"
        self.page.scroll_to(over)
        self.page.press(over)
        told = self.page.until(
            "!document.getElementById('moment').hidden && document.querySelector('#moment h3').textContent"
        )
        clicked_s = float(str(told).removeprefix("At ").removesuffix(" s"))
        assert clicked_s == pytest.approx(at_s, abs=0.001)
        return clicked_s, self.page.run(SENTENCES), self.page.run(ROWS)

    def explained(self, at_s: float) -> dict[str, Any]:
        done = CliRunner().invoke(main, ["explain", str(self.log), "--at", f"{at_s:.4f}", "--json", "--no-page"])
        assert done.exit_code == 0, done.output
        found: dict[str, Any] = json.loads(done.stdout)
        return found


@pytest.fixture(scope="module")
def record_and_log(tmp_path_factory: pytest.TempPathFactory) -> tuple[SessionRecord, Path]:
    folder = tmp_path_factory.mktemp("walked")
    write_recording(cut(trial("negard_patient2"), 0.0, LENGTH_S), folder / "walk.parquet")
    record = replay(folder / "walk.parquet", folder / "out", SETTINGS)
    (log,) = (folder / "out").glob("walk-*/session.feslog")
    return record, log


@pytest.fixture(scope="module")
def walked(record_and_log: tuple[SessionRecord, Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Walked]:
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    record, log = record_and_log
    write_report(record, log.with_name("page.html"))
    with chromium(tmp_path_factory.mktemp("profile")) as page:
        page.size(1280, 900)
        yield Walked(log, record, page)
        assert page.console == []
        assert page.run("performance.getEntriesByType('resource').length") == 0


@pytest.mark.parametrize("transition", [Transition.T1, Transition.T2, Transition.T3, Transition.T4])
@pytest.mark.parametrize("before_s", [0.0, 0.05])
def test_the_click_says_what_explain_says_at_that_sample(
    walked: Walked, transition: Transition, before_s: float
) -> None:
    change = [each for each in walked.record.phases if each.transition is transition][5]
    wanted_s = (change.t_ns - walked.origin_ns) / NS_PER_S - before_s
    _, sentences, rows = walked.click(wanted_s + 0.001)
    sample_s = next(float(found[1]) for line in sentences if (found := re.search(r"sample of ([\d.]+) s", line)))
    found = walked.explained(sample_s + 0.0004)
    for line in found["sentences"]:
        if re.match(r"The right foot|T\d", line):
            assert line in sentences, "word for word"
    assert not found["differs"]
    assert [row[1:] for row in rows] == [
        [
            row["foot"].replace("_", " "), row["guard"], "✓" if row["holds"] else "·", row["what"], cell(row["seen"]),
            row["sign"], cell(row["limit"]), row["unit"], row["of"],
        ]
        for row in found["guards"]
    ]  # fmt: skip
    assert [row[0] for row in rows] == ["" if row["asked"] else "unused" for row in found["guards"]]
    if not before_s:
        assert f"{transition.name} fired at this sample." in sentences


def test_the_click_says_why_there_was_no_stimulation(walked: Walked) -> None:
    own = bursts(walked.record.commands)
    first = next(each for each in walked.record.phases if each.transition is Transition.T2)
    assert first.t_ns < own[0].t_on_ns, "the first stride is walked without stimulation"
    begin_s = (first.t_ns - walked.origin_ns) / NS_PER_S + 0.05
    between_s = (own[3].t_off_ns - walked.origin_ns) / NS_PER_S + 0.3
    within_s = (own[3].t_on_ns - walked.origin_ns) / NS_PER_S + 0.3
    for at_s in (begin_s, between_s):
        clicked_s, sentences, _ = walked.click(at_s)
        (channel,) = walked.explained(clicked_s)["channels"]
        assert sentences[0] == channel["why"], "word for word"
        assert "The gate was armed." in sentences
    assert "on, " in walked.click(within_s)[1][0]


def test_what_the_report_keeps_is_bounded_and_has_every_phase_change(
    record_and_log: tuple[SessionRecord, Path],
) -> None:
    record, _ = record_and_log
    (trace,) = guard_traces(record)
    assert trace.same
    kept = set(trace.t_ns[trace.fired > 0].tolist())
    assert kept == {change.t_ns for change in record.phases}, "sensor and computer keep one clock in a recording"
    seconds = (trace.t_ns[-1] - trace.t_ns[0]) / NS_PER_S
    assert len(trace.t_ns) <= min(MOST_ROWS, seconds * NS_PER_S / FINEST_NS + 1) + len(record.phases)
    assert np.all(np.diff(trace.t_ns) > 0)
    assert {row.transition for row in TABLE} == set(Transition) - {Transition.NONE}


def test_a_record_that_is_no_session_has_no_guards(record_and_log: tuple[SessionRecord, Path]) -> None:
    record, _ = record_and_log
    for header in ({}, {**record.header, "calibration": {"right_foot": {}}}, {**record.header, "session": {}}):
        assert guard_traces(SessionRecord(header, samples=record.samples, phases=record.phases)) == []
