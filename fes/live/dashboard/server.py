"""The dashboard's web server: files held in memory, one web socket a browser, and a stop that needs one request."""

import asyncio
import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Final

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from fes.live.dashboard.access import Access
from fes.live.dashboard.frames import StateBuffer
from fes.live.dashboard.message_handler import NAME, MessageHandler
from fes.live.dashboard.network_guard import NetworkGuard
from fes.live.status import Status

OWN: Final = ("page.css", "page.js", "link.js", "charts.js", "side.js", "words.js")
SHARED: Final = ("uPlot.iife.min.js", "uPlot.min.css")  # the report's
TYPES: Final = {"html": "text/html; charset=utf-8", "js": "text/javascript; charset=utf-8", "css": "text/css"}
BROWSERS: Final = 8
KEEP_ALIVE_S: Final = 0.4
SLOW_S: Final = 5.0  # a browser that takes no frame for so long is let go; it comes back by itself


def assets() -> dict[str, Response]:
    """Path → answer for all that there is."""
    places = {"/": ("fes.live.dashboard", "index.html")}
    places |= {f"/static/{name}": ("fes.live.dashboard", name) for name in OWN}
    places |= {f"/static/{name}": ("fes.report", name) for name in SHARED}
    return {
        path: Response(files(package).joinpath("static", name).read_bytes(), media_type=TYPES[name.rsplit(".", 1)[1]])
        for path, (package, name) in places.items()
    }


@dataclass(eq=False)
class Server:
    """The application, and the browsers that are connected.

    ``stop`` hands an emergency stop on, at once; it is given the press's name, which may be "". ``send`` hands another
    command on; False where that was not possible. ``on_link_used`` is called when a link has been used.
    """

    buffer: StateBuffer
    access: Access
    about: dict[str, Any]
    port: int
    new_token: Callable[[], str]
    stop: Callable[[str], None]
    send: Callable[[bytes], bool]
    on_link_used: Callable[[], None]

    def __post_init__(self) -> None:
        self._waiting: dict[WebSocket, asyncio.Event] = {}
        pages = [Route(path, answer, methods=["GET"]) for path, answer in assets().items()]
        self.app = Starlette(
            routes=[*pages, Route("/stop", self._on_stop, methods=["POST"]), WebSocketRoute("/live", self._on_browser)],
            middleware=[Middleware(NetworkGuard, port=self.port)],
        )

    @property
    def browsers(self) -> int:
        """How many are connected."""
        return len(self._waiting)

    def changed(self) -> None:
        """The buffer has something new."""
        for event in self._waiting.values():
            event.set()

    async def _on_stop(self, request: Request) -> Response:
        """An emergency stop: no token, no body, no look at who asks."""
        self.stop(request.query_params.get("press", "")[:NAME])
        return PlainTextResponse("stop\n")

    async def _on_browser(self, socket: WebSocket) -> None:
        if len(self._waiting) >= BROWSERS:
            await socket.close(1013, "too many browsers")
            return
        await socket.accept()
        self._waiting[socket] = asyncio.Event()
        handler = MessageHandler(self.access, self.about, self._newest, self.new_token)
        pushing: asyncio.Task[None] | None = None
        try:
            while True:
                outcome = handler.handle(await socket.receive_text(), time.monotonic_ns())
                if outcome.stop:
                    self.stop(outcome.press)
                if outcome.entered:
                    self.on_link_used()
                reply = outcome.reply
                if outcome.command and not self.send(outcome.command):
                    reply = {"said": "the session does not take it now; not done"}
                if reply is not None:
                    await asyncio.wait_for(socket.send_text(json.dumps(reply)), SLOW_S)
                if outcome.reply and "hello" in outcome.reply and pushing is None:
                    pushing = asyncio.create_task(self._push(socket, handler))
        except (WebSocketDisconnect, RuntimeError, TimeoutError, KeyError):  # gone, or sent bytes: either way done
            pass
        finally:
            del self._waiting[socket]
            if pushing is not None:
                pushing.cancel()

    async def _push(self, socket: WebSocket, handler: MessageHandler) -> None:
        """Frames to one browser, each when the one before has been taken; what it missed is in the next."""
        changed, seen = self._waiting[socket], 0
        with suppress(WebSocketDisconnect, RuntimeError, TimeoutError, OSError):
            while True:
                with suppress(TimeoutError):
                    await asyncio.wait_for(changed.wait(), KEEP_ALIVE_S)
                changed.clear()
                number = self.buffer.number
                frame = self.buffer.since(seen, time.monotonic_ns())
                frame |= {"role": handler.role, "browsers": len(self._waiting)}
                await asyncio.wait_for(socket.send_text(json.dumps(frame)), SLOW_S)
                seen = number

    def _newest(self, t_ns: int) -> tuple[Status | None, int]:
        heard_ns = self.buffer.heard_ns
        return self.buffer.newest, 0 if heard_ns is None else t_ns - heard_ns
