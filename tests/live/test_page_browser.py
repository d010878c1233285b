"""The page in a real browser, told made-up things: every state in words, nothing smuggled in, nothing hidden."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from page_browser import CHROMIUM, Page, chromium

from fes.live.commands import State
from fes.live.dashboard.process import DashboardProcess
from fes.live.status import FootStatus, Status, TuningStatus
from fes.session_log import Note
from fes.signals import NS_PER_S, StimCommand, StrideResult
from fes.walk_record import MARK

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")

SMUGGLED = '<img src="/x" onerror="document.title=1"><script>document.title=2</script>'
FOOT = FootStatus("swing", True, 3, 1.234, 0.6, 500.0, 1.0)
SHOWN = Status(t_ns=NS_PER_S, state="running", intensity=0.2, on=True, feet={"right_foot": FOOT}, stimulator="open")
REMEMBER = """
window.sockets = [];
window.WebSocket = class extends WebSocket {
  constructor(...given) {
    super(...given);
    this.seen = 0;
    sockets.push(this);
    this.addEventListener("message", () => this.seen++);
  }
};
"""
ABOUT = {
    "mode": "live",
    "name": f"Trial {SMUGGLED}",
    "most_intensity": 0.6,
    "intensity_step": 0.05,
    "channels": [{"number": 0, "name": SMUGGLED, "foot": "right_foot", "current_ma": 30.0, "most_ma": 40.0}],
    "feet": ["right_foot"],
}


@pytest.fixture(scope="module")
def process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DashboardProcess]:
    with DashboardProcess(tmp_path_factory.mktemp("page"), ABOUT) as made:
        yield made


@pytest.fixture(scope="module")
def page(process: DashboardProcess, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium(tmp_path_factory.mktemp("browser")) as made:
        made.size(1024, 768)
        made.call("Page.addScriptToEvaluateOnNewDocument", source=REMEMBER)
        made.go(process.url)
        made.until("document.getElementById('session-name').textContent !== ''")
        yield made


def until(process: DashboardProcess, page: Page, status: Status, expression: str) -> None:
    """Tell it, as a session would, until the page shows it."""
    end_s = time.monotonic() + 20
    while not page.run(expression):
        assert time.monotonic() < end_s, page.run("document.body.innerText")
        process.stream.send(status.encode())
        time.sleep(0.05)


@pytest.mark.parametrize("state", State)
def test_every_state_is_said_in_words_and_the_stop_is_in_view(
    process: DashboardProcess, page: Page, state: State, tmp_path: Path
) -> None:
    current = state in (State.ARMED, State.RUNNING)
    fault = {State.FAULT: "right_foot: sensor lost", State.STOPPED: "emergency stop"}.get(state, "")
    status = replace(SHOWN, state=str(state), on=current, fault=fault)
    until(process, page, status, f"document.body.dataset.state === '{state}'")
    assert page.text("#state-word").isupper()
    assert len(page.text("#state-text")) > 10
    assert ("sensor lost" in page.text("#fault")) == (state is State.FAULT)
    assert page.run("document.getElementById('fault').hidden") == (state is not State.FAULT)
    assert page.text("#current") == ("⚡ Current ON" if current else "No current")
    assert page.run("document.getElementById('arm').disabled") == (
        state not in (State.SHADOW, State.STOPPED, State.FAULT)
    )
    assert page.run("document.getElementById('up').disabled") == (not (current or state is State.SHADOW))
    for width, height in ((390, 664), (768, 1024), (1280, 720), (1024, 600)):
        page.size(width, height)
        box = page.run(
            "(r => [r.left, r.top, r.right, r.bottom])(document.getElementById('stop').getBoundingClientRect())"
        )
        assert 0 <= box[0] < box[2] <= width
        assert 0 <= box[1] < box[3] <= height
        assert box[2] - box[0] >= 200
        assert box[3] - box[1] >= 80
        buttons = page.run(
            "['pause', 'arm', 'disarm', 'up', 'down'].map((id) => document.getElementById(id).getBoundingClientRect())"
            ".map((r) => [r.left, r.top, r.right, r.bottom])"
        )
        for left, top, right, bottom in buttons:
            assert 0 <= left < right <= width
            assert 0 <= top < bottom <= height
            assert bottom - top >= 48
        assert page.run("document.documentElement.scrollWidth") <= width


WORN = ("left_foot", "right_foot", "left_shank", "right_shank", "left_thigh", "right_thigh")
SIZES = ((390, 844), (768, 1024), (1024, 768), (1280, 720), (1920, 1080), (1080, 1920))
# what lies on what else, what sticks out of its box, what is cut off; by names of elements
MISPLACED = """
(() => {
  const found = [], rect = (each) => each.getBoundingClientRect();
  const name = (each) => `${each.tagName}.${each.className || each.id}: ${each.textContent.slice(0, 30)}`;
  const before = (a, b) => a.right <= b.left + 1 || a.bottom <= b.top + 1;
  const apart = (a, b) => before(a, b) || before(b, a);
  const boxes = "main, #roles, .foot, #mark, .numbers, .phases, header, #controls, #dose, #acts";
  for (const box of document.querySelectorAll(boxes)) {
    const inside = [...box.children].filter((each) => rect(each).width && rect(each).height);
    inside.forEach((one, at) => inside.slice(at + 1).forEach((other) => {
      if (!apart(rect(one), rect(other))) found.push(`${name(one)} on ${name(other)}`);
    }));
    for (const each of inside) if (rect(each).left < rect(box).left - 1 || rect(each).right > rect(box).right + 1)
      found.push(`${name(each)} out of ${name(box)}`);
  }
  for (const each of document.querySelectorAll(".foot *, header *, button, #intensity"))
    if (each.scrollWidth > each.clientWidth + 1 && each.clientWidth) found.push(`${name(each)} is cut off`);
  return found;
})()
"""


@pytest.mark.parametrize("count", range(1, len(WORN) + 1))
def test_nothing_overlaps_with_one_to_six_sensors_on_any_screen(
    process: DashboardProcess, page: Page, count: int
) -> None:
    page.run("document.getElementById('feet').replaceChildren()")
    feet = {name: replace(FOOT, phase="loading_response", strides=1234, rate_hz=1000.0) for name in WORN[:count]}
    fault = "left_foot, right_foot: sensor lost: device reports readiness to read but returned no data"
    remedy = "Check plug, battery and range; its line is opened again by itself. Then arm again."
    status = replace(SHOWN, state="fault", on=False, feet=feet, fault=fault, remedy=remedy, notices=[fault, fault])
    cards = len({"right_foot", *WORN[:count]})  # the channel's foot has one whatever is worn
    until(process, page, status, f"document.querySelectorAll('.foot').length === {cards}")
    until(process, page, status, "document.body.dataset.state === 'fault'")
    for width, height in SIZES:
        page.size(width, height)
        process.stream.send(status.encode())
        assert page.run(MISPLACED) == [], (width, height)
        assert page.run("document.documentElement.scrollWidth") <= width
        stop = page.run("(r => [r.top, r.bottom])(document.getElementById('stop').getBoundingClientRect())")
        assert 0 <= stop[0] < stop[1] <= height
        seen, whole = page.run("(l => [l.clientHeight, l.scrollHeight])(document.getElementById('notices'))")
        assert seen >= min(whole, 0.29 * height), f"at {width} px the notices are cut to {seen} of {whole} px"
    page.run("document.getElementById('feet').replaceChildren()")


SCREENS = ((390, 844), (768, 1024), (1024, 768), (1440, 900), (1920, 1080))


@pytest.mark.parametrize("size", SCREENS, ids=str)
def test_what_stimulates_stands_first_and_in_view_and_what_drives_nothing_is_one_line(
    process: DashboardProcess, page: Page, size: tuple[int, int]
) -> None:
    width, height = size
    page.size(width, height)
    idle = FootStatus("", False, 0, None, None, 100.0, 1.0)
    still = replace(FOOT, phase="stance", walking=False)
    worn = {"left_foot": still, "left_shank": idle, "right_foot": FOOT, "right_shank": replace(idle, age_ms=1e6)}
    process.stream.command(StimCommand(NS_PER_S, 0, True, 12.5, 300.0, 40.0, 60))
    status = replace(SHOWN, feet=worn)
    until(process, page, status, "document.querySelectorAll('.foot').length === 2")
    until(process, page, status, "document.querySelector('.channel.on #sent-0')?.textContent === '12.5 mA'")
    page.run("document.querySelector('main').scrollTop = 0")
    assert page.run("[...document.querySelectorAll('.foot')].map((each) => each.id)") == [
        "foot-right_foot",
        "foot-left_foot",
    ]
    assert page.text("#foot-right_foot .phase") == "Swing"
    assert page.text("#others") == "Other sensors: left shank 100 Hz · right shank silent"
    footer = page.run("document.querySelector('footer').getBoundingClientRect().top")
    place = "(r => [r.left, r.top, r.bottom])(document.getElementById({!r}).getBoundingClientRect())"
    driving, other, chart = (
        page.run(place.format(name)) for name in ("foot-right_foot", "foot-left_foot", "envelope-panel")
    )
    assert driving[:2] == min(driving[:2], other[:2], chart[:2])
    assert max(driving[2], chart[2]) <= footer  # nobody scrolls to see what flows


def test_a_foot_whose_sensor_is_silent_says_no_phase(process: DashboardProcess, page: Page) -> None:
    silent = replace(SHOWN, feet={"right_foot": replace(FOOT, age_ms=1001.0)})
    until(process, page, silent, "document.querySelector('#foot-right_foot .phase')?.textContent === '–'")
    assert page.text("#foot-right_foot .walks") == "phase not known"
    assert page.text("#foot-right_foot .age") == "silent"


def test_a_shank_that_stands_for_its_foot_has_the_foots_channel(process: DashboardProcess, page: Page) -> None:
    worn = {"right_shank": FOOT, "left_foot": FOOT}
    until(process, page, replace(SHOWN, feet=worn), "document.querySelector('#foot-right_shank .channel') !== null")
    assert page.run("[...document.querySelectorAll('.foot')].map((each) => each.id)")[0] == "foot-right_shank"
    assert page.run("document.getElementById('foot-right_foot')") is None


def test_the_space_bar_in_the_marks_field_is_a_stop_and_an_underscore_a_blank(
    process: DashboardProcess, page: Page
) -> None:
    page.size(1024, 768)
    until(process, page, SHOWN, "document.body.dataset.state === 'running'")
    page.run("document.getElementById('mark-text').focus()")
    link = process.stream.link
    link.settimeout(10.0)
    try:
        page.call("Input.dispatchKeyEvent", type="keyDown", key=" ", code="Space", text=" ")
        assert link.recv(100) == b'{"ask":"stop"}'
        link.setblocking(False)
        until(process, page, replace(SHOWN, state="stopped"), "document.body.dataset.state === 'stopped'")
        page.run("document.getElementById('mark-text').value = 'brace_on'")
        page.run("document.getElementById('mark').requestSubmit()")
        link.settimeout(10.0)
        assert link.recv(512) == b'{"ask": "mark", "text": "brace on"}'
        assert page.run("document.getElementById('mark-text').value") == ""
    finally:
        link.setblocking(False)


def test_names_and_messages_are_text_and_nothing_else(process: DashboardProcess, page: Page) -> None:
    process.stream.note(Note(2 * NS_PER_S, "fault", "gate", SMUGGLED))
    process.stream.note(Note(2 * NS_PER_S, "info", MARK, SMUGGLED[:80]))
    made = StrideResult("right_foot", 1, 0, NS_PER_S, 1.25, 0.08, 0.0, 0.0, 0.6, 1, 2, 3, 4)
    process.stream.stride(replace(made, trajectory_m=np.linspace((0.0, 0.0, 0.0), (1.25, 0.0, 0.0), 50)))
    process.stream.stride(replace(made, number=2, valid=False, reason=SMUGGLED, stride_length_m=float("nan")))
    process.stream.command(StimCommand(NS_PER_S, 0, True, 12.5, 300.0, 40.0, 60))
    unmeasured = replace(FOOT, stride_length_m=float("nan"), speed_mps=float("nan"))
    status = replace(SHOWN, message=SMUGGLED, notices=[SMUGGLED], feet={"right_foot": unmeasured})
    until(process, page, status, "document.querySelectorAll('#strides tr').length === 2")
    assert SMUGGLED in page.text("#session-name")
    assert SMUGGLED in page.text("#notes")
    assert SMUGGLED in page.text("#feet")
    assert SMUGGLED in page.text("#notices")
    assert page.text("#marked button") == SMUGGLED[:80]
    assert SMUGGLED in page.text("#strides")
    assert SMUGGLED in page.text("#message")
    assert page.text("#sent-0") == "12.5 mA"
    assert page.text("#foot-right_foot .length") == "–"
    assert "1.25" in page.text("#strides")
    assert page.run("document.querySelectorAll('main img, main script, footer img').length") == 0
    assert page.run("document.title").startswith("FES")
    assert page.console == []


def test_what_the_tuning_has_made_of_a_current_stands_beside_it(process: DashboardProcess, page: Page) -> None:
    suggested = TuningStatus("suggest", now="22.0 mA, 287 µs", suggestion="current 22.0 → 24.0 mA")
    shown = "document.querySelector('#tuned-0').textContent"
    until(process, page, replace(SHOWN, tuning={"0": suggested}), f"{shown} !== ''")
    assert page.text("#set-0").strip() == "of 22.0, by tuning"
    assert page.text("#tuned-0") == "Tuning suggests current 22.0 → 24.0 mA. In the terminal y accepts."
    frozen = replace(suggested, frozen="the intensity was lowered by hand")
    until(process, page, replace(SHOWN, tuning={"0": frozen}), f"{shown}.includes('frozen')")
    assert page.text("#tuned-0").endswith("In the terminal g goes on.")


def test_a_question_is_read_whole_on_a_phone(process: DashboardProcess, page: Page) -> None:
    page.size(390, 844)
    page.run("document.getElementById('question-text').textContent = 'Arm? The patient stands. '.repeat(8)")
    page.run("document.getElementById('question').hidden = false")
    try:
        for name in ("question-text", "yes", "no"):
            left, right = page.run(
                f"(r => [r.left, r.right])(document.getElementById('{name}').getBoundingClientRect())"
            )
            assert 0 <= left < right <= 390, name
    finally:
        page.run("document.getElementById('question').hidden = true")
        page.size(1024, 768)


def test_a_connection_that_comes_back_shows_nothing_twice(process: DashboardProcess, page: Page) -> None:
    for k in range(100):
        process.stream.command(StimCommand(NS_PER_S + k * 20_000_000, 0, True, 9.0, 300.0, 40.0, 60))
    later = replace(SHOWN, t_ns=3 * NS_PER_S)
    drawn = "Number(document.getElementById('envelope').dataset.drawn)"
    until(process, page, later, f"{drawn} >= 100 && document.querySelectorAll('#strides tr').length === 2")
    before = page.run(drawn)
    page.run("sockets.at(-1).close()")
    until(process, page, later, "sockets.length > 1 && sockets.at(-1).seen > 2")
    until(process, page, later, "document.querySelectorAll('#strides tr').length === 2")
    assert page.run(drawn) <= before
    assert page.text("#link-text") == "this page controls"


def test_silence_is_said_to_be_old_and_the_space_bar_stops(process: DashboardProcess, page: Page) -> None:
    until(process, page, SHOWN, "document.body.dataset.state === 'running'")
    page.until("document.body.dataset.state === 'lost'")  # nothing is told any more
    assert "Nothing is heard of the session" in page.text("#alarm")
    assert page.text("#current") == "Current unknown"
    assert page.run("document.getElementById('up').disabled")
    page.call("Input.dispatchKeyEvent", type="keyDown", key=" ", code="Space", text=" ")
    process.stream.link.settimeout(10.0)
    assert process.stream.link.recv(100) == b'{"ask":"stop"}'
    process.stream.link.setblocking(False)


def test_a_page_opened_without_a_link_stops_all_the_same(process: DashboardProcess, tmp_path: Path) -> None:
    with chromium(tmp_path / "browser") as stranger:
        stranger.go(process.url.partition("#")[0])
        stranger.until("!document.getElementById('alarm').hidden")
        assert stranger.text("#session-name") == ""
        stranger.press("#stop")
        process.stream.link.settimeout(10.0)
        assert process.stream.link.recv(100) == b'{"ask":"stop"}'
        process.stream.link.setblocking(False)
