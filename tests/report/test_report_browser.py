"""The report in a real browser: no complaint, no request, plots drawn, definitions shown, a summary of one page."""

from __future__ import annotations

import base64
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import report_records as make
from page_browser import CHROMIUM, Page, chromium

from fes.report.comparison.page import compare_sessions, render_comparison
from fes.report.comparison.session import of_record
from fes.report.page import write_report
from fes.session_log import SessionRecord

A4_WIDTH_PX, A4_HEIGHT_PX = 703, 1009  # what the margins leave of the sheet, at 96 pixels per inch

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")


def opened(path: Path, profile: Path) -> tuple[str, str]:
    """The page after its script has run, and what the browser logged."""
    command = [
        str(CHROMIUM),
        *("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-dev-shm-usage"),
        *(f"--user-data-dir={profile}", "--window-size=1280,2000", "--virtual-time-budget=2000"),
        *("--enable-logging=stderr", "--dump-dom", path.as_uri()),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return done.stdout, "\n".join(line for line in done.stderr.splitlines() if "CONSOLE" in line)


def test_plots_are_drawn_and_the_console_is_silent(tmp_path):
    record = make.walk(6, rate_hz=500.0)
    record.samples["left_foot"].acc_mps2[200:260] = np.nan
    write_report(record, tmp_path / "report.html")
    page, console = opened(tmp_path / "report.html", tmp_path / "profile")
    assert console == ""
    assert 'data-drawn="6"' in page  # two feet with two signals each, the current, and the whole session
    assert page.count("<canvas") == 6
    selected = re.search(r'class="chart overview".*?u-select" style="[^"]*width: ([\d.]+)px', page, re.S)
    assert selected
    assert float(selected.group(1)) > 100


def test_a_session_without_anything_is_no_error_in_the_browser(tmp_path):
    write_report(SessionRecord({}), tmp_path / "report.html")
    page, console = opened(tmp_path / "report.html", tmp_path / "profile")
    assert console == ""
    assert 'data-drawn="0"' in page


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    write_report(make.walk(30, rate_hz=200.0), folder / "report.html")
    with chromium(folder / "profile") as browser:
        browser.size(1280, 900)
        browser.go((folder / "report.html").as_uri())
        assert browser.run(f"{FOLDS}.map(fold => fold.open)") == [False] * 3
        browser.run("location.hash = '#paths'")
        assert browser.until(f"{FOLDS}[0].open"), "a link to what is folded opens it"
        browser.run(f"{FOLDS}.forEach(fold => fold.open = true)")
        browser.scroll_to("body")
        yield browser


FOLDS = "[...document.querySelectorAll('details.role')]"
TIP = "document.getElementById('tip')"
TERM = "document.querySelector('#parameters tbody a.term')"


def test_nothing_is_asked_of_any_network_and_nothing_complained_of(page: Page):
    assert page.run("performance.getEntriesByType('resource').length") == 0
    assert page.console == []


def test_a_definition_shows_on_hover_focus_and_touch(page: Page):
    page.scroll_to("#parameters tbody a.term")
    assert page.run(f"{TIP}.hidden")
    x, y = page.middle("#parameters tbody a.term")
    page.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    shown = page.until(f"!{TIP}.hidden && {TIP}.textContent")
    assert shown.startswith(
        "stride length (SL): Horizontal distance of the foot between two of its mid-stances, scaled so"
    )
    assert "Wang et al. 2013" in shown
    page.call("Input.dispatchMouseEvent", type="mouseMoved", x=2, y=2)
    assert page.until(f"{TIP}.hidden")

    page.run(f"{TERM}.focus()")
    assert page.run(f"{TIP}.textContent") == shown
    assert page.run(f"{TERM}.getAttribute('aria-describedby')") == "tip"
    box = page.run(f"(r => [r.left, r.top, r.right, r.bottom])({TIP}.getBoundingClientRect())")
    assert 0 <= box[0] < box[2] <= 1280
    assert 0 <= box[1] < box[3] <= 900
    page.call("Input.dispatchKeyEvent", type="keyDown", key="Escape")
    assert page.run(f"{TIP}.hidden")
    page.run(f"{TERM}.blur()")

    page.size(820, 1180, touch=True)
    page.scroll_to("#parameters tbody a.term")
    place = page.run("location.hash")
    page.tap("#parameters tbody a.term")
    assert page.until(f"!{TIP}.hidden && {TIP}.textContent") == shown
    assert page.run("location.hash") == place  # it explains, and does not jump away
    assert page.run("document.documentElement.scrollWidth") <= 820
    page.size(1280, 900)


def test_the_space_figure_turns_by_keys_buttons_and_pointer(page: Page):
    first = "document.querySelector('svg.space path').getAttribute('d')"
    drawn = page.run(first)
    page.run("document.querySelector('svg.space').focus()")
    page.call("Input.dispatchKeyEvent", type="keyDown", key="ArrowLeft")
    turned = page.run(first)
    assert turned != drawn
    page.call("Input.dispatchKeyEvent", type="keyDown", key="Home")
    # drawn by the report and by the script alike, but for a tenth of a pixel
    numbers = [[float(v) for v in re.findall(r"[\d.]+", d)] for d in (drawn, page.run(first))]
    np.testing.assert_allclose(numbers[0], numbers[1], atol=0.2)
    page.run("document.querySelector('.turn button[aria-label=\"Look from above\"]').click()")
    assert page.run(first) != drawn
    page.scroll_to("svg.space")
    x, y = page.middle("svg.space")
    before = page.run(first)
    for kind, at in (("mousePressed", x), ("mouseMoved", x + 40), ("mouseReleased", x + 40)):
        page.call("Input.dispatchMouseEvent", type=kind, x=at, y=y, button="left", clickCount=1)
    assert page.run(first) != before


def test_a_click_in_the_timeline_says_what_was_at_that_instant(page: Page):
    over = "#charts .chart:not(.overview) .u-over"
    page.scroll_to(over)
    x, y = page.middle(over)
    for kind in ("mousePressed", "mouseReleased"):
        page.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
    told = page.until("!document.getElementById('moment').hidden && document.getElementById('moment').textContent")
    at = re.search(r"At ([\d.]+) s", told)
    assert at
    first, last = (
        float(each) for each in re.findall(r"[\d.]+", page.run("document.getElementById('window').textContent"))
    )
    assert float(at[1]) == pytest.approx((first + last) / 2, abs=0.1), "the middle of the window was clicked"
    assert f"--at {at[1]}" in told
    for words in ("left foot: ", " since ", "TA left: "):
        assert words in told
    page.scroll_to("body")


def test_the_printed_summary_is_the_first_page(page: Page, tmp_path):
    """Laid out for A4 it ends before the sheet does, and what follows begins on the next."""
    page.call("Emulation.setEmulatedMedia", media="print")
    page.size(A4_WIDTH_PX, A4_HEIGHT_PX)
    page.call("Emulation.setEmulatedMedia", media="print")
    bottom = page.run("document.getElementById('summary').getBoundingClientRect().bottom + scrollY")
    assert 300 < bottom < A4_HEIGHT_PX
    assert page.run(f"{FOLDS}.map(fold => getComputedStyle(fold).breakBefore)") == ["page"] * 3
    assert page.run("getComputedStyle(document.querySelector('nav')).display") == "none"
    page.call("Emulation.setEmulatedMedia", media="")
    page.size(1280, 900)

    def printed() -> tuple[bytes, int]:
        pdf = base64.b64decode(page.call("Page.printToPDF", preferCSSPageSize=True)["data"])
        return pdf, len(re.findall(rb"/Type /Page\b(?!s)", pdf))

    page.run(f"{FOLDS}.forEach(fold => fold.open = false)")
    assert printed()[1] == 1, "what is folded on the screen is not printed"
    page.run(f"{FOLDS}.forEach(fold => fold.open = true)")
    pdf, sheets = printed()
    assert 4 <= sheets <= 20
    if (reader := shutil.which("pdftotext")) is None:
        return
    (tmp_path / "report.pdf").write_bytes(pdf)
    told = subprocess.run(
        [reader, "-layout", str(tmp_path / "report.pdf"), "-"], capture_output=True, text=True, check=True
    ).stdout.split("\f")
    assert "No fault found in data and stimulation" in told[0]
    assert "What to do: Nothing" in told[0]
    assert told[0].count("±") >= 4
    assert "page 1 of" in told[0]
    assert "How the feet moved" not in told[0]
    assert "How the feet moved" in told[1]
    assert all("not a medical device" in sheet for sheet in told[:-1])


# --- The comparison of two sessions ---


COMPARED_TERM = "document.querySelector('.compare tbody .term')"
COMPARED_TIP = f"{COMPARED_TERM}.querySelector('.tip')"


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("comparison")
    sessions = [
        of_record(make.walk(30, seed=seed), label, folder / f"{label}.feslog")
        for label, seed in (("before", 1), ("after", 9))
    ]
    (folder / "page.html").write_text(render_comparison(compare_sessions(sessions)), encoding="utf-8")
    with chromium(folder / "profile") as browser:
        browser.size(1280, 900)
        browser.go((folder / "page.html").as_uri())
        yield browser


def test_a_comparison_asks_no_network_and_nothing_complained_of(compared: Page):
    assert compared.run("performance.getEntriesByType('resource').length") == 0
    assert compared.console == []


@pytest.mark.parametrize("width", [1280, 820])
def test_a_comparison_fits_and_its_figures_are_drawn(compared: Page, width: int):
    compared.size(width, 1100)
    assert compared.run("document.documentElement.scrollWidth") <= width
    boxes = compared.run(
        "[...document.querySelectorAll('svg path')].filter(p => p.getAttribute('d').length > 100)"
        ".map(p => p.getBoundingClientRect()).map(r => [r.width, r.height])"
    )
    assert len(boxes) >= 8  # the mean courses of height and pitch, of both sides, of both sessions
    assert all(0 < wide <= width and high > 0 for wide, high in boxes)


def test_a_comparisons_term_explains_itself_by_keyboard_and_by_touch(compared: Page):
    compared.size(1280, 900)
    assert compared.run(f"getComputedStyle({COMPARED_TIP}).display") == "none"
    compared.run(f"{COMPARED_TERM}.focus()")
    assert compared.run(f"getComputedStyle({COMPARED_TIP}).display") == "block"
    assert len(compared.run(f"{COMPARED_TIP}.textContent")) > 30
    compared.scroll_to(".compare tbody .term")
    box = compared.run(f"(r => [r.left, r.right])({COMPARED_TIP}.getBoundingClientRect())")
    assert 0 <= box[0] < box[1] <= 1280
    compared.run(f"{COMPARED_TERM}.blur()")
    compared.size(820, 1180, touch=True)
    compared.scroll_to(".compare tbody .term")
    compared.tap(".compare tbody .term")
    assert compared.until(f"getComputedStyle({COMPARED_TIP}).display === 'block'")


def test_of_a_comparison_printed_there_are_no_open_explanations(compared: Page):
    compared.run(f"{COMPARED_TERM}.focus()")
    compared.call("Emulation.setEmulatedMedia", media="print")
    assert compared.run(f"getComputedStyle({COMPARED_TIP}).display") == "none"
    compared.call("Emulation.setEmulatedMedia", media="")
