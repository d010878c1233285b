"""`fes run --dashboard` in a real browser, between simulated devices; the stimulator's own record is the judge."""

from __future__ import annotations

import http.client
import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from live_runs import LiveRun, live_run, prepare, standing_first
from page_browser import CHROMIUM, Page, chromium
from replays import MS, cut, trial

from drivers.simulated.spawn import free_bus, why_silent
from fes.cli.common import OK
from fes.cli.replay.command import repeat
from fes.hil.campaign_bench import LOST_TIME
from fes.live.dashboard.process import press_stop
from fes.recording import write_recording
from fes.session_log import SessionRecord, read_session
from fes.signals import OperatorAction

STOP_MS = 150

NO_BUS = why_silent(free_bus())
pytestmark = [
    pytest.mark.skipif(bool(NO_BUS), reason=f"no CAN between processes on this machine: {NO_BUS}"),
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo-terminals on this machine"),
]
in_a_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return prepare(tmp_path_factory.mktemp("loop"))


@pytest.fixture(scope="module")
def standing(loop: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same, standing for a minute."""
    recording = tmp_path_factory.mktemp("standing") / "standing.parquet"
    write_recording(standing_first(cut(trial("negard_patient2"), 3.0, 5.0), 60), recording)
    return recording, loop[1]


def link_of(run: LiveRun, timeout_s: float = 120.0) -> str:
    """The newest link of the session's page."""
    end_s = time.monotonic() + timeout_s
    while not (found := [path for path in run.folder.glob("*/*/page.url") if path.read_text().strip()]):
        assert run.process.poll() is None, run.said()
        assert time.monotonic() < end_s
        time.sleep(0.02)
    return found[0].read_text().strip()


def answer_of(port: int, timeout_s: float = 60.0) -> int:
    """The page's answer, once it has come up."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=timeout_s)
    try:
        connection.request("GET", "/")
        return connection.getresponse().status
    finally:
        connection.close()


def state_is(*states: str) -> str:
    return f"{json.dumps(states)}.includes(document.body.dataset.state)"


def confirmed(page: Page, button: str) -> None:
    """Press it, and say yes to what it asks."""
    page.until(f"!document.querySelector('{button}').disabled")
    page.press(button)
    page.until("!document.getElementById('question').hidden")
    time.sleep(0.35)  # a second tap that comes sooner is none
    page.press("#yes")


def stopped_at_ns(record: SessionRecord) -> int:
    """When the loop took the stop."""
    return next(act.t_ns for act in record.acts if act.action is OperatorAction.EMERGENCY_STOP)


@contextmanager
def burst_by_hand(run: LiveRun, intensity: float = 0.3) -> Iterator[None]:
    """In the middle of a burst of a second, the patient standing.

    Armed again for it, as an operator would, where a machine that is too busy has held the session up until it latched.
    """
    end_s = time.monotonic() + 60
    while run.current_ma() <= 0.0:
        assert time.monotonic() < end_s, run.status
        run.armed_at(intensity)
        run.order("trigger", confirm=True)
        since_s = time.monotonic()
        while run.current_ma() <= 0.0 and time.monotonic() - since_s < 1.0:  # it begins with the next command
            time.sleep(0.005)
        time.sleep(0.2)
    yield


@in_a_browser
def test_arms_raises_only_when_confirmed_and_its_stop_button_stops(standing: tuple[Path, Path], tmp_path: Path) -> None:
    recording, calibration = standing
    with (
        live_run(tmp_path, recording, "--calibration", calibration, "--dashboard") as run,
        chromium(tmp_path / "browser") as page,
    ):
        page.size(1024, 768, touch=True)
        page.go(link_of(run))
        page.until(state_is("shadow"))
        confirmed(page, "#arm")
        run.until(lambda status: status.state in ("armed", "running"))
        page.press("#up")
        page.until("!document.getElementById('question').hidden")
        page.press("#no")
        assert page.text("#intensity") == "0 %"
        confirmed(page, "#up")
        page.until("document.getElementById('intensity').textContent === '5 %'")
        run.until(lambda status: status.intensity >= 0.3, "up")
        with burst_by_hand(run):
            page.until("document.getElementById('current').className === 'on'")
            blow_ns = page.tap("#stop")
        off_ms = run.off_after_ms(blow_ns)
        page.until(state_is("stopped"))
        assert run.stays_off(blow_ns + STOP_MS * MS, 0.2)
        said = run.quit()
        page.until(state_is("ended"))
        assert run.process.returncode == OK, said
        record = read_session(run.log)
        to_loop_ms = (stopped_at_ns(record) - blow_ns) / MS
        print(f"off {off_ms:.1f} ms after the touch, of which {to_loop_ms:.1f} ms to the loop")
        assert off_ms <= STOP_MS
        assert page.console == []
        assert repeat(run.log).difference == ""
        assert not {"starlette", "uvicorn", "websockets"} & run.loaded()


@in_a_browser
@pytest.mark.slow
def test_what_it_shows_is_what_the_log_holds_also_after_reloading_and_in_a_second_browser(
    loop: tuple[Path, Path], tmp_path: Path
) -> None:
    recording, calibration = loop
    with (
        live_run(tmp_path, recording, "--calibration", calibration, "--dashboard") as run,
        chromium(tmp_path / "browser") as page,
    ):
        page.size(1280, 800)
        first = link_of(run)
        page.go(first)
        run.armed_at()
        run.in_mid_burst()
        page.until("document.querySelectorAll('#strides tr').length >= 5")
        page.until("document.getElementById('session-name').textContent.length > 0")
        page.until("Number(document.getElementById('envelope').dataset.drawn) > 100")
        page.until("(document.getElementById('side').dataset.drawn ?? '').startsWith('right_foot:')")
        shown, rows = shown_strides(page)
        page.call("Page.reload")
        page.until("document.querySelectorAll('#strides tr').length >= 5")
        assert page.text("#link-text") == "this page controls"
        again, _ = shown_strides(page)
        with chromium(tmp_path / "other") as other:
            other.go(first)  # used
            other.until("!document.getElementById('alarm').hidden")
            assert "used already" in other.text("#alarm")
            other.go("about:blank")
            other.go(link_of(run))
            other.until("document.querySelectorAll('#strides tr').length >= 5")
            page.until("document.getElementById('link-text').textContent === 'this page watches'")
            assert page.run("document.getElementById('up').disabled")
            status = run.until(lambda status: True)  # a busy machine may hold the sensor up, page or none
            assert status.state in ("armed", "running") or any(word in status.fault for word in LOST_TIME), status
            page.press("#stop")  # an old link's
            other.until(state_is("stopped"))
            said = run.quit()
            other.until(state_is("ended"))
            assert other.console == []
        assert run.process.returncode == OK, said
        record = read_session(run.log)
        logged = {(stride.foot, stride.number): stride for stride in record.strides}
        assert len(shown) >= 5
        for each in (*shown, *again):
            stride = logged[each["foot"], each["number"]]
            assert each["valid"] == stride.valid
            assert each["stride_length_m"] == stride.stride_length_m
            assert each["clearance_m"] == stride.clearance_m
            assert each["speed_mps"] == stride.speed_mps
            if row := rows.get(each["number"]):
                assert row[2:4] == [f"{stride.stride_length_m:.2f}", f"{100 * stride.clearance_m:.1f}"]
        assert page.console == []
        assert repeat(run.log).difference == ""


def shown_strides(page: Page) -> tuple[list[dict[str, Any]], dict[int, list[str]]]:
    """What the table holds: the numbers behind it, and its text by the stride's number."""
    found = page.run(
        "[...document.querySelectorAll('#strides tr')]"
        ".map(row => [row.dataset.stride, [...row.cells].map(cell => cell.textContent)])"
    )
    strides = [json.loads(data) for data, _ in found]
    return strides, {each["number"]: cells for each, (_, cells) in zip(strides, found, strict=True) if each["valid"]}


@in_a_browser
@pytest.mark.slow
def test_the_stop_button_again_and_again(standing: tuple[Path, Path], tmp_path: Path) -> None:
    recording, calibration = standing
    stops: list[tuple[int, float]] = []
    with (
        live_run(tmp_path, recording, "--calibration", calibration, "--dashboard") as run,
        chromium(tmp_path / "browser") as page,
    ):
        page.size(768, 1024, touch=True)
        page.go(link_of(run))
        run.armed_at(0.3)
        page.until(state_is("armed", "running"))
        page.tap("#pause")
        run.until(lambda status: status.state == "paused")
        page.until("document.getElementById('pause').textContent === 'Go on'")
        page.tap("#pause")
        page.until("!document.getElementById('question').hidden")
        assert run.until(lambda status: True).state == "paused"
        page.press("#no")
        confirmed(page, "#pause")
        assert run.until(lambda status: status.state in ("armed", "running")).intensity == pytest.approx(0.3)
        for _ in range(10):
            run.armed_at(0.3)
            with burst_by_hand(run):
                blow_ns = page.tap("#stop")
            stops.append((blow_ns, run.off_after_ms(blow_ns)))
            run.until(lambda status: status.state == "stopped")
            page.until(state_is("stopped"))
        run.quit()
        taken_ns = [act.t_ns for act in read_session(run.log).acts if act.action is OperatorAction.EMERGENCY_STOP]
        assert len(taken_ns) == len(stops)  # a press is one stop, though it goes two ways
        to_loop_ms = sorted((taken - blow) / MS for taken, (blow, _) in zip(taken_ns, stops, strict=True))
        off_ms = sorted(off for _, off in stops)
        print(
            f"touch to output off: median {off_ms[5]:.1f} ms, at most {off_ms[-1]:.1f} ms; "
            f"of which touch to loop: median {to_loop_ms[5]:.1f} ms, at most {to_loop_ms[-1]:.1f} ms"
        )
        assert off_ms[-1] <= STOP_MS


@in_a_browser
@pytest.mark.slow
def test_stopped_or_killed_its_process_changes_nothing(loop: tuple[Path, Path], tmp_path: Path) -> None:
    recording, calibration = loop
    with (
        live_run(tmp_path, recording, "--calibration", calibration, "--dashboard") as run,
        chromium(tmp_path / "browser") as browser,
    ):
        link = link_of(run)
        port = int(link.split(":")[2].split("/")[0])
        browser.go(link)
        run.armed_at()
        run.in_mid_burst()
        (page,) = run.children("fes.live.dashboard")
        os.kill(page, signal.SIGSTOP)  # it reads nothing any more
        browser.until(state_is("lost"))
        assert "SPACE" in browser.text("#alarm")
        assert run.until(lambda status: True).state in ("armed", "running")
        run.in_mid_burst()
        blow_ns = time.monotonic_ns()
        os.kill(page, signal.SIGKILL)
        seen = run.until(lambda status: "the dashboard has ended" in status.message)
        assert seen.state in ("armed", "running")
        run.until(lambda status: not status.on)
        run.in_mid_burst()  # the next step is stimulated like those before
        with pytest.raises(OSError):
            press_stop(port)
        browser.press("#stop")
        browser.until("document.getElementById('alarm').textContent.includes('not confirmed')")
        os.write(run.keys, b" ")
        run.until(lambda status: status.state == "stopped")
        run.quit()
        record = read_session(run.log)
        after = [note.text for note in record.notes if note.severity == "fault" and note.t_ns >= blow_ns]
        # a busy machine may hold the loop up, with or without a page
        after = [text for text in after if not any(word in text for word in LOST_TIME)]
        assert after == ["emergency stop (key)"]
        assert repeat(run.log).difference == ""


@pytest.mark.slow
def test_a_stop_by_request_is_prompt(standing: tuple[Path, Path], tmp_path: Path) -> None:
    recording, calibration = standing
    with live_run(tmp_path, recording, "--calibration", calibration, "--dashboard") as run:
        port = int(link_of(run).split(":")[2].split("/")[0])
        assert answer_of(port) == http.client.OK  # the link is there sooner than the server
        run.armed_at(0.3)
        with burst_by_hand(run):
            blow_ns = time.monotonic_ns()
            press_stop(port)
        off_ms = run.off_after_ms(blow_ns)
        print(f"off {off_ms:.1f} ms after the request")
        assert off_ms <= STOP_MS
        run.quit()
