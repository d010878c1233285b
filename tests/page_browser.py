"""A real headless Chromium, driven over its DevTools protocol."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-dev-shm-usage")


class Page:
    """One page of the browser."""

    def __init__(self, link: ClientConnection) -> None:
        self._socket = link
        self._number = 0
        self.console: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One command and its answer."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            said = json.loads(self._socket.recv(timeout=30))
            if said.get("id") == self._number:
                assert "error" not in said, (method, said["error"])
                result: dict[str, Any] = said["result"]
                return result
            self._note(said)

    def _note(self, said: dict[str, Any]) -> None:
        if said.get("method") == "Log.entryAdded":
            self.console.append(said["params"]["entry"]["text"])
        elif said.get("method") in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown"):
            self.console.append(json.dumps(said["params"]))

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def text(self, selector: str) -> str:
        return str(self.run(f"document.querySelector({json.dumps(selector)})?.textContent ?? ''"))

    def until(self, expression: str, timeout_s: float = 30.0) -> Any:
        """Wait until it is true; its value."""
        end_s = time.monotonic() + timeout_s
        while not (value := self.run(expression)):
            assert time.monotonic() < end_s, (
                f"{expression} did not come; the page: {self.run('document.body.innerText')}"
            )
            time.sleep(0.02)
        return value

    def go(self, url: str) -> None:
        self.call("Page.navigate", url=url)
        self.until("document.readyState === 'complete'")

    def size(self, width: int, height: int, *, dark: bool = False, touch: bool = False) -> None:
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=touch)
        self.call("Emulation.setTouchEmulationEnabled", enabled=touch)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def middle(self, selector: str) -> tuple[float, float]:
        box = self.run(
            f"(r => [r.x + r.width / 2, r.y + r.height / 2])"
            f"(document.querySelector({json.dumps(selector)}).getBoundingClientRect())"
        )
        return box[0], box[1]

    def scroll_to(self, selector: str) -> None:
        """Bring an element to the middle of the window; when this returns it stays there.

        The page is told of the scrolling with the next frame, and a pointer that came sooner would have its effect
        undone by that. What was unfolded just before is laid out in later frames still, and moves what is below it.
        """
        self.run(
            f"""(element => new Promise(stays => {{
                let place = NaN, frames = 0;
                const look = () => {{
                    element.scrollIntoView({{block: "center", behavior: "instant"}});
                    const {{top}} = element.getBoundingClientRect();
                    frames = top === place ? frames + 1 : 0;
                    place = top;
                    if (frames === 3) stays(); else requestAnimationFrame(look);
                }};
                look();
            }}))(document.querySelector({json.dumps(selector)}))"""
        )

    def press(self, selector: str) -> int:
        """Press and release in the middle of an element; when the press was sent (ns)."""
        x, y = self.middle(selector)
        where = {"x": x, "y": y, "button": "left", "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)  # as every pointer gets there
        begin_ns = time.monotonic_ns()
        self.call("Input.dispatchMouseEvent", type="mousePressed", **where)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", **where)
        return begin_ns

    def tap(self, selector: str) -> int:
        """Touch an element; when that was sent (ns)."""
        x, y = self.middle(selector)
        begin_ns = time.monotonic_ns()
        self.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        return begin_ns

    def picture(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))


@contextmanager
def chromium(profile: Path) -> Iterator[Page]:
    """A browser with one empty page, ended afterwards."""
    command = [str(CHROMIUM), *FLAGS, f"--user-data-dir={profile}", "--remote-debugging-port=0", "about:blank"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        told = profile / "DevToolsActivePort"
        end_s = time.monotonic() + 30
        while not (told.exists() and len(told.read_text().splitlines()) == 2):
            assert process.poll() is None, "the browser has ended"
            assert time.monotonic() < end_s, "the browser does not start"
            time.sleep(0.02)
        port, path = told.read_text().splitlines()
        with connect(f"ws://127.0.0.1:{port}{path}", ping_interval=None) as browser:
            browser.send(json.dumps({"id": 1, "method": "Target.createTarget", "params": {"url": "about:blank"}}))
            target = json.loads(browser.recv(timeout=30))["result"]["targetId"]
        address = f"ws://127.0.0.1:{port}/devtools/page/{target}"
        with connect(address, max_size=1 << 24, ping_interval=None) as link:
            yield Page(link)
    finally:
        process.kill()
        process.wait(10)
