"""The comparison of two sessions in a real browser: nothing is asked for, nothing runs over the edge, terms explain."""

from __future__ import annotations

import pytest
import report_records as make
from page_browser import CHROMIUM, Page, chromium

from fes.report.comparison.page import compare_sessions, render_comparison
from fes.report.comparison.session import of_record

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")

TERM = "document.querySelector('.compare tbody .term')"
TIP = f"{TERM}.querySelector('.tip')"


@pytest.fixture(scope="module")
def page(tmp_path_factory):
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


def test_nothing_is_asked_of_any_network_and_nothing_complained_of(page: Page):
    assert page.run("performance.getEntriesByType('resource').length") == 0
    assert page.console == []


@pytest.mark.parametrize("width", [1280, 820])
def test_it_fits_and_its_figures_are_drawn(page: Page, width: int):
    page.size(width, 1100)
    assert page.run("document.documentElement.scrollWidth") <= width
    boxes = page.run(
        "[...document.querySelectorAll('svg path')].filter(p => p.getAttribute('d').length > 100)"
        ".map(p => p.getBoundingClientRect()).map(r => [r.width, r.height])"
    )
    assert len(boxes) >= 8  # the mean courses of height and pitch, of both sides, of both sessions
    assert all(0 < wide <= width and high > 0 for wide, high in boxes)


def test_a_term_explains_itself_by_keyboard_and_by_touch(page: Page):
    page.size(1280, 900)
    assert page.run(f"getComputedStyle({TIP}).display") == "none"
    page.run(f"{TERM}.focus()")
    assert page.run(f"getComputedStyle({TIP}).display") == "block"
    assert len(page.run(f"{TIP}.textContent")) > 30
    page.scroll_to(".compare tbody .term")
    box = page.run(f"(r => [r.left, r.right])({TIP}.getBoundingClientRect())")
    assert 0 <= box[0] < box[1] <= 1280
    page.run(f"{TERM}.blur()")
    page.size(820, 1180, touch=True)
    page.scroll_to(".compare tbody .term")
    page.tap(".compare tbody .term")
    assert page.until(f"getComputedStyle({TIP}).display === 'block'")


def test_printed_there_are_no_open_explanations(page: Page):
    page.run(f"{TERM}.focus()")
    page.call("Emulation.setEmulatedMedia", media="print")
    assert page.run(f"getComputedStyle({TIP}).display") == "none"
    page.call("Emulation.setEmulatedMedia", media="")
