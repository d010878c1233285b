"""Stop is never refused: presses on the live page's server, under load, to the last pulse at the stimulator's node.

``FES_PRESSES=1000 pytest -s tests/transports/test_stop_presses.py`` takes about half an hour and prints the figures.
"""

from __future__ import annotations

import base64
import json
import multiprocessing
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from live_runs import LiveRun, live_run, prepare, standing_first
from replays import cut, trial
from test_page_end_to_end import burst_by_hand, link_of

from fes.live.dashboard.process import press_stop
from fes.recording import write_recording

PRESSES = int(os.environ.get("FES_PRESSES", "10"))
P99_MS, ENOUGH = 100.0, 1000
HALF_OPEN, FLOOD_S = 300, 0.01


def connected(port: int, begun: bytes) -> socket.socket:
    link = socket.create_connection(("127.0.0.1", port), 5.0)
    with suppress(OSError):
        link.sendall(begun)
    return link


def upgrade(port: int) -> bytes:
    """The request for the page's web socket."""
    key = base64.b64encode(bytes(16)).decode()
    return (
        f"GET /live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Origin: http://127.0.0.1:{port}\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n"
    ).encode()


def hold_half_open(port: int, ended: threading.Event) -> None:
    """Always 300 connections that never make a whole request: those that the server closes are opened again."""
    links: list[socket.socket] = []
    while not ended.is_set():
        for link in list(links):
            link.setblocking(False)
            with suppress(BlockingIOError, OSError):
                if link.recv(1) == b"":
                    links.remove(link)
                    link.close()
        with suppress(OSError):
            while len(links) < HALF_OPEN and not ended.is_set():
                links.append(connected(port, b"POST /stop HTTP/1.1\r\nHost: x\r\n"))
        ended.wait(0.2)
    for link in links:
        link.close()


def flood(port: int, ended: threading.Event) -> None:
    """Web sockets without a link, a hundred a second, of which sixteen stay open."""
    links: list[socket.socket] = []
    while not ended.wait(FLOOD_S):
        with suppress(OSError):
            links.append(connected(port, upgrade(port)))
        if len(links) > 16:
            links.pop(0).close()
    for link in links:
        link.close()


def blocked_browser(port: int, token: str) -> socket.socket:
    """A browser with a link whose main thread is blocked: it entered, and reads nothing any more."""
    link = socket.create_connection(("127.0.0.1", port), 5.0)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    link.sendall(upgrade(port))
    assert b" 101 " in link.recv(1000)
    text = json.dumps({"token": token}).encode()
    link.sendall(bytes((0x81, 0x80 | len(text), 0, 0, 0, 0)) + text)  # masked with zeros
    return link


def spin() -> None:
    while True:
        pass


@contextmanager
def loaded(port: int, token: str) -> Iterator[None]:
    """All of it at once: connections, flood, a blocked browser, and every processor busy."""
    ended = threading.Event()
    threads = [threading.Thread(target=target, args=(port, ended)) for target in (hold_half_open, flood)]
    busy = [multiprocessing.get_context("spawn").Process(target=spin, daemon=True) for _ in range(os.cpu_count() or 1)]
    with ExitStack() as stack:
        stack.enter_context(blocked_browser(port, token))
        for each in (*threads, *busy):
            each.start()
        try:
            yield
        finally:
            ended.set()
            for process in busy:
                process.kill()
            for thread in threads:
                thread.join(10.0)


def pressed(run: LiveRun, port: int) -> float:
    """From the press to the last pulse, ms."""
    with burst_by_hand(run, 0.05):
        before_ns = time.monotonic_ns()
        press_stop(port)
    off_ms = run.off_after_ms(before_ns)
    run.until(lambda status: status.state == "stopped")
    return off_ms


@pytest.mark.slow
@pytest.mark.requirement("SR-16")
def test_every_press_stops_in_time_whatever_else_connects(tmp_path: Path) -> None:
    _, calibration = prepare(tmp_path)
    recording = tmp_path / "standing.parquet"
    write_recording(standing_first(cut(trial("negard_patient2"), 3.0, 5.0), 60), recording)
    with live_run(tmp_path, recording, "--calibration", calibration, "--dashboard") as run:
        address, _, token = link_of(run).partition("#")
        port = int(address.split(":")[2].split("/")[0])
        with loaded(port, token):
            off_ms = np.array([pressed(run, port) for _ in range(PRESSES)])
        run.quit()
    median, p99 = np.percentile(off_ms, (50, 99), method="higher")
    print(f"{PRESSES} presses, none lost: off after p50 {median:.1f}, p99 {p99:.1f}, at most {off_ms.max():.1f} ms")
    assert median <= P99_MS
    if PRESSES >= ENOUGH:  # of fewer it is the worst, which a machine that others use decides
        assert p99 <= P99_MS
